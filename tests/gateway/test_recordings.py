"""Orders to record images, and what is told of them; no process is started."""

from __future__ import annotations

import errno
import os
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from stereoservo.gateway import recordings
from stereoservo.gateway.publisher import EventLog, OperatorNotes
from stereoservo.gateway.recordings import CannotRecordError, ImageRecordings, Recordings
from stereoservo.messages.cell_file import RecordingSection
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.recording_request import RecordedImages, read_request, request_path
from stereoservo.messages.wire import EventMessage, decode
from stereoservo.recording.ring import RingLimits
from stereoservo.recording.step_messages import RecordedCheckpoint, RecordedStep, RecordingStart
from stereoservo.recording.step_records import fingerprint


class Settings(msgspec.Struct):
    """What a recorder asks of the core's settings."""

    rate_hz: float


class Bench:
    """Orders of a cell with these cameras, on a clock of its own."""

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch, **cameras: str) -> None:
        self.directories = CellDirectories("cell", directory, directory)
        self.events: list[EventMessage] = []
        self.now = 100.0
        clock = SimpleNamespace(monotonic=lambda: self.now, monotonic_ns=lambda: int(self.now * 1e9))
        monkeypatch.setattr(recordings, "time", clock)
        plan: Any = SimpleNamespace(
            directories=self.directories,
            cameras=[SimpleNamespace(name=name, delivers=delivers) for name, delivers in cameras.items()],
        )
        log = EventLog("boot", lambda payload: self.events.append(decode(payload, EventMessage)))
        self.orders = ImageRecordings(plan, log)
        self.flight = directory / "flight.mcap"

    def tell(self, camera: str, frames: int, left_out: int = 0, why: str = "ended") -> None:
        file = str(self.flight.with_suffix(".images") / f"{camera}.avi")
        self.orders.add_report(RecordedImages(camera, file, frames, left_out, 1000, why))

    def ordered(self) -> str | None:
        order = read_request(request_path(self.directories))
        return None if order is None else order.directory


def test_a_recording_is_summed_up_once_all_cameras_have_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path, monkeypatch, left="frames", right="frames", third="observations")
    bench.orders.check()
    bench.orders.begin(bench.flight)
    assert bench.ordered() == str(tmp_path / "flight.images")
    assert "third deliver observations" in bench.events[-1].message
    bench.tell("right", 40, 2, "the disk is full")
    bench.orders.poll()
    assert bench.orders.running
    bench.orders.end()
    assert bench.ordered() is None
    bench.orders.poll()
    assert [event.kind for event in bench.events] == ["images"]
    bench.tell("left", 50)
    bench.orders.poll()
    bench.orders.poll()
    assert [event.kind for event in bench.events] == ["images", "images_recorded"]
    found = bench.events[-1].images
    assert found is not None
    assert [(one.camera, one.frames, one.left_out) for one in found.cameras] == [
        ("left", 50, 0),
        ("right", 40, 2),
    ]
    assert bench.events[-1].message.endswith("left: 50 frames; right: 40 frames, 2 left out, the disk is full")


def test_a_vision_process_that_states_nothing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path, monkeypatch, left="frames", right="frames")
    bench.orders.begin(bench.flight)
    bench.orders.add_report(RecordedImages("right", "/elsewhere/right.avi", 9, 0, 9))
    bench.orders.end()
    bench.tell("left", 5)
    bench.now += recordings.REPORT_TIMEOUT_S + 0.1
    bench.orders.poll()
    found = bench.events[-1].images
    assert found is not None
    assert "did not report how many" in found.cameras[1].why
    assert not bench.orders.running


def test_a_new_recording_does_not_wait_for_the_last_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path, monkeypatch, left="frames")
    bench.orders.begin(bench.flight)
    first = read_request(request_path(bench.directories))
    bench.orders.end()
    bench.now += 0.1
    bench.flight = tmp_path / "second.mcap"
    bench.orders.begin(bench.flight)
    second = read_request(request_path(bench.directories))
    assert first is not None
    assert second is not None
    assert first.number != second.number
    assert [event.kind for event in bench.events] == ["images", "images_recorded", "images"]


def test_cameras_without_pictures_are_refused_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path, monkeypatch, left="observations", right="observations")
    with pytest.raises(CannotRecordError, match="left, right deliver observations"):
        bench.orders.check()
    request_path(bench.directories).write_text('{"number": 1, "directory": "/old"}')
    assert Bench(tmp_path, monkeypatch, left="frames").ordered() is None, "of a gateway that has died"


def test_a_cell_that_states_nothing_keeps_ten_minutes_in_half_a_gibibyte_and_four_faults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[Path, RingLimits]] = []
    monkeypatch.setattr(recordings, "RingThread", lambda *what: made.append(what))
    directories = CellDirectories("cell", tmp_path, tmp_path)
    plan: Any = SimpleNamespace(
        directories=directories, cameras=[], record="", cell=SimpleNamespace(recording=RecordingSection())
    )
    Recordings(plan, EventLog("boot", lambda _: None), lambda topic, text: None)
    assert made == [(directories.recordings, RingLimits(600.0, 512 << 20, 2048 << 20, 4))]


def test_the_ring_is_always_written_and_a_recording_on_request_beside_it(tmp_path: Path) -> None:
    directories = CellDirectories("cell", tmp_path / "run", tmp_path)
    events: list[EventMessage] = []
    plan: Any = SimpleNamespace(
        directories=directories, cameras=[], record="",
        cell=SimpleNamespace(cell=SimpleNamespace(name="cell"), recording=RecordingSection(reserve_mib=0)),
    )  # fmt: skip
    (tmp_path / "run").mkdir()
    log = EventLog("boot", lambda payload: events.append(decode(payload, EventMessage)))
    both = Recordings(plan, log, lambda topic, text: None)
    assert both.wants_steps
    begin = RecordingStart(Settings(250.0), fingerprint())  # type: ignore[arg-type]

    def stream(first: int) -> None:
        both.take(begin)
        both.take(RecordedCheckpoint(first, first, b"state"))
        for k in range(first, first + 10):
            both.take(RecordedStep(k, b"step"))

    stream(1)
    assert not both.running
    both.request()
    stream(11)
    assert both.running
    assert [event.kind for event in events] == ["recording"]
    assert both.stop().endswith(": 10 steps")
    assert both.wants_steps
    both.keep_ring(0)
    stream(21)
    both.close()
    assert [event.kind for event in events] == ["recording", "ring_kept"]
    assert [path.parent.name for path in directories.recordings.rglob("*.mcap")].count("recordings") == 1
    assert (
        len(list((directories.recordings / "kept").rglob("*.mcap")))
        + len(list((directories.recordings / "ring").glob("*.mcap")))
        == 3
    )
    plan.cell.recording = RecordingSection(ring_mib=0)
    without = Recordings(plan, log, lambda topic, text: None)
    assert not without.wants_steps
    without.keep_ring(0)
    without.close()


def no_room(*_: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_ends_a_recording_and_the_next_request_begins_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directories = CellDirectories("cell", tmp_path / "run", tmp_path)
    events: list[EventMessage] = []
    plan: Any = SimpleNamespace(
        directories=directories, cameras=[], record="",
        cell=SimpleNamespace(
            cell=SimpleNamespace(name="cell"), recording=RecordingSection(ring_mib=0, reserve_mib=0)
        ),
    )  # fmt: skip
    (tmp_path / "run").mkdir()
    log = EventLog("boot", lambda payload: events.append(decode(payload, EventMessage)))
    notes = OperatorNotes(log)
    flight = Recordings(plan, log, notes.set_note)
    begin = RecordingStart(Settings(250.0), fingerprint())  # type: ignore[arg-type]

    def stream(first: int) -> None:
        flight.take(RecordedCheckpoint(first, first, b"state"))
        for k in range(first, first + 100):
            flight.take(RecordedStep(k, os.urandom(10_000)))

    flight.request()
    flight.take(begin)
    stream(1)
    assert flight.running
    ended = flight.path
    with monkeypatch.context() as patch:
        patch.setattr("stereoservo.recording.flight_recorder._OutputFile.write", no_room)
        stream(101)
    assert not flight.running
    (note,) = notes.texts
    assert ended in note
    assert "No space left" in note
    assert [event.kind for event in events] == ["recording", "recording_failed", "warning"]
    stream(201)
    assert not flight.running, "it ends with its last whole chunk"
    flight.request()
    flight.take(begin)
    stream(301)
    assert flight.running
    assert flight.path != ended
    assert notes.texts == ()
    flight.close()


def test_a_ring_that_is_not_written_is_a_note_until_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rings: list[SimpleNamespace] = []

    def ring(*_: object) -> SimpleNamespace:
        rings.append(SimpleNamespace(reports=deque(), trouble="", take=lambda _: None, close=lambda: None))
        return rings[-1]

    monkeypatch.setattr(recordings, "RingThread", ring)
    directories = CellDirectories("cell", tmp_path, tmp_path)
    plan: Any = SimpleNamespace(
        directories=directories, cameras=[], record="",
        cell=SimpleNamespace(cell=SimpleNamespace(name="cell"), recording=RecordingSection()),
    )  # fmt: skip
    events: list[EventMessage] = []
    log = EventLog("boot", lambda payload: events.append(decode(payload, EventMessage)))
    notes = OperatorNotes(log)
    flight = Recordings(plan, log, notes.set_note)
    (one,) = rings
    one.reports.append(("warning", "the flight ring is not written: No space left"))
    one.trouble = "No space left"
    for _ in range(3):
        flight.poll()
    assert notes.texts == ("the flight ring is not written: No space left",)
    one.trouble = ""
    one.reports.append(("ring_kept", "kept"))
    flight.poll()
    assert notes.texts == ()
    assert [event.kind for event in events] == ["warning", "ring_kept"]
