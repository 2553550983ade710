"""Mobility of an arm at its current posture: which translations and rotations of the body it can make, described in
words, and which part of a required motion it lacks (thesis 7.3.3, 8; errata, deficient arms).

A numerical criterion on the Jacobian of the body's points, in orthogonal coordinates whose unit is the body's radius.
Used by planning and for refusals; the loop calls `mobility_kernel`. No LAPACK, no BLAS: the core uses its results in
refusals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.control.mobility_kernel import (
    brackets,
    cross,
    drivable_freedoms,
    joints_to_block,
    least_squares,
    multiply,
    point_jacobian,
)
from stereoservo.geometry.homogeneous import GeometryError, plane_of_points
from stereoservo.geometry.screws import twist_matrix
from stereoservo.kinematics.kernels import image_jacobian, invert4, symmetric_eigen4
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.linear import null_direction, right_singular

FOCAL_PX = 1000.0
"""A typical focal length."""

GUESS = 1e-3
"""Weight of the assumptions of a typical focal length and of a principal point at the body: they matter only if nothing
else determines the metric.
"""


def body_frame(
    generators: FloatArray,
    matrices: FloatArray,
    points: FloatArray,
    plane_at_infinity: FloatArray,
    H_projective_to_euclidean: FloatArray | None = None,
) -> FloatArray:
    """``E`` (4, 4) that maps the body's own coordinates to the model's frame: columns x, y, z and the centroid.

    x to the right in the image of the first camera, y down, z towards the camera, orthonormal except for one unit, the
    rms distance of ``points`` (m, 4) from their centroid.

    ``generators`` (n, 4, 4): of rigid motions; ``matrices`` (c, 3, 4).

    Raises GeometryError for a camera at the body's centroid, coincident points, estimates that are no metric, and
    values that are not finite.
    """
    for name, value in (("generators", generators), ("cameras", matrices), ("points", points)):
        if not np.isfinite(value).all():
            raise GeometryError("not_finite", f"the {name} are not finite")
    centroid = (points / (points * plane_at_infinity).sum(axis=1)[:, None]).mean(axis=0)
    flat = _directions(plane_at_infinity)
    if H_projective_to_euclidean is None:
        Q = _estimate_metric(generators, matrices, centroid, flat)
    else:
        axes = multiply(H_projective_to_euclidean[:3], flat)
        Q = multiply(axes.T, axes)
    heights = (points * plane_at_infinity).sum(axis=1)[:, None]
    offsets = multiply(points / heights - centroid, flat)
    radius = float(np.sqrt((multiply(offsets, Q) * offsets).sum() / len(points)))
    P = matrices[0]
    m = (P * centroid).sum(axis=1)
    centre = plane_of_points(P[0], P[1], P[2])
    # Towards the camera, of any height: a centre at infinity is a direction. The depth determines the sign.
    approach = multiply(flat.T, (centre - float((centre * plane_at_infinity).sum()) * centroid)[:, None])[:, 0]
    size = _length(approach, Q)
    if not (size > 0.0 and radius > 1e-9 * size):
        raise GeometryError("degenerate", "the body has no size, or a camera is at its centre", radius=radius)
    z = approach / size
    if float((P[2] * (flat * z).sum(axis=1)).sum()) * float(m[2]) > 0.0:
        z = -z
    g = multiply((P[:2] - (m[:2] / m[2])[:, None] * P[2]) / m[2], flat)
    aa, ab, bb = float((g[0] * g[0]).sum()), float((g[0] * g[1]).sum()), float((g[1] * g[1]).sum())
    x = _without(bb * g[0] - ab * g[1], z, Q)
    x = x / _length(x, Q)
    y = _without(_without(aa * g[1] - ab * g[0], z, Q), x, Q)
    y = y / _length(y, Q)
    E = np.empty((4, 4))
    E[:, :3] = radius * multiply(flat, np.column_stack([x, y, z]))
    E[:, 3] = centroid
    return E


def _length(v: FloatArray, Q: FloatArray) -> float:
    return float(np.sqrt(max(0.0, _product(v, v, Q))))


def _product(v: FloatArray, w: FloatArray, Q: FloatArray) -> float:
    return float((Q * v[:, None] * w).sum())


def _without(v: FloatArray, unit: FloatArray, Q: FloatArray) -> FloatArray:
    rest: FloatArray = v - _product(v, unit, Q) * unit
    return rest


def _directions(plane_at_infinity: FloatArray) -> FloatArray:
    """Orthonormal directions (4, 3) of height 0: the columns of a reflection that are orthogonal to the plane."""
    v = plane_at_infinity / np.sqrt((plane_at_infinity**2).sum())
    k = int(np.abs(v).argmax())
    v[k] += 1.0 if v[k] > 0.0 else -1.0
    reflection = np.eye(4) - 2.0 / float((v * v).sum()) * v[:, None] * v
    return np.ascontiguousarray(np.delete(reflection, k, axis=1))


def _estimate_metric(generators: FloatArray, matrices: FloatArray, centre: FloatArray, flat: FloatArray) -> FloatArray:
    """Scalar product ``Q`` (3, 3) of directions ``flat`` (4, 3), up to scale: ``RᵀQ + QR = 0`` for rotations ``R``."""
    rows = []
    for G in generators:
        R = multiply(multiply(np.ascontiguousarray(flat.T), G), flat)
        size = float(np.sqrt((R * R).sum()))
        if size > 1e-9 * float(np.sqrt((G * G).sum())):
            R = R / size
            rows.append(np.stack([(multiply(R.T, S) + multiply(S, R)).ravel() for S in _SYMMETRIC], axis=1))
    for P in matrices:
        m = (P * centre).sum(axis=1)
        # Body at the origin, pixels in units of a typical focal length
        centred = np.array([[1, 0, -m[0] / m[2]], [0, 1, -m[1] / m[2]], [0, 0, FOCAL_PX]])
        H = multiply(multiply(centred, P), flat)
        columns = np.stack([cross(H[1], H[2]), cross(H[2], H[0]), cross(H[0], H[1])], axis=1)
        inverse = columns / np.cbrt(abs(float((H[0] * columns[:, 0]).sum()))) ** 2
        images = [multiply(multiply(inverse.T, S), inverse) for S in _SYMMETRIC]
        rows.append(np.array([[w[0, 1] for w in images], [w[0, 0] - w[1, 1] for w in images]]))
        guesses = [[w[0, 2] for w in images], [w[1, 2] for w in images], [w[2, 2] - w[0, 0] for w in images]]
        rows.append(GUESS * np.array(guesses))
    q, _, _, _ = null_direction(np.concatenate(rows))
    Q = (q[:, None, None] * _SYMMETRIC).sum(axis=0)
    Q = Q if Q[0, 0] + Q[1, 1] + Q[2, 2] > 0.0 else -Q
    padded = np.zeros((4, 4))
    padded[:3, :3] = Q
    padded[3, 3] = Q[0, 0] + Q[1, 1] + Q[2, 2]
    values, _ = symmetric_eigen4(padded)
    if not values[0] > 1e-9 * values[3]:
        raise GeometryError(
            "degenerate",
            "right angles cannot be determined from this arm and its cameras; give H_projective_to_euclidean",
        )
    estimated: FloatArray = Q / values[3]
    return estimated


_OFF = np.sqrt(0.5)
_SYMMETRIC = np.array(
    [
        [[1, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 1]],
        [[0, _OFF, 0], [_OFF, 0, 0], [0, 0, 0]],
        [[0, 0, _OFF], [0, 0, 0], [_OFF, 0, 0]],
        [[0, 0, 0], [0, 0, _OFF], [0, _OFF, 0]],
    ]
)


FREEDOMS = (
    "translation across the image, sideways",
    "translation across the image, up and down",
    "translation towards the camera",
    "rotation about the image's horizontal axis",
    "rotation about the image's vertical axis",
    "rotation in the image plane",
)
"""The six of a rigid body about its centroid, as seen by one camera."""

REACH = 0.03
"""Fraction of a required motion that may remain undone: error of the operators."""

WEAK = 3e-3
"""Singular value, relative to the largest, below which motions are large for a small effect."""

PARALLEL = 0.03
"""Sine below which motions count as equal when the degrees of freedom of an arm in other postures are counted."""

NAMED = 0.5
"""Components of a motion at least this large, relative to the largest, are named."""


@dataclass(frozen=True, eq=False)
class Freedom:
    """A motion of the body, ``name``: description, ``generator`` (4, 4) in the model's frame.

    ``share`` in [0, 1]: fraction of it that the arm can make.
    """

    name: str
    generator: FloatArray
    share: float


@dataclass(frozen=True, eq=False)
class Mobility:
    """The degrees of freedom of an arm of n joints at its current posture.

    ``rank``: number of the body's degrees of freedom that can be driven; ``capacity``: the number in other postures.
    ``freedoms``: the six of `FREEDOMS`, with shares.
    ``missing``: 6 - rank motions of which the arm can make no part.
    ``directions`` (n, n): joint motions as columns, in units of the joints, that move the body by ``values`` (n,) [body
    radii, rms over its points], descending, and by ``pixels`` (n,) [px, rms over points and cameras].
    ``self_motions`` (n, n - rank): columns [rad or m] that do not move the body.
    ``block``: indices of joints that should not move in this posture.
    """

    rank: int
    capacity: int
    freedoms: tuple[Freedom, ...]
    missing: tuple[Freedom, ...]
    values: FloatArray
    pixels: FloatArray
    directions: FloatArray
    self_motions: FloatArray
    block: tuple[int, ...]


def mobility(
    operators: FloatArray,
    matrices: FloatArray,
    points: FloatArray,
    plane_at_infinity: FloatArray,
    H_projective_to_euclidean: FloatArray | None = None,
    unit: FloatArray | None = None,
    camera: str = "the first camera",
) -> Mobility:
    """The degrees of freedom of an arm: ``operators`` (n, 4, 4) at the current configuration, ``points`` (m, 4) of
    height 1.

    ``matrices`` (c, 3, 4): the first camera names the motions.
    ``unit`` (n,) [rad or m]: equivalent amounts of each joint's motion, None: 1.
    ``H_projective_to_euclidean``: None: right angles are estimated (`body_frame`).

    Raises GeometryError for collinear points, which do not show all degrees of freedom, and as `body_frame` does.
    """
    n = operators.shape[0]
    units = np.ones(n) if unit is None else np.asarray(unit, dtype=np.float64)
    E = body_frame(operators, matrices, points, plane_at_infinity, H_projective_to_euclidean)
    named = rigid_motions(E)
    fields = _motions(E, named, points)
    _refuse_line(fields)
    rank, capacity, values, V, made = _drivable(E, operators, points, units)
    shares = _lengths(multiply(made.T, fields / _lengths(fields)))
    missing = tuple(Freedom(_describe(E, X, points, camera), X, 0.0) for X in _left_over(named, fields, made, rank))
    block = joints_to_block(_motions(E, operators, points), units, capacity, WEAK) if n else np.zeros(0)
    J = image_jacobian(operators, matrices, points) * units
    pixels = _lengths(multiply(J.reshape(-1, n), V)) / np.sqrt(J.shape[0] * J.shape[1])
    return Mobility(
        rank=rank,
        capacity=capacity,
        freedoms=tuple(
            Freedom(f"{name} of {camera}", X, float(share))
            for name, X, share in zip(FREEDOMS, named, np.minimum(shares, 1.0), strict=True)
        ),
        missing=missing,
        values=values,
        pixels=pixels,
        directions=V,
        self_motions=units[:, None] * V[:, rank:],
        block=tuple(np.flatnonzero(block).tolist()),
    )


def missing_freedom(
    operators: FloatArray,
    matrices: FloatArray,
    points: FloatArray,
    plane_at_infinity: FloatArray,
    required: FloatArray,
    H_projective_to_euclidean: FloatArray | None = None,
    camera: str = "the first camera",
    tolerance: float = REACH,
) -> Freedom | None:
    """The part of a ``required`` motion of the body (4, 4), a generator or twist of any size, that the arm cannot make
    here.

    None if at most ``tolerance`` of it remains, or the motion is zero. The ``generator`` is the remaining part. Raises
    GeometryError as `mobility` does, and for a motion that is not finite.
    """
    if not np.isfinite(required).all():
        raise GeometryError("not_finite", f"the required motion is not finite: {np.asarray(required).tolist()}")
    n = operators.shape[0]
    E = body_frame(operators, matrices, points, plane_at_infinity, H_projective_to_euclidean)
    named = rigid_motions(E)
    fields = _motions(E, named, points)
    _refuse_line(fields)
    field = _motions(E, required[None], points)
    *_, made = _drivable(E, operators, points, np.ones(n))
    done = multiply(made.T, field)
    left = field - multiply(made, done)
    size = float(_lengths(field)[0])
    if float(_lengths(left)[0]) <= tolerance * size:
        return None
    rest = _combined(least_squares(fields, left[:, 0].copy()), named)
    return Freedom(_describe(E, rest, points, camera), rest, float(_lengths(done)[0]) / size)


def _lengths(columns: FloatArray) -> FloatArray:
    lengths: FloatArray = np.sqrt((columns * columns).sum(axis=0))
    return lengths


def _combined(factors: FloatArray, generators: FloatArray) -> FloatArray:
    total: FloatArray = (factors[:, None, None] * generators).sum(axis=0)
    return total


def _left_over(named: FloatArray, fields: FloatArray, made: FloatArray, rank: int) -> list[FloatArray]:
    """Generators of the degrees of freedom that are not ``made`` (3m, rank): those nearest to the named ones, strongest
    first.
    """
    rest = fields / _lengths(fields)
    rest = rest - multiply(made, multiply(made.T, rest))
    generators = []
    for _ in range(len(named) - rank):
        twist = least_squares(fields, np.ascontiguousarray(rest[:, int(_lengths(rest).argmax())]))
        strongest = multiply(fields, twist[:, None])
        generators.append(_combined(twist / np.abs(twist).max(), named))
        rest = rest - multiply(strongest, multiply(strongest.T, rest)) / float((strongest * strongest).sum())
    return generators


def _drivable(
    E: FloatArray, operators: FloatArray, points: FloatArray, units: FloatArray
) -> tuple[int, int, FloatArray, FloatArray, FloatArray]:
    """`drivable_freedoms`, at most the arm's capacity, and the motion of the points that they cause, as orthonormal
    columns.
    """
    n = operators.shape[0]
    if not n:
        return 0, 0, np.zeros(0), np.zeros((0, 0)), np.zeros((3 * len(points), 0))
    rows = _motions(E, operators, points)
    rank, values, V = drivable_freedoms(rows, units)
    capacity = min(n, len(_closure(np.stack([_twist(E, X) for X in operators]))))
    rank = min(rank, capacity)
    return rank, capacity, values, V, multiply(rows * units, V[:, :rank]) / values[:rank]


def rigid_motions(E: FloatArray) -> FloatArray:
    """Generators (6, 4, 4) of `FREEDOMS` in the frame that ``E`` (4, 4) maps the body's frame to."""
    local = np.concatenate([twist_matrix(np.zeros(3), np.eye(3)), twist_matrix(np.eye(3), np.zeros(3))])
    inverse = invert4(E)
    return np.stack([multiply(multiply(E, X), inverse) for X in local])


def _twist(E: FloatArray, X: FloatArray) -> FloatArray:
    """Components (6,) of a motion ``X`` (4, 4) along `FREEDOMS`."""
    local = multiply(multiply(invert4(E), X), E)
    skew = 0.5 * (local[:3, :3] - local[:3, :3].T)
    return np.array([*local[:3, 3], skew[2, 1], skew[0, 2], skew[1, 0]])


def _motions(E: FloatArray, generators: FloatArray, points: FloatArray) -> FloatArray:
    """`point_jacobian` (3m, k) of generators (k, 4, 4) in the body's frame."""
    form = np.ascontiguousarray(invert4(E)[:3])
    return point_jacobian(np.ascontiguousarray(generators), np.ascontiguousarray(points), form)


def _refuse_line(fields: FloatArray) -> None:
    _, singular = right_singular(fields)
    if not singular[-1] > 1e-3 * singular[0]:
        raise GeometryError(
            "degenerate",
            "the points lie on one line; three that span a face show all freedoms",
            singular=singular,
        )


def _describe(E: FloatArray, X: FloatArray, points: FloatArray, camera: str) -> str:
    """Description of a motion: its components by how far they move the body's points."""
    sizes = _lengths(_motions(E, rigid_motions(E), points)) * np.abs(_twist(E, X))
    order = [i for i in np.argsort(-sizes, kind="stable").tolist() if sizes[i] > NAMED * sizes.max()]
    return " together with ".join(FREEDOMS[i] for i in order) + f" of {camera}"


def attainable_motions(E: FloatArray, operators: FloatArray) -> FloatArray:
    """Generators (k, 4, 4) of all motions that the arm has in any posture, k <= 6: its operators and their brackets."""
    if not len(operators):
        return np.zeros((0, 4, 4))
    named = rigid_motions(E)
    motions = [_combined(twist, named) for twist in _closure(np.stack([_twist(E, X) for X in operators]))]
    return np.stack(motions) if motions else np.zeros((0, 4, 4))


def _closure(twists: FloatArray) -> FloatArray:
    """Basis (k, 6) of the closure of the joints' twists (n, 6), with components as from `_twist`, under
    their brackets.
    """
    twists = twists[_lengths(twists.T) > 0.0]
    if not len(twists):
        return twists
    v, w = twists[:, :3], twists[:, 3:]
    turning = _lengths(w.T) > PARALLEL * _lengths(v.T) / 1e3
    arms = _lengths(v[turning].T) / _lengths(w[turning].T)
    length = max(float(np.sqrt((arms**2).mean())), 1.0) if turning.any() else 1.0
    scaled = np.hstack([v / length, w])
    basis = _independent(scaled / _lengths(scaled.T)[:, None])
    while True:
        grown = _independent(brackets(basis))
        if len(grown) == len(basis):
            motions: FloatArray = basis * np.array([length] * 3 + [1.0] * 3)
            return motions
        basis = grown


def _independent(vectors: FloatArray) -> FloatArray:
    V, values = right_singular(vectors)
    return np.ascontiguousarray(V.T[values > PARALLEL * values[0]])
