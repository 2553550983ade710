"""Alignment of the points of a taught or CAD goal with the markers observed now, and reprojection of its set-points
into the current cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from stereoservo.gateway.marker_views import MarkerViews
from stereoservo.gateway.observation_cache import MarkerObservations
from stereoservo.geometry.alignment import AlignmentFrame, Family, align, point_residuals, reprojected
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.moved_cameras import FrameChange
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import BoolArray, FloatArray

Pixels = dict[str, dict[int, tuple[float, float]]]
Deviations = dict[str, dict[int, float]]
Fit = Callable[[BoolArray], tuple[FrameChange, FloatArray]]

RESIDUAL_PX = 1.5
"""Common markers that disagree by more than this, and by six deviations, have not moved as one."""
SIGMA_PX = 2.0
"""Set-points that are known no better than this are refused."""
DEVIATIONS = 6.0
MIN_MARKERS = 3


class TransferError(Exception):
    """A taught goal cannot be transferred, or a CAD goal not be located; the text has cause and values."""


def require_still(observations: MarkerObservations, markers: list[int], what: str) -> None:
    """Raise TransferError naming those of ``markers`` that move."""
    moving = sorted(
        {m for points in observations.values() for m in markers if m in points and points[m].moves}
    )
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
    """Map of points (n, 4) onto their observed markers; refused where they have not moved rigidly."""

    def fit(rows: BoolArray) -> tuple[FrameChange, FloatArray]:
        kept = np.flatnonzero(rows)
        own = None if covariance is None else covariance[kept]
        change = align(
            family, old, new, points[kept], now.pixels[:, kept], now.sigmas[:, kept], own, [common[k] for k in kept]
        )  # fmt: skip
        return change, point_residuals(new.Ps, move_points(change.H, points[kept]), now.pixels[:, kept])

    usable: BoolArray = np.asarray(
        np.isfinite(points).all(axis=1) & np.isfinite(now.pixels).all(axis=2).any(axis=0)
    )
    try:
        change, residuals = fit(usable)
    except GeometryError as error:
        raise TransferError(f"{what}: {error}") from error
    worst = float(np.nanmax(residuals))
    limit = max(
        RESIDUAL_PX, DEVIATIONS * float(np.nanmax(np.where(np.isfinite(now.sigmas), now.sigmas, np.nan)))
    )
    ids = [common[k] for k in np.flatnonzero(usable)]
    if worst > limit:
        raise TransferError(
            f"{what}: markers {listed(ids)} have not moved as one body: {worst:.1f} px is left at marker "
            f"{ids[int(np.nanargmax(residuals))]}, {limit:.1f} px is allowed"
            f"{_outlier_marker(fit, usable, common, limit)}"
        )
    count = f"{len(ids)} markers ({listed(ids)})"
    return change, f"{what} by {count} as a {family} map, which agree within {worst:.2f} px"


def _outlier_marker(fit: Fit, usable: BoolArray, common: list[int], limit: float) -> str:
    """The single marker without which the others agree; empty where there is none, or too few are left."""
    best = (limit, -1)
    for k in np.flatnonzero(usable):
        without = usable.copy()
        without[k] = False
        try:
            _, residuals = fit(without)
        except GeometryError:
            continue  # too few are left, or they are coplanar: this one cannot be tested
        best = min(best, (float(np.nanmax(residuals)), int(k)))
    if best[1] < 0:
        return ""
    return (
        f"; without marker {common[best[1]]} the others agree within {best[0]:.2f} px: it has slipped, or is taken for "
        "another"
    )


def reproject_set_points(
    model: CellModel, names: list[int], points: FloatArray, covariance: FloatArray, what: str
) -> tuple[Pixels, Deviations, str]:
    """Raw set-points of points (n, 4) by camera and marker, their deviations [px], and a description of their
    accuracy.

    A point outside of an image is none there. Raises TransferError behind a camera, and where too few remain.
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


def listed(markers: Iterable[object]) -> str:
    """Markers as text, separated by commas."""
    return ", ".join(str(marker) for marker in markers) or "none"
