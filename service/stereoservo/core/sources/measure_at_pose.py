"""Measurement at joint positions, shared by calibration, model check and teaching: moves there, settles, and averages
the raw pixels of every marker, with covariances.

Pixels here are raw: no model is needed, and the stored values remain valid when the lens model improves.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.cycle import Sample
from stereoservo.core.monitor_state import ObservationStatistics
from stereoservo.core.prediction import joints_at
from stereoservo.core.rest_averages import add_observation, averages, measurement_buffers
from stereoservo.core.settings import CoreSettings, TrialSettings
from stereoservo.core.sources.joint_move import approach_velocity, arrived, farthest, joints_ahead
from stereoservo.core.state import PoseMeasurement
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray

FIRST_FRAME_S = 120.0  # a camera that has never delivered may still be starting
LOST_S = 0.4  # markers missing for so long in motion: back off
AT_REST = 0.01  # [rad/s or m/s]

Phase = Literal["move", "settle", "collect", "return", "sweep", "finish"]


def trial_settings(settings: CoreSettings) -> TrialSettings:
    """The cell's [calibration] section. Raises ValueError if there is none."""
    if settings.trials is None:
        raise ValueError("the cell has no [calibration] section")
    return settings.trials


def first_visit(target: FloatArray, q: FloatArray, now_ns: int, settings: CoreSettings) -> dict[str, object]:
    """Fields of a ``Visiting`` that starts from ``q`` (n,) to ``target`` (n,)."""
    return {
        "phase": "move",
        "target": target.copy(),
        "phase_ns": now_ns,
        "start": q.copy(),
        "sums": ObservationStatistics(**measurement_buffers(settings)),
        "joint_sum": np.zeros(q.size),
    }


def enter(visit: PoseMeasurement, phase: Phase, context: StepContext) -> None:
    """Start a phase."""
    visit.phase = phase
    visit.phase_ns = context.now_ns
    visit.start = context.q.copy()
    visit.lost_ns = 0
    if phase == "collect":
        visit.sums = ObservationStatistics(**measurement_buffers(context.settings))
        visit.joint_sum = np.zeros_like(context.q)
        visit.joint_frames = 0


def rest(context: StepContext, *, finished: bool = False) -> SourceOutput:
    """No motion."""
    return SourceOutput(np.zeros_like(context.q), finished=finished)


def abort(visit: PoseMeasurement, context: StepContext, reason: Reason) -> SourceOutput:
    """The end of the programme for a reason."""
    context.emit("calibration_aborted", id=visit.id, message=reason.hint, reasons=(reason,))
    return rest(context, finished=True)


def at_target(visit: PoseMeasurement, context: StepContext) -> bool:
    """Whether the arm rests at the target."""
    return (
        arrived(context.q, visit.target, context.settings)
        and arrived(joints_ahead(context), visit.target, context.settings)
        and bool((np.abs(context.state.block.command) < AT_REST).all())
    )


def continue_move(visit: PoseMeasurement, context: StepContext, trial: TrialSettings) -> SourceOutput:
    """The velocity towards the target."""
    velocity = approach_velocity(joints_ahead(context), visit.target, context.settings, trial.speed_scale)
    return SourceOutput(velocity, speed_scale=trial.speed_scale)


def too_slow(visit: PoseMeasurement, context: StepContext, trial: TrialSettings) -> Reason | None:
    """The reason if the stop is not reached in three times the expected time."""
    elapsed_s = (context.now_ns - visit.phase_ns) * 1e-9
    speed = context.settings.limits.velocity_max * context.settings.limits.speed_scale
    limit_s = 5.0 + 3.0 * float((np.abs(visit.target - visit.start) / (speed * trial.speed_scale)).max())
    if elapsed_s <= limit_s:
        return None
    joint = farthest(context.q, visit.target, context.settings)
    name = context.settings.joint_names[joint]
    return Reason(
        "STOP_NOT_REACHED",
        "hold",
        name,
        float(context.q[joint]),
        float(visit.target[joint]),
        "rad or m",
        f"joint {name} did not reach its stop within {limit_s:.0f} s ({context.settings.arrival_origin(joint)}): a "
        "limit, a keep-out, or a blocked joint",
    )


def _of_body(ids: IntArray, static: tuple[int, ...]) -> int:
    """Number of ``ids`` that are not ``static`` points of the scene."""
    of_scene = set(static)
    return sum(marker not in of_scene for marker in ids.tolist())


def markers_lost(visit: PoseMeasurement, context: StepContext, trial: TrialSettings) -> bool:
    """Whether some camera has seen too few markers for ``LOST_S``, whatever the other cameras saw meanwhile."""
    for observation in context.observations:
        if _of_body(observation.ids, context.settings.scene_ids) < trial.min_markers:
            if not visit.lost_ns:
                visit.lost_ns, visit.lost_camera = context.now_ns, observation.camera
            lost_s = (context.now_ns - visit.lost_ns) * 1e-9
            if visit.lost_camera == observation.camera and lost_s > LOST_S:
                return True
        elif visit.lost_camera == observation.camera:
            visit.lost_ns = 0
    return False


def collect_samples(visit: PoseMeasurement, context: StepContext, trial: TrialSettings) -> tuple[Sample, ...] | None:
    """Settle, then average frames; returns the samples once there are enough or the waiting time is over, else None."""
    if visit.phase == "settle":
        if (context.now_ns - visit.phase_ns) * 1e-9 >= trial.settle_s:
            enter(visit, "collect", context)
        return None
    for camera, observation in context.ingested.observations:
        offset_ns = context.state.cameras[camera].offset_ns
        at_shutter = joints_at(context.state.history, observation.t_shutter_ns + offset_ns)
        if at_shutter is None:
            continue
        if add_observation(visit.sums, context.settings, observation, trial.frames, visit.phase_ns - offset_ns):
            visit.joint_sum += at_shutter
            visit.joint_frames += 1
    silent = min(estimate.last_seq for estimate in context.state.cameras) < 0
    if silent:
        visit.silent_ns = context.now_ns
    # A camera that has started late gets the whole of wait_s for its frames.
    begin_ns = visit.phase_ns if silent else max(visit.phase_ns, visit.silent_ns)
    waited_s = (context.now_ns - begin_ns) * 1e-9
    limit_s = max(trial.wait_s, FIRST_FRAME_S) if silent else trial.wait_s
    if bool((visit.sums.frames >= trial.frames).all()) or waited_s > limit_s:
        return averages(visit.sums, context.settings)
    return None


def mean_joints(visit: PoseMeasurement) -> FloatArray:
    """Mean joint positions (n,) during the measurement."""
    mean: FloatArray = visit.joint_sum / max(visit.joint_frames, 1)
    return mean


def too_few_seen(samples: tuple[Sample, ...], trial: TrialSettings, static: tuple[int, ...] = ()) -> Sample | None:
    """The camera that saw too few markers, or too few frames, at a stop; ``static`` points do not count."""
    for sample in sorted(samples, key=lambda sample: _of_body(sample.ids, static)):
        if _of_body(sample.ids, static) < trial.min_markers or sample.frames < max(1, trial.frames // 2):
            return sample
    return None


def unseen_at_base(
    poorest: Sample, trial: TrialSettings, static: tuple[int, ...] = (), where: str = "at the base"
) -> Reason:
    """Why the programme cannot start: too few markers are visible ``where`` it begins; ``static`` points do not
    count.
    """
    seen = _of_body(poorest.ids, static)
    if poorest.frames == 0:
        return Reason(
            "CAMERA_SILENT",
            "hold",
            poorest.camera,
            0.0,
            float(trial.frames),
            "frames",
            f"camera {poorest.camera} delivers no frames: is it connected? See the daemon's log",
        )
    if seen >= trial.min_markers:
        return Reason(
            "CAMERA_SILENT",
            "hold",
            poorest.camera,
            float(poorest.frames),
            float(trial.frames),
            "frames",
            f"camera {poorest.camera} delivered {poorest.frames} of {trial.frames} frames {where} in "
            f"{trial.wait_s:g} s: a slow or interrupted camera; see the daemon's log, or raise calibration.wait_s",
        )
    return Reason(
        "MARKERS_NOT_SEEN",
        "hold",
        poorest.camera,
        float(seen),
        float(trial.min_markers),
        "markers",
        f"camera {poorest.camera} shows {seen} markers in {poorest.frames} frames {where}: "
        "check light, focus, and that every camera sees the marker body there",
    )


def blocked(target: FloatArray, moving: list[int], context: StepContext, back: FloatArray | None = None) -> str:
    """Why a stop must not be tried: a joint limit of the ``moving`` joints, a keep-out; empty if it may.

    The programme does not rely on the safety stage: a keep-out blocks the stop if it intersects the box spanned by the
    current position and the stop, and by the return position ``back`` (n,) if that is another one.
    """
    limits = context.settings.limits
    margin = limits.position_margin + 2.0 * context.settings.arrival
    for joint in moving:
        low, high = limits.position_min[joint] + margin[joint], limits.position_max[joint] - margin[joint]
        if not low <= target[joint] <= high:
            return "(joint limit)"
    ends = np.array([context.q, target, target if back is None else back])
    low, high = ends.min(axis=0), ends.max(axis=0)
    for name, box in zip(limits.keep_out_names, limits.keep_outs, strict=True):
        if bool(((box[:, 0] - margin <= high) & (low <= box[:, 1] + margin)).all()):
            return f"(keep-out {name})"
    return ""
