"""Arms whose encoders have 4096 counts a turn: trial motions, home, and joint goals arrive, and say where they rest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.messages.cell_file import CellFile, check_cell
from stereoservo.messages.goals import Calibrate, JointTarget
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import demo_cell

NAMES = tuple(f"j{k}" for k in range(1, 7))
STEP = 2.0 * np.pi / 4096


def cell_file(mechanics: Any) -> CellFile:
    base = dict(zip(NAMES, demo_cell().base.tolist(), strict=True))
    limits = zip(NAMES, (2.7, 2.3, 2.4, 4.7, 1.8, 4.7), strict=True)
    ranges = dict(zip(NAMES, (0.2, 0.2, 0.2, 0.5, 0.4, 0.6), strict=True))
    return check_cell(
        {
            "schema": 1,
            "cell": {"name": "coarse"},
            "joints": {"driver": "fake", "options": {"mechanics": mechanics}},
            "camera": [{"name": name, "driver": "fake"} for name in ("left", "right")],
            "safety": {
                "limit": [
                    {"joint": n, "min": -m, "max": m, "velocity": 1.0, "acceleration": 4.0} for n, m in limits
                ]
            },
            "calibration": {
                "base": base, "range": ranges, "stops": 5, "frames": 2, "settle_s": 0.05, "speed_scale": 1.0,
            },
        }
    )  # fmt: skip


COUNTS = {name: {"encoder_step": STEP, "encoder_side": "joint"} for name in NAMES}
ARMS = {"coarse encoders": COUNTS, "serial servos": "serial_servo"}


@pytest.fixture(scope="module", params=list(ARMS))
def operated(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[LockstepOperator, TrueJointHistory]]:
    directory = tmp_path_factory.mktemp("coarse")
    history = TrueJointHistory.in_memory(6, capacity=1 << 15)
    services = {"world": history}
    file = cell_file(ARMS[request.param])
    with LockstepCell(file, cell_dir=directory, runtime_dir=directory, services=services) as cell:
        cell.run_for(0.5)
        operator = LockstepOperator(cell)
        operator.enable()
        yield operator, history


def rest_of(history: TrueJointHistory) -> np.ndarray:
    newest = history.newest()
    assert newest is not None
    return newest[1]


def test_a_joint_goal_arrives_and_the_arm_rests_there(
    operated: tuple[LockstepOperator, TrueJointHistory],
) -> None:
    operator, history = operated
    rng = np.random.default_rng(3)
    for _ in range(3):
        target = demo_cell().base + rng.uniform(-0.1, 0.1, 6)
        end = operator.goal(JointTarget(dict(zip(NAMES, target.tolist(), strict=True))))
        assert end.kind == "goal_reached", end.reasons
        assert np.abs(rest_of(history) - target).max() < (0.75 + 0.5) * STEP
        operator.cell.run_for(0.2)
        rested = rest_of(history)
        operator.cell.run_for(1.0)
        assert np.ptp([rested, rest_of(history)], axis=0).max() < 1e-6


def test_home_arrives(operated: tuple[LockstepOperator, TrueJointHistory]) -> None:
    operator, history = operated
    assert operator.home().kind == "goal_reached"
    assert np.abs(rest_of(history) - demo_cell().base).max() < (0.75 + 0.5) * STEP


def test_trial_motions_are_done(operated: tuple[LockstepOperator, TrueJointHistory]) -> None:
    operator, _ = operated
    cell = operator.cell
    since = cell.events[-1].seq
    assert cell.submit(Calibrate("0000cafe")).accepted
    end = cell.wait_for(lambda event: event.kind in ("calibration_finished", "calibration_aborted"), 600.0, since)
    assert end.kind == "calibration_finished", end.message
    collector = TrialCollector(cell.settings)
    for event in cell.events:
        collector.add(event)
    assert {event.trial for event in cell.events if event.kind == "calibration_frames"} == {-1, 0, 1, 2, 3, 4, 5}
    assert np.bincount(collector.trials().trials + 1, minlength=7).min() >= 10
