"""The progress of a law's run: updates it in each step, finds out why the run is slow or stuck, and tests whether the
cameras agree with each other and with the joints where a goal ends, as far as image noise and the model's accuracy
allow.

The law makes the arm follow a camera that drifts slowly: when both images show the set-points, the arm is beside the
goal. Only that camera has a difference between observed and predicted pixels. It is too small for one round of frames
(`monitors.fault_isolation`), but visible in the mean over the frames in which the goal's error is inside its tolerance.

These mean innovations ``d`` are Gaussian with the covariance ``C = Σ/N + S P Sᵀ + J_q S_q J_qᵀ`` of the detector's
noise over N frames, the model's parameters and the errors of joint readings that the model states. For each camera the
hypothesis that it was displaced, ``d = E ξ``, reduces the chi-square ``dᵀ C⁻¹ d``; if nothing was displaced, the
reduction is a chi-square of six degrees of freedom.
A healthy camera is called displaced with a probability of at most `FALSE_ALARMS` at each test, all cameras together.
Displacements of less than `SHARE` of the goal's tolerance are tolerated. If the joints explain
``d`` better than any one camera, the cameras agree: the goal is where they show it. If a gain is in `DOUBT`, which
noise causes in one goal of a hundred, more frames are averaged, up to `MOST_FRAMES`: by the union bound the probability
of a false alarm is then at most so many times `FALSE_ALARMS` for that goal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from stereoservo.calibration.change.hypothesis_test import UNCLEAR, chi2_quantile
from stereoservo.control.law_registry import LAWS
from stereoservo.control.laws.stereo import ILL_CONDITIONED
from stereoservo.core.block import Block
from stereoservo.core.context import StepContext
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitors.fault_isolation import named
from stereoservo.core.prediction import chain_at
from stereoservo.core.state import LawRun
from stereoservo.kinematics.kernels import (
    distort_pixel,
    image_jacobian,
    multiply4_into,
    transform_points,
    undistort_pixel,
)
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray, KindArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import cholesky_solve, damped_least_squares, damped_solve, factor_solve

AVERAGED_S = 0.5
"""Time constant of the mean error [s]: long enough that noise alone does not look like progress."""
SMALLER = 0.95
"""Factor on the least mean error so far: below it the error counts as smaller."""
GOES_ON, OUT_OF_TIME, SETTLED = range(3)
"""Results of `account_run`."""


def error_of_run(block: Block) -> float | None:
    """The error [px] of the active law in its last step; None if none was measured."""
    run = block.numbers.run
    return run.newest_px if run.measured else None


@kernel
def begin_run(block: Record) -> None:
    """Reset the run for a law that starts."""
    memory = block[0]
    run, frames = memory.run, 0
    for c in range(memory.cameras):
        frames += memory.estimates[c].frames
    run.moved_s, run.held, run.last_frames = 0.0, 0, frames
    run.measured, run.newest_px, run.first_px = False, 0.0, 0.0
    run.mean_px, run.least_px, run.least_s = 0.0, 0.0, 0.0
    forget_frames(block)


class RunTerms(NamedTuple):
    """Conditions of a run: the tolerance [px] in which the error has to stay for so many frames, and the time limit
    [s].
    """

    tolerance_px: float
    hold_frames: int
    time_limit_s: float


@kernel
def account_run(block: Record, measured: bool, error_px: float, enough: bool, dt_s: float, terms: RunTerms) -> int:
    """Update the run by a step of ``dt_s`` with this error. Returns `OUT_OF_TIME`; `SETTLED` if ``enough`` markers are
    seen and the error has stayed inside its tolerance for the required number of frames of every camera on average;
    otherwise `GOES_ON`.
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
    """Update the means by which a run is judged by the error of this step."""
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
def decay_of_error(block: Record, tolerance_px: float, gain_near: float, gain_far: float) -> tuple[bool, float, float]:
    """Whether there is an error, the completed fraction [0, 1] of its decay, and the remaining seconds at the smaller
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
    """Time [s] in which an error decays to the tolerance."""
    times = error_px / tolerance_px
    return math.log(1.0 if times < 1.0 else times) / gain


STUCK_S = 3.0
"""Time of motion without a smaller error [s] after which a law is reported as stuck."""
NEAR_LIMIT = 0.087
"""Clearance to a limit less its margin [rad or m] below which it is reported: five degrees."""
NEAR_SINGULAR = 2.0 * ILL_CONDITIONED
FEW_MARKERS = 4
TAIL = 10.0
"""Factor on the tolerance: below it the error is in the slow end of the exponential decay (tail)."""
TAIL_S = 2.0
"""Shortest duration of a tail that is reported [s]."""
NOISE_SIGMAS = 3.0

CAUSES = (
    "KEEP_OUT", "JOINT_LIMIT", "INCIDENCES_CONTRADICT", "INCIDENCE_NOT_DRIVABLE", "NOT_REACHABLE", "NO_FACE",
    "FEATURES_STALE", "TOO_FEW_MARKERS", "VISIBILITY_BLOCKED", "VISIBILITY_WAIT", "JACOBIAN_ILL_CONDITIONED",
    "NEAR_SINGULAR", "VELOCITY_SCALED",
)  # fmt: skip
"""Possible causes of a stuck law, the most probable first."""


class Traits(NamedTuple):
    """Properties of a run: its current ``gain`` and the time ``left_s`` in which its error decays; of its goal the
    set-points that count (c, m), whether they move, and whether its law may get stuck in a local minimum.
    """

    gain: float
    left_s: float
    required: FloatArray | None = None
    moves: bool = False
    local_law: str = ""


def examine_progress(source: LawRun, context: StepContext, earlier: tuple[Reason, ...], traits: Traits) -> list[Reason]:
    """The progress reasons in addition to those already given (``earlier``) in this step, the most serious first."""
    found = [*_near_limits(context), *_near_singular(source, context), *_few_markers(source, context, traits)]
    tail = _tail(source, context, traits)
    if tail is not None:
        found.append(tail)
    if not traits.moves:
        stuck = _stall_reason(source, context, (*earlier, *found), traits)
        if stuck is not None:
            found.insert(0, stuck)
    return found


def _near_limits(context: StepContext) -> list[Reason]:
    limits, moving = context.settings.limits, context.state.block.command
    found = []
    for j, name in enumerate(context.settings.joint_names):
        for bound, side in ((limits.position_max[j], 1.0), (limits.position_min[j], -1.0)):
            limit = float(bound) - side * limits.position_margin
            clearance = side * (limit - float(context.q[j]))
            if clearance < NEAR_LIMIT and side * moving[j] > 0.0:
                hint = f"joint {name} is {max(clearance, 0.0):.3f} from its limit less the margin, and moves towards it"
                found.append(Reason("NEAR_LIMIT", "info", name, float(context.q[j]), limit, "rad or m", hint))
    return found


def _near_singular(source: LawRun, context: StepContext) -> list[Reason]:
    """From the pivots of the pixels' normal matrix: a small one is a motion that needs large joint travel and is hardly
    visible.
    """
    if context.prediction is None or context.weights is None:
        return []
    from_pivots = image_conditioning(context, source)
    if from_pivots >= NEAR_SINGULAR or len(context.q) > 6:
        return []
    hint = "some motion of the body takes large joint motions here: expect it to be slow, or go round the singularity"
    return [Reason("NEAR_SINGULAR", "info", "", from_pivots, NEAR_SINGULAR, "", hint)]


def image_conditioning(context: StepContext, source: LawRun) -> float:
    """Smallest Cholesky pivot of the normal matrix of all seen pixels over its largest diagonal element;
    0: singular.
    """
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
    if traits.required is not None:
        usable = usable * traits.required
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


def _stall_reason(source: LawRun, context: StepContext, earlier: tuple[Reason, ...], traits: Traits) -> Reason | None:
    run = context.state.block.numbers.run
    error, since_s = error_of_run(context.state.block), run.moved_s - run.least_s
    if error is None or error <= source.tolerance_px or since_s < STUCK_S:
        return None
    codes = {reason.code: reason for reason in reversed(earlier)}
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
    return Reason("STUCK", "slow", "" if cause is None else cause.subject, error, source.tolerance_px, "px", hint)


def _noise_px(source: LawRun, context: StepContext) -> float:
    """Largest standard deviation [px] of one observation of a marker that is seen."""
    if context.weights is None:
        return 0.0
    usable = context.weights * source.used[:, None]
    if not bool((usable > 0.0).any()):
        return 0.0
    return 1.0 / float(usable[usable > 0.0].min())


FALSE_ALARMS = 1e-6
"""Largest probability that noise, as stated, makes any camera appear displaced in one test."""
DOUBT = 1e-2
"""Probability below which a gain is not attributed to noise before more frames are averaged."""
MOST_FRAMES = 50
"""Frames of a camera that are averaged before a gain still in doubt is attributed to noise."""
SHARE = 0.5
"""Fraction of a goal's tolerance: rms change of a camera's pixels up to which its displacement is tolerated."""
FREEDOMS = 6
"""Degrees of freedom of a displacement."""
BIAS_PX = 0.05
"""Standard deviation [px] of a marker's centre that is the same in all frames, caused by detector and light."""
FEWEST = 3
"""Least number of markers in a camera's images for the camera to be tested and to confirm the joints."""
MOST_ROWS = 64
"""Largest number of observations (markers times cameras) that are used: if there are more, evenly chosen ones."""
DAMPING = 1e-9
LENS_STEP = 1e-3
"""Step of a lens parameter for derivatives by it, in standard deviations."""
AGREED, DOUBTFUL, UNDECIDED, DISPLACED = range(4)
"""Results of `decide`."""


# -- the mean innovations -----------------------------------------------------------------------------------


@kernel
def forget_frames(block: Record) -> None:
    """Reset the means."""
    memory = block[0]
    observed = memory.cameras * memory.markers
    memory.settled_innovation[: 2 * observed] = 0.0
    memory.settled_variance[:observed] = 0.0
    memory.settled_count[:observed] = 0.0
    memory.settled_ns[: memory.cameras] = 0


@kernel
def take_frames(block: Record) -> None:
    """Add the newest frame of each camera to the sums, once: its markers that passed the gate."""
    memory = block[0]
    m, rows = memory.markers, memory.rows
    for c in range(memory.cameras):
        t_ns = memory.sightings[c].t_ns
        if t_ns <= memory.settled_ns[c]:
            continue
        memory.settled_ns[c] = t_ns
        for i in range(m):
            cell, row = c * m + i, c * rows + i
            if memory.seen_ns[cell] != t_ns:
                continue
            for a in range(2):
                memory.settled_innovation[2 * cell + a] += memory.frame_innovation[2 * row + a]
            memory.settled_variance[cell] += 0.5 * (memory.frame_spread[4 * row] + memory.frame_spread[4 * row + 3])
            memory.settled_count[cell] += 1.0


# -- the accuracy of the model ------------------------------------------------------------------------------

GENERATOR, MATRIX, LENS, POINT = range(4)
"""Parts of a model, in the order of `ModelCovariance.parts`."""


@dataclass(frozen=True, eq=False)
class ModelParameters:
    """The free parameters of a model as kernels take them: ``directions`` (p, 16), of a generator, a camera's matrix, a
    lens or a point, padded; the ``part`` (p,) that each changes, `GENERATOR` to `POINT`, and the ``index`` (p,) of the
    joint, camera (in the cell's order) or marker; their ``covariance`` (p, p).
    """

    directions: FloatArray
    part: IntArray
    index: IntArray
    covariance: FloatArray


def model_parameters(model: CellModel, cameras: tuple[str, ...]) -> ModelParameters | None:
    """Parameters of a model in a cell with these ``cameras``; None if it states no covariance."""
    given = model.covariance
    if given is None:
        return None
    order = {name: c for c, name in enumerate(cameras)}
    directions, parts, indices, kept = [], [], [], []
    for part, bases in enumerate(given.parts):
        for k, basis in enumerate(bases):
            index = order.get(model.cameras[k].name, -1) if part in (MATRIX, LENS) else k
            for direction in basis:
                padded = np.zeros(16)
                padded[: direction.size] = direction.reshape(-1)
                directions.append(padded)
                parts.append(part)
                indices.append(index)
                kept.append(index >= 0)
    used = np.flatnonzero(kept)
    return ModelParameters(
        np.array(directions).reshape(-1, 16)[used],
        np.array(parts, np.int64)[used],
        np.array(indices, np.int64)[used],
        np.ascontiguousarray(given.covariance[np.ix_(used, used)]),
    )


@kernel
def pixel_slopes(
    parameters: tuple[FloatArray, IntArray, IntArray, FloatArray],
    chain: tuple[FloatArray, KindArray, FloatArray, bool],
    q: FloatArray,
    marker_points: FloatArray,
    cameras: tuple[FloatArray, FloatArray],
    observed_of: tuple[IntArray, IntArray],
) -> FloatArray:
    """Derivatives (2 k, p) of the innovations of k observations, in ideal pixels, by the ``parameters`` of a model,
    with the joints at ``q`` (n,).

    ``chain``: generators (n, 4, 4), kinds, zeros, and whether the tip comes first.
    ``cameras``: matrices (c, 3, 4) and lenses.
    ``observed_of``: the camera and the marker of each observation, (k,) each.
    """
    (matrices, lenses), (camera_of, marker_of) = cameras, observed_of
    directions, part, index, covariance = parameters
    generators, kinds, zero, tip_first = chain
    n, observed = q.size, camera_of.size
    motions = np.empty((n, 4, 4))
    for j in range(n):
        _motion(generators[j], kinds[j] == 1, q[j] - zero[j], motions[j])
    before, after = np.empty((n + 1, 4, 4)), np.empty((n + 1, 4, 4))
    before[0], after[n] = np.eye(4), np.eye(4)
    for k in range(n):
        multiply4_into(before[k], motions[n - 1 - k if tip_first else k], before[k + 1])
    for back in range(n):
        k = n - 1 - back
        multiply4_into(motions[n - 1 - k if tip_first else k], after[k + 1], after[k])
    H = before[n]
    points = transform_points(H, marker_points)
    slopes = np.zeros((2 * observed, part.size))
    first, second, third = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    for p in range(part.size):
        at, D = index[p], directions[p].reshape((4, 4))
        if part[p] == GENERATOR:
            k = n - 1 - at if tip_first else at
            multiply4_into(D, motions[at], first)
            multiply4_into(motions[at], D, second)
            multiply4_into(before[k], first - second, third)
            multiply4_into(third, after[k + 1], first)
        for s in range(observed):
            c, i = camera_of[s], marker_of[s]
            if ((part[p] == MATRIX or part[p] == LENS) and c != at) or (part[p] == POINT and i != at):
                continue
            P, X = matrices[c], points[i]
            x, y, d = _times(P[0], X), _times(P[1], X), _times(P[2], X)
            u, v = x / d, y / d
            if part[p] == LENS:
                step = LENS_STEP * math.sqrt(covariance[p, p])
                raw_u, raw_v = distort_pixel(lenses[c], u, v)
                size = lenses.shape[1]
                ahead = undistort_pixel(lenses[c] + step * directions[p, :size], raw_u, raw_v)
                behind = undistort_pixel(lenses[c] - step * directions[p, :size], raw_u, raw_v)
                slopes[2 * s, p] = (ahead[0] - behind[0]) / (2.0 * step)
                slopes[2 * s + 1, p] = (ahead[1] - behind[1]) / (2.0 * step)
                continue
            change = np.zeros(3)
            for r in range(3):
                if part[p] == MATRIX:
                    change[r] = _times(D[r], X)
                elif part[p] == GENERATOR:
                    for a in range(4):
                        change[r] += P[r, a] * _times(first[a], marker_points[i])
                else:
                    for a in range(4):
                        change[r] += P[r, a] * _times(H[a], D[0])
            slopes[2 * s, p] = -(change[0] - u * change[2]) / d
            slopes[2 * s + 1, p] = -(change[1] - v * change[2]) / d
    return slopes


@kernel
def _motion(generator: FloatArray, prismatic: bool, step: float, motion: FloatArray) -> None:
    """``exp(step Ĝ)`` into (4, 4)."""
    square = np.empty((4, 4))
    multiply4_into(generator, generator, square)
    half = math.sin(0.5 * step)
    linear, quadratic = (step, 0.0) if prismatic else (math.sin(step), 2.0 * half * half)
    for i in range(4):
        for k in range(4):
            motion[i, k] = (1.0 if i == k else 0.0) + linear * generator[i, k] + quadratic * square[i, k]


@kernel
def _times(row: FloatArray, X: FloatArray) -> float:
    product: float = row[0] * X[0] + row[1] * X[1] + row[2] * X[2] + row[3] * X[3]
    return product


@kernel
def added_covariance(C: FloatArray, slopes: FloatArray, covariance: FloatArray) -> None:
    """Add ``S P Sᵀ`` of the ``slopes`` (r, p) to the lower triangle of ``C`` (r, r)."""
    rows, p = slopes.shape
    product = np.zeros(p)
    for i in range(rows):
        for a in range(p):
            product[a] = 0.0
        for b in range(p):
            if slopes[i, b] == 0.0:
                continue
            for a in range(p):
                product[a] += slopes[i, b] * covariance[b, a]
        for k in range(i + 1):
            total = 0.0
            for a in range(p):
                total += product[a] * slopes[k, a]
            C[i, k] += total


# -- the hypotheses -----------------------------------------------------------------------------------------


@kernel
def explained(d: FloatArray, C: FloatArray, columns: FloatArray, first: int, last: int, x: FloatArray) -> float:
    """Least-squares ``x`` of ``d = A x`` (r,) with the Cholesky factor ``C`` (r, r) of the covariance, where ``A`` (r,
    k) has the ``columns`` in the rows from ``first`` to ``last``; returns the reduction of chi-square.
    """
    rows, count = d.size, columns.shape[1]
    weighted = np.empty((count, rows))
    column = np.zeros(rows)
    for k in range(count):
        column[:] = 0.0
        column[first:last] = columns[first:last, k]
        factor_solve(C, column, weighted[k])
    N, b = np.zeros((count, count)), np.zeros(count)
    for k in range(count):
        for r in range(rows):
            b[k] += weighted[k, r] * d[r]
        for j in range(k + 1):
            for r in range(first, last):
                N[k, j] += weighted[k, r] * columns[r, j]
            N[j, k] = N[k, j]
    damped_solve(N, b, DAMPING, x)
    gain = 0.0
    for k in range(count):
        gain += b[k] * x[k]
    return gain


@kernel
def compare_causes(
    d: FloatArray,
    C: FloatArray,
    displaced: FloatArray,
    jacobian: FloatArray,
    begins: IntArray,
    found: tuple[FloatArray, FloatArray],
) -> bool:
    """Reduction of the chi-square of ``d`` (2 k,) under each hypothesis. Writes to the gains (c + 1,) of ``found`` the
    reduction if each camera was displaced, and if the joints deviate from their readings; to its effects (c,) the rms
    displacement of each camera's pixels in that case [px].
    Returns False if the covariance ``C`` (2 k, 2 k), which is overwritten, is not positive definite.

    ``displaced`` (2 k, 6), ``jacobian`` (2 k, n): derivatives of the pixels. These are ordered by camera; ``begins`` (c
    + 1,) holds the first row of each.
    """
    gains, effects = found
    x = np.zeros(d.size)
    if not cholesky_solve(C, d, x) > 0.0:
        return False
    cameras = effects.size
    for c in range(cameras):
        first, last = begins[c], begins[c + 1]
        gains[c], effects[c] = 0.0, 0.0
        if last - first < 2 * FEWEST:
            continue
        twist = np.zeros(displaced.shape[1])
        gains[c] = explained(d, C, displaced, first, last, twist)
        squares = 0.0
        for r in range(first, last):
            shift = 0.0
            for k in range(twist.size):
                shift += displaced[r, k] * twist[k]
            squares += shift * shift
        effects[c] = math.sqrt(2.0 * squares / (last - first))
    gains[cameras] = explained(d, C, jacobian, 0, d.size, np.zeros(jacobian.shape[1]))
    return True


@lru_cache(maxsize=16)
def significant_gain(cameras: int, probability: float = FALSE_ALARMS) -> float:
    """Reduction of chi-square that noise exceeds for one of so many cameras with this probability."""
    return chi2_quantile(probability / cameras, FREEDOMS)


def decide(
    gains: FloatArray, effects: FloatArray, measurements: int, freedoms: int, limit_px: float, judged: FloatArray,
    *, may_wait: bool = False,
) -> tuple[int, list[int]]:  # fmt: skip
    """Interpret the ``gains`` (c + 1,) and ``effects`` (c,) of `compare_causes`; returns the result and the cameras
    concerned.

    `AGREED`: no camera that is ``judged`` (c,) > 0 was displaced by more than ``limit_px``.
    `DISPLACED`: one was.
    `UNDECIDED`: one of several cameras, or the joints with all ``freedoms``, explain the data equally well (Schwarz
    criterion).
    `DOUBTFUL`, only if it ``may_wait``: more frames show whether it is noise.
    """
    cameras = effects.size
    penalty = math.log(measurements)
    scores = [FREEDOMS * penalty - float(gains[c]) for c in range(cameras)]
    joints = freedoms * penalty - float(gains[cameras])
    least = significant_gain(cameras, DOUBT if may_wait else FALSE_ALARMS)
    found = [c for c in range(cameras) if judged[c] > 0.0 and gains[c] > least and effects[c] >= limit_px]
    if not found or joints < min(scores[c] for c in found) - UNCLEAR:
        return AGREED, []
    best = min(scores)
    likely = [c for c in found if scores[c] < best + UNCLEAR]
    if not likely:  # a camera that is not judged explains it better
        return AGREED, []
    if max(float(gains[c]) for c in likely) <= significant_gain(cameras):
        return DOUBTFUL, likely
    alone = len(likely) == 1 and joints > best + UNCLEAR
    return (DISPLACED if alone else UNDECIDED), likely


# -- where a goal ends --------------------------------------------------------------------------------------


def disagreement(source: LawRun, context: StepContext, required: FloatArray | None) -> Reason | None:
    """The reason why a goal whose error is inside its tolerance is not reached: a camera that it uses, with set-points
    ``required`` (c, m) in it (None: in all), disagrees with the other cameras and the joints; None if they agree.

    Not tested: models that state no covariance, cameras that may move, and bodies that move independently of the arm.
    """
    state, arrays, model = context.state, context.derived.arrays, context.state.model
    if arrays is None or model is None or state.target is not None or any(state.mobile):
        return None
    parameters = _parameters(context, model)
    if parameters is None:
        return None
    observed = _chosen(state.block.settled_count)
    begins = np.searchsorted(observed[:, 0], np.arange(len(arrays.matrices) + 1)) * 2
    if int((np.diff(begins) >= 2 * FEWEST).sum()) < 2:
        return None
    snapshot = _snapshot(context, arrays, parameters, observed)
    gains, effects = np.zeros(len(arrays.matrices) + 1), np.zeros(len(arrays.matrices))
    if not compare_causes(*snapshot, begins, (gains, effects)):
        return None
    judged = source.used if required is None else source.used * (required > 0.0).any(axis=1)
    limit_px = SHARE * source.tolerance_px
    may_wait = float(state.block.settled_count.max()) < MOST_FRAMES
    found, cameras = decide(gains, effects, int(begins[-1]), len(context.q), limit_px, judged, may_wait=may_wait)
    if found == AGREED:
        return None
    names = tuple(context.settings.cameras[c].name for c in cameras)
    return _reason(names, float(effects[cameras].max()), limit_px, source.tolerance_px, found)


def _parameters(context: StepContext, model: CellModel) -> ModelParameters | None:
    kept = context.derived.parameters
    if kept is None or kept[0] is not model:
        names = tuple(camera.name for camera in context.settings.cameras)
        kept = context.derived.parameters = model, model_parameters(model, names)
    return kept[1]


def _chosen(count: FloatArray) -> IntArray:
    """Cameras and markers (k, 2) of the observations that are used, chosen from those that were counted (c, m)."""
    cameras, markers = count.shape
    seen = np.flatnonzero((count > 0.0).any(axis=0))
    most = max(FEWEST + 1, MOST_ROWS // cameras)
    if seen.size > most:
        seen = seen[np.arange(most) * seen.size // most]
    chosen = np.zeros((cameras, markers), bool)
    chosen[:, seen] = count[:, seen] > 0.0
    return np.argwhere(chosen)


def _snapshot(
    context: StepContext, arrays: ModelArrays, parameters: ModelParameters, observed: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """For the observations ``observed`` (k, 2): mean innovations (2 k,), their covariance (2 k, 2 k), and the
    derivatives of the pixels by a displacement of the camera (2 k, 6) and by the joints (2 k, n).
    """
    block, q = context.state.block, context.q
    cameras, markers = np.ascontiguousarray(observed[:, 0]), np.ascontiguousarray(observed[:, 1])
    given = (parameters.part != POINT) | np.isin(parameters.index, markers)
    directions, part, index = parameters.directions[given], parameters.part[given], parameters.index[given]
    covariance = np.ascontiguousarray(parameters.covariance[np.ix_(given, given)])
    count = block.settled_count[cameras, markers]
    d = (block.settled_innovation[cameras, markers] / count[:, None]).reshape(-1)
    H, operators = chain_at(arrays, q)
    points = transform_points(H, arrays.marker_points)
    jacobian = image_jacobian(operators, arrays.matrices, points)[cameras, markers].reshape(len(d), -1)
    C = np.diag(np.repeat(block.settled_variance[cameras, markers] / count**2 + BIAS_PX**2, 2))
    slopes = pixel_slopes(
        (directions, part, index, covariance),
        (arrays.generators, arrays.kinds, arrays.zero, arrays.tip_first),
        q,
        arrays.marker_points,
        (arrays.matrices, arrays.lenses),
        (cameras, markers),
    )
    added_covariance(C, slopes, covariance)
    if arrays.joint_accuracy is not None:
        deviations = arrays.joint_accuracy.deviations((q - arrays.zero)[None])[0]
        added_covariance(C, jacobian, np.diag(deviations**2))
    if arrays.metric_basis is not None:
        displaced = image_jacobian(arrays.metric_basis, arrays.matrices, points)[cameras, markers]
    else:
        displaced = _affine_motions(d, arrays.matrices, points, cameras, markers)
    return d, C, displaced.reshape(len(d), -1), jacobian


def _affine_motions(
    d: FloatArray, matrices: FloatArray, points: FloatArray, cameras: IntArray, markers: IntArray
) -> FloatArray:
    """Derivatives (2 k, 6) of the pixels by an affine motion of a camera's image, used if the derivatives by its
    displacement are unknown.
    """
    images = np.einsum("kij,kj->ki", matrices[cameras], points[markers])
    places = images[:, :2] / images[:, 2:]
    centroid, size = places.mean(axis=0), max(float(places.std()), 1.0)
    columns = np.concatenate([np.ones((len(places), 1)), (places - centroid) / size], axis=1)
    motions = np.zeros((len(d), FREEDOMS))
    motions[0::2, :3], motions[1::2, 3:] = columns, columns
    return motions


def _reason(names: tuple[str, ...], effect_px: float, limit_px: float, tolerance_px: float, found: int) -> Reason:
    if found == DOUBTFUL:
        return Reason(
            "CAMERAS_COMPARED",
            "slow",
            ", ".join(names),
            effect_px,
            limit_px,
            "px",
            f"camera {' or '.join(names)} may be off by {effect_px:.3g} px rms (limit {limit_px:.3g} px): more frames "
            "are averaged before the goal counts as reached",
        )
    words = named(names) if found == DISPLACED else f"camera {' or '.join(names)}"
    causes = f"{words} crept or was moved"
    if found == UNDECIDED:
        causes = f"either {words} crept or was moved, or a joint's zero is off, or the marker body slipped on the arm"
    return Reason(
        "CAMERAS_DISAGREE",
        "hold",
        ", ".join(names),
        effect_px,
        limit_px,
        "px",
        f"the error is within its tolerance of {tolerance_px:g} px, but {words} is off by {effect_px:.3g} px rms "
        f"beside what the joints and the other cameras show (limit {limit_px:.3g} px): {causes}. Run calibrate "
        "--check; put back what moved, or calibrate",
    )
