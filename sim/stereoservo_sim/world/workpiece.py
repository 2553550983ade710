"""The simulated workpiece: a plate of two small faces beside the marker body, static until it is moved on request.

Its current pose, or its motion, is in a file in the cell's runtime directory, so that a shell, a test or a
demonstration can move it while the cell runs, in whichever processes its cameras run. With cameras on the arm the same
file moves the marker body that they observe.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.dot_plates import WORKPIECE
from stereoservo_sim.world.body import MarkerBody

Metres = Annotated[float, Meta(ge=-10, le=10)]
Degrees = Annotated[float, Meta(ge=-180, le=180)]

FILE_NAME = "simulated-workpiece.json"
TILT = float(np.deg2rad(25.0))


class MovedFileError(Exception):
    """The file that moves an object has invalid content; the text names the file and states what would be valid."""


class Moved(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A displacement: ``shift_m`` [m] and the rotation vector ``turn_deg`` [degrees]."""

    shift_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    turn_deg: tuple[Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0)

    @property
    def matrix(self) -> FloatArray:
        """Displacement (4, 4): rotation about the origin, then translation. Raises ValueError if not finite."""
        if not np.isfinite([*self.shift_m, *self.turn_deg]).all():
            raise ValueError(f"shift_m {self.shift_m} and turn_deg {self.turn_deg} must be finite numbers")
        pose = np.eye(4)
        pose[:3, 3] = self.shift_m
        vector = np.deg2rad(self.turn_deg)
        angle = float(np.linalg.norm(vector))
        if angle > 0.0:
            x, y, z = vector / angle
            skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            pose[:3, :3] += np.sin(angle) * skew + (1.0 - np.cos(angle)) * skew @ skew
        return pose


class Motion(Moved, frozen=True, forbid_unknown_fields=True):
    """A continuing displacement, from the monotonic time ``since_ns`` on (None: since its file was written) for
    ``for_s``.

    It translates at ``velocity_m_s``, rotates at ``turn_rate_deg_s`` about an axis through ``about_m`` [m] from its
    origin (a turntable's), and oscillates along ``swing_m`` at ``swing_hz``; it restarts from its beginning every
    ``every_s``.
    """

    velocity_m_s: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    turn_rate_deg_s: tuple[Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0)
    about_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    swing_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    swing_hz: Annotated[float, Meta(ge=0, le=10)] = 0.0
    since_ns: int | None = None
    for_s: Annotated[float, Meta(gt=0)] | None = None
    every_s: Annotated[float, Meta(gt=0)] | None = None

    def at(self, t_ns: int) -> Moved:
        """The displacement at ``t_ns``."""
        elapsed_s = max(0.0, (t_ns - (self.since_ns or 0)) * 1e-9)
        elapsed_s = elapsed_s if self.every_s is None else elapsed_s % self.every_s
        elapsed_s = elapsed_s if self.for_s is None else min(elapsed_s, self.for_s)
        swing = float(np.sin(2.0 * np.pi * self.swing_hz * elapsed_s))
        shift = np.array(self.shift_m) + elapsed_s * np.array(self.velocity_m_s) + swing * np.array(self.swing_m)
        turned = elapsed_s * np.array(self.turn_rate_deg_s)
        axis, turn = np.array(self.about_m), np.array(self.turn_deg) + turned
        shift = shift + axis - Moved(turn_deg=tuple(turned.tolist())).matrix[:3, :3] @ axis
        return Moved(tuple(shift.tolist()), tuple(turn.tolist()))


@dataclass(frozen=True, eq=False)
class Workpiece:
    """The workpiece. ``body``: its faces in its own frame; ``stand`` (4, 4): its initial pose in the world."""

    body: MarkerBody
    stand: FloatArray

    def pose(self, moved: Moved) -> FloatArray:
        """Pose (4, 4) in the world, rotated about its own centre by world axes and translated."""
        return moved_pose(self.stand, moved)

    def marker_positions(self, pose: FloatArray) -> FloatArray:
        """Markers in the world at ``pose`` (4, 4), (m, 3) [m], rows as ``body.ids``."""
        return self.body.marker_points @ pose[:3, :3].T + pose[:3, 3]


def moved_pose(stand: FloatArray, moved: Moved) -> FloatArray:
    """The pose ``stand`` (4, 4) rotated about its own origin by the world's axes and translated."""
    displacement = moved.matrix
    pose = stand.copy()
    pose[:3, :3] = displacement[:3, :3] @ stand[:3, :3]
    pose[:3, 3] += displacement[:3, 3]
    return pose


def plate_body(tilt: float = TILT) -> MarkerBody:
    """Body of an upper and a lower face, ridge towards the viewer, each inclined by ``tilt`` [rad].

    The viewer's frame: origin in the middle of the ridge, x right, y down, z away from the viewer.
    """
    c, s = np.cos(tilt), np.sin(tilt)
    poses = []
    for face, side in zip(WORKPIECE, (-1.0, 1.0), strict=True):
        pose = np.array([[1, 0, 0, 0], [0, c, -side * s, 0], [0, side * s, c, 0], [0, 0, 0, 1.0]])
        pose[:3, 3] = pose[:3, 1] * side * face.half_side
        poses.append(pose)
    return MarkerBody(faces=WORKPIECE, flange_to_face=np.stack(poses))


class MovedFile:
    """File in the cell's runtime directory with the current displacement of an object; read again when it changes.

    ``name``: of the file; by default the workpiece's.
    """

    def __init__(self, runtime_dir: Path, name: str = FILE_NAME) -> None:
        self.path = runtime_dir / name
        self._seen: tuple[int, int, int] | None = None
        self._moved: Moved = Moved()

    def write(self, moved: Moved) -> None:
        """Write a displacement or motion atomically; effective from the next shutter on. Raises OSError, ValueError."""
        if not np.isfinite(moved.matrix).all():
            raise ValueError(f"{moved} is no displacement")
        fresh = self.path.with_name(f"{self.path.name}.{os.getpid()}")
        fresh.write_bytes(msgspec.json.encode(moved) + b"\n")
        fresh.replace(self.path)

    def now(self, otherwise: Moved = Moved(), t_ns: int | None = None) -> Moved:  # noqa: B008 - frozen
        """Current displacement, of a motion at ``t_ns``; ``otherwise`` if there is no file. Raises MovedFileError."""
        try:
            status = self.path.stat()
            seen = (status.st_ino, status.st_mtime_ns, status.st_size)
            if seen != self._seen:
                self._moved = self._read(status.st_mtime_ns)
                self._seen = seen
        except FileNotFoundError:
            self._seen = None
            return otherwise
        except Exception as error:  # a decoder may raise anything
            raise MovedFileError(
                f'{self.path}: {error}; such a file holds {{"shift_m": [x, y, z], "turn_deg": [x, y, z]}}, and of a '
                'workpiece that goes on "velocity_m_s", "turn_rate_deg_s", or "swing_m" with "swing_hz"'
            ) from error
        if isinstance(self._moved, Motion) and t_ns is not None:
            return self._moved.at(t_ns)
        return self._moved

    def _read(self, written_ns: int) -> Moved:
        motion = msgspec.json.decode(self.path.read_bytes(), type=Motion)
        if not any((*motion.velocity_m_s, *motion.turn_rate_deg_s, motion.swing_hz)):
            return Moved(motion.shift_m, motion.turn_deg)
        if motion.since_ns is not None:
            return motion
        elapsed_ns = max(0, time.time_ns() - written_ns)
        return msgspec.structs.replace(motion, since_ns=time.monotonic_ns() - elapsed_ns)
