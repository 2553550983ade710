"""Experiment with real images: fixed uncalibrated cameras, calibrated from a real arm's recorded displacements
alone.

A tag on the hand is found in the images; the product's fit takes the arm's poses as those of a free arm
(`calibration.known_arm`), and its model predicts poses that it has not seen, with the covariance of what it predicts.
Folds are fixed: pose index modulo FOLDS is held out. The error is the distance of a predicted corner from the measured
one [px], over *all* held-out corners.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
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
from stereoservo.geometry.cameras import triangulate
from stereoservo.geometry.distortion import undistort
from stereoservo.geometry.homogeneous import from_homogeneous
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.experiments.real.hand_poses import HandEyeSet, load_hand_eye_set, read_image
from stereoservo_sim.experiments.real.tags import (
    DICTIONARY_NAME,
    STANDING,
    TAG_IDS,
    Flatness,
    find_standing_tags,
    find_tags,
    flatness,
    median_image,
    register_tag,
    tag_cells,
)
from stereoservo_sim.progress import ProgressCall

GreyImage = npt.NDArray[np.uint8]

FOLDS = 5
TABLE_TAGS = (0, 2, 3)
FEW_POSES, SUBSETS = 12, 10
"""Poses of a small training set, and how many such sets are drawn by default."""
INSIDE = 0.95
"""Probability of the ellipses that held-out corners are counted in."""
FAR = 4.0
"""Deviations beyond which a corner is far from where it was predicted."""
OPENCV_SIGMA = 0.3
"""Deviation [px] that is stated for cv2's subpixel corners; the fit estimates it where it is larger."""
STILL_PX, STILL_M = 3.0, 0.05
"""A tag that moves by less in every image while the hand moves by more is not on the hand."""


@dataclass(frozen=True)
class Observations:
    """Detections in the images. ``camera`` (v,) indexes ``cameras``; ``pose`` (v,) is the pose index of the file
    names.

    ``pixels`` (v, 4, 2) registered corners with ``sigmas`` (v, 4), ``start`` (v, 4, 2) those of cv2's subpixel
    refinement [px].
    ``backgrounds``: the median image of each camera; ``standing``: table tags found there, corners (4, 2) by
    id.
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
    displacement ``zero`` (4, 4), and the tag's corners there, ``pixels`` (c, n, 4, 2) and ``sigmas`` (c, n, 4) [px].
    """

    cameras: tuple[TrialCamera, ...]
    displacements: FloatArray
    positions: FloatArray
    generators: FloatArray
    zero: FloatArray
    pixels: FloatArray
    sigmas: FloatArray

    def trials(self, stops: BoolArray) -> tuple[TrialData, IntArray]:
        """Trial data of the poses where ``stops`` (n,) holds, and the cameras that show the tag in enough of them."""
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
        """Predicted pixels (c, n, 4, 2) at all poses, and the covariances (c, n, 4, 2, 2) of what is measured there;
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
    """Held-out ``errors`` (c, n, 4, 2) [px], predicted less measured, and ``squares`` (c, n, 4) of them in the
    deviations that were predicted; NaN where nothing was. ``deviations`` (c, n, 4) [px], an axis. ``fits`` by fold.
    """

    errors: FloatArray
    squares: FloatArray
    deviations: FloatArray
    fits: tuple[tuple[int, PoseFit], ...] = ()

    @property
    def distances(self) -> FloatArray:
        """Distances (k,) [px] of the corners that were predicted."""
        return np.asarray(np.linalg.norm(self.errors[np.isfinite(self.squares)], axis=1))


@dataclass(frozen=True)
class Coverage:
    """How many of ``corners`` in ``views`` lie inside their ``INSIDE`` ellipses, the 99 % interval of that share where
    the corners of a view err together, and the largest distance in predicted deviations.
    """

    corners: int
    views: int
    inside: float
    interval: tuple[float, float]
    largest: float
    beyond: int


@dataclass(frozen=True)
class FewPoses:
    """A training set of ``FEW_POSES`` poses: its ``seed``, how the rest is predicted; or why it was ``refused``."""

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
    """Everything that report and plots need. ``variants``: held-out poses by other lenses and other corners;
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
    """Detect, fit, predict. ``progress`` is called with (stage, done, total). ``seed`` is the first of those that draw
    ``few_sets`` small training sets.

    Raises ExperimentError: what :func:`load_hand_eye_set` raises, the codes of the fit, ``tag_id``, ``image``,
    ``image_size``, ``tag_not_seen``, ``tag_stands_still``, ``too_few_poses``.
    """
    for tag in (hand_tag, *table_tags):
        if not 0 <= tag < TAG_IDS:
            raise ExperimentError(
                "tag_id", f"tag {tag} is not in {DICTIONARY_NAME}: 0..{TAG_IDS - 1}", tag=tag
            )
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
        whole = fit_poses(
            views, np.ones(len(indices), dtype=bool), standing=seen.standing, table_tags=table_tags
        )
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


def observe(
    data: HandEyeSet, hand_tag: int, table_tags: tuple[int, ...], progress: ProgressCall
) -> Observations:
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
    """Raise ``tag_stands_still`` where the hand moved, by ``displacements`` (v, 4, 4), but the tag did not, in any
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
    """The product's fit to the poses where ``stops`` (n,) holds; ``standing``: corners of ``table_tags`` by camera,
    which become static points.

    Raises CalibrationError, and ExperimentError (``too_few_poses``).
    """
    trials, kept = views.trials(stops)
    static = (
        _static([standing[c] for c in kept], table_tags, float(np.nanmedian(trials.sigmas)))
        if standing
        else None
    )
    fit = fit_model(msgspec.structs.replace(trials, static=static), epoch=1, options=options or FitOptions())
    return PoseFit(fit, kept, views)


def _static(
    standing: list[dict[int, FloatArray]], tags: tuple[int, ...], sigma: float
) -> StaticObservations | None:
    """Corners of tags that stand still, each a marker: STANDING plus four times the tag's id, plus its number."""
    found = [tag for tag in tags if any(tag in camera for camera in standing)]
    if not found:
        return None
    missing = np.full((4, 2), np.nan)
    pixels = np.stack([np.concatenate([camera.get(tag, missing) for tag in found]) for camera in standing])
    ids = tuple(STANDING + 4 * tag + corner for tag in found for corner in range(4))
    return StaticObservations(ids, pixels, np.where(np.isfinite(pixels).all(axis=2), sigma, np.nan))


def cross_validate(views: PoseViews, fold: IntArray, options: FitOptions | None = None) -> HeldOut:
    """Each fold (n,) predicted from the others; what no fold could predict stays NaN.

    Raises CalibrationError, and ExperimentError (``too_few_poses``) where nothing could be predicted.
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
        if whole is None:
            whole = part
        else:
            whole = HeldOut(
                *(
                    np.where(np.isfinite(own), own, others)
                    for own, others in (
                        (part.errors, whole.errors),
                        (part.squares, whole.squares),
                        (part.deviations, whole.deviations),
                    )
                )
            )
    if whole is None:
        raise few
    return HeldOut(whole.errors, whole.squares, whole.deviations, tuple(fits))


def judged(fitted: PoseFit, out: BoolArray) -> HeldOut:
    """How a fit predicts the poses where ``out`` (n,) holds."""
    pixels, covariances = fitted.predict()
    errors = pixels - fitted.views.pixels
    errors[:, ~out] = np.nan
    known = np.isfinite(errors).all(axis=3)
    squares, deviations = np.full(known.shape, np.nan), np.full(known.shape, np.nan)
    squares[known] = np.einsum(
        "ka,kab,kb->k", errors[known], np.linalg.inv(covariances[known]), errors[known]
    )
    deviations[known] = np.sqrt(np.trace(covariances[known], axis1=1, axis2=2) / 2.0)
    return HeldOut(errors, squares, deviations)


def coverage(held: HeldOut) -> Coverage:
    """How the predicted covariances hold. Corners of one view share the error of the arm's pose: a share of them has
    the scatter of as many trials as there are views, at most.
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
    """Held-out poses by lenses that are not left to the data, and by cv2's corners."""
    pinhole = FitOptions(lens="none")
    wanted: dict[str, Callable[[], HeldOut]] = {
        "no lens": lambda: cross_validate(views, fold, pinhole),
        "cv2 subpixel corners": lambda: cross_validate(opencv, fold),
        "cv2 subpixel corners, no lens": lambda: cross_validate(opencv, fold, pinhole),
    }
    return {name: run() for name, run in wanted.items()}


def _from_few_poses(views: PoseViews, indices: IntArray, seed: int) -> FewPoses:
    """All other poses predicted from FEW_POSES that a seed draws."""
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
    """Each set of two or more of the cameras that every fold fitted, the largest set last; corners of held-out poses in
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
