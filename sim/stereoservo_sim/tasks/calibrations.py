"""The controller's model in the tasks: from the calibration motion (``self``), from ground truth (``exact``), or metric
with errors (``coarse``).

``self``: joint by joint from mid-range, `STOPS` stops a joint as far as both cameras keep the plate in view,
`FRAMES` noisy frames averaged at each, as the daemon does. Afterwards the arm's position is taken from its own
readings: the free arm's operators are re-based to a task's start by the displacement computed from its readings.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stereoservo.geometry.cameras import camera_centre
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.screws import exp_twist
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import chain_forward
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.kept_models import model_of_trials
from stereoservo_sim.tasks.arms import MID_RANGE, ArmName, free_cell, mechanics_of, rx90_cell
from stereoservo_sim.tasks.options import FRAMES, STOPS
from stereoservo_sim.tasks.setting import (
    FOCAL_ERROR,
    HAND_EYE_ERROR_DEG,
    camera_matrices,
    camera_poses,
    cartesian_twists,
)
from stereoservo_sim.tasks.task_file import AlignmentTask
from stereoservo_sim.tasks.twist_arm import twist_cell
from stereoservo_sim.world.exact_model import exact_model, twists
from stereoservo_sim.world.mechanical_trials import mechanical_trials
from stereoservo_sim.world.presets import MechanicsPreset
from stereoservo_sim.world.synthetic import Kind, SyntheticCell

CalibrationName = Literal["self", "exact", "coarse"]
CELLS: dict[ArmName, Callable[[], SyntheticCell]] = {
    "free": free_cell,
    "rx90": rx90_cell,
    "twist": twist_cell,
}

"""Synthetic cell of each arm."""
LEAST_SIGMA_PX = 1e-3
"""Standard deviation assigned to averaged observations if the images have no noise: a fit needs it as weight."""
TRIAL_MARGIN_PX, TRIAL_ANGLE_DEG = 20.0, 65.0
"""Calibration motions end this far from an image's border, or when the plate is seen at this angle to its normal."""
MAX_TURN, MAX_TRAVEL = np.radians(50.0), 0.25
"""Largest calibration motion to either side [rad], [m]."""


class TaskCalibration(NamedTuple):
    """An arm with its model; None if the model is metric with errors, drawn per task. ``facts``: for the report.

    ``focal_error`` (share), ``hand_eye_error_deg``: of a metric model.
    """

    arm: ArmName
    cell: SyntheticCell
    model: CellModel | None
    facts: dict[str, object]
    focal_error: float = FOCAL_ERROR
    hand_eye_error_deg: float = HAND_EYE_ERROR_DEG


@dataclass(frozen=True, eq=False)
class Knowledge:
    """The controller's model at the start of a task.

    ``matrices`` (c, 3, 4), ``camera_centres`` (c, 4) and ``points`` (m, 4) scaled to ``plane_at_infinity @ M = 1``; the
    points by kinematics alone, None if the markers' positions on the body are unknown. ``basis`` (r, 4, 4): operators
    that span the displacements; of a serial arm those at its ``zero`` (n,), which is None if they are constant.
    ``kinds``:
    of the joints.
    """

    composition: Composition
    matrices: FloatArray
    camera_centres: FloatArray
    plane_at_infinity: FloatArray
    basis: FloatArray
    points: FloatArray | None
    kinds: tuple[Kind, ...]
    zero: FloatArray | None = None

    def operators(self, joints: FloatArray) -> FloatArray:
        """Operators (n, 4, 4) at the arm's readings (n,) (5.21)."""
        if self.zero is None:
            return self.basis
        kinds = np.array([kind == "prismatic" for kind in self.kinds], dtype=np.uint8)
        found: FloatArray = chain_forward(self.basis, kinds, self.zero, joints)[1]
        return found


def calibrate(
    arm: ArmName,
    calibration: CalibrationName,
    noise_px: float,
    seed: int,
    mechanics: MechanicsPreset | None = None,
) -> TaskCalibration:
    """Calibrate once per file and seed. Raises CalibrationError if the calibration motion gives no model."""
    cell = CELLS[arm]()
    if calibration == "coarse":
        return metric_model(arm, cell, FOCAL_ERROR, HAND_EYE_ERROR_DEG)
    if calibration == "exact":
        return TaskCalibration(arm, cell, exact_model(cell), {})
    return self_calibrated(arm, cell, noise_px, seed, mechanics)


def metric_model(arm: ArmName, cell: SyntheticCell, focal_error: float, hand_eye_error_deg: float) -> TaskCalibration:
    """Metric model with too long focal lengths (by a share), and the arm rotated about each task's own axis."""
    facts: dict[str, object] = {"focal_error": focal_error, "hand_eye_error_deg": hand_eye_error_deg}
    return TaskCalibration(arm, cell, None, facts, focal_error, hand_eye_error_deg)


def self_calibrated(
    arm: ArmName,
    cell: SyntheticCell,
    noise_px: float,
    seed: int,
    mechanics: MechanicsPreset | None = None,
) -> TaskCalibration:
    """Model from a calibration motion about the cell's home, of a serial arm with ``mechanics``; a kept one if the same
    motion was learnt from before. Raises CalibrationError.
    """
    started = time.perf_counter()
    cell = with_trial_ranges(cell)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    sigma = max(noise_px / np.sqrt(FRAMES), LEAST_SIGMA_PX)
    gears = mechanics_of(mechanics)
    trials = cell.trials(sigma, rng, STOPS) if gears is None else mechanical_trials(cell, gears, sigma, rng, STOPS)
    learnt = model_of_trials(trials)
    assert learnt.model.statistics is not None
    facts = {
        "stops_per_joint": STOPS,
        "frames_per_stop": FRAMES,
        "ranges": [round(float(value), 4) for value in cell.ranges],
        "sigma_px": sigma,
        "rms_px": learnt.model.statistics.rms_px,
        "stratum": learnt.model.stratum,
        "model": learnt.facts,
        "seconds": round(time.perf_counter() - started, 3),
    }
    return TaskCalibration(arm, cell, learnt.model, facts)


def with_trial_ranges(cell: SyntheticCell) -> SyntheticCell:
    """The cell with each joint's range (n,) to either side as far as both cameras keep seeing the printed face."""
    shares = np.linspace(0.0, 1.0, 101)
    largest = np.where([kind == "revolute" for kind in cell.kinds], MAX_TURN, MAX_TRAVEL)
    ranges = np.empty(len(largest))
    for j, most in enumerate(largest):
        good = np.ones(len(shares), dtype=bool)
        for sign in (-1.0, 1.0):
            positions = np.repeat(cell.home[None], len(shares), axis=0)
            positions[:, j] += sign * most * shares
            good &= cell.in_view(positions, TRIAL_MARGIN_PX).all(axis=(0, 2)) & _shows_face(cell, positions)
        reached = len(shares) if good.all() else int(np.argmin(good))
        ranges[j] = most * shares[max(reached - 1, 0)]
    return replace(cell, ranges=ranges)


def _shows_face(cell: SyntheticCell, positions: FloatArray) -> npt.NDArray[np.bool_]:
    """Mask (s,): whether each camera sees the plate's front at less than ``TRIAL_ANGLE_DEG`` from its normal."""
    markers = cell.markers(positions)[..., :3]
    middle = markers.mean(axis=1)
    normal = -np.cross(markers[:, 1] - markers[:, 0], markers[:, 3] - markers[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    sight = camera_poses()[:, None, :3, 3] - middle
    cosine = (sight * normal).sum(axis=-1) / np.linalg.norm(sight, axis=-1)
    return np.asarray((cosine > np.cos(np.radians(TRIAL_ANGLE_DEG))).all(axis=0))


def known_at_start(calibration: TaskCalibration, task: AlignmentTask, joints: FloatArray | None) -> Knowledge:
    """The controller's model at the start of ``task``; ``joints`` (n,): readings of a serial arm there."""
    if calibration.model is None:
        return _coarse(calibration, task, serial=joints is not None)
    model = calibration.model
    matrices = np.array([camera.matrix for camera in model.cameras])
    infinity = model.plane_at_infinity
    centres = _camera_centres(matrices, infinity)
    if joints is not None:
        chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero)
        points = model.marker_points @ chain.displacement(joints).T
        return Knowledge(
            Composition.BASE_FIRST, matrices, centres, infinity, model.generators, points, model.joint_kinds, model.zero
        )
    shift, turn = readings(task.start)
    moved = exp_twist(np.tensordot(shift, model.generators[:3], axes=1))
    turned = exp_twist(np.tensordot(turn, model.generators[3:], axes=1))
    basis = np.concatenate([model.generators[:3], conjugate(moved, model.generators[3:])])
    points = model.marker_points @ (moved @ turned).T
    return Knowledge(Composition.SIMULTANEOUS, matrices, centres, infinity, basis, points, model.joint_kinds)


def readings(start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Readings of the free arm's joints at a pose (4, 4): shift (3,) [m] and rotation (3,) [rad] from mid-range.

    The rotation about the initial position of the centre comes first, then the shift.
    """
    turn = Rotation.from_matrix(start[:3, :3] @ MID_RANGE[:3, :3].T).as_rotvec()
    return start[:3, 3] - MID_RANGE[:3, 3], turn


def _coarse(calibration: TaskCalibration, task: AlignmentTask, serial: bool) -> Knowledge:
    """Metric model in the rig's frame: focal lengths too long, arm rotated about the plate's centre at the start."""
    matrices = camera_matrices(1.0 + calibration.focal_error)
    infinity = np.array([0.0, 0.0, 0.0, 1.0])
    centres = _camera_centres(matrices, infinity)
    middle = task.start[:3, 3]
    turn = Rotation.from_rotvec(np.radians(calibration.hand_eye_error_deg) * task.error_axis).as_matrix()
    if not serial:
        basis = cartesian_twists(middle, turn)
        return Knowledge(Composition.SIMULTANEOUS, matrices, centres, infinity, basis, None, calibration.cell.kinds)
    error = np.eye(4)
    error[:3, :3], error[:3, 3] = turn, middle - turn @ middle
    cell = calibration.cell
    generators = conjugate(error, twists(cell, cell.home))
    return Knowledge(Composition.BASE_FIRST, matrices, centres, infinity, generators, None, cell.kinds, cell.home)


def _camera_centres(matrices: FloatArray, infinity: FloatArray) -> FloatArray:
    centres = np.array([camera_centre(P) for P in matrices])
    return np.asarray(centres / (centres @ infinity)[:, None])
