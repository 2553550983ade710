"""Request to the vision processes to record their images, passed by a file, and their reports of what was recorded.

The request is a small file in the cell's runtime directory, replaced as a whole and read a few times a second, so that
a vision process that starts late, or again, finds it.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import msgspec

from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.files import read_bounded, write_atomically

IMAGES_SUFFIX = ".images"
MAX_REQUEST_BYTES = 1 << 16


class ImageRecordingRequest(msgspec.Struct, frozen=True):
    """Request to record into ``directory`` (empty: to stop). ``number`` is different for each request."""

    number: int = 0
    directory: str = ""


class RecordedImages(msgspec.Struct, frozen=True):
    """Report of one camera's recording. ``left_out``: number of delivered frames that are not in it;
    ``why`` it ended.
    """

    camera: str
    file: str
    frames: int
    left_out: int
    bytes: int
    why: str = ""


class ImagesRecorded(msgspec.Struct, frozen=True):
    """A recording of images that has ended."""

    directory: str
    cameras: tuple[RecordedImages, ...]


def request_path(directories: CellDirectories) -> Path:
    """The file of a cell's request."""
    return directories.runtime / "images.json"


def images_directory(recording: Path) -> Path:
    """The image directory of a flight recording: ``NAME.images`` beside ``NAME.mcap``."""
    return recording.with_suffix(IMAGES_SUFFIX)


def write_request(path: Path, order: ImageRecordingRequest) -> None:
    """Replace the request. Raises OSError."""
    write_atomically(path, msgspec.json.encode(order))


def read_request(path: Path) -> ImageRecordingRequest | None:
    """The current request; None if there is none. Raises DamagedError."""
    with decoding(partial(DamagedError, path)):
        try:
            data = read_bounded(path, MAX_REQUEST_BYTES)
        except FileNotFoundError:
            return None
        return msgspec.json.decode(data, type=ImageRecordingRequest)
