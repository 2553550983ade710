"""Quantities that any calibrated model has, whatever its stratum: what the images show of markers, axes and lenses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.cameras import project, projection_jacobian
from stereoservo.geometry.distortion import distort, distortion_jacobian
from stereoservo.kinematics.axes import FramedModel
from stereoservo.kinematics.model import CellModel

FloatArray = npt.NDArray[np.float64]
Values = Callable[[FramedModel], FloatArray]

FARTHEST_LINE = 1e6
"""Distance from the image's middle [image widths] up to which the image of an axis is told."""


@dataclass(frozen=True)
class Group:
    """Quantities that are computed together: names with units, and their values (k,) of a framed model."""

    names: tuple[tuple[str, str], ...]
    values: Values


def sights(model: CellModel, parts: FramedModel) -> Group:
    """Raw pixels of the middle marker at the zero, and how each joint moves it (5.38)."""
    marker = _middle_marker(parts)
    label = f"marker {model.marker_ids[marker]}"
    names: list[tuple[str, str]] = []
    for camera in model.cameras:
        names += [(f"{label} in {camera.name}: {axis}", "px") for axis in ("u", "v")]
        for joint, kind in zip(model.joint_names, model.joint_kinds, strict=True):
            unit = "px/rad" if kind == "revolute" else "px/m"
            names += [(f"{label} in {camera.name}: d{axis}/d{joint}", unit) for axis in ("u", "v")]

    def values(parts: FramedModel) -> FloatArray:
        point = parts.points[marker]
        out = []
        for P, lens in zip(parts.cameras, parts.lenses, strict=True):
            ideal = project(P, point[None])[0]
            slope = distortion_jacobian(lens, ideal[None])[0] @ projection_jacobian(P, point[None])[0]
            moves = sense_of(model) * slope @ (parts.generators @ point).T
            out += [distort(lens, ideal[None])[0], moves.T.ravel()]
        return np.concatenate(out)

    return Group(tuple(names), values)


def sense_of(model: CellModel) -> float:
    """-1 where the joints carry the cameras: `framed` tells generators as of an arm that carries the markers."""
    return -1.0 if model.tip_first else 1.0


def _middle_marker(parts: FramedModel) -> int:
    """The marker nearest to the middle of the first camera's image of them."""
    pixels = project(parts.cameras[0], parts.points)
    return int(np.argmin(np.linalg.norm(pixels - pixels.mean(axis=0), axis=1)))


def axis_images(model: CellModel, parts: FramedModel) -> list[Group]:
    """Ideal images of the revolute axes at the zero: angle of the line in [0°, 180°) from u towards v, and how far to
    the right of it, looking along it, the image's middle lies.
    """
    groups = []
    for j, (joint, kind) in enumerate(zip(model.joint_names, model.joint_kinds, strict=True)):
        if kind != "revolute":
            continue
        for c, camera in enumerate(model.cameras):
            middle = np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1), 1.0])
            here = _image_line(parts, j, c)
            if abs(here @ middle) > FARTHEST_LINE * camera.width * np.linalg.norm(here[:2]):
                continue
            angle = float(np.remainder(np.arctan2(-here[0], here[1]), np.pi))

            def values(
                parts: FramedModel, j: int = j, c: int = c, angle: float = angle, middle: FloatArray = middle
            ) -> FloatArray:
                line = _image_line(parts, j, c)
                along = np.array([line[1], -line[0]])
                sense = np.sign(along @ (np.cos(angle), np.sin(angle))) / np.linalg.norm(along)
                u, v = sense * along
                # About the present angle, so that none jumps by half a turn.
                turn = np.arctan2(
                    np.cos(angle) * v - np.sin(angle) * u, np.cos(angle) * u + np.sin(angle) * v
                )
                return np.array([np.degrees(angle + turn), sense * (line @ middle)])

            label = f"axis {joint} in {camera.name}"
            groups.append(
                Group(((f"{label}: angle", "°"), (f"{label}: distance from the middle", "px")), values)
            )
    return groups


def lenses(model: CellModel) -> list[Group]:
    """Distortion where the model has any."""
    groups = []
    for c, camera in enumerate(model.cameras):
        if camera.lens[0] == 0.0:
            continue

        def values(parts: FramedModel, c: int = c) -> FloatArray:
            return parts.lenses[c, :3]

        label = f"{camera.name}: lens"
        groups.append(Group(((f"{label} k", ""), (f"{label} cu", "px"), (f"{label} cv", "px")), values))
    return groups


def _image_line(parts: FramedModel, j: int, c: int) -> FloatArray:
    """Image (3,) of the axis of joint ``j``, the line of its fixed points."""
    ends = np.linalg.svd(parts.generators[j])[2][2:]
    line = np.cross(parts.cameras[c] @ ends[0], parts.cameras[c] @ ends[1])
    return np.asarray(line / np.linalg.norm(line), dtype=np.float64)
