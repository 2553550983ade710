"""Experiments: moving targets, followed by cameras on the arm, on a pan-tilt head, and before static cameras
(``moving-targets``), and faults meanwhile (``moving-faults``).

The demo's arm, or the head (thesis 4.5.4), in lockstep. With cameras on the arm the marker body slides or oscillates,
and the goal is to keep its initial image. With static cameras the workpiece slides beside the body, and the goal is
that the body stays beside it. Or both are on a turntable. The two degrees of freedom of a head keep one marker at its
initial pixel in one camera. Evaluated against ground truth, which the core never sees.

Faults: a camera is bumped, a joint's zero changes, a marker slips. Recorded are the fault that the model monitor
names, the delay, and false verdicts without a fault. Each fault moves the pixels by some px rms; it occurs while the
target moves, and the first verdict after it counts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from stereoservo.core.cycle import Event, StepInputs, StepOutputs
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.goals import FeatureTarget, Goal, LawName, RunGoal
from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo.ports.devices import JointState
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.experiments.experiment import crossed
from stereoservo_sim.experiments.figures import Figures, labelled, picture, stacked_bars
from stereoservo_sim.experiments.lockstep_cells import enabled, lockstep, with_fake_arm
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.arms.arm_goals import joints_nearby
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.workpiece import Motion, Moved, MovedFile, moved_pose

NOISE_PX, RATE_HZ = 0.1, 30.0
GAIN = 2.0
ON_THE_ARM, STANDING, ON_A_HEAD = "on the arm", "standing", "on a pan-tilt head"
CELLS = {ON_THE_ARM: "eye_in_hand", STANDING: "workpiece", ON_A_HEAD: "pan_tilt"}
"""Mounting of the cameras, and the shipped cell with it."""
LAWS: dict[str, tuple[LawName, ...]] = {
    ON_THE_ARM: ("stereo", "cartesian3"),
    STANDING: ("stereo", "cartesian3"),
    ON_A_HEAD: ("image",),
}


class Way(NamedTuple):
    """Motion of a target: along a line at ``speed`` [m/s], oscillating by ``amplitude`` [m] at ``hz`` [Hz], or on a
    turntable at ``turn`` [rad/s].
    """

    speed: float = 0.0
    amplitude: float = 0.0
    hz: float = 0.0
    turn: float = 0.0


MOTIONS = {
    "5 mm/s": Way(0.005),
    "20 mm/s": Way(0.02),
    "50 mm/s": Way(0.05),
    "±20 mm at 0.5 Hz": Way(0.0, 0.02, 0.5),
    "turns at 0.1 rad/s": Way(turn=0.1),
    "turns at 0.3 rad/s": Way(turn=0.3),
    "turns at 0.5 rad/s": Way(turn=0.5),
}
RADIUS_M, TILT = 0.1, 0.1
"""Distance of a target on a turntable from its axis, and largest angle of the axis from the line of sight [rad]."""
SPEED_SHARE, STEP_S, DRAWS = 0.8, 0.05, 100
"""Largest share of the joints' speed limits that a motion may need, checked in steps of this time; and largest number
of motions drawn.
"""
RANGE_LEFT = 0.1
"""Distance to the joints' limits that such a motion leaves [rad]."""
REST_S, SETTLE_S, JUDGED_S = 1.0, 2.0, 2.0
"""Time at rest; then in motion before the error is evaluated, and during evaluation."""
STEADY_PX = 1.0


@dataclass(frozen=True)
class Followed:
    """Accuracy of following a moving target: largest and rms distance [px] of a marker from its goal, over cameras,
    markers and time; the ``verdicts`` of the model monitor, and why the goal ended, '' if it did not.
    """

    largest_px: float
    rms_px: float
    verdicts: tuple[str, ...]
    ended: str


def run_moving_targets(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Run every mounting, law and motion with ``seeds`` seeds from ``seed`` on; returns the command's JSON object."""
    rows: list[dict[str, Any]] = []
    conditions = [(place, law, name, True) for place in CELLS for law in LAWS[place] for name in MOTIONS]
    conditions += [(ON_THE_ARM, "stereo", name, False) for name in MOTIONS]
    found = crossed(lambda c, k: follow(*c[:3], k, follows=c[3]), conditions, seeds, seed, progress)
    for (place, law, name, follows), flown in zip(conditions, found, strict=True):
        steady = sum(one.largest_px <= STEADY_PX and not one.ended for one in flown)
        rows.append(
            {
                "cameras": place,
                "law": law,
                "target": name,
                "followed": follows,
                "rms_px": float(np.sqrt(np.mean([one.rms_px**2 for one in flown]))),
                "largest_px": max(one.largest_px for one in flown),
                "within_1_px": f"{steady} of {seeds}",
                "verdicts": ", ".join(sorted({verdict for one in flown for verdict in one.verdicts})),
            }
        )
    return {
        "rows": rows,
        "assumptions": [
            f"exact model, {NOISE_PX:g} px noise a marker, cameras at {RATE_HZ:g} Hz, loop at 250 Hz, gain {GAIN:g}/s",
            f"errors are judged from {SETTLE_S:g} s after the target sets out, for {JUDGED_S:g} s, over all markers in "
            "both cameras, by the truth",
            f"turntables: {RADIUS_M:g} m from the axis, which leaves the line of sight by {TILT:g} rad at most; drawn "
            f"anew where the arm would need more than {SPEED_SHARE:g} of a joint's speed limit, or come within "
            f"{RANGE_LEFT:g} rad of a joint's range",
            "on a pan-tilt head: one marker in the first camera, by its image alone",
            "followed: with follow_markers; else as a goal that stands",
        ],
    }


@lru_cache(maxsize=len(CELLS))
def world_of(place: str) -> SimulatedCell:
    """The simulated world of the shipped cell with its cameras mounted as in `CELLS`."""
    path = shipped_cell_path(CELLS[place])
    return true_cell(load_cell_file(path), path.parent)


def cell_of(place: str) -> CellFile:
    """That cell with fakes for arm and cameras."""
    cell = load_cell_file(shipped_cell_path(CELLS[place]))
    options: dict[str, Any] = {"noise_px": NOISE_PX, "rate_hz": RATE_HZ}
    if place == STANDING:
        options["workpiece"] = True
    cameras = (
        msgspec.structs.replace(camera, driver="fake", detector=None, detector_options={}, options=options)
        for camera in cell.camera
    )
    return with_fake_arm(cell, cameras, cell.joints.options if place == ON_A_HEAD else {})


def motion_of(place: str, name: str, seed: int, since_ns: int) -> Motion:
    """One of `MOTIONS` in a cell, with a direction or axis drawn from the seed; of turntables the first that the arm
    can follow without a wrist singularity or the end of a joint's range.
    """
    cell, way = world_of(place), MOTIONS[name]
    if way.turn:
        rng = np.random.default_rng([seed, 29])
        drawn = (turntable_of(cell, way.turn, rng, since_ns) for _ in range(DRAWS))
        return next(motion for motion in drawn if share_of_speed(place, motion) <= SPEED_SHARE)
    direction = direction_of(cell, seed)
    return Motion(
        velocity_m_s=_three(way.speed * direction),
        swing_m=_three(way.amplitude * direction),
        swing_hz=way.hz,
        since_ns=since_ns,
    )


def direction_of(cell: SimulatedCell, seed: int) -> FloatArray:
    """A direction (3,) in the world: to the right in the images, and less so up or down, nearer or farther."""
    up, far = np.random.default_rng([seed, 19]).uniform(-0.4, 0.4, 2)
    found: FloatArray = _camera_to_world(cell) @ np.array([1.0, up, far]) / np.sqrt(1.0 + up * up + far * far)
    return found


def turntable_of(cell: SimulatedCell, turn: float, rng: np.random.Generator, since_ns: int) -> Motion:
    """A turntable at ``turn`` [rad/s], either sense, its axis `RADIUS_M` beside the target and nearly along the line of
    sight.

    With cameras on the arm the axis may be anywhere around the target; beside a workpiece it is on the body's side, so
    that the arm can reach the body's pose all the time.
    """
    to_world = _camera_to_world(cell)
    axis = to_world @ np.array([*rng.uniform(-TILT, TILT, 2), 1.0])
    axis *= rng.choice((-1.0, 1.0)) / np.linalg.norm(axis)
    beside = to_world @ np.array([*rng.standard_normal(2), 0.0])
    part = cell.workpiece
    if part is not None:
        middle = part.marker_positions(part.stand).mean(axis=0)
        beside = cell.marker_positions(cell.base).mean(axis=0) - middle
    beside = beside - axis * float(axis @ beside)
    return Motion(
        turn_rate_deg_s=_three(np.rad2deg(turn) * axis),
        about_m=_three(RADIUS_M * beside / np.linalg.norm(beside)),
        since_ns=since_ns,
    )


def share_of_speed(place: str, motion: Motion) -> float:
    """Largest share of a joint's speed limit that an arm needs to follow the target; infinite if a joint would leave
    its
    range; 0 for a head, which cannot follow it.
    """
    if place == ON_A_HEAD:
        return 0.0
    world = world_of(place)
    safety = cell_of(place).safety
    limits = np.array([limit.velocity for limit in safety.limit])
    low, high = (np.array([getattr(limit, end) for limit in safety.limit]) for end in ("min", "max"))
    stand = world.workpiece.stand if world.workpiece is not None else world.stand
    assert stand is not None
    carried = np.linalg.inv(stand) @ world.flange(world.base)
    start_ns, q, largest = motion.since_ns or 0, world.base, 0.0
    for elapsed_s in np.arange(0.0, SETTLE_S + JUDGED_S, STEP_S) + STEP_S:
        wanted = moved_pose(stand, motion.at(start_ns + round(elapsed_s * 1e9))) @ carried
        before, (q, _) = q, joints_nearby(world.robot, wanted, q)
        if (np.minimum(q - low, high - q) < RANGE_LEFT).any():
            return np.inf
        largest = max(largest, float((np.abs(q - before) / (STEP_S * limits)).max()))
    return largest


def _camera_to_world(cell: SimulatedCell) -> FloatArray:
    camera_to_world = np.linalg.inv(cell.rig.world_to_rig)[:3, :3]
    if cell.stand is not None:
        camera_to_world = cell.flange(cell.base)[:3, :3] @ camera_to_world
    return np.asarray(camera_to_world)


def _three(vector: FloatArray) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def follow(place: str, law: LawName, name: str, seed: int, *, follows: bool) -> Followed:
    """Follow a target with one motion; deterministic given the seed."""
    world = world_of(place)
    history = TrueJointHistory.in_memory(len(world.base), capacity=1 << 14)
    seen: list[tuple[int, FloatArray]] = []
    verdicts: set[str] = set()

    def watch(inputs: StepInputs, outputs: StepOutputs) -> None:
        newest = history.newest()
        if newest is not None:
            seen.append((newest[0], newest[1].copy()))
        verdicts.update(e.name for e in outputs.events if e.kind == "health" and e.name != "ok")

    with under_way(place, law, name, seed, history, follows=follows, watch=watch) as (cell, goal, motion):
        cell.run_for(SETTLE_S + JUDGED_S)
        ends = [e for e in cell.events if e.id == goal.id and e.kind in ("goal_aborted", "goal_cancelled")]
    assert motion.since_ns is not None  # it starts during the run
    judged = [(t, q) for t, q in seen if t >= motion.since_ns + round(SETTLE_S * 1e9)]
    judged_by = _judged_by(place, world)
    errors = np.array([_errors(world, motion.at(t), q)[judged_by] for t, q in judged[::3]])
    return Followed(
        float(errors.max()),
        float(np.sqrt((errors**2).mean())),
        tuple(sorted(verdicts)),
        "; ".join(reason.code for event in ends for reason in event.reasons),
    )


@contextmanager
def under_way(
    place: str, law: LawName, name: str, seed: int, history: TrueJointHistory, *, follows: bool,
    watch: Callable[[StepInputs, StepOutputs], None] | None = None,
) -> Iterator[tuple[LockstepCell, Goal, Motion]]:  # fmt: skip
    """The cell with its goal at the start of the target's motion, and that motion."""
    world = world_of(place)
    with lockstep(cell_of(place), seed, history, watch) as (cell, folder):
        enabled(cell, exact_simulated_model(world, seed), seed, 0.5)
        goal = _goal(world, law, follows, _judged_by(place, world))
        cell.submit(RunGoal(goal))
        cell.run_for(REST_S)
        motion = motion_of(place, name, seed, cell.clock.now_ns())
        MovedFile(folder).write(motion)
        yield cell, goal, motion


def _judged_by(place: str, world: SimulatedCell) -> BoolArray:
    """Mask of markers by camera (c, m) that the goal uses: all; for a head the middle one in the first camera."""
    if place != ON_A_HEAD:
        return np.ones((len(world.rig.cameras), len(world.body.ids)), dtype=bool)
    first = world.rig.cameras[0]
    pixels = world.truth_pixels(world.base)[first.name]
    off = np.linalg.norm(pixels - pixels.mean(axis=0), axis=1)
    off[~world.visible(world.base, first)] = np.inf
    chosen = np.zeros((len(world.rig.cameras), len(pixels)), dtype=bool)
    chosen[0, int(off.argmin())] = True
    return chosen


def _goal(world: SimulatedCell, law: LawName, follows: bool, shown: BoolArray) -> Goal:
    """Current observations of the markers ``shown`` (c, m), relative to the target's current pose."""
    named = partial(_named, decimals=6)
    target = FeatureTarget(
        {
            camera: named(world.body.ids[shown[c]], pixels[shown[c]])
            for c, (camera, pixels) in enumerate(world.truth_pixels(world.base).items())
            if shown[c].any()
        }
    )
    goal = Goal("0000abcd", target, law=law, gain=GAIN, tolerance_px=0.06 if follows else 0.001, time_limit_s=600.0)
    if not follows:
        return goal
    part = world.workpiece
    if part is None:
        return msgspec.structs.replace(goal, follow_markers=tuple(int(i) for i in world.body.ids))
    positions = part.marker_positions(part.stand)
    seen = {
        camera.name: named(part.body.ids, world.in_world(camera, world.base).image_of(positions)[0])
        for camera in world.rig.cameras
    }
    return msgspec.structs.replace(goal, follow_markers=tuple(int(i) for i in part.body.ids), follow_seen=seen)


def _named(ids: Any, pixels: FloatArray, decimals: int) -> dict[int, tuple[float, float]]:
    return {
        int(i): (round(float(u), decimals), round(float(v), decimals)) for i, (u, v) in zip(ids, pixels, strict=True)
    }


def _errors(world: SimulatedCell, moved: Moved, q: FloatArray) -> FloatArray:
    """Distances (c, m) [px] of the body's markers from their positions in the goal, with the arm at ``q`` (n,)."""
    here = world
    if world.stand is not None:
        here = SimulatedCell(world.robot, world.body, world.rig, world.base, moved_pose(world.stand, moved))
    found = []
    for camera in world.rig.cameras:
        wanted = world.marker_positions(world.base)
        if world.stand is None:
            wanted = _carried(world, wanted, moved)
        goal = world.in_world(camera, world.base).image_of(wanted)[0]
        seen = here.in_world(camera, q).image_of(here.marker_positions(q))[0]
        found.append(np.linalg.norm(seen - goal, axis=-1))
    return np.array(found)


def _carried(world: SimulatedCell, points: FloatArray, moved: Moved) -> FloatArray:
    """Points (m, 3) that move with the workpiece."""
    part = world.workpiece
    assert part is not None
    D = part.pose(moved) @ np.linalg.inv(part.stand)
    return np.asarray(points @ D[:3, :3].T + D[:3, 3])


def draw_moving_targets(answer: dict[str, Any]) -> Figures:
    """Largest errors, one bar per condition."""
    figure = picture(9, 4)
    axis = figure.subplots()
    rows = answer["rows"]
    names = [
        "\n".join((row["cameras"], row["law"], row["target"], "" if row["followed"] else "not followed"))
        for row in rows
    ]
    axis.bar(range(len(rows)), [row["largest_px"] for row in rows])
    axis.set_xticks(range(len(rows)), names, fontsize=5, rotation=60)
    axis.set_yscale("log")
    labelled(axis, "largest error while the target moves", "", "[px]")
    return {"moving-targets": figure}


# -- faults meanwhile ------------------------------------------------------------------------------------------

Fault = Literal["camera bumped", "joint zero drifts", "joint zero jumps", "marker slipped"]
FAULTS: dict[Fault, tuple[str, ...]] = {
    "camera bumped": ("camera_moved",),
    "joint zero drifts": ("joint_zero", "JOINT_NOT_FOLLOWING"),
    "joint zero jumps": ("joint_zero", "JOINT_NOT_FOLLOWING"),
    "marker slipped": ("marker_slipped",),
}
"""Faults, and the verdicts and fault codes that name them."""
FAULT_PX: dict[Fault, tuple[float, float]] = {
    "camera bumped": (2.0, 10.0),
    "joint zero drifts": (2.0, 10.0),
    "joint zero jumps": (10.0, 40.0),
    "marker slipped": (2.0, 10.0),
}
"""Rms image displacement [px] of the markers that a fault moves."""
BEFORE_S, AFTER_S = 1.5, 1.5
"""Time of target motion before the fault, and time for the monitor to name it."""
UNCLEAR = "unclear"
"""Verdict of a fault with several equally likely causes; it names none."""
DRIFT_NS, JUMP_NS = 1_000_000_000, 20_000_000
"""Time in which a joint's zero drifts, and jumps: within a frame."""


@dataclass(frozen=True)
class Named:
    """Named fault: the ``verdict`` and its ``subject``, '' if none, ``delay_s`` after the fault, whether it is
    ``right``, for a fault of ``size_px``; ``early``: verdicts before it; ``unclear``: whether a fault was reported
    before, or without, its cause.
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
    """Run every mounting and fault with ``seeds`` seeds from ``seed`` on, motions in turn; returns the command's JSON
    object.
    """
    rows: list[dict[str, Any]] = []
    conditions = [(place, fault) for place in CELLS for fault in FAULTS]
    motions = list(MOTIONS)
    found = crossed(lambda c, k: disturb(*c, motions[(k - seed) % len(motions)], k), conditions, seeds, seed, progress)
    for (place, fault), flown in zip(conditions, found, strict=True):
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
        "rows": rows,
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
    """Follow a target, and inject a fault; deterministic given the seed."""
    world = world_of(place)
    history = TrueJointHistory.in_memory(len(world.base), capacity=1 << 14)
    with under_way(place, LAWS[place][-1], name, seed, history, follows=True) as (cell, _, _):
        cell.run_for(BEFORE_S)
        return named_after(cell, world, history, fault, name, seed)


def named_after(
    cell: LockstepCell, world: SimulatedCell, history: TrueJointHistory, fault: Fault, name: str, seed: int
) -> Named:
    """Result of the monitor after a fault at this time."""
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
    """A finite number, else None: no event has no delay."""
    return value if np.isfinite(value) else None


def _verdict(event: Event) -> str:
    """The verdict of the model monitor, or the code of a fault."""
    return event.name if event.kind == "health" else ", ".join(reason.code for reason in event.reasons)


def _subject(event: Event) -> str:
    return event.reasons[0].subject if event.reasons else ""


def _pixels(world: SimulatedCell, q: FloatArray) -> FloatArray:
    return np.array(list(world.truth_pixels(q).values()))


def _bump(cell: LockstepCell, world: SimulatedCell, q: FloatArray, size_px: float, rng: np.random.Generator) -> str:
    """Rotate one camera about a random axis in its own frame."""
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


def _zero_off(
    cell: LockstepCell,
    world: SimulatedCell,
    q: FloatArray,
    size_px: float,
    rng: np.random.Generator,
    over_ns: int,
) -> str:
    """Change the offset of one joint's encoder, within ``over_ns``."""
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


_DISTURBANCES: dict[Fault, Callable[..., str]] = {
    "camera bumped": _bump,
    "joint zero drifts": partial(_zero_off, over_ns=DRIFT_NS),
    "joint zero jumps": partial(_zero_off, over_ns=JUMP_NS),
    "marker slipped": _slip_marker,
}
"""Each injects a fault into a cell, and returns the subject that should be named."""


def draw_moving_faults(answer: dict[str, Any]) -> Figures:
    """Correctly, wrongly and not named faults, one bar per row."""
    rows = answer["rows"]
    names = [f"{row['cameras']}, {row['fault']}" for row in rows]
    return {"moving-faults": stacked_bars(rows, names, ("right", "wrong", "none"))}
