"""The benchmark of thesis 8.7: half a turn about the roll axis, the face tilted by 60°; and an arm that reaches it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from stereoservo.trajectory.cartesian_path import CartesianPath, cartesian_path
from stereoservo.trajectory.plan import Profile
from stereoservo.trajectory.three_points import decompose
from stereoservo_sim.exact_model import exact_model
from stereoservo_sim.synthetic import SyntheticCell, rotation, translation
from stereoservo_sim.tasks.arms import MID_RANGE, PLATE_ON_FLANGE, RX90_LIMITS, rx90_cell
from stereoservo_sim.tasks.calibrations import Calibration, Knowledge
from stereoservo_sim.tasks.closed_loop import LoopSettings, run_task
from stereoservo_sim.tasks.setting import FACE, HOMOGENEOUS_MARKERS, camera_poses, cartesian_twists
from stereoservo_sim.tasks.task_file import AlignmentTask
from stereoservo_sim.tasks.wrist_solutions import inverse_kinematics

FloatArray = npt.NDArray[np.float64]

TILT_DEG, DEPTH_M = 60.0, 1.0
ASIDE_M = {"centred": 0.0, "aside": 0.15}
"""Of the plate's middle from the roll axis at the goal: to the side that its face looks away from."""
LIMIT_MARGIN = np.radians(5.0)
WAY_STEPS = 25
LARGEST_JOINT_STEP = np.radians(25.0)
"""Between two samples of the way: beyond it the arm would change its posture."""
TRIED_GAIN, TRIED_SEEDS = 1.0, 4


def benchmark_task(where: str) -> AlignmentTask:
    """``centred``: nothing but the turn; ``aside``: the plate's middle goes from one side of the axis to the other."""
    goal = translation(ASIDE_M[where], 0.0, DEPTH_M) @ rotation("y", TILT_DEG)
    start = rotation("z", 180.0) @ goal
    number = list(ASIDE_M).index(where)
    return AlignmentTask(number, 0, 180.0, 2.0 * ASIDE_M[where], np.array([1.0, 0.0, 0.0]), start, goal)


def true_way(task: AlignmentTask, profile: Profile = "linear") -> CartesianPath:
    """The Cartesian way (7.25) of the plate in the rig's own frame."""
    A, A_star = HOMOGENEOUS_MARKERS @ task.start.T, HOMOGENEOUS_MARKERS @ task.goal.T
    eyes = np.hstack([camera_poses()[:, :3, 3], np.ones((2, 1))])
    parts = decompose(
        cartesian_twists(task.start[:3, 3]), A[FACE], A_star[FACE], A.mean(axis=0), A_star.mean(axis=0), eyes
    )
    return cartesian_path(parts, profile)


def known_way(
    knowledge: Knowledge, targets: FloatArray, profile: Profile = "linear"
) -> tuple[CartesianPath, FloatArray]:
    """The same from what a controller knows, towards points ``targets`` (m, 4); and the points (m, 4) now.

    Raises ValueError where it does not know the markers' places on the body.
    """
    if knowledge.points is None:
        raise ValueError("a model that knows the markers' places on the body is needed")
    A = knowledge.points
    parts = decompose(
        knowledge.basis,
        A[FACE],
        targets[FACE],
        A.mean(axis=0),
        targets.mean(axis=0),
        knowledge.camera_centres,
    )
    return cartesian_path(parts, profile), A


def placed_rx90(task: AlignmentTask, seed: int, tries: int = 2000) -> SyntheticCell | None:
    """The RX 90 with its base where it drives the whole Cartesian way of ``task`` without a limit; None if not found.

    Configurations at the start are drawn by seed. The Cartesian laws then have to drive it with an exact model, for
    several seeds of the noise: it decides the sense of half a turn. Home is the configuration nearest to the start in
    which the plate is at mid-range.
    """
    rng, cell = np.random.default_rng([seed, 90]), rx90_cell()
    low, high = RX90_LIMITS[:, 0] + LIMIT_MARGIN, RX90_LIMITS[:, 1] - LIMIT_MARGIN
    limits = np.stack([low, high], axis=1)
    back = np.linalg.inv(PLATE_ON_FLANGE)
    way = true_way(task)
    poses = [way.displacement(s) @ task.start @ back for s in np.linspace(0.0, 1.0, WAY_STEPS)]
    for _ in range(tries):
        q = rng.uniform(low, high)
        base = poses[0] @ np.linalg.inv(np.linalg.inv(cell.base) @ cell.flange(q))
        inverse = np.linalg.inv(base)
        home = _nearest(inverse_kinematics(inverse @ MID_RANGE @ back, limits), q)
        if home is not None and _follows(inverse, poses, q, limits):
            found = replace(cell, base=base, home=home)
            if _drives(found, task):
                return found
    return None


def _drives(cell: SyntheticCell, task: AlignmentTask) -> bool:
    exact = Calibration("rx90", cell, exact_model(cell), {})
    return all(
        run_task(task, exact, LoopSettings(law=law, arm="rx90", gain=TRIED_GAIN, seed=seed))[0].success
        for law in ("cartesian3", "cartesian2")
        for seed in range(TRIED_SEEDS)
    )


def _follows(inverse: FloatArray, poses: list[FloatArray], q: FloatArray, limits: FloatArray) -> bool:
    """Whether one posture from ``q`` (6,) follows the flange's poses within the limits."""
    for pose in poses[1:]:
        following = _nearest(inverse_kinematics(inverse @ pose, limits), q)
        if following is None or float(np.abs(following - q).max()) > LARGEST_JOINT_STEP:
            return False
        q = following
    return True


def _nearest(found: FloatArray, q: FloatArray) -> FloatArray | None:
    return None if len(found) == 0 else found[int(np.abs(found - q).max(axis=1).argmin())]
