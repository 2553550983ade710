"""A goal by dragging the marker body in one picture: the other pictures follow along the epipolar lines, and the
kinematics of the learnt model make of it a posture that the arm can take.

Nothing here needs a metric model: joints, pixels and epipolar lines are what a projective one knows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.cameras import camera_centre, project_many
from stereoservo.geometry.distortion import distort, undistort
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray

FOLLOWING_WEIGHT = 0.3
"""Weight of the pixels in the pictures that follow, beside 1 in the one in which the body is dragged."""
ITERATIONS = 40
DAMPING = 1e-3
"""First damping, relative to the largest diagonal entry of the normal equations."""
CONVERGED_PX = 1e-6
LINE_STEPS = 24


@dataclass(frozen=True)
class DraggedGoal:
    """A posture ``joints`` (n,), its raw pixels (c, m, 2) of all markers, NaN where none, and how far the dragged
    picture is from what was asked, rms [px].
    """

    joints: FloatArray
    pixels: FloatArray
    left_px: float


class DragModel:
    """A learnt model, for dragging: predictions, epipolar lines, and the posture that follows a drag.

    ``limits`` (n, 2): joint positions [rad or m] that may be taken.
    """

    def __init__(self, model: CellModel, limits: FloatArray) -> None:
        self.model = model
        self.limits = limits
        self.cameras = tuple(camera.name for camera in model.cameras)
        self._Ps = np.array([camera.matrix for camera in model.cameras])
        self._chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)

    def pixels(self, joints: FloatArray) -> FloatArray:
        """Raw pixels (c, m, 2) of the markers at ``joints`` (n,); NaN where a lens shows none."""
        return self._raw(self._ideal(joints))

    def dragged(
        self, start: FloatArray, camera: str, shift: tuple[float, float], turn: float = 0.0
    ) -> DraggedGoal:
        """The posture near ``start`` (n,) whose picture in ``camera`` is that of ``start``, moved by ``shift`` [px] and
        turned by ``turn`` [rad] about the middle of its markers.

        In every other camera each marker goes to the point of its epipolar line nearest to where it is. The posture is
        the least-squares one (Levenberg-Marquardt, clipped to the limits). Raises GeometryError.
        """
        c = self._index(camera)
        now = self._ideal(start)
        raw = self._raw(now)[c]
        middle = raw.mean(axis=0)
        cosine, sine = np.cos(turn), np.sin(turn)
        asked = undistort(
            self.model.cameras[c].lens,
            middle + (raw - middle) @ np.array([[cosine, sine], [-sine, cosine]]) + np.array(shift),
        )
        if not np.isfinite(asked).all():
            raise GeometryError(
                "outside", f"the body is dragged out of what the lens of {camera} shows", camera=camera
            )
        wanted = now.copy()
        wanted[c] = asked
        for k in range(len(self.cameras)):
            if k != c:
                wanted[k] = _feet(self._lines(c, k, asked), now[k])
        weights = np.where(np.arange(len(self.cameras)) == c, 1.0, FOLLOWING_WEIGHT)
        joints = self._fitted(start, wanted, weights)
        reached = self._ideal(joints)
        left = float(np.sqrt(((reached[c] - asked) ** 2).sum(axis=-1).mean()))
        return DraggedGoal(joints, self._raw(reached), left)

    def epipolar_lines(self, camera: str, pixel: tuple[float, float]) -> dict[str, FloatArray]:
        """The epipolar line of a raw ``pixel`` in every other camera: raw points (k, 2) along it, across the picture.

        Raises GeometryError.
        """
        c = self._index(camera)
        ideal = undistort(self.model.cameras[c].lens, np.array([pixel], dtype=np.float64))
        found = {}
        for k, other in enumerate(self.model.cameras):
            if k != c and np.isfinite(ideal).all():
                points = _across(self._lines(c, k, ideal)[0], other.width, other.height)
                raw = distort(other.lens, points)
                found[other.name] = raw[np.isfinite(raw).all(axis=1)]
        return found

    def _index(self, camera: str) -> int:
        if camera not in self.cameras:
            raise GeometryError(
                "camera", f"no camera {camera!r} in the model; it has {', '.join(self.cameras)}"
            )
        return self.cameras.index(camera)

    def _ideal(self, joints: FloatArray) -> FloatArray:
        return project_many(self._Ps, self.model.marker_points @ self._chain.displacement(joints).T)

    def _raw(self, ideal: FloatArray) -> FloatArray:
        return np.array(
            [distort(camera.lens, pixels) for camera, pixels in zip(self.model.cameras, ideal, strict=True)]
        )

    def _lines(self, c: int, k: int, ideal: FloatArray) -> FloatArray:
        """Epipolar lines (m, 3) in camera ``k`` of ideal pixels (m, 2) in camera ``c``: epipole and image of the ray."""
        epipole = self._Ps[k] @ camera_centre(self._Ps[c])
        ray = np.linalg.pinv(self._Ps[c]) @ np.column_stack([ideal, np.ones(len(ideal))]).T
        lines: FloatArray = np.cross(epipole, (self._Ps[k] @ ray).T)
        return lines

    def _fitted(self, start: FloatArray, wanted: FloatArray, weights: FloatArray) -> FloatArray:
        """Joints (n,) within the limits whose ideal pixels are nearest to ``wanted`` (c, m, 2)."""
        low, high = self.limits.T
        q = np.clip(start, low, high)
        scale = np.sqrt(weights)[:, None, None]
        residual = (scale * (wanted - self._ideal(q))).ravel()
        damping = DAMPING
        for _ in range(ITERATIONS):
            points = self.model.marker_points @ self._chain.displacement(q).T
            J = (scale[..., None] * self._chain.image_jacobian(self._Ps, q, points)).reshape(len(residual), -1)
            free = ~(((q <= low) & (J.T @ residual < 0.0)) | ((q >= high) & (J.T @ residual > 0.0)))
            if not free.any():
                break
            A = J[:, free].T @ J[:, free]
            A += damping * A.diagonal().max() * np.eye(len(A))
            step = np.zeros(len(q))
            step[free] = np.linalg.solve(A, J[:, free].T @ residual)
            tried = np.clip(q + step, low, high)
            with np.errstate(invalid="ignore"):
                left = (scale * (wanted - self._ideal(tried))).ravel()
            if not left @ left < residual @ residual:
                damping *= 10.0
                if damping > 1e6:
                    break
                continue
            gain = float(np.sqrt(residual @ residual) - np.sqrt(left @ left))
            q, residual, damping = tried, left, max(damping / 10.0, 1e-12)
            if gain < CONVERGED_PX:
                break
        return q


def _feet(lines: FloatArray, pixels: FloatArray) -> FloatArray:
    """The points (m, 2) of lines (m, 3) nearest to ``pixels`` (m, 2)."""
    normals = lines[:, :2]
    away = (normals * pixels).sum(axis=1) + lines[:, 2]
    return pixels - normals * (away / (normals**2).sum(axis=1))[:, None]


def _across(line: FloatArray, width: int, height: int) -> FloatArray:
    """Points (k, 2) along a line (3,) over the picture and a little beyond."""
    middle = 0.5 * np.array([[width, height]])
    foot = _feet(line[None], middle)[0]
    along = np.array([-line[1], line[0]]) / np.hypot(line[0], line[1])
    reach = 0.75 * np.hypot(width, height)
    points: FloatArray = foot + np.linspace(-reach, reach, LINE_STEPS)[:, None] * along
    return points
