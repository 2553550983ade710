"""State of the servo process without the numerical libraries: its record in shared memory, as any process may read it,
and the message of it that clients get.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from stereoservo.messages.files import read_bounded
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Health, RefinementState
from stereoservo.messages.wire import LoopInfo, StateMessage

STATE_LAYOUT = "ServoState.1"
"""Of the records of `daemon.ipc_messages.ServoState` in their slot."""
MAX_PLAN_BYTES = 1 << 24
COMMISSIONING_SPEED = 0.05
"""Share of the cell's speed that `run --commissioning` leaves."""


class Numbers:
    """An array of numbers out of a record, without numpy."""

    def __init__(self, values: tuple[float, ...]) -> None:
        self.values = values

    def __iter__(self) -> Iterator[float]:
        return iter(self.values)


class _Status(msgspec.Struct):
    t_ns: int
    lifecycle: str
    model: str
    model_epoch: int
    source: str
    goal: str
    law: str
    level: str
    reasons: tuple[Reason, ...]
    positions: Numbers
    velocities: Numbers
    command: Numbers
    error_px: float | None
    task_error: Numbers
    innovation_px: dict[str, float]
    visible: dict[str, int]
    progress: float | None = None
    seconds_left: float | None = None
    efforts: Numbers | None = None
    following_errors: Numbers | None = None
    effort_limits: Numbers | None = None
    following_limits: Numbers | None = None
    health: Health = Health()


class LoopStatistics(msgspec.Struct, frozen=True):
    """Counts and quantiles of the loop's cycles since its start. Lateness: time of waking after the slot [us]."""

    rate_hz: float
    cycles: int
    overruns: int
    skipped: int
    p50_us: float
    p99_us: float
    max_us: float
    work_p50_us: float
    work_p99_us: float
    work_max_us: float


class StateRecord(msgspec.Struct):
    """What of a `daemon.ipc_messages.ServoState` clients are told."""

    status: _Status
    loop: LoopStatistics
    driver_active: bool
    records_dropped: int
    differences: tuple[str, ...]
    notes: tuple[str, ...] = ()
    auxiliary: dict[str, float] = {}


class _Name(msgspec.Struct):
    name: str


class _Cell(msgspec.Struct):
    cell: _Name


class _Joints(msgspec.Struct):
    joints: tuple[_Name, ...]


class RunRecord(msgspec.Struct):
    """What of a `daemon.ipc_messages.RunPlan` goes into the state's message."""

    cell: _Cell
    boot: str
    joints: _Joints
    dry_run: bool = False


def _numbers(kind: type, value: Any) -> Numbers:
    """msgspec ``dec_hook``. Raises ValueError, TypeError for what is no array of 64-bit floats."""
    name, _, data = value
    if name != "<f8" or len(data) % 8:
        raise ValueError(f"an array of {name!r:.40}; 64-bit floats are needed")
    return Numbers(struct.unpack(f"<{len(data) // 8}d", data))


_state_decoder = msgspec.msgpack.Decoder(StateRecord, dec_hook=_numbers)
_run_decoder = msgspec.msgpack.Decoder(RunRecord)


def decode_state(record: bytes) -> StateRecord:
    """The state in a slot's record. Raises msgspec.MsgspecError."""
    return _state_decoder.decode(record)


def plan_path(runtime: Path) -> Path:
    """The file of the run plan in a cell's runtime directory."""
    return runtime / "plan.msgpack"


def read_run(runtime: Path) -> RunRecord:
    """The run whose runtime directory this is. Raises OSError, ValueError, msgspec.MsgspecError."""
    return _run_decoder.decode(read_bounded(plan_path(runtime), MAX_PLAN_BYTES))


def state_message(
    run: Any,
    boot: str,
    state: Any,
    *,
    servo_alive: bool,
    last_event: int,
    notes: tuple[str, ...] = (),
    refused_messages: int = 0,
    refinement: RefinementState | None = None,
) -> StateMessage:
    """The state in the clients' format; numbers that are not finite are left out.

    ``run``: a `RunRecord` or the run plan itself; ``state``: a `StateRecord` or the servo process's own `ServoState`.
    """
    status, loop = state.status, state.loop
    names = tuple(joint.name for joint in run.joints.joints)
    now_ns = time.monotonic_ns()
    return StateMessage(
        cell=run.cell.cell.name,
        boot=boot,
        t_ns=status.t_ns,
        t_wall=time.time() - (now_ns - status.t_ns) * 1e-9,
        lifecycle=status.lifecycle,
        model=status.model,
        model_epoch=status.model_epoch,
        source=status.source,
        goal=status.goal,
        law=status.law,
        level=status.level,
        reasons=tuple(status.reasons),
        joints=_finite(names, status.positions),
        velocities=_finite(names, status.velocities),
        command=_finite(names, status.command),
        error_px=_number(status.error_px),
        task_error=tuple(float(x) for x in status.task_error if math.isfinite(x)),
        innovation_px={name: value for name, value in status.innovation_px.items() if math.isfinite(value)},
        visible=status.visible,
        loop=LoopInfo(
            rate_hz=loop.rate_hz,
            cycles=loop.cycles,
            overruns=loop.overruns,
            skipped=loop.skipped,
            lateness_us={"p50": loop.p50_us, "p99": loop.p99_us, "max": loop.max_us},
            work_us={"p50": loop.work_p50_us, "p99": loop.work_p99_us, "max": loop.work_max_us},
            records_dropped=state.records_dropped,
        ),
        driver_active=state.driver_active,
        servo_alive=servo_alive,
        dry_run=run.dry_run,
        differences=state.differences,
        last_event=last_event,
        notes=(*notes, *state.notes),
        refused_messages=refused_messages,
        refinement=refinement,
        progress=_number(status.progress),
        seconds_left=_number(status.seconds_left),
        efforts=_finite(names, status.efforts),
        following_errors=_finite(names, status.following_errors),
        effort_limits=_finite(names, status.effort_limits),
        following_limits=_finite(names, status.following_limits),
        health=status.health,
        auxiliary={name: value for name, value in state.auxiliary.items() if math.isfinite(value)},
    )


def _number(value: float | None) -> float | None:
    """A finite number, else None."""
    return float(value) if value is not None and math.isfinite(value) else None


def _finite(names: tuple[str, ...], values: Iterable[float] | None) -> dict[str, float]:
    if values is None:
        return {}
    return {name: float(value) for name, value in zip(names, values, strict=True) if math.isfinite(value)}
