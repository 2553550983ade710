"""Every family of arms against a metric solver: all solutions, singular poses, goals out of reach."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from stereoservo_sim.experiments import metric_inverse as metric
from stereoservo_sim.experiments.catalogue import EXPERIMENTS
from stereoservo_sim.experiments.inverse_kinematics import (
    FAMILIES,
    PUMA_ROWS,
    differences,
    family_row,
    from_rows,
    hide,
    offset,
)
from stereoservo_sim.world.synthetic import OFFSET_ROWS, RX90_ROWS

SEARCHED = ("offset wrist", "six revolute, general", "seven revolute")
FULL = {"PUMA": 8.0, "wrist, square": 2.0, "gantry with wrist": 2.0, "two revolute, parallel": 2.0}
"""Solutions of every pose, where their number does not depend on it."""
CLOSE = 1e-6
"""Joints of a solution [rad or m]: rounding (1e-15) over the sine of the closest angle to a singularity drawn."""


def check(row, poses):
    assert row["solved"] == poses
    assert row["worst_residual"] < 1e-8
    for handled in (row["singular"], row["unreachable"], row["self_motion"]):
        if handled is not None:
            done, of = handled.split(" of ")
            assert done == of
    if row["solutions"] is None:
        assert row["self_motion"] is not None
        return
    assert row["found_share"] == 1.0
    assert row["others"] == 0
    assert row["worst_joint_error"] < CLOSE
    assert row["solutions"] == FULL.get(row["family"], row["solutions"] / poses) * poses


@pytest.mark.parametrize("name", FAMILIES)
def test_all_solutions_of_a_family_are_found(name):
    poses = 5 if name in SEARCHED else 100 if name in ("PUMA", "arm with wrist") else 200
    check(family_row(name, FAMILIES[name], poses, np.random.default_rng(11)), poses)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", FAMILIES)
def test_all_solutions_of_ten_thousand_poses_are_found(name):
    poses = 10_000 if FAMILIES[name].judge is not FAMILIES["six revolute, general"].judge else 1_000
    check(family_row(name, FAMILIES[name], poses, np.random.default_rng(12)), poses)


@pytest.mark.parametrize("rows", [RX90_ROWS, PUMA_ROWS])
def test_the_judge_finds_its_own_poses_again(rows):
    """The metric solver against forward kinematics alone: every solution it gives, and the pose's own joints."""
    axes, rng = from_rows(rows), np.random.default_rng(1)
    judge(axes, metric.with_wrist, rng)


def test_the_judge_of_offset_wrists_finds_its_own_poses_again():
    for axes in (from_rows(OFFSET_ROWS), offset(np.random.default_rng(2))):
        judge(axes, metric.three_parallel, np.random.default_rng(3))


def judge(axes, solver, rng):
    q = rng.uniform(-np.pi, np.pi, (200, 6))
    goals = axes.displacements(q)
    for own, goal, solutions in zip(q, goals, solver(axes, goals), strict=True):
        right = solutions[~np.isnan(solutions).any(axis=1)]
        assert axes.displacements(right) == pytest.approx(np.broadcast_to(goal, (len(right), 4, 4)), abs=1e-6)
        assert differences(axes, own[None], right)[0] < CLOSE


def test_sixteen_solutions():
    """Manseur and Doty's arm (1989) has poses with all 16 that six revolute joints can have; two searches find them."""
    axes = from_rows(((0.3, 90, 0), (1, 1, 0), (0, 90, 0.2), (1.5, 1, 0), (0, 90, 0), (0, 1, 0)))
    q = np.array([1.884858309, -1.334007929, 2.088433311, -0.79732727, -2.441595111, 0.09812977])
    goal = axes.displacements(q[None])[0]
    rng = np.random.default_rng(0)
    arm = hide(axes, rng)
    found = arm.solve(goal, None)
    metric_ones = metric.all_solutions(axes, goal, 2000, rng)
    assert len(found.joints) == len(metric_ones) == 16
    assert differences(axes, metric_ones, found.joints - arm.chain.zero).max() < CLOSE


def test_reproduce_prints_one_finite_json_object_and_the_same_for_the_same_seed(app, tmp_path):
    runs = [CliRunner().invoke(app, ["inverse-kinematics", "--seeds", "2", "--seed", "5", "--json"]) for _ in range(2)]
    assert [run.exit_code for run in runs] == [0, 0]
    answer = json.loads(runs[0].stdout)
    assert runs[0].stdout == runs[1].stdout
    assert [row["family"] for row in answer["rows"]] == list(FAMILIES)
    assert answer["thesis"] == {}
    assert answer["seed"] == 5
    for row in answer["rows"]:
        check(row, 2)
    (picture,) = EXPERIMENTS["inverse-kinematics"].draw(answer, tmp_path)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_another_seed_draws_other_arms():
    one, other = (family_row("arm", FAMILIES["arm"], 3, np.random.default_rng(seed)) for seed in (1, 2))
    assert one != other


@pytest.fixture
def app():
    import typer

    from stereoservo_sim.commands.reproduce import reproduce

    assert "inverse-kinematics" in EXPERIMENTS
    app = typer.Typer()
    app.command()(reproduce)
    return app
