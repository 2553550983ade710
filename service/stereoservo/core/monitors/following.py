"""Following-error monitoring: bounds, sums and reasons for joints that do not follow their commands, and the delays of
drives.

The commanded travel of a joint is compared with its reading, once without delay and once with its drive's delay
(`measure_delays`); travel between the two does not count as missing. The delay of a drive may be unknown. It is
measured for each joint at each start from rest, as the time from a small commanded travel until the reading shows it.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from stereoservo.core.block import DELAY_SAMPLES, LONGEST_DELAY_S
from stereoservo.core.monitor_state import DriveDelays
from stereoservo.core.settings import CoreSettings
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel

MEMORY_S = 1.0  # after which a missing travel is forgotten: drives have gain errors of a few per cent
LAG_S = 0.15  # a healthy drive lags by less than this at full speed
SILENCE_S = 0.25  # of motion after which a reading has answered, whatever the drive's lag
PLAY = {"revolute": 0.06, "prismatic": 0.005}  # [rad, m] commanded before a healthy joint's reading changes
ANSWERS = {
    "revolute": 1e-3,
    "prismatic": 1e-4,
}  # [rad, m] least change of a reading, for encoders without coarser steps
FRICTION = {"revolute": 0.01, "prismatic": 0.001}  # [rad/s, m/s] below which a healthy joint may stick


@lru_cache(maxsize=8)
def of_kinds(kinds: tuple[str, ...], resolution: tuple[float, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``PLAY``, ``ANSWERS`` and ``FRICTION`` (n,) of joints of these kinds and encoder steps; read-only."""
    play, answers, friction = (np.array([value[kind] for kind in kinds]) for value in (PLAY, ANSWERS, FRICTION))
    if resolution:
        answers = np.maximum(answers, 1.5 * np.array(resolution))  # one encoder step to and fro is no motion
    for value in (play, answers, friction):
        value.setflags(write=False)
    return play, answers, friction


def not_following(joint: int, missing: float, limit: float, delay_s: float, settings: CoreSettings) -> Reason:
    """Reason: a joint lacks ``missing`` of its travel, with its sign; ``limit`` is the travel explained by lag."""
    name, unit = settings.joint_names[joint], settings.joint_unit(joint)
    known = f", {delay_s:.2f} s of delay apart" if delay_s > 0.0 else ""
    return Reason(
        "JOINT_NOT_FOLLOWING",
        "fault",
        name,
        abs(missing),
        limit,
        unit,
        f"joint {name} lacks {missing:+.3f} {unit} of the travel it was sent (up to {limit:.3f} is lag{known}): check "
        "its encoder, brake and drive; then reset and enable",
    )


def silent(joint: int, sent: float, since_s: float, settings: CoreSettings) -> Reason:
    """Reason: the reading of a joint did not change for ``since_s`` while the travel ``sent`` was commanded."""
    name, unit, limit = (
        settings.joint_names[joint],
        settings.joint_unit(joint),
        PLAY[settings.joint_kinds[joint]],
    )
    return Reason(
        "JOINT_NOT_FOLLOWING",
        "fault",
        name,
        abs(sent),
        limit,
        unit,
        f"the reading of joint {name} stood still for {since_s:.2f} s while it was sent {sent:+.3f} {unit} of travel "
        f"(up to {limit:g} may be play): check its encoder, brake and drive; then reset and enable",
    )


@kernel
def worst_follower(allowed: FloatArray, now: FloatArray, late: FloatArray) -> tuple[int, float]:
    """The joint with the largest missing travel relative to ``allowed`` (n,), and its missing travel with sign; -1:
    none.

    The missing travel without delay (``now``) and with the drive's delay (``late``), (n,) each, bound the true one.
    """
    worst, most = -1, 1.0
    missing = 0.0
    for j in range(allowed.shape[0]):
        beyond = min(abs(now[j]), abs(late[j])) if now[j] * late[j] > 0.0 else 0.0
        if beyond > most * allowed[j]:
            worst, most, missing = j, beyond / allowed[j], math.copysign(beyond, now[j])
    return worst, missing


@kernel
def account_silence(block: Record, workspace: Record) -> None:
    """Add up the travel commanded to each joint, at the time of its arrival, and its duration, since the reading last
    changed, less the part that friction may hold back.
    """
    memory, work = block[0], workspace[0]
    n, dt_s = memory.joints, work.elapsed_s
    q, velocity, answers, friction = (
        work.q[:n],
        memory.delay_velocity[:n],
        work.answers[:n],
        work.friction[:n],
    )
    silent_from, silent_travel, silent_s = (
        memory.silent_from[:n],
        memory.silent_travel[:n],
        memory.silent_s[:n],
    )
    for j in range(q.shape[0]):
        if abs(q[j] - silent_from[j]) > answers[j]:
            silent_from[j], silent_travel[j], silent_s[j] = q[j], 0.0, 0.0
            continue
        felt = velocity[j] - min(max(velocity[j], -friction[j]), friction[j])
        silent_travel[j] += felt * dt_s
        if felt != 0.0:
            silent_s[j] += dt_s


LEAST_S = 0.04
"""Least delay that is used [s]: friction and play look like shorter ones."""
ONSET_S = 0.1
"""Time [s] within which the measured travel must be commanded at a start from rest; at lower speed, friction and play
would distort the result.
"""
ONSET_TRAVEL = 2.0
"""Travel used for the measurement, as a multiple of the least change of a reading."""
WAITS, RESTS, SETS_OUT = 0.0, 1.0, 2.0
"""Phases of a measurement."""
STEADY = 0.1
"""Largest difference between the current and the arriving command of a joint, as a fraction, for a motion to be steady
enough to measure the delay.
"""
PHASE, RESTED_S, STOOD_AT, SENT_BEFORE, SINCE_S, PASSED_S, DIRECTION = range(7)
"""Rows of `DriveDelays.onset`."""


@kernel
def delays_of(block: Record) -> DriveDelays:
    """The arrays of the ``block`` for drive delays."""
    memory = block[0]
    n, past = memory.joints, memory.past
    return DriveDelays(
        memory.delay_s[:n],
        memory.delay_samples[: DELAY_SAMPLES * n].reshape((DELAY_SAMPLES, n)),
        memory.delay_onset[: 7 * n].reshape((7, n)),
        memory.delay_sent[:n],
        memory.delay_past[: past * n].reshape((past, n)),
        memory.delay_velocity[:n],
        memory.delay_under_way[:n],
        memory.delay_accounted[:n],
        memory.delay_missing[:n],
    )


@kernel
def measure_delays(command: FloatArray, q: FloatArray, answers: FloatArray, dt_s: float, delays: DriveDelays) -> None:
    """Update the ``delays`` by ``dt_s`` [s] at the velocities ``command`` (n,).

    ``answers`` (n,): least change of the readings ``q`` (n,).
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
            if command[j] * onset[DIRECTION, j] < 0.0 and math.isfinite(samples[-1, j]):
                onset[PHASE, j], onset[DIRECTION, j] = WAITS, command[j]  # it must pass through its play first
        if onset[PHASE, j] != SETS_OUT:
            continue
        onset[SINCE_S, j] += dt_s
        was_sent, made = sent[j] - onset[SENT_BEFORE, j], q[j] - onset[STOOD_AT, j]
        if onset[PASSED_S, j] >= 0.0:
            onset[PASSED_S, j] += dt_s
        elif abs(was_sent) >= travel:
            onset[PASSED_S, j] = 0.0
        late = onset[PASSED_S, j] > LONGEST_DELAY_S or (onset[PASSED_S, j] < 0.0 and onset[SINCE_S, j] > ONSET_S)
        if abs(made) >= travel or late:
            onset[PHASE, j], onset[DIRECTION, j] = WAITS, was_sent
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
    """The median of the finite samples; of two middle ones the greater."""
    known = samples[np.isfinite(samples)]
    for k in range(1, known.size):  # for these few `np.sort` would take longer to compile than ten kernels
        value, at = known[k], k
        while at > 0 and known[at - 1] > value:
            known[at] = known[at - 1]
            at -= 1
        known[at] = value
    return float(known[known.size // 2])


@kernel
def account_travel(block: Record, workspace: Record, command: FloatArray, fresh: bool, delays: DriveDelays) -> None:
    """Update the travel by the time since the last step at the velocities ``command`` (n,): without delay in the
    ``block``'s untold and missing travel, with delay in ``delays``.

    ``fresh``: whether the readings are new. If a joint in steady motion has moved farther than its delay allows, its
    delay is shorter; the shorter one is added to the samples.
    """
    memory, work = block[0], workspace[0]
    n, dt_s, step = memory.joints, work.elapsed_s, memory.delay_steps
    delay_s, samples, _, sent, past, velocity, in_transit, accounted, missing_late = delays
    untold, missing, answers = memory.untold_travel[:n], memory.missing_travel[:n], work.answers[:n]
    forgotten = max(0.0, 1.0 - dt_s / MEMORY_S)
    rows = past.shape[0]
    for j in range(command.shape[0]):
        untold[j] += command[j] * dt_s
        past[step % rows, j] = sent[j]
        back = min(round(delay_s[j] / work.period_s), rows - 2)
        arrived = past[(step - back) % rows, j]
        in_transit[j] = sent[j] - arrived
        if back == 0:
            velocity[j] = command[j]
        elif dt_s > 0.0:
            velocity[j] = (arrived - past[(step - back - 1) % rows, j]) / dt_s
        if not fresh:
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
        if back > 0 and steady and ahead > LEAST_S * speed + travel:  # play caused the longer time
            _push(samples[:, j], max(delay_s[j] - ahead / speed, 0.0))
            delay_s[j] = samples[-1, j] if samples[-1, j] >= LEAST_S else 0.0
