"""Lossless compression of a recording: step records by their differences from the previous record of the same form,
checkpoints by their differences from the previous checkpoint.
"""

from __future__ import annotations

import struct

import numpy as np
import zstandard

from stereoservo.numerics.arrays import IntArray
from stereoservo.recording.step_layout import form_of

LARGEST = 64 << 20
"""Largest size of a block or checkpoint [bytes]: a larger stated size is damage, and is not allocated."""
MOST_KEPT = 8 * LARGEST
"""Largest size of rows that are kept from one block to the next [bytes]."""
LEVEL = 9
COUNT = struct.Struct("<II")
"""Head of a block: number of records, and number of their forms."""
ZERO, REPEATED = 64, 65
"""Kinds of a column: zero, or equal to the previous column. Otherwise the kind is the number of trailing zeros removed
(0 to 63), and its numbers follow.
"""


class StepBlocks:
    """Compresses and restores blocks of step records (`step_layout`).

    Records of a form (`step_layout.form_of`) are rows of 64-bit numbers. Their differences from row to row are stored,
    grouped by byte. The first row is compared with the last one of its form since `begin`, which is called at each
    point where reading may start: a checkpoint.
    """

    def __init__(self) -> None:
        self._compressor = zstandard.ZstdCompressor(level=LEVEL)
        self._decompressor = zstandard.ZstdDecompressor()
        self._last: dict[tuple[int, int], IntArray] = {}

    def begin(self) -> None:
        """Discard the previous records."""
        self._last = {}

    def compress(self, records: list[bytes]) -> bytes:
        """A block of records."""
        groups: dict[tuple[int, int], list[int]] = {}
        for i, record in enumerate(records):
            groups.setdefault((len(record), form_of(record)), []).append(i)
        kinds = np.empty(len(records), "<u2")
        for k, places in enumerate(groups.values()):
            kinds[places] = k
        parts = [
            COUNT.pack(len(records), len(groups)),
            np.array(list(groups), "<u4").tobytes(),
            kinds.tobytes(),
        ]
        for form, places in groups.items():
            data = b"".join([records[i] + bytes(-form[0] % 8) for i in places])
            rows = np.frombuffer(data, "<i8").reshape(len(places), -1)
            parts += self._columns(rows, form)
        return self._compressor.compress(b"".join(parts))

    def _columns(self, rows: IntArray, form: tuple[int, int]) -> list[bytes]:
        """Encode the differences from row to row: kinds of columns, then the bytes of those that are stored."""
        count, width = rows.shape
        before = self._last.get(form, np.zeros(width, np.int64))
        self._last[form] = rows[-1]
        difference = np.ascontiguousarray(np.diff(rows, axis=0, prepend=before[None]).T)
        bits = np.bitwise_or.reduce(difference, axis=1).view(np.uint64)
        kinds = (np.frexp((bits & (~bits + np.uint64(1))).astype(np.float64))[1] - 1).astype(np.uint8)
        kinds[1:][(difference[1:] == difference[:-1]).all(axis=1)] = REPEATED
        kinds[bits == 0] = ZERO
        stored = kinds < ZERO
        numbers = difference[stored] >> kinds[stored, None].astype(np.int64)
        folded = ((numbers << 1) ^ (numbers >> 63)).astype("<i8")  # signed to unsigned by magnitude
        return [kinds.tobytes(), folded.view(np.uint8).reshape(-1, count, 8).transpose(2, 0, 1).tobytes()]

    def restore(self, block: bytes) -> list[bytes]:
        """The records of a block, in their order. Raises any exception on damaged bytes, before more than a few times
        ``LARGEST`` bytes are allocated, or more than ``MOST_KEPT`` are kept for the next block.
        """
        data = _decompressed(self._decompressor, block)
        count, groups = COUNT.unpack_from(data)
        if 8 * count > LARGEST:
            raise ValueError(f"a block that states {count} records")
        forms = np.frombuffer(data, "<u4", 2 * groups, COUNT.size).reshape(-1, 2).tolist()
        at = COUNT.size + 8 * groups
        kinds = np.frombuffer(data, "<u2", count, at)
        at += 2 * count
        sizes = np.bincount(kinds, minlength=groups).tolist()
        if len(sizes) > groups or 0 in sizes:
            raise ValueError("a block with forms that no record has, or records of no form")
        if sum((8 + length) * size for size, (length, _) in zip(sizes, forms, strict=True)) > LARGEST:
            raise ValueError("a block of more records than there may be")
        places = np.split(np.argsort(kinds, kind="stable"), np.cumsum(sizes)[:-1])
        records = [b""] * count
        for found, (length, form) in zip(places, forms, strict=True):
            rows, at = self._rows(data, at, len(found), (length, form))
            for i, row in zip(found, rows, strict=True):
                records[i] = row.tobytes()[:length]
        if sum(row.nbytes for row in self._last.values()) > MOST_KEPT:
            raise ValueError("records of more forms since the last checkpoint than there may be")
        if at != len(data):
            raise ValueError(f"a block with {len(data) - at} bytes too many")
        return records

    def _rows(self, data: bytes, at: int, count: int, form: tuple[int, int]) -> tuple[IntArray, int]:
        """Inverse of `_columns`, and the position after the columns."""
        width = -(-form[0] // 8)
        kinds = np.frombuffer(data, np.uint8, width, at)
        at += width
        if kinds.max(initial=0) > REPEATED:
            raise ValueError("a column of a kind that is not known")
        stored = kinds < ZERO
        planes = np.frombuffer(data, np.uint8, 8 * count * int(np.count_nonzero(stored)), at)
        at += len(planes)
        folded = np.ascontiguousarray(planes.reshape(8, -1, count).transpose(1, 2, 0)).view("<u8")[..., 0]
        numbers = (folded >> np.uint64(1)).view(np.int64) ^ -(folded & np.uint64(1)).view(np.int64)
        numbers = numbers << kinds[stored, None].astype(np.int64)
        difference = np.zeros((width, count), np.int64)
        used = kinds != ZERO
        difference[used] = numbers[(np.cumsum(stored) - 1)[used]]  # a repeated one equals the newest stored one
        before = self._last.get(form, np.zeros(width, np.int64))
        rows: IntArray = np.cumsum(np.vstack([before[None], difference.T]), axis=0)[1:]
        self._last[form] = rows[-1]
        return np.ascontiguousarray(rows, dtype="<i8"), at


class Checkpoints:
    """Compresses and restores checkpoints, each with the previous one as its dictionary: at rest few bytes differ."""

    def __init__(self) -> None:
        self._before = b""

    def compress(self, data: bytes) -> bytes:
        """A checkpoint that follows the previous ones."""
        compressor = zstandard.ZstdCompressor(level=LEVEL, dict_data=self._dictionary())
        self._before = data
        return compressor.compress(data)

    def restore(self, data: bytes) -> bytes:
        """Inverse of `compress`, in the same order. Raises any exception on damaged bytes."""
        self._before = _decompressed(zstandard.ZstdDecompressor(dict_data=self._dictionary()), data)
        return self._before

    def _dictionary(self) -> zstandard.ZstdCompressionDict | None:
        if not self._before:
            return None
        return zstandard.ZstdCompressionDict(self._before, dict_type=zstandard.DICT_TYPE_RAWCONTENT)


def _decompressed(decompressor: zstandard.ZstdDecompressor, data: bytes) -> bytes:
    stated = zstandard.frame_content_size(data)
    if not 0 <= stated <= LARGEST:
        raise ValueError(f"compressed data that state a size of {stated} bytes")
    return decompressor.decompress(data)
