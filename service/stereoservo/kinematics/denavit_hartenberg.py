"""Denavit-Hartenberg parameters of a calibrated metric model with standard deviations, scaled by one known length
(thesis 5.1, 5.2, 5.5.2).

Row j, base first, is the motion of joint j and the link after it: ``Rz(θ) Tz(d) Tx(a) Rx(α) Ry(β)``, with
``θ = q + theta`` for a revolute and ``d = scale q + d`` for a prismatic joint. In (5.1) link j precedes joint j: its
r_j, α_j and l_j (r is the length, l the offset; the text under it has them exchanged) are a, α and d of row j-1 here.

Conventions where the classical ones are ambiguous or fail:

- skew axes: x is the common normal, from axis j to axis j+1, so that ``a > 0`` and α lies in (-180°, 180°];
- axes that (nearly) intersect, within ``MEETING`` of the arm's size: x is along ``z_j x z_j+1``, so that α lies in
  (0°, 180°) and the small a may have either sign;
- axes (nearly) parallel, by less than ``PARALLEL``: the common normal is undefined or ill-conditioned, so d is 0 and
  a small second angle β takes its place (Hayati): x goes from the end of the previous row, normal to axis j, to axis
  j+1;
- prismatic joints have no position: their axis passes through the end of the previous row (``a = 0``), and through the
  first revolute axis if they begin the chain; if it is parallel to the adjacent axis, x is unchanged;
- the base frame is free: theta and d of row 1 are 0, and so is the d at which the first axis of another direction
  leaves those parallel to the first. The part after the last axis belongs to the tool: that row is 0.

``chosen`` lists the entries that are set by a convention and not measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.kinematics.axes import (
    Axes,
    FramedModel,
    axis_angle,
    common_normal,
    euclidean_centres,
    framed_model,
    joint_axes,
    unit,
)
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import standard_deviations
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.known_length import KnownLength
from stereoservo.numerics.arrays import FloatArray

LinkKind = Literal["skew", "meeting", "parallel", "to_prismatic", "last"]

PARALLEL = np.radians(5.0)
"""Angle between axes [rad] below which a row has β in place of d."""
MEETING = 0.01
"""Distance between axes, as a fraction of the arm's size, below which they count as intersecting."""
DH_HEADER = ("joint", "a [mm]", "α [°]", "β [°]", "d [mm]", "θ [°]", "metres of a slide's unit")
ROUNDING = 1e-9
"""Standard deviations below this fraction of the value are rounding: the value is the known length itself."""
COLUMNS = ("a", "alpha", "beta", "d", "theta")


class ReadOutError(ValueError):
    """The model does not contain the requested quantity.

    Attributes:
        code: ``stratum``, ``unknown_name``, ``length``.
        data: the values in the message.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data


class DhRow(msgspec.Struct, frozen=True):
    """Denavit-Hartenberg parameters of one link: ``a``, ``d`` [m], ``alpha``, ``beta``, ``theta`` [rad], each with its
    standard deviation.

    ``theta`` (revolute) and ``d`` (prismatic) are the offsets at joint position 0; ``scale``: metres for one unit of a
    prismatic joint. A standard deviation is None if the model contains no covariance, 0 for entries in ``chosen``.
    """

    joint: str
    kind: str
    link: LinkKind
    a: float
    alpha: float
    beta: float
    d: float
    theta: float
    scale: float | None
    a_std: float | None
    alpha_std: float | None
    beta_std: float | None
    d_std: float | None
    theta_std: float | None
    scale_std: float | None
    chosen: tuple[str, ...]


def denavit_hartenberg(model: CellModel, known: KnownLength) -> tuple[DhRow, ...]:
    """Denavit-Hartenberg rows of a metric ``model``, base first, scaled by the ``known`` length.

    Raises ReadOutError: ``stratum`` (not metric), ``unknown_name``, ``length`` (not positive, or the model's is zero).
    """
    _check_known(model, known)
    parts = framed_model(model)
    axes = axes_at_origin(parts)
    links = conventions(parts)

    def read(candidate: CellModel) -> FloatArray:
        return dh_values(framed_model(candidate), links, known, model).ravel()

    values = read(model).reshape(-1, 6)
    if not np.isfinite(values[:, :5]).all():
        raise ReadOutError("length", f"the model's {_length_name(known)} is zero: it gives no scale")
    deviations = standard_deviations(model, read)
    deviations_by_row = None if deviations is None else deviations.reshape(-1, 6)
    chosen = chosen_columns(axes, links)
    return tuple(
        _row(
            name,
            kind,
            links[j].link,
            values[j],
            None if deviations_by_row is None else deviations_by_row[j],
            chosen[j],
        )
        for j, (name, kind) in enumerate(zip(model.joint_names, parts.kinds, strict=True))
    )


def dh_cells(row: DhRow) -> tuple[str, ...]:
    """A row as text below `DH_HEADER`: values with their standard deviations, those set by a convention in brackets."""
    cells = [row.joint]
    for column in COLUMNS:
        factor = 1e3 if column in ("a", "d") else float(np.degrees(1.0))
        value, std = factor * getattr(row, column), getattr(row, f"{column}_std")
        if column in row.chosen:
            cells.append(f"({value:.6g})")
        else:
            cells.append(_with_deviation(value, None if std is None else factor * std))
    return (*cells, "" if row.scale is None else _with_deviation(row.scale, row.scale_std))


def _with_deviation(value: float, std: float | None) -> str:
    if std is None or std <= ROUNDING * abs(value):
        return f"{value:.6g}"
    return f"{value:.{decimals(std)}f} ± {std:.2g}"


def decimals(std: float) -> int:
    """Number of significant decimals for a standard deviation."""
    return max(0, 1 - math.floor(math.log10(std)))


def metres_per_length(model: CellModel, known: KnownLength) -> float:
    """Scale of the Euclidean frame of a metric ``model`` [m per unit length], from the ``known`` length.

    Raises ReadOutError as `denavit_hartenberg`.
    """
    _check_known(model, known)
    parts = framed_model(model)
    axes = axes_at_origin(parts)
    length = _length(parts, axes, dh_table(axes, conventions(parts)), known, model)
    if not length > 0.0:
        raise ReadOutError("length", f"the model's {_length_name(known)} is zero: it gives no scale")
    return known.metres / length


def _row(
    joint: str,
    kind: str,
    link: LinkKind,
    values: FloatArray,
    deviations_by_row: FloatArray | None,
    chosen: tuple[str, ...],
) -> DhRow:
    """A row from its six values and their standard deviations, if any."""
    slides = kind == "prismatic"
    columns = {column: float(value) for column, value in zip(COLUMNS, values, strict=False)}

    def std(column: str) -> float | None:
        if deviations_by_row is None:
            return None
        return 0.0 if column in chosen else float(deviations_by_row[COLUMNS.index(column)])

    return DhRow(
        joint=joint,
        kind=kind,
        link=link,
        scale=float(values[5]) if slides else None,
        scale_std=float(deviations_by_row[5]) if slides and deviations_by_row is not None else None,
        chosen=chosen,
        a_std=std("a"),
        alpha_std=std("alpha"),
        beta_std=std("beta"),
        d_std=std("d"),
        theta_std=std("theta"),
        **columns,
    )


def chosen_columns(axes: Axes, links: tuple[Convention, ...]) -> tuple[tuple[str, ...], ...]:
    """Columns of each row that are set by a convention and not measured."""
    first, leaves = base_leaves(axes)
    by_link: dict[LinkKind, set[str]] = {
        "skew": {"beta"},
        "meeting": {"beta"},
        "parallel": {"d"},
        "to_prismatic": {"a", "d"},
        "last": set(COLUMNS),
    }
    rows = []
    for j, convention in enumerate(links):
        names = set(by_link[convention.link])
        if convention.link == "to_prismatic":
            names.add("theta" if _parallel(*axes.directions[j : j + 2]) else "beta")
        if j < first and convention.link == "parallel":
            names.add("theta")
        if j == 0:
            names |= {"d", "theta"}
        if j < first:
            names |= {"a", "d"}
        if j == leaves:
            names.add("d")
        rows.append(tuple(column for column in COLUMNS if column in names))
    return tuple(rows)


def dh_values(parts: FramedModel, links: tuple[Convention, ...], known: KnownLength, names: CellModel) -> FloatArray:
    """``a, α, β, d, θ`` and the prismatic scale (n, 6) in metres; ``names``: a model with the names of ``known``."""
    axes = axes_at_origin(parts)
    table = dh_table(axes, links)
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.float64(known.metres) / _length(parts, axes, table, known, names)
        table[:, [0, 3]] *= metres
        return np.column_stack([table, axes.scales * metres])


def _length(parts: FramedModel, axes: Axes, table: FloatArray, known: KnownLength, names: CellModel) -> float:
    """The known length in the units of the frame."""
    if known.what == "markers":
        i, k = (names.marker_ids.index(int(marker)) for marker in known.of)
        return float(np.linalg.norm(parts.points[i, :3] - parts.points[k, :3]))
    if known.what == "baseline":
        cameras = [camera.name for camera in names.cameras]
        centres = euclidean_centres(parts.cameras[[cameras.index(str(name)) for name in known.of]])
        return float(np.linalg.norm(centres[1] - centres[0]))
    j = names.joint_names.index(str(known.of[0]))
    if known.what == "prismatic":
        return float(axes.scales[j])
    return float(abs(table[j, 0 if known.what == "a" else 3]))


def _length_name(known: KnownLength) -> str:
    return f"{known.what} of {', '.join(str(name) for name in known.of)}"


def _check_known(model: CellModel, known: KnownLength) -> None:
    if model.stratum != "metric":
        raise ReadOutError(
            "stratum",
            f"the model's stratum is {model.stratum!r}: angles and lengths of its axes are not identified; "
            "Denavit-Hartenberg rows need 'metric' (joint axes of two directions and more)",
            stratum=model.stratum,
        )
    if not (np.isfinite(known.metres) and known.metres > 0.0):
        raise ReadOutError("length", f"a known length of {known.metres} m; a positive one is needed")
    valid: tuple[str | int, ...]
    if known.what == "markers":
        valid, count = model.marker_ids, 2
    elif known.what == "baseline":
        valid, count = tuple(camera.name for camera in model.cameras), 2
    else:
        of_kind = {"prismatic": ("prismatic",)}.get(known.what, ("revolute", "prismatic"))
        valid, count = (
            tuple(name for name, kind in zip(model.joint_names, model.joint_kinds, strict=True) if kind in of_kind),
            1,
        )
    if len(known.of) != count or len(set(known.of)) != count or not set(known.of) <= set(valid):
        raise ReadOutError(
            "unknown_name",
            f"known length {_length_name(known)}: {count} of {', '.join(str(name) for name in valid) or 'none'} needed",
            of=known.of,
            valid=valid,
        )


@dataclass(frozen=True)
class Convention:
    """Convention of one link: its kind, and the sense of x relative to ``z_j x z_j+1`` where axes intersect."""

    link: LinkKind
    sense: float = 1.0


def conventions(parts: FramedModel) -> tuple[Convention, ...]:
    """Convention of each link of a mechanism, by the rules of this module."""
    axes = axes_at_origin(parts)
    plain = tuple(Convention(_link_kind(axes, j)) for j in range(len(axes.kinds)))
    table = dh_table(axes, plain)
    # An arm whose axes all intersect has no size: the size of the carried body is used.
    body = float(np.linalg.norm(np.ptp(parts.points[:, :3], axis=0)))
    size = max(body, float(np.abs(table[:, [0, 3]]).max()))
    result = []
    for convention, a in zip(plain, table[:, 0], strict=True):
        if convention.link != "skew":
            result.append(convention)
        elif abs(a) <= MEETING * size:
            result.append(Convention("meeting"))
        else:
            result.append(Convention("skew", float(np.sign(a))))
    return tuple(result)


def _link_kind(axes: Axes, j: int) -> LinkKind:
    if j + 1 == len(axes.kinds):
        return "last"
    if axes.kinds[j + 1] == "prismatic":
        return "to_prismatic"
    return "parallel" if _parallel(axes.directions[j], axes.directions[j + 1]) else "skew"


def _parallel(u: FloatArray, v: FloatArray) -> bool:
    angle = axis_angle(u, v)
    return bool(min(angle, float(np.pi) - angle) < PARALLEL)


def axes_at_origin(parts: FramedModel) -> Axes:
    """The axes with all joints at position 0, whatever the model's zero (5.21)."""
    chain = ProjectiveChain(parts.kinds, parts.generators, parts.zero)
    return joint_axes(parts.kinds, chain.operators_at(np.zeros(len(parts.kinds))))


def dh_table(axes: Axes, links: tuple[Convention, ...]) -> FloatArray:
    """Rows (n, 5) ``a, α, β, d, θ`` in units of the frame, of `axes_at_origin`."""
    n = len(axes.kinds)
    table = np.zeros((n, 5))
    origin = base_origin(axes)
    x: FloatArray | None = None
    for j in range(n):
        z = axes.directions[j]
        before = _square_to(z, x)
        foot, along, after = _link(axes, j, links[j], origin, before)
        table[j, :3] = after
        if j > 0:
            table[j, 3] = float((foot - origin) @ z)
            table[j, 4] = float(np.arctan2(np.cross(before, along) @ z, before @ along))
        y = np.cross(z, along)
        ca, sa, cb, sb = np.cos(after[1]), np.sin(after[1]), np.cos(after[2]), np.sin(after[2])
        # First column of Rx(α) Ry(β) in the frame (along, y, z).
        x = cb * along + sb * sa * y - sb * ca * z
        origin = foot + after[0] * along
    return table


def _link(
    axes: Axes, j: int, convention: Convention, start: FloatArray, before: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Foot point (3,) of link j on its axis, its x (3,), and ``a, α, β`` (3,).

    ``start``, ``before`` (3,): the end of the previous row and its x.
    """
    z = axes.directions[j]
    if convention.link == "last":
        return start, before, np.zeros(3)
    z_next, c_next = axes.directions[j + 1], axes.points[j + 1]
    if convention.link == "to_prismatic":
        if _parallel(z, z_next):
            return start, before, np.array([0.0, *_two_angles(z, before, z_next)])
        return start, unit(np.cross(z, z_next)), np.array([0.0, axis_angle(z, z_next), 0.0])
    if convention.link == "parallel":
        # Intersection of the next axis with the plane through the start, normal to this axis.
        arm = c_next + z_next * ((start - c_next) @ z / (z_next @ z)) - start
        length = float(np.linalg.norm(arm))
        # A prismatic axis that passes through the axis it carries: x has no direction.
        along = unit(arm) if length > 1e-9 * float(np.linalg.norm(start) + 1.0) else before
        return start, along, np.array([length, *_two_angles(z, along, z_next)])
    own = start if axes.kinds[j] == "prismatic" else axes.points[j]
    foot, foot_next = common_normal(own, z, c_next, z_next)
    along = convention.sense * unit(np.cross(z, z_next))
    angle = convention.sense * axis_angle(z, z_next)
    return foot, along, np.array([(foot_next - foot) @ along, angle, 0.0])


def _two_angles(z: FloatArray, x: FloatArray, z_next: FloatArray) -> tuple[float, float]:
    """α in [-90°, 270°) and β that turn ``z`` into ``z_next`` about ``x``, then about the new y."""
    y = np.cross(z, x)
    beta = float(np.arcsin(np.clip(z_next @ x, -1.0, 1.0)))
    alpha = float(np.arctan2(-(z_next @ y), z_next @ z))
    return float(np.remainder(alpha + 0.5 * np.pi, 2 * np.pi) - 0.5 * np.pi), beta


def _square_to(z: FloatArray, x: FloatArray | None) -> FloatArray:
    """Unit projection of ``x`` normal to ``z``, or any normal of ``z`` if there is none."""
    if x is None or np.linalg.norm(np.cross(z, x)) < 1e-3:
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
    return unit(x - z * (x @ z))


def base_leaves(axes: Axes) -> tuple[int, int]:
    """Indices of the first revolute joint, and of the last one parallel to it before an axis of another direction.

    Both are the number of joints if there is no such joint.
    """
    n = len(axes.kinds)
    placed = [j for j, kind in enumerate(axes.kinds) if kind == "revolute"]
    if not placed:
        return n, n
    for before, j in pairwise(placed):
        if not _parallel(axes.directions[placed[0]], axes.directions[j]):
            return placed[0], before
    return placed[0], n


def base_origin(axes: Axes) -> FloatArray:
    """Origin (3,) of the base, chosen so that no row contains an arbitrary length.

    It lies on the first revolute axis, at the height at which the first axis of another direction leaves those parallel
    to it.
    """
    first, last = base_leaves(axes)
    if first == len(axes.kinds):
        return np.zeros(3)
    anchor = axes.points[first]
    if last < len(axes.kinds):
        other = next(j for j in range(last + 1, len(axes.kinds)) if axes.kinds[j] == "revolute")
        foot, _ = common_normal(axes.points[last], axes.directions[last], axes.points[other], axes.directions[other])
        z = axes.directions[first]
        anchor = anchor + z * ((foot - anchor) @ z)
    return np.asarray(anchor, dtype=np.float64)
