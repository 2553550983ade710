"""Freedoms of arms against Euclidean truth, hidden by random projective frames."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from oracles.mobility import (
    drivable_freedoms_reference,
    joints_to_block_reference,
    point_jacobian_reference,
    self_motion_reference,
)
from stereoservo.control.mobility import FREEDOMS, body_frame, missing_freedom, mobility
from stereoservo.control.mobility_kernel import (
    drivable_freedoms,
    joints_to_block,
    point_jacobian,
    self_motion_from_limits,
)
from stereoservo.geometry.homogeneous import GeometryError

SEVEN = ((0, -90, 0.34), (0, 90, 0), (0, 90, 0.4), (0, -90, 0), (0, -90, 0.4), (0, 90, 0), (0, 0, 0.126))
SEVEN_MIDDLE = np.radians([10, 30, 20, -60, 15, 50, 10])
UP = np.array([0.2, -0.9, 0.3]) / np.linalg.norm([0.2, -0.9, 0.3])
BASE, ELBOW, FARTHER, WRIST = ([0.5, 0.3, 1.5], [0.3, 0.0, 1.3], [0.15, -0.2, 1.2], [0.05, -0.03, 1.1])


def arm(virtual, rng, screws):
    T0 = virtual.pose(Rotation.from_euler("xyz", [20, -15, 40], degrees=True), [0.05, -0.03, 1.1])
    return virtual.World(np.array(screws), T0, virtual.random_frame(rng), np.zeros(len(screws)))


def scara(virtual, rng):
    return arm(virtual, rng, [virtual.screw(UP, np.array(p)) for p in (BASE, ELBOW, WRIST)] + [virtual.screw(UP)])


def planar(virtual, rng, joints):
    points = (BASE, ELBOW, FARTHER, WRIST)[-joints:]
    return arm(virtual, rng, [virtual.screw(UP, np.array(p)) for p in points])


def gantry(virtual, rng):
    return arm(virtual, rng, [virtual.screw(axis) for axis in np.eye(3)])


def wrist_singular(virtual, rng):
    q = virtual.RX90_MIDDLE.copy()
    q[4] = 0.0
    return virtual.rx90(rng, q=q)


def seen(world, known=True, q=None):
    """Operators, cameras, points, plane at infinity and, if known, the metric upgrade."""
    upgrade = np.linalg.inv(world.frame) if known else None
    return world.operators(q), world.matrices, world.hidden(world.markers(q)), world.infinity, upgrade


def twist_of(world, generator):
    """Euclidean (v, w) of a generator (4, 4) of the hidden frame; the rest of it must be small."""
    X = np.linalg.inv(world.frame) @ generator @ world.frame
    assert np.abs(X[3]).max() < 1e-6 * np.abs(X).max()
    assert np.abs(X[:3, :3] + X[:3, :3].T).max() < 1e-6 * np.abs(X).max()
    return np.array([*X[:3, 3], X[2, 1], X[0, 2], X[1, 0]])


def truth(world):
    """Euclidean twists (n, 6) of the joints as they stand."""
    return np.array([twist_of(world, X) for X in world.operators()])


def point_motions(world):
    """Euclidean Jacobian (3m, 6) of the markers by twists (v, w)."""
    X = world.markers()[:, :3]
    return np.concatenate([np.hstack([np.eye(3), np.cross(np.eye(3), x).T]) for x in X])


def moments(world):
    J = point_motions(world)
    return J.T @ J


@pytest.mark.parametrize("known", [True, False])
def test_regular_six_joints_drive_all(virtual, known):
    world = virtual.rx90(np.random.default_rng(0))
    found = mobility(*seen(world, known))
    assert (found.rank, found.capacity) == (6, 6)
    assert found.missing == ()
    assert found.block == ()
    assert found.self_motions.shape == (6, 0)
    assert min(freedom.share for freedom in found.freedoms) > 1 - 1e-9
    assert [freedom.name for freedom in found.freedoms] == [f"{name} of the first camera" for name in FREEDOMS]


@pytest.mark.parametrize("known", [True, False])
def test_wrist_singularity_loses_one_rotation(virtual, known):
    world = wrist_singular(virtual, np.random.default_rng(1))
    found = mobility(*seen(world, known))
    assert (found.rank, found.capacity) == (5, 6)
    assert found.block == (3,)  # of two joints that do the same, the one nearer to the base
    # Joints 4 and 6 against each other: the body stands.
    np.testing.assert_allclose(np.abs(found.self_motions[:, 0]), [0, 0, 0, 0.5**0.5, 0, 0.5**0.5], atol=1e-9)
    (missing,) = found.missing
    twists = truth(world)
    assert np.linalg.matrix_rank(twists, tol=1e-6) == 5
    lost = twist_of(world, missing.generator)
    assert np.linalg.matrix_rank(np.vstack([twists, lost]), tol=1e-6) == 6
    # In truth: orthogonal to what the arm makes of the markers, so that their moments of it are the reciprocal wrench.
    expected = np.linalg.solve(moments(world), np.linalg.svd(twists)[2][5])
    expected *= (lost @ expected) / (expected @ expected)
    np.testing.assert_allclose(lost, expected, atol=1e-6)
    # It turns about the horizontal of the first camera, which stands turned by 10 degrees about y, more than otherwise.
    turn = Rotation.from_euler("y", -10, degrees=True).apply(lost[3:])
    assert abs(turn[0]) > 2 * np.abs(turn[1:]).max()
    assert missing.name == "rotation about the image's horizontal axis of the first camera"


@pytest.mark.parametrize("known", [True, False])
def test_scara_lacks_the_two_tilts(virtual, known):
    world = scara(virtual, np.random.default_rng(2))
    found = mobility(*seen(world, known))
    assert (found.rank, found.capacity) == (4, 4)
    assert found.block == ()
    assert len(found.missing) == 2
    assert all(freedom.share > 1 - 1e-9 for freedom in found.freedoms[:3])
    for missing in found.missing:
        assert missing.name.startswith("rotation")
        turn = twist_of(world, missing.generator)[3:]
        # what it misses is across its axes; exactly so in the measure of the plate's inertia, which is not round
        assert abs(turn @ UP) / np.linalg.norm(turn) < 0.7
    span = np.vstack([truth(world), *(twist_of(world, m.generator) for m in found.missing)])
    assert np.linalg.matrix_rank(span, tol=1e-6) == 6
    assert found.missing[0].name == "rotation about the image's horizontal axis of the first camera"


@pytest.mark.parametrize("joints", [3, 4])
def test_planar_arms(virtual, joints):
    world = planar(virtual, np.random.default_rng(3), joints)
    found = mobility(*seen(world))
    assert (found.rank, found.capacity) == (3, 3)
    assert found.block == ()
    assert found.self_motions.shape == (joints, joints - 3)
    (lift,) = [m for m in found.missing if m.name.startswith("translation")]
    v = twist_of(world, lift.generator)
    middle = world.markers().mean(axis=0)[:3]
    moved = v[:3] + np.cross(v[3:], middle)
    assert abs(moved @ UP) / np.linalg.norm(moved) > 0.9


@pytest.mark.parametrize("known", [True, False])
def test_gantry_turns_nothing(virtual, known):
    world = gantry(virtual, np.random.default_rng(4))
    found = mobility(*seen(world, known))
    assert (found.rank, found.capacity) == (3, 3)
    assert {m.name for m in found.missing} == {f"{name} of the first camera" for name in FREEDOMS[3:]}
    assert [round(f.share) for f in found.freedoms] == [1, 1, 1, 0, 0, 0]


@pytest.mark.parametrize("build", [wrist_singular, scara, gantry], ids=["wrist", "scara", "gantry"])
def test_small_errors_of_the_operators_change_nothing(virtual, build):
    """A calibration's 0.1 degrees and 0.1 mm: the same freedoms, in the same words."""
    rng = np.random.default_rng(12)
    world = build(virtual, rng)
    exact = mobility(*seen(world))
    operators, *rest = seen(world)
    for _ in range(5):
        estimated = []
        for X in operators:
            D = virtual.pose(Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=3)), 1e-4 * rng.normal(size=3))
            D = world.frame @ D @ np.linalg.inv(world.frame)
            estimated.append(D @ X @ np.linalg.inv(D))
        found = mobility(np.array(estimated), *rest)
        assert (found.rank, found.capacity, found.block) == (exact.rank, exact.capacity, exact.block)
        assert {m.name for m in found.missing} == {m.name for m in exact.missing}


def test_pixels_are_those_of_a_finite_motion(virtual):
    world = virtual.rx90(np.random.default_rng(5))
    found = mobility(*seen(world))
    for i in range(6):
        step = 1e-5 * found.directions[:, i]
        moved = world.pixels(world.markers(world.q + step)) - world.pixels(world.markers(world.q - step))
        assert np.sqrt((moved**2).sum() / 8) / 2e-5 == pytest.approx(found.pixels[i], rel=1e-5)
        markers = world.markers(world.q + step) - world.markers(world.q - step)
        radius = np.sqrt(((world.markers() - world.markers().mean(axis=0)) ** 2).sum(axis=1).mean())
        assert np.sqrt((markers**2).sum() / 4) / 2e-5 / radius == pytest.approx(found.values[i], rel=1e-5)


@pytest.mark.parametrize("near_deg", [0.0, 1.0, 5.0, 30.0])
def test_near_the_singularity_a_joint_is_blocked_and_the_rest_is_well_conditioned(virtual, near_deg):
    rng = np.random.default_rng(6)
    q = virtual.RX90_MIDDLE.copy()
    q[4] = np.radians(near_deg)
    world = virtual.rx90(rng, q=q)
    found = mobility(*seen(world))
    assert bool(found.block) == (near_deg < 10)
    rows = truth(world)[[j for j in range(6) if j not in found.block]]
    free = [j for j in range(6) if j not in found.block]
    left = mobility(world.operators()[free], *seen(world)[1:])
    assert left.values[-1] > 3e-3 * left.values[0]
    assert np.linalg.matrix_rank(rows, tol=1e-6) == len(free)


def form_of(world):
    operators, matrices, points, infinity, upgrade = seen(world)
    return np.ascontiguousarray(np.linalg.inv(body_frame(operators, matrices, points, infinity, upgrade))[:3])


def rows_of(world, form, q=None):
    return point_jacobian(
        np.ascontiguousarray(world.operators(q)), np.ascontiguousarray(world.hidden(world.markers(q))), form
    )


def test_self_motion_of_seven_joints_leaves_the_images(virtual):
    """From one limit towards the middle over many steps; the markers stand to second order of a step."""
    rng = np.random.default_rng(7)
    world = virtual.rx90(rng, q=SEVEN_MIDDLE, rows=SEVEN)
    found = mobility(*seen(world))
    assert (found.rank, found.capacity) == (6, 6)
    assert found.block == ()
    assert found.self_motions.shape == (7, 1)
    form = form_of(world)
    lower, upper = world.q - np.radians(200), world.q + np.radians(200)
    lower[0], upper[0] = world.q[0] - np.radians(2), world.q[0] + np.radians(170)  # at its limit
    upper[6] = lower[6] = 0.0  # said to have no range: no pull
    upper[5], lower[5] = np.inf, -np.inf
    before = world.pixels(world.markers())
    start = world.q.copy()
    rate, dt = 1.0, 0.002
    half = np.array([0.5 * (u - v) if np.isfinite(u - v) and u > v else 1.0 for u, v in zip(upper, lower, strict=True)])
    for _ in range(1500):
        velocity = self_motion_from_limits(rows_of(world, form), world.q, lower, upper, rate)
        assert (np.abs(velocity) <= rate * half * (1 + 1e-12)).all()
        world.q = world.q + dt * velocity
    assert world.q[0] - start[0] > np.radians(10)
    assert np.abs(world.q - start).max() > np.radians(10)
    assert np.abs(world.pixels(world.markers()) - before).max() < 0.5
    # Half the step, half the error: it is the integration's, not the motion's.
    world.q = start.copy()
    errors = []
    for step in (0.02, 0.01):
        world.q = start.copy()
        for _ in range(round(0.4 / step)):
            world.q = world.q + step * self_motion_from_limits(rows_of(world, form), world.q, lower, upper, rate)
        errors.append(np.abs(world.pixels(world.markers()) - before).max())
    assert errors[1] == pytest.approx(0.5 * errors[0], rel=0.15)


def test_arm_without_self_motions_rests_at_its_limits(virtual):
    world = virtual.rx90(np.random.default_rng(8))
    velocity = self_motion_from_limits(rows_of(world, form_of(world)), world.q, world.q - 0.01, world.q + 3.0, 1.0)
    assert not velocity.any()
    broken = np.full((12, 6), np.nan)
    assert not self_motion_from_limits(broken, world.q, world.q - 0.01, world.q + 3.0, 1.0).any()


def test_wanted_motions_are_refused_in_words_where_they_are_not_the_arms(virtual):
    rng = np.random.default_rng(9)
    world = scara(virtual, rng)
    middle = world.markers().mean(axis=0)[:3]
    inverse = np.linalg.inv(world.frame)

    def asked(G, cell=world, known=True):
        return missing_freedom(*seen(cell, known)[:4], cell.frame @ G @ np.linalg.inv(cell.frame), seen(cell, known)[4])

    assert asked(virtual.screw(UP, middle)) is None
    assert asked(0.3 * virtual.screw(UP, np.array(ELBOW)) - 2 * virtual.screw([1, 0, 0])) is None
    assert asked(np.zeros((4, 4))) is None
    right = Rotation.from_euler("y", 10, degrees=True).as_matrix()[:, 0]
    for known in (True, False):
        refused = asked(0.01 * virtual.screw(right, middle), known=known)
        assert refused is not None
        assert refused.name == "rotation about the image's horizontal axis of the first camera"
        assert refused.share < 0.5
    across = np.cross(UP, [1, 0, 0])
    assert asked(virtual.screw(across / np.linalg.norm(across), middle)).name.startswith("rotation")

    # The part that is left is a rigid motion which the arm has nothing of.
    refused = asked(virtual.screw(right, middle))
    again = missing_freedom(*seen(world)[:4], refused.generator, seen(world)[4])
    assert again.share < 1e-6
    assert np.allclose((inverse @ refused.generator @ world.frame)[3], 0, atol=1e-9)

    flat = planar(virtual, rng, 3)
    lift = asked(virtual.screw(UP), flat)
    assert lift.name.startswith("translation")
    assert lift.share < 1e-6

    stuck = wrist_singular(virtual, rng)
    twists = truth(stuck)
    J = point_motions(stuck)
    made = np.linalg.svd(J @ twists.T)[0][:, :5]
    for _ in range(10):
        v, w = 0.05 * rng.normal(size=3), rng.normal(size=3)
        G = virtual.screw(w, middle) + virtual.screw(v)
        motion = J @ np.concatenate([G[:3, 3], w])
        refused = asked(G, stuck)
        assert refused is not None
        assert refused.share == pytest.approx(np.linalg.norm(made.T @ motion) / np.linalg.norm(motion), abs=1e-9)
    joint_five = inverse_of(stuck) @ stuck.operators()[4] @ stuck.frame
    assert asked(joint_five, stuck) is None


def inverse_of(world):
    return np.linalg.inv(world.frame)


def test_degenerate_input(virtual):
    rng = np.random.default_rng(10)
    world = virtual.rx90(rng)
    operators, matrices, points, infinity, upgrade = seen(world)
    with pytest.raises(GeometryError, match="one line"):
        mobility(operators, matrices, points[[0, 0, 1]], infinity, upgrade)
    with pytest.raises(GeometryError, match="not finite"):
        mobility(operators * np.nan, matrices, points, infinity, upgrade)
    with pytest.raises(GeometryError, match="no size"):
        mobility(operators, matrices, points[[0, 0, 0]], infinity, upgrade)
    with pytest.raises(GeometryError, match="not finite"):
        missing_freedom(operators, matrices, points, infinity, np.full((4, 4), np.nan), upgrade)
    none = mobility(np.zeros((2, 4, 4)), matrices, points, infinity, upgrade)
    assert none.rank == 0
    assert len(none.missing) == 6
    assert missing_freedom(np.zeros((1, 4, 4)), matrices, points, infinity, operators[0], upgrade).share == 0.0


def test_body_frame_is_right_angled_and_faces_the_camera(virtual):
    rng = np.random.default_rng(11)
    for known in (True, False):
        world = virtual.rx90(rng)
        E = np.linalg.inv(world.frame) @ body_frame(*seen(world, known))
        markers = world.markers()
        radius = np.sqrt(((markers - markers.mean(axis=0)) ** 2).sum(axis=1).mean())
        gram = E[:3, :3].T @ E[:3, :3]
        np.testing.assert_allclose(gram / gram[0, 0], np.eye(3), atol=1e-6)
        if known:
            assert gram[0, 0] == pytest.approx(radius**2)
        np.testing.assert_allclose(E[:, 3], markers.mean(axis=0), atol=1e-9)
        step = world.pixels(np.array([E[:, 3], E[:, 3] + 1e-6 * E[:, 0], E[:, 3] + 1e-6 * E[:, 1]]))[0]
        assert step[1, 0] > step[0, 0]
        assert step[2, 1] > step[0, 1]
        assert E[:3, 2] @ (world.eyes[0][:3] - E[:3, 3]) > 0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 8), rank=st.integers(1, 6))
def test_kernels_are_their_references(seed, n, rank):
    rng = np.random.default_rng(seed)
    rank = min(n, rank)
    left = np.linalg.qr(rng.normal(size=(12, rank)))[0]
    right = np.linalg.qr(rng.normal(size=(n, rank)))[0]
    rows = left * rng.uniform(0.1, 1, rank) @ right.T
    unit = rng.uniform(0.5, 2, n)
    found, values, V = drivable_freedoms(rows, unit)
    expected, expected_values, expected_V = drivable_freedoms_reference(rows, unit)
    assert found == expected
    np.testing.assert_allclose(values, expected_values, atol=1e-10 * values[0])
    np.testing.assert_allclose(V[:, :found] @ np.diag(values[:found] ** 2) @ V[:, :found].T,
                               expected_V[:, :found] @ np.diag(values[:found] ** 2) @ expected_V[:, :found].T,
                               atol=1e-10 * values[0] ** 2)  # fmt: skip
    capacity = int(rng.integers(rank, n + 1))
    blocked = joints_to_block(rows, unit, capacity, 1e-6)
    assert (blocked == joints_to_block_reference(rows, unit, capacity, 1e-6)).all()
    assert blocked.sum() == capacity - rank
    q, half = rng.uniform(-1, 1, n), rng.uniform(0.5, 2, n)
    velocity = self_motion_from_limits(rows, q, -half, half, 0.7)
    np.testing.assert_allclose(velocity, self_motion_reference(rows, q, -half, half, 0.7), atol=1e-10)
    assert np.abs(rows @ velocity).max() < 1e-9 * max(1.0, np.abs(rows).max())
    operators, points, form = rng.normal(size=(n, 4, 4)), rng.normal(size=(5, 4)), rng.normal(size=(3, 4))
    np.testing.assert_allclose(
        point_jacobian(operators, points, form), point_jacobian_reference(operators, points, form), atol=1e-12
    )
