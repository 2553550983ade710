"""Travel that joints were sent and did not make, and how late their drives are: the accounts of one step, as a kernel.

A drive may answer commands a while later, and nobody may have said so. The delay of each joint is measured where it
sets out from rest: from when it was sent a small travel until its reading shows it. What a joint was sent is then
compared with its reading as of now and as of so long ago, and what lies between the two is not missing.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.core.monitor_state import DriveDelays
from stereoservo.core.settings import CoreSettings
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

LEAST_S, LONGEST_S = 0.04, 0.25
"""Friction and play look like less; a drive that is later does not follow."""
SAMPLES = 5
"""Of a joint's delay, of which the median counts."""
ONSET_S = 0.1
"""In which a joint that sets out must be sent the travel that is timed; friction and play would count at less speed."""
ONSET_TRAVEL = 2.0
"""The travel that is timed, times that by which a reading answers."""
WAITS, RESTS, SETS_OUT = 0.0, 1.0, 2.0
"""Phases of a measurement."""
PHASE, REST_S, STOOD_AT, SENT_BEFORE, SINCE_S, PASSED_S = range(6)
"""Rows of `DriveDelays.onset`."""


def unknown_delays(settings: CoreSettings) -> DriveDelays:
    """Of joints of which nothing has been sent or seen."""
    n = len(settings.joint_names)
    return DriveDelays(
        delay_s=np.zeros(n), samples=np.full((SAMPLES, n), np.nan), onset=np.zeros((6, n)), sent=np.zeros(n),
        past=np.zeros((math.ceil(LONGEST_S * settings.rate_hz) + 2, n)), velocity=np.zeros(n),
        under_way=np.zeros(n), accounted=np.zeros(n), missing=np.zeros(n),
    )  # fmt: skip


@kernel
def measure_delays(
    command: FloatArray, q: FloatArray, answers: FloatArray, dt_s: float, sent: FloatArray, onset: FloatArray,
    samples: FloatArray, delay_s: FloatArray,
) -> None:  # fmt: skip
    """Account for ``dt_s`` [s] at the velocities ``command`` (n,), into the arrays of `DriveDelays`.

    ``answers`` (n,): by which the readings ``q`` (n,) answer.
    """
    for j in range(q.shape[0]):
        sent[j] += command[j] * dt_s
        travel = ONSET_TRAVEL * answers[j]
        onset[REST_S, j] = onset[REST_S, j] + dt_s if command[j] == 0.0 else 0.0
        if onset[PHASE, j] == WAITS and onset[REST_S, j] >= LONGEST_S:
            onset[PHASE, j] = RESTS
        if onset[PHASE, j] == RESTS:
            if command[j] == 0.0:
                onset[STOOD_AT, j], onset[SENT_BEFORE, j] = q[j], sent[j]
                continue
            onset[PHASE, j], onset[SINCE_S, j], onset[PASSED_S, j] = SETS_OUT, 0.0, -1.0
        if onset[PHASE, j] != SETS_OUT:
            continue
        onset[SINCE_S, j] += dt_s
        was_sent, made = sent[j] - onset[SENT_BEFORE, j], q[j] - onset[STOOD_AT, j]
        if onset[PASSED_S, j] >= 0.0:
            onset[PASSED_S, j] += dt_s
        elif abs(was_sent) >= travel:
            onset[PASSED_S, j] = 0.0
        late = onset[PASSED_S, j] > LONGEST_S or (onset[PASSED_S, j] < 0.0 and onset[SINCE_S, j] > ONSET_S)
        if abs(made) >= travel or late:
            onset[PHASE, j] = WAITS
            if not late and onset[PASSED_S, j] >= 0.0 and made * was_sent > 0.0:
                _push(samples[:, j], onset[PASSED_S, j])
                median_s = _median(samples[:, j])
                delay_s[j] = median_s if median_s >= LEAST_S else 0.0


@kernel
def _push(samples: FloatArray, newest: float) -> None:
    for k in range(samples.shape[0] - 1):
        samples[k] = samples[k + 1]
    samples[-1] = newest


@kernel
def _median(samples: FloatArray) -> float:
    """Of those that are numbers: the middle one, of two the greater."""
    known = np.sort(samples[np.isfinite(samples)])
    return float(known[known.size // 2])


@kernel
def account_travel(
    command: FloatArray, moved: FloatArray, told: bool, keep: float, dt_s: float, period_s: float, step: int,
    delays: tuple[FloatArray, ...], untold: FloatArray, missing: FloatArray,
) -> None:  # fmt: skip
    """Account for ``dt_s`` [s] of travel, sent as of now in ``untold`` and ``missing`` (n,), as of the delays in
    ``delays``: `DriveDelays`' ``delay_s``, ``sent``, ``past``, ``velocity``, ``under_way``, ``accounted``, ``missing``.

    ``moved`` (n,): of the readings since they were last ``told``; ``keep``: share of what is missing that is kept.
    """
    delay_s, sent, past, velocity, under_way, accounted, missing_late = delays
    rows = past.shape[0]
    for j in range(command.shape[0]):
        untold[j] += command[j] * dt_s
        past[step % rows, j] = sent[j]
        back = min(round(delay_s[j] / period_s), rows - 2)
        arrived = past[(step - back) % rows, j]
        under_way[j] = sent[j] - arrived
        velocity[j] = (arrived - past[(step - back - 1) % rows, j]) / dt_s if dt_s > 0.0 else 0.0
        if not told:
            missing[j] *= keep
            missing_late[j] *= keep
            continue
        missing[j] = keep * (missing[j] + untold[j] - moved[j])
        missing_late[j] = keep * (missing_late[j] + arrived - accounted[j] - moved[j])
        untold[j], accounted[j] = 0.0, arrived


@kernel
def account_silence(
    q: FloatArray, velocity: FloatArray, answers: FloatArray, friction: FloatArray, dt_s: float,
    silent_from: FloatArray, silent_travel: FloatArray, silent_s: FloatArray,
) -> None:  # fmt: skip
    """Add up what each joint was sent (``velocity`` (n,), as it arrives), and for how long, since its reading changed.

    ``friction`` (n,) may hold the rest back.
    """
    for j in range(q.shape[0]):
        if abs(q[j] - silent_from[j]) > answers[j]:
            silent_from[j], silent_travel[j], silent_s[j] = q[j], 0.0, 0.0
            continue
        felt = velocity[j] - min(max(velocity[j], -friction[j]), friction[j])
        silent_travel[j] += felt * dt_s
        if felt != 0.0:
            silent_s[j] += dt_s
