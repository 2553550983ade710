"""Emulated cameras in virtual time: when pictures are taken and sent, what they show, and what orders make of them."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, Frame
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_sim.emulators.cameras.stream_settings import StreamSettings
from stereoservo_sim.emulators.fault_engine import FaultCommandError
from stereoservo_sim.world.simulated_cell import demo_cell
from stereoservo_sim.world.workpiece import Moved

MS = 1_000_000


def decoded(picture):
    return cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_GRAYSCALE)


def of(sent, stream):
    return [(t, picture) for t, name, picture in sent if name == f"/{stream}.mjpg"]


def found(picture, tmp_path, camera="left"):
    """Markers that the detector finds in a picture: id -> pixel."""
    context = DriverContext(VirtualClock(), "t", tmp_path, tmp_path, camera)
    seen = DotDetector({}, context).detect(Frame(camera, 0, 0, 0, decoded(picture)), None)
    return dict(zip(seen.ids.tolist(), seen.pixels, strict=True))


def truth(picture, camera):
    """Exact pixels of the markers at the picture's shutter."""
    cell = demo_cell()
    q = cell.base.copy()
    q[0] += 0.2 * picture.t_shutter_ns * 1e-9
    pixels, _ = camera.image_of(cell.marker_positions(q))
    return dict(zip(cell.body.ids.tolist(), pixels, strict=True))


def errors(picture, camera, tmp_path):
    seen, exact = found(picture, tmp_path), truth(picture, camera)
    assert len(seen) >= 7
    return np.array([seen[i] - exact[i] for i in seen])


def test_shutters_keep_their_grid_and_pictures_come_a_latency_later(make_bench):
    bench = make_bench()
    bench.run(0.5)
    for name, skew in (("left", 0), ("right", 15 * MS)):
        sent = of(bench.sent, name)
        assert len(sent) >= 12
        for t, picture in sent:
            assert abs((picture.t_shutter_ns - skew) - round(picture.seq * 1e9 / 30)) <= 1
            assert 0 <= t - (picture.t_shutter_ns + 40 * MS) < MS
        assert [b.seq - a.seq for (_, a), (_, b) in pairwise(sent)] == [1] * (len(sent) - 1)


def test_a_picture_shows_the_arm_at_its_shutter_and_jpeg_moves_no_dot(make_bench, tmp_path):
    """The noise of two grey levels is 0.005 px in a dot, JPEG adds 0.0014 px; the arm goes 2 px between pictures."""
    bench = make_bench()
    left = demo_cell().rig.camera("left")
    sent = of(bench.run(0.4), "left")
    assert abs(truth(sent[5][1], left)[0] - truth(sent[4][1], left)[0]).max() > 1.0
    off = np.concatenate([errors(picture, left, tmp_path) for _, picture in sent])
    assert np.sqrt((off**2).mean()) < 0.01
    assert np.abs(off.mean(axis=0)).max() < 4 * 0.01 / np.sqrt(len(off))


def test_jitter_moves_sending_alone_and_keeps_the_order(make_bench):
    plain = make_bench(StreamSettings(name="left"))
    shaken = make_bench(StreamSettings(name="left", jitter_ms=30.0))
    plain.run(1.0)
    shaken.run(1.0)
    times = [t for t, _ in of(shaken.sent, "left")]
    assert times == sorted(times)
    shutters = [picture.t_shutter_ns for _, picture in of(shaken.sent, "left")]
    assert shutters[:25] == [picture.t_shutter_ns for _, picture in of(plain.sent, "left")][:25]
    late = [t - s - 40 * MS for t, s in zip(times, shutters, strict=True)]
    assert min(late) < -5 * MS
    assert max(late) > 5 * MS


def test_losses_are_of_the_share_that_was_set_and_the_same_each_time(make_bench):
    """About 95 pictures, a fifth lost: 19, and 4 standard deviations are 16."""
    runs = [make_bench(StreamSettings(name="left", drop_rate=0.2, rate_hz=100)).run(1.0) for _ in range(2)]
    numbers = [[picture.seq for _, picture in of(run, "left")] for run in runs]
    assert numbers[0] == numbers[1]
    lost = numbers[0][-1] - numbers[0][0] + 1 - len(numbers[0])
    assert 3 <= lost <= 35


def test_what_lasts_ends_by_itself(make_bench):
    bench = make_bench(StreamSettings(name="left"))
    bench.run(0.2)
    assert bench.order("freeze left for 200ms") == "left: frozen for 0.2 s"
    frozen = bench.run(0.2)
    assert len(frozen) >= 5
    assert len({picture.data for _, _, picture in frozen[2:]}) == 1  # two were on their way already
    assert len({picture.seq for _, _, picture in frozen}) == len(frozen)
    bench.run(0.1)
    after = bench.run(0.2)
    assert len({picture.data for _, _, picture in after}) == len(after) >= 5
    assert [event.kind for event in bench.emulator.take_events()] == ["order", "ended"]


def test_orders_wait_for_their_time(make_bench):
    bench = make_bench(StreamSettings(name="left"))
    assert bench.order("drop left for 300ms @ 200ms") == "drop at 0.2 s"
    sent = bench.run(1.0)
    gap = max(b.t_shutter_ns - a.t_shutter_ns for (_, _, a), (_, _, b) in pairwise(sent))
    assert 300 * MS <= gap <= 367 * MS


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("black left", lambda image, before: image.max() <= 2),
        ("white left", lambda image, before: image.min() >= 253),
        ("flip left", lambda image, before: close(image[::-1, ::-1], before)),
        ("mirror left", lambda image, before: close(image[:, ::-1], before)),
        ("exposure left 0.5", lambda image, before: close(image, before * 0.5)),
        ("size left 320x240", lambda image, before: image.shape == (240, 320)),
        ("lamp on", lambda image, before: image[:40, :40].mean() > before[:40, :40].mean() + 80),
    ],
)
def test_what_is_wrong_with_a_picture_is_seen_in_it(make_bench, text, holds):
    bench = make_bench(StreamSettings(name="left"), noise=0.0)
    before = decoded(bench.run(0.1)[-1][2]).astype(float)
    bench.order(text)
    assert holds(decoded(bench.run(0.15)[-1][2]), before)
    bench.order("clear left")
    assert close(decoded(bench.run(0.15)[-1][2]), before)


def close(image, wanted):
    """The arm goes on, so that edges of the body differ; nearly all pixels do not."""
    return float((np.abs(image.astype(float) - wanted) < 6).mean()) > 0.95


def test_spoilt_jpegs_are_as_many_as_ordered(make_bench):
    bench = make_bench(StreamSettings(name="left"))
    bench.run(0.1)
    whole = len(bench.sent[-1][2].data)
    bench.order("truncate left 3")
    lengths = [len(picture.data) for _, _, picture in bench.run(0.3)]
    assert sum(length < 0.7 * whole for length in lengths) == 3
    bench.order("corrupt left 2")
    bench.run(0.3)
    assert bench.emulator.cameras[0].condition.corrupt == 0


def test_a_bump_moves_the_camera_in_its_own_frame_at_once(make_bench, tmp_path):
    bench = make_bench(StreamSettings(name="left"))
    bench.run(0.1)
    bench.order("bump left 1deg 3cm")
    picture = bench.run(0.15)[-1][2]
    left = demo_cell().rig.camera("left").moved_by(Moved((0.03, 0.0, 0.0), (0.0, 1.0, 0.0)).matrix)
    assert np.abs(errors(picture, left, tmp_path)).max() < 0.05
    bench.order("bump left back")
    picture = bench.run(0.15)[-1][2]
    assert np.abs(errors(picture, demo_cell().rig.camera("left"), tmp_path)).max() < 0.05


def test_swapped_cameras_show_each_other_and_go_back(make_bench, tmp_path):
    bench = make_bench()
    bench.run(0.1)
    bench.order("swap left right for 200ms")
    (_, picture) = of(bench.run(0.18), "left")[-1]
    assert np.abs(errors(picture, demo_cell().rig.camera("right"), tmp_path)).max() < 0.05
    bench.run(0.1)
    (_, picture) = of(bench.run(0.1), "left")[-1]
    assert np.abs(errors(picture, demo_cell().rig.camera("left"), tmp_path)).max() < 0.05


def test_other_times_and_losses_by_order(make_bench):
    bench = make_bench(StreamSettings(name="left"))
    for text in ("latency left 80ms", "skew left 10ms", "jitter left 1ms"):
        bench.order(text)
    bench.run(0.2)
    t, _, picture = bench.run(0.2)[-1]
    assert abs(t - picture.t_shutter_ns - 80 * MS) <= 2 * MS
    assert picture.t_shutter_ns - 10 * MS == pytest.approx(picture.seq * 1e9 / 30, abs=1)
    bench.order("loss left 100%")
    bench.run(0.1)
    assert bench.run(0.3) == []
    assert "skew 10 ms" in bench.order("status")


def test_no_camera_of_that_name(make_bench):
    bench = make_bench()
    for text in ("freeze middle", "swap left middle", "drop middle @ 3s"):
        with pytest.raises(FaultCommandError, match="cameras: left, right, all"):
            bench.order(text)


def test_nobody_looks_nothing_is_rendered(make_bench):
    bench = make_bench()
    bench.emulator.wanted = {"/right.mjpg"}
    sent = bench.run(0.2)
    assert {stream for _, stream, _ in sent} == {"/right.mjpg"}
