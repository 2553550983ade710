"""Cartesian laws near singularities of the arm, and in frames of any anisotropy."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo.control.cartesian_components import normal_frame, stacked_singular
from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.laws.cartesian3 import LONGEST_STEP
from stereoservo.control.step_correction import SINGULAR, damped_step, rigid_motions
from stereoservo.kinematics.composition import Composition

PERIOD = 0.04
BOTH = ("cartesian2", "cartesian3")


def arranged(virtual, world, T_star, frame=None):
    """Scene and task towards a pose of the plate, in another projective frame where there is one."""
    frame = np.eye(4) if frame is None else frame
    back = np.linalg.inv(frame)
    operators = np.ascontiguousarray(frame @ world.operators() @ back)
    seen = world.pixels(virtual.PLATE @ world.plate_pose().T)
    wanted = world.pixels(virtual.PLATE @ T_star.T)
    points, targets = (world.triangulated(pixels) @ frame.T for pixels in (seen, wanted))
    scene = Scene(
        operators, int(Composition.BASE_FIRST), world.matrices @ back, world.camera_centres @ frame.T, points, seen,
        np.ones((2, 4)),
    )  # fmt: skip
    task = Task(
        wanted, np.ones((2, 4)), np.zeros((2, 4, 2)), targets, np.ones(4), points.mean(axis=0),
        targets.mean(axis=0), np.arange(3),
    )  # fmt: skip
    return scene, task


def anisotropic(rng, ratio):
    """A random change of frame (4, 4) with singular values from 1 to ``ratio``."""
    left, right = (np.linalg.qr(rng.normal(size=(4, 4)))[0] for _ in range(2))
    return left @ np.diag(np.geomspace(1.0, ratio, 4)) @ right


@pytest.mark.parametrize("law", BOTH)
@pytest.mark.parametrize("stretched", [None, 0.0, 1e-3])
def test_joint_velocities_do_not_depend_on_the_projective_frame(virtual, law, stretched):
    rng = np.random.default_rng(3)
    T0, _ = virtual.random_task(rng, 10, 0.05)
    world = virtual.rx90(rng, T0=T0)
    if stretched is not None:
        world.q[4] = stretched
    T_star = world.plate_pose(world.q + np.array([0.15, -0.1, 0.12, 0.3, 0.2, 0.2]))
    options = Options(1.5, PERIOD)
    expected = LAWS[law].step(*arranged(virtual, world, T_star), options)
    for _ in range(4):
        found = LAWS[law].step(*arranged(virtual, world, T_star, anisotropic(rng, 1e4)), options)
        np.testing.assert_array_equal(found.status, expected.status)
        # What is exactly singular has an arbitrary sign for its way out, and rounding at 1e4 decides near it.
        tolerance = 1e-4 if stretched is None else 1e-2
        np.testing.assert_allclose(
            np.abs(found.velocity), np.abs(expected.velocity), rtol=tolerance,
            atol=tolerance * np.abs(expected.velocity).max(),
        )  # fmt: skip
        np.testing.assert_allclose(found.error[1:], expected.error[1:], atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_the_normal_frame_is_one_up_to_a_rotation(seed):
    rng = np.random.default_rng(seed)
    points, centres = rng.normal(size=(3, 4)), rng.normal(size=(2, 4))
    change, back = normal_frame(points, centres)
    np.testing.assert_allclose(change @ back, np.eye(4), atol=1e-9)
    moved = points @ change.T
    eyes = 0.9 * moved.mean(axis=0) + 0.1 * centres @ change.T
    np.testing.assert_allclose(moved.T @ moved / 3 + eyes.T @ eyes / 2, np.eye(4), atol=1e-9)
    other = anisotropic(rng, 1e4)
    again, _ = normal_frame(points @ other.T, centres @ other.T)
    turn = again @ other @ back
    np.testing.assert_allclose(turn @ turn.T, np.eye(4), atol=1e-6)
    flat = np.array([[1.0, 2.0, 3.0, 1.0]] * 3)
    np.testing.assert_array_equal(normal_frame(flat, flat)[0], np.eye(4))


def singular_arm(virtual, seed, wrist):
    rng = np.random.default_rng(seed)
    T0, _ = virtual.random_task(rng, 10, 0.05)
    world = virtual.rx90(rng, T0=T0)
    world.q[4] = wrist
    return rng, world, np.ascontiguousarray(world.operators())


@pytest.mark.parametrize("wrist", [0.0, 1e-5, 1e-3])
def test_all_rigid_motions_are_known_at_a_stretched_wrist(virtual, wrist):
    rng, world, operators = singular_arm(virtual, 1, wrist)
    V, values = stacked_singular(operators)
    assert values[5] < SINGULAR * values[0]
    found, known = rigid_motions(operators, V, values)
    assert known
    gram = np.einsum("aij,bij->ab", found, found)
    np.testing.assert_allclose(gram, np.eye(6), atol=1e-9)
    # Motions that the arm makes elsewhere are among them.
    world.q[3:] += rng.uniform(0.3, 0.6, 3)
    for operator in world.operators():
        size = np.linalg.norm(operator)
        left = operator - np.einsum("a,aij->ij", np.einsum("aij,ij->a", found, operator), found)
        assert np.linalg.norm(left) < 1e-7 * size


def test_the_damped_step_is_exact_where_the_arm_can_and_bounded_where_it_cannot(virtual):
    rng, _, operators = singular_arm(virtual, 2, 0.0)
    V, values = stacked_singular(operators)
    can = np.tensordot(rng.normal(size=6), operators, axes=1)
    step = damped_step(operators, V, values, np.ascontiguousarray(can), 1.0)
    np.testing.assert_allclose(np.tensordot(step, operators, axes=1), can, atol=1e-7 * np.linalg.norm(can))
    rigid, _ = rigid_motions(operators, V, values)
    lost = damped_step(operators, V, values, np.ascontiguousarray(rigid[5]), 1.0)
    np.testing.assert_allclose(np.tensordot(lost, operators, axes=1), 0.0, atol=1e-6)  # the body stays
    assert 0.1 < np.abs(lost).max() <= 0.5


@pytest.mark.parametrize("law", BOTH)
@pytest.mark.parametrize("wrist", [0.0, 5e-4, 1.5e-3])
def test_no_joint_goes_farther_than_a_radian_in_one_step(virtual, law, wrist):
    """A long step with a high gain asks for more of the motions that the arm can hardly make."""
    _, world, _ = singular_arm(virtual, 4, wrist)
    T_star = world.plate_pose(world.q + np.array([0.4, -0.3, 0.3, 1.2, 0.6, -1.0]))
    step = LAWS[law].step(*arranged(virtual, world, T_star), Options(20.0, 0.5))
    assert 0.5 < 0.5 * np.abs(step.velocity).max() <= LONGEST_STEP * (1.0 + 1e-12)
