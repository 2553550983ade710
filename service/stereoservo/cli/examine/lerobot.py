"""A LeRobot data set as a recording: docs/recordings.md has what is read of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.cli.examine.folder import (
    DETECTOR,
    GatheredFrames,
    detected,
    gathered_views,
    stated_detector,
)
from stereoservo.cli.output import CommandError, note
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports import lerobot

BETWEEN_S, HELD_S = 1.0, 0.4
"""Time put between two episodes, and for which the joints then go on as at their ends."""
MOST_FRAMES = 6000
"""Frames that are examined; of longer data sets every second one, every third, …"""
COMPRESSED_PX = 0.1
"""Deviation of pixels in compressed pictures at least, whatever detectors state for others."""
COUNTED_S = 1e-3
"""Difference of stamps from the count of frames at which they are that count."""


def read_data_set(
    folder: Path, units: str | None, cameras: str | None = None, detector: Path | None = None
) -> RecordedViews:
    """The recording in a data set, its joints in ``units`` (``deg,gripper.pos=none``), of some ``cameras`` or all.
    Raises CommandError naming what would be valid.
    """
    with _refused():
        return _views(folder, units, cameras, detector)


@contextmanager
def _refused() -> Iterator[None]:
    try:
        yield
    except lerobot.DataSetError as error:
        raise CommandError(error.code, str(error)) from error


def _views(folder: Path, units: str | None, cameras: str | None, detector: Path | None) -> RecordedViews:
    info = lerobot.read_info(folder)
    names, kinds, scales, columns = lerobot.joints_of(lerobot.state_names(info, folder), units)
    wanted = None if cameras is None else [name.strip() for name in cameras.split(",")]
    keys = lerobot.camera_features(info, folder, wanted)
    rows = lerobot.read_rows(folder, info)
    stamps, joint_times, states = _one_clock(rows)
    every = max(1, -(-len(rows.stamp) * len(keys) // MOST_FRAMES))
    if every > 1:
        note(f"{len(rows.stamp) * len(keys)} pictures: of each camera one in {every} is examined")
    frames, notes = GatheredFrames({}), []
    for name, key in keys.items():
        look = stated_detector(detector or folder / DETECTOR, name)
        least = COMPRESSED_PX if info.features[key].dtype == "video" else 0.0
        seen: dict[float, tuple[int, int, dict[int, tuple[float, float, float]]]] = {}
        size = None
        for row, decoded in lerobot.pictures(folder, info, key, rows, every, gray=True):
            image = decoded()
            size, before = (image.shape[1], image.shape[0]), size
            if before not in (None, size):
                raise CommandError(
                    "dataset", f"LeRobot data set {folder}: {key}: a picture of {size} after {before}"
                )
            markers = {
                marker: (u, v, max(sigma, least))
                for marker, (u, v, sigma) in detected(look, name, row, image).items()
            }
            seen[float(stamps[row])] = -1, int(rows.episode[row]), markers
        found = sum(bool(markers) for _, _, markers in seen.values())
        note(f"camera {name}: markers in {found} of {len(seen)} pictures")
        if found and size is not None:
            frames.sizes[name] = size
            frames.seen |= {(name, stamp): frame for stamp, frame in seen.items()}
        else:
            notes.append(f"camera {name} shows a marker in none of its {len(seen)} pictures, and is left out")
    if not frames.sizes:
        raise CommandError(
            "dataset",
            f"LeRobot data set {folder}: no camera shows a marker that the detector looks for; its cameras are "
            f"{', '.join(keys) or 'none'}",
        )
    counted = bool(np.abs(rows.stamp - rows.frame / info.fps).max() < COUNTED_S)
    if counted:
        note("stamps are the count of frames over the rate: dropped frames cannot be told")
    positions = states[:, columns] * scales
    views = gathered_views(frames, joint_times, names, kinds, positions, None, True, counted)
    return replace(views, notes=tuple(notes))


def _one_clock(rows: lerobot.EpisodeRows) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Stamps (r,) [s] of one clock, episodes one after another, and times (j,) and states (j, n) of the joints, which
    go on for a moment before and after each episode: pictures that are late against them are of there.
    """
    stamps = rows.stamp.copy()
    times, states, end = [], [], 0.0
    for episode in np.unique(rows.episode).tolist():
        mine = np.flatnonzero(rows.episode == episode)
        stamps[mine] += end - stamps[mine[0]]
        own, state = stamps[mine], rows.state[mine]
        times.append(np.concatenate([[own[0] - HELD_S], own, [own[-1] + HELD_S]]))
        states += [_gone_on(own[1::-1], state[1::-1]), state, _gone_on(own[-2:], state[-2:])]
        end = float(own[-1]) + BETWEEN_S
    return stamps, np.concatenate(times), np.concatenate(states)


def _gone_on(times: FloatArray, states: FloatArray) -> FloatArray:
    """State (1, n) a moment after the last one of two at their ``times``, or before where they go backwards."""
    elapsed = abs(float(times[-1] - times[0]))
    return states[-1:] + (states[-1:] - states[:1]) * (HELD_S / elapsed if elapsed > 0.0 else 0.0)
