"""The demonstration in one process on a virtual clock."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from stereoservo.core.cycle import StepInputs, StepOutputs
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.messages.goals import JointTarget, LawName
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.demonstration.scenario import (
    SIGHT_S,
    Calibrated,
    MarkerSights,
    SightCollection,
    VisualTarget,
)


class LockstepDemonstrator:
    """``scenario.Operator`` of a cell in lockstep."""

    def __init__(self, cell: LockstepCell, seed: int, progress: Callable[[float], None]) -> None:
        self._cell = cell
        self._operator = LockstepOperator(cell, seed=seed)
        self._progress = progress

    def enable(self) -> None:
        """Wait for the first joint samples and frames, then enable."""
        self._cell.run_for(0.5)
        self._operator.enable()

    def calibrate(self) -> Calibrated:
        """Run trial motions and fit; ``seconds`` are virtual."""
        start_ns = self._cell.clock.now_ns()
        model = self._operator.calibrate(lambda _, fraction: self._progress(fraction))
        return Calibrated(model, (self._cell.clock.now_ns() - start_ns) * 1e-9)

    def move(self, joints: dict[str, float]) -> None:
        """Execute a joint goal."""
        event = self._operator.goal(JointTarget(joints))
        if event.kind != "goal_reached":
            raise RuntimeError(f"the arm did not reach the pose to be shown: {event.message}")

    def teach(self, name: str, frames: int) -> None:
        """Teach the current view."""
        self._operator.teach(name, frames)

    def home(self) -> None:
        """Move home."""
        self._operator.home()

    def joints(self) -> npt.NDArray[np.float64]:
        """Measured joint positions (n,), a step later."""
        return self._cell.step().status.positions

    def sights(self, frames: int) -> MarkerSights:
        """What the cameras see, so many frames of each; virtual time passes."""
        found = SightCollection((camera.name for camera in self._cell.settings.cameras), frames)
        before = self._cell.on_step

        def collect(inputs: StepInputs, outputs: StepOutputs) -> None:
            for seen in inputs.observations:
                found.add(seen.camera, seen.ids.tolist(), seen.pixels.tolist())
            if before is not None:
                before(inputs, outputs)

        self._cell.on_step = collect
        try:
            until_ns = self._cell.clock.now_ns() + round(SIGHT_S * 1e9)
            while not found.complete:
                if self._cell.clock.now_ns() > until_ns:
                    raise RuntimeError(found.missing)
                self._cell.step()
        finally:
            self._cell.on_step = before
        return found.sights

    def planned_s(self, target: VisualTarget, law: LawName) -> float:
        """Seconds that the goal's plan needs."""
        return self._operator.planned(target, law=law).seconds

    def servo(self, target: VisualTarget, law: LawName, follow: tuple[int, ...] = ()) -> str:
        """Execute a goal to its end."""
        event = self._operator.goal(target, law=law, follow_markers=follow)
        return (
            "reached"
            if event.kind == "goal_reached"
            else f"{event.kind.removeprefix('goal_')}: {event.message}"
        )

    def rest(self, seconds: float) -> None:
        """Let virtual time pass."""
        self._cell.run_for(seconds)
