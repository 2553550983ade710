"""Simulated drives: exact ramps, limits, the command time-out, and stalls of the process."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo.ports.devices import JointSpec
from stereoservo_sim.world.velocity_drives import DriveBank, IdealPlant, RigidPlant, ramp

MS = 1_000_000
JOINT = JointSpec("a", "revolute", -1.0, 1.0, velocity_max=1.0, acceleration_max=4.0)


def bank(start=0.0, plant=None):
    plant = plant or IdealPlant(np.array([start]))
    return DriveBank((JOINT,), plant, now_ns=0, step_ns=MS, timeout_ns=100 * MS)


def test_ramp_is_the_closed_form_of_uniform_acceleration():
    q, v = ramp(np.array([0.0]), np.array([0.0]), np.array([1.0]), np.array([4.0]), 0.1)
    assert np.isclose(v[0], 0.4)
    assert np.isclose(q[0], 0.5 * 4 * 0.1**2)
    q, v = ramp(q, v, np.array([1.0]), np.array([4.0]), 0.5)
    assert v[0] == 1.0
    assert np.isclose(q[0], 1.0**2 / (2 * 4) + (0.6 - 0.25) * 1.0)


def test_ramps_add_up_whatever_the_steps():
    target, limit = np.array([-0.7, 0.3]), np.array([4.0, 2.0])
    whole = ramp(np.zeros(2), np.array([0.5, 0.0]), target, limit, 0.4)
    q, v = np.zeros(2), np.array([0.5, 0.0])
    for _ in range(40):
        q, v = ramp(q, v, target, limit, 0.01)
    assert np.allclose(q, whole[0], atol=1e-12)
    assert np.allclose(v, whole[1], atol=1e-12)


def test_velocity_is_cut_and_said():
    drives = bank()
    assert drives.command(0, np.array([0.5])) == (np.array([0.5]), ())
    sent, reasons = drives.command(0, np.array([-7.0]))
    assert sent.tolist() == [-1.0]
    assert reasons == ("drive_velocity_limit",)


def test_without_commands_the_drives_brake_by_themselves():
    drives = bank()
    drives.command(0, np.array([0.8]))
    drives.advance(100 * MS)
    assert np.isclose(drives.plant.velocities[0], 0.4)
    assert not drives.timed_out
    drives.advance(2000 * MS)
    assert drives.timed_out
    assert drives.plant.velocities[0] == 0.0
    # 0.1 s of acceleration, then the same ramp back.
    assert np.isclose(drives.plant.positions[0], 2 * 0.4**2 / (2 * 4))


def test_commands_keep_the_drives_going():
    drives = bank()
    for k in range(20):
        drives.command(k * 50 * MS, np.array([0.2]))
    assert not drives.timed_out
    assert np.isclose(drives.plant.velocities[0], 0.2)
    assert drives.command(1000 * MS, np.array([0.0]))[1] == ()


def test_brake_comes_to_rest():
    drives = bank()
    drives.command(0, np.array([0.4]))
    drives.brake(90 * MS)
    drives.advance(300 * MS)
    assert drives.plant.velocities[0] == 0.0
    assert not drives.timed_out


def test_the_end_stop_holds():
    drives = bank(0.9)
    for k in range(30):
        drives.command(k * 20 * MS, np.array([1.0]))
    assert drives.plant.positions[0] == 1.0
    assert drives.plant.velocities[0] == 0.0


def test_time_moves_in_whole_steps_and_never_past_now():
    drives = bank()
    drives.command(0, np.array([0.1]))
    drives.advance(2_700_000)
    assert drives.t_ns == 2 * MS
    drives.advance(2_900_000)
    assert drives.t_ns == 2 * MS


class SteppingPlant(RigidPlant):
    """A plant that must be stepped, as a physics engine."""

    def __init__(self) -> None:
        self.positions = np.zeros(1)
        self.velocities = np.zeros(1)
        self.efforts = np.zeros(1)
        self.steps = 0

    def follow(self, set_positions, set_velocities, h):
        assert h == pytest.approx(1e-3)
        self.positions, self.velocities = set_positions.copy(), set_velocities.copy()
        self.steps += 1

    def close(self):
        pass


def test_catching_up_after_a_stall_is_bounded():
    plant = SteppingPlant()
    drives = bank(plant=plant)
    drives.command(0, np.array([1.0]))
    drives.advance(3600 * 1000 * MS)  # an hour in the debugger
    assert drives.t_ns == 3600 * 1000 * MS
    assert plant.velocities[0] == 0.0
    assert plant.steps <= 100 + 250 + 2  # the time-out and the longest brake ramp


def test_stepping_and_closed_form_agree():
    plant = SteppingPlant()
    stepped, exact = bank(plant=plant), bank()
    for k, value in enumerate([0.3, 0.9, -0.5, -0.5, 0.1]):
        for drives in (stepped, exact):
            drives.command(k * 37 * MS, np.array([value]))
    for drives in (stepped, exact):
        drives.advance(900 * MS)
    assert np.allclose(stepped.plant.positions, exact.plant.positions, atol=1e-12)
