"""Data types of path planning: the request with its limits, the closest approach of a path to each limit, and the
plan, a path of the marker body and the arm's joints in time.

Plain data; `planner` makes it, a slice of work at a time, so that a loop may plan while it runs.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from stereoservo.numerics.arrays import FloatArray, IntArray

Profile = Literal["linear", "exponential", "translation-first", "rotation-first", "planar-first"]
Limit = Literal["JOINT_LIMIT", "KEEP_OUT", "FIELD_OF_VIEW", "FACE_HIDDEN", "BEHIND_CAMERA", "NOT_REACHABLE"]


class PlanLimits(msgspec.Struct, frozen=True, eq=False):
    """Limits that a path must respect.

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
    """A request for a plan: from which pose to which, with what arm, cameras and limits.

    ``operators`` (n, 4, 4), ``joints`` (n,), ``points`` (m, 4) now; ``targets`` (m, 4) at the goal; ``centre``,
    ``centre_target`` (4,): heights 1. ``faces`` (f, 3): markers of the faces that must stay visible to every camera
    that sees them now and at the goal. ``kept`` (m,): 1 for markers that must stay in the images of these cameras.
    ``bend``: whether detours from ``profile``'s straight path are searched where that is not feasible.
    ``speed_scale`` (0, 1] of velocity and acceleration limits. ``posture`` (n,): joints near which the plan ends, on
    the straight line in the joints, where the arm reaches the goal by several postures.
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
    posture: FloatArray | None = None


class ClosestApproach(msgspec.Struct, frozen=True):
    """Closest approach of a path to one limit, or where it breaks it.

    ``index``: of the joint, keep-out or camera; ``marker``: index of the marker, -1 where none is meant. ``value`` and
    ``limit`` in ``unit``; ``room``: what is left, negative where the limit is broken. ``share`` in [0, 1]: the
    path parameter.
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
    """A feasible path in time: K samples from now to the goal.

    ``times`` (K,) [s] from 0, ``joints`` (K, n), ``displacements`` (K, 4, 4) of the body from its present pose,
    ``shares`` (K,): path parameters. ``way``: its name for people, e.g. "linear" or "bent away from the camera by 0.1".
    ``approaches``: the closest to every kind of limit.
    """

    times: FloatArray
    joints: FloatArray
    displacements: FloatArray
    shares: FloatArray
    way: str
    approaches: tuple[ClosestApproach, ...]
