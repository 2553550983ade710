"""Experiment: servoing with more than two cameras, some of them moving, by any pair or all (thesis 9, fig. 9.1).

The demo's arm in lockstep before four cameras, two of them mobile. Each seed has a calibration and one taught goal.
The goal is then run by every pair, by all, by all while both mobile cameras are carried along a smooth path during the
motion, and by a carried camera with a static one while the others are covered. Evaluated against ground truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.core.cycle import Event, StepInputs, StepOutputs
from stereoservo.core.model_arrays import model_arrays
from stereoservo.core.prediction import predict
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CameraSection, CellFile, load_cell_file
from stereoservo.messages.goals import FeatureTarget, Goal, JointTarget, RunGoal
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.cells import demo_cell_path
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.experiments.experiment import Comparison, not_comparable
from stereoservo_sim.experiments.figures import Figures, by_condition, draw_points, picture
from stereoservo_sim.experiments.lockstep_cells import enabled, lockstep, with_fake_arm
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import spread
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, demo_cell
from stereoservo_sim.world.workpiece import Moved

NOISE_PX = 0.05
RATE_HZ = 30.0
GOAL = DEMO_GOALS["near"]
PLACES: dict[str, tuple[str, Moved]] = {
    "left": ("left", Moved()),
    "right": ("right", Moved()),
    "high": ("left", Moved((0.10, -0.35, 0.05), (-14.0, 0.0, 0.0))),
    "wide": ("right", Moved((0.30, -0.05, 0.05), (0.0, -12.0, 0.0))),
}
"""Camera of the demo's rig by name, and its displacement from there, in its own frame."""
MOBILE = ("high", "wide")
PATHS: dict[str, Moved] = {
    "high": Moved((0.10, 0.0, 0.0), (2.0, -10.0, 1.0)),
    "wide": Moved((0.0, -0.10, 0.0), (-10.0, 1.0, -2.0)),
}
"""Final displacement of a carried camera from its initial pose, in its own frame."""
CARRIED_S = 3.0
TOLERANCE_PX = 0.15
HOLD_FRAMES = 60
"""Frames at the goal, so that the remaining error is noise, not residual motion."""
LIMIT_S = 60.0


@dataclass(frozen=True)
class CarryCondition:
    """An experimental condition. ``used``: cameras that the goal names; ``carried`` during the motion; ``covered``
    once these are at rest.
    """

    name: str
    used: tuple[str, ...]
    carried: tuple[str, ...] = ()
    covered: tuple[str, ...] = ()


ALL = tuple(PLACES)
CONDITIONS = (
    *(CarryCondition(" + ".join(pair), pair) for pair in combinations(ALL, 2)),
    CarryCondition("all four", ALL),
    CarryCondition("all four, two carried on the way", ALL, MOBILE),
    CarryCondition("left + high, high carried, the others covered", ("left", "high"), ("high",), ("right", "wide")),
)


@dataclass(frozen=True)
class CarriedGoalResult:
    """One goal: rms distance of the markers from their goal [mm]; of the carried cameras, the rms reprojection error
    [px] per coordinate of the estimated matrix.
    """

    reached: bool
    error_mm: float
    camera_px: float | None


@dataclass
class _Carrying:
    """Cameras being carried, and their start time."""

    since_ns: int = 0
    moves: tuple[str, ...] = ()


def run_mobile_cameras(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Run every condition with ``seeds`` seeds from ``seed`` on; returns the JSON object of the command."""
    flown: dict[str, list[CarriedGoalResult]] = {condition.name: [] for condition in CONDITIONS}
    steps = 1 + len(CONDITIONS)
    for k in range(seeds):
        progress("seeds and goals", k * steps, seeds * steps)
        model, target = calibrated(seed + k)
        for c, condition in enumerate(CONDITIONS):
            progress("seeds and goals", k * steps + 1 + c, seeds * steps)
            flown[condition.name].append(fly(condition, model, target, seed + k))
    whole = flown["all four"]
    return {
        "rows": [_row(condition, flown[condition.name], whole) for condition in CONDITIONS],
        "thesis": {
            "figure": "9.1",
            "cameras": "several, mobile ones among them, adjusted on-line against one tool",
        },
        "goals": [
            {"condition": name, "reached": one.reached, "error_mm": one.error_mm, "camera_px": one.camera_px}
            for name, several in flown.items()
            for one in several
        ],
        "assumptions": [
            f"{NOISE_PX:g} px noise a marker, {RATE_HZ:g} Hz, law cartesian3 with triangulated points",
            f"carried by 10 cm and 10 degrees in {CARRIED_S:g} s, from the moment the goal is sent",
            "ratio: rms of the errors over that of all four, the same calibrations and noise",
        ],
    }


def cell_of() -> CellFile:
    """The demo's cell with fakes for the arm and for four cameras, and a short calibration."""
    cameras = (
        CameraSection(
            name,
            "fake",
            mobile=name in MOBILE,
            options={
                "view": view,
                "noise_px": NOISE_PX,
                "rate_hz": RATE_HZ,
                "moved": {"shift_m": list(moved.shift_m), "turn_deg": list(moved.turn_deg)},
            },
        )
        for name, (view, moved) in PLACES.items()
    )
    return with_fake_arm(load_cell_file(demo_cell_path()), cameras, calibrates_fast=True)


def calibrated(seed: int) -> tuple[CellModel, FeatureTarget]:
    """A model, and the goal as seen by the four cameras."""
    with lockstep(cell_of(), seed) as (cell, _):
        cell.run_for(0.5)
        operator = LockstepOperator(cell, seed=seed)
        operator.enable()
        model = operator.calibrate()
        operator.goal(JointTarget(dict(zip(cell.settings.joint_names, GOAL.tolist(), strict=True))))
        cell.run_for(0.4)
        operator.teach("goal", 30)
        return model, operator.taught["goal"]


def fly(
    condition: CarryCondition,
    model: CellModel,
    target: FeatureTarget,
    seed: int,
    recording: Path | None = None,
) -> CarriedGoalResult:
    """Servo the arm from home to the goal under one condition; deterministic given the seed."""
    history = TrueJointHistory.in_memory(6, capacity=1 << 14)
    carrying = _Carrying()

    def carry(inputs: StepInputs, _: StepOutputs) -> None:
        _carry(cell, carrying, inputs)

    with lockstep(cell_of(), seed, history, carry, recording=recording) as (cell, _):
        enabled(cell, model, 0, 0.5)
        goal = Goal(
            "0000abcd", _shown_to(target, condition.used), law="cartesian3", points="triangulated",
            cameras=condition.used, tolerance_px=TOLERANCE_PX, hold_frames=HOLD_FRAMES, time_limit_s=LIMIT_S,
        )  # fmt: skip
        cell.submit(RunGoal(goal))
        carrying.moves, carrying.since_ns = condition.carried, cell.clock.now_ns()
        for name in condition.carried:
            cell.wait_for(_stands_again(name), LIMIT_S)
        for name in condition.covered:
            cell.cameras[ALL.index(name)].blackout = True  # type: ignore[attr-defined]
        ended = cell.wait_for(lambda e: e.id == goal.id and e.kind in ("goal_reached", "goal_aborted"), 2 * LIMIT_S)
        cell.run_for(0.5)
        newest = history.newest()
        assert newest is not None
        world = demo_cell()
        apart = world.marker_positions(newest[1]) - world.marker_positions(GOAL)
        error_mm = float(1e3 * np.sqrt(np.mean(np.sum(apart**2, axis=-1))))
        return CarriedGoalResult(
            ended.kind == "goal_reached", error_mm, _camera_error(cell, condition.carried, newest[1])
        )


def _stands_again(name: str) -> Callable[[Event], bool]:
    return lambda event: event.kind == "camera_adjusted" and name in event.cameras


def _shown_to(target: FeatureTarget, used: tuple[str, ...]) -> FeatureTarget:
    return msgspec.structs.replace(
        target, set_points={name: pixels for name, pixels in target.set_points.items() if name in used}
    )


def _carry(cell: LockstepCell, carrying: _Carrying, inputs: StepInputs) -> None:
    """Set the carried cameras to their poses at this time."""
    share = min(max((inputs.now_ns - carrying.since_ns) * 1e-9 / CARRIED_S, 0.0), 1.0)
    for name in carrying.moves:
        camera: Any = cell.cameras[ALL.index(name)]
        camera.bump(carried_to(name, share * share * (3.0 - 2.0 * share)))


def carried_to(name: str, share: float) -> Moved:
    """Pose of camera ``name`` after a ``share`` of its path, from that of the rig's camera."""
    from scipy.spatial.transform import Rotation

    shift, turn = np.array(PATHS[name].shift_m) * share, np.array(PATHS[name].turn_deg) * share
    matrix = PLACES[name][1].matrix @ Moved(tuple(shift.tolist()), tuple(turn.tolist())).matrix
    vector = np.degrees(Rotation.from_matrix(matrix[:3, :3]).as_rotvec())
    return Moved(tuple(matrix[:3, 3].tolist()), tuple(vector.tolist()))


def _camera_error(cell: LockstepCell, carried: tuple[str, ...], q: FloatArray) -> float | None:
    """Rms error [px] per coordinate of the core's predicted pixels in carried cameras, against noise-free ones."""
    model = cell.core.state.model
    if not carried or model is None:
        return None
    world = demo_cell()
    points = world.marker_positions(q)
    arrays = model_arrays(model, cell.settings)
    expected = predict(arrays, q).pixels
    squares = []
    for name in carried:
        k = ALL.index(name)
        driver: Any = cell.cameras[k]
        rows = [world.body.ids.tolist().index(i) for i in model.marker_ids]
        seen = world.visible(q, driver.camera)[rows]
        true = driver.camera.image_of(points)[0][rows]
        squares.append(((distort(arrays.lenses[k], expected[k]) - true)[seen] ** 2).mean())
    return float(np.sqrt(np.mean(squares)))


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _row(condition: CarryCondition, flown: list[CarriedGoalResult], whole: list[CarriedGoalResult]) -> dict[str, Any]:
    cameras = [one.camera_px for one in flown if one.camera_px is not None]
    return {
        "cameras": condition.name,
        "reached": f"{sum(one.reached for one in flown)} of {len(flown)}",
        "error_mm": spread([one.error_mm for one in flown]),
        "ratio": _rms([one.error_mm for one in flown]) / _rms([one.error_mm for one in whole]),
        "camera_px": f"{_rms(cameras):.3f}" if cameras else "",
    }


def compare_mobile_cameras(answer: dict[str, Any]) -> list[Comparison]:
    """Fig. 9.1, a sketch of a proposal: whether it works."""
    reached, asked = sum(goal["reached"] for goal in answer["goals"]), len(answer["goals"])
    return [
        not_comparable(
            "fig. 9.1",
            "several cameras, mobile ones adjusted on-line against one tool",
            "further work",
            f"{reached} of {asked} goals reached",
            "the thesis sketches it and measures nothing",
        )
    ]


def draw_mobile_cameras(answer: dict[str, Any]) -> Figures:
    """Final errors, one column per condition."""
    figure = picture(9, 4)
    axis = figure.subplots()
    draw_points(axis, by_condition(answer, "cameras", "error_mm"), "error at the goal", "[mm]")
    return {"mobile-cameras": figure}
