"""In words, while a goal runs: how far it is, how long it takes still, and why it is slow or stuck.

The laws and the safety stage tell what they limit in a step; here is what shows only over time, or only beside a limit.
"""

from __future__ import annotations

from math import log

import numpy as np

from stereoservo.control.gains import GainCurve, gain_at
from stereoservo.control.laws import ILL_CONDITIONED
from stereoservo.control.reasons import Reason
from stereoservo.kinematics.linear_kernels import damped_least_squares
from stereoservo.runtime.motion import BRAKE_SHARE, Present
from stereoservo.runtime.state import JointMove, LawRun, PlanJob, Servoing, Source

STUCK_S = 3.0
"""Time of motion without a smaller error after which a law is said to be stuck."""
AVERAGED_S = 0.5
"""Time constant of the mean error that is looked at: noise alone shall not look like an advance."""
SMALLER = 0.95
"""Of the least mean error so far, below which it counts as smaller."""
LOOK_EVERY_S = 0.2
NEAR_LIMIT = 0.087
"""Room to a limit less its margin [rad or m] below which it is told: five degrees."""
NEAR_SINGULAR = 2.0 * ILL_CONDITIONED
FEW_MARKERS = 4
TAIL = 10.0
"""Times its tolerance, below which an error decays in the gain's tail."""
TAIL_S = 2.0
"""Least time that a tail takes to be told."""
NOISE_SIGMAS = 3.0

CAUSES = (
    "KEEP_OUT", "JOINT_LIMIT", "INCIDENCES_CONTRADICT", "INCIDENCE_NOT_DRIVABLE", "NOT_REACHABLE", "NO_FACE",
    "FEATURES_STALE", "TOO_FEW_MARKERS", "VISIBILITY_BLOCKED", "VISIBILITY_WAIT", "JACOBIAN_ILL_CONDITIONED",
    "NEAR_SINGULAR", "VELOCITY_SCALED",
)  # fmt: skip
"""What may hold a law up, the most probable first."""


def share_and_seconds(source: Source, present: Present) -> tuple[float | None, float | None]:
    """Share [0, 1] of the goal's way that is done, and the seconds left; None where that is not known."""
    if isinstance(source, JointMove):
        return _of_move(source, present)
    if not isinstance(source, LawRun) or source.error_px is None:
        return None, None
    if isinstance(source, Servoing) and source.law == "trajectory":
        if source.plan is None:
            return None, None
        length_s = float(source.plan.times[-1])
        if source.plan_s < length_s:
            return source.plan_s / length_s, length_s - source.plan_s
    if isinstance(source, Servoing) and source.stream is not None:
        return None, None
    left_s = _decay_s(source, source.error_px)
    whole_s = _decay_s(source, max(source.watch.first_px, source.error_px))
    return (1.0 if whole_s <= 0.0 else 1.0 - left_s / whole_s), left_s


def _decay_s(source: LawRun, error_px: float) -> float:
    """Time in which an error decays to the tolerance at the slower of the goal's gains."""
    return log(max(error_px / source.tolerance_px, 1.0)) / min(source.gain_near, source.gain_far)


def _of_move(source: JointMove, present: Present) -> tuple[float, float]:
    limits = present.settings.limits
    whole, left = np.abs(source.target - source.start), np.abs(source.target - present.q)
    speed = limits.velocity_max * (source.speed_scale * limits.speed_scale)
    seconds = np.where(left > 0.0, left / speed + 0.5 * speed / (BRAKE_SHARE * limits.acceleration_max), 0.0)
    longest = float(whole.max())
    done = 1.0 if longest == 0.0 else 1.0 - min(1.0, float(left.max()) / longest)
    return done, float(seconds.max())


def watch(source: LawRun, present: Present, told: tuple[Reason, ...]) -> tuple[Reason, ...]:
    """What a law's run shows beside what it has ``told`` itself; kept between two looks, so that it is steady."""
    seen = source.watch
    error = source.error_px
    if error is not None:
        seen.first_px = max(seen.first_px, error)
        share = present.dt_s / (present.dt_s + AVERAGED_S)
        seen.mean_px = error if seen.mean_px == 0.0 else seen.mean_px + share * (error - seen.mean_px)
        if seen.least_px == 0.0 or seen.mean_px < SMALLER * seen.least_px or error <= source.tolerance_px:
            seen.least_px, seen.least_s = max(seen.mean_px, 1e-9), source.moved_s
    every = max(1, round(LOOK_EVERY_S / present.dt_s))
    if present.state.step % every == 0:
        seen.reasons = _look(source, present, told)
    if not seen.reasons:
        return ()
    codes = {reason.code for reason in told}
    return tuple(reason for reason in seen.reasons if reason.code not in codes)


def _look(source: LawRun, present: Present, told: tuple[Reason, ...]) -> list[Reason]:
    found = [*_near_limits(present), *_near_singular(source, present), *_few_markers(source, present)]
    tail = _tail(source)
    if tail is not None:
        found.append(tail)
    if not (isinstance(source, Servoing) and source.stream is not None):
        stuck = _stuck(source, present, (*told, *found))
        if stuck is not None:
            found.insert(0, stuck)
    return found


def _near_limits(present: Present) -> list[Reason]:
    limits, moving = present.settings.limits, present.state.command
    found = []
    for j, name in enumerate(present.settings.joint_names):
        for bound, side in ((limits.position_max[j], 1.0), (limits.position_min[j], -1.0)):
            limit = float(bound) - side * limits.position_margin
            room = side * (limit - float(present.q[j]))
            if room < NEAR_LIMIT and side * moving[j] > 0.0:
                hint = f"joint {name} is {max(room, 0.0):.3f} from its limit less the margin, and moves towards it"
                found.append(Reason("NEAR_LIMIT", "info", name, float(present.q[j]), limit, "rad or m", hint))
    return found


def _near_singular(source: LawRun, present: Present) -> list[Reason]:
    """By the pivots of the pixels' normal matrix: a small one is a motion that takes much and shows little."""
    if present.prediction is None or present.weights is None:
        return []
    from_pivots = image_conditioning(present, source)
    if from_pivots >= NEAR_SINGULAR or len(present.q) > 6:
        return []
    hint = "some motion of the body takes large joint motions here: expect it to be slow, or go round the singularity"
    return [Reason("NEAR_SINGULAR", "info", "", from_pivots, NEAR_SINGULAR, "", hint)]


def image_conditioning(present: Present, source: LawRun) -> float:
    """Smallest Cholesky pivot of the normal matrix of all seen pixels over its largest diagonal; 0: singular."""
    assert present.prediction is not None
    assert present.weights is not None
    n = len(present.q)
    J = np.ascontiguousarray(present.prediction.jacobian).reshape(-1, n)
    weights = np.repeat((present.weights * source.used[:, None] > 0.0).astype(np.float64).reshape(-1), 2)
    _, conditioning = damped_least_squares(J, np.zeros(len(J)), weights, 0.0)
    return float(conditioning)


def _few_markers(source: LawRun, present: Present) -> list[Reason]:
    if present.weights is None:
        return []
    usable = present.weights * source.used[:, None]
    if isinstance(source, Servoing):
        usable = usable * source.wanted
    seen = int((usable.max(axis=0) > 0.0).sum())
    if seen >= FEW_MARKERS:
        return []
    hint = f"{seen} of the goal's markers are seen: one more that is hidden stops the arm, and the noise counts in full"
    return [Reason("FEW_MARKERS", "info", "", float(seen), float(FEW_MARKERS), "markers", hint)]


def _tail(source: LawRun) -> Reason | None:
    error = source.error_px
    if error is None or not source.tolerance_px < error < TAIL * source.tolerance_px:
        return None
    left_s = _decay_s(source, error)
    if left_s < TAIL_S:
        return None
    gain = gain_at(GainCurve(source.gain_near, source.gain_far, source.gain_slope), error)
    hint = (
        f"near the goal the error falls to a third in {1.1 / gain:.1f} s: a higher gain (or one that rises near the "
        "goal), or a wider tolerance, is faster"
    )
    return Reason("LOW_GAIN", "info", "", left_s, TAIL_S, "s", hint)


def _stuck(source: LawRun, present: Present, told: tuple[Reason, ...]) -> Reason | None:
    error, since_s = source.error_px, source.moved_s - source.watch.least_s
    if error is None or error <= source.tolerance_px or since_s < STUCK_S:
        return None
    codes = {reason.code: reason for reason in reversed(told)}
    cause = next((codes[code] for code in CAUSES if code in codes), None)
    noise = _noise_px(source, present)
    if error <= NOISE_SIGMAS * noise:
        cause = None
        why = (
            f"most probably the tolerance of {source.tolerance_px:g} px is below what the images allow: a marker has "
            f"a deviation of {noise:.3f} px; widen it"
        )
    elif cause is not None:
        why = f"most probably {cause.code} {cause.subject}".rstrip() + f": {cause.hint}"
    elif isinstance(source, Servoing) and source.law not in ("cartesian3", "cartesian2", "trajectory"):
        why = f"most probably law {source.law!r} rests in a minimum beside the goal: take cartesian3 or trajectory"
    else:
        why = "nothing holds it up that is known: has the goal's body another shape, or has a camera or marker moved?"
    hint = f"the error is {error:.3f} px, no smaller for {since_s:.0f} s; {why}"
    return Reason(
        "STUCK", "slow", "" if cause is None else cause.subject, error, source.tolerance_px, "px", hint
    )


def _noise_px(source: LawRun, present: Present) -> float:
    """Largest deviation [px] of one observation of a marker that is seen."""
    if present.weights is None:
        return 0.0
    usable = present.weights * source.used[:, None]
    if not bool((usable > 0.0).any()):
        return 0.0
    return 1.0 / float(usable[usable > 0.0].min())


def planning_reason(job: PlanJob) -> Reason:
    """That a goal is being planned."""
    done = job.planning.followed
    hint = (
        f"goal {job.source.goal.id} is being planned ({done} ways tried); cancel it, hold or stop at any time"
    )
    return Reason("PLANNING", "info", job.source.goal.id, float(done), None, "ways", hint)
