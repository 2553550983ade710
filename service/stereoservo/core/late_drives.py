"""Drives that answer commands a while later, and that nobody may have said so of: the delay of each joint is measured
where it sets out from rest, from when it was sent a small travel until its reading shows it; and the travel that is
under way.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.core.block import DELAY_SAMPLES, LONGEST_DELAY_S
from stereoservo.core.monitor_state import DriveDelays
from stereoservo.core.monitors.following import MEMORY_S
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel

LEAST_S = 0.04
"""Friction and play look like less."""
ONSET_S = 0.1
"""In which a joint that sets out must be sent the travel that is timed; friction and play would count at less speed."""
ONSET_TRAVEL = 2.0
"""The travel that is timed, times that by which a reading answers."""
WAITS, RESTS, SETS_OUT = 0.0, 1.0, 2.0
"""Phases of a measurement."""
STEADY = 0.1
"""Share of a joint's command from which the one that arrives may differ in a motion that tells of the delay."""
PHASE, RESTED_S, STOOD_AT, SENT_BEFORE, SINCE_S, PASSED_S, TOWARDS = range(7)
"""Rows of `DriveDelays.onset`."""


@kernel
def delays_of(block: Record) -> DriveDelays:
    """The arrays of the ``block`` that are of late drives."""
    memory = block[0]
    n, past = memory.joints, memory.past
    return DriveDelays(
        memory.delay_s[:n], memory.delay_samples[: DELAY_SAMPLES * n].reshape((DELAY_SAMPLES, n)),
        memory.delay_onset[: 7 * n].reshape((7, n)), memory.delay_sent[:n],
        memory.delay_past[: past * n].reshape((past, n)), memory.delay_velocity[:n], memory.delay_under_way[:n],
        memory.delay_accounted[:n], memory.delay_missing[:n],
    )  # fmt: skip


@kernel
def measure_delays(
    command: FloatArray, q: FloatArray, answers: FloatArray, dt_s: float, delays: DriveDelays
) -> None:
    """Account for ``dt_s`` [s] at the velocities ``command`` (n,), into the ``delays``.

    ``answers`` (n,): by which the readings ``q`` (n,) answer.
    """
    sent, onset, samples, delay_s = delays.sent, delays.onset, delays.samples, delays.delay_s
    for j in range(q.shape[0]):
        sent[j] += command[j] * dt_s
        travel = ONSET_TRAVEL * answers[j]
        onset[RESTED_S, j] = onset[RESTED_S, j] + dt_s if command[j] == 0.0 else 0.0
        if onset[PHASE, j] == WAITS and onset[RESTED_S, j] >= LONGEST_DELAY_S:
            onset[PHASE, j] = RESTS
        if onset[PHASE, j] == RESTS:
            if command[j] == 0.0:
                onset[STOOD_AT, j], onset[SENT_BEFORE, j] = q[j], sent[j]
                continue
            onset[PHASE, j], onset[SINCE_S, j], onset[PASSED_S, j] = SETS_OUT, 0.0, -1.0
            if command[j] * onset[TOWARDS, j] < 0.0 and math.isfinite(samples[-1, j]):
                onset[PHASE, j], onset[TOWARDS, j] = WAITS, command[j]  # through its play first
        if onset[PHASE, j] != SETS_OUT:
            continue
        onset[SINCE_S, j] += dt_s
        was_sent, made = sent[j] - onset[SENT_BEFORE, j], q[j] - onset[STOOD_AT, j]
        if onset[PASSED_S, j] >= 0.0:
            onset[PASSED_S, j] += dt_s
        elif abs(was_sent) >= travel:
            onset[PASSED_S, j] = 0.0
        late = onset[PASSED_S, j] > LONGEST_DELAY_S or (
            onset[PASSED_S, j] < 0.0 and onset[SINCE_S, j] > ONSET_S
        )
        if abs(made) >= travel or late:
            onset[PHASE, j], onset[TOWARDS, j] = WAITS, was_sent
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
def account_travel(block: Record, room: Record, command: FloatArray, told: bool, delays: DriveDelays) -> None:
    """Account for the time since the last step of travel at the velocities ``command`` (n,), as of now in the
    ``block``'s untold and missing travel, as of the delays in ``delays``.

    ``told``: whether the readings are news. A joint that makes, in steady motion, what has not arrived yet by its delay
    is less late: what it is goes into the samples.
    """
    memory, work = block[0], room[0]
    n, dt_s, step = memory.joints, work.elapsed_s, memory.delay_steps
    delay_s, samples, _, sent, past, velocity, under_way, accounted, missing_late = delays
    untold, missing, answers = memory.untold_travel[:n], memory.missing_travel[:n], work.answers[:n]
    forgotten = max(0.0, 1.0 - dt_s / MEMORY_S)
    rows = past.shape[0]
    for j in range(command.shape[0]):
        untold[j] += command[j] * dt_s
        past[step % rows, j] = sent[j]
        back = min(round(delay_s[j] / work.period_s), rows - 2)
        arrived = past[(step - back) % rows, j]
        under_way[j] = sent[j] - arrived
        if back == 0:
            velocity[j] = command[j]
        elif dt_s > 0.0:
            velocity[j] = (arrived - past[(step - back - 1) % rows, j]) / dt_s
        if not told:
            missing[j] *= forgotten
            missing_late[j] *= forgotten
            continue
        moved = work.q[j] - memory.last_positions[j]
        missing[j] = forgotten * (missing[j] + untold[j] - moved)
        missing_late[j] = forgotten * (missing_late[j] + arrived - accounted[j] - moved)
        untold[j], accounted[j] = 0.0, arrived
        speed, travel = abs(velocity[j]), ONSET_TRAVEL * answers[j]
        ahead = -math.copysign(missing_late[j], missing_late[j] * velocity[j])
        steady = abs(velocity[j] - command[j]) <= STEADY * speed and speed * ONSET_S >= travel
        if back > 0 and steady and ahead > LEAST_S * speed + travel:  # it was play that took so long
            _push(samples[:, j], max(delay_s[j] - ahead / speed, 0.0))
            delay_s[j] = samples[-1, j] if samples[-1, j] >= LEAST_S else 0.0
