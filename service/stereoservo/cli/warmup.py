"""Command ``stereoservo warmup``: compiles the numba kernels of the servo loop into the cache on disk."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from importlib.util import find_spec

from stereoservo.cli.output import CommandError, JsonOption, emit
from stereoservo.daemon.process_control import child_environment


def warmup(json: JsonOption = False) -> None:
    """Compile the kernels of the loop, so that the first start is as fast as any other."""
    if find_spec("numba") is None:
        raise ModuleNotFoundError(name="numba")
    began = time.monotonic()
    command = [sys.executable, "-m", "stereoservo.daemon.kernel_compilation", str(os.getpid())]
    done = subprocess.run(command, env=child_environment(), stdout=sys.stderr, check=False)
    if done.returncode != 0:
        raise CommandError(
            "compilation", f"compiling ended with exit code {done.returncode}; its message is above"
        )
    seconds = time.monotonic() - began
    emit({"seconds": seconds}, f"kernels are compiled ({seconds:.1f} s)", json)
