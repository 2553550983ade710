"""The demonstration: an uncalibrated cell calibrates itself, is taught goals, and reaches them."""
