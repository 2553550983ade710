"""Reading of ``.npz`` archives from untrusted sources."""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt

MOST_EXPANSION = 1100
"""Bound of the expansion ratio of deflated data."""


def read_archive(data: bytes, limit: int) -> dict[str, npt.NDArray[Any]]:
    """Arrays of an ``.npz`` archive by name. Before allocation, the stated sizes are compared with the available bytes,
    and their sum with ``limit`` [bytes]; object arrays are not read.

    Raises ValueError, and the exceptions of `zipfile` for a damaged archive.
    """
    if not data.startswith(b"PK"):
        raise ValueError("it is no .npz archive")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        items = archive.infolist()
        size = sum(item.file_size for item in items)
        if size > limit:
            raise ValueError(f"it unpacks to {size} bytes; at most {limit} are read")
        for item in items:
            stored = len(data) if item.compress_type == zipfile.ZIP_STORED else len(data) * MOST_EXPANSION
            if item.file_size > stored:
                raise ValueError(f"{item.filename} is said to have {item.file_size} bytes")
        return {item.filename.removesuffix(".npy"): _array(item.filename, archive.read(item)) for item in items}


def _array(name: str, data: bytes) -> npt.NDArray[Any]:
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{name} has npy version {version}; 1.0 and 2.0 are read")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read_header(file)
    if dtype.hasobject or dtype.itemsize == 0:
        raise ValueError(f"{name} is an array of {dtype}; numbers are read")
    rest = data[file.tell() :]
    if math.prod(shape) * dtype.itemsize != len(rest):
        raise ValueError(f"{name} is said to have shape {shape} of {dtype}, and has {len(rest)} bytes")
    return np.frombuffer(rest, dtype).reshape(shape, order="F" if fortran else "C").copy()
