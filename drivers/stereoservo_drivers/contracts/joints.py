"""Contract tests of joint drivers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import pytest

from stereoservo.ports.devices import DriverContext, DriverError, JointDriver
from stereoservo_drivers.contracts.pacing import PacedSuite, measure, report_budget


class JointDriverContract(PacedSuite):
    """Base class of the tests: subclass under pytest and override :meth:`make_driver`.

    The suite moves the arm: slowly (``speed`` of each joint's largest velocity) and for fractions of a
    second. Clear the machine's surroundings before you run it on hardware.
    """

    speed = 0.05
    """Fraction of each joint's largest velocity at which the suite moves the arm."""
    rest_velocity = 1e-3
    """Below this [rad/s or m/s] the arm counts as at rest."""
    brake_s = 1.0
    """Time in which the arm must come to rest from ``speed``."""
    enforces_timeout = True
    """Whether the device stops by itself when commands cease. Every device should; set False only with a
    reason.
    """

    def make_driver(self, context: DriverContext) -> JointDriver:
        """A new driver, connected to nothing."""
        raise NotImplementedError("override make_driver(context)")

    @pytest.fixture
    def driver(self, context: DriverContext) -> Iterator[JointDriver]:
        """A fresh driver, closed after the test."""
        driver = self.make_driver(context)
        yield driver
        driver.close()

    @pytest.fixture
    def configured(self, driver: JointDriver) -> JointDriver:
        """A configured driver."""
        driver.configure()
        return driver

    @pytest.fixture
    def active(self, configured: JointDriver) -> JointDriver:
        """An active driver."""
        configured.activate()
        return configured

    def slow(self, driver: JointDriver) -> np.ndarray:
        """A small velocity of every joint, away from its nearer limit."""
        joints = driver.describe().joints
        positions = driver.read_state().positions
        middle = np.array([(j.position_min + j.position_max) / 2 for j in joints])
        signs = np.where(positions <= middle, 1.0, -1.0)
        return signs * self.speed * np.array([j.velocity_max for j in joints])

    def drive(
        self, driver: JointDriver, context: DriverContext, velocity: np.ndarray, seconds: float
    ) -> None:
        """Command ``velocity`` at the driver's rate for ``seconds``."""
        period = 1.0 / driver.describe().rate_hz
        for _ in range(max(round(seconds / period), 1)):
            driver.read_state()
            driver.write_velocity(velocity)
            self.wait(context, period)

    def settle(self, driver: JointDriver, context: DriverContext, seconds: float) -> None:
        """Read only, for ``seconds``."""
        period = 1.0 / driver.describe().rate_hz
        for _ in range(max(round(seconds / period), 1)):
            self.wait(context, period)
            driver.read_state()

    def test_is_a_joint_driver(self, driver: JointDriver) -> None:
        assert isinstance(driver, JointDriver)

    def test_describes_itself_before_it_is_configured(self, driver: JointDriver) -> None:
        description = driver.describe()
        names = [joint.name for joint in description.joints]
        assert names
        assert len(set(names)) == len(names)
        for joint in description.joints:
            assert joint.position_min < joint.position_max, joint
            assert joint.velocity_max > 0, joint
            assert joint.acceleration_max > 0, joint
            assert 0 <= joint.resolution < joint.position_max - joint.position_min, joint
        assert description.rate_hz > 0
        assert description.command_timeout_s > 0
        assert len(description.effort_units) in (0, len(names))
        assert description.call_budget_us > 0

    def test_description_does_not_change_with_the_lifecycle(self, driver: JointDriver) -> None:
        before = driver.describe()
        driver.configure()
        assert driver.describe() == before
        driver.activate()
        assert driver.describe() == before

    def test_reading_before_configure_is_refused(self, driver: JointDriver) -> None:
        with pytest.raises(DriverError):
            driver.read_state()

    def test_activate_before_configure_is_refused(self, driver: JointDriver) -> None:
        with pytest.raises(DriverError):
            driver.activate()

    def test_writing_before_activate_is_refused(self, configured: JointDriver) -> None:
        zero = np.zeros(len(configured.describe().joints))
        with pytest.raises(DriverError) as refusal:
            configured.write_velocity(zero)
        assert refusal.value.code
        assert str(refusal.value)

    def test_writing_after_deactivate_is_refused(self, active: JointDriver) -> None:
        active.deactivate()
        with pytest.raises(DriverError):
            active.write_velocity(np.zeros(len(active.describe().joints)))

    def test_can_be_activated_again(self, active: JointDriver, context: DriverContext) -> None:
        active.deactivate()
        active.activate()
        self.drive(active, context, np.zeros(len(active.describe().joints)), 0.05)

    def test_nothing_moves_when_it_is_configured_and_activated(
        self, configured: JointDriver, context: DriverContext
    ) -> None:
        before = configured.read_state().positions
        configured.activate()
        self.settle(configured, context, 0.2)
        state = configured.read_state()
        assert np.all(np.abs(state.positions - before) < 1e-3)
        assert np.all(np.abs(state.velocities) < self.rest_velocity)

    def test_states_fit_the_description(self, configured: JointDriver) -> None:
        joints = configured.describe().joints
        state = configured.read_state()
        assert state.positions.shape == (len(joints),)
        assert state.velocities.shape == (len(joints),)
        assert state.positions.dtype == np.float64
        assert np.all(np.isfinite(state.positions))
        assert np.all(np.isfinite(state.velocities))
        for loads in (state.efforts, state.following_errors):
            assert loads is None or (loads.shape == (len(joints),) and np.all(np.isfinite(loads)))

    def test_stamps_and_numbers_grow_and_are_not_from_the_future(
        self, active: JointDriver, context: DriverContext
    ) -> None:
        period = 1.0 / active.describe().rate_hz
        states = []
        for _ in range(20):
            self.wait(context, period)
            state = active.read_state()
            assert state.t_ns <= context.clock.now_ns()
            states.append(state)
        assert all(b.t_ns >= a.t_ns for a, b in pairwise(states))
        assert states[-1].t_ns > states[0].t_ns
        assert all(b.seq >= a.seq for a, b in pairwise(states))
        assert states[-1].seq > states[0].seq

    def test_a_state_is_not_changed_by_later_reads(self, active: JointDriver, context: DriverContext) -> None:
        velocity = self.slow(active)
        state = active.read_state()
        positions = state.positions.copy()
        self.drive(active, context, velocity, 0.2)
        assert np.array_equal(state.positions, positions)

    def test_moves_the_way_it_is_told(self, active: JointDriver, context: DriverContext) -> None:
        velocity = self.slow(active)
        start_ns, before = context.clock.now_ns(), active.read_state().positions
        self.drive(active, context, velocity, 0.3)
        moved = active.read_state().positions - before
        elapsed_s = (context.clock.now_ns() - start_ns) * 1e-9  # above 0.3 s on a machine that stalls
        assert np.all(moved * np.sign(velocity) > 0)
        assert np.all(np.abs(moved) < elapsed_s * np.abs(velocity) * 1.5 + 1e-3)

    def test_report_says_what_was_asked_and_sent(self, active: JointDriver) -> None:
        velocity = self.slow(active)
        report = active.write_velocity(velocity)
        assert np.array_equal(report.asked, velocity)
        assert report.sent.shape == velocity.shape
        if not report.reasons:
            assert np.allclose(report.sent, velocity, atol=1e-3)

    def test_commands_beyond_the_limits_are_cut_and_said(
        self, active: JointDriver, context: DriverContext
    ) -> None:
        limits = np.array([joint.velocity_max for joint in active.describe().joints])
        asked = 3.0 * limits * np.sign(self.slow(active))
        report = active.write_velocity(asked)
        active.write_velocity(np.zeros_like(asked))
        assert np.array_equal(report.asked, asked)
        assert np.all(np.abs(report.sent) <= limits * (1 + 1e-6))
        assert report.reasons

    def test_the_command_is_not_kept_by_reference(self, active: JointDriver) -> None:
        velocity = self.slow(active)
        report = active.write_velocity(velocity)
        asked = velocity.copy()
        velocity[:] = 0.0
        assert np.array_equal(report.asked, asked)

    def test_commands_of_the_wrong_shape_are_refused(self, active: JointDriver) -> None:
        with pytest.raises(DriverError):
            active.write_velocity(np.zeros(len(active.describe().joints) + 1))

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_commands_that_are_not_finite_are_refused(self, active: JointDriver, bad: float) -> None:
        command = np.zeros(len(active.describe().joints))
        command[0] = bad
        with pytest.raises(DriverError):
            active.write_velocity(command)

    def test_stop_brings_the_arm_to_rest(self, active: JointDriver, context: DriverContext) -> None:
        self.drive(active, context, self.slow(active), 0.2)
        active.stop()
        self.settle(active, context, self.brake_s)
        before = active.read_state()
        self.settle(active, context, 0.1)
        after = active.read_state()
        assert np.all(np.abs(after.velocities) < self.rest_velocity)
        assert np.all(np.abs(after.positions - before.positions) < 1e-4)

    def test_stop_never_raises_in_any_state(self, context: DriverContext) -> None:
        driver = self.make_driver(context)
        for step in (lambda: None, driver.configure, driver.activate, driver.deactivate, driver.close):
            step()
            driver.stop()
            driver.stop()

    def test_deactivate_stops_the_arm(self, active: JointDriver, context: DriverContext) -> None:
        self.drive(active, context, self.slow(active), 0.2)
        active.deactivate()
        self.settle(active, context, self.brake_s)
        assert np.all(np.abs(active.read_state().velocities) < self.rest_velocity)

    def test_deactivate_and_close_are_idempotent(self, active: JointDriver) -> None:
        active.deactivate()
        active.deactivate()
        active.close()
        active.close()

    def test_a_closed_driver_refuses_to_read_and_write(self, active: JointDriver) -> None:
        count = len(active.describe().joints)
        active.close()
        with pytest.raises(DriverError):
            active.read_state()
        with pytest.raises(DriverError):
            active.write_velocity(np.zeros(count))

    def test_stops_by_itself_when_commands_cease(self, active: JointDriver, context: DriverContext) -> None:
        if not self.enforces_timeout:
            pytest.skip("this device has no command time-out of its own")
        self.drive(active, context, self.slow(active), 0.2)
        self.settle(active, context, active.describe().command_timeout_s + self.brake_s)
        assert np.all(np.abs(active.read_state().velocities) < self.rest_velocity)

    def test_moves_again_after_a_command_timeout(self, active: JointDriver, context: DriverContext) -> None:
        velocity = self.slow(active)
        self.drive(active, context, velocity, 0.1)
        self.settle(active, context, active.describe().command_timeout_s + self.brake_s)
        before = active.read_state().positions
        self.drive(active, context, velocity, 0.3)
        assert np.all((active.read_state().positions - before) * np.sign(velocity) > 0)

    def test_call_times_beside_the_budget(
        self,
        active: JointDriver,
        context: DriverContext,
        record_property: Callable[[str, object], None],
    ) -> None:
        description = active.describe()
        velocity = self.slow(active)
        period = 1.0 / description.rate_hz

        def cycle() -> None:
            active.write_velocity(velocity)
            self.wait(context, period)

        reads = measure(100, active.read_state, before=cycle)
        writes = measure(
            100, lambda: active.write_velocity(velocity), before=lambda: self.wait(context, period)
        )
        active.stop()
        budget = description.call_budget_us
        report_budget(record_property, description.driver, budget, read_state=reads, write_velocity=writes)
        assert reads["median_us"] > 0
        assert writes["median_us"] > 0
