"""Mechanics of real joints against closed forms."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from stereoservo_sim.world.mechanics import (
    PRESETS,
    Mechanics,
    Transmission,
    at_rest,
    chosen_mechanics,
    coupled,
    gravity_load,
    gravity_torques,
    play_at_rest,
    preset,
    quantised,
    ripple,
)
from stereoservo_sim.world.robots import RX90, flange_pose
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, demo_cell

H = 1e-3
NO_LOAD = np.zeros(1)


def one(load=0.0, start=0.0, **fields):
    return Transmission((Mechanics(**fields),), np.array([start]), lambda _: np.array([load]))


def drive(transmission, to, seconds=0.5, settle=0.5):
    """Move the set-point in a straight line to ``to`` and wait; returns the links on the way."""
    start = transmission.motor.copy()
    steps = round(seconds / H)
    links = []
    for k in range(1, steps + round(settle / H) + 1):
        transmission.follow(start + (np.array([to]) - start) * min(k / steps, 1.0), H)
        links.append(float(transmission.link[0]))
    return np.array(links)


def test_a_perfect_joint_follows_its_set_point_to_the_bit():
    joint = one()
    links = drive(joint, 0.7)
    assert links[-1] == 0.7
    assert joint.readings[0] == 0.7
    assert joint.rest(1.0)


def test_ripple_has_its_amplitude_order_and_phase():
    turn = np.linspace(0.0, 2.0 * np.pi, 20_001)[:-1]
    error = ripple(turn, np.array(1.5e-4), np.array(200.0), np.array(0.3))
    spectrum = np.fft.rfft(error) / len(turn)
    assert np.argmax(np.abs(spectrum)) == 200
    assert np.isclose(2.0 * np.abs(spectrum[200]), 1.5e-4)
    assert np.isclose(np.angle(spectrum[200]) + np.pi / 2, 0.3)
    assert np.isclose(np.abs(np.delete(spectrum, 200)).max(), 0.0, atol=1e-15)


def test_an_encoder_on_the_motor_does_not_see_the_ripple_and_one_on_the_joint_does():
    for side, seen in (("motor", 0.0), ("joint", 1e-3 * np.sin(3.0 * 0.4))):
        joint = one(ripple=1e-3, ripple_order=3.0, encoder_side=side)
        drive(joint, 0.4)
        assert np.isclose(joint.link[0], 0.4 + 1e-3 * np.sin(3.0 * 0.4))
        assert np.isclose(joint.readings[0], 0.4 + seen)


@pytest.mark.parametrize("play", [1e-3, 0.0175])
def test_without_a_load_the_play_is_a_hysteresis_loop_of_its_width(play):
    joint = one(play=play)
    drive(joint, 0.5)
    assert np.isclose(joint.link[0], 0.5 - play / 2)
    up = drive(joint, 0.6)[-1]
    drive(joint, 0.8)
    down = drive(joint, 0.6)[-1]
    assert np.isclose(down - up, play, rtol=1e-9)
    # A turn back by less than the play moves nothing.
    held = drive(joint, 0.6 + 0.9 * play)
    assert np.ptp(held) == 0.0


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_load_presses_the_link_against_its_flank_from_both_directions(side):
    joint = one(load=0.5 * side, play=0.01, play_friction=0.1)
    assert joint.link[0] == pytest.approx(0.0)
    offsets = []
    for to in (0.3, 0.5, 0.3, 0.1, 0.3):
        drive(joint, to)
        offsets.append(joint.link[0] - joint.motor[0])
    assert np.allclose(offsets, side * 0.005, atol=1e-12)


def test_a_load_that_friction_bears_leaves_the_play_to_the_direction():
    joint = one(load=0.05, play=0.01, play_friction=0.1)
    drive(joint, 0.3)
    assert np.isclose(joint.link[0] - joint.motor[0], -0.005)
    drive(joint, 0.0)
    assert np.isclose(joint.link[0] - joint.motor[0], 0.005)


def test_where_the_load_changes_its_sign_the_link_falls_to_the_other_flank_in_a_finite_time():
    joint = Transmission(
        (Mechanics(play=0.02, play_friction=0.1),), np.array([-0.5]), lambda q: np.where(q < 0.0, -1.0, 1.0)
    )
    assert np.isclose(joint.link[0] - joint.motor[0], -0.01)
    links = drive(joint, 0.1)
    assert np.isclose(links[-1] - 0.1, 0.01)
    assert np.abs(np.diff(links)).max() < 0.02 / 4


@pytest.mark.parametrize("step", [1.5e-3, 2.0 * np.pi / 4096])
def test_readings_are_at_most_half_a_step_off_and_evenly_so(step):
    angles = np.linspace(-1.0, 1.0, 100_001)
    error = quantised(angles, np.array(step)) - angles
    assert np.abs(error).max() <= step / 2 * (1 + 1e-9)
    assert np.isclose(error.std(), step / np.sqrt(12.0), rtol=2e-3)
    assert np.array_equal(quantised(angles, np.array(0.0)), angles)


def test_friction_holds_the_motor_within_its_dead_band():
    joint = one(dead_band=0.004)
    drive(joint, 0.1)
    assert np.isclose(joint.motor[0], 0.098)
    joint = one(dead_band=0.004)
    held = drive(joint, 0.0019)
    assert np.ptp(held) == 0.0


def test_friction_takes_its_speed_from_a_drive_that_follows_velocities():
    joint = one(dead_speed=0.01)
    for k in range(1, 1001):
        joint.follow(np.array([0.008 * k * 1e-3]), 1e-3)
    assert joint.motor[0] == 0.0
    for k in range(1, 1001):
        joint.follow(np.array([0.008 + 0.05 * k * 1e-3]), 1e-3)
    assert np.isclose(joint.motor[0], 0.04)
    for k in range(1, 1001):
        joint.follow(np.array([0.058 - 0.03 * k * 1e-3]), 1e-3)
    assert np.isclose(joint.motor[0], 0.02)
    joint.follow(np.array([0.028]), 1e-3)
    assert joint.rest(1e-3)


def test_a_drive_is_late_by_its_delay_and_its_time_constant():
    joint = one(delay_s=0.05, lag_s=0.02)
    speed = 0.4
    for k in range(1, 1001):
        joint.follow(np.array([speed * k * H]), H)
    assert np.isclose(speed * 1.0 - joint.link[0], speed * (0.05 + 0.02), atol=speed * H)
    end = np.array([speed])
    assert not joint.rest(H)
    for _ in range(1000):
        joint.follow(end, H)
    assert joint.link[0] == speed
    assert joint.rest(H)


def test_the_zero_drifts_with_time_at_rest_too_and_the_images_do_not_show_it():
    joint = one(zero_drift=0.36)
    drive(joint, 0.2)
    assert joint.rest(99.0)
    assert np.isclose(joint.readings[0], 0.2 + 0.36 * 100.0 / 3600.0)
    assert joint.link[0] == 0.2


def test_a_coupled_joint_turns_with_the_one_before_it():
    motor = np.array([[0.5, 1.0, -2.0], [0.1, 0.0, 0.0]])
    assert np.allclose(coupled(motor, np.array([9.0, 0.0, 0.05])), [[0.0, 0.0, 0.05], [0.0, 0.0, 0.0]])


def test_rest_after_a_motion_is_the_closed_form_of_many_postures_at_once():
    joint = Mechanics(
        ripple=2e-4, ripple_order=40.0, ripple_phase=1.0, play=8e-3, play_friction=0.2, sag=0.03,
        encoder_step=2e-3, encoder_side="joint",
    )  # fmt: skip

    def load_of(q):
        return np.cos(q)

    moved = Transmission((joint,), np.array([0.0]), load_of)
    targets = np.array([0.4, 1.5, 1.65, 1.5, 2.0])
    before = np.concatenate([[0.0], targets[:-1]])
    seen = []
    for target in targets:
        drive(moved, float(target))
        seen.append((moved.link[0], quantised(moved.readings, np.array([2e-3]))[0]))
    motor = targets[:, None]
    links, readings = at_rest((joint,), motor, load_of(motor), (targets - before)[:, None])
    assert np.allclose(np.array(seen)[:, 0], links[:, 0], atol=1e-9)
    assert np.allclose(np.array(seen)[:, 1], readings[:, 0], atol=1e-9)


def test_an_arm_sags_downwards_in_every_posture():
    rng = np.random.default_rng(4)
    for _ in range(50):
        q = rng.uniform([j.position_min for j in RX90.joints], [j.position_max for j in RX90.joints])
        load = gravity_load(RX90, q)
        assert np.abs(load).max() <= 1.0
        assert load[0] == pytest.approx(0.0)  # its axis is vertical
        assert flange_pose(RX90, q + 1e-4 * load)[2, 3] < flange_pose(RX90, q)[2, 3]


def test_gravity_torques_are_those_of_the_physics_engine():
    from stereoservo_sim.world.mechanics import largest_torques
    from stereoservo_sim.world.physics import PybulletPlant

    plant = PybulletPlant(RX90, demo_cell().base, 1e-3)
    try:
        for q in (demo_cell().base, *DEMO_GOALS.values()):
            plant.place(q)
            torques = gravity_load(RX90, q) * largest_torques(RX90)
            # The engine's flange weighs 0.1 kg more, at most 1.4 m away.
            assert np.allclose(torques, -plant.efforts, atol=0.1 * 9.81 * 1.4)
    finally:
        plant.close()


def test_gravity_torque_of_a_horizontal_rod_is_its_weight_times_half_its_length():
    torque = gravity_torques(
        np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]), np.array([[0.5, 0.0, 0.0]]), np.array([2.0])
    )
    assert np.isclose(torque[0], 2.0 * 9.81 * 0.5)


def test_a_link_starts_where_the_world_left_it():
    names = RX90.joint_names
    for option in PRESETS:
        mechanics = chosen_mechanics(option, names)
        assert mechanics is not None
        base = demo_cell().base
        arm = Transmission(mechanics, base, lambda q: gravity_load(RX90, q))
        assert np.allclose(arm.link, base, atol=1e-12)
        assert arm.rest(1.0)


def test_presets_differ_in_phase_from_joint_to_joint():
    phases = {joint.ripple_phase for joint in preset("strain_wave", 6)}
    assert len(phases) == 6


def test_a_cell_files_choice_is_a_preset_or_a_table_by_joint():
    assert chosen_mechanics("none", ("a", "b")) is None
    assert chosen_mechanics({}, ("a", "b")) is None
    chosen = chosen_mechanics({"b": Mechanics(play=0.01)}, ("a", "b"))
    assert chosen == (Mechanics(), Mechanics(play=0.01))
    with pytest.raises(ValueError, match=r"no joint 'c'; joints: a, b"):
        chosen_mechanics({"c": Mechanics()}, ("a", "b"))
    with pytest.raises(ValueError, match="first joint"):
        chosen_mechanics({"a": Mechanics(coupling=0.1)}, ("a", "b"))
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"play": -1.0}, Mechanics)


def test_play_without_a_direction_rests_in_the_middle():
    play = play_at_rest(np.array([0.01]), NO_LOAD, np.array([0.1]), NO_LOAD)
    assert play[0] == 0.0
