"""THE safety stage: one, last, always on. Nothing runs between it and the drive.

In this order: finite check, stale-input policy (coast on prediction, then brake), braking-aware position
margins and joint-space keep-outs, uniform velocity scale, uniform acceleration limit. It is not a safety
function in the sense of the standards: it limits commands, it does not watch the machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.control.safety_kernel import IntArray, limit_velocity
from stereoservo.geometry.homogeneous import FloatArray

NON_FINITE_COMMAND = "NON_FINITE_COMMAND"
JOINTS_STALE = "JOINTS_STALE"
FEATURES_STALE = "FEATURES_STALE"
COASTING = "COASTING"
JOINT_LIMIT = "JOINT_LIMIT"
KEEP_OUT = "KEEP_OUT"
VELOCITY_SCALED = "VELOCITY_SCALED"
ACCELERATION_LIMITED = "ACCELERATION_LIMITED"
BRAKING = "BRAKING"

TOUCHED = 1e-9
"""Relative change of a command that is worth a reason."""


class SafetyConfigurationError(ValueError):
    """Limits or a step that the stage cannot work with; ``data`` holds the values the message speaks of."""

    def __init__(self, message: str, **data: object) -> None:
        super().__init__(message)
        self.data = data


@dataclass(frozen=True, eq=False)
class SafetyLimits:
    """What may never be exceeded; all arrays in joint order, [rad] or [m] and seconds.

    ``keep_outs`` (k, n, 2): boxes (low, high) in joint space, ±inf where a joint does not bound the box. The
    boxes and the position range are kept away from by ``position_margin``. ``coast_s``: how long a law may
    run on prediction; ``features_fresh_s``: the age of the newest features up to which a law does not coast
    at all (a frame or two); the arm brakes when they are older than both. Raises
    SafetyConfigurationError.
    """

    joint_names: tuple[str, ...]
    position_min: FloatArray
    position_max: FloatArray
    velocity_max: FloatArray
    acceleration_max: FloatArray
    position_margin: float
    keep_outs: FloatArray
    keep_out_names: tuple[str, ...]
    joint_timeout_s: float
    coast_s: float
    features_fresh_s: float = 0.15

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        for name in ("position_min", "position_max", "velocity_max", "acceleration_max"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if array.shape != (n,) or np.isnan(array).any():
                raise SafetyConfigurationError(
                    f"{name} is {array.tolist()}; {n} numbers, one a joint, are needed",
                    name=name,
                    value=array.tolist(),
                )
            object.__setattr__(self, name, array)
        boxes = np.ascontiguousarray(self.keep_outs, dtype=np.float64).reshape(-1, n, 2)
        object.__setattr__(self, "keep_outs", boxes)
        for j, joint in enumerate(self.joint_names):
            if not self.position_min[j] + self.position_margin <= self.position_max[j] - self.position_margin:
                raise SafetyConfigurationError(
                    f"joint {joint!r}: {self.position_min[j]} to {self.position_max[j]} leaves "
                    f"nothing inside the margin {self.position_margin}",
                    joint=joint,
                )
            for name in ("velocity_max", "acceleration_max"):
                value = float(getattr(self, name)[j])
                if not 0.0 < value < math.inf:
                    raise SafetyConfigurationError(
                        f"joint {joint!r}: {name} is {value}; a positive finite number is needed",
                        joint=joint,
                        value=value,
                    )
        if len(self.keep_out_names) != boxes.shape[0]:
            raise SafetyConfigurationError(
                f"{boxes.shape[0]} keep-outs have {len(self.keep_out_names)} names; one each is needed"
            )
        for k, name in enumerate(self.keep_out_names):
            if np.isnan(boxes[k]).any() or not (boxes[k, :, 0] < boxes[k, :, 1]).all():
                raise SafetyConfigurationError(
                    f"keep-out {name!r}: every low must be below its high, got {boxes[k].tolist()}"
                )
            if not np.isfinite(boxes[k]).any():
                raise SafetyConfigurationError(
                    f"keep-out {name!r} bounds no joint: the arm would have nowhere to be"
                )
        for name in ("position_margin", "joint_timeout_s", "coast_s", "features_fresh_s"):
            if not getattr(self, name) >= 0.0:
                raise SafetyConfigurationError(
                    f"{name} is {getattr(self, name)}; zero or more is needed", name=name
                )


@dataclass(frozen=True, eq=False)
class SafetyInputs:
    """One step: ``raw`` (n,) what the motion source wants, ``positions`` (n,) as measured, ``previous`` (n,)
    command.

    ``joint_age_s``, ``feature_age_s``: ages of the newest joint sample and of the newest accepted features
    [s]. ``needs_features``: whether the source may not go on without. ``speed_scale`` in [0, 1]. ``brake``:
    stop or hold.
    """

    raw: FloatArray
    positions: FloatArray
    previous: FloatArray
    dt_s: float
    joint_age_s: float = 0.0
    feature_age_s: float = 0.0
    needs_features: bool = False
    speed_scale: float = 1.0
    brake: bool = False


@dataclass(frozen=True, eq=False)
class SafetyResult:
    """``raw`` and ``limited`` joint velocities (n,) and why they differ; ``braking``: the stage overrules the
    source.
    """

    raw: FloatArray
    limited: FloatArray
    reasons: tuple[Reason, ...]
    braking: bool


def safety_stage(inputs: SafetyInputs, limits: SafetyLimits) -> SafetyResult:
    """Limit one command.

    The output is finite and, for any ``raw``, within velocity and acceleration limits, the latter relative to
    ``previous`` (which, where it was no output of this stage, counts as scaled to the velocity limits;
    non-finite entries as rest). A joint that started inside its margins at a speed it can brake from never
    leaves them; one outside moves only inward; keep-out boxes are never entered. The output is a non-negative
    multiple of ``raw`` unless positions, acceleration or braking acted; then the joint that must brake does
    so fully, at the cost of direction. Raises SafetyConfigurationError for a period that is not positive or
    arrays of a wrong length.
    """
    raw, positions, previous = inputs.raw, inputs.positions, inputs.previous
    n = len(limits.joint_names)
    if raw.shape != (n,) or positions.shape != (n,) or previous.shape != (n,):
        raise SafetyConfigurationError(
            f"raw {raw.shape}, positions {positions.shape}, previous {previous.shape}; each must be ({n},)"
        )
    if not 0.0 < inputs.dt_s < math.inf:
        raise SafetyConfigurationError(
            f"dt_s is {inputs.dt_s}; a positive finite period is needed", dt_s=inputs.dt_s
        )
    reasons: list[Reason] = []
    brake = _stale(inputs, limits, reasons)
    if not (np.isfinite(raw).all() and np.isfinite(positions).all()):
        brake = True
        _tell_non_finite(raw, positions, limits, reasons)
    if inputs.brake:
        brake = True
    age = (
        min(max(inputs.joint_age_s, 0.0), limits.joint_timeout_s)
        if math.isfinite(inputs.joint_age_s)
        else 0.0
    )
    speed_scale = min(max(inputs.speed_scale, 0.0), 1.0) if math.isfinite(inputs.speed_scale) else 0.0
    limited, acted, scales = limit_velocity(
        raw,
        positions,
        previous,
        brake,
        inputs.dt_s,
        age,
        speed_scale,
        limits.position_min,
        limits.position_max,
        limits.velocity_max,
        limits.acceleration_max,
        limits.position_margin,
        limits.keep_outs,
    )
    if brake:
        reasons.append(_braking(limited, limits, inputs.brake))
    if acted.any():
        _tell_positions(acted, inputs, limits, reasons)
    if scales[1] >= 0.0 and scales[0] < 1.0 - TOUCHED:
        j = int(scales[1])
        reasons.append(
            Reason(
                VELOCITY_SCALED,
                "slow",
                limits.joint_names[j],
                float(abs(raw[j])),
                float(limits.velocity_max[j] * speed_scale),
                "1/s",
                "slower, in the same direction; a lower gain or a higher speed scale avoids it",
            )
        )
    if not brake and scales[3] >= 0.0 and scales[2] < 1.0 - TOUCHED:
        j = int(scales[3])
        reasons.append(
            Reason(
                ACCELERATION_LIMITED,
                "info",
                limits.joint_names[j],
                float(limits.acceleration_max[j] / scales[2]) if scales[2] > 0.0 else None,
                float(limits.acceleration_max[j]),
                "1/s²",
                "passes by itself",
            )
        )
    return SafetyResult(raw, limited, tuple(reasons), brake)


def _stale(inputs: SafetyInputs, limits: SafetyLimits, reasons: list[Reason]) -> bool:
    """Whether the inputs are too old to move on."""
    brake = False
    if not inputs.joint_age_s <= limits.joint_timeout_s:  # NaN is stale
        brake = True
        reasons.append(
            Reason(
                JOINTS_STALE,
                "hold",
                "",
                _number(inputs.joint_age_s),
                limits.joint_timeout_s,
                "s",
                "the joint driver delivers no samples: check drives and bus",
            )
        )
    if inputs.needs_features and not inputs.feature_age_s <= limits.features_fresh_s:
        if inputs.feature_age_s <= limits.coast_s:
            reasons.append(
                Reason(
                    COASTING,
                    "info",
                    "",
                    inputs.feature_age_s,
                    limits.coast_s,
                    "s",
                    "moving on the prediction of the joints; brakes when no camera shows markers in time",
                )
            )
        else:
            brake = True
            reasons.append(
                Reason(
                    FEATURES_STALE,
                    "hold",
                    "",
                    _number(inputs.feature_age_s),
                    limits.coast_s,
                    "s",
                    "no camera shows enough markers: clear the view, or move the arm back by joints",
                )
            )
    return brake


def _tell_non_finite(
    raw: FloatArray, positions: FloatArray, limits: SafetyLimits, reasons: list[Reason]
) -> None:
    for j, name in enumerate(limits.joint_names):
        for what, value in (("command", raw[j]), ("measured position", positions[j])):
            if not math.isfinite(value):
                reasons.append(
                    Reason(
                        NON_FINITE_COMMAND,
                        "hold",
                        name,
                        None,
                        None,
                        "",
                        f"{what} of joint {name} is {value}: a fault of the source or the driver",
                    )
                )


def _tell_positions(
    acted: IntArray, inputs: SafetyInputs, limits: SafetyLimits, reasons: list[Reason]
) -> None:
    margin = limits.position_margin
    for j, code in enumerate(acted.tolist()):
        if not code:
            continue
        name, position = limits.joint_names[j], float(inputs.positions[j])
        upward = (
            inputs.previous[j] if inputs.raw[j] == 0.0 or not math.isfinite(inputs.raw[j]) else inputs.raw[j]
        ) > 0.0
        if code == 1:
            bound = float(limits.position_max[j] - margin if upward else limits.position_min[j] + margin)
            hint = f"jog {name} {'down' if upward else 'up'}, away from its limit"
            reasons.append(Reason(JOINT_LIMIT, "slow", name, position, bound, "", hint))
            continue
        box = limits.keep_outs[code - 2, j]
        bound = float(box[0] - margin if upward else box[1] + margin)
        hint = f"keep-out {limits.keep_out_names[code - 2]!r}: jog {name} {'down' if upward else 'up'}"
        reasons.append(Reason(KEEP_OUT, "slow", name, position, bound, "", hint))


def _braking(limited: FloatArray, limits: SafetyLimits, asked: bool) -> Reason:
    j = int(np.abs(limited).argmax())
    hint = "stop or hold was asked for; resume to go on" if asked else "passes with the reason beside it"
    return Reason(BRAKING, "hold", limits.joint_names[j], float(abs(limited[j])), 0.0, "1/s", hint)


def _number(value: float) -> float | None:
    """JSON carries no NaN or infinity."""
    return value if math.isfinite(value) else None
