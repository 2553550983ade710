"""Command ``stereoservo warmup``: compiles the numba kernels of the servo loop into the cache on disk."""

from __future__ import annotations

import time

from stereoservo.cli.output import JsonOption, emit
from stereoservo.daemon.kernel_compilation import compile_in_parallel, warm_up


def warmup(json: JsonOption = False) -> None:
    """Compile the kernels of the loop, so that the first start is as fast as any other."""
    began = time.monotonic()
    compile_in_parallel()
    warm_up()
    seconds = time.monotonic() - began
    emit({"seconds": seconds}, f"kernels are compiled ({seconds:.1f} s)", json)
