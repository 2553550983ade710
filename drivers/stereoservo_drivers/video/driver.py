"""Camera driver ``video``: images of a real camera, or of a recording, as stamped frames."""

from __future__ import annotations

import fcntl
import os
import struct
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import cv2

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import CameraDescription, CameraStatistics, Clock, DriverContext, DriverError, Frame
from stereoservo.ports.discovery import FoundCamera
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState
from stereoservo_drivers.video.mjpeg import MjpegSource
from stereoservo_drivers.video.options import DRIVER, Place, VideoOptions, decode_video_options, frozen_frames
from stereoservo_drivers.video.pictures import check_size, one_channel
from stereoservo_drivers.video.playback import Playback
from stereoservo_drivers.video.server_clock import ServerClock
from stereoservo_drivers.video.sources import CaptureSource, GenicamSource, LiveSource, Settings, SourcePicture
from stereoservo_drivers.video.stream_monitor import Watch

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
        self._watch = Watch(self._options.rate_hz)
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
QUERYCAP, ENUM_FMT = 0x80685600, 0xC0405602
ENUM_FRAMESIZES, ENUM_FRAMEINTERVALS = 0xC02C564A, 0xC034564B
"""Requests of Linux' videodev2.h; the size of the structure is part of them."""
CAPTURE = 1
"""``V4L2_BUF_TYPE_VIDEO_CAPTURE``, and ``V4L2_CAP_VIDEO_CAPTURE``."""
DISCRETE = 1
LARGEST_PIXELS = 2_000_000
"""Larger pictures cost more time than they are worth, and are not proposed first."""
LEAST_RATE_HZ = 10.0
PROBED_PICTURES = 12
USUAL_RATES = (5.0, 7.5, 10.0, 15.0, 20.0, 24.0, 25.0, 30.0, 50.0, 60.0, 90.0, 100.0, 120.0)
NEAR = 0.12

Ioctl = Callable[[int, bytearray], None]
"""Fills a structure by a request; raises OSError at the end of the list."""
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
        modes = asked(device)
        if modes is None:
            continue
        try:
            name = (node / "name").read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            name = "camera"
        path = stable.get(os.path.realpath(device), device)
        found.append(FoundCamera(f"{name} ({device})", {"source": str(path)}, modes))
    return tuple(found)


def device_modes(device: Path) -> tuple[Mode, ...] | None:
    """Modes of a V4L2 device, best first; None if it cannot be opened or captures no pictures."""
    try:
        descriptor = os.open(device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        return modes_told(lambda request, data: fcntl.ioctl(descriptor, request, data, True) and None)
    finally:
        os.close(descriptor)


def modes_told(ioctl: Ioctl) -> tuple[Mode, ...] | None:
    """Modes that a device reports by V4L2's requests, best first; None if it captures no pictures."""
    about = bytearray(104)
    try:
        ioctl(QUERYCAP, about)
    except OSError:
        return None
    if not struct.unpack_from("I", about, 88)[0] & CAPTURE:
        return None
    modes = set()
    for form in _listed(ioctl, ENUM_FMT, 64, lambda k, data: struct.pack_into("II", data, 0, k, CAPTURE)):
        pixel_format = struct.unpack_from("I", form, 44)[0]

        def sizes(k: int, data: bytearray, code: int = pixel_format) -> None:
            struct.pack_into("II", data, 0, k, code)

        for size in _listed(ioctl, ENUM_FRAMESIZES, 44, sizes):
            kind, width, height = struct.unpack_from("III", size, 8)
            if kind != DISCRETE:
                continue

            def intervals(k: int, data: bytearray, code: int = pixel_format, w: int = width, h: int = height) -> None:
                struct.pack_into("IIII", data, 0, k, code, w, h)

            for interval in _listed(ioctl, ENUM_FRAMEINTERVALS, 52, intervals):
                kind, numerator, denominator = struct.unpack_from("III", interval, 16)
                if kind == DISCRETE and numerator:
                    modes.add((width, height, denominator / numerator))
    return tuple(sorted(modes, key=_preference, reverse=True))


def _listed(ioctl: Ioctl, request: int, size: int, ask: Callable[[int, bytearray], None]) -> list[bytearray]:
    """Entries of one of V4L2's lists, up to its end."""
    entries: list[bytearray] = []
    while len(entries) < 256:
        data = bytearray(size)
        ask(len(entries), data)
        try:
            ioctl(request, data)
        except OSError:
            break
        entries.append(data)
    return entries


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

    def __init__(self, source: LiveSource, place: Place, options: VideoOptions, camera: str, watch: Watch) -> None:
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
        image = one_channel(picture.image, options.channel, options.flip)
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
