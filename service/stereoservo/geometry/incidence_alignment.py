"""Alignment of points, lines and planes, in any mix, with their current images: the map between two projective frames
of least image error, in the group that the frames' strata allow (thesis 2.5.3, 2.6.2).

A line is given by image segments, whose ends need not correspond between images or between the old and the current
views; a plane by points on it, others in the old views than in the current ones. The start is linear in all constraints
(2.84), or, if these are too few and the frames are metric, from the lines' directions; it is refined on the group as
for points alone (`alignment`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.alignment import (
    AlignmentFrame,
    Family,
    PointViews,
    algebra,
    descend,
    local_frame,
    point_residuals,
    start_map,
    upgrades,
)
from stereoservo.geometry.cameras import (
    project_many,
    projection_jacobian_many,
    triangulate,
    triangulation_covariance,
)
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.homography import unit_determinant
from stereoservo.geometry.incidences import (
    Incidence,
    homography_from_incidences,
    homography_refine_incidences,
)
from stereoservo.geometry.lines import image_lines, line_points, span_matrix, triangulate_lines
from stereoservo.geometry.moved_cameras import FrameChange
from stereoservo.numerics.arrays import FloatArray

EPIPOLAR = 4.0
"""Factor on the noise in the test for lines in an epipolar plane, so that the covariance of accepted ones is valid."""
STEP_PX = 1e-3
"""Step of the difference quotients of triangulated lines [px]."""
DIRECTIONS = 5
"""Most lines for which both orientations are tried."""
STARTS = 4
AMBIGUOUS = 25.0
"""Two maps whose squared errors [variances] differ by less than this explain the images equally well."""
APART = 0.02
"""Difference of maps of unit norm from which they count as two."""
FIRM = 25.0
"""Variance of a feature, relative to the median one, up to which the linear start uses it."""
EQUATIONS = 15
"""Number of equations that determine a homography of space."""


@dataclass(frozen=True, eq=False)
class MixedFeatures:
    """Features in ``c`` cameras of a frame: ``points`` (c, n, 2), ``segments`` (c, m, 2, 2) of lines and ``on_planes``,
    for each plane the points (c, k, 2) on it [px]; NaN where missing. ``sigmas`` (c, n), ``line_sigmas`` (c, m),
    ``plane_sigmas`` (c, k) [px].
    """

    points: FloatArray
    sigmas: FloatArray
    segments: FloatArray
    line_sigmas: FloatArray
    on_planes: tuple[FloatArray, ...] = ()
    plane_sigmas: tuple[FloatArray, ...] = ()


@dataclass(frozen=True)
class _Lines:
    """Line constraints: each old line as two points, ``A`` (m, 2, 4) with ``covariance`` (m, 8, 8), and its current
    image ``lines`` (c, m, 3), from ``segments`` (c, m, 2, 2) with noise ``sigmas`` (c, m) [px]; NaN where missing.
    """

    Ps: FloatArray
    A: FloatArray
    covariance: FloatArray
    lines: FloatArray
    segments: FloatArray
    sigmas: FloatArray

    def _moved(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moved points (m, 2, 4) and the derivatives (c, m, 2, 4) of their distances [px] from the lines by them."""
        moved = self.A @ T.T
        J = projection_jacobian_many(self.Ps, moved.reshape(-1, 4)).reshape(len(self.Ps), -1, 2, 2, 4)
        return moved, np.einsum("cmi,cmkij->cmkj", self.lines[..., :2], J)

    def distances(self, T: FloatArray) -> FloatArray:
        """Distances (c, m, 2) [px] of the moved points from the lines; NaN where missing."""
        moved, _ = self._moved(T)
        pixels = project_many(self.Ps, moved.reshape(-1, 4)).reshape(len(self.Ps), -1, 2, 2)
        away: FloatArray = np.einsum("cmi,cmki->cmk", self.lines[..., :2], pixels) + self.lines[..., 2][..., None]
        return away

    def whitening(self, T: FloatArray) -> FloatArray:
        """Whitening (m, 2c, 2c) of the distances: noise of the current ends and of the old line."""
        c = len(self.Ps)
        moved, J = self._moved(T)
        pixels = project_many(self.Ps, moved.reshape(-1, 4)).reshape(c, -1, 2, 2)
        along = self.segments[..., 1, :] - self.segments[..., 0, :]
        squared = (along**2).sum(axis=-1)
        s = ((pixels - self.segments[..., :1, :]) * along[..., None, :]).sum(axis=-1) / squared[..., None]
        shares = np.stack([1.0 - s, s], axis=-1)  # weights of the two ends at each point of the line
        whitening = np.zeros((self.A.shape[0], 2 * c, 2 * c))
        by_A = np.einsum("cmkj,ji->cmki", J, T)
        for m in range(self.A.shape[0]):
            seen = np.flatnonzero(np.isfinite(self.lines[:, m]).all(axis=1))
            rows = np.concatenate([[2 * k, 2 * k + 1] for k in seen])
            M = np.zeros((2 * len(seen), 8))
            own = np.zeros((2 * len(seen), 2 * len(seen)))
            for row, k in enumerate(seen):
                for end in range(2):
                    M[2 * row + end, 4 * end : 4 * end + 4] = by_A[k, m, end]
                block = slice(2 * row, 2 * row + 2)
                own[block, block] = self.sigmas[k, m] ** 2 * shares[k, m] @ shares[k, m].T
            root = np.linalg.cholesky(own + M @ self.covariance[m] @ M.T + 1e-12 * np.trace(own) * np.eye(len(own)))
            whitening[m][np.ix_(rows, rows)] = np.linalg.inv(root)
        return whitening

    def residuals(self, T: FloatArray, whitening: FloatArray) -> FloatArray:
        """Whitened distances (2 c m,), zero where missing."""
        away = np.nan_to_num(self.distances(T)).transpose(1, 0, 2).reshape(len(self.A), -1, 1)
        flat: FloatArray = (whitening @ away).ravel()
        return flat

    def jacobian(self, T: FloatArray, generators: FloatArray, whitening: FloatArray) -> FloatArray:
        """Derivatives (2 c m, k) of the residuals by x in ``exp(Σ x Ĝ) T`` at x = 0."""
        moved, J = self._moved(T)
        by_map = np.nan_to_num(np.einsum("cmkj,gji,mki->mckg", J, generators, moved))
        flat = by_map.reshape(len(self.A), -1, len(generators))
        slopes: FloatArray = (whitening @ flat).reshape(-1, len(generators))
        return slopes


@dataclass(frozen=True)
class _Planes:
    """Plane constraints: old points ``X`` (p, 4) with ``covariance`` (p, 4, 4), each with its current plane ``b``
    (p, 4) and ``plane_covariance`` (p, 4, 4); current points are scaled to depth 1 in the camera ``P`` (3, 4).
    """

    P: FloatArray
    X: FloatArray
    covariance: FloatArray
    b: FloatArray
    plane_covariance: FloatArray

    def _moved(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        moved = self.X @ T.T
        depth = moved @ self.P[2]
        return moved / depth[:, None], depth

    def whitening(self, T: FloatArray) -> FloatArray:
        """Inverse standard deviation (p,) of each point's distance from its plane."""
        moved, depth = self._moved(T)
        by_point = (self.b @ T) / depth[:, None]
        variance = np.einsum("pi,pij,pj->p", by_point, self.covariance, by_point)
        variance += np.einsum("pi,pij,pj->p", moved, self.plane_covariance, moved)
        deviations: FloatArray = 1.0 / np.sqrt(np.maximum(variance, 1e-300))
        return deviations

    def residuals(self, T: FloatArray, whitening: FloatArray) -> FloatArray:
        """Distances (p,) in standard deviations."""
        away: FloatArray = (self._moved(T)[0] * self.b).sum(axis=1) * whitening
        return away

    def jacobian(self, T: FloatArray, generators: FloatArray, whitening: FloatArray) -> FloatArray:
        """Derivatives (p, k) of the residuals by the map's parameters."""
        moved, _ = self._moved(T)
        steps = np.einsum("gij,pj->pgi", generators, moved)
        along = steps - (steps @ self.P[2])[..., None] * moved[:, None]
        slopes: FloatArray = np.einsum("pgi,pi->pg", along, self.b) * whitening[:, None]
        return slopes


@dataclass(frozen=True)
class _Mixed:
    """All constraints together, with the methods of `PointViews`."""

    parts: tuple[PointViews | _Lines | _Planes, ...]

    def whitening(self, T: FloatArray) -> tuple[FloatArray, ...]:
        return tuple(part.whitening(T) for part in self.parts)

    def residuals(self, T: FloatArray, whitening: tuple[FloatArray, ...]) -> FloatArray:
        if not np.isfinite(T).all():
            raise np.linalg.LinAlgError("the map has diverged")
        return np.concatenate([part.residuals(T, w) for part, w in zip(self.parts, whitening, strict=True)])

    def jacobian(self, T: FloatArray, generators: FloatArray, whitening: tuple[FloatArray, ...]) -> FloatArray:
        return np.concatenate([part.jacobian(T, generators, w) for part, w in zip(self.parts, whitening, strict=True)])


def line_end_points(Ps: FloatArray, segments: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two points (m, 2, 4), at depth 1, on each line of segments ``(c, m, 2, 2)`` [px], NaN where missing, and their
    covariance (m, 8, 8) for ends of noise ``sigmas`` (c, m) [px].

    They lie where the line crosses the planes through the ends in the first camera that sees it, normal to its image.
    Raises GeometryError for lines that fewer than two cameras see, and lines in an epipolar plane.
    """
    m = segments.shape[1]
    first = np.isfinite(segments).all(axis=(2, 3)).argmax(axis=0)
    own = segments[first, np.arange(m)]
    along = own[:, 1] - own[:, 0]
    planes = np.stack(
        [
            np.einsum("mji,mj->mi", Ps[first], np.column_stack([along, -(along * own[:, end]).sum(axis=1)]))
            for end in range(2)
        ],
        axis=1,
    )
    sigma = float(np.median(sigmas[np.isfinite(sigmas)])) if np.isfinite(sigmas).any() else 1.0

    def points(seen: FloatArray) -> FloatArray:
        L = triangulate_lines(Ps, seen, EPIPOLAR * sigma)
        found = np.einsum("mij,mkj->mki", span_matrix(L), planes)
        scaled: FloatArray = found / (found @ Ps[0, 2])[..., None]
        return scaled

    A = points(segments)
    covariance = np.zeros((m, 8, 8))
    for index in itertools.product(range(len(Ps)), range(2), range(2)):
        c, end, axis = index
        seen_here = np.isfinite(segments[c]).all(axis=(1, 2))
        if not seen_here.any():
            continue
        more, less = segments.copy(), segments.copy()
        more[c, :, end, axis] += STEP_PX
        less[c, :, end, axis] -= STEP_PX
        slope = ((points(more) - points(less)) / (2.0 * STEP_PX)).reshape(m, 8)
        slope = np.where(seen_here[:, None], slope * np.where(seen_here, sigmas[c], 0.0)[:, None], 0.0)
        covariance += slope[:, :, None] * slope[:, None, :]
    return A, covariance


def plane_through(points: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit plane (4,) of least squares through points ``(k, 4)`` of depth 1, and its covariance (4, 4).

    ``covariance`` (k, 4, 4). Raises GeometryError for fewer than three points, and points on one line.
    """
    if len(points) < 3:
        raise GeometryError("too_few", f"{len(points)} points of a plane; 3 are needed", points=len(points))
    weights = np.ones(len(points))
    for _ in range(3):
        values, vectors = np.linalg.eigh((points * weights[:, None]).T @ points)
        b = vectors[:, 0]
        variance = np.einsum("i,kij,j->k", b, covariance, b)
        weights = 1.0 / np.maximum(variance, 1e-300)
    if not values[1] > 9.0:
        raise GeometryError("degenerate", "the points of a plane lie on one line within their noise")
    inverse = (vectors[:, 1:] / values[1:]) @ vectors[:, 1:].T
    return b, inverse


def align_incidences(
    family: Family, old: AlignmentFrame, new: AlignmentFrame, then: MixedFeatures, now: MixedFeatures
) -> tuple[FrameChange, FloatArray, FloatArray]:
    """Map of the family from the features ``then`` of the old frame to those ``now`` of the new one; residuals in the
    new cameras: rms distances of the points (n,) and weighted largest distances of the lines (m,) [px].

    Features correspond by index. Raises GeometryError for features that are not determined by two cameras, too few
    features, and if these do not determine the map, or leave two.
    """
    mixed, incidences, firmness = _constraints(old, new, then, now)
    up_old, up_new = upgrades(family, old, new)
    sigmas = np.concatenate([now.sigmas.ravel(), now.line_sigmas.ravel()])
    noise_px = float(np.median(sigmas[np.isfinite(sigmas)])) if np.isfinite(sigmas).any() else 1.0
    starts = _starts(family, incidences, up_old, up_new, new, firmness, noise_px)
    local = local_frame(family, move_points(up_new, _present(incidences, starts[0]))) @ up_new
    generators = np.linalg.inv(local) @ algebra(family) @ local
    found: list[tuple[float, FloatArray]] = []
    for start in starts:
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                T = descend(start, generators, mixed)
                left = mixed.residuals(T, mixed.whitening(T))
        except np.linalg.LinAlgError:
            continue  # diverged from this start
        if np.isfinite(left).all() and _before_cameras(T, incidences, new):
            found.append((float(left @ left), T))
    if not found:
        raise GeometryError("degenerate", "no map brings the features before the cameras where they are seen")
    found.sort(key=lambda pair: pair[0])
    squares, T = found[0]
    for other_squares, other in found[1:]:
        if other_squares < squares + AMBIGUOUS and float(np.abs(other - T).max()) > APART * float(np.abs(T).max()):
            raise GeometryError(
                "degenerate",
                "two maps bring the features onto their images alike; add a line or a point that tells them apart",
            )
    J = mixed.jacobian(T, generators, mixed.whitening(T))
    _, singular, rows = np.linalg.svd(J, full_matrices=False)
    k = len(generators)
    if len(singular) < k or not singular[k - 1] > 1e-8 * singular[0]:
        raise GeometryError("degenerate", f"the features leave the {family} map open; add lines or points")
    chart = (generators @ T).reshape(k, 16).T @ (rows.T / singular)
    count = int(np.count_nonzero(np.abs(J).max(axis=1)))
    freedom = count - k
    rms = float(np.sqrt(squares / freedom)) if freedom > 0 else 0.0
    change = FrameChange(T, chart @ chart.T, tuple(range(then.points.shape[1])), rms, freedom)
    return change, *_fit_residuals(mixed, T)


def _fit_residuals(mixed: _Mixed, T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of the map ``T`` (4, 4): rms distances of points [px], and largest distances of lines, relative to
    their uncertainty beside the current noise [px]: a line that lay nearly in an epipolar plane then counts little.
    """
    points, lines = np.zeros(0), np.zeros(0)
    for part in mixed.parts:
        if isinstance(part, PointViews):
            seen = np.where(part.weights > 0.0, 1.0, np.nan)[..., None]
            points = point_residuals(part.Ps, part.M @ T.T, part.pixels * seen)
        elif isinstance(part, _Lines):
            whitened = part.residuals(T, part.whitening(T)).reshape(len(part.A), -1)
            lines = np.abs(whitened).max(axis=1) * part.sigmas.min(axis=0)
    return points, lines


def _constraints(
    old: AlignmentFrame, new: AlignmentFrame, then: MixedFeatures, now: MixedFeatures
) -> tuple[_Mixed, list[Incidence], FloatArray]:
    """All constraints in pixels, the same ones as incidences in space, and the variance of each old feature."""
    M = triangulate(old.Ps, then.points, then.sigmas, iterations=6)
    Y = triangulate(new.Ps, now.points, now.sigmas, iterations=6)
    lost = np.flatnonzero(~(np.isfinite(M).all(axis=1) & np.isfinite(Y).all(axis=1)))
    if len(lost):
        raise GeometryError(
            "too_few",
            f"point(s) {lost.tolist()} are not seen by two cameras, then and now",
            points=lost.tolist(),
        )
    pixels = np.nan_to_num(now.points)
    weights = np.where(np.isfinite(now.points).all(axis=2), 1.0 / now.sigmas, 0.0)
    parts: list[PointViews | _Lines | _Planes] = []
    traces: list[float] = []
    if len(M):
        own = covariance_of(old.Ps, M, then.sigmas)
        parts.append(PointViews(new.Ps, M, pixels, weights, own))
        traces += np.trace(own, axis1=1, axis2=2).tolist()
    incidences = [Incidence(a[None], b[None]) for a, b in zip(M, Y, strict=True)]
    if then.segments.shape[1]:
        A, covariance = line_end_points(old.Ps, then.segments, then.line_sigmas)
        sigma = float(np.median(now.line_sigmas[np.isfinite(now.line_sigmas)]))
        B = line_points(triangulate_lines(new.Ps, now.segments, EPIPOLAR * sigma))
        parts.append(_Lines(new.Ps, A, covariance, image_lines(now.segments), now.segments, now.line_sigmas))
        traces += (0.5 * np.trace(covariance, axis1=1, axis2=2)).tolist()
        incidences += [Incidence(a, b, now.segments[:, k]) for k, (a, b) in enumerate(zip(A, B, strict=True))]
    planes = [
        _on_plane(old, new, *views)
        for views in zip(then.on_planes, then.plane_sigmas, now.on_planes, now.plane_sigmas, strict=True)
    ]
    for X, own, b, b_covariance, Yp in planes:
        k = len(X)
        parts.append(_Planes(new.Ps[0], X, own, np.tile(b, (k, 1)), np.tile(b_covariance, (k, 1, 1))))
        traces += np.trace(own, axis1=1, axis2=2).tolist()
        incidences += [Incidence(x[None], Yp) for x in X]
    return _Mixed(tuple(parts)), incidences, np.array(traces)


def _on_plane(
    old: AlignmentFrame,
    new: AlignmentFrame,
    then_px: FloatArray,
    then_sigmas: FloatArray,
    now_px: FloatArray,
    now_sigmas: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Old points with covariances, the current plane with its covariance, and three points (3, 4) that span it."""
    X = triangulate(old.Ps, then_px, then_sigmas, iterations=6)
    Y = triangulate(new.Ps, now_px, now_sigmas, iterations=6)
    known_X, known_Y = np.isfinite(X).all(axis=1), np.isfinite(Y).all(axis=1)
    X, Y = X[known_X], Y[known_Y]
    b, covariance = plane_through(Y, covariance_of(new.Ps, Y, now_sigmas[:, known_Y]))
    if not len(X):
        raise GeometryError("too_few", "no point of a plane was seen by two cameras then")
    spanning = np.linalg.svd(b[None])[2][1:]
    return X, covariance_of(old.Ps, X, then_sigmas[:, known_X]), b, covariance, spanning


def covariance_of(Ps: FloatArray, M: FloatArray, sigmas: FloatArray) -> FloatArray:
    """Covariances (n, 4, 4) of triangulated points (n, 4); ``sigmas`` (c, n), infinite where a view is missing."""
    return triangulation_covariance(Ps, M, sigmas) if len(M) else np.zeros((0, 4, 4))


def _starts(
    family: Family,
    incidences: Sequence[Incidence],
    up_old: FloatArray,
    up_new: FloatArray,
    new: AlignmentFrame,
    firmness: FloatArray,
    noise_px: float,
) -> list[FloatArray]:
    """Initial maps, the most likely first. Raises GeometryError if the constraints are too few for any."""
    starts: list[FloatArray] = []
    refusal: GeometryError | None = None
    if sum(incidence.equations for incidence in incidences) >= EQUATIONS:
        try:
            H = homography_from_incidences(_firm(incidences, firmness))
            if family == "projective":
                H = homography_refine_incidences(H, incidences, new.Ps, noise_px)
            own = np.concatenate([incidence.first for incidence in incidences])
            starts.append(start_map(family, own, own @ H.T, up_old, up_new) if family != "projective" else H)
        except GeometryError as error:
            refusal = error
    if family in ("rigid", "similar"):
        starts += _metric_starts(incidences, up_old, up_new, scaled=family == "similar")
    if not starts:
        raise refusal or GeometryError(
            "too_few",
            f"{sum(incidence.equations for incidence in incidences)} equations of {len(incidences)} features; "
            + (
                f"a {family} map needs three edges that are not parallel, or two and a point"
                if family in ("rigid", "similar")
                else f"a {family} map needs at least {EQUATIONS}, four of each edge, three of each point"
            ),
        )
    return [_in_front(T, incidences, new) for T in starts]


def _firm(incidences: Sequence[Incidence], firmness: FloatArray) -> list[Incidence]:
    """Incidences whose old features are accurate: inaccurate ones would dominate the linear solution."""
    kept = [
        incidence for incidence, trace in zip(incidences, firmness, strict=True) if trace <= FIRM * np.median(firmness)
    ]
    return kept if sum(incidence.equations for incidence in kept) > EQUATIONS else list(incidences)


def _in_front(T: FloatArray, incidences: Sequence[Incidence], new: AlignmentFrame) -> FloatArray:
    """``T`` with the sign that puts the features in front of the first camera."""
    return T if float(np.sign(_present(incidences, T) @ new.Ps[0, 2]).sum()) >= 0.0 else -T


def _metric_starts(
    incidences: Sequence[Incidence], up_old: FloatArray, up_new: FloatArray, *, scaled: bool
) -> list[FloatArray]:
    """Rigid or similar maps (with |det| = 1) by directions of lines, normals of planes and points, best first."""

    def finite(points: FloatArray, up: FloatArray) -> FloatArray:
        X = points @ up.T
        found: FloatArray = X[:, :3] / X[:, 3:]
        return found

    old = [finite(incidence.first, up_old) for incidence in incidences]
    new = [finite(incidence.second, up_new) for incidence in incidences]
    lines = [k for k, incidence in enumerate(incidences) if len(incidence.first) == 2]
    known = [k for k, incidence in enumerate(incidences) if len(incidence.second) == 1]
    first = [_unit(old[k][1] - old[k][0]) for k in lines] + [
        _unit(old[b][0] - old[a][0]) for a, b in itertools.pairwise(known)
    ]
    second = [_unit(new[k][1] - new[k][0]) for k in lines] + [
        _unit(new[b][0] - new[a][0]) for a, b in itertools.pairwise(known)
    ]
    if len(first) < 2:
        return []
    free = min(len(lines), DIRECTIONS)
    found: list[tuple[float, FloatArray]] = []
    for signs in itertools.product((1.0, -1.0), repeat=free):
        used = list(range(free)) + list(range(len(lines), len(first)))
        flips = np.array([*signs, *[1.0] * (len(used) - free)])
        U, singular, Vt = np.linalg.svd(
            np.array([second[k] for k in used]).T @ (flips[:, None] * np.array([first[k] for k in used]))
        )
        if not singular[1] > 1e-3 * singular[0]:
            continue
        R = (U * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        solved = _shift(R, incidences, old, new, scaled=scaled)
        if solved is not None:
            found.append(solved)
    found.sort(key=lambda pair: pair[0])
    return [unit_determinant(np.linalg.inv(up_new) @ T @ up_old, "the map") for _, T in found[:STARTS]]


def _shift(
    R: FloatArray,
    incidences: Sequence[Incidence],
    old: list[FloatArray],
    new: list[FloatArray],
    *,
    scaled: bool,
) -> tuple[float, FloatArray] | None:
    """Residual and map with rotation ``R`` (3, 3), by linear least squares; None if it is not determined."""
    rows, rhs = [], []
    for incidence, a, b in zip(incidences, old, new, strict=True):
        across = np.eye(3)
        for direction in np.linalg.svd(b[1:] - b[0])[2][: len(incidence.second) - 1] if len(b) > 1 else ():
            across = across - np.outer(direction, direction)
        for x in a:
            rotated = R @ x
            rows.append(across @ np.column_stack([rotated if scaled else np.zeros(3), np.eye(3)]))
            rhs.append(across @ (b[0] if scaled else b[0] - rotated))
    A, y = np.concatenate(rows), np.concatenate(rhs)
    if not scaled:
        A = A[:, 1:]
    solution, _, rank, _ = np.linalg.lstsq(A, y, rcond=1e-6)
    if rank < A.shape[1] or (scaled and not solution[0] > 0.0):
        return None
    T = np.eye(4)
    T[:3, :3] = (solution[0] if scaled else 1.0) * R
    T[:3, 3] = solution[-3:]
    return float(((A @ solution - y) ** 2).sum()), T


def _unit(vector: FloatArray) -> FloatArray:
    unit: FloatArray = vector / max(float(np.linalg.norm(vector)), 1e-300)
    return unit


def _present(incidences: Sequence[Incidence], T: FloatArray) -> FloatArray:
    return np.concatenate([incidence.first for incidence in incidences]) @ T.T


def _before_cameras(T: FloatArray, incidences: Sequence[Incidence], new: AlignmentFrame) -> bool:
    """Whether each camera has all moved points on the same side."""
    depths = _present(incidences, T) @ new.Ps[:, 2].T
    return bool((np.sign(depths) == np.sign(depths[0])).all())
