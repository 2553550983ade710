"""A whole cell in lockstep whose cell file states no ranges: it plans its trials, calibrates, and checks itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CellFile, check_cell
from stereoservo.ports.devices import JointState
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator, LockstepRefusalError
from stereoservo_sim.world.simulated_cell import demo_cell

NAMES = tuple(f"j{k}" for k in range(1, 7))


def cell_file(**calibration: Any) -> CellFile:
    base = demo_cell().base
    limits = zip(NAMES, (2.7, 2.3, 2.4, 4.7, 1.8, 4.7), strict=True)
    return check_cell(
        {
            "schema": 1,
            "cell": {"name": "planned"},
            "joints": {"driver": "fake"},
            "camera": [{"name": name, "driver": "fake"} for name in ("left", "right")],
            "safety": {
                "limit": [
                    {"joint": n, "min": -m, "max": m, "velocity": 1.0, "acceleration": 4.0} for n, m in limits
                ]
            },
            "calibration": {
                "base": dict(zip(NAMES, base.tolist(), strict=True)),
                "stops": 7, "frames": 2, "settle_s": 0.05, "speed_scale": 1.0, **calibration,
            },
        }
    )  # fmt: skip


Calibrated = tuple[LockstepOperator, CellModel, TrialData]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Calibrated]:
    directory = tmp_path_factory.mktemp("planned")
    with LockstepCell(cell_file(), cell_dir=directory, runtime_dir=directory) as cell:
        cell.run_for(0.5)
        operator = LockstepOperator(cell)
        operator.enable()
        model = operator.calibrate()
        assert operator.trials is not None
        yield operator, model, operator.trials


def test_a_cell_without_ranges_calibrates_to_the_noise_floor(calibrated: Calibrated) -> None:
    operator, model, trials = calibrated
    assert model.stratum == "metric"
    assert model.statistics is not None
    assert model.statistics.chi2_ok
    for j in range(6):
        own = trials.trials == j
        assert np.ptp(trials.positions[own, j]) > 0.2, NAMES[j]
        assert own.sum() >= 5
    warnings = [e.message for e in operator.cell.events if e.kind == "warning"]
    assert not [message for message in warnings if "loses the markers" in message], warnings


@pytest.mark.slow  # in the suite: the stops of such a plan, tests/core/test_trials.py
def test_a_spread_joint_gives_every_trial_several_positions_of_the_body(tmp_path: Path) -> None:
    spread = {"joint": "j6", "positions": 3, "range": 0.5}
    ranges = dict(zip(NAMES, (0.2, 0.2, 0.2, 0.5, 0.4, 0.6), strict=True))
    with LockstepCell(cell_file(range=ranges, spread=spread, stops=5), cell_dir=tmp_path, runtime_dir=tmp_path) as cell:
        cell.run_for(0.5)
        operator = LockstepOperator(cell)
        operator.enable()
        model = operator.calibrate()
    trials = operator.trials
    assert trials is not None
    for j in range(5):
        turned = trials.positions[trials.trials == j, 5]
        assert len(np.unique(turned.round(2))) == 3, NAMES[j]
    assert model.statistics is not None
    assert model.statistics.chi2_ok
    assert model.stratum == "metric"


def test_an_unchanged_cell_holds_and_a_drifted_joint_is_named(calibrated: Calibrated) -> None:
    operator, model, _ = calibrated
    report = operator.check(model)
    assert report.status == "holds", report.message
    assert report.stops >= 6
    zero = model.zero.copy()
    zero[2] += 0.01
    drifted = operator.check(msgspec.structs.replace(model, zero=zero))
    assert [(cause.kind, cause.subject) for cause in drifted.causes] == [("joint", "j3")]
    assert drifted.causes[0].value == pytest.approx(0.01, abs=5 * drifted.causes[0].deviation)
    assert drifted.status == "recalibrate"
    assert "recalibrate because zero of joint j3 drifted by" in drifted.message


def test_an_encoder_that_lost_its_zero_is_found_and_cured(
    calibrated: Calibrated, monkeypatch: pytest.MonkeyPatch
) -> None:
    operator, model, _ = calibrated
    with pytest.raises(CalibrationError) as caught:
        operator.reset_zeros(model)
    assert caught.value.code == "check_holds"
    cell = operator.cell
    operator.teach("before")
    read = cell.joints.read_state

    def offset() -> JointState:
        state = read()
        return msgspec.structs.replace(state, positions=state.positions - 0.02 * np.eye(6)[3])

    monkeypatch.setattr(cell.joints, "read_state", offset)
    cured, told = operator.reset_zeros(model)
    (joint,) = told.joints
    assert joint.joint == "j4"
    assert joint.drift == pytest.approx(0.02, abs=5 * joint.deviation)
    assert told.sigmas_before > 5
    assert told.sigmas_after < 1.2
    assert cell.status is not None
    assert cell.status.model_epoch == cured.epoch == told.epoch > told.from_epoch == model.epoch
    report = operator.check(cured)
    assert report.status == "holds", report.message
    # The loop's own predictions are back at the noise, and a goal of the old epoch is refused as after a calibration.
    cell.run_for(0.5)
    assert cell.status.model == "valid"
    with pytest.raises(LockstepRefusalError, match="teach it again"):
        operator.goal("before")
    operator.teach("after")
    assert operator.goal("after").kind == "goal_reached"
