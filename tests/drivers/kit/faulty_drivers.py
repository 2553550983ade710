"""A small correct driver of a simulated device, and what people get wrong in theirs: one fault each."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import msgspec
import numpy as np

from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.ports.devices import (
    CommandReport,
    DriverError,
    JointDriverDescription,
    JointSpec,
    JointState,
)
from stereoservo_drivers.kit.auxiliary import AuxiliaryMotion
from stereoservo_drivers.kit.bench import JointDriverSetup
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState

CREATED, CONFIGURED, ACTIVE, CLOSED = LifecycleState
AUXILIARY = (AuxiliarySpec("gripper", "prismatic", 0.0, 0.08, 0.1), AuxiliarySpec("valve", "digital"))
LOW, HIGH, FASTEST, TIMEOUT_S, STEP = np.full(2, -1.0), np.full(2, 1.0), np.full(2, 1.0), 0.1, 1e-4


class Device:
    """Two axes that follow velocities at once, for 0.1 s after the last one (``forever``: without end)."""

    def __init__(self, clock: Any, forever: bool = False) -> None:
        self.clock, self.forever = clock, forever
        self.positions, self.velocities = np.zeros(2), np.zeros(2)
        self.now_ns = self.until_ns = clock.now_ns()
        self.writes = 0
        self.gone = self.broken = False

    def exchange(self, velocities: Any = None) -> None:
        if self.gone:
            raise OSError("unplugged")
        now_ns = self.clock.now_ns()
        moving_ns = now_ns - self.now_ns if self.forever else max(0, min(now_ns, self.until_ns) - self.now_ns)
        self.positions = self.positions + self.velocities * moving_ns * 1e-9
        if now_ns >= self.until_ns and not self.forever:
            self.velocities = np.zeros(2)
        self.now_ns = now_ns
        if velocities is not None:
            self.writes += 1
            self.velocities, self.until_ns = velocities, now_ns + round(TIMEOUT_S * 1e9)


class Driver:
    """The correct one. Faults override its small methods."""

    forever = False
    resolution = STEP

    def __init__(self, options: Any, context: Any) -> None:
        self.context = context
        self.life = DriverLifecycle("joint driver 'small'")
        self.device: Device | None = None
        self.reads = self.writes = 0
        self.beside = AuxiliaryMotion(AUXILIARY)

    def describe(self) -> JointDriverDescription:
        joints = tuple(JointSpec(name, "revolute", -1.0, 1.0, 1.0, 100.0, self.resolution) for name in ("a", "b"))
        return JointDriverDescription("small", joints, 250.0, "clock", TIMEOUT_S, 500.0, auxiliary=AUXILIARY)

    def configure(self) -> None:
        self.life.require("configure()", CREATED, CONFIGURED)
        self.device = self.device or Device(self.context.clock, self.forever)
        self.life.state = CONFIGURED

    def activate(self) -> None:
        self.life.require("activate()", CONFIGURED)
        self.life.state = ACTIVE

    def read_state(self) -> JointState:
        self.life.require("read_state()", CONFIGURED, ACTIVE)
        assert self.device is not None
        self.exchange()
        self.reads += 1
        positions = np.round(self.device.positions / STEP) * STEP
        return JointState(
            self.number(), self.stamp(), self.told(positions), self.told_speeds(self.device.velocities.copy())
        )

    def write_velocity(self, qd: Any) -> CommandReport:
        self.life.require("write_velocity()", ACTIVE)
        assert self.device is not None
        asked = np.array(qd, dtype=np.float64)
        self.verify(asked)
        sent = self.limited(np.clip(asked, -FASTEST, FASTEST))
        self.exchange(self.sent(sent))
        self.writes += 1
        reasons = ("limit",) if (sent != asked).any() else ()
        return CommandReport(self.writes, self.context.clock.now_ns(), asked, sent, reasons)

    def write_auxiliary(self, values: Any) -> None:
        self.life.require("write_auxiliary()", ACTIVE)
        self.beside.order(values, self.context.clock.now_ns())

    def read_auxiliary(self) -> dict[str, float]:
        return self.beside.values(self.context.clock.now_ns())

    def stop_auxiliary(self) -> None:
        self.beside.stop(self.context.clock.now_ns())

    def stop(self) -> None:
        self.stop_auxiliary()
        try:
            if self.device is not None and self.life.state in (CONFIGURED, ACTIVE):
                self.exchange(np.zeros(2))
        except DriverError:
            self.lost = True

    def deactivate(self) -> None:
        if self.life.state is ACTIVE:
            self.stop()
            self.life.state = CONFIGURED

    def close(self) -> None:
        self.deactivate()
        self.life.state = CLOSED

    def exchange(self, velocities: Any = None) -> None:
        assert self.device is not None
        try:
            self.device.exchange(velocities)
        except OSError as error:
            raise DriverError("connection_lost", str(error)) from error
        self.look()

    def look(self) -> None:
        assert self.device is not None
        if self.device.broken:
            raise DriverError("protective_stop", "the device stands in a protective stop; release it")

    def number(self) -> int:
        return self.reads

    def stamp(self) -> int:
        return self.context.clock.now_ns()

    def told(self, positions: Any) -> Any:
        return positions

    def told_speeds(self, velocities: Any) -> Any:
        return velocities

    def sent(self, velocities: Any) -> Any:
        return velocities

    def verify(self, asked: Any) -> None:
        if asked.shape != (2,) or not np.isfinite(asked).all():
            raise DriverError("command", f"two finite velocities are needed, not {asked.tolist()}")

    def limited(self, velocities: Any) -> Any:
        assert self.device is not None
        outward = ((self.device.positions >= HIGH) & (velocities > 0.0)) | (
            (self.device.positions <= LOW) & (velocities < 0.0)
        )
        return np.where(outward, 0.0, velocities)


class StaleStamps(Driver):
    def stamp(self) -> int:
        return self.context.clock.now_ns() - 300_000_000


class FrozenStamps(Driver):
    def stamp(self) -> int:
        self.first = getattr(self, "first", self.context.clock.now_ns())
        return self.first


class SequenceGoesBack(Driver):
    def number(self) -> int:
        return self.reads % 8


class IgnoredStop(Driver):
    forever = True

    def stop(self) -> None:
        return


class RaisingStop(Driver):
    def stop(self) -> None:
        self.exchange(np.zeros(2))


class BlockingRead(Driver):
    def read_state(self) -> JointState:
        time.sleep(0.03)
        return super().read_state()


class StopsOnlyByReading(Driver):
    """Behind it a device that goes on for ever: it stands still while somebody reads."""

    forever = True
    commanded_ns = 0

    def write_velocity(self, qd: Any) -> CommandReport:
        self.commanded_ns = self.context.clock.now_ns()
        return super().write_velocity(qd)

    def read_state(self) -> JointState:
        if self.commanded_ns and self.context.clock.now_ns() - self.commanded_ns > TIMEOUT_S * 1e9:
            self.stop()
        return super().read_state()


class ReadsFeedTheWatchdog(StopsOnlyByReading):
    """A correct one: any packet feeds the device's watchdog, as of servos on a bus; the driver stops while it reads."""

    forever = False

    def read_state(self) -> JointState:
        state = super().read_state()
        assert self.device is not None
        self.device.until_ns = self.context.clock.now_ns() + round(TIMEOUT_S * 1e9)
        return state

    def has_tripped(self) -> bool:
        assert self.device is not None
        return bool(self.writes) and self.context.clock.now_ns() > self.device.until_ns


class RefusesAfterATrip(ReadsFeedTheWatchdog):
    """Correct, too."""

    dead = False

    def read_state(self) -> JointState:
        self.dead = self.dead or self.has_tripped()
        return super().read_state()

    def verify(self, asked: Any) -> None:
        super().verify(asked)
        if self.dead:
            raise DriverError("tripped", "the watchdog has tripped; activate again")


class DeadAfterATrip(RefusesAfterATrip):
    """Once the watchdog has tripped, commands are taken, and nothing moves."""

    def verify(self, asked: Any) -> None:
        Driver.verify(self, asked)

    def sent(self, velocities: Any) -> Any:
        return 0.0 * velocities if self.dead else velocities


class SlowRead(Driver):
    """15 ms in a cycle of 4 ms."""

    def read_state(self) -> JointState:
        time.sleep(0.015)
        return super().read_state()


class SlowWrite(Driver):
    def sent(self, velocities: Any) -> Any:
        time.sleep(0.003)
        return velocities


class SlowAndStated(Driver):
    """What it states it keeps, but no cycle has room for it."""

    def describe(self) -> JointDriverDescription:
        return msgspec.structs.replace(super().describe(), call_budget_us=50_000.0)

    def read_state(self) -> JointState:
        time.sleep(0.005)
        return super().read_state()


class NearlyStale(Driver):
    """Younger than `safety.joint_timeout_s`, until the next cycle comes."""

    def stamp(self) -> int:
        return self.context.clock.now_ns() - 95_000_000


class OldPositionsFreshStamps(Driver):
    """Positions of 0.1 s ago, as of a buffer that is read from its wrong end."""

    def told(self, positions: Any) -> Any:
        self.past = [*getattr(self, "past", []), positions][-25:]
        return self.past[0]


class DeactivatedWithoutStop(Driver):
    def deactivate(self) -> None:
        if self.life.state is ACTIVE:
            self.life.state = CONFIGURED


class ConfiguredOnce(Driver):
    """A fault of the arm is never reset."""

    def configure(self) -> None:
        self.life.require("configure()", CREATED)
        super().configure()


class MovesWhenConfigured(Driver):
    """The device stays where it was left."""

    def configure(self) -> None:
        super().configure()
        assert self.device is not None
        place = self.context.services.get("place", np.zeros(2)) + 0.02
        self.device.positions = self.context.services["place"] = place


class Degrees(Driver):
    def told(self, positions: Any) -> Any:
        return np.degrees(positions)

    def told_speeds(self, velocities: Any) -> Any:
        return np.degrees(velocities)


class DegreesCommanded(Driver):
    def sent(self, velocities: Any) -> Any:
        return np.radians(velocities)


class SignFlipped(Driver):
    def told(self, positions: Any) -> Any:
        return positions * [1.0, -1.0]

    def told_speeds(self, velocities: Any) -> Any:
        return velocities * [1.0, -1.0]


class AgreesWithItselfOnly(SignFlipped):
    """A joint counts the other way in commands and positions alike."""

    def sent(self, velocities: Any) -> Any:
        return velocities * [1.0, -1.0]


class JointsSwapped(Driver):
    """In commands and positions alike; the joints stand at different places."""

    def configure(self) -> None:
        super().configure()
        assert self.device is not None
        self.device.positions = np.array([0.1, -0.1])

    def told(self, positions: Any) -> Any:
        return positions[::-1].copy()

    def told_speeds(self, velocities: Any) -> Any:
        return velocities[::-1].copy()

    def sent(self, velocities: Any) -> Any:
        return velocities[::-1].copy()


class LeftRunning(Driver):
    """close() switches the device's time-out off and does not stop."""

    def close(self) -> None:
        if self.device is not None:
            self.device.forever = True
        self.life.state = CLOSED


class FaultUnnoticed(Driver):
    def look(self) -> None:
        return


class NeverMended(Driver):
    """A fault that was told once is told for ever."""

    failed = False

    def look(self) -> None:
        assert self.device is not None
        self.failed = self.failed or self.device.broken
        if self.failed:
            raise DriverError("protective_stop", "the device stands in a protective stop; release it")


class VelocityOfTheMotor(Driver):
    def told_speeds(self, velocities: Any) -> Any:
        return 100.0 * velocities


class WritesAfterClose(Driver):
    def stop(self) -> None:
        if self.device is not None:
            self.exchange(np.zeros(2))


class LeakedThread(Driver):
    def configure(self) -> None:
        super().configure()
        self.ended = threading.Event()
        threading.Thread(target=self.ended.wait, args=(8.0,), daemon=True, name="reader").start()


class LeakedFile(Driver):
    kept: tuple[Any, ...] = ()

    def configure(self) -> None:
        super().configure()
        type(self).kept = (*self.kept, open("/dev/null"))  # noqa: SIM115


class LimitsNotKept(Driver):
    def limited(self, velocities: Any) -> Any:
        return velocities


class VelocityNotCut(Driver):
    def write_velocity(self, qd: Any) -> CommandReport:
        report = super().write_velocity(qd)
        return CommandReport(report.seq, report.t_ns, report.asked, report.asked)


class TimeOutNotKept(Driver):
    forever = True


class NotANumberWhileMoving(Driver):
    def told_speeds(self, velocities: Any) -> Any:
        return velocities if not velocities.any() else np.array([velocities[0], math.nan])


class NotANumberAccepted(Driver):
    def verify(self, asked: Any) -> None:
        if asked.shape != (2,):
            raise DriverError("command", "two velocities are needed")


class SharedArrays(Driver):
    def __init__(self, options: Any, context: Any) -> None:
        super().__init__(options, context)
        self.buffer = np.zeros(2)

    def told(self, positions: Any) -> Any:
        self.buffer[:] = positions
        return self.buffer


class CoarseEncoder(Driver):
    def told(self, positions: Any) -> Any:
        return np.round(positions / 0.0015) * 0.0015


class LostDeviceUnnoticed(Driver):
    def exchange(self, velocities: Any = None) -> None:
        assert self.device is not None
        if not self.device.gone:
            super().exchange(velocities)


class LostDeviceAsOSError(Driver):
    def exchange(self, velocities: Any = None) -> None:
        assert self.device is not None
        self.device.exchange(velocities)


class CommandsBeforeActivate(Driver):
    def activate(self) -> None:
        self.life.state = ACTIVE

    def write_velocity(self, qd: Any) -> CommandReport:
        if self.life.state is CONFIGURED:
            self.activate()
        return super().write_velocity(qd)


class GripperGoesOn(Driver):
    def stop_auxiliary(self) -> None:
        return


class GripperOfAnArmThatIsOff(Driver):
    def write_auxiliary(self, values: Any) -> None:
        self.beside.order(values, self.context.clock.now_ns())


class ConfigureFails(Driver):
    def configure(self) -> None:
        raise DriverError("servo", "servo 1 is in mode 3")


class ReadFailsInConfigure(Driver):
    def configure(self) -> None:
        super().configure()
        self.read_state()

    def told(self, positions: Any) -> Any:
        raise KeyError("servo 1")


class StopFailsWhileConnected(Driver):
    def stop(self) -> None:
        if self.life.state is ACTIVE:
            raise OSError("write failed")
        super().stop()


class OptionsRefused(Driver):
    def __init__(self, options: Any, context: Any) -> None:
        raise DriverError("option", "driver 'small': servo is missing")


class LimitsInDegrees(Driver):
    def describe(self) -> JointDriverDescription:
        joints = (JointSpec("a", "revolute", -150.0, 150.0, 90.0, 10.0),)
        return msgspec.structs.replace(super().describe(), joints=joints)


FAULTY = {
    StaleStamps: "numbers and stamps its samples",
    FrozenStamps: "numbers and stamps its samples",
    SequenceGoesBack: "numbers and stamps its samples",
    IgnoredStop: "stops",
    RaisingStop: "stop raises nothing unconnected",
    BlockingRead: "answers in time",
    StopsOnlyByReading: "stops when commands cease",
    DeadAfterATrip: "stops when commands cease",
    SlowRead: "answers in time",
    SlowWrite: "answers in time",
    SlowAndStated: "answers in time",
    NearlyStale: "numbers and stamps its samples",
    OldPositionsFreshStamps: "moves as told",
    DeactivatedWithoutStop: "stops",
    ConfiguredOnce: "refuses commands unless active",
    MovesWhenConfigured: "stands when activated",
    Degrees: "moves as told",
    DegreesCommanded: "moves as told",
    SignFlipped: "moves as told",
    AgreesWithItselfOnly: "moves as told",
    JointsSwapped: "moves as told",
    LeftRunning: "stands once closed",
    FaultUnnoticed: "tells faults of the device",
    NeverMended: "tells faults of the device",
    VelocityOfTheMotor: "agrees with its velocities",
    WritesAfterClose: "is silent once closed",
    LeakedThread: "leaves nothing behind",
    LeakedFile: "leaves nothing behind",
    LimitsNotKept: "keeps position limits",
    VelocityNotCut: "cuts velocities at the limits",
    TimeOutNotKept: "stops when commands cease",
    NotANumberWhileMoving: "moves as told",
    NotANumberAccepted: "refuses bad commands",
    SharedArrays: "keeps samples apart",
    CoarseEncoder: "states its resolution",
    LostDeviceUnnoticed: "reports a lost device",
    LostDeviceAsOSError: "reports a lost device",
    GripperGoesOn: "orders auxiliary joints",
    GripperOfAnArmThatIsOff: "orders auxiliary joints",
    CommandsBeforeActivate: "refuses commands unless active",
}
"""Driver -> the check that is to catch its fault."""


class SmallSetup(JointDriverSetup):
    """The device's own counter and cable."""

    driver: type[Driver] = Driver

    def make_driver(self, context: Any) -> Any:
        return self.driver({}, context)

    def unplug(self, driver: Any) -> bool:
        driver.device.gone = True
        return True

    def break_down(self, driver: Any) -> bool:
        driver.device.broken = True
        driver.device.velocities = np.zeros(2)
        return True

    def mend(self, driver: Any) -> None:
        driver.device.broken = False

    def device_writes(self, driver: Any) -> int:
        return driver.device.writes

    def true_positions(self, driver: Any) -> Any:
        if not driver.device.gone:
            driver.device.exchange()
        return driver.device.positions.copy()
