"""The fake arm: its arithmetic and the faults that can be ordered."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.fake import FakeJointDriver
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory
from stereoservo_sim.world.simulated_cell import demo_cell

MS = 1_000_000


def context(tmp_path, clock=None, **services):
    return DriverContext(clock or VirtualClock(), "t", tmp_path, tmp_path, seed=1, services=services)


def active(options, ctx):
    driver = FakeJointDriver(options, ctx)
    driver.configure()
    driver.activate()
    return driver


def run(driver, clock, velocity, cycles, period_ns=4 * MS):
    for _ in range(cycles):
        driver.read_state()
        driver.write_velocity(np.asarray(velocity))
        clock.advance_to(clock.now_ns() + period_ns)
    return driver.read_state()


def test_starts_at_the_base(tmp_path):
    assert np.allclose(active({}, context(tmp_path)).read_state().positions, demo_cell().base, atol=1e-5)


def test_starts_where_it_is_told(tmp_path):
    driver = active({"start": {"j2": -1.0}}, context(tmp_path))
    expected = demo_cell().base.copy()
    expected[1] = -1.0
    assert np.allclose(driver.read_state().positions, expected, atol=1e-5)


def test_encoder_has_its_resolution(tmp_path):
    clock = VirtualClock()
    driver = active({"encoder": 0.01, "joints": [{"name": "a"}]}, context(tmp_path, clock))
    position = run(driver, clock, [0.1], 37).positions[0]
    truth = TrueJointHistory.open(tmp_path / FILE_NAME).newest()[1][0]
    assert position == pytest.approx(round(truth / 0.01) * 0.01, abs=1e-12)
    assert position != truth


def test_mechanics_bring_their_encoder_and_the_driver_describes_it(tmp_path):
    clock = VirtualClock()
    driver = active({"mechanics": "serial_servo"}, context(tmp_path, clock))
    step = 2.0 * np.pi / 4096
    assert [joint.resolution for joint in driver.describe().joints] == [step] * 6
    state = run(driver, clock, [0.1] * 6, 37)
    counts = state.positions / step
    assert np.allclose(counts, np.round(counts), atol=1e-9)
    truth = TrueJointHistory.open(tmp_path / FILE_NAME).newest()[1]
    assert np.abs(state.positions - truth).max() <= 0.5 * step * (1 + 1e-9)


def test_mechanics_by_joint_leave_the_others_perfect(tmp_path):
    clock = VirtualClock()
    driver = active({"mechanics": {"j3": {"sag": 0.05}}, "encoder": 0.0}, context(tmp_path, clock))
    state = driver.read_state()
    truth = TrueJointHistory.open(tmp_path / FILE_NAME).newest()[1]
    off = truth - state.positions
    assert abs(off[2]) > 1e-3
    assert np.array_equal(np.delete(off, 2), np.zeros(5))
    assert np.allclose(truth, demo_cell().base, atol=1e-12)
    assert driver.describe().joints[2].resolution == 0.0


def test_the_truth_is_recorded_with_its_stamps(tmp_path):
    clock = VirtualClock()
    driver = active({"joints": [{"name": "a", "acceleration": 2.0}]}, context(tmp_path, clock))
    begin = clock.now_ns()
    run(driver, clock, [0.4], 100)
    history = TrueJointHistory.open(tmp_path / FILE_NAME)
    for t in (0.05, 0.1, 0.3, 0.35):
        # 0.2 s of acceleration, then constant speed.
        expected = t * t if t < 0.2 else 0.04 + 0.4 * (t - 0.2)
        assert history.at(begin + round(t * 1e9))[0] == pytest.approx(expected, abs=1e-7)


def test_a_shared_world_takes_the_truth(tmp_path):
    world = TrueJointHistory.in_memory(6)
    clock = VirtualClock()
    driver = active({}, context(tmp_path, clock, world=world))
    run(driver, clock, np.full(6, 0.1), 10)
    driver.close()
    assert world.count >= 10
    assert not (tmp_path / FILE_NAME).exists()
    with pytest.raises(DriverError, match="JointHistory of 6 joints"):
        active({}, context(tmp_path, world=TrueJointHistory.in_memory(2)))


def test_a_restarted_arm_stands_where_it_was_left(tmp_path):
    clock = VirtualClock()
    first = active({}, context(tmp_path, clock))
    left = run(first, clock, np.full(6, 0.2), 50)
    first.close()
    clock.advance_to(clock.now_ns() + 500 * MS)
    again = active({}, context(tmp_path, clock))
    assert np.allclose(again.read_state().positions, left.positions, atol=5e-3)
    again.close()
    fresh = active({"resume": False}, context(tmp_path, clock))
    assert np.allclose(fresh.read_state().positions, demo_cell().base, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 250}, "no option 'rate'.* valid: .*rate_hz"),
        ({"rate_hz": 5}, "rate_hz"),
        ({"start": {"j9": 0.0}}, "no joint 'j9'; joints: j1, j2"),
        ({"start": {"j1": 9.0}}, "its range is -2.79"),
        ({"faults": {"explode": True}}, "explode"),
        ({"joints": [{"name": "a", "kind": "spherical"}]}, "spherical"),
        ({"mechanics": "belt"}, 'mechanics = "belt"; valid: .*serial_servo'),
        ({"mechanics": {"j9": {}}}, "mechanics: no joint 'j9'; joints: j1, j2"),
        ({"mechanics": {"j2": {"play": -1.0}}}, "play = -1"),
        ({"mechanics": {"j2": {"slack": 1.0}}}, "no option 'slack'.* valid: .*play"),
    ],
)
def test_bad_options_are_refused_with_what_would_be_valid(tmp_path, options, message):
    with pytest.raises(DriverError, match=message) as refusal:
        FakeJointDriver(options, context(tmp_path))
    assert refusal.value.code == "option"


@pytest.mark.parametrize("call", ["write", "read"])
def test_the_nth_call_fails_and_those_after_it(tmp_path, call):
    clock = VirtualClock()
    driver = active({"faults": {f"fail_{call}": 3}}, context(tmp_path, clock))
    method = driver.read_state if call == "read" else lambda: driver.write_velocity(np.zeros(6))
    method(), method()
    for _ in range(2):
        with pytest.raises(DriverError, match="as ordered") as failure:
            method()
        assert failure.value.code == "connection_lost"
        assert failure.value.retry


def test_a_drive_whose_link_breaks_stops_by_its_own_timeout(tmp_path):
    clock = VirtualClock()
    world = TrueJointHistory.in_memory(6)
    driver = active({"faults": {"fail_write": 20}}, context(tmp_path, clock, world=world))
    run(driver, clock, np.full(6, 0.3), 19)
    for _ in range(100):
        clock.advance_to(clock.now_ns() + 4 * MS)
        driver.read_state()
    assert np.all(world.newest()[2] == 0.0)


def test_activation_can_fail(tmp_path):
    driver = FakeJointDriver({"faults": {"fail_activate": True}}, context(tmp_path))
    driver.configure()
    with pytest.raises(DriverError, match="as ordered"):
        driver.activate()
    driver.faults.fail_activate = False
    driver.activate()


def test_a_frozen_feedback_repeats_its_last_state(tmp_path):
    clock = VirtualClock()
    world = TrueJointHistory.in_memory(6)
    driver = active({}, context(tmp_path, clock, world=world))
    before = run(driver, clock, np.full(6, 0.1), 5)
    driver.faults.freeze_encoder_after = 1
    after = run(driver, clock, np.full(6, 0.1), 20)
    assert after is before
    assert np.all(world.newest()[1] > before.positions + 0.005)


def test_a_stuck_encoder_goes_on_with_its_stamps(tmp_path):
    clock = VirtualClock()
    driver = active({"faults": {"stuck_encoder_after": 3}}, context(tmp_path, clock))
    state = run(driver, clock, np.full(6, 0.1), 20)
    assert np.allclose(state.positions, demo_cell().base, atol=1e-3)
    assert state.t_ns >= clock.now_ns() - 2 * MS
    assert not state.velocities.any()


def test_dropped_commands_are_reported_as_sent_but_move_nothing(tmp_path):
    clock = VirtualClock()
    driver = active({"faults": {"drop_writes_after": 1}}, context(tmp_path, clock))
    report = driver.write_velocity(np.full(6, 0.2))
    assert np.array_equal(report.sent, np.full(6, 0.2))
    assert np.allclose(run(driver, clock, np.full(6, 0.2), 20).positions, demo_cell().base, atol=1e-5)


def test_delayed_states_are_old_and_say_so(tmp_path):
    clock = VirtualClock()
    world = TrueJointHistory.in_memory(6)
    driver = active({"faults": {"delay_s": 0.02}, "encoder": 0.0}, context(tmp_path, clock, world=world))
    state = run(driver, clock, np.full(6, 0.2), 50)
    assert clock.now_ns() - state.t_ns == pytest.approx(20 * MS, abs=5 * MS)
    assert np.allclose(state.positions, world.at(state.t_ns), atol=1e-9)


def test_drives_can_run_away_from_their_commands(tmp_path):
    clock = VirtualClock()
    driver = active({"faults": {"gain": -1.0}}, context(tmp_path, clock))
    state = run(driver, clock, np.full(6, 0.1), 100)
    assert np.allclose(state.velocities, -0.1)
