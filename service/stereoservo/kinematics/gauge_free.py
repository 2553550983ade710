"""List of a model's gauge-invariant quantities (independent of frame and scale), named and with standard deviations,
and of those that its stratum does not determine, with the reason.

In every stratum: the image of a marker at the zero, its motion by each joint in each image, and the images of the axes.
Affine: coordinates in units of prismatic joints, ratios of distances between parallel axes. Metric: angles between
axes, intrinsics, vergence, all ratios of lengths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import msgspec
import numpy as np

from stereoservo.geometry.cameras import project, projection_jacobian
from stereoservo.geometry.distortion import distort, distortion_jacobian, has_distortion
from stereoservo.kinematics.axes import FramedModel, axis_angle, camera_intrinsics, euclidean_centres, framed_model
from stereoservo.kinematics.covariance import standard_deviations
from stereoservo.kinematics.denavit_hartenberg import (
    Convention,
    axes_at_origin,
    chosen_columns,
    conventions,
    dh_table,
)
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray


class Quantity(msgspec.Struct, frozen=True):
    """A named quantity. ``std`` is None if the model contains no covariance.

    ``value`` is None if the model does not determine it; ``reason`` then holds the cause.
    """

    name: str
    unit: str
    value: float | None
    std: float | None
    reason: str = ""


def gauge_free_quantities(model: CellModel) -> list[Quantity]:
    """All quantities of ``model`` that its stratum determines, then those that it does not, with the reason."""
    groups = _groups(model)

    def read(candidate: CellModel) -> FloatArray:
        parts = framed_model(candidate)
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
    revolute = [name for name, kind in zip(model.joint_names, model.joint_kinds, strict=True) if kind == "revolute"]
    if model.stratum == "metric":
        return [
            ("scale of lengths", "images and joint angles fix ratios only; one known length gives the scale"),
            ("place of the base and of the tool", "only what lies between the first and the last axis shows"),
        ]
    axes = (
        f"all axes of {', '.join(revolute)} are parallel"
        if len(revolute) > 1
        else f"{revolute[0]} is the only revolute joint"
        if revolute
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
    parts = framed_model(model)
    groups = [marker_images(model, parts), *axis_images(model, parts), *lenses(model)]
    if model.stratum == "affine":
        groups += affine_quantities(model, parts)
    if model.stratum == "metric":
        groups += metric_quantities(model, parts)
    return [group for group in groups if group.names]


# -- the quantities ------------------------------------------------------------------------------------------
# Functions of a calibrated model that give its gauge-invariant quantities, with names and units: images of markers and
# axes, lenses, and the affine or metric quantities of its stratum.


Values = Callable[[FramedModel], FloatArray]

FARTHEST_LINE = 1e6
"""Distance from the image centre [image widths] up to which the image of an axis is listed."""


@dataclass(frozen=True)
class Group:
    """Quantities that are computed together: names with units, and a function of a framed model that returns their
    values (k,).
    """

    names: tuple[tuple[str, str], ...]
    values: Values


def marker_images(model: CellModel, parts: FramedModel) -> Group:
    """Quantities of the markers' images: raw pixels of the central marker at the zero, its motion by each joint
    (5.38).
    """
    marker = _central_marker(parts)
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
            moves = motion_sign(model) * slope @ (parts.generators @ point).T
            out += [distort(lens, ideal[None])[0], moves.T.ravel()]
        return np.concatenate(out)

    return Group(tuple(names), values)


def motion_sign(model: CellModel) -> float:
    """Sign of joint motion: -1 if the joints carry the cameras, because `framed_model` returns generators with the
    signs of an arm that carries the markers.
    """
    return -1.0 if model.tip_first else 1.0


def _central_marker(parts: FramedModel) -> int:
    """Marker nearest to the centroid of the markers in the first camera's image."""
    pixels = project(parts.cameras[0], parts.points)
    return int(np.argmin(np.linalg.norm(pixels - pixels.mean(axis=0), axis=1)))


def axis_images(model: CellModel, parts: FramedModel) -> list[Group]:
    """Quantities of the revolute axes' ideal images at the zero: angle of the line in [0°, 180°) from u towards v,
    and signed distance of the image's centre to its right.
    """
    groups = []
    for j, (joint, kind) in enumerate(zip(model.joint_names, model.joint_kinds, strict=True)):
        if kind != "revolute":
            continue
        for c, camera in enumerate(model.cameras):
            image_centre = np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1), 1.0])
            here = _image_line(parts, j, c)
            if abs(here @ image_centre) > FARTHEST_LINE * camera.width * np.linalg.norm(here[:2]):
                continue
            angle = float(np.remainder(np.arctan2(-here[0], here[1]), np.pi))

            def values(
                parts: FramedModel,
                j: int = j,
                c: int = c,
                angle: float = angle,
                image_centre: FloatArray = image_centre,
            ) -> FloatArray:
                line = _image_line(parts, j, c)
                along = np.array([line[1], -line[0]])
                sense = np.sign(along @ (np.cos(angle), np.sin(angle))) / np.linalg.norm(along)
                u, v = sense * along
                # Relative to the current angle, so that none jumps by half a turn.
                turn = np.arctan2(np.cos(angle) * v - np.sin(angle) * u, np.cos(angle) * u + np.sin(angle) * v)
                return np.array([np.degrees(angle + turn), sense * (line @ image_centre)])

            label = f"axis {joint} in {camera.name}"
            groups.append(Group(((f"{label}: angle", "°"), (f"{label}: distance from the middle", "px")), values))
    return groups


def lenses(model: CellModel) -> list[Group]:
    """Quantities of lens distortion, if the model has any."""
    groups = []
    for c, camera in enumerate(model.cameras):
        if not has_distortion(camera.lens):
            continue

        label, terms = f"{camera.name}: lens", ("k2", "p1", "p2") if len(camera.lens) > 4 else ()
        free = [0, 1, 2, 4, 5, 6][: 3 + len(terms)]

        def values(parts: FramedModel, c: int = c, free: list[int] = free) -> FloatArray:
            return parts.lenses[c, free]

        names = [(f"{label} k", ""), (f"{label} cu", "px"), (f"{label} cv", "px")]
        groups.append(Group((*names, *((f"{label} {term}", "") for term in terms)), values))
    return groups


def _image_line(parts: FramedModel, j: int, c: int) -> FloatArray:
    """Image (3,) of the axis of joint ``j``, the line of its fixed points."""
    ends = np.linalg.svd(parts.generators[j])[2][2:]
    line = np.cross(parts.cameras[c] @ ends[0], parts.cameras[c] @ ends[1])
    return np.asarray(line / np.linalg.norm(line), dtype=np.float64)


INDEPENDENT = 1e-3
"""Smallest over largest singular value of prismatic unit directions from which on they span space."""
PARALLEL = 1e-2
"""Sine of the angle [affine frame] up to which axes of an affine model count as parallel."""

LEAST = 0.1
"""Smallest length of the arm, as a fraction of the cell's largest, that may be the unit of ratios: noise must not be.
"""


def affine_quantities(model: CellModel, parts: FramedModel) -> list[Group]:
    slides = [j for j, kind in enumerate(parts.kinds) if kind == "prismatic"]
    groups = []
    if len(slides) >= 3:
        groups += _coordinates(model, parts, slides)
    if len(slides) < 3:
        groups += _heights(model, parts, slides)
    return groups + _parallel_axes(model, parts)


def _spanning(parts: FramedModel, slides: list[int]) -> list[int]:
    """The first three prismatic joints whose directions span space, or an empty list."""
    steps = parts.generators[slides, :3, 3]
    steps = steps / np.linalg.norm(steps, axis=1)[:, None]
    chosen: list[int] = []
    for k in range(len(slides)):
        trial = steps[[*chosen, k]]
        values = np.linalg.svd(trial, compute_uv=False)
        if values[-1] > INDEPENDENT * values[0]:
            chosen.append(k)
        if len(chosen) == 3:
            return [slides[k] for k in chosen]
    return []


def _coordinates(model: CellModel, parts: FramedModel, slides: list[int]) -> list[Group]:
    """Quantities: vectors from the first marker to each other one, in units of three spanning prismatic joints."""
    basis = _spanning(parts, slides)
    if not basis or len(parts.points) < 2:
        return []
    first = model.marker_ids[0]
    names = tuple(
        (f"marker {other} from {first} along {model.joint_names[j]}", "joint units")
        for other in model.marker_ids[1:]
        for j in basis
    )

    def values(parts: FramedModel) -> FloatArray:
        steps = parts.generators[basis, :3, 3]
        offsets = parts.points[1:, :3] - parts.points[0, :3]
        return np.asarray(np.linalg.solve(steps.T, offsets.T).T.ravel(), dtype=np.float64)

    return [Group(names, values)]


def _heights(model: CellModel, parts: FramedModel, slides: list[int]) -> list[Group]:
    """Quantities: heights of markers along a revolute axis, in units of a prismatic joint that is not normal to it."""
    revolute = [j for j, kind in enumerate(parts.kinds) if kind == "revolute"]
    if not revolute or not slides or len(parts.points) < 2:
        return []
    j, k = revolute[-1], slides[0]
    normal = _rotation_plane(parts.generators[j])
    step = parts.generators[k, :3, 3]
    if abs(normal @ step) < INDEPENDENT * np.linalg.norm(normal) * np.linalg.norm(step):
        return []
    first = model.marker_ids[0]
    names = tuple(
        (
            f"marker {other} above {first} along axis {model.joint_names[j]}",
            f"units of {model.joint_names[k]}",
        )
        for other in model.marker_ids[1:]
    )

    def values(parts: FramedModel) -> FloatArray:
        normal = _rotation_plane(parts.generators[j])
        heights = (parts.points[1:, :3] - parts.points[0, :3]) @ normal
        return np.asarray(heights / (normal @ parts.generators[k, :3, 3]), dtype=np.float64)

    return [Group(names, values)]


def _rotation_plane(G: FloatArray) -> FloatArray:
    """Normal covector (3,) of the planes of an affine rotation: the left kernel of its 3x3 block."""
    result: FloatArray = np.linalg.svd(G[:3, :3].T)[2][2]
    return result


def _parallel_axes(model: CellModel, parts: FramedModel) -> list[Group]:
    """Quantities of three successive parallel revolute axes: ratio of distances, and the angle at the middle one."""
    revolute = [j for j, kind in enumerate(parts.kinds) if kind == "revolute"]
    groups = []
    for three in zip(revolute, revolute[1:], revolute[2:], strict=False):
        directions = np.array([_axis_direction(parts.generators[j]) for j in three])
        if np.linalg.norm(np.cross(directions[0], directions[1:]), axis=1).max() > PARALLEL:
            continue
        a, b, c = (model.joint_names[j] for j in three)

        def values(parts: FramedModel, three: tuple[int, int, int] = three) -> FloatArray:
            G = parts.generators[three[1]]
            before, after = (_plane_arm(G, parts.generators[j]) for j in (three[0], three[2]))
            ratio = np.linalg.norm(after) / np.linalg.norm(before)
            angle = np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after)
            return np.array([ratio, np.degrees(np.remainder(angle, 2 * np.pi))])

        names = (
            (f"distance of axes {b} {c} over {a} {b}", ""),
            (f"angle from axis {a} over {b} to {c} at the zero", "°"),
        )
        groups.append(Group(names, values))
    return groups


def _axis_direction(G: FloatArray) -> FloatArray:
    """Direction (3,) of the axis of an affine rotation: the kernel of its 3x3 block, at unit length."""
    result: FloatArray = np.linalg.svd(G[:3, :3])[2][2]
    return result


def _fixed_point(G: FloatArray) -> FloatArray:
    """A point (3,) on the axis of an affine rotation."""
    return np.asarray(-np.linalg.pinv(G[:3, :3], rcond=1e-6) @ G[:3, 3], dtype=np.float64)


def _plane_arm(G: FloatArray, other: FloatArray) -> FloatArray:
    """Vector (2,) from the axis of ``G`` to that of ``other``, in an orthonormal frame of the plane of rotation.

    ``A³ = -A``: ``-A²`` projects along the axis, and ``e``, ``A e`` are orthogonal and of equal length.
    """
    A = G[:3, :3]
    plane = -(A @ A)
    e = plane[:, int(np.argmax(np.linalg.norm(plane, axis=0)))]
    frame = np.column_stack([e, A @ e])
    arm = plane @ (_fixed_point(other) - _fixed_point(G))
    return np.asarray(np.linalg.lstsq(frame, arm, rcond=None)[0], dtype=np.float64)


def metric_quantities(model: CellModel, parts: FramedModel) -> list[Group]:
    links = conventions(parts)
    return [
        *(_intrinsics(camera.name, c) for c, camera in enumerate(model.cameras)),
        *(_vergence(model, c) for c in range(1, len(model.cameras))),
        *_axis_angles(model, links),
        _lengths(model, parts, links),
    ]


def _intrinsics(name: str, c: int) -> Group:
    def values(parts: FramedModel) -> FloatArray:
        return camera_intrinsics(parts.cameras[c])

    return Group(tuple((f"{name}: {part}", "px") for part in ("fx", "skew", "fy", "u0", "v0")), values)


def _vergence(model: CellModel, c: int) -> Group:
    names = ((f"vergence {model.cameras[0].name} {model.cameras[c].name}", "°"),)

    def values(parts: FramedModel) -> FloatArray:
        # The third row of a Euclidean camera's left block is its optical axis.
        one, other = parts.cameras[0][2, :3], parts.cameras[c][2, :3]
        return np.array([np.degrees(axis_angle(one, other))])

    return Group(names, values)


def _axis_angles(model: CellModel, links: tuple[Convention, ...]) -> list[Group]:
    """Quantities: angles between successive axes; for nearly parallel revolute axes Hayati's two small signed
    angles.
    """
    two = [link.link == "parallel" and kind == "revolute" for link, kind in zip(links, model.joint_kinds, strict=True)]
    names: list[tuple[str, str]] = []
    for (a, b), signed in zip(pairwise(model.joint_names), two, strict=False):
        label = f"angle of axes {a} {b}"
        parts_of = (" about their normal", " within their plane") if signed else ("",)
        names += [(label + part, "°") for part in parts_of]

    def values(parts: FramedModel) -> FloatArray:
        axes = axes_at_origin(parts)
        table = dh_table(axes, links)
        out: list[float] = []
        for j, (u, v) in enumerate(pairwise(axes.directions)):
            out += list(table[j, 1:3]) if two[j] else [axis_angle(u, v)]
        return np.degrees(out)

    return [Group(tuple(names), values)] if names else []


def _lengths(model: CellModel, parts: FramedModel, links: tuple[Convention, ...]) -> Group:
    """Quantities: common normals, offsets along axes, baselines, marker distances, prismatic units, divided by the
    arm's largest length.
    """
    named = _named_lengths(model, parts, links)
    measured = _measured_lengths(parts, links)
    usable = [k for k, (_, arm) in enumerate(named) if arm and abs(measured[k]) > LEAST * np.abs(measured).max()]
    if not usable:  # all axes intersect: the first baseline, or the first distance of markers
        usable = [next(k for k, (name, arm) in enumerate(named) if name.startswith(("baseline", "distance")))]
    largest = max(usable, key=lambda k: abs(measured[k]))
    unit = named[largest][0]
    kept = [k for k, (name, _) in enumerate(named) if k != largest and name]

    def values(parts: FramedModel) -> FloatArray:
        lengths = _measured_lengths(parts, links)
        return np.asarray(lengths[kept] / abs(lengths[largest]), dtype=np.float64)

    return Group(tuple((f"{named[k][0]} over {unit}", "") for k in kept), values)


def _named_lengths(model: CellModel, parts: FramedModel, links: tuple[Convention, ...]) -> list[tuple[str, bool]]:
    """Name of each measured length and whether it belongs to the arm; the name is empty if a convention sets it."""
    chosen_of = chosen_columns(axes_at_origin(parts), links)
    names: list[tuple[str, bool]] = []
    for j, joint in enumerate(model.joint_names):
        chosen = chosen_of[j]
        names += [("" if column in chosen else f"{column} of {joint}", column not in chosen) for column in ("a", "d")]
        names.append((f"unit of {joint}", True) if parts.kinds[j] == "prismatic" else ("", False))
    left = model.cameras[0].name
    names += [(f"baseline {left} {camera.name}", False) for camera in model.cameras[1:]]
    first = model.marker_ids[0]
    return names + [(f"distance of markers {first} {other}", False) for other in model.marker_ids[1:]]


def _measured_lengths(parts: FramedModel, links: tuple[Convention, ...]) -> FloatArray:
    axes = axes_at_origin(parts)
    table = dh_table(axes, links)
    arm = np.column_stack([table[:, 0], table[:, 3], np.nan_to_num(axes.scales)]).ravel()
    centres = euclidean_centres(parts.cameras)
    points = parts.points[:, :3]
    return np.concatenate(
        [
            arm,
            np.linalg.norm(centres[1:] - centres[0], axis=1),
            np.linalg.norm(points[1:] - points[0], axis=1),
        ]
    )
