"""The tasks' arm behind an interface of Cartesian velocities: its virtual joints against the true plate, and tasks."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from stereoservo.ports.devices import DriverError
from stereoservo_sim.tasks.arms import MID_RANGE, rx90_cell, rx90_reach
from stereoservo_sim.tasks.calibrations import calibrate
from stereoservo_sim.tasks.closed_loop import LoopSettings, run_task
from stereoservo_sim.tasks.twist_arm import TwistArm, twist_cell, twist_start

GAIN = 2.0


@pytest.fixture(scope="module")
def twist():
    return calibrate("twist", "exact", 0.1, 0)


def straight(task):
    return np.array([task.start, task.goal])


def placed(tasks, count):
    """Tasks that the arm can do, the smallest turns first."""
    by_angle = sorted(tasks, key=lambda task: task.angle_deg)
    return list(islice((t for t in by_angle if twist_start(straight(t)) is not None), count))


def test_the_plate_is_where_six_exact_joints_would_have_it():
    """The controller's own inverse kinematics leaks; what it tells does not."""
    cell = twist_cell()
    np.testing.assert_allclose(cell.flange(cell.home), MID_RANGE, atol=1e-12)
    start = twist_start(MID_RANGE[None])
    assert start is not None
    arm = TwistArm(start)
    np.testing.assert_allclose(arm.joints, cell.home, atol=1e-5)
    asked = np.array([0.05, -0.04, 0.03, 0.2, -0.1, 0.15])
    for _ in range(100):
        arm.move(asked, 0.01)
        np.testing.assert_allclose(cell.flange(arm.joints), arm.pose, atol=1e-5)
    # The ramp of slides takes 0.07 s; the rest of the difference is the controller's.
    assert arm.joints - cell.home == pytest.approx(asked, rel=0.15)
    assert np.abs(arm.joints - cell.home - asked).max() > 1e-4


def test_what_the_arm_cannot_do_is_out_of_reach(public_kind):
    """Too far; and from the start's posture only by another one, to which no straight way leads."""
    far = MID_RANGE.copy()
    far[2, 3] = 4.0
    assert twist_start(np.array([MID_RANGE, far])) is None
    cell = rx90_cell()
    assert any(
        rx90_reach(cell, task.start, task.goal) is not None and twist_start(straight(task)) is None
        for task in public_kind
    )


def test_a_controller_that_stops_the_arm_is_told_in_its_own_words(public_kind, twist, monkeypatch):
    """A goal on whose way a joint of the arm ends, of which the service knows nothing."""
    start = twist_start(MID_RANGE[None])
    arm = TwistArm(start)
    with pytest.raises(DriverError, match=r"joint j\d of the arm at its limit|near a singularity") as caught:
        arm.move(np.array([0.25, 0.0, 0.0, 0.0, 0.0, 0.0]), 8.0)

    def stops(self, velocity, dt_s):
        raise caught.value

    monkeypatch.setattr(TwistArm, "move", stops)
    (task,) = placed(public_kind, 1)
    result, _ = run_task(task, twist, LoopSettings(arm="twist", core=True, gain=GAIN))
    assert (result.success, result.reason, result.refused) == (False, "PROTECTIVE_STOP", "")
    assert result.stopped == str(caught.value)


def test_the_law_alone_tells_slides_and_turns_apart(public_kind, twist):
    """In the operators at the readings, and in speeds."""
    (task,) = placed(public_kind, 1)
    result, trace = run_task(task, twist, LoopSettings(arm="twist", law="trajectory", gain=GAIN))
    assert result.success, result
    assert trace.joints.shape[1] == 6


@pytest.mark.slow
def test_twelve_of_twelve_self_calibrated(public_kind):
    learnt = calibrate("twist", "self", 0.1, 0)
    results = [
        run_task(task, learnt, LoopSettings(arm="twist", core=True, gain=GAIN))[0]
        for task in placed(public_kind[:24], 12)
    ]
    assert len(results) == 12
    assert [result for result in results if not result.success] == []
