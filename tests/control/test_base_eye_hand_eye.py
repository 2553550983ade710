"""Table 8.1: cameras in the hand and cameras that stand are one law; robots that take Cartesian velocities another arm.

An arm with cameras in its hand, before an object that stands, and the same arm set up the other way round: its hand
bolted to the camera stand, its base carrying the object. The images are the same, so must be the joint velocities.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from oracles.screw_transfer import (
    base_from_hand,
    base_link,
    cartesian_velocity,
    command_operators,
    hand_from_base,
    hand_from_camera,
    joint_velocity,
    screw_of_points,
    screw_operator,
    seen_from_other_end,
    tool_frame,
)
from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import chain_forward

DT = 0.04


def hand_eye(virtual, rng):
    """An arm with the rig in its hand: its generators in its base, the base seen from the rig, the two descriptions."""
    built = virtual.rx90(rng)  # for its generators; in the rig's coordinates, which serve as the base's here
    in_base, q = built.generators, built.q
    object_in_rig = virtual.pose(Rotation.from_euler("xyz", [15, -20, 30], degrees=True), [0.04, -0.02, 1.1])
    hand = virtual.pose(Rotation.from_euler("xyz", [140, 20, 10], degrees=True), [0.4, 0.1, 0.7])
    rig_from_base = np.linalg.inv(hand)  # at joint angles zero
    turned = virtual.World(in_base, np.eye(4), np.eye(4), q)
    object_in_base = turned.displacement(q) @ hand @ object_in_rig

    def seen(q):
        """Object's pose in the rig's coordinates: the rig rides on the hand."""
        return rig_from_base @ np.linalg.inv(turned.displacement(q)) @ object_in_base

    other_way = virtual.World(
        -(rig_from_base @ in_base @ hand)[::-1],
        rig_from_base @ object_in_base,
        virtual.random_frame(rng),
        q[::-1],
    )
    eye = virtual.World(in_base, np.eye(4), virtual.random_frame(rng), q)
    return SimpleNamespace(arm=turned, hand=hand, seen=seen, q=q, base_eye=other_way, eye=eye)


def scene(world, operators, composition, pixels):
    return Scene(
        operators, int(composition), world.matrices, world.camera_centres, world.triangulated(pixels), pixels,
        np.full((2, 4), 10.0),
    )  # fmt: skip


def task(world, set_points):
    targets = world.triangulated(set_points)
    return Task(
        set_points, np.ones((2, 4)), np.zeros((2, 4, 2)), targets, np.ones(4), np.zeros(4), targets.mean(axis=0),
        np.arange(3),
    )  # fmt: skip


@pytest.mark.parametrize("law", ["stereo", "image", "cartesian3", "cartesian2"])
def test_hand_eye_and_base_eye_are_one_law(virtual, law):
    rng = np.random.default_rng(3)
    cell = hand_eye(virtual, rng)
    base_eye, eye = cell.base_eye, cell.eye
    q = cell.q.copy()
    q_star = q + np.array([0.1, -0.08, 0.12, 0.2, -0.15, 0.3])
    # both are the same images to begin with
    np.testing.assert_allclose(base_eye.plate_pose(q[::-1]), cell.seen(q), atol=1e-12)
    set_points = eye.pixels(virtual.PLATE @ cell.seen(q_star).T)
    at_zero = seen_from_other_end(cell.arm.generators, eye.frame @ np.linalg.inv(cell.hand))
    largest, first = 0.0, None
    for _ in range(250):
        pixels = eye.pixels(virtual.PLATE @ cell.seen(q).T)
        np.testing.assert_allclose(base_eye.pixels(base_eye.markers(q[::-1])), pixels, atol=1e-8)
        # hand-eye: spatial operators of the arm in its base, as the cameras at its other end see them
        rig_from_base = np.linalg.inv(cell.arm.displacement(q) @ cell.hand)
        operators = seen_from_other_end(cell.arm.operators(q), eye.frame @ rig_from_base)
        np.testing.assert_allclose(
            chain_forward(at_zero, np.zeros(6, np.uint8), np.zeros(6), q, True)[1], operators, atol=1e-9
        )
        answers = []
        for world, ops, composition in (
            (eye, operators, Composition.TIP_FIRST),
            (base_eye, base_eye.operators(q[::-1]), Composition.BASE_FIRST),
        ):
            now = scene(world, ops, composition, pixels)
            wanted = task(world, set_points)._replace(centre=now.points.mean(axis=0))
            answers.append(LAWS[law].step(now, wanted, Options(gain=1.5, dt_s=DT, damping=0.0)).velocity)
        hand_velocity, base_velocity = answers[0], answers[1][::-1]
        scale = np.abs(hand_velocity).max()
        first = scale if first is None else first
        if scale > 1e-3 * first:
            largest = max(largest, float(np.abs(hand_velocity - base_velocity).max() / scale))
        q = q + DT * hand_velocity
    assert largest < 1e-6
    error = np.linalg.norm(eye.pixels(virtual.PLATE @ cell.seen(q).T) - set_points, axis=-1).max()
    assert error < 0.1


def test_the_classical_transfers_give_these_joint_velocities(virtual):
    """Camera screw -> hand screw (8.17) and camera screw -> base screw (8.20): the same joint screw (8.22)."""
    rng = np.random.default_rng(5)
    cell = hand_eye(virtual, rng)
    q = cell.q
    arm_now = cell.arm.displacement(q)
    S, S_star = ((virtual.PLATE @ cell.seen(a).T)[:, :3] for a in (q, q + 0.05))
    camera = screw_of_points(S, -(S - S_star), moving_camera=True)
    # the hand's frame is at the flange, linked to the rig by T_HC; base from hand is the arm
    T_HC = virtual.pose(Rotation.from_euler("xy", [10, 30], degrees=True), [0.05, 0.02, -0.1])
    T_BH = arm_now @ cell.hand @ np.linalg.inv(T_HC)
    T_HB = np.linalg.inv(T_BH)
    in_base = cell.arm.operators(q)
    in_hand = hand_from_base(T_HB, in_base)
    hand_screw = hand_from_camera(T_HC, screw_operator(camera))
    by_hand = joint_velocity(in_hand, hand_screw)
    by_base = joint_velocity(in_base, base_from_hand(T_HB, hand_screw))
    np.testing.assert_allclose(by_hand, by_base, atol=1e-10)
    # and from the operators in a projective frame, the scene's motion being the reverse
    operators = seen_from_other_end(in_base, cell.eye.frame @ np.linalg.inv(arm_now @ cell.hand))
    scene_motion = -hand_from_camera(cell.eye.frame, screw_operator(camera))
    np.testing.assert_allclose(joint_velocity(operators, scene_motion), by_hand, atol=1e-9)


class TwistRobot:
    """Takes ``(v, w)`` in its base, about ``point``, a function of the hand's pose; tells this pose."""

    def __init__(self, pose, point=None):
        self.pose, self.point = pose, point

    def centre(self):
        return np.zeros(3) if self.point is None else self.point(self.pose)

    def move(self, v, w, dt):
        point = self.centre()
        twist = np.zeros((4, 4))
        twist[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
        twist[:3, 3] = v - np.cross(w, point)
        self.pose = expm(dt * twist) @ self.pose


@pytest.fixture
def commanded(virtual):
    """A plate in the hand of a robot that takes twists, before a rig that nobody calibrated; the link learnt."""
    rng = np.random.default_rng(8)
    T0, T_star = virtual.random_task(rng, 70, 0.2)
    world = virtual.World(np.zeros((0, 4, 4)), np.eye(4), virtual.random_frame(rng), np.zeros(0))
    rig_from_base = virtual.pose(Rotation.from_euler("xyz", [100, 20, -60], degrees=True), [0.3, 0.4, 1.5])
    hand_from_plate = virtual.pose(Rotation.from_euler("xyz", [20, 10, 40], degrees=True), [0.02, 0.03, 0.12])

    def hand(plate_in_rig):
        return np.linalg.inv(rig_from_base) @ plate_in_rig @ np.linalg.inv(hand_from_plate)

    def plate(pose):
        return rig_from_base @ pose @ hand_from_plate

    def hide(D):
        return world.frame @ D @ np.linalg.inv(world.frame)

    # trials: the pose told by the robot, the displacement of the markers told by the uncalibrated rig
    poses = [hand(T0)]
    for axis in (*np.eye(3), -np.eye(3)[0]):
        turn = virtual.pose(Rotation.from_rotvec(0.3 * axis), 0.05 * rng.normal(size=3))
        poses.append(hand(T0 @ turn))
    seen = np.array([hide(plate(T) @ np.linalg.inv(T0)) for T in poses])
    seen = seen + 1e-6 * rng.normal(size=seen.shape)
    seen /= np.linalg.det(seen)[:, None, None] ** 0.25
    link = base_link(np.array(poses), seen)

    def in_base(X):
        return np.linalg.inv(rig_from_base) @ X

    return SimpleNamespace(world=world, hand=hand, plate=plate, in_base=in_base, T0=T0, T_star=T_star, link=link)


@pytest.mark.parametrize("law", ["stereo", "cartesian3"])
@pytest.mark.parametrize("about", ["base", "tool"])
def test_a_robot_commanded_by_twists_is_an_arm_of_simultaneous_joints(virtual, commanded, law, about):
    world, H_base = commanded.world, commanded.link.H_base
    start = commanded.hand(commanded.T0)
    markers = world.triangulated(world.pixels(virtual.PLATE @ commanded.T0.T))
    # the tool's frame, from three markers; the robot is told its tool-hand link and turns about the tool's point
    T_HL = np.linalg.inv(start) @ tool_frame(markers[:3], H_base)
    corner = commanded.T0 @ virtual.PLATE[0]
    robot = TwistRobot(start, None if about == "base" else lambda T: (T @ T_HL)[:3, 3])
    set_points = world.pixels(virtual.PLATE @ commanded.T_star.T)
    middles = []
    for _ in range(400):
        middles.append((virtual.PLATE @ commanded.plate(robot.pose).T).mean(axis=0)[:3])
        pixels = world.pixels(virtual.PLATE @ commanded.plate(robot.pose).T)
        operators = command_operators(H_base, robot.centre())
        now = scene(world, operators, Composition.SIMULTANEOUS, pixels)
        wanted = task(world, set_points)._replace(centre=now.points.mean(axis=0))
        command = LAWS[law].step(now, wanted, Options(gain=1.5, dt_s=DT)).velocity
        robot.move(command[:3], command[3:], DT)
    error = np.linalg.norm(world.pixels(virtual.PLATE @ commanded.plate(robot.pose).T) - set_points, axis=-1)
    assert error.max() < 0.01
    assert np.abs(command).max() < 1e-3
    if law == "cartesian3":
        gone, way = np.array(middles) - middles[0], middles[-1] - middles[0]
        deviation = np.linalg.norm(np.cross(gone, way), axis=1) / np.linalg.norm(way)
        assert deviation.max() < 2e-5, "at 25 Hz the middle stays on its line where the composition is the true one"
    # what was learnt as the tool's point is the first marker, in metres
    np.testing.assert_allclose((start @ T_HL)[:3, 3], commanded.in_base(corner)[:3], atol=1e-4)


def test_joint_velocities_said_as_cartesian_ones_make_the_same_motion(virtual):
    """An arm learnt by its joints and commanded by twists: the controller's own Jacobian gives the joints back."""
    rng = np.random.default_rng(9)
    world = virtual.rx90(rng)
    rig_from_base = virtual.pose(Rotation.from_euler("xyz", [70, 10, 30], degrees=True), [0.2, 0.5, 1.2])
    H_base = np.linalg.inv(world.frame @ rig_from_base)
    q_dot = rng.normal(size=6)
    base = cartesian_velocity(world.operators(), q_dot, H_base)
    own = (
        np.linalg.inv(rig_from_base)
        @ virtual.World(world.generators, world.plate, np.eye(4), world.q).operators()
        @ rig_from_base
    )
    np.testing.assert_allclose(joint_velocity(own, screw_operator(base)), q_dot, atol=1e-9)
    T_HB = np.linalg.inv(virtual.pose(Rotation.from_euler("x", 50, degrees=True), [0.1, 0.2, 0.6]))
    hand = cartesian_velocity(world.operators(), q_dot, T_HB @ H_base)
    np.testing.assert_allclose(joint_velocity(hand_from_base(T_HB, own), screw_operator(hand)), q_dot, atol=1e-9)
