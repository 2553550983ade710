"""What every motion source gets and gives: one view of the present, one joint velocity (DESIGN 2, step 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.estimate import ModelArrays, Prediction
from stereoservo.runtime.ports import CameraObservation, FloatArray
from stereoservo.runtime.settings import CoreSettings
from stereoservo.runtime.state import CoreState, JointMove

APPROACH_GAIN = 15.0  # [1/s] end of a joint move
BRAKE_SHARE = 0.6  # of the acceleration limit that a joint move plans with
ARRIVED = 5e-4  # [rad or m]
ARRIVED_STEPS = 5

Emit = Callable[..., None]


@dataclass(frozen=True)
class Present:
    """One step as a motion source sees it. ``prediction``, ``weights`` (c, m), ``pixels`` (c, m, 2) need a model."""

    now_ns: int
    dt_s: float
    q: FloatArray
    state: CoreState
    settings: CoreSettings
    observations: tuple[CameraObservation, ...]
    emit: Emit
    arrays: ModelArrays | None = None
    prediction: Prediction | None = None
    weights: FloatArray | None = None
    pixels: FloatArray | None = None
    """Ideal pixels."""
    goals_read: list[str] = field(default_factory=list)
    """Ids of the goals that were looked at in this step: one at most, for it is work."""


@dataclass(frozen=True)
class Motion:
    """What a source wants: joint velocity (n,), whether it may not go on without features, whether it has finished,
    and whether because its goal is ``reached``.
    """

    velocity: FloatArray
    needs_features: bool = False
    speed_scale: float = 1.0
    finished: bool = False
    reached: bool = False
    error_px: float | None = None
    task_error: FloatArray = field(default_factory=lambda: np.zeros(0))
    reasons: tuple[Reason, ...] = ()


def towards(q: FloatArray, target: FloatArray, settings: CoreSettings, speed_scale: float) -> FloatArray:
    """Joint velocity (n,) on the straight joint-space line to ``target``, slow enough to brake on it."""
    distance = target - q
    length = np.maximum(np.abs(distance), 1e-12)
    limits = settings.limits
    speed = np.minimum(
        limits.velocity_max * (speed_scale * limits.speed_scale),
        np.sqrt(2.0 * BRAKE_SHARE * limits.acceleration_max * length),
    )
    return distance * min(float((speed / length).min()), APPROACH_GAIN)


def arrived(q: FloatArray, target: FloatArray) -> bool:
    """Whether every joint is within ``ARRIVED`` of its target."""
    return bool(np.abs(target - q).max() < ARRIVED)


def joint_move(move: JointMove, present: Present) -> Motion:
    """One step of a joint move; it ends when it arrived and rested, or at its time limit."""
    still = arrived(present.q, move.target)
    move.settled = move.settled + 1 if still else 0
    worst = int(np.abs(move.target - present.q).argmax())
    if move.settled >= ARRIVED_STEPS:
        present.emit("goal_reached", id=move.id, message="joints at target")
        return Motion(np.zeros_like(present.q), finished=True, reached=True)
    elapsed_s = (present.now_ns - move.started_ns) * 1e-9
    if elapsed_s > move.time_limit_s:
        name = present.settings.joint_names[worst]
        reason = Reason(
            "TIME_LIMIT", "hold", name, elapsed_s, move.time_limit_s, "s",
            f"joint {name} is {abs(move.target[worst] - present.q[worst]):.4f} from its target: is it blocked, or at "
            "a limit?",
        )  # fmt: skip
        present.emit("goal_aborted", id=move.id, message="joint move not finished in time", reasons=(reason,))
        return Motion(np.zeros_like(present.q), finished=True)
    return Motion(
        towards(present.q, move.target, present.settings, move.speed_scale), speed_scale=move.speed_scale
    )


def measurement_buffers(settings: CoreSettings) -> dict[str, Any]:
    """Empty sums of pixel sights for every camera and every marker id of the cell."""
    c, m = len(settings.cameras), len(settings.marker_ids)
    return {
        "counts": np.zeros((c, m)),
        "sums": np.zeros((c, m, 2)),
        "first": np.zeros((c, m, 2)),
        "deviation_sums": np.zeros((c, m, 2)),
        "square_sums": np.zeros((c, m)),
        "covariance_sums": np.zeros((c, m, 2, 2)),
        "frames": np.zeros(c, dtype=np.int64),
    }
