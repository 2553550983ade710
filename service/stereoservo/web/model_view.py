"""What pages are shown of a learnt model at some joints: predictions, the scene, and a dragged posture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Goal, PlanReport
from stereoservo.messages.wire import CellInfo, StateMessage
from stereoservo.numerics.arrays import FloatArray
from stereoservo.web.drag_goal import DragModel
from stereoservo.web.scene import Scene


@dataclass(frozen=True)
class ModelView:
    """A model as it is drawn; without one (None) nothing is."""

    model: DragModel | None = None
    scene: Scene | None = None

    @classmethod
    def of(cls, model: CellModel, info: CellInfo) -> Self:
        """The view of ``model``, of the cell with these joints."""
        limits = np.array([[joint.position_min, joint.position_max] for joint in info.joints])
        return cls(DragModel(model, limits), Scene.of(model))

    def at(self, state: StateMessage) -> dict[str, Any]:
        """``predicted`` pixels and the ``scene`` at the joints of ``state``, beside which a page gets them."""
        joints = np.array(list(state.joints.values()))
        model = self.model
        if model is None or joints.shape != model.model.zero.shape or not np.isfinite(joints).all():
            return {"predicted": {}, "scene": None}
        return {
            "predicted": by_camera(model, model.pixels(joints)),
            "scene": None if self.scene is None else self.scene.at(joints),
        }

    def goal(self, goal: Goal, plan: PlanReport | None) -> dict[str, Any]:
        """What a page draws of a goal that runs: its plan, its set-points where it states pixels, and in the ``scene``
        the markers (m, 3) where the plan ends, else None.
        """
        points = None
        if self.scene is not None and plan is not None and len(plan.joints) == len(self.scene.chain.kinds):
            points = self.scene.markers(np.array([way[-1] for way in plan.joints.values()])).tolist()
        stated = getattr(goal.target, "set_points", {})
        return {"goal": {"id": goal.id, "plan": plan, "set_points": stated, "scene": points}}


def by_camera(model: DragModel, pixels: FloatArray) -> dict[str, dict[int, list[float]]]:
    """Pixels (c, m, 2) by camera and marker; those that are not there are left out."""
    return {
        camera: {
            marker: pixel.tolist()
            for marker, pixel in zip(model.model.marker_ids, shown, strict=True)
            if np.isfinite(pixel).all()
        }
        for camera, shown in zip(model.cameras, pixels, strict=True)
    }


def drag_answer(model: DragModel, joints: FloatArray, camera: str, left_px: float) -> dict[str, Any]:
    """What a page draws of a dragged posture: pixels, and the epipolar lines of the body's middle."""
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
    """What a page draws while no goal runs."""
    return {"goal": {"id": "", "plan": None, "set_points": {}, "scene": None}}
