"""What becomes of the motion source's velocity, in one kernel: friction is added, late drives are looked ahead of, and
the safety stage, the last one, makes a command of it.
"""

from __future__ import annotations

from stereoservo.core.cycle import NOT_MEASURED
from stereoservo.core.friction import add_friction
from stereoservo.core.ingest import TAKEN
from stereoservo.core.limit import FRESH, Bounds, Wanted, limit_velocity
from stereoservo.core.sources.progress import follow_error
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel


@kernel
def command(block: Record, room: Record, keep_outs: FloatArray) -> None:
    """Stage 6: the ``command`` (n,) of the block by the ``velocity`` (n,) of the motion in the ``room``; zero where the
    drives are not active. ``limited`` of the room: whether there is anything to tell of it;
    ``result``: the values that recordings keep, whose error is that of a law's kernel here.
    """
    memory, work = block[0], room[0]
    n = memory.joints
    sent, velocity, raw = memory.command[:n], work.velocity[:n], work.raw[:n]
    if work.rests != 0:
        velocity[:] = 0.0
    newest_ns = 0
    for c in range(memory.cameras):
        newest_ns = max(newest_ns, memory.estimates[c].accepted_ns)
    work.features_ns = newest_ns
    feature_age_s = (work.now_ns - newest_ns) * 1e-9
    work.added = 0
    if work.compensates != 0:
        looks = work.joints_found == TAKEN and (
            work.needs_features == 0 or feature_age_s <= work.bounds[FRESH]
        )
        work.added = int(add_friction(block, room, looks))
    if work.added == 0:
        raw[:] = velocity
    _foresee(block, room)
    work.previous[:n] = sent
    limits = Bounds(work.limits[: 4 * n].reshape((4, n)), work.bounds, keep_outs)
    wanted = Wanted(
        raw, work.outermost[:n], work.previous[:n], work.paused != 0, work.dt_s,
        (work.now_ns - memory.last_joints_ns) * 1e-9, feature_age_s, work.needs_features != 0, work.speed_scale,
    )  # fmt: skip
    told, found = limit_velocity(wanted, limits, sent, work.acted[:n])
    work.limited, work.finite = int(told), int(found.finite)
    work.allowed_scale, work.scale, work.share = found.speed_scale, found.scale, found.share
    work.scaled_by, work.shared_by = found.scaled_by, found.shared_by
    if work.active == 0:
        sent[:] = 0.0
    work.result[0] = work.error_px if work.rests == 0 and work.measured != 0 else NOT_MEASURED
    work.result[1 : 1 + n], work.result[1 + n : 1 + 2 * n] = raw, memory.velocities[:n]
    work.result[1 + 2 * n : 1 + 3 * n] = sent
    if work.runs != 0:
        follow_error(block, work.tolerance_px, work.dt_s)


@kernel
def _foresee(block: Record, room: Record) -> None:
    """Into ``outermost`` (n,) of the ``room``, where joints are, or, of late drives, will be before they obey the
    velocity, farthest towards where they go.
    """
    memory, work = block[0], room[0]
    for j in range(memory.joints):
        q, velocity = work.q[j], work.raw[j]
        work.outermost[j] = q
        if memory.delay_s[j] == 0.0:
            continue
        ahead = q + memory.delay_under_way[j]
        towards = velocity if velocity != 0.0 else memory.command[j]
        work.outermost[j] = max(q, ahead) if towards > 0.0 else min(q, ahead)
