"""Rounds of frames: one frame of every camera that delivers, and whether its innovations, unfiltered, still look like
noise. Only where they do not is it asked what explains them (`fault_isolation`). A diagnosis needs two rounds of the
last three.
"""

from __future__ import annotations

from stereoservo.core.camera_state import CameraMonitor
from stereoservo.core.context import StepContext
from stereoservo.core.monitor_state import LATE_S, STALE_PERIODS, ModelDiagnosis, ModelMonitor
from stereoservo.core.monitors.diagnosis import unmask_returned
from stereoservo.core.monitors.fault_isolation import bench_now, diagnosed_beside_joint_errors
from stereoservo.core.prediction import (
    MODEL_SIGMA_PX,
    camera_chi2,
    gate_threshold,
    improbable,
    rows_in_use,
    used_rows,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel

AGREE, OF = 2, 3
"""Rounds of the last ones that must say the same."""
LATEST_S = 0.15
"""By which at most, where nothing but noise is left then."""
LATEST_MODEL_PX = 0.1
"""What the model may be off by besides, at the latest."""


NOISE = ModelDiagnosis()
"""Of a round that needs no explanation."""


def finish_round(context: StepContext) -> ModelDiagnosis | None:
    """Finish a round where one is complete; the new verdict where it has changed."""
    state, arrays = context.state, context.arrays
    watching = state.watching
    if arrays is None:
        return None
    if not watching.due:
        for sighting in watching.sightings:
            if sighting.looked:
                return None
    if state.lifecycle in (Lifecycle.FAULT, Lifecycle.UNCONFIGURED):
        return None  # joints that a faulty drive tells are no measure of cameras
    watching.due = False
    moving = sum([1 << c for c, mobile in enumerate(state.mobile) if mobile is not None and mobile.moving])
    looked_at, odd, masked = judge_round(
        state.block.record, context.derived.room.record, context.now_ns, watching.masked, moving
    )
    if not looked_at:
        return None
    watching.rounds += 1
    verdict = NOISE
    if odd and not _all_late(_cameras(odd), watching, context.settings):
        bench = bench_now(watching, _cameras(looked_at), arrays, context.settings)
        verdict = diagnosed_beside_joint_errors(bench, proven=state.reanchoring is not None)
    watching.last = [*watching.last[1 - OF :], verdict]
    if masked:
        unmask_returned(watching, _cameras(looked_at), context)
    return _changed(watching)


def _cameras(bits: int) -> list[int]:
    """Numbers of the cameras that ``bits`` stands for."""
    return [c for c in range(bits.bit_length()) if bits >> c & 1]


@kernel
def judge_round(
    block: Record, room: Record, now_ns: int, masked: FloatArray, moving: int
) -> tuple[int, int, bool]:
    """Look at the newest frame of each camera: those that are recent, and of them those whose innovations do not look
    like noise, all together and each of them; and whether any marker is ``masked`` (m,) > 0.

    Cameras are bits of a number, as are those that are ``moving``, which are left out.
    """
    memory, work = block[0], room[0]
    rows = memory.rows
    known = odd = 0
    for c in range(memory.cameras):
        frame, bit = memory.sightings[c], 1 << c
        age_s = (now_ns - frame.t_ns) * 1e-9
        recent = not frame.looked or age_s * work.camera_rates[c] <= STALE_PERIODS
        frame.looked = True
        if not recent or frame.t_ns <= 0 or moving & bit:
            continue
        known |= bit
        at, end = rows * c, rows * (c + 1)
        chi2, _, _, largest, count = camera_chi2(
            memory.frame_innovation[2 * at : 2 * end].reshape((rows, 2)),
            memory.frame_spread[4 * at : 4 * end].reshape((rows, 2, 2)),
            rows_in_use(memory.frame_seen[at:end], masked), MODEL_SIGMA_PX,
        )  # fmt: skip
        if not (chi2 <= work.noise_chi2[count] and largest <= work.gate):
            odd |= bit
    return known, odd, bool((masked > 0.0).any())


def _all_late(cameras: list[int], watching: ModelMonitor, settings: CoreSettings) -> bool:
    """Whether the newest frame of each of these ``cameras`` is `_late`."""
    frames = [watching.sightings[c] for c in cameras]
    return all(_late(frame, used_rows(watching, frame), settings) for frame in frames)


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
    chi2, _, _, largest, count = camera_chi2(rest, sighting.spread, used, model_px)
    return bool(chi2 <= improbable(2.0 * count) and largest <= gate_threshold(settings.gate_sigma))


def _key(verdict: ModelDiagnosis) -> tuple[str, ...]:
    """What two rounds must agree in."""
    return (verdict.kind, *verdict.subjects)


def _changed(watching: ModelMonitor) -> ModelDiagnosis | None:
    """The verdict that two of the last three rounds agree in, where it is another than before."""
    if {verdict.kind for verdict in (watching.verdict, *watching.last)} == {"ok"}:
        watching.verdict = watching.last[-1] if len(watching.last) == OF else watching.verdict
        return None
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
