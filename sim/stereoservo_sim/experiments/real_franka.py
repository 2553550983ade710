"""Experiment with real images: fixed uncalibrated cameras, calibrated from a real arm's recorded displacements
alone.

A tag on the hand is found in the images. The product's fit takes the arm's poses as those of a free arm
(`calibration.known_arm`), and its model predicts held-out poses, with the covariance of the prediction.
Folds are fixed: pose index modulo FOLDS is held out. The error is the distance of a predicted corner from the measured
one [px], over *all* held-out corners.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from rich.console import Console
from scipy.stats import binom
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.known_arm import LEAST_VIEWS, frame_of_known_arm, free_arm, trials_of_poses
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import (
    CalibrationError,
    StaticObservations,
    TrialCamera,
    TrialData,
)
from stereoservo.geometry.cameras import camera_centre, triangulate
from stereoservo.geometry.distortion import undistort
from stereoservo.geometry.homogeneous import from_homogeneous
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo_sim.experiments.experiment import ExperimentError, whole_table
from stereoservo_sim.experiments.figures import Figures, picture
from stereoservo_sim.experiments.hand_eye_data import (
    DICTIONARY_NAME,
    STANDING,
    TAG_IDS,
    Flatness,
    HandEyeSet,
    find_standing_tags,
    find_tags,
    flatness,
    load_hand_eye_set,
    median_image,
    read_image,
    register_tag,
    tag_cells,
)
from stereoservo_sim.progress import ProgressCall

GreyImage = npt.NDArray[np.uint8]

FOLDS = 5
TABLE_TAGS = (0, 2, 3)
FEW_POSES, SUBSETS = 12, 10
"""Poses of a small training set, and default number of such sets."""
INSIDE = 0.95
"""Probability of the ellipses in which held-out corners are counted."""
FAR = 4.0
"""Standard deviations beyond which a corner is far from its prediction."""
OPENCV_SIGMA = 0.3
"""Standard deviation [px] stated for cv2's subpixel corners; the fit estimates a larger one."""
STILL_PX, STILL_M = 3.0, 0.05
"""A tag that moves by less in every image while the hand moves by more is not on the hand."""


@dataclass(frozen=True)
class Observations:
    """Detections in the images. ``camera`` (v,) indexes ``cameras``; ``pose`` (v,) is the pose index of the file names.

    ``pixels`` (v, 4, 2) registered corners with ``sigmas`` (v, 4), ``start`` (v, 4, 2) those of cv2's subpixel
    refinement [px].
    ``backgrounds``: the median image of each camera; ``standing``: table tags found there, corners (4, 2) by id.
    """

    cameras: list[int]
    sizes: IntArray
    camera: IntArray
    pose: IntArray
    pixels: FloatArray
    sigmas: FloatArray
    start: FloatArray
    registered: BoolArray
    images_read: int
    backgrounds: list[GreyImage]
    standing: list[dict[int, FloatArray]]


@dataclass(frozen=True)
class PoseViews:
    """The arm's poses ``positions`` (n, 6), as those of a free arm of ``generators`` (6, 4, 4) whose zero is the
    displacement ``zero`` (4, 4), and the tag's corners at them, ``pixels`` (c, n, 4, 2) and ``sigmas`` (c, n, 4) [px].
    """

    cameras: tuple[TrialCamera, ...]
    displacements: FloatArray
    positions: FloatArray
    generators: FloatArray
    zero: FloatArray
    pixels: FloatArray
    sigmas: FloatArray

    def trials(self, stops: BoolArray) -> tuple[TrialData, IntArray]:
        """Trial data of the poses selected by ``stops`` (n,), and the cameras that show the tag in enough of them."""
        shown = np.isfinite(self.pixels).all(axis=(2, 3))
        kept = np.flatnonzero((shown & stops).sum(axis=1) >= LEAST_VIEWS)
        if len(kept) < 2:
            count = (shown & stops).sum(axis=1).tolist()
            raise ExperimentError(
                "too_few_poses",
                f"the tag is seen in {count} poses by the cameras; at least two need {LEAST_VIEWS}",
                views=count,
                needed=LEAST_VIEWS,
            )
        used = np.flatnonzero(stops & shown[kept].any(axis=0))
        whole = trials_of_poses(
            self.displacements,
            [self.cameras[c] for c in kept],
            range(4),
            self.pixels[kept],
            self.sigmas[kept],
        )
        return msgspec.structs.replace(
            whole,
            positions=whole.positions[used],
            trials=whole.trials[used],
            pixels=whole.pixels[:, used],
            sigmas=whole.sigmas[:, used],
        ), kept


@dataclass(frozen=True)
class PoseFit:
    """The product's ``fit`` to some poses, with the cameras ``kept`` (indices)."""

    fit: CalibrationFit
    kept: IntArray
    views: PoseViews

    def predict(self) -> tuple[FloatArray, FloatArray]:
        """Predicted pixels (c, n, 4, 2) at all poses, and the covariances (c, n, 4, 2, 2) of measurements there;
        NaN for cameras that were not kept.
        """
        pixels = np.full(self.views.pixels.shape, np.nan)
        covariances = np.full((*pixels.shape, 2), np.nan)
        factor = max(1.0, self.fit.report.sigma_factor) ** 2
        pixels[self.kept], of_model = pixel_covariances(self.fit.model, self.views.positions)
        noise = (factor * self.views.sigmas[self.kept] ** 2)[..., None, None] * np.eye(2)
        covariances[self.kept] = of_model + noise
        return pixels, covariances

    @cached_property
    def camera_to_base(self) -> FloatArray:
        """Rigid ``H`` (4, 4) [m] from the first camera's frame to the arm's base."""
        return np.asarray(np.linalg.inv(frame_of_known_arm(self.fit.model, self.views.generators)))

    @property
    def to_base(self) -> FloatArray:
        """``H`` (4, 4) from the model's frame to the arm's base [m]."""
        upgrade = self.fit.model.projective_to_euclidean
        assert upgrade is not None
        return np.asarray(self.camera_to_base @ upgrade)

    @property
    def matrices(self) -> FloatArray:
        """Cameras (c, 3, 4) from the arm's base [m] to ideal pixels."""
        back = np.linalg.inv(self.to_base)
        return np.array([camera.matrix @ back for camera in self.fit.model.cameras])

    @property
    def corners(self) -> FloatArray:
        """Corners (4, 3) of the tag in the hand [m]."""
        points = self.fit.model.marker_points @ self.to_base.T @ np.linalg.inv(self.views.zero).T
        return np.asarray(points[:, :3] / points[:, 3:])


@dataclass(frozen=True)
class HeldOut:
    """Held-out ``errors`` (c, n, 4, 2) [px], predicted minus measured, and their ``squares`` (c, n, 4) normalised by
    the predicted covariances; NaN without prediction. ``deviations`` (c, n, 4) [px], per axis. ``fits`` by fold.
    """

    errors: FloatArray
    squares: FloatArray
    deviations: FloatArray
    fits: tuple[tuple[int, PoseFit], ...] = ()

    def over(self, other: HeldOut) -> HeldOut:
        """These, with missing ones taken from ``other``."""
        names = ("errors", "squares", "deviations")
        pairs = ((getattr(self, name), getattr(other, name)) for name in names)
        return HeldOut(*(np.where(np.isfinite(own), own, others) for own, others in pairs))

    @property
    def distances(self) -> FloatArray:
        """Distances (k,) [px] of the predicted corners."""
        return np.asarray(np.linalg.norm(self.errors[np.isfinite(self.squares)], axis=1))


@dataclass(frozen=True)
class Coverage:
    """Number of ``corners`` in ``views`` inside their ``INSIDE`` ellipses, the 99 % interval of that share with
    correlated corners of a view, and the largest distance in predicted standard deviations.
    """

    corners: int
    views: int
    inside: float
    interval: tuple[float, float]
    largest: float
    beyond: int


@dataclass(frozen=True)
class FewPoses:
    """A training set of ``FEW_POSES`` poses: its ``seed``, the prediction of the others; or why it was ``refused``."""

    seed: int
    poses: tuple[int, ...]
    held_out: HeldOut | None
    refused: str = ""


@dataclass(frozen=True)
class Triangulated:
    """Triangulation errors: the cameras (indices) used, and the distances ``errors`` (n,) [m] of the corners from
    their true positions.
    """

    cameras: tuple[int, ...]
    errors: FloatArray

    @property
    def rms_mm(self) -> float:
        """Root mean square distance [mm]."""
        return float(1e3 * np.sqrt(np.mean(self.errors**2)))


@dataclass(frozen=True)
class RealFrankaResult:
    """All data for report and plots. ``variants``: held-out poses by other lenses and other corners;
    ``indices`` (n,) of the poses.
    """

    directory: Path
    hand_tag: int
    seed: int
    indices: IntArray
    views: PoseViews
    observations: Observations
    whole: PoseFit
    held_out: HeldOut
    variants: dict[str, HeldOut]
    few: tuple[FewPoses, ...]
    table: Flatness
    triangulated: list[Triangulated]


def run_real_franka(
    directory: Path,
    *,
    hand_tag: int = 9,
    table_tags: tuple[int, ...] = TABLE_TAGS,
    few_sets: int = SUBSETS,
    seed: int = 0,
    progress: ProgressCall | None = None,
) -> RealFrankaResult:
    """Detect, fit, predict. ``progress`` is called with (stage, done, total). ``seed``: first of the seeds that draw
    ``few_sets`` small training sets.

    Raises ExperimentError: the errors of :func:`load_hand_eye_set`, the codes of the fit, ``tag_id``, ``image``,
    ``image_size``, ``tag_not_seen``, ``tag_stands_still``, ``too_few_poses``.
    """
    for tag in (hand_tag, *table_tags):
        if not 0 <= tag < TAG_IDS:
            raise ExperimentError("tag_id", f"tag {tag} is not in {DICTIONARY_NAME}: 0..{TAG_IDS - 1}", tag=tag)
    table_tags = tuple(tag for tag in table_tags if tag != hand_tag)
    tell: ProgressCall = progress or (lambda stage, done, total: None)
    data = load_hand_eye_set(directory)
    seen = observe(data, hand_tag, table_tags, tell)

    indices = np.array(sorted(data.poses))
    displacements = np.stack([data.poses[i] for i in indices])
    views = pose_views(displacements, indices, seen, seen.pixels, seen.sigmas)
    _check_that_tag_follows(seen, hand_tag, displacements[np.searchsorted(indices, seen.pose)])
    fold = indices % FOLDS
    try:
        tell("fit", 0, 4)
        whole = fit_poses(views, np.ones(len(indices), dtype=bool), standing=seen.standing, table_tags=table_tags)
        tell("fit", 1, 4)
        held_out = cross_validate(views, fold)
        tell("fit", 2, 4)
        variants = _variants(views, pose_views(displacements, indices, seen, seen.start, None), fold)
        tell("fit", 3, 4)
        few = tuple(_from_few_poses(views, indices, one) for one in range(seed, seed + few_sets))
        tell("fit", 4, 4)
    except CalibrationError as error:
        raise ExperimentError(error.code, str(error), **error.data) from error
    return RealFrankaResult(
        directory, hand_tag, seed, indices, views, seen, whole, held_out, variants, few,
        flatness(whole.fit.model, table_tags), triangulation_errors(held_out.fits, views, fold),
    )  # fmt: skip


def pose_views(
    displacements: FloatArray,
    indices: IntArray,
    seen: Observations,
    corners: FloatArray,
    sigmas: FloatArray | None,
) -> PoseViews:
    """The views at ``displacements`` (n, 4, 4) of the pose ``indices`` (n,), with these ``corners`` (v, 4, 2) [px]."""
    positions, generators, zero = free_arm(displacements)
    at = seen.camera, np.searchsorted(indices, seen.pose)
    pixels = np.full((len(seen.cameras), len(indices), 4, 2), np.nan)
    noise = np.full(pixels.shape[:3], np.nan)
    pixels[at], noise[at] = corners, OPENCV_SIGMA if sigmas is None else sigmas
    cameras = tuple(
        TrialCamera(f"cam{number}", int(width), int(height))
        for number, (width, height) in zip(seen.cameras, seen.sizes, strict=True)
    )
    return PoseViews(cameras, displacements, positions, generators, zero, pixels, noise)


def observe(data: HandEyeSet, hand_tag: int, table_tags: tuple[int, ...], progress: ProgressCall) -> Observations:
    """Find the hand tag in every image, and the table tags in each camera's median image."""
    cells = tag_cells(hand_tag)
    found, sizes, backgrounds, standing = [], [], [], []
    done = 0
    for number, camera in enumerate(data.cameras):
        images: list[GreyImage] = []
        for pose, path in sorted((p, path) for (p, c), path in data.images.items() if c == camera):
            image = read_image(path)
            if images and image.shape != images[0].shape:
                (height, width), (h, w) = image.shape, images[0].shape
                raise ExperimentError(
                    "image_size",
                    f"{path} is {width}x{height}, earlier images of camera {camera} are {w}x{h}",
                    image=str(path),
                )
            images.append(image)
            start = find_tags(image).get(hand_tag)
            if start is not None:
                found.append((number, pose, register_tag(image, start, cells)))
            done += 1
            progress("detect", done, len(data.images))
        sizes.append(images[0].shape[::-1])
        backgrounds.append(median_image(images))
        standing.append(find_standing_tags(backgrounds[-1], table_tags))
    if not found:
        raise ExperimentError(
            "tag_not_seen",
            f"tag {hand_tag} of {DICTIONARY_NAME} is in none of the {done} images of {data.directory}",
            tag=hand_tag,
            images=done,
        )
    return Observations(
        data.cameras,
        np.array(sizes, dtype=np.int64),
        np.array([number for number, _, _ in found], dtype=np.int64),
        np.array([pose for _, pose, _ in found], dtype=np.int64),
        np.stack([view.corners for _, _, view in found]),
        np.stack([view.sigmas for _, _, view in found]),
        np.stack([view.start for _, _, view in found]),
        np.array([view.registered for _, _, view in found]),
        done,
        backgrounds,
        standing,
    )


def _check_that_tag_follows(seen: Observations, hand_tag: int, displacements: FloatArray) -> None:
    """Raise ``tag_stands_still`` if the hand moved, by ``displacements`` (v, 4, 4), but the tag did not, in any
    camera.
    """
    middles = seen.pixels.mean(axis=1)
    spread = [np.ptp(middles[seen.camera == c], axis=0).max(initial=0.0) for c in np.unique(seen.camera)]
    travel = float(np.ptp(displacements[:, :3, 3], axis=0).max())
    if len(seen.pose) > 1 and max(spread) < STILL_PX and travel > STILL_M:
        raise ExperimentError(
            "tag_stands_still",
            f"tag {hand_tag} moves by {max(spread):.2f} px at most while the hand moves by {travel:.2f} m; "
            "is it on the table? --hand-tag names the one on the hand",
            tag=hand_tag,
            travel_m=travel,
        )


def fit_poses(
    views: PoseViews,
    stops: BoolArray,
    options: FitOptions | None = None,
    *,
    standing: list[dict[int, FloatArray]] | None = None,
    table_tags: tuple[int, ...] = (),
) -> PoseFit:
    """The product's fit to the poses selected by ``stops`` (n,); ``standing``: corners of ``table_tags`` by camera,
    which become static points.

    Raises CalibrationError, and ExperimentError (``too_few_poses``).
    """
    trials, kept = views.trials(stops)
    static = _static([standing[c] for c in kept], table_tags, float(np.nanmedian(trials.sigmas))) if standing else None
    fit = fit_model(msgspec.structs.replace(trials, static=static), epoch=1, options=options or FitOptions())
    return PoseFit(fit, kept, views)


def _static(standing: list[dict[int, FloatArray]], tags: tuple[int, ...], sigma: float) -> StaticObservations | None:
    """Corners of static tags as markers with ids STANDING plus four times the tag's id, plus the corner's number."""
    found = [tag for tag in tags if any(tag in camera for camera in standing)]
    if not found:
        return None
    missing = np.full((4, 2), np.nan)
    pixels = np.stack([np.concatenate([camera.get(tag, missing) for tag in found]) for camera in standing])
    ids = tuple(STANDING + 4 * tag + corner for tag in found for corner in range(4))
    return StaticObservations(ids, pixels, np.where(np.isfinite(pixels).all(axis=2), sigma, np.nan))


def cross_validate(views: PoseViews, fold: IntArray, options: FitOptions | None = None) -> HeldOut:
    """Prediction of each fold (n,) from the others; NaN if no fold could predict it.

    Raises CalibrationError, and ExperimentError (``too_few_poses``) if nothing could be predicted.
    """
    whole: HeldOut | None = None
    fits = []
    for number in np.unique(fold):
        out = fold == number
        try:
            fitted = fit_poses(views, ~out, options)
        except ExperimentError as error:
            few = error
            continue
        fits.append((int(number), fitted))
        part = judged(fitted, out)
        whole = part if whole is None else part.over(whole)
    if whole is None:
        raise few
    return HeldOut(whole.errors, whole.squares, whole.deviations, tuple(fits))


def judged(fitted: PoseFit, out: BoolArray) -> HeldOut:
    """Prediction of a fit at the poses selected by ``out`` (n,)."""
    pixels, covariances = fitted.predict()
    errors = pixels - fitted.views.pixels
    errors[:, ~out] = np.nan
    known = np.isfinite(errors).all(axis=3)
    squares, deviations = np.full(known.shape, np.nan), np.full(known.shape, np.nan)
    squares[known] = np.einsum("ka,kab,kb->k", errors[known], np.linalg.inv(covariances[known]), errors[known])
    deviations[known] = np.sqrt(np.trace(covariances[known], axis1=1, axis2=2) / 2.0)
    return HeldOut(errors, squares, deviations)


def coverage(held: HeldOut) -> Coverage:
    """Validity of the predicted covariances. Corners of one view share the error of the arm's pose: the scatter of
    their share is at most that of as many trials as there are views.
    """
    known = np.isfinite(held.squares)
    squares, count = held.squares[known], int(known.any(axis=2).sum())
    low, high = (float(binom.ppf(tail, count, INSIDE)) / count for tail in (0.005, 0.995))
    limit = float(chi2_distribution.ppf(INSIDE, 2))
    return Coverage(
        int(known.sum()),
        count,
        float((squares <= limit).mean()),
        (low, high),
        float(np.sqrt(squares.max())),
        int((squares > FAR**2).sum()),
    )


def _variants(views: PoseViews, opencv: PoseViews, fold: IntArray) -> dict[str, HeldOut]:
    """Held-out poses by lenses not left to the data, and by cv2's corners."""
    pinhole = FitOptions(lens="none")
    wanted: dict[str, Callable[[], HeldOut]] = {
        "no lens": lambda: cross_validate(views, fold, pinhole),
        "cv2 subpixel corners": lambda: cross_validate(opencv, fold),
        "cv2 subpixel corners, no lens": lambda: cross_validate(opencv, fold, pinhole),
    }
    return {name: run() for name, run in wanted.items()}


def _from_few_poses(views: PoseViews, indices: IntArray, seed: int) -> FewPoses:
    """Prediction of all other poses from FEW_POSES random ones."""
    n = len(indices)
    chosen = np.random.default_rng(seed).choice(n, min(FEW_POSES, n - 1), replace=False)
    inside = np.isin(np.arange(n), chosen)
    poses = tuple(int(i) for i in indices[inside])
    try:
        return FewPoses(seed, poses, judged(fit_poses(views, inside), ~inside))
    except (CalibrationError, ExperimentError) as error:
        return FewPoses(seed, poses, None, f"{error.code}: {error}")


def triangulation_errors(
    folds: tuple[tuple[int, PoseFit], ...], views: PoseViews, fold: IntArray
) -> list[Triangulated]:
    """Each set of two or more of the cameras fitted in every fold, the largest set last; corners of held-out poses in
    which all these cameras saw the tag.
    """
    if not folds:
        return []
    common = sorted(set.intersection(*(set(fitted.kept.tolist()) for _, fitted in folds)))
    shown = np.isfinite(views.pixels).all(axis=(2, 3))
    subsets = [s for size in range(2, len(common) + 1) for s in combinations(common, size)]
    errors: dict[tuple[int, ...], list[FloatArray]] = {subset: [] for subset in subsets}
    for number, fitted in folds:
        model, to_base = fitted.fit.model, fitted.to_base
        chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero)
        for stop in np.flatnonzero((fold == number) & shown[common].all(axis=0)):
            moved = chain.displacement(views.positions[stop])
            truth = from_homogeneous(model.marker_points @ moved.T @ to_base.T)
            for subset in subsets:
                rows = [int(np.flatnonzero(fitted.kept == c)[0]) for c in subset]
                ideal = np.array(
                    [
                        undistort(model.cameras[row].lens, views.pixels[c, stop])
                        for c, row in zip(subset, rows, strict=True)
                    ]
                )
                matrices = np.array([model.cameras[row].matrix for row in rows])
                points = triangulate(matrices, ideal)
                errors[subset].append(np.linalg.norm(from_homogeneous(points @ to_base.T) - truth, axis=1))
    return [Triangulated(s, np.concatenate(found)) for s, found in errors.items() if found]


# -- report and figures ----------------------------------------------------------------------------------------

REFERENCE = {
    "median_px": 0.66,
    "rms_px": 0.86,
    "tag_sides_mm": [38.94, 39.09],
    "table_flatness_mm": 0.48,
    "corners": "cv2 CORNER_REFINE_SUBPIX, no radial term",
    "data": "fairo_franka/set_a, hand tag 9",
}
"""Former measurements on that set; for other sets they are only a scale."""

THESIS = {
    "rms_px": [0.09, 0.16],
    "what": "residual of the thesis's own self-calibration: dots, another arm, not held out",
}

MAGNIFIED = 40
"""Scale of the error arrows in the overlay."""

STATE = "distance of a predicted tag corner from the measured one [px], over all corners of held-out poses"


def report_real_franka(result: RealFrankaResult) -> dict[str, Any]:
    """JSON object of ``reproduce real-franka``."""
    seen, whole, table = result.observations, result.whole, result.table
    corners, report = whole.corners, whole.fit.report
    sides = 1e3 * np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    kept = whole.kept.tolist()
    return {
        "experiment": "real-franka",
        **_figures(result.held_out, result),
        "uncertainty": _uncertainty(result.held_out),
        "few_poses": _few_poses(result),
        "tag_side_mm": float(sides.mean()),
        "tag_sides_mm": sides.tolist(),
        "table_flatness_mm": table.rms_mm,
        "table_flatness_reason": table.reason,
        "table_tags": list(table.tags),
        "table_corners": len(table.points),
        "reference": REFERENCE,
        "thesis": THESIS,
        "error_is": STATE,
        "folds": f"pose index modulo {FOLDS}",
        "rows": _rows(result),
        "variants": {
            "lens chosen on training poses": {
                **_figures(result.held_out, result),
                "lenses": {str(fold): fitted.fit.report.lens.model for fold, fitted in result.held_out.fits},
            },
            **{name: _figures(held, result) for name, held in result.variants.items()},
        },
        "fit": {
            "rms_px": report.rms_px,
            "lens": report.lens.model,
            "sigma_factor": report.sigma_factor,
            "chi2": report.chi2,
            "degrees_of_freedom": report.degrees_of_freedom,
            "outliers": len(report.outliers),
            "tag_offset_m": corners.mean(axis=0).tolist(),
            "cameras": {one.name: one.intrinsics for one in report.cameras},
            "pose_errors": [
                {"axis": one.name, "random": one.random, "by_posture": one.posture, "rms_px": one.pixels}
                for one in report.joints
            ],
            "notes": list(report.notes),
        },
        "triangulation": [
            {
                "cameras": _names(result, list(found.cameras)),
                "rms_mm": found.rms_mm,
                "median_mm": float(1e3 * np.median(found.errors)),
                "corners": len(found.errors),
            }
            for found in result.triangulated
        ],
        "triangulation_is": "distance of triangulated corners of held-out poses from where the arm says that they are",
        "hand_tag": result.hand_tag,
        "dictionary": DICTIONARY_NAME,
        "seed": result.seed,
        "data": str(result.directory),
        "images": {
            "read": seen.images_read,
            "with_hand_tag": len(seen.camera),
            "registered": int(seen.registered.sum()),
            "by_camera": dict(
                zip(
                    _names(result, list(range(len(seen.cameras)))),
                    np.bincount(seen.camera, minlength=len(seen.cameras)).tolist(),
                    strict=True,
                )
            ),
            "poses": len(np.unique(seen.pose)),
            "cameras_left_out": [seen.cameras[i] for i in range(len(seen.cameras)) if i not in kept],
        },
    }


def _uncertainty(held: HeldOut) -> dict[str, Any]:
    """The predicted deviations of held-out corners, and their validity."""
    found = coverage(held)
    return {
        "median_px": float(np.nanmedian(held.deviations)),
        "inside": found.inside,
        "inside_is": f"share of {found.corners} corners in their {INSIDE:.0%} ellipses",
        "interval": list(found.interval),
        "interval_is": f"99 % of the share in {found.views} views, whose corners err together",
        "holds": found.interval[0] <= found.inside <= found.interval[1],
        "largest_sigmas": found.largest,
        f"beyond_{FAR:.0f}_sigmas": found.beyond,
    }


def _few_poses(result: RealFrankaResult) -> dict[str, Any]:
    """Prediction of the remaining poses by training sets of few poses."""
    rows: list[dict[str, Any]] = []
    for one in result.few:
        rows.append({"seed": one.seed, "poses": list(one.poses)})
        if one.held_out is None:
            rows[-1]["refused"] = one.refused
            continue
        rows[-1].update(_figures(one.held_out, result), **_uncertainty(one.held_out))
        del rows[-1]["not_predicted"]  # the training poses are among them
    told = [one for one in rows if "corners" in one]
    return {
        "poses": FEW_POSES,
        "sets": len(rows),
        "refused": len(rows) - len(told),
        "corners": sum(one["corners"] for one in told),
        "max_px": max((one["max_px"] for one in told), default=None),
        "largest_sigmas": max((one["largest_sigmas"] for one in told), default=None),
        f"beyond_{FAR:.0f}_sigmas": sum(one[f"beyond_{FAR:.0f}_sigmas"] for one in told),
        "rows": rows,
    }


def _names(result: RealFrankaResult, cameras: list[int]) -> list[str]:
    return [f"cam{result.observations.cameras[i]}" for i in cameras]


def _figures(held: HeldOut, result: RealFrankaResult) -> dict[str, Any]:
    """Median, rms and largest distance [px], and per axis, of the predicted corners."""
    known = held.errors[np.isfinite(held.squares)]
    distance = np.linalg.norm(known, axis=1)
    measured = int(np.isfinite(result.views.pixels).all(axis=3).sum())
    return {
        "median_px": float(np.median(distance)),
        "rms_px": float(np.sqrt((distance**2).mean())),
        "max_px": float(distance.max()),
        "per_axis": {
            "median_abs_px": np.median(np.abs(known), axis=0).tolist(),
            "rms_px": np.sqrt((known**2).mean(axis=0)).tolist(),
        },
        "corners": len(known),
        "not_predicted": measured - len(known),
    }


def _rows(result: RealFrankaResult) -> list[dict[str, Any]]:
    seen, held = result.observations, result.held_out
    indices = np.unique(seen.pose)
    stops = {int(pose): stop for stop, pose in enumerate(result.indices)}
    lenses = {fold: fitted.fit.report.lens.model for fold, fitted in held.fits}
    rows = []
    for fold in range(FOLDS):
        for c, name in enumerate(_names(result, list(range(len(seen.cameras))))):
            poses = [int(i) for i in indices if i % FOLDS == fold and i in seen.pose[seen.camera == c]]
            if not poses:
                continue
            squares = held.squares[c, [stops[pose] for pose in poses]]
            distance = np.linalg.norm(held.errors[c, [stops[pose] for pose in poses]], axis=2)
            predicted = np.isfinite(squares).all(axis=1)
            known = distance[predicted]
            rows.append(
                {
                    "fold": fold,
                    "camera": name,
                    "poses": poses,
                    "predicted": int(predicted.sum()),
                    "median_px": float(np.median(known)) if known.size else None,
                    "rms_px": float(np.sqrt((known**2).mean())) if known.size else None,
                    "largest_sigmas": float(np.sqrt(squares[predicted].max())) if known.size else None,
                    "lens": lenses.get(fold),
                }
            )
    return rows


def draw_real_franka(result: RealFrankaResult) -> Figures:
    """Residuals, overlay and cameras."""
    painters = {"residuals": _draw_residuals, "overlay": _draw_overlay, "cameras": _draw_cameras}
    found = {name: picture(6.4, 4.8) for name in painters}
    for name, painter in painters.items():
        painter(result, found[name])
    return found


def _draw_residuals(result: RealFrankaResult, figure: Any) -> None:
    seen = result.observations
    figure.set_size_inches(10, 4.5)
    cloud, bars = figure.subplots(1, 2)
    for index, name in enumerate(_names(result, list(range(len(seen.cameras))))):
        errors = result.held_out.errors[index].reshape(-1, 2)
        cloud.plot(errors[:, 0], errors[:, 1], ".", markersize=4, label=name)
    cloud.set(xlabel="u, predicted − measured [px]", ylabel="v [px]", title="held-out corners", aspect="equal")
    cloud.grid(alpha=0.3)
    cloud.legend()
    both = {
        "registered corners": result.held_out,
        "cv2 subpixel corners": result.variants["cv2 subpixel corners"],
    }
    finite = {label: held.distances for label, held in both.items()}
    edges = np.linspace(0, max(float(np.percentile(d, 99.5)) for d in finite.values()), 40)
    for label, distance in finite.items():
        bars.hist(distance, bins=edges, histtype="step", label=f"{label}: median {np.median(distance):.2f} px")
    bars.set(xlabel="distance [px]", ylabel="corners", title="held-out distance")
    bars.legend()


def _draw_overlay(result: RealFrankaResult, figure: Any) -> None:
    seen = result.observations
    count = len(seen.cameras)
    figure.set_size_inches(min(6.5 * count, 26), 5)
    axes = figure.subplots(1, count, squeeze=False)[0]
    closed = [0, 1, 2, 3, 0]
    for index, (axis, name) in enumerate(zip(axes, _names(result, list(range(count))), strict=True)):
        axis.imshow(seen.backgrounds[index], cmap="gray", alpha=0.6)
        inside = np.isfinite(result.held_out.squares[index]).all(axis=1)
        pixels, errors = result.views.pixels[index, inside], result.held_out.errors[index, inside]
        for i, (measured, error) in enumerate(zip(pixels, errors, strict=True)):
            predicted = measured + error
            labels = ("measured", "predicted, held out") if i == 0 else (None, None)
            axis.plot(*measured[closed].T, "-", color="tab:green", linewidth=1.6, label=labels[0])
            axis.plot(*predicted[closed].T, "--", color="tab:red", linewidth=0.8, label=labels[1])
            axis.annotate(str(result.indices[inside][i]), measured.max(axis=0), fontsize=6, color="tab:blue")
        corners, arrows = pixels.reshape(-1, 2), MAGNIFIED * errors.reshape(-1, 2)
        axis.quiver(*corners.T, *arrows.T, angles="xy", scale_units="xy", scale=1, width=0.002, color="tab:purple")
        axis.set(title=f"{name}, errors x{MAGNIFIED}", xticks=[], yticks=[])
        if inside.any():
            axis.legend(fontsize=7)


def _draw_cameras(result: RealFrankaResult, figure: Any) -> None:
    figure.set_size_inches(8, 7)
    axis = figure.add_subplot(projection="3d")
    whole = result.whole
    hand = result.views.displacements @ np.append(whole.corners.mean(axis=0), 1.0)
    axis.scatter(*hand[:, :3].T, color="0.4", s=12, label="tag on the hand")
    if len(result.table.points):
        base = result.table.points @ whole.camera_to_base[:3, :3].T + whole.camera_to_base[:3, 3]
        axis.scatter(*base.T, color="0.7", marker="s", s=12, label="table tags")
    for P, name in zip(whole.matrices, _names(result, whole.kept.tolist()), strict=True):
        centre = from_homogeneous(camera_centre(P)[None])[0]
        seen = hand[:, :3].mean(axis=0)
        depth = float(np.linalg.norm(seen - centre))
        axis.scatter(*centre, s=40, label=name)
        ahead = P[2, :3] / np.linalg.norm(P[2, :3])
        axis.plot(*np.stack([centre, centre + 0.4 * depth * ahead]).T, color="black", linewidth=0.8)
    axis.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="recovered cameras, in the arm's base")
    axis.set_aspect("equal")
    axis.legend()


def show_real_franka(answer: dict[str, Any], console: Console) -> None:
    """Tables of the held-out errors and of the figures beside the reference."""
    reference, told, few = answer["reference"], answer["uncertainty"], answer["few_poses"]
    flat, (low, high) = answer["table_flatness_mm"], told["interval"]
    sides, others = (
        ", ".join(f"{side:.2f}" for side in answer["tag_sides_mm"]),
        "–".join(f"{side:.2f}" for side in reference["tag_sides_mm"]),
    )
    lines = [
        ["median [px]", f"{answer['median_px']:.3f}", f"{reference['median_px']}"],
        ["rms [px]", f"{answer['rms_px']:.3f}", f"{reference['rms_px']}"],
        ["tag sides [mm]", sides, others],
        [
            "table flatness [mm]",
            answer["table_flatness_reason"] if flat is None else f"{flat:.3f}",
            f"{reference['table_flatness_mm']}",
        ],
        ["predicted deviation, median [px]", f"{told['median_px']:.3f}", ""],
        ["inside 95 % ellipses", f"{told['inside']:.1%}", f"{low:.1%} to {high:.1%}"],
        ["largest error [predicted deviations]", f"{told['largest_sigmas']:.2f}", ""],
    ]
    title = "real-franka: held-out poses predicted from the arm's poses"
    whole_table(console, title, {"": "left", "ours": "right", "reference": "right"}, lines)
    console.print(
        f"trained on {few['poses']} poses, {few['sets']} times ({few['refused']} refused): largest error "
        f"{few['max_px'] or 0.0:.2f} px, {few['largest_sigmas'] or 0.0:.2f} predicted deviations; "
        f"{few['beyond_4_sigmas']} of {few['corners']} corners beyond 4"
    )
    measures = {"median [px]": "median_px", "rms [px]": "rms_px", "largest [px]": "max_px"}
    lines = [
        [name, *(f"{figures[key]:.3f}" for key in measures.values())] for name, figures in answer["variants"].items()
    ]
    whole_table(console, "variants", {"": "left", **dict.fromkeys(measures, "right")}, lines)
    images = answer["images"]
    console.print(f"{images['with_hand_tag']} of {images['read']} images show tag {answer['hand_tag']}")
    if answer["not_predicted"]:
        console.print(f"{answer['not_predicted']} corners not predicted: too few views of that camera are left")
