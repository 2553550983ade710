"""What a step observes, before anything is decided: the kernels of the stages 1 to 3 and of the active goal's progress,
in their order.
"""

from __future__ import annotations

from stereoservo.core.context import StepContext
from stereoservo.core.estimate import estimate, note_frames, take_frames_apart
from stereoservo.core.ingest import ingest
from stereoservo.core.monitor import detect
from stereoservo.core.sources.law import follow_goal


def observe(context: StepContext, *, decides: bool) -> int:
    """What the stages have found, as bits of a number (`ingest`, `monitor`); the present, where there is a model.

    The goal's progress is looked at here in steps in which nothing is decided before the motion; where Python
    ``decides``, or anything is found, the goal may be another one then, and its law looks itself.
    """
    derived = context.derived
    room, block = derived.room, context.state.block
    work, record, space = room.numbers, block.record, room.record
    found = ingest(record, space)
    if work.frames_apart:
        take_frames_apart(context)
    if derived.arrays is None:
        note_frames(record, space)
    else:
        estimate(record, space)
        if block.numbers.history_count:
            context.arrays = context.moved_arrays or derived.arrays
            context.prediction, context.weights, context.pixels = room.prediction, room.weights, room.pixels
    found |= detect(record, space)
    context.goes_on = bool(work.aims) and not found and not decides and follow_goal(record, space)
    return found
