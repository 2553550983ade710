"""The law ``trajectory`` in a campaign: the path is planned before the motion, or refused, and then tracked."""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import Scene, Task
from stereoservo.kinematics.kernels import project_points, transform_points
from stereoservo.kinematics.model import pinhole
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.plan import ClosestApproach, Plan, PlanLimits, PlanRequest
from stereoservo.planning.planner import plan
from stereoservo.planning.tracking import advance, planned_joints, sample_plan
from stereoservo_sim.tasks.setting import FACE, HEIGHT, WIDTH
from stereoservo_sim.world.synthetic import Kind

LOOK_S = 0.4
"""The controller looks at the plate for so long before it plans."""
VIEW_MARGIN_PX = 2.0
"""Planned distance from the images' borders: for noise and what the body lags."""
JOINT_MARGIN = 0.02
"""Planned distance from the joints' limits [rad], likewise."""
LARGEST_LAG_PX = 20.0
"""Distance behind its path at which the plan waits for the body."""
SPEED_M, SPEED_RAD = 0.1, 0.6
"""[m/s], [rad/s]; accelerations reach them in half a second."""
ACCELERATION_S = 0.5


class NoPathError(Exception):
    """There is no path. ``reason``: why, and where on the path."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class PlannedPath:
    """A planned path during its execution."""

    def __init__(self, planned: Plan, start: FloatArray, task: Task) -> None:
        self.plan = planned
        self._start = start
        self._task = task
        self._time_s = 0.0

    def task_now(self, scene: Scene, task: Task, joints: FloatArray, dt_s: float) -> Task:
        """Current set-points of the plan, with their velocities as a difference over ``dt_s``.

        The same of its joints, for an arm at ``joints`` (n,).
        The plan's time advances by ``dt_s``, or less where the body lags.
        """
        set_points = self._set_points(scene)
        apart = np.sqrt(((set_points - scene.pixels) ** 2).sum(axis=-1))
        lag = float(np.where(scene.weights > 0.0, apart, 0.0).max()) / LARGEST_LAG_PX
        begin_s, self._time_s = self._time_s, advance(self.plan, self._time_s, dt_s, lag)
        planned = planned_joints(self.plan, begin_s, self._time_s, dt_s, joints)
        return task._replace(
            set_points=set_points, rates=(self._set_points(scene) - set_points) / dt_s, joint_rates=planned.rates,
            joint_error=planned.error, joint_weight=planned.weight,
        )  # fmt: skip

    def _set_points(self, scene: Scene) -> FloatArray:
        points = transform_points(sample_plan(self.plan, self._time_s).displacement, self._start)
        pixels, _ = project_points(scene.matrices, points)
        length_s = float(self.plan.times[-1])
        share = min(1.0, self._time_s / length_s) if length_s > 0.0 else 1.0
        # What the goal's pixels differ by from the body's projections comes in along the way.
        goal, _ = project_points(scene.matrices, self._task.target_points)
        return np.asarray(pixels + share * (self._task.set_points - goal))


def plan_task_path(
    scene: Scene, task: Task, joints: FloatArray, limits: FloatArray, kinds: tuple[Kind, ...]
) -> PlannedPath:
    """Path from ``scene`` to ``task``; ``limits`` (n, 2) and ``kinds`` of the joints. Raises NoPathError."""
    n, cameras = len(joints), len(scene.matrices)
    speeds = np.array([SPEED_M if kind == "prismatic" else SPEED_RAD for kind in kinds])
    request = PlanRequest(
        operators=scene.operators,
        composition=scene.composition,
        joints=joints,
        matrices=scene.matrices,
        camera_centres=scene.camera_centres,
        points=scene.points,
        targets=task.target_points,
        kept=np.ones(len(scene.points)),
        centre=task.centre,
        centre_target=task.centre_target,
        faces=FACE[None],
        limits=PlanLimits(
            position_min=limits[:, 0] + JOINT_MARGIN,
            position_max=limits[:, 1] - JOINT_MARGIN,
            velocity_max=speeds,
            acceleration_max=speeds / ACCELERATION_S,
            keep_outs=np.zeros((0, n, 2)),
            sizes=np.tile(np.array([WIDTH, HEIGHT], dtype=np.float64), (cameras, 1)),
            lenses=np.tile(pinhole(), (cameras, 1)),
            view_margin_px=VIEW_MARGIN_PX,
        ),
    )
    planning = plan(request)
    if planning.plan is None:
        raise NoPathError("; ".join(describe_failure(failure) for failure in planning.failure))
    return PlannedPath(planning.plan, scene.points.copy(), task)


def describe_failure(failure: ClosestApproach) -> str:
    """A failure as text."""
    marker = f" of marker {failure.marker}" if failure.marker >= 0 else ""
    return (
        f"{failure.what} {failure.index}{marker} at {failure.share:.0%} of the way: {failure.value:.4g} "
        f"{failure.unit}, limit {failure.limit:.4g}"
    )
