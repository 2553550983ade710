"""Maps between frames within their groups, against Euclidean truth hidden by random projective frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from oracles.projective_points import move_cameras
from stereoservo.geometry.alignment import (
    DRAWING,
    POINTS_NEEDED,
    AlignmentFrame,
    align,
    drawn_points,
    family_between,
    point_residuals,
    reprojected,
)
from stereoservo.geometry.cameras import (
    pixel_normaliser,
    projection_jacobian_many,
    triangulate,
    triangulation_covariance,
)
from stereoservo.geometry.displacements import similarity_from_points
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.moved_cameras import carried_point_covariance
from stereoservo.geometry.strata import euclidean_to_projective

seeds = st.integers(0, 2**32 - 1)
SPOTS = np.array([[-0.1, -0.1, 0.0], [0.12, -0.08, 0.03], [0.0, 0.11, -0.06], [0.03, 0.02, 0.13], [-0.08, 0.07, 0.1]])
TOOL = np.array([[0.05, -0.02, 0.04], [0.1, 0.05, 0.02], [0.02, 0.09, 0.06]])
FAMILIES = ("rigid", "similar", "affine", "projective")
SIGMA = 0.1


def rigid(rng, turn=0.4, move=0.05):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.uniform(-turn, turn, 3)).as_matrix()
    T[:3, 3] = rng.uniform(-move, move, 3)
    return T


def ones(X):
    return np.hstack([X, np.ones((len(X), 1))])


class Cell:
    """A workpiece and a tool placed before a rig, seen through a projective frame that hides all lengths."""

    def __init__(self, rig, rng):
        self.rig = rig
        self.middle = np.array([0, 0, rig.baseline / np.tan(np.deg2rad(rig.vergence_deg))])
        plane = np.append(rng.uniform(-0.1, 0.1, 3), rng.uniform(0.5, 2.0))
        self.hidden = euclidean_to_projective(plane, pixel_normaliser(640, 480) @ rig.K)
        self.Ps = move_cameras(self.hidden, rig.Ps)
        # What a model knows of its frame, up to one length and anybody's axes.
        affine = np.eye(4)
        affine[:3] = rng.normal(size=(3, 4))
        self.to_affine = affine @ np.linalg.inv(self.hidden)
        scale = np.diag([*[rng.uniform(0.5, 2.0)] * 3, 1.0])
        self.to_euclidean = scale @ rigid(rng, 2.0, 1.0) @ np.linalg.inv(self.hidden)

    def frame(self, family, same_as=None):
        upgrade = self.to_euclidean if same_as is None else same_as
        return AlignmentFrame(
            self.Ps,
            self.to_affine if family != "projective" else None,
            upgrade if family in ("rigid", "similar") else None,
        )

    def see(self, X, rng, sigma):
        return self.rig.pixels(X) + sigma * rng.normal(size=(2, len(X), 2))


def carried(family, make_rig, rng, sigma, n=5):
    """The tool's pixels after the workpiece has moved: found, their deviations, and the truth."""
    old = Cell(make_rig(), rng)
    new = old if family == "rigid" else Cell(make_rig(focal=700.0, baseline=0.25, vergence_deg=24.0), rng)
    place = rigid(rng)
    place[:3, 3] += old.middle
    moved = np.eye(4)
    moved[:3, 3] = new.middle
    moved = moved @ rigid(rng) @ np.linalg.inv(place)  # a motion of the workpiece, and of the cameras
    W, L = ones(SPOTS[:n]) @ place.T, ones(TOOL) @ place.T
    sigmas = np.full((2, 8), max(sigma, 1e-6))
    M_W = triangulate(old.Ps, old.see(W, rng, sigma), iterations=8)
    M_L = triangulate(old.Ps, old.see(L, rng, sigma), iterations=8)
    change = align(
        family, old.frame(family), new.frame(family), M_W, new.see(W @ moved.T, rng, sigma), sigmas[:, :n],
        triangulation_covariance(old.Ps, M_W, sigmas[:, :n]),
    )  # fmt: skip
    spread = carried_point_covariance(change, M_L, triangulation_covariance(old.Ps, M_L, sigmas[:, :3]))
    found = move_points(change.H, M_L)
    pixels, deviations = reprojected(new.Ps, found, spread)
    return pixels, deviations, new.rig.pixels(L @ moved.T), change, (new, found, spread)


@pytest.mark.parametrize("family", FAMILIES)
@given(seed=seeds)
@settings(max_examples=8)
def test_without_noise_the_map_is_exact_from_as_few_points_as_it_needs(make_rig, family, seed):
    rng = np.random.default_rng(seed)
    pixels, _, truth, change, (new, found, _) = carried(family, make_rig, rng, 0.0, POINTS_NEEDED[family])
    assert np.abs(pixels - truth).max() < 1e-5
    assert (found @ new.Ps[0, 2] > 0).all()
    assert abs(abs(np.linalg.det(change.H)) - 1) < 1e-9


@pytest.mark.parametrize("family", FAMILIES)
def test_errors_of_carried_set_points_are_as_first_order_theory(make_rig, family):
    total = []
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        pixels, _, truth, _, (new, found, spread) = carried(family, make_rig, rng, SIGMA)
        # One marker of the tool: its three freedoms seen as four pixel coordinates of rank 3.
        J = projection_jacobian_many(new.Ps, found[:1])[:, 0].reshape(4, 4)
        S = J @ spread[0] @ J.T
        values, vectors = np.linalg.eigh(S)
        error = vectors[:, 1:].T @ (pixels - truth)[:, 0].ravel()
        total.append(float(np.sum(error**2 / values[1:])))
    assert chi2.ppf(0.0005, 180) < sum(total) < chi2.ppf(0.9995, 180)


def test_a_smaller_group_amplifies_noise_less(make_rig):
    largest = {}
    for family in FAMILIES:
        spreads = [carried(family, make_rig, np.random.default_rng(seed), SIGMA)[1].max() for seed in range(20)]
        largest[family] = float(np.median(spreads))
    assert largest["rigid"] <= largest["affine"] <= largest["projective"]
    assert largest["rigid"] < 5 * SIGMA


def test_the_group_follows_from_what_both_frames_know():
    P = np.zeros((2, 3, 4))
    bare, flat = AlignmentFrame(P), AlignmentFrame(P, np.eye(4))
    assert family_between(DRAWING, bare, False) == "projective"
    assert family_between(DRAWING, flat, False) == "affine"
    assert family_between(DRAWING, DRAWING, False) == "similar"
    assert family_between(DRAWING, DRAWING, True) == "rigid"


@pytest.mark.parametrize(
    ("family", "spots", "text"),
    [
        ("rigid", SPOTS[:2], "2 points are known and seen by two cameras .*; a rigid map needs at least 3"),
        ("rigid", np.outer([0.0, 1.0, 2.0, 3.0], [0.05, 0.02, 0.01]), "lie on one line"),
        ("affine", SPOTS[:3], "affine map needs at least 4"),
        ("affine", SPOTS * [1, 1, 0], "coplanar"),
        ("projective", SPOTS[:4], "at least 5"),
        ("projective", np.where(np.arange(5)[:, None] < 4, SPOTS * [1, 1, 0], SPOTS), r"\[0, 1, 2, 3\] are coplanar"),
    ],
)  # fmt: skip
def test_points_that_leave_the_map_open_are_refused_with_the_reason(make_rig, family, spots, text):
    cell = Cell(make_rig(), np.random.default_rng(5))
    X = ones(np.asarray(spots) + cell.middle)
    pixels = cell.rig.pixels(X)
    with pytest.raises(GeometryError, match=text):
        align(family, cell.frame(family), cell.frame(family), triangulate(cell.Ps, pixels), pixels, 0.01)


def test_points_seen_by_one_camera_only_still_help(make_rig):
    cell, rng = Cell(make_rig(), np.random.default_rng(6)), np.random.default_rng(7)
    X = ones(SPOTS + cell.middle)
    moved = X @ (np.eye(4) + 0.01 * np.eye(4)[:, [3, 0, 1, 2]] * [0, 0, 0, 1]).T
    before, after = cell.rig.pixels(X), cell.see(moved, rng, SIGMA)
    M = triangulate(cell.Ps, before)
    after[1, 4] = np.nan
    some = align("rigid", cell.frame("rigid"), cell.frame("rigid"), M, after, SIGMA)
    assert some.points == (0, 1, 2, 3, 4)
    assert some.degrees_of_freedom == 18 - 6
    after[0, 4] = np.nan
    fewer = align("rigid", cell.frame("rigid"), cell.frame("rigid"), M, after, SIGMA)
    assert fewer.points == (0, 1, 2, 3)
    assert np.trace(fewer.covariance) > np.trace(some.covariance)


def test_a_mirrored_body_is_no_rigid_motion_and_shows_in_its_residuals(make_rig):
    cell = Cell(make_rig(), np.random.default_rng(8))
    X = ones(SPOTS + cell.middle)
    mirrored = X * [-1, 1, 1, 1]
    pixels = cell.rig.pixels(mirrored)
    M = triangulate(cell.Ps, cell.rig.pixels(X))
    change = align("rigid", cell.frame("rigid"), cell.frame("rigid"), M, pixels)
    assert np.linalg.det(change.H) > 0
    assert point_residuals(cell.Ps, move_points(change.H, M), pixels).max() > 10


def test_a_similarity_of_points_is_proper_and_finds_the_scale():
    rng = np.random.default_rng(9)
    T = rigid(rng, 2.0, 1.0)
    moved = 3.0 * SPOTS @ T[:3, :3].T + T[:3, 3]
    found = similarity_from_points(SPOTS, moved, scaled=True)
    assert np.allclose(found[:3, :3], 3.0 * T[:3, :3], atol=1e-12)
    flat = SPOTS * [1, 1, 0]
    assert np.linalg.det(similarity_from_points(flat, flat * [-1, 1, 1], scaled=False)) > 0.99


def test_a_drawing_is_placed_by_rigid_motions_only():
    T = rigid(np.random.default_rng(10))
    assert np.allclose(drawn_points(SPOTS, T)[:, :3], SPOTS @ T[:3, :3].T + T[:3, 3])
    with pytest.raises(GeometryError, match="is a mirror image"):
        drawn_points(SPOTS, np.diag([-1.0, 1, 1, 1]))
    with pytest.raises(GeometryError, match="off a rigid motion by 3"):
        drawn_points(SPOTS, np.diag([2.0, 1, 1, 1]))
