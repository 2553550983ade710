"""Calibration from recorded images for ``stereoservo calibrate CELL.toml --images DIR``: extracts the trial data,
stores and fits them, and formats the result.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from stereoservo.cli.calibrate.stored_trials import (
    StoredFit,
    fit_stored_trials,
    resolve_cell,
    source_of_stored,
)
from stereoservo.cli.output import CommandError, note

TRIALS_FILE = "trials.npz"
TELL_EVERY = 500


class ImagesUsed(msgspec.Struct, frozen=True):
    """Images used by a calibration. ``left_out``: rests that were not used, by the reason."""

    directory: str
    stops: int
    frames: int
    left_out: dict[str, int]
    standing: tuple[int, ...]


class ImageFit(StoredFit, frozen=True):
    """A fit of recorded images."""

    from_images: ImagesUsed | None = None


def fit_images(cell: str, images: Path, output: Path | None) -> ImageFit:
    """Find the trials in recorded images, keep them beside the images, and fit them.

    Raises CommandError, CalibrationError, RecordingError, ImageFileError, DriverError, PluginError, CellFileError.
    """
    from stereoservo.calibration.trial_data import save_trials
    from stereoservo.daemon.jobs.recorded_image_trials import trials_from_images

    if not cell.endswith(".toml"):
        raise CommandError(
            "usage",
            f"--images needs the cell file, for its cameras' detectors; {cell!r} is a name. Give CELL.toml",
        )
    resolve_cell(cell, output)

    def progress(camera: str, frames: int) -> None:
        if frames % TELL_EVERY == 0:
            note(f"camera {camera}: {frames} frames")

    found = trials_from_images(Path(cell), images, note, progress)
    for why, number in found.left_out.items():
        note(f"{number} rests are not used: {why}")
    if found.standing:
        markers = ", ".join(str(marker) for marker in found.standing)
        note(f"markers {markers} stood still: they are not of the body, and left out")
    path = images / TRIALS_FILE
    save_trials(found.trials, path)
    note(f"{found.stops} stops, {found.frames} frames; the trial data are kept in {path}")
    used = ImagesUsed(str(images), found.stops, found.frames, found.left_out, found.standing)
    fit = fit_stored_trials(cell, path, None, 0.3, output)
    return ImageFit(**{**msgspec.structs.asdict(fit), "from_images": used})


def source_of_images(result: ImageFit) -> str:
    """What the fit was made of, as lines of text."""
    used = result.from_images
    what = "" if used is None else f"\n  images {used.directory}: {used.stops} stops, {used.frames} frames"
    return source_of_stored(result) + what
