"""Stage 6: computes the command from the motion source's velocity, in one kernel: friction compensation, look-ahead for
late drives, and the safety stage, which is the last one.

The friction of each joint is estimated from small commands and the resulting travel: an integral action for a joint
that does not move, and none for one that follows. Play and sag cause no wind-up, since the encoder of a motor that
turns through its play does move; for encoders on the output side of the play see `friction_bounds`.

The safety stage limits joint velocities in this order: finite check, stale-input policy (coast on prediction, then
brake), uniform velocity scale, braking-aware position margins and joint-space keep-outs, uniform acceleration limit. It
is not a safety function in the sense of the standards: it limits commands, it does not monitor the machine.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import force_setattr

from stereoservo.core.context import StepContext
from stereoservo.core.cycle import NOT_MEASURED
from stereoservo.core.ingest import ACCEPTED
from stereoservo.core.settings import CoreSettings, MotionLimits
from stereoservo.core.sources.progress import follow_error
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray, Record
from stereoservo.numerics.compilation import kernel


@kernel
def command(block: Record, workspace: Record, keep_outs: FloatArray) -> None:
    """Stage 6: compute the ``command`` (n,) of the block from the ``velocity`` (n,) of the motion in the workspace
    ``workspace``; zero if the drives are not active.

    Also written to the workspace: ``limited``, whether there is anything to report about the command; ``result``, the
    values that recordings keep, where the error is that of a law's kernel.
    """
    memory, work = block[0], workspace[0]
    n = memory.joints
    sent, velocity, raw = memory.command[:n], work.velocity[:n], work.raw[:n]
    if work.rests != 0:
        velocity[:] = 0.0
    newest_ns = 0
    for c in range(memory.cameras):
        newest_ns = max(newest_ns, memory.estimates[c].accepted_ns)
    work.features_ns = newest_ns
    feature_age_s = (work.now_ns - newest_ns) * 1e-9
    work.added = 0
    if work.compensates != 0:
        fresh = work.joints_found == ACCEPTED and (work.needs_features == 0 or feature_age_s <= work.bounds[FRESH])
        work.added = int(add_friction(block, workspace, fresh))
    if work.added == 0:
        raw[:] = velocity
    _foresee(block, workspace)
    work.previous[:n] = sent
    limits = Bounds(work.limits[: 4 * n].reshape((4, n)), work.bounds, keep_outs)
    requested = Requested(
        raw, work.outermost[:n], work.previous[:n], work.paused != 0, work.dt_s,
        (work.now_ns - memory.last_joints_ns) * 1e-9, feature_age_s, work.needs_features != 0, work.speed_scale,
    )  # fmt: skip
    reported, found = limit_velocity(requested, limits, sent, work.acted[:n])
    work.limited, work.finite = int(reported), int(found.finite)
    work.allowed_scale, work.scale, work.share = found.speed_scale, found.scale, found.share
    work.scaled_by, work.shared_by = found.scaled_by, found.shared_by
    if work.active == 0:
        sent[:] = 0.0
    work.result[0] = work.error_px if work.rests == 0 and work.measured != 0 else NOT_MEASURED
    work.result[1 : 1 + n], work.result[1 + n : 1 + 2 * n] = raw, memory.velocities[:n]
    work.result[1 + 2 * n : 1 + 3 * n] = sent
    if work.runs != 0:
        follow_error(block, work.tolerance_px, work.dt_s)


@kernel
def _foresee(block: Record, workspace: Record) -> None:
    """Write to ``outermost`` (n,) of the ``workspace`` the extreme position of each joint in its direction of
    motion: the current position, or for a late drive the position that the joint reaches before it executes the
    velocity.
    """
    memory, work = block[0], workspace[0]
    for j in range(memory.joints):
        q, velocity = work.q[j], work.raw[j]
        work.outermost[j] = q
        if memory.delay_s[j] == 0.0:
            continue
        ahead = q + memory.delay_under_way[j]
        direction = velocity if velocity != 0.0 else memory.command[j]
        work.outermost[j] = max(q, ahead) if direction > 0.0 else min(q, ahead)


RISE_S = 0.25
"""Time constant of the estimate [s]; the command of a joint that does not move grows by its source's velocity in this
time.
"""
LAG_S = 0.06
"""Lag of a healthy drive [s]; travel is compared over longer times."""
MOST = {"revolute": 0.015, "prismatic": 0.0015}
"""Largest compensation [rad/s, m/s]: 1.5 times the friction of a healthy joint; see `monitors.following.FRICTION`."""
SMALL = 2.0
"""Factor on ``MOST``: velocities requested below it are small."""
LEAST_TRAVEL = {"revolute": 2e-4, "prismatic": 2e-5}
"""Least travel that is compared [rad, m], in addition to the lag, for fine encoders."""
LEAST_STEPS = 5.0
"""The same in steps of the encoder."""


# -- friction -----------------------------------------------------------------------------------------------------


def friction_bounds(
    kinds: tuple[str, ...], resolution: tuple[float, ...], inexact: bool
) -> tuple[FloatArray, FloatArray]:
    """The largest compensation (n,) [rad/s or m/s], and the least travel (n,) [rad or m] that is compared; both are
    read-only.

    Joints with coarse encoders are not compensated if the model states errors of joint readings (``inexact``). Play
    before the encoder looks like friction, and a coarse encoder shows too late that the play is taken up; the joint
    would hunt.
    """
    most, travel = (np.array([value[kind] for kind in kinds]) for value in (MOST, LEAST_TRAVEL))
    if resolution:
        least = LEAST_STEPS * np.array(resolution)
        most = np.where((least > travel) & inexact, 0.0, most)
        travel = np.maximum(travel, least)
    return most, travel


@kernel
def add_friction(block: Record, workspace: Record, fresh: bool) -> bool:
    """Write to ``raw`` (n,) of the ``workspace`` the motion's ``velocity`` (n,) plus the friction compensation;
    returns whether there is any compensation. Zero remains zero: a joint that shall not move is not compensated.

    If ``fresh`` is True, the commanded travel, at the time of its arrival, is compared with the measured travel once it
    is large enough. The comparison restarts when the direction reverses.
    """
    memory, work = block[0], workspace[0]
    n, dt_s, q = memory.joints, work.dt_s, work.q[: memory.joints]
    desired, velocity, most, travel = (
        work.velocity[:n],
        work.raw[:n],
        work.friction_most[:n],
        work.friction_travel[:n],
    )
    arrives = memory.delay_velocity[:n] if work.watches_following != 0 else memory.command[:n]
    friction, stood_at = memory.friction[:n], memory.friction_from[:n]
    sent, sent_s = memory.friction_sent[:n], memory.friction_s[:n]
    changed = False
    for j in range(desired.size):
        velocity[j] = 0.0
        sent[j] += arrives[j] * dt_s
        sent_s[j] += dt_s
        if fresh:
            valid = abs(desired[j]) < SMALL * most[j] and desired[j] * sent[j] >= 0.0
            enough = valid and abs(sent[j]) > travel[j] + LAG_S * abs(sent[j]) / sent_s[j]
            if enough:
                share = (q[j] - stood_at[j]) / sent[j]
                lost = max(0.0, min(1.0 - share, 1.0)) * sent[j] / sent_s[j]
                friction[j] += min(sent_s[j] / RISE_S, 1.0) * (lost - friction[j])
            if desired[j] * friction[j] < 0.0:
                friction[j] *= 1.0 - min(dt_s / RISE_S, 1.0)
            friction[j] = max(-most[j], min(friction[j], most[j]))
            if enough or not valid:
                sent[j], sent_s[j], stood_at[j] = 0.0, 0.0, q[j]
        changed = changed or friction[j] != 0.0
        if desired[j] != 0.0:
            velocity[j] = desired[j] + friction[j]
    return changed


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
"""Relative change of a command above which a reason is given."""
MARGIN, TIMEOUT, FRESH, COAST = range(4)
"""Indices of `SafetyLimits.bounds`."""
TINY = 1e-300
"""Smallest fraction used as a divisor: avoids division by zero."""


# -- the safety stage: limits and their reasons -----------------------------------------------------------------


class SafetyConfigurationError(ValueError):
    """Invalid limits, or an invalid step; ``data`` holds the values named in the message."""

    def __init__(self, message: str, **data: object) -> None:
        super().__init__(message)
        self.data = data


class SafetyLimits(MotionLimits, frozen=True, eq=False, dict=True, kw_only=True):
    """The limits of the safety stage.

    ``features_fresh_s``: age of the newest features up to which a law does not coast (one or two frames) [s]. The arm
    brakes when the features are older than both this and ``coast_s``.

    Raises SafetyConfigurationError.
    """

    joint_names: tuple[str, ...]
    features_fresh_s: float = 0.15

    @cached_property
    def table(self) -> FloatArray:
        """The joints' limits as the kernel takes them (4, n): smallest and largest position, velocity, acceleration."""
        return np.array([self.position_min, self.position_max, self.velocity_max, self.acceleration_max])

    @cached_property
    def bounds(self) -> FloatArray:
        """The scalar limits as the kernel takes them (4,): position margin, and the longest ages of joints, of fresh
        features and of any features.
        """
        return np.array([self.position_margin, self.joint_timeout_s, self.features_fresh_s, self.coast_s])

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
            force_setattr(self, name, array)
        boxes = np.ascontiguousarray(self.keep_outs, dtype=np.float64).reshape(-1, n, 2)
        force_setattr(self, "keep_outs", boxes)
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
                raise SafetyConfigurationError(f"keep-out {name!r} bounds no joint: the arm would have nowhere to be")
        for name in ("position_margin", "joint_timeout_s", "coast_s", "features_fresh_s"):
            if not getattr(self, name) >= 0.0:
                raise SafetyConfigurationError(f"{name} is {getattr(self, name)}; zero or more is needed", name=name)


class SafetyInputs(msgspec.Struct, frozen=True, eq=False):
    """Inputs of one step: ``raw`` (n,) requested by the motion source, measured ``positions`` (n,), ``previous``
    command (n,).

    ``joint_age_s``, ``feature_age_s``: ages of the newest joint sample and of the newest accepted features [s];
    negative or non-finite ages count as stale.
    ``needs_features``: whether the source must stop without features.
    ``speed_scale``: in [0, 1].
    ``brake``: stop or hold.
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


class SafetyResult(msgspec.Struct, frozen=True, eq=False):
    """``raw`` and ``limited`` joint velocities (n,) and the reasons of their difference; ``braking``: the stage
    overrides the source.
    """

    raw: FloatArray
    limited: FloatArray
    reasons: tuple[Reason, ...] = ()
    braking: bool = False


def explained(
    inputs: SafetyInputs, limits: SafetyLimits, limited: FloatArray, found: LimitsFound, acted: FloatArray
) -> SafetyResult:
    """The result with its reasons, from the results ``found`` and ``acted`` (n,) of `limit_velocity`."""
    reasons: list[Reason] = []
    brake = _stale(inputs, limits, reasons) or inputs.brake
    finite, speed_scale, scale, scaled_by, share, shared_by = found
    if not finite:
        brake = True
        _report_non_finite(inputs.raw, inputs.positions, limits, reasons)
    if brake:
        reasons.append(_braking(limited, limits, inputs.brake))
    _report_positions(acted.tolist(), inputs, limits, reasons)
    if scaled_by >= 0 and scale < 1.0 - TOUCHED:
        j = scaled_by
        reasons.append(
            Reason(
                VELOCITY_SCALED,
                "slow",
                limits.joint_names[j],
                float(abs(inputs.raw[j])),
                float(limits.velocity_max[j] * speed_scale),
                "1/s",
                "slower, in the same direction; a lower gain or a higher speed scale avoids it",
            )
        )
    if not brake and shared_by >= 0 and share < 1.0 - TOUCHED:
        j = shared_by
        reasons.append(
            Reason(
                ACCELERATION_LIMITED,
                "info",
                limits.joint_names[j],
                _number(float(limits.acceleration_max[j]) / max(share, TINY)),
                float(limits.acceleration_max[j]),
                "1/s²",
                "passes by itself",
            )
        )
    return SafetyResult(inputs.raw, limited, tuple(reasons), brake)


def limited_command(context: StepContext, limits: SafetyLimits) -> SafetyResult:
    """The safety stage's result for this step's motion, with its reasons."""
    workspace, block = context.derived.workspace, context.state.block
    work, given = workspace.numbers, workspace.arrays
    raw, command = given["raw"].copy(), block.command.copy()
    if not work.limited:
        return SafetyResult(raw, command)
    inputs = SafetyInputs(
        raw, given["outermost"], given["previous"], context.dt_s,
        (context.now_ns - block.numbers.last_joints_ns) * 1e-9, (context.now_ns - work.features_ns) * 1e-9,
        bool(work.needs_features), work.speed_scale, bool(work.paused),
    )  # fmt: skip
    found = LimitsFound(bool(work.finite), work.allowed_scale, work.scale, work.scaled_by, work.share, work.shared_by)
    return explained(inputs, limits, command, found, given["acted"])


def safety_limits(settings: CoreSettings, features_fresh_s: float) -> SafetyLimits:
    """The limits of a cell. Raises SafetyConfigurationError."""
    shared = {name: getattr(settings.limits, name) for name in MotionLimits.__struct_fields__}
    return SafetyLimits(**shared, joint_names=settings.joint_names, features_fresh_s=features_fresh_s)


def _within(age_s: float, limit_s: float) -> bool:
    """Whether an age is valid: not NaN, not negative, and within its limit."""
    return 0.0 <= age_s <= limit_s


def _stale(inputs: SafetyInputs, limits: SafetyLimits, reasons: list[Reason]) -> bool:
    """Whether the inputs are too old to move, or their age is not credible."""
    brake = False
    if not _within(inputs.joint_age_s, limits.joint_timeout_s):
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
    if inputs.needs_features and not _within(inputs.feature_age_s, limits.features_fresh_s):
        if _within(inputs.feature_age_s, limits.coast_s):
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


def _report_non_finite(raw: FloatArray, positions: FloatArray, limits: SafetyLimits, reasons: list[Reason]) -> None:
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


def _report_positions(acted: list[float], inputs: SafetyInputs, limits: SafetyLimits, reasons: list[Reason]) -> None:
    margin = limits.position_margin
    for j, code in enumerate(int(one) for one in acted):
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
    """The value, or None for NaN and infinity, which JSON cannot represent."""
    return value if math.isfinite(value) else None


# -- the safety stage's kernels ------------------------------------------------------------------------------------


@kernel
def stoppable_speed(distance: float, acceleration: float, dt: float) -> float:
    """Largest speed that can be held for ``dt`` and still allows braking within ``distance``: ``v·dt + v²/2a = d``; 0
    if d <= 0.

    The discrete braking ``v, v − a·dt, …`` needs no more distance, and each of its steps can be stopped likewise.
    """
    if not distance > 0.0:
        return 0.0
    step = acceleration * dt
    # the root of the quadratic in the form that does not cancel for small distances
    return 2.0 * acceleration * distance / (step + math.sqrt(step * step + 2.0 * acceleration * distance))


class JointLimits(NamedTuple):
    """Limits of the joints, (n,) each, with the ``margin`` of positions and ``keep_outs`` (k, n, 2): `SafetyLimits`."""

    position_min: FloatArray
    position_max: FloatArray
    velocity_max: FloatArray
    acceleration_max: FloatArray
    margin: float
    keep_outs: FloatArray


class VelocityCaps(NamedTuple):
    """Velocity caps ``low``, ``high`` (n,) and their sources (n,): -1 the position limit, k >= 0 keep-out box k."""

    low: FloatArray
    high: FloatArray
    low_by: IntArray
    high_by: IntArray


@kernel
def _position_caps(
    ahead: FloatArray, behind: FloatArray, previous: FloatArray, dt: float, limits: JointLimits
) -> VelocityCaps:
    """The velocity caps of position limits and keep-outs.

    ``ahead`` and ``behind`` (n,): the joint's extreme positions, given the age of its sample; NaN sets no cap.
    """
    position_min, position_max, velocity_max, acceleration_max, margin, keep_outs = limits
    n = previous.shape[0]
    low, high = np.empty(n), np.empty(n)
    low_by, high_by = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for j in range(n):
        low_by[j] = -1
        high_by[j] = -1
        low[j] = -math.inf
        high[j] = math.inf
        if math.isnan(ahead[j]) or math.isnan(behind[j]):
            continue
        high[j] = stoppable_speed(position_max[j] - margin - ahead[j], acceleration_max[j], dt)
        low[j] = -stoppable_speed(behind[j] - (position_min[j] + margin), acceleration_max[j], dt)
    for k in range(keep_outs.shape[0]):
        # Of the joints that keep the arm out of the box, the one with the most time to spare is limited.
        # As long as one joint can always stop outside, the box is never entered.
        best = -1
        best_above = False
        best_slack = -math.inf
        for j in range(n):
            if math.isnan(ahead[j]) or math.isnan(behind[j]):
                continue
            for above in (False, True):
                if above:
                    if math.isinf(keep_outs[k, j, 1]):
                        continue
                    clearance = behind[j] - (keep_outs[k, j, 1] + margin)
                    speed = max(0.0, -previous[j])
                else:
                    if math.isinf(keep_outs[k, j, 0]):
                        continue
                    clearance = keep_outs[k, j, 0] - margin - ahead[j]
                    speed = max(0.0, previous[j])
                slack = (clearance - 0.5 * speed * speed / acceleration_max[j]) / velocity_max[j]
                if slack > best_slack:
                    best, best_above, best_slack = j, above, slack
        if best < 0:
            continue
        if best_above:
            cap = -stoppable_speed(behind[best] - (keep_outs[k, best, 1] + margin), acceleration_max[best], dt)
            if cap > low[best]:
                low[best] = cap
                low_by[best] = k
        else:
            cap = stoppable_speed(keep_outs[k, best, 0] - margin - ahead[best], acceleration_max[best], dt)
            if cap < high[best]:
                high[best] = cap
                high_by[best] = k
    return VelocityCaps(low, high, low_by, high_by)


@kernel
def _within_speed_limits(previous: FloatArray, velocity_max: FloatArray) -> FloatArray:
    """The previous command (n,) scaled into the speed limits, so that no motion continues above them."""
    before = np.zeros(previous.shape[0])
    shrink = 1.0
    for j in range(before.shape[0]):
        if math.isfinite(previous[j]):
            before[j] = previous[j]
            if abs(before[j]) > velocity_max[j]:
                shrink = min(shrink, velocity_max[j] / abs(before[j]))
    for j in range(before.shape[0]):
        before[j] *= shrink
    return before


@kernel
def _velocity_scale(
    desired: FloatArray, low: FloatArray, high: FloatArray, velocity_max: FloatArray, speed_scale: float
) -> tuple[float, int]:
    """The factor that brings all joints within their speed limits, and the joint that requires it, -1 for none.

    A joint that brakes for its position limit is held below its speed limit by its cap: it slows no other joint.
    """
    scale, scaled_by = 1.0, -1
    for j in range(desired.shape[0]):
        limit = velocity_max[j] * speed_scale
        cap = high[j] if desired[j] > 0.0 else -low[j]
        if cap > limit and abs(desired[j]) * scale > limit:
            scale = limit / abs(desired[j])
            scaled_by = j
    return scale, scaled_by


class Requested(NamedTuple):
    """The requested motion: ``raw`` velocity, joint ``positions`` and the ``previous`` command, (n,) each; the other
    fields as in `SafetyInputs`.
    """

    raw: FloatArray
    positions: FloatArray
    previous: FloatArray
    brake: bool
    dt: float
    joint_age: float
    feature_age: float
    needs_features: bool
    speed_scale: float


class Bounds(NamedTuple):
    """``table`` (4, n), ``bounds`` (4,) and ``keep_outs`` (k, n, 2) of `SafetyLimits`."""

    table: FloatArray
    bounds: FloatArray
    keep_outs: FloatArray


class LimitsFound(NamedTuple):
    """Whether all values were ``finite``; the ``speed_scale`` in effect; velocity ``scale`` and acceleration ``share``,
    each with the joint that requires it, -1 for none.
    """

    finite: bool
    speed_scale: float
    scale: float
    scaled_by: int
    share: float
    shared_by: int


@kernel
def limit_velocity(motion: Requested, by: Bounds, limited: FloatArray, acted: FloatArray) -> tuple[bool, LimitsFound]:
    """Apply staleness, braking, velocity, position, keep-out and acceleration limits, in this order. Returns whether
    there is anything to report, and the `LimitsFound`.

    The arm also brakes if velocity or positions are not finite.

    ``limited`` (n,): receives the velocity.
    ``acted`` (n,): receives the limit that acted on each joint: 0 none, 1 position limit, 2 + k keep-out k.
    """
    raw, positions, previous, brake, dt, joint_age, feature_age, needs_features, speed_scale = motion
    table, bounds, keep_outs = by
    margin, timeout, fresh, coast = bounds[MARGIN], bounds[TIMEOUT], bounds[FRESH], bounds[COAST]
    limits = JointLimits(table[0], table[1], table[2], table[3], margin, keep_outs)
    reported, sample_age = brake, joint_age
    if not 0.0 <= joint_age <= timeout:
        brake, sample_age = True, timeout
    if needs_features and not 0.0 <= feature_age <= fresh:
        reported, brake = True, brake or not 0.0 <= feature_age <= coast
    speed_scale = min(max(speed_scale, 0.0), 1.0) if math.isfinite(speed_scale) else 0.0
    velocity_max, acceleration_max = limits.velocity_max, limits.acceleration_max
    n = raw.shape[0]
    finite = True
    for j in range(n):
        acted[j] = 0.0
        finite = finite and math.isfinite(raw[j]) and math.isfinite(positions[j])
    brake = brake or not finite
    before = _within_speed_limits(previous, velocity_max)
    ahead, behind = np.empty(n), np.empty(n)
    for j in range(n):
        # since the sample the joint may have been faster than now, by the speed it can have braked
        drift = before[j] * sample_age
        faster = 0.5 * acceleration_max[j] * sample_age * sample_age
        position = positions[j] if math.isfinite(positions[j]) else math.nan
        ahead[j] = position + max(0.0, drift + faster)
        behind[j] = position + min(0.0, drift - faster)
    low, high, low_by, high_by = _position_caps(ahead, behind, before, dt, limits)

    for j in range(n):
        limited[j] = 0.0 if brake else raw[j]
    scale, scaled_by = _velocity_scale(limited, low, high, velocity_max, speed_scale)
    for j in range(n):
        # Scaled before the comparison with its caps: far from its limits no joint is clipped, whatever is requested.
        limited[j] *= scale
        if limited[j] > high[j]:
            limited[j] = high[j]
            acted[j] = high_by[j] + 2
        elif limited[j] < low[j]:
            limited[j] = low[j]
            acted[j] = low_by[j] + 2

    share, shared_by = 1.0, -1
    for j in range(n):
        step = abs(limited[j] - before[j])
        limit = acceleration_max[j] * dt
        if step * share > limit:
            share = limit / step
            shared_by = j
    for j in range(n):
        if share < 1.0:
            limited[j] = before[j] + share * (limited[j] - before[j])
        # Scaling by another joint may leave this one above its cap: then it brakes with full acceleration.
        step = acceleration_max[j] * dt
        if limited[j] > high[j]:
            limited[j] = min(limited[j], max(high[j], before[j] - step))
            acted[j] = high_by[j] + 2
        elif limited[j] < low[j]:
            limited[j] = max(limited[j], min(low[j], before[j] + step))
            acted[j] = low_by[j] + 2
    reported = reported or brake or scaled_by >= 0 or shared_by >= 0
    for j in range(n):
        reported = reported or acted[j] != 0.0
    return reported, LimitsFound(finite, speed_scale, scale, scaled_by, share, shared_by)
