"""Velocity screws of camera, hand, tool and base: from moving points, between links, to and from joint velocities; the
links between the model's frame, camera, tool and robot base; operators of robots that take Cartesian commands (thesis
8.2).

A screw is the velocity of a rigid motion: the vector ``(v, w)`` [m/s, rad/s] in a Euclidean frame, ``v`` the velocity
of what passes the frame's origin; or the operator ``T̂ = [[w]ₓ v; 0 0]``, (4, 4), of which the conjugate ``Ĥ`` exists in
every projective frame. A link ``T_AB`` (4, 4) takes points from frame B to frame A, ``X_A = T_AB X_B``, and screws with
them: ``T̂_A = T_AB T̂_B T_AB⁻¹`` (8.16), whatever the frames.

What varies and what is fixed (table 8.1):

    |          | base-eye                              | hand-eye                              |
    | variable | camera to tool in hand                | camera to object on base              |
    | fixed    | camera and object on base             | camera and tool in hand               |
    | goal     | image of tool                         | image of object                       |
    | implicit | tool to object (end point in loop)    | camera to tool (end point open loop)  |

Both are one problem: an arm has two ends, and the operators of the one are those of the other moved along the arm,
their sign turned (`seen_from_other_end`). A robot that takes no joint velocities but Cartesian ones is the same again:
an arm of six joints that move at once, ``Composition.SIMULTANEOUS``, whose operators are the six unit screws of its
command, learnt or from `command_operators`; its joint velocity is ``(v, w)`` itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.lines import cross_matrix
from stereoservo.geometry.screws import twist_matrix
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray

TWIST_TOLERANCE = 1e-4
"""What an operator may leave beside a Euclidean twist, relative to it, before it counts as one of another frame."""


def twist_vectors(T: FloatArray, tolerance: float = 1e-9) -> tuple[FloatArray, FloatArray]:
    """``w`` [rad/s] and ``v`` [m/s] (..., 3) of Euclidean twists (..., 4, 4): the reverse of `twist_matrix`.

    Raises GeometryError where one is no twist: its last row or its block's symmetric part is above ``tolerance`` of
    its norm; then it is in another frame.
    """
    T = np.asarray(T, dtype=np.float64)
    block = T[..., :3, :3]
    symmetric = block + np.swapaxes(block, -1, -2)
    excess = np.sqrt((T[..., 3, :] ** 2).sum(axis=-1) + 0.25 * (symmetric**2).sum(axis=(-2, -1)))
    size = np.linalg.norm(T, axis=(-2, -1))
    if not (excess <= tolerance * size).all():
        worst = float(np.max(excess / np.where(size > 0, size, 1.0)))
        raise GeometryError(
            "degenerate",
            f"a matrix is no Euclidean twist: {worst:.3g} of it is not; conjugate it by H_PE first",
            excess=worst,
        )
    odd_part = 0.5 * (block - np.swapaxes(block, -1, -2))
    w = np.stack([odd_part[..., 2, 1], odd_part[..., 0, 2], odd_part[..., 1, 0]], axis=-1)
    return w, T[..., :3, 3].copy()


class Screw(NamedTuple):
    """A velocity screw: ``v`` (3,) [m/s] and ``w`` (3,) [rad/s] of a Euclidean frame."""

    v: FloatArray
    w: FloatArray


def point_interaction(S: FloatArray, moving_camera: bool = False) -> FloatArray:
    """``[I | −[S]ₓ]`` (..., 3, 6): the velocity of points ``S`` (..., 3) [m] by a screw ``(v, w)`` (8.14, errata).

    Of the points' own motion in the camera's frame; with ``moving_camera`` the screw is the camera's, all signs turned.
    """
    S = np.asarray(S, dtype=np.float64)
    J = np.concatenate([np.broadcast_to(np.eye(3), (*S.shape[:-1], 3, 3)), -cross_matrix(S)], axis=-1)
    interaction: FloatArray = -J if moving_camera else J
    return interaction


def screw_of_points(S: FloatArray, S_dot: FloatArray, moving_camera: bool = False) -> Screw:
    """Least-squares screw of points ``(k, 3)`` [m] with velocities ``(k, 3)`` [m/s], k >= 3 (8.15).

    Raises GeometryError for fewer than three points, and where they lie on one line, about which a turn is not seen.
    """
    S, rates = _finite("points", S), _finite("velocities", S_dot)
    if len(S) < 3:
        raise GeometryError("too_few", f"{len(S)} points; three fix a screw", points=len(S))
    singular = np.linalg.svd(S - S.mean(axis=0), compute_uv=False)
    if not singular[1] > 1e-9 * max(float(singular[0]), float(np.abs(S).max())):
        raise GeometryError("degenerate", "the points lie on one line; a turn about it moves none of them")
    J = point_interaction(S, moving_camera).reshape(-1, 6)
    vector = np.asarray(np.linalg.lstsq(J, rates.ravel(), rcond=None)[0], dtype=np.float64)
    return Screw(vector[:3], vector[3:])


def _finite(what: str, values: FloatArray) -> FloatArray:
    values = np.asarray(values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise GeometryError("not_finite", f"{what} must be finite, got {values.tolist()}")
    return values


def screw_operator(screw: Screw) -> FloatArray:
    """``T̂`` (4, 4) of a screw."""
    return twist_matrix(screw.w, screw.v)


def operator_screw(T: FloatArray, tolerance: float = TWIST_TOLERANCE) -> Screw:
    """Screw of a Euclidean operator ``T̂`` (4, 4). Raises GeometryError where the operator is not Euclidean."""
    w, v = twist_vectors(T, tolerance)
    return Screw(v, w)


def screw_transfer(T: FloatArray) -> FloatArray:
    """``[R [t]ₓR; 0 R]`` (6, 6) on vectors ``(v, w)`` of the link ``T = (R, t)`` (4, 4) (8.16)."""
    R, t = T[:3, :3], T[:3, 3]
    M = np.zeros((6, 6))
    M[:3, :3] = M[3:, 3:] = R
    M[:3, 3:] = cross_matrix(t) @ R
    return M


def hand_from_camera(H_HC: FloatArray, camera: FloatArray) -> FloatArray:
    """``T̂_H = T_HC T̂_C T_HC⁻¹`` (..., 4, 4) (8.16): through the hand-eye link, in any frames."""
    return conjugate(H_HC, camera)


def hand_from_tool(H_HL: FloatArray, H_LC: FloatArray, camera: FloatArray) -> FloatArray:
    """``T̂_H = T_HL (T_LC(t) T̂_C T_LC⁻¹(t)) T_HL⁻¹`` (..., 4, 4) (8.18): through a tool that the camera observes."""
    return conjugate(H_HL, conjugate(H_LC, camera))


def hand_from_base(H_HB: FloatArray, base: FloatArray) -> FloatArray:
    """``T̂_H = T_HB(Q) T̂_B T_HB⁻¹(Q)`` (..., 4, 4) (8.19): along the arm at its present configuration."""
    return conjugate(H_HB, base)


def base_from_hand(H_HB: FloatArray, hand: FloatArray) -> FloatArray:
    """``T̂_B = T_HB⁻¹ T̂_H T_HB`` (..., 4, 4), of the joints' operators and so of their sum (8.20, errata)."""
    inverse: FloatArray = np.asarray(np.linalg.inv(H_HB), dtype=np.float64)
    return conjugate(inverse, hand)


def seen_from_other_end(operators: FloatArray, H_other_from_this: FloatArray) -> FloatArray:
    """Joint operators (n, 4, 4) of the motion of one end of the arm relative to cameras at the other end.

    ``operators`` at the present configuration, in the frame of this end; ``H_other_from_this`` (4, 4) the present link.
    What moved by ``Ĥ_j`` is now static, and the world moves by ``−Ĥ_j``. The composition is reversed: BASE_FIRST for
    TIP_FIRST.
    """
    return -conjugate(H_other_from_this, operators)


def joint_velocity(operators: FloatArray, velocity: FloatArray) -> FloatArray:
    """``q̇`` (n,) with ``Σ q̇_j Ĥ_j = Ĥ`` (4, 4) (8.21, 8.22), of least norm where the arm has more joints than needed.

    Operators in one frame, any. Raises GeometryError where the arm cannot make that motion here, naming what is left.
    """
    A = _finite("operators", operators).reshape(len(operators), 16).T
    b = _finite("velocity", velocity).ravel()
    size = np.linalg.norm(A, axis=0)
    scaled = A / np.where(size > 0, size, 1.0)
    q_dot = np.linalg.lstsq(scaled, b, rcond=1e-9)[0]
    left = float(np.linalg.norm(scaled @ q_dot - b))
    if not left <= TWIST_TOLERANCE * max(float(np.linalg.norm(b)), 1e-300):
        raise GeometryError(
            "degenerate",
            f"no joint velocity makes this motion: {left:.3g} of {np.linalg.norm(b):.3g} is left; the arm is deficient "
            "or singular here, or the operators are of another frame",
            left=left,
        )
    velocities: FloatArray = q_dot / np.where(size > 0, size, 1.0)
    return velocities


class StratumError(ValueError):
    """The model's stratum does not determine Cartesian velocities.

    Attributes: stratum: of the model. missing: what would make it able to.
    """

    def __init__(self, message: str, stratum: str, missing: str) -> None:
        super().__init__(message)
        self.stratum = stratum
        self.missing = missing


def camera_frame(model: CellModel) -> FloatArray:
    """``H_PE`` (4, 4) onto the Euclidean frame of the model's first camera, in metres.

    The unit is that of the prismatic joints. Raises StratumError for a model that is not metric, and for a metric one
    of revolute joints alone, whose lengths are known up to one factor.
    """
    H = model.projective_to_euclidean
    if model.stratum != "metric" or H is None:
        missing = "H_PE: a metric calibration, or a base link (base_link) from poses that the robot reports"
        raise StratumError(
            f"the model is {model.stratum}: angles and lengths of its frame are unknown, (v, w) means nothing in it; "
            f"needed is {missing}",
            model.stratum,
            missing,
        )
    slides = [j for j, kind in enumerate(model.joint_kinds) if kind == "prismatic"]
    if not slides:
        missing = "one known length: a prismatic joint, or a base link (base_link) from poses that the robot reports"
        raise StratumError(
            f"the model is metric up to one factor, no joint tells a length; needed is {missing}",
            model.stratum,
            missing,
        )
    lengths = np.linalg.norm(conjugate(H, model.generators[slides])[:, :3, 3], axis=1)
    upgrade: FloatArray = np.diag([1.0, 1.0, 1.0, float(lengths.mean())]) @ H
    return upgrade


class BaseLink(NamedTuple):
    """``H_base`` (4, 4): points of the model's projective frame to the robot's base frame [m]. ``residual``: see
    `base_link`.
    """

    H_base: FloatArray
    residual: float


def base_link(poses: FloatArray, displacements: FloatArray) -> BaseLink:
    """The link from the model's frame, of any stratum, to the robot's base, from poses that the robot reports.

    ``poses`` (k, 4, 4): base from hand [m]; ``displacements`` (k, 4, 4): of the marker body from some zero, in the
    model's frame, normalised, at the same stops: static cameras, k >= 3 with rotations about two axes. With
    ``B_i = T_i T_0⁻¹`` and ``D_i = H_i H_0⁻¹`` the link fulfils ``H_base D_i = B_i H_base``: linear in it and, where
    the turns are not all about parallel axes, with one solution up to its factor, Euclidean and in metres whatever the
    model's stratum was. ``residual``: rms of the equations at ``|H_base| = 1``. Raises GeometryError naming what is
    too few or parallel.
    """
    poses, displacements = _finite("poses", poses), _finite("displacements", displacements)
    if poses.shape != displacements.shape or poses.ndim != 3 or len(poses) < 3:
        raise GeometryError(
            "too_few",
            f"{poses.shape} poses and {displacements.shape} displacements; three or more of each are needed, paired",
        )
    B = poses[1:] @ np.linalg.inv(poses[0])
    D = displacements[1:] @ np.linalg.inv(displacements[0])
    eye = np.eye(4)
    rows = np.concatenate([np.kron(eye, d.T) - np.kron(b, eye) for b, d in zip(B, D, strict=True)])
    _, values, vectors = np.linalg.svd(rows, full_matrices=False)
    if not values[-2] > 10.0 * max(float(values[-1]), 1e-12 * float(values[0])):
        raise GeometryError(
            "degenerate",
            f"the poses do not fix the link (least singular values {values[-2]:.3g}, {values[-1]:.3g}): turn the hand "
            "about two axes that are not parallel, and more where the poses are noisy",
            values=values,
        )
    return BaseLink(vectors[-1].reshape(4, 4), float(values[-1]) / float(np.sqrt(len(rows))))


def cartesian_velocity(
    operators: FloatArray, velocity: FloatArray, H_frame: FloatArray, tolerance: float = TWIST_TOLERANCE
) -> Screw:
    """Screw ``(v, w)`` [m/s, rad/s] of the marker body, in a Euclidean frame, at joint velocities ``velocity``
    (n,).

    ``operators`` (n, 4, 4) in the model's frame; ``H_frame`` (4, 4) from it to the frame of the command:
    `camera_frame`, ``base_link(...).H_base``, or ``T_HB @ H_base`` for the hand's. For cameras in the hand
    ``operators`` move the scene: the hand moves by their negative. Raises GeometryError where the sum is no Euclidean
    twist there.
    """
    total = np.tensordot(np.asarray(velocity, dtype=np.float64), operators, axes=1)
    return operator_screw(conjugate(H_frame, total), tolerance)


def command_operators(H_frame: FloatArray, centre: FloatArray | None = None) -> FloatArray:
    """Operators (6, 4, 4), in the model's frame, of the six unit commands ``v_x … w_z`` of a robot that takes ``(v,
    w)``.

    ``H_frame`` (4, 4) as for `cartesian_velocity`; ``centre`` (3,) [m] in the command's frame: the point about which it
    turns, its origin if None (robots that turn about the tool's point give it at every step). They are an arm with
    ``Composition.SIMULTANEOUS``. With commands in a static frame, and about its origin, they are constant; in the
    hand's frame ``H_frame`` moves with the hand.
    """
    units = np.eye(3)
    point = np.zeros(3) if centre is None else np.asarray(centre, dtype=np.float64)
    twists = np.concatenate([
        twist_matrix(np.zeros((3, 3)), units),
        twist_matrix(units, np.cross(point, units)),
    ])  # fmt: skip
    inverse: FloatArray = np.asarray(np.linalg.inv(H_frame), dtype=np.float64)
    return conjugate(inverse, twists)


def tool_frame(markers: FloatArray, H_frame: FloatArray) -> FloatArray:
    """Frame defined by three markers ``(3, 4)`` of the tool: ``T_frame_tool`` (4, 4) from tool coordinates.

    Origin in the first, x towards the second, the third in the xy plane with y > 0; in the Euclidean frame of
    ``H_frame`` (4, 4). With the pose ``T_BH`` of the hand ``T_HL = T_BH⁻¹ T_BL`` is the tool-hand link, which stays
    (8.18). Raises GeometryError for markers on one line or at infinity.
    """
    X = np.asarray(markers, dtype=np.float64) @ np.asarray(H_frame, dtype=np.float64).T
    if X.shape != (3, 4):
        raise GeometryError("shape", f"markers have shape {np.shape(markers)}; (3, 4) is needed")
    if not (np.abs(X[:, 3]) > 1e-12 * np.linalg.norm(X, axis=1)).all():
        raise GeometryError("degenerate", "a marker lies at infinity of this frame", heights=X[:, 3])
    X = X[:, :3] / X[:, 3:]
    x, y = X[1] - X[0], X[2] - X[0]
    z = np.cross(x, y)
    if not np.linalg.norm(z) > 1e-9 * np.linalg.norm(x) * np.linalg.norm(y):
        raise GeometryError("degenerate", "the markers lie on one line; a frame needs three that do not")
    T = np.eye(4)
    T[:3, 0] = x / np.linalg.norm(x)
    T[:3, 2] = z / np.linalg.norm(z)
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    T[:3, 3] = X[0]
    return T
