"""Recording what a camera delivers: ordered by a file, beside the detection, bounded, counted, never in its way."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from stereoservo.messages.recording_request import ImageRecordingRequest, RecordedImages, write_request
from stereoservo.ports.devices import CameraObservation, Frame
from stereoservo.ports.image_files import ImageLimits, ImageReader, ImageWriter
from stereoservo.recording import image_recording
from stereoservo.recording.image_recording import REQUEST_EVERY_NS, WAITING_FRAMES, ImageRecorder


def whole(reader: ImageReader) -> bool:
    """Whether all that was recorded was read; meaningful at the end."""
    return reader._done and reader.lost == 0 and reader.end is not None


LIMITS = ImageLimits(keep_free_bytes=0)


class Bench:
    """A recorder of camera left, its order, and what it reports; time passes by ``look``."""

    def __init__(self, directory: Path, limits: ImageLimits = LIMITS) -> None:
        self.order = directory / "images.json"
        self.images = directory / "flight.images"
        self.reports: list[tuple[str, str, RecordedImages | None]] = []
        self.recorder = ImageRecorder(self.order, "left", "test", 30.0, lambda *said: self.reports.append(said), limits)
        self.now_ns = 0
        self.seq = 0
        self.rng = np.random.default_rng(0)

    def begin(self, number: int = 1) -> None:
        write_request(self.order, ImageRecordingRequest(number, str(self.images)))
        self.look()

    def look(self) -> None:
        self.now_ns += REQUEST_EVERY_NS
        self.recorder.poll_request(self.now_ns)

    def frame(self, height: int = 48) -> Frame:
        self.seq += 1
        picture = self.rng.integers(0, 256, (height, 64)).astype(np.uint8)
        return Frame("left", self.seq, 1000 * self.seq, 1000 * self.seq + 5, picture)

    def until(self, wanted: Callable[[], bool]) -> None:
        for _ in range(2000):
            if wanted():
                return
            self.look()
            time.sleep(0.005)
        raise AssertionError("never happened")

    def finished(self) -> RecordedImages:
        """End the order and wait for what is told."""
        self.order.unlink(missing_ok=True)
        self.until(lambda: any(kind == "images_ended" for kind, _, _ in self.reports))
        (result,) = [images for kind, _, images in self.reports if kind == "images_ended"]
        assert result is not None
        return result


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    found = Bench(tmp_path)
    yield found
    found.recorder.close()
    assert not any(thread.name == "images-left" for thread in threading.enumerate())


def test_what_is_delivered_under_an_order_is_in_the_file(bench: Bench) -> None:
    """Neither before it nor after it; several frames of one poll are all taken; a buffer may be used again."""
    bench.recorder.take([bench.frame()])
    bench.begin()
    frames = [bench.frame() for _ in range(9)]
    kept = [frame.image.copy() for frame in frames]
    for some in (frames[:1], frames[1:4], frames[4:]):
        bench.recorder.take(some)
        for frame in some:
            frame.image[:] = 0
    result = bench.finished()
    bench.recorder.take([bench.frame()])
    assert (result.camera, result.frames, result.left_out, result.why) == ("left", 9, 0, "ended")
    assert result.file == str(bench.images / "left.avi")
    assert result.bytes == (bench.images / "left.avi").stat().st_size
    with ImageReader(bench.images / "left.avi", "left") as reader:
        found = list(reader)
    assert whole(reader)
    assert [frame.seq for frame in found] == [frame.seq for frame in frames]
    assert all((one.image == other).all() for one, other in zip(found, kept, strict=True))


def test_a_disk_that_is_too_slow_costs_frames_which_are_counted_and_never_time(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_go = threading.Event()
    append = ImageWriter.append

    def slow(self: ImageWriter, frame: Frame, left_out: int = 0) -> None:
        assert let_go.wait(20.0)
        append(self, frame, left_out)

    monkeypatch.setattr(ImageWriter, "append", slow)
    bench.begin()
    for _ in range(WAITING_FRAMES + 40):
        bench.recorder.take([bench.frame()])  # returns though nothing is written
    let_go.set()
    bench.until(lambda: not bench.recorder._recording.waiting)  # type: ignore[union-attr]
    bench.recorder.take([bench.frame()])
    result = bench.finished()
    assert result.frames + result.left_out == WAITING_FRAMES + 41
    assert 39 <= result.left_out <= 40, "the thread may hold one frame beside those that wait"
    with ImageReader(bench.images / "left.avi") as reader:
        seqs = [frame.seq for frame in reader]
    assert seqs[-1] == WAITING_FRAMES + 41
    assert reader.end is not None
    assert reader.end.left_out == result.left_out
    _, *lines, _ = map(json.loads, (bench.images / "left.jsonl").read_text().splitlines())
    told = 0
    for line, before in zip(lines, [{"seq": 0}, *lines], strict=False):
        assert line["seq"] - before["seq"] == 1 + line.get("left_out", 0), "a gap is told where it is"
        told += line.get("left_out", 0)
    assert told == result.left_out


def test_a_writer_slower_than_the_camera_ends_with_its_order(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy computer there is always a frame that waits; those after the end are none of the recording's."""
    append = ImageWriter.append
    written = threading.Semaphore(0)

    def slow(self: ImageWriter, frame: Frame, left_out: int = 0) -> None:
        assert written.acquire(timeout=20.0)
        append(self, frame, left_out)

    monkeypatch.setattr(ImageWriter, "append", slow)
    bench.begin()
    bench.recorder.take([bench.frame() for _ in range(WAITING_FRAMES)])
    bench.order.unlink()
    bench.look()
    for _ in range(3 * WAITING_FRAMES):
        bench.recorder.take([bench.frame()])
        written.release()
    result = bench.finished()
    assert (result.frames, result.left_out) == (WAITING_FRAMES, 0)


def test_a_full_disk_ends_the_recording_and_not_the_camera(tmp_path: Path) -> None:
    bench = Bench(tmp_path, ImageLimits(max_seconds=4.5e-6, keep_free_bytes=0))
    bench.begin()
    for _ in range(8):
        bench.recorder.take([bench.frame()])
    bench.until(lambda: bool(bench.reports))
    bench.recorder.take([bench.frame()])
    for _ in range(3):
        bench.look()
    ((kind, text, result),) = bench.reports
    assert kind == "images_ended"
    assert "ended early" in text
    assert "the limit is" in text
    assert result is not None
    assert (result.frames, result.left_out) == (5, 3)
    with ImageReader(bench.images / "left.avi") as reader:
        assert sum(1 for _ in reader) == 5
    assert reader.end is not None
    assert "the limit is" in reader.end.why
    bench.begin(2)  # over files that are there: told, and nothing is overwritten
    bench.recorder.take([bench.frame()])
    bench.until(lambda: len(bench.reports) == 2)
    assert "never writes over another" in bench.reports[1][1]
    bench.recorder.close()


def test_a_directory_that_cannot_be_made_is_reported(bench: Bench) -> None:
    bench.images.write_text("a file is in the way")
    bench.begin()
    bench.recorder.take([bench.frame(), bench.frame()])
    bench.until(lambda: bool(bench.reports))
    kind, text, result = bench.reports[0]
    assert kind == "images_ended"
    assert str(bench.images) in text
    assert result is not None
    assert (result.frames, result.left_out) == (0, 2)


def test_frames_that_do_not_fit_are_left_out(bench: Bench) -> None:
    bench.begin()
    bench.recorder.take([bench.frame(), bench.frame(height=40), bench.frame()])
    observation = CameraObservation("left", 1, 1, 1, np.array([1]), np.zeros((1, 2)), np.zeros((1, 2, 2)))
    bench.recorder.take([observation])
    result = bench.finished()
    assert (result.frames, result.left_out, result.why) == (2, 1, "ended")


def test_the_end_of_the_process_ends_the_file_whole(bench: Bench) -> None:
    bench.begin()
    bench.recorder.take([bench.frame() for _ in range(20)])
    bench.recorder.close()
    assert [kind for kind, _, _ in bench.reports] == ["images_ended"]
    with ImageReader(bench.images / "left.avi") as reader:
        assert sum(1 for _ in reader) == 20
    assert whole(reader)


def test_an_order_that_is_no_order_is_reported_and_ignored(bench: Bench) -> None:
    bench.order.write_text("{]")
    bench.look()
    bench.recorder.take([bench.frame()])
    assert bench.reports[0][0] == "warning"
    assert bench.recorder._recording is None


def test_two_orders_make_two_recordings(bench: Bench, tmp_path: Path) -> None:
    bench.begin(1)
    bench.recorder.take([bench.frame()])
    bench.images = tmp_path / "second.images"
    bench.begin(2)
    bench.until(lambda: len(bench.reports) == 1)
    bench.look()
    bench.recorder.take([bench.frame(), bench.frame()])
    bench.recorder.close()
    assert [images.frames for _, _, images in bench.reports if images is not None] == [1, 2]
    assert image_recording.CLOSING_S < 4.0, "the supervisor kills the process after 4 s"


@pytest.mark.parametrize("data", [b"", b"\xff", b"[" * 60_000, b'{"number": "one"}', b" " * 100_000])
def test_an_order_that_cannot_be_read_is_set_aside_and_reported_once(bench: Bench, data: bytes) -> None:
    bench.order.write_bytes(data)
    for _ in range(5):
        bench.look()
    ((kind, text, images),) = bench.reports
    assert (kind, images) == ("warning", None)
    assert "set aside as images.json.damaged-1" in text
    bench.reports.clear()
    bench.begin()
    bench.recorder.take([bench.frame()])
    assert bench.finished().frames == 1
