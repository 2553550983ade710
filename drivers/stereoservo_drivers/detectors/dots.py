"""The dot detector: faces of seven dots, found anywhere, then tracked in windows placed by the core's
priors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from stereoservo.runtime.ports import (
    CameraObservation,
    DetectorDescription,
    DriverContext,
    DriverError,
    FloatArray,
    Frame,
    ImageArray,
    Prior,
)
from stereoservo_drivers.detectors import centroids, patterns, tracking
from stereoservo_drivers.detectors.blobs import find_spots
from stereoservo_drivers.detectors.centroids import (
    AREA,
    CXX,
    CXY,
    CYY,
    FIELDS,
    NOISE,
    measure_windows,
    scratch,
)
from stereoservo_drivers.detectors.patterns import basis_inverse, find_face
from stereoservo_drivers.detectors.plates import CORNERS, DEFAULT_BODY, FACES, DotFace
from stereoservo_drivers.detectors.tracking import SHAPE, expect, judge, settle_face

QUANTISATION = 1.0 / 12.0
"""Least noise variance [grey levels squared]: rounding to whole levels."""
SMALLEST_IMAGE = 32
SAME_SPOT_PX = 2.0
"""A spot this near to a dot that was tracked is that dot."""
Positive = Annotated[float, Meta(gt=0)]


class FaceOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A face of one's own: ids and positions of its dots [any unit], four corners clockwise first; radius
    in that unit.
    """

    name: str
    ids: tuple[int, ...]
    positions: tuple[tuple[float, float], ...]
    radius: Positive


class DotOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[camera.detector_options]`` of the detector ``dots``."""

    polarity: Literal["light", "dark"] = "light"
    """Dots lighter or darker than their plate."""
    faces: tuple[FaceOptions, ...] | None = None
    """Default: the two faces of the default marker body."""
    beside: tuple[str | FaceOptions, ...] = ()
    """Faces that stand beside the body, a workpiece's: names of printed ones or faces of one's own. No prior tells
    where they are, so that every image is searched for them.
    """
    image_size: tuple[int, int] | None = None
    """(width, height) [px] that frames must have; default: that of the first frame."""
    max_prior_age_s: Positive = 0.25
    min_contrast: Annotated[int, Meta(ge=5, le=250)] = 30
    """Least difference of a dot from its background [grey levels]."""
    min_dots: Annotated[int, Meta(ge=1)] = 4
    """Tracking that finds fewer dots gives way to acquisition."""
    acquire_dots: Annotated[int, Meta(ge=6, le=7)] = 6
    """Dots of a face that acquisition must find."""
    consistency_px: Positive = 0.3
    """How far a dot may lie from its face's homography [px]: print and lens errors, not noise."""
    gate_sigma: Annotated[float, Meta(ge=0)] = 0.0
    """Refuse dots so many standard deviations off their prior; 0: leave it to the core."""
    lopsided: Positive = 0.02
    """Largest odd harmonic of a whole dot's edge; a cut of 0.5 px makes 0.02, of 1 px 0.04."""
    floor_px: Annotated[float, Meta(ge=0)] = 0.001
    """Systematic standard deviation [px], part of every covariance: sampling of sharp edges and rounding to grey
    levels. The default is what residuals of calibrations have beyond the scatter of frames at 2 grey levels of
    noise (tests/sim/test_demo.py holds the pooled chi-square); noise-free images, whose rounding nothing
    dithers, have 0.0013.
    """
    max_spots: Annotated[int, Meta(ge=7, le=100)] = 48
    """Dot-like spots that acquisition looks at, the roundest first."""


@dataclass(frozen=True)
class _Pattern:
    """A face as the kernels want it, in units of half the distance of its corners."""

    ids: npt.NDArray[np.int64]
    positions: FloatArray
    radius: float
    bases: npt.NDArray[np.int64]
    inverses: FloatArray


_Found = tuple[FloatArray, npt.NDArray[np.bool_]]
"""Measurements (faces, 7, FIELDS) and which of them are accepted (faces, 7)."""


class DotDetector:
    """Dots of self-identifying faces with ids, centres and calibrated covariances. One thread at a time.

    With a fresh prior the dots are measured in windows; otherwise, or when fewer than ``min_dots`` are
    found, the whole image is searched and every face identified on its own. Faces ``beside`` the body, which the prior
    does not know, are searched for in the whole image. A face with fewer than four
    accepted dots is not reported: fewer cannot be checked. Ids are reported in ascending order. The same
    frame and prior give the same observation.

    Raises DriverError: ``option`` at construction; ``image_format``, ``image_size`` by :meth:`detect` for
    frames that are not what was announced. Content never raises.
    """

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        try:
            self.options = msgspec.convert(dict(options), DotOptions, strict=True)
        except msgspec.ValidationError as error:
            known = ", ".join(DotOptions.__struct_fields__)
            raise DriverError(
                "option",
                f"detector options of camera {context.camera!r}: {error}; known options: {known}",
                options=dict(options),
            ) from error
        self.camera = context.camera
        self._patterns = _patterns(self.options)
        self._dark = self.options.polarity == "dark"
        self._labels, self._stack = scratch()
        centroids.compile_kernels()
        patterns.compile_kernels()
        tracking.compile_kernels()
        self._size = self.options.image_size
        self._every_id = np.array([pattern.ids for pattern in self._patterns])
        self._positions = np.array([pattern.positions for pattern in self._patterns])
        self._radii = np.array([pattern.radius for pattern in self._patterns])
        self._ids = tuple(sorted(self._every_id.ravel().tolist()))
        self._place = {marker: k for k, marker in enumerate(self._every_id.ravel().tolist())}

    def describe(self) -> DetectorDescription:
        """The marker ids of all faces."""
        return DetectorDescription("dots", self._ids, self.options.floor_px)

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        """Dots of ``frame``. Raises DriverError (``image_format``, ``image_size``); never on content."""
        image = self._checked(frame)
        if prior is not None and self._fresh(frame, prior):
            found = self._track(image, prior, (frame.t_shutter_ns - prior.t_ns) * 1e-9)
            if found[1].sum() >= self.options.min_dots:
                return self._observation(frame, self._with_others(image, found, prior))
        return self._observation(frame, self._acquire(image, range(len(self._patterns))))

    def _fresh(self, frame: Frame, prior: Prior) -> bool:
        age_s = abs(frame.t_shutter_ns - prior.t_ns) * 1e-9
        return len(prior.ids) > 0 and age_s <= self.options.max_prior_age_s

    def _checked(self, frame: Frame) -> ImageArray:
        image = frame.image
        if not isinstance(image, np.ndarray) or image.ndim != 2 or image.dtype != np.uint8:
            shape, kind = getattr(image, "shape", None), getattr(image, "dtype", type(image).__name__)
            raise DriverError(
                "image_format",
                f"camera {self.camera!r}: image of shape {shape}, {kind}; expected (height, width) of uint8",
                shape=shape,
                dtype=str(kind),
            )
        height, width = image.shape
        if self._size is None and min(width, height) >= SMALLEST_IMAGE:
            self._size = (width, height)
        if (width, height) != self._size:
            expected = (
                f"{self._size[0]}x{self._size[1]}" if self._size else f"at least {SMALLEST_IMAGE} a side"
            )
            raise DriverError(
                "image_size",
                f"camera {self.camera!r}: image of {width}x{height} px; expected {expected}",
                size=(width, height),
                expected=self._size,
            )
        return np.ascontiguousarray(image)

    def _track(self, image: ImageArray, prior: Prior, dt_s: float) -> _Found:
        options = self.options
        faces, n = self._every_id.shape
        m = faces * n
        predicted, present = np.zeros((m, 2)), np.zeros(m, np.bool_)
        shapes, windows, least = np.zeros((m, SHAPE)), np.zeros((m, 4), np.int64), np.zeros(m, np.int64)
        dots, used, status = np.zeros((m, FIELDS)), np.zeros(m, np.bool_), np.zeros(m, np.int64)
        covariances = np.ascontiguousarray(prior.covariances, np.float64)
        ids = np.ascontiguousarray(prior.ids, np.int64)
        expect(
            self._every_id, self._positions, self._radii, ids, np.ascontiguousarray(prior.pixels, np.float64),
            np.ascontiguousarray(prior.velocities, np.float64), covariances, dt_s, predicted, present, shapes,
            windows, least,
        )  # fmt: skip
        measure_windows(
            image, self._dark, windows, predicted, options.min_contrast, least, self._labels, self._stack,
            dots, status
        )  # fmt: skip
        gates = np.zeros((m, 3))
        if options.gate_sigma:
            for k, marker in enumerate(ids.tolist()):
                if marker in self._place:
                    gates[self._place[marker]] = _gate(covariances[k], options.gate_sigma)
        judge(
            self._positions, self._radii, predicted, present, shapes, status, gates, options.lopsided,
            options.consistency_px, dots, used,
        )  # fmt: skip
        return dots.reshape(faces, n, FIELDS), used.reshape(faces, n)

    def _with_others(self, image: ImageArray, tracked: _Found, prior: Prior) -> _Found:
        """What was tracked, and the faces beside the body that the prior does not know, wherever they are."""
        unknown = ~np.isin(self._every_id, prior.ids).any(axis=1)
        unknown[: len(self._patterns) - len(self.options.beside)] = False
        if not unknown.any():
            return tracked
        dots, used = tracked
        found, seen = self._acquire(image, np.flatnonzero(unknown).tolist(), dots[used, :2])
        return np.where(unknown[:, None, None], found, dots), np.where(unknown[:, None], seen, used)

    def _acquire(self, image: ImageArray, faces: Iterable[int], taken: FloatArray | None = None) -> _Found:
        """The ``faces`` by index, among all spots but those ``taken`` (k, 2) [px]."""
        options = self.options
        spots = find_spots(
            image,
            self._dark,
            options.min_contrast,
            options.lopsided,
            options.max_spots,
            self._labels,
            self._stack,
        )
        if taken is not None and len(taken) and len(spots):
            away = np.hypot(*(spots[:, None, :2] - taken[None]).transpose(2, 0, 1)).min(axis=1)
            spots = spots[away > SAME_SPOT_PX]
        centres, areas = np.ascontiguousarray(spots[:, :2]), np.ascontiguousarray(spots[:, AREA])
        owners = np.full(self._every_id.shape, -1, np.int64)
        for f in faces:
            pattern, owner, count = self._patterns[f], owners[f], 0
            for bases in (slice(0, 1), slice(1, None)):
                # the first basis is the corners, the others stand in where one is hidden
                if count == 0 and len(spots) >= options.acquire_dots:
                    count = find_face(
                        pattern.positions, pattern.radius, centres, areas, pattern.bases[bases],
                        pattern.inverses[bases], options.acquire_dots, 1.5, options.consistency_px, owner,
                    )  # fmt: skip
        owners = _without_conflicts(owners)
        used = owners >= 0
        dots = np.zeros((*used.shape, FIELDS))
        dots[used] = spots[owners[used]]
        for f, pattern in enumerate(self._patterns):
            if used[f].any():
                settle_face(
                    pattern.positions,
                    pattern.radius,
                    dots[f],
                    used[f],
                    options.consistency_px,
                    options.acquire_dots,
                )
        return dots, used

    def _observation(self, frame: Frame, found: _Found) -> CameraObservation:
        dots, used = found
        ids, chosen = self._every_id[used], dots[used]
        order = np.argsort(ids)
        ids, chosen = ids[order], chosen[order]
        variance = noise_variances(chosen[:, NOISE])
        covariances = variance[:, None, None] * chosen[:, [CXX, CXY, CXY, CYY]].reshape(-1, 2, 2)
        covariances += self.options.floor_px**2 * np.eye(2)
        return CameraObservation(
            camera=frame.camera,
            seq=frame.seq,
            t_shutter_ns=frame.t_shutter_ns,
            t_received_ns=frame.t_received_ns,
            ids=ids,
            pixels=np.ascontiguousarray(chosen[:, :2]),
            covariances=covariances,
        )


def noise_variances(measured: FloatArray) -> FloatArray:
    """Noise variance of each dot's surroundings (k,) from the measured ones (k,), -1 where there is none
    [levels²].

    One picture has one noise: each gets the median over all dots, which is steadier (a dot's own: 15 %),
    unless its own surroundings are more than twice as restless.
    """
    known = measured[measured >= 0.0]
    if not len(known):
        return np.full(len(measured), 1.0 + QUANTISATION)
    common = max(float(np.median(known)), QUANTISATION)
    return np.where(measured > 2.0 * common, measured, common)


def _gate(covariance: FloatArray, sigma: float) -> tuple[float, float, float]:
    """Inverse of a covariance (2, 2), (xx, xy, yy), over ``sigma`` squared; all 0, no gate, where it is
    singular.
    """
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    scale = (xx * yy - xy * xy) * sigma**2
    return (yy / scale, -xy / scale, xx / scale) if scale > 0.0 else (0.0, 0.0, 0.0)


def _without_conflicts(owners: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Faces (f, 7) that share a spot: the one with more dots stays; of equals, none."""
    kept = owners.copy()
    for f, owner in enumerate(owners):
        mine = owner[owner >= 0]
        for g, other in enumerate(owners):
            if f != g and np.isin(mine, other).any() and (other >= 0).sum() >= len(mine):
                kept[f] = -1
    return kept


def _patterns(options: DotOptions) -> tuple[_Pattern, ...]:
    if options.faces is not None and not options.faces:
        raise DriverError("option", "faces: is empty; give at least one face, or leave it out", faces=[])
    known = [_printed(face) if isinstance(face, str) else face for face in options.beside]
    patterns = tuple(
        _pattern(face.name, face.ids, np.array(face.positions, dtype=float), face.radius)
        for face in (*(DEFAULT_BODY if options.faces is None else options.faces), *known)
    )
    ids = [int(i) for pattern in patterns for i in pattern.ids]
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise DriverError("option", f"faces: marker ids {twice} are used twice; ids must differ", ids=twice)
    return patterns


def _printed(name: str) -> DotFace:
    if name not in FACES:
        raise DriverError(
            "option", f"beside: no face {name!r} is printed; there are {', '.join(FACES)}", face=name
        )
    return FACES[name]


def _pattern(name: str, ids: Sequence[int], positions: FloatArray, radius: float) -> _Pattern:
    if len(ids) != 7 or positions.shape != (7, 2) or not np.isfinite(positions).all():
        raise DriverError(
            "option",
            f"face {name!r}: {len(ids)} ids and positions {positions.shape}; a face has 7 ids and 7 finite (x, y)",
            face=name,
        )
    corners = positions[list(CORNERS)]
    edges = np.roll(corners, -1, axis=0) - corners
    turns = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
    if not (turns > 0).all():
        raise DriverError(
            "option",
            f"face {name!r}: its first four dots are not convex and clockwise (x right, y down)",
            face=name,
        )
    unit = 0.5 * float(np.linalg.norm(edges, axis=1).mean())
    scaled = np.ascontiguousarray((positions - corners.mean(axis=0)) / unit)
    bases = np.array([CORNERS, *(_spare_basis(scaled, corner) for corner in CORNERS)], np.int64)
    return _Pattern(
        ids=np.array(ids, np.int64),
        positions=scaled,
        radius=radius / unit,
        bases=bases,
        inverses=np.array([basis_inverse(scaled[basis]) for basis in bases]),
    )


def _spare_basis(positions: FloatArray, missing: int) -> tuple[int, int, int, int]:
    """Four dots without ``missing``, convex and clockwise where possible, whose smallest triangle is
    largest.
    """
    points = [complex(x, y) for x, y in positions]

    def quality(rows: tuple[int, ...]) -> float:
        p = [points[i] for i in rows]
        triangles = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
        return min(((p[b] - p[a]).conjugate() * (p[c] - p[a])).imag for a, b, c in triangles)

    others = [i for i in range(len(positions)) if i != missing]
    best = max(permutations(others, 4), key=quality)
    return best[0], best[1], best[2], best[3]
