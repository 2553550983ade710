"""Fault trials of the CAN arm in virtual time: the driver's master on the emulated bus, bit times included.

Each trial drives six axes at constant speed, injects one fault at a random phase of the cycle, and evaluates the axes'
true velocities: when the master detected it, when all axes were at rest, what was latched, and whether anything moved
or was powered again by itself afterwards.
"""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import Subscriptions
from stereoservo_drivers.canopen.driver import make_bringup, make_codec
from stereoservo_drivers.canopen.master import Master, MasterFault, MasterSettings, Mode
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_sim.emulators.bus.bus_emulator import BusEmulator
from stereoservo_sim.emulators.bus.factory import DrivesSettings, make_bus_emulator

Host = Literal["runs", "killed", "cycle_hangs", "loop_hangs", "adapter_gone"]
Stage = Literal["running", "standing", "start", "reset"]


class FaultCase(msgspec.Struct, frozen=True):
    """One fault case of the table.

    ``stage``: when the fault occurs: running; when the arm is enabled and about to move (standing; times count from its
    first command); before bring-up (start); or a fault whose reset is then tried (reset). ``orders``: commands for the
    emulated bus at that moment. ``host``: what happens to the master's computer then. ``codes``: what the master may
    latch first, or bring-up may refuse with, one or several by the fault's phase; empty: nothing latches, motion
    continues. ``bound_ms``: from the fault to all axes at rest. ``by``: the side that ends motion. ``afterwards``:
    ordered once the axes rest: it removes the cause, and nothing may move again by itself. ``options``: changes of the
    cell's options. ``warm_s``: motion before the fault. ``towards``: the node that has to move in its positive
    direction; 0: none.
    """

    name: str
    orders: tuple[str, ...] = ()
    codes: tuple[str, ...] = ()
    afterwards: tuple[str, ...] = ()
    bound_ms: float | None = None
    host: Host = "runs"
    by: Literal["master", "drives", "bring-up", "nobody"] = "master"
    stage: Stage = "running"
    options: dict[str, Any] = {}
    warm_s: float = 0.1
    towards: int = 0


AFTER_A_HANG = "emergency, left_operational, drive_fault, disabled, bus_silent"
"""Codes that a thread may find first when it continues after the drives have stopped by themselves."""
SWITCHES_SENT = {"feedback": ("velocity", "switches")}
NO_DEADLINE = {"rpdo_deadline_ms": 0}
"""The drives' deadline for commands is off: their heartbeat monitor (0x1016) of the master acts alone."""


def _case(
    name: str, orders: str = "", codes: str = "", bound_ms: float | None = None, afterwards: str = "", **more: Any
) -> FaultCase:
    """A fault case whose orders and codes are given as one text, separated by ``, ``."""
    first, latched, last = (tuple(filter(None, text.split(", "))) for text in (orders, codes, afterwards))
    return FaultCase(name, first, latched, last, bound_ms, **more)


EITHER_PROTOCOL = (
    _case("node silent", "silence 4", "silent", 60, "speak 4"),
    _case("duplicate node id running", "duplicate 2 running", "duplicate", 60, "duplicate 2 off"),
    _case(
        "limit switch active before motion",
        "limit 3 +",
        "limit_switch, emergency, drive_fault",
        40,
        "limit 3 off",
        options=SWITCHES_SENT,
        towards=3,
        stage="standing",
    ),
    _case(
        "encoder against the command from the start",
        "invert 3",
        "encoder_reversed",
        200,
        "invert 3 off",
        stage="standing",
    ),
    _case("duplicate node id at start", "duplicate 2 running", "duplicate_node", by="bring-up", stage="start"),
    _case("node missing at start", "silence 4", "node_missing", by="bring-up", stage="start"),
    _case("servo loop hangs", "", "loop_hung", 150, host="loop_hangs"),
)
"""Cases that are the same for drives of both protocols."""

CIA402_CASES = (
    *EITHER_PROTOCOL,
    _case("drive fault with emergency", "fault 3 0x3210", "emergency, drive_fault", 40),
    _case("emergency alone", "emcy 5 0x4210", "emergency", 40),
    _case("node's cable out", "cable 4 out", "silent", 60, "cable 4 in"),
    _case("node reboots", "reboot 5", "rebooted, silent", 60),
    _case("one TPDO lost", "lose 2 tpdo1", by="nobody"),
    _case("three TPDOs lost", "lose 2 tpdo1 3", by="nobody"),
    _case("TPDOs late by 6 ms", "late 2 6ms", "late, silent", 150, "late 2 0", warm_s=0.5),
    _case(
        "duplicate node id boots", "duplicate 2 boots", "rebooted, duplicate, left_operational", 60, "duplicate 2 off"
    ),
    _case("mapping changed", "remap 3", "mapping, silent", 40),
    _case("bus cable out", "cable out", "bus_silent", 150, "cable in", by="drives", options=NO_DEADLINE),
    _case("bus cable out, RPDO deadline", "cable out", "bus_silent", 60, "cable in", by="drives"),
    _case("master killed", "", "", 150, host="killed", by="drives", options=NO_DEADLINE),
    _case("master killed, RPDO deadline", "", "", 60, host="killed", by="drives"),
    _case("cycle thread hangs", "", AFTER_A_HANG, 150, host="cycle_hangs", by="drives", options=NO_DEADLINE),
    _case("cycle thread hangs, RPDO deadline", "", AFTER_A_HANG, 60, host="cycle_hangs", by="drives"),
    _case(
        "adapter gone",
        "adapter out",
        "connection_lost",
        150,
        "adapter in",
        host="adapter_gone",
        by="drives",
        options=NO_DEADLINE,
    ),
    _case("SYNC lost", "drop-sync", "bus_silent", 60, "pass-sync"),
    _case("limit switch", "limit 3 +", "limit_switch, emergency", 40, "limit 3 off", options=SWITCHES_SENT, towards=3),
    _case("limit switch, switches not sent", "limit 3 +", "limit_switch, emergency", 140, "limit 3 off", towards=3),
    _case(
        "NMT stop by a stranger",
        "nmt stop",
        "left_operational, emergency, disabled, drive_fault, bus_silent",
        60,
        "nmt start",
    ),
    _case("NMT reset of one node", "nmt reset 6", "rebooted, silent, left_operational", 60),
    _case("babbling node", "flood 1", "bus_flood", 60, "calm 1"),
    _case("encoder runs against the command", "invert 3", "encoder_reversed", 200, "invert 3 off"),
    _case("drive in fault at start", "fault 3 0x3210", "drive_fault, emergency", stage="start"),
    _case("cause that stays: reset refused", "sticky 3 0x4310", "emergency, drive_fault", 40, stage="reset"),
)
"""Cases of six CiA 402 drives at 250 Hz with ramps of 12.5 ms."""

ODRIVE_CASES = (
    *EITHER_PROTOCOL,
    _case("drive error", "fault 3 0x20", "drive_fault", 40),
    _case("node reboots", "reboot 5", "silent", 60),
    _case("one answer lost", "lose 2 0x049", by="nobody"),
    _case("answers late by 6 ms", "late 2 6ms", "late, silent", 150, "late 2 0", warm_s=0.5),
    _case("bus cable out", "cable out", "bus_silent", 150, "cable in", by="drives"),
    _case("master killed", "", "", 150, host="killed", by="drives"),
    _case("cycle thread hangs", "", AFTER_A_HANG, 150, host="cycle_hangs", by="drives"),
    _case("end stop", "limit 3 +", "drive_fault", 40, "limit 3 off", towards=3),
    _case("drive in error at start", "fault 3 0x20", "drive_fault", stage="start"),
    _case("cause that stays: reset refused", "sticky 3 0x2000", "drive_fault", 40, stage="reset"),
)
"""Cases of six ODrives whose watchdogs are set to 100 ms."""

CASES: dict[str, tuple[FaultCase, ...]] = {"cia402": CIA402_CASES, "odrive": ODRIVE_CASES}
"""Cases by protocol."""


# -- fault trials ------------------------------------------------------------------------------------------


AXES = 6
RATE_HZ = 250.0
COUNTS_PER_REV = 4096.0
GEAR_RATIO = 100.0
SPEED_COUNTS_S = 50_000.0
RAMP_COUNTS_S2 = 4e6
"""Ramp from ``SPEED_COUNTS_S`` to rest in 12.5 ms."""
BOOT_S = 1.5
"""Time for the drives to boot before bring-up."""
ENABLE_S = 1.0
SETTLE_S = 0.1
"""Least time after the fault in which the axes must come to rest and tolerated events must not latch."""


class Trial(msgspec.Struct, frozen=True):
    """Result of one fault trial. Times after the fault [ms]; None: not detected, or never at rest.

    ``code``: the first latched, or why bring-up refused. ``restarted``: something moved or was powered again by itself.
    ``problem``: deviation from the table, or that reset and enable did not restore motion (for a persistent cause: that
    they did); empty: none.
    """

    detected_ms: float | None
    rest_ms: float | None
    code: str
    restarted: bool
    problem: str


class TrialError(Exception):
    """The trial could not begin: bring-up or enabling failed before a fault was injected."""


def trial_options(protocol: str, **changes: object) -> CanOptions:
    """Options of six joints with the table's speed and ramps."""
    odrive = protocol == "odrive"
    counts_per_rad = COUNTS_PER_REV * GEAR_RATIO / (2.0 * math.pi)
    ramp = RAMP_COUNTS_S2 / counts_per_rad
    joints = tuple(
        CanJoint(
            name=f"j{k}",
            node_id=k,
            counts_per_rev=1.0 if odrive else COUNTS_PER_REV,
            gear_ratio=GEAR_RATIO,
            direction=1 if k % 2 else -1,
            max_velocity=1.0,
            max_acceleration=ramp,
            quick_stop_deceleration=ramp,
            position_min=-3.0,
            position_max=3.0,
        )
        for k in range(1, AXES + 1)
    )
    base = CanOptions(
        protocol="odrive" if odrive else "cia402", interface="virtual", channel="trial", rate_hz=RATE_HZ, joint=joints
    )
    return msgspec.structs.replace(base, **changes)


def trial_speed() -> float:
    """Speed of the trials [rad/s]."""
    return SPEED_COUNTS_S / (COUNTS_PER_REV * GEAR_RATIO / (2.0 * math.pi))


class FaultRig:
    """Emulated bus, master and its host, up to the injection of the case's fault."""

    def __init__(self, case: FaultCase, protocol: str) -> None:
        self.case = case
        options = trial_options(protocol, **case.options)
        self.emulator = make_bus_emulator(options, DrivesSettings(plant="ideal", bit_time=True), t_ns=0)
        self.axes = [node.axis for node in self.emulator.nodes]
        codec = make_codec(options)
        self.bringup = make_bringup(options, codec, Path())
        self.master = Master(codec, MasterSettings.of(options))
        self.host = VirtualHost(self.emulator, self.master)
        self.host.wait(BOOT_S)

    def order(self, texts: tuple[str, ...]) -> None:
        """Send fault commands to the emulator now."""
        for text in texts:
            self.emulator.order(text, self.host.t_ns)

    def enable(self) -> None:
        """Request enabling and run until the master has decided."""
        self.master.request_enable(self.host.t_ns)
        until = self.host.t_ns + round(ENABLE_S * 1e9)
        while self.host.t_ns < until and self.master.mode in (Mode.OFF, Mode.ENABLING):
            self.master.port_called(self.host.t_ns)
            self.host.wait(1.0 / RATE_HZ)

    def start(self) -> None:
        """Run bring-up and enable. Raises TrialError."""
        try:
            self.bringup.connect(self.host)
        except DriverError as error:
            raise TrialError(f"bring-up failed: {error}") from error
        self.host.begin_cycle()
        self.host.wait(0.05)
        self.enable()
        if self.master.mode is not Mode.RUNNING:
            raise TrialError(f"not enabled: {self.master.fault}, {self.master.codec.status_words()}")
        self.host.velocities = np.zeros(AXES)

    def warm_up(self, speed: FloatArray) -> None:
        """Drive at ``speed`` (n,). Raises TrialError."""
        self.host.velocities = speed
        self.host.wait(self.case.warm_s)
        if self.master.fault is not None or not self.all_move(speed):
            raise TrialError(f"not at speed: {self.master.fault}, {[axis.velocity for axis in self.axes]}")

    def all_move(self, speed: FloatArray) -> bool:
        """Whether all axes move at ``speed`` (n,), within 2 %."""
        return all(abs(axis.velocity - v) < 0.02 * abs(v) for axis, v in zip(self.axes, speed, strict=True))

    def still(self) -> bool:
        """Whether all axes are at rest."""
        return self.emulator.at_rest()


def run_trial(
    case: FaultCase,
    protocol: str,
    rng: np.random.Generator,
    *,
    run_on_s: float = 1.0,
    rig: Callable[[FaultCase, str], FaultRig] = FaultRig,
) -> Trial:
    """Run one trial on a new ``rig``. ``run_on_s``: time after rest in which nothing may move by itself. Raises
    TrialError.
    """
    return _run(rig(case, protocol), rng, run_on_s)


def _run(rig: FaultRig, rng: np.random.Generator, run_on_s: float) -> Trial:
    case = rig.case
    if case.stage == "start":
        return _start_trial(rig, run_on_s)
    speed = trial_speed() * rng.choice([-1.0, 1.0], AXES)
    if case.towards:
        speed[case.towards - 1] = trial_speed()
    rig.start()
    if case.stage != "standing":
        rig.warm_up(speed)
    rig.host.wait(rng.uniform(0.0, 1.0) / RATE_HZ)
    t0 = rig.host.t_ns
    rig.order(case.orders)
    rig.host.velocities = speed
    _inject_host_fault(rig)
    if case.by == "nobody":
        return _tolerated(rig, speed)
    rest_ns = _until_rest(rig, t0)
    _recover(rig)
    fault = rig.master.fault
    detected_ms = None if fault is None else (fault.t_ns - t0) * 1e-6
    rest_ms = None if rest_ns is None else (rest_ns - t0) * 1e-6
    restarted = _restarts(rig, run_on_s)
    return Trial(
        detected_ms=detected_ms,
        rest_ms=rest_ms,
        code="" if fault is None else fault.code,
        restarted=restarted,
        problem=_problem(case, fault, rest_ms, restarted) or _reset(rig, speed),
    )


def _inject_host_fault(rig: FaultRig) -> None:
    """Inject the fault of the master's host."""
    if rig.case.host in ("killed", "cycle_hangs"):
        rig.host.cycling = False
    elif rig.case.host == "loop_hangs":
        rig.host.velocities = None


def _until_rest(rig: FaultRig, t0: int) -> int | None:
    """Run until the axes have been at rest for a while; returns when the last one stopped, None if never."""
    rig.host.wait(max(SETTLE_S, 2e-3 * (rig.case.bound_ms or 0.0)))
    if not rig.still():
        return None
    rests = [event.t_ns for event in rig.emulator.events if event.kind == "all_rest" and event.t_ns >= t0]
    return rests[-1] if rests else None


def _recover(rig: FaultRig) -> None:
    """Remove the cause; a hung thread continues."""
    rig.order(rig.case.afterwards)
    if rig.case.host == "cycle_hangs":
        rig.host.cycling = True
        rig.host.wait(8.0 / RATE_HZ)


def _restarts(rig: FaultRig, run_on_s: float) -> bool:
    """Whether anything moves or is powered within ``run_on_s``, while commands continue and enabling is requested."""
    since = rig.host.t_ns
    positions = [axis.position for axis in rig.axes]
    rig.host.velocities = np.full(AXES, trial_speed())
    if rig.master.fault is not None:
        rig.master.request_enable(since)
    rig.host.wait(run_on_s)
    moved = max(abs(axis.position - before) for axis, before in zip(rig.axes, positions, strict=True))
    again = any(event.kind in ("moves", "power_on") for event in rig.emulator.events if event.t_ns > since)
    return again or moved > 1e-4 or not rig.still()


def _problem(case: FaultCase, fault: MasterFault | None, rest_ms: float | None, restarted: bool) -> str:
    if rest_ms is None:
        return "never at rest"
    if case.bound_ms is not None and rest_ms > case.bound_ms:
        return f"at rest after {rest_ms:.1f} ms"
    if restarted:
        return "moved or was powered again by itself"
    code = "nothing" if fault is None else fault.code
    if case.codes and code not in case.codes:
        return f"latched {code}, not {' or '.join(case.codes)}"
    return ""


def _reset(rig: FaultRig, speed: FloatArray) -> str:
    """Reset, check that it enables nothing, enable, move. Returns the failure; for persistent causes, that the
    reset was wrongly accepted.
    """
    if rig.case.host == "killed":
        return ""
    rig.host.end_cycle()
    try:
        if rig.case.host == "adapter_gone":
            rig.bringup.connect(rig.host)
        else:
            rig.bringup.reset(rig.host)
    except DriverError as error:
        rig.host.resume_cycle()
        rig.host.wait(0.05)
        refused = rig.case.stage == "reset" and rig.master.fault is not None
        return "" if refused else f"reset refused: {error}"
    rig.host.velocities = speed
    rig.host.begin_cycle()
    rig.host.wait(0.05)
    if rig.case.stage == "reset":
        return "" if rig.master.fault is not None else "the reset was not refused"
    if rig.master.fault is not None:
        return f"latched again after the reset: {rig.master.fault.text()}"
    if any(axis.powered for axis in rig.axes) or not rig.still():
        return "the reset gave power"
    rig.enable()
    rig.host.wait(0.1)
    if rig.master.mode is not Mode.RUNNING or not rig.all_move(speed):
        return f"not moving after reset and enable: {rig.master.fault}"
    return ""


def _tolerated(rig: FaultRig, speed: FloatArray) -> Trial:
    rig.host.wait(SETTLE_S)
    fault = rig.master.fault
    problem = ""
    if fault is not None:
        problem = f"latched {fault.code}: {fault.message}"
    elif not rig.all_move(speed):
        problem = "the axes do not move on"
    elif rig.master.statistics.lost == 0:
        problem = "nothing was lost"
    return Trial(None, None, fault.code if fault else "", False, problem)


def _start_trial(rig: FaultRig, run_on_s: float) -> Trial:
    """Trial of a fault present before bring-up: bring-up is refused, or it is latched and enabling is refused."""
    rig.order(rig.case.orders)
    rig.host.wait(0.01)  # frames still on the wire
    code = ""
    try:
        rig.bringup.connect(rig.host)
    except DriverError as error:
        code = error.code
    else:
        rig.host.begin_cycle()
        rig.host.wait(0.05)
        rig.enable()
        code = rig.master.fault.code if rig.master.fault is not None else ""
    restarted = _restarts(rig, run_on_s)
    problem = ""
    if code not in rig.case.codes:
        problem = f"refused with {code or 'nothing'}, not {' or '.join(rig.case.codes)}"
    elif restarted:
        problem = "something moved or was powered"
    return Trial(None, None, code, restarted, problem)


# -- a host in virtual time ----------------------------------------------------------------------------------
# The master's computer in the emulated bus's virtual time: bring-up, cycle, and its failures; without threads and
# clock.


class VirtualHost(Subscriptions):
    """A link for bring-up and, after ``begin_cycle``, the master's ticks on an absolute grid.

    Frames enter the wire at the tick's time and reach the master when they end on the bus. ``velocities`` (n,): written
    by the servo loop each cycle; None: it does not call the port. ``cycling`` False: the thread of the cycle hangs or
    is dead, and neither receives nor sends; frames that arrive meanwhile wait.
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
        """Stop ticking, for a reset; the bus keeps running."""
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
        """Execute the next event at ``t_ns``: a heartbeat between the cycles, else a tick."""
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
            self.master.latch(MasterFault("connection_lost", "the adapter was unplugged", t_ns=self.emulator.t_ns))


# -- rows of the fault table -----------------------------------------------------------------------------------


class FaultRow(msgspec.Struct, frozen=True):
    """Summary of one fault over several trials.

    Times [ms] after the fault. ``detected_cycles``: largest, in cycles of the master. ``codes``: count of each code
    latched first. ``restarts``: trials in which something moved or was powered again by itself.
    """

    protocol: str
    fault: str
    trials: int
    detected_ms_median: float | None
    detected_ms_max: float | None
    detected_cycles: int | None
    rest_ms_median: float | None
    rest_ms_max: float | None
    bound_ms: float | None
    by: str
    codes: dict[str, int]
    restarts: int
    problems: tuple[str, ...]
    ok: bool


def trial_rng(case: FaultCase, protocol: str, seed: int, trial: int) -> np.random.Generator:
    """Random generator of one trial's phase and directions, different for every fault."""
    return np.random.default_rng([seed, trial, zlib.crc32(f"{protocol} {case.name}".encode())])


def run_row(case: FaultCase, protocol: str, trials: int, seed: int, *, run_on_s: float = 1.0) -> FaultRow:
    """Run ``trials`` trials. Raises TrialError."""
    return summarize(
        case,
        protocol,
        [run_trial(case, protocol, trial_rng(case, protocol, seed, k), run_on_s=run_on_s) for k in range(trials)],
    )


def summarize(case: FaultCase, protocol: str, trials: Sequence[Trial]) -> FaultRow:
    """Row of a fault's trials. If only the drives detect a fault, a later latch of the master is no detection."""
    seen = [] if case.host in ("killed", "cycle_hangs") else [trial.detected_ms for trial in trials]
    detected_median, detected_max = _median_and_max(seen)
    rest_median, rest_max = _median_and_max([trial.rest_ms for trial in trials])
    problems = tuple(sorted({trial.problem for trial in trials if trial.problem}))
    return FaultRow(
        protocol=protocol,
        fault=case.name,
        trials=len(trials),
        detected_ms_median=detected_median,
        detected_ms_max=detected_max,
        detected_cycles=None if detected_max is None else math.ceil(detected_max * 1e-3 * RATE_HZ),
        rest_ms_median=rest_median,
        rest_ms_max=rest_max,
        bound_ms=case.bound_ms,
        by=case.by,
        codes=dict(Counter(trial.code for trial in trials if trial.code)),
        restarts=sum(trial.restarted for trial in trials),
        problems=problems,
        ok=not problems,
    )


def _median_and_max(values: Sequence[float | None]) -> tuple[float | None, float | None]:
    """Median and maximum of the values that are not None, to 0.01; None if there are none."""
    there = [value for value in values if value is not None]
    if not there:
        return None, None
    return round(float(np.median(there)), 2), round(max(there), 2)
