"""What the core's Python state says of the steps to come, written where kernels read it: only after a step in which
Python has changed anything.
"""

from __future__ import annotations

import sys

from stereoservo.core import monitor
from stereoservo.core.command import friction_bounds
from stereoservo.core.context import StepContext
from stereoservo.core.estimate import offset_rules, place_unknown
from stereoservo.core.monitor import NOISE, QUIET, looks_apart
from stereoservo.core.move import MOTION_SOURCES, arrange_motion, paused
from stereoservo.core.sources.law import aim_at, by_kernel
from stereoservo.core.state import CalibrationMotion, Holding, Leased, ServoGoal, Source
from stereoservo.messages.status import Lifecycle

FAULTY = (Lifecycle.FAULT, Lifecycle.UNCONFIGURED)
"""In which joints are no measure of cameras."""


def arrange(context: StepContext) -> None:
    """Write what stands into the workspace."""
    state, settings, derived = context.state, context.settings, context.derived
    room, watching, kind = derived.room, state.watching, MOTION_SOURCES[type(state.source)]
    work, given = room.numbers, room.arrays
    work.active, work.faulty = state.lifecycle is Lifecycle.ACTIVE, state.lifecycle in FAULTY
    work.stopped, work.by_images = state.stopped, kind.by_images
    work.learning = isinstance(state.source, CalibrationMotion)
    work.rounds_apart = looks_apart(state)
    work.frames_apart = any(state.mobile) or state.target is not None
    work.quiet = watching.last == QUIET and watching.verdict == NOISE
    work.paused = paused(state)
    if derived.arrays is not None:
        given["masked"][:] = watching.masked
    for c, (rule, stated_ns) in enumerate(offset_rules(state, settings)):
        given["unknown"][c] = place_unknown(c, state, settings)
        given["offset_rule"][c], given["stated_offset_ns"][c] = rule, stated_ns
    inexact = state.model is not None and state.model.joint_accuracy is not None
    given["friction_most"][:], given["friction_travel"][:] = friction_bounds(
        settings.joint_kinds, settings.resolution, inexact
    )
    source = state.source
    work.aims = (
        isinstance(source, ServoGoal)
        and derived.arrays is not None
        and by_kernel(source, derived.laws[source.law])
        and bool(work.active)
        and not work.paused
    )
    if work.aims and isinstance(source, ServoGoal):
        aim_at(room, source)
    arrange_motion(context)


def attends(context: StepContext) -> bool:
    """Whether Python has to look after the state in every step: a monitor asks for it, or a goal that is planned,
    queued, waits, or cannot go on.
    """
    state, source = context.state, context.state.source
    return (
        any(entry.attends(state) for entry in monitor.MONITORS)
        or any(state.mobile)
        or bool(state.queue or state.waiting or state.queued_until_ns)
        or state.planning is not None
        or state.ahead is not None
        or MOTION_SOURCES[type(source)].waits(source, context)
        or (state.lifecycle is not Lifecycle.ACTIVE and not isinstance(source, Holding))
    )


NEVER_NS = sys.maxsize


def lease_until_ns(source: Source) -> int:
    """When the lease of the active source runs out; `NEVER_NS` where it has none."""
    if not isinstance(source, Leased) or source.lease_s is None:
        return NEVER_NS
    return source.lease_until_ns
