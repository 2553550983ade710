"""Alignment of the points of a taught or CAD goal with the markers observed now, or of its workpiece's edges and faces,
and reprojection of its set-points into the current cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from stereoservo.gateway.marker_views import MarkerViews, observed_views
from stereoservo.gateway.observation_cache import MarkerObservations
from stereoservo.gateway.validation import listed
from stereoservo.geometry.alignment import AlignmentFrame, Family, align, point_residuals, reprojected
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.incidence_alignment import MixedFeatures, align_incidences
from stereoservo.geometry.lines import line_points, triangulate_lines
from stereoservo.geometry.moved_cameras import FrameChange
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Feature, TaughtTarget
from stereoservo.numerics.arrays import BoolArray, FloatArray

Pixels = dict[str, dict[int, tuple[float, float]]]
Deviations = dict[str, dict[int, float]]
Fit = Callable[[BoolArray], tuple[FrameChange, FloatArray]]

RESIDUAL_PX = 1.5
"""Common markers that disagree by more than this, and by six standard deviations, have not moved rigidly."""
SIGMA_PX = 2.0
"""Set-points with at least this standard deviation [px] are refused."""
DEVIATIONS = 6.0
ALIKE = 3.0
"""Factor on the best explanation's residual, or on the standard deviation of the observations: explanations with
smaller residuals count as equally good.
"""
MIN_MARKERS = 3


class TransferError(Exception):
    """A taught goal cannot be transferred, or a CAD goal cannot be located; the text has cause and values."""


def require_still(observations: MarkerObservations, markers: list[int], what: str) -> None:
    """Raise TransferError naming the ``markers`` that move."""
    moving = sorted({m for points in observations.values() for m in markers if m in points and points[m].moves})
    if moving:
        raise TransferError(f"{what} {listed(moving)} move now; send the goal when they stand still")


def align_points(
    family: Family,
    old: AlignmentFrame,
    new: AlignmentFrame,
    points: FloatArray,
    covariance: FloatArray | None,
    now: MarkerViews,
    common: list[int],
    what: str,
) -> tuple[FrameChange, str]:
    """Map of points (n, 4) onto their observed markers; refused if they have not moved rigidly."""

    def fit(rows: BoolArray) -> tuple[FrameChange, FloatArray]:
        kept = np.flatnonzero(rows)
        own = None if covariance is None else covariance[kept]
        change = align(
            family, old, new, points[kept], now.pixels[:, kept], now.sigmas[:, kept], own, [common[k] for k in kept]
        )
        return change, point_residuals(new.Ps, move_points(change.H, points[kept]), now.pixels[:, kept])

    usable: BoolArray = np.asarray(np.isfinite(points).all(axis=1) & np.isfinite(now.pixels).all(axis=2).any(axis=0))
    try:
        change, residuals = fit(usable)
    except GeometryError as error:
        raise TransferError(f"{what}: {error}") from error
    worst = float(np.nanmax(residuals))
    sigma, limit = _allowed(now)
    ids = [common[k] for k in np.flatnonzero(usable)]
    if worst > limit:
        others = np.arange(usable.size)
        fits = [(f"marker {common[k]}", lambda k=k: fit(usable & (others != k))[1]) for k in np.flatnonzero(usable)]
        raise TransferError(
            f"{what}: markers {listed(ids)} have not moved as one body: {worst:.1f} px is left at marker "
            f"{ids[int(np.nanargmax(residuals))]}, {limit:.1f} px is allowed"
            f"{_outlier(fits, sigma, limit, 'has slipped, or is taken for another')}"
        )
    count = f"{len(ids)} markers ({listed(ids)})"
    return change, f"{what} by {count} as a {family} map, which agree within {worst:.2f} px"


def _allowed(now: MarkerViews) -> tuple[float, float]:
    """Largest standard deviation of the observations, and the largest accepted residual of a fit [px]."""
    sigma = float(now.sigmas[np.isfinite(now.sigmas)].max(initial=0.0))
    return sigma, max(RESIDUAL_PX, DEVIATIONS * sigma)


def _outlier(fits: Iterable[tuple[str, Callable[[], FloatArray]]], sigma: float, limit: float, why: str) -> str:
    """Text naming the single feature without which the fit's residual [px] is below ``limit``, and its reason ``why``;
    or all features that explain it as well as the best one. Empty if there is none, or too few features remain.
    """
    left: dict[str, float] = {}
    for name, fit in fits:
        try:
            left[name] = float(np.nanmax(fit(), initial=0.0))
        except GeometryError:
            continue  # too few remain, or they are coplanar: this one cannot be tested
    best = min(left.values(), default=limit)
    alike = sorted((px, name) for name, px in left.items() if px < min(limit, max(ALIKE * best, ALIKE * sigma)))
    if not alike:
        return ""
    if len(alike) == 1:
        return f"; without {alike[0][1]} the others agree within {best:.2f} px: it {why}"
    each = ", or without ".join(f"{name} (within {px:.2f} px)" for px, name in alike)
    return f"; without {each} the others agree: one of them {why}, and more features would tell which"


def reproject_set_points(
    model: CellModel, names: list[int], points: FloatArray, covariance: FloatArray, what: str
) -> tuple[Pixels, Deviations, str]:
    """Raw set-points of points (n, 4) by camera and marker, their standard deviations [px], and a description of their
    accuracy.

    A point outside of an image yields no set-point there. Raises TransferError for a point behind a camera, and if too
    few remain.
    """
    views = MarkerViews.empty(model, names)
    pixels, deviations = reprojected(views.Ps, points, covariance)
    depths = np.einsum("cj,nj->cn", views.Ps[:, 2], points) * views.front_signs()[:, None]
    if not (depths > 0).all():
        camera, k = (int(i) for i in np.argwhere(~(depths > 0))[0])
        raise TransferError(f"{what}, marker {names[k]} comes behind camera {views.cameras[camera]!r}")
    worst = float(deviations.max())
    if not worst <= SIGMA_PX:
        camera, k = (int(i) for i in np.argwhere(~(deviations <= SIGMA_PX))[0])
        raise TransferError(
            f"{what}, the set-point of marker {names[k]} in camera {views.cameras[camera]!r} would be known to "
            f"{deviations[camera, k]:.1f} px only, {SIGMA_PX:g} px is allowed: use more common markers, farther apart "
            "and nearer to the goal"
        )
    raw = views.raw(pixels)
    found: Pixels = {}
    known: Deviations = {}
    outside: list[str] = []
    for c, name in enumerate(views.cameras):
        width, height = views.sizes[c]
        for k, (marker, (u, v)) in enumerate(zip(names, raw[c], strict=True)):
            if -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5:
                found.setdefault(name, {})[marker] = (float(u), float(v))
                known.setdefault(name, {})[marker] = float(deviations[c, k])
            else:
                outside.append(f"{marker} in {name!r}")
    kept = {marker for seen in found.values() for marker in seen}
    if len(kept) < MIN_MARKERS:
        raise TransferError(f"{what}, markers leave the images ({', '.join(outside)}); 3 must stay in view")
    left = f"; outside of the image: {', '.join(outside)}" if outside else ""
    return found, known, f"set-points known to {worst:.2f} px{left}"


# -- edges and faces --

SEGMENT_PX = 0.5
"""Standard deviation [px] of the ends of segments that a client states."""


@dataclass(frozen=True)
class CommonFeatures:
    """Features that determine a workpiece's motion.

    ``points``: ids; ``lines``: two ids each; ``planes``: ids of their points.
    """

    points: tuple[int, ...]
    lines: tuple[tuple[int, int], ...]
    planes: tuple[tuple[int, ...], ...]

    @property
    def ids(self) -> list[int]:
        """All ids, sorted."""
        return sorted({*self.points, *(m for line in self.lines for m in line), *(m for p in self.planes for m in p)})

    @property
    def names(self) -> list[str]:
        """Names of points and lines, in their order."""
        return [f"point {marker}" for marker in self.points] + [f"edge {a}-{b}" for a, b in self.lines]

    def without(self, k: int) -> CommonFeatures:
        """These features without the k-th of `names`."""
        n = len(self.points)
        points = self.points[:k] + self.points[k + 1 :] if k < n else self.points
        lines = self.lines if k < n else self.lines[: k - n] + self.lines[k - n + 1 :]
        return CommonFeatures(points, lines, self.planes)


def align_features(
    requested: TaughtTarget,
    family: Family,
    old: AlignmentFrame,
    new: AlignmentFrame,
    taught: MarkerViews,
    observations: MarkerObservations,
    model: CellModel,
) -> tuple[FrameChange, str]:
    """Map of the workpiece since the goal was taught, by the requested lines, planes and points, and a sentence on its
    evidence. Raises TransferError.
    """
    features = CommonFeatures(requested.common, requested.lines, requested.planes)
    what = f"relative to the {requested.relative_to}"
    then, now = taught.subset(features.ids), observed_views(observations, model, features.ids)
    _require_seen(features, then, "when it was taught")
    _require_seen(features, now, "now")
    require_still(observations, features.ids, "the edges and points")

    def fit(chosen: CommonFeatures) -> tuple[FrameChange, FloatArray]:
        change, points, lines = align_incidences(family, old, new, _mixed(then, chosen), _mixed(now, chosen))
        return change, np.concatenate([points, lines])

    left_out: list[str] = []
    while True:
        try:
            change, away = fit(features)
            break
        except GeometryError as error:
            lost = sorted(error.data.get("lines", ()), reverse=True)
            if not lost or len(lost) == len(features.lines):
                raise TransferError(f"{what}, by {_counted(features)}: {error}") from error
            for k in lost:
                left_out.append("{}-{}".format(*features.lines[k]))
                features = features.without(len(features.points) + k)
    sigma, limit = _allowed(now)
    worst = float(away.max(initial=0.0))
    if worst > limit:
        fits = [(name, lambda k=k: fit(features.without(k))[1]) for k, name in enumerate(features.names)]
        raise TransferError(
            f"{what}: {_counted(features)} have not moved as one body: {worst:.1f} px is left at "
            f"{features.names[int(away.argmax())]}, {limit:.1f} px is allowed"
            f"{_outlier(fits, sigma, limit, 'is another one, or was taken for another')}"
        )
    note = f"{what} by {_counted(features)} as a {family} map, which agree within {worst:.2f} px"
    if left_out:
        note += f"; left out, since they lie in a plane through two cameras' centres: edges {listed(left_out)}"
    return change, note


def fixed_line(feature: Feature, model: CellModel) -> Feature:
    """A line given by segments in its images, as two points in the model's frame. Raises TransferError."""
    views = MarkerViews.empty(model, (0, 1))
    for camera, ends in feature.segments.items():
        views.add(camera, {k: (pixel, SEGMENT_PX) for k, pixel in enumerate(ends)})
    try:
        line = triangulate_lines(views.Ps, views.pixels[:, None], SEGMENT_PX)
    except GeometryError as error:
        raise TransferError(f"a fixed line by its segments: {error}") from error
    points = line_points(line)[0]
    return Feature(points=tuple((float(x), float(y), float(z), float(w)) for x, y, z, w in points))


def _mixed(views: MarkerViews, features: CommonFeatures) -> MixedFeatures:
    points = views.subset(features.points)
    ends = views.subset([marker for line in features.lines for marker in line])
    c, m = len(views.cameras), len(features.lines)
    segments = ends.pixels.reshape(c, m, 2, 2).copy()
    sigmas = ends.sigmas.reshape(c, m, 2).max(axis=2, initial=0.0)
    missing = ~np.isfinite(segments).all(axis=(2, 3))
    segments[missing], sigmas = np.nan, np.where(missing, np.inf, sigmas)
    planes = [views.subset(plane) for plane in features.planes]
    return MixedFeatures(
        points.pixels,
        points.sigmas,
        segments,
        sigmas,
        tuple(plane.pixels for plane in planes),
        tuple(plane.sigmas for plane in planes),
    )


def _require_seen(features: CommonFeatures, views: MarkerViews, when: str) -> None:
    """Raise TransferError for points and edges seen by fewer than two cameras, and planes of too few points."""
    seen: BoolArray = np.asarray(np.isfinite(views.pixels).all(axis=2))

    def cameras(ids: Iterable[int]) -> list[str]:
        rows = [views.ids.index(marker) for marker in ids]
        return [name for name, visible in zip(views.cameras, seen[:, rows], strict=True) if bool(visible.all())]

    named: list[tuple[str, Sequence[int]]] = [(f"point {marker}", (marker,)) for marker in features.points]
    named += [(f"edge {a}-{b}", (a, b)) for a, b in features.lines]
    for name, ids in named:
        by = cameras(ids)
        if len(by) < 2:
            raise TransferError(f"{name} is seen by {listed(by)} {when}; two cameras are needed")
    for plane in features.planes:
        found = [marker for marker in plane if len(cameras((marker,))) >= 2]
        needed = 3 if when == "now" else 1
        if len(found) < needed:
            raise TransferError(
                f"of the plane of {listed(plane)}, two cameras see {listed(found)} {when}; {needed} or more are needed"
            )


def _counted(features: CommonFeatures) -> str:
    parts = []
    if features.lines:
        parts.append(f"{len(features.lines)} edges ({listed(f'{a}-{b}' for a, b in features.lines)})")
    if features.points:
        parts.append(f"{len(features.points)} points ({listed(features.points)})")
    if features.planes:
        parts.append(f"{len(features.planes)} planes")
    return ", ".join(parts)
