"""Experiment with real images: fixed uncalibrated cameras, calibrated from a real arm's recorded displacements
alone.

A tag on the hand is found in the images; free 3x4 cameras and the tag's four corners in the hand are fitted
to the arm's poses; poses that the fit has not seen are predicted. Folds are fixed: pose index modulo FOLDS is
held out. The error is the distance of a predicted corner from the measured one [px], over *all* held-out
corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.experiments.real.driven_cameras import (
    LEAST_VIEWS,
    DrivenCameras,
    TagViews,
    Triangulated,
    fit_driven_cameras,
    predict,
    refit,
    triangulation_errors,
)
from stereoservo_sim.experiments.real.hand_poses import HandEyeSet, load_hand_eye_set, read_image
from stereoservo_sim.experiments.real.tags import (
    DICTIONARY_NAME,
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
STILL_PX, STILL_M = 3.0, 0.05
"""A tag that moves by less in every image while the hand moves by more is not on the hand."""


@dataclass(frozen=True)
class Observations:
    """Detections in the images. ``camera`` (v,) indexes ``cameras``; ``pose`` (v,) is the pose index of the file
    names.

    ``pixels`` (v, 4, 2) registered corners, ``start`` (v, 4, 2) those of cv2's subpixel refinement [px].
    ``backgrounds``: the median image of each camera; ``standing``: table tags found there, corners (4, 2) by
    id.
    """

    cameras: list[int]
    sizes: IntArray
    camera: IntArray
    pose: IntArray
    pixels: FloatArray
    start: FloatArray
    registered: BoolArray
    images_read: int
    backgrounds: list[GreyImage]
    standing: list[dict[int, FloatArray]]


@dataclass(frozen=True)
class Fits:
    """The two models of one set of views, of the cameras ``kept`` (indices); ``radial_better`` by Akaike's
    criterion."""

    kept: IntArray
    pinhole: DrivenCameras
    radial: DrivenCameras
    radial_better: bool

    @property
    def better(self) -> DrivenCameras:
        """The model that Akaike's criterion prefers on these views."""
        return self.radial if self.radial_better else self.pinhole

    def errors(self, model: DrivenCameras, displacements: FloatArray, views: TagViews) -> FloatArray:
        """Predicted less measured pixels ``(v, k, 2)`` [px]; NaN for cameras that were not kept."""
        errors = np.full(views.pixels.shape, np.nan)
        inside = np.isin(views.camera, self.kept)
        camera = np.searchsorted(self.kept, views.camera[inside])
        errors[inside] = predict(model, displacements, camera, views.pose[inside]) - views.pixels[inside]
        return errors


@dataclass(frozen=True)
class HeldOut:
    """Held-out errors ``(v, 4, 2)`` [px] by model, NaN where no fold could predict. ``chosen``: by each
    fold's own criterion, on its training poses alone; ``radial_folds``: the folds that took the radial
    terms; ``fits``: of each fold that could be predicted, number, cameras and the model that it chose."""

    chosen: FloatArray
    pinhole: FloatArray
    radial: FloatArray
    radial_folds: tuple[int, ...]
    fits: tuple[tuple[int, IntArray, DrivenCameras], ...] = ()


@dataclass(frozen=True)
class RealFrankaResult:
    """Everything that report and plots need. ``held_out_opencv``: the same with cv2's corners, as
    baseline."""

    directory: Path
    hand_tag: int
    seed: int
    displacements: FloatArray
    views: TagViews
    observations: Observations
    fits: Fits
    held_out: HeldOut
    held_out_opencv: HeldOut
    table: Flatness
    triangulated: list[Triangulated]


def run_real_franka(
    directory: Path,
    *,
    hand_tag: int = 9,
    table_tags: tuple[int, ...] = TABLE_TAGS,
    seed: int = 0,
    progress: ProgressCall | None = None,
) -> RealFrankaResult:
    """Detect, fit, predict. ``progress`` is called with (stage, done, total). ``seed`` turns the starting
    guesses.

    Raises ExperimentError: what :func:`load_hand_eye_set` and :func:`fit_driven_cameras` raise, ``tag_id``,
    ``image``, ``image_size``, ``tag_not_seen``, ``tag_stands_still``, ``too_few_poses``.
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

    indices = sorted(data.poses)
    displacements = np.stack([data.poses[i] for i in indices])
    views = TagViews(seen.camera, np.searchsorted(indices, seen.pose), seen.pixels)
    opencv_views = TagViews(views.camera, views.pose, seen.start)
    _check_that_tag_follows(seen, hand_tag, views, displacements)
    fold = seen.pose % FOLDS
    tell("fit", 0, 3)
    fits = fit_both(displacements, views, seen.sizes, seed)
    tell("fit", 1, 3)
    held_out = cross_validate(displacements, views, seen.sizes, fold, seed)
    tell("fit", 2, 3)
    held_out_opencv = cross_validate(displacements, opencv_views, seen.sizes, fold, seed)
    tell("fit", 3, 3)
    table = flatness(fits.better, [seen.standing[i] for i in fits.kept], table_tags)
    triangulated = triangulation_errors(held_out.fits, displacements, views, fold)
    return RealFrankaResult(
        directory, hand_tag, seed, displacements, views, seen, fits, held_out, held_out_opencv, table,
        triangulated,
    )  # fmt: skip


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
        np.stack([view.start for _, _, view in found]),
        np.array([view.registered for _, _, view in found]),
        done,
        backgrounds,
        standing,
    )


def _check_that_tag_follows(
    seen: Observations, hand_tag: int, views: TagViews, displacements: FloatArray
) -> None:
    """Raise ``tag_stands_still`` where the hand moved but the tag did not, in any camera."""
    middles = seen.pixels.mean(axis=1)
    spread = [np.ptp(middles[seen.camera == c], axis=0).max(initial=0.0) for c in np.unique(seen.camera)]
    travel = float(np.ptp(displacements[views.pose][:, :3, 3], axis=0).max())
    if len(seen.pose) > 1 and max(spread) < STILL_PX and travel > STILL_M:
        raise ExperimentError(
            "tag_stands_still",
            f"tag {hand_tag} moves by {max(spread):.2f} px at most while the hand moves by {travel:.2f} m; "
            "is it on the table? --hand-tag names the one on the hand",
            tag=hand_tag,
            travel_m=travel,
        )


def fit_both(displacements: FloatArray, views: TagViews, sizes: IntArray, seed: int) -> Fits:
    """Fit without and with radial terms the cameras that have LEAST_VIEWS views; raises ``too_few_poses`` if
    none has."""
    count = np.bincount(views.camera, minlength=len(sizes))
    kept = np.flatnonzero(count >= LEAST_VIEWS)
    if not len(kept):
        raise ExperimentError(
            "too_few_poses",
            f"the tag is seen in {count.tolist()} poses by the cameras; at least one needs {LEAST_VIEWS}",
            views=count.tolist(),
            needed=LEAST_VIEWS,
        )
    inside = views.take(np.isin(views.camera, kept))
    inside = TagViews(np.searchsorted(kept, inside.camera), inside.pose, inside.pixels)
    pinhole = fit_driven_cameras(displacements, inside, sizes[kept], np.random.default_rng(seed))
    radial = refit(pinhole, displacements, inside, radial=True)
    return Fits(kept, pinhole, radial, _prefers_radial(pinhole, radial, displacements, inside))


def _prefers_radial(
    pinhole: DrivenCameras, radial: DrivenCameras, displacements: FloatArray, views: TagViews
) -> bool:
    """Whether Akaike's criterion prefers radial terms. A view counts as two measurements: its corners share the
    error of the arm's pose.
    """
    common = pinhole.inliers & radial.inliers
    rss = [
        float(((predict(m, displacements, views.camera, views.pose) - views.pixels)[common] ** 2).sum())
        for m in (pinhole, radial)
    ]
    if min(rss) <= 0.0:
        return rss[1] < rss[0]
    return 2 * int(common.sum()) * float(np.log(rss[0] / rss[1])) > 2 * len(radial.radial)


def cross_validate(
    displacements: FloatArray, views: TagViews, sizes: IntArray, fold: IntArray, seed: int
) -> HeldOut:
    """Predict each fold (v,) from the others; a fold whose complement fits no camera stays NaN.

    Raises ExperimentError ``too_few_poses`` where nothing could be predicted.
    """
    chosen, pinhole, radial = (np.full(views.pixels.shape, np.nan) for _ in range(3))
    radial_folds: list[int] = []
    fold_fits: list[tuple[int, IntArray, DrivenCameras]] = []
    for number in np.unique(fold):
        out = fold == number
        training, held = views.take(~out), views.take(out)
        if (np.bincount(training.camera, minlength=len(sizes)) < LEAST_VIEWS).all():
            continue
        fits = fit_both(displacements, training, sizes, seed)
        pinhole[out] = fits.errors(fits.pinhole, displacements, held)
        radial[out] = fits.errors(fits.radial, displacements, held)
        chosen[out] = radial[out] if fits.radial_better else pinhole[out]
        fold_fits.append((int(number), fits.kept, fits.better))
        if fits.radial_better:
            radial_folds.append(int(number))
    if not np.isfinite(chosen).any():
        count = np.bincount(views.camera, minlength=len(sizes))
        raise ExperimentError(
            "too_few_poses",
            f"the tag is seen in {count.tolist()} poses by the cameras; without a fold (pose index modulo "
            f"{FOLDS}) at least one needs {LEAST_VIEWS}, and another to predict",
            views=count.tolist(),
            needed=LEAST_VIEWS,
        )
    return HeldOut(chosen, pinhole, radial, tuple(radial_folds), tuple(fold_fits))
