"""The flight ring: segments that replay by themselves, bounded in time, bytes and free space, kept at a fault."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from stereoservo.core.state_encoding import encode_state
from stereoservo.recording import ring as ring_module
from stereoservo.recording.replay import RecordingError, replay
from stereoservo.recording.ring import FlightRing, RingLimits, RingThread
from stereoservo.recording.step_layout import encode_step
from stereoservo.recording.step_messages import RecordedCheckpoint, RecordedStep, RecordingStart, StepMessage
from stereoservo.recording.step_records import fingerprint

MIB = 1 << 20
CHECKPOINT_EVERY = 25


class Flight:
    """A core in virtual time whose step records go into a ring; the wall clock goes with it."""

    def __init__(self, bench: Any, directory: Path, **limits: float) -> None:
        self.bench, self.directory = bench, directory
        bench.ready()
        given = {"seconds": 600.0, "bytes": 512 * MIB, "reserve_bytes": MIB, "kept": 2, **limits}
        self.limits = RingLimits(**given)  # type: ignore[arg-type]
        self.free, self.steps, self.said = 10 * MIB, 0, []
        self.log: list[StepMessage] = []
        self.restart()

    def restart(self) -> None:
        """A gateway that begins, with the one before killed or never there."""
        self.ring = FlightRing(
            self.directory, self.limits, lambda kind, message: self.said.append((kind, message)),
            wall=lambda: 1e9 + self.bench.now_ns * 1e-9, free=lambda _: self.free,
        )  # fmt: skip
        self.steps = 0
        self.ring.take(RecordingStart(self.bench.settings, fingerprint()))

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * self.bench.settings.rate_hz)):
            state = self.bench.core.state
            if self.steps % CHECKPOINT_EVERY == 0:
                self.ring.take(RecordedCheckpoint(self.bench.now_ns, state.step, encode_state(state)))
            outputs = self.bench.step()
            inputs = self.bench.log[-1][0]
            self.ring.take(RecordedStep(inputs.now_ns, encode_step(inputs, outputs)))
            self.steps += 1
            if self.steps % CHECKPOINT_EVERY == 0:
                self.stamp()

    def stamp(self) -> None:
        """Files were written now by the ring's clock, not by the real one."""
        wall = 1e9 + self.bench.now_ns * 1e-9
        for path in self.segments():
            if path.stat().st_mtime > wall + 1e6:
                os.utime(path, (wall, wall))

    def segments(self) -> list[Path]:
        return sorted(self.ring.segments.glob("*.mcap"))


@pytest.fixture
def flight(benches: Any, tmp_path: Path) -> Flight:
    return Flight(benches(3, noise_px=0.1), tmp_path)


def test_each_segment_replays_by_itself(flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ring_module, "SEGMENT_S", 0.5)
    flight.fly(1.9)
    flight.ring.close()
    segments = flight.segments()
    assert len(segments) == 4
    results = [replay(path) for path in segments]
    assert [result.identical for result in results] == [True] * 4
    assert [result.steps for result in results] == [50, 50, 50, 40]
    assert flight.said == []


def test_a_kill_loses_less_than_half_a_second(flight: Flight) -> None:
    flight.fly(3.0)
    (segment,) = flight.segments()  # which nobody has closed
    with pytest.raises(RecordingError) as caught:
        replay(segment)
    assert caught.value.cut
    result = caught.value.result
    assert result is not None
    assert result.identical is True
    assert flight.steps - result.steps < 0.5 * flight.bench.settings.rate_hz


def test_the_oldest_segments_are_dropped_by_age(flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ring_module, "SEGMENT_S", 0.25)
    flight.limits = flight.limits._replace(seconds=0.75)
    flight.restart()
    flight.fly(2.5)
    assert 4 <= len(flight.segments()) <= 6
    assert replay(flight.segments()[0]).identical is True


def test_the_oldest_segments_are_dropped_by_bytes(flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ring_module, "CHUNK_BYTES", 0)
    monkeypatch.setattr("stereoservo.recording.flight_recorder.CHUNK_BYTES", 1024)
    flight.limits = flight.limits._replace(bytes=120_000)
    flight.restart()
    for _ in range(6):
        flight.fly(0.5)
        assert sum(path.stat().st_size for path in flight.segments()) <= flight.limits.bytes
    first = flight.segments()[0]
    assert len(flight.segments()) > 3
    flight.fly(3.0)
    assert not first.exists()


def test_a_reserve_of_the_disk_stays_free_and_it_is_said_once(flight: Flight) -> None:
    flight.fly(0.5)
    flight.free = MIB - 1
    flight.fly(1.0)
    (segment,) = flight.segments()
    size = segment.stat().st_size
    assert [kind for kind, _ in flight.said] == ["warning"]
    assert "less than 1 MiB are free" in flight.said[0][1]
    assert replay(segment).steps == 50
    flight.free = 10 * MIB
    flight.fly(0.5)
    assert len(flight.segments()) == 2
    assert segment.stat().st_size == size
    assert len(flight.said) == 1


def test_a_full_disk_ends_a_segment_and_not_the_ring(flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    flight.fly(0.25)

    def full(self: Any, message: StepMessage) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("stereoservo.recording.flight_recorder.FlightRecorder.write", full)
        flight.fly(0.75)
    assert [kind for kind, _ in flight.said] == ["warning"]
    assert "No space left" in flight.said[0][1]
    flight.fly(0.5)
    flight.ring.close()
    assert replay(flight.segments()[-1]).identical is True


def test_a_disk_without_any_room_leaves_no_empty_segments_and_is_trouble_until_a_chunk_is_written(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Any, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("stereoservo.recording.flight_recorder._OutputFile.write", full)
        flight.fly(1.0)
        assert flight.ring.trouble == "No space left on device"
    assert flight.segments() == []
    assert [kind for kind, _ in flight.said] == ["warning"]
    flight.fly(1.0)
    assert flight.ring.trouble == ""
    assert len(flight.said) == 1
    flight.ring.close()
    assert replay(flight.segments()[-1]).identical is True


def test_the_ring_is_kept_at_a_fault_with_what_follows(flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ring_module, "AFTER_FAULT_S", 0.5)
    for fault in range(3):
        flight.fly(0.5)
        flight.ring.keep(flight.bench.now_ns)
        flight.ring.keep(flight.bench.now_ns)  # another one of the same moment
        flight.fly(1.0)
        assert len([kind for kind, _ in flight.said if kind == "ring_kept"]) == fault + 1
    kept = sorted(flight.ring.kept.iterdir())
    assert len(kept) == 2
    for place in kept:
        (segment,) = place.glob("*.mcap")
        result = replay(segment)
        assert result.identical is True
        assert result.steps >= 100, "what came before the fault, and half a second after it"
    assert str(kept[-1]) in flight.said[-1][1]


def test_a_gateway_that_was_killed_leaves_its_segments(flight: Flight) -> None:
    flight.fly(0.5)
    (left,) = flight.segments()
    size = left.stat().st_size
    flight.restart()
    flight.fly(0.5)
    flight.ring.close()
    old, new = flight.segments()
    assert old == left
    assert old.stat().st_size >= size
    assert replay(new).identical is True


def test_the_thread_writes_what_it_is_given_and_counts_what_it_cannot_take(
    benches: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = Flight(benches(3), tmp_path / "other")
    thread = RingThread(tmp_path, RingLimits(600.0, 512 * MIB, 0, 1))
    flight.ring = thread  # type: ignore[assignment]
    thread.segments = tmp_path / "ring"  # type: ignore[attr-defined]
    thread.take(RecordingStart(flight.bench.settings, fingerprint()))
    flight.fly(0.5)
    monkeypatch.setattr(ring_module, "WAITING_BYTES", 0)
    flight.fly(0.25)
    monkeypatch.undo()
    flight.fly(0.5)
    thread.keep(0)
    thread.close()
    thread.close()
    (kept,) = (tmp_path / "kept").iterdir()
    (segment,) = kept.glob("*.mcap")
    result = replay(segment)
    assert (result.identical, result.gaps) == (True, 1)
    assert [kind for kind, _ in thread.reports] == ["ring_kept"]
