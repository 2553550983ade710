"""An interrupt whose exception was lost still ends a wait."""

from __future__ import annotations

import subprocess
import sys

SWALLOWS = """
import os, signal
from stereoservo.cli import interruption

class Swallower:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)  # what is raised in a destructor is printed and lost
        for _ in range(1000):
            pass

interruption.check()
interruption.install()
swallower = Swallower()
del swallower
print("lost")
try:
    interruption.check()
except KeyboardInterrupt:
    print("remembered")
"""


def test_an_interrupt_that_a_destructor_swallowed_is_remembered() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SWALLOWS], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.split() == ["lost", "remembered"], done.stderr
    assert "KeyboardInterrupt" in done.stderr
