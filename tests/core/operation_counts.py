"""Counts the operations of single core steps, with kernels as Python: ``NUMBA_DISABLE_JIT=1 operation_counts.py FILE``.

``FILE`` holds steps that `recorded` has written: a core is a function of its state and its inputs, so that each of them
can be run by itself. Prints one JSON object: for each step the lines of kernels and of other Python that it ran.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import msgspec
import numpy as np

from stereoservo.numerics import compilation

KERNELS: set[CodeType] = set()
PACKAGE = str(Path(compilation.__file__).parents[1])


class RecordedStep(msgspec.Struct):
    """A step of a core: what it does, the core's settings, its state before and its inputs, encoded."""

    kind: str
    settings: bytes
    state: bytes
    inputs: bytes


def mark_kernels() -> None:
    """Keep the code of every kernel that is defined from here on."""
    compile_kernel = compilation._compile

    def marked(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
        KERNELS.add(function.__code__)
        return compile_kernel(function, **options)

    compilation._compile = marked


def part_by_attribute(core: Any) -> None:
    """Let kernels as Python have the records of a core's block and workspace as compiled ones do."""
    block, workspace = core.state.block, core._derived.workspace
    vars(block)["record"], vars(workspace)["record"] = (
        block.record.view(np.recarray),
        workspace.record.view(np.recarray),
    )


def recorded(path: Path, kinds: tuple[str, ...] = ()) -> list[str]:
    """Write the first step of every kind, or of these ``kinds``, of a run in the largest cell into a file; their kinds.

    Goals are accepted at rest, preempted while the arm moves, by other kinds of goals too, and moved.
    """
    from stereoservo.control.marker_groups import with_groups
    from stereoservo.core.cycle import StepInputs, encode
    from stereoservo.core.state_encoding import encode_state
    from stereoservo.messages.goals import (
        DisplacementTarget,
        Goal,
        JointTarget,
        PointTarget,
        Request,
        RunGoal,
    )
    from stereoservo_sim.benchmarks.cycle import CoreLoop, largest_cell
    from stereoservo_sim.world.exact_model import exact_model

    found: dict[str, RecordedStep] = {}

    class Recorder(CoreLoop):
        target = ""

        def before(self, kind: str, inputs: StepInputs) -> None:
            name = f"{kind} ({self.target})" if kind.endswith(("goal", "read", "told", "fit")) else kind
            if name not in found and (not kinds or name in kinds):
                state = encode_state(self.core.state)
                found[name] = RecordedStep(name, encode(self.core.settings), state, encode(inputs))

        def take(self, name: str, target: Any, number: int) -> None:
            self.target = name
            goal = Goal(f"00000000-0000-0000-0000-{number:012d}", target, law="cartesian3", gain=0.3)
            outputs = self.step(requests=(Request(number, "test", RunGoal(goal)),))
            for _ in range(300):
                replies = [event for event in outputs.events if event.kind == "reply"]
                if replies:
                    break
                outputs = self.step()
            assert replies[0].accepted, replies[0].message
            for _ in range(11):
                self.step()

    cell = largest_cell()
    model = with_groups(exact_model(cell))
    loop = Recorder(cell, 0, model)
    loop.take_model()
    for _ in range(25):
        loop.step()
    loop.take("features", loop.target_at(0.3), 11)
    loop.take("features", loop.target_at(0.25), 12)
    loop.move_goal(1)
    loop.step()
    arrays = loop.core.state.model
    assert arrays is not None
    points = {i: tuple(X) for i, X in zip(model.marker_ids, arrays.marker_points.tolist(), strict=True)}
    loop.take("points", PointTarget(points, model.epoch), 13)
    eye = tuple(float(i == k) for i in range(4) for k in range(4))
    loop.take("displacement", DisplacementTarget(eye, model.epoch), 14)
    loop.take("joints", JointTarget({"j1": float(cell.home[0]) + 0.1}), 15)
    path.write_bytes(msgspec.msgpack.encode(list(found.values())))
    return list(found)


def counts(path: Path) -> dict[str, tuple[int, int]]:
    """Of each recorded step: lines of kernels, and of other Python of the package."""
    mark_kernels()
    from stereoservo.core.cycle import StepInputs, decode_array
    from stereoservo.core.servo_core import ServoCore
    from stereoservo.core.settings import CoreSettings
    from stereoservo.core.state_encoding import decode_state

    found = {}
    for step in msgspec.msgpack.decode(path.read_bytes(), type=list[RecordedStep]):
        settings = msgspec.msgpack.decode(step.settings, type=CoreSettings, dec_hook=decode_array)
        inputs = msgspec.msgpack.decode(step.inputs, type=StepInputs, dec_hook=decode_array)
        core = ServoCore(settings, decode_state(step.state))
        part_by_attribute(core)
        lines = [0, 0]

        def line(frame: FrameType, event: str, argument: Any, lines: list[int] = lines) -> Any:
            lines[frame.f_code not in KERNELS] += event == "line"
            return line

        def call(frame: FrameType, event: str, argument: Any, line: Any = line) -> Any:
            return line if frame.f_code.co_filename.startswith(PACKAGE) else None

        sys.settrace(call)
        try:
            core.step(inputs)
        finally:
            sys.settrace(None)
        found[step.kind] = (lines[0], lines[1])
    return found


if __name__ == "__main__":
    print(json.dumps(counts(Path(sys.argv[1]))))
