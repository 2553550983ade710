"""A finished model as a rig again: for its residuals, its curvature and the causes of what does not fit."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.axes import stratum_frame
from stereoservo.kinematics.calibration.rig import Rig
from stereoservo.kinematics.model import CellModel


def projective_rig(model: CellModel) -> Rig:
    """The model in its own projective frame, joints counted from the base."""
    return _rig(model, np.eye(4))


def stratum_rig(model: CellModel) -> Rig:
    """The model in the best frame that its stratum has, joints counted from the base; heights 1 but projective."""
    return _rig(model, stratum_frame(model.stratum, model.plane_at_infinity, model.projective_to_euclidean))


def acting_order(model: CellModel) -> tuple[int, ...]:
    """Joints in the order in which a rig composes them: with cameras on the tip the tip's joint first."""
    order = tuple(range(len(model.joint_names)))
    return order[::-1] if model.tip_first else order


def acting_rig(model: CellModel) -> Rig:
    """`stratum_rig` with joints in `acting_order`."""
    rig, order = stratum_rig(model), list(acting_order(model))
    return Rig(tuple(rig.kinds[j] for j in order), rig.generators[order], rig.cameras, rig.points, rig.lenses)


def _rig(model: CellModel, frame: FloatArray) -> Rig:
    back = np.asarray(np.linalg.inv(frame))
    points = model.marker_points @ frame.T
    flat = model.stratum == "projective" or bool((frame == np.eye(4)).all())
    return Rig(
        model.joint_kinds,
        frame @ model.generators @ back,
        np.array([camera.matrix for camera in model.cameras]) @ back,
        points if flat else points / points[:, 3:],
        np.array([camera.lens for camera in model.cameras]),
    )
