"""The simulated workpiece: a plate of two small faces beside the marker body, static until it is moved on request.

Its present pose is in a file in the cell's runtime directory, so that a shell, a test or a demonstration can
move it while the cell runs, whichever processes its cameras live in.
"""

from __future__ import annotations

import os
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
    """Invalid content of the file that moves a thing; the text names the file and what would be valid."""


class Moved(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A displacement: ``shift_m`` [m] and the rotation vector ``turn_deg`` [degrees]."""

    shift_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    turn_deg: tuple[Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0)

    @property
    def matrix(self) -> FloatArray:
        """Displacement (4, 4): rotation about the origin, then translation. Raises ValueError where not finite."""
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


@dataclass(frozen=True, eq=False)
class Workpiece:
    """The workpiece. ``body``: its faces in its own frame; ``stand`` (4, 4): its initial pose in the world."""

    body: MarkerBody
    stand: FloatArray

    def pose(self, moved: Moved) -> FloatArray:
        """Pose (4, 4) in the world, rotated about its own centre by world axes and translated."""
        displacement = moved.matrix
        pose = self.stand.copy()
        pose[:3, :3] = displacement[:3, :3] @ self.stand[:3, :3]
        pose[:3, 3] += displacement[:3, 3]
        return pose

    def marker_positions(self, pose: FloatArray) -> FloatArray:
        """Markers in the world at ``pose`` (4, 4), (m, 3) [m], rows as ``body.ids``."""
        return self.body.marker_points @ pose[:3, :3].T + pose[:3, 3]


def plate_body(tilt: float = TILT) -> MarkerBody:
    """The upper and the lower face, ridge towards the viewer, each inclined by ``tilt`` [rad].

    The frame is the viewer's: origin in the middle of the ridge, x right, y down, z away from him.
    """
    c, s = np.cos(tilt), np.sin(tilt)
    poses = []
    for face, side in zip(WORKPIECE, (-1.0, 1.0), strict=True):
        pose = np.array([[1, 0, 0, 0], [0, c, -side * s, 0], [0, side * s, c, 0], [0, 0, 0, 1.0]])
        pose[:3, 3] = pose[:3, 1] * side * face.half_side
        poses.append(pose)
    return MarkerBody(faces=WORKPIECE, flange_to_face=np.stack(poses))


class MovedFile:
    """File with the present displacement of a thing in the cell's runtime directory; read again when changed.

    ``name``: of the file; by default the workpiece's.
    """

    def __init__(self, runtime_dir: Path, name: str = FILE_NAME) -> None:
        self.path = runtime_dir / name
        self._seen: tuple[int, int, int] | None = None
        self._moved = Moved()

    def write(self, moved: Moved) -> None:
        """Write a displacement atomically; it acts from the next shutter on. Raises OSError, ValueError."""
        if not np.isfinite(moved.matrix).all():
            raise ValueError(f"{moved} is no displacement")
        fresh = self.path.with_name(f"{self.path.name}.{os.getpid()}")
        fresh.write_bytes(msgspec.json.encode(moved) + b"\n")
        fresh.replace(self.path)

    def now(self, otherwise: Moved = Moved()) -> Moved:  # noqa: B008 - frozen
        """Present displacement; ``otherwise`` where there is no file. Raises MovedFileError."""
        try:
            status = self.path.stat()
            seen = (status.st_ino, status.st_mtime_ns, status.st_size)
            if seen != self._seen:
                self._moved = msgspec.json.decode(self.path.read_bytes(), type=Moved)
                self._seen = seen
        except FileNotFoundError:
            self._seen = None
            return otherwise
        except Exception as error:  # a decoder may raise anything
            raise MovedFileError(
                f'{self.path}: {error}; such a file holds {{"shift_m": [x, y, z], "turn_deg": [x, y, z]}}'
            ) from error
        return self._moved
