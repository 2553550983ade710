"""A planned way of the marker body, before anything moves: what it is asked from, what it is, why there is none.

Plain data; `trajectory.planning` makes it, a slice of work at a time, so that a loop may plan while it runs.
"""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import FloatArray

IntArray = npt.NDArray[np.int64]
Profile = Literal["linear", "exponential", "translation-first", "rotation-first", "planar-first"]
Limit = Literal["JOINT_LIMIT", "KEEP_OUT", "FIELD_OF_VIEW", "FACE_HIDDEN", "BEHIND_CAMERA", "NOT_REACHABLE"]


class PlanLimits(msgspec.Struct, frozen=True, eq=False):
    """What a way must respect.

    ``position_min``, ``position_max``, ``velocity_max``, ``acceleration_max`` (n,), margins taken off already;
    ``keep_outs`` (k, n, 2) boxes in joint space. ``sizes`` (c, 2) images [px], ``lenses`` (c, 4) as
    `geometry.distortion` has them, ``view_margin_px`` from the images' borders.
    """

    position_min: FloatArray
    position_max: FloatArray
    velocity_max: FloatArray
    acceleration_max: FloatArray
    keep_outs: FloatArray
    sizes: FloatArray
    lenses: FloatArray
    view_margin_px: float


class PlanRequest(msgspec.Struct, frozen=True, eq=False):
    """From where to where, with what.

    ``operators`` (n, 4, 4), ``joints`` (n,), ``points`` (m, 4) now; ``targets`` (m, 4) at the goal; ``centre``,
    ``centre_target`` (4,): heights 1. ``faces`` (f, 3): markers of the faces whose sight is kept by every camera that
    has it now and at the goal. ``kept`` (m,): 1 for markers that must stay in the images of these cameras.
    ``bend``: whether another way than ``profile``'s straight one is looked for where that is not feasible.
    ``speed_scale`` (0, 1] of velocity and acceleration limits.
    """

    operators: FloatArray
    composition: int
    joints: FloatArray
    matrices: FloatArray
    camera_centres: FloatArray
    points: FloatArray
    targets: FloatArray
    kept: FloatArray
    centre: FloatArray
    centre_target: FloatArray
    faces: IntArray
    limits: PlanLimits
    profile: Profile = "linear"
    bend: bool = True
    speed_scale: float = 1.0


class Approach(msgspec.Struct, frozen=True):
    """How near a way comes to one limit, or where it fails on it.

    ``index``: of the joint, keep-out or camera; ``marker``: index of the marker, -1 where none is meant. ``value`` and
    ``limit`` in ``unit``; ``room``: what is left, negative where the limit is broken. ``share`` in [0, 1]: where on
    the way.
    """

    what: Limit
    index: int
    value: float
    limit: float
    unit: str
    room: float
    share: float
    marker: int = -1


class Plan(msgspec.Struct, frozen=True, eq=False):
    """A feasible way: K samples from now to the goal.

    ``times`` (K,) [s] from 0, ``joints`` (K, n), ``displacements`` (K, 4, 4) of the body from its present pose,
    ``shares`` (K,) of the way. ``way``: its name for people, e.g. "linear" or "bent away from the camera by 0.1".
    ``approaches``: the closest to every kind of limit.
    """

    times: FloatArray
    joints: FloatArray
    displacements: FloatArray
    shares: FloatArray
    way: str
    approaches: tuple[Approach, ...]
