"""What an ordinary step of the core costs, in counts: how much Python it runs, and what it does not make anew."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import stereoservo
from stereoservo.core.cycle import StepOutputs
from stereoservo.messages.goals import LawName
from stereoservo_sim.benchmarks.core_loop import CoreLoop
from stereoservo_sim.benchmarks.cycle import drive
from stereoservo_sim.world.synthetic import rx90

PACKAGE = str(Path(stereoservo.__file__).parent)
LINES = {"stereo": 270, "cartesian3": 280, "trajectory": 560}
"""Of Python that a step between frames may run, kernels apart (242, 251, 513 when this was written; 388, 397, 508
by the stages alone; 533, 551, 614 with a call from Python for each part of a stage), in a step that sends no priors.
"""

FRAME_LINES = {"stereo": 480, "cartesian3": 530}
"""Likewise of a step with frames of two cameras (439, 484 when this was written; 584, 629 by the stages alone)."""


def lines_of(loop: CoreLoop) -> tuple[int, StepOutputs]:
    """Lines of Python of the package that the next step runs, and its outputs."""
    count, step = [0], loop.core.step

    def line(frame: FrameType, event: str, argument: Any) -> Any:
        count[0] += event == "line"
        return line

    def call(frame: FrameType, event: str, argument: Any) -> Any:
        return line if frame.f_code.co_filename.startswith(PACKAGE) else None

    def traced(inputs: Any) -> StepOutputs:
        before = sys.gettrace()
        sys.settrace(call)
        try:
            return step(inputs)
        finally:
            sys.settrace(before)

    loop.core.step = traced  # type: ignore[method-assign]
    try:
        outputs = loop.step()
    finally:
        loop.core.step = step  # type: ignore[method-assign]
    return count[0], outputs


@pytest.mark.parametrize("law", list(LINES))
def test_a_step_between_frames_runs_little_python(law: LawName) -> None:
    loop, found = CoreLoop(rx90(), 1), []
    drive(loop, law, 60)
    for _ in range(30):
        lines, outputs = lines_of(loop)
        if loop.kind == "moving, between" and not outputs.priors and not outputs.status.reasons:
            found.append(lines)
    assert len(found) >= 5
    assert min(found) <= LINES[law]


@pytest.mark.parametrize("law", list(FRAME_LINES))
def test_a_step_with_frames_runs_little_python(law: LawName) -> None:
    loop, found = CoreLoop(rx90(), 1), []
    drive(loop, law, 60)
    for _ in range(60):
        lines, outputs = lines_of(loop)
        if loop.kind == "moving, frames" and not outputs.status.reasons:
            found.append(lines)
    assert len(found) >= 3
    assert min(found) <= FRAME_LINES[law]


def test_what_has_not_changed_since_the_last_step_is_told_by_the_same_objects() -> None:
    loop = CoreLoop(rx90(), 1)
    drive(loop, "stereo", 60)
    before = loop.step().status
    for _ in range(20):
        now = loop.step().status
        same = [
            now.health is before.health,
            now.innovation_px is before.innovation_px,
            now.visible is before.visible,
        ]
        assert loop.kind in ("moving, between", "moving, frames")
        assert all(same) if loop.kind == "moving, between" else not any(same[1:])
        before = now
