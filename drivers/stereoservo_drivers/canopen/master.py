"""The cyclic CAN master, without I/O: time and frames in, frames out.

A tick closes the cycle that ends, checks it, and returns the frames of the next: poll, axes, heartbeat. The first fault
latches; from then on every tick sends target zero and quick stop to all axes, until ``clear``. Nothing here clears a
fault or enables by itself.

Threads: ``tick`` and ``receive`` belong to one; the rest may be called from another.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from enum import StrEnum

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointState
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import AxisFault, Codec
from stereoservo_drivers.canopen.odrive import RESOLUTION_TURNS
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_drivers.canopen.units import JointScale

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


# -- master ------------------------------------------------------------------------------------------


__all__ = ["ENABLE_LIMIT_S", "Master", "MasterFault", "MasterSettings", "MasterStatistics", "Mode"]

ENABLE_LIMIT_S = 1.5
STOP_MARGIN_S = 0.1
REST_SHARE = 0.01
"""Share of the largest velocity below which a joint that is commanded to zero counts as at rest."""
REST_CYCLES = 3
FRESH_CYCLES = 2
RESOLUTION_SAID = 1e-3
"""[rad/s or m/s] A larger change of a command by the wire's resolution is reported."""


@dataclass
class _Monitors:
    frames: FrameCounter
    lateness: LatenessMonitor
    flood: FloodMonitor
    jump: JumpMonitor
    reversal: ReversalMonitor


@dataclass
class _Cycle:
    """The current cycle; ``owed_ns``: the first poll since the last complete answer; its answers may belong to it."""

    poll_ns: int = 0
    owed_ns: int = 0
    answered_ns: int = 0
    received: int = 0
    open: bool = False
    states: list[JointState] = field(default_factory=list)


class Master:
    """Cyclic master over a ``codec``. ``fault``: the first one, None without one; ``later_faults``: the later ones."""

    def __init__(self, codec: Codec, settings: MasterSettings) -> None:
        self.codec = codec
        self.settings = settings
        self.fault: MasterFault | None = None
        self.later_faults: list[MasterFault] = []
        self.statistics = MasterStatistics()
        joints = settings.joints
        self._n = len(joints)
        self._period_s = 1.0 / settings.rate_hz
        self._period_ns = round(1e9 / settings.rate_hz)
        self._max_velocity = np.array([joint.max_velocity for joint in joints])
        self._acceleration = np.array([joint.max_acceleration for joint in joints])
        self._low = np.array([joint.position_min for joint in joints])
        self._high = np.array([joint.position_max for joint in joints])
        counts = settings.resolution_counts
        self._resolution = np.array([counts * JointScale.of(joint).resolution for joint in joints])
        self._zero = np.zeros(self._n)
        self.stop_limit_s = float(np.max(self._max_velocity / self._acceleration)) + STOP_MARGIN_S
        self._seq = 0
        self._restart()

    def _restart(self) -> None:
        codec, settings = self.codec, self.settings
        self._mode = Mode.OFF
        self._since_ns = 0
        self._request = ""
        self._command: tuple[FloatArray, int] = (self._zero, 0)
        self._called_ns = 0
        self._cycle = _Cycle()
        self._heartbeat_ns = 0
        self._rests = 0
        self._sample: JointState | None = None
        self._sent = self._zero
        self._monitors = _Monitors(
            frames=FrameCounter(codec.bit_name, settings.max_missed_cycles),
            lateness=LatenessMonitor(codec.bit_name, codec.bit_axis, self._period_ns),
            flood=FloodMonitor(settings.bitrate, self._period_s),
            jump=JumpMonitor(self._max_velocity, self._resolution),
            reversal=ReversalMonitor(self._acceleration, self._resolution, self._period_s),
        )

    # -- what others ask for --------------------------------------------------------------------------------

    @property
    def mode(self) -> Mode:
        """Current mode; LATCHED as long as there is a fault."""
        return self._mode if self.fault is None else Mode.LATCHED

    def set_command(self, velocities: FloatArray, now_ns: int) -> None:
        """Set the command (n,), sent from the next tick on while running. Counts as a call of the port."""
        self._command = (velocities.copy(), now_ns)
        self._called_ns = now_ns

    def port_called(self, now_ns: int) -> None:
        """Record that the port's user is alive."""
        self._called_ns = now_ns

    def request_enable(self, now_ns: int) -> None:
        """Enable all axes at velocity zero from the next tick on, unless a fault is latched."""
        self._command = (self._zero, 0)
        self._called_ns = now_ns
        self._request = "enable"

    def request_disable(self) -> None:
        """Bring to rest from the next tick on, then switch off."""
        self._request = "disable"

    def latch(self, fault: MasterFault) -> None:
        """Latch ``fault``: the first one; later ones are appended to ``later_faults`` (each code and axis once)."""
        if self.fault is None:
            self.fault = fault
            return
        known = {(f.code, f.axis) for f in (self.fault, *self.later_faults)}
        if (fault.code, fault.axis) not in known:
            self.later_faults.append(fault)

    def clear(self) -> None:
        """Clear the latched fault and all observations. The axes are off, and remain off until enabled.

        Call it while the cycle is not running. A drive that is still in fault latches again with the next answers.
        """
        self.codec.faults()  # events of the reset itself: a node that was commanded to boot has booted
        self._restart()
        self.later_faults = []
        self.fault = None

    def sample(self) -> JointState | None:
        """The newest complete set, stamped with its poll; None before the first."""
        return self._sample

    def at_rest(self) -> bool | None:
        """Whether all axes are at rest by the newest complete set; None if that is too old."""
        sample, poll_ns = self._sample, self._cycle.poll_ns
        if sample is None or poll_ns - sample.t_ns > FRESH_CYCLES * self._period_ns:
            return None
        return bool(np.all(np.abs(sample.velocities) <= REST_SHARE * self._max_velocity))

    def limited(self, velocities: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
        """The velocities that would be sent for a command (n,), and why they differ. Before the first sample: zero."""
        sample = self._sample
        if sample is None:
            return self._zero.copy(), ("no_position",)
        sent, reasons = limit_command(velocities, self._max_velocity, sample.positions, self._low, self._high)
        wire = self.codec.sendable(sent)
        if np.max(np.abs(wire - sent)) > RESOLUTION_SAID:
            reasons = (*reasons, "drive_resolution")
        return wire, reasons

    # -- the bus --------------------------------------------------------------------------------------------

    @property
    def awaits_answers(self) -> bool:
        """Whether replies to the newest poll are still missing."""
        return self._cycle.received != self.codec.expected

    def receive(self, frame: CanFrame, now_ns: int) -> bool:
        """Process a frame that arrived at ``now_ns``; returns whether it belongs to the cycle."""
        bit = self.codec.receive(frame)
        if bit < 0:
            self.statistics.foreign += 1
            if self._cycle.open:
                self._monitors.flood.note(frame.id)
            return False
        cycle = self._cycle
        if not cycle.open:
            return True
        self._monitors.frames.counts[bit] += 1
        self._monitors.lateness.arrivals[bit] = now_ns - cycle.poll_ns
        before = cycle.received
        cycle.received |= 1 << bit
        if cycle.received == self.codec.expected and before != cycle.received:
            self._complete(now_ns)
        return True

    def _complete(self, now_ns: int) -> None:
        feedback = self.codec.feedback
        poll_ns = self._cycle.poll_ns
        positions = feedback.positions.copy()
        velocities = feedback.velocities.copy()
        if math.isnan(velocities[0]):  # a complete set: either all drives send it or none
            last = self._sample
            if last is None:
                velocities = np.zeros(self._n)
            else:
                velocities = (positions - last.positions) / (max(poll_ns - last.t_ns, 1) * 1e-9)
        self._seq += 1
        sample = JointState(
            seq=self._seq,
            t_ns=poll_ns,
            positions=positions,
            velocities=velocities,
            efforts=None if feedback.efforts is None else feedback.efforts.copy(),
            following_errors=None if feedback.following_errors is None else feedback.following_errors.copy(),
        )
        self._sample = sample
        self._cycle.states.append(sample)
        self._cycle.answered_ns = now_ns
        self.statistics.answered_ns = now_ns - poll_ns
        self.statistics.answered_max_ns = max(self.statistics.answered_max_ns, now_ns - poll_ns)

    def tick(self, now_ns: int) -> list[CanFrame]:
        """End the current cycle and start the next; returns the frames to send now, in order."""
        complete = self._cycle.received == self.codec.expected
        if self._cycle.open:
            self._close(now_ns, complete)
        axes = self._axes(now_ns, complete)
        frames = [*self.codec.poll(), *axes]
        if self._heartbeat_due(now_ns):
            frames += self.codec.heartbeat()
        owed_ns = self._cycle.owed_ns if self._cycle.open and not complete else now_ns
        self._cycle = _Cycle(poll_ns=now_ns, owed_ns=owed_ns, open=True)
        return frames

    def _heartbeat_due(self, now_ns: int) -> bool:
        if not self._monitors.frames.within_allowed_misses:
            return False
        due = now_ns - self._heartbeat_ns >= self.settings.heartbeat_ms * 1_000_000 - self._period_ns // 2
        if due:
            self._heartbeat_ns = now_ns
            self.statistics.heartbeats += 1
        return due

    # -- verdict on a cycle ---------------------------------------------------------------------------------

    def _close(self, now_ns: int, complete: bool) -> None:
        statistics, monitors = self.statistics, self._monitors
        cycle_ns = now_ns - self._cycle.poll_ns
        statistics.cycles += 1
        statistics.complete += complete
        statistics.incomplete += not complete
        statistics.longest_cycle_ns = max(statistics.longest_cycle_ns, cycle_ns)
        monitors.frames.end_cycle()
        statistics.lost = monitors.frames.lost
        statistics.doubled = monitors.frames.doubled
        for fault in self.codec.faults():
            self.latch(self._from_axis(fault, now_ns))
        for trip in (
            monitors.flood.end_cycle(cycle_ns),  # before it makes the drives miss frames
            monitors.frames.verdict(self._period_s),
            monitors.lateness.end_cycle(monitors.frames.owing),
            *self._watch_encoders(cycle_ns),
        ):
            if trip is not None:
                self.latch(self._from_trip(trip, now_ns))
        self._watch_port(now_ns)

    def _watch_encoders(self, cycle_ns: int) -> list[Trip | None]:
        trips = []
        for sample in self._cycle.states:
            cycle = self._cycle
            trips.append(self._monitors.jump.check(cycle.owed_ns, cycle.answered_ns, sample.positions.tolist()))
            if self.mode is Mode.RUNNING:
                trips.append(self._monitors.reversal.check(cycle_ns * 1e-9, self._sent, sample.positions))
        return trips

    def _watch_port(self, now_ns: int) -> None:
        silent_ms = (now_ns - self._called_ns) * 1e-6
        limit_ms = self.settings.loop_timeout_ms
        if self.mode in (Mode.RUNNING, Mode.ENABLING) and silent_ms > limit_ms:
            self.latch(
                MasterFault(
                    "loop_hung",
                    f"the servo loop has not called the driver for {silent_ms:.0f} ms, limit {limit_ms}",
                    value=silent_ms,
                    limit=limit_ms,
                    hint="the servo process hangs or is starved of the processor",
                    t_ns=now_ns,
                )
            )

    def _from_axis(self, fault: AxisFault, now_ns: int) -> MasterFault:
        name = self.settings.joints[fault.axis].name if fault.axis >= 0 else ""
        message = fault.message if name in fault.message else f"joint {name!r}: {fault.message}"
        return MasterFault(fault.code, message, axis=name, value=fault.value, hint=fault.hint, t_ns=now_ns)

    def _from_trip(self, trip: Trip, now_ns: int) -> MasterFault:
        axis = self.codec.bit_axis[trip.bit] if trip.bit >= 0 else trip.axis
        name = self.settings.joints[axis].name if axis >= 0 else ""
        return MasterFault(
            trip.code,
            f"joint {name!r}: {trip.message}" if name else trip.message,
            axis=name,
            value=trip.value,
            limit=trip.limit,
            hint=trip.hint,
            t_ns=now_ns,
        )

    # -- modes ----------------------------------------------------------------------------------------------

    def _enter(self, mode: Mode, now_ns: int) -> None:
        self._mode = mode
        self._since_ns = now_ns
        self._rests = 0
        self._sent = self._zero
        self._monitors.reversal.restart()

    def _axes(self, now_ns: int, complete: bool) -> list[CanFrame]:
        request, self._request = self._request, ""
        if self.fault is None:
            self._follow(request, now_ns)
            self._advance(now_ns, complete)
        mode = self.mode
        if mode is Mode.LATCHED:
            self._mode = Mode.OFF
            return self.codec.quick_stop()
        if mode is Mode.ENABLING:
            return self.codec.enable()
        if mode is Mode.RUNNING:
            self._sent = self._wanted(now_ns)
            return self.codec.command(self._sent)
        if mode is Mode.STOPPING:
            return self.codec.command(self._zero)
        return self.codec.idle()

    def _follow(self, request: str, now_ns: int) -> None:
        if request == "enable" and self._mode is Mode.OFF:
            self._enter(Mode.ENABLING, now_ns)
        elif request == "disable" and self._mode is Mode.ENABLING:
            self._enter(Mode.OFF, now_ns)
        elif request == "disable" and self._mode is Mode.RUNNING:
            self._enter(Mode.STOPPING, now_ns)

    def _advance(self, now_ns: int, complete: bool) -> None:
        in_mode_s = (now_ns - self._since_ns) * 1e-9
        if self._mode is Mode.ENABLING:
            if complete and self.codec.enabled():
                self._enter(Mode.RUNNING, now_ns)
            elif in_mode_s > ENABLE_LIMIT_S:
                self.latch(self._states_fault("enable_timeout", in_mode_s, ENABLE_LIMIT_S, now_ns))
        elif self._mode is Mode.RUNNING:
            if complete and not self.codec.enabled():
                self.latch(self._states_fault("disabled", None, None, now_ns))
        elif self._mode is Mode.STOPPING:
            self._rests = self._rests + 1 if complete and self.at_rest() else 0
            if self._rests >= REST_CYCLES or in_mode_s > self.stop_limit_s:
                self._enter(Mode.OFF, now_ns)

    def _states_fault(self, code: str, value: float | None, limit: float | None, now_ns: int) -> MasterFault:
        states = zip(self.settings.joints, self.codec.status_words(), strict=True)
        words = ", ".join(f"{joint.name}: {state}" for joint, state in states)
        if value is None:
            message, hint = (f"a drive left its enabled state by itself: {words}", "look at the drive's own inputs")
        else:
            message = f"not all drives are enabled after {value:.2f} s, limit {limit:g}: {words}"
            hint = "is the power stage supplied, is the emergency stop released?"
        return MasterFault(code, message, value=value, limit=limit, hint=hint, t_ns=now_ns)

    def _wanted(self, now_ns: int) -> FloatArray:
        velocities, t_ns = self._command
        if now_ns - t_ns > self.settings.command_timeout_s * 1e9:
            return self._zero
        assert self._sample is not None  # running: there has been a complete cycle
        return limit_command(velocities, self._max_velocity, self._sample.positions, self._low, self._high)[0]


class Mode(StrEnum):
    """Modes of the master's commands to the axes."""

    OFF = "off"
    ENABLING = "enabling"
    RUNNING = "running"
    STOPPING = "stopping"
    LATCHED = "latched"


class MasterFault(msgspec.Struct, frozen=True):
    """The fault that ended motion. ``axis``: the joint's name, empty for the bus. ``value``, ``limit``: if there are
    any.
    """

    code: str
    message: str
    axis: str = ""
    value: float | None = None
    limit: float | None = None
    hint: str = ""
    t_ns: int = 0

    def text(self) -> str:
        """The fault as one sentence."""
        return self.message + (f": {self.hint}" if self.hint else "")


class MasterSettings(msgspec.Struct, frozen=True):
    """Settings of the master. ``resolution_counts``: smallest step of a position."""

    joints: tuple[CanJoint, ...]
    rate_hz: float
    bitrate: int
    heartbeat_ms: int
    max_missed_cycles: int
    command_timeout_s: float
    loop_timeout_ms: int
    resolution_counts: float = 1.0

    @classmethod
    def of(cls, options: CanOptions) -> MasterSettings:
        """The settings in ``options``."""
        return cls(
            joints=options.joint,
            rate_hz=options.rate_hz,
            bitrate=options.bitrate,
            heartbeat_ms=options.heartbeat_ms,
            max_missed_cycles=options.max_missed_cycles,
            command_timeout_s=options.command_timeout_s,
            loop_timeout_ms=options.loop_timeout_ms,
            resolution_counts=RESOLUTION_TURNS if options.protocol == "odrive" else 1.0,
        )


@dataclass
class MasterStatistics:
    """Statistics since the start. ``incomplete``: cycles that missed a frame. ``longest_cycle_ns``: between two ticks.

    ``answered_ns``: from the newest complete cycle's poll to its last frame; ``answered_max_ns``: the largest.
    """

    cycles: int = 0
    complete: int = 0
    incomplete: int = 0
    lost: int = 0
    doubled: int = 0
    foreign: int = 0
    heartbeats: int = 0
    longest_cycle_ns: int = 0
    answered_ns: int = 0
    answered_max_ns: int = 0


def limit_command(
    velocities: FloatArray,
    max_velocities: FloatArray,
    positions: FloatArray,
    position_min: FloatArray,
    position_max: FloatArray,
) -> tuple[FloatArray, tuple[str, ...]]:
    """Velocities (n,) within the drives' limits, and why they differ (``drive_velocity_limit``, ``position_limit``).

    Beyond a velocity limit all joints are scaled alike, so that the direction of motion is kept. A joint at or beyond a
    position limit may only move inward; the others continue. Joints of unknown position (NaN) do not move.
    """
    reasons: tuple[str, ...] = ()
    excess = float((np.abs(velocities) / max_velocities).max())
    if excess > 1.0:
        velocities = velocities / excess
        reasons = ("drive_velocity_limit",)
    above, below = positions > position_min, positions < position_max
    if (above & below).all():
        return velocities, reasons
    allowed = (above | (velocities >= 0.0)) & (below | (velocities <= 0.0)) & np.isfinite(positions)
    if (~allowed & (velocities != 0.0)).any():
        reasons = (*reasons, "position_limit")
    return np.where(allowed, velocities, 0.0), reasons
