"""Experiment: a camera is bumped, a joint's zero goes off, a marker slips while a moving target is followed; what the
watch over the model names, how soon, and what it names where nothing happened.

The cells, motions and goals of `moving_targets`. Each fault moves the pixels by some px rms; it comes while the
target moves, and the first verdict after it counts.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.core.cycle import Event
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointState
from stereoservo_sim.experiments.laws.driven_tasks import labelled, picture, saved
from stereoservo_sim.experiments.laws.moving_targets import (
    CELLS,
    GAIN,
    LAWS,
    MOTIONS,
    NOISE_PX,
    RATE_HZ,
    under_way,
    world_of,
)
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.workpiece import Moved

Fault = Literal["camera bumped", "joint zero drifts", "joint zero jumps", "marker slipped"]
FAULTS: dict[Fault, tuple[str, ...]] = {
    "camera bumped": ("camera_moved",), "joint zero drifts": ("joint_zero", "JOINT_NOT_FOLLOWING"),
    "joint zero jumps": ("joint_zero", "JOINT_NOT_FOLLOWING"), "marker slipped": ("marker_slipped",),
}  # fmt: skip
"""What happens, and the verdicts and faults that name it."""
FAULT_PX: dict[Fault, tuple[float, float]] = {
    "camera bumped": (2.0, 10.0), "joint zero drifts": (2.0, 10.0), "joint zero jumps": (10.0, 40.0),
    "marker slipped": (2.0, 10.0),
}  # fmt: skip
"""How far it moves the markers that it moves in the images [px], rms."""
BEFORE_S, AFTER_S = 1.5, 1.5
"""The target moves, then there is a fault, and the watch has so long to name it."""
UNCLEAR = "unclear"
"""The verdict that something is wrong which several causes explain alike; it names none."""
DRIFT_NS, JUMP_NS = 1_000_000_000, 20_000_000
"""In which a joint's zero drifts, and jumps: within a frame."""


@dataclass(frozen=True)
class Named:
    """What was named: the ``verdict`` and its ``subject``, '' where nothing was, ``delay_s`` after the fault, whether
    that is ``right``, of a fault of ``size_px``; ``early``: verdicts before it; ``unclear``: whether it was told that
    something is wrong before, or without, what it is.
    """

    verdict: str
    subject: str
    right: bool
    delay_s: float
    size_px: float
    motion: str
    early: tuple[str, ...]
    unclear: bool


def run_moving_faults(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Every place and fault with ``seeds`` seeds from ``seed`` on, motions in turn; the JSON object of the command."""
    rows: list[dict[str, Any]] = []
    conditions = [(place, fault) for place in CELLS for fault in FAULTS]
    for k, (place, fault) in enumerate(conditions):
        flown = []
        for s in range(seeds):
            progress("conditions and seeds", k * seeds + s, len(conditions) * seeds)
            flown.append(disturb(place, fault, list(MOTIONS)[s % len(MOTIONS)], seed + s))
        named = [one for one in flown if one.verdict]
        delays = [one.delay_s for one in flown if one.right] or [float("nan")]
        wrong = Counter(f"{one.verdict} {one.subject}".strip() for one in named if not one.right)
        missed = [one.size_px for one in flown if not one.verdict]
        rows.append(
            {
                "cameras": place,
                "fault": fault,
                "events": seeds,
                "right": sum(one.right for one in flown),
                "wrong": sum(wrong.values()),
                "none": len(missed),
                "unclear_first": sum(one.unclear for one in flown),
                "delay_median_s": _number(float(np.median(delays))),
                "delay_largest_s": _number(float(np.max(delays))),
                "largest_missed_px": max(missed, default=0.0),
                "named_instead": ", ".join(f"{name} ({count})" for name, count in sorted(wrong.items())),
                "false_verdicts": sum(len(one.early) for one in flown),
            }
        )
    return {
        "experiment": "moving-faults",
        "rows": rows,
        "seed": seed,
        "seeds": seeds,
        "false_verdicts": sum(row["false_verdicts"] for row in rows),
        "watched_s": len(conditions) * seeds * (1.0 + BEFORE_S),
        "assumptions": [
            f"exact model, {NOISE_PX:g} px noise a marker, cameras at {RATE_HZ:g} Hz, loop at 250 Hz, gain {GAIN:g}/s",
            f"motions in turn: {', '.join(MOTIONS)}",
            f"the fault comes {BEFORE_S:g} s after the target sets out, and moves what it moves by "
            + ", ".join(f"{low:g} to {high:g} px ({fault})" for fault, (low, high) in FAULT_PX.items())
            + f"; the first verdict or fault within {AFTER_S:g} s that names a cause counts",
            "unclear_first: one that names none came before, or alone",
            "before carried cameras a zero that drifts looks like a target that moves otherwise: it is followed",
            "bumped: one camera turned; zeros drift within 1 s, jump within 20 ms; a marker slips in its face's plane",
            "false verdicts: all that came before the fault, in watched_s seconds in all",
        ],
    }


def disturb(place: str, fault: Fault, name: str, seed: int) -> Named:
    """Follow a target, and disturb the cell; deterministic given the seed."""
    world = world_of(place)
    history = TrueJointHistory.in_memory(len(world.base), capacity=1 << 14)
    with under_way(place, LAWS[place][-1], name, seed, history, follows=True) as (cell, _, _):
        cell.run_for(BEFORE_S)
        return named_after(cell, world, history, fault, name, seed)


def named_after(
    cell: LockstepCell, world: SimulatedCell, history: TrueJointHistory, fault: Fault, name: str, seed: int
) -> Named:
    """What is named after a fault that comes now."""
    rng = np.random.default_rng([seed, list(FAULTS).index(fault), 37])
    size_px = float(rng.uniform(*FAULT_PX[fault]))
    onset_ns, newest = cell.clock.now_ns(), history.newest()
    assert newest is not None  # the arm was enabled
    subject = _DISTURBANCES[fault](cell, world, newest[1].copy(), size_px, rng)
    cell.run_for(AFTER_S)
    told = [e for e in cell.events if (e.kind == "health" and e.name != "ok") or e.kind == "fault"]
    early = tuple(_verdict(e) for e in told if e.t_ns <= onset_ns)
    late = [e for e in told if e.t_ns > onset_ns and _verdict(e) != UNCLEAR]
    unclear = any(_verdict(e) == UNCLEAR for e in told if e.t_ns > onset_ns)
    if not late:
        return Named("", "", False, float("nan"), size_px, name, early, unclear)
    verdict, delay_s = _verdict(late[0]), 1e-9 * (late[0].t_ns - onset_ns)
    right = verdict in FAULTS[fault] and _subject(late[0]) == subject
    return Named(verdict, _subject(late[0]), right, delay_s, size_px, name, early, unclear)


def _number(value: float) -> float | None:
    """A finite number, else None: what no event was named in has no delay."""
    return value if np.isfinite(value) else None


def _verdict(event: Event) -> str:
    """The verdict of the watch over the model, or the code of a fault."""
    return event.name if event.kind == "health" else ", ".join(reason.code for reason in event.reasons)


def _subject(event: Event) -> str:
    return event.reasons[0].subject if event.reasons else ""


def _pixels(world: SimulatedCell, q: FloatArray) -> FloatArray:
    return np.array(list(world.truth_pixels(q).values()))


def _bump(
    cell: LockstepCell, world: SimulatedCell, q: FloatArray, size_px: float, rng: np.random.Generator
) -> str:
    """Turn one camera about a random axis in its own frame."""
    c = int(rng.integers(len(cell.cameras)))
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    camera = world.rig.cameras[c]
    before = _pixels(world, q)[c]

    def turned(degrees: float) -> Moved:
        x, y, z = (degrees * axis).tolist()
        return Moved((0.0, 0.0, 0.0), (x, y, z))

    moved = world.in_world(camera.moved_by(turned(1.0).matrix), q)
    after = moved.image_of(world.marker_positions(q))[0]
    driver: Any = cell.cameras[c]
    driver.bump(turned(size_px / _rms(after - before)))
    return camera.name


def _rms(change: FloatArray) -> float:
    """Root mean square distance [px] of pixels (..., 2)."""
    return float(np.sqrt((change**2).sum(axis=-1).mean()))


def _drift(
    cell: LockstepCell, world: SimulatedCell, q: FloatArray, size_px: float, rng: np.random.Generator
) -> str:
    return _zero_off(cell, world, q, size_px, rng, DRIFT_NS)


def _jump(
    cell: LockstepCell, world: SimulatedCell, q: FloatArray, size_px: float, rng: np.random.Generator
) -> str:
    return _zero_off(cell, world, q, size_px, rng, JUMP_NS)


def _zero_off(
    cell: LockstepCell,
    world: SimulatedCell,
    q: FloatArray,
    size_px: float,
    rng: np.random.Generator,
    over_ns: int,
) -> str:
    """Have one joint's encoder read otherwise than before, coming about ``over_ns``."""
    joint = int(rng.integers(len(q)))
    small = 1e-4 * np.eye(len(q))[joint]
    slope = _rms(_pixels(world, q + small) - _pixels(world, q)) / 1e-4
    offset = float(rng.choice((-1.0, 1.0))) * size_px / slope
    since_ns, driver = cell.clock.now_ns(), cell.joints
    read: Any = driver.read_state

    def off() -> JointState:
        state: JointState = read()
        positions = state.positions.copy()
        positions[joint] += offset * min(1.0, (state.t_ns - since_ns) / over_ns)
        return msgspec.structs.replace(state, positions=positions)

    arm: Any = driver
    arm.read_state = off
    return cell.settings.joint_names[joint]


def _slip_marker(
    cell: LockstepCell, world: SimulatedCell, q: FloatArray, size_px: float, rng: np.random.Generator
) -> str:
    """Move one of the markers that both cameras see in the plane of its face."""
    seen = np.all([world.visible(q, camera) for camera in world.rig.cameras], axis=0)
    row = int(rng.choice(np.flatnonzero(seen)))
    marker = int(world.body.ids[row])
    angle = float(rng.uniform(0.0, 2.0 * np.pi))
    direction = np.array([np.cos(angle), np.sin(angle)])

    def slipped(metres: float) -> SimulatedCell:
        faces = []
        for face in world.body.faces:
            shift = np.where(np.asarray(face.ids)[:, None] == marker, metres * direction, 0.0)
            faces.append(replace(face, positions=face.positions + shift))
        return replace(world, body=replace(world.body, faces=tuple(faces)))

    slope = _rms((_pixels(slipped(1e-4), q) - _pixels(world, q))[:, row]) / 1e-4
    there = slipped(size_px / slope)
    for camera in cell.cameras:
        driver: Any = camera
        driver.cell, driver._cell = (replace(one, body=there.body) for one in (driver.cell, driver._cell))
    return str(marker)


_DISTURBANCES = {
    "camera bumped": _bump, "joint zero drifts": _drift, "joint zero jumps": _jump, "marker slipped": _slip_marker,
}  # fmt: skip
"""Each does it to a cell, and returns the subject that is to be named."""


def draw_moving_faults(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Named rightly, wrongly and not at all, a bar a row. Raises OSError."""
    figure = picture(7, 4)
    axis = figure.subplots(1, 1)
    rows, under = answer["rows"], np.zeros(len(answer["rows"]))
    for what in ("right", "wrong", "none"):
        counts = np.array([row[what] for row in rows], dtype=np.float64)
        axis.bar(range(len(rows)), counts, bottom=under, label=what)
        under += counts
    axis.set_xticks(
        range(len(rows)), [f"{row['cameras']}\n{row['fault']}" for row in rows], fontsize=6, rotation=60
    )
    axis.legend()
    labelled(axis, "named while a moving target is followed", "", "events")
    return [saved(figure, folder, "moving-faults")]
