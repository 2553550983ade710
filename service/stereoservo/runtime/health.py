"""The watch over the model: do innovations, unfiltered, still look like noise, and if not, what explains them?

A round is one frame of every camera that delivers. Its chi-square, with the covariances of detector, timing and model,
is cheap; only where it is improbable is it asked which single change explains it: a moved camera, cameras moved as one,
a slipped marker, a drifted joint zero (`kinematics.moved`). A verdict needs two rounds of the last three.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.cycle import CameraHealth, Health, Lifecycle, ModelReadiness
from stereoservo.runtime.diagnosis import diagnosed
from stereoservo.runtime.estimate import MODEL_SIGMA_PX, FrameSights, ModelArrays
from stereoservo.runtime.gate_kernel import camera_chi2, gate_threshold
from stereoservo.runtime.health_state import Sighting, Verdict, Watching, nothing_sighted
from stereoservo.runtime.motion import Present
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.settings import CoreSettings
from stereoservo.runtime.state import CoreState
from stereoservo.runtime.timing import advice, fold_timing

AGREE, OF = 2, 3
"""Rounds of the last ones that must say the same."""
BACK_ROUNDS = 30
"""Rounds in which a masked marker must stand where it should, to be used again."""
STALE_PERIODS = 2.5
"""Frames that are older than so many periods of their camera are left out of a round."""
LATE_S, LATEST_S = 0.02, 0.15
"""By which a busy computer may get a stamp wrong; by which at most, where nothing but noise is left then."""
LATEST_MODEL_PX = 0.1
"""What the model may be off by besides, at the latest."""
FEWEST_LEFT = 4
"""Markers of a camera that must remain where others are masked."""


def start(
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


def see(watching: Watching, camera: int, sights: FrameSights, q: FloatArray) -> None:
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


def _used(watching: Watching, sighting: Sighting) -> FloatArray:
    """(k,) 1 for what is seen and has not slipped."""
    used = sighting.seen.copy()
    used[: len(watching.masked)] *= 1.0 - watching.masked
    return used


def watch(present: Present) -> Verdict | None:
    """Finish a round where one is complete; the new verdict where it has changed."""
    watching, arrays = present.state.watching, present.arrays
    if arrays is None or not (watching.due or all(not s.looked for s in watching.sightings)):
        return None
    if present.state.lifecycle in (Lifecycle.FAULT, Lifecycle.UNCONFIGURED):
        return None  # joints that a faulty drive tells are no measure of cameras
    watching.due = False
    known = []
    for c, (camera, sighting) in enumerate(zip(present.settings.cameras, watching.sightings, strict=True)):
        age_s = (present.now_ns - sighting.t_ns) * 1e-9
        recent = not sighting.looked or age_s * camera.rate_hz <= STALE_PERIODS
        mobile = present.state.mobile[c]
        if recent and sighting.t_ns > 0 and not (mobile is not None and mobile.moving):
            known.append(c)
        sighting.looked = True
    if not known:
        return None
    watching.rounds += 1
    watching.last = [*watching.last[1 - OF :], _judged(watching, known, arrays, present.settings)]
    _look_for_masked(watching, known, present)
    return _changed(watching)


def _judged(watching: Watching, known: list[int], arrays: ModelArrays, settings: CoreSettings) -> Verdict:
    """What one round says, of the cameras ``known``."""
    suspicious = False
    for c in known:
        sighting = watching.sightings[c]
        used = _used(watching, sighting)
        likely = _likely(sighting.innovation, sighting.spread, used, settings)
        suspicious |= not (likely or _late(sighting, used, settings))
    if not suspicious:
        return Verdict()
    weights = np.zeros((len(known), len(arrays.rows)))
    innovation = np.zeros((len(known), len(arrays.rows), 2))
    for row, c in enumerate(known):
        sighting = watching.sightings[c]
        variance = 0.5 * (sighting.spread[:, 0, 0] + sighting.spread[:, 1, 1]) + MODEL_SIGMA_PX**2
        weights[row] = _used(watching, sighting) / np.sqrt(variance)
        innovation[row] = sighting.innovation
    newest = max(known, key=lambda c: watching.sightings[c].t_ns)
    return diagnosed(arrays, settings, known, watching.sightings[newest].q, innovation, weights)


def _likely(
    innovation: FloatArray, spread: FloatArray, used: FloatArray, settings: CoreSettings,
    model_px: float = MODEL_SIGMA_PX,
) -> bool:  # fmt: skip
    """Whether innovations (k, 2) look like noise, all together and each of them."""
    chi2, _, _, largest = camera_chi2(innovation, spread, used, model_px)
    return chi2 <= _improbable(2.0 * float(used.sum())) and largest <= gate_threshold(settings.gate_sigma)


def _late(sighting: Sighting, used: FloatArray, settings: CoreSettings) -> bool:
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


def _changed(watching: Watching) -> Verdict | None:
    """The verdict that two of the last three rounds agree in, where it is another than before."""
    keys = [verdict.key for verdict in watching.last]
    for verdict in reversed(watching.last):
        if keys.count(verdict.key) < (OF if verdict.kind == "ok" else AGREE):
            continue
        if verdict.key == watching.verdict.key:
            watching.verdict = verdict
            return None
        watching.verdict = verdict
        return verdict
    return None


# -- what follows from a verdict ------------------------------------------------------------------------------


def tell(verdict: Verdict, present: Present) -> None:
    """Say a new verdict in an event."""
    message = verdict.text or "the images agree with the model again"
    reason = verdict_reason(verdict)
    present.emit(
        "health", message=message, name=verdict.kind, reasons=() if reason is None else (reason,),
        cameras=verdict.subjects if verdict.kind in MOVED else (),
    )  # fmt: skip


MOVED = ("camera_moved", "cameras_moved_together")


def verdict_reason(verdict: Verdict) -> Reason | None:
    """A verdict as a reason; None where all is well."""
    subject, value = ", ".join(verdict.subjects), verdict.size
    if verdict.kind in MOVED:
        return Reason("CAMERA_MOVED", "hold", subject, verdict.moved_px, None, "px", verdict.text)
    if verdict.kind == "marker_slipped":
        return Reason("MARKER_SLIPPED", "info", subject, verdict.moved_px, None, "px", verdict.text)
    if verdict.kind == "joint_zero":
        return Reason(
            "JOINT_ZERO_DRIFTED", "info", subject, value, verdict.deviation, verdict.unit, verdict.text
        )
    if verdict.kind == "unclear":
        return Reason("IMAGES_UNEXPLAINED", "info", subject, verdict.moved_px, None, "px", verdict.text)
    return None


def mask(verdict: Verdict, present: Present) -> bool:
    """Use a slipped marker no more, where every camera has enough others; whether it is so."""
    state, arrays = present.state, present.arrays
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


def _look_for_masked(watching: Watching, known: list[int], present: Present) -> None:
    """A masked marker that stands where it should again, to every camera that sees it, is used again."""
    arrays = present.arrays
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
            present.emit("health", message=message, name="ok")


def shown(state: CoreState) -> Verdict:
    """The verdict as it is shown: a marker that is left out remains one that has slipped."""
    verdict, masked = state.watching.verdict, masked_ids(state)
    if verdict.kind != "ok" or not masked:
        return verdict
    listed = tuple(str(marker) for marker in masked)
    text = f"marker {', '.join(listed)} has slipped and is not used; fix it where it was, or calibrate"
    return Verdict("marker_slipped", listed, text=text)


def health_now(state: CoreState, settings: CoreSettings, reanchoring: str) -> Health:
    """What the status says of the model's health."""
    if state.model is None or state.readiness == ModelReadiness.NONE:
        return Health()
    watching, verdict = state.watching, shown(state)
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
