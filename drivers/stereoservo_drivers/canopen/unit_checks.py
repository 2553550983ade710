"""Checks whether a joint's units, limits and signs in the cell file agree with the drive's behaviour."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import ExaminationFinding
from stereoservo_drivers.canopen.options import CanJoint
from stereoservo_drivers.canopen.units import JointScale

NOISE_COUNTS = 8.0
NOISE = 1e-4
"""[rad or m] An encoder at rest may waver by so much, or by ``NOISE_COUNTS``."""
COARSE = 1e-4
"""[rad/s or m/s] A velocity unit that is larger shows in how a law comes to rest."""
JOG = {"revolute": math.radians(1.0), "prismatic": 2e-3}
"""How far a joint is jogged [rad or m]."""
SLOWEST_SHARE = 5e-3
FASTEST = {"revolute": 0.04, "prismatic": 0.005}
"""[rad/s or m/s]"""
DOUBLING_S = 0.06
"""The jog's velocity doubles in this time: units that are wrong by a thousand show while it still creeps."""
RUNAWAY = 3.0
TOLERANCE = 0.15
LAG_S = 0.15
SURE = 1.3
"""A named unit within this factor of what would fit is meant."""
STOPPED_EARLY = 6.0
"""The same for a joint that was stopped before it had come up to speed."""
NAMED_UNITS = {1.0: "rev/s", 60.0: "rpm", 600.0: "rpm/10", 6000.0: "rpm/100", 60_000.0: "rpm/1000"}


def position_finding(joint: CanJoint, position: float) -> ExaminationFinding:
    """Finding on a joint's position [rad or m] against the machine's limits."""
    name, unit = f"{joint.name} position", _unit(joint)
    limits = f"{joint.position_min:g} to {joint.position_max:g} {unit}"
    if joint.position_min <= position <= joint.position_max:
        return ExaminationFinding(name, True, f"{position:+.4f} {unit}, within {limits}")
    outside = max(joint.position_min - position, position - joint.position_max)
    message = f"{position:+.4f} {unit} is {outside:.3g} {unit} outside {limits}"
    zero = joint.offset_rad + position
    remedy = f"if the joint stands at its zero now, offset_rad = {zero:.4f}"
    if joint.kind == "revolute" and abs(zero) > math.pi:
        remedy = (
            "so far outside, counts_per_rev (of the motor, after quadrature) or gear_ratio is wrong, limits are in "
            "degrees, or the encoder has lost its zero: home the drive"
        )
    return ExaminationFinding(name, False, message, remedy)


def noise_finding(joint: CanJoint, positions: FloatArray) -> ExaminationFinding:
    """Finding on positions (k,) of a joint that should be at rest."""
    name, unit = f"{joint.name} at rest", _unit(joint)
    counts = abs(JointScale.of(joint).counts_per_unit)
    range_seen = float(np.ptp(positions))
    drift = float(positions[-1] - positions[0])
    message = f"wavers by {range_seen:.2g} {unit} ({range_seen * counts:.0f} counts)"
    if range_seen <= max(NOISE, NOISE_COUNTS / counts):
        return ExaminationFinding(name, True, message)
    if abs(drift) > 0.8 * range_seen:
        return ExaminationFinding(
            name, False, f"moves by {drift:+.2g} {unit} while nobody drives it",
            "it sinks: see to its brake; or it was pushed: leave it alone and repeat",
        )  # fmt: skip
    return ExaminationFinding(
        name, False, message, "encoder cable, its screen, and the encoder's type set in the drive"
    )


def resolution_finding(joint: CanJoint) -> ExaminationFinding:
    """Finding on the joint velocity of one velocity unit."""
    unit = _unit(joint)
    step = 1.0 / abs(JointScale.of(joint).velocity_units_per_unit)
    message = (
        f"one unit of velocity is {step:.2g} {unit}/s, one count {JointScale.of(joint).resolution:.2g} {unit}"
    )
    if step <= COARSE:
        return ExaminationFinding(f"{joint.name} units", True, message)
    return ExaminationFinding(
        f"{joint.name} units",
        None,
        f"{message}: coarse; goals end in a slow hunt about rest",
        "set the drive's velocity unit finer (0x60A9, e.g. rpm/1000) and velocity_units_per_rev_s with it",
    )


def jog_velocity(joint: CanJoint, t_s: float, share: float) -> float | None:
    """Velocity [rad/s or m/s] of the jog at ``t_s`` after its start: slow, doubling, constant; None: finished.

    ``share`` of ``JOG``, with its sign, is how far it goes.
    """
    sign = math.copysign(1.0, share)
    fastest = min(FASTEST[joint.kind], 0.2 * joint.max_velocity)
    slowest = max(SLOWEST_SHARE * fastest, 1.0 / abs(JointScale.of(joint).velocity_units_per_unit))
    slowest = min(slowest, fastest)
    growth = math.log(2.0) / DOUBLING_S
    rise_s = math.log(fastest / slowest) / growth
    risen = (fastest - slowest) / growth
    if t_s < rise_s:
        return sign * slowest * math.exp(growth * t_s)
    if t_s < rise_s + max(abs(share) * JOG[joint.kind] - risen, 0.0) / fastest:
        return sign * fastest
    return None


@dataclass
class JogTrace:
    """Record of a jog, ``add`` every cycle. ``asked``: commanded travel so far [rad or m]; ``unsure``: what of it, and
    beside it, cycles may account for that took more than twice their ``cycle_s``: drives that hear nothing stop by
    themselves at some time, or go on.
    """

    joint: CanJoint
    start: float
    cycle_s: float
    asked: float = 0.0
    unsure: float = 0.0
    longest_s: float = 0.0
    commanded: float = 0.0
    longest_lag: float = 0.0
    reported: float = 0.0
    positions: list[float] = field(default_factory=list)

    @property
    def travel(self) -> float:
        """Travel by the joint's encoder."""
        return self.positions[-1] - self.start if self.positions else 0.0

    def add(self, commanded: float, position: float, velocity: float, dt_s: float) -> None:
        """Add one cycle: the velocity commanded in it, position and velocity as reported at its end."""
        fastest = max(abs(commanded), abs(self.commanded))
        self.asked += commanded * dt_s
        self.unsure += fastest * max(dt_s - 2.0 * self.cycle_s, 0.0)
        self.longest_s = max(self.longest_s, dt_s if fastest else 0.0)
        self.commanded = commanded
        self.positions.append(position)
        self.reported += velocity * dt_s
        self.longest_lag = max(self.longest_lag, abs(self.asked - self.travel))

    def runs_away(self) -> bool:
        """Whether the joint moves far more than commanded, and must be stopped."""
        margin = max(NOISE, NOISE_COUNTS / abs(JointScale.of(self.joint).counts_per_unit))
        return abs(self.travel) > RUNAWAY * abs(self.asked) + 3.0 * margin

    def in_doubt(self) -> bool:
        """Whether a drive with right units may have moved so, because cycles took too long."""
        asked, travel = abs(self.asked), math.copysign(1.0, self.asked) * self.travel
        low, high = (1.0 - TOLERANCE) * (asked - self.unsure), (1.0 + TOLERANCE) * (asked + self.unsure)
        apart = abs(self.reported - self.travel)
        return (
            self.unsure > 0.0 and low <= travel <= high and apart <= 2 * TOLERANCE * abs(travel) + self.unsure
        )


def jog_finding(trace: JogTrace) -> ExaminationFinding:
    """Finding on a finished jog: direction, travel, and the factor by which the units are wrong; None where this
    computer stood still for so long that it cannot be told.
    """
    found = _finding_of_units(trace)
    if found.ok is True or not trace.in_doubt():
        return found
    asked, travel = _travel_text(trace.joint, trace.asked), _travel_text(trace.joint, trace.travel)
    return ExaminationFinding(
        found.name, None,
        f"asked for {asked}, moved {travel} by its own encoder, but while it moved a cycle took "
        f"{trace.longest_s * 1e3:.0f} ms instead of {trace.cycle_s * 1e3:.0f}, in which drives may stop: not judged",
        "repeat it when this computer has less to do",
    )  # fmt: skip


def _finding_of_units(trace: JogTrace) -> ExaminationFinding:
    joint = trace.joint
    name = f"{joint.name} jog"
    asked, travel = _travel_text(joint, trace.asked), _travel_text(joint, trace.travel)
    ratio = trace.travel / trace.asked if trace.asked else math.inf
    if trace.runs_away():
        remedy = _units_remedy(joint, ratio, at_least=True)
        return ExaminationFinding(
            name, False, f"asked for {asked}, moved {travel} before it was stopped", remedy
        )
    if ratio > 1.0 + TOLERANCE:
        return ExaminationFinding(
            name, False, f"asked for {asked}, moved {travel}: {ratio:.3g} times", _units_remedy(joint, ratio)
        )
    if ratio < -0.05:
        return ExaminationFinding(
            name, False, f"asked for {asked}, its encoder moved {travel}: the wrong way",
            "motor and encoder count in opposite senses: polarity of the encoder in the drive (0x607E turns both)",
        )  # fmt: skip
    if ratio < 0.05:
        return ExaminationFinding(
            name, False, f"asked for {asked}, moved {travel}: it stands",
            f"brake, safe torque off, the drive's mode; or {_units_remedy(joint, ratio)}"
            if ratio > 1e-5 else "brake, safe torque off, the drive's mode, its velocity limit",
        )  # fmt: skip
    if ratio < 1.0 - TOLERANCE:
        return ExaminationFinding(
            name, False, f"asked for {asked}, moved {travel}: {ratio:.3g} times", _units_remedy(joint, ratio)
        )
    share = trace.reported / trace.travel
    if not 1.0 - 2 * TOLERANCE < share < 1.0 + 2 * TOLERANCE:
        return ExaminationFinding(
            name, False,
            f"moved {travel}, but the velocity that the drive reports (0x606C) adds up to "
            f"{_travel_text(joint, trace.reported)}: {share:.3g} times",
            "actual and target velocity differ in units: see the drive's manual; or leave velocity out of feedback",
        )  # fmt: skip
    fastest = min(FASTEST[joint.kind], 0.2 * joint.max_velocity)
    lag_s = trace.longest_lag / fastest
    message = f"asked for {asked}, moved {travel} by its own encoder, at most {lag_s * 1e3:.0f} ms behind"
    if lag_s > LAG_S:
        return ExaminationFinding(
            name, None, message, "velocity loop of the drive: gains, or its acceleration limit"
        )
    return ExaminationFinding(
        name, True, f"{message}; where your eye saw less or more, gear_ratio is wrong by that factor, where it saw the "
        "other way, direction",
    )  # fmt: skip


def _units_remedy(joint: CanJoint, ratio: float, *, at_least: bool = False) -> str:
    """Remedy for wrong units. ``at_least``: the joint was stopped while accelerating; the true ratio is larger."""
    configured = joint.velocity_units_per_rev_s or joint.counts_per_rev
    if not 0.0 < abs(ratio) < math.inf:
        return f"velocity_units_per_rev_s is {configured:g}, counts_per_rev {joint.counts_per_rev:g}: both right?"
    fits = configured / abs(ratio)
    low, high = (fits / STOPPED_EARLY, fits * SURE) if at_least else (fits / SURE, fits * SURE)
    named = {**NAMED_UNITS, joint.counts_per_rev: "counts/s"}
    near = [value for value in named if low <= value <= high and value != configured]
    if near:
        unit = max(near) if at_least else min(near, key=lambda value: abs(math.log(value / fits)))
        return f"velocity_units_per_rev_s = {unit:g} ({named[unit]})? it is {configured:g}"
    return (
        f"velocity_units_per_rev_s is {configured:g}; about {_rounded(fits)} would fit this travel, if counts_per_rev "
        f"({joint.counts_per_rev:g}) is right"
    )


def _rounded(value: float) -> str:
    return f"{value:.0f}" if 100.0 <= value < 1e9 else f"{value:.3g}"


def _unit(joint: CanJoint) -> str:
    return "rad" if joint.kind == "revolute" else "m"


def _travel_text(joint: CanJoint, travel: float) -> str:
    return f"{math.degrees(travel):+.3f}°" if joint.kind == "revolute" else f"{travel * 1e3:+.3f} mm"
