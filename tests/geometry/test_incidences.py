import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import chi2

from oracles.frame_change import homography_refine
from stereoservo.geometry.cameras import project, project_many, triangulate
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.homography import homography_from_points
from stereoservo.geometry.incidences import (
    Incidence,
    homography_from_incidences,
    homography_refine_incidences,
)

seeds = st.integers(0, 2**32 - 1)
BOX = np.array([[x, y, z, 1.0] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


def frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


def as_unit(H):
    H = H / abs(np.linalg.det(H)) ** 0.25
    return H * np.sign(H.flat[np.abs(H).argmax()])


def spans(rng, count, size):
    """Random primitives (count, size, 4) of Euclidean points of height 1 in a box of side 2."""
    return np.concatenate([rng.uniform(-1, 1, (count, size, 3)), np.ones((count, size, 1))], axis=2)


def moved(rng, H, A, size=None):
    """The same span after H by other points of it, at other heights; more points make it larger."""
    B = A @ H.T
    if size is not None and size > len(B):
        B = np.vstack([B, rng.normal(size=(size - len(B), 4))])
    return frame(rng)[: len(B), : len(B)] @ B


MIXES = {
    "five points": [(1, 1, 5)],
    "five planes": [(3, 3, 5)],
    "five lines": [(2, 2, 5)],
    "three points and two lines": [(1, 1, 3), (2, 2, 2)],
    "two points, two planes, a line": [(1, 1, 2), (3, 3, 2), (2, 2, 1)],
    "fifteen points in planes": [(1, 3, 15)],
    "points on lines, lines in planes, points": [(1, 2, 3), (2, 3, 3), (1, 1, 1)],
    "everything": [(1, 1, 2), (2, 2, 2), (3, 3, 1), (1, 2, 2), (1, 3, 3), (2, 3, 1)],
}


@pytest.mark.parametrize("mix", MIXES.values(), ids=MIXES.keys())
@given(seed=seeds)
def test_linear_homography_from_any_mix_is_exact(mix, seed):
    rng = np.random.default_rng(seed)
    H = frame(rng)
    incidences = [Incidence(A, moved(rng, H, A, outer)) for size, outer, count in mix for A in spans(rng, count, size)]
    found = homography_from_incidences(incidences, tolerance=1e-12)
    assert np.allclose(as_unit(found), as_unit(H), atol=1e-5)


@given(seeds, st.integers(5, 12))
def test_on_points_it_is_the_existing_linear_homography(seed, n):
    rng = np.random.default_rng(seed)
    A = np.vstack([BOX[[0, 1, 2, 4, 7]], spans(rng, n, 1)[:, 0]])[:n]
    B = (A @ frame(rng).T) * rng.uniform(0.5, 2.0, (n, 1)) + 1e-3 * rng.normal(size=(n, 4))
    H = homography_from_incidences([Incidence(a, b) for a, b in zip(A, B, strict=True)])
    assert np.allclose(H, homography_from_points(A, B), atol=1e-9)


def test_the_sign_keeps_the_heights_of_points():
    rng = np.random.default_rng(1)
    A, H = np.vstack([BOX[[0, 1, 2, 4, 7]]]), frame(rng)
    for sign in (1.0, -1.0):
        B = sign * A @ H.T
        found = homography_from_incidences([Incidence(a, b) for a, b in zip(A, B, strict=True)])
        assert (((A @ found.T) * B).sum(axis=1) > 0).all()


def test_degenerate_mixes_are_refused_with_a_reason():
    rng = np.random.default_rng(2)
    H = frame(rng)
    lines = [Incidence(A, moved(rng, H, A)) for A in spans(rng, 5, 2)]
    with pytest.raises(GeometryError, match=r"4 x line onto line.* 1 free parameter") as error:
        homography_from_incidences(lines[:4])  # two transversals: 16 equations, but one freedom is left
    assert error.value.data["family"] == 1
    with pytest.raises(GeometryError, match="3 x line onto line: 12 equations") as error:
        homography_from_incidences(lines[:3])
    assert error.value.data["equations"] == 12
    with pytest.raises(GeometryError, match="nothing: 0 equations"):
        homography_from_incidences([])
    flat = spans(rng, 6, 1)
    flat[:, :, 2] = 0.3
    points = [Incidence(A, moved(rng, H, A)) for A in flat]
    with pytest.raises(GeometryError, match="first primitives lie in one plane"):
        homography_from_incidences(points)
    with pytest.raises(GeometryError, match="free parameter"):
        homography_from_incidences([*points, Incidence(BOX[7], H @ BOX[7])])  # all but one on a plane
    # Planes through one common point: the dual of points in a plane.
    pencil = [np.vstack([BOX[:1], A]) for A in spans(rng, 6, 2)]
    with pytest.raises(GeometryError, match="free parameter"):
        homography_from_incidences([Incidence(A, moved(rng, H, A)) for A in pencil])
    # Any points into one plane: the maps that crush space into it are many.
    plane = spans(rng, 1, 3)[0]
    with pytest.raises(GeometryError, match="second primitives lie in one plane"):
        homography_from_incidences([Incidence(A, plane) for A in spans(rng, 20, 1)])


def test_constraints_that_are_not_linear_or_no_primitive_are_refused():
    rng = np.random.default_rng(3)
    line, point = spans(rng, 1, 2)[0], spans(rng, 1, 1)[0]
    with pytest.raises(GeometryError, match="a line cannot lie in a point; constrain the inverse"):
        Incidence(line, point)
    with pytest.raises(GeometryError, match="rank 4"):
        Incidence(BOX, BOX)
    with pytest.raises(GeometryError, match="zero"):
        Incidence(np.zeros(4), point)
    with pytest.raises(GeometryError, match="images of a line"):
        Incidence(line, line, np.zeros((2, 2)))
    with pytest.raises(GeometryError, match="images of a plane"):
        Incidence(point, spans(rng, 1, 3)[0], np.zeros((2, 2)))


def test_in_pixels_points_reach_the_existing_minimum(rig):
    rng = np.random.default_rng(4)
    X = rig.points(rng, 9)
    M = X @ frame(rng).T
    pixels = project_many(rig.Ps, X) + rng.normal(0, 0.4, (2, 9, 2))
    pixels[1, 3] = np.nan
    start = homography_from_points(M, X)
    expected = homography_refine(start, rig.Ps, M, pixels)
    incidences = [Incidence(M[i], X[i], pixels[:, i]) for i in range(9)]
    found = homography_refine_incidences(homography_from_incidences(incidences), incidences, rig.Ps)
    assert np.allclose(as_unit(found), as_unit(expected), atol=1e-6)


def noisy_scene(rig, rng, sigma):
    """Points, lines and planes of the rig's scene with noise of ``sigma`` [px] on what each error compares.

    The noise of a line target is on its segments' ends where they are the moved points' own images, so that each
    distance has unit size; that of a plane target is on the moved point.
    """
    G = frame(rng)
    X, ends, on_planes = rig.points(rng, 4), rig.points(rng, 10).reshape(5, 2, 4), rig.points(rng, 12)
    incidences = []
    for point in X:
        incidences.append(
            Incidence(G @ point, point, project_many(rig.Ps, point[None])[:, 0] + rng.normal(0, sigma, (2, 2)))
        )
    for pair in ends:
        images = np.stack([project(P, pair) for P in rig.Ps]) + rng.normal(0, sigma, (2, 2, 2))
        incidences.append(Incidence(pair @ G.T, pair, images))
    for point in on_planes:
        plane = np.vstack([point, rig.points(rng, 2)])
        seen = triangulate(rig.Ps, project_many(rig.Ps, point[None]) + rng.normal(0, sigma, (2, 1, 2)))[0]
        incidences.append(Incidence(G @ seen, plane))
    return np.linalg.inv(G), incidences


def test_a_mix_reaches_the_noise_floor_in_pixels(rig):
    sigma, trials, total, linear_total = 0.3, 25, 0.0, 0.0
    for seed in range(trials):
        rng = np.random.default_rng(100 + seed)
        truth, incidences = noisy_scene(rig, rng, sigma)
        start = homography_from_incidences(incidences)
        H = homography_refine_incidences(start, incidences, rig.Ps, sigma)
        assert np.isclose(abs(np.linalg.det(H)), 1.0)
        total += cost(H, incidences, rig.Ps, sigma)
        linear_total += cost(start, incidences, rig.Ps, sigma)
        assert np.abs(as_unit(H) - as_unit(truth)).max() < 0.1
    # 4 points of four coordinates, 5 lines of four distances, 12 points in planes; 15 parameters.
    low, high = chi2.interval(0.9999, trials * (16 + 20 + 12 - 15))
    assert low < total < high
    assert linear_total > 1.5 * total


def cost(H, incidences, Ps, sigma):
    """Squared pixel errors by hand, one point after the other; planes by the exact nearest pixels."""
    total = 0.0
    for incidence in incidences:
        for first in incidence.first:
            m = Ps @ (H @ first)
            u = m[:, :2] / m[:, 2:]
            if incidence.images is None:
                a = np.linalg.svd(incidence.second)[2][3]
                free = np.linalg.svd(a[None])[2][1:].T  # points of the plane
                scale = free.T @ (H @ first)

                def displacement(y, free=free, u=u, scale=scale):
                    image = Ps @ (free @ (scale + np.linalg.norm(scale) * y))
                    return ((image[:, :2] / image[:, 2:] - u) / sigma).ravel()

                total += 2.0 * least_squares(displacement, np.zeros(3), method="lm").cost
            elif len(incidence.second) == 1:
                total += (((u - incidence.images) / sigma) ** 2).sum()
            else:
                for c in range(len(Ps)):
                    p, q = incidence.images[c]
                    along = (q - p) / np.linalg.norm(q - p)
                    offset = u[c] - p
                    total += ((along[0] * offset[1] - along[1] * offset[0]) / sigma) ** 2
    return total


def test_the_refined_mix_is_a_minimum(rig):
    rng = np.random.default_rng(5)
    _, incidences = noisy_scene(rig, rng, 0.5)
    H = homography_refine_incidences(homography_from_incidences(incidences), incidences, rig.Ps, 0.5)
    least = cost(H, incidences, rig.Ps, 0.5)
    for _ in range(20):
        step = rng.normal(size=(4, 4))
        neighbour = H + 1e-3 * np.linalg.norm(H) * step / np.linalg.norm(step)
        assert cost(neighbour, incidences, rig.Ps, 0.5) > least * (1 - 1e-4)


def test_refinement_refuses_too_few_pixels_other_cameras_and_freedoms(rig):
    rng = np.random.default_rng(6)
    truth, incidences = noisy_scene(rig, rng, 0.1)
    with pytest.raises(GeometryError, match="12 pixel errors"):
        homography_refine_incidences(truth, incidences[:3], rig.Ps)
    with pytest.raises(GeometryError, match="images of 2 cameras, not of 1"):
        homography_refine_incidences(truth, incidences, rig.Ps[:1])
    with pytest.raises(GeometryError, match="do not determine"):
        homography_refine_incidences(truth, incidences[4:8], rig.Ps)  # four lines


def test_points_that_are_coplanar_within_noise_are_refused(rig):
    rng = np.random.default_rng(7)
    G = frame(rng)
    for relief, refused in ((1e-4, True), (3e-2, False)):
        X = rig.points(rng, 9)
        X[:, 2] = X[:, 2].mean() + relief * rng.uniform(-1, 1, 9)
        pixels = rig.pixels(X) + rng.normal(0, 0.3, (2, 9, 2))
        incidences = [Incidence(G @ X[i], X[i], pixels[:, i]) for i in range(9)]
        start = np.linalg.inv(G)
        if not refused:
            homography_refine_incidences(start, incidences, rig.Ps, 0.3)
            continue
        with pytest.raises(GeometryError, match="nearly in one plane") as error:
            homography_refine_incidences(start, incidences, rig.Ps, 0.3)
        assert error.value.data["deviations"] < error.value.data["needed"]
