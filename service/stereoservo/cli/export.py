"""Command ``stereoservo export``: writes a flight recording for Foxglove and Rerun, a calibrated model as URDF, or the
cameras of a rig for OpenCV, ROS and Kalibr.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import cv2
import msgspec
import typer
from foxglove.messages import CompressedImage
from mcap.writer import CompressionType, Writer

from stereoservo.cli.output import CommandError, JsonOption, emit, log
from stereoservo.core.cycle import Status, StepInputs, StepOutputs
from stereoservo.core.settings import CoreSettings
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.denavit_hartenberg import DH_HEADER, ReadOutError, denavit_hartenberg, dh_cells
from stereoservo.kinematics.metric_frames import scale_length
from stereoservo.kinematics.model import CellModel, load_model
from stereoservo.kinematics.urdf import metric_arm, urdf_text
from stereoservo.messages.cell_file import load_cell_file
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
    markers_seen,
    reasons,
    schema_of,
    set_points_of,
    stamp,
)
from stereoservo.recording.foxglove_channels import (
    log as log_entry,
)
from stereoservo.recording.replay import RecordingError, ReplayResult, recorded_span, replay, whole_messages
from stereoservo.recording.step_layout import decode_step

if TYPE_CHECKING:
    from stereoservo.kinematics.inverse.recognition import Evidence


SAME = 1e-9
"""Relative error up to which a replay on another processor counts as the same."""


def export(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A flight recording (*.mcap), a model (*.json); or cameras: a rig of `calibrate --rig`, or a "
            "file of OpenCV, ROS (or a folder of these) or Kalibr.",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Of a recording: file to write (default: FILE.foxglove.mcap).")
    ] = None,
    urdf: Annotated[
        Path | None, typer.Option("--urdf", metavar="FILE", help="Of a metric model: the URDF file to write.")
    ] = None,
    dh: Annotated[
        bool, typer.Option("--dh", help="Of a metric model: print its Denavit-Hartenberg parameters.")
    ] = False,
    length: Annotated[
        str,
        typer.Option(
            "--length",
            metavar="WHAT:OF=METRES",
            help="The known length: markers:10,11=0.05 (two ids), baseline:left,right=0.2 (two cameras), "
            "a:JOINT=METRES or d:JOINT=METRES (of its Denavit-Hartenberg row), "
            "prismatic:JOINT=1. Default: calibration.known_length of --cell, else the unit of a slide.",
        ),
    ] = "",
    cell: Annotated[
        Path | None,
        typer.Option(
            "--cell", metavar="FILE", help="Cell file: calibration.known_length, and safety.limit for the URDF."
        ),
    ] = None,
    opencv: Annotated[
        Path | None, typer.Option("--opencv", metavar="FILE.yml", help="Of cameras: FileStorage YAML to write.")
    ] = None,
    ros: Annotated[
        Path | None, typer.Option("--ros", metavar="DIR", help="Of cameras: folder for a camera_info YAML of each.")
    ] = None,
    kalibr: Annotated[
        Path | None, typer.Option("--kalibr", metavar="FILE.yaml", help="Of cameras: Kalibr's camera chain.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write a recording for Foxglove and Rerun, which still replays bit for bit; a model's dimensions, or its URDF; or
    cameras for OpenCV, ROS and Kalibr.

    Pictures in NAME.images beside a recording go with it. A URDF has the joints, and markers and cameras as links.
    """
    if opencv is not None or ros is not None or kalibr is not None:
        _export_cameras(file, opencv, ros, kalibr, json)
        return
    if file.suffix == ".json":
        if urdf is None and not dh:
            raise CommandError(
                "usage",
                f"what to write of {file} is not said: of a model --urdf FILE or --dh, of cameras of `calibrate --rig` "
                "--opencv FILE.yml, --ros DIR or --kalibr FILE.yaml",
            )
        _export_model(file, urdf, dh, length, cell, json)
    elif urdf is not None or dh:
        raise CommandError("usage", f"--urdf and --dh are for a model (*.json); {file} is none")
    else:
        _export_flight(file, output if output is not None else file.with_suffix(".foxglove.mcap"), json)


def _export_cameras(file: Path, opencv: Path | None, ros: Path | None, kalibr: Path | None, json: bool) -> None:
    from stereoservo.calibration.camera_rig import exchange  # OpenCV and YAML: only for this
    from stereoservo.calibration.camera_rig.rig_calibration import load_rig

    cameras, unit = exchange.load_cameras(file) if file.suffix != ".json" else (), "m"
    if file.suffix == ".json":
        rig = load_rig(file)
        cameras, unit = rig.cameras, rig.unit
    if unit != "m":
        log(f"{file} holds no length in metres: translations are in baselines")
    written: list[str] = []
    if opencv is not None:
        exchange.save_opencv(cameras, opencv)
        written.append(str(opencv))
    if ros is not None:
        written += [str(path) for path in exchange.save_ros(cameras, ros)]
        if len(cameras) > 2:
            log("camera_info has no place for the poses of more than two cameras: they are left out")
    if kalibr is not None:
        exchange.save_kalibr(cameras, kalibr)
        written.append(str(kalibr))
    names = [camera.name for camera in cameras]
    emit({"written": written, "cameras": names, "unit": unit}, f"{', '.join(names)}: {', '.join(written)}", json)


def _export_flight(file: Path, target: Path, json: bool) -> None:
    result = export_flight(file, target)
    if result.replay.identical is False:
        raise CommandError(
            "differs",
            f"{target} is written, but the replay that it is made from differs from the recording at step "
            f"{result.replay.first_difference}: joints and markers are those recorded, states and errors may not be",
        )
    error = result.replay.max_relative_error
    if error > SAME:
        log(
            f"the replay on this machine or version differs from the recording (largest relative error {error:.2g}): "
            "joints and markers are those recorded, states and errors those of the replay"
        )
    sizes = file.stat().st_size, target.stat().st_size
    lines = [f"{topic:32} {count} messages" for topic, count in sorted(result.messages.items())]
    lines.append(f"{target}: {sizes[1] / 1e6:.1f} MB, {sizes[1] / max(sizes[0], 1):.2f} times the recording")
    if result.incomplete:
        lines.append(f"up to where the recording breaks off: {result.incomplete}")
    figures = {
        "file": str(target),
        "identical": result.replay.identical,
        "max_relative_error": error,
        "steps": result.replay.steps,
        "messages": result.messages,
        "bytes": sizes[1],
        "recording_bytes": sizes[0],
        "incomplete": result.incomplete,
    }
    emit(figures, "\n".join(lines), json)


def _export_model(file: Path, urdf: Path | None, dh: bool, length: str, cell_path: Path | None, json: bool) -> None:
    model = load_model(file)
    cell = None if cell_path is None else load_cell_file(cell_path)
    if cell is not None and cell.calibration is not None:
        length = length or cell.calibration.known_length
    try:
        known = scale_length(model, length)
        told: dict[str, Any] = {"joints": list(model.joint_names), "known": known}
        lines = [f"scaled by {known.what} of {', '.join(str(name) for name in known.of)}, {known.metres:g} m"]
        if dh:
            rows = denavit_hartenberg(model, known)
            told["denavit_hartenberg"] = msgspec.to_builtins(rows)
            lines += [" | ".join(cells) for cells in (DH_HEADER, *(dh_cells(row) for row in rows))]
            from stereoservo.kinematics.inverse.recognition import structure  # statistics: only for this

            holds = structure(model)
            told["structure"] = [{**asdict(one), "joints": [model.joint_names[j] for j in one.joints]} for one in holds]
            lines += [_words(one, model) for one in holds]
        if urdf is not None:
            arm = metric_arm(model, known)
            limits = () if cell is None else cell.safety.limit
            bounds = {limit.joint: (limit.min, limit.max, limit.velocity) for limit in limits}
            urdf.write_text(urdf_text(model, arm, urdf.stem, bounds))
            told["urdf"] = str(urdf)
            told["position_scales"] = dict(zip(model.joint_names, arm.scales.tolist(), strict=True))
            counts = f"{len(model.joint_names)} joints, {len(model.marker_ids)} markers, {len(model.cameras)} cameras"
            lines.append(f"{urdf}: {counts}")
    except (ReadOutError, GeometryError) as error:
        raise CommandError(error.code, str(error)) from error
    emit(told, "\n".join(lines), json)


def _words(one: Evidence, model: CellModel) -> str:
    """Constraints on some axes that hold within the model's covariance, in words."""
    *first, last = (model.joint_names[j] for j in one.joints)
    how = "are parallel" if one.condition == "parallel" else "meet in one point"
    held = (
        f"deviation {one.deviation:.1g}"
        if one.chi2 is None
        else f"chi-square {one.chi2:.1f} of {one.freedom}, up to {one.threshold:.1f}"
    )
    return f"axes of {', '.join(first)} and {last} {how}, by the model's covariance: {held}"


# -- flights -------------------------------------------------------------------------------------------------
# A flight recording with further messages for other programs: copies its bit-exact messages into a new file, runs them
# through the core, and adds the cell's state with Foxglove's schemas (`foxglove_channels`).


STATE_EVERY_NS = 50_000_000
SCENE_EVERY_NS = 200_000_000
JPEG_QUALITY = 80
BLOCK_STEPS = 100
"""Steps per compressed block: 0.4 s of a loop of 250 Hz."""


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
        """Messages of one step: all events and frames, state and scene less often."""
        status = outputs.status
        if inputs.model_update is not None:
            self.models[inputs.model_update.model.epoch] = inputs.model_update.model
        for request in inputs.requests:
            if isinstance(request.command, RunGoal):
                self._targets[request.command.goal.id] = request.command.goal.target
        now_ns = inputs.now_ns + self.shift_ns
        for event in outputs.events:
            yield log_entry(event.t_ns + self.shift_ns, event.kind, event.message, "core")
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
            "/joints", t_ns, names, positions=status.positions, velocities=status.velocities, efforts=status.efforts
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
    """The exported file: one channel per topic, created with its first message."""

    def __init__(self, stream: Any) -> None:
        self._writer = Writer(stream, compression=CompressionType.LZ4, enable_data_crcs=True)
        self._writer.start(profile=FORMAT, library="stereoservo")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self.counts: dict[str, int] = {}

    def copy(self, topic: str, data: bytes, t_ns: int) -> None:
        """Write a message of the recording, unchanged."""
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, TOPICS[topic], 0)
        self._add(topic, data, t_ns)

    def publish(self, message: Published) -> None:
        """Write a message with a schema."""
        if message.topic not in self._channels:
            schema = schema_of(message.content)
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
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
    """The recording's own messages, in their compressed form, at the wall clock's time of their step."""
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
            content = CompressedImage(timestamp=stamp(t_ns), frame_id=frame.camera, data=jpeg.tobytes(), format="jpeg")
            file.publish(Published(f"/camera/{frame.camera}/image", t_ns, content))
