"""Detector of dot faces (seven dots each): acquisition in the whole image, then tracking in windows at the core's
priors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.devices import (
    CameraObservation,
    DetectorDescription,
    DriverContext,
    DriverError,
    Frame,
    Prior,
)
from stereoservo_drivers.detectors import acquisition, centroids, face_tracking, levels, patterns
from stereoservo_drivers.detectors.acquisition import Expectation, find_spots
from stereoservo_drivers.detectors.centroids import measure_windows
from stereoservo_drivers.detectors.components import FIELDS, scratch
from stereoservo_drivers.detectors.face_options import FaceOptions, Positive, patterns_of
from stereoservo_drivers.detectors.face_tracking import SHAPE, expect, judge, settle_face
from stereoservo_drivers.detectors.frame_images import sized_image

SAME_SPOT_PX = 2.0
"""A spot this near to a dot that was tracked is that dot."""


class DotOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[camera.detector_options]`` of the detector ``dots``."""

    polarity: Literal["light", "dark"] = "light"
    """Dots lighter or darker than their plate."""
    faces: tuple[FaceOptions, ...] | None = None
    """Default: the two faces of the default marker body."""
    beside: tuple[str | FaceOptions, ...] = ()
    """Faces beside the body, such as a workpiece's: names of printed ones or custom faces. No prior contains
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
    gate_probability: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    """Refuse tracked dots so far off their prior that only 1 - this of good ones are (chi-square of two degrees of
    freedom; covariance of prior and measurement); 0: leave it to the core, which can tell what moved.
    """
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


_Found = tuple[FloatArray, npt.NDArray[np.bool_]]
"""Measurements (faces, 7, FIELDS) and which of them are accepted (faces, 7)."""


class DotDetector:
    """Detects dots of self-identifying faces: ids, centres and calibrated covariances. One thread at a time.

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
        self._patterns = patterns_of(self.options.faces, self.options.beside)
        self._dark = self.options.polarity == "dark"
        self._labels, self._stack = scratch()
        centroids.compile_kernels()
        patterns.compile_kernels()
        face_tracking.compile_kernels()
        levels.compile_kernels()
        self._size = self.options.image_size
        self._every_id = np.array([pattern.ids for pattern in self._patterns])
        self._order = np.argsort(self._every_id.ravel())
        self._positions = np.array([pattern.positions for pattern in self._patterns])
        self._radii = np.array([pattern.radius for pattern in self._patterns])
        self._ids = tuple(sorted(self._every_id.ravel().tolist()))
        self._place = {marker: k for k, marker in enumerate(self._every_id.ravel().tolist())}

    def describe(self) -> DetectorDescription:
        """The marker ids of all faces."""
        return DetectorDescription("dots", self._ids, self.options.floor_px)

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        """Dots of ``frame``. Raises DriverError (``image_format``, ``image_size``); never on content."""
        image = sized_image(frame, self.camera, self._size)
        self._size = (image.shape[1], image.shape[0])
        if prior is not None and self._fresh(frame, prior):
            found = self._track(image, prior, (frame.t_shutter_ns - prior.t_ns) * 1e-9)
            if found[1].sum() >= self.options.min_dots:
                return self._observation(frame, self._with_others(image, found, prior))
        return self._observation(frame, self._search(frame, image, prior))

    def _search(self, frame: Frame, image: ImageArray, prior: Prior | None) -> _Found:
        """Search for all faces: near the prior, of any age; in the whole image if that is not enough."""
        every = range(len(self._patterns))
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

    def _track(self, image: ImageArray, prior: Prior, dt_s: float) -> _Found:
        options = self.options
        faces, n = self._every_id.shape
        m = faces * n
        predicted, present = np.zeros((m, 2)), np.zeros(m, np.bool_)
        shapes, windows, least = np.zeros((m, SHAPE)), np.zeros((m, 4), np.int64), np.zeros(m, np.int64)
        dots, used, status = np.zeros((m, FIELDS)), np.zeros(m, np.bool_), np.zeros(m, np.int64)
        uncertain = np.ascontiguousarray(prior.covariances, np.float64)
        ids = np.ascontiguousarray(prior.ids, np.int64)
        expect(
            self._every_id, self._positions, self._radii, ids, np.ascontiguousarray(prior.pixels, np.float64),
            np.ascontiguousarray(prior.velocities, np.float64), uncertain, dt_s, predicted, present, shapes,
            windows, least,
        )  # fmt: skip
        measure_windows(
            image, self._dark, windows, predicted, options.min_contrast, least, self._labels, self._stack,
            dots, status
        )  # fmt: skip
        covariance, limit = np.zeros((m, 3)), np.inf
        if options.gate_probability:
            limit = -2.0 * np.log1p(-options.gate_probability)
            for k, marker in enumerate(ids.tolist()):
                if marker in self._place:
                    covariance[self._place[marker]] = uncertain[k].ravel()[[0, 1, 3]]
        judge(
            self._positions, self._radii, predicted, present, shapes, status, covariance, limit, options.lopsided,
            options.consistency_px, dots, used,
        )  # fmt: skip
        return dots.reshape(faces, n, FIELDS), used.reshape(faces, n)

    def _with_others(self, image: ImageArray, tracked: _Found, prior: Prior) -> _Found:
        """Tracked dots together with faces outside of the body, which the prior does not contain, found by search."""
        if not self.options.beside:
            return tracked
        unknown = ~np.isin(self._every_id, prior.ids).any(axis=1)
        unknown[: len(self._patterns) - len(self.options.beside)] = False
        if not unknown.any():
            return tracked
        dots, used = tracked
        missing_faces = np.flatnonzero(unknown).tolist()
        found, seen = self._acquire(image, missing_faces, [None] * len(unknown), taken=dots[used, :2])
        return np.where(unknown[:, None, None], found, dots), np.where(unknown[:, None], seen, used)

    def _acquire(
        self,
        image: ImageArray,
        faces: Sequence[int],
        expected: Sequence[Expectation | None],
        origin: npt.NDArray[np.int64] | None = None,
        taken: FloatArray | None = None,
    ) -> _Found:
        """Find the ``faces`` (indices) among all spots of an image except those ``taken`` (k, 2) [px].

        ``expected`` of all faces chooses among copies. ``origin`` (2,): the image's offset in a larger one.
        """
        options = self.options
        least, tolerance = options.acquire_dots, options.consistency_px
        spots = find_spots(
            image,
            self._dark,
            options.min_contrast,
            options.lopsided,
            options.max_spots,
            self._labels,
            self._stack,
        )
        if origin is not None:
            spots[:, :2] += origin
        if taken is not None and len(taken) and len(spots):
            away = np.hypot(*(spots[:, None, :2] - taken[None]).transpose(2, 0, 1)).min(axis=1)
            spots = spots[away > SAME_SPOT_PX]
        owners = np.full(self._every_id.shape, -1, np.int64)
        for f in faces:
            copies = acquisition.copies_of(self._patterns[f], spots, least, tolerance)
            owner = acquisition.choose(copies, spots, expected[f])
            if owner is not None:
                owners[f] = owner
        owners = acquisition.without_conflicts(owners)
        used = owners >= 0
        dots = np.zeros((*used.shape, FIELDS))
        dots[used] = spots[owners[used]]
        for f, pattern in enumerate(self._patterns):
            if used[f].any():
                settle_face(pattern.positions, pattern.radius, dots[f], used[f], tolerance, least)
        return dots, used

    def _observation(self, frame: Frame, found: _Found) -> CameraObservation:
        dots, used = found
        rows = self._order[used.ravel()[self._order]]
        ids, chosen = self._every_id.ravel()[rows], dots.reshape(-1, FIELDS)[rows]
        covariance = np.empty((len(ids), 2, 2))
        levels.covariances(chosen, self.options.floor_px, covariance)
        return CameraObservation(
            camera=frame.camera,
            seq=frame.seq,
            t_shutter_ns=frame.t_shutter_ns,
            t_received_ns=frame.t_received_ns,
            ids=ids,
            pixels=np.ascontiguousarray(chosen[:, :2]),
            covariances=covariance,
        )
