"""``reproduce laws``: what the pictures of docs/goals-and-laws.md claim."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from stereoservo.core.model_arrays import with_unit_height
from stereoservo.kinematics.kernels import triangulate
from stereoservo_sim.experiments import laws_compared
from stereoservo_sim.experiments.catalogue import EXPERIMENTS
from stereoservo_sim.experiments.laws_compared import (
    CURRENT,
    compared_tasks,
    report_laws,
    run_laws,
    show_laws,
)
from stereoservo_sim.tasks.calibrations import calibrate
from stereoservo_sim.tasks.ground_truth import sight

LARGEST_PICTURE = 60_000


@pytest.fixture(scope="module")
def exact():
    return calibrate("free", "exact", 0.0, 0)


@pytest.fixture(scope="module")
def comparison(exact):
    return run_laws(0, lambda *told: None, calibration=exact)


def test_the_tasks_are_what_their_names_say():
    tasks = compared_tasks()
    for task in tasks.values():
        turn = task.start[:3, :3] @ task.goal[:3, :3].T
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
        assert angle == pytest.approx(task.angle_deg, abs=1e-3)
        assert np.linalg.norm(task.start[:3, 3] - task.goal[:3, 3]) == pytest.approx(task.distance_m, abs=1e-5)
    assert round(tasks["large"].angle_deg) == 132
    assert tasks["roll"].angle_deg == 180.0
    for pose in (tasks["roll"].start, tasks["roll"].goal):
        assert np.degrees(np.arccos(abs(pose[2, 2]))) == pytest.approx(60.0)


def test_what_each_law_does(comparison):
    rows = {(row["task"], row["law"]): row for row in report_laws(comparison)["rows"]}
    for task in ("large", "roll", "bent"):
        assert rows[task, "trajectory"]["success"]
        for law in ("cartesian3", "cartesian2"):
            assert rows[task, law]["line_deviation_mm"] < 1.0
            assert rows[task, law]["worst_view_angle_deg"] < 90.0
    assert rows["roll", "cartesian3"]["success"]
    assert rows["roll", "cartesian2"]["success"]
    assert rows["roll", CURRENT]["reason"] == "BACK_FACE"
    assert rows["bent", "cartesian3"]["reason"] == "OUT_OF_VIEW"
    assert rows["bent", "trajectory"]["line_deviation_mm"] > 10.0
    assert rows["large", "stereo"]["line_deviation_mm"] > 10.0


def test_it_is_shown_and_drawn_small_enough_to_keep(comparison, tmp_path):
    text = StringIO()
    show_laws(report_laws(comparison), Console(file=text))
    assert "cartesian3" in text.getvalue()
    paths = EXPERIMENTS["laws"].draw(comparison, tmp_path)
    assert len(paths) == 6
    assert all(1_000 < path.stat().st_size <= LARGEST_PICTURE for path in paths)
    assert "laws" in EXPERIMENTS


def test_goals_that_are_shown_are_reached(exact):
    goal = sight(laws_compared.goal_pose()).pixels
    for law in ("stereo", "cartesian3"):
        assert np.abs(laws_compared.shown(exact, law).pixels[-1] - goal).max() < 0.5


def test_a_displacement_counts_from_where_the_body_is(exact):
    first, second = laws_compared.displaced_twice(exact)
    # in the rig, both are the same motion of the body
    moves = [drive.poses[-1] @ np.linalg.inv(drive.poses[0]) for drive in (first, second)]
    assert np.allclose(first.poses[-1], second.poses[0], atol=2e-3)
    assert np.allclose(moves[0], moves[1], atol=3e-3)
    assert np.linalg.norm(first.poses[-1][:3, 3] - first.poses[0][:3, 3]) > 0.1


def test_a_carried_goal_stands_to_the_workpiece_as_taught(exact):
    carried = laws_compared.carried_over(exact)
    assert np.abs(carried.drive.pixels[-1] - carried.set_points).max() < 0.5
    # all points of the workpiece and the plate have moved by one motion of space
    world = laws_compared.World(exact, laws_compared.start_pose())
    matrices = world.knowledge.matrices
    assert np.abs(carried.taught - carried.set_points).max() > 10.0

    def points(workpiece, plate):
        pixels = np.concatenate([workpiece, plate], axis=1)
        found, ok = triangulate(matrices, np.ascontiguousarray(pixels), np.ones(pixels.shape[:2]), 5)
        assert ok.all()
        return with_unit_height(found, world.knowledge.plane_at_infinity)

    then = points(carried.workpiece_then, carried.taught)
    now = points(carried.workpiece_now, carried.set_points)
    motion = np.linalg.lstsq(then[:5], now[:5], rcond=None)[0]
    assert np.abs(then[5:] @ motion - now[5:]).max() < 1e-6


def test_the_marker_comes_onto_the_line(exact):
    on_line = laws_compared.point_on_line(exact)
    for camera in range(2):
        a, b = on_line.line[camera]
        normal = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
        for drive in (on_line.alone, on_line.with_second):
            assert abs(normal @ (drive.pixels[-1, camera, 0] - a)) < 0.5
    away = [np.abs(drive.pixels[-1] - on_line.set_points).mean() for drive in (on_line.alone, on_line.with_second)]
    assert away[1] < 0.5 * away[0]


def test_feed_forward_takes_the_lag_away(exact):
    streamed = laws_compared.streamed(exact)
    lag = [
        np.abs(drive.pixels[-50:] - streamed.target[-50:]).max() for drive in (streamed.fed_forward, streamed.without)
    ]
    assert lag[0] < 0.1 * lag[1]
