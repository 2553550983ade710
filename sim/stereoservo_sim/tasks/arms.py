"""Simulated arms of the alignment tasks: the plate's true pose, and its motion by joint velocities.

``free`` is a virtual arm of six Cartesian generators that act at once; ``rx90`` a serial arm of six revolute joints
with limits; ``twist`` the same behind an interface of Cartesian velocities (`twist_arm`). The controller receives only
the readings of their joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Literal, Protocol

import numpy as np

from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import exp_twist, multiply4_into
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.tasks.setting import (
    HEIGHT,
    HOMOGENEOUS_MARKERS,
    MARKERS,
    WIDTH,
    camera_poses,
    cartesian_twists,
    intrinsics,
)
from stereoservo_sim.world.mechanical_trials import synthetic_load
from stereoservo_sim.world.mechanics import Mechanics, Transmission, preset, quantised
from stereoservo_sim.world.presets import MechanicsPreset
from stereoservo_sim.world.synthetic import RX90_ROWS, SyntheticCell, dh_link, placed, rotation, translation

ArmName = Literal["free", "rx90", "twist"]

MID_RANGE = translation(0.0, 0.0, 1.1) @ rotation("y", 15) @ rotation("x", -10)
"""The plate's pose (4, 4) at the centre of calibration."""
PLATE_ON_FLANGE = translation(0.0, 0.0, 0.02) @ rotation("x", 180)
"""Pose (4, 4) of the plate on the flange: its printed face points along the flange's z."""
RX90_HOME = np.radians([10.0, -60.0, 165.0, 20.0, 50.0, 15.0])
RX90_LIMITS = np.radians(
    [(-160.0, 160.0), (-227.5, 47.5), (-52.5, 232.5), (-270.0, 270.0), (-105.0, 120.0), (-270.0, 270.0)]
)
"""Limits (6, 2) [rad]."""
GEAR_STEPS = 4
"""Steps of imperfect mechanics per step of the loop."""


class TaskArm(Protocol):
    """Protocol of an arm during a task. ``pose`` (4, 4) of the plate in the rig, ``joints`` (n,): its readings."""

    pose: FloatArray
    joints: FloatArray
    composition: Composition
    limits: FloatArray

    def move(self, velocity: FloatArray, dt_s: float) -> None:
        """Move at ``velocity`` (n,) for ``dt_s``. Raises DriverError if the arm has stopped by itself."""
        ...


class FreeArm:
    """TaskArm with translations along and rotations about the rig's axes through the plate's centre at the start
    (re-based there).

    ``joints``: the integrals of the velocities, from zero.
    """

    composition = Composition.SIMULTANEOUS
    limits = np.tile([-np.inf, np.inf], (6, 1))

    def __init__(self, start: FloatArray) -> None:
        self.pose = start.copy()
        self.joints = np.zeros(6)
        self._twists = cartesian_twists(start[:3, 3])

    def move(self, velocity: FloatArray, dt_s: float) -> None:
        """Displace the plate by ``exp(dt Σ q̇_j T_j)``."""
        step = velocity * dt_s
        moved = np.empty((4, 4))
        multiply4_into(exp_twist((step[:, None, None] * self._twists).sum(axis=0)), self.pose, moved)
        self.pose = moved
        self.joints = self.joints + step


class SerialArm:
    """The RX 90 from a configuration ``joints`` (6,) of its links; with ``mechanics`` its readings differ."""

    composition = Composition.BASE_FIRST
    limits = RX90_LIMITS

    def __init__(self, cell: SyntheticCell, joints: FloatArray, mechanics: Sequence[Mechanics] | None = None) -> None:
        self._cell = cell
        self.joints = joints.copy()
        self.pose = cell.flange(joints) @ PLATE_ON_FLANGE
        self._gears: Transmission | None = None
        if mechanics is not None:
            self._gears = Transmission(mechanics, joints, partial(synthetic_load, cell))
            self._set_positions = self._gears.motor.copy()
            self.joints = quantised(self._gears.readings, self._gears.encoder_step)

    def move(self, velocity: FloatArray, dt_s: float) -> None:
        """Integrate the joints, without limits."""
        if self._gears is None:
            self.joints = self.joints + velocity * dt_s
            self.pose = self._cell.flange(self.joints) @ PLATE_ON_FLANGE
            return
        for _ in range(GEAR_STEPS):
            self._set_positions = self._set_positions + velocity * (dt_s / GEAR_STEPS)
            self._gears.follow(self._set_positions, dt_s / GEAR_STEPS)
        self.joints = quantised(self._gears.readings, self._gears.encoder_step)
        self.pose = self._cell.flange(self._gears.link) @ PLATE_ON_FLANGE


def mechanics_of(name: MechanicsPreset | None) -> tuple[Mechanics, ...] | None:
    """Mechanics of the RX 90's joints after a preset, or None."""
    return None if name is None else preset(name, len(RX90_HOME))


def _cameras() -> tuple[FloatArray, FloatArray]:
    """Intrinsics and poses from the rig to each camera, in the form of synthetic cells."""
    return np.array([intrinsics()] * 2), np.linalg.inv(camera_poses())


def free_cell() -> SyntheticCell:
    """Synthetic cell of the free arm: a chain 3P3R at mid-range, for its calibration motion."""
    # Transforms between joint frames, whose z axes are x, y, z, x, y, z of the rig.
    turns = [rotation("y", 90), rotation("x", -90), np.eye(4)] * 2
    facing = MID_RANGE.copy()
    facing[:3, 3] = 0.0
    links = tuple(np.linalg.inv(turn) @ then for turn, then in zip(turns, [*turns[1:], facing], strict=True))
    intrinsic, poses = _cameras()
    lenses = np.tile(np.array([0.0, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1), 0.5 * WIDTH]), (2, 1))
    return SyntheticCell(
        translation(*MID_RANGE[:3, 3]) @ turns[0],
        ("prismatic",) * 3 + ("revolute",) * 3,
        links,
        MARKERS,
        intrinsic,
        poses,
        np.zeros(6),
        np.zeros(6),
        lenses,
    )


def rx90_cell() -> SyntheticCell:
    """The RX 90 with the plate at mid-range when at home."""
    body = (HOMOGENEOUS_MARKERS @ PLATE_ON_FLANGE.T)[:, :3]
    turned = MID_RANGE @ np.linalg.inv(PLATE_ON_FLANGE)
    turned[:3, 3] = 0.0
    return placed(
        ("revolute",) * 6,
        tuple(dh_link(*row) for row in RX90_ROWS),
        body,
        RX90_HOME,
        np.zeros(6),
        turned,
        cameras=_cameras(),
        distance=float(MID_RANGE[2, 3]),
    )


@dataclass(frozen=True, eq=False)
class Reach:
    """Configurations of the RX 90 at a task's start and goal, the pair with the least maximum joint motion."""

    start: FloatArray
    goal: FloatArray


def rx90_reach(cell: SyntheticCell, start: FloatArray, goal: FloatArray) -> Reach | None:
    """Configurations of the RX 90 for two poses (4, 4) of the plate within its limits; None if there are none."""
    back = np.linalg.inv(PLATE_ON_FLANGE)
    found = [inverse_kinematics(np.linalg.inv(cell.base) @ pose @ back, RX90_LIMITS) for pose in (start, goal)]
    if not (len(found[0]) and len(found[1])):
        return None
    travel = np.abs(found[0][:, None] - found[1][None]).max(axis=-1)
    i, k = np.unravel_index(int(travel.argmin()), travel.shape)
    return Reach(found[0][i], found[1][k])


# -- inverse kinematics of the RX 90 -------------------------------------------------------------------------
# Closed-form Euclidean inverse kinematics of the synthetic RX 90, for ground truth only.


UPPER, FOREARM, HAND = RX90_ROWS[1][0], RX90_ROWS[3][2], RX90_ROWS[5][2]
"""Lengths [m]: shoulder to elbow, elbow to wrist, wrist to flange."""
SHOULDER = RX90_ROWS[0][2]


def inverse_kinematics(flange: FloatArray, limits: FloatArray) -> FloatArray:
    """All configurations (k, 6) [rad] within ``limits`` (6, 2) that bring the flange to a pose (4, 4) in the base's
    frame.

    k is 0 out of reach. Angles a whole turn apart are separate configurations. At a singular wrist the fourth joint is
    left at zero; above the shoulder the first is.
    """
    wrist = flange[:3, 3] - HAND * flange[:3, 2]
    found = []
    for shoulder, elbow, flip in product((0, 1), repeat=3):
        first = np.arctan2(wrist[1], wrist[0]) + np.pi * shoulder
        along = np.cos(first) * wrist[0] + np.sin(first) * wrist[1]
        # In the plane of upper arm and forearm, x out and y down.
        x, y = along, SHOULDER - wrist[2]
        sine = (x * x + y * y - UPPER**2 - FOREARM**2) / (2.0 * UPPER * FOREARM)
        if abs(sine) > 1.0:
            continue
        third = np.pi - np.arcsin(sine) if elbow else np.arcsin(sine)
        own = np.arctan2(-FOREARM * np.cos(third), UPPER + FOREARM * np.sin(third))
        second = np.arctan2(y, x) - own
        base = np.eye(4)
        for angle, row in zip((first, second, third), RX90_ROWS, strict=False):
            base = base @ rotation("z", np.degrees(angle)) @ dh_link(*row)
        R = base[:3, :3].T @ flange[:3, :3]
        found.append((first, second, third, *_wrist(R, bool(flip))))
    return _within(np.array(found).reshape(-1, 6), limits)


def _wrist(R: FloatArray, flip: bool) -> tuple[float, float, float]:
    """Wrist angles of ``R = Rz Ry Rz``."""
    fifth = float(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2]))
    if np.sin(fifth) < 1e-9:
        turn = np.arctan2(R[1, 0], R[1, 1])
        return 0.0, fifth, float(turn)
    sign = -1.0 if flip else 1.0
    fourth = np.arctan2(sign * R[1, 2], sign * R[0, 2])
    return float(fourth), sign * fifth, float(np.arctan2(sign * R[2, 1], -sign * R[2, 0]))


def _within(angles: FloatArray, limits: FloatArray) -> FloatArray:
    """All solutions, including whole turns, that lie within the limits."""
    kept = []
    for row in angles:
        choices = []
        for angle, (low, high) in zip(row, limits, strict=True):
            first = angle + 2.0 * np.pi * np.ceil((low - angle) / (2.0 * np.pi))
            choices.append(np.arange(first, high + 1e-12, 2.0 * np.pi))
        kept.extend(product(*choices))
    return np.array(kept).reshape(-1, 6)
