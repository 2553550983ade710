"""Data types of path planning: the request with its limits, the closest approach of a path to each limit, and the plan,
a path of the marker body and the arm's joints in time.

Plain data; `planner` computes it in slices of work, so that the loop can plan while it runs.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from stereoservo.numerics.arrays import FloatArray, IntArray

Profile = Literal["linear", "exponential", "translation-first", "rotation-first", "planar-first"]
Limit = Literal["JOINT_LIMIT", "KEEP_OUT", "FIELD_OF_VIEW", "FACE_HIDDEN", "BEHIND_CAMERA", "NOT_REACHABLE"]


class PlanLimits(msgspec.Struct, frozen=True, eq=False):
    """Limits that a path must respect.

    ``position_min``, ``position_max``, ``velocity_max``, ``acceleration_max`` (n,), with margins already subtracted;
    ``keep_outs`` (k, n, 2) boxes in joint space. ``sizes`` (c, 2) of the images [px], ``lenses`` (c, 4) as in
    `geometry.distortion`, ``view_margin_px``: distance from the image borders [px].
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
    """A request for a plan: start and goal pose, arm, cameras and limits.

    ``operators`` (n, 4, 4), ``joints`` (n,), ``points`` (m, 4): current markers; ``targets`` (m, 4): markers at the
    goal; ``centre``, ``centre_target`` (4,): heights 1. ``faces`` (f, 3): markers of the faces that must stay visible
    to every camera that sees them now and at the goal. ``must_stay_visible`` (m,): 1 for markers that must stay in
    the images of these cameras. ``bend``: whether detours from ``profile``'s straight path are searched if that path is
    not feasible. ``speed_scale`` (0, 1] of velocity and acceleration limits. ``posture`` (n,): joints near which the
    plan ends, on the straight line in joint space, if the arm can reach the goal in several postures.
    """

    operators: FloatArray
    composition: int
    joints: FloatArray
    matrices: FloatArray
    camera_centres: FloatArray
    points: FloatArray
    targets: FloatArray
    must_stay_visible: FloatArray = msgspec.field(name="kept")
    centre: FloatArray
    centre_target: FloatArray
    faces: IntArray
    limits: PlanLimits
    profile: Profile = "linear"
    bend: bool = True
    speed_scale: float = 1.0
    posture: FloatArray | None = None


class ClosestApproach(msgspec.Struct, frozen=True):
    """Closest approach of a path to one limit, or its violation.

    ``index``: of the joint, keep-out or camera; ``marker``: index of the marker, -1 for none. ``value`` and ``limit``
    in ``unit``; ``clearance``: negative if the limit is violated. ``path_parameter`` in [0, 1].
    """

    kind: Limit = msgspec.field(name="what")
    index: int
    value: float
    limit: float
    unit: str
    clearance: float = msgspec.field(name="room")
    path_parameter: float = msgspec.field(name="share")
    marker: int = -1


class Plan(msgspec.Struct, frozen=True, eq=False):
    """A feasible path in time: K samples from the current pose to the goal.

    ``times`` (K,) [s] from 0, ``joints`` (K, n), ``displacements`` (K, 4, 4) of the body from its current pose,
    ``path_parameters`` (K,). ``description``: text for the operator, e.g. "linear" or "bent away from the camera
    by 0.1". ``approaches``: the closest approach to each kind of limit.
    """

    times: FloatArray
    joints: FloatArray
    displacements: FloatArray
    path_parameters: FloatArray = msgspec.field(name="shares")
    description: str = msgspec.field(name="way")
    approaches: tuple[ClosestApproach, ...]
