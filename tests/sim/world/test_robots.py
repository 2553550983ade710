"""The arm: its forward kinematics in three independent ways."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.world.physics import PybulletPlant
from stereoservo_sim.world.robots import RX90, RX90_ROWS, flange_pose, joint_frames, shape_segments, urdf


def product_of_dh_matrices(q):
    """Textbook: Rz(q) Tz(d) Tx(a) Rx(alpha), multiplied out by hand (Spong)."""
    pose = np.eye(4)
    for (a, alpha, d), angle in zip(RX90_ROWS, q, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return pose


def random_configurations(count, seed=0):
    low = np.array([j.position_min for j in RX90.joints])
    high = np.array([j.position_max for j in RX90.joints])
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


def test_forward_kinematics_is_the_product_of_the_rows():
    for q in random_configurations(20):
        assert np.allclose(flange_pose(RX90, q), product_of_dh_matrices(q), atol=1e-12)


def test_arm_upright_at_a_configuration_known_by_hand():
    # Upper arm and forearm straight up: 0.42 + 0.40 + 0.80 + 0.085 above the floor.
    pose = flange_pose(RX90, np.deg2rad([0, -90, 90, 0, 0, 0]))
    assert np.allclose(pose[:3, 3], [0, 0, 1.705], atol=1e-12)
    assert np.allclose(pose[:3, 2], [0, 0, 1], atol=1e-12)


@pytest.fixture(scope="module")
def engine():
    plant = PybulletPlant(RX90, np.zeros(6), 1e-3)
    yield plant
    plant.close()


def test_urdf_means_the_same_arm_to_pybullet(engine):
    for q in random_configurations(30, seed=1):
        engine.place(q)
        assert np.abs(engine.flange() - flange_pose(RX90, q)).max() < 1e-6


def test_efforts_at_rest_are_what_gravity_asks_for(engine):
    """Where the arm stands still, the motors of the stepped engine and inverse dynamics say the same torques."""
    for q in random_configurations(3, seed=5):
        engine.place(q)
        asked = engine.efforts.copy()
        for _ in range(300):
            engine.follow(q, np.zeros(6), 1e-3)
        assert np.abs(engine.efforts - asked).max() < 1e-3 * max(1.0, np.abs(asked).max())
        assert abs(engine.efforts[0]) < 1e-3  # a vertical axis carries no weight


def test_urdf_names_the_joints_and_their_limits():
    text = urdf(RX90)
    for joint in RX90.joints:
        assert f'<joint name="{joint.name}" type="revolute">' in text
        assert f'lower="{joint.position_min!r}" upper="{joint.position_max!r}"' in text


def test_links_hang_together():
    """Each shape of a moving link keeps its length and its place on its own joint's axis system."""
    q0, q1 = random_configurations(2, seed=2)
    ends0, radii = shape_segments(RX90, q0)
    ends1, _ = shape_segments(RX90, q1)
    lengths = np.linalg.norm(ends0[:, 1] - ends0[:, 0], axis=1)
    assert np.allclose(lengths, np.linalg.norm(ends1[:, 1] - ends1[:, 0], axis=1))
    assert np.all(radii > 0)
    elbow = joint_frames(RX90, q0)[0][2][:3, 3]
    assert np.allclose(ends0[2, 1], elbow)  # the upper arm ends where the forearm's joints begin
    assert np.allclose(ends0[4, 0], elbow)
