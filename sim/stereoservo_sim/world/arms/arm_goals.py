"""Finds goals of a demonstration for any simulated arm: configurations, and paths to them, that all cameras see."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.arms.arm_cell import LEVER, WIDEST, body_jacobian, seen_by_all
from stereoservo_sim.world.camera_rig import inverse_pose
from stereoservo_sim.world.robots import RX90, Robot, flange_pose, joint_frames
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, HAND_GOALS, SimulatedCell

DRAWN, ENOUGH = 600, 16
"""Largest number of configurations drawn, and number of good ones at which drawing ends."""
SWING = {"revolute": 0.7, "prismatic": 0.25}
"""Range of the draw about each joint's base [rad or m]; for an arm's last joint up to ``WIDEST``."""
CLEAR = {"revolute": 0.1, "prismatic": 0.02}
"""Required distance from the joints' limits, at the goal and on the path [rad or m]."""
LOOKED_AT = 9
"""Configurations of a path at which visibility is checked."""
LEAST_TURN, LEAST_WAY = 0.15, 0.03
"""A goal below both, rotation [rad] and translation [m], is too close to be used."""
STIFFEST = 0.02
"""Least ratio of smallest to largest singular value of the body's Jacobian, at the goal and on the path."""
STEPS = 30
"""Steps of the straight path; inverse kinematics is solved in each."""


def goals_of(cell: SimulatedCell) -> dict[str, FloatArray]:
    """Goal configurations (n,) of a cell by name: ``near``, ``roll`` (largest rotation), ``far``.

    At them, and on the paths to them from the base (straight in joint space and, if the arm can, straight in space),
    every camera sees every marker, and no joint reaches its limit. Raises ValueError if fewer than three are found.
    """
    if cell.robot is RX90:
        return DEMO_GOALS if cell.stand is None else HAND_GOALS
    straight = goes_straight(cell.robot, cell.base)
    good: list[tuple[float, float, FloatArray]] = []
    for q in _drawn(cell):
        turn, way = _motion(cell, q)
        if (turn > LEAST_TURN or way > LEAST_WAY) and _good(cell, q, straight):
            good.append((turn, way, q))
            if len(good) == ENOUGH:
                break
    chosen: dict[str, FloatArray] = {}
    for name, worth in (
        ("roll", lambda turn, way: turn + 0.1 * way),
        ("far", lambda turn, way: way / 0.3 + 0.3 * turn),
        ("near", lambda turn, way: -abs(turn - 0.5) - 4.0 * abs(way - 0.12)),
    ):
        if not good:
            raise ValueError(
                f"{cell.robot.name}: {len(chosen)} goals of {DRAWN} drawn configurations are seen by every camera on "
                "the whole way; three are needed: another base, or cameras farther away (distance_m)"
            )
        best = max(range(len(good)), key=lambda k: worth(good[k][0], good[k][1]))
        chosen[name] = good.pop(best)[2]
    return {name: chosen[name] for name in ("near", "roll", "far")}


def goes_straight(robot: Robot, q: FloatArray) -> bool:
    """Whether the arm's motions at ``q`` (n,) form a group: every pose it reaches is then reached on a straight path.

    True for all six degrees of freedom, a SCARA or a gantry; false for a pan-tilt head.
    """
    frames, _ = joint_frames(robot, q)
    axes, straight = frames[:, :3, 2], robot.prismatic[:, None]
    turns = np.where(straight, 0.0, axes)
    moves = np.where(straight, axes, np.cross(frames[:, :3, 3], axes))
    twists = np.concatenate([moves, turns], axis=1)
    rank = np.linalg.matrix_rank(twists, tol=1e-6)
    brackets = [
        np.concatenate([np.cross(turns[a], moves[b]) - np.cross(turns[b], moves[a]), np.cross(turns[a], turns[b])])
        for a, b in combinations(range(len(q)), 2)
    ]
    return bool(np.linalg.matrix_rank(np.array([*twists, *brackets]), tol=1e-6) == rank)


def _drawn(cell: SimulatedCell) -> Iterator[FloatArray]:
    joints, base = cell.robot.joints, cell.base
    clear = np.array([CLEAR[joint.kind] for joint in joints])
    low = np.array([joint.position_min for joint in joints]) + clear
    high = np.array([joint.position_max for joint in joints]) - clear
    swing = np.array([SWING[joint.kind] for joint in joints])
    if joints[-1].kind == "revolute" and len(joints) > 2:
        swing[-1] = WIDEST
    rng = np.random.default_rng(11)
    for _ in range(DRAWN):
        q = base + rng.uniform(0.1, 1.0) * swing * rng.uniform(-1.0, 1.0, len(base))
        yield np.clip(q, low, high)


def _body_in_rig(cell: SimulatedCell, q: FloatArray) -> FloatArray:
    flange = flange_pose(cell.robot, q)
    if cell.stand is None:
        return cell.rig.world_to_rig @ flange
    return cell.rig.world_to_rig @ inverse_pose(flange) @ cell.stand


def _flange_for(cell: SimulatedCell, seen: FloatArray) -> FloatArray:
    """Flange pose at which the rig sees the body at pose ``seen`` (4, 4)."""
    if cell.stand is None:
        return inverse_pose(cell.rig.world_to_rig) @ seen
    return cell.stand @ inverse_pose(seen) @ cell.rig.world_to_rig


def _motion(cell: SimulatedCell, q: FloatArray) -> tuple[float, float]:
    """Rotation [rad] of the body and translation [m] of its centre from the base to ``q`` (n,), in the rig's frame."""
    before, after = _body_in_rig(cell, cell.base), _body_in_rig(cell, q)
    middle = cell.body.marker_points.mean(axis=0)
    moved = (after[:3, :3] - before[:3, :3]) @ middle + after[:3, 3] - before[:3, 3]
    turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).magnitude()
    return float(turn), float(np.linalg.norm(moved))


def _good(cell: SimulatedCell, q: FloatArray, straight: bool) -> bool:
    """Whether a goal ``q`` (n,) and the paths to it are visible, within limits and away from singularities."""
    if not seen_by_all(cell, q):
        return False
    shares = np.linspace(0.0, 1.0, LOOKED_AT)[:, None]
    way = cell.base + shares * (q - cell.base)
    if straight:
        solved = straight_way(cell, q)
        if solved is None:
            return False
        way = np.concatenate([way, solved[:: max(1, len(solved) // LOOKED_AT)]])
    return all(_stiff(cell.robot, one) and seen_by_all(cell, one) for one in way)


def _stiff(robot: Robot, q: FloatArray) -> bool:
    pose = flange_pose(robot, q)
    values = np.linalg.svd(body_jacobian(robot, q, pose[:3, 3] + 0.1 * pose[:3, 2]), compute_uv=False)
    return bool(values[-1] > STIFFEST * values[0])


def straight_way(cell: SimulatedCell, q: FloatArray) -> FloatArray | None:
    """Joint path (k, n) that moves the body from the base to its pose at ``q`` (n,) on a straight line in the rig's
    frame.

    None if a joint would reach its limit or the arm cannot follow.
    """
    start, end = _body_in_rig(cell, cell.base), _body_in_rig(cell, q)
    middle = np.append(cell.body.marker_points.mean(axis=0), 1.0)
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    a, b = (start @ middle)[:3], (end @ middle)[:3]
    joints = cell.robot.joints
    clear = np.array([CLEAR[joint.kind] for joint in joints])
    low = np.array([joint.position_min for joint in joints]) + 0.9 * clear
    high = np.array([joint.position_max for joint in joints]) - 0.9 * clear
    at, way = cell.base.copy(), [cell.base]
    for share in np.linspace(0.0, 1.0, STEPS + 1)[1:]:
        seen = np.eye(4)
        seen[:3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ start[:3, :3]
        seen[:3, 3] = a + share * (b - a) - seen[:3, :3] @ middle[:3]
        at, left = joints_nearby(cell.robot, _flange_for(cell, seen), at)
        if left > 1e-3 or (at < low).any() or (at > high).any():
            return None
        way.append(at)
    return np.array(way)


def joints_nearby(robot: Robot, wanted: FloatArray, q: FloatArray) -> tuple[FloatArray, float]:
    """Joints (n,) near ``q`` (n,) that bring the flange to the pose ``wanted`` (4, 4), by Newton's method, and the
    residual before the last step [m; rotations times the lever].
    """
    for _ in range(3):
        pose = flange_pose(robot, q)
        turn = Rotation.from_matrix(wanted[:3, :3] @ pose[:3, :3].T).as_rotvec()
        error = np.concatenate([wanted[:3, 3] - pose[:3, 3], LEVER * turn])
        q = q + np.linalg.pinv(body_jacobian(robot, q, pose[:3, 3]), rcond=1e-4) @ error
    return q, float(np.abs(error).max())
