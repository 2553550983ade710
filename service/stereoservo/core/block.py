"""The numbers that the stages of a step remember from one step to the next, as one flat record of fixed size, the same
for cells of any size: compiled kernels take it as one argument, of one type.

The record has room for the largest cell. An array of ``(rows, n)`` values lies packed at the start of its field, so
that a kernel has it as ``record.field[: rows * n].reshape((rows, n))``, and Python as an attribute of `Block`: a view
of the same memory. Attributes that are arrays are written in place; assigning one raises AttributeError, for it would
part it from the record.
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
"""Time constant of the filtered joint velocities."""
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
    "rows": MAX_MARKERS,
    "window": MAX_WINDOW,
    "past": steps_of_delay(MAX_RATE_HZ),
}
"""Counts of the largest cell: ``rows`` of a frame, markers of the model and static points; ``window`` samples of
the watch on contact; steps of the ``past``.
"""


class RunProgress(Kept):
    """How the law at work has got on since its goal began.

    ``moved_s``: how long it has been allowed to move. ``newest_px``: the largest error over markers and cameras, where
    one was ``measured`` in the last step; ``held``: frames that it has been inside its tolerance, the last ones being
    counted when the cameras had ``last_frames`` in all. ``first_px``: the largest so far; ``mean_px`` of late;
    ``least_px``: the smallest such mean, improved for the last time after ``least_s`` of motion.
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
    """The numbers at the head of a record: the counts, and what is no array. Read and written like attributes."""

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
"""Of arrays that are not of float64."""
CAMERAS: dict[str, tuple[type[CameraEstimate] | type[CameraMonitor], tuple[str, ...]]] = {
    "estimates": (CameraEstimate, ("innovation", "sigma", "seen_ns")),
    "sightings": (
        CameraMonitor,
        ("frame_innovation", "frame_spread", "frame_seen", "frame_velocity", "frame_q"),
    ),
}
"""Of each camera, by name of their field: what has numbers there, and the arrays of which it has a row."""
SIGHTS = tuple(name for _, names in CAMERAS.values() for name in names)
"""These arrays are written out with the cameras, and not with the block."""
SETTLED_FRAMES = ("settled_innovation", "settled_variance", "settled_count", "settled_ns")
"""Sums over frames, which begin anew with another model."""


def packed_type(
    numbers: type[ctypes.Structure], arrays: Shapes, others: Mapping[str, Any],
    parts: Mapping[str, type[ctypes.Structure]],
) -> np.dtype[Any]:  # fmt: skip
    """The type of a record of ``numbers`` and room for the ``arrays`` of the largest cell, of float64 or ``others``,
    and for the ``parts`` of each camera.
    """
    fields: list[Any] = [(name, np.dtype(kind)) for name, kind, *_ in numbers._fields_]
    fields += [(name, np.dtype(kind), (MAX_CAMERAS,)) for name, kind in parts.items()]
    fields += [
        (name, others.get(name, np.float64), (math.prod(shape_of(shape, MOST)),))
        for name, shape in arrays.items()
    ]
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


BLOCK = packed_type(Numbers, ARRAYS, OTHER_TYPES, {part: kind for part, (kind, _) in CAMERAS.items()})


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

    Friction, while something works on a goal (see `core.move`): ``friction`` (n,) [rad/s or m/s], the velocity that is
    added for it; ``friction_from`` (n,): readings from which travel is compared; ``friction_sent`` (n,): commanded
    since [rad or m], in the time ``friction_s`` (n,). ``run``: how the law at work gets on.

    Loads (see `core.monitors.collision`): ``mean_efforts`` (n,), moving mean; ``effort_excess``, ``following_excess``
    (samples, n), newest last: how far the last samples lay beyond what is expected; ``contact_low``, ``contact_high``
    (2, n), of efforts and following errors: what a contact has brought, and what it may take away again in the next
    ``leave_s`` of motion. ``efforts``, ``following_errors`` (n,) of the sample at ``loads_ns``, where it tells
    them.

    Cameras: ``round_due``: one has given two frames since the last round, the others are not waited for; ``estimates``
    and ``sightings``, one each, of which ``innovation`` (c, m, 2), ``sigma`` (c, m), ``seen_ns`` (c, m), and
    ``frame_…`` (c, k, …) for the newest frames, have the arrays, a row a camera. Of the frames in which the error of
    the law at work has been inside its tolerance (see `core.sources.progress`): the sums of their innovations,
    ``settled_innovation`` (c, m, 2), and variances, ``settled_variance`` (c, m) [px²], how many they are,
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
        """Nothing known, in a cell with these ``counts``. Raises ValueError."""
        for name, most in MOST.items():
            if not 0 <= counts[name] <= most:
                raise ValueError(f"{counts[name]} {name}; {most} are possible")
        keep = self.__dict__
        keep["record"] = np.zeros(1, BLOCK)
        keep["numbers"] = Numbers.from_buffer(self.record.view(np.uint8).data)
        self._count(counts)
        self.numbers.last_joints_seq = -1
        self.delay_samples[:] = np.nan
        self.begin_sights(counts["markers"], counts["rows"])

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
        """What lies in the record of one camera, with its rows of the arrays."""
        assert BLOCK.fields is not None
        kind, arrays = CAMERAS[part]
        at = BLOCK.fields[part][1] + c * ctypes.sizeof(kind)
        found = kind.from_buffer(self.record.view(np.uint8).data, at)
        vars(found).update({name.removeprefix("frame_"): getattr(self, name)[c] for name in arrays})
        return found

    def counts(self) -> dict[str, int]:
        """Of each of `MOST`, how many the cell has."""
        return {name: getattr(self.numbers, name) for name in MOST}

    def begin_sights(self, markers: int, rows: int) -> None:
        """Cameras that have seen nothing yet of so many markers, ``rows`` with the static points."""
        self._count({**self.counts(), "markers": markers, "rows": rows})
        for name in SIGHTS:
            getattr(self, name)[:] = 0
        self.sigma[:] = 1.0
        for camera, frame in zip(self.estimates, self.sightings, strict=True):
            camera.count_as(NOTHING_KNOWN)
            frame.count_as(NOTHING_SEEN)

    def remember_steps(self, past: int) -> None:
        """Room for so many steps of the past, of which nothing is known."""
        self._count({**self.counts(), "past": past})
        self.delay_past[:] = 0.0

    def kept(self) -> dict[str, Any]:
        """All that is to be written out but the `SIGHTS`, by name: numbers, then arrays."""
        return {
            **{name: getattr(self.numbers, name) for name, *_ in Numbers._fields_ if name != "run"},
            "run": self.numbers.run.kept(),
            **{name: getattr(self, name) for name in ARRAYS if name not in SIGHTS},
        }


def restored(kept: Mapping[str, Any]) -> Block:
    """The block of which `Block.kept` wrote ``kept``; what it does not name is as in the beginning. Raises ValueError,
    TypeError where it is none.
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
