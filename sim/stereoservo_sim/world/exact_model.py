"""Exact models of synthetic cells and of the simulated cell: the result of a calibration without noise."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.cameras import pixel_normaliser
from stereoservo.geometry.strata import euclidean_to_projective
from stereoservo.kinematics.model import MODEL_SCHEMA, CameraModel, CellModel, FitStatistics, Stratum
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.robots import joint_frames
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.synthetic import SyntheticCell


def twists(cell: SyntheticCell, zero: FloatArray) -> FloatArray:
    """Twists (n, 4, 4) of the joints in the rig's frame at ``zero`` (n,), base first."""
    points, directions = cell.axes(zero)
    if cell.mount == "eye_in_hand":
        to_rig = np.linalg.inv(cell.flange(zero))
        points = points @ to_rig[:3, :3].T + to_rig[:3, 3]
        directions = -directions @ to_rig[:3, :3].T
    result = np.zeros((len(cell.kinds), 4, 4))
    for T, kind, c, w in zip(result, cell.kinds, points, directions, strict=True):
        if kind == "revolute":
            T[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
            T[:3, 3] = -T[:3, :3] @ c
        else:
            T[:3, 3] = w
    return result


def exact_model(
    cell: SyntheticCell,
    zero: FloatArray | None = None,
    stratum: Stratum = "metric",
    plane: tuple[float, float, float, float] = (0.05, -0.03, 0.4, 0.3),
) -> CellModel:
    """Model of ``cell`` in the canonical projective frame with ``plane`` as its plane at infinity.

    ``plane`` must not pass between the markers as seen from the left camera; the default is clear of them for cameras
    of ordinary focal lengths. ``zero``: joint zeros, home if None. ``stratum``: of the model.
    """
    zero = cell.home if zero is None else zero
    normaliser = pixel_normaliser(cell.width, cell.height)
    to_left, infinity = cell.poses[0], np.array(plane)
    frame = euclidean_to_projective(infinity, normaliser @ cell.intrinsics[0])
    change = frame @ to_left
    back = np.linalg.inv(change)
    cameras = np.array([K @ pose[:3] for K, pose in zip(cell.intrinsics, cell.poses, strict=True)]) @ back
    return CellModel(
        schema=MODEL_SCHEMA,
        epoch=1,
        joint_names=cell.joint_names,
        joint_kinds=cell.kinds,
        zero=np.asarray(zero, dtype=np.float64),
        generators=change @ twists(cell, zero) @ back,
        cameras=tuple(
            CameraModel(f"cam{c}", matrix, cell.width, cell.height, lens)
            for c, (matrix, lens) in enumerate(zip(cameras, cell.lenses, strict=True))
        ),
        marker_ids=cell.marker_ids,
        marker_points=cell.markers(np.atleast_2d(zero))[0] @ change.T,
        plane_at_infinity=infinity,
        stratum=stratum,
        projective_to_euclidean=np.linalg.inv(frame) if stratum == "metric" else None,
        statistics=None,
        mount=cell.mount,
    )


def exact_simulated_model(cell: SimulatedCell, seed: int) -> CellModel:
    """Model of the simulated cell with its base as zero, in a projective frame drawn with ``seed``."""
    frames, flange = joint_frames(cell.robot, cell.base)
    generators = np.zeros((len(cell.base), 4, 4))
    for twist, frame, joint in zip(generators, frames, cell.robot.joints, strict=True):
        if joint.kind == "prismatic":
            twist[:3, 3] = frame[:3, 2]
            continue
        x, y, z = frame[:3, 2]
        twist[:3, :3] = [(0, -z, y), (z, 0, -x), (-y, x, 0)]
        twist[:3, 3] = -twist[:3, :3] @ frame[:3, 3]
    points = np.column_stack([cell.marker_positions(cell.base), np.ones(len(cell.body.ids))])
    if cell.stand is not None:  # everything in the flange's frame
        back = np.linalg.inv(flange)
        generators = -back @ generators @ flange
        points = points @ back.T
    H = np.eye(4) + 0.3 * np.random.default_rng(seed).standard_normal((4, 4))
    inverse = np.linalg.inv(H)
    plane = np.array([0, 0, 0, 1.0]) @ H
    points = points @ inverse.T
    return CellModel(
        schema=MODEL_SCHEMA, epoch=3, joint_names=cell.robot.joint_names,
        joint_kinds=tuple(joint.kind for joint in cell.robot.joints),
        zero=cell.base, generators=inverse @ generators @ H,
        cameras=tuple(CameraModel(c.name, c.P @ H, c.width, c.height, c.lens) for c in cell.rig.cameras),
        marker_ids=tuple(int(i) for i in cell.body.ids), marker_points=points / (points @ plane)[:, None],
        plane_at_infinity=plane, stratum="metric", projective_to_euclidean=H,
        statistics=FitStatistics(0.01, 1.0, 1, True, 1, 0, 0, (), 1),
        mount="eye_to_hand" if cell.stand is None else "eye_in_hand",
    )  # fmt: skip
