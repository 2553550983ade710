"""Short forms of a goal's target (name, joint positions or set-points) and options, converted to messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypedDict

from stereoservo.messages.goals import (
    AdaptiveGain,
    Centre,
    FeatureTarget,
    JacobianName,
    JointTarget,
    LawName,
    PointSource,
    ProfileName,
    Target,
    TaughtTarget,
)


class GoalOptions(TypedDict, total=False):
    """Fields of `Goal` beside id and target; the cell's default applies to those left out."""

    law: LawName | None
    points: PointSource | None
    jacobian: JacobianName | None
    centre: Centre | None
    cameras: tuple[str, ...] | None
    profile: ProfileName | None
    posture: dict[str, float] | None
    gain: float | AdaptiveGain | None
    damping: float | None
    tolerance_px: float | None
    hold_frames: int | None
    speed_scale: float
    lease_s: float | None
    time_limit_s: float | None
    mode: Literal["preempt", "queue"]
    blend_px: float | None
    acknowledge_s: float | None
    follow_markers: tuple[int, ...]


def as_target(target: Target | str | Mapping[str, Any]) -> Target:
    """A target from its short form: a taught goal's name, positions by joint, or set-points by camera."""
    if isinstance(target, str):
        return TaughtTarget(target)
    if isinstance(target, Mapping):
        if all(isinstance(value, Mapping) for value in target.values()) and target:
            return FeatureTarget(
                {
                    camera: {int(marker): (float(u), float(v)) for marker, (u, v) in points.items()}
                    for camera, points in target.items()
                }
            )
        return JointTarget({str(name): float(value) for name, value in target.items()})
    return target
