"""The master's computer in the emulated bus's virtual time: bring-up, cycle, and its failures; without threads or
clock.
"""

from __future__ import annotations

from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.bringup import Subscriptions
from stereoservo_drivers.canopen.master import Master, MasterFault
from stereoservo_sim.emulators.bus.bus_emulator import BusEmulator


class VirtualHost(Subscriptions):
    """A link for bring-up and, once ``begin_cycle`` was called, the master's ticks on an absolute grid.

    Frames are handed to the wire at the tick's time and reach the master when they end on the bus. ``velocities`` (n,)
    is what the servo loop writes each cycle, None: it makes no call of the port.
    ``cycling`` False: the thread of the cycle hangs, or is dead: it neither receives nor sends. What arrives meanwhile
    waits for it.
    """

    def __init__(self, emulator: BusEmulator, master: Master) -> None:
        super().__init__()
        self.emulator = emulator
        self.master = master
        self.t_ns = emulator.t_ns
        self.velocities: FloatArray | None = None
        self.cycling = True
        self.plugged = True
        self._period_ns = round(1e9 / master.settings.rate_hz)
        self._next_ns: int | None = None
        self._heartbeat_ns = self.t_ns
        self._waiting: list[tuple[int, CanFrame]] = []
        emulator.on_adapter = self._adapter

    # -- link -----------------------------------------------------------------------------------------------

    def send(self, frames: list[CanFrame]) -> None:
        """Queue frames on the wire now."""
        for frame in frames:
            self.emulator.inject(frame, self.t_ns)

    def wait(self, seconds: float) -> None:
        """Let the bus run for some time."""
        self.run_until(self.t_ns + round(seconds * 1e9))

    def now_ns(self) -> int:
        """Virtual time."""
        return self.t_ns

    # -- cycle ----------------------------------------------------------------------------------------------

    def begin_cycle(self) -> None:
        """Start ticking the master."""
        self.master.clear()
        self._next_ns = self.t_ns

    def resume_cycle(self) -> None:
        """Tick again after a failed reset: latched faults stay."""
        self._next_ns = self.t_ns

    def end_cycle(self) -> None:
        """Stop ticking, for a reset; the bus is still served."""
        self._next_ns = None
        self._heartbeat_ns = self.t_ns

    def run_until(self, t_ns: int) -> None:
        """Run bus and host up to ``t_ns``, included."""
        while (due := self._due_ns()) <= t_ns:
            self._advance(due)
            self._act()
        self._advance(t_ns)

    def _due_ns(self) -> int:
        return self._heartbeat_ns if self._next_ns is None else self._next_ns

    def _advance(self, t_ns: int) -> None:
        self.emulator.run_until(t_ns)
        self.t_ns = t_ns
        self._waiting += self.emulator.delivered() if self.plugged else []
        if not self.cycling:
            return
        arrived, self._waiting = self._waiting, []
        for when_ns, frame in arrived:
            self.master.receive(frame, when_ns)
            self.tell(frame)

    def _act(self) -> None:
        """Execute what is due at ``t_ns``: a heartbeat between the cycles, else a tick."""
        if self._next_ns is None:
            self._heartbeat_ns = self.t_ns + self.master.settings.heartbeat_ms * 1_000_000
            self.send(self.master.codec.heartbeat())
            return
        self._next_ns += self._period_ns
        if not (self.cycling and self.plugged):
            return
        if self.velocities is not None:
            self.master.set_command(self.velocities, self.t_ns)
        self.send(self.master.tick(self.t_ns))

    def _adapter(self, plugged: bool) -> None:
        """Handle an exception of the channel like the bus thread: latch, and end."""
        self.plugged = plugged
        if not plugged:
            self.master.latch(
                MasterFault("connection_lost", "the adapter was unplugged", t_ns=self.emulator.t_ns)
            )
