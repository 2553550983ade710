"""Normal form, logarithms and generators of projective displacements (thesis 3, 4): inverses of the exponentials."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.displacements import (
    _square,
    nearest_rotation_generator,
    nearest_translation_generator,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import FloatArray

HALF_TURN_SINE = 1e-7
"""|sin θ| below which a rotation does not tell its generator: the difference to its inverse is rounding."""


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
        agreement = (images * M_to).sum(axis=1) / (np.linalg.norm(images, axis=1) * np.linalg.norm(M_to, axis=1))
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
        raise GeometryError("degenerate", f"the rotation is {theta:.3g} rad; the identity has no axis", theta=theta)
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
        raise GeometryError("half_turn", "the rotation is half a turn within its noise, which hides its sense")
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
        raise GeometryError("degenerate", f"tau is {tau}; a generator needs a finite motion other than zero", tau=tau)
    return log_translation(H) / tau


def dual_generator(G: FloatArray) -> FloatArray:
    """``−Ĥᵀ``: the operator of a generator ``(..., 4, 4)`` on planes (2.70)."""
    dual: FloatArray = -np.swapaxes(G, -1, -2)
    return dual


def bracket(A: FloatArray, B: FloatArray) -> FloatArray:
    """Lie bracket ``AB − BA`` of generators ``(..., 4, 4)``."""
    product: FloatArray = A @ B - B @ A
    return product
