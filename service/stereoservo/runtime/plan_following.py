"""Following a planned way in the images: where the set-points are now on their way, and how fast they go."""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import Scene, Task
from stereoservo.kinematics.kernels import project_points, transform_points
from stereoservo.runtime.motion import Present
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.state import Servoing
from stereoservo.trajectory.tracking import advance, planned_joints, sample_plan

LARGEST_LAG_PX = 20.0
"""Distance behind its way at which the body is waited for."""


def on_the_way(source: Servoing, present: Present, scene: Scene, task: Task) -> Task:
    """The task of law ``trajectory`` now: where the plan has set-points and joints, and how fast; its time goes on."""
    plan = source.plan
    assert plan is not None
    begin_s = source.plan_s
    set_points, share = _set_points(source, scene)
    wanted = np.ones_like(source.wanted) if share < 1.0 else source.wanted
    apart = np.sqrt(((set_points - scene.pixels) ** 2).sum(axis=-1))
    lag = float(np.where(scene.weights * wanted > 0.0, apart, 0.0).max()) / LARGEST_LAG_PX
    source.plan_s = advance(plan, source.plan_s, present.dt_s, lag)
    # What the set-points move by in the step that begins: its mean is what a velocity held so long can do.
    ahead, _ = _set_points(source, scene)
    joints = planned_joints(plan, begin_s, source.plan_s, present.dt_s, present.q)
    return task._replace(
        set_points=set_points, wanted=wanted, rates=(ahead - set_points) / present.dt_s, joint_rates=joints.rates,
        joint_error=joints.error, joint_weight=joints.weight,
    )  # fmt: skip


def _set_points(source: Servoing, scene: Scene) -> tuple[FloatArray, float]:
    """Where the plan has the set-points (c, m, 2) at its present time, and the share of this time in its length.

    What the goal's set-points differ by from the body's projections is brought in along the way.
    """
    plan, start = source.plan, source.start_points
    assert plan is not None
    assert start is not None
    here = sample_plan(plan, source.plan_s).displacement
    pixels, _ = project_points(scene.matrices, transform_points(here, start))
    length_s = float(plan.times[-1])
    share = min(1.0, source.plan_s / length_s) if length_s > 0.0 else 1.0
    goal_pixels, _ = project_points(scene.matrices, source.target_points)
    given = source.wanted[..., None] > 0.0
    return pixels + share * np.where(given, source.set_points - goal_pixels, 0.0), share
