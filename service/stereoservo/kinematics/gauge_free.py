"""List of a model's gauge-invariant quantities (independent of frame and scale), named and with standard deviations,
and of those that its stratum does not determine, with the reason.

What a stratum does not determine is listed, too, with the reason. In every stratum: where a marker is seen at the
zero, how each joint moves it in each image, and where the axes are seen. Affine: coordinates in units of prismatic
joints, ratios of distances between parallel axes. Metric: angles between axes, intrinsics, vergence, all ratios
of lengths.
"""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.kinematics.axes import framed
from stereoservo.kinematics.covariance import standard_deviations
from stereoservo.kinematics.model import CellModel
from stereoservo.kinematics.quantities import (
    Group,
    affine_quantities,
    axis_images,
    lenses,
    metric_quantities,
    sights,
)
from stereoservo.numerics.arrays import FloatArray


class Quantity(msgspec.Struct, frozen=True):
    """A named quantity. ``std`` is None where the model carries no covariance.

    ``value`` is None where the model does not determine it; ``reason`` then holds the cause.
    """

    name: str
    unit: str
    value: float | None
    std: float | None
    reason: str = ""


def gauge_free_quantities(model: CellModel) -> list[Quantity]:
    """All quantities of ``model`` that its stratum determines, then what it does not, with the reason."""
    groups = _groups(model)

    def read(candidate: CellModel) -> FloatArray:
        parts = framed(candidate)
        return np.concatenate([group.values(parts) for group in groups])

    values = read(model)
    deviations = standard_deviations(model, read)
    names = [name for group in groups for name in group.names]
    rows = [
        Quantity(name, unit, float(value), None if deviations is None else float(deviations[k]))
        for k, ((name, unit), value) in enumerate(zip(names, values, strict=True))
    ]
    return rows + [Quantity(name, "", None, None, reason) for name, reason in not_identified(model)]


def not_identified(model: CellModel) -> list[tuple[str, str]]:
    """Quantities that the model leaves undetermined, with the reason: ``(name, reason)``."""
    turning = [
        name for name, kind in zip(model.joint_names, model.joint_kinds, strict=True) if kind == "revolute"
    ]
    if model.stratum == "metric":
        return [
            ("scale of lengths", "images and joint angles fix ratios only; one known length gives the scale"),
            ("place of the base and of the tool", "only what lies between the first and the last axis shows"),
        ]
    axes = (
        f"all axes of {', '.join(turning)} are parallel"
        if len(turning) > 1
        else f"{turning[0]} is the only revolute joint"
        if turning
        else "there is no revolute joint"
    )
    metric = (
        f"{axes}: stretching space along one direction changes no image; a joint that turns about another "
        "direction would settle it"
    )
    open_angles = [
        ("angles between axes and directions", metric),
        ("intrinsics and vergence", metric),
        ("ratios of lengths in different directions", metric),
    ]
    if model.stratum == "affine":
        return open_angles
    plane = (
        f"{axes}, and no prismatic joint leads out of the planes in which markers turn: a pencil of planes "
        "stays fixed, any of which may be the one at infinity"
    )
    return [("plane at infinity", plane), ("ratios of lengths on one line", plane), *open_angles]


def _groups(model: CellModel) -> list[Group]:
    parts = framed(model)
    groups = [sights(model, parts), *axis_images(model, parts), *lenses(model)]
    if model.stratum == "affine":
        groups += affine_quantities(model, parts)
    if model.stratum == "metric":
        groups += metric_quantities(model, parts)
    return [group for group in groups if group.names]
