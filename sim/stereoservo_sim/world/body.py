"""The marker body on the flange, as ground truth: planar faces with dots, joined like a shallow roof."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.ports.dot_plates import DEFAULT_BODY, DotFace


@dataclass(frozen=True, eq=False)
class MarkerBody:
    """Faces and their poses in the flange's frame.

    ``flange_to_face`` (f, 4, 4): maps face coordinates (x right, y down, z into the plate as seen from in
    front) to the flange's frame [m]; the outward normal of a face is its -z axis.
    """

    faces: tuple[DotFace, ...]
    flange_to_face: FloatArray

    @property
    def ids(self) -> IntArray:
        """All marker ids, face by face, (m,)."""
        return np.array([i for face in self.faces for i in face.ids], dtype=np.int64)

    @property
    def marker_points(self) -> FloatArray:
        """Dot centres in the flange's frame, (m, 3) [m], rows as ``ids``."""
        return np.concatenate(
            [
                face.positions @ pose[:3, :2].T + pose[:3, 3]
                for face, pose in zip(self.faces, self.flange_to_face, strict=True)
            ]
        )

    @property
    def marker_radii(self) -> FloatArray:
        """Radius of each marker, (m,) [m]."""
        return np.concatenate([np.full(len(face.ids), face.radius) for face in self.faces])

    @property
    def marker_normals(self) -> FloatArray:
        """Outward unit normal at each marker in the flange's frame, (m, 3)."""
        return np.concatenate(
            [
                np.tile(-pose[:3, 2], (len(face.ids), 1))
                for face, pose in zip(self.faces, self.flange_to_face, strict=True)
            ]
        )


def roof_body(
    faces: tuple[DotFace, DotFace] = (DEFAULT_BODY[0], DEFAULT_BODY[1]),
    *,
    tilt: float = float(np.deg2rad(18.0)),
    stand_off: float = 0.06,
    shift: tuple[float, float] = (0.02, 0.01),
    roll: float = 0.0,
) -> MarkerBody:
    """Two faces side by side, ridge towards the viewer, each inclined by ``tilt`` [rad].

    Args:
        faces: left and right face as seen from in front.
        tilt: inclination of each face about the ridge [rad].
        stand_off: distance of the ridge from the flange along its z axis [m].
        shift: offset of the ridge across the flange's axis [m].
        roll: turn of the body about the flange's z axis [rad].
    """
    c, s = np.cos(roll), np.sin(roll)
    # Seen from in front (looking along -z of the flange): right and down are across, into the body is -z.
    viewer = np.array([[c, s, 0, 0], [s, -c, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]])
    viewer[:3, 3] = (*shift, stand_off)
    poses = []
    for face, side in zip(faces, (-1.0, 1.0), strict=True):
        ct, st = np.cos(tilt), np.sin(tilt)
        # The plate slopes away from the viewer (towards +z of the face frame) with distance from the ridge.
        turn = np.array([[ct, 0, -side * st, 0], [0, 1, 0, 0], [side * st, 0, ct, 0], [0, 0, 0, 1.0]])
        turn[:3, 3] = turn[:3, 0] * side * face.half_side
        poses.append(viewer @ turn)
    return MarkerBody(faces=tuple(faces), flange_to_face=np.stack(poses))
