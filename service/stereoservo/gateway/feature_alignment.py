"""Alignment of a taught goal's workpiece by its edges and faces, and points beside them: the map since it was taught,
from mixed incidences, for `goal_transfer`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from stereoservo.gateway.marker_views import MarkerViews, observed_views
from stereoservo.gateway.observation_cache import MarkerObservations
from stereoservo.gateway.point_alignment import (
    DEVIATIONS,
    RESIDUAL_PX,
    TransferError,
    listed,
    require_still,
)
from stereoservo.geometry.alignment import AlignmentFrame, Family
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.incidence_alignment import MixedFeatures, align_incidences
from stereoservo.geometry.lines import line_points, triangulate_lines
from stereoservo.geometry.moved_cameras import FrameChange
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Feature, TaughtTarget
from stereoservo.numerics.arrays import BoolArray, FloatArray

SEGMENT_PX = 0.5
"""Of the ends of segments that a client states."""


@dataclass(frozen=True)
class CommonFeatures:
    """What gives a workpiece's motion: ids of ``points``, ``lines`` by two ids each, ``planes`` by their points."""

    points: tuple[int, ...]
    lines: tuple[tuple[int, int], ...]
    planes: tuple[tuple[int, ...], ...]

    @property
    def ids(self) -> list[int]:
        """All ids, sorted."""
        return sorted(
            {*self.points, *(m for line in self.lines for m in line), *(m for p in self.planes for m in p)}
        )

    @property
    def names(self) -> list[str]:
        """What to call points and lines, in their order."""
        return [f"point {marker}" for marker in self.points] + [f"edge {a}-{b}" for a, b in self.lines]

    def without(self, k: int) -> CommonFeatures:
        """These without the k-th of `names`."""
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
    """Map of the workpiece since the goal was taught, by the lines, planes and points that are asked for, and a
    sentence on its evidence. Raises TransferError.
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
    known = now.sigmas[np.isfinite(now.sigmas)]
    limit = max(RESIDUAL_PX, DEVIATIONS * float(known.max(initial=0.0)))
    worst = float(away.max(initial=0.0))
    if worst > limit:
        raise TransferError(
            f"{what}: {_counted(features)} have not moved as one body: {worst:.1f} px is left at "
            f"{features.names[int(away.argmax())]}, {limit:.1f} px is allowed{_outlier(fit, features, limit)}"
        )
    note = f"{what} by {_counted(features)} as a {family} map, which agree within {worst:.2f} px"
    if left_out:
        note += (
            f"; left out, since they lie in a plane through two cameras' centres: edges {listed(left_out)}"
        )
    return change, note


def fixed_line(feature: Feature, model: CellModel) -> Feature:
    """A line that is given by segments of its images, by two points in the model's frame. Raises TransferError."""
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
        points.pixels, points.sigmas, segments, sigmas, tuple(plane.pixels for plane in planes),
        tuple(plane.sigmas for plane in planes),
    )  # fmt: skip


def _require_seen(features: CommonFeatures, views: MarkerViews, when: str) -> None:
    """Raise TransferError for points and edges that fewer than two cameras see, and planes of too few points."""
    seen: BoolArray = np.asarray(np.isfinite(views.pixels).all(axis=2))

    def cameras(ids: Iterable[int]) -> list[str]:
        rows = [views.ids.index(marker) for marker in ids]
        return [name for name, there in zip(views.cameras, seen[:, rows], strict=True) if bool(there.all())]

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


def _outlier(
    fit: Callable[[CommonFeatures], tuple[FrameChange, FloatArray]], features: CommonFeatures, limit: float
) -> str:
    """The single point or edge without which the others agree; empty where there is none, or too few are left."""
    best = (limit, -1)
    for k in range(len(features.names)):
        try:
            _, away = fit(features.without(k))
        except GeometryError:
            continue  # too few are left: this one cannot be tested
        best = min(best, (float(away.max(initial=0.0)), k))
    if best[1] < 0:
        return ""
    return (
        f"; without {features.names[best[1]]} the others agree within {best[0]:.2f} px: it is another one, or was "
        "taken for another"
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
