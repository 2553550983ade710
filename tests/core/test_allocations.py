"""An ordinary step keeps nothing: neither objects nor bytes grow, however many steps there are."""

from __future__ import annotations

import gc
import sys
import tracemalloc
from typing import Any, NamedTuple

import pytest

from stereoservo.core.cycle import StepInputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state import Holding, ServoGoal
from stereoservo.messages.goals import Goal, Request, RunGoal
from stereoservo_sim.benchmarks import cycle
from stereoservo_sim.benchmarks.cycle import CoreLoop
from stereoservo_sim.world.synthetic import rx90

STEPS, WARM = 10_000, 1000
LEAST_BLOCKS, LEAST_BYTES = 50, 5000
"""What caches, and lists of free objects, may take once, of whatever many steps."""


class Advancing(ServoCore):
    """A core of which nothing but the command is asked; ``peaks``: the most bytes that a step has made at once, of
    those with frames and of those between them.
    """

    def __init__(self, core: ServoCore) -> None:
        super().__init__(core.settings, core.state)
        self.peaks = {"with frames": 0, "between": 0}

    def step(self, inputs: StepInputs) -> Any:
        if not tracemalloc.is_tracing():
            self.advance(inputs)
            return self.newest
        tracemalloc.reset_peak()
        before, _ = tracemalloc.get_traced_memory()
        self.advance(inputs)
        _, peak = tracemalloc.get_traced_memory()
        kind = "with frames" if inputs.observations else "between"
        self.peaks[kind] = max(self.peaks[kind], peak - before)
        return self.newest


class Leaking(Advancing):
    """That keeps an object a step."""

    def __init__(self, core: ServoCore) -> None:
        super().__init__(core)
        self.kept: list[object] = []

    def advance(self, inputs: StepInputs) -> None:
        super().advance(inputs)
        self.kept.append(object())


class Growth(NamedTuple):
    """Blocks of memory, and bytes, that are in use after so many steps and were not before."""

    blocks: int
    kept_bytes: int


def growth(loop: CoreLoop, steps: int) -> Growth:
    """Of a ``loop`` that runs so many steps twice: the blocks of the first run, which nothing watches, and the bytes of
    the second one.
    """

    def run(count: int) -> None:
        for _ in range(count):
            loop.step()
            loop.times.clear()

    run(WARM)
    gc.collect()
    blocks = sys.getallocatedblocks()
    run(steps)
    gc.collect()
    blocks = sys.getallocatedblocks() - blocks
    tracemalloc.start()
    try:
        run(WARM)  # what was made before is not traced: it would be missing where it is replaced
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        run(steps)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return Growth(blocks, after - before)


def loop_of(motion: str, core: type[Advancing] = Advancing) -> CoreLoop:
    """A core at rest with a model, or on its way to a goal by a law, slowly enough that it is so all the time."""
    loop = CoreLoop(rx90(), 0)
    loop.take_model()
    loop.core = core(loop.core)
    if motion != "rest":
        goal = Goal("00000001", loop.target_at(0.3), law=motion, gain=0.02)  # type: ignore[arg-type]
        loop.step(requests=(Request(2, "test", RunGoal(goal)),))
    return loop


@pytest.mark.parametrize("every", [cycle.FRAME_EVERY, 1], ids=["between frames", "frames in every step"])
@pytest.mark.parametrize("motion", ["rest", "stereo", "cartesian3"])
def test_an_ordinary_step_keeps_nothing(motion: str, every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cycle, "FRAME_EVERY", every)
    loop = loop_of(motion)
    found = growth(loop, STEPS)
    assert isinstance(loop.core.state.source, Holding if motion == "rest" else ServoGoal)
    assert loop.core.newest.command is not None
    assert loop.core.newest.command.any() == (motion != "rest")
    print(f"{motion}, frames every {every}: {found}, bytes at once: {loop.core.peaks}")  # type: ignore[attr-defined]
    assert found.blocks <= LEAST_BLOCKS
    assert found.kept_bytes <= LEAST_BYTES


def test_what_a_step_keeps_is_seen() -> None:
    found = growth(loop_of("rest", Leaking), 1000)
    assert found.blocks >= 990
    assert found.kept_bytes >= 16 * 990
