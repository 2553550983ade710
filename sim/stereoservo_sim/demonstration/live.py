"""The demonstration as real processes: a daemon, and a client over zenoh."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereoservo.gateway.client import Client
from stereoservo.gateway.messages import EventMessage
from stereoservo.kinematics.model import load_model
from stereoservo.runtime.commands import JointTarget, LawName
from stereoservo_sim.demonstration.scenario import Calibrated, VisualTarget


class LiveDemonstrator:
    """``scenario.Operator`` as a goal client of a running daemon."""

    def __init__(self, client: Client, progress: Callable[[float], None]) -> None:
        self._client = client
        self._progress = progress

    def enable(self) -> None:
        """Enable the arm."""
        self._client.enable()

    def calibrate(self) -> Calibrated:
        """Calibrate; the model is read from where the daemon stored it."""
        start = time.monotonic()
        result = self._client.calibrate(self._hear)
        seconds = time.monotonic() - start
        return Calibrated(load_model(Path(result.model)), seconds)

    def _hear(self, event: EventMessage) -> None:
        if event.progress is not None:
            self._progress(event.progress)

    def move(self, joints: dict[str, float]) -> None:
        """Joint goal."""
        self._client.goal(JointTarget(joints)).reached()

    def teach(self, name: str, frames: int) -> None:
        """Teach what is seen."""
        self._client.teach(name, frames)

    def home(self) -> None:
        """Move home."""
        self._client.home().reached()

    def joints(self) -> npt.NDArray[np.float64]:
        """Measured joint positions (n,)."""
        return np.array(list(self._client.status().joints.values()))

    def planned_s(self, target: VisualTarget, law: LawName) -> float:
        """Seconds that the goal's plan needs."""
        plan = self._client.check(self._client.make_goal(target, law=law)).plan
        assert plan is not None  # a goal of the images is planned
        return plan.seconds

    def servo(self, target: VisualTarget, law: LawName) -> str:
        """Run a goal to its end, under a lease."""
        result = self._client.goal(target, law=law, lease_s=2.0).wait()
        return result.outcome if result.outcome == "reached" else f"{result.outcome}: {result.message}"

    def rest(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)
