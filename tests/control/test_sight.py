"""Ways in sight (7.4.2): against a fine search of the square of translation and turn; kernel against reference."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracles.face_visibility import visible_rotation
from stereoservo.control.laws.cartesian3 import visible_rotation as kernel


def problem(virtual, rng, angle=None):
    """A face, a turn about its middle, a way, cameras; in a random frame. Whether it is seen, Euclidean."""
    T0, T_star = virtual.random_task(rng, rng.uniform(100, 180) if angle is None else angle, rng.uniform(0, 1.5))
    world = virtual.free_arm(rng, T0)
    turn = Rotation.from_matrix(T_star[:3, :3] @ T0[:3, :3].T).as_rotvec()
    theta = float(np.linalg.norm(turn))
    G = virtual.screw(turn / theta, T0[:3, 3])
    way = np.append(T_star[:3, 3] - T0[:3, 3], 0.0)
    face = np.append(-T0[:3, 2], T0[:3, 2] @ T0[:3, 3])

    def seen(shares, angles):
        """(angles, shares): whether both cameras see the face."""
        normals = Rotation.from_rotvec(np.outer(angles, turn / theta)).apply(-T0[:3, 2])
        eyes = world.eyes[:, None, :3] - T0[:3, 3] - np.outer(shares, way[:3])
        return (np.einsum("csi,ti->cts", eyes, normals) > 0).all(axis=0)

    inverse = np.linalg.inv(world.frame)
    hidden = (inverse.T @ face, world.frame @ G @ inverse, world.frame @ way, world.camera_centres)
    return hidden, theta, seen


def reachable(seen, angle, cells=100):
    """Whether a way on which neither goes back exists in a fine grid of (s, t)."""
    steps = np.linspace(0, 1, cells + 1)
    free = seen(steps, angle * steps)
    reach = np.zeros_like(free)
    for i in range(cells + 1):
        for j in range(cells + 1):
            before = (i > 0 and reach[i - 1, j]) or (j > 0 and reach[i, j - 1]) or (i == j == 0)
            reach[i, j] = free[i, j] and before
    return bool(reach[-1, -1])


def test_a_way_is_found_where_a_search_finds_one(virtual):
    clear = {True: 0, False: 0}
    for seed in range(25):
        hidden, theta, seen = problem(virtual, np.random.default_rng(50189 + seed), angle=170.0)
        way = visible_rotation(*hidden, theta)
        short, long = reachable(seen, theta), reachable(seen, theta - 2 * np.pi)
        assert way.clear == (short or long)
        if way.clear:
            assert way.angle == pytest.approx(theta) or way.angle == pytest.approx(theta - 2 * np.pi)
            assert reachable(seen, way.angle)
        clear[way.angle > 0] += 1
    assert clear[True] > 0
    assert clear[False] > 0


@pytest.mark.parametrize("seed", range(30))
def test_the_kernel_is_the_reference(virtual, seed):
    rng = np.random.default_rng(seed)
    (face, H, displacement, eyes), theta, _ = problem(virtual, rng)
    eyes = eyes[: seed % 3]
    for angle in (theta, -theta, 0.0):
        for side in (1.0, -1.0):
            expected = visible_rotation(face, H, displacement, side * eyes, angle)
            found = kernel(face, H, displacement, eyes, side, angle)
            np.testing.assert_allclose(found[:3], expected[:3], rtol=0, atol=1e-9)
            assert found[3] == expected.clear


def test_translation_waits_for_the_turn_and_the_turn_for_the_translation(virtual):
    """A face on the camera's left that looks far to the right goes to its mirror image: neither may go alone."""
    eye = np.array([[0.0, 0, 0, 1.0]])

    def way(x, phi, to_x, to_phi):
        """From depth 1 at x, its normal (sin phi, 0, -cos phi): seen while cos phi > x sin phi."""
        normal = np.array([np.sin(phi), 0, -np.cos(phi)])
        face = np.append(normal, -normal @ [x, 0, 1.0])
        turn = np.angle(np.exp(1j * (phi - to_phi)))
        return visible_rotation(face, virtual.screw([0, 1.0, 0], [x, 0, 1.0]), np.array([to_x - x, 0, 0, 0]), eye, turn)

    far = np.radians(120.0)
    assert way(-1.0, 0.0, 1.0, 0.0) == (0.0, 1.0, 0.0, True)
    both = way(-1.0, far, 1.0, -far)
    assert both.clear
    assert both.angle == pytest.approx(2 * far)  # not the short way, through the back
    margin = 0.1 * (np.cos(far) + np.sin(far))
    assert both.translation == pytest.approx((1.0 + (np.cos(far) - margin) / np.sin(far)) / 2.0)
    last = np.radians(120.0 + 45.0) - np.arcsin(margin / np.sqrt(2.0))
    assert last - 2 * far / 32 <= both.turn <= last
    # a face that stands edge on has no way to a goal beyond the plane that it stands in
    edge = way(-1.0, np.radians(134.9), 1.0, np.radians(134.9) - np.pi)
    assert edge.translation < 0.01


def test_cameras_that_see_the_back_now_or_at_the_end_do_not_count(virtual):
    G = virtual.screw([0, 1.0, 0], [0, 0, 1.0])
    face, still = np.array([0, 0, -1.0, 1.0]), np.zeros(4)
    ahead, behind = np.array([[0, 0, 0, 1.0]]), np.array([[0, 0, 3.0, 1.0]])
    assert visible_rotation(face, G, still, ahead, np.pi) == (np.pi, 1.0, np.pi, True)
    assert visible_rotation(face, G, still, behind, 0.3) == (0.3, 1.0, 0.3, True)
    assert visible_rotation(face, G, still, np.zeros((0, 4)), 0.3) == (0.3, 1.0, 0.3, True)
