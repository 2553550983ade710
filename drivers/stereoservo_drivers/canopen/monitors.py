"""Monitors of the CAN master: missed, doubled, late and foreign frames; encoder jumps; motion against the command.

Each monitor evaluates the data of a cycle and returns a :class:`Trip` or None. No clock, no I/O.
"""

from __future__ import annotations

import math
from collections import Counter, deque

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray

DOUBLES_IN_A_ROW = 3
"""A single duplicate may be a frame delayed by a busy bus; several in a row are two drives with one node id."""
OWED_CYCLES = 25
"""Cycles within which a missed frame may still arrive, in addition to its cycle's: no duplicate, but a delayed host or
adapter.
"""
LATE_WINDOW = 25
LATE_RANK = LATE_WINDOW // 5
LATE_BASELINES = 16
"""Number of evaluated windows without owed frames that determine the baseline."""
LATE_EVERY = 5
"""Interval of evaluations [cycles]; divides the window."""
LATE_SHARE = 0.35
"""Share of the period: a drive is late if it exceeds its own baseline by this, compared with the other drives. A
quarter, and a tenth for the resolution of arrival times, which is the interval of reads (an eighth of the period).
"""
LATE_SHARE_SINGLE = 0.5
"""The same for a single drive, which cannot be compared with others."""
FLOOD_WINDOW = 5
FLOOD_SHARE = 0.30
FLOOD_FRAME_BITS = 111
"""Length of a data frame of 8 bytes without stuffing (CiA 301, ISO 11898-1)."""
JUMP_FACTOR = 3.0
JUMP_COUNTS = 16.0
REVERSED_EVERY_S = 0.02
REVERSED_WINDOW_S = 0.06
REVERSED_FOR_S = 0.1
REVERSED_SHARE = 0.3
REVERSED_COUNTS = 8.0


class Trip(msgspec.Struct, frozen=True):
    """Reason of a monitor to end motion. ``bit`` or ``axis``: the faulty one, -1: none in particular."""

    code: str
    message: str
    value: float
    limit: float
    hint: str
    bit: int = -1
    axis: int = -1


class FrameCounter:
    """Counts the frames of every cycle, by bit: consecutive misses, consecutive duplicates."""

    def __init__(self, names: tuple[str, ...], max_missed: int) -> None:
        self._names = names
        self._max_missed = max_missed
        self.counts = [0] * len(names)
        """Frames of the current cycle, by bit, written by the receiver."""
        self._once = [1] * len(names)
        self._clean = False
        self._misses = [0] * len(names)
        self._doubles = [0] * len(names)
        self._owed = [0] * len(names)
        self._calm = 0
        self.owing = False
        """Whether a frame was missed that may still arrive."""
        self.lost = 0
        self.doubled = 0

    @property
    def within_allowed_misses(self) -> bool:
        """Whether no bit exceeds the tolerated number of misses."""
        return max(self._misses) <= self._max_missed

    def end_cycle(self) -> None:
        """Evaluate a poll's cycle."""
        every_one_once = self.counts == self._once
        if every_one_once and self._clean:
            self.counts[:] = [0] * len(self.counts)
            self._calm += 1
            if self._calm == OWED_CYCLES:
                self._owed = [0] * len(self._owed)
                self.owing = False
            return
        self._clean = every_one_once
        self._calm = 0
        for bit, count in enumerate(self.counts):
            if count == 1:
                self._misses[bit] = self._doubles[bit] = 0
            elif count == 0:
                self._misses[bit] += 1
                self._doubles[bit] = 0
                self._owed[bit] += 1
                self.lost += 1
            else:
                late = min(count - 1, self._owed[bit])
                self._owed[bit] -= late
                self._misses[bit] = 0
                self._doubles[bit] = self._doubles[bit] + 1 if count - 1 > late else 0
                self.doubled += count - 1
            self.counts[bit] = 0
        self.owing = any(self._owed)

    def verdict(self, period_s: float) -> Trip | None:
        """Trip of the last cycle, after ``end_cycle``."""
        if self._clean:
            return None
        return self._missing(period_s) or self._duplicate()

    def _missing(self, period_s: float) -> Trip | None:
        worst = max(self._misses)
        if worst <= self._max_missed:
            return None
        waited = f"{worst} cycles ({worst * period_s * 1e3:.0f} ms), limit {self._max_missed}"
        # If the bus became silent during a cycle, the frames answered before that have one miss less.
        if len(self._misses) > 1 and min(self._misses) >= self._max_missed:
            return Trip(
                "bus_silent",
                f"no drive answered for {waited}",
                worst,
                self._max_missed,
                "check the bus cable, its termination, the bitrate and the drives' logic supply",
            )
        bit = self._misses.index(worst)
        return Trip(
            "silent",
            f"no {self._names[bit]} for {waited}",
            worst,
            self._max_missed,
            "is the drive powered, is its cable in?",
            bit=bit,
        )

    def _duplicate(self) -> Trip | None:
        worst = max(self._doubles)
        if worst < DOUBLES_IN_A_ROW:
            return None
        bit = self._doubles.index(worst)
        return Trip(
            "duplicate",
            f"more than one {self._names[bit]} in each of {worst} consecutive cycles",
            worst,
            DOUBLES_IN_A_ROW,
            "two drives have the same node id: give one of them another",
            bit=bit,
        )


class LatenessMonitor:
    """Monitors the delay of frames after their poll against its baseline.

    A drive that is late by more than a cycle answers as often as one in time; only its phase shows it. Of the arrivals
    in ``LATE_WINDOW`` cycles the lower quintile is used: a late drive is late in nearly all cycles, a busy host in
    some. The baseline is the smallest such value of the first windows in which no frame was owed: after a miss an early
    frame may be the late one of the previous cycle. A delay common to all axes is caused by the host or the bus (a
    buffering adapter) and no reason to stop: it is subtracted.
    """

    def __init__(self, names: tuple[str, ...], bit_axis: tuple[int, ...], period_ns: int) -> None:
        self._names = names
        self._axes = np.array(bit_axis)
        self._period_ns = period_ns
        self._limit_ns = period_ns * (LATE_SHARE if len(set(bit_axis)) > 1 else LATE_SHARE_SINGLE)
        self._arrivals = np.zeros((LATE_WINDOW, len(names)))
        self.arrivals = [0] * len(names)
        """[ns] after the poll, by bit, written by the receiver; the last value is kept if a frame does not arrive."""
        self._newest: list[list[int]] = []
        self._cycles = 0
        self._baseline = np.full(len(names), math.inf)
        self._settled = 0
        self._looks = 0

    def end_cycle(self, owing: bool) -> Trip | None:
        """Evaluate every ``LATE_EVERY`` cycles, once there is a baseline. ``owing``: missed frames may still arrive."""
        self._settled = 0 if owing else self._settled + 1
        self._newest.append(self.arrivals.copy())
        self._cycles += 1
        if self._cycles % LATE_EVERY:
            return None
        first = (self._cycles - LATE_EVERY) % LATE_WINDOW
        self._arrivals[first : first + LATE_EVERY] = self._newest
        self._newest.clear()
        if self._cycles < LATE_WINDOW:
            return None
        usual = np.partition(self._arrivals, LATE_RANK, axis=0)[LATE_RANK]
        if self._looks < LATE_BASELINES and self._settled >= LATE_WINDOW:
            self._looks += 1
            np.minimum(self._baseline, usual, out=self._baseline)
        return self._judge(usual - self._baseline)

    def _judge(self, excess: FloatArray) -> Trip | None:
        worst = int(excess.argmax())
        if excess[worst] <= self._limit_ns:
            return None
        others = excess[self._axes != self._axes[worst]]
        alone = float(excess[worst]) - (max(float(others.min()), 0.0) if others.size else 0.0)
        if alone <= self._limit_ns:
            return None
        return Trip(
            "late",
            f"{self._names[worst]} comes {alone * 1e-6:.2f} ms later after its poll than it used to, against the other "
            f"drives, in four of five of {LATE_WINDOW} cycles; limit {self._limit_ns * 1e-6:.2f} ms",
            alone * 1e-6,
            self._limit_ns * 1e-6,
            "the drive is overloaded, or its frames wait behind others of higher priority",
            bit=worst,
        )


class FloodMonitor:
    """Monitors frames outside of the cycle: one id's share of the bus over the last ``FLOOD_WINDOW`` cycles.

    Counted by id, since after a stall of the host or the adapter the heartbeats and emergencies of all nodes arrive at
    once.
    """

    def __init__(self, bitrate: int, period_s: float) -> None:
        self._frames_per_ns = FLOOD_SHARE * bitrate / FLOOD_FRAME_BITS * 1e-9
        self._least = max(math.ceil(self._frames_per_ns * period_s * 1e9 * FLOOD_WINDOW), 4 * FLOOD_WINDOW)
        self._by_id: dict[int, int] = {}
        self._cycles: deque[tuple[int, dict[int, int]]] = deque([(0, {})] * FLOOD_WINDOW, FLOOD_WINDOW)
        self._heard = 0
        """Frames of all ids within the window."""

    def note(self, can_id: int) -> None:
        """Count a frame that does not belong to the cycle."""
        if can_id in self._by_id or len(self._by_id) < 256:
            self._by_id[can_id] = self._by_id.get(can_id, 0) + 1
            self._heard += 1

    def end_cycle(self, cycle_ns: int) -> Trip | None:
        """Evaluate every cycle, so that a flood is reported before the drives' own frames are missed."""
        forgotten = self._cycles[0][1]
        if forgotten:
            self._heard -= sum(forgotten.values())
        self._cycles.append((cycle_ns, self._by_id))
        self._by_id = {}
        if self._heard <= self._least:
            return None
        total: Counter[int] = Counter()
        for _, heard in self._cycles:
            total.update(heard)
        loudest, count = total.most_common(1)[0]
        elapsed_ns = sum(elapsed for elapsed, _ in self._cycles)
        limit = max(math.ceil(self._frames_per_ns * elapsed_ns), self._least)
        if count <= limit:
            return None
        return Trip(
            "bus_flood",
            f"{count} frames 0x{loudest:X} within {elapsed_ns * 1e-6:.0f} ms, limit {limit}; they are not part of the "
            "cycle",
            count,
            limit,
            f"find and silence the node that sends 0x{loudest:X}",
        )


class JumpMonitor:
    """Monitors position changes larger than the axis can move.

    An answer that arrived late, or was read late by a busy computer, counts in a later cycle than it was requested in.
    A set was therefore measured between the first unanswered poll and its arrival; the longest time between two sets is
    from the former of one to the latter of the next.
    """

    def __init__(self, max_velocities: FloatArray, resolutions: FloatArray) -> None:
        fastest = (JUMP_FACTOR * max_velocities).tolist()
        self._axes = list(zip(fastest, (JUMP_COUNTS * resolutions).tolist(), strict=True))
        self._positions: list[float] | None = None
        self._earliest_ns = 0

    def check(self, earliest_ns: int, latest_ns: int, positions: list[float]) -> Trip | None:
        """Check a complete set (n,) that was measured between two times. Of several axes that jump, the first is
        reported.
        """
        last, elapsed_s = self._positions, (latest_ns - self._earliest_ns) * 1e-9
        self._positions, self._earliest_ns = positions, earliest_ns
        if last is None:
            return None
        for axis, (fastest, margin) in enumerate(self._axes):
            moved, limit = abs(positions[axis] - last[axis]), fastest * elapsed_s + margin
            if not moved <= limit:
                return self._trip(axis, moved, limit, elapsed_s)
        return None

    def _trip(self, axis: int, moved: float, limit: float, elapsed_s: float) -> Trip:
        return Trip(
            "encoder_jump",
            f"position jumped by {moved:.6g} within at most {elapsed_s * 1e3:.1f} ms; at "
            f"{JUMP_FACTOR:g} times max_velocity it is {limit:.3g}",
            moved,
            limit,
            "check the encoder, its cable, and counts_per_rev and gear_ratio",
            axis=axis,
        )


class ReversalMonitor:
    """Monitors axes that move against their command.

    Compares over ``REVERSED_WINDOW_S`` the commanded travel, ramped at the joint's acceleration, with the measured one.
    Opposite signs for ``REVERSED_FOR_S`` trip: longer than any drive lags behind its ramp.
    """

    def __init__(self, accelerations: FloatArray, resolutions: FloatArray, period_s: float) -> None:
        self._accelerations = accelerations
        self._least = REVERSED_COUNTS * resolutions
        self._every = max(round(REVERSED_EVERY_S / period_s), 1)
        self._window = max(round(REVERSED_WINDOW_S / (self._every * period_s)), 2)
        self._need = max(round(REVERSED_FOR_S / (self._every * period_s)), 3)
        self.restart()

    def restart(self) -> None:
        """Restart, at rest."""
        n = self._accelerations.size
        self._velocities = np.zeros(n)
        self._asked = np.zeros(n)
        self._history: list[tuple[FloatArray, FloatArray]] = []
        self._runs = np.zeros(n, dtype=np.int64)
        self._cycles = 0
        self._dt_s = 0.0

    def check(self, dt_s: float, command: FloatArray, positions: FloatArray) -> Trip | None:
        """Check one cycle of ``dt_s``: sent velocities (n,), positions (n,). Evaluates every ``REVERSED_EVERY_S``."""
        self._cycles += 1
        self._dt_s += dt_s
        if self._cycles % self._every:
            return None
        step = self._accelerations * self._dt_s
        self._velocities = self._velocities + np.minimum(np.maximum(command - self._velocities, -step), step)
        self._asked = self._asked + self._velocities * self._dt_s
        self._dt_s = 0.0
        self._history.append((self._asked, positions))
        if len(self._history) <= self._window:
            return None
        asked_then, positions_then = self._history.pop(0)
        asked, moved = self._asked - asked_then, positions - positions_then
        against = (asked * moved < 0.0) & (np.abs(moved) > REVERSED_SHARE * np.abs(asked))
        against &= (np.abs(asked) > self._least) & (np.abs(moved) > self._least)
        self._runs = np.where(against, self._runs + 1, 0)
        axis = int(np.argmax(self._runs))
        if self._runs[axis] < self._need:
            return None
        return Trip(
            "encoder_reversed",
            f"moves against its command: asked to travel {asked[axis]:+.4g}, measured {moved[axis]:+.4g}",
            float(moved[axis]),
            float(asked[axis]),
            "encoder and motor count in opposite senses, or the axis is being pushed; "
            "check the encoder's polarity in the drive (direction in the cell file turns both alike)",
            axis=axis,
        )
