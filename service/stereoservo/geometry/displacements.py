"""Projective displacements: normal form, generators, closed-form exponentials and logarithms (thesis 3, 4).

A revolute generator ``Ĥ`` (4, 4) has eigenvalues (0, 0, i, −i): ``Ĥ³ = −Ĥ``. A prismatic one is nilpotent:
``Ĥ² = 0``. Displacements act on points from the left; conjugates in a projective frame of Euclidean ones.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray

HALF_TURN_SINE = 1e-7
"""|sin θ| below which a rotation does not tell its generator: the difference to its inverse is rounding."""


def _square(H: FloatArray, what: str) -> FloatArray:
    H = np.asarray(H, dtype=np.float64)
    if H.shape != (4, 4):
        raise GeometryError("shape", f"{what} has shape {H.shape}; (4, 4) is needed", shape=H.shape)
    if not np.isfinite(H).all():
        raise GeometryError("not_finite", f"{what} must be finite, got {H.tolist()}")
    return H


def normalise_displacement(
    H: FloatArray, M_from: FloatArray | None = None, M_to: FloatArray | None = None
) -> FloatArray:
    """``H`` (4, 4) scaled to determinant 1 (2.34), the sign so that it keeps heights.

    The sign is read from points ``M_from`` (n, 4) and their images ``M_to`` (n, 4), both of positive height
    (depth 1 in the first camera). Without points it is that of the trace, which is noise near a half-turn:
    refused there. Raises GeometryError for ``det H <= 0`` (a reflection, or singular), and where the sign
    cannot be told.
    """
    H = _square(H, "displacement")
    size = float(np.linalg.norm(H))
    determinant = float(np.linalg.det(H / size)) if size > 0 else 0.0
    if not determinant > 1e-14:
        raise GeometryError(
            "orientation",
            f"det H is {determinant:.3g} (at unit norm); a displacement has a positive determinant",
            determinant=determinant,
        )
    H = H / (size * determinant**0.25)
    if M_from is not None and M_to is not None:
        images = M_from @ H.T
        agreement = (images * M_to).sum(axis=1) / (
            np.linalg.norm(images, axis=1) * np.linalg.norm(M_to, axis=1)
        )
        votes = int((agreement > 0).sum()), int((agreement < 0).sum())
        if votes[0] == votes[1]:
            raise GeometryError(
                "orientation",
                f"{votes[0]} points say one sign of H and {votes[1]} the other; heights disagree",
                votes=votes,
            )
        return H if votes[0] > votes[1] else -H
    trace = float(np.trace(H))
    if abs(trace) < 1e-6:
        raise GeometryError(
            "orientation",
            f"the trace is {trace:.3g} (half a turn), it tells no sign; give points",
            trace=trace,
        )
    return H if trace > 0 else -H


def exp_rotation(G: FloatArray, theta: npt.ArrayLike) -> FloatArray:
    """``exp(θĤ) = I + sin θ Ĥ + (1 − cos θ) Ĥ²`` (4.27): ``G`` (..., 4, 4), ``theta`` (...) [rad] -> (...,
    4, 4).
    """
    angle = np.asarray(theta, dtype=np.float64)[..., None, None]
    # 2 sin²(θ/2) instead of 1 − cos θ: exact for small angles.
    H: FloatArray = np.eye(4) + np.sin(angle) * G + 2.0 * np.sin(0.5 * angle) ** 2 * (G @ G)
    return H


def exp_translation(G: FloatArray, tau: npt.ArrayLike) -> FloatArray:
    """``exp(τĤ) = I + τĤ`` (3.21): ``G`` (..., 4, 4), ``tau`` (...) -> (..., 4, 4)."""
    H: FloatArray = np.eye(4) + np.asarray(tau, dtype=np.float64)[..., None, None] * G
    return H


def exp_generator(kind: str, G: FloatArray, q: npt.ArrayLike) -> FloatArray:
    """The displacement of a ``revolute`` [rad] or ``prismatic`` [m] joint. Raises GeometryError for
    another kind.
    """
    if kind == "revolute":
        return exp_rotation(G, q)
    if kind == "prismatic":
        return exp_translation(G, q)
    raise GeometryError("shape", f"joint kind is {kind!r}; 'revolute' or 'prismatic' are known", kind=kind)


def rotation_angle(H: FloatArray) -> float:
    """Angle in [0, π] of a projective rotation ``H`` (4, 4), normalised: from trace and odd part, accurate
    everywhere.
    """
    H = _square(H, "rotation")
    odd = 0.5 * (H - np.linalg.inv(H))
    sine = np.sqrt(max(0.0, -0.5 * float(np.sum(odd * odd.T))))
    return float(np.arctan2(sine, 0.5 * (np.trace(H) - 2.0)))


def rotation_axis(H: FloatArray) -> FloatArray:
    """Two orthonormal points ``(2, 4)`` on the axis of a projective rotation ``H`` (4, 4); defined at θ =
    π too.
    """
    H = _square(H, "rotation")
    _, singular, rows = np.linalg.svd(H - np.eye(4))
    if not singular[1] > 1e-12:
        raise GeometryError("degenerate", "H is the identity; a rotation by a non-zero angle is needed")
    return np.ascontiguousarray(rows[2:])


def log_rotation(H: FloatArray) -> tuple[FloatArray, float]:
    """``(Ĥ, θ)`` with ``H = exp(θĤ)``, θ in (0, π), of a projective rotation ``H`` (4, 4), normalised
    (4.28).

    The odd part of H gives the generator; near θ = π, where it is small, it is read between the eigenspaces
    of the even part ``I + (1 − cos θ)Ĥ²``, which are accurate there. ``Ĥ³ = −Ĥ`` holds to rounding. Raises
    GeometryError for the identity and for a half-turn: at θ = π the matrix tells the axis (`rotation_axis`)
    but not the generator.
    """
    H = _square(H, "rotation")
    theta = rotation_angle(H)
    if theta < HALF_TURN_SINE:
        raise GeometryError(
            "degenerate", f"the rotation is {theta:.3g} rad; the identity has no axis", theta=theta
        )
    if np.pi - theta < HALF_TURN_SINE:
        raise GeometryError(
            "half_turn",
            f"the rotation is {theta!r} rad; half a turn tells its axis, not its generator",
            theta=theta,
        )
    inverse = np.linalg.inv(H)
    odd = (H - inverse) / (2.0 * np.sin(theta))
    if theta < 0.75 * np.pi:
        return nearest_rotation_generator(odd), theta
    return generator_between(odd, 0.5 * (H + inverse) - np.eye(4)), theta


def generator_between(odd: FloatArray, even: FloatArray) -> FloatArray:
    """The generator ``Ĥ`` (4, 4) near ``odd`` (4, 4) between the eigenspaces of ``even`` ~ ``Ĥ²`` (4, 4), of
    rank two.

    For rotations by nearly π, whose even part is accurate where the odd one is small. Raises GeometryError
    (``half_turn``) where the odd part is lost in noise.
    """
    U, _, Vt = np.linalg.svd(even)
    columns, rows = U[:, :2], Vt[:2]
    # Ĥ = C J R with R C invertible; restrict the odd part to the plane, where it is a 2x2 with J² = −1.
    metric = np.linalg.inv(rows @ columns)
    plane = metric @ (rows @ odd @ columns)
    plane = plane - 0.5 * np.trace(plane) * np.eye(2)
    determinant = float(np.linalg.det(plane))
    if not determinant > 0:
        raise GeometryError(
            "half_turn", "the rotation is half a turn within its noise, which hides its sense"
        )
    G: FloatArray = columns @ (plane / np.sqrt(determinant)) @ metric @ rows
    return G


def rotation_generator(H: FloatArray) -> FloatArray:
    """The generator ``Ĥ`` (4, 4) of a projective rotation (4.28), for the sense of rotation that takes
    less than π.
    """
    return log_rotation(H)[0]


def log_translation(H: FloatArray) -> FloatArray:
    """``τĤ = (H − H⁻¹)/2`` (3.23) of a projective translation ``H`` (4, 4), normalised, as an exact
    nilpotent.

    Raises GeometryError for the identity.
    """
    H = _square(H, "translation")
    return nearest_translation_generator(0.5 * (H - np.linalg.inv(H)))


def translation_generator(H: FloatArray, tau: float = 1.0) -> FloatArray:
    """The generator ``Ĥ`` (4, 4) of a projective translation by ``tau`` [m] (3.23). Raises GeometryError
    for tau 0.
    """
    if tau == 0.0 or not np.isfinite(tau):
        raise GeometryError(
            "degenerate", f"tau is {tau}; a generator needs a finite motion other than zero", tau=tau
        )
    return log_translation(H) / tau


def nearest_rotation_generator(A: FloatArray) -> FloatArray:
    """An exact revolute generator (``Ĥ³ = −Ĥ``) near ``A`` (4, 4): its complex eigenvectors, ``−2 Im(v
    wᴴ)``.

    Raises GeometryError where A has no complex pair of eigenvalues.
    """
    A = _square(A, "generator")
    values, right = np.linalg.eig(A)
    k = int(np.argmax(values.imag))
    if not values[k].imag > 1e-9 * float(np.abs(values).max()):
        raise GeometryError(
            "degenerate",
            f"eigenvalues {values.tolist()} hold no complex pair; a rotation has ±i",
            eigenvalues=values,
        )
    # The left eigenvector from the transpose: inverting all eigenvectors fails near a defective kernel.
    adjoint_values, left = np.linalg.eig(A.T)
    v, w = right[:, k], left[:, int(np.argmin(np.abs(adjoint_values - values[k])))]
    product = w @ v
    if abs(product) < 1e-12:
        raise GeometryError("degenerate", "left and right eigenvectors are orthogonal; the pair is defective")
    G: FloatArray = -2.0 * (np.outer(v, w) / product).imag
    # x ↦ −x³(5 + 3x²)/2 has ±i and 0 as fixed points of slope zero: rounding is squared away.
    for _ in range(2):
        square = G @ G
        G = -0.5 * G @ square @ (5.0 * np.eye(4) + 3.0 * square)
    return G


def nearest_translation_generator(A: FloatArray) -> FloatArray:
    """The nilpotent of rank one (``Ĥ² = 0``) nearest to ``A`` (4, 4) (3.32-3.34, with hᵀk = 0 kept
    exactly).

    Raises GeometryError for A = 0.
    """
    from scipy.optimize import (
        brentq,
    )  # here, so that the servo process can import displacements without scipy

    A = _square(A, "generator")
    size = float(np.linalg.norm(A, 2))
    if not size > 0:
        raise GeometryError("degenerate", "the generator is zero; a translation is needed")
    A = A / size

    def pair(shift: float) -> tuple[FloatArray, FloatArray]:
        U, _, Vt = np.linalg.svd(A - shift * np.eye(4))
        return U[:, 0], Vt[0]

    def overlap(shift: float) -> float:
        k, h = pair(shift)
        return float(-(k @ h))

    # The best k hᵀ under hᵀk = 0 is a leading singular pair of A − λI, λ the constraint's multiplier; there
    # the
    # norm of A − λI is least. That norm is convex in λ, and its slope is −kᵀh.
    shift = brentq(overlap, -2.0, 2.0, xtol=1e-16, rtol=1e-15)
    k, h = pair(float(shift))
    k = k - h * (h @ k)
    G: FloatArray = size * np.outer(k, h) * float(k @ A @ h) / float(k @ k)
    return G


def conjugate(H: FloatArray, G: FloatArray) -> FloatArray:
    """``H Ĝ H⁻¹``: a generator or displacement ``G`` (..., 4, 4) seen after the map ``H`` (4, 4) of the
    points.
    """
    moved: FloatArray = H @ G @ np.linalg.inv(H)
    return moved


def dual_generator(G: FloatArray) -> FloatArray:
    """``−Ĥᵀ``: the operator of a generator ``(..., 4, 4)`` on planes (2.70)."""
    dual: FloatArray = -np.swapaxes(G, -1, -2)
    return dual


def bracket(A: FloatArray, B: FloatArray) -> FloatArray:
    """Lie bracket ``AB − BA`` of generators ``(..., 4, 4)``."""
    product: FloatArray = A @ B - B @ A
    return product
