import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from oracles.projective_points import move_cameras, move_planes
from stereoservo.geometry.cameras import project
from stereoservo.geometry.homogeneous import GeometryError, plane_of_points
from stereoservo.geometry.lines import (
    crossing_angles,
    image_lines,
    interpretation_planes,
    line_covariance,
    line_in_planes,
    line_motion,
    line_planes,
    line_points,
    line_projection,
    line_residual,
    line_through_points,
    meet_matrix,
    nearest_line,
    project_lines,
    reciprocal_product,
    span_matrix,
    triangulate_lines,
)

seeds = st.integers(0, 2**32 - 1)


def frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


def unit(L):
    """One representative of a line, whatever its scale and sense."""
    L = L / np.linalg.norm(L, axis=-1, keepdims=True)
    largest = np.take_along_axis(L, np.abs(L).argmax(axis=-1)[..., None], axis=-1)
    return L * np.sign(largest)


def third_camera(rig):
    """The rig's two cameras and one above them, so that no line is in all epipolar planes."""
    above = rig.Ps[0] @ np.array([[1, 0, 0, 0.05], [0, 1, 0, 0.2], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return np.concatenate([rig.Ps, above[None]])


def scene_lines(rig, rng, n):
    """Ends (n, 2, 4) of segments that are not in epipolar planes: mostly vertical ones."""
    X = rig.points(rng, 2 * n).reshape(n, 2, 4)
    X[:, 1, 1] = X[:, 0, 1] + rng.choice([-1.0, 1.0], n) * rng.uniform(0.08, 0.15, n)
    return X


def segments_of(Ps, X):
    return np.stack([project(P, X.reshape(-1, 4)).reshape(len(X), 2, 2) for P in Ps])


def test_coordinates_are_direction_and_moment_in_a_euclidean_frame():
    rng = np.random.default_rng(1)
    x, d = rng.normal(size=(2, 3))
    L = line_through_points(np.append(x, 1.0), np.append(x + d, 1.0))
    assert np.allclose(L, np.concatenate([d, np.cross(x, d)]))
    normals, offsets = np.linalg.svd(d[None])[2][1:], None
    offsets = -normals @ x
    assert np.allclose(
        unit(line_in_planes(np.append(normals[0], offsets[0]), np.append(normals[1], offsets[1]))), unit(L)
    )


@given(seeds)
def test_two_points_two_planes_and_coordinates_are_one_line(seed):
    rng = np.random.default_rng(seed)
    A, B, C = rng.normal(size=(3, 4))
    L = line_through_points(A, B)
    assert abs(line_residual(L)) < 1e-13
    points, planes = line_points(L), line_planes(L)
    assert np.allclose(points @ points.T, np.eye(2))
    assert np.allclose(planes @ planes.T, np.eye(2))
    scale = np.linalg.norm(L)
    assert np.abs(planes @ points.T).max() < 1e-13
    assert np.abs(planes @ np.stack([A, B]).T).max() < 1e-12 * np.linalg.norm([A, B])
    assert np.allclose(line_through_points(*points), L / scale, atol=1e-13)
    assert np.allclose(line_in_planes(*planes), L / scale, atol=1e-13)
    a = rng.normal(size=4)
    assert np.allclose(span_matrix(L) @ a, A * (B @ a) - B * (A @ a), atol=1e-12)
    through = meet_matrix(L) @ C
    plane = plane_of_points(A, B, C)
    assert np.allclose(np.abs(through), np.abs(plane), atol=1e-12)
    assert np.isclose(abs(through @ plane), np.linalg.norm(plane) ** 2)


@given(seeds)
def test_reciprocal_product_is_the_determinant_and_vanishes_where_lines_meet(seed):
    rng = np.random.default_rng(seed)
    A, B, C, D = rng.normal(size=(4, 4))
    product = reciprocal_product(line_through_points(A, B), line_through_points(C, D))
    assert np.isclose(product, -np.linalg.det(np.column_stack([A, B, C, D])), atol=1e-12)
    meeting = line_through_points(rng.normal() * A + rng.normal() * B, D)
    assert abs(reciprocal_product(line_through_points(A, B), meeting)) < 1e-11


@given(seeds)
def test_lines_move_with_their_points_and_planes(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(2, 4))
    H = frame(rng)
    moved = line_motion(H) @ line_through_points(A, B)
    assert np.allclose(moved, line_through_points(H @ A, H @ B), atol=1e-11)
    planes = move_planes(H, line_planes(line_through_points(A, B)))
    assert np.allclose(unit(line_in_planes(*planes)), unit(moved), atol=1e-9)


@given(seeds, st.integers(1, 6))
def test_nearest_line_is_a_line_and_no_neighbour_is_nearer(seed, count):
    rng = np.random.default_rng(seed)
    raw = rng.normal(size=(count, 6))
    line = nearest_line(raw)
    assert np.abs(line_residual(line)).max() < 1e-12
    distance = np.linalg.norm(raw - line, axis=1)
    for step in (1e-3, 1e-2, 0.3):
        for _ in range(5):
            other = nearest_line(line + step * rng.normal(size=line.shape)) * rng.uniform(0.9, 1.1)
            assert (np.linalg.norm(raw - other, axis=1) >= distance - 1e-12).all()


def test_projection_of_a_line_is_the_line_of_the_projections(rig):
    rng = np.random.default_rng(2)
    X = scene_lines(rig, rng, 20)
    L = line_through_points(X[:, 0], X[:, 1])
    segments = segments_of(rig.Ps, X)
    lines = project_lines(rig.Ps, L)
    assert np.allclose(np.linalg.norm(lines[..., :2], axis=-1), 1.0)
    ends = np.concatenate([segments, np.ones((2, 20, 2, 1))], axis=3)
    assert np.abs(np.einsum("cnei,cni->cne", ends, lines)).max() < 1e-9
    assert np.allclose(unit(image_lines(segments)), unit(lines))
    raw = line_projection(rig.Ps[1]) @ L[0]
    assert np.allclose(raw, np.cross(rig.Ps[1] @ X[0, 0], rig.Ps[1] @ X[0, 1]))


@pytest.mark.parametrize("cameras", [2, 3])
@given(seed=seeds)
def test_reconstruction_is_exact_in_any_projective_frame(rig, cameras, seed):
    rng = np.random.default_rng(seed)
    H = frame(rng)
    X = scene_lines(rig, rng, 5)
    euclidean = third_camera(rig)[:cameras]
    Ps = move_cameras(H, euclidean) * rng.uniform(0.5, 2.0, (cameras, 1, 1)) * rng.choice([-1, 1], (cameras, 1, 1))
    segments = segments_of(euclidean, X)
    # The ends of one image are not those of the other: each slides along its line.
    slide = rng.uniform(-0.3, 0.3, (cameras, 5, 2, 1))
    segments = segments + slide * (segments[:, :, ::-1] - segments)
    truth = line_motion(H) @ line_through_points(X[:, 0], X[:, 1])[..., None]
    found = triangulate_lines(Ps, segments, sigma=1e-3)
    assert np.allclose(unit(found), unit(truth[..., 0]), atol=1e-8)


def test_the_interpretation_planes_hold_the_line_as_corrected(rig):
    """(2.72) with its erratum: the plane's row is lᵀP itself, not a dual of l."""
    X = scene_lines(rig, np.random.default_rng(3), 6)
    planes = interpretation_planes(rig.Ps, image_lines(segments_of(rig.Ps, X)))
    assert np.abs(np.einsum("cnj,nej->cne", planes, X)).max() < 1e-9


def test_three_cameras_reach_the_noise_floor_and_report_it(rig):
    rng = np.random.default_rng(4)
    sigma, n = 0.2, 400
    H = frame(rng)
    X = scene_lines(rig, rng, n)
    Ps = move_cameras(H, third_camera(rig))
    clean = segments_of(third_camera(rig), X)
    measured = clean + rng.normal(0, sigma, clean.shape)
    found = triangulate_lines(Ps, measured, sigma)
    lines = project_lines(Ps, found)
    ends = np.concatenate([measured, np.ones((3, n, 2, 1))], axis=3)
    total = (np.einsum("cnei,cni->cne", ends, lines) ** 2).sum() / sigma**2
    low, high = chi2.interval(0.9999, n * (6 - 4))  # six distances less the line's four freedoms
    assert low < total < high

    truth = unit((line_motion(H) @ line_through_points(X[:, 0], X[:, 1])[..., None])[..., 0])
    error = found * np.sign((found * truth).sum(axis=1))[:, None] - truth
    covariance = line_covariance(Ps, truth, clean, sigma)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.pinv(covariance, rcond=1e-9, hermitian=True), error)
    low, high = chi2.interval(0.9999, 4 * n)
    assert low < squared.sum() < high


def test_a_view_that_is_missing_is_left_out(rig):
    rng = np.random.default_rng(5)
    X = scene_lines(rig, rng, 4)
    Ps = third_camera(rig)
    segments = segments_of(Ps, X)
    segments[1, 2] = np.nan
    found = triangulate_lines(Ps, segments, sigma=1e-3)
    assert np.allclose(unit(found), unit(line_through_points(X[:, 0], X[:, 1])), atol=1e-9)
    segments[0, 2] = np.nan
    with pytest.raises(GeometryError, match=r"line\(s\) \[2\] are seen by fewer than two") as error:
        triangulate_lines(Ps, segments)
    assert error.value.data["views"] == [1]


def test_a_line_in_an_epipolar_plane_is_refused_with_its_angle(rig):
    rng = np.random.default_rng(6)
    X = scene_lines(rig, rng, 3)
    centre = np.append(-rig.R.T @ rig.t, 1.0)
    X[1, 1] = X[1, 0] + 0.3 * centre - 0.3 * np.array([0, 0, 0, 1.0])  # along the baseline: parallel to it
    Ps = move_cameras(frame(rng), rig.Ps)
    clean = segments_of(rig.Ps, X)
    angles = crossing_angles(Ps, clean)
    assert angles[0, 1, 1] < 1e-9
    assert angles[1, 0, 1] < 1e-9
    assert np.isnan(angles[0, 0]).all()
    assert angles[0, 1, [0, 2]].min() > np.deg2rad(20)
    for noise in (0.0, 0.3):
        with pytest.raises(GeometryError, match=r"line\(s\) \[1\] lie in an epipolar plane") as error:
            triangulate_lines(Ps, clean + rng.normal(0, noise, clean.shape), sigma=0.3)
        assert error.value.code == "degenerate"
        assert error.value.data["angles_rad"][0] < error.value.data["needed_rad"][0]
    third = third_camera(rig)
    found = triangulate_lines(third, segments_of(third, X), sigma=0.3)  # another camera above tells it
    assert np.allclose(unit(found), unit(line_through_points(X[:, 0], X[:, 1])), atol=1e-9)


def test_the_crossing_angle_scales_the_error_of_the_line(rig):
    """What the refusal rests on: tilting the segment towards the epipolar line by 1/k costs k in depth."""
    rng = np.random.default_rng(7)
    middle = rig.points(rng, 1)[0]
    sizes = []
    angles = np.deg2rad([60.0, 6.0])
    for angle in angles:
        step = 0.1 * np.array([np.cos(angle), np.sin(angle), 0.0, 0.0])
        X = np.stack([middle - step, middle + step])[None]
        covariance = line_covariance(rig.Ps, line_through_points(X[:, 0], X[:, 1]), segments_of(rig.Ps, X), sigma=0.1)
        sizes.append(np.sqrt(np.trace(covariance[0])))
    assert np.isclose(sizes[1] / sizes[0], np.sin(angles[0]) / np.sin(angles[1]), rtol=0.35)


def test_what_is_no_line_is_refused():
    with pytest.raises(GeometryError, match="no line") as error:
        line_points(np.array([1.0, 0, 0, 1.0, 0, 0]))
    assert np.isclose(error.value.data["residual"], 1.0)
    with pytest.raises(GeometryError, match="zero"):
        line_planes(np.zeros(6))
    with pytest.raises(GeometryError, match=r"\(\.\.\., 6\)"):
        line_points(np.ones(4))
    with pytest.raises(GeometryError, match="nearest"):
        nearest_line(np.array([1.0, 0, 0, 1.0, 0, 0]))
    with pytest.raises(GeometryError, match="do not fit"):
        triangulate_lines(np.zeros((2, 3, 4)), np.zeros((3, 1, 2, 2)))
