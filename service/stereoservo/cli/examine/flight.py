"""A flight recording as joints and marker pixels over time."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.calibration.trial_data import TrialCamera
from stereoservo.cli.output import note
from stereoservo.core.state_encoding import StateVersionError, decode_state
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.decoding import cause_of
from stereoservo.ports.devices import CameraObservation
from stereoservo.recording.recorded_motion import read_motion
from stereoservo.recording.replay import RecordingError, recorded_messages
from stereoservo.recording.step_layout import decode_step

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
