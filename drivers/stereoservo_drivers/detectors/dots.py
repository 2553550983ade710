"""Detector of dot faces (seven dots each): acquisition in the whole image, then tracking in windows at the core's
priors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from stereoservo.numerics.arrays import BoolArray, FloatArray, ImageArray, IntArray
from stereoservo.numerics.compilation import kernel, plain
from stereoservo.ports.devices import CameraObservation, DetectorDescription, DriverContext, DriverError, Frame, Prior
from stereoservo.ports.dot_plates import CORNERS, DEFAULT_BODY, FACES, DotFace
from stereoservo_drivers.detectors import acquisition, centroids, patterns
from stereoservo_drivers.detectors.acquisition import Expectation, find_spots
from stereoservo_drivers.detectors.centroids import DotWindows, measure_windows
from stereoservo_drivers.detectors.components import (
    AREA,
    CONTRAST,
    CXX,
    CXY,
    CYY,
    FIELDS,
    NOISE,
    OK,
    Picture,
    Scratch,
    scratch,
)
from stereoservo_drivers.detectors.face_fit import (
    FEW_TOLERANCE,
    SHAPE,
    THINNEST,
    agree_with_prior,
    median,
    settle_face,
    whole,
)
from stereoservo_drivers.detectors.homographies import fit_homography, image_of_circle
from stereoservo_drivers.detectors.kernel_types import (
    BOOL,
    FLOAT,
    IMAGE,
    INT,
    SCRATCH,
    compile_for,
    fields,
    given,
    written,
)
from stereoservo_drivers.detectors.patterns import SearchedFaces, basis_inverse
from stereoservo_drivers.frame_images import sized_image

SAME_SPOT_PX = 2.0
"""A spot this near to a tracked dot is the same dot."""


class DotOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[camera.detector_options]`` of the detector ``dots``."""

    polarity: Literal["light", "dark"] = "light"
    """Dots lighter or darker than their plate."""
    faces: tuple[FaceOptions, ...] | None = None
    """Default: the two faces of the default marker body."""
    beside: tuple[str | FaceOptions, ...] = ()
    """Faces besides the body, such as a workpiece's: names of printed ones or custom faces. No prior contains their
    positions, so that every image is searched for them.
    """
    image_size: tuple[int, int] | None = None
    """(width, height) [px] that frames must have; default: that of the first frame."""
    max_prior_age_s: Positive = 0.25
    min_contrast: Annotated[int, Meta(ge=5, le=250)] = 30
    """Least difference of a dot from its background [grey levels]."""
    min_dots: Annotated[int, Meta(ge=1)] = 4
    """Number of found dots below which tracking is replaced by acquisition."""
    acquire_dots: Annotated[int, Meta(ge=6, le=7)] = 6
    """Dots of a face that acquisition must find."""
    consistency_px: Positive = 0.3
    """Largest distance of a dot from its face's homography [px]: print and lens errors, not noise."""
    gate_probability: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    """Significance level at which tracked dots are refused for their distance from the prior: good ones exceed it with
    probability 1 - this (chi-square of two degrees of freedom; covariance of prior and measurement); 0: leave it to the
    core, which can determine what moved.
    """
    lopsided: Positive = 0.02
    """Largest odd harmonic of a whole dot's edge; a cut of 0.5 px makes 0.02, of 1 px 0.04."""
    floor_px: Annotated[float, Meta(ge=0)] = 0.001
    """Systematic standard deviation [px], part of every covariance: sampling of sharp edges and rounding to grey
    levels. The default is the excess of calibration residuals over the scatter of frames at 2 grey levels of noise
    (tests/sim/test_demo.py has the pooled chi-square); noise-free images, with rounding that nothing dithers, have
    0.0013.
    """
    max_spots: Annotated[int, Meta(ge=7, le=100)] = 48
    """Largest number of dot-like spots that acquisition examines, the roundest first."""


_Found = tuple[FloatArray, npt.NDArray[np.bool_]]
"""Measurements (faces, 7, FIELDS) and which of them are accepted (faces, 7)."""


class _Seen(NamedTuple):
    """Data of an observation: arrays of its own, with the first rows filled."""

    ids: IntArray
    pixels: FloatArray
    covariances: FloatArray

    @classmethod
    def of(cls, most: int) -> _Seen:
        return cls(np.empty(most, np.int64), np.empty((most, 2)), np.empty((most, 2, 2)))

    def observation(self, frame: Frame, count: int) -> CameraObservation:
        """The observation of a ``frame``, from the first ``count`` rows."""
        return CameraObservation(
            frame.camera,
            frame.seq,
            frame.t_shutter_ns,
            frame.t_received_ns,
            self.ids[:count],
            self.pixels[:count],
            self.covariances[:count],
        )


class DotDetector:
    """Detects dots of self-identifying faces: ids, centres and calibrated covariances. One thread at a time.

    With a fresh prior the dots are measured in windows; otherwise, or if fewer than ``min_dots`` are found, the whole
    image is searched and every face identified independently. Faces ``beside`` the body, which are not in the prior,
    are searched for in the whole image. A face with fewer than four accepted dots is not reported: fewer cannot be
    checked. Ids are reported in ascending order. The same frame and prior yield the same observation.

    Raises DriverError: ``option`` at construction; ``image_format``, ``image_size`` by :meth:`detect` for frames that
    differ from the announced ones. Content never raises.
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
        self._patterns = patterns_of(self.options.faces, self.options.beside)
        self._dark = self.options.polarity == "dark"
        self._scratch = scratch()
        patterns.compile_kernels()
        acquisition.compile_kernels()
        _compile_kernels()
        self._size = self.options.image_size
        self._every_id = np.array([pattern.ids for pattern in self._patterns])
        self._order = np.argsort(self._every_id.ravel())
        positions = np.array([pattern.positions for pattern in self._patterns])
        radii = np.array([pattern.radius for pattern in self._patterns])
        self._faces = FaceDots(self._every_id, positions, radii)
        self._searched = SearchedFaces(
            positions,
            radii,
            np.array([pattern.bases for pattern in self._patterns]),
            np.array([pattern.inverses for pattern in self._patterns]),
        )
        self._dots = np.zeros((self._every_id.size, FIELDS))
        self._used = np.zeros(self._every_id.size, np.bool_)
        self._gate = np.inf
        if self.options.gate_probability:
            self._gate = -2.0 * np.log1p(-self.options.gate_probability)

    def describe(self) -> DetectorDescription:
        """The marker ids of all faces."""
        ids = tuple(self._every_id.ravel()[self._order].tolist())
        return DetectorDescription("dots", ids, self.options.floor_px)

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        """Dots of ``frame``. Raises DriverError (``image_format``, ``image_size``); never on content."""
        image = sized_image(frame, self.camera, self._size)
        self._size = (image.shape[1], image.shape[0])
        seen = _Seen.of(self._used.size)
        if prior is not None and self._fresh(frame, prior):
            found = self._track(image, prior, (frame.t_shutter_ns - prior.t_ns) * 1e-9, seen)
            if found >= self.options.min_dots and not self.options.beside:
                return seen.observation(frame, found)
            if found >= self.options.min_dots:
                return self._observation(frame, self._with_others(image, prior), seen)
        return self._observation(frame, self._search(frame, image, prior), seen)

    def _search(self, frame: Frame, image: ImageArray, prior: Prior | None) -> _Found:
        """Search for all faces: near the prior, of any age; in the whole image if that is not enough."""
        every = np.ones(len(self._patterns), np.bool_)
        if prior is None or not len(prior.ids):
            return self._acquire(image, every, [None] * len(every))
        limit_s = self.options.max_prior_age_s
        expected = acquisition.expectations(prior, frame.t_shutter_ns, limit_s, self._every_id)
        region = acquisition.region_of(expected, image.shape)
        if region is not None:
            dots, used = self._acquire(acquisition.crop(image, region), every, expected, np.array(region[:2]))
            if used.any(axis=1).all():
                return dots, used
        return self._acquire(image, every, expected)

    def _fresh(self, frame: Frame, prior: Prior) -> bool:
        age_s = abs(frame.t_shutter_ns - prior.t_ns) * 1e-9
        return len(prior.ids) > 0 and age_s <= self.options.max_prior_age_s

    def _track(self, image: ImageArray, prior: Prior, dt_s: float, seen: _Seen) -> int:
        """Measure and check the dots of a prior, writing to ``seen`` and for :meth:`_with_others`; returns the number
        accepted.
        """
        options = self.options
        expected = (
            np.ascontiguousarray(prior.ids, np.int64),
            np.ascontiguousarray(prior.pixels, np.float64),
            np.ascontiguousarray(prior.velocities, np.float64),
            np.ascontiguousarray(prior.covariances, np.float64),
            dt_s,
        )
        gates = (options.min_contrast, self._gate, options.lopsided, options.consistency_px, options.floor_px)
        found: int = track(
            (image, self._dark),
            (*self._faces, self._order),
            expected,
            gates,
            plain(self._scratch),
            (self._dots, self._used, *seen),
        )
        return found

    def _with_others(self, image: ImageArray, prior: Prior) -> _Found:
        """Tracked dots together with faces outside of the body, which the prior does not contain, found by search."""
        shape = self._every_id.shape
        dots, used = self._dots.reshape(*shape, FIELDS), self._used.reshape(shape)
        unknown = ~np.isin(self._every_id, prior.ids).any(axis=1)
        unknown[: len(self._patterns) - len(self.options.beside)] = False
        if not unknown.any():
            return dots, used
        found, right = self._acquire(image, unknown, [None] * len(unknown), taken=dots[used, :2])
        return np.where(unknown[:, None, None], found, dots), np.where(unknown[:, None], right, used)

    def _acquire(
        self,
        image: ImageArray,
        sought: BoolArray,
        expected: Sequence[Expectation | None],
        origin: npt.NDArray[np.int64] | None = None,
        taken: FloatArray | None = None,
    ) -> _Found:
        """Find the faces that are ``sought`` (f,) among all spots of an image except those ``taken`` (k, 2) [px].

        ``expected`` of all faces chooses among copies. ``origin`` (2,): the image's offset in a larger one.
        """
        options = self.options
        spots = find_spots(image, self._dark, options.min_contrast, options.lopsided, options.max_spots, self._scratch)
        if origin is not None:
            spots[:, :2] += origin
        if taken is not None and len(taken) and len(spots):
            away = np.hypot(*(spots[:, None, :2] - taken[None]).transpose(2, 0, 1)).min(axis=1)
            spots = np.ascontiguousarray(spots[away > SAME_SPOT_PX])
        copies = acquisition.copies_of(self._searched, sought, spots, options.acquire_dots, options.consistency_px)
        owners = np.full(self._every_id.shape, -1, np.int64)
        for f, found in enumerate(copies):
            owner = acquisition.choose(found, spots, expected[f])
            if owner is not None:
                owners[f] = owner
        dots, used = np.zeros((*owners.shape, FIELDS)), np.zeros(owners.shape, np.bool_)
        checks = options.consistency_px, options.acquire_dots
        settle_faces(plain(self._faces), spots, owners, checks, dots, used)
        return dots, used

    def _observation(self, frame: Frame, found: _Found, seen: _Seen) -> CameraObservation:
        dots, used = found
        count = report(
            self._every_id, self._order, dots.reshape(-1, FIELDS), used.ravel(), self.options.floor_px, plain(seen)
        )
        return seen.observation(frame, count)


MIN_HALF_WINDOW = 14
MAX_HALF_WINDOW = 64
SHAPE_MARGIN = 6
"""Pixels between a dot's expected outline and the border of its window, in addition to the prior's uncertainty."""


class FaceDots(NamedTuple):
    """f faces of n dots: their ``ids`` (f, n), ``positions`` (f, n, 2) and ``radii`` (f,) [pattern units]."""

    ids: IntArray
    positions: FloatArray
    radii: FloatArray


class PriorDots(NamedTuple):
    """The dots of a prior: ``ids`` (k,), ``pixels`` (k, 2) [px], ``velocities`` (k, 2) [px/s] and ``covariances``
    (k, 2, 2) [px²], ``dt_s`` [s] before the image.
    """

    ids: IntArray
    pixels: FloatArray
    velocities: FloatArray
    covariances: FloatArray
    dt_s: float


class ExpectedDots(NamedTuple):
    """Prior of the m dots of all faces, where ``present`` (m,): ``predicted`` (m, 2) [px] with covariances ``spread``
    (m, 3), xx, xy, yy [px²], and the ``shapes`` (m, SHAPE) of their images.
    """

    predicted: FloatArray
    present: BoolArray
    spread: FloatArray
    shapes: FloatArray


class TrackGates(NamedTuple):
    """Requirements for a tracked dot: at least ``contrast`` [grey levels]; ``limit``, infinite for none: the largest
    squared distance from its prior in covariances of prior and measurement; ``lopsided``, ``tolerance`` [px] as in the
    options.
    ``floor`` [px]: standard deviation that is part of every covariance.
    """

    contrast: int
    limit: float
    lopsided: float
    tolerance: float
    floor: float


@kernel
def expect(face_dots, prior, expected, windows):
    """Write the `DotWindows` for the dots of a prior to ``windows``, and their expected properties to ``expected``.

    Faces that the prior shows from behind, too thin, too uncertain or with fewer than four dots remain empty. Returns
    the number of windows.
    """
    every_id, patterns, radii = face_dots
    ids, pixels, velocities, covariances, dt_s = prior
    predicted, present, spread, shapes = expected
    faces, n = every_id.shape
    count = 0
    H = np.zeros((3, 3))
    reaches = np.zeros(n)
    for f in range(faces):
        mine = present[f * n : (f + 1) * n]
        places = predicted[f * n : (f + 1) * n]
        for i in range(n):
            for k in range(ids.size):
                if ids[k] != every_id[f, i]:
                    continue
                du, dv = velocities[k, 0] * dt_s, velocities[k, 1] * dt_s
                u, v = pixels[k, 0] + du, pixels[k, 1] + dv
                xx, xy, yy = covariances[k, 0, 0], covariances[k, 0, 1], covariances[k, 1, 1]
                row = spread[f * n + i]
                row[0], row[1], row[2] = xx, xy, yy
                largest = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
                reach = 3.0 * np.sqrt(max(largest, 0.0)) + 0.25 * (abs(du) + abs(dv))
                # comparisons fail for NaN
                if abs(u) < 1e6 and abs(v) < 1e6 and reach < MAX_HALF_WINDOW:
                    places[i, 0] = u
                    places[i, 1] = v
                    reaches[i] = reach
                    mine[i] = True
        good = fit_homography(patterns[f], places, mine, H)
        for i in range(n):
            shape = shapes[f * n + i]
            if good and not image_of_circle(H, patterns[f, i, 0], patterns[f, i, 1], radii[f], shape):
                good = False
            if good and mine[i] and (shape[6] < THINNEST or shape[5] + reaches[i] + SHAPE_MARGIN > MAX_HALF_WINDOW):
                good = False
        for i in range(n):
            if good and mine[i]:
                shape = shapes[f * n + i]
                half = max(int(np.ceil(shape[5] + reaches[i])) + SHAPE_MARGIN, MIN_HALF_WINDOW)
                u, v = int(np.floor(places[i, 0] + 0.5)), int(np.floor(places[i, 1] + 0.5))
                window = windows.boxes[f * n + i]
                window[0], window[1], window[2], window[3] = u - half, v - half, u + half + 1, v + half + 1
                windows.least[f * n + i] = max(5, int(0.4 * shape[4]))
                count += 1
        if not good:
            mine[:] = False
    return count


@kernel
def _gate(expected, status, gates, dots, used):
    """Write to ``used`` (n,) which dots of a face pass the gates, individually and relative to their neighbours."""
    predicted, present, spread, shapes = expected
    limit, lopsided = gates.limit, gates.lopsided
    n = used.size
    contrasts = np.zeros(n)
    scales = np.zeros(n)
    for i in range(n):
        used[i] = False
        if not present[i] or status[i] != OK:
            continue
        area, shape, dot = dots[i, AREA], shapes[i], dots[i]
        # blur inflates the area of thin dots
        most = np.pi * (shape[5] + 1.0) * (shape[6] + 1.0) * 1.4
        du, dv = dots[i, 0] - predicted[i, 0], dots[i, 1] - predicted[i, 1]
        noise = max(dot[NOISE], 0.08)
        xx, xy = spread[i, 0] + noise * dot[CXX], spread[i, 1] + noise * dot[CXY]
        yy = spread[i, 2] + noise * dot[CYY]
        off = yy * du * du - 2.0 * xy * du * dv + xx * dv * dv
        near = off <= limit * (xx * yy - xy * xy) or limit == np.inf
        contrasts[i] = dots[i, CONTRAST]
        scales[i] = area / shape[4]
        used[i] = area > 0.6 * shape[4] and area < most and near and whole(dot, lopsided)
    contrast = median(contrasts, used)
    scale = median(scales, used)
    for i in range(n):
        if used[i]:
            alike = contrasts[i] > 0.5 * contrast and contrasts[i] < 2.0 * contrast
            used[i] = alike and scales[i] > 0.8 * scale and scales[i] < 1.25 * scale


@kernel
def judge(face_dots, expected, status, gates, dots, used):
    """Accept measured dots: complete, of the expected size, similar, nearest to their own prediction, consistent with
    the face.

    Moves ``dots`` (m, FIELDS) to the dots' centres, writes ``used`` (m,). Returns their number.
    """
    _, patterns, radii = face_dots
    predicted, present, spread, shapes = expected
    tolerance = gates.tolerance
    faces, n = patterns.shape[0], patterns.shape[1]
    total = 0
    for f in range(faces):
        a, b = f * n, (f + 1) * n
        mine = used[a:b]
        own_face = ExpectedDots(predicted[a:b], present[a:b], spread[a:b], shapes[a:b])
        _gate(own_face, status[a:b], gates, dots[a:b], mine)
        count = 0
        for i in range(a, b):
            if not used[i]:
                continue
            own = (dots[i, 0] - predicted[i, 0]) ** 2 + (dots[i, 1] - predicted[i, 1]) ** 2
            for k in range(faces * n):
                other = (dots[i, 0] - predicted[k, 0]) ** 2 + (dots[i, 1] - predicted[k, 1]) ** 2
                if present[k] and other < own:
                    used[i] = False
            count += 1 if used[i] else 0
        count = settle_face(patterns[f], radii[f], dots[a:b], mine, tolerance, np.int64(4)) if count >= 4 else 0
        if count == 0 or (count <= 5 and not agree_with_prior(predicted[a:b], dots[a:b], mine, FEW_TOLERANCE)):
            mine[:] = False
            count = 0
        total += count
    return total


@kernel
def report(every_id, order, dots, used, floor, seen):
    """Write the dots of ``used`` (m,) of ``dots`` (m, FIELDS) as an observation, by ascending id, into the first rows
    of ``seen`` (the fields of a `_Seen`); returns their number. ``order`` (m,) sorts the ids of all faces (f, n);
    ``floor`` [px].
    """
    ids, pixels, covariances = seen
    n = every_id.shape[1]
    chosen = np.empty((used.size, FIELDS))
    count = 0
    for k in order:
        if used[k]:
            ids[count] = every_id[k // n, k % n]
            pixels[count, 0], pixels[count, 1] = dots[k, 0], dots[k, 1]
            for j in range(FIELDS):
                chosen[count, j] = dots[k, j]
            count += 1
    centroids.covariances(chosen[:count], floor, covariances)
    return count


@kernel
def track(picture, faces, prior, gates, scratch, found):
    """Compute an observation from an image and a prior: :func:`expect`, the measurement in windows, :func:`judge`,
    :func:`report`. Returns the number of dots.

    All arguments are the fields of their records, `Picture`, `FaceDots` and the order of all their ids (m,),
    `PriorDots`, `TrackGates`, `Scratch`; ``found``: dots (m, FIELDS) and used (m,), which are written, then those of a
    `_Seen`.
    """
    picture, prior, gates = Picture(*picture), PriorDots(*prior), TrackGates(*gates)
    every_id, patterns, radii, order = faces
    face_dots = FaceDots(every_id, patterns, radii)
    dots, used, seen_ids, seen_pixels, seen_covariances = found
    m = used.size
    predicted, spread, shapes = np.zeros((m, 2)), np.zeros((m, 3)), np.zeros((m, SHAPE))
    boxes, least, status = np.zeros((m, 4), np.int64), np.zeros(m, np.int64), np.zeros(m, np.int64)
    present = np.zeros(m, np.bool_)
    used[:] = False
    expected, windows = ExpectedDots(predicted, present, spread, shapes), DotWindows(boxes, predicted, least)
    expect(face_dots, prior, expected, windows)
    measure_windows(picture, windows, gates.contrast, Scratch(*scratch), dots, status)
    judge(face_dots, expected, status, gates, dots, used)
    return report(every_id, order, dots, used, gates.floor, (seen_ids, seen_pixels, seen_covariances))


@kernel
def settle_faces(face_dots, spots, owners, checks, dots, used):
    """Check the faces (f, n) that acquisition found: ``owners`` are rows of ``spots``, -1 for missing dots.

    ``face_dots``: the fields of a `FaceDots`; ``checks``: the largest distance [px] of a dot from its face's
    homography, and the least number of dots of a face. Of faces that share a spot the one with more dots is kept; of
    equals, none. Writes ``dots`` (f, n, FIELDS) and ``used`` (f, n), which are zero before.
    """
    _, patterns, radii = face_dots
    tolerance, least = checks
    faces, n = owners.shape
    for f in range(faces):
        mine = count = 0
        keep = True
        for i in range(n):
            mine += 1 if owners[f, i] >= 0 else 0
        for g in range(faces):
            others = shared = 0
            for i in range(n):
                others += 1 if owners[g, i] >= 0 else 0
                for k in range(n):
                    shared += 1 if owners[g, i] >= 0 and owners[g, i] == owners[f, k] else 0
            keep = keep and (g == f or shared == 0 or others < mine)
        for i in range(n):
            if keep and owners[f, i] >= 0:
                used[f, i] = True
                count += 1
                for j in range(FIELDS):
                    dots[f, i, j] = spots[owners[f, i], j]
        if count > 0:
            settle_face(patterns[f], radii[f], dots[f], used[f], tolerance, least)


def _compile_kernels() -> None:
    """Compile the kernels of tracking, or load them from the cache."""
    seen = written(INT, 1), written(FLOAT, 2), written(FLOAT, 3)
    # before `track`, which calls it with the same types
    compile_for(report, given(INT, 2), given(INT, 1), written(FLOAT, 2), written(BOOL, 1), FLOAT, fields(*seen))
    faces = given(INT, 2), given(FLOAT, 3), given(FLOAT, 1)
    compile_for(
        track,
        fields(IMAGE, BOOL),
        fields(*faces, given(INT, 1)),
        fields(given(INT, 1), given(FLOAT, 2), given(FLOAT, 2), given(FLOAT, 3), FLOAT),
        fields(INT, FLOAT, FLOAT, FLOAT, FLOAT),
        SCRATCH,
        fields(written(FLOAT, 2), written(BOOL, 1), *seen),
    )
    compile_for(
        settle_faces,
        fields(*faces),
        given(FLOAT, 2),
        given(INT, 2),
        fields(FLOAT, INT),
        written(FLOAT, 3),
        written(BOOL, 2),
    )


# -- options of faces ----------------------------------------------------------------------------------------
# Options of the faces that the dot detector searches, and their patterns for the kernels.


Positive = Annotated[float, Meta(gt=0)]


class FaceOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A custom face: ids and positions of its dots [any unit], four corners clockwise first; radius in that unit."""

    name: str
    ids: tuple[int, ...]
    positions: tuple[tuple[float, float], ...]
    radius: Positive


@dataclass(frozen=True)
class Pattern:
    """A face in the kernels' form, in units of half the distance of its corners."""

    ids: npt.NDArray[np.int64]
    positions: FloatArray
    radius: float
    bases: npt.NDArray[np.int64]
    inverses: FloatArray


def patterns_of(
    faces: Sequence[FaceOptions | DotFace] | None, beside: Sequence[str | FaceOptions]
) -> tuple[Pattern, ...]:
    """Patterns of a body's ``faces`` (None: the default body's) and of those ``beside`` it. Raises DriverError."""
    if faces is not None and not faces:
        raise DriverError("option", "faces: is empty; give at least one face, or leave it out", faces=[])
    known = [_printed(face) if isinstance(face, str) else face for face in beside]
    patterns = tuple(
        _pattern(face.name, face.ids, np.array(face.positions, dtype=float), face.radius)
        for face in (*(DEFAULT_BODY if faces is None else faces), *known)
    )
    ids = [int(i) for pattern in patterns for i in pattern.ids]
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise DriverError("option", f"faces: marker ids {twice} are used twice; ids must differ", ids=twice)
    return patterns


def _printed(name: str) -> DotFace:
    if name not in FACES:
        raise DriverError("option", f"beside: no face {name!r} is printed; there are {', '.join(FACES)}", face=name)
    return FACES[name]


def _pattern(name: str, ids: Sequence[int], positions: FloatArray, radius: float) -> Pattern:
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
            "option", f"face {name!r}: its first four dots are not convex and clockwise (x right, y down)", face=name
        )
    unit = 0.5 * float(np.linalg.norm(edges, axis=1).mean())
    scaled = np.ascontiguousarray((positions - corners.mean(axis=0)) / unit)
    bases = np.array([CORNERS, *(_spare_basis(scaled, corner) for corner in CORNERS)], np.int64)
    return Pattern(
        ids=np.array(ids, np.int64),
        positions=scaled,
        radius=radius / unit,
        bases=bases,
        inverses=np.array([basis_inverse(scaled[basis]) for basis in bases]),
    )


def _spare_basis(positions: FloatArray, missing: int) -> tuple[int, int, int, int]:
    """Four dots excluding ``missing``, convex and clockwise where possible, with the largest smallest triangle."""
    points = [complex(x, y) for x, y in positions]

    def quality(rows: tuple[int, ...]) -> float:
        p = [points[i] for i in rows]
        triangles = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
        return min(((p[b] - p[a]).conjugate() * (p[c] - p[a])).imag for a, b, c in triangles)

    others = [i for i in range(len(positions)) if i != missing]
    best = max(permutations(others, 4), key=quality)
    return best[0], best[1], best[2], best[3]
