"""Export of a flight recording for other programs: copies its bit-exact messages into a new file, runs them through the
core, and adds the cell's activity in Foxglove's schemas (`foxglove_channels`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
from foxglove.messages import CompressedImage
from mcap.writer import CompressionType, Writer

from stereoservo.core.cycle import Status, StepInputs, StepOutputs
from stereoservo.core.settings import CoreSettings
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import RunGoal
from stereoservo.messages.recording_request import images_directory
from stereoservo.ports.image_files import ImageReader
from stereoservo.recording.compression import Checkpoints, StepBlocks
from stereoservo.recording.flight_recorder import FORMAT, TOPICS
from stereoservo.recording.foxglove_channels import (
    MetricScene,
    Published,
    cell_status,
    joints,
    log,
    markers_seen,
    reasons,
    schema_of,
    set_points_of,
    stamp,
)
from stereoservo.recording.replay import (
    RecordingError,
    ReplayResult,
    recorded_span,
    replay,
    whole_messages,
)
from stereoservo.recording.step_layout import decode_step

STATE_EVERY_NS = 50_000_000
SCENE_EVERY_NS = 200_000_000
JPEG_QUALITY = 80
BLOCK_STEPS = 100
"""Steps in a compressed block: 0.4 s of a loop of 250 Hz."""


@dataclass
class FlightChannels:
    """Converts a recording's steps into messages. ``shift_ns``: wall clock minus the recording's clock.

    ``models``: by epoch, those at the start of the recording.
    """

    settings: CoreSettings
    shift_ns: int
    models: dict[int, CellModel]
    _targets: dict[str, Any] = field(default_factory=dict)
    _scene: MetricScene | None = None
    _epoch: int = -1
    _codes: tuple[str, ...] = ()
    _state_ns: int = -STATE_EVERY_NS
    _scene_ns: int = -SCENE_EVERY_NS

    def take(self, inputs: StepInputs, outputs: StepOutputs) -> Iterator[Published]:
        """Messages of one step: events and frames as they are, state and scene less often."""
        status = outputs.status
        if inputs.model_update is not None:
            self.models[inputs.model_update.model.epoch] = inputs.model_update.model
        for request in inputs.requests:
            if isinstance(request.command, RunGoal):
                self._targets[request.command.goal.id] = request.command.goal.target
        now_ns = inputs.now_ns + self.shift_ns
        for event in outputs.events:
            yield log(event.t_ns + self.shift_ns, event.kind, event.message, "core")
        codes = tuple(reason.code for reason in status.reasons)
        if codes != self._codes:
            self._codes = codes
            yield reasons(now_ns, status.reasons)
        priors = {prior.camera: prior.pixels for prior in outputs.priors}
        target = self._targets.get(status.goal)
        for seen in inputs.observations:
            wanted = set_points_of(target, seen.camera)
            t_ns = seen.t_shutter_ns + self.shift_ns
            yield markers_seen(seen.camera, t_ns, seen.pixels, priors.get(seen.camera), wanted)
        if inputs.now_ns - self._state_ns >= STATE_EVERY_NS:
            self._state_ns = inputs.now_ns
            yield from self._state(now_ns, status)
        if inputs.now_ns - self._scene_ns >= SCENE_EVERY_NS:
            yield from self._space(inputs.now_ns, status)

    def _state(self, t_ns: int, status: Status) -> Iterator[Published]:
        names = self.settings.joint_names
        yield joints(
            "/joints",
            t_ns,
            names,
            positions=status.positions,
            velocities=status.velocities,
            efforts=status.efforts,
        )
        yield joints("/command", t_ns, names, velocities=status.command)
        yield Published("/status", t_ns, cell_status(status))

    def _space(self, now_ns: int, status: Status) -> Iterator[Published]:
        if status.model_epoch != self._epoch:
            self._epoch = status.model_epoch
            model = self.models.get(status.model_epoch)
            self._scene = MetricScene(model) if model is not None and model.stratum == "metric" else None
        if self._scene is None:
            return
        self._scene_ns = now_ns
        yield self._scene.transforms(now_ns + self.shift_ns)
        yield self._scene.update(now_ns + self.shift_ns, status.positions)


class _File:
    """The exported file: one channel a topic, made with its first message."""

    def __init__(self, stream: Any) -> None:
        self._writer = Writer(stream, compression=CompressionType.LZ4, enable_data_crcs=True)
        self._writer.start(profile=FORMAT, library="stereoservo")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self.counts: dict[str, int] = {}

    def copy(self, topic: str, data: bytes, t_ns: int) -> None:
        """A message of the recording, as it is."""
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, TOPICS[topic], 0)
        self._add(topic, data, t_ns)

    def publish(self, message: Published) -> None:
        """A message with a schema."""
        if message.topic not in self._channels:
            schema = schema_of(message.content)
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            self._channels[message.topic] = self._writer.register_channel(
                message.topic, schema.message, self._schemas[schema.name]
            )
        self._add(message.topic, message.encode(), message.t_ns)
        self.counts[message.topic] = self.counts.get(message.topic, 0) + 1

    def _add(self, topic: str, data: bytes, t_ns: int) -> None:
        self._writer.add_message(self._channels[topic], log_time=t_ns, publish_time=t_ns, data=data)

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()


@dataclass(frozen=True)
class ExportResult:
    """``messages``: their numbers by topic; ``incomplete``: why the recording ends early, if it does."""

    file: Path
    replay: ReplayResult
    messages: dict[str, int]
    incomplete: str


def export_flight(source: Path, target: Path) -> ExportResult:
    """Write ``target``: the recording ``source`` with Foxglove's channels, and with its pictures if it has them.

    Raises RecordingError, ImageFileError, FileExistsError, OSError.
    """
    if target.exists():
        raise FileExistsError(f"{target} exists; name another file with --output, or remove it")
    part = target.with_name(target.name + ".part")
    try:
        with part.open("wb") as stream:
            file = _File(stream)
            result = _fill(file, source, target)
            file.finish()
        os.replace(part, target)
    finally:
        with suppress(FileNotFoundError):
            part.unlink()
    return result


def _fill(file: _File, source: Path, target: Path) -> ExportResult:
    """Copy the recording, replay it, add pictures."""
    span = recorded_span(source)
    shift_ns = span.shift_ns
    channels: FlightChannels | None = None
    incomplete = ""

    def begin(settings: CoreSettings) -> None:
        nonlocal channels
        channels = FlightChannels(settings, shift_ns, span.models)

    def observe(inputs: StepInputs, outputs: StepOutputs) -> None:
        assert channels is not None
        for message in channels.take(inputs, outputs):
            file.publish(message)

    try:
        result = replay(source, observe=observe, header=begin)
    except RecordingError as error:
        if error.result is None or not error.cut:
            raise
        result, incomplete = error.result, str(error)
    _copy(file, source, span.first_ns + shift_ns, shift_ns)
    for video in sorted(images_directory(source).glob("*.avi")):
        _add_pictures(file, video, shift_ns)
    return ExportResult(target, result, dict(file.counts), incomplete)


def _copy(file: _File, source: Path, t_ns: int, shift_ns: int) -> None:
    """The recording's own messages, in their compressed form, at the wall clock's time of the step they belong to."""
    blocks, checkpoints, held, held_ns = StepBlocks(), Checkpoints(), list[bytes](), t_ns
    for topic, data in whole_messages(source):
        if topic == "step":
            t_ns = decode_step(data).inputs.now_ns + shift_ns
            held_ns = held_ns if held else t_ns
            held.append(data)
            if len(held) < BLOCK_STEPS:
                continue
        if held:
            file.copy("steps", blocks.compress(held), held_ns)
            held = []
        if topic == "checkpoint":
            blocks.begin()
            file.copy("state", checkpoints.compress(data), t_ns)
        elif topic != "step":
            file.copy(topic, data, t_ns)
    if held:
        file.copy("steps", blocks.compress(held), held_ns)


def _add_pictures(file: _File, video: Path, shift_ns: int) -> None:
    """A camera's recorded pictures, as JPEG."""
    with ImageReader(video) as reader:
        for frame in reader:
            done, jpeg = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            if not done:
                continue
            t_ns = frame.t_shutter_ns + shift_ns
            content = CompressedImage(
                timestamp=stamp(t_ns), frame_id=frame.camera, data=jpeg.tobytes(), format="jpeg"
            )
            file.publish(Published(f"/camera/{frame.camera}/image", t_ns, content))
