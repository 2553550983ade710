"""A gateway whose files are damaged or whose disk is full: it comes up, says so once, and loses as little as it can."""

from __future__ import annotations

import errno
import io
import os
import tempfile
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest

from stereoservo.client import FailedError
from stereoservo.core.cycle import Event, Sample
from stereoservo.daemon.kernel_compilation import example_model, example_settings
from stereoservo.daemon.supervisor import record_run
from stereoservo.gateway import persistence, recordings
from stereoservo.gateway.calibration_jobs import CalibrationJobs
from stereoservo.gateway.model_updates import RelocalizationJobs
from stereoservo.gateway.observation_cache import ObservationCache
from stereoservo.gateway.persistence import Journal, ModelStore, OpenGoalRecord, TaughtStore
from stereoservo.gateway.publisher import EventLog, OperatorNotes
from stereoservo.gateway.recordings import Recordings
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.gateway.teaching import TaughtGoalRegistry
from stereoservo.kinematics.model import save_model
from stereoservo.messages import files
from stereoservo.messages.cell_file import RecordingSection
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.run_record import begin_run, end_run, read_goals, read_run
from stereoservo.messages.wire import EventMessage
from stereoservo.recording import flight_recorder
from stereoservo.recording.step_messages import RecordedStep, RecordingStart
from stereoservo.recording.step_records import fingerprint

MODEL = example_model()
SETTINGS = example_settings()


def full_disk(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")


class Bench:
    """Notes and events of a gateway."""

    def __init__(self) -> None:
        self.log = EventLog("boot", lambda _: None)
        self.notes = OperatorNotes(self.log)

    @property
    def events(self) -> list[EventMessage]:
        return list(self.log.since(1).events)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def models(directory: Path, *epochs: int) -> ModelStore:
    store = ModelStore(directory)
    for epoch in epochs:
        save_model(msgspec.structs.replace(MODEL, epoch=epoch), store.path(epoch))
    return store


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0x20
    path.write_bytes(bytes(data))


# -- models -------------------------------------------------------------------------------------------------


class StubLink:
    def __init__(self) -> None:
        self.models: list[int] = []
        self.kept: list[bool] = []

    def send_model(self, model: Any, reanchored: tuple[str, ...] = (), *, kept: bool = False) -> bool:
        self.models.append(model.epoch)
        self.kept.append(kept)
        return True


@pytest.mark.parametrize("at", [0, 200, 1000, -30])
def test_a_damaged_model_is_set_aside_and_the_one_before_is_used(tmp_path: Path, bench: Bench, at: int) -> None:
    store, link = models(tmp_path, 1, 2, 3), StubLink()
    flip(store.path(3), at)
    damaged = store.path(3).read_bytes()
    jobs = CalibrationJobs(SETTINGS, store, cast(ServoConnection, link), bench.log, tmp_path / "checks.jsonl")
    jobs.load(0)
    assert link.models == [2]
    assert link.kept == [True]
    (note,) = jobs.notes
    assert "model-000003.json" in note
    assert "set aside as model-000003.json.damaged-1" in note
    assert "model epoch 2 is used instead" in note
    assert [(event.kind, event.message) for event in bench.events] == [("warning", note)]
    assert (tmp_path / "model-000003.json.damaged-1").read_bytes() == damaged
    assert store.next_epoch() == 4  # that of the damaged one is never given again
    again = CalibrationJobs(SETTINGS, store, cast(ServoConnection, link), bench.log, tmp_path / "checks.jsonl")
    again.load(2)
    assert again.notes == ()


def test_without_a_good_model_the_cell_starts_uncalibrated(tmp_path: Path, bench: Bench) -> None:
    store, link = models(tmp_path, 1, 2), StubLink()
    store.path(1).write_bytes(b"")
    store.path(2).write_bytes(b"[" * 60_000)
    jobs = CalibrationJobs(SETTINGS, store, cast(ServoConnection, link), bench.log, tmp_path / "checks.jsonl")
    jobs.load(0)
    assert (link.models, jobs.model) == ([], None)
    assert len(jobs.notes) == 2
    assert all("no model is used" in note for note in jobs.notes)


def test_a_model_of_another_version_is_not_damaged_and_stays(tmp_path: Path) -> None:
    store = models(tmp_path, 1)
    store.path(2).write_text('{"schema": 9}')
    found, passed = store.newest_fitting(SETTINGS, recover=True)
    assert found is not None
    assert found.epoch == 1
    assert len(passed) == 1
    assert store.path(2).exists()


def test_who_only_looks_renames_nothing(tmp_path: Path) -> None:
    store = models(tmp_path, 1)
    store.path(2).write_text("{")
    store.newest_fitting(SETTINGS)
    assert store.path(2).exists()


def test_a_folder_of_models_that_is_gone_is_reported(tmp_path: Path, bench: Bench) -> None:
    store = ModelStore(tmp_path / "gone")
    jobs = CalibrationJobs(SETTINGS, store, cast(ServoConnection, StubLink()), bench.log, tmp_path / "checks.jsonl")
    jobs.load(0)
    assert "No such file" in jobs.notes[0]


# -- taught goals -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data", [b"", b'{"schema": 2, "goals": {', b"[" * 60_000, b"\xff", b'{"schema": 9}'])
def test_a_damaged_file_of_taught_goals_is_set_aside_and_reported_once(
    tmp_path: Path, bench: Bench, data: bytes
) -> None:
    path = tmp_path / "taught.json"
    path.write_bytes(data)
    store = TaughtStore(path, recover=bench.notes.set_note)
    assert store.names == ()
    (note,) = bench.notes.texts
    assert str(path) in note
    assert "set aside as taught.json.damaged-1" in note
    assert [(event.kind, event.message) for event in bench.events] == [("warning", note)]
    assert (tmp_path / "taught.json.damaged-1").read_bytes() == data
    assert TaughtStore(path).names == ()


def taught_event(seq: int = 1, t_ns: int = 1) -> Event:
    sample = Sample(
        "left", np.array([2, 5]), np.array([[1.5, 2.5], [3.0, 4.0]]), np.tile(0.01 * np.eye(2), (2, 1, 1)), 20,
        np.full(2, 20.0), np.zeros(2),
    )  # fmt: skip
    return Event(seq, t_ns, "taught", name="pick", request=7, samples=(sample,))


def test_a_goal_that_cannot_be_stored_is_refused_with_the_reason(
    tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = TaughtStore(tmp_path / "taught.json")
    teaching = TaughtGoalRegistry(store, ObservationCache({"left": 0.0}), lambda: MODEL, bench.log)
    monkeypatch.setattr(files.tempfile, "mkstemp", full_disk)
    assert teaching.taught(taught_event()) is False
    assert store.names == ()
    (event,) = bench.events
    assert (event.kind, event.request, event.accepted) == ("warning", 7, False)  # what `teach` waits for
    assert "No space left on device" in event.message
    assert FailedError("teaching 'pick'", event).code == "failed"
    monkeypatch.undo()
    assert teaching.taught(taught_event()) is True
    assert TaughtStore(tmp_path / "taught.json").names == ("pick",)


# -- all that is replaced as a whole ------------------------------------------------------------------------


class HalfWritten(io.FileIO):
    """A file of which the disk takes one half."""

    def write(self, data: Any) -> int:
        super().write(bytes(data)[: len(data) // 2])
        return int(full_disk())


def break_disk(patch: pytest.MonkeyPatch, stage: str) -> str:
    """Let writing files fail at a ``stage``; returns the words of the error."""
    really = io.open

    def read_only(*_: Any, **__: Any) -> Any:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    def open_file(path: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
        if "w" not in mode:
            return really(path, mode, *rest, **named)
        return HalfWritten(path, "w") if stage == "write" else read_only()

    if stage == "replace":
        patch.setattr(os, "replace", read_only)
    else:
        patch.setattr(io, "open", open_file)
    if stage == "open":
        patch.setattr(tempfile, "mkstemp", read_only)
    return os.strerror(errno.ENOSPC if stage == "write" else errno.EROFS)


@pytest.mark.parametrize("stage", ["open", "write", "replace"])
def test_what_cannot_be_written_keeps_its_bytes_is_reported_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    directories = CellDirectories("cell", tmp_path, tmp_path)
    directories.models.mkdir()
    store = models(directories.models, MODEL.epoch)
    begin_run(directories, "boot", 7)
    goals = OpenGoalRecord(directories, "boot")
    log = EventLog("boot", lambda _: None, goals.observe)
    log.add("goal_accepted", id="one")
    teaching = TaughtGoalRegistry(TaughtStore(directories.taught), ObservationCache({"left": 0.0}), lambda: MODEL, log)
    assert teaching.taught(taught_event())
    link = cast(ServoConnection, StubLink())
    cameras = RelocalizationJobs(store, link, log, lambda: MODEL, lambda _: None)
    calibration = CalibrationJobs(SETTINGS, store, link, log, directories.checks)
    for seq in (2, 3):
        sample = msgspec.structs.replace(taught_event().samples[0], camera=SETTINGS.cameras[0].name)
        stop = Event(seq, seq, "calibration_sample", id="g", joints=np.zeros(6), samples=(sample,), trial=-1)
        calibration.on_core_event(stop, fresh=True)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    told = len(log.since(1).events)
    with monkeypatch.context() as patch:
        words = break_disk(patch, stage)
        name, matrix = MODEL.cameras[1].name, 2.0 * MODEL.cameras[1].matrix
        adjusted = Event(4, 4, "camera_adjusted", name=name, matrix=matrix, epoch=MODEL.epoch)
        cameras.on_core_event(adjusted, fresh=True)
        assert not teaching.taught(msgspec.structs.replace(taught_event(5), name="place"))
        calibration.on_core_event(Event(6, 6, "calibration_finished", id="g"), fresh=True)
        while calibration.busy:
            calibration.poll()
        record_run(partial(end_run, directories, "a cause"))
        log.add("goal_accepted", id="two")
    events = log.since(1).events[told:]
    assert [e.kind for e in events] == ["warning", "warning", "calibration_failed", "goal_accepted"]
    assert all(words in event.message for event in events[:3])
    kept = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert {path: data for path, data in kept.items() if path.suffix != ".new"} == before
    record_run(partial(end_run, directories, "a cause"))
    log.add("goal_reached", id="one")
    run = read_run(directories)
    assert run is not None
    assert run.cause == "a cause"
    assert [goal.id for goal in read_goals(directories)] == ["two"]


# -- journal ------------------------------------------------------------------------------------------------


def test_a_journal_on_a_full_disk_counts_what_it_loses_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "journal.jsonl"
    space = [25]

    class Full(persistence.FileIO):
        def write(self, data: Any) -> int:
            if space[0] <= 0:
                full_disk()
            written = super().write(bytes(data)[: space[0]])
            space[0] -= written
            return written

    monkeypatch.setattr(persistence, "FileIO", Full)
    journal = Journal(path)
    for k in range(5):
        journal.add(b'{"line": %d}' % k)
    assert "3 events are missing in it: No space left on device" in journal.note
    space[0] = 1000
    journal.add(b'{"line": 5}')
    journal.close()
    whole = [line for line in path.read_bytes().splitlines() if line.endswith(b"}")]
    assert whole[0] == b'{"line": 0}'
    assert whole[-1] == b'{"line": 5}'


def test_a_journal_that_cannot_be_opened_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(persistence.time, "monotonic", lambda: now)
    path = tmp_path / "state" / "journal.jsonl"
    journal = Journal(path)
    journal.add(b"one")
    assert "1 events are missing in it: No such file or directory" in journal.note
    path.parent.mkdir()
    journal.add(b"two")  # not tried in the same second
    now += 2.0
    journal.add(b"three")
    assert "2 events are missing" in journal.note
    journal.close()
    assert path.read_bytes() == b"three\n"


# -- recordings ---------------------------------------------------------------------------------------------


class Recorder:
    """Recordings of a cell without cameras, on a disk with so much ``space``."""

    def __init__(self, directory: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
        directories = CellDirectories("cell", directory, directory)
        plan: Any = SimpleNamespace(
            directories=directories,
            cameras=[],
            record="",
            cell=SimpleNamespace(cell=SimpleNamespace(name="cell"), recording=RecordingSection(ring_mib=0)),
        )
        monkeypatch.setattr(recordings, "request_path", lambda _: directory / "images.json")
        self.recordings = Recordings(plan, bench.log, bench.notes.set_note)
        self.recordings.request()
        self.start = RecordingStart(SETTINGS, fingerprint())


def test_a_recording_on_a_full_disk_ends_and_the_rest_is_counted(
    tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(tmp_path, bench, monkeypatch)
    recorder.recordings.take(recorder.start)
    rng = np.random.default_rng(1)
    for k in range(400):
        if k == 300:
            monkeypatch.setattr(flight_recorder._OutputFile, "write", full_disk)
        recorder.recordings.take(RecordedStep(k, rng.bytes(4000)))
    assert [event.kind for event in bench.events] == ["recording", "recording_failed", "warning"]
    assert "No space left on device" in bench.events[1].message
    assert "No space left on device" in bench.notes.texts[0]
    text = recorder.recordings.stop()
    kept, left_out = (int(word) for word in text.replace(",", "").split() if word.isdigit())
    assert 0 < kept <= 300
    assert kept + left_out == 400


def test_a_recording_that_cannot_begin_is_reported_and_given_up(
    tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(tmp_path, bench, monkeypatch)
    (tmp_path / "recordings").write_text("a file in the place of the folder")
    recorder.recordings.take(recorder.start)
    recorder.recordings.take(RecordedStep(1, b"x"))
    assert recorder.recordings.refused
    assert not recorder.recordings.running
    assert bench.events[0].kind == "recording_failed"
    assert len(bench.notes.texts) == 1
    (tmp_path / "recordings").unlink()
    recorder.recordings.request()
    recorder.recordings.take(recorder.start)
    assert recorder.recordings.running
    assert not recorder.recordings.refused
    assert bench.notes.texts == ()
    recorder.recordings.stop()


def test_a_note_is_one_event_however_often_it_changes(bench: Bench) -> None:
    for k in range(100):
        bench.notes.set_note("journal", f"{k} lines are missing")
        bench.notes.set_note("slots", "")
    assert bench.notes.texts == ("99 lines are missing",)
    assert len(bench.events) == 1
    bench.notes.set_note("journal", "")
    bench.notes.set_note("journal", "again")
    assert len(bench.events) == 2


def test_what_a_driver_leaves_out_is_a_note_of_the_whole_run_and_an_event() -> None:
    log = EventLog("boot", lambda _: None)
    notes = OperatorNotes(log, ("joint 'gripper' is left out",))
    notes.set_note("journal", "records left out")
    assert notes.texts == ("joint 'gripper' is left out", "records left out")
    assert next(event.message for event in log.since(1).events) == "joint 'gripper' is left out"
