"""Command ``stereoservo examine``: a recording of joints and pictures judged: cameras, joints, stamps, frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer

from stereoservo.calibration.examination.examination import RecordingReport, examine_views
from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.calibration.trial_data import TrialCamera
from stereoservo.cli.examine.folder import (
    DETECTOR,
    GatheredFrames,
    detected,
    gathered_views,
    read_folder,
    stated_detector,
)
from stereoservo.cli.output import CommandError, JsonOption, emit, note
from stereoservo.core.state_encoding import StateVersionError, decode_state
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.decoding import cause_of
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports import lerobot
from stereoservo.ports.devices import CameraObservation
from stereoservo.ports.lerobot import is_data_set
from stereoservo.recording.recorded_motion import read_motion
from stereoservo.recording.replay import RecordingError, recorded_messages
from stereoservo.recording.step_layout import decode_step


def examine(
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET",
            help="A flight recording (*.mcap), a folder or a LeRobot data set: docs/recordings.md.",
        ),
    ],
    units: Annotated[
        str | None,
        typer.Option(help="Of a LeRobot data set: in what its states are, such as deg,gripper.pos=none."),
    ] = None,
    cameras: Annotated[
        str | None, typer.Option(help="Of a LeRobot data set: the cameras to examine, such as top,side.")
    ] = None,
    detector: Annotated[
        Path | None,
        typer.Option(
            help="Of a LeRobot data set: the file that names the detector. Default: detector.toml in it."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Judge a recording of joints and pictures: bumped cameras, drifted zeros, late stamps, dropped frames.

    Cameras and arm are learnt from the motion in it. Each cause has its onset, size and deviation; where the recording
    does not tell two causes apart, both are named, and what would decide. Exits non-zero only where it cannot be read.
    """
    if dataset.is_dir() and is_data_set(dataset):
        views = read_data_set(dataset, units, cameras, detector)
    elif any(one is not None for one in (units, cameras, detector)):
        raise CommandError(
            "dataset", f"--units, --cameras and --detector are for LeRobot data sets; {dataset} is none"
        )
    elif dataset.is_dir():
        views = read_folder(dataset)
    elif dataset.is_file():
        views = read_flight(dataset)
    else:
        raise CommandError(
            "dataset", f"{dataset} is no flight recording (*.mcap), folder or LeRobot data set"
        )
    report = examine_views(views)
    emit(report, _text(report), json)


def _text(report: RecordingReport) -> str:
    lines = []
    if report.learnt_from is None and report.rms_px is not None:
        lines.append(
            f"residuals {report.rms_px:.3f} px rms ({report.before_px:.3f} px with what has happened), of the "
            f"{report.stratum} model that the recording holds: no joint motions to learn one from"
        )
    if report.learnt_from is not None:
        first, last, stops = report.learnt_from
        lines.append(
            f"residuals {report.rms_px:.3f} px rms ({report.before_px:.3f} px with what has happened); "
            f"{report.stratum} model learnt from {stops} stops in frames {first} to {last}, {report.outliers} pixels "
            "left out"
        )
    for name, one in report.cameras.items():
        rms = "" if one.rms_px is None else f", {one.rms_px:.3f} px rms"
        offset = (
            ""
            if one.offset_s is None
            else f", {1e3 * one.offset_s:+.1f} ± {1e3 * (one.offset_deviation_s or 0):.1g} ms"
        )
        lost = "drops cannot be told" if one.dropped is None else f"{one.dropped} dropped"
        lines.append(f"  camera {name}: {one.frames} frames, {lost}{rms}{offset}")
    if report.joints:
        lines.append(
            "  by joint [px rms]: " + ", ".join(f"{name} {rms:.3f}" for name, rms in report.joints.items())
        )
    if len(report.episodes) > 1:
        lines += [_of_episode(report, name, rms) for name, rms in report.episodes.items()]
    lines += [f"* {cause.message}" for cause in report.causes] or ["nothing has happened"]
    lines += [f"  note: {one}" for one in report.notes]
    lines.append(
        f"(a recording to which nothing has happened is said to have a change once in {1 / report.false_alarm:.0f})"
    )
    return "\n".join(lines)


def _of_episode(report: RecordingReport, name: str, rms: float) -> str:
    """Line on an episode: its residuals, and which causes are in it."""
    held = [f"{one.kind} {one.subject}".strip() for one in report.causes if int(name) in one.episodes]
    return f"  episode {name}: {rms:.3f} px rms, {', '.join(held) or 'nothing has happened'}"


# -- flight recordings ---------------------------------------------------------------------------------------
# A flight recording as joints and marker pixels over time.


BODY_MOVES = (
    "the marker body of this cell moves by itself ([scene] moves = true): where it did, that is in the residuals and "
    "may be told as a cause, and is no fault; stamps are not examined, since such motion looks as if they were late"
)
MOST_FRAMES = 6000
"""Frames that are examined; of longer recordings every second one, every third, …"""


def read_flight(path: Path) -> RecordedViews:
    """The recording in a flight (*.mcap): what the core took in of joints and cameras. Raises RecordingError."""
    motion = read_motion(path)
    observations, model = _contents(path)
    settings = motion.settings
    cameras = [camera.name for camera in settings.cameras]
    seen = [one for one in observations if one.camera in cameras]
    every = max(1, -(-len(seen) // MOST_FRAMES))
    if every > 1:
        note(f"{len(seen)} frames: of each camera one in {every} is examined")
    ranks = dict.fromkeys(cameras, 0)
    kept: list[CameraObservation] = []
    for one in sorted(seen, key=lambda o: (o.t_shutter_ns, cameras.index(o.camera))):
        if ranks[one.camera] % every == 0:
            kept.append(one)
        ranks[one.camera] += 1
    ids = tuple(i for i in settings.marker_ids if i not in settings.scene_ids)
    column = {marker: k for k, marker in enumerate(ids)}
    pixels, sigmas = np.full((len(kept), len(ids), 2), np.nan), np.ones((len(kept), len(ids)))
    for k, one in enumerate(kept):
        mine = np.array([column.get(int(i), -1) for i in one.ids], dtype=np.int64)
        known = mine >= 0
        pixels[k, mine[known]] = one.pixels[known]
        sigmas[k, mine[known]] = np.sqrt(0.5 * np.trace(one.covariances, axis1=1, axis2=2))[known]
    begin = int(motion.joint_ns[0])
    known_offsets = {} if model is None else {one.camera: one.offset_s for one in model.shutter_offsets}
    stamps = [(one.t_shutter_ns - begin) * 1e-9 + known_offsets.get(one.camera, 0.0) for one in kept]
    # Numbers count what the camera took; where frames are left out they would tell of drops.
    numbers = [one.seq if every == 1 else -1 for one in kept]
    return RecordedViews(
        settings.joint_names, settings.joint_kinds,
        tuple(TrialCamera(c.name, c.width, c.height, c.mount) for c in settings.cameras), ids,
        np.asarray((motion.joint_ns - begin) * 1e-9, dtype=np.float64), motion.positions,
        np.array([cameras.index(one.camera) for one in kept], dtype=np.int64),
        np.array(stamps), np.array(numbers, dtype=np.int64),
        np.zeros(len(kept), dtype=np.int64), pixels, sigmas, model=model,
        body_moves=settings.body_moves, notes=(BODY_MOVES,) if settings.body_moves else (),
    )  # fmt: skip


def _contents(path: Path) -> tuple[list[CameraObservation], CellModel | None]:
    """All observations, and the first model."""
    found: list[CameraObservation] = []
    model: CellModel | None = None
    for topic, data in recorded_messages(path):
        try:
            if topic == "checkpoint" and model is None:
                model = decode_state(msgspec.msgpack.decode(data)[1]).model
            elif topic == "step":
                inputs = decode_step(data).inputs
                found += inputs.observations
                if model is None and inputs.model_update is not None:
                    model = inputs.model_update.model
        except StateVersionError:
            continue  # a recording of another version is examined without its model
        except Exception as error:  # a decoder may raise anything
            raise RecordingError(path, 0, f"{topic} record is damaged ({cause_of(error)})") from error
    return found, model


# -- LeRobot data sets ---------------------------------------------------------------------------------------
# A LeRobot data set as a recording: docs/recordings.md has what is read of it.


BETWEEN_S, HELD_S = 1.0, 0.4
"""Time put between two episodes, and for which the joints then go on as at their ends."""
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
