"""The progress of a law's run: what every step adds to it, and why it is slow or stuck: what is found when it is looked
at, a few times a second.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.law_registry import LAWS
from stereoservo.control.laws.stereo import ILL_CONDITIONED
from stereoservo.core.block import Block
from stereoservo.core.context import StepContext
from stereoservo.core.monitors.agreement import forget_frames, take_frames
from stereoservo.core.state import LawRun
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import damped_least_squares

AVERAGED_S = 0.5
"""Time constant of the mean error that is looked at: noise alone shall not look like an advance."""
SMALLER = 0.95
"""Of the least mean error so far, below which it counts as smaller."""
GOES_ON, OUT_OF_TIME, SETTLED = range(3)
"""What `account_run` has found."""


def error_of_run(block: Block) -> float | None:
    """The error [px] of the law at work in its last step; None where none was measured."""
    run = block.numbers.run
    return run.newest_px if run.measured else None


@kernel
def begin_run(block: Record) -> None:
    """A law begins."""
    memory = block[0]
    run, frames = memory.run, 0
    for c in range(memory.cameras):
        frames += memory.estimates[c].frames
    run.moved_s, run.held, run.last_frames = 0.0, 0, frames
    run.measured, run.newest_px, run.first_px = False, 0.0, 0.0
    run.mean_px, run.least_px, run.least_s = 0.0, 0.0, 0.0
    forget_frames(block)


class RunTerms(NamedTuple):
    """Of a run: the tolerance [px] in which it has to stay for so many frames, and the time [s] in which it has to get
    there.
    """

    tolerance_px: float
    hold_frames: int
    time_limit_s: float


@kernel
def account_run(
    block: Record, measured: bool, error_px: float, enough: bool, dt_s: float, terms: RunTerms
) -> int:
    """Account for a step of ``dt_s`` with this error; whether the run is out of time, or, where ``enough`` markers are
    seen, has stayed below its tolerance for its frames of every camera on average.
    """
    memory = block[0]
    run = memory.run
    run.moved_s += dt_s
    run.measured, run.newest_px = measured, error_px
    if run.moved_s > terms.time_limit_s:
        return OUT_OF_TIME
    if not enough:
        return GOES_ON
    frames = 0
    for c in range(memory.cameras):
        frames += memory.estimates[c].frames
    new = frames - run.last_frames
    if new >= memory.cameras:
        run.last_frames = frames
        if measured and error_px <= terms.tolerance_px:
            run.held += new // memory.cameras
            take_frames(block)
        elif run.held > 0:
            run.held = 0
            forget_frames(block)
    return SETTLED if run.held >= terms.hold_frames else GOES_ON


@kernel
def follow_error(block: Record, tolerance_px: float, dt_s: float) -> None:
    """Take the error of this step into the means by which a run is judged."""
    run = block[0].run
    if not run.measured:
        return
    error = run.newest_px
    if error > run.first_px:
        run.first_px = error
    share = dt_s / (dt_s + AVERAGED_S)
    run.mean_px = error if run.mean_px == 0.0 else run.mean_px + share * (error - run.mean_px)
    if run.least_px == 0.0 or run.mean_px < SMALLER * run.least_px or error <= tolerance_px:
        run.least_px, run.least_s = run.mean_px if not run.mean_px < 1e-9 else 1e-9, run.moved_s


@kernel
def decay_of_error(
    block: Record, tolerance_px: float, gain_near: float, gain_far: float
) -> tuple[bool, float, float]:
    """Whether there is an error, the share [0, 1] of its way that is done, and the seconds that are left, at the slower
    of the gains.
    """
    run = block[0].run
    gain = min(gain_near, gain_far)
    left_s = _decay_s(run.newest_px, tolerance_px, gain)
    first = run.newest_px if run.newest_px > run.first_px else run.first_px
    whole_s = _decay_s(first, tolerance_px, gain)
    return run.measured, 1.0 if whole_s <= 0.0 else 1.0 - left_s / whole_s, left_s


@kernel
def _decay_s(error_px: float, tolerance_px: float, gain: float) -> float:
    """Time in which an error decays to the tolerance."""
    times = error_px / tolerance_px
    return math.log(1.0 if times < 1.0 else times) / gain


STUCK_S = 3.0
"""Time of motion without a smaller error after which a law is said to be stuck."""
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


class Traits(NamedTuple):
    """Of a run its ``gain`` now and the time ``left_s`` in which its error decays; of its goal the set-points that
    count (c, m), whether they move, a law that may rest in a minimum.
    """

    gain: float
    left_s: float
    wanted: FloatArray | None = None
    moves: bool = False
    local_law: str = ""


def examine_progress(
    source: LawRun, context: StepContext, told: tuple[Reason, ...], traits: Traits
) -> list[Reason]:
    """The reasons beside those that are ``told`` in this step, the gravest first."""
    found = [*_near_limits(context), *_near_singular(source, context), *_few_markers(source, context, traits)]
    tail = _tail(source, context, traits)
    if tail is not None:
        found.append(tail)
    if not traits.moves:
        stuck = _stall_reason(source, context, (*told, *found), traits)
        if stuck is not None:
            found.insert(0, stuck)
    return found


def _near_limits(context: StepContext) -> list[Reason]:
    limits, moving = context.settings.limits, context.state.block.command
    found = []
    for j, name in enumerate(context.settings.joint_names):
        for bound, side in ((limits.position_max[j], 1.0), (limits.position_min[j], -1.0)):
            limit = float(bound) - side * limits.position_margin
            room = side * (limit - float(context.q[j]))
            if room < NEAR_LIMIT and side * moving[j] > 0.0:
                hint = f"joint {name} is {max(room, 0.0):.3f} from its limit less the margin, and moves towards it"
                found.append(Reason("NEAR_LIMIT", "info", name, float(context.q[j]), limit, "rad or m", hint))
    return found


def _near_singular(source: LawRun, context: StepContext) -> list[Reason]:
    """By the pivots of the pixels' normal matrix: a small one is a motion that takes much and shows little."""
    if context.prediction is None or context.weights is None:
        return []
    from_pivots = image_conditioning(context, source)
    if from_pivots >= NEAR_SINGULAR or len(context.q) > 6:
        return []
    hint = "some motion of the body takes large joint motions here: expect it to be slow, or go round the singularity"
    return [Reason("NEAR_SINGULAR", "info", "", from_pivots, NEAR_SINGULAR, "", hint)]


def image_conditioning(context: StepContext, source: LawRun) -> float:
    """Smallest Cholesky pivot of the normal matrix of all seen pixels over its largest diagonal; 0: singular."""
    assert context.prediction is not None
    assert context.weights is not None
    n = len(context.q)
    J = np.ascontiguousarray(context.prediction.jacobian).reshape(-1, n)
    weights = np.repeat((context.weights * source.used[:, None] > 0.0).astype(np.float64).reshape(-1), 2)
    _, conditioning = damped_least_squares(J, np.zeros(len(J)), weights, 0.0)
    return float(conditioning)


def _few_markers(source: LawRun, context: StepContext, traits: Traits) -> list[Reason]:
    if context.weights is None:
        return []
    usable = context.weights * source.used[:, None]
    if traits.wanted is not None:
        usable = usable * traits.wanted
    seen = int((usable.max(axis=0) > 0.0).sum())
    if seen >= FEW_MARKERS:
        return []
    hint = f"{seen} of the goal's markers are seen: one more that is hidden stops the arm, and the noise counts in full"
    return [Reason("FEW_MARKERS", "info", "", float(seen), float(FEW_MARKERS), "markers", hint)]


def _tail(source: LawRun, context: StepContext, traits: Traits) -> Reason | None:
    error = error_of_run(context.state.block)
    if error is None or not source.tolerance_px < error < TAIL * source.tolerance_px:
        return None
    gain, left_s = traits.gain, traits.left_s
    if left_s < TAIL_S:
        return None
    hint = (
        f"near the goal the error falls to a third in {1.1 / gain:.1f} s: a higher gain (or one that rises near the "
        "goal), or a wider tolerance, is faster"
    )
    return Reason("LOW_GAIN", "info", "", left_s, TAIL_S, "s", hint)


def _stall_reason(
    source: LawRun, context: StepContext, told: tuple[Reason, ...], traits: Traits
) -> Reason | None:
    run = context.state.block.numbers.run
    error, since_s = error_of_run(context.state.block), run.moved_s - run.least_s
    if error is None or error <= source.tolerance_px or since_s < STUCK_S:
        return None
    codes = {reason.code: reason for reason in reversed(told)}
    cause = next((codes[code] for code in CAUSES if code in codes), None)
    noise = _noise_px(source, context)
    if error <= NOISE_SIGMAS * noise:
        cause = None
        why = (
            f"most probably the tolerance of {source.tolerance_px:g} px is below what the images allow: a marker has "
            f"a deviation of {noise:.3f} px; widen it"
        )
    elif cause is not None:
        why = f"most probably {cause.code} {cause.subject}".rstrip() + f": {cause.hint}"
    elif traits.local_law:
        law = traits.local_law
        sure = " or ".join((*LAWS.on_path("straight")[:1], *LAWS.on_path("planned")[:1]))
        why = f"most probably law {law!r} rests in a minimum beside the goal: take {sure}"
    else:
        why = "nothing holds it up that is known: has the goal's body another shape, or has a camera or marker moved?"
    hint = f"the error is {error:.3f} px, no smaller for {since_s:.0f} s; {why}"
    return Reason(
        "STUCK", "slow", "" if cause is None else cause.subject, error, source.tolerance_px, "px", hint
    )


def _noise_px(source: LawRun, context: StepContext) -> float:
    """Largest deviation [px] of one observation of a marker that is seen."""
    if context.weights is None:
        return 0.0
    usable = context.weights * source.used[:, None]
    if not bool((usable > 0.0).any()):
        return 0.0
    return 1.0 / float(usable[usable > 0.0].min())
