"""Experiment: targets that move by themselves, followed by cameras on the arm, on a pan-tilt head, and before cameras
that stand.

The demo's arm, or the head (thesis 4.5.4), in lockstep. With cameras on the arm the marker body slides or swings before
them, and the goal is that they see it where they saw it at first; with cameras that stand the workpiece slides beside
the body, and the goal is that the body stays beside it. Or both ride on a turntable. The two freedoms of a head keep
one marker where it was in one camera. Judged by the truth, which the core never sees.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from stereoservo.core.cycle import ModelUpdate, StepInputs, StepOutputs
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.goals import FeatureTarget, Goal, LawName, RunGoal
from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.experiments.laws.driven_tasks import labelled, picture, saved
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
"""Where the cameras are, and the shipped cell with them there."""
LAWS: dict[str, tuple[LawName, ...]] = {
    ON_THE_ARM: ("stereo", "cartesian3"), STANDING: ("stereo", "cartesian3"), ON_A_HEAD: ("image",),
}  # fmt: skip


class Way(NamedTuple):
    """How a target moves: along a line at ``speed`` [m/s], swinging by ``amplitude`` [m] at ``hz`` [Hz], or on a
    turntable at ``turn`` [rad/s].
    """

    speed: float = 0.0
    amplitude: float = 0.0
    hz: float = 0.0
    turn: float = 0.0


MOTIONS = {
    "5 mm/s": Way(0.005), "20 mm/s": Way(0.02), "50 mm/s": Way(0.05), "±20 mm at 0.5 Hz": Way(0.0, 0.02, 0.5),
    "turns at 0.1 rad/s": Way(turn=0.1), "turns at 0.3 rad/s": Way(turn=0.3), "turns at 0.5 rad/s": Way(turn=0.5),
}  # fmt: skip
RADIUS_M, TILT = 0.1, 0.1
"""Of a target on a turntable from its axis, and of the axis from the line of sight, at most [rad]."""
SPEED_SHARE, STEP_S, DRAWS = 0.8, 0.05, 100
"""Of its joints' speed limits, what an arm may need for a motion that is asked of it, looked at in such steps; and how
many are drawn for one.
"""
RANGE_LEFT = 0.1
"""That such a motion leaves of the joints' ranges [rad]."""
REST_S, SETTLE_S, JUDGED_S = 1.0, 2.0, 2.0
"""The target stands; then it moves: until the error is judged, and for so long."""
STEADY_PX = 1.0


@dataclass(frozen=True)
class Followed:
    """How a moving target was followed: largest and rms distance [px] of a marker from its goal, over cameras, markers
    and time; the ``verdicts`` that the watch over the model gave, and why the goal ended, '' where it did not.
    """

    largest_px: float
    rms_px: float
    verdicts: tuple[str, ...]
    ended: str


def run_moving_targets(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Every place, law and motion with ``seeds`` seeds from ``seed`` on; the JSON object of the command."""
    rows: list[dict[str, Any]] = []
    conditions = [(place, law, name, True) for place in CELLS for law in LAWS[place] for name in MOTIONS]
    conditions += [(ON_THE_ARM, "stereo", name, False) for name in MOTIONS]
    for k, (place, law, name, follows) in enumerate(conditions):
        flown = []
        for s in range(seeds):
            progress("conditions and seeds", k * seeds + s, len(conditions) * seeds)
            flown.append(follow(place, law, name, seed + s, follows=follows))
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
        "experiment": "moving-targets",
        "rows": rows,
        "seed": seed,
        "seeds": seeds,
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
    """The simulated world of the shipped cell with its cameras in a place of `CELLS`."""
    path = shipped_cell_path(CELLS[place])
    return true_cell(load_cell_file(path), path.parent)


def cell_of(place: str) -> CellFile:
    """That cell with fakes for arm and cameras."""
    cell = load_cell_file(shipped_cell_path(CELLS[place]))
    options: dict[str, Any] = {"noise_px": NOISE_PX, "rate_hz": RATE_HZ}
    if place == STANDING:
        options["workpiece"] = True
    cameras = tuple(
        msgspec.structs.replace(camera, driver="fake", detector=None, detector_options={}, options=options)
        for camera in cell.camera
    )
    return msgspec.structs.replace(
        cell, camera=cameras, joints=msgspec.structs.replace(
            cell.joints, driver="fake", options=cell.joints.options if place == ON_A_HEAD else {}
        )
    )  # fmt: skip


def motion_of(place: str, name: str, seed: int, since_ns: int) -> Motion:
    """One of `MOTIONS` in a cell, along, or about, what the seed says; of turntables the first that the arm can follow:
    where it comes near a singularity of its wrist, or to the end of a joint's range, another.
    """
    cell, way = world_of(place), MOTIONS[name]
    if way.turn:
        rng = np.random.default_rng([seed, 29])
        drawn = (turntable_of(cell, way.turn, rng, since_ns) for _ in range(DRAWS))
        return next(motion for motion in drawn if share_of_speed(place, motion) <= SPEED_SHARE)
    direction = direction_of(cell, seed)
    return Motion(
        velocity_m_s=_three(way.speed * direction), swing_m=_three(way.amplitude * direction), swing_hz=way.hz,
        since_ns=since_ns,
    )  # fmt: skip


def direction_of(cell: SimulatedCell, seed: int) -> FloatArray:
    """A direction (3,) in the world: to the right in the images, and less so up or down, nearer or farther."""
    up, far = np.random.default_rng([seed, 19]).uniform(-0.4, 0.4, 2)
    found: FloatArray = _camera_to_world(cell) @ np.array([1.0, up, far]) / np.sqrt(1.0 + up * up + far * far)
    return found


def turntable_of(cell: SimulatedCell, turn: float, rng: np.random.Generator, since_ns: int) -> Motion:
    """A turntable that turns at ``turn`` [rad/s], either way, its axis `RADIUS_M` beside the target and nearly along
    the line of sight: anywhere round a target before cameras on the arm; beside a workpiece on the body's side, so that
    the arm reaches the body's place all the way.
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
        turn_rate_deg_s=_three(np.rad2deg(turn) * axis), about_m=_three(RADIUS_M * beside / np.linalg.norm(beside)),
        since_ns=since_ns,
    )  # fmt: skip


def share_of_speed(place: str, motion: Motion) -> float:
    """The largest share of a joint's speed limit that an arm needs to go with the target, without bound where a joint
    would leave its range; 0 of a head, which cannot go with it.
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
    """Follow a target that moves in one way; deterministic given the seed."""
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
    assert motion.since_ns is not None  # it sets out in mid-run
    judged = [(t, q) for t, q in seen if t >= motion.since_ns + round(SETTLE_S * 1e9)]
    judged_by = _judged_by(place, world)
    errors = np.array([_errors(world, motion.at(t), q)[judged_by] for t, q in judged[::3]])
    return Followed(
        float(errors.max()), float(np.sqrt((errors**2).mean())), tuple(sorted(verdicts)),
        "; ".join(reason.code for event in ends for reason in event.reasons),
    )  # fmt: skip


@contextmanager
def under_way(
    place: str, law: LawName, name: str, seed: int, history: TrueJointHistory, *, follows: bool,
    watch: Callable[[StepInputs, StepOutputs], None] | None = None,
) -> Iterator[tuple[LockstepCell, Goal, Motion]]:  # fmt: skip
    """The cell with its goal at the moment at which the target sets out, and that motion."""
    world = world_of(place)
    with (
        tempfile.TemporaryDirectory(prefix="stereoservo-moving-") as scratch,
        LockstepCell(
            cell_of(place), cell_dir=Path(scratch), runtime_dir=Path(scratch), seed=seed,
            services={"world": history}, on_step=watch,
        ) as cell,
    ):  # fmt: skip
        cell.run_for(0.5)
        LockstepOperator(cell, seed=seed).enable()
        cell.update_model(ModelUpdate(exact_simulated_model(world, seed)))
        cell.run_for(0.5)
        goal = _goal(world, law, follows, _judged_by(place, world))
        cell.submit(RunGoal(goal))
        cell.run_for(REST_S)
        motion = motion_of(place, name, seed, cell.clock.now_ns())
        MovedFile(Path(scratch)).write(motion)
        yield cell, goal, motion


def _judged_by(place: str, world: SimulatedCell) -> BoolArray:
    """Markers of cameras (c, m) that the goal shows: all; of a head the one in the middle of the first camera."""
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
    """What is seen now of the markers ``shown`` (c, m), relative to the target where it is now."""
    named = partial(_named, decimals=6)
    target = FeatureTarget(
        {
            camera: named(world.body.ids[shown[c]], pixels[shown[c]])
            for c, (camera, pixels) in enumerate(world.truth_pixels(world.base).items())
            if shown[c].any()
        }
    )
    goal = Goal(
        "0000abcd", target, law=law, gain=GAIN, tolerance_px=0.06 if follows else 0.001, time_limit_s=600.0
    )
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
    return msgspec.structs.replace(
        goal, follow_markers=tuple(int(i) for i in part.body.ids), follow_seen=seen
    )


def _named(ids: Any, pixels: FloatArray, decimals: int) -> dict[int, tuple[float, float]]:
    return {
        int(i): (round(float(u), decimals), round(float(v), decimals))
        for i, (u, v) in zip(ids, pixels, strict=True)
    }


def _errors(world: SimulatedCell, moved: Moved, q: FloatArray) -> FloatArray:
    """Distances (c, m) [px] of the body's markers from where the goal has them, with the arm at ``q`` (n,)."""
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
    """Points (m, 3) that go with the workpiece."""
    part = world.workpiece
    assert part is not None
    D = part.pose(moved) @ np.linalg.inv(part.stand)
    return np.asarray(points @ D[:3, :3].T + D[:3, 3])


def draw_moving_targets(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Largest errors, a bar a condition. Raises OSError."""
    figure = picture(9, 4)
    axis = figure.subplots(1, 1)
    rows = answer["rows"]
    axis.bar(range(len(rows)), [row["largest_px"] for row in rows])
    axis.set_xticks(
        range(len(rows)),
        [
            "\n".join((row["cameras"], row["law"], row["target"], "" if row["followed"] else "not followed"))
            for row in rows
        ],
        fontsize=5, rotation=60,
    )  # fmt: skip
    axis.set_yscale("log")
    labelled(axis, "largest error while the target moves", "", "[px]")
    return [saved(figure, folder, "moving-targets")]
