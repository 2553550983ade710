"""Homographies of space from any mix of point, line and plane constraints, linear and in pixels (thesis 2.6.2)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereoservo.geometry.cameras import project_many, triangulation_covariance
from stereoservo.geometry.homogeneous import GeometryError, unit_rows
from stereoservo.geometry.homography import unit_determinant
from stereoservo.geometry.lines import image_lines
from stereoservo.numerics.arrays import FloatArray

# -- subspaces -----------------------------------------------------------------------------------------------
# Linear subspaces of projective space as spans of points or meets of hyperplanes: basis, dual, dimension, incidence,
# relative position (thesis 2.5.3, 2.6.2).
#
# A k-dimensional subspace of ``P^n`` (N = n + 1) is either the span of K = k + 1 points, a multi-column, or the meet
# of L = n - k hyperplanes, a multi-row. Both are stored one vector a row: ``(K, N)`` and ``(L, N)``. The empty
# subspace has no point, the whole space no hyperplane: ``(0, N)``. Results are orthonormal rows.
#
# Ranks are numerical. A sine in R^N counts as zero below ``tolerance``; the default lies between rounding (1e-16) and
# the sines of exact input. Noisy input needs a tolerance of the size of its noise, in a frame where coordinates are of
# order one (`stereoservo.geometry.homogeneous.whitener`).


TOLERANCE = 1e-9
"""Default of the sine below which a vector counts as lying in a subspace."""

Position = Literal["disjoint", "intersecting", "first_in_second", "second_in_first", "coincident"]


def _vectors(vectors: FloatArray) -> FloatArray:
    vectors = np.atleast_2d(np.asarray(vectors, dtype=np.float64))
    if vectors.ndim != 2 or vectors.shape[1] < 2:
        raise GeometryError(
            "shape",
            f"a multi-column or multi-row has shape {vectors.shape}; (count, N) with N >= 2 is needed",
            shape=vectors.shape,
        )
    return unit_rows(vectors) if len(vectors) else vectors


def basis(vectors: FloatArray, tolerance: float = TOLERANCE) -> FloatArray:
    """Orthonormal rows ``(rank, N)`` that span the same subspace as the vectors ``(m, N)`` (2.62).

    The rank counts singular values of the unit vectors above ``tolerance`` times the largest. For points the result is
    their join; for hyperplanes, the multi-row of their meet. Raises GeometryError for vectors that are zero or not
    finite.
    """
    unit = _vectors(vectors)
    if not len(unit):
        return unit
    _, singular, rows = np.linalg.svd(unit, full_matrices=False)
    return np.ascontiguousarray(rows[singular > tolerance * singular[0]])


def dual(vectors: FloatArray, tolerance: float = TOLERANCE) -> FloatArray:
    """Multi-row ``(N - rank, N)`` of a multi-column ``(m, N)``, and vice versa: the complement (2.65-2.67)."""
    unit = _vectors(vectors)
    if not len(unit):
        return np.eye(unit.shape[1])
    _, singular, rows = np.linalg.svd(unit, full_matrices=len(unit) < unit.shape[1])
    return np.ascontiguousarray(rows[int((singular > tolerance * singular[0]).sum()) :])


def dimension(points: FloatArray, tolerance: float = TOLERANCE) -> int:
    """Dimension k of the span of points ``(m, N)``: 0 a point, 1 a line, 2 a plane; -1 the empty subspace."""
    return len(basis(points, tolerance)) - 1


def _same_space(*subspaces: FloatArray) -> None:
    sizes = [np.atleast_2d(points).shape[-1] for points in subspaces]
    if len(set(sizes)) != 1:
        raise GeometryError(
            "shape", f"vectors have {sizes} coordinates; subspaces of one space are needed", sizes=sizes
        )


def incidence_matrix(planes: FloatArray, points: FloatArray) -> FloatArray:
    """``C = [[a]] [[A]]`` (L, K) of a multi-row ``(L, N)`` and a multi-column ``(K, N)`` (2.74).

    Zero if the points' span lies in the meet of the planes (2.77). Its kernel gives the intersection (2.75).
    Vectors are not normalised; the entries are sines if they are orthonormal (`basis`).
    """
    _same_space(planes, points)
    C: FloatArray = np.atleast_2d(planes) @ np.atleast_2d(points).T
    return C


@dataclass(frozen=True)
class Relation:
    """Relative position of two subspaces.

    ``position``; ``dimension`` d of their intersection, -1 if disjoint; ``intersection`` a multi-column
    (d + 1, N); ``sines`` (min(K, L)) of the principal angles between the first and the second, ascending.
    """

    position: Position
    dimension: int
    intersection: FloatArray
    sines: FloatArray


def relation(first: FloatArray, second: FloatArray, tolerance: float = TOLERANCE) -> Relation:
    """Relation of the spans of points ``first`` (m, N) and ``second`` (m', N) (2.74-2.77, fig. 2.15).

    The singular values of the incidence matrix of the second's multi-row and the first's multi-column are the sines
    of principal angles, since both are orthonormal. With their rank, ``d = K - rank - 1``, and the subspaces are
    disjoint iff ``rank = K`` (errata; the thesis's ``L`` is wrong). Intersections of two lines in the plane and
    of a line with a plane in space always exist; two lines in space meet only if a sine vanishes.
    """
    _same_space(first, second)
    A, B = basis(first, tolerance), basis(second, tolerance)
    if not len(A) or not len(B):
        raise GeometryError("shape", "a subspace is empty; at least one point each is needed")
    C = incidence_matrix(dual(B), A)
    _, singular, kernel = np.linalg.svd(C, full_matrices=True)
    rank = int((singular > tolerance).sum())
    d = len(A) - rank - 1
    intersection = np.ascontiguousarray(kernel[rank:] @ A)
    position: Position
    if d < 0:
        position = "disjoint"
    elif d + 1 == len(A) == len(B):
        position = "coincident"
    elif d + 1 == len(A):
        position = "first_in_second"
    elif d + 1 == len(B):
        position = "second_in_first"
    else:
        position = "intersecting"
    return Relation(position, d, intersection, singular[::-1].copy())


def coincident(first: FloatArray, second: FloatArray, tolerance: float = TOLERANCE) -> bool:
    """Whether two spans coincide (2.77): equal dimensions and a vanishing incidence matrix."""
    return relation(first, second, tolerance).position == "coincident"


PRIMITIVES = {1: "point", 2: "line", 3: "plane"}

RANK = 1e-12
"""Rank tolerance inside one primitive; `Incidence` has already checked the independence of its vectors."""

UNDETERMINED = 0.3
"""Standard deviation of a homography, relative to its norm, above which it counts as undetermined."""
REGULAR = 5.0
"""Number of standard deviations by which a homography's determinant must differ from zero."""


@dataclass(frozen=True)
class Incidence:
    """A constraint on a homography: the span of ``first``, once moved, lies in the span of ``second`` (2.77).

    ``first`` (K, 4) points in the first frame, ``second`` (K', 4) points in the second one: 1 a point, 2 a line,
    3 a plane; K = K' makes them coincide. The reverse, K > K', is not linear in H: use it with the inverse map.
    ``images``: observations of ``second`` by c cameras, NaN where missing: pixels (c, 2) of a point, segments
    (c, 2, 2) of a line [px]. Points of ``first`` are then compared there: for a line pass the ends that matter.
    """

    first: FloatArray
    second: FloatArray
    images: FloatArray | None = None

    def __post_init__(self) -> None:
        for name in ("first", "second"):
            points = np.atleast_2d(np.asarray(getattr(self, name), dtype=np.float64))
            rank = len(basis(points)) if points.shape[1:] == (4,) and len(points) else 0
            if not 1 <= rank <= 3:
                raise GeometryError(
                    "shape",
                    f"the {name} primitive has shape {points.shape} and rank {rank}; "
                    "one to three independent points (k, 4) are needed",
                    shape=points.shape,
                    rank=rank,
                )
            object.__setattr__(self, name, points if rank == len(points) else basis(points))
        if len(self.first) > len(self.second):
            raise GeometryError(
                "shape",
                f"a {PRIMITIVES[len(self.first)]} cannot lie in a {PRIMITIVES[len(self.second)]}; "
                "constrain the inverse homography, or exchange the two",
                first=len(self.first),
                second=len(self.second),
            )
        if self.images is not None and (
            len(self.second) == 3 or np.shape(self.images)[1:] != ((2,) if len(self.second) == 1 else (2, 2))
        ):
            raise GeometryError(
                "shape",
                f"images of a {PRIMITIVES[len(self.second)]} have shape {np.shape(self.images)}; "
                "pixels (c, 2) of a point or segments (c, 2, 2) of a line are needed",
                images=np.shape(self.images),
            )

    @property
    def equations(self) -> int:
        """Number K (4 - K') of linear equations (2.84)."""
        return len(self.first) * (4 - len(self.second))

    def __str__(self) -> str:
        relation = "onto" if len(self.first) == len(self.second) else "in"
        return f"{PRIMITIVES[len(self.first)]} {relation} {PRIMITIVES[len(self.second)]}"


def homography_from_incidences(incidences: Sequence[Incidence], tolerance: float = TOLERANCE) -> FloatArray:
    """``H`` (4, 4) from any mix of point, line and plane constraints, linear (2.84-2.87); ``|det H| = 1``.

    Each element of ``[[b]] H [[A]] = 0`` is one equation; whitened as in `homography_from_points`, with which it
    agrees to rounding on points. The sign keeps the heights of points constrained to points; without such constraints
    the largest entry is positive. Five points, five lines or five planes in general position determine H, four lines
    with their two transversals do not. Raises GeometryError for fewer than 15 equations, and, stating the dimension
    of the remaining family, if they do not determine H (singular values below ``tolerance``).
    """
    equations = sum(incidence.equations for incidence in incidences)
    kinds = ", ".join(f"{count} x {kind}" for kind, count in Counter(map(str, incidences)).items()) or "nothing"
    if equations < 15:
        raise GeometryError(
            "too_few",
            f"{kinds}: {equations} equations; a 4x4 homography needs at least 15",
            equations=equations,
            kinds=kinds,
        )
    W_A = _span_whitener([incidence.first for incidence in incidences], "first")
    W_B = _span_whitener([incidence.second for incidence in incidences], "second")
    rows = []
    for incidence in incidences:
        planes = dual(incidence.second @ W_B.T, RANK)
        rows.append(np.einsum("li,kj->lkij", planes, basis(incidence.first @ W_A.T, RANK)).reshape(-1, 16))
    system = np.concatenate(rows)
    _, singular, v = np.linalg.svd(system, full_matrices=len(system) < 16)
    family = int((singular[:15] <= tolerance * singular[0]).sum())
    if family:
        raise GeometryError(
            "degenerate",
            f"{kinds}: they leave a family of homographies with {family} free parameter(s); add constraints, or "
            "move them into general position",
            family=family,
            singular=singular,
            kinds=kinds,
        )
    H = v[15].reshape(4, 4)
    determinant = abs(float(np.linalg.det(H)))
    if not determinant > 1e-12:
        raise GeometryError(
            "degenerate",
            f"{kinds}: only a singular map meets them (determinant {determinant:.3g} at unit norm)",
            determinant=determinant,
            kinds=kinds,
        )
    H = unit_determinant(np.linalg.solve(W_B, H) @ W_A, "the homography")
    pairs = [(i.first[0], i.second[0]) for i in incidences if len(i.second) == 1]
    agreement = sum(float(np.sign(second @ H @ first)) for first, second in pairs) or H.flat[np.abs(H).argmax()]
    return -H if agreement < 0 else H


def _span_whitener(subspaces: Sequence[FloatArray], name: str) -> FloatArray:
    """``W`` (4, 4) that gives the projectors onto the spans unit sum: `whitener` for subspaces of any dimension."""
    bases = np.concatenate([basis(points, RANK) for points in subspaces])
    values, vectors = np.linalg.eigh(bases.T @ bases / len(subspaces))
    if not values[0] > 1e-14 * values[3]:
        raise GeometryError(
            "degenerate", f"the {name} primitives lie in one plane; spatial ones are needed", moments=values
        )
    W: FloatArray = (vectors / np.sqrt(values)).T
    return W


def homography_refine_incidences(
    H: FloatArray, incidences: Sequence[Incidence], Ps: FloatArray, sigma: float = 1.0
) -> FloatArray:
    """``H`` (4, 4) that satisfies point, line and plane constraints with least squared pixel errors, ``|det H| = 1``.

    The renormalised form of (2.86): in cameras ``Ps`` (c, 3, 4) of the second frame, a moved point is compared to
    a target's pixels, or by its distance to a target line's segments, scaled by its own current depth. A target
    without ``images`` (all planes) is compared by the least displacement of the moved point's pixels, ``sigma``
    [px] each, that brings it into the target, to first order. ``H`` is the start (`homography_from_incidences`).

    Raises GeometryError for fewer than 15 pixel errors, ``images`` of a different number of cameras, and an
    undetermined H.
    """
    from scipy.optimize import least_squares  # here, so that a gateway that aligns nothing does without scipy

    Ps = np.asarray(Ps, dtype=np.float64)
    points = np.concatenate([incidence.first for incidence in incidences])
    targets = _PixelTargets.of(incidences, len(Ps))
    if targets.count < 15:
        raise GeometryError(
            "too_few", f"{targets.count} pixel errors; 15 parameters need as many", measured=targets.count
        )
    W = _span_whitener([incidence.first for incidence in incidences], "first")
    X = points @ W.T
    base = (np.asarray(H, dtype=np.float64) / np.linalg.norm(H) @ np.linalg.inv(W)).ravel()
    chart = np.linalg.svd(base[None])[2][1:].T * float(np.linalg.norm(base))

    def residuals(z: FloatArray) -> FloatArray:
        return targets.errors(X @ (base + chart @ z).reshape(4, 4).T, Ps, sigma)

    fit = least_squares(
        residuals, np.zeros(15), jac="3-point", method="lm", xtol=1e-13, ftol=1e-13, gtol=1e-13, max_nfev=5000
    )
    refined = (base + chart @ fit.x).reshape(4, 4)
    _refuse_undetermined(refined, chart, np.asarray(fit.jac, dtype=np.float64), sigma)
    return unit_determinant(refined @ W, "the refined homography")


def _refuse_undetermined(H: FloatArray, chart: FloatArray, jacobian: FloatArray, sigma: float) -> None:
    """Raise GeometryError if noise leaves ``H`` (4, 4), moved along ``chart`` (16, 15), undetermined or singular."""
    _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
    uncertainty = 1.0 / max(float(singular[14]), 1e-300)
    if uncertainty > UNDETERMINED:
        raise GeometryError(
            "degenerate",
            f"the images do not determine the homography: {sigma:.3g} px of noise leave it uncertain by "
            f"{uncertainty:.3g} of its norm, {UNDETERMINED} is allowed; add constraints in general position",
            uncertainty=uncertainty,
            singular=singular,
        )
    # Relative standard deviation of the determinant: tr(H⁻¹ dH) over the covariance of dH.
    covariance_px = np.linalg.inv(H).T.ravel() @ chart @ (rows.T / singular)
    deviations = 1.0 / max(float(np.linalg.norm(covariance_px)), 1e-300)
    if deviations < REGULAR:
        raise GeometryError(
            "degenerate",
            f"with {sigma:.3g} px of noise the homography is only {deviations:.3g} standard deviations from a singular "
            f"one, {REGULAR:g} are needed; the primitives are nearly in one plane",
            deviations=deviations,
            needed=REGULAR,
        )


@dataclass(frozen=True)
class _PixelTargets:
    """Targets of moved points as flat lists: index of the point, index of the camera, pixel."""

    pixel_at: tuple[list[int], list[int]]
    pixels: FloatArray
    line_at: tuple[list[int], list[int]]
    lines: FloatArray
    plane_at: dict[int, list[int]]
    planes: dict[int, FloatArray]

    @classmethod
    def of(cls, incidences: Sequence[Incidence], cameras: int) -> _PixelTargets:
        pixel_at: tuple[list[int], list[int]] = ([], [])
        line_at: tuple[list[int], list[int]] = ([], [])
        pixels: list[FloatArray] = []
        lines: list[FloatArray] = []
        plane_at: dict[int, list[int]] = {}
        planes: dict[int, list[FloatArray]] = {}
        index = 0
        for incidence in incidences:
            own = range(index, index + len(incidence.first))
            index += len(incidence.first)
            if incidence.images is None:
                rows = dual(incidence.second)
                plane_at.setdefault(len(rows), []).extend(own)
                planes.setdefault(len(rows), []).extend(rows for _ in own)
                continue
            images = np.asarray(incidence.images, dtype=np.float64)
            if len(images) != cameras:
                raise GeometryError(
                    "shape",
                    f"a target has images of {len(images)} cameras, not of {cameras}",
                    images=len(images),
                )
            at, values, targets = (
                (pixel_at, pixels, images) if len(incidence.second) == 1 else (line_at, lines, image_lines(images))
            )
            for c in np.flatnonzero(np.isfinite(targets).all(axis=1)).tolist():
                for k in own:
                    at[0].append(c)
                    at[1].append(k)
                    values.append(targets[c])
        return cls(
            pixel_at,
            np.reshape(pixels, (-1, 2)),
            line_at,
            np.reshape(lines, (-1, 3)),
            plane_at,
            {size: np.stack(rows) for size, rows in planes.items()},
        )

    @property
    def count(self) -> int:
        return self.pixels.size + len(self.lines) + sum(size * len(at) for size, at in self.plane_at.items())

    def errors(self, moved: FloatArray, Ps: FloatArray, sigma: float) -> FloatArray:
        """All errors in units of ``sigma`` [px] for moved points ``(p, 4)``."""
        u = project_many(Ps, moved)
        parts = [(u[self.pixel_at] - self.pixels).ravel() / sigma]
        on_line = u[self.line_at]
        parts.append(((on_line * self.lines[:, :2]).sum(axis=1) + self.lines[:, 2]) / sigma)
        for size, at in self.plane_at.items():
            X = moved[at] / (moved[at] @ Ps[0, 2])[:, None]
            B = self.planes[size]
            covariance_px = B @ triangulation_covariance(Ps, X, np.full((len(Ps), 1), sigma)) @ B.transpose(0, 2, 1)
            offset = np.einsum("nij,nj->ni", B, X)
            parts.append(np.linalg.solve(np.linalg.cholesky(covariance_px), offset[..., None]).ravel())
        return np.concatenate(parts)
