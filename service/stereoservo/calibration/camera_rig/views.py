"""Views of a rigid marker body that is waved in front of a rig's cameras: the data of a calibration without an arm, and
its refusals.

Also the places at which a body waved by hand was held still, from the observations of all cameras over time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stereoservo.calibration.trial_data import CalibrationError, TrialCamera
from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo.ports.devices import CameraObservation

LEAST_MARKERS = 4
"""Least number of markers in a view: fewer determine no plane homography and no pose with redundancy."""
LEAST_STOPS = 3
"""Least number of places of the body: with fewer, a lens cannot be checked."""
STRAIGHT = 0.02
"""Second singular value of a layout, relative to the first, below which its markers count as collinear."""
FLAT = 1e-6
"""Third singular value of a layout, relative to the first, above which it is not planar."""


@dataclass(frozen=True)
class RigViews:
    """Raw ``pixels`` (c, s, m, 2) [px] of m markers at s places of the body, NaN if not seen, with
    ``sigmas`` (c, s, m) [px] per axis; all cameras observed it at the same instant. ``names`` (s,) of the places.

    ``layout`` (m, 3) [m]: positions of the markers on the body, a plane; None if unknown.
    """

    cameras: tuple[TrialCamera, ...]
    marker_ids: tuple[int, ...]
    names: tuple[str, ...]
    pixels: FloatArray
    sigmas: FloatArray
    layout: FloatArray | None = None

    @property
    def seen(self) -> BoolArray:
        """Mask (c, s, m) of the available pixels."""
        return np.asarray(np.isfinite(self.pixels).all(axis=-1))

    def select(self, stops: BoolArray, markers: BoolArray) -> RigViews:
        """The views at selected ``stops`` (s,) of selected ``markers`` (m,)."""
        return replace(
            self,
            marker_ids=tuple(i for i, keep in zip(self.marker_ids, markers, strict=True) if keep),
            names=tuple(n for n, keep in zip(self.names, stops, strict=True) if keep),
            pixels=self.pixels[:, stops][:, :, markers],
            sigmas=self.sigmas[:, stops][:, :, markers],
            layout=None if self.layout is None else self.layout[markers],
        )


def refused(code: str, cause: str, value: float, limit: float, unit: str, remedy: str) -> CalibrationError:
    """Error for refused data: what is wrong, its value and limit, and advice."""
    return CalibrationError(
        code,
        f"{cause}: {value:.3g}{unit}, the limit is {limit:.3g}{unit}. {remedy}",
        cause=cause,
        value=float(value),
        limit=float(limit),
        unit=unit.strip(),
        remedy=remedy,
    )


def usable_views(views: RigViews) -> RigViews:
    """The views without images of too few markers, places that no camera saw and markers that were seen only once.

    Raises CalibrationError: ``bad_data``, ``too_few_views``, ``camera_apart``, ``markers_on_a_line``.
    """
    c, s, m = views.sigmas.shape
    if views.pixels.shape != (c, s, m, 2) or len(views.cameras) != c or len(views.marker_ids) != m:
        raise CalibrationError("bad_data", f"pixels {views.pixels.shape} and sigmas {views.sigmas.shape} do not fit")
    if not (views.sigmas[views.seen] > 0.0).all():
        raise CalibrationError("bad_data", "sigmas must be positive where there is a pixel")
    rich = views.seen.sum(axis=2) >= LEAST_MARKERS
    views = replace(views, pixels=np.where(rich[:, :, None, None], views.pixels, np.nan))
    seen = views.seen
    views = views.select(np.asarray(seen.any(axis=(0, 2))), seen.sum(axis=(0, 1)) >= 2)
    _require_stops(views)
    _require_layout(views)
    return views


def _require_stops(views: RigViews) -> None:
    by_camera = np.asarray(views.seen.any(axis=2))
    for camera, mine in zip(views.cameras, by_camera, strict=True):
        if int(mine.sum()) < LEAST_STOPS:
            raise refused(
                "too_few_views",
                f"camera {camera.name!r} saw the body at too few places",
                int(mine.sum()),
                LEAST_STOPS,
                " places",
                "Wave it before every camera, at ten places or more, at least four markers in the picture",
            )
    reached = {0}
    for _ in views.cameras:
        reached |= {k for k in range(len(views.cameras)) if any((by_camera[k] & by_camera[j]).any() for j in reached)}
    unlinked = [camera.name for k, camera in enumerate(views.cameras) if k not in reached]
    if unlinked:
        raise refused(
            "camera_apart",
            f"camera(s) {', '.join(unlinked)} never saw the body together with {views.cameras[0].name!r} or a camera "
            "that did",
            0,
            1,
            " places in common",
            "Hold it where two cameras at a time see it; a chain of pairs will do",
        )


def _require_layout(views: RigViews) -> None:
    if views.layout is None:
        if len(views.cameras) < 2:
            raise refused(
                "one_camera",
                "one camera alone cannot find where the markers of the body are",
                1,
                2,
                " cameras",
                "State the layout (--board with --pitch, or --layout), or use a second camera",
            )
        return
    singular_values = np.linalg.svd(views.layout - views.layout.mean(axis=0), compute_uv=False)
    if not singular_values[1] > STRAIGHT * singular_values[0]:
        raise refused(
            "markers_on_a_line",
            "the markers lie on one line: width of the layout, relative to its length",
            float(singular_values[1] / singular_values[0]),
            STRAIGHT,
            "",
            "Use a board, or a body with markers beside that line",
        )
    if len(singular_values) > 2 and singular_values[2] > FLAT * singular_values[0]:
        raise refused(
            "layout_not_flat",
            "the stated layout is no plane: its depth, relative to its length",
            float(singular_values[2] / singular_values[0]),
            FLAT,
            "",
            "Leave the layout out, for a body in space is found with the cameras, and state one length (--length)",
        )


STILL_PX = 0.5
"""Median motion of the markers between two frames up to which a body counts as still [px]."""
GAP_S = 0.25
"""Largest time between consecutive frames."""
HELD_S = 0.3
"""Time for which the body must be still in all cameras that see it."""
ELSEWHERE_PX = 8.0
"""Median distance of the markers from the previous place, in some camera, from which a place is a new one."""


@dataclass(frozen=True)
class _StillInterval:
    """An interval [ns] in which one camera saw the body still, or (``empty``) did not see it."""

    began: int
    ended: int
    empty: bool


def still_places(cameras: Sequence[TrialCamera], seen: Mapping[str, Sequence[CameraObservation]]) -> RigViews:
    """The views of a body at the places at which it was held still for ``HELD_S`` in all cameras that saw it; each
    camera's pixels are the means over that time, with the detector's standard deviations.
    """
    ids = tuple(sorted({int(i) for one in seen.values() for o in one for i in o.ids}))
    times = [_intervals(seen[camera.name]) for camera in cameras]
    common = [(still.began, still.ended) for still in times[0]] if times else []
    for one in times[1:]:
        common = [
            (max(a, still.began), min(b, still.ended))
            for a, b in common
            for still in one
            if min(b, still.ended) - max(a, still.began) >= HELD_S * 1e9
        ]
    pixels: list[FloatArray] = []
    sigmas: list[FloatArray] = []
    names: list[str] = []
    start = min((one[0].t_shutter_ns for one in seen.values() if len(one)), default=0)
    for began, ended in common:
        if ended - began < HELD_S * 1e9:
            continue
        views = [_mean(seen[camera.name], began, ended, ids) for camera in cameras]
        place = np.array([pixel for pixel, _ in views])
        if not (np.isfinite(place).all(axis=2).sum(axis=1) >= LEAST_MARKERS).any():
            continue
        if pixels and not _elsewhere(place, pixels[-1]):
            continue
        pixels.append(place)
        sigmas.append(np.array([sigma for _, sigma in views]))
        names.append(f"{(began - start) * 1e-9:.1f} s")
    shape = (0, len(cameras), len(ids))
    stacked = np.array(pixels).reshape(-1, *shape[1:], 2).transpose(1, 0, 2, 3)
    return RigViews(
        tuple(cameras),
        ids,
        tuple(names),
        stacked,
        np.array(sigmas).reshape(-1, *shape[1:]).transpose(1, 0, 2),
    )


def _intervals(observations: Sequence[CameraObservation]) -> list[_StillInterval]:
    """Intervals in which one camera saw the body still, or did not see it."""
    found: list[_StillInterval] = []
    for before, after in pairwise(observations):
        if after.t_shutter_ns - before.t_shutter_ns > GAP_S * 1e9:
            continue
        few = max(len(before.ids), len(after.ids)) < LEAST_MARKERS
        if not few:
            common, a, b = np.intersect1d(before.ids, after.ids, return_indices=True)
            if len(common) < LEAST_MARKERS:
                continue
            if float(np.median(np.linalg.norm(after.pixels[b] - before.pixels[a], axis=1))) > STILL_PX:
                continue
        last = found[-1] if found else None
        if last is not None and last.ended == before.t_shutter_ns and last.empty == few:
            found[-1] = _StillInterval(last.began, after.t_shutter_ns, few)
        else:
            found.append(_StillInterval(before.t_shutter_ns, after.t_shutter_ns, few))
    return found


def _mean(
    observations: Sequence[CameraObservation], began: int, ended: int, ids: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Mean pixels (m, 2), NaN if a marker was in less than half of the frames, and the detector's sigmas (m,)."""
    inside = [o for o in observations if began <= o.t_shutter_ns <= ended]
    column = {marker: k for k, marker in enumerate(ids)}
    total, squares, count = np.zeros((len(ids), 2)), np.zeros(len(ids)), np.zeros(len(ids))
    for one in inside:
        at = [column[int(i)] for i in one.ids]
        total[at] += one.pixels
        squares[at] += 0.5 * np.trace(one.covariances, axis1=1, axis2=2)
        count[at] += 1
    often = count >= max(1.0, 0.5 * len(inside))
    safe = np.maximum(count, 1.0)
    pixels = np.where(often[:, None], total / safe[:, None], np.nan)
    return pixels, np.where(often, np.sqrt(np.maximum(squares / safe, 1e-12)), 1.0)


def _elsewhere(place: FloatArray, before: FloatArray) -> bool:
    """Whether the body (c, m, 2) is away from its previous place."""
    for first, second in zip(place, before, strict=True):
        common = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
        if common.any() and float(np.median(np.linalg.norm((first - second)[common], axis=1))) > ELSEWHERE_PX:
            return True
    seen = [np.asarray(np.isfinite(one).all(axis=2)).any(axis=1) for one in (place, before)]
    return bool((seen[0] != seen[1]).any())
