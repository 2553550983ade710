"""Commands of the drivers, found by entry point ``stereoservo.commands``."""
