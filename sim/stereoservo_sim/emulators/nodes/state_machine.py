"""The power state machine of CiA 402-2 (IEC 61800-7-201): states, commands, transitions 0 to 16, option codes.

It decides; ``drive_motion.py`` does what it asks for (power, brake, ramps) and says when that is done.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, IntEnum, StrEnum


class Cia402State(StrEnum):
    """States by their names in the standard."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


class Command(Enum):
    """Commands of the control word's bits 0 to 3."""

    SHUTDOWN = 1
    SWITCH_ON = 2
    DISABLE_VOLTAGE = 3
    QUICK_STOP = 4
    ENABLE = 5


class Ramp(IntEnum):
    """Stop reactions: the common meaning of option codes 0 to 4."""

    COAST = 0
    SLOW_DOWN = 1
    QUICK = 2
    CURRENT_LIMIT = 3
    VOLTAGE_LIMIT = 4


STATUS = {
    Cia402State.NOT_READY: 0x00, Cia402State.SWITCH_ON_DISABLED: 0x40, Cia402State.READY: 0x21,
    Cia402State.SWITCHED_ON: 0x23, Cia402State.ENABLED: 0x27, Cia402State.QUICK_STOP: 0x07,
    Cia402State.FAULT_REACTION: 0x0F, Cia402State.FAULT: 0x08,
}  # fmt: skip
"""Bits 0 to 3, 5 and 6 of the status word (0x6041)."""
FAULT_RESET = 0x80
HALT = 0x100

QUICK_STOP_OPTION = 0x605A
SHUTDOWN_OPTION = 0x605B
DISABLE_OPTION = 0x605C
HALT_OPTION = 0x605D
FAULT_OPTION = 0x605E
ABORT_OPTION = 0x6007


def command(word: int) -> Command | None:
    """The command in a control word; none where bit 7 is set."""
    if word & FAULT_RESET:
        return None
    if not word & 0x02:
        return Command.DISABLE_VOLTAGE
    if not word & 0x04:
        return Command.QUICK_STOP
    if not word & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE if word & 0x08 else Command.SWITCH_ON


class PowerMachine:
    """State of the power drive system.

    ``option(index)``: the drive's option codes. ``clear_faults()``: a fault reset is asked for; whether it succeeds.
    ``ramp``: how the drive is to come to rest, None while nothing asks for it; ``after``: the state that follows once
    it stands and the brake is closed, None: it stays, held by torque. ``opening``: power is on and the brake opens,
    before ENABLED (transition 4 is complete when the drive can move).

    A command that changes the state is carried out before the next (IEC 61800-7-201): one that comes while the drive
    slows down for transition 5 or 8 waits, the newest counts; disable voltage and quick stop do not wait. Transition
    16 needs a new command: a master that keeps sending "enable" does not undo a quick stop that the drive began.
    """

    def __init__(self, option: Callable[[int], int], clear_faults: Callable[[], bool]) -> None:
        self._option = option
        self._clear_faults = clear_faults
        self.power_on()

    def power_on(self) -> None:
        """Transition 0, power on."""
        self.word = 0
        self._enter(Cia402State.NOT_READY)

    def ready(self) -> None:
        """Transition 1: the self-test is done."""
        if self.state is Cia402State.NOT_READY:
            self._enter(Cia402State.SWITCH_ON_DISABLED)

    @property
    def powered(self) -> bool:
        """Whether the power stage is on."""
        return self.opening or self.state in (
            Cia402State.ENABLED,
            Cia402State.QUICK_STOP,
            Cia402State.FAULT_REACTION,
        )

    @property
    def halted(self) -> bool:
        """Whether halt (bit 8) keeps an enabled drive at rest."""
        return bool(self.word & HALT)

    def control(self, word: int) -> None:
        """Process a control word."""
        edge = bool(word & FAULT_RESET) and not self.word & FAULT_RESET
        before = command(self.word)
        self.word = word
        if self.state is Cia402State.FAULT:
            if edge and self._clear_faults():
                self._enter(Cia402State.SWITCH_ON_DISABLED)  # 15
            return
        given = command(word)
        if given is None:
            return
        if self.state is Cia402State.ENABLED and self.after is not None:
            self._waiting = given not in (Command.DISABLE_VOLTAGE, Command.QUICK_STOP)
            if self._waiting:
                return
        self._obey(given, new=given is not before)

    def fault(self) -> None:
        """Transition 13, from any state; 14 at once where no power stage must be brought to rest."""
        if self.state in (Cia402State.FAULT_REACTION, Cia402State.FAULT):
            return
        moving = self.state in (Cia402State.ENABLED, Cia402State.QUICK_STOP)
        self._enter(Cia402State.FAULT_REACTION)
        if moving:
            self._stop(Ramp(self._option(FAULT_OPTION)), Cia402State.FAULT)
        else:
            self._enter(Cia402State.FAULT)

    def connection_aborted(self) -> bool:
        """Reaction of 0x6007 to a lost connection; returns whether the caller must report a fault instead."""
        option = self._option(ABORT_OPTION)
        if option == 2:
            self._obey(Command.DISABLE_VOLTAGE, new=True)
        elif option == 3:
            self._obey(Command.QUICK_STOP, new=True)
        return option == 1

    def opened(self) -> None:
        """Complete transition 4: the brake is open."""
        if self.opening:
            self._enter(Cia402State.ENABLED)

    def rested(self) -> None:
        """Complete a stop: the drive is at rest and its brake is closed."""
        if self.after is None:
            return
        waiting = self._waiting
        self._enter(self.after)  # 5, 8, 12 or 14
        given = command(self.word)
        if waiting and given is not None:
            self._obey(given, new=True)

    def _settle(self) -> None:
        self.ramp: Ramp | None = None
        self.after: Cia402State | None = None
        self.opening = False

    def _enter(self, state: Cia402State) -> None:
        self.state = state
        self._waiting = False
        self._settle()

    def _stop(self, ramp: Ramp, after: Cia402State | None) -> None:
        self._settle()
        if ramp is Ramp.COAST:
            self._enter(after if after is not None else Cia402State.SWITCH_ON_DISABLED)
            return
        self.ramp, self.after = ramp, after

    def _obey(self, given: Command, *, new: bool) -> None:
        state = self.state
        if state is Cia402State.SWITCH_ON_DISABLED:
            if given is Command.SHUTDOWN:
                self._enter(Cia402State.READY)  # 2
        elif state is Cia402State.READY:
            if given in (Command.DISABLE_VOLTAGE, Command.QUICK_STOP):
                self._enter(Cia402State.SWITCH_ON_DISABLED)  # 7
            elif given in (Command.SWITCH_ON, Command.ENABLE):
                self._enter(Cia402State.SWITCHED_ON)  # 3
                self.opening = given is Command.ENABLE
        elif state is Cia402State.SWITCHED_ON:
            if given in (Command.DISABLE_VOLTAGE, Command.QUICK_STOP):
                self._enter(Cia402State.SWITCH_ON_DISABLED)  # 10
            elif given is Command.SHUTDOWN:
                self._enter(Cia402State.READY)  # 6
            else:
                self.opening = given is Command.ENABLE  # 4, or given up before the brake was open
        elif state is Cia402State.ENABLED:
            self._obey_enabled(given)
        elif state is Cia402State.QUICK_STOP:
            if given is Command.DISABLE_VOLTAGE:
                self._enter(Cia402State.SWITCH_ON_DISABLED)  # 12
            elif given is Command.ENABLE and new and self.after is None:
                self._enter(Cia402State.ENABLED)  # 16

    def _obey_enabled(self, given: Command) -> None:
        if given is Command.DISABLE_VOLTAGE:
            self._enter(Cia402State.SWITCH_ON_DISABLED)  # 9
        elif given is Command.QUICK_STOP:
            self._enter(Cia402State.QUICK_STOP)  # 11
            option = self._option(QUICK_STOP_OPTION)
            self._stop(
                Ramp(option - 4 if option > 4 else option),
                None if option > 4 else Cia402State.SWITCH_ON_DISABLED,
            )
        elif given is Command.SHUTDOWN:
            self._stop(Ramp(self._option(SHUTDOWN_OPTION)), Cia402State.READY)  # 8
        elif given is Command.SWITCH_ON:
            self._stop(Ramp(self._option(DISABLE_OPTION)), Cia402State.SWITCHED_ON)  # 5
