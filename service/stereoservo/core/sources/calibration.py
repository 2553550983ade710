"""Motion source of calibration: moves each joint alone from a base posture, chooses its range by the images of a small
first motion, and averages the markers' pixels at every stop.

From the base, joint l moves in steps to one side, then to the other (thesis 5.4.1, fig. 5.13); the steps are uneven
(`stop_offset`). The range is stated in the cell file, or determined during the motion (`plan_sides`): as far as the
markers remain in every view. At a stop the pixels are averaged at rest; a spread joint, if there is one, visits several
positions there (fig. 5.16). A step that loses the markers is reversed and that side is closed. Finally all joints are
offset from the base at once (`combined_offsets`), if linear extrapolation from the single-joint motions predicts that
the markers remain visible. These poses identify what single joints cannot: sag that depends on several joints, coupled
joints, and the order of the joints.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.cycle import PathFrame, PathRecord, Sample
from stereoservo.core.monitors.collision import learnt_loads
from stereoservo.core.rest_averages import marker_rows
from stereoservo.core.settings import LARGEST_RANGE, CoreSettings, TrialSettings
from stereoservo.core.sources.measure_at_pose import (
    abort,
    at_target,
    blocked,
    collect_samples,
    continue_move,
    enter,
    first_visit,
    markers_lost,
    mean_joints,
    rest,
    too_few_seen,
    too_slow,
    trial_settings,
    unseen_at_base,
)
from stereoservo.core.state import CalibrationMotion, TrialMotion
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.ports.devices import JointKindName

NO_STEP = 1e-9  # step of a side without planned stops
MOST_STOPS = 1.5  # factor on calibration.stops, for a joint with a larger range than planned


def start_trials(goal_id: str, q: FloatArray, now_ns: int, settings: CoreSettings) -> CalibrationMotion:
    """The calibration programme before its first move, to the base."""
    trials = trial_settings(settings)
    n = q.size
    # One more than the positions of the spread joint: the last one is that joint at its base.
    unseen = np.full((len(trials.spread_offsets) + 1, len(settings.cameras), len(settings.marker_ids), 2), np.nan)
    return CalibrationMotion(
        id=goal_id, lease_s=None, lease_until_ns=0, joint=-1, side=1, k=0, count=0, step=0.0, reach=np.zeros(2),
        turn=-1, seen_turns=0, base_pixels=unseen, last=unseen.copy(), last_at=0.0, before=unseen.copy(),
        before_at=0.0, lowest=trials.base.copy(), highest=trials.base.copy(), stops=np.zeros(n, np.int64),
        motion_sigmas=np.zeros(n), sigma_px=0.0, slope_sums=np.zeros((n, *unseen.shape[1:])),
        slope_weights=np.zeros((n, *unseen.shape[1:3])),
        **first_visit(trials.base, q, now_ns, settings),  # type: ignore[arg-type]
    )  # fmt: skip


def trials_step(trials: CalibrationMotion, context: StepContext) -> SourceOutput:
    """One step of the programme."""
    settings = trial_settings(context.settings)
    _record_path(trials, context)
    if trials.phase in ("move", "return", "finish"):
        return _move(trials, context, settings)
    samples = collect_samples(trials, context, settings)
    if samples is None:
        return rest(context)
    return _stop_done(trials, context, settings, samples)


def finish(trials: TrialMotion, context: StepContext) -> SourceOutput:
    """The end of trial motions that are done."""
    context.emit(
        "calibration_finished",
        id=trials.id,
        message="trial motions done",
        progress=1.0,
        loads=learnt_loads(trials.id, context.state),
    )
    return rest(context, finished=True)


def _move(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> SourceOutput:
    if at_target(trials, context):
        if trials.phase == "finish":
            return finish(trials, context)
        if trials.phase == "return":
            return _next(trials, context, settings)
        enter(trials, "settle", context)
        return rest(context)
    reason = too_slow(trials, context, settings)
    if reason is not None and _combining(trials) and trials.phase == "move":
        return _left_out(trials, context, f"is not reached: {reason.hint}")
    if reason is not None:
        return abort(trials, context, reason)
    if trials.phase == "move" and trials.joint >= 0 and markers_lost(trials, context, settings):
        return _turn_done(trials, context, settings, "in motion")
    return continue_move(trials, context, settings)


def _stop_done(
    trials: CalibrationMotion, context: StepContext, settings: TrialSettings, samples: tuple[Sample, ...]
) -> SourceOutput:
    poorest = too_few_seen(samples, settings, context.settings.scene_ids)
    if poorest is not None:
        if trials.joint < 0 and trials.turn < 0:
            return abort(trials, context, unseen_at_base(poorest, settings, context.settings.scene_ids))
        return _turn_done(trials, context, settings, "at the stop")
    mean = mean_joints(trials)
    # The base with the spread joint turned is a stop of that joint's own.
    trial = settings.spread_joint if trials.joint < 0 and trials.turn >= 0 else trials.joint
    trial = -1 if _combining(trials) else trial
    context.emit(
        "calibration_sample",
        id=trials.id,
        joints=mean,
        samples=samples,
        trial=trial,
        progress=_progress(trials, settings),
        path=_path_record(trials),
    )
    if not _combining(trials):
        _remember(trials, context, settings, samples, mean)
    trials.seen_turns += 1
    return _turn_done(trials, context, settings, "", mean)


PATH_FRAMES, PATH_JOINTS, PATH_MARKERS = 200, 2000, 8
"""Largest numbers of frames and joint samples kept of one path, and of markers of a frame: enough to measure the delay
of its stamps.
"""
PATH_APART_NS = 2_000_000
"""Least time between joint samples that are kept [ns]."""


def _record_path(trials: CalibrationMotion, context: StepContext) -> None:
    """Record the observations on the path to a stop, until its markers are averaged; a path that is too long is not
    recorded.
    """
    for camera, observation in context.ingested.observations:
        if len(trials.path_frames) < PATH_FRAMES and observation.ids.size:
            chosen = slice(None, None, max(1, -(-observation.ids.size // PATH_MARKERS)))
            trials.path_frames.append(
                PathFrame(
                    camera,
                    observation.t_shutter_ns,
                    np.asarray(observation.ids[chosen], dtype=np.int64),
                    np.array(observation.pixels[chosen]),
                )
            )
    if len(trials.path_ns) < PATH_JOINTS:
        record_joints(trials, context)


def record_joints(trials: TrialMotion, context: StepContext) -> None:
    """Record the joint sample, unless it is too near to the last one."""
    now_ns = context.state.block.numbers.last_joints_ns
    if not trials.path_ns or now_ns - trials.path_ns[-1] >= PATH_APART_NS:
        trials.path_ns.append(now_ns)
        trials.path_joints.append(context.q.copy())


def driven_path(trials: TrialMotion, leg: int = 0) -> PathRecord:
    """The record of the path so far; recording restarts."""
    frames, times, joints = trials.path_frames, trials.path_ns, trials.path_joints
    trials.path_frames, trials.path_ns, trials.path_joints = [], [], []
    return PathRecord(tuple(frames), np.array(times, dtype=np.int64), np.array(joints), leg)


def _path_record(trials: CalibrationMotion) -> PathRecord | None:
    """The record of the path that ends here, if it is whole and shows motion."""
    record = driven_path(trials)
    return None if len(record.joints_ns) == PATH_JOINTS or len(record.frames) < 2 else record


def _remember(
    trials: CalibrationMotion,
    context: StepContext,
    settings: TrialSettings,
    samples: tuple[Sample, ...],
    mean: FloatArray,
) -> None:
    """Store the pixels for the extrapolation to the next stop, and how far and how fast the markers moved."""
    pixels, sigmas = marker_pixels(samples, context.settings)
    slot = _slot(trials, context, settings)
    if trials.joint < 0:
        trials.base_pixels[slot] = pixels
        stated = sigmas[np.isfinite(sigmas)]
        trials.sigma_px = max(trials.sigma_px, float(np.median(stated)))
        return
    trials.last[slot] = pixels
    moved = image_motion(trials.base_pixels[slot], pixels, sigmas)
    trials.motion_sigmas[trials.joint] = max(trials.motion_sigmas[trials.joint], moved)
    offset, shift = float(mean[trials.joint] - settings.base[trials.joint]), pixels - trials.base_pixels[slot]
    seen = np.isfinite(shift).all(axis=-1)
    trials.slope_sums[trials.joint, seen] += offset * shift[seen]
    trials.slope_weights[trials.joint, seen] += offset**2


def _progress(trials: CalibrationMotion, settings: TrialSettings) -> float:
    done, n = 0.0, len(trials.stops)
    if _combining(trials):
        done = n + trials.k / settings.together
    elif trials.joint >= 0:
        done = trials.joint + min(1.0, float(trials.stops[trials.joint]) / settings.stops)
    return min(1.0, done / (n + (settings.together > 0)))


def _combining(trials: CalibrationMotion) -> bool:
    """Whether the single joints are done, and all joints are offset from the base at once."""
    return trials.joint == len(trials.stops)


# -- one stop: the positions of the spread joint ------------------------------------------------------------


def _turns(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> int:
    """Number of positions that the spread joint visits at a stop of the current joint; 0: it stays at its base."""
    spread = settings.spread_joint
    if spread < 0 or trials.joint == spread or _combining(trials):
        return 0
    if trials.joint < 0:
        return len(settings.spread_offsets)
    # Only joints on the far side of the spread joint move the turned plate as one body.
    rides = all(camera.mount == "eye_in_hand" for camera in context.settings.cameras)
    far = trials.joint > spread if rides else trials.joint < spread
    return len(settings.spread_offsets) if far else 0


def _slot(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> int:
    """Index of the spread joint's current position, counted from its lowest; the last number is its base."""
    count = len(settings.spread_offsets)
    if trials.turn < 0 or _turns(trials, context, settings) == 0:
        return count
    return trials.turn if trials.k % 2 == 0 else count - 1 - trials.turn


def _turn_to(trials: CalibrationMotion, context: StepContext, settings: TrialSettings, turn: int) -> None:
    """Set the target of the spread joint: its order of positions alternates from stop to stop."""
    trials.turn = turn
    slot = _slot(trials, context, settings)
    if slot < len(settings.spread_offsets):
        spread = settings.spread_joint
        trials.target[spread] = settings.base[spread] + settings.spread_offsets[slot]


def _turn_done(
    trials: CalibrationMotion,
    context: StepContext,
    settings: TrialSettings,
    lost: str,
    mean: FloatArray | None = None,
) -> SourceOutput:
    """Continue with the next position of the spread joint; after the last, the stop is done."""
    turns = _turns(trials, context, settings)
    if lost and turns:
        name = context.settings.joint_names[settings.spread_joint]
        context.emit(
            "warning",
            id=trials.id,
            message=f"calibration: position {trials.turn + 1} of joint {name} loses the markers {lost}; left out",
        )
    if trials.turn + 1 < turns:
        _turn_to(trials, context, settings, trials.turn + 1)
        enter(trials, "move", context)
        return rest(context)
    if trials.joint < 0 or (_combining(trials) and not lost):
        return _next(trials, context, settings)
    if _combining(trials):
        return _left_out(trials, context, f"loses the markers {lost}")
    if trials.seen_turns == 0:
        return _back_off(trials, context, settings, lost)
    trials.stops[trials.joint] += 1
    if mean is not None:
        trials.lowest = np.minimum(trials.lowest, mean)
        trials.highest = np.maximum(trials.highest, mean)
    if trials.step == 0.0:
        _plan(trials, context, settings)
    return _next(trials, context, settings)


# -- one joint: its two sides -------------------------------------------------------------------------------


def _next(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> SourceOutput:
    """Choose the next stop: further on this side, the other side, the next joint, or home."""
    while True:
        if _combining(trials):
            if not _set_all_targets(trials, context, settings):
                trials.target = settings.base.copy()
                enter(trials, "finish", context)
            return rest(context)
        if trials.joint >= 0:
            if trials.step == 0.0:  # its range is not known yet
                size = probe_size(context.settings.joint_kinds[trials.joint])
                if _set_target(trials, context, settings, trials.side * size):
                    return rest(context)
                _probe_failed(trials)
                continue
            if _further(trials, context, settings):
                return rest(context)
            if trials.side > 0:
                _other_side(trials, settings)
                continue
            poor = _poor(trials, context, settings)
            if poor is not None:
                return abort(trials, context, poor)
        trials.joint += 1
        if _combining(trials):
            trials.k = 0
        else:
            _begin_joint(trials, context, settings)


def _planned(trials: CalibrationMotion, settings: TrialSettings) -> bool:
    return not np.isfinite(settings.range[trials.joint])


def _begin_joint(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> None:
    """Set the joint's steps, or step 0: a probe determines them."""
    trials.side, trials.k, trials.step, trials.count = 1, 0, 0.0, 0
    _at_base(trials)
    if _planned(trials, settings):
        trials.reach = span(trials.joint, context.settings, settings)
        return
    trials.step = float(2.0 * settings.range[trials.joint] / (settings.stops - 1))
    trials.count = settings.stops // 2


def _at_base(trials: CalibrationMotion) -> None:
    trials.last, trials.last_at = trials.base_pixels.copy(), 0.0
    trials.before, trials.before_at = np.full_like(trials.base_pixels, np.nan), 0.0


def _probe_failed(trials: CalibrationMotion) -> None:
    trials.reach[0 if trials.side > 0 else 1] = 0.0
    if trials.side < 0:
        trials.step, trials.count = NO_STEP, 0
    trials.side = -1


def _plan(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> None:
    """After the probe: set the steps of both sides, the upper one first."""
    trials.reach, steps, counts = plan_sides(
        trials.base_pixels, trials.last, trials.last_at, trials.reach, context.settings, settings
    )
    trials.side, trials.k, trials.count, trials.step = 1, 0, counts[0], max(float(steps[0]), NO_STEP)
    _at_base(trials)


def _other_side(trials: CalibrationMotion, settings: TrialSettings) -> None:
    """The lower side: with the stated steps, or with the stops of the joint that remain after the upper one."""
    trials.side, trials.k = -1, 0
    _at_base(trials)
    if not _planned(trials, settings):
        trials.count = settings.stops - 1 - settings.stops // 2
        return
    left = max(settings.stops - 1 - int(trials.stops[trials.joint]), 2)
    trials.count = left if trials.reach[1] > 0.0 else 0
    trials.step = max(float(trials.reach[1]) / left, NO_STEP)


def _further(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> bool:
    """Start for the next stop of this side, if the markers are expected to be visible there."""
    offset = stop_offset(trials.side, trials.k + 1, trials.count, trials.step)
    if not _planned(trials, settings):
        if trials.k >= trials.count:
            return False
    elif not _promising(trials, context, settings, offset):
        return False
    trials.k += 1
    if _set_target(trials, context, settings, offset):
        return True
    trials.k -= 1
    return False


def _promising(trials: CalibrationMotion, context: StepContext, settings: TrialSettings, offset: float) -> bool:
    """Whether a planned joint continues to ``offset``: the markers remain visible according to the plan or to the last
    two stops.

    The plan's linear extrapolation is corrected during the motion: a side that turns out longer gets more stops.
    """
    if trials.k == 0 or trials.count == 0:
        return trials.count > 0
    most = span(trials.joint, context.settings, settings)[0 if trials.side > 0 else 1]
    crowded = int(trials.stops[trials.joint]) >= MOST_STOPS * settings.stops
    if trials.k >= trials.count and (abs(offset) > most or crowded):
        return False
    ahead = extrapolated(trials.last, trials.last_at, trials.before, trials.before_at, offset)
    return enough_inside(ahead, context.settings, settings)


def _set_target(trials: CalibrationMotion, context: StepContext, settings: TrialSettings, offset: float) -> bool:
    """Start for ``offset`` from the base, unless a limit or a keep-out forbids it."""
    target = settings.base.copy()
    target[trials.joint] += offset
    why = blocked(target, [trials.joint], context)
    if why:
        name = context.settings.joint_names[trials.joint]
        context.emit(
            "warning",
            id=trials.id,
            message=f"calibration: joint {name} does not go to {target[trials.joint]:+.3f} {why}; its stops end there",
        )
        return False
    trials.target = target
    trials.before, trials.before_at = trials.last, trials.last_at
    trials.last, trials.last_at = np.full_like(trials.base_pixels, np.nan), offset
    trials.seen_turns = 0
    trials.turn = -1
    if _turns(trials, context, settings):
        _turn_to(trials, context, settings, 0)
    enter(trials, "move", context)
    return True


def _set_all_targets(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> bool:
    """Start for the next stop of all joints at once; False after the last."""
    everything = list(range(len(trials.stops)))
    low, high = trials.lowest - settings.base, trials.highest - settings.base
    weights = np.maximum(trials.slope_weights, 1e-300)[..., None]
    slopes = np.where(trials.slope_weights[..., None] > 0.0, trials.slope_sums / weights, np.nan)
    while trials.k < settings.together:
        offsets = in_view_at(
            combined_offsets(trials.k, low, high),
            lambda at: enough_inside(
                trials.base_pixels[-1:] + np.nansum(at[:, None, None, None] * slopes, axis=0),
                context.settings,
                settings,
            ),
        )
        trials.k += 1
        if offsets is None:
            why = "(the markers would leave a view)"
        else:
            why = blocked(settings.base + offsets, everything, context, settings.base)
            if not why:
                trials.target, trials.seen_turns, trials.turn = settings.base + offsets, 0, -1
                enter(trials, "move", context)
                return True
        context.emit("warning", id=trials.id, message=f"calibration: stop {trials.k} of all joints left out {why}")
    return False


def _left_out(trials: CalibrationMotion, context: StepContext, why: str) -> SourceOutput:
    """Skip a stop of all joints, and return to the base."""
    context.emit("warning", id=trials.id, message=f"calibration: stop {trials.k} of all joints {why}; left out")
    trials.target = trial_settings(context.settings).base.copy()
    enter(trials, "return", context)
    return rest(context)


def _back_off(trials: CalibrationMotion, context: StepContext, settings: TrialSettings, where: str) -> SourceOutput:
    """Reverse the last step; this side ends there, or continues with smaller steps if it has only started."""
    name = context.settings.joint_names[trials.joint]
    context.emit(
        "warning",
        id=trials.id,
        message=f"calibration: joint {name} loses the markers {where} at {context.q[trials.joint]:+.3f}; backing off",
    )
    trials.target = settings.base.copy()
    if trials.step == 0.0:
        _probe_failed(trials)
    else:
        trials.k -= 1
        trials.target[trials.joint] += stop_offset(trials.side, trials.k, trials.count, trials.step)
        smallest = 2.0 * probe_size(context.settings.joint_kinds[trials.joint])
        if _planned(trials, settings) and trials.k == 0 and trials.step > smallest:
            trials.step *= 0.5
            _at_base(trials)
        else:
            trials.count = 0
    enter(trials, "return", context)
    return rest(context)


def _poor(trials: CalibrationMotion, context: StepContext, settings: TrialSettings) -> Reason | None:
    j = trials.joint
    visited = float(trials.highest[j] - trials.lowest[j])
    return too_little(
        j,
        int(trials.stops[j]) + 1,
        visited,
        float(trials.motion_sigmas[j]),
        trials.sigma_px,
        context.settings,
        settings,
    )


# -- where the stops are ------------------------------------------------------------------------------------------

GOLDEN = 0.6180339887498949
UNEVEN_STEP = 0.5
"""Largest fraction of a step by which the stops of a single joint are moved towards the base."""
SHARE, UNEVEN = 0.8, 0.5
"""Largest offset of a joint from the centre of its range, as a fraction of half the range in which it was driven; and
the fraction of this offset by which stops differ, so that a gear's ripple does not repeat and errors that grow with the
range become visible.
"""
ORDER = 16
"""Order of the Hadamard matrix whose signs give the sides to which joints are offset: its columns after the first, of
ones, are as many as the joints of the largest cell.
"""
SHRUNK = (1.0, 0.75, 0.5)
"""Factors on the offsets of a stop, tried one after the other until the markers remain in view."""


def stop_offset(side: int, k: int, count: int, step: float) -> float:
    """Offset from the base [rad or m] of stop ``k`` of ``count`` on a ``side``, 1 or -1; at its end, ``count`` steps.

    Stops before the end are moved towards the base by up to half a step, by multiples of the golden ratio: with equal
    distances, ripple of a gear whose period divides the distance would be invisible.
    """
    if k == 0 or k == count:
        return side * k * step
    return side * step * (k - UNEVEN_STEP * ((k * GOLDEN + 0.25 * (1 - side)) % 1.0))


def combined_offsets(k: int, low: FloatArray, high: FloatArray) -> FloatArray:
    """Offsets (n,) from the base of stop ``k`` of all joints. ``low``, ``high`` (n,): the range in which each was
    driven alone.

    Signs are those of the columns of a Hadamard matrix: within ``ORDER`` stops every pair of joints is offset equally
    often to each combination of sides.
    """
    joint = np.arange(len(low))
    signs = np.array([1.0 - 2.0 * (((k % ORDER) & (1 + j)).bit_count() % 2) for j in joint.tolist()])
    shares = SHARE * (1.0 - UNEVEN * ((GOLDEN * (k + 1) * (joint + 1)) % 1.0))
    return np.asarray(0.5 * (low + high) + signs * shares * 0.5 * (high - low))


def in_view_at(offsets: FloatArray, in_view: Callable[[FloatArray], bool]) -> FloatArray | None:
    """``offsets`` (n,) multiplied by the largest factor of `SHRUNK` that ``in_view`` allows; None if it allows none."""
    for share in SHRUNK:
        if in_view(share * offsets):
            return share * offsets
    return None


MIN_STOPS = 4  # of one joint, including the base
MIN_MOTION_SIGMAS = 40.0
"""Motion in the images [sigmas] below which a joint's axis is lost in the noise of its stops."""
PROBE: dict[JointKindName, float] = {"revolute": 0.02, "prismatic": 0.005}  # [rad, m]
BORDER = 0.03
"""Margin to the border of a view, as a fraction of its width."""
BRAKING = 0.6
"""Fraction of the acceleration limit with which a sweep that must end is braked."""
KEPT = 0.75
"""Fraction of the markers seen at the base that must remain inside; never fewer than ``min_markers``."""


def probe_size(kind: JointKindName) -> float:
    """Offset of the first small motion of a joint [rad or m]."""
    return PROBE[kind]


def span(joint: int, core: CoreSettings, settings: TrialSettings) -> FloatArray:
    """Range (2,) of a joint upwards and downwards from its base: its limits, and a reasonable largest range."""
    limits = core.limits
    margin = limits.position_margin + 4.0 * core.arrival[joint]
    base = settings.base[joint]
    up = limits.position_max[joint] - margin - base
    down = base - limits.position_min[joint] - margin
    largest = LARGEST_RANGE[core.joint_kinds[joint]]
    return np.array([min(max(float(up), 0.0), largest), min(max(float(down), 0.0), largest)])


def marker_pixels(samples: tuple[Sample, ...], core: CoreSettings) -> tuple[FloatArray, FloatArray]:
    """Pixels (c, m, 2) and sigmas (c, m) [px] of a stop in the cell's order, NaN where a marker was not seen."""
    row = {camera.name: c for c, camera in enumerate(core.cameras)}
    pixels = np.full((len(row), len(core.marker_ids), 2), np.nan)
    sigmas = np.full(pixels.shape[:2], np.nan)
    for sample in samples:
        c, seen = row[sample.camera], marker_rows(core, sample.ids)
        pixels[c, seen] = sample.pixels
        sigmas[c, seen] = np.sqrt(0.5 * (sample.covariances[:, 0, 0] + sample.covariances[:, 1, 1]))
    return pixels, sigmas


def image_motion(base: FloatArray, pixels: FloatArray, sigmas: FloatArray) -> float:
    """Mean distance of the markers from their pixels at the base, in sigmas, in the camera with the largest distance.

    ``base``, ``pixels`` (c, m, 2), ``sigmas`` (c, m) [px].
    """
    distance = np.sqrt(((pixels - base) ** 2).sum(axis=-1)) / sigmas
    best = 0.0
    for row in distance:
        seen = row[np.isfinite(row)]
        if seen.size:
            best = max(best, float(seen.sum()) / seen.size)
    return best


def _needed(seen: IntArray | int, settings: TrialSettings) -> IntArray:
    return np.maximum(settings.min_markers, np.ceil(KEPT * np.asarray(seen))).astype(np.int64)


def enough_inside(pixels: FloatArray, core: CoreSettings, settings: TrialSettings) -> bool:
    """Whether enough of the markers (p, c, m, 2) are inside every view by a margin; NaN: not seen, not counted."""
    return bool(inside_by_margin(pixels, core, settings).all())


def inside_by_margin(pixels: FloatArray, core: CoreSettings, settings: TrialSettings) -> BoolArray:
    """For which of the positions (p,) enough of the markers (p, c, m, 2) are inside every view by a margin."""
    enough = np.ones(len(pixels), dtype=bool)
    for c, camera in enumerate(core.cameras):
        known = np.isfinite(pixels[:, c]).all(axis=-1)
        kept = (_inside(pixels[:, c], camera.width, camera.height) & known).sum(axis=-1)
        seen = known.sum(axis=-1)
        enough &= (seen == 0) | (kept >= _needed(seen, settings))
    return enough


def _inside(pixels: FloatArray, width: int, height: int) -> npt.NDArray[np.bool_]:
    margin = BORDER * width
    top = np.array([width, height]) - 1.0 - margin
    inside = (pixels >= margin) & (pixels <= top)
    return np.asarray(inside.all(axis=-1))


def extrapolated(last: FloatArray, last_at: float, before: FloatArray, before_at: float, at: float) -> FloatArray:
    """Pixels (p, c, m, 2) at offset ``at`` on the straight line through those of two stops."""
    found: FloatArray = last + (last - before) * ((at - last_at) / (last_at - before_at))
    return found


def plan_sides(
    base: FloatArray, probe: FloatArray, offset: float, reach: FloatArray, core: CoreSettings, settings: TrialSettings
) -> tuple[FloatArray, FloatArray, tuple[int, int]]:
    """Plan both sides from a probe's pixels (p, c, m, 2) at ``offset``; returns the ranges (2,) up and down, steps
    (2,), and numbers of stops.

    By linear extrapolation through base and probe, the range ends where too few markers would be left in some view. It
    is never larger than the given ``reach`` (2,).
    """
    rates = (probe - base) / offset
    found = np.array(
        [
            min(
                [float(reach[i])]
                + [
                    _travel_to_border(base[p, c], sign * rates[p, c], camera.width, camera.height, settings)
                    for p in np.flatnonzero(np.isfinite(probe - base).any(axis=(1, 2, 3)))
                    for c, camera in enumerate(core.cameras)
                ]
            )
            for i, sign in enumerate((1.0, -1.0))
        ]
    )
    found[found < 2.0 * abs(offset)] = 0.0
    total = settings.stops - 1
    if found.sum() == 0.0:
        return found, np.zeros(2), (0, 0)
    up = int(np.clip(round(total * found[0] / found.sum()), 1, total - 1)) if found.all() else 0
    counts = (up, total - up) if found.all() else ((total, 0) if found[0] > 0.0 else (0, total))
    steps = np.array([r / count if count else 0.0 for r, count in zip(found, counts, strict=True)])
    return found, steps, counts


def _travel_to_border(pixels: FloatArray, rates: FloatArray, width: int, height: int, settings: TrialSettings) -> float:
    """Joint offset at which too few markers (m, 2), moving at ``rates`` (m, 2) [px a unit], are left inside."""
    margin = BORDER * width
    low, high = np.full(2, margin), np.array([width, height]) - 1.0 - margin
    travels = []
    for pixel, rate in zip(pixels, rates, strict=True):
        if not (np.isfinite(pixel).all() and np.isfinite(rate).all()):
            continue
        travel = np.inf
        for x, v, a, b in zip(pixel, rate, low, high, strict=True):
            if v != 0.0:
                travel = min(travel, max(0.0, ((b if v > 0.0 else a) - x) / v))
        travels.append(travel)
    if not travels:
        return 0.0
    travels.sort(reverse=True)
    return float(travels[min(int(_needed(len(travels), settings)), len(travels)) - 1])


def too_little(
    joint: int,
    stops: int | None,
    visited: float,
    motion: float,
    sigma_px: float,
    core: CoreSettings,
    settings: TrialSettings,
) -> Reason | None:
    """Why a joint's trial cannot identify it, and the remedy: too few stops, too small a range, or too little motion in
    the images (``motion`` in sigmas of ``sigma_px``); None if it can. ``stops``: None for a sweep.
    """
    name = core.joint_names[joint]
    stated = np.isfinite(settings.range[joint])
    wider = (
        f"raise calibration.range.{name}"
        if stated
        else "put the base where this joint has more range before the border of a view or its limit"
    )
    at_stops, least_stops = ("", "") if stops is None else (f"at {stops} stops ", f"{MIN_STOPS} stops over ")
    if (stops is not None and stops < MIN_STOPS) or visited < settings.min_range:
        return Reason(
            "TRIAL_TOO_SMALL",
            "hold",
            name,
            visited,
            settings.min_range,
            "rad or m",
            f"joint {name} was seen {at_stops}over {visited:.3f}; at least {least_stops}{settings.min_range} are "
            f"needed: change calibration.base so that the markers stay in view, or {wider}",
        )
    if motion < MIN_MOTION_SIGMAS:
        more = MIN_MOTION_SIGMAS / max(motion, 0.1)
        return Reason(
            "TRIAL_TOO_SMALL",
            "hold",
            name,
            motion,
            MIN_MOTION_SIGMAS,
            "sigmas",
            f"joint {name} moved the markers by {motion:.1f} sigmas of {sigma_px:.3g} px over {visited:.3f}; at least "
            f"{MIN_MOTION_SIGMAS:g} are needed to see its axis: {wider} ({more:.1f} times as much), put the markers "
            "farther from its axis, or lower the noise (light, larger dots, calibration.frames)",
        )
    return None
