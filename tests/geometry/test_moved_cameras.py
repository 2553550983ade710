import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from oracles.frame_change import (
    STANDARD_BASIS,
    canonical_frame,
    carry_over,
    frame_change,
    frame_change_from_points,
    scene_frame,
)
from oracles.optimal_triangulation import fundamental_of_cameras
from oracles.projective_points import move_cameras
from stereoservo.geometry.cameras import (
    canonical_pair,
    pixel_normaliser,
    project,
    project_many,
    triangulate,
    triangulation_covariance,
)
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.moved_cameras import (
    carried_point_covariance,
    plane_deviations,
    refuse_coplanar,
    resect_moved_camera,
)
from stereoservo.geometry.screws import screw_twist
from stereoservo.geometry.strata import euclidean_to_projective

seeds = st.integers(0, 2**32 - 1)
SOME = np.array([[-0.1, -0.1, 0.0], [0.12, -0.08, 0.03], [0.0, 0.11, -0.06], [0.03, 0.02, 0.13], [-0.08, 0.07, 0.1]])


class MovedCell:
    """A scene before and after its two cameras were moved: Euclidean truth, canonical frames old and new."""

    def __init__(self, make_rig, rng, n):
        self.old_rig = make_rig()
        self.new_rig = make_rig(focal=700.0, baseline=0.25, vergence_deg=rng.uniform(18, 30), roll_deg=-2.0)
        spots = np.vstack([SOME, rng.uniform(-0.15, 0.15, (n - 5, 3))])[:n]
        self.X = np.hstack([spots + self.middle(self.old_rig), np.ones((n, 1))])
        # The new rig looks at the same place from some 20 degrees aside.
        self.T = np.eye(4)
        self.T[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)).as_matrix()
        self.T[:3, 3] = self.middle(self.new_rig) - self.T[:3, :3] @ self.middle(self.old_rig)
        self.old_frame = self.canonical(self.old_rig, rng)
        self.new_frame = self.canonical(self.new_rig, rng)
        self.M = move_points(self.old_frame, self.X)
        self.Ps_old = move_cameras(self.old_frame, self.old_rig.Ps)
        self.Ps_new = move_cameras(self.new_frame, self.new_rig.Ps)
        self.H = self.new_frame @ self.T @ np.linalg.inv(self.old_frame)
        self.pixels_old = self.old_rig.pixels(self.X)
        self.pixels_new = self.new_rig.pixels(self.X @ self.T.T)

    @staticmethod
    def middle(rig):
        return np.array([0, 0, rig.baseline / np.tan(np.deg2rad(rig.vergence_deg))])

    @staticmethod
    def canonical(rig, rng):
        plane = np.append(rng.uniform(-0.1, 0.1, 3), rng.uniform(0.5, 2.0))
        return euclidean_to_projective(plane, pixel_normaliser(640, 480) @ rig.K)


def as_unit(H):
    H = H / abs(np.linalg.det(H)) ** 0.25
    return H * np.sign(H.flat[np.abs(H).argmax()])


@given(seeds)
def test_five_points_carry_the_standard_basis(make_rig, seed):
    cell = MovedCell(make_rig, np.random.default_rng(seed), 5)
    H = scene_frame(cell.M)
    moved = move_points(H, STANDARD_BASIS)
    for found, point in zip(moved, cell.M, strict=True):
        assert np.linalg.norm(np.cross(found[:3], point[:3])) < 1e-10
        assert np.allclose(found / found[3], point / point[3], atol=1e-9)
    # (2.21): the coordinates of anything else in the points' frame are the same before and after the move.
    other = np.array([0.3, -0.2, 1.1 + cell.middle(cell.old_rig)[2], 1.0])
    before = np.linalg.solve(H, cell.old_frame @ other)
    new_points = move_points(cell.new_frame @ cell.T, cell.X)
    after = np.linalg.solve(scene_frame(new_points), cell.new_frame @ cell.T @ other)
    assert np.allclose(
        before / np.linalg.norm(before), after / np.linalg.norm(after) * np.sign(before @ after), atol=1e-8
    )


@pytest.mark.parametrize("n", [5, 9])
@settings(max_examples=25)
@given(seed=seeds)
def test_everything_known_is_brought_over(make_rig, n, seed):
    rng = np.random.default_rng(seed)
    cell = MovedCell(make_rig, rng, n)
    change = frame_change(cell.M, cell.Ps_new, cell.pixels_new, sigma=0.01)
    assert np.allclose(as_unit(change.H), as_unit(cell.H), atol=1e-7)
    assert change.rms < 1e-4
    assert change.degrees_of_freedom == 4 * n - 15
    assert ((change.H @ cell.M.T)[2] / cell.M[:, 2] > 0).all()
    linear = frame_change_from_points(cell.M, move_points(cell.H, cell.M))
    assert np.allclose(as_unit(linear), as_unit(cell.H), atol=1e-7)

    twists = np.stack([screw_twist(rng.normal(size=3), rng.normal(size=3), p) for p in (0.0, 0.0, 0.3)])
    marker = np.append(cell.middle(cell.old_rig) + rng.uniform(-0.1, 0.1, 3), 1.0)
    known = carry_over(
        change.H,
        points=move_points(cell.old_frame, marker[None]),
        generators=conjugate(cell.old_frame, twists),
        cameras=cell.Ps_old,
    )
    assert np.allclose(known.generators, conjugate(cell.new_frame @ cell.T, twists), atol=1e-6)
    expected = project_many(cell.new_rig.Ps, (cell.T @ marker)[None])
    assert np.allclose(project_many(cell.Ps_new, known.points), expected, atol=1e-5)
    assert np.allclose(project_many(known.cameras, known.points), cell.old_rig.pixels(marker[None]), atol=1e-5)


def test_the_new_frame_may_be_that_of_a_fundamental_matrix(make_rig):
    rng = np.random.default_rng(1)
    cell = MovedCell(make_rig, rng, 8)
    Ps = np.stack(
        canonical_pair(
            fundamental_of_cameras(*cell.new_rig.Ps),
            640,
            480,
            left=cell.pixels_new[0],
            right=cell.pixels_new[1],
        )
    )
    change = frame_change(cell.M, Ps, cell.pixels_new, sigma=0.1)
    generator = screw_twist(rng.normal(size=3), cell.middle(cell.old_rig))
    moved = carry_over(change.H, points=cell.M, generators=conjugate(cell.old_frame, generator)[None])
    turned = np.einsum("ij,nj->ni", np.eye(4) + 0.05 * moved.generators[0], moved.points)
    truth = cell.X @ (np.eye(4) + 0.05 * generator).T @ cell.T.T
    assert np.allclose(project_many(Ps, turned), project_many(cell.new_rig.Ps, truth), atol=1e-5)


@pytest.mark.parametrize("old_noise", [False, True])
def test_noise_floor_and_covariance(make_rig, old_noise):
    """Residuals and errors of H over many trials against the chi-squared law of its own covariance."""
    sigma, n, trials = 0.2, 12, 60
    cell = MovedCell(make_rig, np.random.default_rng(2), n)
    residual = error = 0.0
    marker = move_points(
        cell.old_frame, np.append(cell.middle(cell.old_rig) + np.array([0.02, -0.03, 0.05]), 1.0)[None]
    )
    marker_error = 0.0
    truth = as_unit(cell.H)
    for seed in range(trials):
        rng = np.random.default_rng(1000 + seed)
        M, covariance = cell.M, None
        if old_noise:
            sigmas = np.full((2, n), sigma)
            M = triangulate(cell.Ps_old, cell.pixels_old + rng.normal(0, sigma, (2, n, 2)), sigmas, iterations=6)
            covariance = triangulation_covariance(cell.Ps_old, M, sigmas)
        pixels = cell.pixels_new + rng.normal(0, sigma, (2, n, 2))
        pixels[1, 7] = np.nan
        change = frame_change(M, cell.Ps_new, pixels, sigma, covariance)
        assert change.degrees_of_freedom == 4 * n - 2 - 15
        residual += change.rms**2 * change.degrees_of_freedom
        H = change.H * np.sign((change.H * truth).sum())
        values, vectors = np.linalg.eigh(change.covariance)
        assert (values[1:] > 0).all()
        difference = vectors.T @ (H - truth).ravel()
        error += (difference[1:] ** 2 / values[1:]).sum()

        spread = carried_point_covariance(change, marker)[0]
        carried = move_points(change.H, marker)[0]
        P = cell.Ps_new[0]
        m = P @ carried
        J = (P[:2] - np.outer(m[:2] / m[2], P[2])) / m[2]
        offset = m[:2] / m[2] - project(P, move_points(cell.H, marker))[0]
        marker_error += offset @ np.linalg.solve(J @ spread @ J.T, offset)
    low, high = chi2.interval(0.9999, trials * (4 * n - 2 - 15))
    assert low < residual < high
    low, high = chi2.interval(0.9999, trials * 15)
    assert low < error < high
    low, high = chi2.interval(0.9999, trials * 2)
    assert low < marker_error < high


def test_four_coplanar_of_five_are_refused_by_name(make_rig):
    rng = np.random.default_rng(3)
    cell = MovedCell(make_rig, rng, 5)
    flat = cell.X.copy()
    flat[3, :3] = flat[0, :3] + 0.7 * (flat[1, :3] - flat[0, :3]) + 0.6 * (flat[4, :3] - flat[0, :3])
    M = move_points(cell.old_frame, flat)
    with pytest.raises(GeometryError, match=r"points \[0, 1, 3, 4\] are coplanar") as error:
        scene_frame(M)
    assert error.value.data["coplanar"] == [0, 1, 3, 4]
    with pytest.raises(GeometryError, match=r"\[0, 1, 3, 4\] are coplanar"):
        frame_change_from_points(M, move_points(cell.H, M))
    clean = cell.new_rig.pixels(flat @ cell.T.T)
    for noise in (0.0, 0.3):
        pixels = clean + rng.normal(0, noise, clean.shape)
        with pytest.raises(GeometryError, match=r"\[0, 1, 3, 4\] are coplanar.*besides point 2") as error:
            frame_change(M, cell.Ps_new, pixels, sigma=0.3)
        assert error.value.data["deviations"] < error.value.data["needed"]


def test_all_but_one_coplanar_are_refused_by_their_own_numbers(make_rig):
    rng = np.random.default_rng(4)
    cell = MovedCell(make_rig, rng, 9)
    flat = cell.X.copy()
    flat[[0, 2, 3, 4, 6, 7, 8], 2] = cell.middle(cell.old_rig)[2]  # 5 stands off; 1 is not seen
    pixels = cell.new_rig.pixels(flat @ cell.T.T) + rng.normal(0, 0.2, (2, 9, 2))
    pixels[0, 1] = np.nan
    with pytest.raises(GeometryError, match=r"\[0, 2, 3, 4, 6, 7, 8\] are coplanar.*point 5"):
        frame_change(move_points(cell.old_frame, flat), cell.Ps_new, pixels, sigma=0.2)


def test_deviations_from_a_plane_do_not_depend_on_the_frame(make_rig):
    rng = np.random.default_rng(5)
    cell = MovedCell(make_rig, rng, 6)
    covariance = triangulation_covariance(cell.Ps_old, cell.M / cell.M[:, 2:3], np.full((2, 6), 3.0))
    M = cell.M / cell.M[:, 2:3]
    _, here = plane_deviations(M, covariance)
    H = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
    _, there = plane_deviations(M @ H.T, H @ covariance @ H.T)
    assert np.isclose(here, there, rtol=1e-3)
    refuse_coplanar(M, 1e-3 * covariance)


def test_a_single_moved_camera_is_resected_with_its_covariance(make_rig):
    sigma, trials, n = 0.3, 80, 10
    cell = MovedCell(make_rig, np.random.default_rng(6), n)
    truth = cell.new_rig.Ps[0] @ cell.T @ np.linalg.inv(cell.old_frame)
    truth = truth / np.linalg.norm(truth)
    residual = error = 0.0
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        found = resect_moved_camera(cell.M, cell.pixels_new[0] + rng.normal(0, sigma, (n, 2)), sigma)
        assert found.degrees_of_freedom == 2 * n - 11
        residual += found.rms**2 * found.degrees_of_freedom
        P = found.P * np.sign((found.P * truth).sum())
        values, vectors = np.linalg.eigh(found.covariance)
        difference = vectors.T @ (P - truth).ravel()
        error += (difference[1:] ** 2 / values[1:]).sum()
    low, high = chi2.interval(0.9999, trials * (2 * n - 11))
    assert low < residual < high
    low, high = chi2.interval(0.9999, trials * 11)
    assert low < error < high


def test_a_moved_left_camera_gets_its_canonical_frame(make_rig):
    rng = np.random.default_rng(7)
    cell = MovedCell(make_rig, rng, 8)
    N = pixel_normaliser(640, 480)
    left = resect_moved_camera(cell.M, cell.pixels_new[0]).P
    H = canonical_frame(left, N, cell.M)
    canonical = left @ np.linalg.inv(H)
    assert np.allclose(canonical / canonical[2, 2], np.hstack([np.linalg.inv(N), np.zeros((3, 1))]), atol=1e-6)
    moved = carry_over(H, points=cell.M, cameras=cell.Ps_old[1:])
    assert (moved.points[:, 2] > 0).all()
    assert np.isclose(np.mean(moved.points[:, 3] / moved.points[:, 2]), 1.0)
    assert np.allclose(project(canonical, moved.points), cell.pixels_new[0], atol=1e-6)
    assert np.allclose(project(moved.cameras[0], moved.points), cell.pixels_old[1], atol=1e-6)
    with pytest.raises(GeometryError, match="passes through"):
        canonical_frame(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]), N, cell.M)


def test_too_few_flat_and_misshapen_input_is_refused(make_rig):
    rng = np.random.default_rng(8)
    cell = MovedCell(make_rig, rng, 7)
    few = cell.pixels_new.copy()
    few[0, [0, 2, 6]] = np.nan
    with pytest.raises(GeometryError, match=r"4 of 7 points .*\[1, 3, 4, 5\]") as error:
        frame_change(cell.M, cell.Ps_new, few)
    assert error.value.code == "too_few"
    with pytest.raises(GeometryError, match="do not fit"):
        frame_change(cell.M[:5], cell.Ps_new, cell.pixels_new)
    with pytest.raises(GeometryError, match="five carry a frame"):
        scene_frame(cell.M)
    with pytest.raises(GeometryError, match="at least 5"):
        refuse_coplanar(cell.M[:4])
    with pytest.raises(GeometryError, match="both must be"):
        frame_change_from_points(cell.M, cell.M[:5])
    with pytest.raises(GeometryError, match="at least 6"):
        resect_moved_camera(cell.M[:5], cell.pixels_new[0, :5])
    almost = cell.X.copy()
    almost[:, 2] = cell.middle(cell.old_rig)[2] + 1e-5 * rng.normal(size=7)
    pixels = cell.new_rig.pixels(almost @ cell.T.T)[0]
    with pytest.raises(GeometryError, match="coplanar within noise"):
        resect_moved_camera(move_points(cell.old_frame, almost), pixels, sigma=0.3)
