"""Motion of an emulated CiA 402 drive: power stage, brake and ramps, and its measured values.

Units: positions in counts, velocities in the drive's velocity units, accelerations in velocity units per second.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, IntEnum, StrEnum

from stereoservo_drivers.canopen.options import CanJoint
from stereoservo_sim.emulators.nodes.communication import Dictionary
from stereoservo_sim.emulators.nodes.node import NEVER_NS, EmulatedAxis, NodeSettings
from stereoservo_sim.world.velocity_drives import REST_VELOCITY

# -- the state machine ---------------------------------------------------------------------------------------
# The power state machine of CiA 402-2 (IEC 61800-7-201): states, commands, transitions 0 to 16, option codes.
#
# It decides; ``drive_motion.py`` executes its requests (power, brake, ramps) and reports their completion.


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
    Cia402State.NOT_READY: 0x00,
    Cia402State.SWITCH_ON_DISABLED: 0x40,
    Cia402State.READY: 0x21,
    Cia402State.SWITCHED_ON: 0x23,
    Cia402State.ENABLED: 0x27,
    Cia402State.QUICK_STOP: 0x07,
    Cia402State.FAULT_REACTION: 0x0F,
    Cia402State.FAULT: 0x08,
}
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
    """The command in a control word; none if bit 7 is set."""
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

    ``option(index)``: the drive's option codes. ``clear_faults()``: called for a fault reset; returns whether it
    succeeds.
    ``ramp``: how the drive is to come to rest, None without a request; ``after``: the state that follows once it is at
    rest and the brake is closed, None: it stays, held by torque. ``opening``: power is on and the brake opens, before
    ENABLED (transition 4 is complete when the drive can move).

    A command that changes the state is completed before the next (IEC 61800-7-201): one that arrives while the drive
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
        return self.opening or self.state in (Cia402State.ENABLED, Cia402State.QUICK_STOP, Cia402State.FAULT_REACTION)

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
        """Transition 13, from any state; 14 at once if no power stage must be brought to rest."""
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
                self.opening = given is Command.ENABLE  # 4, or abandoned before the brake was open
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
                Ramp(option - 4 if option > 4 else option), None if option > 4 else Cia402State.SWITCH_ON_DISABLED
            )
        elif given is Command.SHUTDOWN:
            self._stop(Ramp(self._option(SHUTDOWN_OPTION)), Cia402State.READY)  # 8
        elif given is Command.SWITCH_ON:
            self._stop(Ramp(self._option(DISABLE_OPTION)), Cia402State.SWITCHED_ON)  # 5


PROFILE_POSITION, PROFILE_VELOCITY, CYCLIC_VELOCITY = 1, 3, 9
NEW_SET_POINT = 0x0010
"""New set-point bit of the control word in profile position."""
FOLLOWING_ERROR = 0x8611
REACHED_SHARE = 0.01
"""Velocity window of "target reached" as a share of the largest velocity; the EDS has no 0x606D."""
STANDING_UNITS = 1
"""Speed up to which bit 12 of profile velocity reports zero speed (0x606F) [velocity units]."""
PARAMETERS = (HALT_OPTION, 0x6065, 0x6066, 0x607D, 0x607F, 0x6080, 0x6083, 0x6084, 0x6085)
LIMIT_FACTOR = 2.0
"""Deceleration at the current limit, as a multiple of the quick stop deceleration."""


def wrap32(value: int) -> int:
    """``value`` wrapped to 32 bits, as by a counter that overflows."""
    return (value + 2**31) % 2**32 - 2**31


def clamp16(value: int) -> int:
    """``value`` clamped to 16 bits."""
    return max(-(2**15), min(2**15 - 1, value))


class Brake:
    """A holding brake with a delay."""

    def __init__(self, travel_ns: int) -> None:
        self._travel_ns = travel_ns
        self.closed = True
        self._wanted = True
        self._due_ns = NEVER_NS

    def move(self, closed: bool, t_ns: int) -> None:
        """Open or close it; repeated requests have no effect."""
        if closed is not self._wanted:
            self._wanted = closed
            self._due_ns = t_ns + self._travel_ns
        if t_ns >= self._due_ns:
            self.closed = self._wanted
            self._due_ns = NEVER_NS

    def due_ns(self) -> int:
        """Time at which the motion ends."""
        return self._due_ns


class DriveMotion:
    """Moves one axis by the power state machine and the objects; computes the measured objects."""

    def __init__(
        self, axis: EmulatedAxis, joint: CanJoint, dictionary: Dictionary, machine: PowerMachine, settings: NodeSettings
    ) -> None:
        self.axis = axis
        self.machine = machine
        self.warning = False
        self._dictionary = dictionary
        self._settings = settings
        turns = joint.gear_ratio / (1.0 if joint.kind == "prismatic" else 2.0 * math.pi)
        self._direction = joint.direction
        self._counts = joint.direction * joint.counts_per_rev * turns
        self._units = joint.direction * (joint.velocity_units_per_rev_s or joint.counts_per_rev) * turns
        self._offset = joint.offset_rad
        self._brake = Brake(round(settings.brake_ms * 1e6))
        self._mirror: float | None = None
        self._limited = False
        self._following = False
        self._goal: float | None = None
        self._acknowledged = False
        self._beyond_since_ns = NEVER_NS
        for index in PARAMETERS:
            dictionary.changed(index, lambda sub, value: self.load_parameters())
        self.load_parameters()

    def load_parameters(self) -> None:
        """Read limits and ramps from the dictionary."""
        get = self._dictionary.get
        speeding_up, slowing_down, quick = (self._acceleration(index) for index in (0x6083, 0x6084, 0x6085))
        limit = LIMIT_FACTOR * quick
        self._speeding_up, self._slowing_down = speeding_up, slowing_down
        self._ramps = {Ramp.SLOW_DOWN: slowing_down, Ramp.QUICK: quick, Ramp.CURRENT_LIMIT: limit}
        self._ramps[Ramp.VOLTAGE_LIMIT] = limit
        self._halt = Ramp(get(HALT_OPTION, 0, 1))
        self._largest = min(get(0x607F, 0, 2**32 - 1), get(0x6080, 0, 2**32 - 1))
        low, high = get(0x607D, 1), get(0x607D, 2)
        self._low = low if -(2**31) < low < high else None
        self._high = high if low < high < 2**31 - 1 else None
        self._window = get(0x6065, 0, abs(round(self._counts * self._settings.following_window)))
        self._window_ns = get(0x6066) * 1_000_000

    def _acceleration(self, index: int) -> float:
        """Acceleration [rad/s² or m/s²]."""
        value = self._dictionary.get(index)
        return value / abs(self._units) if value else self.axis.joint.acceleration_max

    # -- measured values -------------------------------------------------------------------------------------------

    def _measured(self) -> float:
        """Joint position reported by the encoder: mirrored about the position at which an injected reversal began."""
        axis = self.axis
        if not axis.inverted_encoder:
            self._mirror = None
            return axis.position
        if self._mirror is None:
            self._mirror = axis.position
        return 2.0 * self._mirror - axis.position

    def position(self) -> int:
        """Position, 0x6064."""
        return wrap32(round(self._counts * (self._measured() + self._offset)))

    def velocity(self) -> int:
        """Velocity, 0x606C."""
        velocity = -self.axis.velocity if self.axis.inverted_encoder else self.axis.velocity
        return wrap32(round(self._units * velocity))

    def velocity_demand(self) -> int:
        """Velocity demand, 0x606B."""
        return wrap32(round(self._units * self.axis.set_velocity))

    def torque(self) -> int:
        """0x6077 [permille of the rated torque], in the motor's direction."""
        return clamp16(round(1000.0 * self._direction * self.axis.effort))

    def _error(self) -> float:
        return self.axis.set_position - self._measured() if self.machine.powered else 0.0

    def following_error(self) -> int:
        """0x60F4 [counts]: demanded minus measured position."""
        return max(-(2**31), min(2**31 - 1, round(self._counts * self._error())))

    def digital_inputs(self) -> int:
        """0x60FD: bits 0 and 1 are the limit switches of the motor's negative and positive side."""
        side = self.axis.limit_switch * self._direction
        return (side < 0) | (side > 0) << 1

    def status(self) -> int:
        """Status word 0x6041. Bit 12 in mode 9: the drive follows the command; in mode 3: speed is zero; in mode 1: the
        set-point is accepted. Bit 10 in modes 1 and 3: target reached.
        """
        machine = self.machine
        word = STATUS[machine.state] | 0x10 | 0x200
        if self.warning and machine.state not in (Cia402State.FAULT, Cia402State.FAULT_REACTION):
            word |= 0x80
        if self._limited or self.axis.limit_switch:
            word |= 0x800
        mode = self._dictionary.get(0x6061)
        standing = abs(self.velocity()) <= STANDING_UNITS
        if mode == CYCLIC_VELOCITY and self._following:
            word |= 0x1000
        if mode == PROFILE_VELOCITY:
            word |= 0x1000 * standing | 0x400 * self._reached(standing)
        if mode == PROFILE_POSITION:
            word |= 0x1000 * self._acknowledged | 0x400 * (standing and self._goal is None)
        return word

    def _reached(self, standing: bool) -> bool:
        if self.machine.state is not Cia402State.ENABLED:
            return False
        if self.machine.halted:
            return standing
        target = self._dictionary.get(0x60FF)
        return abs(self.velocity() - target) <= max(REACHED_SHARE * self._largest, STANDING_UNITS)

    # -- actions ---------------------------------------------------------------------------------------------------

    def power_lost(self, t_ns: int) -> None:
        """Reset after loss of the supply or a reboot of the firmware."""
        self.load_parameters()
        self._limited = self._following = self._acknowledged = False
        self._goal = None
        self._beyond_since_ns = NEVER_NS
        self._brake.move(True, t_ns)  # the brake closes without power
        self._rest()

    def _rest(self) -> None:
        axis = self.axis
        self._goal = None
        axis.powered = False
        axis.target = 0.0
        axis.brake_closed = self._brake.closed

    def step(self, t_ns: int) -> bool:
        """Advance axis, brake and state machine to ``t_ns``; returns whether the following error has exceeded its
        limit.
        """
        for _ in range(len(Cia402State)):
            state = self.machine.state
            self._act(t_ns)
            if self.machine.state is state:
                break
        self.axis.brake_closed = self._brake.closed
        return self._off_course(t_ns)

    def _act(self, t_ns: int) -> None:
        machine, axis = self.machine, self.axis
        self._following = self._limited = False
        if not machine.powered:
            self._brake.move(True, t_ns)
            self._rest()
            return
        axis.powered = True
        standing = abs(axis.set_velocity) <= REST_VELOCITY
        if machine.after is not None and standing:
            axis.target = 0.0
            self._brake.move(True, t_ns)
            if self._brake.closed:
                machine.rested()
            return
        self._brake.move(False, t_ns)
        if machine.opening:
            axis.target = 0.0
            if not self._brake.closed:
                machine.opened()
        elif machine.state is not Cia402State.ENABLED or machine.ramp is not None:
            self._brake_with(machine.ramp or Ramp.QUICK)
        elif machine.halted:
            self._brake_with(self._halt)
        else:
            self._follow()

    def _brake_with(self, ramp: Ramp) -> None:
        self.axis.target = 0.0
        self.axis.acceleration = self._ramps[ramp]

    def _follow(self) -> None:
        """Enabled: follow the target velocity within the drive's limits, with ramps of 0x6083 and 0x6084.

        In cyclic synchronous velocity the standard leaves ramps to the master; this drive, like many, limits the
        acceleration by 0x6083 there, in both directions.
        """
        axis, get = self.axis, self._dictionary.get
        mode = get(0x6061)
        if mode == PROFILE_POSITION:
            self._go()
            return
        wanted = get(0x60FF) if mode in (PROFILE_VELOCITY, CYCLIC_VELOCITY) else 0
        allowed = max(-self._largest, min(self._largest, wanted))
        target = allowed / self._units
        slower = abs(target) < abs(axis.set_velocity) or target * axis.set_velocity < 0.0
        acceleration = self._slowing_down if slower and mode == PROFILE_VELOCITY else self._speeding_up
        stopped = target != 0.0 and self._barred(math.copysign(1.0, target))
        if stopped:
            self._brake_with(Ramp.QUICK)
        else:
            axis.target, axis.acceleration = target, acceleration
        self._limited = stopped or allowed != wanted
        self._following = mode == CYCLIC_VELOCITY and not stopped

    def take_set_point(self) -> None:
        """Profile position: the rising edge of the control word's bit 4 accepts 0x607A at once; the falling edge clears
        bit 12.
        """
        asked = bool(self.machine.word & NEW_SET_POINT) and self.machine.state is Cia402State.ENABLED
        if asked and not self._acknowledged:
            self._goal = self._dictionary.get(0x607A) / self._counts - self._offset
        self._acknowledged = asked

    def _go(self) -> None:
        """Profile position: move to the set-point, no faster than the ramp can stop there."""
        axis = self.axis
        axis.acceleration = self._speeding_up
        axis.target = 0.0
        if self._goal is None:
            return
        gap = self._goal - axis.set_position
        tick_s = self._settings.tick_ns * 1e-9
        if abs(gap) * abs(self._counts) < 1.0 and abs(axis.set_velocity) <= self._speeding_up * tick_s:
            self._goal = None
            return
        fastest = min(self._dictionary.get(0x6081), self._largest) / abs(self._units)
        braking = math.sqrt(2.0 * 0.8 * self._speeding_up * abs(gap))
        axis.target = math.copysign(min(fastest, braking, abs(gap) / (2.0 * tick_s)), gap)

    def _barred(self, side: float) -> bool:
        """Whether a limit switch or a software limit (0x607D) prevents motion to ``side`` of the joint.

        Software limits act early enough for the quick stop ramp to end there; the whole range of 32 bits means no
        limit.
        """
        axis = self.axis
        if axis.limit_switch * side > 0:
            return True
        outward = self._counts * side > 0
        limit = self._high if outward else self._low
        if limit is None:
            return False
        braking = max(axis.set_velocity * side, 0.0) ** 2 / (2.0 * self._ramps[Ramp.QUICK])
        rest = self._counts * (self._measured() + side * braking + self._offset)
        return rest >= limit if outward else rest <= limit

    def _off_course(self, t_ns: int) -> bool:
        if not self.machine.powered:
            self._beyond_since_ns = NEVER_NS
            return False
        beyond = self._window != 2**32 - 1 and abs(self.following_error()) > self._window
        if not beyond:
            self._beyond_since_ns = NEVER_NS
            return False
        self._beyond_since_ns = min(self._beyond_since_ns, t_ns)
        return t_ns - self._beyond_since_ns >= self._window_ns

    def due_ns(self, t_ns: int) -> int:
        """Time at which ``step`` is next needed."""
        tick = t_ns + self._settings.tick_ns if self.machine.powered else NEVER_NS
        return min(tick, self._brake.due_ns())
