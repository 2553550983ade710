"""Drives that move links through imperfect mechanics."""

from __future__ import annotations

import numpy as np

from stereoservo.ports.devices import JointSpec
from stereoservo_sim.world.mechanics import MechanicalPlant, Mechanics, preset
from stereoservo_sim.world.robots import RX90
from stereoservo_sim.world.simulated_cell import demo_cell
from stereoservo_sim.world.velocity_drives import DriveBank, IdealPlant

MS = 1_000_000
JOINT = JointSpec("a", "revolute", -1.0, 1.0, velocity_max=1.0, acceleration_max=4.0)


def bank(start=0.0, **fields):
    plant = MechanicalPlant(IdealPlant(np.array([start])), (Mechanics(**fields),), None)
    return DriveBank((JOINT,), plant, now_ns=0, step_ns=MS, timeout_ns=100 * MS)


def run(drives, velocity, until_ms, start_ms=0):
    for t in range(start_ms, until_ms, 10):
        drives.command(t * MS, np.array([velocity]))
    drives.advance(until_ms * MS)


def test_perfect_mechanics_are_those_of_the_plant_itself():
    rigid = DriveBank((JOINT,), IdealPlant(np.zeros(1)), now_ns=0, step_ns=MS, timeout_ns=100 * MS)
    for drives in (rigid, geared := bank()):
        run(drives, 0.5, 400)
        run(drives, 0.0, 900, 400)
    assert np.isclose(geared.plant.positions[0], rigid.plant.positions[0], atol=1e-12)
    assert np.array_equal(geared.plant.readings, geared.plant.positions)
    assert geared.plant.velocities[0] == 0.0


def test_what_was_commanded_late_still_moves_the_arm_after_the_drives_stand():
    drives = bank(delay_s=0.2)
    run(drives, 0.5, 300)
    run(drives, 0.0, 450, 300)
    moving = drives.plant.positions[0]
    drives.advance(3_600_000 * MS)
    assert drives.plant.positions[0] > moving + 0.02
    assert np.isclose(drives.plant.positions[0], drives.set_positions[0])
    assert drives.plant.velocities[0] == 0.0


def test_the_encoders_zero_drifts_while_the_arm_stands():
    drives = bank(zero_drift=1e-3)
    drives.advance(3_600_000 * MS)
    assert np.isclose(drives.plant.readings[0] - drives.plant.positions[0], 1e-3)
    assert drives.plant.positions[0] == 0.0


def test_drives_begin_at_the_motors_angle_and_do_not_jerk():
    base = demo_cell().base
    plant = MechanicalPlant(IdealPlant(base), preset("serial_servo", 6), RX90)
    drives = DriveBank(RX90.joints, plant, now_ns=0, step_ns=MS, timeout_ns=100 * MS)
    assert np.abs(drives.set_positions - base).max() > 0.01  # it sags and lies on its flanks
    drives.command(0, np.zeros(6))
    drives.advance(50 * MS)
    assert np.allclose(plant.positions, base, atol=1e-12)
    assert np.allclose(plant.readings, base, atol=1e-12)  # its encoders sit on the joints


def test_an_encoder_on_the_motor_reports_the_motors_velocity():
    drives = bank(ripple=1e-3, ripple_order=100.0)
    run(drives, 0.5, 1000)
    assert np.isclose(drives.plant.reading_rates[0], 0.5)
    assert np.isclose(drives.plant.velocities[0], 0.5 * (1.0 + 0.1 * np.cos(100.0 * drives.plant.motors[0])), atol=2e-3)
