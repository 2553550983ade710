"""A flight recording of the core's bench, with pictures of one camera."""

import uuid
from pathlib import Path

import numpy as np

from core.conftest import Bench, make_bench
from stereoservo.core.state_encoding import encode_state
from stereoservo.messages.goals import FeatureTarget, Goal, RunGoal
from stereoservo.messages.recording_request import images_directory
from stereoservo.ports.devices import Frame
from stereoservo.ports.image_files import ImageWriter
from stereoservo.recording.flight_recorder import FlightRecorder
from stereoservo.recording.step_layout import encode_step
from stereoservo.recording.step_records import fingerprint

GOAL_ID = str(uuid.UUID(int=1))
GOAL_STEP = 5


def record_bench(flight: Path, steps: int) -> tuple[Bench, FeatureTarget]:
    """Record ``steps`` towards a goal of `GOAL_ID`, sent in step `GOAL_STEP`; each 100th has a picture of camera
    left, all of whose pixels are its number / 4. Returns the bench with its log, and the goal's set-points.
    """
    bench = make_bench(0, 0.02, k1=-0.1).ready()
    target = FeatureTarget(bench.features(bench.q + np.array([0.2, -0.1, 0.1, 0.2, -0.2, 0.3])))
    images_directory(flight).mkdir()
    left = bench.settings.cameras[0]
    pictures = ImageWriter(
        images_directory(flight) / "left.avi", left.name, (left.width, left.height), 30.0, driver="fake"
    )
    with FlightRecorder(flight, bench.settings, fingerprint()) as recorder, pictures:
        recorder.checkpoint(bench.core.state.step + 1, encode_state(bench.core.state), bench.now_ns)
        for k in range(steps):
            outputs = bench.step(*([RunGoal(Goal(GOAL_ID, target))] if k == GOAL_STEP else []))
            inputs = bench.log[-1][0]
            recorder.step(encode_step(inputs, outputs), inputs.now_ns)
            if k % 100 == 0:
                image = np.full((left.height, left.width), k // 4, dtype=np.uint8)
                pictures.append(Frame(left.name, k, inputs.now_ns, inputs.now_ns, image))
    return bench, target
