"""Camera driver ``video``: images of a real camera, or of a recording, as stamped frames."""

from __future__ import annotations

import os
import re
import stat
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports import lerobot
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import CameraDescription, CameraStatistics, Clock, DriverContext, DriverError, Frame
from stereoservo.ports.discovery import FoundCamera
from stereoservo.ports.image_files import ImageFileError, ImageReader, sidecar_of
from stereoservo_drivers.episodes import episode_of, refused
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState
from stereoservo_drivers.video.mjpeg import MjpegSource
from stereoservo_drivers.video.options import DRIVER, Place, VideoOptions, decode_video_options, frozen_frames
from stereoservo_drivers.video.pictures import (
    JPEG,
    PICTURE_FLAG,
    PNG,
    StreamMonitor,
    check_size,
    one_channel,
    picture_size,
)
from stereoservo_drivers.video.server_clock import ServerClock
from stereoservo_drivers.video.sources import (
    CAPTURE,
    QUERY_CAPABILITY,
    Capability,
    CaptureSource,
    GenicamSource,
    Ioctl,
    LiveSource,
    Settings,
    SourcePicture,
    modes,
    opened,
)

MOST_A_POLL = 8
"""Largest number of frames that a late poll skips: bounds its time."""


class Playback:
    """Frames of a recording at their times; the first one is due when delivery starts.

    With pace ``every`` each poll returns the next frame with the recording's own stamps, at any time.
    """

    def __init__(self, place: Place, options: VideoOptions, camera: str, watch: StreamMonitor, clock: Clock) -> None:
        self.settings: Settings = {}
        self._place = place
        self._options = options
        self._camera = camera
        self._watch = watch
        self._clock = clock
        self._look = frozen_frames(options, place)
        self._recording: Recording | None = None
        self._coming: Frame | None = None
        self._error: DriverError | None = None
        self._offset_ns = 0

    def open(self) -> None:
        """Open, and read the first frame. Raises DriverError."""
        first = self._open()
        self._watch.number = max(self._watch.number, first.seq - 1)
        self._coming = first

    def _open(self) -> Frame:
        self._watch.begin()
        self._recording = open_recording(self._place, self._options, self._camera)
        first = self._recording.read()
        if first is None:
            raise self._place.error("empty", "holds no frame")
        return first

    def begin(self) -> None:
        """Start delivery: the next frame is due now; for an episode in repeated playback, the one at the clock's time.
        Raises DriverError.
        """
        if self._coming is None or self._options.pace != "recorded":
            return
        now_ns = self._clock.now_ns()
        self._offset_ns = now_ns - self._coming.t_received_ns
        if isinstance(self._recording, EpisodePictures) and self._options.loop:
            into_ns = now_ns % self._recording.period_ns
            self._offset_ns = now_ns - into_ns
            if self._coming.t_received_ns < into_ns:
                coming = self._recording.read_from(into_ns)
                if coming is None:  # after its last frame
                    self._offset_ns += self._recording.period_ns
                    self._recording.close()
                    coming = self._open()
                self._coming = coming

    def take(self) -> Frame | None:
        """The newest frame that is due. Raises DriverError: the recording's, ``frozen``, or ``end_of_file``."""
        every = self._options.pace == "every"
        now_ns = self._clock.now_ns()
        found: Frame | None = None
        for _ in range(1 if every else MOST_A_POLL):
            coming = self._coming
            if coming is None or (not every and coming.t_received_ns + self._offset_ns > now_ns):
                break
            found = self._seen(coming) or found
            self._coming = self._after(coming)
        if found is None and self._error is not None:
            raise self._error
        return found

    def _seen(self, coming: Frame) -> Frame | None:
        """The frame to deliver; None if it repeats the last image."""
        watch = self._watch
        image = one_channel(watch.eight_bits(coming.image), self._options.channel, self._options.flip)
        if not watch.see(image, coming.t_received_ns, coming.seq, 0, look=self._look > 0):
            if watch.row >= self._look:
                self._error = self._place.error(
                    "frozen", f"shows the same picture {watch.row} times (frozen_frames = {self._look})"
                )
            return None
        return Frame(
            self._camera,
            watch.number,
            coming.t_shutter_ns + self._offset_ns,
            coming.t_received_ns + self._offset_ns,
            image,
        )

    def _after(self, coming: Frame) -> Frame | None:
        """The frame after ``coming``; None at the end or at an error, which :meth:`take` then raises."""
        if self._error is not None or self._recording is None:
            return None
        try:
            following = self._recording.read()
            if following is None and self._options.loop:
                self._recording.close()
                following = self._open()
                period_ns = round(1e9 / self._options.rate_hz)
                self._offset_ns += coming.t_received_ns + period_ns - following.t_received_ns
        except DriverError as error:
            self._error = error
            return None
        if following is None:
            self._error = self._place.error(
                "end_of_file",
                "the recording is over. loop = true plays it again and again; a new start of the process, once more",
            )
        return following

    def close(self) -> None:
        """Close the recording."""
        if self._recording is not None:
            self._recording.close()


# -- recorded pictures ---------------------------------------------------------------------------------------
# Readers of recorded images: video files and numbered image files, one image at a time in constant memory.


LARGEST_PICTURE = 50_000_000


class Recording(Protocol):
    """Protocol of a recording that is read forwards."""

    def read(self) -> Frame | None:
        """The next frame with the recording's own stamps and numbers; None at the end. Raises DriverError."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...


def open_recording(place: Place, options: VideoOptions, camera: str) -> Recording:
    """The recording from its frame ``start`` on. Raises DriverError."""
    if place.kind == "episode":
        return EpisodePictures(place, options, camera)
    if place.kind == "sequence":
        return NumberedPictures(place, options, camera)
    check_file(place, place.path)
    if sidecar_of(place.path).exists():
        return StampedVideo(place, options, camera)
    return PlainVideo(place, options, camera)


def check_file(place: Place, path: Path) -> None:
    """Check that a file can be read. Raises DriverError: ``missing``, ``permission``, ``not_a_file``, ``empty``."""
    try:
        found = path.stat()
        if stat.S_ISREG(found.st_mode):
            path.open("rb").close()
    except FileNotFoundError as error:
        raise place.error("missing", f"there is no file {path}") from error
    except OSError as error:
        code = "permission" if isinstance(error, PermissionError) else "not_a_file"
        raise place.error(code, f"{path} cannot be read ({error.strerror})") from error
    if not stat.S_ISREG(found.st_mode):
        raise place.error("not_a_file", f"{path} is a directory or a device, not a file")
    if found.st_size == 0:
        raise place.error("empty", f"{path} is empty")


class PlainVideo:
    """A video without a sidecar: frames are numbered from 0, stamps are on a grid of ``rate_hz`` from 0."""

    def __init__(self, place: Place, options: VideoOptions, camera: str) -> None:
        self._place = place
        self._options = options
        self._camera = camera
        self._next = options.start
        settings = [
            cv2.CAP_PROP_N_THREADS,
            1,
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            round(options.open_timeout_s * 1e3),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            round(options.read_timeout_s * 1e3),
        ]
        self._capture = cv2.VideoCapture(str(place.path), cv2.CAP_FFMPEG, settings)
        try:
            if not self._capture.isOpened():
                raise place.error(
                    "not_a_video", "holds no video that can be read: cut off, of another kind, or damaged"
                )
            size = [self._capture.get(p) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
            check_size(place, options, int(size[0]), int(size[1]))
            self._said = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
            if options.start and (
                0 < self._said <= options.start or not self._capture.set(cv2.CAP_PROP_POS_FRAMES, float(options.start))
            ):
                raise place.error("start", f"start = {options.start}; it has {self._said} frames")
        except DriverError:
            self._capture.release()
            raise

    def read(self) -> Frame | None:
        """The next frame. Raises DriverError (``truncated``: it states more frames; ``silent``: reading does not
        end).
        """
        begun_s = time.monotonic()
        if not self._capture.grab():
            if time.monotonic() - begun_s >= self._options.read_timeout_s:
                raise self._place.error(
                    "silent",
                    f"no frame {self._next} was found within {self._options.read_timeout_s:g} s (read_timeout_s): "
                    "damaged data, or a disk that does not answer",
                    frame=self._next,
                )
            # Containers without a count of frames state an estimate.
            if self._next + 1 + self._said // 50 < self._said:
                raise self._place.error(
                    "truncated",
                    f"ends after {self._next} frames and says that it has {self._said}: the file is cut off. Take "
                    "another copy, or use what comes before",
                    frame=self._next,
                )
            return None
        whole, image = self._capture.retrieve()
        if not whole:
            raise self._place.error("decode", f"frame {self._next} cannot be decoded", frame=self._next)
        t_ns = round(self._next / self._options.rate_hz * 1e9)
        frame = Frame(self._camera, self._next, t_ns - round(self._options.latency_s * 1e9), t_ns, image)
        self._next += 1
        return frame

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


class StampedVideo:
    """A recorded camera with its sidecar: recorded numbers and stamps, every frame checked by its CRC."""

    def __init__(self, place: Place, options: VideoOptions, camera: str) -> None:
        self._place = place
        try:
            self._reader = ImageReader(place.path, camera)
        except ImageFileError as error:
            raise _translated(place, error) from error
        try:
            header = self._reader.header
            check_size(place, options, header.width, header.height)
            for number in range(options.start):
                if self._reader.skip() is None:
                    raise place.error("start", f"start = {options.start}; it has {number} frames")
        except ImageFileError as error:
            self._reader.close()
            raise _translated(place, error) from error
        except DriverError:
            self._reader.close()
            raise

    def read(self) -> Frame | None:
        """The next frame. Raises DriverError (``crc``, ``sidecar``; ``truncated``: frames or lines are missing)."""
        try:
            frame = self._reader.read()
        except ImageFileError as error:
            raise _translated(self._place, error) from error
        if frame is None and self._reader.lost:
            raise self._place.error(
                "truncated",
                f"video and sidecar have {self._reader.frame} frames in common, {self._reader.lost} are in one of them "
                "only: a file is cut off. Take another copy, or use what comes before",
                frame=self._reader.frame,
                lost=self._reader.lost,
            )
        return frame

    def close(self) -> None:
        """Close the files."""
        self._reader.close()


class NumberedPictures:
    """Image files numbered without a gap; stamps as for :class:`PlainVideo`."""

    def __init__(self, place: Place, options: VideoOptions, camera: str) -> None:
        self._place = place
        self._options = options
        self._camera = camera
        numbers = sorted(_numbers(place))
        if not numbers:
            raise place.error("missing", f"there is no picture of this name in {place.path.parent}")
        if options.start and options.start not in numbers:
            raise place.error("start", f"start = {options.start}; there are the numbers {numbers[0]} to {numbers[-1]}")
        self._next = options.start or numbers[0]
        self._last = numbers[-1]
        gap = next((a + 1 for a, b in pairwise(numbers) if b != a + 1 and a >= self._next), None)
        if gap is not None:
            raise place.error(
                "sequence_gap",
                f"picture {place.path.name % gap} is missing, though later ones are there. Copy it, number them anew, "
                f"or start behind it",
                frame=gap,
            )

    def read(self) -> Frame | None:
        """The next image. Raises DriverError (``missing``, ``corrupt``, ``image_size``)."""
        number = self._next
        if number > self._last:
            return None
        path = self._place.path.with_name(self._place.path.name % number)
        image = self._decoded(path, number)
        check_size(self._place, self._options, image.shape[1], image.shape[0])
        self._next += 1
        t_ns = round(number / self._options.rate_hz * 1e9)
        return Frame(self._camera, number, t_ns - round(self._options.latency_s * 1e9), t_ns, image)

    def _decoded(self, path: Path, number: int) -> ImageArray:
        check_file(self._place, path)
        image: ImageArray | None = None
        size = path.stat().st_size
        if size > LARGEST_PICTURE:
            raise self._place.error(
                "frame_too_large", f"{path.name} has {size} bytes; at most {LARGEST_PICTURE} are read", frame=number
            )
        data = path.read_bytes()
        if not data.startswith((JPEG, PNG)) or picture_size(data) is not None:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), PICTURE_FLAG)
        if image is None or image.dtype not in (np.uint8, np.uint16):
            raise self._place.error(
                "corrupt", f"{path.name} is no whole picture: cut off, damaged, or of another kind", frame=number
            )
        return image

    def close(self) -> None:
        """No effect: no file is open between images."""


class EpisodePictures:
    """Pictures of one camera of an episode of a LeRobot data set; stamps are the data set's, from 0 on.

    ``period_ns``: time after which the episode restarts, if it does.
    """

    def __init__(self, place: Place, options: VideoOptions, camera: str) -> None:
        self._place = place
        self._options = options
        self._camera = camera
        assert options.episode is not None  # of such a place
        with refused(place.shown):
            self._episode = episode_of(place.path, options.episode)
            info = self._episode.info
            wanted = options.feature or camera
            (key,) = lerobot.camera_features(info, place.path, [wanted]).values()
            self._pictures = lerobot.pictures(place.path, info, key, self._episode.rows, gray=options.channel == "gray")
        if options.rate_hz != info.fps:
            raise place.error("rate", f"rate_hz = {options.rate_hz!r}; the data set has {info.fps!r} frames a second")
        self.period_ns = self._episode.period_ns

    def read(self) -> Frame | None:
        """The next frame. Raises DriverError."""
        return self.read_from(0)

    def read_from(self, t_ns: int) -> Frame | None:
        """The next frame from a time [ns] on; None if there is none. Raises DriverError."""
        with refused(self._place.shown):
            for row, decoded in self._pictures:
                received_ns = int(self._episode.stamps_ns[row])
                if received_ns < t_ns:
                    continue
                image = decoded()
                check_size(self._place, self._options, image.shape[1], image.shape[0])
                number = int(self._episode.rows.frame[row])
                shutter_ns = received_ns - round(self._options.latency_s * 1e9)
                return Frame(self._camera, number, shutter_ns, received_ns, image)
        return None

    def close(self) -> None:
        """Close the files."""
        self._pictures.close()


def _numbers(place: Place) -> Iterator[int]:
    head, tail = re.split(r"%(?:0\d+)?d", place.path.name)
    pattern = re.compile(re.escape(head) + r"(\d+)" + re.escape(tail))
    try:
        for entry in place.path.parent.iterdir():
            found = pattern.fullmatch(entry.name)
            if found and place.path.name % int(found[1]) == entry.name:
                yield int(found[1])
    except OSError as error:
        code = "missing" if isinstance(error, FileNotFoundError) else "permission"
        raise place.error(code, f"directory {place.path.parent} cannot be read ({error.strerror})") from error


def _translated(place: Place, error: ImageFileError) -> DriverError:
    code = {"size": "image_size", "video": "not_a_video"}.get(error.code, error.code)
    return DriverError(code, str(error), source=place.shown, frame=error.frame, **error.data)


# -- driver ------------------------------------------------------------------------------------------


LIVE_BUDGET_US = 1000.0
RECORDED_BUDGET_US = 50_000.0
"""Call budget: a poll of a recording decodes due frames in the caller's own thread."""


class Feed(Protocol):
    """Protocol of a source of frames: a :class:`Reader` or a :class:`Playback`, opened and closed once."""

    @property
    def settings(self) -> Settings:
        """Requested and reported settings of the source."""
        ...

    def open(self) -> None:
        """Open the source. Raises DriverError."""
        ...

    def begin(self) -> None:
        """Start delivery."""
        ...

    def take(self) -> Frame | None:
        """The newest frame, once. Raises DriverError."""
        ...

    def close(self) -> None:
        """Release everything. Idempotent; never raises."""
        ...


class VideoCameraDriver:
    """One camera. Options: :class:`~stereoservo_drivers.video.options.VideoOptions`.

    It does not reconnect by itself: a source that fails raises DriverError from :meth:`poll`, and the owner of the
    driver closes it and configures it again, which reopens the source (an old `cv2.VideoCapture` never recovers).
    Counts, frame numbers and the last picture, by which a frozen camera is detected, are kept. A recording that has
    ended or is damaged remains so: configured again, it raises the same error and does not restart.
    """

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self._options, self._place = decode_video_options(options, context.cell_dir)
        self._context = context
        self._check_arm()
        self._life = DriverLifecycle(f"camera driver {DRIVER!r} ({context.camera})")
        self._watch = StreamMonitor(self._options.rate_hz)
        limit_s = self._options.server_clock_s
        self._server_clock = None if limit_s is None else ServerClock(limit_s)
        self._feed: Feed | None = None
        self._over: DriverError | None = None
        self._openings = 0
        self._settings: Settings = {}

    def describe(self) -> CameraDescription:
        """Description by the options; works unconnected."""
        return CameraDescription(
            driver=DRIVER,
            name=self._context.camera,
            width=self._options.width,
            height=self._options.height,
            rate_hz=self._options.rate_hz,
            delivers="frames",
            call_budget_us=LIVE_BUDGET_US if self._place.live else RECORDED_BUDGET_US,
        )

    @classmethod
    def find_cameras(cls) -> tuple[FoundCamera, ...]:
        """V4L2 cameras of this computer."""
        pass  # only for `stereoservo setup`

        return found_cameras()

    @classmethod
    def probe_camera(cls, options: Mapping[str, Any]) -> tuple[int, int, float]:
        """Width, height [px] and rate [Hz] of a source's pictures. Raises DriverError."""
        pass

        return probed(options)

    def configure(self) -> None:
        """Open the source and receive a first image, within ``open_timeout_s``; also after :meth:`close`.

        Raises DriverError: the source's error, ``image_size``, ``open_timeout``, ``end_of_file``.
        """
        self._life.require("configure()", LifecycleState.CREATED, LifecycleState.CONFIGURED, LifecycleState.CLOSED)
        if self._life.state is LifecycleState.CONFIGURED:
            return
        if self._over is not None:
            raise _again(self._over)
        feed = self._new_feed()
        try:
            feed.open()
        except DriverError:
            feed.close()
            raise
        self._feed = feed
        self._openings += 1
        self._life.state = LifecycleState.CONFIGURED

    def _check_arm(self) -> None:
        """Raise DriverError if the cell's joints are played back from an episode without this camera."""
        arm, options, place = self._context.arm, self._options, self._place
        if place.kind != "episode" or "dataset" not in arm:
            return
        if (arm.get("dataset"), arm.get("episode")) != (options.source, options.episode):
            raise place.error(
                "option",
                f"the joints are of episode {arm.get('episode')} of {arm.get('dataset')}: cameras are to be, too",
            )
        if not options.loop or options.pace != "recorded":
            raise place.error(
                "option",
                'the joints play this episode again and again: loop = true and pace = "recorded" make cameras play it '
                "at the same times",
            )

    def _new_feed(self) -> Feed:
        place, options, context = self._place, self._options, self._context
        if not place.live:
            return Playback(place, options, context.camera, self._watch, context.clock)
        source = live_source(place, options, context.clock, self._server_clock)
        return Reader(source, place, options, context.camera, self._watch)

    def activate(self) -> None:
        """Start delivery. Raises DriverError."""
        self._life.require("activate()", LifecycleState.CONFIGURED, LifecycleState.ACTIVE)
        if self._life.state is LifecycleState.CONFIGURED and self._feed is not None:
            self._feed.begin()
        self._life.state = LifecycleState.ACTIVE

    def poll(self) -> list[Frame]:
        """The newest frame since the last poll, or none. Raises DriverError: the source failed or has ended."""
        self._life.require("poll()", LifecycleState.ACTIVE)
        assert self._feed is not None
        try:
            frame = self._feed.take()
        except DriverError as error:
            if not self._place.live:
                self._over = error
            raise
        return [] if frame is None else [frame]

    def deactivate(self) -> None:
        """Stop delivery; the source remains open. Idempotent."""
        if self._life.state is LifecycleState.ACTIVE:
            self._life.state = LifecycleState.CONFIGURED

    def close(self) -> None:
        """Release the source, within half a second. Idempotent; never raises."""
        if self._feed is not None:
            self._settings = self._feed.settings
            self._feed.close()
            self._feed = None
        self._life.state = LifecycleState.CLOSED

    def statistics(self) -> CameraStatistics:
        """Counts since the driver was first configured, including reconnections; any state."""
        watch = self._watch
        return CameraStatistics(
            frames=watch.frames,
            dropped=watch.dropped,
            frozen=watch.frozen,
            reconnects=max(0, self._openings - 1),
            settings=dict(self._feed.settings if self._feed is not None else self._settings),
            server_clock=None if self._server_clock is None else self._server_clock.estimate.told,
        )


def _again(error: DriverError) -> DriverError:
    return DriverError(error.code, str(error), retry=error.retry, **error.data)


# -- discovery -----------------------------------------------------------------------------------------------
# Discovery of cameras: V4L2 devices of this computer, their picture sizes and rates; pictures of a source.


CLASS = Path("/sys/class/video4linux")
BY_ID = Path("/dev/v4l/by-id")
DEVICES = Path("/dev")
LARGEST_PIXELS = 2_000_000
"""Larger pictures cost more time than they are worth, and are not proposed first."""
LEAST_RATE_HZ = 10.0
PROBED_PICTURES = 12
USUAL_RATES = (5.0, 7.5, 10.0, 15.0, 20.0, 24.0, 25.0, 30.0, 50.0, 60.0, 90.0, 100.0, 120.0)
NEAR = 0.12

Mode = tuple[int, int, float]


def found_cameras(
    directory: Path = CLASS,
    links: Path = BY_ID,
    devices: Path = DEVICES,
    asked: Callable[[Path], tuple[Mode, ...] | None] | None = None,
) -> tuple[FoundCamera, ...]:
    """V4L2 cameras, in the order of their numbers, by their persistent link if they have one.

    ``directory``: the kernel's; ``links``: udev's names of devices; ``asked``: a device's modes, None if it captures no
    pictures (cameras have such devices for their metadata).
    """
    asked = device_modes if asked is None else asked
    stable = {}
    if links.is_dir():
        stable = {os.path.realpath(link): link for link in sorted(links.iterdir(), reverse=True)}
    found = []
    for node in sorted(directory.glob("video*"), key=lambda path: (len(path.name), path.name)):
        device = devices / node.name
        listed = asked(device)
        if listed is None:
            continue
        try:
            name = (node / "name").read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            name = "camera"
        path = stable.get(os.path.realpath(device), device)
        found.append(FoundCamera(f"{name} ({device})", {"source": str(path)}, listed))
    return tuple(found)


def device_modes(device: Path) -> tuple[Mode, ...] | None:
    """Modes of a V4L2 device, best first; None if it cannot be opened or captures no pictures."""
    try:
        with opened(str(device)) as ioctl:
            return modes_told(ioctl)
    except OSError:
        return None


def modes_told(ioctl: Ioctl) -> tuple[Mode, ...] | None:
    """Modes that a device reports, best first; None if it captures no pictures. Raises OSError."""
    about = Capability()
    ioctl(QUERY_CAPABILITY, about)
    if not about.device_caps & CAPTURE:
        return None
    found = {(mode.width, mode.height, rate) for mode in modes(ioctl) for rate in mode.rates_hz}
    return tuple(sorted(found, key=_preference, reverse=True))


def _preference(mode: Mode) -> tuple[bool, int, float]:
    """Order of modes: fast enough and not too large; then the larger; then the faster."""
    width, height, rate = mode
    return rate >= LEAST_RATE_HZ and width * height <= LARGEST_PIXELS, width * height, rate


def probed(options: Mapping[str, Any]) -> Mode:
    """Size and rate of the pictures that a source delivers now. Raises DriverError."""
    decoded, place = decode_video_options({"width": 640, "height": 480, **options}, Path())
    if not place.live:
        raise place.error("option", "is a recording; `stereoservo setup` takes cameras")
    source = live_source(place, decoded, MonotonicClock())
    try:
        source.open()
        pictures = [picture for _ in range(PROBED_PICTURES) if (picture := source.read()) is not None]
    finally:
        source.release()
    if len(pictures) < 2:
        raise place.error("damaged", f"{PROBED_PICTURES} pictures, {len(pictures)} of them whole")
    height, width = pictures[-1].image.shape[:2]
    seconds = (pictures[-1].t_received_ns - pictures[0].t_received_ns) * 1e-9
    return int(width), int(height), usual_rate((len(pictures) - 1) / max(seconds, 1e-3))


def usual_rate(rate_hz: float) -> float:
    """The usual camera rate nearest to a measured one, or the measured one rounded down if none is near."""
    near = min(USUAL_RATES, key=lambda usual: abs(usual - rate_hz))
    return near if abs(near - rate_hz) <= NEAR * near else float(max(int(rate_hz), 1))


# -- the reader's thread -------------------------------------------------------------------------------------
# Live cameras: the source by the kind of its place, and the thread that waits for its images and stores the newest.


JOIN_S = 0.5
"""Time that :meth:`Reader.close` waits for its thread [s]. A thread that hangs in a library is abandoned; it is a
daemon, and anything it still receives is discarded.
"""


def live_source(
    place: Place, options: VideoOptions, clock: Clock, server_clock: ServerClock | None = None
) -> LiveSource:
    """A source for a ``place`` that delivers images by itself; not connected yet.

    ``server_clock``: clock estimate of an MJPEG stream's server; None: its stamps are not used.
    """
    if place.kind == "http":
        return MjpegSource(place, options, clock, server_clock)
    if place.kind == "genicam":
        return GenicamSource(place, options, clock)
    return CaptureSource(place, options, clock)


class Reader:
    """Reads ``source``, which must be unused, in a separate thread. Every wait of its callers is bounded."""

    def __init__(
        self, source: LiveSource, place: Place, options: VideoOptions, camera: str, watch: StreamMonitor
    ) -> None:
        self.abandoned = False
        self._source = source
        self._place = place
        self._options = options
        self._camera = camera
        self._watch = watch
        self._frozen_frames = frozen_frames(options, place)
        self._latency_ns = round(options.latency_s * 1e9)
        self._changed = threading.Condition()
        self._ending = False
        self._heard_s: float | None = None
        self._after_ns = 0
        self._newest: Frame | None = None
        self._error: DriverError | None = None
        self._thread = threading.Thread(target=self._run, name=f"video-{camera}", daemon=True)

    @property
    def settings(self) -> Settings:
        """Requested and reported settings of the source."""
        return dict(self._source.settings)

    def open(self) -> None:
        """Start, and wait for the first image. Raises DriverError: the source's, or ``open_timeout``."""
        self._watch.begin()
        self._thread.start()
        limit = self._options.open_timeout_s
        with self._changed:
            self._changed.wait_for(lambda: self._heard_s is not None or self._error is not None, limit)
            if self._error is not None and self._heard_s is None:
                raise self._error
            if self._heard_s is None:
                raise self._place.error(
                    "open_timeout", f"gave no picture within {limit:g} s (open_timeout_s)", retry=True
                )

    def begin(self) -> None:
        """Start delivery of images that arrive from now on."""
        with self._changed:
            self._newest = None

    def take(self) -> Frame | None:
        """The newest frame, once. Raises DriverError: the source's, ``frozen``, or ``silent``."""
        with self._changed:
            frame, self._newest = self._newest, None
            if frame is not None:
                return frame
            if self._error is not None:
                raise DriverError(
                    self._error.code, str(self._error), retry=self._error.retry, **self._error.data
                ) from self._error
            silent_s = time.monotonic() - (self._heard_s or 0.0)
        if silent_s > self._options.read_timeout_s:
            raise self._place.error(
                "silent", f"no picture for {silent_s:.2f} s (read_timeout_s)", retry=True, silent_s=silent_s
            )
        return None

    def close(self) -> None:
        """End the thread, or abandon it if it hangs. Idempotent; never raises."""
        with self._changed:
            self._ending = True
            self._newest = None
        self._source.interrupt()
        if self._thread.ident is not None:
            self._thread.join(JOIN_S)
            self.abandoned = self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._source.open()
            while not self._ending:
                picture = self._source.read()
                if picture is not None:
                    self._keep(picture)
        except DriverError as error:
            self._fail(error)
        except cv2.error as error:
            self._fail(self._place.error("decode", f"OpenCV: {error}", retry=True))
        except Exception as error:
            self._fail(self._place.error("reader", f"{type(error).__name__}: {error}", retry=True))
            raise
        finally:
            self._source.release()

    def _fail(self, error: DriverError) -> None:
        with self._changed:
            self._error = error
            self._changed.notify_all()

    def _keep(self, picture: SourcePicture) -> None:
        options = self._options
        check_size(self._place, options, picture.image.shape[1], picture.image.shape[0])
        image = one_channel(self._watch.eight_bits(picture.image), options.channel, options.flip)
        with self._changed:
            if self._ending:  # closed meanwhile; another reader may use the watch
                return
            fresh = self._watch.see(
                image, picture.t_received_ns, picture.seq, picture.skipped, look=self._frozen_frames > 0
            )
            if fresh:
                # Two pictures from one read have the same time; increasing stamps all the same.
                received_ns = max(picture.t_received_ns, self._after_ns)
                self._after_ns = received_ns + 1
                known_ns = picture.t_shutter_ns
                shutter_ns = received_ns - self._latency_ns if known_ns is None else known_ns
                self._newest = Frame(self._camera, self._watch.number, shutter_ns, received_ns, image)
            self._heard_s = time.monotonic()
            self._changed.notify_all()
            row = self._watch.row
        if 0 < self._frozen_frames <= row:
            raise self._place.error(
                "frozen",
                f"gave the same picture {row} times (frozen_frames = {self._frozen_frames}). Restart the camera; where "
                "it has no noise at all, frozen_frames = 0 looks for none",
                retry=True,
                pictures=row,
            )
