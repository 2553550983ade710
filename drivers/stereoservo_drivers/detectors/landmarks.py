"""Landmarks: natural features with ids common to all cameras of a cell, and their file.

A file is written once, by `stereoservo learn-corners`; each camera's detector reads it and works independently. It has
one reference picture per camera, the position of each landmark in it, and whether it belongs to the tool or to the
scene.
"""

from __future__ import annotations

import io
import math
import stat
from pathlib import Path
from typing import Any, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.messages.decoding import decoding
from stereoservo.numerics.archives import read_archive
from stereoservo.numerics.arrays import FloatArray, ImageArray, IntArray
from stereoservo.ports.devices import DriverError

SCHEMA = 1
LARGEST_FILE = 256 * 2**20
MOST_LANDMARKS = 5000
LARGEST_PICTURE = 64 * 2**20
Kind = Literal["tool", "static", "unsorted"]
KINDS: tuple[Kind, ...] = ("tool", "static", "unsorted")
"""Moves with the arm; static; learnt without a picture after a motion, so that the kind is unknown."""


class CameraReference(msgspec.Struct, frozen=True, eq=False):
    """Reference of one camera: ``name``, ``picture`` (h, w), the mean of ``averaged`` images; ``pixels`` (m, 2) of the
    landmarks in it [px], NaN for invisible ones, and their ``sigmas`` (m,) [px].
    """

    name: str
    picture: ImageArray
    averaged: int
    pixels: FloatArray
    sigmas: FloatArray


class Landmarks(msgspec.Struct, frozen=True, eq=False):
    """Landmarks of a cell: ``ids`` (m,), ascending, and ``kinds`` (m,), positions in ``KINDS``; one reference per
    camera.
    """

    ids: IntArray
    kinds: IntArray
    cameras: tuple[CameraReference, ...]

    def of_kind(self, kind: Kind) -> IntArray:
        """Ids (k,) of the landmarks of a kind."""
        ids: IntArray = self.ids[self.kinds == KINDS.index(kind)]
        return ids

    def camera(self, name: str) -> CameraReference:
        """The reference of a camera. Raises DriverError (``landmarks``) if there is none."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(repr(camera.name) for camera in self.cameras)
        raise DriverError(
            "landmarks",
            f"no landmarks of camera {name!r}; the file has those of {known}: learn them with this camera's images",
            camera=name,
            known=[camera.name for camera in self.cameras],
        )


class _LandmarkHeader(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    schema: int
    cameras: tuple[str, ...]
    averaged: tuple[int, ...]


def encode_landmarks(landmarks: Landmarks) -> bytes:
    """Landmarks as npz bytes: a JSON header, PNG pictures, arrays. Raises DriverError (``landmarks``)."""
    check_landmarks(landmarks, "landmarks")
    header = _LandmarkHeader(
        SCHEMA, tuple(c.name for c in landmarks.cameras), tuple(c.averaged for c in landmarks.cameras)
    )
    arrays: dict[str, npt.NDArray[Any]] = {
        "header": np.frombuffer(msgspec.json.encode(header), np.uint8),
        "ids": landmarks.ids,
        "kinds": landmarks.kinds,
    }
    for c, camera in enumerate(landmarks.cameras):
        arrays[f"picture{c}"] = cv2.imencode(".png", camera.picture)[1].ravel()
        arrays[f"pixels{c}"] = camera.pixels
        arrays[f"sigmas{c}"] = camera.sigmas
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def decode_landmarks(data: bytes, path: Path | str = "<landmarks>") -> Landmarks:
    """Inverse of :func:`encode_landmarks`. Raises DriverError (``landmarks``) naming the mismatch."""
    with decoding(lambda cause: _bad(path, f"is not a file of landmarks: {cause}"), (DriverError,)):
        arrays = read_archive(data, LARGEST_FILE)
        try:
            landmarks = _landmarks(arrays, path)
        except KeyError as error:
            raise _bad(path, f"is not a file of landmarks: array {error} is missing") from error
        if arrays:
            raise ValueError(f"unknown arrays: {', '.join(sorted(arrays))}")
    check_landmarks(landmarks, path)
    return landmarks


def _landmarks(arrays: dict[str, npt.NDArray[Any]], path: Path | str) -> Landmarks:
    """Landmarks from the arrays of a file, which are removed from ``arrays``. May raise any exception."""
    header = msgspec.json.decode(arrays.pop("header").tobytes(), type=_LandmarkHeader)
    if header.schema != SCHEMA:
        raise _bad(path, f"schema is {header.schema}; this version reads {SCHEMA}")
    if len(header.averaged) != len(header.cameras):
        raise ValueError(f"{len(header.cameras)} cameras and {len(header.averaged)} counts of images")
    cameras = tuple(
        CameraReference(
            name,
            _picture(arrays.pop(f"picture{c}")),
            averaged,
            _typed(arrays.pop(f"pixels{c}"), np.float64),
            _typed(arrays.pop(f"sigmas{c}"), np.float64),
        )
        for c, (name, averaged) in enumerate(zip(header.cameras, header.averaged, strict=True))
    )
    return Landmarks(_typed(arrays.pop("ids"), np.int64), _typed(arrays.pop("kinds"), np.int64), cameras)


def load_landmarks(path: Path) -> Landmarks:
    """Read and check a file of landmarks. Raises DriverError (``landmarks``)."""
    try:
        found = path.stat()
        if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):  # reading a pipe would block
            raise _bad(path, "is no regular file; `stereoservo learn-corners` writes one")
        size = found.st_size
        if size > LARGEST_FILE:
            raise _bad(path, f"has {size} bytes; at most {LARGEST_FILE} are read: is it a file of landmarks?")
        return decode_landmarks(path.read_bytes(), path)
    except OSError as error:
        raise _bad(path, f"cannot be read: {error.strerror}; `stereoservo learn-corners` writes one") from error


def check_landmarks(landmarks: Landmarks, path: Path | str) -> None:
    """Check shapes, ids and pixels. Raises DriverError (``landmarks``) if they are inconsistent."""
    m = len(landmarks.ids)
    if landmarks.ids.shape != (m,) or landmarks.kinds.shape != (m,):
        raise _bad(path, f"ids {landmarks.ids.shape} and kinds {landmarks.kinds.shape}; both must be (m,)")
    if not 1 <= m <= MOST_LANDMARKS:
        raise _bad(path, f"{m} landmarks; 1 to {MOST_LANDMARKS} are valid")
    if landmarks.ids[0] < 0 or not (np.diff(landmarks.ids) > 0).all():
        raise _bad(path, "ids must ascend from 0 on, each once")
    if not ((landmarks.kinds >= 0) & (landmarks.kinds < len(KINDS))).all():
        raise _bad(path, f"kinds must be 0 to {len(KINDS) - 1}: {', '.join(KINDS)}")
    names = [camera.name for camera in landmarks.cameras]
    if not names or len(set(names)) != len(names) or not all(names):
        raise _bad(path, f"cameras {names}; at least one, names that differ")
    for camera in landmarks.cameras:
        height, width = camera.picture.shape
        if camera.pixels.shape != (m, 2) or camera.sigmas.shape != (m,) or camera.averaged < 1:
            raise _bad(
                path,
                f"camera {camera.name!r}: pixels {camera.pixels.shape}, sigmas {camera.sigmas.shape} of {m} landmarks, "
                f"mean of {camera.averaged} images",
            )
        seen = np.isfinite(camera.pixels).all(axis=1)
        inside = (camera.pixels[seen] >= 0.0) & (camera.pixels[seen] <= np.array([width, height]) - 1.0)
        sigmas = camera.sigmas[seen]
        if not inside.all() or not (np.isfinite(sigmas) & (sigmas >= 0.0)).all():
            raise _bad(
                path,
                f"camera {camera.name!r}: landmarks outside of its picture of {width}x{height} px, or sigmas that are "
                "no lengths",
            )


def _picture(encoded: npt.NDArray[Any]) -> ImageArray:
    data = _typed(encoded, np.uint8)
    # PNG has its size in bytes 16 to 24: checked first, so that a small file cannot request a huge picture.
    if len(data) < 33 or data[:8].tobytes() != b"\x89PNG\r\n\x1a\n":
        raise ValueError("a reference picture is no PNG")
    width, height = (int.from_bytes(data[k : k + 4].tobytes(), "big") for k in (16, 20))
    if math.prod((width, height)) > LARGEST_PICTURE:
        raise ValueError(f"a reference picture has {width}x{height} px; at most {LARGEST_PICTURE} in all are read")
    picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise ValueError("a reference picture is damaged")
    return np.asarray(picture, dtype=np.uint8)


def _typed(array: npt.NDArray[Any], dtype: Any) -> npt.NDArray[Any]:
    if array.dtype != dtype:
        raise ValueError(f"an array of {array.dtype}; {np.dtype(dtype)} is valid")
    return np.ascontiguousarray(array)


def _bad(path: Path | str, message: str, **data: Any) -> DriverError:
    return DriverError("landmarks", f"{path}: {message}", path=str(path), **data)
