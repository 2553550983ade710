"""Data that pages draw from a learnt model at given joints: predictions, the scene, and a dragged posture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from stereoservo.geometry.cameras import camera_centre, project_many
from stereoservo.geometry.distortion import distort, undistort
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.axes import euclidean_centres, framed_model, joint_axes
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Goal, PlanReport
from stereoservo.messages.wire import CellInfo, StateMessage
from stereoservo.numerics.arrays import FloatArray


@dataclass(frozen=True)
class ModelView:
    """Drawing data of a model; empty without a model (None)."""

    model: DragModel | None = None
    scene: Scene | None = None

    @classmethod
    def of(cls, model: CellModel, info: CellInfo) -> Self:
        """The view of ``model``, of the cell with these joints."""
        limits = np.array([[joint.position_min, joint.position_max] for joint in info.joints])
        return cls(DragModel(model, limits), Scene.of(model))

    def at(self, state: StateMessage) -> dict[str, Any]:
        """``predicted`` pixels and the ``scene`` at the joints of ``state``, published along with it."""
        joints = np.array(list(state.joints.values()))
        model = self.model
        if model is None or joints.shape != model.model.zero.shape or not np.isfinite(joints).all():
            return {"predicted": {}, "scene": None}
        return {
            "predicted": by_camera(model, model.pixels(joints)),
            "scene": None if self.scene is None else self.scene.at(joints),
        }

    def goal(self, goal: Goal, plan: PlanReport | None) -> dict[str, Any]:
        """Drawing data of a running goal: its plan, its set-points if it has pixels, and in the ``scene`` the markers
        (m, 3) at the end of the plan, else None.
        """
        points = None
        if self.scene is not None and plan is not None and len(plan.joints) == len(self.scene.chain.kinds):
            points = self.scene.markers(np.array([positions[-1] for positions in plan.joints.values()])).tolist()
        stated = getattr(goal.target, "set_points", {})
        return {"goal": {"id": goal.id, "plan": plan, "set_points": stated, "scene": points}}


def by_camera(model: DragModel, pixels: FloatArray) -> dict[str, dict[int, list[float]]]:
    """Pixels (c, m, 2) by camera and marker, without missing ones."""
    return {
        camera: {
            marker: pixel.tolist()
            for marker, pixel in zip(model.model.marker_ids, shown, strict=True)
            if np.isfinite(pixel).all()
        }
        for camera, shown in zip(model.cameras, pixels, strict=True)
    }


def drag_answer(model: DragModel, joints: FloatArray, camera: str, left_px: float) -> dict[str, Any]:
    """Drawing data of a dragged posture: pixels, and the epipolar lines of the body's centroid."""
    pixels = model.pixels(joints)
    c = model.cameras.index(camera)
    u, v = pixels[c].mean(axis=0).tolist()
    lines = model.epipolar_lines(camera, (u, v))
    return {
        "pixels": by_camera(model, pixels),
        "lines": {name: line.tolist() for name, line in lines.items()},
        "left_px": left_px,
        "camera": camera,
    }


def no_goal() -> dict[str, Any]:
    """Drawing data while no goal runs."""
    return {"goal": {"id": "", "plan": None, "set_points": {}, "scene": None}}


# -- dragged postures ----------------------------------------------------------------------------------------
# A goal by dragging the marker body in one picture: in the other pictures its markers follow along their epipolar
# lines, and the kinematics of the learnt model fit a posture that the arm can take.
#
# This does not need a metric model, only a plane at infinity, which fixes the depth in the dragged picture.


ITERATIONS = 40
DAMPING, LEAST_DAMPING, LARGEST_DAMPING = 1e-3, 1e-12, 1e6
"""Initial, least and largest damping, relative to the largest diagonal entry of the normal equations."""
CONVERGED_PX = 1e-6
LINE_STEPS = 24


@dataclass(frozen=True)
class DraggedGoal:
    """A posture ``joints`` (n,), its raw pixels (c, m, 2) of all markers, NaN where there are none, and the rms
    distance [px] of the dragged picture from the requested one.
    """

    joints: FloatArray
    pixels: FloatArray
    left_px: float


class DragModel:
    """A learnt model, for dragging: predictions, epipolar lines, and the posture that follows a drag.

    ``limits`` (n, 2): allowed joint positions [rad or m].
    """

    def __init__(self, model: CellModel, limits: FloatArray) -> None:
        self.model = model
        self.limits = limits
        self.cameras = tuple(camera.name for camera in model.cameras)
        self._Ps = np.array([camera.matrix for camera in model.cameras])
        self._chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)

    def pixels(self, joints: FloatArray) -> FloatArray:
        """Raw pixels (c, m, 2) of the markers at ``joints`` (n,); NaN outside of a lens's image."""
        return self._raw(self._ideal(joints))

    def dragged(
        self,
        start: FloatArray,
        camera: str,
        shift: tuple[float, float],
        turn: float = 0.0,
        nearer: float = 1.0,
    ) -> DraggedGoal:
        """The posture near ``start`` (n,) at which the centroid of the markers is moved by ``shift`` [px] in
        ``camera``.

        One picture does not determine the depth. It is held constant with respect to the model's plane at infinity, so
        the body moves parallel to the picture without turning; ``nearer`` multiplies it. ``turn`` [rad] turns the body
        about the ray through its centroid. In the other cameras every marker moves along its epipolar line. The posture
        is the least-squares one over all pictures (Levenberg-Marquardt, clipped to the limits). Raises GeometryError.
        """
        c = self._index(camera)
        required = project_many(self._Ps, self._required_points(c, self._points(start), np.array(shift), turn, nearer))
        if not np.isfinite(required).all():
            raise GeometryError("outside", f"the body is dragged into the focal plane of {camera}", camera=camera)
        joints = self._fitted(start, required)
        reached = self._ideal(joints)
        left = float(np.sqrt(((reached[c] - required[c]) ** 2).sum(axis=-1).mean()))
        return DraggedGoal(joints, self._raw(reached), left)

    def _required_points(self, c: int, points: FloatArray, shift: FloatArray, turn: float, nearer: float) -> FloatArray:
        """Markers (m, 4) requested by `dragged`; the arm may be unable to make this displacement."""
        lens, P = self.model.cameras[c].lens, self._Ps[c, None]
        centroid = points.mean(axis=0)
        centre = project_many(P, centroid[None])[0]
        asked = undistort(lens, distort(lens, centre) + shift)
        if not np.isfinite(asked).all():
            raise GeometryError(
                "outside",
                f"the body is dragged out of what the lens of {self.cameras[c]} shows",
                camera=self.cameras[c],
            )
        cosine, sine = np.cos(turn), np.sin(turn)
        rotated = centre + (project_many(P, points)[0] - centre) @ np.array([[cosine, sine], [-sine, cosine]])
        goal = self._on_rays(c, asked, nearer * centroid[None] @ self._Ps[c, 2])[0]
        placed: FloatArray = self._on_rays(c, rotated, points @ self._Ps[c, 2]) + (goal - centroid)
        return placed

    def _on_rays(self, c: int, ideal: FloatArray, depths: FloatArray) -> FloatArray:
        """Points (m, 4) of scale 1 that camera ``c`` sees at ideal pixels (m, 2) with ``depths`` (m,)."""
        rows = np.vstack([self._Ps[c], self.model.plane_at_infinity])
        sides = np.column_stack([depths[:, None] * ideal, depths, np.ones(len(ideal))])
        found: FloatArray = np.linalg.solve(rows, sides.T).T
        return found

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
            raise GeometryError("camera", f"no camera {camera!r} in the model; it has {', '.join(self.cameras)}")
        return self.cameras.index(camera)

    def _points(self, joints: FloatArray) -> FloatArray:
        points: FloatArray = self.model.marker_points @ self._chain.displacement(joints).T
        return points

    def _ideal(self, joints: FloatArray) -> FloatArray:
        return project_many(self._Ps, self._points(joints))

    def _raw(self, ideal: FloatArray) -> FloatArray:
        return np.array(
            [distort(camera.lens, pixels) for camera, pixels in zip(self.model.cameras, ideal, strict=True)]
        )

    def _lines(self, c: int, k: int, ideal: FloatArray) -> FloatArray:
        """Epipolar lines (m, 3) in camera ``k`` of ideal pixels (m, 2) in camera ``c``: through the epipole."""
        epipole = self._Ps[k] @ camera_centre(self._Ps[c])
        ray = np.linalg.pinv(self._Ps[c]) @ np.column_stack([ideal, np.ones(len(ideal))]).T
        lines: FloatArray = np.cross(epipole, (self._Ps[k] @ ray).T)
        return lines

    def _fitted(self, start: FloatArray, required: FloatArray) -> FloatArray:
        """Joints (n,) within the limits with ideal pixels nearest to ``required`` (c, m, 2)."""
        low, high = self.limits.T
        q = np.clip(start, low, high)
        residual = (required - self._ideal(q)).ravel()
        damping = DAMPING
        for _ in range(ITERATIONS):
            J = self._chain.image_jacobian(self._Ps, q, self._points(q)).reshape(len(residual), -1)
            downhill = J.T @ residual
            free = ~(((q <= low) & (downhill < 0.0)) | ((q >= high) & (downhill > 0.0)))
            if not free.any():
                break
            A = J[:, free].T @ J[:, free]
            A += damping * A.diagonal().max() * np.eye(len(A))
            tried = q.copy()
            tried[free] += np.linalg.solve(A, downhill[free])
            tried = np.clip(tried, low, high)
            left = (required - self._ideal(tried)).ravel()
            if not left @ left < residual @ residual:  # NaN in a focal plane: not an improvement
                damping *= 10.0
                if damping > LARGEST_DAMPING:
                    break
                continue
            gain = float(np.sqrt(residual @ residual) - np.sqrt(left @ left))
            q, residual, damping = tried, left, max(damping / 10.0, LEAST_DAMPING)
            if gain < CONVERGED_PX:
                break
        return q


def _feet(lines: FloatArray, pixels: FloatArray) -> FloatArray:
    """The points (m, 2) of lines (m, 3) nearest to ``pixels`` (m, 2)."""
    normals = lines[:, :2]
    away = (normals * pixels).sum(axis=1) + lines[:, 2]
    feet: FloatArray = pixels - normals * (away / (normals**2).sum(axis=1))[:, None]
    return feet


def _across(line: FloatArray, width: int, height: int) -> FloatArray:
    """Points (k, 2) along a line (3,) across the picture and slightly beyond."""
    centre = 0.5 * np.array([[width, height]])
    foot = _feet(line[None], centre)[0]
    along = np.array([-line[1], line[0]]) / np.hypot(line[0], line[1])
    reach = 0.75 * np.hypot(width, height)
    points: FloatArray = foot + np.linspace(-reach, reach, LINE_STEPS)[:, None] * along
    return points


# -- the scene -----------------------------------------------------------------------------------------------
# Three-dimensional scene of a metric model: joint axes, markers and cameras in its Euclidean frame.


@dataclass(frozen=True)
class Scene:
    """The scene of a metric model with static cameras; its unit of length is the model's own."""

    chain: ProjectiveChain
    points: FloatArray
    cameras: list[dict[str, Any]]

    @classmethod
    def of(cls, model: CellModel) -> Self | None:
        """The scene of ``model``; None if it is not metric, or its cameras are mounted on the arm."""
        if model.stratum != "metric" or model.tip_first:
            return None
        parts = framed_model(model)
        directions = parts.cameras[:, 2, :3] * np.sign(np.linalg.det(parts.cameras[:, :, :3]))[:, None]
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        cameras = [
            {"name": camera.name, "centre": centre.tolist(), "axis": axis.tolist()}
            for camera, centre, axis in zip(model.cameras, euclidean_centres(parts.cameras), directions, strict=True)
        ]
        return cls(ProjectiveChain(parts.kinds, parts.generators, parts.zero), parts.points, cameras)

    def markers(self, joints: FloatArray) -> FloatArray:
        """Markers (m, 3) at ``joints`` (n,)."""
        points = self.points @ self.chain.displacement(joints).T
        found: FloatArray = points[:, :3] / points[:, 3:]
        return found

    def at(self, joints: FloatArray) -> dict[str, Any]:
        """Axes (a point near the markers, a direction), markers and cameras at ``joints`` (n,)."""
        markers = self.markers(joints)
        axes = joint_axes(self.chain.kinds, self.chain.operators_at(joints))
        centroid = markers.mean(axis=0)
        origins = np.where(np.isfinite(axes.points), axes.points, centroid)
        along = ((centroid - origins) * axes.directions).sum(axis=1)
        nearest = origins + along[:, None] * axes.directions
        return {
            "axes": [[p.tolist(), d.tolist()] for p, d in zip(nearest, axes.directions, strict=True)],
            "markers": markers.tolist(),
            "cameras": self.cameras,
        }
