"""The six virtual joints of an arm driven by Cartesian velocities, as a serial arm: ground truth of the cell if the
arm's controller follows its commands exactly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointSpec
from stereoservo_sim.world.camera_rig import inverse_pose
from stereoservo_sim.world.robots import Robot
from stereoservo_sim.world.simulated_cell import SimulatedCell

TO_NEXT = np.eye(4)[:, [1, 2, 0, 3]]
"""Rotation (4, 4) whose z axis is the previous x, so that x, y, z come in turn; base to first virtual joint's frame."""


def virtual_links(attitude: FloatArray) -> FloatArray:
    """Links (6, 4, 4) after the virtual joints of ``T = Tx Ty Tz A Rx Ry Rz``, the last one to the tool itself;
    ``attitude`` (3, 3): A.
    """
    turned = np.eye(4)
    turned[:3, :3] = attitude
    return np.array([TO_NEXT, TO_NEXT, turned @ TO_NEXT, TO_NEXT, TO_NEXT, np.eye(4)])


def virtual_robot(robot: Robot, tool: FloatArray, attitude: FloatArray, joints: tuple[JointSpec, ...]) -> Robot:
    """The virtual joints of ``tool`` (4, 4) on the flange of ``robot``, as an arm; ``attitude`` (3, 3): A."""
    links = virtual_links(attitude)
    links[-1] = inverse_pose(tool)
    return Robot(f"{robot.name} by twists", robot.mounted @ TO_NEXT, links, joints, np.zeros(6), np.zeros((6, 3)), ())


def virtual_cell(
    cell: SimulatedCell, tool: FloatArray, attitude: FloatArray, joints: tuple[JointSpec, ...], base: FloatArray
) -> SimulatedCell:
    """``cell`` with its arm replaced by six virtual ``joints``, laid out around ``base`` (6,)."""
    return replace(cell, robot=virtual_robot(cell.robot, tool, attitude, joints), base=base)
