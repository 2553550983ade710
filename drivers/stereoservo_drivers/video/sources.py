"""Live sources: a video device or an RTSP stream (an MJPEG stream is in ``mjpeg.py``). Used by one thread each."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from typing import Protocol

import cv2

from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.devices import Clock
from stereoservo_drivers.video import v4l2
from stereoservo_drivers.video.options import Place, VideoOptions

OLDEST_NS = 1_000_000_000
"""A picture that is said to have come longer ago has a stamp that is not believed."""
Settings = dict[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class SourcePicture:
    """An image of a source: ``image`` ``(height, width[, 3])``, when it was received, the source's number of it,
    how many images received before it were skipped, and the time of its shutter, where the source knows it.
    """

    image: ImageArray
    t_received_ns: int
    seq: int | None = None
    skipped: int = 0
    t_shutter_ns: int | None = None


class LiveSource(Protocol):
    """Protocol of a source that delivers images by itself. ``settings``: requested and reported ones."""

    settings: Settings

    def open(self) -> None:
        """Connect. Blocks at most for the time-out of opening, as far as the libraries respect it. Raises
        DriverError.
        """
        ...

    def read(self) -> SourcePicture | None:
        """Wait for the next image; None: a damaged one was received. Raises DriverError."""
        ...

    def interrupt(self) -> None:
        """Wake a blocked :meth:`open` or :meth:`read`, where that is possible. From another thread; never raises."""
        ...

    def release(self) -> None:
        """Release all resources."""
        ...


class CaptureSource:
    """A device (V4L2) or an RTSP stream (FFmpeg), by `cv2.VideoCapture`. Not reused after a failure."""

    def __init__(self, place: Place, options: VideoOptions, clock: Clock) -> None:
        self.settings: Settings = {}
        self._place = place
        self._options = options
        self._clock = clock
        self._capture: cv2.VideoCapture | None = None

    def open(self) -> None:
        """Open and apply the settings. Raises DriverError."""
        device = self._place.kind == "device"
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # ours say more
        if device:
            self._check_device()
        self._capture = self._open_device() if device else self._open_stream()
        if not self._capture.isOpened():
            raise self._place.error(
                "not_opened",
                "opened no video: is it used by another program, or not a camera?"
                if device
                else f"gave no video within {self._options.open_timeout_s:g} s: look at its address, path and password",
                retry=True,
            )
        if device:
            self._set()

    def _open_device(self) -> cv2.VideoCapture:
        return cv2.VideoCapture(self._place.device, cv2.CAP_V4L2)

    def _open_stream(self) -> cv2.VideoCapture:
        times = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(self._options.open_timeout_s * 1e3),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(self._options.read_timeout_s * 1e3),
            cv2.CAP_PROP_N_THREADS, 1,  # of several, FFmpeg holds a picture back for each
        ]  # fmt: skip
        return cv2.VideoCapture(self._place.url.geturl(), cv2.CAP_FFMPEG, times)

    def _check_device(self) -> None:
        path = self._place.shown
        try:
            os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC))
        except OSError as error:
            code, remedy = {
                errno.ENOENT: ("missing", "no such device; `ls /dev/video*` shows those there are"),
                errno.EACCES: ("permission", "no right to use it; the user must be in the group 'video'"),
                errno.EBUSY: ("busy", "another program uses it"),
            }.get(error.errno or 0, ("not_opened", f"cannot be opened ({error.strerror})"))
            raise self._place.error(code, remedy, retry=True) from error

    def _set(self) -> None:
        options = self._options
        if options.pixel_format:
            code = cv2.VideoWriter.fourcc(*options.pixel_format)
            self._ask("pixel_format", cv2.CAP_PROP_FOURCC, float(code))
        self._ask("width", cv2.CAP_PROP_FRAME_WIDTH, float(options.width))
        self._ask("height", cv2.CAP_PROP_FRAME_HEIGHT, float(options.height))
        self._ask("rate_hz", cv2.CAP_PROP_FPS, options.rate_hz)
        try:
            with v4l2.opened(self._place.shown) as ioctl:
                self._check_size(ioctl)
                self.settings.update(apply_controls(ioctl, options))
        except ValueError as error:
            raise self._place.error("setting", str(error)) from error
        except OSError as error:
            raise self._place.error(
                "not_opened", f"takes no settings ({error.strerror})", retry=True
            ) from error

    def _check_size(self, ioctl: v4l2.Ioctl) -> None:
        """Raises DriverError, with the device's modes, where it takes another size than asked."""
        got = self.settings["width"][1], self.settings["height"][1]
        if None in got or got == (self._options.width, self._options.height):
            return
        known = "; ".join(map(str, v4l2.modes(ioctl))) or "it lists none"
        raise self._place.error(
            "image_size",
            f"has no {self._options.width}x{self._options.height} px with these options and takes "
            f"{got[0]:g}x{got[1]:g}. "
            f"Its modes: {known}. Set width, height and pixel_format to one of them",
            got=got,
            asked=(self._options.width, self._options.height),
        )

    def _ask(self, name: str, what: int, value: float) -> None:
        """Set a property and read it back. An unsupported or adjusted one is no error: the settings report it."""
        capture = self._capture
        assert capture is not None
        known = capture.set(what, value)
        self.settings[name] = value, capture.get(what) if known else None

    def read(self) -> SourcePicture | None:
        """The next image. Raises DriverError."""
        capture = self._capture
        assert capture is not None
        if not capture.grab():
            raise self._place.error(
                "connection_lost", "gives no more pictures: unplugged, ended, or silent too long", retry=True
            )
        t_ns = self._clock.now_ns()
        if (
            self._place.kind == "device"
        ):  # OpenCV passes on the kernel's time, of UVC cameras by the monotonic clock
            t_ns = received_ns(t_ns, t_ns - capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        whole, image = capture.retrieve()
        return SourcePicture(image, t_ns) if whole else None

    def interrupt(self) -> None:
        """No effect: `cv2.VideoCapture.grab` ends by its own time-out."""

    def release(self) -> None:
        """Release the device or the stream."""
        if self._capture is not None:
            self._capture.release()


def received_ns(now_ns: int, age_ns: float) -> int:
    """When a picture came [ns, monotonic] that is said to be ``age_ns`` old at ``now_ns``; now, where that is not
    believed: it is of another clock, or its age more than ``OLDEST_NS``.
    """
    return now_ns - round(age_ns) if 0.0 <= age_ns < OLDEST_NS else now_ns


def apply_controls(ioctl: v4l2.Ioctl, options: VideoOptions) -> Settings:
    """Set the controls that ``options`` state, what they lock before what they set, and return what was asked and what
    the device reads back, None where it has no such control. Raises ValueError for a value out of its range.
    """
    settings: Settings = {}

    def ask(name: str, value: float) -> int | None:
        got = v4l2.set_control(ioctl, name, round(value))
        settings[name] = float(value), None if got is None else float(got)
        return got

    if options.exposure == "auto":
        if ask("auto_exposure", v4l2.EXPOSURE_APERTURE_PRIORITY) is None:
            ask("auto_exposure", v4l2.EXPOSURE_AUTO)
    elif options.exposure is not None:
        ask("auto_exposure", v4l2.EXPOSURE_MANUAL)
        ask("exposure", options.exposure)
    for automatic, name, value in (
        ("autofocus", "focus", options.focus),
        ("auto_white_balance", "white_balance", options.white_balance),
    ):
        if value is not None:
            ask(automatic, value == "auto")
            if value != "auto":
                ask(name, value)
    if options.gain is not None:
        ask("gain", options.gain)
    if options.power_line_hz is not None:
        ask("power_line", v4l2.POWER_LINE[options.power_line_hz])
    if options.rate_priority is not None:
        ask("exposure_changes_rate", not options.rate_priority)
    return settings
