"""Detector of ArUco tags and AprilTags: their corners, identified by the tag's code.

The marker of corner ``c`` (0 top left as drawn, clockwise) of tag ``t`` has the id ``first_marker + 4 t + c``, unless
``markers`` names others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.devices import CameraObservation, DetectorDescription, DriverContext, DriverError, Frame, Prior
from stereoservo_drivers.detectors import tag_registration
from stereoservo_drivers.detectors.acquisition import noise_level
from stereoservo_drivers.detectors.tag_registration import (
    FIRST_BLUR_PX,
    DictionaryName,
    dictionary,
    register_tag,
    size_of,
    tag_cells,
)
from stereoservo_drivers.frame_images import SMALLEST_IMAGE, sized_image
from stereoservo_drivers.options import invalid

NOISY = 3.0
"""Noise [grey levels] above which the image is smoothed for the search, but not for the measurement."""
SAME_TAG = 0.25
"""Two finds of a tag are the same if they are nearer than this share of its side."""
ROOM_PX = 12.0
ROOM = 0.35
"""Margin around a prior's tag in the search window: pixels, and share of the tag's size."""
MOST_WINDOWS = 0.5
"""Share of the image's pixels in windows above which the whole image is searched instead, once."""
LEAST_THRESHOLD_WINDOW, LARGEST_THRESHOLD_WINDOW = 5, 23
"""Sizes [px] of the adaptive threshold's windows, in steps of nine; the largest alone finds most tags."""
GATE_SIGMA, GATE_PX = 5.0, 3.0
"""Largest distance of a corner from its prior for the prior to decide between two tags of one id: sigmas, pixels."""
Refinement = Literal["pattern", "subpixel", "apriltag", "none"]
_METHODS = {
    "pattern": cv2.aruco.CORNER_REFINE_NONE,
    "subpixel": cv2.aruco.CORNER_REFINE_SUBPIX,
    "apriltag": cv2.aruco.CORNER_REFINE_APRILTAG,
    "none": cv2.aruco.CORNER_REFINE_NONE,
}
STATED_PX: dict[str, float] = {"pattern": 0.003, "subpixel": 0.25, "apriltag": 0.15, "none": 0.9}
"""Standard deviation [px] of each refinement, in addition to the noise's if that is known."""
APRILTAG_OFFSET = 0.5
"""Offset that CORNER_REFINE_APRILTAG adds to each coordinate: its pixel centres are at halves."""
Id = Annotated[int, Meta(ge=0, le=1_000_000_000)]


class TagMarkers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Explicit marker ids of the four corners of a tag."""

    tag: Id
    ids: tuple[Id, Id, Id, Id]


class TagOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[camera.detector_options]`` of the detector ``aruco``."""

    tags: tuple[Id, ...]
    """Tags of the cell; no others are reported."""
    dictionary: DictionaryName = "36h11"
    first_marker: Id = 0
    """Corner c of tag t is marker ``first_marker + 4 t + c``."""
    markers: tuple[TagMarkers, ...] = ()
    """Other ids for the corners of some of ``tags``."""
    refinement: Refinement = "pattern"
    """Method of refining corners: ``pattern`` fits the whole printed tag; the others are OpenCV's."""
    floor_px: Annotated[float, Meta(ge=0)] | None = None
    """Systematic standard deviation [px], part of every covariance; a misfit found in residuals of ``pattern`` counts
    as part of it. Default: that of the refinement.
    """
    image_size: tuple[int, int] | None = None
    """(width, height) [px] that frames must have; default: that of the first frame."""
    max_prior_age_s: Annotated[float, Meta(gt=0)] = 0.25
    min_contrast: Annotated[int, Meta(ge=5, le=250)] = 30
    """Least difference of white and black [grey levels]."""


@dataclass(frozen=True)
class _Found:
    """A detected tag: corners (4, 2) [px] and their covariances (4, 2, 2) [px²]."""

    corners: FloatArray
    covariances: FloatArray


class TagDetector:
    """Detects corners of square tags with ids and covariances. One thread at a time.

    A tag's identity is read from its cells in every image. With a fresh prior its pattern is fitted at the expected
    place; if that fails, it is searched in a window around that place. Tags without a prior, and all tags if none is
    found, are searched in the whole image. A tag that is seen twice is not reported, unless a prior is near only one of
    the two. A tag that is not completely in the image, or with a cell that contradicts the code (refinement
    ``pattern``), is not reported. Ids are reported in ascending order. The same frame and prior yield the same
    observation.

    Raises DriverError: ``option`` at construction; ``image_format``, ``image_size`` by :meth:`detect` for frames that
    differ from the announced ones. Content never raises.
    """

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self.camera = context.camera
        self.options = _decoded(options, context.camera)
        self._ids = _marker_ids(self.options, context.camera)
        self._tag_of = {marker: (tag, c) for tag, ids in self._ids.items() for c, marker in enumerate(ids)}
        name = self.options.dictionary
        self._cells = {tag: tag_cells(name, tag) for tag in self._ids}
        stated = STATED_PX[self.options.refinement]
        self._floor_px = stated if self.options.floor_px is None else self.options.floor_px
        self._markers = np.array(sorted(self._tag_of), dtype=np.int64)
        rows = {tag: k for k, tag in enumerate(self._ids)}
        self._corner_of = np.array([(rows[t], c) for _, (t, c) in sorted(self._tag_of.items())])
        self._detector = _opencv_detector(self.options, LEAST_THRESHOLD_WINDOW)
        self._quick = _opencv_detector(self.options, LARGEST_THRESHOLD_WINDOW)
        self._size = self.options.image_size
        tag_registration.compile_kernels()

    def describe(self) -> DetectorDescription:
        """The marker ids of all tags."""
        return DetectorDescription("aruco", tuple(sorted(self._tag_of)), self._floor_px)

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        """Corners of the tags in ``frame``. Raises DriverError (``image_format``, ``image_size``); never on
        content.
        """
        image = sized_image(frame, self.camera, self._size)
        self._size = (image.shape[1], image.shape[0])
        expected = self._expected(frame, prior)
        found = self._found_at(image, expected)
        astray = {tag: places for tag, places in expected.items() if tag not in found}
        windows = {tag: _window(image, *places) for tag, places in astray.items()}
        if sum(window.size for window, _ in windows.values()) <= MOST_WINDOWS * image.size:
            for tag, (window, origin) in windows.items():
                one = self._search_window(image, window, origin, tag, expected[tag])
                if one is not None:
                    found[tag] = one
            astray = {}
        missing = [tag for tag in self._ids if tag in astray or tag not in expected or not found]
        if missing:
            found |= self._search(image, missing, expected)
        return self._observation(frame, found)

    def _expected(self, frame: Frame, prior: Prior | None) -> dict[int, tuple[FloatArray, FloatArray]]:
        """Expected corners of a tag from a fresh prior: pixels (4, 2) and standard deviations (4,) [px]."""
        if prior is None or abs(frame.t_shutter_ns - prior.t_ns) * 1e-9 > self.options.max_prior_age_s:
            return {}
        dt_s = (frame.t_shutter_ns - prior.t_ns) * 1e-9
        at = np.minimum(np.searchsorted(self._markers, prior.ids), len(self._markers) - 1)
        places = prior.pixels + dt_s * prior.velocities
        variances = prior.covariances[:, 0, 0] + prior.covariances[:, 1, 1]
        usable = np.isfinite(places).all(axis=1) & (variances >= 0.0) & (variances < np.inf)
        usable &= self._markers[at] == prior.ids
        corners, sigmas = np.full((len(self._ids), 4, 2), np.nan), np.zeros((len(self._ids), 4))
        row, corner = self._corner_of[at[usable]].T
        corners[row, corner] = places[usable]
        sigmas[row, corner] = np.sqrt(variances[usable])
        height, width = frame.image.shape
        inside = ((corners > -0.5) & (corners < np.array([width, height]) - 0.5)).all(axis=(1, 2))
        tags = list(self._ids)
        return {tags[k]: (corners[k], sigmas[k]) for k in np.flatnonzero(inside)}

    def _found_at(self, image: ImageArray, expected: Mapping[int, tuple[FloatArray, FloatArray]]) -> dict[int, _Found]:
        """Tags whose pattern fits at the expected place: no search, and no other tag of this id can be as near."""
        found: dict[int, _Found] = {}
        if self.options.refinement != "pattern":
            return found
        for tag, (corners, sigmas) in expected.items():
            gates = GATE_SIGMA * sigmas + GATE_PX
            side = float(np.hypot(*(corners[2] - corners[0])) / np.sqrt(2.0))
            if gates.max() > side:
                continue
            blur_px = min(max(FIRST_BLUR_PX, sigmas.max()), side / len(self._cells[tag]) / 3.0)
            one = self._measured(image, tag, corners, blur_px)
            if one is not None and (np.hypot(*(one.corners - corners).T) <= gates).all():
                found[tag] = one
        return found

    def _search_window(
        self, image: ImageArray, window: ImageArray, origin: FloatArray, tag: int, places: tuple[FloatArray, FloatArray]
    ) -> _Found | None:
        """Search for ``tag`` in a window of the image."""
        if min(window.shape) < SMALLEST_IMAGE:
            return None
        quads = self._quads(self._detector, window, {tag}).get(tag, [])
        return self._chosen(image, tag, [quad + origin for quad in quads], places)

    def _search(
        self, image: ImageArray, tags: Iterable[int], expected: Mapping[int, tuple[FloatArray, FloatArray]]
    ) -> dict[int, _Found]:
        """Search for ``tags`` in the whole image: with one threshold, and with all of them unless each is found."""
        wanted = set(tags)
        found: dict[int, _Found] = {}
        for detector in (self._quick, self._detector):
            chosen = {
                tag: self._chosen(image, tag, quads, expected.get(tag))
                for tag, quads in self._quads(detector, image, wanted).items()
            }
            found = {tag: one for tag, one in chosen.items() if one is not None}
            if len(found) == len(wanted):
                break
        return found

    def _quads(
        self, detector: cv2.aruco.ArucoDetector, image: ImageArray, tags: set[int]
    ) -> dict[int, list[FloatArray]]:
        """Quadrilaterals (4, 2) [px] decoded by OpenCV as one of ``tags``."""
        image = np.ascontiguousarray(image)  # it may be a window
        searched = cv2.GaussianBlur(image, (5, 5), 1.0) if noise_level(image) > NOISY else image
        corners, ids, _ = detector.detectMarkers(searched)
        quads: dict[int, list[FloatArray]] = {}
        for quad, tag in zip(corners, [] if ids is None else np.ravel(ids).tolist(), strict=True):
            if tag in tags:
                quads.setdefault(tag, []).append(np.asarray(quad, dtype=np.float64).reshape(4, 2))
        return quads

    def _chosen(
        self, image: ImageArray, tag: int, quads: Iterable[FloatArray], places: tuple[FloatArray, FloatArray] | None
    ) -> _Found | None:
        """The tag among ``quads``: the only one, or the one at the prior's ``places``; else None."""
        finds: list[_Found] = []
        for quad in quads:
            one = self._measured(image, tag, quad)
            if one is not None and not any(_same(one.corners, other.corners) for other in finds):
                finds.append(one)
        if len(finds) > 1 and places is not None:
            corners, sigmas = places
            gates = GATE_SIGMA * sigmas + GATE_PX
            finds = [f for f in finds if (np.linalg.norm(f.corners - corners, axis=1) <= gates).all()]
        return finds[0] if len(finds) == 1 else None

    def _measured(self, image: ImageArray, tag: int, quad: FloatArray, blur_px: float = FIRST_BLUR_PX) -> _Found | None:
        variance = self._floor_px**2
        if self.options.refinement == "pattern":
            fit = register_tag(image, quad, self._cells[tag], blur_px)
            if fit is None or fit.contrast < self.options.min_contrast:
                return None
            # of the misfit that the fit includes, only the remainder up to the floor is added
            return _Found(fit.corners, fit.covariances + max(variance - fit.misfit, 0.0) * np.eye(2))
        if self.options.refinement == "apriltag":
            quad = quad - APRILTAG_OFFSET
        return _Found(quad, np.tile(variance * np.eye(2), (4, 1, 1)))

    def _observation(self, frame: Frame, found: Mapping[int, _Found]) -> CameraObservation:
        ids = np.array([marker for tag in found for marker in self._ids[tag]], dtype=np.int64)
        pixels = np.array([one.corners for one in found.values()], dtype=np.float64).reshape(-1, 2)
        covariances = np.array([one.covariances for one in found.values()], dtype=np.float64)
        height, width = frame.image.shape
        inside = np.all((pixels > -0.5) & (pixels < np.array([width, height]) - 0.5), axis=1)
        order = np.argsort(np.where(inside, ids, np.iinfo(np.int64).max))[: int(inside.sum())]
        return CameraObservation(
            camera=frame.camera,
            seq=frame.seq,
            t_shutter_ns=frame.t_shutter_ns,
            t_received_ns=frame.t_received_ns,
            ids=ids[order],
            pixels=np.ascontiguousarray(pixels[order]),
            covariances=np.ascontiguousarray(covariances.reshape(-1, 2, 2)[order]),
        )


def _same(one: FloatArray, other: FloatArray) -> bool:
    side = float(np.linalg.norm(one - np.roll(one, 1, axis=0), axis=1).max())
    return float(np.linalg.norm(one.mean(axis=0) - other.mean(axis=0))) < SAME_TAG * side


def _window(image: ImageArray, corners: FloatArray, sigmas: FloatArray) -> tuple[ImageArray, FloatArray]:
    """Part of an image around expected ``corners`` (4, 2), and its first pixel (2,)."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = ROOM * float((high - low).max()) + ROOM_PX + GATE_SIGMA * float(sigmas.max())
    height, width = image.shape
    left, top = np.maximum(np.floor(low - margin), 0).astype(int).tolist()
    right, bottom = int(min(high[0] + margin + 1, width)), int(min(high[1] + margin + 1, height))
    return image[top:bottom, left:right], np.array([left, top], dtype=np.float64)


def _opencv_detector(options: TagOptions, least_window: int) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = _METHODS[options.refinement]
    # the registration's own reading tolerates bits flipped by noise; without it the code must be exact
    parameters.errorCorrectionRate = 1.0 if options.refinement == "pattern" else 0.0
    # by default, the white margin's outline on a darker wall replaces the tag's: one in seven is lost
    parameters.minMarkerDistanceRate = 0.02
    parameters.minGroupDistance = 0.05
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.25
    parameters.adaptiveThreshWinSizeMin = least_window
    parameters.adaptiveThreshWinSizeMax = LARGEST_THRESHOLD_WINDOW
    parameters.adaptiveThreshWinSizeStep = 9
    return cv2.aruco.ArucoDetector(dictionary(options.dictionary), parameters)


def _decoded(options: Mapping[str, Any], camera: str) -> TagOptions:
    try:
        return msgspec.convert(dict(options), TagOptions, strict=True)
    except msgspec.ValidationError as error:
        raise DriverError(
            "option",
            f"detector options of camera {camera!r}: {invalid(TagOptions, options, error)}",
            options=dict(options),
        ) from error


def _marker_ids(options: TagOptions, camera: str) -> dict[int, tuple[int, int, int, int]]:
    """Marker ids of the corners of each tag. Raises DriverError ``option``."""
    where, count = f"detector options of camera {camera!r}", size_of(options.dictionary)
    beyond = sorted({tag for tag in options.tags if tag >= count})
    if not options.tags or beyond or len(set(options.tags)) < len(options.tags):
        raise DriverError(
            "option",
            f"{where}: tags = {list(options.tags)}; valid: one or more different ids of {options.dictionary}, "
            f"0 to {count - 1}",
            tags=list(options.tags),
        )
    others = {own.tag: own.ids for own in options.markers}
    unknown = sorted(set(others) - set(options.tags))
    if unknown or len(others) < len(options.markers):
        raise DriverError(
            "option",
            f"{where}: markers for tags {[own.tag for own in options.markers]}; valid: each of tags = "
            f"{list(options.tags)} at most once",
            tags=unknown,
        )
    first = options.first_marker
    ids = {}
    for tag in sorted(options.tags):
        k = first + 4 * tag
        ids[tag] = others.get(tag, (k, k + 1, k + 2, k + 3))
    every = [marker for four in ids.values() for marker in four]
    twice = sorted({marker for marker in every if every.count(marker) > 1})
    if twice:
        raise DriverError("option", f"{where}: marker ids {twice} are used twice; ids must differ", ids=twice)
    return ids
