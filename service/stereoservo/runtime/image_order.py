"""How vision processes are told to record what their cameras deliver, and what they say came of it.

The order is a small file in the cell's runtime directory, replaced as a whole and looked at a few times a second: a
vision process that starts late, or again, finds it there.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from stereoservo.runtime.directories import CellDirectories

IMAGES_SUFFIX = ".images"


class ImageOrder(msgspec.Struct, frozen=True):
    """Record into ``directory`` from now on; empty: do not. ``number`` tells one order from the next."""

    number: int = 0
    directory: str = ""


class RecordedImages(msgspec.Struct, frozen=True):
    """What one camera's recording holds. ``left_out``: delivered frames that are not in it; ``why`` it ended."""

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


def order_path(directories: CellDirectories) -> Path:
    """Where the order of a cell lies."""
    return directories.runtime / "images.json"


def images_directory(recording: Path) -> Path:
    """Where the images go that belong to a flight recording: ``NAME.images`` beside ``NAME.mcap``."""
    return recording.with_suffix(IMAGES_SUFFIX)


def give_order(path: Path, order: ImageOrder) -> None:
    """Put an order in the place of the one before. Raises OSError."""
    temporary = path.with_suffix(".new")
    temporary.write_bytes(msgspec.json.encode(order))
    temporary.replace(path)


def read_order(path: Path) -> ImageOrder | None:
    """The present order; None where there is none. Raises msgspec.MsgspecError."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    return msgspec.json.decode(data, type=ImageOrder)
