"""What an ordinary step of the core costs, in counts: how much Python it runs."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import stereoservo
from stereoservo.core.cycle import StepInputs
from stereoservo.messages.goals import LawName
from stereoservo_sim.benchmarks.cycle import CoreLoop, drive
from stereoservo_sim.world.synthetic import rx90

PACKAGE = str(Path(stereoservo.__file__).parent)
LINES = {"stereo": 105, "cartesian3": 110, "trajectory": 450}
"""Of Python that a step between frames may run, kernels apart (92, 96, 417 when this was written; 242, 251, 513 by
the fast path that was beside the stages, with the outputs that it made in every step; 388, 397, 508 by the stages).
"""

FRAME_LINES = {"stereo": 130, "cartesian3": 160}
"""Likewise of a step with frames of two cameras (117, 143 when this was written; 439, 484 by the fast path)."""


def lines_of(loop: CoreLoop) -> int:
    """Lines of Python of the package that the next step runs, without what is asked of it afterwards."""
    count, advance = [0], loop.core.advance

    def line(frame: FrameType, event: str, argument: Any) -> Any:
        count[0] += event == "line"
        return line

    def call(frame: FrameType, event: str, argument: Any) -> Any:
        return line if frame.f_code.co_filename.startswith(PACKAGE) else None

    def traced(inputs: StepInputs) -> None:
        before = sys.gettrace()
        sys.settrace(call)
        try:
            advance(inputs)
        finally:
            sys.settrace(before)

    loop.core.advance = traced  # type: ignore[method-assign]
    try:
        loop.step()
    finally:
        loop.core.advance = advance  # type: ignore[method-assign]
    return count[0]


@pytest.mark.parametrize("law", list(LINES))
def test_a_step_between_frames_runs_little_python(law: LawName) -> None:
    loop = CoreLoop(rx90(), 1)
    drive(loop, law, 60)
    found = [lines for lines in (lines_of(loop) for _ in range(30)) if loop.kind == "moving, between"]
    assert len(found) >= 5
    assert sorted(found)[len(found) // 2] <= LINES[law]


@pytest.mark.parametrize("law", list(FRAME_LINES))
def test_a_step_with_frames_runs_little_python(law: LawName) -> None:
    loop = CoreLoop(rx90(), 1)
    drive(loop, law, 60)
    found = [lines for lines in (lines_of(loop) for _ in range(60)) if loop.kind == "moving, frames"]
    assert len(found) >= 3
    assert sorted(found)[len(found) // 2] <= FRAME_LINES[law]
