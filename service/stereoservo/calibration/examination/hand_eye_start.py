"""Start of a hand-eye fit: intrinsics and poses of a known board from its pictures, the order of its corners
where it looks alike after half a turn, and both transforms in closed form from rotations, then translations.

Also mistakes in reported poses that these settle before the fit: other readings of the rotations, poses beside the
wrong pictures, motions that do not determine a hand-eye transform.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.camera_rig.rig_bundle import rigid
from stereoservo.calibration.examination.hand_eye_fit import FALSE_ALARM, BoardViews, motions
from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import FloatArray, IntArray

AMBIGUOUS = 2.0
"""Ratio of reprojection errors up to which the second solution of a plane's pose is possible."""
LEAST_MARKERS = 4
ROBUST_ROUNDS = 20
MOUNTS: tuple[Mount, ...] = ("eye_in_hand", "eye_to_hand")
LEAST_VIEWS = 4
"""Least number of views of a hand-eye transform: three with one to check them."""
LEAST_TURN_DEG = 20.0
"""Rotation of the hand about a second axis that the literature of hand-eye calibration asks for, at least."""


class BoardPoses(NamedTuple):
    """By view, the possible ``poses`` (s, 4, 4, 4) of the board in one camera [board units]: two solutions of the plane
    in the order of the corners, and two after half a turn; NaN if there is none. ``matrix`` (3, 3) of the camera.
    """

    poses: FloatArray
    matrix: FloatArray


def half_turn(layout: FloatArray) -> tuple[FloatArray, IntArray | None]:
    """Half turn (4, 4) of a board about its middle, in its plane, and the marker (m,) that each one falls on; None if
    the layout does not fall on itself.
    """
    middle = 0.5 * (layout.min(axis=0) + layout.max(axis=0))
    R = np.diag([-1.0, -1.0, 1.0])
    H = rigid(R, middle - R @ middle)
    turned = layout @ R.T + H[:3, 3]
    distances = np.linalg.norm(turned[:, None] - layout, axis=2)
    falls = distances.argmin(axis=1)
    alike = distances.min(axis=1).max() < 1e-6 * float(np.ptp(layout, axis=0).max())
    return H, falls if alike else None


def camera_matrix(views: BoardViews, c: int) -> FloatArray:
    """Matrix (3, 3) of camera c from the board's pictures alone, with a central principal point and no lens."""
    width, height = (int(one) for one in views.sizes[c])
    objects, images = [], []
    for pixels in views.pixels[c]:
        seen = np.isfinite(pixels).all(axis=1)
        if seen.sum() >= LEAST_MARKERS:
            objects.append(views.layout[seen].astype(np.float32))
            images.append(pixels[seen].astype(np.float32))
    K = np.array([[width, 0.0, 0.5 * (width - 1)], [0.0, width, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS
        | cv2.CALIB_FIX_ASPECT_RATIO
        | cv2.CALIB_FIX_PRINCIPAL_POINT
        | cv2.CALIB_ZERO_TANGENT_DIST
        | cv2.CALIB_FIX_K1
        | cv2.CALIB_FIX_K2
        | cv2.CALIB_FIX_K3
    )
    found = np.asarray(cv2.calibrateCamera(objects, images, (width, height), K, np.zeros(5), flags=flags)[1])
    # Frontal views alone do not determine a focal length.
    return found if 0.25 * width < found[0, 0] < 10.0 * width else K


def board_poses(views: BoardViews, c: int) -> BoardPoses:
    """The possible poses of the board in camera c."""
    K = camera_matrix(views, c)
    H, _ = half_turn(views.layout)
    found = np.full((len(views.names), 4, 4, 4), np.nan)
    for i, pixels in enumerate(views.pixels[c]):
        seen = np.isfinite(pixels).all(axis=1)
        if seen.sum() < LEAST_MARKERS:
            continue
        _, turns, shifts, errors = cv2.solvePnPGeneric(
            views.layout[seen], pixels[seen], K, np.zeros(5), flags=cv2.SOLVEPNP_IPPE
        )
        errors = np.ravel(errors)
        for k, (turn, shift) in enumerate(zip(turns, shifts, strict=True)):
            if k < 2 and errors[k] <= AMBIGUOUS * errors[0] and float(shift[2, 0]) > 0.0:
                found[i, k] = rigid(Rotation.from_rotvec(np.ravel(turn)).as_matrix(), np.ravel(shift))
                found[i, 2 + k] = found[i, k] @ H
    return BoardPoses(found, K)


def angles_between(rotations: FloatArray, others: FloatArray) -> FloatArray:
    """Angles (i, j) [rad] of the rotations between ``rotations`` (i, 3, 3) and ``others`` (j, 3, 3)."""
    traces = np.einsum("iab,jab->ij", rotations, others)
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))


def chosen_poses(possible: FloatArray, poses: FloatArray, turns: bool) -> IntArray:
    """Choice (s,) among the ``possible`` board poses (s, 4, 4, 4) whose rotations between views have the angles of the
    arm's ``poses`` (s, 4, 4), which needs no hand-eye transform; -1 where none is possible. ``turns``: whether half
    turns of the board are possible.
    """
    s = len(poses)
    known = np.isfinite(possible[..., 0, 0])
    if not turns:
        known = known & np.array([True, True, False, False])
    wanted = angles_between(poses[:, :3, :3], poses[:, :3, :3])
    flat = np.where(known[..., None, None], possible[..., :3, :3], 0.0).reshape(4 * s, 3, 3)
    differences = np.abs(angles_between(flat, flat).reshape(s, 4, s, 4) - wanted[:, None, :, None])
    differences[~known] = np.inf
    differences.transpose(2, 3, 0, 1)[~known] = np.inf
    best, least = np.where(known.any(axis=1), 0, -1), np.inf
    for i in range(s):
        for k in np.flatnonzero(known[i, :2]):
            choice = differences[i, k].argmin(axis=1)
            mine = np.flatnonzero(known.any(axis=1))
            pairs = differences[mine[:, None], choice[mine][:, None], mine, choice[mine]]
            total = float(np.median(pairs, axis=1).sum())
            if total < least:
                best, least = np.where(known.any(axis=1), choice, -1), total
    if turns and (best >= 2).sum() > (best >= 0).sum() / 2.0:
        best = np.where(best >= 0, best ^ 2, -1)  # the board's own frame turned: the same for all views
    return best


class ClosedForm(NamedTuple):
    """Transforms ``A`` (4, 4), ``C`` (4, 4) and ``scale`` from board poses, and what is left of each view: ``turns``
    (s,) [rad] and ``shifts`` (s,) [m].
    """

    A: FloatArray
    C: FloatArray
    scale: float
    turns: FloatArray
    shifts: FloatArray

    @property
    def log_likelihood(self) -> float:
        """Of the better three quarters of the views, their deviations estimated, up to a constant."""
        total = 0.0
        for errors in (self.turns, self.shifts):
            kept = np.sort(errors)[: max(3, 3 * len(errors) // 4)]
            total -= 3.0 * len(errors) * float(np.log(np.sqrt((kept**2).mean()) + 1e-9))
        return total


def closed_form(board: FloatArray, poses: FloatArray, mount: Mount) -> ClosedForm:
    """Transforms from ``board`` (s, 4, 4) poses in the camera and ``poses`` (s, 4, 4) of the hand: rotations
    between views about axes that ``A`` maps on each other, then translations and scale linearly; views far off
    count less.
    """
    G = motions(poses, mount)
    s = len(G)
    T, R = board[:, :3, :3], G[:, :3, :3]
    weights: FloatArray = np.ones(s)
    i, j = np.triu_indices(s, 1)
    seen = Rotation.from_matrix(T[i] @ T[j].swapaxes(1, 2)).as_rotvec()
    moved = Rotation.from_matrix(R[i] @ R[j].swapaxes(1, 2)).as_rotvec()
    for _ in range(ROBUST_ROUNDS):
        RA = _aligned(seen, moved, weights[i] * weights[j])
        RC = Rotation.from_matrix(R.swapaxes(1, 2) @ RA.T @ T).mean(weights=weights).as_matrix()
        turns = np.asarray(Rotation.from_matrix(T.swapaxes(1, 2) @ (RA @ R @ RC)).magnitude())
        weights = 1.0 / (1.0 + (turns / max(1.5 * float(np.median(turns)), 1e-9)) ** 2)
    rows = np.concatenate(
        [np.broadcast_to(np.eye(3), (s, 3, 3)), RA @ R, -board[:, :3, 3, None]], axis=2
    )  # of t_A, t_C and the scale
    right = -(G[:, :3, 3] @ RA.T)
    for _ in range(ROBUST_ROUNDS):
        root = np.sqrt(weights)[:, None, None]
        x = np.linalg.lstsq((root * rows).reshape(-1, 7), (root[..., 0] * right).ravel(), rcond=1e-9)[0]
        shifts = np.linalg.norm(rows @ x - right, axis=1)
        weights = 1.0 / (1.0 + (shifts / max(1.5 * float(np.median(shifts)), 1e-12)) ** 2)
    return ClosedForm(rigid(RA, x[:3]), rigid(RC, x[3:6]), float(x[6]), turns, shifts)


def _aligned(seen: FloatArray, moved: FloatArray, weights: FloatArray) -> FloatArray:
    """Rotation (3, 3) that maps vectors ``moved`` (k, 3) on ``seen`` (k, 3)."""
    U, _, Vt = np.linalg.svd((weights[:, None] * seen).T @ moved)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


# -- mistakes in poses -------------------------------------------------------------------------------------------


class Reading(NamedTuple):
    """A way in which poses may have been meant: ``apply`` yields the poses (s, 4, 4), NaN where there is none."""

    kind: str
    sentence: str
    remedy: str
    apply: Callable[[FloatArray], FloatArray]


def _turned(rotations: Callable[[Rotation], Rotation]) -> Callable[[FloatArray], FloatArray]:
    def apply(poses: FloatArray) -> FloatArray:
        found = poses.copy()
        found[:, :3, :3] = rotations(Rotation.from_matrix(poses[:, :3, :3])).as_matrix()
        return found

    return apply


def _shifted(by: int) -> Callable[[FloatArray], FloatArray]:
    def apply(poses: FloatArray) -> FloatArray:
        found = np.full_like(poses, np.nan)
        if by > 0:
            found[:-by] = poses[by:]
        else:
            found[-by:] = poses[:by]
        return found

    return apply


def _as_text(poses: FloatArray) -> FloatArray:
    """The poses of pictures that were sorted by name as text: 0, 1, 10, 11, 2, …"""
    return poses[sorted(range(len(poses)), key=str)]


_ORDER = "write x y z, then the quaternion as qx qy qz qw, with a header that names the columns"
READINGS: tuple[Reading, ...] = (
    Reading("as_given", "the poses are as given", "", lambda poses: poses),
    Reading(
        "quaternion_order",
        "the quaternions have w first, and were read as x y z w",
        _ORDER,
        _turned(lambda r: Rotation.from_quat(np.roll(r.as_quat(), -1, axis=1))),
    ),
    Reading(
        "quaternion_order",
        "the quaternions have w last, and were read as w x y z",
        _ORDER,
        _turned(lambda r: Rotation.from_quat(np.roll(r.as_quat(), 1, axis=1))),
    ),
    Reading(
        "rotation_transposed",
        "the rotations are inverted (transposed), the positions are not",
        "export the 4x4 matrix row by row, of the hand in the base",
        _turned(lambda r: r.inv()),
    ),
    Reading(
        "euler_order",
        "the Euler angles are about the moving axes x y z, and were read about the fixed ones",
        "state the order and frame of the Euler angles, or export quaternions",
        _turned(lambda r: Rotation.from_euler("XYZ", r.as_euler("xyz"))),
    ),
    Reading(
        "euler_order",
        "the Euler angles are about the fixed axes x y z, and were read about the moving ones",
        "state the order and frame of the Euler angles, or export quaternions",
        _turned(lambda r: Rotation.from_euler("xyz", r.as_euler("XYZ"))),
    ),
    Reading(
        "euler_order",
        "the Euler angles are in the reverse order (rz ry rx)",
        "state the order and frame of the Euler angles, or export quaternions",
        _turned(lambda r: Rotation.from_euler("xyz", r.as_euler("xyz")[:, ::-1])),
    ),
    Reading(
        "rotation_vector",
        "the angles are a rotation vector, and were read as Euler angles",
        "state that the rotation is a rotation vector (axis times angle)",
        _turned(lambda r: Rotation.from_rotvec(r.as_euler("xyz"))),
    ),
    Reading(
        "rotation_vector",
        "the angles are Euler angles, and were read as a rotation vector",
        "state the order and frame of the Euler angles",
        _turned(lambda r: Rotation.from_euler("xyz", r.as_rotvec())),
    ),
    Reading(
        "degrees",
        "the angles are in radians, and were read as degrees",
        "state the unit of the angles",
        _turned(lambda r: Rotation.from_rotvec(np.degrees(r.as_rotvec()))),
    ),
    *(
        Reading(
            "shifted",
            f"the pictures are shifted by {abs(by)} against the poses: picture k belongs to pose k{by:+d}",
            "pair each picture with the pose at which it was taken",
            _shifted(by),
        )
        for by in (1, -1, 2, -2)
    ),
    Reading(
        "reversed",
        "the poses are in the reverse order of the pictures",
        "pair each picture with the pose at which it was taken",
        lambda poses: poses[::-1],
    ),
    Reading(
        "sorted_as_text",
        "the pictures are sorted by name as text (0, 1, 10, 11, 2), the poses by number",
        "number the pictures with leading zeros",
        _as_text,
    ),
)


class Explained(NamedTuple):
    """How a reading with a mount explains the board's poses: ``rows`` (k,) of the views with ``poses`` (k, 4, 4), the
    choice (k,) among the board's poses, the transforms; and the log-likelihood per view.
    """

    reading: Reading
    mount: Mount
    rows: IntArray
    poses: FloatArray
    choice: IntArray
    form: ClosedForm

    @property
    def per_view(self) -> float:
        """Log-likelihood per view."""
        return self.form.log_likelihood / len(self.rows)


def explanations(board: BoardPoses, poses: FloatArray, turns: bool) -> list[Explained]:
    """All readings of the ``poses`` (s, 4, 4) with both mounts that leave enough views, the best first."""
    found = []
    seen = np.isfinite(board.poses[:, 0, 0, 0])
    for reading in READINGS:
        meant = reading.apply(poses)
        rows = np.flatnonzero(seen & np.isfinite(meant[:, 0, 0]))
        if len(rows) < LEAST_VIEWS:
            continue
        choice = chosen_poses(board.poses[rows], meant[rows], turns)
        chosen = board.poses[rows, choice]
        for mount in MOUNTS:
            form = closed_form(chosen, meant[rows], mount)
            found.append(Explained(reading, mount, rows, meant[rows], choice, form))
    return sorted(found, key=lambda one: -one.per_view)


def log_odds(one: Explained, other: Explained) -> float:
    """Logarithm of the odds of an explanation against another, over the views of the shorter."""
    return (one.per_view - other.per_view) * min(len(one.rows), len(other.rows))


LEAST_ODDS = float(np.log(2 * len(READINGS) / FALSE_ALARM))
"""Log-odds from which an explanation is preferred to that of the poses as given."""


class Rotations(NamedTuple):
    """Extent [deg] of the hand's rotations about their principal axes (3, 3), in the hand, largest first."""

    extent_deg: FloatArray
    axes: FloatArray

    @property
    def main_axis(self) -> str:
        """The principal axis in words."""
        k = int(np.abs(self.axes[0]).argmax())
        near = abs(self.axes[0, k]) > np.cos(np.radians(10.0))
        return f"the hand's {'xyz'[k]}" if near else f"({', '.join(f'{one:.2f}' for one in self.axes[0])}) in the hand"


def rotations_of(poses: FloatArray) -> Rotations:
    """The extent of the rotations of ``poses`` (s, 4, 4)."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    vectors = (turns.mean().inv() * turns).as_rotvec()
    axes = np.linalg.svd(vectors - vectors.mean(axis=0))[2]
    extent = np.degrees(np.ptp(vectors @ axes.T, axis=0))
    order = np.argsort(-extent)
    return Rotations(extent[order], axes[order])
