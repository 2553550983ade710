"""Counts what steps of the core do, with kernels as Python: ``NUMBA_DISABLE_JIT=1 step_counts.py MODEL MARKERS``.

Prints one JSON object: for each kind of step the most lines of this package that one ran. ``MODEL``: file of the model
of `rx90_with_facets`, with its coplanar groups.
"""

from __future__ import annotations

import json
import sys
import tracemalloc
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import numpy as np

import stereoservo
from core.operation_counts import part_by_attribute
from stereoservo.core.cycle import StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.kinematics.model import load_model
from stereoservo.messages.goals import (
    CancelGoal,
    Command,
    DisplacementTarget,
    Feature,
    Goal,
    IncidenceSpec,
    IncidenceTarget,
    JointTarget,
    PointTarget,
    Request,
    RunGoal,
    Target,
    Teach,
    UpdateGoal,
)
from stereoservo_sim.benchmarks.cycle import CoreLoop, rx90_with_facets

PACKAGE = str(Path(stereoservo.__file__).parent)


class CountedCore(ServoCore):
    """A core that counts the lines of its package that each step runs, or the bytes that it has allocated at once."""

    def __init__(self, core: ServoCore, measure: Literal["lines", "bytes"]) -> None:
        super().__init__(core.settings, core.state)
        self.measure, self.lines, self.name = measure, 0, ""
        self.most: dict[str, int] = {}
        if measure == "lines":
            part_by_attribute(self)

    def step(self, inputs: StepInputs) -> StepOutputs:
        self.lines = 0
        if self.measure == "bytes":
            tracemalloc.start()
        else:
            sys.settrace(self._call)
        try:
            outputs = super().step(inputs)
        finally:
            sys.settrace(None)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        self.most[self.name] = max(self.most.get(self.name, 0), self.lines, peak)
        return outputs

    def _call(self, frame: FrameType, event: str, argument: Any) -> Any:
        return self._line if frame.f_code.co_filename.startswith(PACKAGE) else None

    def _line(self, frame: FrameType, event: str, argument: Any) -> Any:
        self.lines += event == "line"
        return self._line


def counts(model_path: Path, markers: int, measure: Literal["lines", "bytes"]) -> dict[str, int]:
    """The most of each kind of step, in a run that takes in every kind."""
    cell = rx90_with_facets(markers, 2)
    model = load_model(model_path)
    loop = CoreLoop(cell, 0, model)
    core = loop.core = CountedCore(loop.core, measure)
    number = 0

    def run(name: str, *commands: Command, steps: int = 1) -> list[StepOutputs]:
        nonlocal number
        number += 1
        core.name = name
        requests = tuple(Request(number, "test", command) for command in commands)
        return [loop.step(requests=requests), *(loop.step() for _ in range(steps - 1))]

    def goal(name: str, target: Target, **options: Any) -> Goal:
        return Goal(f"00000000-0000-0000-0000-{number:012d}", target, **options)

    def replies(outputs: list[StepOutputs]) -> list[Any]:
        return [event for output in outputs for event in output.events if event.kind == "reply"]

    def answered(name: str, asked: Goal) -> None:
        """Ask for a goal, and go on until it is answered: of a large body after some steps."""
        answers = replies(run(name, RunGoal(asked)))
        for _ in range(100):
            if answers:
                break
            answers = replies([loop.step()])
        if not (answers and answers[0].accepted):
            raise RuntimeError(f"goal of {name}: {[answer.message for answer in answers]}")

    core.name = "model"
    loop.take_model()
    run("steps", steps=12)
    far = goal("far", loop.target_at(0.03), law="cartesian3")
    run("features", RunGoal(far))
    run("planning", steps=3)
    run("cancel", CancelGoal(far.id))
    points = {i: tuple(X) for i, X in zip(model.marker_ids, model.marker_points.tolist(), strict=True)}
    first, second = model.marker_ids[:2]  # apart: of an incidence that is made already rounding alone says what can be
    corner = IncidenceSpec("point-on-point", Feature(markers=(first,)), Feature(points=(points[second],)))
    for name, target in (
        ("points", PointTarget(points, model.epoch)),
        ("displacement", DisplacementTarget(tuple(np.eye(4).ravel().tolist()), model.epoch)),
        ("joints", JointTarget({"j1": float(cell.home[0]) + 0.1})),
        ("incidence", IncidenceTarget((corner,), model_epoch=model.epoch)),
    ):
        answered(name, goal(name, target, check=True))
    here = goal("here", loop.target_at(0.0), law="cartesian3")
    answered("here", here)
    run("update", UpdateGoal(here.id, loop.target_at(0.001)))
    run("steps", steps=12)
    run("cancel", CancelGoal(here.id))
    run("teach", Teach("place", 2))
    run("taught", steps=23)
    loop.shift_px = 8.0  # as if a camera had been pushed
    run("pushed", steps=33)
    return core.most


if __name__ == "__main__":
    print(json.dumps(counts(Path(sys.argv[1]), int(sys.argv[2]), "lines")))
