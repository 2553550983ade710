"""Files and numbered pictures: every frame at its time, and every kind of file that is not what it should be."""

from __future__ import annotations

import os
from itertools import pairwise

import cv2
import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError, Frame
from stereoservo.ports.image_files import ImageWriter, sidecar_of
from stereoservo_drivers.video.driver import VideoCameraDriver

from .conftest import HEIGHT, WIDTH, number_of, picture

MS = 1_000_000


def write_video(path, count=20, codec="FFV1", size=(WIDTH, HEIGHT), images=None):
    gray = codec == "FFV1"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 30.0, size, isColor=gray is False)
    assert writer.isOpened()
    for image in images or [picture(number, *size) for number in range(count)]:
        writer.write(image if gray or image.ndim == 3 else cv2.merge([image] * 3))
    writer.release()
    return path


def write_recording(path, camera="left", lost=(), count=12, same=()):
    with ImageWriter(path, camera, (WIDTH, HEIGHT), 50.0) as writer:
        for k in range(count):
            if k not in lost:
                shutter = 7_000 * MS + k * 20 * MS
                image = picture(k - 1 if k in same else k)
                writer.append(Frame(camera, 100 + k, shutter, shutter + 5 * MS, image))
    return path


def write_pictures(directory, numbers, ending="png"):
    for number in numbers:
        assert cv2.imwrite(str(directory / f"p{number:03d}.{ending}"), picture(number))


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def camera(tmp_path, clock):
    """Makes an active driver on a virtual clock, closed after the test."""
    made = []

    def make(source, **options):
        context = DriverContext(clock, "t", tmp_path, tmp_path, "left")
        driver = VideoCameraDriver({"source": source, "width": WIDTH, "height": HEIGHT, **options}, context)
        made.append(driver)
        driver.configure()
        driver.activate()
        return driver

    yield make
    for driver in made:
        driver.close()


def play(driver):
    """All frames with pace ``every``, and the error at the end."""
    frames = []
    for _ in range(1000):
        try:
            frames += driver.poll()
        except DriverError as error:
            return frames, error
    pytest.fail("no end")


@pytest.mark.parametrize(("ending", "codec"), [("avi", "FFV1"), ("mkv", "FFV1"), ("mp4", "mp4v"), ("avi", "MJPG")])
def test_a_file_gives_each_frame_once_in_order(tmp_path, camera, ending, codec):
    write_video(tmp_path / f"v.{ending}", codec=codec)
    frames, end = play(camera(f"v.{ending}", pace="every", rate_hz=25.0, latency_s=0.01))
    assert [number_of(frame.image) for frame in frames] == list(range(20))
    assert [frame.seq for frame in frames] == list(range(20))
    assert [frame.t_received_ns for frame in frames] == [k * 40 * MS for k in range(20)]
    assert all(frame.t_received_ns - frame.t_shutter_ns == 10 * MS for frame in frames)
    assert end.code == "end_of_file"
    if codec == "FFV1":
        assert all(np.array_equal(frame.image, picture(k)) for k, frame in enumerate(frames))


@pytest.mark.parametrize("source", ["v.avi", "v.mkv", "p%03d.png"])
def test_it_can_start_in_the_middle(tmp_path, camera, source):
    if source.startswith("p"):
        write_pictures(tmp_path, range(20))
    else:
        write_video(tmp_path / source)
    frames, _ = play(camera(source, pace="every", start=13))
    assert [number_of(frame.image) for frame in frames] == list(range(13, 20))
    assert [frame.seq for frame in frames] == list(range(13, 20))
    with pytest.raises(DriverError) as caught:
        camera(source, start=99)
    assert caught.value.code == "start"
    assert "start = 99" in str(caught.value)


def test_frames_come_at_their_times(tmp_path, camera, clock):
    write_video(tmp_path / "v.avi")
    begin = clock.now_ns()
    driver = camera("v.avi", rate_hz=50.0, latency_s=0.005)
    frames = []
    for _ in range(90):
        frames += driver.poll()
        clock.advance_to(clock.now_ns() + 4 * MS)
    assert [frame.t_received_ns - begin for frame in frames] == [k * 20 * MS for k in range(18)]
    assert frames[3].t_shutter_ns == frames[3].t_received_ns - 5 * MS
    assert driver.statistics().dropped == 0


def test_a_late_poll_gives_the_newest_frame_that_is_due(tmp_path, camera, clock):
    write_video(tmp_path / "v.avi")
    driver = camera("v.avi", rate_hz=50.0)
    assert driver.poll()[0].seq == 0
    clock.advance_to(clock.now_ns() + 110 * MS)
    (frame,) = driver.poll()
    assert (frame.seq, number_of(frame.image)) == (5, 5)
    assert driver.statistics().frames == 6
    assert driver.statistics().dropped == 0


def test_after_a_pause_it_goes_on_where_it_was(tmp_path, camera, clock):
    write_video(tmp_path / "v.avi")
    driver = camera("v.avi", rate_hz=50.0)
    driver.poll()
    driver.deactivate()
    clock.advance_to(clock.now_ns() + 1000 * MS)
    driver.activate()
    (frame,) = driver.poll()
    assert (frame.seq, frame.t_received_ns) == (1, clock.now_ns())


def test_the_end_stays_the_end_however_often_it_is_opened(tmp_path, camera):
    write_video(tmp_path / "v.avi", count=3)
    driver = camera("v.avi", pace="every")
    play(driver)
    for _ in range(2):
        driver.close()
        with pytest.raises(DriverError) as caught:
            driver.configure()
        assert caught.value.code == "end_of_file"
        assert "loop = true" in str(caught.value)
        assert not caught.value.retry


def test_a_loop_goes_on_in_number_and_time(tmp_path, camera, clock):
    write_pictures(tmp_path, range(4, 9))
    driver = camera("p%03d.png", rate_hz=50.0, loop=True)
    frames = []
    for _ in range(62):
        frames += driver.poll()
        clock.advance_to(clock.now_ns() + 5 * MS)
    assert [number_of(frame.image) for frame in frames] == [4 + k % 5 for k in range(16)]
    assert {b.seq - a.seq for a, b in pairwise(frames)} == {1}
    assert {b.t_received_ns - a.t_received_ns for a, b in pairwise(frames)} == {20 * MS}


def test_a_recorded_camera_gives_its_own_stamps_numbers_and_pixels(tmp_path, camera):
    write_recording(tmp_path / "left.avi", lost=(4, 7, 8))
    driver = camera("left.avi", pace="every", rate_hz=50.0, latency_s=0.5)
    frames, end = play(driver)
    kept = [k for k in range(12) if k not in (4, 7, 8)]
    assert [frame.seq for frame in frames] == [100 + k for k in kept]
    assert [frame.t_shutter_ns for frame in frames] == [7_000 * MS + k * 20 * MS for k in kept]
    assert all(frame.t_received_ns - frame.t_shutter_ns == 5 * MS for frame in frames)
    assert all(np.array_equal(frame.image, picture(k)) for k, frame in zip(kept, frames, strict=True))
    assert driver.statistics().dropped == 3
    assert end.code == "end_of_file"


def test_a_recorded_camera_on_the_clock_keeps_its_latency_and_gaps(tmp_path, camera, clock):
    write_recording(tmp_path / "left.avi", lost=(4,))
    begin = clock.now_ns()
    driver = camera("left.avi", rate_hz=50.0)
    frames = []
    for _ in range(44):
        frames += driver.poll()
        clock.advance_to(clock.now_ns() + 5 * MS)
    kept = [k for k in range(11) if k != 4]
    assert [frame.t_received_ns - begin for frame in frames] == [k * 20 * MS for k in kept]
    assert all(frame.t_received_ns - frame.t_shutter_ns == 5 * MS for frame in frames)


def test_flipped_bytes_of_a_recording_are_caught_by_the_crc(tmp_path, camera):
    path = write_recording(tmp_path / "left.avi")
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(5)
    for at in rng.integers(len(data) // 2, len(data) * 3 // 4, 40):
        data[at] ^= 0x55
    path.write_bytes(data)
    frames, error = play(camera("left.avi", pace="every", rate_hz=50.0))
    assert error.code == "crc"
    assert "left.avi" in str(error)
    assert len(frames) == error.data["frame"]
    assert all(np.array_equal(frame.image, picture(k)) for k, frame in enumerate(frames))


@pytest.mark.parametrize("recorded", [True, False])
def test_a_file_that_was_cut_off_is_told_with_the_frame(tmp_path, camera, recorded):
    path = write_recording(tmp_path / "left.avi") if recorded else write_video(tmp_path / "left.avi")
    os.truncate(path, path.stat().st_size // 2)
    frames, error = play(camera("left.avi", pace="every", rate_hz=50.0))
    assert error.code == "truncated"
    assert 0 < len(frames) < 12
    assert error.data["frame"] == len(frames)


def test_the_recording_of_another_camera_is_refused(tmp_path, camera):
    write_recording(tmp_path / "left.avi", camera="right")
    with pytest.raises(DriverError) as caught:
        camera("left.avi")
    assert caught.value.code == "camera"
    assert "'right'" in str(caught.value)


@pytest.mark.parametrize("source", ["v.avi", "p%03d.png", "left.avi"])
def test_pictures_of_another_size_are_refused_with_both_sizes(tmp_path, camera, source):
    write_video(tmp_path / "v.avi")
    write_recording(tmp_path / "left.avi")
    write_pictures(tmp_path, range(3))
    with pytest.raises(DriverError) as caught:
        camera(source, width=320, height=240)
    assert caught.value.code == "image_size"
    assert "64x48" in str(caught.value)
    assert "320x240" in str(caught.value)


def _no_moov(path):
    write_video(path, codec="mp4v")
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"moov") - 4])


@pytest.mark.parametrize(
    ("name", "make", "code"),
    [
        ("v.avi", lambda path: None, "missing"),
        ("v.avi", lambda path: path.mkdir(), "not_a_file"),
        ("v.avi", os.mkfifo, "not_a_file"),
        ("v.avi", lambda path: path.touch(), "empty"),
        ("v.avi", lambda path: path.write_text("a text, not a video\n" * 100), "not_a_video"),
        ("v.mkv", lambda path: path.write_bytes(np.random.default_rng(1).bytes(5000)), "not_a_video"),
        ("v.mp4", _no_moov, "not_a_video"),
    ],
    ids=["missing", "directory", "fifo", "empty", "text", "noise", "mp4-without-moov"],
)
def test_what_is_no_video_is_refused(tmp_path, camera, name, make, code):
    make(tmp_path / name)
    with pytest.raises(DriverError) as caught:
        camera(name)
    assert caught.value.code == code
    assert str(tmp_path / name) in str(caught.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_the_right_to_read_is_told(tmp_path, camera):
    write_video(tmp_path / "v.avi").chmod(0)
    with pytest.raises(DriverError) as caught:
        camera("v.avi")
    assert caught.value.code == "permission"


def test_a_foreign_sidecar_is_refused(tmp_path, camera):
    sidecar_of(write_video(tmp_path / "v.avi")).write_text('{"hello": 1}\n')
    with pytest.raises(DriverError) as caught:
        camera("v.avi")
    assert caught.value.code == "foreign_sidecar"


def test_a_file_of_ten_gigabytes_costs_no_memory_and_no_patience(tmp_path, camera):
    os.truncate(write_video(tmp_path / "v.avi"), 10 << 30)  # sparse; behind the video there are zeros without an end
    before = _peak_kib()
    frames, error = play(camera("v.avi", pace="every", read_timeout_s=0.1))
    assert [number_of(frame.image) for frame in frames] == list(range(20))
    assert error.code == "silent"
    assert error.data["frame"] == 20
    assert _peak_kib() - before < 100_000


def _peak_kib():
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))


def test_a_gap_in_numbered_pictures_is_told(tmp_path, camera):
    write_pictures(tmp_path, [0, 1, 2, 4, 5])
    with pytest.raises(DriverError) as caught:
        camera("p%03d.png")
    assert caught.value.code == "sequence_gap"
    assert "p003.png" in str(caught.value)
    assert [frame.seq for frame in play(camera("p%03d.png", start=4, pace="every"))[0]] == [4, 5]


def test_other_files_beside_numbered_pictures_do_not_count(tmp_path, camera):
    write_pictures(tmp_path, [7, 8])
    (tmp_path / "p9.png").touch()
    (tmp_path / "p0010.png").touch()
    (tmp_path / "p011.png.txt").touch()
    assert [frame.seq for frame in play(camera("p%03d.png", pace="every"))[0]] == [7, 8]


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_a_damaged_picture_of_a_sequence_is_told_and_never_delivered(tmp_path, camera, ending):
    write_pictures(tmp_path, range(3), ending)
    path = tmp_path / f"p001.{ending}"
    os.truncate(path, path.stat().st_size * 9 // 10)
    frames, error = play(camera(f"p%03d.{ending}", pace="every"))
    assert [frame.seq for frame in frames] == [0]
    assert error.code == "corrupt"
    assert error.data["frame"] == 1


@pytest.mark.parametrize("missing", ["p%03d.png", "no/p%03d.png"])
def test_no_pictures_at_all(camera, missing):
    with pytest.raises(DriverError) as caught:
        camera(missing)
    assert caught.value.code == "missing"


def test_a_frozen_recording_is_told_where_that_is_asked_for(tmp_path, camera):
    write_recording(tmp_path / "left.avi", same=(5,))
    write_video(tmp_path / "still.avi", images=[picture(3)] * 9)
    assert len(play(camera("left.avi", pace="every", rate_hz=50.0))[0]) == 12
    driver = camera("left.avi", pace="every", rate_hz=50.0, frozen_frames=3)
    assert [frame.seq for frame in play(driver)[0]] == [100 + k for k in range(12) if k != 5]
    assert driver.statistics().frozen == 1
    frames, error = play(camera("still.avi", pace="every", frozen_frames=3))
    assert len(frames) == 1
    assert error.code == "frozen"


@pytest.mark.parametrize(
    ("flip", "seen"),
    [
        ("none", lambda image: image),
        ("horizontal", lambda image: image[:, ::-1]),
        ("vertical", lambda image: image[::-1]),
        ("rotate180", lambda image: image[::-1, ::-1]),
    ],
)
def test_flips(tmp_path, camera, flip, seen):
    image = np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    write_video(tmp_path / "v.avi", images=[image])
    frames, _ = play(camera("v.avi", pace="every", flip=flip))
    assert np.array_equal(frames[0].image, seen(image))
    assert frames[0].image.flags.c_contiguous


@pytest.mark.parametrize(("channel", "index"), [("blue", 0), ("green", 1), ("red", 2)])
def test_one_channel_of_a_colour_picture(tmp_path, camera, channel, index):
    image = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "p000.png"), image)
    frames, _ = play(camera("p%03d.png", pace="every", channel=channel))
    assert np.array_equal(frames[0].image, image[:, :, index])


def test_gray_of_a_colour_picture_is_its_luma(tmp_path, camera):
    image = np.random.default_rng(4).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "p000.png"), image)
    frames, _ = play(camera("p%03d.png", pace="every"))
    luma = image @ np.array([0.114, 0.587, 0.299])  # ITU-R BT.601
    assert np.abs(frames[0].image - luma).max() <= 0.51


@pytest.mark.parametrize(("bits", "ending"), [(10, "png"), (12, "png"), (16, "png"), (16, "tif"), (16, "pgm")])
def test_the_upper_eight_bits_of_deep_pictures(tmp_path, camera, bits, ending):
    """10 or 12 bits in 16: the depth is that of the brightest picture so far, so a dark one stays dark."""
    seen = np.stack([picture(1), picture(2) // 16, picture(3)])
    for k, image in enumerate(seen):
        cv2.imwrite(str(tmp_path / f"p{k:03d}.{ending}"), image.astype(np.uint16) << (bits - 8))
    frames, _ = play(camera(f"p%03d.{ending}", pace="every"))
    assert np.array_equal([frame.image for frame in frames], seen)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_portrait_in_gray_or_colour(tmp_path, camera, channels):
    image = picture(1, HEIGHT, WIDTH)
    cv2.imwrite(str(tmp_path / "p000.png"), cv2.merge([image] * channels))
    frames, _ = play(camera("p%03d.png", pace="every", width=HEIGHT, height=WIDTH))
    assert np.array_equal(frames[0].image, image)


def test_pictures_of_no_whole_numbers_are_told(tmp_path, camera):
    cv2.imwrite(str(tmp_path / "p000.tif"), picture(1).astype(np.float32))
    with pytest.raises(DriverError, match="of another kind"):
        camera("p%03d.tif").configure()
