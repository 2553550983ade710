"""Hard alignment tasks: up to 180° and 0.6 m, near the image borders, whose straight path leaves the view.

``python -m stereoservo_sim.tasks.hard_tasks`` writes `tasks_hard.csv` beside this module, reproducible by its seed.
Both end poses are visible in both cameras. Tasks are drawn until their straight path is of the required kind, one after
another of `KINDS`. A third of all rotate by 150° to 180°, every tenth by 180° exactly.
"""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.tasks.ground_truth import PlateView, sight
from stereoservo_sim.tasks.setting import MIN_DEPTH
from stereoservo_sim.tasks.task_file import AlignmentTask, tasks_text

SEED = 20_010_801
COUNT = 120
BORDER_PX = 6.0
"""Least distance of the end poses' markers from the image borders."""
MAX_VIEW_ANGLE_DEG = 78.0
MAX_DISTANCE_M, MAX_ANGLE_DEG = 0.6, 180.0
DEPTHS_M, ASIDE_M, DOWN_M = (0.45, 1.6), 0.45, 0.35
NEAR_PX = 20.0
STEPS = 41
FIRST_ID = 5000
KINDS = ("leaves the view", "near a border", "shows the back", "as it comes")
"""Kinds of straight path, used in turn; on it the centre moves straight and the plate rotates about one axis, by the
shorter rotation.
"""


def shipped_tasks_path() -> Path:
    """The shipped file of hard tasks."""
    with as_file(files(__package__).joinpath("tasks_hard.csv")) as path:
        return path


def hard_tasks(seed: int = SEED, count: int = COUNT) -> tuple[AlignmentTask, ...]:
    """The tasks of a seed."""
    return tuple(_task(seed, number) for number in range(count))


def _task(seed: int, number: int) -> AlignmentTask:
    rng = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    while True:
        angle = _angle(rng, number, kind)
        goal, start = _pose(rng), np.eye(4)
        shift = rng.uniform(0.05, MAX_DISTANCE_M) * _direction(rng)
        axis = _direction(rng)
        if kind == "leaves the view":
            # Both ends are close to the same border, and the plate rotates near it: corners swing out on the path.
            axis = goal[:3, 2] + 0.4 * axis
            axis /= np.linalg.norm(axis)
        start[:3, :3] = Rotation.from_rotvec(np.radians(angle) * axis).as_matrix() @ goal[:3, :3]
        start[:3, 3] = goal[:3, 3] + shift
        if kind == "leaves the view":
            aside = np.array([*_direction(rng)[:2], 0.0])
            goal, start = _pushed(goal, aside, rng), _pushed(start, aside, rng)
        distance = float(np.linalg.norm(start[:3, 3] - goal[:3, 3]))
        if not (_visible(goal) and _visible(start) and distance <= MAX_DISTANCE_M):
            continue
        margin, facing = straight_path_margins(start, goal)
        wanted = {
            "leaves the view": margin < 0.0 and facing > 0.0,
            "shows the back": facing <= 0.0,
            "near a border": 0.0 <= margin < NEAR_PX and facing > 0.0,
            "as it comes": True,
        }
        if wanted[kind]:
            break
    return AlignmentTask(FIRST_ID + number, seed, angle, distance, _direction(rng), start, goal)


def _pushed(pose: FloatArray, aside: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The pose moved along ``aside`` (3,) until it is as near to a border as drawn, if it was farther from it."""
    wanted_px = rng.uniform(BORDER_PX, NEAR_PX)
    low, high = 0.0, 2.0
    moved = pose.copy()
    for _ in range(14):
        middle = 0.5 * (low + high)
        moved[:3, 3] = pose[:3, 3] + middle * aside
        seen = sight(moved)
        inside = seen.depth_m > MIN_DEPTH and seen.margin_px > wanted_px
        low, high = (middle, high) if inside else (low, middle)
    moved[:3, 3] = pose[:3, 3] + low * aside
    return moved


def _angle(rng: np.random.Generator, number: int, kind: str) -> float:
    if number % 10 == 9:
        return MAX_ANGLE_DEG
    if number % 3 == 0 or kind == "shows the back":  # small rotations hardly ever show the back
        return float(rng.uniform(150.0, MAX_ANGLE_DEG))
    return float(rng.uniform(0.0, 150.0))


def straight_path_margins(start: FloatArray, goal: FloatArray) -> tuple[float, float]:
    """Least distance from the image borders [px] and least cosine to the plate's normal on the straight path.

    The centre moves straight while the plate rotates about one axis, by the shorter rotation.
    """
    turn = Rotation.from_matrix(goal[:3, :3] @ start[:3, :3].T).as_rotvec()
    margin, facing = np.inf, np.inf
    shares = np.linspace(0.0, 1.0, STEPS)
    rotations = Rotation.from_rotvec(shares[:, None] * turn).as_matrix() @ start[:3, :3]
    pose = np.eye(4)
    for share, R in zip(shares, rotations, strict=True):
        pose[:3, :3] = R
        pose[:3, 3] = (1.0 - share) * start[:3, 3] + share * goal[:3, 3]
        seen = sight(pose)
        margin = min(margin, seen.margin_px if seen.in_view else min(seen.margin_px, -1.0))
        facing = min(facing, seen.facing)
    return float(margin), float(facing)


def _pose(rng: np.random.Generator) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    pose[:3, 3] = rng.uniform(-ASIDE_M, ASIDE_M), rng.uniform(-DOWN_M, DOWN_M), rng.uniform(*DEPTHS_M)
    return pose


def _visible(pose: FloatArray) -> bool:
    """Whether both cameras see the plate's front, at the required distance from the borders."""
    seen: PlateView = sight(pose)
    return seen.in_view and seen.margin_px >= BORDER_PX and seen.facing > float(np.cos(np.radians(MAX_VIEW_ANGLE_DEG)))


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def hard_tasks_text() -> str:
    """The shipped file's text."""
    source = (
        f"hard tasks, written by stereoservo_sim.tasks.hard_tasks; default_rng([{SEED}, id - {FIRST_ID}]); to 180 deg "
        f"and {MAX_DISTANCE_M} m, end poses visible with a {BORDER_PX:g} px border and below {MAX_VIEW_ANGLE_DEG:g} deg"
    )
    return tasks_text(hard_tasks(), source)


if __name__ == "__main__":
    Path(__file__).with_name("tasks_hard.csv").write_text(hard_tasks_text(), encoding="utf-8")
