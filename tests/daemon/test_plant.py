"""The simulated drives behind their two records, on a virtual clock: orders, their own time-out, failures, sessions."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.daemon.plant import PlantProcess
from stereoservo.daemon.plant_driver import (
    PLANT_CAPACITY,
    PLANT_ORDERS_LAYOUT,
    PLANT_STATE_LAYOUT,
    PlantDriver,
)
from stereoservo.daemon.seqlock import create_slot
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.fake import FakeJointDriver

TIMEOUT_S = 0.1
GRIPPER = {"name": "gripper", "kind": "prismatic", "low": 0.0, "high": 0.08, "velocity": 0.1}


class Cell:
    """A fake arm in a plant, and the servo process's driver of it."""

    def __init__(self, root: Path) -> None:
        self.clock = VirtualClock()
        self.directories = CellDirectories("plant", root, root)
        create_slot(self.directories.plant_state_slot, PLANT_CAPACITY, PLANT_STATE_LAYOUT)
        create_slot(self.directories.plant_orders_slot, PLANT_CAPACITY, PLANT_ORDERS_LAYOUT)
        self.plant = self.started()
        self.driver = PlantDriver(
            self.plant.driver.describe(), self.directories, self.clock, sleep=lambda seconds: self.run(0.001)
        )

    def started(self) -> PlantProcess:
        """A plant process's plant."""
        options = {"command_timeout_s": TIMEOUT_S, "auxiliary": [GRIPPER]}
        root = self.directories.runtime
        return PlantProcess(
            FakeJointDriver(options, DriverContext(self.clock, "plant", root, root)),
            self.directories,
            self.clock,
        )

    @property
    def fake(self) -> Any:
        """The arm."""
        return self.plant.driver

    def run(self, seconds: float) -> None:
        """Let the plant run."""
        for _ in range(round(seconds * 1000)):
            self.clock.sleep(0.001)
            self.plant.step()


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    cell = Cell(tmp_path)
    cell.plant.step()
    cell.driver.configure()
    yield cell
    cell.driver.close()
    cell.plant.close()


def test_orders_reach_the_drives_and_stop_them_when_they_cease(cell: Cell) -> None:
    start = cell.driver.read_state()
    asked = np.zeros(len(start.positions))
    asked[0] = 0.2
    with pytest.raises(DriverError, match="while configured"):  # no power yet, in the drives' own words
        cell.fake.write_velocity(asked)
    cell.driver.activate()
    for _ in range(50):
        cell.driver.write_velocity(asked)
        cell.run(0.004)
    moving = cell.driver.read_state()
    assert moving.velocities[0] == pytest.approx(0.2)
    assert moving.seq > start.seq
    assert moving.positions[0] - start.positions[0] == pytest.approx(0.2 * 0.2, abs=0.2 * 0.2**2)
    cell.run(TIMEOUT_S + 0.2)  # the servo process says nothing
    resting = cell.driver.read_state()
    assert not resting.velocities.any()
    travel = resting.positions[0] - moving.positions[0]
    acceleration = cell.driver.describe().joints[0].acceleration_max
    assert 0.0 < travel <= 0.2 * (TIMEOUT_S + 0.002) + 0.5 * 0.2**2 / acceleration
    cell.driver.write_velocity(asked)
    cell.run(0.1)
    cell.driver.stop()
    cell.run(0.2)
    assert not cell.driver.read_state().velocities.any()


def test_at_rest_the_drives_are_told_so_often_enough_and_obey_motion_and_stop_at_once(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[int, bool]] = []
    write = cell.fake.write_velocity

    def noted(velocities: Any) -> Any:
        told.append((cell.clock.now_ns(), bool(velocities.any())))
        return write(velocities)

    monkeypatch.setattr(cell.fake, "write_velocity", noted)
    cell.driver.activate()
    rest, motion = np.zeros(6), np.full(6, 0.1)
    for _ in range(100):
        cell.driver.write_velocity(rest)
        cell.run(0.004)
    times = np.array([t_ns for t_ns, _ in told])
    assert 10 < len(told) < 30  # of 100 orders
    assert np.diff(times).max() <= 0.25e9 * TIMEOUT_S
    cell.driver.write_velocity(motion)
    cell.run(0.001)
    assert told[-1] == (cell.clock.now_ns(), True)
    cell.run(0.02)
    cell.driver.write_velocity(rest)
    cell.run(0.001)
    assert told[-1] == (cell.clock.now_ns(), False)
    cell.driver.write_velocity(rest)
    stopped: list[int] = []
    monkeypatch.setattr(cell.fake, "stop", lambda: stopped.append(cell.clock.now_ns()))
    cell.driver.stop()
    cell.run(0.001)
    assert stopped == [cell.clock.now_ns()]


def test_a_velocity_beyond_the_drives_limit_is_told(cell: Cell) -> None:
    cell.driver.activate()
    beyond = 10.0 * np.array([joint.velocity_max for joint in cell.driver.describe().joints])
    cell.driver.write_velocity(beyond)
    cell.run(0.002)
    cell.driver.read_state()
    report = cell.driver.write_velocity(beyond)  # and what was sent in its place
    assert report.reasons == ("drive_velocity_limit",)
    np.testing.assert_array_equal(report.sent, 0.1 * beyond)
    np.testing.assert_array_equal(cell.driver.write_velocity(0.0 * beyond).sent, 0.0 * beyond)


@pytest.mark.parametrize("call", ["read", "write"])
def test_a_failure_of_the_drives_is_raised_once_in_their_words_and_stops_them(cell: Cell, call: str) -> None:
    cell.driver.activate()
    asked = np.full(6, 0.1)
    cell.driver.write_velocity(asked)
    cell.run(0.05)
    setattr(cell.fake.faults, f"fail_{call}", 1)
    cell.driver.write_velocity(asked)
    cell.run(0.002)
    with pytest.raises(DriverError, match=f"{call} .* fails as ordered") as caught:
        cell.driver.read_state()
    assert (caught.value.code, caught.value.retry) == ("connection_lost", True)
    setattr(cell.fake.faults, f"fail_{call}", None)
    cell.run(0.3)
    assert not cell.driver.read_state().velocities.any()
    cell.driver.deactivate()
    cell.driver.configure()
    cell.driver.activate()
    cell.driver.write_velocity(asked)
    cell.run(0.1)
    assert cell.driver.read_state().velocities == pytest.approx(asked)


def test_drives_that_refuse_power_say_so(cell: Cell) -> None:
    cell.fake.faults.fail_activate = True
    with pytest.raises(DriverError, match="activate\\(\\) fails as ordered"):
        cell.driver.activate()


def test_a_plant_that_was_started_anew_stands_where_it_was_and_obeys_nobody_before_it_is_configured(
    cell: Cell,
) -> None:
    cell.driver.activate()
    for _ in range(50):
        cell.driver.write_velocity(np.full(6, 0.1))
        cell.run(0.004)
    before = cell.driver.read_state()
    cell.plant.close()
    cell.plant = cell.started()
    for _ in range(10):
        cell.run(0.001)
    with pytest.raises(DriverError) as caught:
        cell.driver.write_velocity(np.full(6, 0.1))
    assert caught.value.code == "plant_ended"
    cell.run(0.2)
    cell.driver.deactivate()
    cell.driver.configure()
    after = cell.driver.read_state()
    assert not after.velocities.any()
    assert after.positions == pytest.approx(before.positions, abs=0.01)
    cell.driver.activate()
    cell.driver.write_velocity(np.full(6, 0.1))
    cell.run(0.1)
    assert cell.driver.read_state().velocities == pytest.approx(np.full(6, 0.1))


def test_a_gripper_goes_where_it_is_ordered_and_stands_at_a_stop(cell: Cell) -> None:
    cell.driver.activate()
    assert isinstance(cell.driver.describe().auxiliary[0], AuxiliarySpec)
    cell.driver.write_auxiliary({"gripper": 0.05})
    cell.run(0.2)
    assert cell.driver.read_state() is not None
    assert cell.driver.read_auxiliary()["gripper"] == pytest.approx(0.02, abs=2e-3)
    cell.driver.stop_auxiliary()
    cell.run(1.0)
    cell.driver.read_state()
    assert cell.driver.read_auxiliary()["gripper"] == pytest.approx(0.02, abs=2e-3)
    with pytest.raises(DriverError, match="there are: gripper"):
        cell.driver.write_auxiliary({"claw": 0.0})


def test_what_was_ordered_of_a_plant_that_ended_is_not_done_by_its_successor(cell: Cell) -> None:
    cell.driver.activate()
    cell.driver.write_auxiliary({"gripper": 0.05})
    cell.run(1.0)
    cell.driver.read_state()
    assert cell.driver.read_auxiliary()["gripper"] == pytest.approx(0.05)
    cell.plant.close()
    cell.plant = cell.started()
    cell.run(0.01)
    cell.driver.configure()  # orders of before would be refused by drives without power, and fail this call
    cell.driver.activate()
    cell.run(1.0)
    cell.driver.read_state()
    assert cell.driver.read_auxiliary()["gripper"] == 0.0


def test_an_order_that_is_refused_is_not_carried_out_with_the_next(cell: Cell) -> None:
    cell.driver.activate()
    with pytest.raises(DriverError, match="there are: gripper"):
        cell.driver.write_auxiliary({"gripper": 0.05, "claw": 0.0})
    cell.driver.write_auxiliary({})
    cell.run(1.0)
    cell.driver.read_state()
    assert cell.driver.read_auxiliary()["gripper"] == 0.0


def test_a_servo_process_started_anew_has_its_calls_carried_out(cell: Cell) -> None:
    calls: list[str] = []
    configure = cell.fake.configure
    cell.fake.configure = lambda: (calls.append("configure"), configure())
    for _ in range(2):  # the first call of each
        cell.driver.close()
        cell.driver = PlantDriver(
            cell.plant.driver.describe(), cell.directories, cell.clock, sleep=lambda seconds: cell.run(0.001)
        )
        cell.driver.configure()
    assert calls == ["configure", "configure"]


def test_a_process_number_that_is_another_users_by_now_is_no_plant(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(pid: int, number: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("stereoservo.daemon.seqlock.os.kill", refused)
    cell.clock.sleep(1.0)
    with pytest.raises(DriverError) as caught:
        cell.driver.read_state()
    assert caught.value.code == "plant_ended"


def test_a_stop_after_close_is_no_error(cell: Cell) -> None:
    cell.driver.activate()
    cell.driver.close()
    cell.driver.stop()
    cell.driver.stop_auxiliary()
    cell.driver.close()
    cell.run(0.01)
    assert cell.fake._life.state == "configured"
