"""Settings of the whole suite."""

import os

from hypothesis import settings

# Before numpy is loaded: on two shared cores the threads of OpenBLAS only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# No deadline: the machines that run this are shared and stall, and kernels compile on first use.
settings.register_profile("stereoservo", deadline=None)
settings.load_profile("stereoservo")
