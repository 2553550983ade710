"""Set-points of a goal from recorded images: mean pixel and standard deviation of each marker over a few frames of
each camera, at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from stereoservo.daemon.camera_setup import recorded_camera, video_of
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation
from stereoservo.ports.image_files import image_lines

GATE_SIGMAS = 6.0
"""Gate [sigmas]: one in 500 million per coordinate; with a thousand coordinates fewer than one in 100 000 goals is
rejected by chance.
"""
MOVED_PX = 0.1
"""Largest drift of a marker from the first frame to the last [px] that is always accepted."""
LEAST_GATE_PX = 0.2
"""Largest deviation of one frame from the mean [px] that is always accepted."""


class SetPointError(Exception):
    """Recorded images do not determine set-points; the message names camera, marker or frame, and a remedy.

    ``code``: ``no_recording``, ``too_few_frames``, ``no_markers``, ``moving``, ``disagree``.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class SetPoints:
    """Mean pixels of one camera by marker, raw, with their standard deviations [px]; ``left_out``: markers seen in
    fewer than half of the frames. ``at_s``: from the beginning of the recording to the first frame.
    """

    camera: str
    pixels: dict[int, tuple[float, float]]
    sigmas: dict[int, float]
    frames: int
    at_s: float
    size: tuple[int, int]
    left_out: tuple[int, ...]


def set_points_from_images(cell_path: Path, images: Path, at_s: float, frames: int) -> tuple[SetPoints, ...]:
    """Set-points of every camera of the cell that has a recording in ``images``: from its first ``frames`` frames
    at or after ``at_s`` from the earliest frame of all, by the cell's detector.

    Raises SetPointError, ImageFileError, DriverError, PluginError, CellFileError.
    """
    cell = load_cell_file(cell_path)
    files = {camera.name: video_of(images, camera.name) for camera in cell.camera}
    found = {name: file for name, file in files.items() if file.is_file()}
    if not found:
        raise SetPointError(
            "no_recording",
            f"{images} holds none of {', '.join(file.name for file in files.values())}, recordings of the cameras of "
            f"{cell_path}; `stereoservo record CELL --images` makes them",
        )
    begin_ns = min(line.t_shutter_ns for file in found.values() for line in islice(image_lines(file), 1))
    from_ns = begin_ns + round(at_s * 1e9)
    return tuple(
        _camera_set_points(cell, cell_path, name, file, begin_ns, from_ns, frames) for name, file in found.items()
    )


def _camera_set_points(
    cell: CellFile, cell_path: Path, name: str, file: Path, begin_ns: int, from_ns: int, frames: int
) -> SetPoints:
    first = last_ns = -1
    for line in image_lines(file):
        last_ns = line.t_shutter_ns
        if last_ns >= from_ns:
            first = line.frame
            break
    if first < 0:
        raise SetPointError(
            "too_few_frames",
            f"{file} ends {(last_ns - begin_ns) * 1e-9:.2f} s after the beginning; no frame is at "
            f"{(from_ns - begin_ns) * 1e-9:.2f} s. Give an earlier --at",
        )
    camera = recorded_camera(cell, cell_path, name, file, first)
    seen = list(islice(camera.observations(lambda text: None), frames))
    if len(seen) < frames:
        raise SetPointError(
            "too_few_frames",
            f"{file} holds {len(seen)} frames from {(from_ns - begin_ns) * 1e-9:.2f} s on; {frames} are wanted. Give "
            "an earlier --at, or fewer --frames",
        )
    size = camera.description.width, camera.description.height
    return averaged(name, seen, (seen[0].t_shutter_ns - begin_ns) * 1e-9, size)


def averaged(camera: str, seen: list[CameraObservation], at_s: float, size: tuple[int, int]) -> SetPoints:
    """Mean of frames at rest. Raises SetPointError: no markers, a moving marker, an inconsistent frame."""
    times = np.array([observation.t_shutter_ns - seen[0].t_shutter_ns for observation in seen]) * 1e-9
    ids = sorted({int(marker) for observation in seen for marker in observation.ids})
    pixels: dict[int, tuple[float, float]] = {}
    sigmas: dict[int, float] = {}
    left_out: list[int] = []
    for marker in ids:
        rows = [(k, int(np.flatnonzero(o.ids == marker)[0])) for k, o in enumerate(seen) if marker in o.ids]
        if 2 * len(rows) < len(seen):
            left_out.append(marker)
            continue
        found = np.array([seen[k].pixels[row] for k, row in rows])
        variances = np.array([0.5 * np.trace(seen[k].covariances[row]) for k, row in rows])
        t = times[[k for k, _ in rows]]
        _require_rest(camera, marker, t, found, variances)
        mean = found.mean(axis=0)
        pixels[marker] = float(mean[0]), float(mean[1])
        sigmas[marker] = float(np.sqrt(variances.sum())) / len(rows)
    if not pixels:
        raise SetPointError(
            "no_markers",
            f"camera {camera}: no marker is in at least half of {len(seen)} frames from {at_s:.2f} s on: does the "
            "cell's detector find them in these pictures? Give another --at",
        )
    return SetPoints(camera, pixels, sigmas, len(seen), at_s, size, tuple(left_out))


def _require_rest(camera: str, marker: int, t: FloatArray, pixels: FloatArray, variances: FloatArray) -> None:
    """Raise SetPointError if a marker (n, 2) drifts over times (n,) [s], or if one frame deviates from the others, by
    more than the variances (n,) [px²] explain.
    """
    off = np.abs(pixels - np.median(pixels, axis=0)).max(axis=1)
    beyond = off > np.maximum(GATE_SIGMAS * np.sqrt(variances), LEAST_GATE_PX)
    late = t - t.mean()
    rate = late @ pixels / max(float(late @ late), 1e-12)
    deviation = float(np.sqrt(variances.mean() / max(float(late @ late), 1e-12)))
    span = float(np.ptp(t))
    drifts = float(np.abs(rate).max()) * span > max(GATE_SIGMAS * deviation * span, MOVED_PX)
    if 4 * int(beyond.sum()) > len(t) or (drifts and not beyond.any()):
        raise SetPointError(
            "moving",
            f"camera {camera}: marker {marker} moves by {np.ptp(pixels, axis=0).max():.2f} px in {span:.2f} s: the "
            "arm, or the camera, is in motion there. Give another --at, where it rests",
        )
    if beyond.any():
        worst = int(off.argmax())
        raise SetPointError(
            "disagree",
            f"camera {camera}: frame {worst} of {len(t)} has marker {marker} {off[worst]:.2f} px away from the others "
            f"(sigma {np.sqrt(variances[worst]):.3f} px): it shakes, or was taken for another. Give another --at",
        )
