"""Motion source of calibration by sweeps: joints move without stopping while the cameras run.

From the base each joint sweeps outwards alone and back, then all joints sweep at once between combinations of offsets.
An outward sweep ends at its planned offset, or where the markers are about to leave a view; the joint then sweeps to
the other side as well. Frames and joint samples are recorded as they come and sent in events `calibration_frames`;
`calibration.sweeps` reduces them to means. Only at the base the arm rests, to see that the markers are in view.

Frames of a moving arm are worth as much as their stamps: where errors of single stamps displace the markers as much as
noise does, the programme with stops begins instead.
"""

from __future__ import annotations

import numpy as np

from stereoservo.calibration.sweeps import smoothed_readings, stamp_scatter
from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.cycle import PathFrame
from stereoservo.core.rest_averages import marker_rows
from stereoservo.core.settings import LARGEST_RANGE, CoreSettings, TrialSettings
from stereoservo.core.sources.calibration import (
    BRAKING,
    driven_path,
    enough_inside,
    finish,
    image_motion,
    inside_by_margin,
    marker_pixels,
    record_joints,
    span,
    start_trials,
    too_little,
)
from stereoservo.core.sources.joint_move import approach_velocity, arrived, joints_ahead
from stereoservo.core.sources.measure_at_pose import (
    AT_REST,
    abort,
    at_target,
    blocked,
    collect_samples,
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
from stereoservo.core.state import SweepMotion
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo.ports.devices import CameraObservation

ALONE, ENOUGH_SIGMAS = 0.5, 200.0
"""Offset, as a fraction of its range, and motion in the images [sigmas] with which a joint's sweep alone ends."""
CORNERS = 5
"""Most combinations of offsets between which all joints sweep at once."""
CANDIDATES = 128
"""Number of combinations from which the next one is chosen."""
NEW = 3.0
"""Weight of the range that a joint has not visited yet, against the length of its sweep, in that choice."""
FRAMES_OF_SWEEP = 16
"""Least number of frames of the slowest camera on one sweep; shorter sweeps are slower."""
SLOWEST = 0.05
"""Least speed of a sweep, as a fraction of that of trial motions."""
PASSED = 0.05
"""Fraction of a sweep's length from its end at which the next one begins."""
LATE_S = 0.3
"""How long frames are awaited at the end of the last sweep."""
MOST_SCATTER = 0.25
"""Mean square displacement of all markers of a frame by errors of its stamp, as a fraction of the variance of a pixel
coordinate, above which the arm stops for its measurements: half a sigma.
"""
FEWEST_FRAMES_JUDGED, CLEARLY = 20, 8.0
"""Number of frames of a camera from which it is judged, and the standard deviations by which it then exceeds that."""
CHUNK = 2000
"""Number of marker observations from which an event is sent before its sweep ends."""


def start_sweeps(goal_id: str, q: FloatArray, now_ns: int, settings: CoreSettings) -> SweepMotion:
    """The programme before its first move, to the base."""
    trials = trial_settings(settings)
    n = q.size
    unseen = np.full((len(settings.cameras), len(settings.marker_ids), 2), np.nan)
    return SweepMotion(
        id=goal_id, lease_s=None, lease_until_ns=0, joint=-1, side=1, outward=False, corner=0, leg=-1, trial=-1,
        base_pixels=unseen, last=unseen.copy(), last_ns=np.zeros(len(settings.cameras), np.int64),
        rates=np.zeros_like(unseen), lowest=trials.base.copy(), highest=trials.base.copy(),
        motion_sigmas=np.zeros(n), sigma_px=0.0, slope_sums=np.zeros((n, *unseen.shape)),
        slope_weights=np.zeros((n, *unseen.shape[:2])), stamp_sums=np.zeros((len(settings.cameras), 2)),
        **first_visit(trials.base, q, now_ns, settings),  # type: ignore[arg-type]
    )  # fmt: skip


def sweeps_step(sweeps: SweepMotion, context: StepContext) -> SourceOutput:
    """One step of the programme."""
    settings = trial_settings(context.settings)
    if sweeps.phase in ("settle", "collect"):
        samples = collect_samples(sweeps, context, settings)
        if samples is None:
            return rest(context)
        poorest = too_few_seen(samples, settings, context.settings.scene_ids)
        if poorest is not None:
            return abort(sweeps, context, unseen_at_base(poorest, settings, context.settings.scene_ids))
        context.emit("calibration_sample", id=sweeps.id, joints=mean_joints(sweeps), samples=samples, progress=0.0)
        sweeps.base_pixels, sigmas = marker_pixels(samples, context.settings)
        sweeps.sigma_px = float(np.median(sigmas[np.isfinite(sigmas)]))
        return _next(sweeps, context, settings)
    if sweeps.leg >= 0:
        _record(sweeps, context)
    if sweeps.phase == "finish" and at_target(sweeps, context):
        return _end(sweeps, context)
    reason = too_slow(sweeps, context, settings)
    if reason is not None:
        return abort(sweeps, context, reason)
    if sweeps.phase == "move" and at_target(sweeps, context):
        enter(sweeps, "settle", context)
        return rest(context)
    if sweeps.phase == "sweep":
        lost = sweeps.outward and markers_lost(sweeps, context, settings)
        if lost or (sweeps.outward and _leaving(sweeps, context, settings)):
            _warn_of_end(sweeps, context, lost)
            return _next(sweeps, context, settings)
        if _passed(sweeps, context) or (sweeps.outward and _enough(sweeps, context, settings)):
            return _next(sweeps, context, settings)
    return _approach(sweeps, context, settings)


def _approach(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> SourceOutput:
    """The velocity towards the target, so slow that the slowest camera takes `FRAMES_OF_SWEEP` frames."""
    limits, scale = context.settings.limits, settings.speed_scale
    if sweeps.phase == "sweep":
        full_s = float((np.abs(sweeps.target - sweeps.start) / (limits.velocity_max * limits.speed_scale)).max())
        full_s *= ALONE if sweeps.trial >= 0 and sweeps.outward else 1.0
        slowest_hz = min(camera.rate_hz for camera in context.settings.cameras)
        scale = min(scale, max(full_s * slowest_hz / FRAMES_OF_SWEEP, SLOWEST * scale))
    velocity = approach_velocity(joints_ahead(context), sweeps.target, context.settings, scale)
    return SourceOutput(velocity, speed_scale=scale)


def _passed(sweeps: SweepMotion, context: StepContext) -> bool:
    """Whether every joint is at the end of its sweep, or near it where it need not be the base."""
    if not sweeps.outward:
        return arrived(context.q, sweeps.target, context.settings)
    near = np.maximum(PASSED * np.abs(sweeps.target - sweeps.start), context.settings.arrival)
    return bool((np.abs(sweeps.target - context.q) <= near).all())


def _enough(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> bool:
    """Whether a joint that sweeps alone has moved the markers enough."""
    joint = sweeps.joint
    if joint == sweeps.lowest.size or sweeps.motion_sigmas[joint] < ENOUGH_SIGMAS:
        return False
    offset = abs(float(context.q[joint] - settings.base[joint]))
    return offset >= max(ALONE * _range(joint, context, settings), 1.5 * settings.min_range)


def _end(sweeps: SweepMotion, context: StepContext) -> SourceOutput:
    """Wait at the base for frames that are under way, and end."""
    if not sweeps.arrived_ns:
        sweeps.arrived_ns = context.now_ns
    if (context.now_ns - sweeps.arrived_ns) * 1e-9 < LATE_S:
        return rest(context)
    _send(sweeps, context)
    return finish(sweeps, context)


# -- what is recorded -----------------------------------------------------------------------------------------


def _record(sweeps: SweepMotion, context: StepContext) -> None:
    """Record the frames and joint samples of this step, and how the markers move."""
    for camera, observation in context.ingested.observations:
        frame = path_frame(camera, observation)
        sweeps.path_frames.append(frame)
        _track(sweeps, context, frame)
    record_joints(sweeps, context)
    if context.ingested.observations and sum(frame.ids.size for frame in sweeps.path_frames) >= CHUNK:
        _send(sweeps, context)


def path_frame(camera: int, observation: CameraObservation) -> PathFrame:
    """A frame of a sweep, with a copy of its pixels."""
    return PathFrame(
        camera,
        observation.t_shutter_ns,
        np.array(observation.ids, dtype=np.int64),
        np.array(observation.pixels),
        0.5 * np.trace(observation.covariances, axis1=1, axis2=2),
    )


def _track(sweeps: SweepMotion, context: StepContext, frame: PathFrame) -> None:
    """Update the rates of a camera's markers, and, while a joint moves alone, its effect on them."""
    camera, rows = frame.camera, marker_rows(context.settings, frame.ids)
    pixels = np.full(sweeps.last[camera].shape, np.nan)
    pixels[rows[rows >= 0]] = frame.pixels[rows >= 0]
    elapsed_s = (frame.t_ns - int(sweeps.last_ns[camera])) * 1e-9
    if 0.0 < elapsed_s < 1.0:
        sweeps.rates[camera] = (pixels - sweeps.last[camera]) / elapsed_s
    sweeps.last[camera], sweeps.last_ns[camera] = pixels, frame.t_ns
    sweeps.lowest, sweeps.highest = np.minimum(sweeps.lowest, context.q), np.maximum(sweeps.highest, context.q)
    joint = sweeps.joint
    if joint == sweeps.lowest.size:
        return
    offset = float(context.q[joint] - trial_settings(context.settings).base[joint])
    shift = pixels - sweeps.base_pixels[camera]
    known = np.isfinite(shift).all(axis=-1)
    sweeps.slope_sums[joint, camera, known] += offset * shift[known]
    sweeps.slope_weights[joint, camera, known] += offset**2
    sigmas = np.full((1, len(pixels)), sweeps.sigma_px)
    moved = image_motion(sweeps.base_pixels[camera][None], pixels[None], sigmas)
    sweeps.motion_sigmas[joint] = max(sweeps.motion_sigmas[joint], moved)


def _send(sweeps: SweepMotion, context: StepContext) -> None:
    """Send what was recorded, in an event; recording goes on."""
    n = sweeps.lowest.size
    joint = n if sweeps.trial < 0 else sweeps.trial
    done = (joint + (sweeps.corner / (CORNERS + 1.0) if joint == n else 0.0)) / (n + 1.0)
    if sweeps.path_ns:
        context.emit(
            "calibration_frames",
            id=sweeps.id,
            trial=sweeps.trial,
            progress=min(1.0, done),
            path=driven_path(sweeps, sweeps.leg),
        )


def _judge_stamps(sweeps: SweepMotion, context: StepContext) -> None:
    """Add the scatter of the cameras' stamps on this sweep to its sums."""
    start_ns, joint = sweeps.path_ns[0], sweeps.joint
    times, readings = 1e-9 * (np.array(sweeps.path_ns) - start_ns), np.array(sweeps.path_joints)[:, [joint]]
    resolution = np.array([context.settings.resolution[joint] if context.settings.resolution else 0.0])
    times, readings = smoothed_readings(times, readings, resolution)
    for camera in range(len(sweeps.stamp_sums)):
        frames = sorted((f for f in sweeps.path_frames if f.camera == camera), key=lambda frame: frame.t_ns)
        pixels = np.full((len(frames), *sweeps.last.shape[1:]), np.nan)
        for k, frame in enumerate(frames):
            rows = marker_rows(context.settings, frame.ids)
            pixels[k, rows[rows >= 0]] = frame.pixels[rows >= 0]
        stamps = np.array([1e-9 * (frame.t_ns - start_ns) for frame in frames])
        scatter, count = stamp_scatter(stamps, pixels, times, readings[:, 0], float(resolution[0]))
        sweeps.stamp_sums[camera] += count * scatter, count


def _scattered(sums: FloatArray, markers: int) -> BoolArray:
    """Mask (c,) of the cameras whose stamps scatter by more than sweeps permit, from their ``sums`` (c, 2)."""
    scatter, counts = sums[:, 0] / np.maximum(sums[:, 1], 1.0), sums[:, 1]
    # The excess of a chi-square's median over n frames deviates by 1.66 √(2 / n); markers share one displacement.
    limit = MOST_SCATTER + CLEARLY * 1.66 * np.sqrt(2.0 / np.maximum(counts, 1.0)) / markers
    return np.asarray((counts >= FEWEST_FRAMES_JUDGED) & (scatter > limit))


def _stop_instead(sweeps: SweepMotion, context: StepContext, camera: int) -> SourceOutput:
    """Begin the programme with stops."""
    scatter = float(np.sqrt(sweeps.stamp_sums[camera, 0] / sweeps.stamp_sums[camera, 1]))
    name = context.settings.cameras[camera].name
    message = (
        f"calibration: in motion the stamps of camera {name} displace the markers of a frame by {scatter:.1f} times "
        f"the noise of a pixel (limit {np.sqrt(MOST_SCATTER):.1f}); the arm stops for measurements instead"
    )
    context.emit("warning", id=sweeps.id, message=message)
    trials = start_trials(sweeps.id, context.q, context.now_ns, context.settings)
    trials.lease_s, trials.lease_until_ns = sweeps.lease_s, sweeps.lease_until_ns
    context.state.source = trials
    return rest(context)


# -- where the joints sweep -----------------------------------------------------------------------------------


def _leaving(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> bool:
    """Whether the markers will leave a view before the joints have braked."""
    if not context.observations:
        return False
    limits = context.settings.limits
    turn_s = float((limits.velocity_max * limits.speed_scale / (BRAKING * limits.acceleration_max)).max())
    speed = np.abs(context.state.block.command)
    fastest = int(speed.argmax())
    if speed[fastest] < AT_REST or (sweeps.last_ns - sweeps.phase_ns).min() * 1e-9 < settings.speed_scale * turn_s:
        return False  # at rest, or the images are still of the sweep before
    to_go_s = float(np.abs(sweeps.target - context.q)[fastest] / speed[fastest])
    brake_s = float((speed / (BRAKING * limits.acceleration_max)).max())
    ages_s = np.minimum((context.now_ns - sweeps.last_ns) * 1e-9 + 0.5 * brake_s, to_go_s)
    ahead = sweeps.last + sweeps.rates * ages_s[:, None, None]
    return not enough_inside(ahead[None], context.settings, settings)


def _warn_of_end(sweeps: SweepMotion, context: StepContext, lost: bool) -> None:
    """Warn that a sweep ends before its target: of all joints, or because the markers are ``lost``."""
    message = ""
    if sweeps.joint == sweeps.lowest.size:
        message = f"calibration: sweep {sweeps.corner} of all joints would lose the markers; ended there"
    elif lost:
        name, at = context.settings.joint_names[sweeps.joint], context.q[sweeps.joint]
        message = f"calibration: joint {name} loses the markers in motion at {at:+.3f}; backing off"
    if message:
        context.emit("warning", id=sweeps.id, message=message)


def _begin(sweeps: SweepMotion, context: StepContext, target: FloatArray, *, outward: bool) -> SourceOutput:
    """Start a sweep to ``target`` (n,)."""
    if sweeps.leg >= 0:
        _send(sweeps, context)
    sweeps.leg += 1
    sweeps.trial = sweeps.joint if sweeps.joint < sweeps.lowest.size else -1
    sweeps.target, sweeps.outward = target, outward
    enter(sweeps, "sweep", context)
    return _approach(sweeps, context, trial_settings(context.settings))


def _range(joint: int, context: StepContext, settings: TrialSettings) -> float:
    """Largest offset of a joint from its base [rad or m]: as stated, else a reasonable one."""
    stated = settings.range[joint]
    return float(stated if np.isfinite(stated) else LARGEST_RANGE[context.settings.joint_kinds[joint]])


def _next(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> SourceOutput:
    """Start the next sweep: back to the base, to the joint's other side, of the next joint, of all joints, or home."""
    n = sweeps.lowest.size
    if sweeps.leg >= 0 and sweeps.joint < n:
        _judge_stamps(sweeps, context)
        scattered = _scattered(sweeps.stamp_sums, len(context.settings.marker_ids))
        if scattered.any():
            return _stop_instead(sweeps, context, int(scattered.argmax()))
    if sweeps.outward and sweeps.joint < n:
        return _begin(sweeps, context, settings.base.copy(), outward=False)
    while sweeps.joint < n:
        if sweeps.joint >= 0:
            if sweeps.side > 0 and _one_side_is_little(sweeps, context, settings):
                sweeps.side = -1
                target = _alone(sweeps, context, settings)
                if target is not None:
                    return _begin(sweeps, context, target, outward=True)
            poor = _poor(sweeps, context, settings)
            if poor is not None:
                return abort(sweeps, context, poor)
        sweeps.joint += 1
        sweeps.side = 1
        if sweeps.joint < n:
            target = _alone(sweeps, context, settings)
            if target is not None:
                return _begin(sweeps, context, target, outward=True)
    target = _combined(sweeps, context, settings)
    if target is not None:
        return _begin(sweeps, context, target, outward=True)
    output = _begin(sweeps, context, settings.base.copy(), outward=False)
    enter(sweeps, "finish", context)
    return output


def _one_side_is_little(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> bool:
    """Whether a joint shall sweep to its lower side as well: the upper one was short, or hardly moved the markers."""
    joint = sweeps.joint
    reached = float(sweeps.highest[joint] - settings.base[joint])
    short = reached < (ALONE - PASSED) * _range(joint, context, settings)
    return short or bool(sweeps.motion_sigmas[joint] < ENOUGH_SIGMAS)


def _alone(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> FloatArray | None:
    """Target (n,) of a joint's outward sweep; None if limits or keep-outs leave no range."""
    joint = sweeps.joint
    offset = min(
        _range(joint, context, settings),
        float(span(joint, context.settings, settings)[0 if sweeps.side > 0 else 1]),
    )
    target = settings.base.copy()
    target[joint] += sweeps.side * offset
    why = blocked(target, [joint], context)
    if why:
        name = context.settings.joint_names[joint]
        message = f"calibration: joint {name} does not go to {target[joint]:+.3f} {why}"
        context.emit("warning", id=sweeps.id, message=message)
    return target if offset > 0.0 and not why else None


def _combined(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> FloatArray | None:
    """Target (n,) of the next sweep of all joints: of many combinations of offsets whose markers are predicted in view,
    the one to which joints sweep farthest, most of it where they have not been; None after the last.
    """
    sweeps.corner += 1
    if sweeps.corner > min(settings.together, CORNERS):
        return None
    everything = list(range(sweeps.lowest.size))
    offsets = _candidates(sweeps, context, settings)
    ranges = np.array([_range(joint, context, settings) for joint in everything])
    here = context.q - settings.base
    far = np.abs(offsets - here) / ranges
    new = np.maximum(offsets - (sweeps.highest - settings.base), (sweeps.lowest - settings.base) - offsets) / ranges
    gains = (far + NEW * np.maximum(new, 0.0)).sum(axis=1)
    weights = sweeps.slope_weights[..., None]
    slopes = np.where(weights > 0.0, sweeps.slope_sums / np.maximum(weights, 1e-300), 0.0)
    ahead = sweeps.base_pixels + np.einsum("kj,jcmx->kcmx", offsets, slopes)
    gains[~inside_by_margin(ahead, context.settings, settings)] = -1.0
    for k in np.argsort(-gains).tolist():
        target = settings.base + offsets[k]
        if gains[k] >= 0.0 and not blocked(target, everything, context, settings.base):
            return np.asarray(target)
    message = f"calibration: sweep {sweeps.corner} of all joints left out (the markers would leave a view, or a limit)"
    context.emit("warning", id=sweeps.id, message=message)
    return None


def _candidates(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> FloatArray:
    """Random combinations (k, n) of offsets from the base within limits, more of them near the ends of the ranges."""
    n = sweeps.lowest.size
    reach = np.array([np.minimum(span(j, context.settings, settings), _range(j, context, settings)) for j in range(n)])
    drawn = np.random.default_rng([sweeps.corner, n]).uniform(-1.0, 1.0, (CANDIDATES, n))
    shares = np.sin(0.5 * np.pi * drawn)
    return np.asarray(np.where(shares > 0.0, shares * reach[:, 0], shares * reach[:, 1]))


def _poor(sweeps: SweepMotion, context: StepContext, settings: TrialSettings) -> Reason | None:
    joint = sweeps.joint
    visited = float(sweeps.highest[joint] - sweeps.lowest[joint])
    motion = float(sweeps.motion_sigmas[joint])
    return too_little(joint, None, visited, motion, sweeps.sigma_px, context.settings, settings)
