"""Command ``stereoservo warmup``: compiles the numba kernels of the servo loop into the cache on disk."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from stereoservo.cli.output import CommandError, JsonOption, emit, log, shipped_or_path
from stereoservo.daemon.process_control import child_environment
from stereoservo.messages.compilation_progress import CompilationProgress, read_progress
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import REPORT_EVERY_S


def warmup(
    cell: Annotated[
        str,
        typer.Argument(
            metavar="[NAME|PATH]",
            help="Also compile what the detectors of this cell need: a file, or the name of a shipped cell.",
        ),
    ] = "",
    json: JsonOption = False,
) -> None:
    """Compile the kernels of the loop, so that the first start is as fast as any other."""
    if find_spec("numba") is None:
        raise ModuleNotFoundError(name="numba")
    began = time.monotonic()
    if cell:
        _warm_up_detectors(cell)
    code = _compile()
    if code != 0:
        raise CommandError("compilation", f"compiling ended with exit code {code}; its message is above")
    seconds = time.monotonic() - began
    emit({"seconds": seconds}, f"kernels are compiled ({seconds:.1f} s)", json)


def _compile() -> int:
    """Compile in a separate process, and print its progress; returns its exit code."""
    with TemporaryDirectory(prefix="stereoservo-warmup-") as told:
        command = [sys.executable, "-m", "stereoservo.daemon.kernel_compilation", str(os.getpid()), "alone", told]
        with subprocess.Popen(command, env=child_environment(), stdout=sys.stderr) as process:
            try:
                return _wait(process, Path(told))
            finally:
                process.kill()  # Ctrl-C is handled by this command alone


def _wait(process: subprocess.Popen[bytes], told: Path) -> int:
    known: tuple[CompilationProgress, ...] = ()
    while True:
        try:
            return process.wait(REPORT_EVERY_S)
        except subprocess.TimeoutExpired:
            progress = read_progress(told)
        if progress and progress != known:
            known = progress
            log(f"compiling: {progress[0].text}")


def _warm_up_detectors(cell: str) -> None:
    """Construct the drivers and detectors of a cell, which compiles missing kernels. Raises as `make_plan`."""
    from stereoservo.daemon.cell_preparation import make_plan
    from stereoservo.daemon.ipc_messages import PlanOptions
    from stereoservo.messages.cell_file import load_cell_file

    path = shipped_or_path(cell).absolute()
    directories = cell_directories(load_cell_file(path).cell.name)
    make_plan(path, directories.runtime, directories.state, PlanOptions("warmup"))
