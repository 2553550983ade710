"""Frames of a calibrated metric model by which people state steps (tool, base, cameras, points of the scene), in metres
by one known length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.geometry.strata import decompose_camera
from stereoservo.kinematics.axes import Axes, FramedModel, framed_model, stratum_frame, unit
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.denavit_hartenberg import ReadOutError, axes_at_origin, base_origin, metres_per_length
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import MetricFrame
from stereoservo.messages.known_length import KnownLength, known_length_of
from stereoservo.numerics.arrays import FloatArray

SQUARE = np.radians(2.0)
"""Smallest angle [rad] between axes of two directions, and largest deviation from right angles of three prismatic
joints that count as the axes of a base.
"""


def scale_length(model: CellModel, text: str) -> KnownLength:
    """The known length stated by ``text``, else the unit of the first prismatic joint. Raises ReadOutError (``length``)
    if there is neither, or ``text`` is invalid.
    """
    slides = [n for n, kind in zip(model.joint_names, model.joint_kinds, strict=True) if kind == "prismatic"]
    if not text and slides:
        return KnownLength("prismatic", (slides[0],), 1.0)
    if not text:
        raise ReadOutError(
            "length",
            "turning joints alone leave the model's scale open, and no length is known: state one as --length "
            "WHAT:OF=METRES, markers:10,11=0.05 say, or as calibration.known_length in the cell file",
        )
    try:
        return known_length_of(text)
    except ValueError as error:
        raise ReadOutError("length", str(error)) from error


def rotation(vector: FloatArray) -> FloatArray:
    """Rotation (3, 3) of a rotation ``vector`` (3,) [rad]. By NumPy alone: the gateway loads no kernels for it."""
    angle = float(np.linalg.norm(vector))
    across = np.cross(vector / (angle or 1.0), np.eye(3)).T
    return np.asarray(np.eye(3) + np.sin(angle) * across + 2.0 * np.sin(0.5 * angle) ** 2 * across @ across)


def base_axes(axes: Axes) -> FloatArray:
    """Axes (3, 3) of the base, as columns: along three orthogonal prismatic joints if the arm begins with them, else z
    along the first axis and x towards the first axis of another direction.
    """
    D = axes.directions
    if axes.kinds[:3] == ("prismatic",) * 3:
        u, _, vt = np.linalg.svd(D[:3].T)
        nearest: FloatArray = u @ vt
        if np.linalg.det(nearest) > 0 and np.abs(D[:3].T - nearest).max() < SQUARE:
            return nearest
    return _axes_along(np.vstack([D, np.eye(3)]))


def _axes_along(directions: FloatArray) -> FloatArray:
    """Axes (3, 3), as columns: z along the first of the ``directions`` (k, 3), x towards the next that differs."""
    z = directions[0]
    other = next(w for w in directions[1:] if np.linalg.norm(np.cross(w, z)) > np.sin(SQUARE))
    x = unit(other - z * (other @ z))
    return np.column_stack([x, np.cross(z, x), z])


class _Placed(NamedTuple):
    """A frame in `framed_model`, at the model's zero: ``axes`` (3, 3) as columns, ``origin`` (3,), and whether it is
    ``carried`` by the arm's last link.
    """

    axes: FloatArray
    origin: FloatArray
    carried: bool


def metric_frame(
    model: CellModel, name: str, known: KnownLength | None, scene: FloatArray | None, centre: tuple[int, ...]
) -> MetricFrame:
    """The frame ``name`` of a metric ``model``: ``tool``, ``base``, ``camera:NAME`` or ``scene:…``.

    ``known``: the length that scales it; None: unscaled, for turns. ``scene`` (3, 4): points of a scene frame in the
    model's. ``centre``: ids of markers about whose middle a turn is made; empty: about the tool's origin. Raises
    ReadOutError (``stratum``, ``axes``, ``points``, ``unknown_name``, ``length``).
    """
    if model.stratum != "metric":
        raise ReadOutError(
            "stratum",
            f"the model's stratum is {model.stratum!r}: lengths and angles are not known in it. A metric model is "
            "needed: calibrate with joint axes of two directions or more",
        )
    parts = framed_model(model)
    in_hand = model.mount == "eye_in_hand"
    metres = 1.0 if known is None else metres_per_length(model, known)
    axes, origin, carried = _placed(model, parts, name, scene)
    pose, upgrade = np.eye(4), stratum_frame(model.stratum, model.plane_at_infinity, model.projective_to_euclidean)
    pose[:3, :3], pose[:3, 3] = axes / metres, origin
    rows = [model.marker_ids.index(marker) for marker in centre]
    middle = parts.points[rows, :3].mean(axis=0) if rows else _tool_origin(parts, in_hand)
    return MetricFrame(
        name=name,
        pose=tuple((np.linalg.inv(upgrade) @ pose).ravel().tolist()),
        with_body=carried != in_hand,
        pivot=tuple((metres * axes.T @ (middle - origin)).tolist()),
        pivot_with_body=bool(rows) or not in_hand,
        scaled=known is not None,
    )


def _placed(model: CellModel, parts: FramedModel, name: str, scene: FloatArray | None) -> _Placed:
    in_hand = model.mount == "eye_in_hand"
    if name.startswith("camera:"):
        cameras = [f"camera:{camera.name}" for camera in model.cameras]
        if name not in cameras:
            raise ReadOutError("unknown_name", f"the model has no {name}; it has {', '.join(cameras)}: calibrate again")
        _, R, t = decompose_camera(parts.cameras[cameras.index(name)])
        return _Placed(R.T, -R.T @ t, in_hand)
    if scene is not None:
        return _Placed(*_by_points(model, scene), False)
    axes = axes_at_origin(parts)
    D = axes.directions
    if not (np.linalg.norm(np.cross(D, D[0]), axis=1) > np.sin(SQUARE)).any():
        raise ReadOutError(
            "axes",
            f"all joint axes of this arm are parallel, so x and y of the {name} frame are undefined: state the step in "
            "camera:NAME or scene:A-B-C",
        )
    if name == "base":
        return _Placed(base_axes(axes), base_origin(axes), False)
    to_origin = ProjectiveChain(parts.kinds, parts.generators, parts.zero).displacement(np.zeros(len(parts.kinds)))
    return _Placed(to_origin[:3, :3].T @ _axes_along(D[::-1]), _tool_origin(parts, in_hand), True)


def _tool_origin(parts: FramedModel, in_hand: bool) -> FloatArray:
    """Origin (3,) of the tool at the model's zero: the middle of the markers, or the centre of the first camera."""
    if not in_hand:
        return np.asarray(parts.points[:, :3].mean(axis=0))
    _, R, t = decompose_camera(parts.cameras[0])
    return -R.T @ t


def _by_points(model: CellModel, scene: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Axes and origin by three points (3, 4): from the first, x to the second, y on the side of the third."""
    points = scene @ stratum_frame(model.stratum, model.plane_at_infinity, model.projective_to_euclidean).T
    a, b, c = points[:, :3] / points[:, 3:]
    x, across = b - a, np.cross(b - a, c - a)
    if not np.linalg.norm(across) > np.sin(SQUARE) * np.linalg.norm(x) * np.linalg.norm(c - a):
        raise ReadOutError("points", "the three points lie on one line; a frame needs three that do not")
    x, z = unit(x), unit(across)
    return np.column_stack([x, np.cross(z, x), z]), a
