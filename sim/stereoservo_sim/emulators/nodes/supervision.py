"""Monitoring by an emulated node: heartbeats of others and the SYNC period; its own heartbeat (CiA 301)."""

from __future__ import annotations

from stereoservo_sim.emulators.nodes.dictionary import Abort, Dictionary, SdoError
from stereoservo_sim.emulators.nodes.node import NEVER_NS

CONSUMER, PRODUCER, SYNC_ID, SYNC_PERIOD = 0x1016, 0x1017, 0x1005, 0x1006
GUARD_TIME, LIFE_FACTOR = 0x100C, 0x100D
TOGGLE = 0x80


class HeartbeatConsumer:
    """Monitors the nodes of 0x1016, each from its first heartbeat on, also after a loss (7.2.8.2.2)."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._subs = [sub for index, sub in dictionary.entries if index == CONSUMER and sub]
        self._deadlines: dict[int, int] = {}
        dictionary.guard(CONSUMER, self._check)
        dictionary.changed(CONSUMER, lambda sub, value: self.reset())

    def _check(self, sub: int, value: int) -> None:
        node, time = value >> 16, value & 0xFFFF
        if node > 0x7F:
            raise SdoError(Abort.INVALID_VALUE)
        if node and time and any(s != sub and self._entry(s)[0] == node for s in self._subs):
            raise SdoError(Abort.INCOMPATIBLE)

    def _entry(self, sub: int) -> tuple[int, int]:
        value = self._dictionary.get(CONSUMER, sub)
        node, time = value >> 16, value & 0xFFFF
        return (node, time) if node and time else (0, 0)

    def reset(self) -> None:
        """Wait for first heartbeats again."""
        self._deadlines.clear()

    def heard(self, node: int, t_ns: int) -> bool:
        """Process a heartbeat; returns whether its node is monitored."""
        for sub in self._subs:
            watched, time = self._entry(sub)
            if watched == node:
                self._deadlines[node] = t_ns + time * 1_000_000
                return True
        return False

    def lost(self, t_ns: int) -> list[int]:
        """Nodes whose heartbeat is overdue, each reported once."""
        nodes = [node for node, deadline in self._deadlines.items() if t_ns >= deadline]
        for node in nodes:
            del self._deadlines[node]
        return nodes

    def due_ns(self) -> int:
        """Time at which the next heartbeat is overdue."""
        return min(self._deadlines.values(), default=NEVER_NS)


class LifeGuard:
    """Node guarding (CiA 301, 7.2.8.2.1): answers remote frames, and monitors that they come within 0x100C times 0x100D
    from the first one on. A node that produces heartbeats does not.
    """

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._toggle = 0
        self._deadline_ns = NEVER_NS
        for index in (GUARD_TIME, LIFE_FACTOR):
            dictionary.changed(index, lambda sub, value: self.reset())

    def reset(self) -> None:
        """Wait for a first remote frame again."""
        self._toggle = 0
        self._deadline_ns = NEVER_NS

    def asked(self, state: int, t_ns: int) -> bytes | None:
        """Answer to a remote frame: the NMT state with a toggling bit; None where heartbeats are produced."""
        if self._dictionary.get(PRODUCER):
            return None
        life_ms = self._dictionary.get(GUARD_TIME) * self._dictionary.get(LIFE_FACTOR)
        self._deadline_ns = t_ns + life_ms * 1_000_000 if life_ms else NEVER_NS
        answer = bytes([state | self._toggle])
        self._toggle ^= TOGGLE
        return answer

    def lost(self, t_ns: int) -> bool:
        """Whether the next remote frame is overdue; reported once."""
        if t_ns < self._deadline_ns:
            return False
        self._deadline_ns = NEVER_NS
        return True

    def due_ns(self) -> int:
        """Time at which the next remote frame is overdue."""
        return self._deadline_ns


class HeartbeatProducer:
    """Produces heartbeats with the period 0x1017 [ms]; 0: none."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._next_ns = NEVER_NS
        self.now_ns = 0
        dictionary.changed(PRODUCER, lambda sub, value: self.restart(self.now_ns))

    def restart(self, t_ns: int) -> None:
        """Restart; the first heartbeat is due after one period."""
        period = self._dictionary.get(PRODUCER)
        self._next_ns = t_ns + period * 1_000_000 if period else NEVER_NS

    def silence(self) -> None:
        """Stop until ``restart``."""
        self._next_ns = NEVER_NS

    def tick(self, t_ns: int) -> bool:
        """Whether a heartbeat is to be sent now; missed ones are not sent later."""
        if t_ns < self._next_ns:
            return False
        period_ns = self._dictionary.get(PRODUCER) * 1_000_000
        self._next_ns += (1 + (t_ns - self._next_ns) // period_ns) * period_ns
        return True

    def due_ns(self) -> int:
        """Time of the next heartbeat."""
        return self._next_ns


class SyncWatch:
    """Monitors SYNC with the period 0x1006 [us]: a loss is reported once after ``factor`` periods, from the first
    SYNC on.

    ``can_id``: of SYNC, from 0x1005.
    """

    def __init__(self, dictionary: Dictionary, factor: float) -> None:
        self._dictionary = dictionary
        self._factor = factor
        self._deadline_ns = NEVER_NS
        self.reset()
        dictionary.changed(SYNC_PERIOD, lambda sub, value: self.reset())
        dictionary.changed(SYNC_ID, lambda sub, value: self._listen())

    def _listen(self) -> None:
        self.can_id = self._dictionary.get(SYNC_ID, 0, 0x80) & 0x7FF

    def reset(self) -> None:
        """Wait for a first SYNC again."""
        self._listen()
        self._deadline_ns = NEVER_NS

    def heard(self, t_ns: int) -> None:
        """Process a SYNC."""
        period_ns = self._dictionary.get(SYNC_PERIOD) * 1000
        self._deadline_ns = t_ns + round(self._factor * period_ns) if period_ns else NEVER_NS

    def lost(self, t_ns: int) -> bool:
        """Whether SYNC is overdue."""
        if t_ns < self._deadline_ns:
            return False
        self._deadline_ns = NEVER_NS
        return True

    def due_ns(self) -> int:
        """Time at which SYNC is overdue."""
        return self._deadline_ns
