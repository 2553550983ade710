"""Settings of the whole suite."""

import os

import pytest
from hypothesis import settings

# Before numpy is loaded: on two shared cores the threads of OpenBLAS only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# No deadline: the machines that run this are shared and stall, and kernels compile on first use.
settings.register_profile("stereoservo", deadline=None)
settings.load_profile("stereoservo")


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--hil CELL.toml``: tests/hil/test_can.py runs on the hardware of that cell, which then MOVES. docs/can.md."""
    parser.addoption(
        "--hil", metavar="CELL.toml", default=None,
        help="run tests/hil/test_can.py on the real cell of this file instead of emulated drives: the arm moves",
    )  # fmt: skip
