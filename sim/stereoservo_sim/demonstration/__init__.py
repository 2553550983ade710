"""The demonstration: an uncalibrated cell calibrates itself, records taught goals, and reaches them."""
