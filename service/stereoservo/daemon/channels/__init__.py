"""Channels for what must not be lost between processes whose ends may die, hang or start anew."""
