"""Serial arms: forward kinematics, shapes, and URDF text; an arm from Denavit-Hartenberg rows.

This is the simulation's ground truth. The service never sees it; it learns the arm from images.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo.ports.devices import JointSpec

SHORTEST = 1e-3
"""Least length between the end points of a capsule [m]; a sphere is a capsule of this length."""
NO_EXTENT = 0.02
"""Radius [m] assumed for the inertia of a link without shapes."""


@dataclass(frozen=True)
class Capsule:
    """A capsule fixed to link ``link`` (0 is the base), in that link's joint frame: ends and radius [m]."""

    link: int
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


class UrdfPosition(NamedTuple):
    """Position of a URDF's joint ``name``: ``factor`` times that of the robot's joint of index ``joint``, plus
    ``offset`` [rad or m].
    """

    name: str
    joint: int
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class Robot:
    """A serial arm of ``n`` joints, each about or along the z axis of its frame.

    ``joints``: the machine's limits.
    ``base`` (4, 4): the first joint's frame in the world at its zero.
    ``links`` (n, 4, 4): from each joint's frame, moved, to the next one's at its zero, the last to the flange.
    ``masses`` (n,) [kg] and ``centres`` (n, 3) [m] of the links in their joints' frames.
    ``shapes``: those of link 0 are in the world.
    ``text``: the URDF that it was read from, for physics and images, mounted at ``mounted`` (4, 4) in the world, with
    the flange at its link ``flange`` and its joints at ``positions``; ``notes``: what is odd or omitted of it.
    """

    name: str
    base: FloatArray
    links: FloatArray
    joints: tuple[JointSpec, ...]
    masses: FloatArray
    centres: FloatArray
    shapes: tuple[Capsule, ...]
    text: str = ""
    positions: tuple[UrdfPosition, ...] = ()
    mounted: FloatArray = field(default_factory=lambda: np.eye(4))
    flange: str = "flange"
    notes: tuple[str, ...] = ()

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, base first."""
        return tuple(joint.name for joint in self.joints)

    @property
    def prismatic(self) -> BoolArray:
        """Which joints move along their axes, (n,)."""
        return np.array([joint.kind == "prismatic" for joint in self.joints])


def link_of_row(a: float, alpha: float, d: float) -> FloatArray:
    """Transform (4, 4) after the joint's rotation in a classic row, a, d [m], alpha [rad]: Tz(d) Tx(a) Rx(alpha)."""
    c, s = np.cos(alpha), np.sin(alpha)
    return np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, d], [0, 0, 0, 1.0]])


def joint_frames(robot: Robot, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Link poses (n, 4, 4) in the world, z along each joint's axis and moved by ``q``; and the flange pose (4, 4).

    Args:
        robot: the arm.
        q: (n,) joint positions [rad or m].
    """
    frames = np.empty((len(robot.joints), 4, 4))
    pose = robot.base
    for i, (joint, link) in enumerate(zip(robot.joints, robot.links, strict=True)):
        moved = pose.copy()
        if joint.kind == "prismatic":
            moved[:3, 3] += q[i] * pose[:3, 2]
        else:
            c, s = np.cos(q[i]), np.sin(q[i])
            moved[:, 0] = c * pose[:, 0] + s * pose[:, 1]
            moved[:, 1] = c * pose[:, 1] - s * pose[:, 0]
        frames[i] = moved
        pose = moved @ link
    return frames, pose


def flange_pose(robot: Robot, q: FloatArray) -> FloatArray:
    """Pose of the flange in the world, (4, 4), z along the last joint's axis, for ``q`` (n,)."""
    return joint_frames(robot, q)[1]


def shape_segments(robot: Robot, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The arm's capsules in the world at ``q``: end points (k, 2, 3) [m], radii (k,) [m]."""
    frames, _ = joint_frames(robot, q)
    ends = np.empty((len(robot.shapes), 2, 3))
    for i, shape in enumerate(robot.shapes):
        frame = np.eye(4) if shape.link == 0 else frames[shape.link - 1]
        for k, point in enumerate((shape.start, shape.end)):
            ends[i, k] = frame[:3, :3] @ np.array(point) + frame[:3, 3]
    return ends, np.array([shape.radius for shape in robot.shapes])


def urdf(robot: Robot) -> str:
    """The arm as URDF text: links ``link_0`` (base) .. ``link_n`` and ``flange``; joints named as the robot's."""
    lines = [f'<robot name="{robot.name}">']
    for i, mass in enumerate((10.0, *robot.masses.tolist())):
        lines.append(f'  <link name="link_{i}">')
        lines += _inertial(mass, [shape for shape in robot.shapes if shape.link == i])
        for shape in robot.shapes:
            if shape.link == i:
                lines += _cylinder(shape)
        lines.append("  </link>")
    previous = robot.base
    for i, joint in enumerate(robot.joints):
        lines += [
            f'  <joint name="{joint.name}" type="{joint.kind}">',
            f'    <parent link="link_{i}"/><child link="link_{i + 1}"/>',
            f"    {_origin(previous)}",
            '    <axis xyz="0 0 1"/>',
            f'    <limit lower="{joint.position_min!r}" upper="{joint.position_max!r}" effort="1000"'
            f' velocity="{joint.velocity_max!r}"/>',
            '    <dynamics damping="0" friction="0"/>',
            "  </joint>",
        ]
        previous = robot.links[i]
    lines += [
        '  <link name="flange">',
        *_inertial(0.1, []),
        "  </link>",
        '  <joint name="flange_mount" type="fixed">',
        f'    <parent link="link_{len(robot.joints)}"/><child link="flange"/>',
        f"    {_origin(previous)}",
        "  </joint>",
        "</robot>",
    ]
    return "\n".join(lines) + "\n"


def _numbers(values: FloatArray) -> str:
    return " ".join(f"{float(value):.17g}" for value in values)


def rotation_to_axis(axis: FloatArray) -> FloatArray:
    """Rotation (4, 4) whose z is along ``axis``."""
    z = axis / np.linalg.norm(axis)
    turn = np.eye(4)
    if z[2] > 1.0 - 1e-12:
        return turn
    x = np.cross(np.eye(3)[int(np.abs(z).argmin())], z)
    x /= np.linalg.norm(x)
    turn[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return turn


def capsule_around(link: int, points: FloatArray) -> Capsule:
    """The slimmest capsule around points (k, 3), among those along the coordinate axes and the longest extent."""
    middle = 0.5 * (points.max(axis=0) + points.min(axis=0))
    spread = points - middle
    longest = np.linalg.eigh(spread.T @ spread)[1][:, -1]
    best: tuple[float, Capsule] | None = None
    for axis in (*np.eye(3), longest):
        along = spread @ axis
        across = spread - along[:, None] * axis
        centre = 0.5 * (across.max(axis=0) + across.min(axis=0))
        radius = float(np.linalg.norm(across - centre, axis=1).max())
        low, high = float(along.min()) + radius, float(along.max()) - radius
        if high - low < SHORTEST:
            low, high = 0.5 * (low + high - SHORTEST), 0.5 * (low + high + SHORTEST)
        start, end = (middle + centre + at * axis for at in (low, high))
        volume = radius**2 * (high - low + 4.0 / 3.0 * radius)
        if best is None or volume < best[0]:
            best = volume, Capsule(link, tuple(start.tolist()), tuple(end.tolist()), max(radius, SHORTEST))
    assert best is not None
    return best[1]


def roll_pitch_yaw(pose: FloatArray) -> FloatArray:
    """Angles (3,) [rad] about the fixed axes x, y, z, in this order, of the rotation of a pose (4, 4)."""
    R = pose[:3, :3]
    return np.array([np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(np.clip(R[2, 0], -1, 1)), np.arctan2(R[1, 0], R[0, 0])])


def _origin(pose: FloatArray) -> str:
    return f'<origin xyz="{_numbers(pose[:3, 3])}" rpy="{_numbers(roll_pitch_yaw(pose))}"/>'


def _inertial(mass: float, shapes: list[Capsule]) -> list[str]:
    """URDF inertial element: mass at the centre of the shapes, inertia of a solid box around them; plausible, not
    identified.
    """
    points = np.array([p for s in shapes for p in (s.start, s.end)]) if shapes else np.zeros((1, 3))
    radius = max((s.radius for s in shapes), default=NO_EXTENT)
    size = points.max(axis=0) - points.min(axis=0) + 2 * radius
    inertia = mass / 12 * (size @ size - size**2)
    return [
        "    <inertial>",
        f'      <origin xyz="{_numbers((points.max(axis=0) + points.min(axis=0)) / 2)}"/>',
        f'      <mass value="{mass!r}"/>',
        f'      <inertia ixx="{inertia[0]:.6g}" iyy="{inertia[1]:.6g}" izz="{inertia[2]:.6g}"'
        ' ixy="0" ixz="0" iyz="0"/>',
        "    </inertial>",
    ]


def _cylinder(shape: Capsule) -> list[str]:
    start, end = np.array(shape.start), np.array(shape.end)
    axis = end - start
    length = float(np.linalg.norm(axis))
    x, y, z = axis / length
    pitch, yaw = float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x))
    return [
        "    <visual>",
        f'      <origin xyz="{_numbers((start + end) / 2)}" rpy="0 {pitch!r} {yaw!r}"/>',
        f'      <geometry><cylinder radius="{shape.radius!r}" length="{length!r}"/></geometry>',
        "    </visual>",
    ]


def _middle(shapes: list[Capsule]) -> FloatArray:
    """Centre (3,) of the bounding box of the end points of ``shapes``."""
    ends = np.array([end for shape in shapes for end in (shape.start, shape.end)])
    return np.asarray(0.5 * (ends.max(axis=0) + ends.min(axis=0)))


def _revolute(name: str, low_deg: float, high_deg: float) -> JointSpec:
    return JointSpec(
        name=name,
        kind="revolute",
        position_min=float(np.deg2rad(low_deg)),
        position_max=float(np.deg2rad(high_deg)),
        velocity_max=1.0,
        acceleration_max=4.0,
    )


RX90_ROWS = tuple(
    (a, float(np.deg2rad(alpha)), d)
    for a, alpha, d in (
        (0.0, -90, 0.42),
        (0.40, 0, 0.0),
        (0.0, 90, 0.0),
        (0.0, -90, 0.80),
        (0.0, 90, 0.0),
        (0.0, 0, 0.085),
    )
)
"""Rows (a [m], alpha [rad], d [m]) after the Stäubli RX 90 of the thesis (its section 5.5)."""

_RX90_SHAPES = (
    Capsule(0, (0, 0, 0.0), (0, 0, 0.10), 0.13),
    Capsule(1, (0, 0, 0.10), (0, 0, 0.42), 0.09),
    Capsule(2, (0, 0, 0), (0.40, 0, 0), 0.07),
    Capsule(3, (0, 0, -0.07), (0, 0, 0.07), 0.07),
    Capsule(4, (0, 0, 0), (0, 0, 0.76), 0.055),
    Capsule(5, (0, 0, -0.045), (0, 0, 0.045), 0.05),
    Capsule(6, (0, 0, 0), (0, 0, 0.12), 0.03),
)

RX90 = Robot(
    name="rx90",
    base=np.eye(4),
    links=np.stack([link_of_row(*row) for row in RX90_ROWS]),
    joints=(
        _revolute("j1", -160, 160),
        _revolute("j2", -137, 137),
        _revolute("j3", -142, 142),
        _revolute("j4", -270, 270),
        _revolute("j5", -105, 120),
        _revolute("j6", -270, 270),
    ),
    masses=np.array((20.0, 15.0, 8.0, 6.0, 2.0, 1.5)),
    centres=np.stack([_middle([s for s in _RX90_SHAPES if s.link == k]) for k in range(1, 7)]),
    shapes=_RX90_SHAPES,
)
"""Six revolute joints of `RX90_ROWS`."""
