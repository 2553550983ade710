"""Primitive motions (7.18)-(7.20) of Euclidean arms seen through random projective frames."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from stereoservo.geometry.homogeneous import plane_of_points
from stereoservo.planning.primitives import (
    HINGE,
    PLANAR,
    TRANSLATION,
    DegenerateStepError,
    NotReachableError,
    arm_freedoms,
    revolution_around_axis,
    revolution_in_plane,
    translation_along_axis,
)


def euclidean(world, operator):
    """A projective operator as the rig sees it."""
    return np.linalg.inv(world.frame) @ operator @ world.frame


def cell(virtual, seed):
    rng = np.random.default_rng(seed)
    T0, _ = virtual.random_task(rng, 30.0, 0.1)
    q = virtual.RX90_MIDDLE + rng.uniform(-0.4, 0.4, 6)
    return rng, (virtual.free_arm(rng, T0) if seed % 3 == 0 else virtual.rx90(rng, q, T0))


def finite(rng, k):
    return np.column_stack([rng.uniform(-0.3, 0.3, (k, 2)), rng.uniform(0.8, 1.3, k), np.ones(k)])


@pytest.mark.parametrize("seed", range(12))
def test_translation(virtual, seed):
    rng, world = cell(virtual, seed)
    X = finite(rng, 2)
    A = world.hidden(X)
    found = translation_along_axis(world.operators(), A[0], A[1])
    way = X[1, :3] - X[0, :3]
    G = euclidean(world, found.operator)
    np.testing.assert_allclose(G[:3, :3], 0, atol=1e-9)
    np.testing.assert_allclose(np.cross(G[:3, 3], way), 0, atol=1e-9)
    assert G[:3, 3] @ way > 0
    assert np.linalg.norm(found.operator @ A[0]) == pytest.approx(1.0)
    np.testing.assert_allclose(np.tensordot(found.screw, world.operators(), 1), found.operator, atol=1e-10)
    assert found.smallest < 1e-10 < found.second <= found.largest


@pytest.mark.parametrize("seed", range(12))
def test_revolution_around_axis(virtual, seed):
    rng, world = cell(virtual, seed)
    X = finite(rng, 2)
    found = revolution_around_axis(world.operators(), *world.hidden(X))
    axis = (X[1, :3] - X[0, :3]) / np.linalg.norm(X[1, :3] - X[0, :3])
    truth = virtual.screw(axis, X[0, :3])
    G = euclidean(world, found.operator)
    np.testing.assert_allclose(G * np.sign((G * truth).sum()), truth, atol=1e-8)
    np.testing.assert_allclose(expm(2 * np.pi * found.operator), np.eye(4), atol=1e-7)


@pytest.mark.parametrize("seed", range(12))
def test_revolution_in_plane(virtual, seed):
    rng, world = cell(virtual, seed)
    X = finite(rng, 3)
    centre = X.mean(axis=0)
    found = revolution_in_plane(world.operators(), plane_of_points(*world.hidden(X)), world.hidden(centre))
    normal = np.cross(X[1, :3] - X[0, :3], X[2, :3] - X[0, :3])
    truth = virtual.screw(normal / np.linalg.norm(normal), centre[:3])
    G = euclidean(world, found.operator)
    np.testing.assert_allclose(G * np.sign((G * truth).sum()), truth, atol=1e-8)


def test_a_redundant_arm_moves_without_its_self_motion(virtual):
    rng, world = cell(virtual, 1)
    X = finite(rng, 2)
    A = world.hidden(X)
    six = world.operators()
    # a seventh joint that moves as a mixture of the others: one self-motion
    seven = np.concatenate([six, np.tensordot([0.3, -0.2, 0.5, 0.1, 0.0, 0.4], six, 1)[None]])
    self_motion = np.array([0.3, -0.2, 0.5, 0.1, 0.0, 0.4, -1.0])
    expected = translation_along_axis(six, *A)
    found = translation_along_axis(seven, *A)
    assert arm_freedoms(seven).joints.shape == (7, 6)
    np.testing.assert_allclose(found.operator, expected.operator, atol=1e-9)
    assert found.screw @ self_motion == pytest.approx(0.0, abs=1e-9)
    assert revolution_around_axis(seven, *A).smallest < 1e-10


def scara(virtual, rng):
    """Three translations and a rotation about z: what a SCARA can do."""
    generators = np.array([virtual.screw(axis) for axis in np.eye(3)] + [virtual.screw([0, 0, 1.0], [0.1, 0, 1])])
    T0 = virtual.pose(Rotation.identity(), [0.05, 0, 1.0])
    return virtual.World(generators, T0, virtual.random_frame(rng), np.zeros(4))


@pytest.mark.parametrize("seed", range(6))
def test_a_deficient_arm_states_which_freedom_it_lacks(virtual, seed):
    rng = np.random.default_rng(seed)
    world = scara(virtual, rng)
    X = finite(rng, 3)
    A, operators = world.hidden(X), world.operators()
    assert translation_along_axis(operators, A[0], A[1]).smallest < 1e-10
    tilted = world.hidden(world.markers())[:3]
    centre = world.hidden(world.plate[:, 3])
    assert revolution_in_plane(operators, plane_of_points(*tilted), centre).smallest < 1e-10
    with pytest.raises(NotReachableError, match="about the hinge") as caught:
        revolution_around_axis(operators, A[0], A[1])
    assert caught.value.freedom == HINGE
    assert caught.value.ratio > caught.value.threshold
    with pytest.raises(NotReachableError) as caught:
        revolution_in_plane(operators, plane_of_points(*A), A[0])
    assert caught.value.freedom == PLANAR
    with pytest.raises(NotReachableError) as caught:
        translation_along_axis(operators[[0, 1, 3]], world.hidden(X[0]), world.hidden(X[0] + [0, 0, 0.2, 0]))
    assert caught.value.freedom == TRANSLATION


def test_an_arm_that_cannot_move_reaches_nothing(virtual):
    _, world = cell(virtual, 1)
    A = world.hidden(world.markers())
    with pytest.raises(NotReachableError):
        translation_along_axis(np.zeros((6, 4, 4)), A[0], A[1])


@pytest.mark.parametrize("primitive", [translation_along_axis, revolution_around_axis])
def test_one_point_twice_is_no_line(virtual, primitive):
    _, world = cell(virtual, 1)
    A = world.hidden(world.markers())[0]
    with pytest.raises(DegenerateStepError):
        primitive(world.operators(), A, A)


@pytest.mark.parametrize("seed", range(10))
def test_operators_with_errors_give_a_slightly_wrong_motion_not_none(virtual, seed):
    rng, world = cell(virtual, seed)
    X = finite(rng, 2)
    A = world.hidden(X)
    exact = revolution_around_axis(world.operators(), *A)
    operators = world.operators()
    found = revolution_around_axis(operators + 1e-5 * rng.normal(size=operators.shape), *A)
    sign = np.sign((exact.operator * found.operator).sum())
    np.testing.assert_allclose(found.operator * sign, exact.operator, atol=0.03)
    assert found.smallest > 0
