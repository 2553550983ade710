"""Settings of the whole suite."""

from hypothesis import settings

# No deadline: the machines that run this are shared and stall, and kernels compile on first use.
settings.register_profile("stereoservo", deadline=None)
settings.load_profile("stereoservo")
