"""Options of the driver ``video``, and the parsing of its ``source``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import SplitResult

import msgspec
from msgspec import Meta

from stereoservo.messages.addresses import Address, AddressError, keep_secret, without_secrets
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.episodes import EpisodeNumber
from stereoservo_drivers.options import decode_options

DRIVER = "video"
Channel = Literal["gray", "red", "green", "blue"]
Flip = Literal["none", "horizontal", "vertical", "rotate180"]
Pace = Literal["recorded", "every"]
SourceKind = Literal["device", "file", "sequence", "episode", "http", "rtsp", "genicam"]
Pixels = Annotated[int, Meta(ge=16, le=16384)]
Seconds = Annotated[float, Meta(ge=0.05, le=60)]

VIDEO_FILES = (".avi", ".mkv", ".mp4")
PICTURE_FILES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")
LIVE_FROZEN_FRAMES = 10
_DEVICE = re.compile(r"/dev/video(\d+)")
_NUMBER = re.compile(r"%(0\d+)?d")
_NO_URL = SplitResult("", "", "", "", "")
VALID_SOURCES = (
    "a device number (0) or path (/dev/video0), a file (.avi, .mkv, .mp4), numbered pictures (left-%04d.png), "
    "http://, https:// (MJPEG, or a snapshot), rtsp://, genicam:// (GigE Vision, USB3 Vision), or, with `episode`, the "
    "folder of a LeRobot data set"
)


class VideoOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of a camera of the driver ``video``.

    ``source``: device number or path, video file, numbered pictures (one ``%04d`` in the file's name), or URL; files
    are relative to the cell file's directory.
    ``width``, ``height`` [px]: requested from a device, and compared with the first picture of any source.
    ``rate_hz``: requested from a device; grid on which missing frames are counted; rate of files without stamps, and of
    requests to a camera of single pictures (snapshots).
    ``latency_s``: from the shutter to the reception, subtracted from the time of reception (recordings with stamps
    already include it).
    ``pixel_format``: four letters such as ``MJPG``, which many USB cameras need for their full rate.

    Controls of a device (V4L2, GenICam), each unchanged if it is not stated, and read back: ``exposure`` [0.1 ms with
    UVC cameras, µs with GenICam], ``gain`` [GenICam: dB] and ``focus`` in units of the device, ``white_balance`` [K]; a
    number locks it, ``"auto"`` lets the camera choose. ``power_line_hz``: the flicker filter, 0 for none.
    ``rate_priority``: automatic exposure must not lower the frame rate.

    ``channel``: gray, or a single colour.
    ``flip``: rotation or mirroring of the picture before any processing.
    ``open_timeout_s``: from connecting to the first picture.
    ``read_timeout_s``: time without a picture after which the camera counts as silent.
    ``frozen_frames``: number of identical pictures that count as a frozen camera, each of which is withheld, from the
    first on; 0 disables the check (default: 10, and 0 for files).

    ``server_clock_s``: of an MJPEG stream: the pictures' own stamps (header ``X-Timestamp``, seconds of the server's
    clock) are used while that clock's standard deviation is at most this [s]; otherwise, and if it is omitted, the time
    of reception minus ``latency_s`` is used.

    Of files and pictures: ``start``, number of the first picture used; ``loop``, restart at the end; ``pace``:
    ``recorded``, each at its time since delivery started (of this camera: several are not aligned), or ``every``, the
    next one at each poll, with the recording's own stamps.

    Of a LeRobot data set, whose folder is the ``source``: ``episode``, and ``feature``, the camera's name there or the
    whole feature (default: the name of the cell's camera). With ``loop`` its times are those of `episodes.Episode`,
    which are common to cameras and joints of one episode.
    """

    source: int | str
    width: Pixels
    height: Pixels
    rate_hz: Annotated[float, Meta(ge=0.1, le=1000)] = 30.0
    latency_s: Annotated[float, Meta(ge=0, le=10)] = 0.0
    exposure: float | Literal["auto"] | None = None
    gain: float | None = None
    focus: float | Literal["auto"] | None = None
    white_balance: float | Literal["auto"] | None = None
    power_line_hz: Literal[0, 50, 60] | None = None
    rate_priority: bool | None = None
    pixel_format: str = ""
    channel: Channel = "gray"
    flip: Flip = "none"
    open_timeout_s: Seconds = 5.0
    read_timeout_s: Seconds = 1.0
    server_clock_s: Annotated[float, Meta(gt=0, le=1)] | None = None
    frozen_frames: Annotated[int, Meta(ge=0, le=100000)] | None = None
    start: Annotated[int, Meta(ge=0)] = 0
    loop: bool = False
    pace: Pace = "recorded"
    episode: EpisodeNumber | None = None
    feature: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.source, str) and "://" in self.source:
            keep_secret(self.source)
            msgspec.structs.force_setattr(self, "source", Address(self.source))


@dataclass(frozen=True)
class Place:
    """A parsed ``source``. ``shown``: for messages; for a URL an `Address`."""

    kind: SourceKind
    shown: str
    device: int | str = -1
    path: Path = Path()
    url: SplitResult = _NO_URL

    @property
    def live(self) -> bool:
        """Whether the source delivers images by itself."""
        return self.kind in ("device", "http", "rtsp", "genicam")

    def error(self, code: str, what: str, *, retry: bool = False, **data: Any) -> DriverError:
        """A DriverError about this source."""
        return DriverError(code, f"{self.shown}: {what}", retry=retry, source=str(self.shown), **data)


def decode_video_options(options: Mapping[str, Any], cell_dir: Path) -> tuple[VideoOptions, Place]:
    """Options and the parsed source; nothing is opened. Raises DriverError (``option``)."""
    decoded = decode_options(VideoOptions, options, DRIVER)
    place = _place(decoded, cell_dir)
    if place.live:
        for name, value, usual in (
            ("start", decoded.start, 0),
            ("loop", decoded.loop, False),
            ("pace", decoded.pace, "recorded"),
        ):
            if value != usual:
                raise _wrong(name, value, f"is for files and numbered pictures; source is {place.shown}")
    if place.kind != "device":
        for name in ("focus", "white_balance", "power_line_hz", "rate_priority"):
            if getattr(decoded, name) is not None:
                raise _wrong(name, getattr(decoded, name), f"is for devices; source is {place.shown}")
    if place.kind != "http" and decoded.server_clock_s is not None:
        raise _wrong("server_clock_s", decoded.server_clock_s, f"is for http://; source is {place.shown}")
    if place.kind == "genicam" and (decoded.channel != "gray" or decoded.pixel_format):
        name = "pixel_format" if decoded.pixel_format else "channel"
        raise _wrong(name, getattr(decoded, name), "pictures of genicam:// are read as Mono8: leave it out")
    if decoded.read_timeout_s * decoded.rate_hz < 2.0:
        raise _wrong(
            "read_timeout_s",
            decoded.read_timeout_s,
            f"valid: two periods of rate_hz or more, {2.0 / decoded.rate_hz:g} s",
        )
    if decoded.pixel_format and (len(decoded.pixel_format) != 4 or not decoded.pixel_format.isascii()):
        raise _wrong("pixel_format", decoded.pixel_format, 'valid: four letters, such as "MJPG" or "YUYV"')
    return decoded, place


def frozen_frames(options: VideoOptions, place: Place) -> int:
    """Number of equal images in a row that mean a frozen camera; 0: disabled."""
    if options.frozen_frames is not None:
        return options.frozen_frames
    return LIVE_FROZEN_FRAMES if place.live else 0


def _place(options: VideoOptions, cell_dir: Path) -> Place:
    """The source; an episode's folder needs no file extension. Raises DriverError."""
    source = options.source
    if options.episode is None:
        if options.feature:
            raise _wrong("feature", options.feature, "is for LeRobot data sets, with `episode`")
        return place_of(source, cell_dir)
    if isinstance(source, int) or "://" in source or source.startswith("/dev/"):
        raise _wrong("episode", options.episode, f"is for the folder of a LeRobot data set; source is {source}")
    if options.start:
        raise _wrong("start", options.start, "an episode is played from its beginning: leave it out")
    path = cell_dir / source
    return Place("episode", f"{path}, episode {options.episode}", path=path)


def place_of(source: int | str, cell_dir: Path) -> Place:
    """Parse ``source``. Raises DriverError (``option``)."""
    if isinstance(source, int):
        if source < 0:
            raise _wrong("source", source, f"valid: {VALID_SOURCES}")
        return Place("device", f"/dev/video{source}", device=source)
    if source.startswith("/dev/"):
        number = _DEVICE.fullmatch(source)
        return Place("device", source, device=int(number[1]) if number else source)
    if "://" in source:
        return _url(Address(source))
    path = cell_dir / source
    suffix = path.suffix.lower()
    if Address(source) != source and not (path.parent if "%" in source else path).exists():
        raise _wrong("source", source, "valid: a URL begins with http://, https:// or rtsp://")
    if "%" in source:
        if len(_NUMBER.findall(path.name)) != 1 or source.count("%") != 1:
            raise _wrong("source", source, "valid: one %d or %04d, in the name of the file")
        if suffix not in PICTURE_FILES:
            raise _wrong("source", source, f"valid endings of numbered pictures: {', '.join(PICTURE_FILES)}")
        return Place("sequence", str(path), path=path)
    if suffix in VIDEO_FILES:
        return Place("file", str(path), path=path)
    hint = f"; a device's number stands without quotes: source = {source}" if source.isdigit() else ""
    raise _wrong("source", source, f"valid: {VALID_SOURCES}{hint}")


def _url(source: Address) -> Place:
    try:
        url = source.parsed()
    except AddressError as error:
        raise _wrong("source", source, str(error)) from error
    if url.scheme in ("http", "https"):
        return Place("http", source, url=url)
    if url.scheme == "genicam":
        return Place("genicam", source, url=url)
    if url.scheme in ("rtsp", "rtsps"):
        return Place("rtsp", source, url=url)
    raise _wrong("source", source, f"valid: {VALID_SOURCES}")


def _wrong(option: str, value: object, what: str) -> DriverError:
    value = without_secrets(value)
    shown = f'"{value}"' if isinstance(value, str) else str(value).lower()
    return DriverError(
        "option", f"driver {DRIVER!r}: {option} = {shown}; {what}", driver=DRIVER, option=option, value=value
    )
