"""The numbers that the stages remember from one step to the next, as one flat record of fixed size, the same for cells
of any size: compiled kernels take it as one argument, of one type.

The record is large enough for the largest cell. An array of ``(rows, n)`` values is packed at the start of its field:
a kernel accesses it as ``record.field[: rows * n].reshape((rows, n))``, and Python as an attribute of `Block`, a view
of the same memory. Array attributes must be written in place; assigning one raises AttributeError, because it would
detach the attribute from the record.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from stereoservo.core.camera_state import (
    KINDS,
    NOTHING_KNOWN,
    NOTHING_SEEN,
    CameraEstimate,
    CameraMonitor,
    Kept,
)
from stereoservo.core.monitor_state import DriveDelays
from stereoservo.messages.cell_file import MAX_CAMERAS, MAX_JOINTS, MAX_MARKERS
from stereoservo.numerics.arrays import FloatArray, IntArray

HISTORY = 128
"""Joint samples kept for interpolation: a third of a second at 1 kHz, half of one at 250 Hz."""
VELOCITY_FILTER_S = 0.01
"""Time constant of the filtered joint velocities [s]."""
DELAY_SAMPLES = 5
"""Number of measurements of a joint's delay; their median is used."""
LONGEST_DELAY_S = 0.25
"""Longest delay of a drive [s]; with a longer delay, the joint counts as not following."""
MAX_RATE_HZ, MAX_WINDOW = 2000, 100
"""The fastest loop [Hz] and the longest window of collision monitoring [samples] that a cell file may state."""


def steps_of_delay(rate_hz: float) -> int:
    """Number of steps to remember in a loop at ``rate_hz``, for delays of drives."""
    return math.ceil(LONGEST_DELAY_S * rate_hz) + 2


MOST = {
    "joints": MAX_JOINTS,
    "cameras": MAX_CAMERAS,
    "markers": MAX_MARKERS,
    "rows": MAX_MARKERS,
    "window": MAX_WINDOW,
    "past": steps_of_delay(MAX_RATE_HZ),
}
"""Counts of the largest cell: ``rows`` of a frame are the model's markers and static points; ``window``: samples of
collision monitoring; ``past``: steps remembered for delays.
"""


class RunProgress(Kept):
    """Progress of the active law since its goal started.

    ``moved_s``: time for which it was allowed to move.
    ``newest_px``: the largest error over markers and cameras, valid if one was ``measured`` in the last step.
    ``held``: frames in which it has been inside its tolerance; they were last counted when the cameras had
    ``last_frames`` in total.
    ``first_px``: the largest error so far.
    ``mean_px``: recent mean error.
    ``least_px``: the smallest mean so far, improved for the last time after ``least_s`` of motion.
    """

    moved_s: float
    held: int
    last_frames: int
    measured: bool
    newest_px: float
    first_px: float
    mean_px: float
    least_px: float
    least_s: float
    _fields_ = tuple((name, KINDS[kind]) for name, kind in __annotations__.items())


class Numbers(ctypes.Structure):
    """The scalar numbers at the head of a record, with the counts. They are read and written like attributes."""

    joints: int
    cameras: int
    markers: int
    window: int
    past: int
    last_step_ns: int
    last_joints_ns: int
    last_joints_seq: int
    last_followed_ns: int
    history_count: int
    followed: int
    silence_known: int
    delay_steps: int
    loads_ns: int
    leave_s: float
    tells_efforts: int
    tells_following: int
    rows: int
    round_due: int
    run: RunProgress
    _fields_ = [
        (name, {"float": ctypes.c_double, "RunProgress": RunProgress}.get(kind, ctypes.c_int64))
        for name, kind in __annotations__.items()
    ]


JOINTS = ("joints",)
Shapes = Mapping[str, tuple[str | int, ...]]
ARRAYS: Shapes = {
    "velocities": JOINTS, "command": JOINTS, "correction": JOINTS,
    "missing_travel": JOINTS, "untold_travel": JOINTS, "last_positions": JOINTS,
    "silent_from": JOINTS, "silent_travel": JOINTS, "silent_s": JOINTS,
    "delay_s": JOINTS, "delay_samples": (DELAY_SAMPLES, "joints"), "delay_onset": (7, "joints"),
    "delay_sent": JOINTS, "delay_velocity": JOINTS, "delay_under_way": JOINTS,
    "delay_accounted": JOINTS, "delay_missing": JOINTS,
    "friction": JOINTS, "friction_from": JOINTS, "friction_sent": JOINTS, "friction_s": JOINTS,
    "mean_efforts": JOINTS, "contact_low": (2, "joints"), "contact_high": (2, "joints"), "efforts": JOINTS,
    "following_errors": JOINTS,
    "history_ns": (HISTORY,), "history_positions": (HISTORY, "joints"), "delay_past": ("past", "joints"),
    "effort_excess": ("window", "joints"), "following_excess": ("window", "joints"),
    "innovation": ("cameras", "markers", 2), "sigma": ("cameras", "markers"), "seen_ns": ("cameras", "markers"),
    "frame_innovation": ("cameras", "rows", 2), "frame_spread": ("cameras", "rows", 2, 2),
    "frame_seen": ("cameras", "rows"), "frame_velocity": ("cameras", "rows", 2), "frame_q": ("cameras", "joints"),
    "settled_innovation": ("cameras", "markers", 2), "settled_variance": ("cameras", "markers"),
    "settled_count": ("cameras", "markers"), "settled_ns": ("cameras",),
}  # fmt: skip
OTHER_TYPES: dict[str, Any] = {"history_ns": np.int64, "seen_ns": np.int64, "settled_ns": np.int64}
"""Types of arrays that are not of float64."""
CAMERAS: dict[str, tuple[type[CameraEstimate] | type[CameraMonitor], tuple[str, ...]]] = {
    "estimates": (CameraEstimate, ("innovation", "sigma", "seen_ns")),
    "sightings": (
        CameraMonitor,
        ("frame_innovation", "frame_spread", "frame_seen", "frame_velocity", "frame_q"),
    ),
}
"""The records of each camera by the name of their field: the type of their numbers, and the arrays in which each camera
has a row.
"""
OBSERVATIONS = tuple(name for _, names in CAMERAS.values() for name in names)
"""These arrays are written out with the cameras, not with the block."""
SETTLED_FRAMES = ("settled_innovation", "settled_variance", "settled_count", "settled_ns")
"""Sums over frames, which are reset with a new model."""


def packed_type(
    numbers: type[ctypes.Structure],
    arrays: Shapes,
    others: Mapping[str, Any],
    parts: Mapping[str, type[ctypes.Structure]],
) -> np.dtype[Any]:
    """The type of a record of ``numbers`` and of the ``arrays`` in the size of the largest cell, of float64 or the
    types in ``others``, and of the ``parts`` of each camera.
    """
    fields: list[Any] = [(name, np.dtype(kind)) for name, kind, *_ in numbers._fields_]
    fields += [(name, np.dtype(kind), (MAX_CAMERAS,)) for name, kind in parts.items()]
    fields += [
        (name, others.get(name, np.float64), (math.prod(shape_of(shape, MOST)),)) for name, shape in arrays.items()
    ]
    return np.dtype(fields, align=True)


def shape_of(shape: tuple[str | int, ...], counts: Mapping[str, int]) -> tuple[int, ...]:
    """A shape with its names replaced by their counts."""
    return tuple(counts[side] if isinstance(side, str) else side for side in shape)


def views(record: np.ndarray[Any, Any], arrays: Shapes, counts: Mapping[str, int]) -> dict[str, Any]:
    """The arrays of a ``record`` (1,), each a view of its packed part."""
    found = {}
    for name, given in arrays.items():
        shape = shape_of(given, counts)
        found[name] = record[name][0, : math.prod(shape)].reshape(shape)
    return found


BLOCK = packed_type(Numbers, ARRAYS, OTHER_TYPES, {part: kind for part, (kind, _) in CAMERAS.items()})


class Block:
    """The remembered numbers; ``record`` (1,) of type `BLOCK` holds all of it, and is what kernels take.

    Joints: recent samples ``history_positions`` (k, n) at ``history_ns`` (k,), a ring buffer with ``history_count``
    entries ever written; ``velocities``, the last ``command`` and the ``correction`` that explains the innovations best
    (n,). Stamps of the last step and sample, and of the last sample processed by following-error monitoring,
    ``last_followed_ns``.

    Following: ``missing_travel`` (n,), recent commanded minus measured travel [rad or m], and ``untold_travel``,
    commanded since the last sample; ``last_positions`` (n,), valid if travel is ``followed``. While ``silence_known``:
    readings ``silent_from`` (n,) when each last changed, ``silent_travel`` commanded since, with its sign, less the
    travel that friction may hold back, and its duration ``silent_s``. ``delay_…``: the arrays of
    `monitor_state.DriveDelays`, after ``delay_steps`` steps.

    Friction, while a goal is active (see `core.move`): ``friction`` (n,) [rad/s or m/s], the velocity that is added for
    it; ``friction_from`` (n,): readings from which travel is compared; ``friction_sent`` (n,): commanded since [rad or
    m], in the time ``friction_s`` (n,). ``run``: progress of the active law.

    Loads (see `core.monitors.collision`): ``mean_efforts`` (n,), moving mean; ``effort_excess``, ``following_excess``
    (samples, n), newest last: excess of the last samples over the expected value; ``contact_low``, ``contact_high`` (2,
    n), of efforts and following errors: the range of loads during a collision, which they may leave again within the
    next ``leave_s`` of motion. ``efforts``, ``following_errors`` (n,) of the sample at ``loads_ns``, if it contains
    them.

    Cameras: ``round_due``: one camera has delivered two frames since the last round, so the round does not wait for the
    others. ``estimates`` and ``sightings``: one record a camera; a row of each of the arrays ``innovation`` (c, m, 2),
    ``sigma`` (c, m), ``seen_ns`` (c, m), and ``frame_…`` (c, k, …) of the newest frames belongs to it. Sums over the
    frames in which the error of the active law was inside its tolerance (see `core.sources.progress`): of their
    innovations, ``settled_innovation`` (c, m, 2), and variances, ``settled_variance`` (c, m) [px²], their number,
    ``settled_count`` (c, m), and the stamp of each camera's last one, ``settled_ns`` (c,).
    """

    record: np.ndarray[Any, Any]
    numbers: Numbers
    delays: DriveDelays
    history_ns: IntArray
    history_positions: FloatArray
    velocities: FloatArray
    command: FloatArray
    correction: FloatArray
    missing_travel: FloatArray
    untold_travel: FloatArray
    last_positions: FloatArray
    silent_from: FloatArray
    silent_travel: FloatArray
    silent_s: FloatArray
    delay_s: FloatArray
    delay_samples: FloatArray
    delay_onset: FloatArray
    delay_sent: FloatArray
    delay_past: FloatArray
    delay_velocity: FloatArray
    delay_under_way: FloatArray
    delay_accounted: FloatArray
    delay_missing: FloatArray
    friction: FloatArray
    friction_from: FloatArray
    friction_sent: FloatArray
    friction_s: FloatArray
    mean_efforts: FloatArray
    effort_excess: FloatArray
    following_excess: FloatArray
    contact_low: FloatArray
    contact_high: FloatArray
    efforts: FloatArray
    following_errors: FloatArray
    innovation: FloatArray
    sigma: FloatArray
    seen_ns: IntArray
    frame_innovation: FloatArray
    frame_spread: FloatArray
    frame_seen: FloatArray
    frame_velocity: FloatArray
    frame_q: FloatArray
    settled_innovation: FloatArray
    settled_variance: FloatArray
    settled_count: FloatArray
    settled_ns: IntArray
    estimates: list[CameraEstimate]
    sightings: list[CameraMonitor]

    def __init__(self, counts: Mapping[str, int]) -> None:
        """An empty block for a cell with these ``counts``. Raises ValueError."""
        for name, most in MOST.items():
            if not 0 <= counts[name] <= most:
                raise ValueError(f"{counts[name]} {name}; {most} are possible")
        keep = self.__dict__
        keep["record"] = np.zeros(1, BLOCK)
        keep["numbers"] = Numbers.from_buffer(self.record.view(np.uint8).data)
        self._count(counts)
        self.numbers.last_joints_seq = -1
        self.delay_samples[:] = np.nan
        self.begin_observations(counts["markers"], counts["rows"])

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{name} of the block is a view of its record: write into it")

    def _count(self, counts: Mapping[str, int]) -> None:
        for name in MOST:
            setattr(self.numbers, name, counts[name])
        self.__dict__.update(views(self.record, ARRAYS, counts))
        self.__dict__["delays"] = DriveDelays(
            self.delay_s, self.delay_samples, self.delay_onset, self.delay_sent, self.delay_past, self.delay_velocity,
            self.delay_under_way, self.delay_accounted, self.delay_missing,
        )  # fmt: skip
        for part in CAMERAS:
            self.__dict__[part] = [self._of_camera(c, part) for c in range(counts["cameras"])]

    def _of_camera(self, c: int, part: str) -> Any:
        """The record of one camera, with its rows of the arrays."""
        assert BLOCK.fields is not None
        kind, arrays = CAMERAS[part]
        at = BLOCK.fields[part][1] + c * ctypes.sizeof(kind)
        found = kind.from_buffer(self.record.view(np.uint8).data, at)
        vars(found).update({name.removeprefix("frame_"): getattr(self, name)[c] for name in arrays})
        return found

    def counts(self) -> dict[str, int]:
        """The cell's count for each name in `MOST`."""
        return {name: getattr(self.numbers, name) for name in MOST}

    def begin_observations(self, markers: int, rows: int) -> None:
        """Reset the cameras' estimates and frames for so many markers; ``rows`` includes the static points."""
        self._count({**self.counts(), "markers": markers, "rows": rows})
        for name in OBSERVATIONS:
            getattr(self, name)[:] = 0
        self.sigma[:] = 1.0
        for camera, frame in zip(self.estimates, self.sightings, strict=True):
            camera.count_as(NOTHING_KNOWN)
            frame.count_as(NOTHING_SEEN)

    def remember_steps(self, past: int) -> None:
        """Size the memory of past steps to so many steps, and reset it."""
        self._count({**self.counts(), "past": past})
        self.delay_past[:] = 0.0

    def kept(self) -> dict[str, Any]:
        """All values to be written out except the `OBSERVATIONS`, by name: numbers, then arrays."""
        return {
            **{name: getattr(self.numbers, name) for name, *_ in Numbers._fields_ if name != "run"},
            "run": self.numbers.run.kept(),
            **{name: getattr(self, name) for name in ARRAYS if name not in OBSERVATIONS},
        }


def restored(kept: Mapping[str, Any]) -> Block:
    """The block from the values ``kept`` written by `Block.kept`; values that are missing are initial ones. Raises
    ValueError or TypeError if ``kept`` is invalid.
    """
    counts = {"rows": 0, **{name: kept.get(name) for name in MOST if name != "rows" or name in kept}}
    if not all(isinstance(count, int) for count in counts.values()):
        raise ValueError(f"a block with counts {counts}")
    block = Block(counts)  # type: ignore[arg-type]
    for name, *_ in Numbers._fields_:
        if name == "run":
            for number in RunProgress.__annotations__.keys() & set(kept.get(name, ())):
                setattr(block.numbers.run, number, kept[name][number])
        elif name in kept:
            setattr(block.numbers, name, kept[name])
    for name in ARRAYS:
        if name not in kept:
            continue
        array, value = getattr(block, name), kept[name]
        if not isinstance(value, np.ndarray) or value.shape != array.shape or value.dtype != array.dtype:
            raise ValueError(f"{name} that is no {array.dtype} of shape {array.shape}")
        array[:] = value
    return block
