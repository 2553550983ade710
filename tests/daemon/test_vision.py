"""The vision process's pipeline in virtual time: newest only, priors, errors and reconnects."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from stereoservo.daemon.heartbeat import CAMERA_OPENS_S, VISION_HANG_S
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_LAYOUT,
    PRIOR_CAPACITY,
    PRIOR_LAYOUT,
    decode_observation,
    encode_prior,
)
from stereoservo.daemon.seqlock import SlotReader, SlotWriter
from stereoservo.daemon.vision import (
    LONGEST_PAUSE_S,
    PRIOR_MAX_AGE_S,
    SILENT_CAMERA_S,
    CameraPipeline,
    VisionSlots,
    camera_loop,
    run_camera,
)
from stereoservo.messages.directories import CellDirectories
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import CameraObservation, DriverError, Frame, Prior


def observation(seq: int, t_ns: int) -> CameraObservation:
    return CameraObservation("left", seq, t_ns, t_ns, np.array([1]), np.zeros((1, 2)), np.zeros((1, 2, 2)))


class StubCamera:
    """Delivers what the test put into ``arriving``; ``fail`` is raised by its call."""

    def __init__(self) -> None:
        self.arriving: list[Frame] | list[CameraObservation] = []
        self.fail: dict[str, DriverError] = {}
        self.calls: list[str] = []

    def _call(self, name: str) -> None:
        self.calls.append(name)
        if name in self.fail:
            raise self.fail[name]

    def configure(self) -> None:
        self._call("configure")

    def activate(self) -> None:
        self._call("activate")

    def poll(self) -> list[Frame] | list[CameraObservation]:
        self._call("poll")
        arrived, self.arriving = self.arriving, []
        return arrived

    def deactivate(self) -> None:
        self._call("deactivate")

    def close(self) -> None:
        self.calls.append("close")


class StubDetector:
    """Notes the prior of each frame."""

    def __init__(self) -> None:
        self.priors: list[Prior | None] = []

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        self.priors.append(prior)
        return observation(frame.seq, frame.t_shutter_ns)


class Bench:
    def __init__(self, directory: Path, detector: StubDetector | None) -> None:
        self.clock = VirtualClock()
        self.camera = StubCamera()
        directories = CellDirectories("bench", directory, directory)
        self.priors = SlotWriter(directories.prior_slot("left"), PRIOR_CAPACITY, PRIOR_LAYOUT)
        self.links = VisionSlots(directories, "left")
        self.newest = SlotReader(directories.observation_slot("left"), OBSERVATION_LAYOUT)
        self.pipeline = CameraPipeline(self.camera, detector, self.links, self.clock)  # type: ignore[arg-type]
        self.reports: list[tuple[str, str]] = []

    def frame(self, seq: int) -> Frame:
        now = self.clock.now_ns()
        return Frame("left", seq, now, now, np.zeros((2, 2), np.uint8))

    def seen(self) -> int | None:
        data = self.newest.poll()
        return None if data is None else decode_observation(data).seq


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path, None)
    yield bench
    bench.links.close()
    bench.priors.close()


def test_only_the_newest_of_several_frames_is_handed_over(bench: Bench) -> None:
    assert not bench.pipeline.poll()
    bench.camera.arriving = [observation(1, 1), observation(2, 2), observation(3, 3)]
    assert bench.pipeline.poll()
    assert bench.seen() == 3
    assert (bench.pipeline.frames, bench.pipeline.written) == (3, 1)


def test_a_camera_may_take_long_to_open_and_to_its_first_image(bench: Bench) -> None:
    beats: list[float] = []
    pipeline = CameraPipeline(bench.camera, None, bench.links, bench.clock, None, beats.append)  # type: ignore[arg-type]
    pipeline.open()
    pipeline.poll()
    bench.camera.arriving = [observation(1, 1)]
    pipeline.poll()
    assert set(beats) == {CAMERA_OPENS_S}
    beats.clear()
    pipeline.poll()
    assert beats == [VISION_HANG_S]
    pipeline.close()
    assert beats[-1] == CAMERA_OPENS_S


def test_a_detector_gets_a_fresh_prior_and_no_stale_one(tmp_path: Path) -> None:
    detector = StubDetector()
    bench = Bench(tmp_path, detector)
    bench.camera.arriving = [bench.frame(1)]
    bench.pipeline.poll()
    prior = Prior("left", bench.clock.now_ns(), np.array([1]), np.ones((1, 2)), np.zeros((1, 2)), np.zeros((1, 2, 2)))
    bench.priors.write(encode_prior(prior))
    for _ in range(2):  # the second frame of the same prior gets it, too
        bench.camera.arriving = [bench.frame(2)]
        bench.pipeline.poll()
    bench.clock.advance_to(bench.clock.now_ns() + int(PRIOR_MAX_AGE_S * 1e9) + 1)
    bench.camera.arriving = [bench.frame(3)]
    bench.pipeline.poll()
    assert [None if p is None else p.t_ns for p in detector.priors] == [None, prior.t_ns, prior.t_ns, None]


def test_frames_without_a_detector_are_an_error_that_says_so(bench: Bench) -> None:
    bench.camera.arriving = [bench.frame(1)]
    with pytest.raises(DriverError, match="names no detector"):
        bench.pipeline.poll()


def run(bench: Bench, seconds: float, script: dict[float, object], period_s: float = 0.0) -> None:
    """Run the pipeline for so much virtual time; at each time of ``script`` call its entry."""
    start = bench.clock.now_ns()
    waiting = sorted(script.items())

    def sleep(s: float) -> None:
        bench.clock.sleep(s)
        while waiting and (bench.clock.now_ns() - start) * 1e-9 >= waiting[0][0]:
            waiting.pop(0)[1]()  # type: ignore[operator]

    run_camera(
        camera_loop(
            bench.pipeline,
            lambda kind, text: bench.reports.append((kind, text)),
            bench.clock.now_ns,
            camera="left",
            poll_s=0.002,
            period_s=period_s,
        ),
        lambda: (bench.clock.now_ns() - start) * 1e-9 >= seconds,
        sleep=sleep,
        between=lambda: None,
    )


def test_a_lost_camera_is_reported_once_retried_with_growing_pauses_and_its_return_reported(
    bench: Bench,
) -> None:
    def lose() -> None:
        bench.camera.fail["poll"] = bench.camera.fail["configure"] = DriverError("connection_lost", "the cable is out")

    def back() -> None:
        bench.camera.fail.clear()
        bench.camera.arriving = [observation(9, 9)]

    run(bench, 40.0, {0.1: lose, 30.0: back})
    assert [kind for kind, _ in bench.reports[:2]] == ["camera_lost", "camera_back"]
    assert "left: the cable is out" in bench.reports[0][1]
    assert bench.seen() == 9
    assert 5 < bench.camera.calls.count("configure") < 30 / LONGEST_PAUSE_S + 16
    assert bench.camera.calls[-1] == "close"


def test_a_camera_that_falls_silent_is_opened_anew(bench: Bench) -> None:
    run(bench, 2.0 * SILENT_CAMERA_S, {})
    assert bench.reports == [("camera_lost", f"camera left: no image for {SILENT_CAMERA_S:g} s; trying again")]
    assert bench.camera.calls.count("configure") == 2


def test_a_slow_camera_is_given_three_of_its_periods(bench: Bench) -> None:
    run(bench, 9.5, {4.0: lambda: bench.camera.arriving.append(observation(1, 1))}, period_s=2.0)
    assert bench.reports == []
    run(bench, 6.5, {}, period_s=2.0)
    assert bench.reports == [("camera_lost", "camera left: no image for 6 s; trying again")]


@pytest.mark.parametrize("true_hz", [29.0, 30.0, 31.0, 45.0, 60.0])
def test_a_camera_is_looked_at_seldom_and_its_frames_are_taken_soon(bench: Bench, true_hz: float) -> None:
    """Of a camera that is described with 30 Hz; jitter of its frames is a tenth of its period."""
    rng, poll_s, looks, waited = np.random.default_rng(1), 0.002, [0], []
    due = [(k + 0.1 * rng.random()) / true_hz for k in range(1, round(10 * true_hz))]
    start_ns = bench.clock.now_ns()

    def poll() -> list[CameraObservation]:
        now_s = (bench.clock.now_ns() - start_ns) * 1e-9
        looks[0] += 1
        arrived = 0
        while due and due[0] <= now_s:
            waited.append(now_s - due.pop(0))
            arrived += 1
        return [observation(len(waited), bench.clock.now_ns())] if arrived else []

    bench.camera.poll = poll  # type: ignore[method-assign]
    loop = camera_loop(
        bench.pipeline, lambda kind, text: None, bench.clock.now_ns,
        camera="left", poll_s=poll_s, period_s=1.0 / 30.0,
    )  # fmt: skip
    while due:
        bench.clock.sleep(next(loop))
    late = np.sort(waited[30:])
    if true_hz < 40.0:
        assert looks[0] < 5 * len(waited)  # 8 without the rhythm
        assert late[round(0.9 * len(late))] <= poll_s + 1e-9
    assert late[-1] <= max(1.0 / 30.0 - 0.9 / true_hz, 0.1 / true_hz) + 2 * poll_s


def test_a_prior_that_cannot_be_read_is_left_out(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    prior = Prior("left", 5, np.array([1]), np.ones((1, 2)), np.zeros((1, 2)), np.zeros((1, 2, 2)))
    bench.priors.write(encode_prior(prior))
    assert bench.links.newest_prior() is not None
    for _ in range(5):
        bench.priors.write(b"\xff" * 100)
        found = bench.links.newest_prior()
        assert found is not None
        assert found.t_ns == 5
    assert capsys.readouterr().err.count("prior-left.slot: 1 records left out") == 1


@pytest.mark.parametrize("error", [ValueError("bad JPEG"), MemoryError(), RecursionError(), IndexError("7")])
def test_whatever_a_frame_raises_is_a_lost_camera_and_ends_nothing(tmp_path: Path, error: Exception) -> None:
    class Raising(StubDetector):
        def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
            if frame.seq < 5:
                raise error
            return super().detect(frame, prior)

    bench = Bench(tmp_path, Raising())

    def deliver(seq: int) -> Callable[[], None]:
        def work() -> None:
            bench.camera.arriving = [bench.frame(seq)]

        return work

    run(bench, 4.0, {0.1: deliver(1), 0.5: deliver(2), 3.0: deliver(9)})
    assert [kind for kind, _ in bench.reports] == ["camera_lost", "camera_back"]
    assert "a frame cannot be used" in bench.reports[0][1]
    assert bench.seen() == 9


def test_a_driver_whose_arrays_do_not_fit_is_a_lost_camera(bench: Bench) -> None:
    bench.camera.arriving = [
        CameraObservation("left", 1, 1, 1, np.array([1, 2]), np.zeros((1, 2)), np.zeros((2, 2, 2)))
    ]
    with pytest.raises(
        DriverError, match=r"pixels are float64 of shape \(1, 2\); float64 \(2, 2\) are needed"
    ) as error:
        bench.pipeline.poll()
    assert error.value.code == "frame"
    assert bench.seen() is None
