"""What a step of the core does is bounded, and grows no faster than the markers: counted, never in time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from stereoservo.control.marker_groups import with_groups
from stereoservo.core.cycle import StepInputs, StepOutputs, encode
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state import ServoGoal
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.kinematics.model import save_model
from stereoservo.messages.goals import Goal, Request, RunGoal
from stereoservo_sim.benchmarks.cycle import (
    CORE_STAGES,
    PARTS,
    CoreLoop,
    rx90_with_facets,
    timed_stages,
)
from stereoservo_sim.world.exact_model import exact_model

from .operation_counts import recorded
from .step_counts import counts

TESTS = str(Path(__file__).parents[1])
KERNELS_AS_PYTHON = {
    **os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join((TESTS, os.environ.get("PYTHONPATH", ""))),
}  # fmt: skip
SIZES = (4, 16, 64, 256)
GROWTH = 1.5
"""By how much the work of a marker may grow from one size to the next, four times as large: m log m, and no m²."""
ONCE = {"lines": 120_000, "bytes": 1_000_000}
"""What a step may do whatever the body: every three of the 24 markers that are tried, in two cameras."""


MOST_LINES = {"kernels": 5_000_000, "Python": 10_000}
"""Of one step in the largest cell (256 markers, 8 cameras, 12 joints); `bench cycle` tells how long they take."""
COSTLIEST = ("model", "moving, frames", "moving, way begun", "moving, update")


def of_lines(model: Path, markers: int) -> dict[str, int]:
    """Lines of each kind of step, in a process in which kernels are Python."""
    script = Path(__file__).with_name("step_counts.py")
    done = subprocess.run(
        [sys.executable, str(script), str(model), str(markers)],
        capture_output=True, text=True, check=False, env=KERNELS_AS_PYTHON,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found: dict[str, int] = json.loads(done.stdout)
    return found


def of_bytes(model: Path, markers: int) -> dict[str, int]:
    """Bytes of each kind of step that are no kernel's own."""
    return counts(model, markers, "bytes")


@pytest.mark.timeout(900)
@pytest.mark.parametrize("count", [of_bytes, pytest.param(of_lines, marks=pytest.mark.slow)])
def test_no_step_grows_faster_than_its_markers(count: Callable[[Path, int], dict[str, int]], tmp_path: Path) -> None:
    found = {}
    for markers in (SIZES[0], *SIZES):  # the first one loads what is loaded once
        path = tmp_path / f"{markers}.json"
        save_model(with_groups(exact_model(rx90_with_facets(markers, 2))), path)
        found[markers] = count(path, markers)
    print(json.dumps(found))
    once = ONCE[count.__name__.removeprefix("of_")]
    for kind in found[SIZES[0]]:
        for few, many in pairwise(SIZES):
            before, after = found[few][kind], found[many][kind]
            assert after <= max(GROWTH * (many / few) * before, once + before), (
                kind,
                few,
                many,
                before,
                after,
            )


@pytest.mark.timeout(900)
@pytest.mark.parametrize("kinds", [COSTLIEST, pytest.param((), marks=pytest.mark.slow)], ids=["costliest", "all"])
def test_no_step_in_the_largest_cell_does_more_than_is_stated(kinds: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "steps.msgpack"
    done = recorded(path, kinds)
    assert set(kinds) <= set(done)
    script = Path(__file__).with_name("operation_counts.py")
    run = subprocess.run(
        [sys.executable, str(script), str(path)],
        capture_output=True, text=True, check=False, env=KERNELS_AS_PYTHON,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    found: dict[str, tuple[int, int]] = json.loads(run.stdout)
    print(json.dumps(found))
    assert set(found) == set(done)
    for kind, (kernels, other) in found.items():
        assert 0 < kernels <= MOST_LINES["kernels"], (kind, kernels)
        assert 0 < other <= MOST_LINES["Python"], (kind, other)


class Twin(CoreLoop):
    """Runs each step a second time, by a core whose state has been written and read."""

    again: StepOutputs | None = None

    def before(self, kind: str, inputs: StepInputs) -> None:
        copied = decode_state(encode_state(self.core.state))
        self.again = ServoCore(self.core.settings, copied).step(inputs)

    def step(self, **inputs: Any) -> StepOutputs:
        outputs = super().step(**inputs)
        assert encode(self.again) == encode(outputs)
        return outputs


def test_a_goal_of_a_large_body_goes_on_from_every_state_bit_for_bit() -> None:
    cell = rx90_with_facets(256, 4)
    loop = Twin(cell, 0, with_groups(exact_model(cell)))
    for number in range(2):  # the second one preempts the first
        loop.start_goal("cartesian3", number)
        for _ in range(3):
            loop.step()
    kinds = {kind for kind, _ in loop.times}
    assert {*PARTS, "way begun", "told"} <= kinds
    assert {f"moving, {part}" for part in (*PARTS, "way begun", "told")} <= kinds


def test_a_goal_of_a_large_body_is_refused_where_the_clock_goes_back_amid_its_resolution() -> None:
    cell = rx90_with_facets(96, 2)
    loop = CoreLoop(cell, 0, with_groups(exact_model(cell)))
    loop.take_model()
    loop.step()
    check = Goal("00000001", loop.target_at(0.3), law="cartesian3", check=True)
    loop.step(requests=(Request(9, "test", RunGoal(check)),))
    job = loop.core.state.planning
    assert job is not None
    assert job.resolution is not None
    back = StepInputs(loop.now_ns - 10**9, 10**7, None, driver_active=True)
    (reply,) = [event for event in loop.core.step(back).events if event.kind == "reply"]
    assert (reply.request, reply.accepted, loop.core.state.planning) == (9, False, None)


def test_a_way_that_is_planned_anew_at_rest_goes_on_from_every_state_bit_for_bit() -> None:
    cell = rx90_with_facets(8, 2)
    loop = Twin(cell, 0, with_groups(exact_model(cell)))
    loop.take_model()
    goals = (
        Goal("00000001", loop.target_at(0.4), law="cartesian3", gain=2.0),
        Goal("00000002", loop.target_at(-0.3), law="trajectory"),  # planned while the arm moves on: anew at rest
    )
    anew = 0
    for number, (goal, steps) in enumerate(zip(goals, (50, 120), strict=True)):
        loop.step(requests=(Request(9 + number, "test", RunGoal(goal)),))
        for _ in range(steps):
            job = loop.core.state.planning
            anew += job is not None and job.purpose == "again"
            loop.step()
    source = loop.core.state.source
    assert anew > 0
    assert isinstance(source, ServoGoal)
    assert source.plan is not None


def test_every_stage_of_a_step_is_timed() -> None:
    cell = rx90_with_facets(8, 2)
    loop = CoreLoop(cell, 0, with_groups(exact_model(cell)))
    loop.start_goal("stereo")
    with timed_stages(loop) as stages:
        for _ in range(3):
            loop.step()
    assert {stage: len(times) for stage, times in stages.items()} == dict.fromkeys(CORE_STAGES, 3)
