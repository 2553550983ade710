"""Lifetime of a cell's emulated cameras, as run by ``stereoservo emulate cameras``."""

from __future__ import annotations

import contextlib
import gc
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2

from stereoservo.messages.cell_file import CellFile
from stereoservo.messages.directories import cell_directories
from stereoservo.ports.clock import MonotonicClock
from stereoservo_sim.emulators.cameras.camera_emulator import CameraEmulator
from stereoservo_sim.emulators.cameras.emulated_camera import EmulatedCamera
from stereoservo_sim.emulators.cameras.stream_server import CameraServer
from stereoservo_sim.emulators.cameras.stream_settings import CamerasSettings, cameras_of_cell, port_of
from stereoservo_sim.emulators.console import Console, Printer

PRIORITY = 3
"""SCHED_FIFO where it is allowed: real cameras take no processor; below the servo process and emulated drives."""


def make_camera_emulator(
    cell: CellFile, settings: CamerasSettings, runtime_dir: Path, cell_dir: Path = Path()
) -> CameraEmulator:
    """The cameras of ``settings``, mounted as those of the cell are, before its arm; ``cell_dir``: of the cell file.

    Raises DriverError.
    """
    clock = MonotonicClock()
    cameras = [
        EmulatedCamera(
            stream,
            settings,
            clock=clock,
            mount=cell.camera[0].mount,
            runtime_dir=runtime_dir,
            cell_dir=cell_dir,
            arm=cell.arm_options,
        )
        for stream in settings.camera
    ]
    return CameraEmulator(cameras, time.monotonic_ns())


def serve_cameras(
    cell: CellFile,
    cell_dir: Path,
    *,
    channel: str | None,
    orders: Sequence[str],
    as_json: bool,
    ended: Callable[[], bool],
) -> None:
    """Serve until ``ended``; ``cell_dir``: of the cell file. Raises EmulationError, DriverError, FaultCommandError."""
    settings = cameras_of_cell(cell)
    port = settings.port if channel is None else port_of(channel)
    cv2.setNumThreads(1)  # on small images they only wait for each other
    emulator = make_camera_emulator(cell, settings, cell_directories(cell.cell.name).runtime, cell_dir)
    for text in orders:
        emulator.order(text, emulator.start_ns)
    server = CameraServer(emulator, cell=cell.cell.name, port=port, connections=settings.connections)
    emulator.open()
    printer = Printer(as_json)
    console = Console(server, printer)
    console.attach()
    with contextlib.suppress(OSError):  # not allowed: then without
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    gc.freeze()  # what was imported is not looked through again
    printer.say(
        "ready", f"listening on {server.url}: {', '.join(server.streams.values())}", channel=server.url,
        streams={name: server.url + path for name, path in server.streams.items()}, t_ns=emulator.start_ns,
        pid=os.getpid(),
    )  # fmt: skip
    try:
        server.run(ended)
    finally:
        printer.say(
            "end", server.words(), pictures=server.pictures, withheld=server.withheld, late_ns=server.late_ns
        )
        printer.end()
