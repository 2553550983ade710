"""The demonstration: an uncalibrated cell calibrates itself, is shown goals, and reaches them."""
