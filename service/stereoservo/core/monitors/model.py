"""The watch over the model: do innovations, unfiltered, still look like noise, and if not, what explains them?

A round is one frame of every camera that delivers. Its chi-square, with the covariances of detector, timing and model,
is cheap; only where it is improbable is it asked which single change explains it: a moved camera, cameras moved as one,
a slipped marker, a drifted joint zero (`kinematics.moved`). A verdict needs two rounds of the last three.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.core.context import StepContext
from stereoservo.core.monitor_state import (
    MOVED,
    CameraMonitor,
    CameraTiming,
    ModelDiagnosis,
    ModelMonitor,
    nothing_sighted,
)
from stereoservo.core.monitors.fault_isolation import LEAST_PX, Bench, diagnosed
from stereoservo.core.prediction import MODEL_SIGMA_PX, FrameResiduals, ModelArrays, distance2, gate_threshold
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import CameraHealth, Health, Lifecycle, ModelReadiness
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

AGREE, OF = 2, 3
"""Rounds of the last ones that must say the same."""
BACK_ROUNDS = 30
"""Rounds in which a masked marker must stand where it should, to be used again."""
STALE_PERIODS = 2.5
"""Frames that are older than so many periods of their camera are left out of a round."""
LATE_S = 0.02
"""By which a busy computer may get a stamp wrong."""
LATEST_S = 0.15
"""By which at most, where nothing but noise is left then."""
LATEST_MODEL_PX = 0.1
"""What the model may be off by besides, at the latest."""
FEWEST_LEFT = 4
"""Markers of a camera that must remain where others are masked."""


def start_model_monitor(
    state: CoreState, arrays: ModelArrays, settings: CoreSettings, masked: tuple[int, ...] = ()
) -> None:
    """Watch over a new model. ``masked``: ids of markers that stay unused."""
    m = len(arrays.marker_ids)
    watching = nothing_sighted(len(settings.cameras), len(arrays.rows), len(settings.joint_names), m)
    for marker in masked:
        if marker in arrays.index:
            watching.masked[arrays.index[marker]] = 1.0
    state.watching = watching


def masked_ids(state: CoreState) -> tuple[int, ...]:
    """Ids of markers that are not used."""
    if state.model is None:
        return ()
    return tuple(
        marker
        for marker, masked in zip(state.model.marker_ids, state.watching.masked, strict=True)
        if masked > 0.0
    )


def fold_residuals(watching: ModelMonitor, camera: int, sights: FrameResiduals, q: FloatArray) -> None:
    """A new frame of one camera, with the arm at ``q`` (n,) then."""
    sighting = watching.sightings[camera]
    watching.due = watching.due or not sighting.looked
    sighting.innovation = sights.innovation
    sighting.spread = sights.spread
    sighting.seen = sights.seen.astype(np.float64)
    sighting.velocity = sights.velocity
    sighting.q = q
    sighting.t_ns = sights.t_shutter_ns
    sighting.fresh, sighting.looked = True, False
    used = _used(watching, sighting)
    chi2, squares, worst, _ = camera_chi2(sighting.innovation, sighting.spread, used, MODEL_SIGMA_PX)
    count = float(used.sum())
    sighting.chi2 = chi2 / max(2.0 * count, 1.0)
    sighting.rms_px = math.sqrt(squares / max(2.0 * count, 1.0))
    sighting.worst = int(worst)
    sighting.worst_px = 0.0 if worst < 0 else float(np.sqrt((sighting.innovation[worst] ** 2).sum()))
    rows = used > 0.0
    fold_timing(
        sighting.timing,
        sighting.innovation[rows],
        sights.velocity[rows],
        sights.noise[rows],
        sights.t_shutter_ns,
    )


def _used(watching: ModelMonitor, sighting: CameraMonitor) -> FloatArray:
    """(k,) 1 for what is seen and has not slipped."""
    used = sighting.seen.copy()
    used[: len(watching.masked)] *= 1.0 - watching.masked
    return used


def finish_round(context: StepContext) -> ModelDiagnosis | None:
    """Finish a round where one is complete; the new verdict where it has changed."""
    watching, arrays = context.state.watching, context.arrays
    if arrays is None or not (watching.due or all(not s.looked for s in watching.sightings)):
        return None
    if context.state.lifecycle in (Lifecycle.FAULT, Lifecycle.UNCONFIGURED):
        return None  # joints that a faulty drive tells are no measure of cameras
    watching.due = False
    known = []
    for c, (camera, sighting) in enumerate(zip(context.settings.cameras, watching.sightings, strict=True)):
        age_s = (context.now_ns - sighting.t_ns) * 1e-9
        recent = not sighting.looked or age_s * camera.rate_hz <= STALE_PERIODS
        mobile = context.state.mobile[c]
        if recent and sighting.t_ns > 0 and not (mobile is not None and mobile.moving):
            known.append(c)
        sighting.looked = True
    if not known:
        return None
    watching.rounds += 1
    watching.last = [*watching.last[1 - OF :], _judged(watching, known, arrays, context.settings)]
    _unmask_returned(watching, known, context)
    return _changed(watching)


def _judged(
    watching: ModelMonitor, known: list[int], arrays: ModelArrays, settings: CoreSettings
) -> ModelDiagnosis:
    """What one round says, of the cameras ``known``."""
    suspicious = False
    for c in known:
        sighting = watching.sightings[c]
        used = _used(watching, sighting)
        likely = _likely(sighting.innovation, sighting.spread, used, settings)
        suspicious |= not (likely or _late(sighting, used, settings))
    if not suspicious:
        return ModelDiagnosis()
    return diagnosed(bench_now(watching, known, arrays, settings))


def bench_now(watching: ModelMonitor, known: list[int], arrays: ModelArrays, settings: CoreSettings) -> Bench:
    """The newest frames of the cameras ``known``."""
    weights = np.zeros((len(known), len(arrays.rows)))
    innovation = np.zeros((len(known), len(arrays.rows), 2))
    for row, c in enumerate(known):
        sighting = watching.sightings[c]
        variance = 0.5 * (sighting.spread[:, 0, 0] + sighting.spread[:, 1, 1]) + MODEL_SIGMA_PX**2
        weights[row] = _used(watching, sighting) / np.sqrt(variance)
        innovation[row] = sighting.innovation
    newest = max(known, key=lambda c: watching.sightings[c].t_ns)
    return Bench(arrays, settings, known, watching.sightings[newest].q, innovation, weights)


def _likely(
    innovation: FloatArray, spread: FloatArray, used: FloatArray, settings: CoreSettings,
    model_px: float = MODEL_SIGMA_PX,
) -> bool:  # fmt: skip
    """Whether innovations (k, 2) look like noise, all together and each of them."""
    chi2, _, _, largest = camera_chi2(innovation, spread, used, model_px)
    return chi2 <= _improbable(2.0 * float(used.sum())) and largest <= gate_threshold(settings.gate_sigma)


def _late(sighting: CameraMonitor, used: FloatArray, settings: CoreSettings) -> bool:
    """Whether a frame that was taken a little earlier or later than stated explains its innovations.

    Pictures are late where a computer is busy; a camera that was moved shows it at rest, too.
    """
    moved = sighting.velocity * used[:, None]
    square = float((moved * moved).sum())
    if square <= 0.0:
        return False
    late_s = float((moved * sighting.innovation).sum()) / square
    if abs(late_s) > LATEST_S:
        return False
    rest = sighting.innovation - late_s * sighting.velocity
    model_px = MODEL_SIGMA_PX if abs(late_s) <= LATE_S else LATEST_MODEL_PX
    return _likely(rest, sighting.spread, used, settings, model_px)


def _improbable(freedoms: float) -> float:
    """Chi-square that is exceeded as rarely as five standard deviations (Wilson and Hilferty 1931)."""
    part = 2.0 / (9.0 * max(freedoms, 1.0))
    return freedoms * (1.0 - part + 5.0 * math.sqrt(part)) ** 3


def _key(verdict: ModelDiagnosis) -> tuple[str, ...]:
    """What two rounds must agree in."""
    return (verdict.kind, *verdict.subjects)


def _changed(watching: ModelMonitor) -> ModelDiagnosis | None:
    """The verdict that two of the last three rounds agree in, where it is another than before."""
    keys = [_key(verdict) for verdict in watching.last]
    for verdict in reversed(watching.last):
        if keys.count(_key(verdict)) < (OF if verdict.kind == "ok" else AGREE):
            continue
        if _key(verdict) == _key(watching.verdict):
            watching.verdict = verdict
            return None
        watching.verdict = verdict
        return verdict
    return None


# -- what follows from a verdict ------------------------------------------------------------------------------


def emit_diagnosis(verdict: ModelDiagnosis, context: StepContext) -> None:
    """Say a new verdict in an event."""
    message = verdict.text or "the images agree with the model again"
    reason = diagnosis_reason(verdict)
    context.emit(
        "health", message=message, name=verdict.kind, reasons=() if reason is None else (reason,),
        cameras=verdict.subjects if verdict.kind in MOVED else (),
    )  # fmt: skip


def diagnosis_reason(verdict: ModelDiagnosis) -> Reason | None:
    """A verdict as a reason; None where all is well."""
    subject, value = ", ".join(verdict.subjects), verdict.size
    if verdict.kind in MOVED:
        return Reason("CAMERA_MOVED", "hold", subject, verdict.moved_px, None, "px", verdict.text)
    if verdict.kind == "cameras_or_arm":
        return Reason("CAMERAS_OR_ARM", "hold", subject, verdict.moved_px, LEAST_PX, "px", verdict.text)
    if verdict.kind == "marker_slipped":
        return Reason("MARKER_SLIPPED", "info", subject, verdict.moved_px, None, "px", verdict.text)
    if verdict.kind == "joint_zero":
        return Reason(
            "JOINT_ZERO_DRIFTED", "info", subject, value, verdict.deviation, verdict.unit, verdict.text
        )
    if verdict.kind == "unclear":
        return Reason("IMAGES_UNEXPLAINED", "info", subject, verdict.moved_px, None, "px", verdict.text)
    return None


def mask_marker(verdict: ModelDiagnosis, context: StepContext) -> bool:
    """Use a slipped marker no more, where every camera has enough others; whether it is so."""
    state, arrays = context.state, context.arrays
    assert arrays is not None
    slipped = [arrays.index[int(marker)] for marker in verdict.subjects if int(marker) in arrays.index]
    masked = state.watching.masked.copy()
    masked[slipped] = 1.0
    seen = [s.seen[: masked.size] for s in state.watching.sightings if bool((s.seen > 0.0).any())]
    if not slipped or min((float((s * (1.0 - masked)).sum()) for s in seen), default=0.0) < FEWEST_LEFT:
        return False
    state.watching.masked = masked
    state.watching.back[slipped] = 0
    for estimate in state.cameras:
        estimate.seen_ns[slipped] = 0
    return True


def _unmask_returned(watching: ModelMonitor, known: list[int], context: StepContext) -> None:
    """A masked marker that stands where it should again, to every camera that sees it, is used again."""
    arrays = context.arrays
    assert arrays is not None
    for i in np.flatnonzero(watching.masked > 0.0):
        seen = [watching.sightings[c] for c in known if watching.sightings[c].seen[i] > 0.0]
        if not seen:
            continue
        only = np.zeros(len(arrays.rows))
        only[i] = 1.0
        good = all(
            camera_chi2(s.innovation, s.spread, only, MODEL_SIGMA_PX)[0] <= _improbable(2.0) for s in seen
        )
        watching.back[i] = watching.back[i] + 1 if good else 0
        if watching.back[i] >= BACK_ROUNDS:
            watching.masked[i] = 0.0
            marker = arrays.marker_ids[int(i)]
            message = f"marker {marker} is where it should be again: it is used again"
            context.emit("health", message=message, name="ok")


def shown_diagnosis(state: CoreState) -> ModelDiagnosis:
    """The verdict as it is shown: a marker that is left out remains one that has slipped."""
    verdict, masked = state.watching.verdict, masked_ids(state)
    if verdict.kind != "ok" or not masked:
        return verdict
    listed = tuple(str(marker) for marker in masked)
    text = f"marker {', '.join(listed)} has slipped and is not used; fix it where it was, or calibrate"
    return ModelDiagnosis("marker_slipped", listed, text=text)


def health_status(state: CoreState, settings: CoreSettings, reanchoring: str) -> Health:
    """What the status says of the model's health."""
    if state.model is None or state.readiness == ModelReadiness.NONE:
        return Health()
    watching, verdict = state.watching, shown_diagnosis(state)
    ids = (*state.model.marker_ids, *state.model.scene_ids)
    return Health(
        verdict=verdict.kind,
        subjects=verdict.subjects,
        size=verdict.size,
        deviation=verdict.deviation,
        unit=verdict.unit,
        text=verdict.text,
        cameras={
            camera.name: CameraHealth(
                sighting.chi2,
                sighting.rms_px,
                ids[sighting.worst] if sighting.worst >= 0 else -1,
                sighting.worst_px,
                "" if moves is None else moves.place,
                advice(sighting.timing),
            )
            for camera, sighting, moves in zip(
                settings.cameras, watching.sightings, state.mobile, strict=True
            )
        },
        masked=masked_ids(state),
        reanchoring=reanchoring,
    )


FORGETTING_S = 30.0
"""Time constant, in seconds of seen motion, with which old frames are forgotten."""
MOVING_PX_S = 20.0
"""Mean pixel speed below which a frame says nothing of time."""
KNOWN_S = 0.002
"""Standard deviation at which the offset is told."""
WRONG_S = 0.004
"""Offset that is worth a word: at 100 px/s it moves a marker by 0.4 px."""
MODEL_PX = 0.3
"""What the model may be off by, beside the noise [px]."""


def fold_timing(
    timing: CameraTiming, innovations: FloatArray, velocities: FloatArray, variances: FloatArray, t_ns: int
) -> None:
    """Take in a frame: ``innovations`` [px] and ``velocities`` [px/s] (k, 2), ``variances`` (k,) [px²] a coordinate.

    The markers of a frame share what the model is off by: they count as one sight, not as k.
    """
    k = variances.shape[0]
    speed = product = square = 0.0
    for i in range(k):
        vu, vv = float(velocities[i, 0]), float(velocities[i, 1])
        speed += math.sqrt(vu * vu + vv * vv)
        weight = 1.0 / (float(variances[i]) + MODEL_PX * MODEL_PX)
        product += weight * (vu * float(innovations[i, 0]) + vv * float(innovations[i, 1]))
        square += weight * (vu * vu + vv * vv)
    if k == 0 or speed < MOVING_PX_S * k:
        return
    elapsed_s = min((t_ns - timing.seen_ns) * 1e-9, 0.2) if timing.seen_ns else 0.0
    keep = math.exp(-elapsed_s / FORGETTING_S)
    timing.product = keep * timing.product + product / k
    timing.square = keep * timing.square + square / k
    timing.seen_ns = t_ns


def offset_s(timing: CameraTiming) -> tuple[float, float]:
    """How much later than stated the shutter opens [s], and its standard deviation; (0, inf) before any motion."""
    if timing.square <= 0.0:
        return 0.0, math.inf
    return timing.product / timing.square, 1.0 / math.sqrt(timing.square)


def advice(timing: CameraTiming) -> str:
    """What is to be said of it to people; empty where the stamps are right, or nothing is known yet."""
    late, deviation = offset_s(timing)
    if deviation > KNOWN_S or abs(late) < max(WRONG_S, 4.0 * deviation):
        return ""
    way = "less" if late > 0 else "more"
    return (
        f"its shutter opens {1e3 * abs(late):.1f} ms {'later' if late > 0 else 'earlier'} than stated "
        f"(± {1e3 * deviation:.1f}): {1e3 * abs(late):.0f} ms {way} latency_s would be right"
    )


@kernel
def camera_chi2(
    innovation: FloatArray, spread: FloatArray, used: FloatArray, model_px: float
) -> tuple[float, float, int, float]:
    """Chi-square of a frame's innovations (k, 2) where ``used`` (k,) > 0, sum of their squares [px²], the row of the
    largest squared distance (-1: none) and this distance.
    """
    total, squares, largest = 0.0, 0.0, 0.0
    worst = -1
    for i in range(used.size):
        if not used[i] > 0.0:
            continue
        x, y = innovation[i, 0], innovation[i, 1]
        m = model_px * model_px
        d2 = distance2(x, y, spread[i, 0, 0] + m, spread[i, 0, 1], spread[i, 1, 1] + m)
        total += d2
        squares += x * x + y * y
        if worst < 0 or d2 > largest:
            worst, largest = i, d2
    return total, squares, worst, largest
