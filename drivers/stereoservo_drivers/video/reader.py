"""Live cameras: the source by the kind of its place, and the thread that waits for its images and keeps the newest."""

from __future__ import annotations

import threading
import time

import cv2

from stereoservo.ports.devices import Clock, DriverError, Frame
from stereoservo_drivers.video.genicam import GenicamSource
from stereoservo_drivers.video.mjpeg import MjpegSource
from stereoservo_drivers.video.options import Place, VideoOptions, frozen_frames
from stereoservo_drivers.video.pictures import check_size, one_channel
from stereoservo_drivers.video.server_clock import ServerClock
from stereoservo_drivers.video.sources import CaptureSource, LiveSource, Settings, SourcePicture
from stereoservo_drivers.video.stream_monitor import Watch

JOIN_S = 0.5
"""How long :meth:`Reader.close` waits for its thread. One that hangs in a library is left to end by itself; it is a
daemon, and nothing that it still receives gets out.
"""


def live_source(
    place: Place, options: VideoOptions, clock: Clock, server_clock: ServerClock | None = None
) -> LiveSource:
    """A source for a ``place`` that delivers images by itself; not connected yet.

    ``server_clock``: what is known of the clock of an MJPEG stream's server; None: its stamps are not used.
    """
    if place.kind == "http":
        return MjpegSource(place, options, clock, server_clock)
    if place.kind == "genicam":
        return GenicamSource(place, options, clock)
    return CaptureSource(place, options, clock)


class Reader:
    """Reads ``source``, which must be unused, in a thread of its own. Every wait of its callers is bounded."""

    def __init__(
        self, source: LiveSource, place: Place, options: VideoOptions, camera: str, watch: Watch
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
        """End the thread, or abandon it where it hangs. Idempotent; never raises."""
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
                # Two pictures that came with one read have one time; in order all the same.
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
