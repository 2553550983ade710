"""Controls and modes of a Video4Linux2 device, by its ioctls (Linux' videodev2.h and v4l2-controls.h)."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import c_int32, c_uint8, c_uint32
from typing import NamedTuple

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
"""Ids of the kernel's controls, by our names."""
EXPOSURE_AUTO, EXPOSURE_MANUAL, EXPOSURE_APERTURE_PRIORITY = 0, 1, 3
POWER_LINE = {0: 0, 50: 1, 60: 2}
"""Values of the control ``power_line``, by hertz; 0: no filter."""
DISABLED = 0x0001
CAPTURE = 1
DISCRETE = 1
MOST_ENTRIES = 256
"""Entries of a list that are read at most, should a driver never end it."""


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
        ("index", c_uint32), ("type", c_uint32), ("flags", c_uint32), ("description", c_uint8 * 32),
        ("pixelformat", c_uint32), ("mbus_code", c_uint32), ("reserved", c_uint32 * 3),
    ]  # fmt: skip


class FrameSize(ctypes.Structure):
    """``struct v4l2_frmsizeenum``; ``sizes``: width and height, or least, most and step of each."""

    _fields_ = [
        ("index", c_uint32), ("pixel_format", c_uint32), ("type", c_uint32), ("sizes", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    ]  # fmt: skip


class FrameInterval(ctypes.Structure):
    """``struct v4l2_frmivalenum``; ``intervals``: numerator and denominator [s], or those of least, most and step."""

    _fields_ = [
        ("index", c_uint32), ("pixel_format", c_uint32), ("width", c_uint32), ("height", c_uint32), ("type", c_uint32),
        ("intervals", c_uint32 * 6), ("reserved", c_uint32 * 2),
    ]  # fmt: skip


def _read_write(number: int, structure: type[ctypes.Structure]) -> int:
    """``_IOWR('V', number, structure)`` of asm-generic/ioctl.h."""
    return 3 << 30 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


ENUM_FORMAT = _read_write(2, FormatDescription)
GET_CONTROL = _read_write(27, Control)
SET_CONTROL = _read_write(28, Control)
QUERY_CONTROL = _read_write(36, QueryControl)
ENUM_SIZES = _read_write(74, FrameSize)
ENUM_INTERVALS = _read_write(75, FrameInterval)

Ioctl = Callable[[int, ctypes.Structure], None]
"""Performs a request on an open device; the structure is filled in. Raises OSError."""


class ControlRange(NamedTuple):
    """What a control takes: ``least`` to ``most`` in steps of ``step``."""

    least: int
    most: int
    step: int


class Mode(NamedTuple):
    """What a device delivers: pixel format (four letters), width and height [px], rates [Hz], highest first."""

    pixel_format: str
    width: int
    height: int
    rates_hz: tuple[float, ...]

    def __str__(self) -> str:
        rates = ", ".join(f"{rate:g}" for rate in self.rates_hz)
        return f"{self.pixel_format} {self.width}x{self.height}" + (f" at {rates} Hz" if rates else "")


@contextmanager
def opened(path: str) -> Iterator[Ioctl]:
    """Requests to the device at ``path``, beside whoever streams from it. Raises OSError."""
    descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        yield lambda request, structure: _request(descriptor, request, structure)
    finally:
        os.close(descriptor)


def _request(descriptor: int, request: int, structure: ctypes.Structure) -> None:
    fcntl.ioctl(descriptor, request, structure)  # type: ignore[call-overload]


def control_range(ioctl: Ioctl, name: str) -> ControlRange | None:
    """Values that the control ``name`` takes; None: the device has none of it."""
    query = QueryControl(id=CONTROLS[name])
    try:
        ioctl(QUERY_CONTROL, query)
    except OSError:
        return None
    return None if query.flags & DISABLED else ControlRange(query.minimum, query.maximum, query.step)


def set_control(ioctl: Ioctl, name: str, value: int) -> int | None:
    """Set the control ``name`` and return what the device then says that it is; None: it has none, or refused.

    Raises ValueError, with the range, for a value outside of it.
    """
    valid = control_range(ioctl, name)
    if valid is None:
        return None
    if not valid.least <= value <= valid.most:
        raise ValueError(
            f"{name} = {value}; this device takes {valid.least} to {valid.most} in steps of {valid.step}"
        )
    control = Control(id=CONTROLS[name], value=value)
    try:
        ioctl(SET_CONTROL, control)
        ioctl(GET_CONTROL, control)
    except OSError:
        return None
    return int(control.value)


def modes(ioctl: Ioctl) -> list[Mode]:
    """What the device says that it delivers, of sizes of its own choice; of others the largest."""
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
    """Whether the list has this entry. Raises OSError for anything but its end, or there being no such list."""
    try:
        ioctl(request, structure)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOTTY):
            return False
        raise
    return True
