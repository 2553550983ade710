"""Live sources: a video device, an RTSP stream or a GenICam camera (an MJPEG stream is in ``mjpeg.py``). Used by one
thread each.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from ctypes import (
    POINTER,
    byref,
    c_char_p,
    c_double,
    c_int,
    c_int32,
    c_size_t,
    c_uint,
    c_uint8,
    c_uint32,
    c_uint64,
    c_void_p,
)
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol
from urllib.parse import unquote

import cv2
import numpy as np

from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.devices import Clock
from stereoservo_drivers.video.options import Place, VideoOptions

OLDEST_NS = 1_000_000_000
"""Largest age [ns] of a picture's stamp that is believed."""
Settings = dict[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class SourcePicture:
    """An image of a source: ``image`` ``(height, width[, 3])``, the time of its reception, the source's number of it,
    the number of images skipped before it, and the time of its shutter, if the source reports it.
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
        """Connect. Blocks at most for the time-out of opening, if the libraries respect it. Raises DriverError."""
        ...

    def read(self) -> SourcePicture | None:
        """Wait for the next image; None: a damaged one was received. Raises DriverError."""
        ...

    def interrupt(self) -> None:
        """Wake a blocked :meth:`open` or :meth:`read`, if that is possible. From another thread; never raises."""
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
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # ours are more specific
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
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            round(self._options.open_timeout_s * 1e3),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            round(self._options.read_timeout_s * 1e3),
            cv2.CAP_PROP_N_THREADS,
            1,  # with several threads, FFmpeg delays a picture for each
        ]
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
            with opened(self._place.shown) as ioctl:
                self._check_size(ioctl)
                self.settings.update(apply_controls(ioctl, options))
        except ValueError as error:
            raise self._place.error("setting", str(error)) from error
        except OSError as error:
            raise self._place.error("not_opened", f"takes no settings ({error.strerror})", retry=True) from error

    def _check_size(self, ioctl: Ioctl) -> None:
        """Raise DriverError, with the device's modes, if its size differs from the requested one."""
        got = self.settings["width"][1], self.settings["height"][1]
        if None in got or got == (self._options.width, self._options.height):
            return
        known = "; ".join(map(str, modes(ioctl))) or "it lists none"
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
        if self._place.kind == "device":  # OpenCV passes on the kernel's time, for UVC cameras by the monotonic clock
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
    """Reception time [ns, monotonic] of a picture with a reported age of ``age_ns`` at ``now_ns``; now, if that is not
    credible: it belongs to another clock, or its age exceeds ``OLDEST_NS``.
    """
    return now_ns - round(age_ns) if 0.0 <= age_ns < OLDEST_NS else now_ns


def apply_controls(ioctl: Ioctl, options: VideoOptions) -> Settings:
    """Set the controls in ``options``, locking ones first, and return the requested values and those that the device
    reads back, None if it has no such control. Raises ValueError for a value out of its range.
    """
    settings: Settings = {}

    def ask(name: str, value: float) -> int | None:
        got = set_control(ioctl, name, round(value))
        settings[name] = float(value), None if got is None else float(got)
        return got

    if options.exposure == "auto":
        if ask("auto_exposure", EXPOSURE_APERTURE_PRIORITY) is None:
            ask("auto_exposure", EXPOSURE_AUTO)
    elif options.exposure is not None:
        ask("auto_exposure", EXPOSURE_MANUAL)
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
        ask("power_line", POWER_LINE[options.power_line_hz])
    if options.rate_priority is not None:
        ask("exposure_changes_rate", not options.rate_priority)
    return settings


# -- Video4Linux ---------------------------------------------------------------------------------------------
# Controls and modes of a Video4Linux2 device, by its ioctls (Linux' videodev2.h and v4l2-controls.h).


_BASE, _CAMERA = 0x00980900, 0x009A0900
CONTROLS = {
    "auto_exposure": _CAMERA + 1,
    "exposure": _CAMERA + 2,
    "exposure_changes_rate": _CAMERA + 3,
    "autofocus": _CAMERA + 12,
    "focus": _CAMERA + 10,
    "auto_white_balance": _BASE + 12,
    "white_balance": _BASE + 26,
    "gain": _BASE + 19,
    "power_line": _BASE + 24,
}
"""Ids of the kernel's controls, by the names used here."""
EXPOSURE_AUTO, EXPOSURE_MANUAL, EXPOSURE_APERTURE_PRIORITY = 0, 1, 3
POWER_LINE = {0: 0, 50: 1, 60: 2}
"""Values of the control ``power_line``, by hertz; 0: no filter."""
DISABLED = 0x0001
CAPTURE = 1
"""``V4L2_BUF_TYPE_VIDEO_CAPTURE``, and ``V4L2_CAP_VIDEO_CAPTURE``."""
DISCRETE = 1
MOST_ENTRIES = 256
"""Largest number of entries read from a list, in case a driver never ends it."""


class Capability(ctypes.Structure):
    """``struct v4l2_capability``."""

    _fields_ = [("names", c_uint8 * 84), ("capabilities", c_uint32), ("device_caps", c_uint32), ("rest", c_uint32 * 3)]


class QueryControl(ctypes.Structure):
    """``struct v4l2_queryctrl``."""

    _fields_ = [
        ("id", c_uint32), ("type", c_uint32), ("name", c_uint8 * 32), ("minimum", c_int32), ("maximum", c_int32),
        ("step", c_int32), ("default_value", c_int32), ("flags", c_uint32), ("reserved", c_uint32 * 2),
    ]  # fmt: skip


class Control(ctypes.Structure):
    """``struct v4l2_control``."""

    _fields_ = [("id", c_uint32), ("value", c_int32)]


class FormatDescription(ctypes.Structure):
    """``struct v4l2_fmtdesc``."""

    _fields_ = [
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_uint8 * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    ]


class FrameSize(ctypes.Structure):
    """``struct v4l2_frmsizeenum``; ``sizes``: width and height, or least, most and step of each."""

    _fields_ = [
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("sizes", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    ]


class FrameInterval(ctypes.Structure):
    """``struct v4l2_frmivalenum``; ``intervals``: numerator and denominator [s], or those of least, most and step."""

    _fields_ = [
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("intervals", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    ]


def _read_write(number: int, structure: type[ctypes.Structure]) -> int:
    """``_IOWR('V', number, structure)`` of asm-generic/ioctl.h."""
    return 3 << 30 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


QUERY_CAPABILITY = 2 << 30 | ctypes.sizeof(Capability) << 16 | ord("V") << 8
ENUM_FORMAT = _read_write(2, FormatDescription)
GET_CONTROL = _read_write(27, Control)
SET_CONTROL = _read_write(28, Control)
QUERY_CONTROL = _read_write(36, QueryControl)
ENUM_SIZES = _read_write(74, FrameSize)
ENUM_INTERVALS = _read_write(75, FrameInterval)

Ioctl = Callable[[int, ctypes.Structure], None]
"""Performs a request on an open device; the structure is filled in. Raises OSError."""


class ControlRange(NamedTuple):
    """Valid values of a control: ``least`` to ``most`` in steps of ``step``."""

    least: int
    most: int
    step: int


class Mode(NamedTuple):
    """A mode of a device: pixel format (four letters), width and height [px], rates [Hz], highest first."""

    pixel_format: str
    width: int
    height: int
    rates_hz: tuple[float, ...]

    def __str__(self) -> str:
        rates = ", ".join(f"{rate:g}" for rate in self.rates_hz)
        return f"{self.pixel_format} {self.width}x{self.height}" + (f" at {rates} Hz" if rates else "")


@contextmanager
def opened(path: str) -> Iterator[Ioctl]:
    """Requests to the device at ``path``, concurrently with any process that streams from it. Raises OSError."""
    descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        yield lambda request, structure: _request(descriptor, request, structure)
    finally:
        os.close(descriptor)


def _request(descriptor: int, request: int, structure: ctypes.Structure) -> None:
    fcntl.ioctl(descriptor, request, structure)  # type: ignore[call-overload]


def control_range(ioctl: Ioctl, name: str) -> ControlRange | None:
    """Valid values of the control ``name``; None: the device does not have it."""
    query = QueryControl(id=CONTROLS[name])
    try:
        ioctl(QUERY_CONTROL, query)
    except OSError:
        return None
    return None if query.flags & DISABLED else ControlRange(query.minimum, query.maximum, query.step)


def set_control(ioctl: Ioctl, name: str, value: int) -> int | None:
    """Set the control ``name`` and return the value that the device then reports; None: it has none, or refused.

    Raises ValueError, with the range, for a value outside of it.
    """
    valid = control_range(ioctl, name)
    if valid is None:
        return None
    if not valid.least <= value <= valid.most:
        raise ValueError(f"{name} = {value}; this device takes {valid.least} to {valid.most} in steps of {valid.step}")
    control = Control(id=CONTROLS[name], value=value)
    try:
        ioctl(SET_CONTROL, control)
        ioctl(GET_CONTROL, control)
    except OSError:
        return None
    return int(control.value)


def modes(ioctl: Ioctl) -> list[Mode]:
    """Modes that the device reports, for sizes of its own choice; of others the largest."""
    found = []
    for index in range(MOST_ENTRIES):
        description = FormatDescription(index=index, type=CAPTURE)
        if not _entry(ioctl, ENUM_FORMAT, description):
            break
        code = int(description.pixelformat)
        for width, height in _sizes(ioctl, code):
            letters = code.to_bytes(4, "little").decode("latin-1").strip()
            found.append(Mode(letters, width, height, _rates(ioctl, code, width, height)))
    return found


def _sizes(ioctl: Ioctl, code: int) -> Iterator[tuple[int, int]]:
    for index in range(MOST_ENTRIES):
        size = FrameSize(index=index, pixel_format=code)
        if not _entry(ioctl, ENUM_SIZES, size):
            return
        if size.type != DISCRETE:
            yield size.sizes[1], size.sizes[4]
            return
        yield size.sizes[0], size.sizes[1]


def _rates(ioctl: Ioctl, code: int, width: int, height: int) -> tuple[float, ...]:
    rates = []
    for index in range(MOST_ENTRIES):
        interval = FrameInterval(index=index, pixel_format=code, width=width, height=height)
        if not _entry(ioctl, ENUM_INTERVALS, interval):
            break
        seconds, parts = interval.intervals[0], interval.intervals[1]  # of a range: the shortest
        if seconds:
            rates.append(parts / seconds)
        if interval.type != DISCRETE:
            break
    return tuple(sorted(set(rates), reverse=True))


def _entry(ioctl: Ioctl, request: int, structure: ctypes.Structure) -> bool:
    """Whether the list has this entry. Raises OSError for anything but its end, or a missing list."""
    try:
        ioctl(request, structure)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOTTY):
            return False
        raise
    return True


# -- GenICam -------------------------------------------------------------------------------------------------
# Cameras of GigE Vision and USB3 Vision (GenICam), by the aravis library's C interface (version 0.8).


LIBRARY = "libaravis-0.8.so.0"
BUFFERS = 8
WAIT_US = 100_000
"""Interval of checks whether a wait for a picture was interrupted."""
FRAME_NUMBERS = 65535
"""GigE Vision 1 counts pictures from 1 to 65535 and restarts."""
AUTO_OFF, AUTO_CONTINUOUS = 0, 2
DAMAGED_IN_A_ROW = 10
SUCCESS = 0
"""``ArvBufferStatus`` of a complete picture."""


class GError(ctypes.Structure):
    """``struct _GError``."""

    _fields_ = [("domain", c_uint), ("code", c_int), ("message", c_char_p)]


_ERROR = POINTER(POINTER(GError))
_FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_camera_new": (c_void_p, (c_char_p, _ERROR)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int, _ERROR)),
    "arv_camera_get_region": (None, (c_void_p, *[POINTER(c_int)] * 4, _ERROR)),
    "arv_camera_set_pixel_format_from_string": (None, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_set_frame_rate": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_frame_rate": (c_double, (c_void_p, _ERROR)),
    **{
        f"arv_camera_is_{feature}_available": (c_int, (c_void_p, _ERROR))
        for feature in ("frame_rate", "exposure_auto", "exposure_time", "gain")
    },
    "arv_camera_set_exposure_time_auto": (None, (c_void_p, c_int, _ERROR)),
    "arv_camera_get_exposure_time_auto": (c_int, (c_void_p, _ERROR)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p, _ERROR)),
    "arv_camera_set_gain": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_gain": (c_double, (c_void_p, _ERROR)),
    "arv_camera_set_acquisition_mode": (None, (c_void_p, c_int, _ERROR)),
    "arv_camera_get_payload": (c_uint, (c_void_p, _ERROR)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p, _ERROR)),
    "arv_camera_start_acquisition": (None, (c_void_p, _ERROR)),
    "arv_camera_stop_acquisition": (None, (c_void_p, _ERROR)),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_system_timestamp": (c_uint64, (c_void_p,)),
    "g_object_unref": (None, (c_void_p,)),
    "g_error_free": (None, (POINTER(GError),)),
}
"""Called functions: return types and arguments."""


class AravisError(Exception):
    """An error reported by the library."""


def load_aravis(name: str = LIBRARY) -> Callable[..., Any]:
    """A function that calls the library's functions by name. Raises OSError if it is not installed.

    If a function's last argument is a ``GError``, it is added, and raised as AravisError.
    """
    library = ctypes.CDLL(name)
    for function, (returned, taken) in _FUNCTIONS.items():
        found = getattr(library, function)
        found.restype, found.argtypes = returned, taken

    def call(function: str, *values: Any) -> Any:
        found = getattr(library, function)
        if _FUNCTIONS[function][1][-1] is not _ERROR:
            return found(*values)
        error = POINTER(GError)()
        result = found(*values, byref(error))
        if error:
            message = (error.contents.message or b"").decode("utf-8", "replace")
            library.g_error_free(error)
            raise AravisError(message)
        return result

    return call


class GenicamSource:
    """One camera (:class:`~stereoservo_drivers.video.sources.LiveSource`), its pictures as 8-bit gray (``Mono8``)."""

    def __init__(self, place: Place, options: VideoOptions, clock: Clock) -> None:
        self.settings: Settings = {}
        self._place = place
        self._options = options
        self._clock = clock
        self._camera: int | None = None
        self._stream: int | None = None
        self._interrupted = False
        self._damaged = 0
        self._numbers = FrameNumbers()

    def open(self) -> None:
        """Connect, set and start the camera. Raises DriverError."""
        try:
            self._call = load_aravis()
        except OSError as error:
            raise self._place.error(
                "missing", f"needs the library aravis 0.8 (apt install libaravis-0.8-0): {error}"
            ) from error
        name = unquote(self._place.url.netloc)
        try:
            self._camera = self._call("arv_camera_new", name.encode())
        except AravisError as error:
            raise self._place.error(
                "not_opened", f"no such camera answers ({error}); `arv-tool-0.8` lists those there are", retry=True
            ) from error
        if self._held_by_another():
            raise self._place.error("busy", "another program controls this camera: end it first", retry=True)
        try:
            self._set()
            self._start()
        except AravisError as error:
            raise self._place.error("setting", f"refuses a setting: {error}", retry=True) from error

    def _held_by_another(self) -> bool:
        call, camera = self._call, self._camera
        if not call("arv_camera_is_gv_device", camera):
            return False
        return not call("arv_gv_device_is_controller", call("arv_camera_get_device", camera))

    def _set(self) -> None:
        options, camera, call = self._options, self._camera, self._call
        call("arv_camera_set_pixel_format_from_string", camera, b"Mono8")
        call("arv_camera_set_region", camera, 0, 0, options.width, options.height)
        place = [c_int() for _ in range(4)]
        call("arv_camera_get_region", camera, *(byref(value) for value in place))
        self.settings["width"] = float(options.width), float(place[2].value)
        self.settings["height"] = float(options.height), float(place[3].value)
        if options.exposure == "auto":
            self._ask("exposure_auto", "exposure_time_auto", "auto_exposure", AUTO_CONTINUOUS)
        elif options.exposure is not None:
            self._ask("exposure_auto", "exposure_time_auto", "auto_exposure", AUTO_OFF)
            self._ask("exposure_time", "exposure_time", "exposure", options.exposure)
        if options.gain is not None:
            self._ask("gain", "gain", "gain", options.gain)
        self._ask("frame_rate", "frame_rate", "rate_hz", options.rate_hz)

    def _ask(self, available: str, feature: str, option: str, value: float) -> None:
        """Set a feature and read it back. A missing one is not an error: the settings report it."""
        self.settings[option] = float(value), None
        if self._call(f"arv_camera_is_{available}_available", self._camera):
            self._call(f"arv_camera_set_{feature}", self._camera, value)
            self.settings[option] = float(value), float(self._call(f"arv_camera_get_{feature}", self._camera))

    def _start(self) -> None:
        camera, call = self._camera, self._call
        call("arv_camera_set_acquisition_mode", camera, 0)  # continuous
        self._stream = call("arv_camera_create_stream", camera, None, None)
        size = call("arv_camera_get_payload", camera)
        for _ in range(BUFFERS):
            call("arv_stream_push_buffer", self._stream, call("arv_buffer_new_allocate", size))
        call("arv_camera_start_acquisition", camera)

    def read(self) -> SourcePicture | None:
        """The next picture; None: it was damaged. Raises DriverError."""
        call = self._call
        end_s = time.monotonic() + self._options.read_timeout_s
        while True:
            buffer = call("arv_stream_timeout_pop_buffer", self._stream, WAIT_US)
            if buffer is not None:
                break
            if self._interrupted or time.monotonic() > end_s:
                raise self._place.error(
                    "connection_lost",
                    f"gave no picture for {self._options.read_timeout_s:g} s (read_timeout_s): unplugged, without "
                    "power, or its packets are dropped by a firewall",
                    retry=True,
                )
        try:
            picture = self._picture(buffer)
        finally:
            call("arv_stream_push_buffer", self._stream, buffer)
        self._damaged = self._damaged + 1 if picture is None else 0
        if self._damaged >= DAMAGED_IN_A_ROW:
            raise self._place.error(
                "corrupt",
                f"{self._damaged} pictures in a row came in part: packets are lost. Give the camera a network "
                "port of its own with jumbo frames (MTU 9000), or lower rate_hz",
                retry=True,
            )
        return picture

    def _picture(self, buffer: int) -> SourcePicture | None:
        call = self._call
        now_ns, wall_ns = self._clock.now_ns(), time.time_ns()
        if call("arv_buffer_get_status", buffer) != SUCCESS:
            return None
        width = call("arv_buffer_get_image_width", buffer)
        height = call("arv_buffer_get_image_height", buffer)
        size = c_size_t()
        data = call("arv_buffer_get_data", buffer, byref(size))
        if data is None or width <= 0 or height <= 0 or size.value < width * height:
            return None
        pixels = np.ctypeslib.as_array(ctypes.cast(data, POINTER(ctypes.c_uint8)), (height, width))
        t_ns = received_ns(now_ns, wall_ns - call("arv_buffer_get_system_timestamp", buffer))
        number = self._numbers.whole(call("arv_buffer_get_frame_id", buffer))
        return SourcePicture(pixels.copy(), t_ns, number)

    def interrupt(self) -> None:
        """Wake :meth:`read`, within a tenth of a second."""
        self._interrupted = True

    def release(self) -> None:
        """Stop the camera and release it."""
        if self._stream is not None:
            with suppress(AravisError):  # a lost camera needs no stop
                self._call("arv_camera_stop_acquisition", self._camera)
            self._call("g_object_unref", self._stream)
            self._stream = None
        if self._camera is not None:
            self._call("g_object_unref", self._camera)
            self._camera = None


class FrameNumbers:
    """Continuous picture numbers from a camera's counter of 16 bits."""

    def __init__(self) -> None:
        self._last = 0
        self._rounds = 0

    def whole(self, number: int) -> int:
        """The continuous number of a picture with the camera's ``number``."""
        if number < self._last and self._last - number > FRAME_NUMBERS // 2 and self._last <= FRAME_NUMBERS:
            self._rounds += 1
        self._last = number
        return self._rounds * FRAME_NUMBERS + number
