"""Learning of landmarks from simultaneous images of several cameras; their separation into tool and scene by a motion.

Corners (Shi and Tomasi 1994) of the first camera are found in the others: keypoints give their approximate positions,
and patches are aligned there to a hundredth of a pixel, forwards and backwards. A match is accepted if it satisfies the
epipolar constraint, with the noise estimated by the alignments, and no second place on the epipolar line looks similar
(thesis 4.5 tracks Harris' points by correlation, and matches them so).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from stereoservo.geometry.fundamental import (
    INLIER_SIGMAS,
    MIN_MATCHES,
    fundamental_robust,
    parallax_ratio,
    sampson_distances,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import BoolArray, FloatArray, ImageArray, IntArray
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.detectors.landmark_search import (
    find_keypoints,
    find_planes,
    match_keypoints,
    nothing,
    search_by_keypoints,
    seek,
    starts_from_planes,
    take_better,
)
from stereoservo_drivers.detectors.landmarks import KINDS, CameraReference, Landmarks
from stereoservo_drivers.detectors.patch_alignment import TEMPLATE_LEVELS, Alignment, ReferencePatches, build_pyramid

SMALLEST_PICTURE = 64
AS_A_PLANE = 4.0
"""Ratio of the residual variances of one homography and of an epipolar geometry below which the matches are on a plane.
"""
BACK_PX = 0.5
STAYED_PX, MOVED_PX = 0.5, 3.0
"""Largest displacement of a landmark that counts as static after a motion, and least one that counts as moved."""
STAYED_SIGMAS = 5.0
BAND_PX = 3.0


class LearningSettings(msgspec.Struct, frozen=True):
    """Settings. ``half``: of the patches' side [px]; ``most`` landmarks; ``spacing_px`` of corners; ``tilts``:
    simulated oblique views, for distant cameras; ``epipolar_px``: error of the epipolar constraint by lenses, in
    addition to the noise [px]; ``least_correlation`` of patches of two cameras; ``margin``: by which a second match
    must correlate less; ``first_id``.
    """

    half: int = 10
    most: int = 150
    spacing_px: float = 9.0
    tilts: int = 3
    keypoints: int = 1000
    radius_px: float = 60.0
    epipolar_px: float = 0.3
    least_correlation: float = 0.9
    margin: float = 0.07
    first_id: int = 1000


@dataclass(frozen=True)
class PairReport:
    """Counts of a pair of cameras' corners by the result of each test. ``epipolar_rms_px`` of the accepted ones (of
    their common plane, where ``planar``: one plane leaves the epipolar geometry undetermined).
    """

    first: str
    second: str
    corners: int
    keypoint_matches: int
    aligned: int
    consistent: int
    unique: int
    epipolar_rms_px: float
    planar: bool


@dataclass(frozen=True)
class LearningReport:
    """Report on ``pairs`` of the first camera with each other one; ``left_out``: matched, but of uncertain kind."""

    pairs: tuple[PairReport, ...]
    left_out: int


def learn_landmarks(
    views: Mapping[str, Sequence[ImageArray]],
    moved: Mapping[str, Sequence[ImageArray]] | None = None,
    settings: LearningSettings | None = None,
) -> tuple[Landmarks, LearningReport]:
    """Landmarks from ``sights``: camera name to one or more simultaneous images (h, w), or images of a scene at rest.

    ``moved``: the same after only the arm has moved; without it every landmark is unsorted.

    Raises DriverError: ``images`` (cameras or sizes do not fit, no texture), ``too_few_matches``, ``no_landmarks``.
    """
    options = settings or LearningSettings()
    pictures = _means(views, "images")
    if len(pictures) < 2:
        raise DriverError(
            "images", f"images of {len(pictures)} camera(s); landmarks are matched between cameras: give at least two"
        )
    names = list(pictures)
    base = names[0]
    corners = find_corners(pictures[base], options)
    m = len(corners)
    pixels, sigmas = {base: corners}, {base: np.zeros(m)}
    reports, seen = [], np.zeros(m, np.bool_)
    for name in names[1:]:
        found, kept, report = _match_pair(
            (base, name), pictures[base], pictures[name], corners, len(views[base]), options
        )
        reports.append(report)
        pixels[name] = np.where(kept[:, None], found.pixels, np.nan)
        sigmas[name] = np.where(kept, np.sqrt(0.5 * np.trace(found.covariances, axis1=1, axis2=2)), 0.0)
        seen |= kept
    kinds, sorted_out = np.full(m, KINDS.index("unsorted")), np.zeros(m, np.bool_)
    if moved is not None:
        kinds, known = sort_landmarks(pictures, pixels, _checked_moved(pictures, moved), options)
        sorted_out = seen & ~known
        seen &= known
    if not seen.any():
        raise DriverError(
            "no_landmarks",
            f"{int(sorted_out.sum())} landmarks were matched between the cameras, and of none it is clear whether it "
            f"moved by more than {MOVED_PX:g} px or stayed: move the last joint further, keep everything else still",
            matched=int(sorted_out.sum()),
        )
    rows = _chosen(seen, kinds, options.most)
    references = tuple(
        CameraReference(
            name,
            pictures[name],
            len(views[name]),
            np.ascontiguousarray(pixels[name][rows]),
            np.ascontiguousarray(sigmas[name][rows]),
        )
        for name in names
    )
    ids = options.first_id + np.arange(len(rows), dtype=np.int64)
    return Landmarks(ids, kinds[rows].astype(np.int64), references), LearningReport(
        tuple(reports), int(sorted_out.sum())
    )


def _chosen(seen: BoolArray, kinds: IntArray, most: int) -> IntArray:
    """Rows of up to ``most`` landmarks, the strongest (first) of each kind, such that no kind displaces another."""
    rank = np.zeros(len(seen), np.int64)
    for kind in range(len(KINDS)):
        mine = seen & (kinds == kind)
        rank[mine] = np.arange(int(mine.sum()))
    rows = np.flatnonzero(seen)
    chosen: IntArray = np.sort(rows[np.argsort(rank[rows], kind="stable")][:most])
    return chosen


def find_corners(picture: ImageArray, settings: LearningSettings) -> FloatArray:
    """Corners (n, 2) [px] of an image, the strongest first. Raises DriverError (``images``) for fewer than eight."""
    found = cv2.goodFeaturesToTrack(picture, 4 * settings.most, 0.005, settings.spacing_px, blockSize=5)
    corners = np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)
    margin = settings.half + 3
    size = np.array(picture.shape[::-1])
    corners = corners[((corners >= margin) & (corners <= size - 1 - margin)).all(axis=1)]
    if len(corners) < MIN_MATCHES:
        raise DriverError(
            "images",
            f"{len(corners)} corners in the first camera's picture; at least {MIN_MATCHES} are needed: is it in focus "
            "and lit, and does anything in it have texture?",
            corners=len(corners),
        )
    return corners


def _means(views: Mapping[str, Sequence[ImageArray]], what: str) -> dict[str, ImageArray]:
    pictures = {}
    for name, images in views.items():
        shapes = {np.shape(image) for image in images}
        if len(shapes) != 1 or len(next(iter(shapes))) != 2 or min(next(iter(shapes))) < SMALLEST_PICTURE:
            raise DriverError(
                "images",
                f"{what} of camera {name!r} have shapes {sorted(map(str, shapes)) or 'none'}; one shape (height, "
                f"width) of at least {SMALLEST_PICTURE} a side is valid",
                camera=name,
            )
        mean = np.mean([np.asarray(image, dtype=np.float64) for image in images], axis=0)
        pictures[name] = np.clip(np.rint(mean), 0, 255).astype(np.uint8)
    return pictures


def _checked_moved(
    pictures: Mapping[str, ImageArray], moved: Mapping[str, Sequence[ImageArray]]
) -> dict[str, ImageArray]:
    after = _means(moved, "images after the motion")
    if set(after) != set(pictures):
        raise DriverError(
            "images",
            f"images after the motion are of {', '.join(sorted(after))}, those before it of "
            f"{', '.join(sorted(pictures))}; the same cameras are needed",
        )
    for name, picture in pictures.items():
        if after[name].shape != picture.shape:
            raise DriverError(
                "images",
                f"camera {name!r}: images of {picture.shape} before and {after[name].shape} after the motion",
                camera=name,
            )
    return {name: after[name] for name in pictures}


def _match_pair(
    names: tuple[str, str],
    left: ImageArray,
    right: ImageArray,
    corners: FloatArray,
    averaged: int,
    settings: LearningSettings,
) -> tuple[Alignment, BoolArray, PairReport]:
    """Matches (m, 2) of the corners of ``left`` in ``right``, and which of them are accepted."""
    first = find_keypoints(left, settings.keypoints, settings.tilts)
    second = find_keypoints(right, settings.keypoints, settings.tilts)
    matches = match_keypoints(first, second)
    pyramid = build_pyramid(right, TEMPLATE_LEVELS)
    patches = ReferencePatches(left, corners, settings.half, averaged)
    found = nothing(len(corners))
    planes = find_planes(first.pixels[matches[:, 0]], second.pixels[matches[:, 1]])
    for rows, warps, where in starts_from_planes(planes, corners, settings.radius_px):
        if len(rows):
            take_better(found, rows, *seek(patches, pyramid, rows, warps, where, settings.least_correlation))
    aligned = _passes_backward_check(found, left, right, corners, settings)
    count = int(aligned.sum())
    if count < MIN_MATCHES:
        raise _too_few(names, len(corners), len(matches), count)
    consistent, F, rms, planar = _epipolar(corners, found, aligned, settings, names, len(matches))
    unique = consistent & _unique(left, right, corners, found, consistent, F, settings)
    if int(unique.sum()) < MIN_MATCHES:
        raise _too_few(names, len(corners), len(matches), int(unique.sum()))
    return (
        found,
        unique,
        PairReport(*names, len(corners), len(matches), count, int(consistent.sum()), int(unique.sum()), rms, planar),
    )


def _too_few(names: tuple[str, str], corners: int, matches: int, agreeing: int) -> DriverError:
    return DriverError(
        "too_few_matches",
        f"cameras {names[0]!r} and {names[1]!r}: {agreeing} of {corners} corners were found in both ({matches} "
        f"keypoints matched); at least {MIN_MATCHES} are needed: show both the same textured things, from nearer "
        "directions, in focus",
        cameras=list(names),
        corners=corners,
        keypoint_matches=matches,
        agreeing=agreeing,
        needed=MIN_MATCHES,
    )


def _passes_backward_check(
    found: Alignment, left: ImageArray, right: ImageArray, corners: FloatArray, settings: LearningSettings
) -> BoolArray:
    """Mask of matches that pass the backward check: aligned in reverse, by patches of the right image."""
    rows = np.flatnonzero(found.found)
    back = ReferencePatches(right, found.pixels[rows], settings.half)
    inverse: FloatArray = np.linalg.inv(found.A[rows])
    result, good = seek(
        back,
        build_pyramid(left, TEMPLATE_LEVELS),
        np.arange(len(rows)),
        inverse,
        corners[rows],
        settings.least_correlation,
        0,
    )
    returned = np.zeros(len(corners), np.bool_)
    returned[rows] = good & (np.linalg.norm(result.pixels - corners[rows], axis=1) <= BACK_PX)
    return returned


def _epipolar(
    corners: FloatArray,
    found: Alignment,
    aligned: BoolArray,
    settings: LearningSettings,
    names: tuple[str, str],
    matches: int,
) -> tuple[BoolArray, FloatArray | None, float, bool]:
    """Mask (m,) of matches consistent with one epipolar geometry by chi-square; F (3, 3) or None for a plane; rms
    [px]; planar.
    """
    rows = np.flatnonzero(aligned)
    left, right = corners[rows], found.pixels[rows]
    try:
        F, inliers = fundamental_robust(left, right, 2.0 * settings.epipolar_px, refuse_plane=False)
        planar = parallax_ratio(F, left[inliers], right[inliers]) < AS_A_PLANE
    except GeometryError as error:
        raise _too_few(names, len(corners), matches, 0) from error
    kept = np.zeros(len(corners), np.bool_)
    if planar:
        kept[rows[inliers]] = True
        return kept, None, float(np.sqrt(np.mean(sampson_distances(F, left, right)[inliers] ** 2))), True
    distances = sampson_distances(F, left, right)
    variances = 0.5 * np.trace(found.covariances[rows], axis1=1, axis2=2) + settings.epipolar_px**2
    good = distances**2 <= INLIER_SIGMAS**2 * variances
    kept[rows[good]] = True
    if int(good.sum()) < MIN_MATCHES:
        raise _too_few(names, len(corners), matches, int(good.sum()))
    return kept, F, float(np.sqrt(np.mean(distances[good] ** 2))), False


def _unique(
    left: ImageArray,
    right: ImageArray,
    corners: FloatArray,
    found: Alignment,
    chosen: BoolArray,
    F: FloatArray | None,
    settings: LearningSettings,
) -> BoolArray:
    """Mask (m,) of matches without a similar second match near their epipolar lines, in either image."""
    unique, half = np.zeros(len(corners), np.bool_), settings.half
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float32)
    for k in np.flatnonzero(chosen):
        A, p, r = found.A[k], found.pixels[k], corners[k]
        inverse = np.linalg.inv(A)
        # The left patch as the right camera sees it.
        u = (r[0] + inverse[0, 0] * x + inverse[0, 1] * y).astype(np.float32)
        v = (r[1] + inverse[1, 0] * x + inverse[1, 1] * y).astype(np.float32)
        warped = cv2.remap(left, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        own = cv2.getRectSubPix(left, (2 * half + 1, 2 * half + 1), (float(r[0]), float(r[1])))
        line = None if F is None else F @ np.array([*r, 1.0])
        back = None if F is None else np.array([*p, 1.0]) @ F
        limit = found.correlations[k] - settings.margin
        unique[k] = _rival(right, warped, p, line, half) < limit and _rival(left, own, r, back, half) < limit
    return unique


def _rival(picture: ImageArray, patch: ImageArray, at: FloatArray, line: FloatArray | None, half: int) -> float:
    """Best correlation of ``patch`` at other places than ``at`` [px], within ``BAND_PX`` of ``line`` (3,); None:
    anywhere.
    """
    scores = cv2.matchTemplate(picture, patch, cv2.TM_CCOEFF_NORMED)
    v, u = np.mgrid[: scores.shape[0], : scores.shape[1]] + half
    elsewhere = np.maximum(np.abs(u - at[0]), np.abs(v - at[1])) > half
    if line is not None:
        elsewhere &= np.abs(line[0] * u + line[1] * v + line[2]) <= BAND_PX * np.hypot(line[0], line[1])
    elsewhere &= np.isfinite(scores)
    return float(scores[elsewhere].max()) if elsewhere.any() else -1.0


def sort_landmarks(
    before: Mapping[str, ImageArray],
    pixels: Mapping[str, FloatArray],
    after: Mapping[str, ImageArray],
    settings: LearningSettings,
) -> tuple[IntArray, BoolArray]:
    """Kinds (m,) of landmarks at ``pixels`` (m, 2) of the images ``before`` a motion, and which are certain (m,).

    Tool: moved in some camera, static in none. Scene: static in some, moved in none. If a motion along the line of
    sight leaves a landmark at its place in one camera, its kind is uncertain.
    """
    m = len(next(iter(pixels.values())))
    stayed, moved = np.zeros(m, np.bool_), np.zeros(m, np.bool_)
    for name, picture in before.items():
        still, gone = _motion(picture, pixels[name], after[name], settings)
        stayed |= still
        moved |= gone
    kinds = np.where(moved, KINDS.index("tool"), KINDS.index("static"))
    return kinds, moved ^ stayed


def _motion(
    before: ImageArray, pixels: FloatArray, after: ImageArray, settings: LearningSettings
) -> tuple[BoolArray, BoolArray]:
    """Masks (m,) of one camera's landmarks that are static, and that moved; those not found again are in neither."""
    m = len(pixels)
    patches = ReferencePatches(before, pixels, settings.half)
    pyramid = build_pyramid(after, TEMPLATE_LEVELS)
    rows = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    alike = settings.least_correlation - 0.05
    result, good = seek(patches, pyramid, rows, np.tile(np.eye(2), (len(rows), 1, 1)), pixels[rows], alike, coarse=0)
    offsets = result.pixels - pixels[rows]
    sigmas = np.sqrt(0.5 * np.trace(result.covariances, axis1=1, axis2=2))
    near = np.linalg.norm(offsets, axis=1) <= np.minimum(STAYED_PX, STAYED_SIGMAS * sigmas + 0.1)
    stayed, moved = np.zeros(m, np.bool_), np.zeros(m, np.bool_)
    stayed[rows] = good & near
    found = search_by_keypoints(
        patches,
        find_keypoints(before, settings.keypoints),
        find_keypoints(after, settings.keypoints),
        pyramid,
        alike,
        settings.radius_px,
        shifted_px=MOVED_PX,
    )
    with np.errstate(invalid="ignore"):
        moved = found.found & (np.linalg.norm(found.pixels - pixels, axis=1) >= MOVED_PX)
    return stayed, moved


COLOURS = ((60, 160, 255), (90, 220, 90), (220, 220, 60))
"""Colours of tool, scene, unsorted (BGR)."""
SHIFT = 4


def draw_landmarks(landmarks: Landmarks) -> ImageArray:
    """Image (h, w, 3) BGR of the cameras side by side: orange tool, green scene, blue unsorted; lines join a
    landmark in the first camera and in the others.
    """
    height = max(camera.picture.shape[0] for camera in landmarks.cameras)
    parts, left = [], []
    for camera in landmarks.cameras:
        left.append(sum(part.shape[1] for part in parts))
        part = np.zeros((height, camera.picture.shape[1], 3), np.uint8)
        part[: camera.picture.shape[0]] = camera.picture[:, :, None]
        parts.append(part)
    drawn = np.hstack(parts)
    joined = drawn.copy()
    for k, kind in enumerate(landmarks.kinds.tolist()):
        places = []
        for camera, shift in zip(landmarks.cameras, left, strict=True):
            if np.isfinite(camera.pixels[k]).all():
                at = (camera.pixels[k] + np.array([shift, 0.0])) * 2**SHIFT
                places.append((int(at[0]), int(at[1])))
        for place in places:
            cv2.circle(drawn, place, 3 * 2**SHIFT, COLOURS[kind], 1, cv2.LINE_AA, SHIFT)
        for place in places[1:]:
            cv2.line(joined, places[0], place, COLOURS[kind], 1, cv2.LINE_AA, SHIFT)
    return np.asarray(cv2.addWeighted(drawn, 0.7, joined, 0.3, 0.0), dtype=np.uint8)
