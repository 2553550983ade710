"""A right-angled frame at the middle of a body as a camera sees it, in any projective frame with its plane at infinity.

It gives motions their everyday names. Where no metric upgrade is known, right angles are estimated: rotations of the
arm keep them (4.43), and pixels are taken for square. That is enough for words, not for measures. No LAPACK, no BLAS:
the core refuses goals in these words.
"""

from __future__ import annotations

import numpy as np

from stereoservo.control.mobility_kernel import cross, multiply
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray, plane_of_points
from stereoservo.kinematics.kernels import symmetric_eigen4
from stereoservo.kinematics.linear_kernels import null_direction

FOCAL_PX = 1000.0
"""A usual focal length."""

GUESS = 1e-3
"""Weight of a usual focal length and of a principal point where the body is: they decide what nothing else does."""


def body_frame(
    generators: FloatArray,
    matrices: FloatArray,
    points: FloatArray,
    plane_at_infinity: FloatArray,
    H_projective_to_euclidean: FloatArray | None = None,
) -> FloatArray:
    """``E`` (4, 4) that maps the body's own coordinates to the model's frame: columns x, y, z and the middle.

    x to the right in the image of the first camera, y down, z towards the camera, orthonormal but for one unit, the rms
    distance of ``points`` (m, 4) from their middle. ``generators`` (n, 4, 4) of rigid motions, ``matrices`` (c, 3, 4).
    Raises GeometryError for a camera at the body's middle, points that are one, estimates that are no metric, and
    what is not finite.
    """
    for name, value in (("generators", generators), ("cameras", matrices), ("points", points)):
        if not np.isfinite(value).all():
            raise GeometryError("not_finite", f"the {name} are not finite")
    middle = (points / (points * plane_at_infinity).sum(axis=1)[:, None]).mean(axis=0)
    flat = _directions(plane_at_infinity)
    if H_projective_to_euclidean is None:
        Q = _estimated_metric(generators, matrices, middle, flat)
    else:
        axes = multiply(H_projective_to_euclidean[:3], flat)
        Q = multiply(axes.T, axes)
    heights = (points * plane_at_infinity).sum(axis=1)[:, None]
    offsets = multiply(points / heights - middle, flat)
    radius = float(np.sqrt((multiply(offsets, Q) * offsets).sum() / len(points)))
    P = matrices[0]
    m = (P * middle).sum(axis=1)
    centre = plane_of_points(P[0], P[1], P[2])
    # Towards the camera, of any height: a centre at infinity is a direction. The depth tells the sense.
    towards = multiply(flat.T, (centre - float((centre * plane_at_infinity).sum()) * middle)[:, None])[:, 0]
    size = _length(towards, Q)
    if not (size > 0.0 and radius > 1e-9 * size):
        raise GeometryError(
            "degenerate", "the body has no size, or a camera stands in its middle", radius=radius
        )
    z = towards / size
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
    E[:, 3] = middle
    return E


def _length(v: FloatArray, Q: FloatArray) -> float:
    return float(np.sqrt(max(0.0, _product(v, v, Q))))


def _product(v: FloatArray, w: FloatArray, Q: FloatArray) -> float:
    return float((Q * v[:, None] * w).sum())


def _without(v: FloatArray, unit: FloatArray, Q: FloatArray) -> FloatArray:
    rest: FloatArray = v - _product(v, unit, Q) * unit
    return rest


def _directions(plane_at_infinity: FloatArray) -> FloatArray:
    """Orthonormal directions (4, 3) of height 0: what of a reflection is left besides the plane."""
    v = plane_at_infinity / np.sqrt((plane_at_infinity**2).sum())
    k = int(np.abs(v).argmax())
    v[k] += 1.0 if v[k] > 0.0 else -1.0
    reflection = np.eye(4) - 2.0 / float((v * v).sum()) * v[:, None] * v
    return np.ascontiguousarray(np.delete(reflection, k, axis=1))


def _estimated_metric(
    generators: FloatArray, matrices: FloatArray, middle: FloatArray, flat: FloatArray
) -> FloatArray:
    """Scalar product ``Q`` (3, 3) of directions ``flat`` (4, 3), up to scale: ``RᵀQ + QR = 0`` for turns ``R``."""
    rows = []
    for G in generators:
        R = multiply(multiply(np.ascontiguousarray(flat.T), G), flat)
        size = float(np.sqrt((R * R).sum()))
        if size > 1e-9 * float(np.sqrt((G * G).sum())):
            R = R / size
            rows.append(np.stack([(multiply(R.T, S) + multiply(S, R)).ravel() for S in _SYMMETRIC], axis=1))
    for P in matrices:
        m = (P * middle).sum(axis=1)
        # Body at the origin, pixels in parts of a usual focal length
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
            "right angles cannot be told from this arm and its cameras; give H_projective_to_euclidean",
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
