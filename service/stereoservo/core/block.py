"""The numbers that the stages of a step remember from one step to the next, as one flat record of fixed size, the same
for cells of any size: compiled kernels take it as one argument, of one type.

The record has room for the largest cell. An array of ``(rows, n)`` values lies packed at the start of its field, so
that a kernel has it as ``record.field[: rows * n].reshape((rows, n))``, and Python as an attribute of `Block`: a view
of the same memory. Attributes that are arrays are written in place; assigning one raises AttributeError, for it would
part it from the record.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from stereoservo.core.monitor_state import DriveDelays
from stereoservo.messages.cell_file import MAX_CAMERAS, MAX_JOINTS, MAX_MARKERS
from stereoservo.numerics.arrays import FloatArray, IntArray

HISTORY = 128
"""Joint samples kept for interpolation: a third of a second at 1 kHz, half of one at 250 Hz."""
DELAY_SAMPLES = 5
"""Of a joint's delay, of which the median counts."""
LONGEST_DELAY_S = 0.25
"""A drive that is later does not follow."""
MAX_RATE_HZ, MAX_WINDOW = 2000, 100
"""The fastest loop and the longest window of contact that a cell file may state."""


def steps_of_delay(rate_hz: float) -> int:
    """Steps to remember of a loop at ``rate_hz``, for drives that are late."""
    return math.ceil(LONGEST_DELAY_S * rate_hz) + 2


MOST = {
    "joints": MAX_JOINTS,
    "cameras": MAX_CAMERAS,
    "markers": MAX_MARKERS,
    "window": MAX_WINDOW,
    "past": steps_of_delay(MAX_RATE_HZ),
}
"""Counts of the largest cell: ``window`` samples of the watch on contact, and steps of the ``past``."""
NUMBERS: dict[str, type[int] | type[float]] = {
    "last_step_ns": int, "last_joints_ns": int, "last_joints_seq": int, "last_followed_ns": int, "history_count": int,
    "followed": int, "silence_known": int, "delay_steps": int, "loads_ns": int, "leave_s": float,
    "tells_efforts": int, "tells_following": int,
}  # fmt: skip
JOINTS = ("joints",)
Shapes = Mapping[str, tuple[str | int, ...]]
ARRAYS: Shapes = {
    "history_ns": (HISTORY,), "history_positions": (HISTORY, "joints"),
    "velocities": JOINTS, "command": JOINTS, "correction": JOINTS,
    "missing_travel": JOINTS, "untold_travel": JOINTS, "last_positions": JOINTS,
    "silent_from": JOINTS, "silent_travel": JOINTS, "silent_s": JOINTS,
    "delay_s": JOINTS, "delay_samples": (DELAY_SAMPLES, "joints"), "delay_onset": (7, "joints"),
    "delay_sent": JOINTS, "delay_past": ("past", "joints"), "delay_velocity": JOINTS, "delay_under_way": JOINTS,
    "delay_accounted": JOINTS, "delay_missing": JOINTS,
    "mean_efforts": JOINTS, "effort_excess": ("window", "joints"), "following_excess": ("window", "joints"),
    "contact_low": (2, "joints"), "contact_high": (2, "joints"), "efforts": JOINTS, "following_errors": JOINTS,
    "innovation": ("cameras", "markers", 2), "sigma": ("cameras", "markers"), "seen_ns": ("cameras", "markers"),
}  # fmt: skip
INTEGERS = ("history_ns", "seen_ns")
"""Arrays of int64; the others are of float64."""
SIGHTS = ("innovation", "sigma", "seen_ns")
"""Arrays that are written out with the cameras whose rows they are."""


def packed_type(
    arrays: Shapes,
    numbers: Mapping[str, type[int] | type[float]],
    integers: tuple[str, ...],
) -> np.dtype[Any]:
    """The type of a record with room for ``arrays`` of the largest cell, ``numbers`` and all `MOST`."""
    fields: list[Any] = [(name, np.int64) for name in MOST]
    fields += [(name, np.int64 if kind is int else np.float64) for name, kind in numbers.items()]
    for name, shape in arrays.items():
        size = math.prod(shape_of(shape, MOST))
        fields.append((name, np.int64 if name in integers else np.float64, (size,)))
    return np.dtype(fields, align=True)


def shape_of(shape: tuple[str | int, ...], counts: Mapping[str, int]) -> tuple[int, ...]:
    """A shape in numbers."""
    return tuple(counts[side] if isinstance(side, str) else side for side in shape)


def views(record: np.ndarray[Any, Any], arrays: Shapes, counts: Mapping[str, int]) -> dict[str, Any]:
    """The arrays of a ``record`` (1,), each a view of its packed part."""
    found = {}
    for name, given in arrays.items():
        shape = shape_of(given, counts)
        found[name] = record[name][0, : math.prod(shape)].reshape(shape)
    return found


BLOCK = packed_type(ARRAYS, NUMBERS, INTEGERS)


class Block:
    """What is remembered; ``record`` (1,) of type `BLOCK` is all of it, and what kernels take.

    Joints: their samples of late, ``history_positions`` (k, n) at ``history_ns`` (k,), a ring to which
    ``history_count`` were ever written; ``velocities``, the last ``command`` and the ``correction`` that explains the
    innovations best (n,). Stamps of the last step and sample, and of the sample up to which travel is accounted for,
    ``last_followed_ns``.

    Following: ``missing_travel`` (n,), commanded less measured travel of late [rad or m], and ``untold_travel``,
    commanded since the last sample; ``last_positions`` (n,), where travel is ``followed``. While ``silence_known``:
    readings ``silent_from`` (n,) when each last changed, ``silent_travel`` sent since, with its sign, less what
    friction may hold back, and for how long, ``silent_s``. ``delay_…``: the arrays of `monitor_state.DriveDelays`,
    after ``delay_steps`` steps.

    Loads (see `core.monitors.collision`): ``mean_efforts`` (n,), moving mean; ``effort_excess``, ``following_excess``
    (samples, n), newest last: how far the last samples lay beyond what is expected; ``contact_low``, ``contact_high``
    (2, n), of efforts and following errors: what a contact has brought, and what it may take away again in the next
    ``leave_s`` of motion. ``efforts``, ``following_errors`` (n,) of the sample at ``loads_ns``, where it tells
    them.

    Sights (c, m, 2), (c, m), (c, m): of each camera's `state.CameraEstimate`, which has its row.
    """

    record: np.ndarray[Any, Any]
    numbers: dict[str, np.ndarray[Any, Any]]
    counts: dict[str, int]
    delays: DriveDelays
    last_step_ns: int
    last_joints_ns: int
    last_joints_seq: int
    last_followed_ns: int
    history_count: int
    history_ns: IntArray
    history_positions: FloatArray
    velocities: FloatArray
    command: FloatArray
    correction: FloatArray
    missing_travel: FloatArray
    untold_travel: FloatArray
    followed: int
    last_positions: FloatArray
    silence_known: int
    silent_from: FloatArray
    silent_travel: FloatArray
    silent_s: FloatArray
    delay_steps: int
    delay_s: FloatArray
    delay_samples: FloatArray
    delay_onset: FloatArray
    delay_sent: FloatArray
    delay_past: FloatArray
    delay_velocity: FloatArray
    delay_under_way: FloatArray
    delay_accounted: FloatArray
    delay_missing: FloatArray
    loads_ns: int
    leave_s: float
    mean_efforts: FloatArray
    effort_excess: FloatArray
    following_excess: FloatArray
    contact_low: FloatArray
    contact_high: FloatArray
    tells_efforts: int
    efforts: FloatArray
    tells_following: int
    following_errors: FloatArray
    innovation: FloatArray
    sigma: FloatArray
    seen_ns: IntArray

    def __init__(self, counts: Mapping[str, int]) -> None:
        """Nothing known, in a cell with these ``counts``."""
        beyond = [
            f"{count} {name}, {MOST[name]} are possible"
            for name, count in counts.items()
            if count > MOST[name]
        ]
        if beyond:
            raise ValueError(f"a cell with {'; '.join(beyond)}")
        self.__dict__["record"] = np.zeros(1, BLOCK)
        self.__dict__["numbers"] = {name: self.record[name] for name in NUMBERS}
        self._count(counts)
        self.last_joints_seq = -1
        self.delay_samples[:] = np.nan
        self.sigma[:] = 1.0

    def __setattr__(self, name: str, value: object) -> None:
        if name not in NUMBERS:
            raise AttributeError(f"{name} of the block is a view of its record: write into it")
        self.numbers[name][0] = value

    def _count(self, counts: Mapping[str, int]) -> None:
        self.__dict__["counts"] = dict(counts)
        for name, count in counts.items():
            self.record[name] = count
        self.__dict__.update(views(self.record, ARRAYS, counts))
        self.__dict__["delays"] = DriveDelays(
            self.delay_s, self.delay_samples, self.delay_onset, self.delay_sent, self.delay_past, self.delay_velocity,
            self.delay_under_way, self.delay_accounted, self.delay_missing,
        )  # fmt: skip

    def begin_sights(self, markers: int) -> None:
        """Sights of so many markers, none of which is seen yet."""
        self._count({**self.counts, "markers": markers})
        self.innovation[:], self.sigma[:], self.seen_ns[:] = 0.0, 1.0, 0

    def remember_steps(self, past: int) -> None:
        """Room for so many steps of the past, of which nothing is known."""
        self._count({**self.counts, "past": past})
        self.delay_past[:] = 0.0

    def kept(self) -> dict[str, Any]:
        """All that is to be written out but the `SIGHTS`, by name: counts, numbers, and arrays."""
        return {
            "counts": self.counts,
            **{name: getattr(self, name) for name in NUMBERS},
            **{name: getattr(self, name) for name in ARRAYS if name not in SIGHTS},
        }


def restored(kept: Mapping[str, Any]) -> Block:
    """The block of which `Block.kept` wrote ``kept``; what it does not name is as in the beginning. Raises KeyError,
    ValueError, TypeError where it is none.
    """
    counts = kept["counts"]
    block = Block({name: int(counts[name]) for name in MOST})
    for name, value in kept.items():
        if name in NUMBERS:
            setattr(block, name, NUMBERS[name](value))
        elif name in ARRAYS:
            array = getattr(block, name)
            if value.shape != array.shape:
                raise ValueError(f"{name} of shape {value.shape}; {array.shape} is needed")
            array[:] = value
    return block


def _number(name: str) -> property:
    return property(lambda block: block.numbers[name].item())


for _name in NUMBERS:
    setattr(Block, _name, _number(_name))
