"""Findings of ``stereoservo doctor`` on each camera from its detections and newest frame: sharpness and contrast of
markers, exposure, frame rate, noise, time between the cameras' shutters.

Pure functions from records to findings. The arm rests meanwhile, or nearly so. Pixels are raw ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.devices import CameraDescription, CameraObservation, CameraStatistics, ExaminationFinding, Frame

HELD_RATE = 0.95
"""Share of the stated rate below which a camera is reported as too slow."""
STEADY_MARKERS = 0.9
"""Share of frames that must show enough markers."""
WINDOW_PX = 10
"""Half the side of the window around a marker in which focus and contrast are judged."""
LOW_CONTRAST = 40.0
"""Grey levels between dark and bright below which noise of 2 levels costs a dot more than 0.03 px."""
WIDE_EDGE_PX = 2.5
"""Standard deviation of an edge's blur above which dots of 10 px are no longer measured well."""
SATURATED = 254
MUCH_SATURATED = 0.05
EDGE_PX = 20
"""Markers nearer to the border of the image than this leave the image with the next motion."""


@dataclass
class CameraRecord:
    """Data of one observed camera: observations ``seen``, newest last; the newest ``frame``."""

    description: CameraDescription
    seen: list[CameraObservation] = field(default_factory=list)
    frame: Frame | None = None
    flipped: int = 0
    """Markers that the detector finds in the mirror image of ``frame``; searched if it finds none in ``frame``."""
    error: str = ""
    statistics: CameraStatistics | None = None
    """Counts of the driver over ``watched_s`` [s], if it reports them."""
    watched_s: float = 0.0
    refused: dict[int, str] = field(default_factory=dict)
    """Reasons why the detector does not report markers in ``frame``, by id, if known; -1: no particular marker."""

    @property
    def name(self) -> str:
        """Name of the camera in the cell file."""
        return self.description.name

    @property
    def shutters_ns(self) -> npt.NDArray[np.int64]:
        """Shutter times (k,)."""
        return np.array([o.t_shutter_ns for o in self.seen], dtype=np.int64)


def examine_record(record: CameraRecord, min_markers: int) -> Iterator[ExaminationFinding]:
    """Findings on one camera by itself. ``min_markers``: number that calibration requires at every stop."""
    what = f"camera {record.name}"
    if record.error:
        yield ExaminationFinding(what, False, record.error)
        return
    if len(record.seen) < 2:
        yield ExaminationFinding(
            what,
            False,
            f"{len(record.seen)} frames while it was watched; at least 2 are needed",
            f"[camera.options] of {record.name!r}: source; is another program using the camera?",
        )
        return
    yield _rate(record)
    yield from _server_clock(record)
    yield _latency(record)
    yield _markers(record, min_markers)
    if record.refused:
        yield _refused(record)
    if record.frame is not None:
        yield from _picture_quality(record.name, record.frame.image, record.seen[-1])


def _server_clock(record: CameraRecord) -> list[ExaminationFinding]:
    """Finding on the clock of a camera's server, if its stamps are used."""
    counted = record.statistics
    if counted is None or counted.server_clock is None:
        return []
    known, told = counted.server_clock
    name = f"{record.name} server clock"
    if known:
        return [ExaminationFinding(name, True, told)]
    return [
        ExaminationFinding(
            name,
            None,
            f"its stamps are refused: {told}",
            "watch for longer (--seconds 20), keep the network free, let the server follow an NTP clock slowly; "
            "meanwhile the time of reception less latency_s counts",
        )
    ]


def _rate(record: CameraRecord) -> ExaminationFinding:
    stamps, asked = record.shutters_ns, record.description.rate_hz
    gaps_ms = np.diff(stamps) * 1e-6
    rate = 1e9 * (len(stamps) - 1) / float(stamps[-1] - stamps[0]) if stamps[-1] > stamps[0] else 0.0
    missing = int(record.seen[-1].seq - record.seen[0].seq) - (len(stamps) - 1)
    counted = record.statistics
    extra = ""
    if counted is not None:
        rate = counted.frames / record.watched_s if record.watched_s > 0 else rate
        extra = f", {counted.dropped} dropped, {counted.frozen} withheld as frozen, {counted.reconnects} reconnects"
        differing = [
            f"{name} asked {want:g}, is {got:g}"
            for name, (want, got) in counted.settings.items()
            if want is not None and got is not None and abs(want - got) > 1e-3 * max(abs(want), 1.0)
        ]
        extra += "".join(f", {summary}" for summary in differing)
    summary = (
        f"{rate:.1f} Hz of {asked:g}, frames {np.median(gaps_ms):.1f} ms apart, at most {gaps_ms.max():.1f}, "
        f"{max(missing, 0)} not looked at{extra}"
    )
    if rate >= HELD_RATE * asked:
        return ExaminationFinding(f"{record.name} rate", True, summary)
    delivered = rate + max(missing, 0) / (1e-3 * float(gaps_ms.sum())) if counted is None else rate
    if delivered >= HELD_RATE * asked:
        return ExaminationFinding(
            f"{record.name} rate",
            None,
            summary,
            f"the camera delivers {delivered:.0f} Hz, this computer keeps up with {rate:.1f}: end what else it does",
        )
    return ExaminationFinding(
        f"{record.name} rate",
        None,
        summary,
        f"more light for a shorter exposure, or rate_hz = {rate:.0f}, which is what it holds",
    )


def _latency(record: CameraRecord) -> ExaminationFinding:
    ms = np.array([(o.t_received_ns - o.t_shutter_ns) * 1e-6 for o in record.seen])
    summary = f"{np.median(ms):.1f} ms from shutter to reception by its driver's word, at most {ms.max():.1f}"
    if ms.max() <= 0.0:
        return ExaminationFinding(
            f"{record.name} latency",
            None,
            f"{summary}: none is stated",
            "latency_s of its options; `stereoservo status` tells it once the arm has moved",
        )
    return ExaminationFinding(f"{record.name} latency", True, summary)


def _markers(record: CameraRecord, min_markers: int) -> ExaminationFinding:
    name = f"{record.name} markers"
    counts = np.array([o.ids.size for o in record.seen])
    known = len(record.description.marker_ids)
    steady = float((counts >= min_markers).mean())
    summary = f"{np.median(counts):.0f} of {known} seen (median), at least {counts.min()}; {min_markers} are needed"
    if counts.max() == 0 and record.flipped:
        return ExaminationFinding(
            name,
            False,
            f"none is seen, but {record.flipped} in the mirror image",
            "print the plate again, not mirrored; or undo the camera's flip (option flip)",
        )
    if counts.max() == 0:
        return ExaminationFinding(
            name,
            False,
            f"none of {known} is seen; look at the picture",
            "the plate in view, light on it, lens cap off; polarity, dictionary, landmarks of detector_options",
        )
    if steady < STEADY_MARKERS:
        return ExaminationFinding(
            name,
            False,
            f"{summary}; enough in {100 * steady:.0f} % of the frames",
            "more light, a nearer or larger plate, less tilt; or calibration.min_markers",
        )
    sigma = float(np.median([np.sqrt(0.5 * np.trace(C)) for C in record.seen[-1].covariances]))
    return ExaminationFinding(name, True, f"{summary}; standard deviation {sigma:.3f} px{_scatter(record)}")


def _refused(record: CameraRecord) -> ExaminationFinding:
    """Reasons why markers are not reported, each with its markers."""
    by_reason: dict[str, list[str]] = {}
    for marker, reason in sorted(record.refused.items()):
        by_reason.setdefault(reason, []).append("" if marker < 0 else str(marker))
    told = [f"{', '.join(ids)}: {reason}".removeprefix(": ") for reason, ids in by_reason.items()]
    return ExaminationFinding(
        f"{record.name} refused",
        None,
        f"not reported in the newest picture: {'; '.join(told)}",
        "better light, the part nearer, its file; or the limits in detector_options",
    )


def _scatter(record: CameraRecord) -> str:
    """Finding on the scatter of the markers, with the arm at rest, against the detector's stated noise."""
    scatter_px = marker_scatter(record)
    return "" if scatter_px is None else f", scatter {scatter_px:.3f} px"


def marker_scatter(record: CameraRecord) -> float | None:
    """Standard deviation [px] of a marker's pixels over the frames, the median of the markers; None if the frames are
    few.
    """
    seen: dict[int, list[FloatArray]] = {}
    for observation in record.seen:
        for marker, pixel in zip(observation.ids.tolist(), observation.pixels, strict=True):
            seen.setdefault(marker, []).append(pixel)
    deviations = [np.var(np.array(pixels), axis=0, ddof=1).mean() for pixels in seen.values() if len(pixels) > 5]
    return float(np.sqrt(np.median(deviations))) if deviations else None


def contrast_and_blur(image: ImageArray, pixel: FloatArray) -> tuple[float, float, float] | None:
    """Contrast [grey levels], blur of the edges (standard deviation [px]) and share of saturated pixels at a marker.

    An edge of contrast c blurred by a Gaussian of s has the largest gradient ``c / (s sqrt(2 pi))``; the central
    difference widens s² by 1/3. None if the window is partly outside of the image.
    """
    u, v = np.rint(pixel).astype(int)
    window = image[v - WINDOW_PX : v + WINDOW_PX + 1, u - WINDOW_PX : u + WINDOW_PX + 1]
    if u < WINDOW_PX or v < WINDOW_PX or window.shape != (2 * WINDOW_PX + 1,) * 2:
        return None
    grey = window.astype(np.float64)
    dark, bright = np.percentile(grey, [5.0, 95.0])
    down, right = np.gradient(grey)
    steepest = float(np.percentile(np.hypot(down, right), 99.0))
    blur = (bright - dark) / (np.sqrt(2 * np.pi) * steepest) if steepest > 0 else np.inf
    return float(bright - dark), float(np.sqrt(max(blur**2 - 1 / 3, 0.0))), float((grey >= SATURATED).mean())


def _picture_quality(name: str, image: ImageArray, observation: CameraObservation) -> Iterator[ExaminationFinding]:
    found = [contrast_and_blur(image, pixel) for pixel in observation.pixels]
    measured = np.array([values for values in found if values is not None])
    if not len(measured):
        return
    contrast, blur, saturated = np.median(measured, axis=0)
    summary = f"contrast {contrast:.0f} grey levels (least {measured[:, 0].min():.0f})"
    if contrast < LOW_CONTRAST:
        yield ExaminationFinding(
            f"{name} contrast",
            None,
            f"{summary}; {LOW_CONTRAST:g} are wanted",
            "more light, longer exposure, matt print",
        )
    else:
        yield ExaminationFinding(f"{name} contrast", True, summary)
    if saturated > MUCH_SATURATED:
        yield ExaminationFinding(
            f"{name} exposure",
            None,
            f"{100 * saturated:.0f} % of the pixels around the markers are white to the limit: edges are cut",
            "shorter exposure, less gain",
        )
    summary = f"edges at the markers are blurred by {blur:.1f} px"
    sharp = bool(blur <= WIDE_EDGE_PX)
    remedy = "" if sharp else "focus the lens at the plate; shorter exposure where it moves"
    yield ExaminationFinding(f"{name} focus", True if sharp else None, summary, remedy)


def examine_skew(records: Sequence[CameraRecord]) -> Iterator[ExaminationFinding]:
    """Finding on the time between the cameras' shutters; not a fault, since each image is used at its own time."""
    shown = [record for record in records if len(record.seen) >= 2]
    for first, second in pairwise(shown):
        intervals = first.shutters_ns[:, None] - second.shutters_ns[None, :]
        nearest = intervals[np.arange(len(intervals)), np.abs(intervals).argmin(axis=1)] * 1e-6
        yield ExaminationFinding(
            f"skew {first.name}-{second.name}",
            True,
            f"{np.median(nearest):+.1f} ms (median; {np.abs(nearest).max():.1f} at most): used, each at its own time",
        )


def mean_observations(record: CameraRecord) -> tuple[npt.NDArray[np.int64], FloatArray, FloatArray]:
    """Markers seen in most frames: ids (k,), mean raw pixels (k, 2), standard deviations (k,) of one observation."""
    pixels: dict[int, list[FloatArray]] = {}
    variances: dict[int, list[float]] = {}
    for observation in record.seen:
        for marker, pixel, C in zip(observation.ids.tolist(), observation.pixels, observation.covariances, strict=True):
            pixels.setdefault(marker, []).append(pixel)
            variances.setdefault(marker, []).append(0.5 * float(np.trace(C)))
    kept = sorted(marker for marker, observations in pixels.items() if 2 * len(observations) >= len(record.seen))
    return (
        np.array(kept, dtype=np.int64),
        np.array([np.mean(pixels[marker], axis=0) for marker in kept]).reshape(-1, 2),
        np.sqrt(np.array([float(np.mean(variances[marker])) for marker in kept])),
    )


def near_border(record: CameraRecord) -> ExaminationFinding | None:
    """Markers that are close to the image border."""
    ids, pixels, _ = mean_observations(record)
    size = np.array([record.description.width, record.description.height])
    close = ids[((pixels < EDGE_PX) | (pixels > size - 1 - EDGE_PX)).any(axis=1)]
    if not close.size:
        return None
    return ExaminationFinding(
        f"{record.name} view",
        None,
        f"markers {close.tolist()} are within {EDGE_PX} px of the picture's border: they leave it with the next motion",
        "aim the camera so that the plate stands near the middle at calibration.base",
    )
