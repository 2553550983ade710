"""Joints that do not follow: bounds, sums and reasons of the watch in `core.monitor`.

What a joint was sent is compared with its reading as of now and as of its drive's delay
(`core.late_drives.measure_delays`), and what lies between the two is not missing.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from stereoservo.core.settings import CoreSettings
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel

MEMORY_S = 1.0  # after which a missing travel is forgotten: drives have gain errors of per cents
LAG_S = 0.15  # a healthy drive lags by less than this at full speed
SILENCE_S = 0.25  # of motion after which a reading has answered, whatever the drive's lag
PLAY = {"revolute": 0.06, "prismatic": 0.005}  # [rad, m] sent before a healthy joint's reading answers
ANSWERS = {
    "revolute": 1e-3,
    "prismatic": 1e-4,
}  # [rad, m] by which a reading answers, where its step is no coarser
FRICTION = {"revolute": 0.01, "prismatic": 0.001}  # [rad/s, m/s] below which a healthy joint may stick


@lru_cache(maxsize=8)
def of_kinds(
    kinds: tuple[str, ...], resolution: tuple[float, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``PLAY``, ``ANSWERS`` and ``FRICTION`` (n,) of joints of these kinds and encoder steps; not to be written to."""
    play, answers, friction = (
        np.array([value[kind] for kind in kinds]) for value in (PLAY, ANSWERS, FRICTION)
    )
    if resolution:
        answers = np.maximum(answers, 1.5 * np.array(resolution))  # one step to and fro is no motion
    for value in (play, answers, friction):
        value.setflags(write=False)
    return play, answers, friction


def not_following(joint: int, missing: float, limit: float, delay_s: float, settings: CoreSettings) -> Reason:
    """That a joint lacks ``missing`` of its travel, with its sign, of which ``limit`` is lag."""
    name, unit = settings.joint_names[joint], settings.joint_unit(joint)
    known = f", {delay_s:.2f} s of delay apart" if delay_s > 0.0 else ""
    return Reason(
        "JOINT_NOT_FOLLOWING", "fault", name, abs(missing), limit, unit,
        f"joint {name} lacks {missing:+.3f} {unit} of the travel it was sent (up to {limit:.3f} is lag{known}): check "
        "its encoder, brake and drive; then reset and enable",
    )  # fmt: skip


def silent(joint: int, sent: float, since_s: float, settings: CoreSettings) -> Reason:
    """That the reading of a joint stood still for ``since_s`` while it was ``sent`` travel."""
    name, unit, limit = (
        settings.joint_names[joint],
        settings.joint_unit(joint),
        PLAY[settings.joint_kinds[joint]],
    )
    return Reason(
        "JOINT_NOT_FOLLOWING", "fault", name, abs(sent), limit, unit,
        f"the reading of joint {name} stood still for {since_s:.2f} s while it was sent {sent:+.3f} {unit} of travel "
        f"(up to {limit:g} may be play): check its encoder, brake and drive; then reset and enable",
    )  # fmt: skip


@kernel
def worst_follower(allowed: FloatArray, now: FloatArray, late: FloatArray) -> tuple[int, float]:
    """The joint that lacks most of its travel, over what is ``allowed`` (n,), and how much, with its sign; -1: none.

    What it was sent as of ``now`` and as of its delay (``late``, (n,) each) bounds where it should be.
    """
    worst, most = -1, 1.0
    missing = 0.0
    for j in range(allowed.shape[0]):
        beyond = min(abs(now[j]), abs(late[j])) if now[j] * late[j] > 0.0 else 0.0
        if beyond > most * allowed[j]:
            worst, most, missing = j, beyond / allowed[j], math.copysign(beyond, now[j])
    return worst, missing


@kernel
def account_silence(block: Record, room: Record) -> None:
    """Add up what each joint was sent, as it arrives, and for how long, since its reading changed; friction may hold
    some of it back.
    """
    memory, work = block[0], room[0]
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
