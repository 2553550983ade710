"""Cameras of GigE Vision and USB3 Vision (GenICam), by the aravis library's C interface (version 0.8)."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from contextlib import suppress
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint64, c_void_p
from typing import Any
from urllib.parse import unquote

import numpy as np

from stereoservo.ports.devices import Clock
from stereoservo_drivers.video.options import Place, VideoOptions
from stereoservo_drivers.video.sources import Settings, SourcePicture, received_ns

LIBRARY = "libaravis-0.8.so.0"
BUFFERS = 8
WAIT_US = 100_000
"""A wait for a picture ends so often, to see whether it was interrupted."""
FRAME_NUMBERS = 65535
"""GigE Vision 1 counts pictures 1 to 65535 and begins again."""
AUTO_OFF, AUTO_CONTINUOUS = 0, 2
DAMAGED_IN_A_ROW = 10
SUCCESS = 0
"""``ArvBufferStatus`` of a picture that is whole."""


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
"""Functions that are called: what they return and take."""


class AravisError(Exception):
    """What the library says is wrong."""


def load_aravis(name: str = LIBRARY) -> Callable[..., Any]:
    """A function that calls the library's functions by name. Raises OSError where it is not installed.

    Where a function's last argument is a ``GError``, it is added, and raised as AravisError.
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
                "not_opened",
                f"no such camera answers ({error}); `arv-tool-0.8` lists those there are",
                retry=True,
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
        """Set a feature and read it back. One that the camera has not is no error: the settings report it."""
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
            with suppress(AravisError):  # one that is gone needs no stop
                self._call("arv_camera_stop_acquisition", self._camera)
            self._call("g_object_unref", self._stream)
            self._stream = None
        if self._camera is not None:
            self._call("g_object_unref", self._camera)
            self._camera = None


class FrameNumbers:
    """Numbers of pictures that go on where a camera's counter of 16 bits begins again."""

    def __init__(self) -> None:
        self._last = 0
        self._rounds = 0

    def whole(self, number: int) -> int:
        """The number of a picture that the camera numbers ``number``."""
        if number < self._last and self._last - number > FRAME_NUMBERS // 2 and self._last <= FRAME_NUMBERS:
            self._rounds += 1
        self._last = number
        return self._rounds * FRAME_NUMBERS + number
