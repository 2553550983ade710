"""Detector of natural features: learnt landmarks, found by keypoints, tracked, and registered to their reference in
every frame.

Tracks from frame to frame accumulate their errors (thesis 4.5: 0.3 px between consecutive images, "otherwise a
noticeable drift"). Here optical flow provides only start values: the reported position is the alignment of the
reference patch with this frame, whose error does not depend on the number of previous frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import BoolArray, FloatArray, ImageArray, IntArray
from stereoservo.ports.devices import CameraObservation, DetectorDescription, DriverContext, DriverError, Frame, Prior
from stereoservo_drivers.detectors.landmark_search import (
    Keypoints,
    Surroundings,
    find_keypoints,
    nothing,
    search_by_keypoints,
    seek,
    take_better,
)
from stereoservo_drivers.detectors.landmarks import KINDS, load_landmarks
from stereoservo_drivers.detectors.patch_alignment import Alignment, ReferencePatches, build_pyramid, compile_kernels
from stereoservo_drivers.frame_images import gray_image
from stereoservo_drivers.options import decode_options

FLOW_BACK_PX = 0.7
"""Largest distance from the start after forward and backward flow [px]."""
PULL = 0.1
"""Share by which a track's warp is pulled to that of its neighbours per frame, for the part that the patch itself does
not determine.
"""
OFF_PX = 5.0
"""Largest distance [px], in addition to the sigmas, of an untracked landmark from its place predicted by prior or
neighbours.
"""
OFF_SIGMAS = 4.0
REFERENCE_TILTS = 1
KEYPOINTS = 600
"""Number of keypoints of the image, and of each view of the reference."""
Positive = Annotated[float, Meta(gt=0)]


class CornerOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[camera.detector_options]`` of the detector ``corners``."""

    landmarks: str
    """File of `stereoservo learn-corners`, relative to the cell file's directory."""
    window: Annotated[int, Meta(ge=4, le=30)] = 10
    """Half the side of the patches [px]."""
    levels: Annotated[int, Meta(ge=1, le=6)] = 4
    """Levels of the pyramid in which flow and patches are computed."""
    max_residual: Annotated[float, Meta(gt=0, le=1)] = 0.5
    """Largest rms difference of a patch from its reference, as a share of its contrast, without gain and offset."""
    min_landmarks: Annotated[int, Meta(ge=5, le=100)] = 6
    """Least number of landmarks of the tool, or of the scene, that must be consistent to be reported."""
    radius_px: Positive = 60.0
    """Radius around a landmark, in the reference, of the keypoints used at acquisition."""
    max_gap_s: Positive = 0.5
    """Age after which tracks are dropped."""
    max_prior_age_s: Positive = 0.25
    search_every: Annotated[int, Meta(ge=1)] = 10
    """Number of frames between searches of the whole image, while only a part of the landmarks is lost."""
    floor_px: Annotated[float, Meta(ge=0)] = 0.02
    """Systematic standard deviation [px], part of every covariance: interpolation, and curved surfaces."""


@dataclass(frozen=True, eq=False)
class _Track:
    """The previous frame: its image, its stamp, and the landmarks' pixels."""

    seq: int
    t_ns: int
    image: ImageArray
    found: Alignment


class CornerDetector:
    """Detects the landmarks of one camera. One thread at a time.

    It stores the last frame, and drops it if the sequence goes back or is interrupted: the same *series* of frames and
    priors yields the same observations. A landmark is reported if its reference patch is found, is similar, and is
    consistent with others of its kind; ids are reported in ascending order.

    Raises DriverError: ``option``, ``landmarks`` at construction; ``image_format``, ``image_size`` by :meth:`detect`
    for frames that are not like the reference. Content never raises.
    """

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self.options = decode_options(CornerOptions, options, f"detector of camera {context.camera!r}")
        self.camera = context.camera
        landmarks = load_landmarks(context.cell_dir / self.options.landmarks)
        reference = landmarks.camera(context.camera)
        compile_kernels()
        patches = ReferencePatches(reference.picture, reference.pixels, self.options.window, reference.averaged)
        rows = np.flatnonzero(patches.valid)
        if len(rows) < self.options.min_landmarks:
            raise DriverError(
                "landmarks",
                f"{context.cell_dir / self.options.landmarks}: camera {context.camera!r} has {len(rows)} landmarks "
                f"with whole patches; at least {self.options.min_landmarks} (min_landmarks) are needed",
                usable=len(rows),
            )
        self._ids: IntArray = landmarks.ids[rows]
        self._kinds: IntArray = landmarks.kinds[rows]
        self._patches = ReferencePatches(
            reference.picture, reference.pixels[rows], self.options.window, reference.averaged
        )
        self._place = {marker: k for k, marker in enumerate(self._ids.tolist())}
        self._around = Surroundings(self._patches.pixels, self._kinds)
        self._shape = reference.picture.shape
        self._keypoints = self._reference_keypoints(reference.picture)
        self._least = 1.0 / np.sqrt(1.0 + self.options.max_residual**2)
        self._track: _Track | None = None
        self._since_search = self.options.search_every

    def describe(self) -> DetectorDescription:
        """The ids of the landmarks that this camera's reference shows."""
        return DetectorDescription("corners", tuple(self._ids.tolist()), self.options.floor_px)

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        """Landmarks of ``frame``. Raises DriverError (``image_format``, ``image_size``); never on content."""
        image = self._checked(frame)
        pyramid = build_pyramid(image, self.options.levels)
        found = nothing(len(self._ids))
        track = self._usable_track(frame)
        if track is None:
            self._since_search = self.options.search_every
        else:
            self._follow(image, pyramid, track, found, prior, frame)
        if prior is not None:
            self._by_prior(pyramid, frame, prior, found)
        if found.found.any():
            self._by_neighbours(pyramid, found)
        self._keep_coherent(found)
        self._search(image, pyramid, found)
        self._track = _Track(frame.seq, frame.t_shutter_ns, image, found)
        return self._observation(frame, found)

    def _reference_keypoints(self, picture: ImageArray) -> Keypoints:
        """Keypoints of the reference near landmarks, from several simulated views."""
        keypoints = find_keypoints(picture, KEYPOINTS, REFERENCE_TILTS)
        near = np.zeros(len(keypoints.pixels), np.bool_)
        for pixel in self._patches.pixels:
            near |= np.linalg.norm(keypoints.pixels - pixel, axis=1) <= self.options.radius_px
        return Keypoints(keypoints.pixels[near], keypoints.descriptors[near])

    def _checked(self, frame: Frame) -> ImageArray:
        image = gray_image(frame, self.camera)
        if image.shape != self._shape:
            (height, width), (h, w) = image.shape, self._shape
            raise DriverError(
                "image_size",
                f"camera {self.camera!r}: image of {width}x{height} px; its landmarks were learnt in {w}x{h}",
                size=(width, height),
                expected=(w, h),
            )
        return image.copy()  # stored for the next frame; a caller may reuse its buffer

    def _usable_track(self, frame: Frame) -> _Track | None:
        track = self._track
        if track is None or frame.seq <= track.seq:
            return None
        gap_s = (frame.t_shutter_ns - track.t_ns) * 1e-9
        return track if 0.0 <= gap_s <= self.options.max_gap_s and track.found.found.any() else None

    def _expected(self, frame: Frame, prior: Prior) -> tuple[IntArray, FloatArray, FloatArray]:
        """Rows of the landmarks in a fresh prior, their expected pixels in this frame (k, 2), sigmas (k,)."""
        dt_s = (frame.t_shutter_ns - prior.t_ns) * 1e-9
        known = np.array([marker in self._place for marker in prior.ids.tolist()], dtype=np.bool_)
        if abs(dt_s) > self.options.max_prior_age_s or not known.any():
            return np.empty(0, np.int64), np.empty((0, 2)), np.empty(0)
        rows = np.array([self._place[marker] for marker in prior.ids[known].tolist()], dtype=np.int64)
        pixels = prior.pixels[known] + dt_s * prior.velocities[known]
        variances = 0.5 * np.trace(prior.covariances[known], axis1=1, axis2=2)
        good = np.isfinite(pixels).all(axis=1) & (variances >= 0.0)
        return rows[good], pixels[good], np.sqrt(variances[good])

    def _follow(
        self,
        image: ImageArray,
        pyramid: list[ImageArray],
        track: _Track,
        found: Alignment,
        prior: Prior | None,
        frame: Frame,
    ) -> None:
        """Track landmarks by optical flow (checked backwards), then register their reference patches from there."""
        rows = np.flatnonzero(track.found.found)
        before = np.ascontiguousarray(track.found.pixels[rows], np.float32).reshape(-1, 1, 2)
        guess = before.copy()
        if prior is not None:
            expected, where, _ = self._expected(frame, prior)
            place = {row: k for k, row in enumerate(expected.tolist())}
            for k, row in enumerate(rows.tolist()):
                if row in place:
                    guess[k, 0] = where[place[row]]
        flow: dict[str, Any] = {
            "winSize": (2 * self.options.window + 1,) * 2,
            "maxLevel": self.options.levels - 1,
            "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03),
            "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        }
        there, ok_there, _ = cv2.calcOpticalFlowPyrLK(track.image, image, before, guess, **flow)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(image, track.image, there, before.copy(), **flow)
        there, back = there.reshape(-1, 2), back.reshape(-1, 2)
        ok = (ok_there.ravel() == 1) & (ok_back.ravel() == 1)
        ok &= np.linalg.norm(back - before.reshape(-1, 2), axis=1) <= FLOW_BACK_PX
        tracked, expectations = rows, guess.reshape(-1, 2).astype(np.float64)
        rows, where = rows[ok], there[ok].astype(np.float64)
        if len(rows):
            self._anchor(pyramid, track, rows, where, found)
        # Flow mistakes a lamp that is switched on for motion; patches do not.
        lost = ~found.found[tracked]
        none = np.zeros(int(lost.sum()))
        self._seek_near(pyramid, tracked[lost], track.found.A[tracked[lost]], expectations[lost], none, found)

    def _anchor(
        self, pyramid: list[ImageArray], track: _Track, rows: IntArray, where: FloatArray, found: Alignment
    ) -> None:
        """Register the reference patches of ``rows`` (k,), starting at the flow's pixels (k, 2)."""
        flowed, used = np.zeros((len(self._ids), 2)), np.zeros(len(self._ids), np.bool_)
        flowed[rows], used[rows] = where, True
        around, _, known = self._around.local_maps(flowed, used)
        warps = track.found.A[rows]
        warps = np.where(known[rows, None, None], (1.0 - PULL) * warps + PULL * around[rows], warps)
        take_better(found, rows, *seek(self._patches, pyramid, rows, warps, where, self._least, 0))

    def _by_prior(self, pyramid: list[ImageArray], frame: Frame, prior: Prior, found: Alignment) -> None:
        """Find missing landmarks by the prior, with the warp that it implies for their neighbourhood."""
        rows, where, sigmas = self._expected(frame, prior)
        pixels, used = np.zeros((len(self._ids), 2)), np.zeros(len(self._ids), np.bool_)
        pixels[rows], used[rows] = where, True
        warps, _, known = self._around.local_maps(pixels, used)
        lost = known[rows] & ~found.found[rows]
        self._seek_near(pyramid, rows[lost], warps[rows[lost]], where[lost], sigmas[lost], found)

    def _by_neighbours(self, pyramid: list[ImageArray], found: Alignment) -> None:
        """Find missing landmarks at positions predicted from their neighbours, e.g. after an occlusion."""
        warps, where, known = self._around.local_maps(found.pixels, found.found)
        rows = np.flatnonzero(known & ~found.found)
        self._seek_near(pyramid, rows, warps[rows], where[rows], np.zeros(len(rows)), found)

    def _seek_near(
        self,
        pyramid: list[ImageArray],
        rows: IntArray,
        warps: FloatArray,
        where: FloatArray,
        sigmas: FloatArray,
        found: Alignment,
    ) -> None:
        if not len(rows):
            return
        result, good = seek(self._patches, pyramid, rows, warps, where, self._least, 1)
        good &= np.linalg.norm(result.pixels - where, axis=1) <= OFF_PX + OFF_SIGMAS * sigmas
        take_better(found, rows, result, good)

    def _keep_coherent(self, found: Alignment) -> None:
        unsorted = self._kinds == KINDS.index("unsorted")
        least = self.options.min_landmarks
        rigid = self._around.coherent(found.A, found.pixels, found.found & ~unsorted, least, one=True)
        free = self._around.coherent(found.A, found.pixels, found.found & unsorted, least, one=False)
        found.found[:] = rigid | free

    def _search(self, image: ImageArray, pyramid: list[ImageArray], found: Alignment) -> None:
        """Search for kinds without any found landmark: at their reference positions, then anywhere by keypoints."""
        kinds = [kind for kind in np.unique(self._kinds) if not found.found[self._kinds == kind].any()]
        self._since_search += 1
        if not kinds:
            return
        missing = np.isin(self._kinds, kinds)
        self._merge(found, self._where_they_were(pyramid, missing), missing)
        missing &= ~np.isin(self._kinds, np.unique(self._kinds[found.found]))
        if not missing.any() or (found.found.any() and self._since_search < self.options.search_every):
            return
        self._since_search = 0
        anywhere = search_by_keypoints(
            self._patches,
            self._keypoints,
            find_keypoints(image, KEYPOINTS),
            pyramid,
            self._least,
            self.options.radius_px,
        )
        self._merge(found, anywhere, missing)

    def _where_they_were(self, pyramid: list[ImageArray], missing: BoolArray) -> Alignment:
        rows, result = np.flatnonzero(missing), nothing(len(self._ids))
        start = np.tile(np.eye(2), (len(rows), 1, 1))
        take_better(
            result, rows, *seek(self._patches, pyramid, rows, start, self._patches.pixels[rows], self._least, 0)
        )
        return result

    def _merge(self, found: Alignment, other: Alignment, missing: BoolArray) -> None:
        """Copy from ``other`` the ``missing`` landmarks that are mutually consistent, and further ones of their
        neighbourhood.
        """
        other.found[:] &= missing
        self._keep_coherent(other)
        if other.found.any():
            take_better(found, np.arange(len(self._ids)), other, other.found)

    def _observation(self, frame: Frame, found: Alignment) -> CameraObservation:
        rows = np.flatnonzero(found.found)
        height, width = self._shape
        pixels = found.pixels[rows]
        inside = ((pixels >= 0.0) & (pixels <= np.array([width, height]) - 1.0)).all(axis=1)
        rows = rows[inside]
        covariances = found.covariances[rows]
        covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
        covariances += self.options.floor_px**2 * np.eye(2)
        return CameraObservation(
            camera=frame.camera,
            seq=frame.seq,
            t_shutter_ns=frame.t_shutter_ns,
            t_received_ns=frame.t_received_ns,
            ids=self._ids[rows],
            pixels=np.ascontiguousarray(found.pixels[rows]),
            covariances=np.ascontiguousarray(covariances),
        )
