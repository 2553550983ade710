"""A right-angled frame at the middle of a body as a camera sees it, in any projective frame with its plane at infinity.

It gives motions their everyday names. Where no metric upgrade is known, right angles are estimated: rotations of the
arm keep them (4.43), and pixels are taken for square. That is enough for words, not for measures.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray, affine_middle

FOCAL_PX = 1000.0
"""Scale of the pixels; it conditions the estimate."""

GUESS = 1e-3
"""Weight of a principal point where the body is seen, which decides only what nothing else does."""


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
    middle = affine_middle(points, plane_at_infinity)
    flat = np.linalg.svd(plane_at_infinity[None])[2][1:].T
    Q = (
        _estimated_metric(generators, matrices, middle, flat)
        if H_projective_to_euclidean is None
        else (H_projective_to_euclidean[:3] @ flat).T @ (H_projective_to_euclidean[:3] @ flat)
    )
    heights = (points @ plane_at_infinity)[:, None]
    offsets = (points / heights - middle) @ flat
    radius = float(np.sqrt(np.einsum("pi,ij,pj->p", offsets, Q, offsets).mean()))
    P = matrices[0]
    centre = np.linalg.svd(P)[2][3]
    # Towards the camera, of any height: a centre at infinity is a direction. The camera's front tells the sense.
    towards = flat.T @ (centre - (centre @ plane_at_infinity) * middle)
    size = np.sqrt(float(towards @ Q @ towards))
    if not (size > 0.0 and radius > 1e-9 * size):
        raise GeometryError(
            "degenerate", "the body has no size, or a camera stands in its middle", radius=radius
        )
    z = towards / size
    # A step towards the camera makes the depth fall.
    if float(P[2] @ (flat @ z)) * float(P[2] @ middle) > 0.0:
        z = -z
    gradient = (P[:2] - np.outer(P[:2] @ middle / (P[2] @ middle), P[2])) / (P[2] @ middle) @ flat
    right = np.linalg.pinv(gradient)[:, 0]
    right = right - (right @ Q @ z) * z
    x = right / np.sqrt(float(right @ Q @ right))
    if float(gradient[0] @ x) < 0.0:
        x = -x
    down = np.linalg.pinv(gradient)[:, 1]
    down = down - (down @ Q @ z) * z - (down @ Q @ x) * x
    y = down / np.sqrt(float(down @ Q @ down))
    E = np.empty((4, 4))
    E[:, :3] = radius * (flat @ np.column_stack([x, y, z]))
    E[:, 3] = middle
    return E


def _estimated_metric(
    generators: FloatArray, matrices: FloatArray, middle: FloatArray, flat: FloatArray
) -> FloatArray:
    """Scalar product ``Q`` (3, 3) of directions ``flat`` (4, 3), up to scale: ``RᵀQ + QR = 0`` for turns ``R``."""
    rows = []
    for G in generators:
        R = flat.T @ G @ flat
        if np.linalg.norm(R) > 1e-9 * np.linalg.norm(G):
            R = R / np.linalg.norm(R)
            rows.append(np.stack([(R.T @ S + S @ R).ravel() for S in _SYMMETRIC], axis=1))
    for P in matrices:
        m = P @ middle
        # Body at the origin, pixels in parts of a usual focal length
        H = np.array([[1, 0, -m[0] / m[2]], [0, 1, -m[1] / m[2]], [0, 0, FOCAL_PX]]) @ P @ flat
        H = H / np.abs(np.linalg.det(H)) ** (1 / 3)
        inverse = np.linalg.inv(H)
        images = [inverse.T @ S @ inverse for S in _SYMMETRIC]
        rows.append(np.array([[w[0, 1] for w in images], [w[0, 0] - w[1, 1] for w in images]]))
        rows.append(GUESS * np.array([[w[0, 2] for w in images], [w[1, 2] for w in images]]))
    q = np.linalg.svd(np.concatenate(rows))[2][5]
    Q = np.tensordot(q, _SYMMETRIC, axes=1)
    values = np.linalg.eigvalsh(Q)
    Q = Q if values[-1] > -values[0] else -Q
    values = np.linalg.eigvalsh(Q)
    if not values[0] > 1e-9 * values[-1]:
        raise GeometryError(
            "degenerate",
            "right angles cannot be told from this arm and its cameras; give H_projective_to_euclidean",
        )
    estimated: FloatArray = Q / values[-1]
    return estimated


_SYMMETRIC = np.array(
    [
        [[1, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ],
    dtype=np.float64,
)
