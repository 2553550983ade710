"""The thread that owns the CAN bus: receives, ticks the master on an absolute time grid, sends.

Before the cycle starts, and while faults are reset, it receives, passes frames to subscribers, and sends the master's
heartbeat. During the cycle heartbeats are sent only by the master's ticks: a hung thread is silent.
"""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.channel import Channel
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import Subscriptions
from stereoservo_drivers.canopen.master import Master, MasterFault

PUMP_WAIT_S = 0.002
HAND_OVER_S = 1.0
READS_A_PERIOD = 8
FIRST_READ = 2
"""Number of reads per period while answers are awaited; then one just before the tick. Waking for every frame costs
more than decoding it, and nothing is decided before the next tick. The interval of the reads is also the resolution of
arrival times. The first read that is worth a wake-up is the ``FIRST_READ``th.
"""
FOLLOW_EVERY_NS = 500_000_000


@dataclass
class ThreadStatistics:
    """Statistics. ``skipped``: slots of the grid that the thread missed. ``late_max_ns``: largest delay of a tick."""

    skipped: int = 0
    late_max_ns: int = 0


class BusThread(Subscriptions):
    """The bus thread, a :class:`~stereoservo_drivers.canopen.codec.Link` that can also run the master's cycle.

    It ends by itself when the connection is lost or an unexpected exception is raised in it: that fault is latched in
    the master, the heartbeat ends, and the drives stop because they monitor it. ``error`` holds the cause.
    """

    def __init__(self, channel: Channel, master: Master) -> None:
        super().__init__()
        self.error: DriverError | None = None
        self.statistics = ThreadStatistics()
        self._channel = channel
        self._master = master
        self._period_ns = round(1e9 / master.settings.rate_hz)
        self._read_every_ns = self._period_ns // READS_A_PERIOD
        self._send_lock = threading.Lock()
        self._cycle_requested = False
        self._cycling = False
        self._ending = False
        self._next_ns = 0
        self._first_read_ns = 0
        self._heartbeat_ns = 0
        self._follow_ns = 0
        self._thread = threading.Thread(target=self._run, name="can-bus", daemon=True)
        self._thread.start()

    # -- link -----------------------------------------------------------------------------------------------

    def send(self, frames: list[CanFrame]) -> None:
        """Send frames in order. Raises DriverError."""
        self._require()
        with self._send_lock:
            self._channel.send(frames)

    def wait(self, seconds: float) -> None:
        """Let the bus run for some time. Raises DriverError once it is lost."""
        self._require()
        time.sleep(seconds)
        self._require()

    def now_ns(self) -> int:
        """Monotonic time."""
        return time.monotonic_ns()

    # -- who owns it ----------------------------------------------------------------------------------------

    @property
    def alive(self) -> bool:
        """Whether the bus is being served."""
        return self._thread.is_alive() and self.error is None

    def begin_cycle(self) -> None:
        """Start ticking the master. Raises DriverError."""
        self._hand_over(True)

    def end_cycle(self) -> None:
        """Stop ticking the master; the bus is still served. Raises DriverError."""
        self._hand_over(False)

    def end(self) -> None:
        """End the thread and release the channel. Never raises."""
        self._ending = True
        self._thread.join()
        self._channel.close()

    def _require(self) -> None:
        if self.error is not None:
            raise self.error

    def _hand_over(self, cycle: bool) -> None:
        self._cycle_requested = cycle
        until = time.monotonic() + HAND_OVER_S
        while self._cycling is not cycle:
            self._require()
            if time.monotonic() > until:
                raise DriverError("bus_thread", f"the thread of the CAN bus did not follow within {HAND_OVER_S:g} s")
            time.sleep(0.0005)

    # -- the thread -----------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._ending:
                self._step()
        except DriverError as error:
            self._fail(error)
        except Exception as error:
            self._fail(_unforeseen(error))
            self._stop_blindly()

    def _fail(self, error: DriverError) -> None:
        self._master.latch(MasterFault(error.code, str(error), hint="reset connects again", t_ns=time.monotonic_ns()))
        self.error = error

    def _stop_blindly(self) -> None:
        """Send quick stop every cycle, without the heartbeat, the absence of which also stops the drives."""
        try:
            while not self._ending:
                with self._send_lock:
                    self._channel.send(self._master.codec.quick_stop())
                time.sleep(self._period_ns * 1e-9)
        except DriverError as error:
            self._fail(error)

    def _step(self) -> None:
        now = time.monotonic_ns()
        if self._cycle_requested is not self._cycling:
            self._cycling = self._cycle_requested
            self._next_ns = now
        if now >= self._follow_ns:
            self._follow_ns = now + FOLLOW_EVERY_NS
            follow_scheduling()
        if not self._cycling:
            self._pump(now)
            self._receive(PUMP_WAIT_S)
        elif now >= self._next_ns:
            if self._master.awaits_answers:  # frames that arrived while this thread was suspended are in time
                self._receive(0.0)
            self._tick(time.monotonic_ns())
        else:
            self._sleep_and_read(now)

    def _sleep_and_read(self, now: int) -> None:
        """Wait for the next slot; frames that have arrived when it starts belong to the cycle that ends there."""
        wake_ns = self._next_ns
        if self._master.awaits_answers:
            wake_ns = min(wake_ns, max(now + self._read_every_ns, self._first_read_ns))
        time.sleep((wake_ns - now) * 1e-9)
        self._receive(0.0)

    def _pump(self, now: int) -> None:
        if now - self._heartbeat_ns >= self._master.settings.heartbeat_ms * 1_000_000:
            self._heartbeat_ns = now
            frames = self._master.codec.heartbeat()
            if frames:
                with self._send_lock:
                    self._channel.send(frames)

    def _receive(self, timeout_s: float) -> None:
        for t_ns, frame in self._channel.receive(timeout_s):
            self._master.receive(frame, t_ns)
            if frame.extended:  # 29-bit identifiers belong to another protocol
                continue
            self.tell(frame)

    def _tick(self, now: int) -> None:
        self.statistics.late_max_ns = max(self.statistics.late_max_ns, now - self._next_ns)
        with self._send_lock:
            self._channel.send(self._master.tick(now))
        self._first_read_ns = now + FIRST_READ * self._read_every_ns
        self._next_ns, skipped = next_slot(self._next_ns, now, self._period_ns)
        self.statistics.skipped += skipped


def next_slot(slot_ns: int, now_ns: int, period_ns: int) -> tuple[int, int]:
    """Next slot of the grid to wait for, after that of ``slot_ns`` was served at ``now_ns``, and the number skipped.

    Missed slots are never repeated, and the drives have at least half a period to answer before the next poll.
    """
    following = slot_ns + period_ns
    behind = now_ns + period_ns // 2 - following
    skipped = -(-behind // period_ns) if behind > 0 else 0
    return following + skipped * period_ns, skipped


def follow_scheduling() -> None:
    """Give this thread a priority just above the main thread's if that is real-time; else leave it unchanged."""
    process = os.getpid()
    # The servo process sets this flag along with the policy, and the kernel reports both together.
    if os.sched_getscheduler(process) & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:
        return
    above = os.sched_getparam(process).sched_priority + 1
    priority = min(above, os.sched_get_priority_max(os.SCHED_FIFO))
    if os.sched_getscheduler(0) == os.SCHED_FIFO and os.sched_getparam(0).sched_priority == priority:
        return
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return  # RLIMIT_RTPRIO allows only the main thread's priority: this thread keeps its own


def _unforeseen(error: Exception) -> DriverError:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = f"{trace.tb_frame.f_code.co_name}, line {trace.tb_lineno}" if trace is not None else "?"
    return DriverError(
        "internal", f"the CAN master failed: {type(error).__name__}: {error} (in {where}); all axes are stopped"
    )
