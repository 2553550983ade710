"""Random tasks like those of the public file: up to 150° and 0.4 m, both ends in view of both cameras."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.tasks.ground_truth import sight
from stereoservo_sim.tasks.task_file import AlignmentTask

MAX_ANGLE_DEG, MAX_DISTANCE_M = 150.0, 0.4
BORDER_PX, MAX_VIEW_ANGLE_DEG = 20.0, 75.0
"""Least distance of the end poses' markers from the image borders, and largest angle from the plate's normal."""
ASIDE_M, DOWN_M, DEPTHS_M = 0.25, 0.2, (0.8, 1.4)


def random_tasks(seed: int, count: int) -> tuple[AlignmentTask, ...]:
    """Random tasks; angle and distance are drawn once per task, the rest until both ends are visible."""
    rng = np.random.default_rng(seed)
    tasks: list[AlignmentTask] = []
    while len(tasks) < count:
        angle, distance = rng.uniform(0, MAX_ANGLE_DEG), rng.uniform(0, MAX_DISTANCE_M)
        while True:
            start, goal = random_ends(rng, angle, distance)
            if visible(goal) and visible(start):
                break
        tasks.append(AlignmentTask(len(tasks), seed, angle, distance, unit(rng), start, goal))
    return tuple(tasks)


def random_ends(rng: np.random.Generator, angle_deg: float, distance_m: float) -> tuple[FloatArray, FloatArray]:
    """Start and goal (4, 4) at a distance in a random direction and rotated about a random axis, in view or not."""
    goal, start = np.eye(4), np.eye(4)
    goal[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    goal[:3, 3] = rng.uniform(-ASIDE_M, ASIDE_M), rng.uniform(-DOWN_M, DOWN_M), rng.uniform(*DEPTHS_M)
    start[:3, :3] = Rotation.from_rotvec(np.radians(angle_deg) * unit(rng)).as_matrix() @ goal[:3, :3]
    start[:3, 3] = goal[:3, 3] + distance_m * unit(rng)
    return start, goal


def visible(pose: FloatArray) -> bool:
    """Whether both cameras see the plate's front, at the required distance from the borders."""
    seen = sight(pose)
    return seen.in_view and seen.margin_px > BORDER_PX and seen.facing > np.cos(np.radians(MAX_VIEW_ANGLE_DEG))


def unit(rng: np.random.Generator) -> FloatArray:
    """Random unit vector (3,), uniform on the sphere."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))
