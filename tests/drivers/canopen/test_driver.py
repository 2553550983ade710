"""The CAN driver and faults: raised once, latched, cleared by nothing but a reset, which enables nothing.

Over emulated CiA 402 drives behind serial-line CAN on TCP, served by a thread of this process.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.ports.clock import MonotonicClock, VirtualClock
from stereoservo.ports.devices import Clock, DriverContext, DriverError, ExaminableJointDriver
from stereoservo_drivers.canopen.driver import CanJointDriver
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_drivers.options import decode_options
from stereoservo_sim.emulators.bus.bus_server import BusServer, SlcanTcp
from stereoservo_sim.emulators.bus.factory import DrivesSettings, make_bus_emulator

OPTIONS: dict[str, Any] = {
    "interface": "stereoservo_slcan",
    "rate_hz": 125.0,
    "max_missed_cycles": 40,
    "heartbeat_timeout_ms": 1000,
    "rpdo_deadline_ms": 1000,
    "loop_timeout_ms": 2000,
    "joint": [
        {
            "name": f"j{k}", "node_id": k, "counts_per_rev": 65536, "gear_ratio": 100.0, "max_velocity": 1.0,
            "max_acceleration": 10.0, "quick_stop_deceleration": 20.0, "position_min": -2.0, "position_max": 2.5,
        }
        for k in (1, 2)
    ],
}  # fmt: skip
ASK = np.array([0.1, -0.1])
PATIENCE_S = 60.0
"""[s] For what a busy machine does late; how long it takes is not judged."""


class Arm:
    """A driver and the drives that it drives."""

    def __init__(self, options: dict[str, Any], server: BusServer, tmp_path: Path) -> None:
        self.server = server
        self.options = options
        self.context = context(tmp_path, MonotonicClock())
        self.driver = CanJointDriver(options, self.context)

    def active(self) -> CanJointDriver:
        self.driver.configure()
        self.driver.activate()
        self.drive(10)
        return self.driver

    def drive(self, cycles: int) -> None:
        for _ in range(cycles):
            self.driver.read_state()
            self.driver.write_velocity(ASK)
            time.sleep(0.008)

    def drive_until_fault(self, limit_s: float = PATIENCE_S) -> DriverError:
        until = time.monotonic() + limit_s
        while time.monotonic() < until:
            try:
                self.drive(1)
            except DriverError as error:
                return error
        raise AssertionError(f"no fault within {limit_s} s")

    def axes(self) -> list[Any]:
        return [node.axis for node in self.server.emulator.nodes]

    def rests(self, limit_s: float = PATIENCE_S) -> bool:
        """Whether all axes truly come to rest, nobody calling the driver."""
        until = time.monotonic() + limit_s
        while time.monotonic() < until:
            if all(axis.velocity == 0.0 for axis in self.axes()):
                return True
            time.sleep(0.01)
        return False

    def wait_for(self, wanted: Callable[[], bool]) -> None:
        until = time.monotonic() + PATIENCE_S
        while not wanted():
            assert time.monotonic() < until
            time.sleep(0.008)


def context(tmp_path: Path, clock: Clock) -> DriverContext:
    return DriverContext(clock=clock, cell="test", runtime_dir=tmp_path, cell_dir=tmp_path)


@pytest.fixture
def make_arm(tmp_path: Path) -> Iterator[Callable[..., Arm]]:
    """``make_arm(option=…)``; ended after the test."""
    opened: list[tuple[Arm, BusServer]] = []

    def make(**changes: Any) -> Arm:
        endpoint = SlcanTcp(0, 1_000_000)
        options = OPTIONS | {"channel": endpoint.channel} | changes
        emulator = make_bus_emulator(
            decode_options(CanOptions, options, "canopen"),
            DrivesSettings(plant="ideal", brake_ms=5.0),
            t_ns=time.monotonic_ns(),
        )
        server = BusServer(emulator, endpoint)
        server.__enter__()
        arm = Arm(options, server, tmp_path)
        opened.append((arm, server))
        return arm

    yield make
    for arm, server in opened:
        arm.driver.close()
        server.__exit__(None, None, None)


@pytest.fixture
def arm(make_arm: Callable[..., Arm]) -> Arm:
    return make_arm()


def test_the_description_is_the_cell_files(arm: Arm) -> None:
    description = arm.driver.describe()
    assert description.lacks == ("following_errors",)
    assert (description.rate_hz, description.pacing, description.command_timeout_s) == (125.0, "clock", 0.1)
    assert [joint.name for joint in description.joints] == ["j1", "j2"]
    first = description.joints[0]
    assert (first.position_min, first.position_max, first.velocity_max) == (-2.0, 2.5, 1.0)
    assert isinstance(arm.driver, ExaminableJointDriver)


def test_bad_options_are_refused_before_anything_is_opened(tmp_path: Path) -> None:
    clock = MonotonicClock()
    with pytest.raises(DriverError, match="are these degrees"):
        CanJointDriver(
            OPTIONS | {"channel": "x", "joint": [OPTIONS["joint"][0] | {"position_max": 170.0}]},
            context(tmp_path, clock),
        )
    with pytest.raises(DriverError, match="chanel"):
        CanJointDriver(OPTIONS | {"chanel": "x"}, context(tmp_path, clock))


def test_lockstep_is_refused(tmp_path: Path) -> None:
    driver = CanJointDriver(OPTIONS | {"channel": "x"}, context(tmp_path, VirtualClock()))
    with pytest.raises(DriverError, match="pybullet"):
        driver.configure()


def test_a_bus_that_is_not_there_may_come_later(make_arm: Callable[..., Arm]) -> None:
    arm = make_arm()
    arm.server.order("adapter out")
    with pytest.raises(DriverError) as refusal:
        arm.driver.configure()
    assert refusal.value.retry
    arm.driver.stop()
    arm.server.order("adapter in")
    arm.driver.configure()
    assert np.isfinite(arm.driver.read_state().positions).all()


def test_a_missing_node_leaves_nothing_open(arm: Arm) -> None:
    arm.server.order("silence 2")
    with pytest.raises(DriverError) as refusal:
        arm.driver.configure()
    assert refusal.value.code == "node_missing"
    assert arm.driver.bus is None
    arm.server.order("speak 2")
    arm.driver.configure()


def test_a_drive_fault_is_raised_once_stops_all_and_stays_until_the_reset(arm: Arm) -> None:
    driver = arm.active()
    arm.server.order("fault 2 0x3210")
    error = arm.drive_until_fault()
    assert "node 2" in str(error)
    assert error.code in ("drive_fault", "emergency")
    assert arm.rests()
    before = driver.read_state()  # told once: where the arm stands is seen again
    arm.wait_for(lambda: driver.read_state().seq > before.seq)
    for _ in range(2):
        with pytest.raises(DriverError, match="0x3210"):
            driver.write_velocity(ASK)
    driver.deactivate()
    with pytest.raises(DriverError, match="0x3210"):
        driver.activate()
    driver.configure()
    time.sleep(0.1)
    assert not any(axis.powered for axis in arm.axes())  # a reset does not enable
    with pytest.raises(DriverError):
        driver.write_velocity(ASK)
    driver.activate()
    start = driver.read_state().positions

    def has_moved() -> bool:
        driver.write_velocity(ASK)
        return bool(np.all((driver.read_state().positions - start) * ASK > 1e-3))

    arm.wait_for(has_moved)


def test_a_drive_that_is_in_fault_at_the_start(arm: Arm) -> None:
    arm.server.order("sticky 1 0x4310")
    driver = arm.driver
    driver.configure()
    with pytest.raises(DriverError, match="0x4310") as told:
        driver.read_state()
    assert told.value.data["latched"], "a reset ends it, and nothing else"
    assert np.isfinite(driver.read_state().positions).all()
    with pytest.raises(DriverError):
        driver.activate()
    with pytest.raises(DriverError) as refusal:
        driver.configure()  # the cause is still there
    assert "0x4310" in str(refusal.value)
    with pytest.raises(DriverError):
        driver.activate()
    arm.server.order("sticky 1 off")
    driver.configure()
    driver.read_state()
    driver.activate()


def test_an_adapter_that_is_pulled_out_and_put_in_again(make_arm: Callable[..., Arm]) -> None:
    arm = make_arm()
    driver = arm.active()
    arm.server.order("adapter out")
    error = arm.drive_until_fault()
    assert error.code == "connection_lost"
    assert arm.rests()  # by the drives' own watch on the master's heartbeat
    driver.stop()
    driver.deactivate()
    with pytest.raises(DriverError):
        driver.configure()  # still out
    with pytest.raises(DriverError):
        driver.activate()
    arm.server.order("adapter in")
    driver.configure()
    assert not any(axis.powered for axis in arm.axes())
    driver.activate()
    arm.drive(5)


def test_a_loop_that_hangs_is_stopped_and_told(make_arm: Callable[..., Arm]) -> None:
    arm = make_arm(loop_timeout_ms=1000)
    driver = arm.active()
    assert arm.rests()
    arm.wait_for(lambda: driver.master.fault is not None)
    with pytest.raises(DriverError) as refusal:
        driver.read_state()
    assert refusal.value.code == "loop_hung"


def test_what_is_raised_in_the_bus_thread_stops_the_arm(
    make_arm: Callable[..., Arm], monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = make_arm()
    driver = arm.active()

    def broken(*_: object) -> int:
        raise KeyError("a defect")

    with monkeypatch.context() as patch:
        patch.setattr(driver.master.codec, "receive", broken)
        error = arm.drive_until_fault()
        assert error.code == "internal"
        assert "KeyError" in str(error)
        assert "a defect" in str(error)
        assert arm.rests()
        driver.deactivate()
    driver.configure()
    driver.activate()
    arm.drive(5)


def test_a_bring_up_that_fails_with_a_defect_leaves_no_pump_behind(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise KeyError("a defect")

    with monkeypatch.context() as patch:
        patch.setattr(arm.driver.bringup, "connect", broken)
        with pytest.raises(KeyError, match="a defect"):
            arm.driver.configure()
    assert arm.driver.bus is None
    arm.active()


def test_stop_keeps_the_drives_enabled(arm: Arm) -> None:
    driver = arm.active()
    driver.stop()
    assert arm.rests()
    assert all(axis.powered for axis in arm.axes())
    arm.drive(5)


def test_close_while_moving_leaves_the_arm_at_rest_and_unpowered(arm: Arm) -> None:
    arm.active()
    arm.driver.close()
    assert all(axis.velocity == 0.0 for axis in arm.axes())
    assert not any(axis.powered for axis in arm.axes())
    arm.driver.close()


def test_a_driver_after_another_finds_the_drives_ready(arm: Arm) -> None:
    arm.active()
    arm.driver.close()
    arm.driver = CanJointDriver(arm.options, arm.context)
    arm.active()


def test_a_command_at_the_limit_is_reported(arm: Arm) -> None:
    driver = arm.active()
    report = driver.write_velocity(np.array([5.0, 0.0]))
    assert report.sent == pytest.approx([1.0, 0.0], abs=1e-4)
    assert report.reasons == ("drive_velocity_limit",)
