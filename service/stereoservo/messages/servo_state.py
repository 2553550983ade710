"""State of the servo process without the numerical libraries: its record in shared memory, readable by any process, and
the state message for clients.
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
from stereoservo.messages.status import CoreStatus, Halt, Health, RefinementState, StatusHeader
from stereoservo.messages.wire import LoopInfo, StateMessage

STATE_LAYOUT = "ServoState.1"
"""Layout of the records of `daemon.ipc_messages.ServoState` in their slot."""
MAX_PLAN_BYTES = 1 << 24
STALE_S = 0.6
"""Time [s] without a sample after which a source counts as lost, for a camera also ``STALE_PERIODS`` of its periods:
its values are then unknown.
"""
STALE_PERIODS = 3.0
NO_CAMERA = "no camera delivers frames: whether the model still holds is unknown"
NO_FRAMES = "no camera delivers frames: the reasons CAMERA_SILENT state why; goals by joints need none"
COMMISSIONING_SPEED = 0.05
"""Fraction of the cell's speed that `run --commissioning` allows."""


class Numbers:
    """An array of numbers from a record, without numpy."""

    def __init__(self, values: tuple[float, ...]) -> None:
        self.values = values

    def __iter__(self) -> Iterator[float]:
        return iter(self.values)


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
    """The part of a `daemon.ipc_messages.ServoState` that clients receive."""

    status: CoreStatus[Numbers]
    loop: LoopStatistics
    driver_active: bool
    records_dropped: int
    differences: tuple[str, ...]
    notes: tuple[str, ...] = ()
    auxiliary: dict[str, float] = {}
    joints_ns: int = 0
    frames_ns: dict[str, int] = {}


class _Name(msgspec.Struct):
    name: str


class _Cell(msgspec.Struct):
    cell: _Name


class _Joints(msgspec.Struct):
    joints: tuple[_Name, ...]


class _Camera(msgspec.Struct):
    name: str
    rate_hz: float


class RunRecord(msgspec.Struct):
    """The part of a `daemon.ipc_messages.RunPlan` that is used in the state message."""

    cell: _Cell
    boot: str
    joints: _Joints
    cameras: tuple[_Camera, ...]
    dry_run: bool = False


def _numbers(kind: type, value: Any) -> Numbers:
    """msgspec ``dec_hook``. Raises ValueError or TypeError for values that are no array of 64-bit floats."""
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
    now_ns: int,
    servo_alive: bool,
    last_event: int,
    notes: tuple[str, ...] = (),
    refused_messages: int = 0,
    refinement: RefinementState | None = None,
    halt: Halt | None = None,
) -> StateMessage:
    """The state in the clients' format, with the ages of its sources at ``now_ns``.

    Numbers that are not finite, and values whose source is lost, are left out. ``run``: a `RunRecord` or the run plan
    itself; ``state``: a `StateRecord` or the servo process's own `ServoState`.
    """
    status, loop = state.status, state.loop
    joints_age_s = _age_s(state.joints_ns, now_ns)
    measured = _fresh(joints_age_s)
    names = tuple(joint.name for joint in run.joints.joints)
    cameras = {camera.name: _age_s(state.frames_ns.get(camera.name, 0), now_ns) for camera in run.cameras}
    fresh = {camera.name for camera in run.cameras if _fresh(cameras[camera.name], camera.rate_hz)}
    header: dict[str, Any] = {name: getattr(status, name) for name in StatusHeader.__struct_fields__}
    if not fresh:
        header["reasons"] = tuple(
            msgspec.structs.replace(reason, hint=NO_FRAMES) if reason.code == "FEATURES_STALE" else reason
            for reason in status.reasons
        )
    return StateMessage(
        **header,
        cell=run.cell.cell.name,
        boot=boot,
        t_wall=time.time() - (time.monotonic_ns() - status.t_ns) * 1e-9,
        joints=_finite(names, status.positions if measured else None),
        velocities=_finite(names, status.velocities if measured else None),
        command=_finite(names, status.command),
        error_px=_number(status.error_px) if fresh else None,
        task_error=tuple(float(x) for x in status.task_error if math.isfinite(x)),
        innovation_px={
            name: value for name, value in status.innovation_px.items() if name in fresh and math.isfinite(value)
        },
        visible={name: count for name, count in status.visible.items() if name in fresh},
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
        efforts=_finite(names, status.efforts if measured else None),
        following_errors=_finite(names, status.following_errors if measured else None),
        effort_limits=_finite(names, status.effort_limits),
        following_limits=_finite(names, status.following_limits),
        health=_health(status.health, fresh),
        auxiliary={name: value for name, value in state.auxiliary.items() if measured and math.isfinite(value)},
        joints_age_s=joints_age_s,
        camera_age_s=cameras,
        halt=halt,
    )


def _age_s(t_ns: int, now_ns: int) -> float | None:
    """Age [s] of the stamp ``t_ns``, to the millisecond; None for 0: no data yet."""
    return round((now_ns - t_ns) * 1e-9, 3) if t_ns else None


def _fresh(age_s: float | None, rate_hz: float = math.inf) -> bool:
    """Whether a source that delivers at ``rate_hz`` is alive."""
    return age_s is not None and age_s <= silence_limit_s(rate_hz)


def silence_limit_s(rate_hz: float) -> float:
    """Age [s] above which a source that delivers at ``rate_hz`` counts as lost."""
    return max(STALE_S, STALE_PERIODS / rate_hz)


def _health(health: Health, fresh: set[str]) -> Health:
    """The health of the model by the ``fresh`` cameras; a diagnosis that is not ``ok`` is kept."""
    cameras = {name: camera for name, camera in health.cameras.items() if name in fresh}
    if not fresh and health.verdict == "ok":
        return msgspec.structs.replace(health, verdict="unknown", text=NO_CAMERA, cameras=cameras)
    return msgspec.structs.replace(health, cameras=cameras)


def _number(value: float | None) -> float | None:
    """A finite number, else None."""
    return float(value) if value is not None and math.isfinite(value) else None


def _finite(names: tuple[str, ...], values: Iterable[float] | None) -> dict[str, float]:
    if values is None:
        return {}
    return {name: float(value) for name, value in zip(names, values, strict=True) if math.isfinite(value)}
