"""``stereoservo emulate WHAT CELL``: runs emulated drives or cameras, or a conveyor, in place of a cell's hardware."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from stereoservo.daemon.process_control import Termination, die_with_parent
from stereoservo.messages.cell_file import CellFile, load_cell_file

PRIORITY = 5
"""SCHED_FIFO priority, if allowed: below the servo process, above processes that only compute."""
GRACE_S = 5.0


def emulate(
    what: Annotated[str, typer.Argument(help="What to stand in for: drives, cameras, conveyor.")],
    cell: Annotated[str, typer.Argument(metavar="CELL", help="A cell file (*.toml), or the name of a shipped cell.")],
    channel: Annotated[
        str | None,
        typer.Option(
            "--channel",
            help="drives: socket://127.0.0.1:PORT (0: free), pty, or INTERFACE:CHANNEL of python-can; cameras: "
            "http://127.0.0.1:PORT. Default: the cell's.",
        ),
    ] = None,
    bit_time: Annotated[
        bool | None,
        typer.Option(
            "--bit-time/--no-bit-time",
            help="drives: frames take their time on the wire. Default: the cell's.",
        ),
    ] = None,
    order: Annotated[
        list[str] | None,
        typer.Option(
            "--order",
            help='An order, e.g. "fault 3 0x3210 @ 2.0s", "freeze left for 2s"; may be repeated. `help` lists them.',
        ),
    ] = None,
    parent: Annotated[int, typer.Option("--parent", help="End when the process of this number ends.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Events as JSON lines on stdout.")] = False,
) -> None:
    """Put emulated drives or cameras, those of the simulated arm, in the place of real ones; orders come from stdin. Or
    run the belt of a simulated cell, until Ctrl-C.
    """
    if what not in KINDS:
        raise typer.BadParameter(f"{what!r} cannot be emulated; there is: {', '.join(KINDS)}", param_hint="WHAT")
    if parent:
        die_with_parent(parent, signal.SIGTERM)
    termination = Termination(grace_s=GRACE_S)
    KINDS[what](_Settings(cell, channel, bit_time, tuple(order or ()), json), termination)


@dataclass(frozen=True)
class _Settings:
    cell: str
    channel: str | None
    bit_time: bool | None
    orders: tuple[str, ...]
    as_json: bool


def _cell_path(cell: str) -> Path:
    from stereoservo_sim.cells import shipped_cell_path

    if cell.endswith(".toml"):
        return Path(cell)
    try:
        return shipped_cell_path(cell)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="CELL") from error


def _drives(settings: _Settings, termination: Termination) -> None:
    from stereoservo.messages.directories import cell_directories, create_directories
    from stereoservo.messages.locks import FileLock
    from stereoservo_sim.world.history import FILE_NAME

    path = _cell_path(settings.cell)
    cell = load_cell_file(path)
    directories = cell_directories(cell.cell.name)
    create_directories(directories)
    # While it is held, a daemon that cleans up this directory leaves the truth file.
    lock = directories.runtime / f"{FILE_NAME}.lock"
    with FileLock(lock, f"the emulated arm of cell {cell.cell.name!r}"):
        _serve(path, cell, directories.runtime, settings, termination)


@contextlib.contextmanager
def _named(path: Path, key: str) -> Iterator[None]:
    """Error of a cell's options, with its file and section."""
    from stereoservo.ports.devices import DriverError
    from stereoservo_sim.emulators.fault_engine import EmulationError

    try:
        yield
    except EmulationError as error:
        raise EmulationError(f"{path}: {error}") from error
    except DriverError as error:
        raise DriverError(error.code, f"{path}: {key}: {error}", **error.data) from error


def _serve(path: Path, cell: CellFile, runtime_dir: Path, settings: _Settings, termination: Termination) -> None:
    from stereoservo_sim.emulators.bus.bus_server import BusServer, open_endpoint, served_channel
    from stereoservo_sim.emulators.bus.factory import drives_of_cell, make_bus_emulator
    from stereoservo_sim.emulators.console import Printer, begin_serving
    from stereoservo_sim.emulators.fault_engine import FaultCommandError

    with _named(path, "joints.options"):
        options, drives = drives_of_cell(cell, path.parent)
    if settings.bit_time is not None:
        drives = msgspec.structs.replace(drives, bit_time=settings.bit_time)
    endpoint = open_endpoint(settings.channel or served_channel(options), options.bitrate)
    try:
        with _named(path, "joints.options"):
            emulator = make_bus_emulator(
                options,
                drives,
                t_ns=time.monotonic_ns(),
                runtime_dir=runtime_dir,
                cell_dir=path.parent,
                mount=cell.camera[0].mount,
            )
    except BaseException:
        endpoint.close()
        raise
    try:
        for text in settings.orders:
            emulator.order(text, emulator.t_ns)
    except FaultCommandError as error:
        endpoint.close()
        raise typer.BadParameter(str(error), param_hint="--order") from error
    printer = Printer(settings.as_json)
    server = BusServer(emulator, endpoint)
    begin_serving(
        server,
        printer,
        PRIORITY,
        f"listening on {server.channel}",
        channel=server.channel,
        nodes=[joint.node_id for joint in options.joint],
        bit_time=drives.bit_time,
    )
    try:
        server.run(lambda: termination.asked)
    finally:
        printer.say("end", server.stalls.words(), **msgspec.to_builtins(server.stalls))
        printer.end()


def _cameras(settings: _Settings, termination: Termination) -> None:
    from stereoservo_sim.emulators.cameras.stream_server import serve_cameras
    from stereoservo_sim.emulators.fault_engine import FaultCommandError

    if settings.bit_time is not None:
        raise typer.BadParameter("cameras have no bus; it is for drives", param_hint="--bit-time")
    path = _cell_path(settings.cell)
    with _named(path, "emulate.cameras"):
        try:
            serve_cameras(
                load_cell_file(path),
                path.parent,
                channel=settings.channel,
                orders=settings.orders,
                as_json=settings.as_json,
                ended=lambda: termination.asked,
            )
        except FaultCommandError as error:
            raise typer.BadParameter(str(error), param_hint="--order") from error


def _conveyor(settings: _Settings, termination: Termination) -> None:
    """Run the belt until the end; the part then stays at its position."""
    from stereoservo.messages.directories import cell_directories, create_directories
    from stereoservo_sim.emulators.console import Printer
    from stereoservo_sim.emulators.fault_engine import EmulationError
    from stereoservo_sim.world.conveyor import ConveyorError, conveyor_of
    from stereoservo_sim.world.workpiece import MovedFile

    for given, option in (
        (settings.channel, "--channel"),
        (settings.bit_time, "--bit-time"),
        (settings.orders, "--order"),
    ):
        if given not in (None, ()):
            raise typer.BadParameter("a conveyor has none; it is for drives or cameras", param_hint=option)
    path = _cell_path(settings.cell)
    cell = load_cell_file(path)
    try:
        conveyor = conveyor_of(cell)
    except ConveyorError as error:
        raise EmulationError(f"{path}: {error}") from error
    if conveyor is None:
        raise EmulationError(f"{path}: no [emulate.conveyor]; the shipped cell 'conveyor' has it")
    directories = cell_directories(cell.cell.name)
    create_directories(directories)
    file, running = MovedFile(directories.runtime), conveyor.running(time.monotonic_ns())
    file.write(running)
    printer = Printer(settings.as_json)
    printer.say(
        "ready",
        f"the belt runs at {conveyor.velocity_m_s} m/s, as {file.path} says; Ctrl-C stops it",
        velocity_m_s=conveyor.velocity_m_s,
        for_s=conveyor.for_s,
        t_ns=running.since_ns,
        pid=os.getpid(),
    )
    while not termination.asked:
        time.sleep(0.05)
    stopped = running.at(time.monotonic_ns())
    file.write(stopped)
    printer.say("end", f"the belt stands, the part at {stopped.shift_m} m", shift_m=stopped.shift_m)
    printer.end()


KINDS = {"drives": _drives, "cameras": _cameras, "conveyor": _conveyor}
