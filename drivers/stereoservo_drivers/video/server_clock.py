"""The clock of a camera's server on another host: its offset and drift, estimated with their uncertainty from stamps of
its pictures, and refused if they are not known well enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereoservo.numerics.arrays import FloatArray

BIN_NS, BINS = 1_000_000_000, 60
"""Interval in which the picture with the shortest delay is stored, and number of stored intervals."""
LEAST_BINS = 5
WORST_DRIFT = 5e-4
"""Largest relative drift of valid clocks: a quartz has 1e-4 at most."""
EARLY_NS, LATE_NS, DEVIATIONS = 1_000_000, 1_000_000, 8.0
"""If a picture arrives earlier than its stamp allows by this, and by so many deviations, its clock was set; the same
holds if the fastest of the last `RECENT` pictures is later by this.
"""
RECENT, OF_RECENT, OF_ONE = 10, 3.0, 20.0
"""Numbers of mean delays by which the fastest recent picture, and a single one, may be late: beyond it, its stamp is
not used.
"""
LATE_S = 3.0
"""Time [s] during which all pictures are late before the clock counts as set back, or the transmission as slower."""
LATEST_NS = 1 << 62
"""Largest stamp: the year 2116."""
HELD_NS = 15_000_000_000
"""Time [ns] without use of stamps after such a change, until the transmission is known again."""


@dataclass(frozen=True)
class ClockEstimate:
    """Estimate of a server's clock. ``offset_ns``: this computer's time minus the server's, at the server's ``at_ns``;
    ``drift``: its change, s/s; ``deviation_ns``: its standard deviation; ``known``: whether it may be used, else
    ``reason`` is the cause.
    """

    offset_ns: int
    drift: float
    deviation_ns: float
    at_ns: int
    known: bool
    reason: str = ""

    @property
    def told(self) -> tuple[bool, str]:
        """Whether the clock is known, and a description."""
        if not self.known:
            return False, self.reason
        return True, (
            f"offset {1e-9 * self.offset_ns:.4f} s, drift {1e6 * self.drift:.1f} ppm, "
            f"deviation {1e-6 * self.deviation_ns:.2f} ms"
        )


UNKNOWN = ClockEstimate(0, 0.0, math.inf, 0, False, "no picture has carried a stamp")


class ServerClock:
    """Estimates a server's clock from the lower envelope of reception minus stamp: a straight line below all pictures,
    through those with the shortest delay (Moon, Skelly and Towsley 1999).

    The shortest delay is not zero. It is bounded by the server's shortest response time: half of that is subtracted,
    and a uniform distribution over all of it, for unequal delays in the two directions, is part of the deviation.
    ``limit_s``: deviation above which the clock is not known.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_ns = 1e9 * limit_s
        self._round_trip_ns = math.inf
        self._bins: list[tuple[int, int, int]] = []
        self._recent: list[float] = []
        self._mean_ns = 0.0
        self._late_ns: int | None = None
        self._late_one = False
        self._held_until_ns: int | None = None
        self._line: tuple[int, float, float, float] | None = None
        self.jumps = 0
        self.estimate = UNKNOWN

    def round_trip(self, duration_ns: int) -> None:
        """Add a response time of the server, from the request to the answer [ns]."""
        self._round_trip_ns = min(self._round_trip_ns, max(duration_ns, 0))

    def see(self, sent_ns: int, received_ns: int) -> ClockEstimate:
        """The clock after a picture that was stamped ``sent_ns`` by the server and began to arrive at ``received_ns``
        of this computer; `received_ns` never goes back."""
        delay_ns = received_ns - sent_ns
        self._late_one = False
        if self._line is not None:
            self._watch(sent_ns, received_ns, delay_ns)
        number = received_ns // BIN_NS
        if self._late_ns is None:
            if not self._bins or self._bins[-1][0] != number:
                self._bins = [*self._bins[-(BINS - 1) :], (number, sent_ns, delay_ns)]
                self._fit()
            elif delay_ns < self._bins[-1][2]:
                self._bins[-1] = (number, sent_ns, delay_ns)
                self._fit()
        self.estimate = self._told(sent_ns, received_ns)
        return self.estimate

    def stamp(self, sent_ns: int, received_ns: int) -> int | None:
        """This computer's time [ns] of the server's stamp, never after ``received_ns``; None if it is unknown."""
        found = self.see(sent_ns, received_ns)
        return min(sent_ns + found.offset_ns, received_ns) if found.known else None

    def _watch(self, sent_ns: int, received_ns: int, delay_ns: int) -> None:
        """Restart if the clock was set, and detect late pictures."""
        assert self._line is not None
        middle_ns, level, slope, spread = self._line
        off_ns = delay_ns - (level + slope * (sent_ns - middle_ns))
        if len(self._bins) < LEAST_BINS:
            return
        if off_ns < -max(EARLY_NS, DEVIATIONS * spread):  # nothing arrives before it is sent
            self._begin(received_ns, held=False)
            return
        self._recent = [*self._recent[-(RECENT - 1) :], off_ns]
        least_ns = max(LATE_NS, DEVIATIONS * spread)
        self._late_one = off_ns > max(least_ns, OF_ONE * self._mean_ns)
        if min(self._recent) <= max(least_ns, OF_RECENT * self._mean_ns) or len(self._recent) < RECENT:
            self._late_ns = None
            if not self._late_one:
                self._mean_ns += (off_ns - self._mean_ns) / 50.0
        elif self._late_ns is None:
            self._late_ns = received_ns
        elif received_ns - self._late_ns > 1e9 * LATE_S:
            self._begin(received_ns, held=True)

    def _begin(self, now_ns: int, *, held: bool) -> None:
        self._bins, self._line, self._late_ns, self._recent = [], None, None, []
        self.jumps += 1
        self._held_until_ns = now_ns + HELD_NS if held else None

    def _fit(self) -> None:
        """Fit the line below all stored pictures with the least mean distance, and their rms distance above it."""
        if len(self._bins) < 2:
            self._line = None
            return
        times = np.array([sent for _, sent, _ in self._bins], dtype=np.int64)
        delays = np.array([delay for _, _, delay in self._bins], dtype=np.int64)
        middle, least = int(times.mean()), int(delays.min())
        x, y = (times - middle).astype(np.float64), (delays - least).astype(np.float64)
        level, slope = envelope(x, y)
        above = y - level - slope * x
        self._line = middle, least + level, slope, float(np.sqrt(np.mean(above**2)))

    def _told(self, sent_ns: int, received_ns: int) -> ClockEstimate:
        if self._line is None or len(self._bins) < LEAST_BINS:
            return ClockEstimate(
                0,
                0.0,
                math.inf,
                sent_ns,
                False,
                f"{len(self._bins)} s of pictures with stamps; {LEAST_BINS} s are needed",
            )
        middle_ns, level, slope, spread = self._line
        bound_ns = self._round_trip_ns
        offset = level + slope * (sent_ns - middle_ns) - (0.5 * bound_ns if math.isfinite(bound_ns) else 0.0)
        span_ns = max(self._bins[-1][1] - self._bins[0][1], 1)
        # A line through the fastest of n similar ones is off by their spread at most, more if it is extrapolated.
        carried = 1.0 + 2.0 * abs(sent_ns - middle_ns) / span_ns
        deviation = math.hypot(bound_ns / math.sqrt(12.0), carried * spread)
        reason = ""
        if not math.isfinite(bound_ns):
            reason = "no answer of the server was timed, so that nothing bounds how long its pictures take"
        elif abs(slope) > WORST_DRIFT:
            reason = f"its clock drifts by {1e6 * slope:.0f} ppm, at most {1e6 * WORST_DRIFT:.0f} are a clock's"
        elif self._held_until_ns is not None and received_ns < self._held_until_ns:
            reason = "all its pictures came later at once: its clock was set, or the way has become longer"
        elif self._late_ns is not None or self._late_one:
            reason = "its pictures come later than its clock tells: it was set, or something holds them up"
        elif deviation > self._limit_ns:
            reason = f"its deviation is {1e-6 * deviation:.2f} ms, the limit {1e-6 * self._limit_ns:.2f} ms"
        return ClockEstimate(round(offset), slope, deviation, sent_ns, not reason, reason)


def envelope(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Level at 0 and slope of the line below all points (n,), n >= 2, ``x`` ascending, with the least mean distance
    from them: the edge of the lower convex hull at their mean.
    """
    hull: list[int] = []
    for k in range(len(x)):
        while len(hull) >= 2 and _turns_down(x, y, hull[-2], hull[-1], k):
            hull.pop()
        hull.append(k)
    middle = float(x.mean())
    at = next((j for j in range(1, len(hull)) if x[hull[j]] >= middle), len(hull) - 1)
    a, b = hull[max(at - 1, 0)], hull[at]
    slope = float((y[b] - y[a]) / (x[b] - x[a])) if x[b] > x[a] else 0.0
    return float(y[a] - slope * x[a]), slope


def _turns_down(x: FloatArray, y: FloatArray, a: int, b: int, c: int) -> bool:
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))


def seconds_in(text: str | None) -> int | None:
    """Nanoseconds of a header such as ``1700000000.123456``; None if it is not a number, or out of range."""
    if text is None or len(text) > 40:
        return None
    whole, _, part = text.strip().partition(".")
    digits = (part + "000000000")[:9]
    if not (whole.isascii() and whole.isdigit() and digits.isascii() and digits.isdigit()):
        return None
    found_ns = int(whole) * 1_000_000_000 + int(digits)
    return found_ns if found_ns < LATEST_NS else None
