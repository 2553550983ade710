"""Mechanics of real joints: gear ripple, play, sag, coupling, friction, drift, delay and coarse encoders.

From the drive to the image there are three angles, all in joint units [rad or m]:

* motor: the drive's set-point, delayed by ``delay_s`` and ``lag_s``, minus the loss by Coulomb friction: ``dead_speed``
  of a drive that follows velocities, ``dead_band`` of one that follows positions;
* link: motor + ripple + play + sag + coupling. The images show the link;
* reading: reported by the encoder of the motor or of the link (``encoder_side``), with ``zero_drift``, in steps of
  ``encoder_step``. An encoder on the motor sees none of the errors of the gear.

Loads are gravity torques on the joints as shares of the arm's largest, positive if they turn the joint in its positive
direction. All arrays are (..., n), n joints, unless stated otherwise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo_sim.world.presets import MechanicsPreset
from stereoservo_sim.world.robots import Robot, joint_frames
from stereoservo_sim.world.velocity_drives import Plant

NonNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]

GRAVITY = np.array([0.0, 0.0, -9.81])
"""Gravity in the world [m/s²]."""
FALL_SPEED = 0.5
"""Speed at which a link crosses its play, and a gear deflects under a load [rad/s or m/s]."""

ARCMIN = float(np.deg2rad(1.0 / 60.0))


class Mechanics(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Mechanics of one joint [rad, s; m for prismatic joints]; the default is perfect.

    ``encoder_step``: its resolution at the joint, 0 if it is not modelled. ``encoder_side``: where it is mounted.
    ``ripple``: amplitude, with ``ripple_order`` periods per turn of the joint and ``ripple_phase`` at its zero.
    ``play``: whole width between the flanks. A load above ``play_friction`` presses the link against the flank in the
    load's direction; below it the link stays where the motor pushed it, on the flank behind the motion.
    ``sag``: deflection under the largest gravity torque. ``coupling``: share of the previous joint's motor angle that
    is added to this joint. ``dead_band``: whole width by which the set-point may move before friction yields.
    ``dead_speed``: by which the motor is slower than its set-point, and below which it does not move.
    ``zero_drift`` [rad/h]: of the encoder's zero. ``lag_s``: time constant of the drive's loop; ``delay_s``: dead
    time of its commands.
    """

    encoder_step: NonNegative = 0.0
    encoder_side: Literal["motor", "joint"] = "motor"
    ripple: NonNegative = 0.0
    ripple_order: NonNegative = 2.0
    ripple_phase: float = 0.0
    play: NonNegative = 0.0
    play_friction: Share = 0.1
    sag: NonNegative = 0.0
    coupling: float = 0.0
    dead_band: NonNegative = 0.0
    dead_speed: NonNegative = 0.0
    zero_drift: float = 0.0
    lag_s: NonNegative = 0.0
    delay_s: NonNegative = 0.0


PRESETS: dict[MechanicsPreset, Mechanics] = {
    # Makers' catalogues: accuracy of 0.5 to 1.5 arcmin, two periods a turn of the wave generator, ratios 50 to 160;
    # no play; spring constants of a size 20 gear that yield about 1 mrad at its first torque. Encoder of 16 bits on
    # the motor: it measures no error of the gear.
    "strain_wave": Mechanics(
        encoder_step=float(2.0 * np.pi / (65536 * 100)), ripple=0.5 * ARCMIN, ripple_order=200.0, sag=1e-3,
        dead_band=2e-5, lag_s=0.002,
    ),
    # Makers' catalogues: play of some to 15 arcmin, low friction, visible compliance. Encoder of 14 bits on the
    # motor, ratio 9.
    "planetary_qdd": Mechanics(
        encoder_step=float(2.0 * np.pi / (16384 * 9)), play=10.0 * ARCMIN, play_friction=0.03, sag=2e-3,
        dead_band=2e-5, lag_s=0.002,
    ),
    # Feetech STS3215, measured by users (TheRobotStudio/SO-ARM100 issue 134): 4096 counts a turn at the output, free
    # play of 1°, 20 to 30 counts of deviation under load. The encoder sits on the output and sees both. Dead zone of
    # one count (register 26), USB and half-duplex bus some milliseconds. Bending of printed links is not in it.
    "serial_servo": Mechanics(
        encoder_step=float(2.0 * np.pi / 4096), encoder_side="joint", play=float(np.deg2rad(1.0)), play_friction=0.1,
        sag=float(np.deg2rad(2.2)), dead_band=float(2.0 * np.pi / 4096), lag_s=0.02, delay_s=0.005,
    ),
}  # fmt: skip
"""Presets by name. Phases of the ripple are set by :func:`preset`."""

MechanicsOption = Literal["none", "strain_wave", "planetary_qdd", "serial_servo"] | dict[str, Mechanics]
"""Value in a cell file: a preset for all joints, or a table by joint; an omitted joint is perfect."""


PINION = 0.02
"""Radius of the pinion [m]: travel of a preset's prismatic joint per radian of its gear."""


def preset(name: MechanicsPreset, joints: int) -> tuple[Mechanics, ...]:
    """Mechanics of all joints after a preset; ripple phases are a golden angle apart, since real gears are not aligned.

    Raises KeyError for an unknown name.
    """
    one = PRESETS[name]
    golden = np.pi * (3.0 - np.sqrt(5.0))
    return tuple(
        msgspec.structs.replace(one, ripple_phase=float((0.7 + golden * k) % (2.0 * np.pi))) for k in range(joints)
    )


def behind_pinion(joint: Mechanics) -> Mechanics:
    """Mechanics [m] of a prismatic joint driven through a pinion by a gear of mechanics ``joint`` [rad]."""
    lengths = ("encoder_step", "ripple", "play", "sag", "dead_band", "dead_speed", "zero_drift")
    scaled = {name: getattr(joint, name) * PINION for name in lengths}
    return msgspec.structs.replace(joint, ripple_order=joint.ripple_order / PINION, **scaled)


def chosen_mechanics(
    option: MechanicsOption, joint_names: Sequence[str], prismatic: Sequence[bool] = ()
) -> tuple[Mechanics, ...] | None:
    """Mechanics of a cell file's joints; None if none are stated.

    ``prismatic``: joints that a preset's gear drives by a pinion; empty: none. Raises ValueError for unknown joints,
    and for a first joint that is coupled to a previous one.
    """
    if option == "none" or option == {}:
        return None
    if isinstance(option, str):
        gears = preset(option, len(joint_names))
        straight = prismatic or (False,) * len(gears)
        return tuple(behind_pinion(gear) if one else gear for gear, one in zip(gears, straight, strict=True))
    for name in option:
        if name not in joint_names:
            raise ValueError(f"mechanics: no joint {name!r}; joints: {', '.join(joint_names)}")
    chosen = tuple(option.get(name, Mechanics()) for name in joint_names)
    if chosen[0].coupling != 0.0:
        raise ValueError(f"mechanics.{joint_names[0]}.coupling: the first joint has none before it")
    return chosen


def column(mechanics: Sequence[Mechanics], name: str) -> FloatArray:
    """Field ``name`` of every joint, (n,)."""
    return np.array([getattr(joint, name) for joint in mechanics], dtype=np.float64)


# -- errors of a gear that have no memory ---------------------------------------------------------------------


def ripple(motor: FloatArray, amplitude: FloatArray, order: FloatArray, phase: FloatArray) -> FloatArray:
    """Angle error of a gear: ``amplitude sin(order motor + phase)``."""
    found: FloatArray = amplitude * np.sin(order * motor + phase)
    return found


def coupled(motor: FloatArray, coupling: FloatArray) -> FloatArray:
    """Rotation (n,) of each joint by coupling with the previous joint's motor; 0 for the first joint."""
    turned = np.zeros_like(motor)
    turned[..., 1:] = coupling[1:] * motor[..., :-1]
    return turned


def quantised(angle: FloatArray, step: FloatArray) -> FloatArray:
    """``angle`` rounded to multiples of ``step``, at most half a step off; unchanged if the step is 0."""
    fine = step <= 0.0
    unit = np.where(fine, 1.0, step)
    return np.where(fine, angle, np.round(angle / unit) * unit)


def play_at_rest(play: FloatArray, load: FloatArray, friction: FloatArray, approach: FloatArray) -> FloatArray:
    """Offset of the link in its play, at rest after a long move in the direction ``approach`` (its sign counts).

    A load above ``friction`` determines the flank; else the link is on the flank behind the motion, or in the middle if
    there was none.
    """
    pressed = np.abs(load) > friction
    found: FloatArray = 0.5 * play * np.where(pressed, np.sign(load), -np.sign(approach))
    return found


def at_rest(
    mechanics: Sequence[Mechanics], motor: FloatArray, load: FloatArray, approach: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Link angles and readings (s, n) at rest at motor angles (s, n), under loads (s, n), approached in the
    directions (s, n); without drift.
    """
    offset = gear_offset(mechanics, motor) + column(mechanics, "sag") * load
    offset = offset + play_at_rest(column(mechanics, "play"), load, column(mechanics, "play_friction"), approach)
    link = motor + offset
    on_joint = np.array([joint.encoder_side == "joint" for joint in mechanics])
    return link, quantised(np.where(on_joint, link, motor), column(mechanics, "encoder_step"))


def gear_offset(mechanics: Sequence[Mechanics], motor: FloatArray) -> FloatArray:
    """Ripple and coupling at motor angles (..., n): the part of the offset that depends on these angles alone."""
    names = ("ripple", "ripple_order", "ripple_phase")
    return ripple(motor, *(column(mechanics, name) for name in names)) + coupled(motor, column(mechanics, "coupling"))


# -- gravity --------------------------------------------------------------------------------------------------


def gravity_torques(
    points: FloatArray,
    axes: FloatArray,
    centres: FloatArray,
    masses: FloatArray,
    gravity: FloatArray = GRAVITY,
    prismatic: BoolArray | None = None,
) -> FloatArray:
    """Torques (n,) [N m] of gravity about revolute joints, positive about their axes; forces [N] along prismatic ones.

    ``points``, ``axes`` (n, 3): on and along each joint's axis. ``centres`` (n, 3) [m], ``masses`` (n,) [kg]: of the
    link after each joint; joint i carries the links i, …, n - 1. ``gravity`` (3,) [m/s²]. ``prismatic`` (n,): mask of
    prismatic joints; None: all are revolute.
    """
    weights = masses[::-1].cumsum()[::-1]
    moments = (masses[:, None] * centres)[::-1].cumsum(axis=0)[::-1]
    levers = moments - weights[:, None] * points
    torques: FloatArray = np.einsum("ij,ij->i", axes, np.cross(levers, gravity))
    if prismatic is not None and prismatic.any():
        torques = np.where(prismatic, weights * (axes @ gravity), torques)
    return torques


def gravity_load(robot: Robot, q: FloatArray) -> FloatArray:
    """Loads (n,) of a robot at ``q`` (n,): gravity torques divided by each joint's `largest_torques`."""
    frames, _ = joint_frames(robot, q)
    centres = np.einsum("nij,nj->ni", frames[:, :3, :3], robot.centres) + frames[:, :3, 3]
    torques = gravity_torques(frames[:, :3, 3], frames[:, :3, 2], centres, robot.masses, prismatic=robot.prismatic)
    return torques / largest_torques(robot)


@lru_cache(maxsize=8)
def largest_torques(robot: Robot) -> FloatArray:
    """Bounds (n,) of gravity torques [N m] with the arm stretched out; forces [N] for prismatic joints."""
    count = len(robot.joints)
    steps = np.linalg.norm(robot.links[:, :3, 3], axis=1)
    steps = steps + [
        max(abs(j.position_min), abs(j.position_max)) if j.kind == "prismatic" else 0.0 for j in robot.joints
    ]
    reach = np.linalg.norm(robot.centres, axis=1)
    bounds = np.array(
        [
            robot.masses[j:].sum()
            if robot.prismatic[j]
            else sum(robot.masses[k] * (steps[j:k].sum() + reach[k]) for k in range(j, count))
            for j in range(count)
        ]
    )
    return np.maximum(bounds * float(np.abs(GRAVITY[2])), 1e-9)


def horizontal_load(q: FloatArray) -> FloatArray:
    """Loads (n,) of joints of an unknown arm, which is level at each joint's zero: ``-cos q``."""
    found: FloatArray = -np.cos(q)
    return found


# -- mechanics with memory -------------------------------------------------------------------------------------


class Transmission:
    """Computes link angles and readings from set-points of the drives, step by step. Positions (n,) [rad or m].

    ``motor``, ``link``: true angles. ``load``: function of the motor angles (n,) that returns the loads (n,).
    Starts at rest with the links at ``link``, pressed by their load against a flank, else in the middle of the play.
    """

    def __init__(
        self, mechanics: Sequence[Mechanics], link: FloatArray, load: Callable[[FloatArray], FloatArray]
    ) -> None:
        self._load = load
        self._play_width, self._half_band = column(mechanics, "play"), 0.5 * column(mechanics, "dead_band")
        self._amplitude, self._order, self._phase = (
            column(mechanics, name) for name in ("ripple", "ripple_order", "ripple_phase")
        )
        self._coupling, self._sag = column(mechanics, "coupling"), column(mechanics, "sag")
        self._friction, self._lag = column(mechanics, "play_friction"), column(mechanics, "lag_s")
        self._drift = column(mechanics, "zero_drift") / 3600.0
        self.encoder_step = column(mechanics, "encoder_step")
        self._on_joint = np.array([joint.encoder_side == "joint" for joint in mechanics])
        self._t = 0.0
        self.motor = link.copy()
        for _ in range(20):  # the offset hardly depends on the angle: each iteration adds two digits or more
            self._settle()
            self.motor = self.motor + (link - self.link)
        self._settle()
        self._lagged = self.motor.copy()
        self._dead_speed = column(mechanics, "dead_speed")
        self._set, self._held_back = self.motor.copy(), np.zeros_like(self.motor)
        self._delay = _Delay(column(mechanics, "delay_s"), self.motor)
        self._resting = True

    def _settle(self) -> None:
        """Settle at rest under the load at ``motor``."""
        load = self._load(self.motor)
        self._play = play_at_rest(self._play_width, load, self._friction, np.zeros_like(load))
        self._sagged = self._sag * load
        self.link = self.motor + self._geared() + self._play + self._sagged

    def _geared(self) -> FloatArray:
        return ripple(self.motor, self._amplitude, self._order, self._phase) + coupled(self.motor, self._coupling)

    @property
    def readings(self) -> FloatArray:
        """Angles at the encoders (n,), with drift, before quantisation."""
        return np.where(self._on_joint, self.link, self.motor) + self._drift * self._t

    @property
    def reading_offset(self) -> FloatArray:
        """Readings minus link angles (n,)."""
        return self.readings - self.link

    def follow(self, set_positions: FloatArray, h: float) -> None:
        """Advance by ``h`` [s] towards set-points (n,)."""
        self._t += h
        arrived = self._delay.after(self._driven(set_positions, h), h)
        share = np.where(self._lag > 0.0, -np.expm1(-h / np.maximum(self._lag, 1e-12)), 1.0)
        step = arrived - self._lagged
        # An exponential never ends: a remainder below a nanometre is completed at once.
        self._lagged = np.where(np.abs(step) < 1e-9, arrived, self._lagged + share * step)
        motor = np.clip(self.motor, self._lagged - self._half_band, self._lagged + self._half_band)
        moved = motor - self.motor
        before, self.motor = self.link, motor
        load = self._load(motor)
        most = FALL_SPEED * h
        half = 0.5 * self._play_width
        held = np.clip(self._play - moved, -half, half)
        pressed = np.abs(load) > self._friction
        fall = np.clip(np.sign(load) * half - held, -most, most)
        self._play = np.where(pressed, held + fall, held)
        self._sagged = self._sagged + np.clip(self._sag * load - self._sagged, -most, most)
        self.link = motor + self._geared() + self._play + self._sagged
        settled = (self._lagged == set_positions - self._held_back).all()
        self._resting = bool(settled and (self.link == before).all())

    def _driven(self, set_positions: FloatArray, h: float) -> FloatArray:
        """Set-points (n,) minus the accumulated motion lost to friction."""
        step = set_positions - self._set
        self._set = set_positions.copy()
        most = self._dead_speed * h
        self._held_back = self._held_back + np.clip(step, -most, most)
        return set_positions - self._held_back

    def rest(self, h: float) -> bool:
        """Let ``h`` [s] pass if nothing moves or is about to; returns whether that is so."""
        if self._resting:
            self._t += h
        return self._resting


class _Delay:
    """Dead time of set-points, one for each joint (n,) [s]; linear interpolation."""

    def __init__(self, delay_s: FloatArray, positions: FloatArray) -> None:
        self._delay = delay_s
        self._longest = float(delay_s.max(initial=0.0))
        self._past: deque[tuple[float, FloatArray]] = deque([(0.0, positions.copy())])
        self._t = 0.0

    def after(self, positions: FloatArray, h: float) -> FloatArray:
        """Set-points (n,) that take effect ``h`` [s] after the last call, at which ``positions`` (n,) were sent."""
        if self._longest == 0.0:
            return positions
        self._t += h
        self._past.append((self._t, positions.copy()))
        while len(self._past) > 2 and self._past[1][0] <= self._t - self._longest:
            self._past.popleft()
        times = [t for t, _ in self._past]
        sent = np.array([q for _, q in self._past])
        return np.array([np.interp(self._t - delay, times, sent[:, j]) for j, delay in enumerate(self._delay.tolist())])


# -- a plant behind them -------------------------------------------------------------------------------------
# A plant with imperfect mechanics: the drives' set-points reach the links through gears; encoders are on one side.


class MechanicalPlant:
    """``links`` moved through ``mechanics``, one per joint; otherwise as :class:`velocity_drives.Plant`.

    ``robot``: whose weight loads the joints; None: the load of an arm that is level at each joint's zero.
    """

    def __init__(self, links: Plant, mechanics: Sequence[Mechanics], robot: Robot | None) -> None:
        load: Callable[[FloatArray], FloatArray] = horizontal_load if robot is None else partial(gravity_load, robot)
        self.links = links
        self.transmission = Transmission(mechanics, links.positions, load)
        self._offset_rates = np.zeros_like(links.positions)

    @property
    def positions(self) -> FloatArray:
        """True positions (n,) of the links."""
        return self.links.positions

    @property
    def velocities(self) -> FloatArray:
        """Velocities of the links (n,)."""
        return self.links.velocities

    @property
    def efforts(self) -> FloatArray:
        """Efforts (n,) that move the links."""
        return self.links.efforts

    @property
    def motors(self) -> FloatArray:
        """Angles of the motors (n,), in units of the joints."""
        return self.transmission.motor

    @property
    def readings(self) -> FloatArray:
        """Angles at the encoders (n,), before quantisation."""
        return self.links.positions + self.transmission.reading_offset

    @property
    def reading_rates(self) -> FloatArray:
        """Velocities at the encoders (n,)."""
        return self.links.velocities + self._offset_rates

    def follow(self, set_positions: FloatArray, set_velocities: FloatArray, h: float) -> None:
        """Advance by ``h`` [s] towards the drives' set-points at its end, (n,), (n,)."""
        gear = self.transmission
        link, offset = gear.link, gear.reading_offset
        gear.follow(set_positions, h)
        self._offset_rates = (gear.reading_offset - offset) / h
        self.links.follow(gear.link, (gear.link - link) / h, h)

    def rest(self, h: float) -> bool:
        """Let ``h`` [s] pass if nothing moves or is about to; returns whether that is so."""
        return self.links.rest(h) and self.transmission.rest(h)

    def close(self) -> None:
        """Release resources."""
        self.links.close()
