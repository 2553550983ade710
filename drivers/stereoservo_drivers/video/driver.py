"""Camera driver ``video``: images of a real camera, or of a recording, as stamped frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from stereoservo.ports.devices import (
    CameraDescription,
    CameraStatistics,
    DriverContext,
    DriverError,
    Frame,
)
from stereoservo.ports.discovery import FoundCamera
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState
from stereoservo_drivers.video.options import DRIVER, decode_video_options
from stereoservo_drivers.video.playback import Playback
from stereoservo_drivers.video.reader import Reader, live_source
from stereoservo_drivers.video.server_clock import ServerClock
from stereoservo_drivers.video.sources import Settings
from stereoservo_drivers.video.stream_monitor import Watch

LIVE_BUDGET_US = 1000.0
RECORDED_BUDGET_US = 50_000.0
"""A poll of a recording decodes what is due in the caller's own thread."""


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

    It does not reconnect by itself: a source that fails raises DriverError from :meth:`poll`, and who holds the driver
    closes it and configures it again, which reopens the source (an old `cv2.VideoCapture` never recovers). Counts,
    numbers of frames and the last picture, by which a frozen camera is known, go on over that. A recording that is over
    or damaged stays so: configured again, it raises the same error and does not restart.
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
        from stereoservo_drivers.video.discovery import found_cameras  # for `stereoservo setup` alone

        return found_cameras()

    @classmethod
    def probe_camera(cls, options: Mapping[str, Any]) -> tuple[int, int, float]:
        """Width, height [px] and rate [Hz] of a source's pictures. Raises DriverError."""
        from stereoservo_drivers.video.discovery import probed

        return probed(options)

    def configure(self) -> None:
        """Open the source and receive a first image, within ``open_timeout_s``; also after :meth:`close`.

        Raises DriverError: what is wrong with the source, ``image_size``, ``open_timeout``, ``end_of_file``.
        """
        self._life.require(
            "configure()", LifecycleState.CREATED, LifecycleState.CONFIGURED, LifecycleState.CLOSED
        )
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
        """Raises DriverError where the cell's joints are played back from an episode that this camera is not with."""
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
        """Stop delivery; the source stays open. Idempotent."""
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
        """Counts since the driver was first configured, over reconnections; any state."""
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
