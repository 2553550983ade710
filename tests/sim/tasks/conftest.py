"""Task files for the tests: the hard ones that are shipped, and others of the public file's kind, drawn here."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo_sim.tasks.calibrations import calibrate
from stereoservo_sim.tasks.judge import sight
from stereoservo_sim.tasks.task_file import AlignmentTask


def unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def drawn_tasks(seed, count):
    """Tasks to 150° and 0.4 m whose ends are visible with 20 px and below 75°, as the benchmark's are drawn."""
    rng = np.random.default_rng(seed)
    tasks = []

    def visible(pose):
        seen = sight(pose)
        return seen.in_view and seen.margin_px > 20 and seen.facing > np.cos(np.radians(75))

    while len(tasks) < count:
        angle, distance = rng.uniform(0, 150), rng.uniform(0, 0.4)
        while True:
            goal, start = np.eye(4), np.eye(4)
            goal[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
            goal[:3, 3] = rng.uniform(-0.25, 0.25), rng.uniform(-0.2, 0.2), rng.uniform(0.8, 1.4)
            start[:3, :3] = Rotation.from_rotvec(np.radians(angle) * unit(rng)).as_matrix() @ goal[:3, :3]
            start[:3, 3] = goal[:3, 3] + distance * unit(rng)
            if visible(goal) and visible(start):
                break
        tasks.append(AlignmentTask(len(tasks), seed, angle, distance, unit(rng), start, goal))
    return tuple(tasks)


@pytest.fixture(scope="session")
def public_kind():
    """50 tasks of the public file's kind."""
    return drawn_tasks(11, 50)


@pytest.fixture(scope="session")
def learnt():
    """The free arm, self-calibrated at 0.1 px."""
    return calibrate("free", "self", 0.1, 0)


@pytest.fixture(scope="session")
def drawn():
    """Draws tasks of the public file's kind: ``drawn(seed, count)``."""
    return drawn_tasks
