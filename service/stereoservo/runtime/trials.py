"""The calibration programme as a motion source: each joint alone, stop after stop.

From the base, joint l goes in equal steps to one side, then to the other (thesis 5.4.1, fig. 5.13); equal steps let all
pairs of neighbouring stops determine one homography. At a stop the pixels are averaged at rest. A step that loses the
markers is taken back and that side is closed.
"""

from __future__ import annotations

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.averaging import add_observation, averages
from stereoservo.runtime.estimate import joints_at
from stereoservo.runtime.motion import ARRIVED, Motion, Present, arrived, measurement_buffers, towards
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.settings import CoreSettings, TrialSettings
from stereoservo.runtime.state import Trials

MIN_STOPS = 4  # of one joint, the base among them
FIRST_FRAME_S = 120.0  # a camera that has never delivered may still be starting
LOST_S = 0.4  # markers missing for so long in motion: back off


def start_trials(goal_id: str, q: FloatArray, now_ns: int, settings: CoreSettings) -> Trials:
    """The programme before its first move: to the base."""
    trials = settings.trials
    if trials is None:
        raise ValueError("the cell has no [calibration] section")
    n = q.size
    return Trials(
        id=goal_id, joint=-1, side=1, k=0, phase="move", target=trials.base.copy(), phase_ns=now_ns, start=q.copy(),
        joint_sum=np.zeros(n), lowest=trials.base.copy(), highest=trials.base.copy(),
        stops=np.zeros(n, np.int64), **measurement_buffers(settings),
    )  # fmt: skip


def step_size(trials: TrialSettings, joint: int) -> float:
    """Distance between neighbouring stops of a joint [rad or m]."""
    return float(2.0 * trials.range[joint] / (trials.stops - 1))


def sides(trials: TrialSettings) -> tuple[int, int]:
    """Number of stops above and below the base."""
    up = trials.stops // 2
    return up, trials.stops - 1 - up


def trials_step(trials: Trials, present: Present) -> Motion:
    """One step of the programme."""
    settings = present.settings.trials
    if settings is None:
        raise ValueError("the cell has no [calibration] section")
    zero = np.zeros_like(present.q)
    if trials.phase in ("move", "return", "finish"):
        return _move(trials, present, settings)
    if trials.phase == "settle":
        if (present.now_ns - trials.phase_ns) * 1e-9 >= settings.settle_s:
            _enter(trials, "collect", present)
        return Motion(zero)
    for observation in present.observations:
        at_shutter = joints_at(present.state.history, observation.t_shutter_ns)
        if at_shutter is None:
            continue
        if add_observation(trials, present.settings, observation, settings.frames, trials.phase_ns):
            trials.joint_sum += at_shutter
            trials.joint_frames += 1
    waited_s = (present.now_ns - trials.phase_ns) * 1e-9
    silent = min(estimate.last_seq for estimate in present.state.cameras) < 0
    limit_s = max(settings.wait_s, FIRST_FRAME_S) if silent else settings.wait_s
    if bool((trials.frames >= settings.frames).all()) or waited_s > limit_s:
        return _stop_done(trials, present, settings)
    return Motion(zero)


def _enter(trials: Trials, phase: str, present: Present) -> None:
    trials.phase = phase  # type: ignore[assignment]
    trials.phase_ns = present.now_ns
    trials.start = present.q.copy()
    trials.lost_ns = 0
    if phase == "collect":
        for name, value in measurement_buffers(present.settings).items():
            setattr(trials, name, value)
        trials.joint_sum = np.zeros_like(present.q)
        trials.joint_frames = 0


def _move(trials: Trials, present: Present, settings: TrialSettings) -> Motion:
    if arrived(present.q, trials.target) and bool((np.abs(present.state.command) < 0.01).all()):
        if trials.phase == "finish":
            present.emit("calibration_finished", id=trials.id, message="trial motions done", progress=1.0)
            return Motion(np.zeros_like(present.q), finished=True)
        if trials.phase == "return":
            trials.phase = "move"
            return _next(trials, present, settings)
        _enter(trials, "settle", present)
        return Motion(np.zeros_like(present.q))
    fault = _too_slow(trials, present)
    if fault is not None:
        return _abort(trials, present, fault)
    if trials.phase == "move" and trials.joint >= 0 and _markers_lost(trials, present, settings):
        return _back_off(trials, present, settings, "in motion")
    velocity = towards(present.q, trials.target, present.settings, settings.speed_scale)
    return Motion(velocity, speed_scale=settings.speed_scale)


def _too_slow(trials: Trials, present: Present) -> Reason | None:
    """The stop is not reached in three times the time it takes."""
    elapsed_s = (present.now_ns - trials.phase_ns) * 1e-9
    trial = present.settings.trials
    speed = present.settings.limits.velocity_max * present.settings.limits.speed_scale
    scale = trial.speed_scale if trial is not None else 1.0
    limit_s = 5.0 + 3.0 * float((np.abs(trials.target - trials.start) / (speed * scale)).max())
    if elapsed_s > limit_s:
        joint = int(np.abs(trials.target - present.q).argmax())
        name = present.settings.joint_names[joint]
        return Reason(
            "STOP_NOT_REACHED", "hold", name, float(present.q[joint]), float(trials.target[joint]), "rad or m",
            f"joint {name} did not reach its stop within {limit_s:.0f} s (tolerance {ARRIVED}): a limit, a keep-out, "
            "or a blocked joint",
        )  # fmt: skip
    return None


def _counts_now(present: Present) -> dict[str, int]:
    return {observation.camera: int(observation.ids.size) for observation in present.observations}


def _markers_lost(trials: Trials, present: Present, settings: TrialSettings) -> bool:
    """Some camera has seen too few markers for ``LOST_S``."""
    for count in _counts_now(present).values():
        if count < settings.min_markers:
            trials.lost_ns = trials.lost_ns or present.now_ns
            return (present.now_ns - trials.lost_ns) * 1e-9 > LOST_S
    if present.observations:
        trials.lost_ns = 0
    return False


def _stop_done(trials: Trials, present: Present, settings: TrialSettings) -> Motion:
    samples = averages(trials, present.settings)
    poorest = min(samples, key=lambda sample: sample.ids.size)
    if poorest.ids.size < settings.min_markers or poorest.frames < max(1, settings.frames // 2):
        if trials.k == 0 and poorest.frames == 0:
            hint = f"camera {poorest.camera} delivers no frames: is it connected? See the daemon's log"
            reason = Reason(
                "CAMERA_SILENT", "hold", poorest.camera, 0.0, float(settings.frames), "frames", hint
            )
            return _abort(trials, present, reason)
        if trials.k == 0:
            return _abort(
                trials, present,
                Reason(
                    "MARKERS_NOT_SEEN", "hold", poorest.camera, float(poorest.ids.size), float(settings.min_markers),
                    "markers",
                    f"camera {poorest.camera} shows {poorest.ids.size} markers in {poorest.frames} frames at the base: "
                    "check light, focus, and that the base configuration shows the marker body to every camera",
                ),
            )  # fmt: skip
        return _back_off(trials, present, settings, "at the stop")
    mean = trials.joint_sum / max(trials.joint_frames, 1)
    present.emit(
        "calibration_sample", id=trials.id, joints=mean, samples=samples, trial=trials.joint,
        progress=_progress(trials, settings, present.settings),
    )  # fmt: skip
    if trials.joint >= 0:
        trials.stops[trials.joint] += 1
        trials.lowest = np.minimum(trials.lowest, mean)
        trials.highest = np.maximum(trials.highest, mean)
    return _next(trials, present, settings)


def _progress(trials: Trials, settings: TrialSettings, core: CoreSettings) -> float:
    done = trials.joint + (float(trials.stops[trials.joint]) / settings.stops if trials.joint >= 0 else 0.0)
    return max(0.0, min(1.0, done / len(core.joint_names)))


def _back_off(trials: Trials, present: Present, settings: TrialSettings, where: str) -> Motion:
    """Take the last step back and close this side."""
    name = present.settings.joint_names[trials.joint]
    present.emit(
        "warning", id=trials.id,
        message=f"calibration: joint {name} loses the markers {where} at {present.q[trials.joint]:+.3f}; backing off",
    )  # fmt: skip
    trials.k -= trials.side
    trials.target = settings.base.copy()
    trials.target[trials.joint] += trials.k * step_size(settings, trials.joint)
    up, down = sides(settings)
    trials.k = up if trials.side > 0 else -down  # nothing further on this side
    _enter(trials, "return", present)
    return Motion(np.zeros_like(present.q))


def _next(trials: Trials, present: Present, settings: TrialSettings) -> Motion:
    """Choose the next stop: further on this side, the other side, the next joint, or home."""
    n = len(present.settings.joint_names)
    up, down = sides(settings)
    if trials.joint >= 0 and trials.side > 0 and trials.k < up:
        trials.k += 1
    elif trials.joint >= 0 and trials.side > 0:
        trials.side, trials.k = -1, -1
    elif trials.joint >= 0 and trials.k > -down:
        trials.k -= 1
    else:
        if trials.joint >= 0:
            poor = _too_little(trials, present, settings)
            if poor is not None:
                return _abort(trials, present, poor)
        trials.joint, trials.side, trials.k = trials.joint + 1, 1, 1
    trials.target = settings.base.copy()
    if trials.joint < n:
        trials.target[trials.joint] += trials.k * step_size(settings, trials.joint)
        _enter(trials, "move", present)
        _clip_to_limits(trials, present, settings)
    else:
        _enter(trials, "finish", present)
    return Motion(np.zeros_like(present.q))


def _clip_to_limits(trials: Trials, present: Present, settings: TrialSettings) -> None:
    """A stop beyond the joint's limits closes its side at once: the programme never leans on the safety stage."""
    limits = present.settings.limits
    margin = limits.position_margin + 2.0 * ARRIVED
    joint = trials.joint
    inside = (
        limits.position_min[joint] + margin <= trials.target[joint] <= limits.position_max[joint] - margin
    )
    if not inside:
        _back_off(trials, present, settings, "(joint limit)")


def _too_little(trials: Trials, present: Present, settings: TrialSettings) -> Reason | None:
    joint = trials.joint
    name = present.settings.joint_names[joint]
    stops = int(trials.stops[joint]) + 1
    visited = float(trials.highest[joint] - trials.lowest[joint])
    if stops >= MIN_STOPS and visited >= settings.min_range:
        return None
    return Reason(
        "TRIAL_TOO_SMALL", "hold", name, visited, settings.min_range, "rad or m",
        f"joint {name} was seen at {stops} stops over {visited:.3f}; at least {MIN_STOPS} stops over "
        f"{settings.min_range} are needed: change calibration.base so that the markers stay in view, or raise "
        f"calibration.range.{name}",
    )  # fmt: skip


def _abort(trials: Trials, present: Present, reason: Reason) -> Motion:
    present.emit("calibration_aborted", id=trials.id, message=reason.hint, reasons=(reason,))
    return Motion(np.zeros_like(present.q), finished=True)
