"""Mistakes in reported poses that the pictures of a known board settle before a hand-eye fit: other readings of the
rotations, poses beside the wrong pictures, motions that do not determine a hand-eye transform.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.examination.hand_eye_fit import FALSE_ALARM
from stereoservo.calibration.examination.hand_eye_start import BoardPoses, ClosedForm, chosen_poses, closed_form
from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import FloatArray, IntArray

MOUNTS: tuple[Mount, ...] = ("eye_in_hand", "eye_to_hand")
LEAST_VIEWS = 4
"""Least number of views of a hand-eye transform: three with one to check them."""
LEAST_TURN_DEG = 20.0
"""Rotation of the hand about a second axis that the literature of hand-eye calibration asks for, at least."""


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
    Reading("quaternion_order", "the quaternions have w first, and were read as x y z w", _ORDER,
            _turned(lambda r: Rotation.from_quat(np.roll(r.as_quat(), -1, axis=1)))),
    Reading("quaternion_order", "the quaternions have w last, and were read as w x y z", _ORDER,
            _turned(lambda r: Rotation.from_quat(np.roll(r.as_quat(), 1, axis=1)))),
    Reading("rotation_transposed", "the rotations are inverted (transposed), the positions are not",
            "export the 4x4 matrix row by row, of the hand in the base", _turned(lambda r: r.inv())),
    Reading("euler_order", "the Euler angles are about the moving axes x y z, and were read about the fixed ones",
            "state the order and frame of the Euler angles, or export quaternions",
            _turned(lambda r: Rotation.from_euler("XYZ", r.as_euler("xyz")))),
    Reading("euler_order", "the Euler angles are about the fixed axes x y z, and were read about the moving ones",
            "state the order and frame of the Euler angles, or export quaternions",
            _turned(lambda r: Rotation.from_euler("xyz", r.as_euler("XYZ")))),
    Reading("euler_order", "the Euler angles are in the reverse order (rz ry rx)",
            "state the order and frame of the Euler angles, or export quaternions",
            _turned(lambda r: Rotation.from_euler("xyz", r.as_euler("xyz")[:, ::-1]))),
    Reading("rotation_vector", "the angles are a rotation vector, and were read as Euler angles",
            "state that the rotation is a rotation vector (axis times angle)",
            _turned(lambda r: Rotation.from_rotvec(r.as_euler("xyz")))),
    Reading("rotation_vector", "the angles are Euler angles, and were read as a rotation vector",
            "state the order and frame of the Euler "
            "angles", _turned(lambda r: Rotation.from_euler("xyz", r.as_rotvec()))),
    Reading("degrees", "the angles are in radians, and were read as degrees",
            "state the unit of the angles", _turned(lambda r: Rotation.from_rotvec(np.degrees(r.as_rotvec())))),
    *(Reading("shifted", f"the pictures are shifted by {abs(by)} against the poses: picture k belongs to pose k{by:+d}",
              "pair each picture with the pose at which it was taken", _shifted(by)) for by in (1, -1, 2, -2)),
    Reading("reversed", "the poses are in the reverse order of the pictures",
            "pair each picture with the pose at which it was taken", lambda poses: poses[::-1]),
    Reading("sorted_as_text", "the pictures are sorted by name as text (0, 1, 10, 11, 2), the poses by number",
            "number the pictures with leading zeros", _as_text),
)  # fmt: skip


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
