"""A calibrated metric model as URDF: joints, markers and cameras, in metres by one known length."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np

from stereoservo.geometry.strata import decompose_camera
from stereoservo.kinematics.axes import framed_model
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.denavit_hartenberg import axes_at_origin, base_origin, metres_per_length
from stereoservo.kinematics.metric_frames import base_axes
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.known_length import KnownLength
from stereoservo.numerics.arrays import FloatArray

UNBOUNDED = 1e3
"""Limit of a prismatic joint without stated limits [m]."""
FASTEST = 1.0
"""Velocity of a joint without stated limits [m/s, rad/s]: the format requires one."""


@dataclass(frozen=True, eq=False)
class MetricArm:
    """A model in metres, all joints at position 0, in its root frame.

    ``directions`` (n, 3) of the axes; ``origins`` (n, 3) on them [m]; ``scales`` (n,): URDF position of a joint divided
    by the model's, 1 for revolute joints; ``markers`` (m, 3) [m]; ``cameras`` (c, 4, 4): root from optical frame.
    ``carried``: what the last link carries, ``"markers"`` or ``"cameras"``; the others are static.
    """

    directions: FloatArray
    origins: FloatArray
    scales: FloatArray
    markers: FloatArray
    cameras: FloatArray
    carried: str


def metric_arm(model: CellModel, known: KnownLength) -> MetricArm:
    """The parts of a metric ``model`` in its root frame.

    If the arm begins with three orthogonal prismatic joints (gantries, and arms with Cartesian velocity commands, where
    it is the robot's own base), the root is the base frame: axes along them, origin where the rotations begin. For
    other arms, z is along the first axis, x towards the first axis of another direction. Raises ReadOutError
    (``stratum``, ``unknown_name``, ``length``), GeometryError.
    """
    metres = metres_per_length(model, known)
    parts = framed_model(model)
    axes = axes_at_origin(parts)
    origin, R = base_origin(axes), base_axes(axes)
    to_root = np.eye(4)
    to_root[:3, :3], to_root[:3, 3] = metres * R.T, -metres * R.T @ origin
    at_zero = ProjectiveChain(parts.kinds, parts.generators, parts.zero).displacement(np.zeros(len(parts.kinds)))
    carries_cameras = model.mount == "eye_in_hand"
    move_markers, move_cameras = (np.eye(4), at_zero) if carries_cameras else (at_zero, np.eye(4))
    cameras = np.tile(np.eye(4), (len(parts.cameras), 1, 1))
    for pose, P in zip(cameras, parts.cameras, strict=True):
        _, turn, shift = decompose_camera(P)
        moved = move_cameras @ np.vstack([np.column_stack([turn.T, -turn.T @ shift]), [0.0, 0.0, 0.0, 1.0]])
        pose[:3, :3] = R.T @ moved[:3, :3]
        pose[:3, 3] = (to_root @ moved[:, 3])[:3]
    origins = np.empty((len(parts.kinds), 3))
    place = np.zeros(3)
    for j, kind in enumerate(parts.kinds):
        if kind == "revolute":  # a prismatic joint has no position: that of the previous joint is used
            place = metres * R.T @ (axes.points[j] - origin)
            place = place - axes.directions[j] @ R * (place @ (R.T @ axes.directions[j]))
        origins[j] = place
    return MetricArm(
        axes.directions @ R,
        origins,
        np.where(np.isnan(axes.scales), 1.0, metres * axes.scales),
        (parts.points @ (to_root @ move_markers).T)[:, :3],
        cameras,
        "cameras" if carries_cameras else "markers",
    )


def urdf_text(model: CellModel, arm: MetricArm, name: str, limits: Mapping[str, tuple[float, float, float]]) -> str:
    """URDF: links ``base``, ``link_1`` … ``link_n``, ``marker_ID``, ``camera_NAME`` (optical frames).

    ``limits`` by joint: lowest, highest position, velocity [rad or m, s] in the model's units; revolute joints without
    limits are ``continuous``.
    """
    lines = [f"<robot name={quoteattr(name)}>", '  <link name="base"/>']
    before, link = np.zeros(3), "base"
    for j, joint in enumerate(model.joint_names):
        child = f"link_{j + 1}"
        low, high, fastest = limits.get(joint, (-np.inf, np.inf, FASTEST))
        kind: str = model.joint_kinds[j]
        if kind == "revolute" and not np.isfinite(low):
            kind = "continuous"
        scale = float(arm.scales[j])
        ends = [float(np.clip(scale * end, -UNBOUNDED, UNBOUNDED)) for end in (low, high)]
        bounds = "" if kind == "continuous" else f'lower="{ends[0]!r}" upper="{ends[1]!r}" '
        lines += [
            f"  <link name={quoteattr(child)}/>",
            f'  <joint name={quoteattr(joint)} type="{kind}">',
            f"    <parent link={quoteattr(link)}/><child link={quoteattr(child)}/>",
            f'    <origin xyz="{_numbers(arm.origins[j] - before)}" rpy="0 0 0"/>',
            f'    <axis xyz="{_numbers(arm.directions[j])}"/>',
            f'    <limit {bounds}effort="1000" velocity="{scale * fastest!r}"/>',
            "  </joint>",
        ]
        before, link = arm.origins[j], child
    for marker, point in zip(model.marker_ids, arm.markers, strict=True):
        pose = np.eye(4)
        pose[:3, 3] = point
        lines += _fixed(f"marker_{marker}", pose, arm.carried == "markers", link, before)
    for camera, pose in zip(model.cameras, arm.cameras, strict=True):
        lines += _fixed(f"camera_{camera.name}", pose, arm.carried == "cameras", link, before)
    return "\n".join([*lines, "</robot>"]) + "\n"


def _fixed(name: str, pose: FloatArray, carried: bool, link: str, origin: FloatArray) -> list[str]:
    """A link at ``pose`` (4, 4) in the root frame, on the last ``link`` at ``origin`` (3,), or on the base."""
    parent, shift = (link, pose[:3, 3] - origin) if carried else ("base", pose[:3, 3])
    R = pose[:3, :3]
    angles = np.array(
        [np.arctan2(R[2, 1], R[2, 2]), np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])), np.arctan2(R[1, 0], R[0, 0])]
    )
    return [
        f"  <link name={quoteattr(name)}/>",
        f'  <joint name={quoteattr(name + "_mount")} type="fixed">',
        f"    <parent link={quoteattr(parent)}/><child link={quoteattr(name)}/>",
        f'    <origin xyz="{_numbers(shift)}" rpy="{_numbers(angles)}"/>',
        "  </joint>",
    ]


def _numbers(values: FloatArray) -> str:
    return " ".join(f"{float(value):.17g}" for value in values)
