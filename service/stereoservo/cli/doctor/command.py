"""Command ``stereoservo doctor``: checks a cell, or a file, folder or stream whose kind is found by its content, and
prints the findings.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import typer

from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.cli.doctor.cell import examine_cell, line_of, remark_findings
from stereoservo.cli.doctor.joints import permission
from stereoservo.cli.examine import DETECTOR, MOST_FRAMES, read_folder
from stereoservo.cli.output import CommandError, JsonOption, code_of, emit, is_known_error, log, shipped_or_path
from stereoservo.core.cycle import decode_array
from stereoservo.core.settings import CoreSettings
from stereoservo.kinematics.model import ModelFileError, decode_model
from stereoservo.messages.addresses import Address
from stereoservo.messages.decoding import decoding
from stereoservo.messages.text_files import decoded_text, json_of
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports import lerobot, plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import (
    CountingCameraDriver,
    DriverContext,
    DriverError,
    ExaminationFinding,
    JointDriverDescription,
)
from stereoservo.recording.replay import RecordingError, recorded_messages
from stereoservo.recording.step_layout import decode_step
from stereoservo.recording.step_messages import Fingerprint

HEAD_BYTES = 1 << 20
"""Part of a file from which its kind is found [bytes]."""
POLL_S = 0.005

Findings = Iterator[ExaminationFinding]


def doctor(
    cell: Annotated[
        str,
        typer.Argument(
            metavar="NAME|PATH|URL",
            help="A cell file, or the name of a shipped one; an EDS, DCF, URDF, model, flight recording, LeRobot set, "
            "or folder of pictures; the URL of a stream.",
        ),
    ],
    jog: Annotated[
        bool, typer.Option("--jog", help="Also turn each joint by one degree and back, once allowed: checks its units.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Allow what --jog asks for.")] = False,
    seconds: Annotated[
        float, typer.Option("--seconds", help="How long the cameras are watched; 0: not at all.", min=0.0, max=600.0)
    ] = 2.0,
    pictures: Annotated[
        Path | None,
        typer.Option("--pictures", help="Where what each camera sees is saved (default: the cell's state directory)."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check a cell: its file, drivers, drives, cameras, directories, wire, model and scheduling; or any other file that
    is read: what it is, what is in it, what is odd.

    Of a cell, nothing moves without ``--jog``; drives and cameras are asked only while no daemon has them. The kind of
    a file is found by its content. Exits 0 where it can be used.
    """
    may_move = permission(jog, yes)
    kind, found = "cell file", None
    if "://" in cell or Path(cell).exists() or Path(cell).suffix not in ("", ".toml"):
        recognised, place = kind_of(cell, seconds)
        kind = recognised.name.partition(" (")[0]
        found = None if recognised.described is None else examine_place(recognised, place)
    findings: list[ExaminationFinding] = []
    try:
        for finding in found or examine_cell(shipped_or_path(cell), may_move, seconds, pictures):
            findings.append(finding)
            if not json:
                emit(None, line_of(finding), False)
    except Exception as error:
        if not findings or not is_known_error(error):
            raise
        tree = msgspec.to_builtins(findings)
        raise CommandError(code_of(error), str(error), kind=kind, checks=tree) from error
    failed = [finding for finding in findings if finding.ok is False]
    if failed:
        tree = msgspec.to_builtins(findings)
        message = "; ".join(f"{finding.name}: {finding.message}" for finding in failed)
        raise CommandError("checks_failed", message, kind=kind, checks=tree)
    emit({"kind": kind, "checks": findings}, "", json)


class Place(NamedTuple):
    """What is examined: a ``given`` path or URL; ``head`` of a file, and its ``text``, of a folder or URL empty;
    ``seconds`` for which a stream is observed.
    """

    given: str
    seconds: float
    head: bytes = b""
    text: str = ""

    @property
    def path(self) -> Path:
        return Path(self.given)


class Kind(NamedTuple):
    """A kind of file: its ``name`` for people; whether a place holds one; and its findings, or None for a cell."""

    name: str
    recognised: Callable[[Place], bool]
    described: Callable[[Place], Findings] | None


def kind_of(given: str, seconds: float) -> tuple[Kind, Place]:
    """The kind of a file, folder or URL. Raises CommandError (``file``, ``unknown_kind``)."""
    place = Place(given, seconds)
    if "://" not in given and not place.path.is_dir():
        if place.path.exists() and not place.path.is_file():
            raise CommandError("file", f"{given}: is no file, folder or URL")
        try:
            with place.path.open("rb") as file:
                head = file.read(HEAD_BYTES)
        except OSError as error:
            raise CommandError("file", f"{given}: {error.strerror}") from error
        place = Place(given, seconds, head, decoded_text(head)[0])
    found = next((kind for kind in KINDS if kind.recognised(place)), CELL if given.endswith(".toml") else None)
    if found is None:
        known = "; ".join(kind.name for kind in KINDS)
        begins = f"it begins with {place.head[:24]!r}"
        raise CommandError("unknown_kind", f"{given} is of no kind that is read: {begins}. Read are: {known}")
    return found, place


def _context(folder: Path) -> DriverContext:
    return DriverContext(MonotonicClock(), "doctor", folder, folder, camera="stream")


# -- models ---------------------------------------------------------------------------------------------------


def _model(place: Place) -> Findings:
    data = place.path.read_bytes()
    try:
        model = decode_model(data, place.path)
    except ModelFileError:
        with decoding(lambda cause: CommandError("file", f"{place.path}: {cause}")):
            odd = json_of(data)[1]
        yield from remark_findings(place.path, odd, "calibrate again, or copy the file again")
        raise
    fit = "" if model.statistics is None else f", {model.statistics.rms_px:.3f} px rms"
    yield ExaminationFinding(
        "model",
        True,
        f"schema {model.schema}, epoch {model.epoch} of {model.created or 'an unknown time'}, {model.stratum}{fit}",
    )
    cameras = ", ".join(f"{one.name} {one.width}x{one.height}" for one in model.cameras)
    yield ExaminationFinding(
        "contents",
        True,
        f"joints {', '.join(model.joint_names)}; cameras {cameras} ({model.mount}); {len(model.marker_ids)} markers",
    )


# -- of drivers -----------------------------------------------------------------------------------------------


def _eds(place: Place) -> Findings:
    yield from plugins.load(plugins.JOINT_DRIVERS, "canopen").examine_file(place.path)


def _urdf(place: Place) -> Findings:
    arm = plugins.load(plugins.JOINT_DRIVERS, "pybullet")
    described: JointDriverDescription = arm(
        {"urdf": str(place.path.absolute())}, _context(place.path.parent)
    ).describe()
    yield ExaminationFinding("arm", True, f"{len(described.joints)} joints from the root to the flange")
    for joint in described.joints:
        unit = "rad" if joint.kind == "revolute" else "m"
        limits = f"{joint.position_min:g} to {joint.position_max:g} {unit}, up to {joint.velocity_max:g} {unit}/s"
        message = f"{joint.kind}, {limits}"
        yield ExaminationFinding(joint.name, True, message)
    for note in described.notes:
        yield ExaminationFinding("arm", None, note)


def _stream(place: Place) -> Findings:
    video, source = plugins.load(plugins.CAMERA_DRIVERS, "video"), {"source": place.given}
    try:
        width, height, rate_hz = video.probe_camera(source)
    except DriverError as error:
        if error.code != "image_size":
            raise
        size = dict(zip(("width", "height"), error.data["got"], strict=True))
        width, height, rate_hz = video.probe_camera({**source, **size})
    message = f"{Address(place.given)}: {width}x{height} px at about {rate_hz:g} Hz"
    yield ExaminationFinding("pictures", True, message)
    if place.seconds <= 0:
        return
    camera = video({**source, "width": width, "height": height, "rate_hz": rate_hz}, _context(Path()))
    levels: list[float] = []
    try:
        camera.configure()
        camera.activate()
        end = time.monotonic() + place.seconds
        while time.monotonic() < end:
            levels += [float(frame.image.mean()) for frame in camera.poll()]
            time.sleep(POLL_S)
        counts = camera.statistics() if isinstance(camera, CountingCameraDriver) else None
    finally:
        camera.close()
    level = f", mean level {np.mean(levels):.0f} of 255" if levels else ""
    yield ExaminationFinding("stream", len(levels) > 1, f"{len(levels)} pictures in {place.seconds:g} s{level}")
    for what in ("dropped", "frozen", "reconnects"):
        if counts is not None and (count := getattr(counts, what)):
            yield ExaminationFinding(what, None, f"{count} in {place.seconds:g} s")


# -- recordings -----------------------------------------------------------------------------------------------


def _flight(place: Place) -> Findings:
    messages: Counter[str] = Counter()
    settings: CoreSettings | None = None
    made: Fingerprint | None = None
    first_ns = last_ns = observations = 0
    cut: RecordingError | None = None
    try:
        for topic, data in recorded_messages(place.path):
            messages[topic] += 1
            with decoding(partial(RecordingError, place.path, messages["step"])):
                if topic == "header":
                    header = msgspec.msgpack.decode(data)
                    made = msgspec.convert(header["fingerprint"], Fingerprint)
                    settings = msgspec.msgpack.decode(header["settings"], type=CoreSettings, dec_hook=decode_array)
                elif topic == "step":
                    inputs = decode_step(data).inputs
                    last_ns, observations = inputs.now_ns, observations + len(inputs.observations)
                    first_ns = first_ns or last_ns
            if messages["step"] % 50_000 == 49_999:
                log(f"{messages['step']} steps")
    except RecordingError as error:
        if not error.cut or not messages["step"]:
            raise
        cut = error
    if settings is None or made is None:
        raise RecordingError(place.path, messages["step"], "holds no header; is it a flight recording?")
    seconds = (last_ns - first_ns) * 1e-9
    rate = f", {(messages['step'] - 1) / seconds:.1f} Hz" if seconds > 0 else ""
    message = f"{messages['step']} steps in {seconds:.1f} s{rate} (loop of {settings.rate_hz:g} Hz)"
    yield ExaminationFinding("flight", True, f"{message}, of stereoservo {made.stereoservo}")
    cameras = ", ".join(f"{one.name} {one.width}x{one.height}" for one in settings.cameras)
    yield ExaminationFinding(
        "contents",
        True,
        f"cell {settings.cell}: joints {', '.join(settings.joint_names)}; cameras {cameras}; {observations} frames; "
        f"{messages['checkpoint']} checkpoints",
    )
    if messages["gap"]:
        yield ExaminationFinding("gaps", None, f"{messages['gap']}: steps are missing there")
    if cut is not None:
        yield ExaminationFinding("end", None, str(cut), "`stereoservo export` and `replay` use what is before the cut")


def _data_set(place: Place) -> Findings:
    folder = place.path
    info = lerobot.read_info(folder)
    losses: list[lerobot.Loss] = []
    rows = lerobot.read_rows(folder, info, losses=losses)
    states, cameras = lerobot.state_names(info, folder), lerobot.camera_features(info, folder)
    episodes = len(np.unique(rows.episode))
    message = f"format {info.codebase_version}, {episodes} episodes, {len(rows.stamp)} rows at {info.fps:g} Hz"
    yield ExaminationFinding("data set", True, message)
    ranges = ", ".join(
        f"{name} {low:g} to {high:g}" for name, low, high in zip(states, *_ranges(rows.state), strict=True)
    )
    yield ExaminationFinding("states", True, f"{ranges}; their units are stated by `examine --units`")
    total = 0
    for name, key in cameras.items():
        stored = info.features[key].dtype == "image"
        every = max(1, -(-len(rows.stamp) * len(cameras) // MOST_FRAMES)) if stored else 1
        found = 0
        for row, picture in lerobot.pictures(folder, info, key, rows, every, losses=losses, stamps_only=not stored):
            try:
                found += not stored or picture() is not None
            except lerobot.DataSetError as error:
                losses.append(lerobot.Loss(str(error), name, int(rows.episode[row]), int(rows.frame[row])))
        asked, shape = len(range(0, len(rows.stamp), every)), "x".join(map(str, info.features[key].shape))
        yield ExaminationFinding(
            f"camera {name}",
            True if found else None,
            f"{info.features[key].dtype}, {shape}: {found} of {asked} pictures",
        )
        total += found
    if not total:
        yield ExaminationFinding("pictures", False, "no camera has any")
    for text in lerobot.described_losses(losses):
        yield ExaminationFinding("lost", None, text, "copy it again from its source; the rest is examined without it")
    if not (folder / DETECTOR).is_file():
        missing = f"no {DETECTOR}, which `examine` needs to find markers"
        yield ExaminationFinding(
            "detector", None, missing, f'{DETECTOR} in the folder: detector = "aruco", [options] tags = [9]'
        )


def _ranges(values: FloatArray) -> tuple[list[float], list[float]]:
    return values.min(axis=0).tolist(), values.max(axis=0).tolist()


def _folder(place: Place) -> Findings:
    views: RecordedViews = read_folder(place.path)
    samples, span = len(views.joint_times), float(np.ptp(views.joint_times))
    what = "poses" if views.generators is not None else f"samples of {', '.join(views.joint_names)}"
    yield ExaminationFinding("arm", True, f"{samples} {what}" + (f" in {span:.1f} s" if views.timed else ""))
    lows, highs = _ranges(views.positions)
    ranges = ", ".join(
        f"{name} {low:.3g} to {high:.3g}" for name, low, high in zip(views.joint_names, lows, highs, strict=True)
    )
    yield ExaminationFinding("ranges", True, f"{ranges} [rad or m]")
    for c, camera in enumerate(views.cameras):
        seen = views.seen[views.camera == c].any(axis=1)
        message = f"{camera.width}x{camera.height}, markers in {int(seen.sum())} of {len(seen)} pictures"
        yield ExaminationFinding(f"camera {camera.name}", bool(seen.any()), message)
    for note in views.notes:
        yield ExaminationFinding("note", None, note)


# -- the table of kinds ---------------------------------------------------------------------------------------


def _text(pattern: str) -> Callable[[Place], bool]:
    """Recogniser of files in whose text a pattern is found."""
    compiled = re.compile(pattern, re.IGNORECASE | re.MULTILINE)
    return lambda place: compiled.search(place.text) is not None


CELL = Kind("cell file (TOML)", _text(r"^\s*\[+(?:cell|joints|camera|safety|servo|calibration)\b|^schema\s*="), None)
KINDS = (
    Kind("URL of a stream or snapshot (http://, https://, rtsp://)", lambda place: "://" in place.given, _stream),
    Kind("LeRobot data set (a folder with meta/info.json)", lambda place: lerobot.is_data_set(place.path), _data_set),
    Kind("folder of joints or poses and pictures or markers", lambda place: place.path.is_dir(), _folder),
    Kind("flight recording (MCAP)", lambda place: place.head.startswith(b"\x89MCAP"), _flight),
    Kind("URDF", _text(r"<robot[\s>]"), _urdf),
    Kind("model (JSON)", _text(r'\A\s*\{[^\0]*"(?:generators|plane_at_infinity)"\s*:'), _model),
    CELL,
    Kind("EDS or DCF", _text(r"^\s*\[\s*(?:(?:0x)?[0-9a-f]{4}(?:\s*sub\s*[0-9a-f]+)?|FileInfo|DeviceInfo)\s*\]"), _eds),
)
"""All kinds, in the order in which they are tried: the readers behind them stand elsewhere, one for each."""


def examine_place(kind: Kind, place: Place) -> Findings:
    """Findings on a place of a kind other than a cell. Raises what its reader raises if it cannot be used."""
    assert kind.described is not None
    yield ExaminationFinding("kind", True, f"{Address(place.given)}: {kind.name}")
    yield from kind.described(place)
