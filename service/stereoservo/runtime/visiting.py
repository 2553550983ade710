"""Going to a configuration and looking from there at rest: what trial motions and the check motion are made of."""

from __future__ import annotations

from typing import Literal

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.averaging import add_observation, averages
from stereoservo.runtime.cycle import Sample
from stereoservo.runtime.estimate import joints_at
from stereoservo.runtime.motion import ARRIVED, Motion, Present, arrived, measurement_buffers, towards
from stereoservo.runtime.ports import FloatArray, IntArray
from stereoservo.runtime.settings import CoreSettings, TrialSettings
from stereoservo.runtime.state import Visiting
from stereoservo.runtime.sums import Sums

FIRST_FRAME_S = 120.0  # a camera that has never delivered may still be starting
LOST_S = 0.4  # markers missing for so long in motion: back off
AT_REST = 0.01  # [rad/s or m/s]

Phase = Literal["move", "settle", "collect", "return", "finish"]


def trial_settings(settings: CoreSettings) -> TrialSettings:
    """The cell's [calibration] section. Raises ValueError where it has none."""
    if settings.trials is None:
        raise ValueError("the cell has no [calibration] section")
    return settings.trials


def first_visit(target: FloatArray, q: FloatArray, now_ns: int, settings: CoreSettings) -> dict[str, object]:
    """Fields of a ``Visiting`` that sets out from ``q`` (n,) to ``target`` (n,)."""
    return {
        "phase": "move",
        "target": target.copy(),
        "phase_ns": now_ns,
        "start": q.copy(),
        "sums": Sums(**measurement_buffers(settings)),
        "joint_sum": np.zeros(q.size),
    }


def enter(visit: Visiting, phase: Phase, present: Present) -> None:
    """Begin a phase."""
    visit.phase = phase
    visit.phase_ns = present.now_ns
    visit.start = present.q.copy()
    visit.lost_ns = 0
    if phase == "collect":
        visit.sums = Sums(**measurement_buffers(present.settings))
        visit.joint_sum = np.zeros_like(present.q)
        visit.joint_frames = 0


def there(visit: Visiting, present: Present) -> bool:
    """Whether the arm rests at the target."""
    return arrived(present.q, visit.target) and bool((np.abs(present.state.command) < AT_REST).all())


def onwards(visit: Visiting, present: Present, trial: TrialSettings) -> Motion:
    """Towards the target."""
    velocity = towards(present.q, visit.target, present.settings, trial.speed_scale)
    return Motion(velocity, speed_scale=trial.speed_scale)


def too_slow(visit: Visiting, present: Present, trial: TrialSettings) -> Reason | None:
    """The stop is not reached in three times the time it takes."""
    elapsed_s = (present.now_ns - visit.phase_ns) * 1e-9
    speed = present.settings.limits.velocity_max * present.settings.limits.speed_scale
    limit_s = 5.0 + 3.0 * float((np.abs(visit.target - visit.start) / (speed * trial.speed_scale)).max())
    if elapsed_s <= limit_s:
        return None
    joint = int(np.abs(visit.target - present.q).argmax())
    name = present.settings.joint_names[joint]
    return Reason(
        "STOP_NOT_REACHED", "hold", name, float(present.q[joint]), float(visit.target[joint]), "rad or m",
        f"joint {name} did not reach its stop within {limit_s:.0f} s (tolerance {ARRIVED}): a limit, a keep-out, "
        "or a blocked joint",
    )  # fmt: skip


def _of_body(ids: IntArray, static: tuple[int, ...]) -> int:
    """How many of ``ids`` are not ``static``, of the scene."""
    return sum(int(marker) not in static for marker in ids)


def markers_lost(visit: Visiting, present: Present, trial: TrialSettings) -> bool:
    """Some camera has seen too few markers for ``LOST_S``."""
    for observation in present.observations:
        if _of_body(observation.ids, present.settings.scene_ids) < trial.min_markers:
            visit.lost_ns = visit.lost_ns or present.now_ns
            return (present.now_ns - visit.lost_ns) * 1e-9 > LOST_S
    if present.observations:
        visit.lost_ns = 0
    return False


def look(visit: Visiting, present: Present, trial: TrialSettings) -> tuple[Sample, ...] | None:
    """Settle, then average frames; the samples once there are enough or waiting is over, else None."""
    if visit.phase == "settle":
        if (present.now_ns - visit.phase_ns) * 1e-9 >= trial.settle_s:
            enter(visit, "collect", present)
        return None
    for observation in present.observations:
        at_shutter = joints_at(present.state.history, observation.t_shutter_ns)
        if at_shutter is None:
            continue
        if add_observation(visit.sums, present.settings, observation, trial.frames, visit.phase_ns):
            visit.joint_sum += at_shutter
            visit.joint_frames += 1
    silent = min(estimate.last_seq for estimate in present.state.cameras) < 0
    if silent:
        visit.silent_ns = present.now_ns
    # A camera that has begun at last gets the whole of wait_s for its frames.
    begin_ns = visit.phase_ns if silent else max(visit.phase_ns, visit.silent_ns)
    waited_s = (present.now_ns - begin_ns) * 1e-9
    limit_s = max(trial.wait_s, FIRST_FRAME_S) if silent else trial.wait_s
    if bool((visit.sums.frames >= trial.frames).all()) or waited_s > limit_s:
        return averages(visit.sums, present.settings)
    return None


def mean_joints(visit: Visiting) -> FloatArray:
    """Joints (n,) while it looked."""
    mean: FloatArray = visit.joint_sum / max(visit.joint_frames, 1)
    return mean


def too_few_seen(
    samples: tuple[Sample, ...], trial: TrialSettings, static: tuple[int, ...] = ()
) -> Sample | None:
    """The camera that saw too few markers, or too few frames, at a stop; ``static`` points do not count."""
    for sample in sorted(samples, key=lambda sample: _of_body(sample.ids, static)):
        if _of_body(sample.ids, static) < trial.min_markers or sample.frames < max(1, trial.frames // 2):
            return sample
    return None


def unseen_at_base(poorest: Sample, trial: TrialSettings, static: tuple[int, ...] = ()) -> Reason:
    """Why nothing can begin: the base shows too little; ``static`` points do not count."""
    seen = _of_body(poorest.ids, static)
    if poorest.frames == 0:
        return Reason(
            "CAMERA_SILENT", "hold", poorest.camera, 0.0, float(trial.frames), "frames",
            f"camera {poorest.camera} delivers no frames: is it connected? See the daemon's log",
        )  # fmt: skip
    if seen >= trial.min_markers:
        return Reason(
            "CAMERA_SILENT", "hold", poorest.camera, float(poorest.frames), float(trial.frames), "frames",
            f"camera {poorest.camera} delivered {poorest.frames} of {trial.frames} frames at the base in "
            f"{trial.wait_s:g} s: a slow or interrupted camera; see the daemon's log, or raise calibration.wait_s",
        )  # fmt: skip
    return Reason(
        "MARKERS_NOT_SEEN", "hold", poorest.camera, float(seen), float(trial.min_markers), "markers",
        f"camera {poorest.camera} shows {seen} markers in {poorest.frames} frames at the base: "
        "check light, focus, and that the base configuration shows the marker body to every camera",
    )  # fmt: skip


def blocked(target: FloatArray, moving: list[int], present: Present) -> str:
    """Why a stop must not be tried: a joint limit of the ``moving`` joints, a keep-out; empty where it may.

    The programme never leans on the safety stage: a keep-out blocks where it meets the box that the way from here
    to the stop spans.
    """
    limits = present.settings.limits
    margin = limits.position_margin + 2.0 * ARRIVED
    for joint in moving:
        low, high = limits.position_min[joint] + margin, limits.position_max[joint] - margin
        if not low <= target[joint] <= high:
            return "(joint limit)"
    for name, box in zip(limits.keep_out_names, limits.keep_outs, strict=True):
        low, high = np.minimum(present.q, target), np.maximum(present.q, target)
        if bool(((box[:, 0] - margin <= high) & (low <= box[:, 1] + margin)).all()):
            return f"(keep-out {name})"
    return ""
