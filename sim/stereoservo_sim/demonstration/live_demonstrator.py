"""The demonstration with real processes: a daemon, and a client over zenoh."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereoservo.client import Client, ClientError, FailedError, GoalHandle
from stereoservo.daemon.servo import SILENCE
from stereoservo.kinematics.model import load_model
from stereoservo.messages.goals import JointTarget, LawName
from stereoservo.messages.wire import EventMessage, FeaturesMessage
from stereoservo_sim.demonstration.scenario import (
    SIGHT_S,
    Calibrated,
    MarkerSights,
    SightCollection,
    VisualTarget,
)

LOOK_EVERY_S = 2.0
RECENT_EVENTS = 50
LOOKS = 3
"""For the event that tells why a cell is held: state and events come by ways of their own."""
MOST_HOLDS = 20
BUSY_COMPUTER = frozenset({"JOINT_STAMP", "LOOP_GAP"})
"""Codes of the stops of a simulated cell whose computer was busy."""


class LiveDemonstrator:
    """``scenario.Operator`` as a goal client of a running daemon.

    As an operator would, it resumes an arm that was held or stopped since the computer was busy, ``MOST_HOLDS`` times
    at most, tells so, and begins anew what a stop ended; any other hold ends what it waits for.
    """

    def __init__(
        self,
        client: Client,
        progress: Callable[[float], None],
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._client = client
        self._progress = progress
        self._tell = tell
        self._looked_s = time.monotonic()
        self._holds = self._looks = 0
        client.while_waiting = self._look

    def enable(self) -> None:
        """Enable the arm."""
        self._client.enable()

    def calibrate(self) -> Calibrated:
        """Calibrate; the model is read from the daemon's file."""
        while True:
            start = time.monotonic()
            try:
                result = self._client.calibrate(self._hear)
            except FailedError as error:
                if not self._goes_on(error.code in BUSY_COMPUTER, str(error)):
                    raise
            else:
                return Calibrated(load_model(Path(result.model)), time.monotonic() - start)

    def _hear(self, event: EventMessage) -> None:
        if event.progress is not None:
            self._progress(event.progress)

    def move(self, joints: dict[str, float]) -> None:
        """Execute a joint goal."""
        self._drive(lambda: self._client.goal(JointTarget(joints))).reached()

    def teach(self, name: str, frames: int) -> None:
        """Teach the current view."""
        self._client.teach(name, frames)

    def home(self) -> None:
        """Move home."""
        self._drive(self._client.home).reached()

    def joints(self) -> npt.NDArray[np.float64]:
        """Measured joint positions (n,)."""
        return np.array(list(self._client.joints().values()))

    def sights(self, frames: int) -> MarkerSights:
        """What the cameras see, so many frames of each."""
        found = SightCollection((camera.name for camera in self._client.info().cameras), frames)
        until_s = time.monotonic() + SIGHT_S
        for message in self._client.watch(features=True):
            if time.monotonic() > until_s:
                raise ClientError(found.missing)
            if isinstance(message, FeaturesMessage):
                found.add(message.camera, message.ids, message.pixels)
            if found.complete:
                break
        return found.sights

    def planned_s(self, target: VisualTarget, law: LawName) -> float:
        """Seconds that the goal's plan needs."""
        plan = self._client.check(self._client.make_goal(target, law=law)).plan
        assert plan is not None  # a goal of the images is planned
        return plan.seconds

    def servo(self, target: VisualTarget, law: LawName, follow: tuple[int, ...] = ()) -> str:
        """Execute a goal to its end, under a lease."""
        result = self._drive(
            lambda: self._client.goal(target, law=law, lease_s=2.0, follow_markers=follow)
        ).wait()
        return result.outcome if result.outcome == "reached" else f"{result.outcome}: {result.message}"

    def _look(self) -> None:
        """Every ``LOOK_EVERY_S``: whether the cell is held. Raises ClientError where nobody would resume it."""
        if time.monotonic() - self._looked_s < LOOK_EVERY_S:
            return
        self._looked_s = time.monotonic()
        state = self._client.status()
        if not any(reason.code == "HELD" for reason in state.reasons):
            return
        told = [
            event
            for event in self._client.events(max(1, state.last_event - RECENT_EVENTS)).events
            if event.kind in ("held", "resumed")
        ]
        known = bool(told) and told[-1].kind == "held"
        self._looks += 1
        if not known and self._looks < LOOKS:
            return
        self._looks = 0
        cause = told[-1].message if known else "no event says why"
        if not self._goes_on(SILENCE in cause, cause):
            raise ClientError(f"the cell was held and nobody resumed it: {cause}")

    def _goes_on(self, was_busy: bool, cause: str) -> bool:
        """Whether the cell was resumed, since the computer ``was_busy``, and not too often yet."""
        self._holds += was_busy
        if not was_busy or self._holds > MOST_HOLDS:
            return False
        self._tell(f"{cause}: resumed")
        self._client.resume()
        return True

    def _drive(self, send: Callable[[], GoalHandle]) -> GoalHandle:
        """A goal that has ended, sent anew where a busy computer ended it."""
        while True:
            handle = send()
            result = handle.wait()
            codes = {reason.code for reason in result.reasons}
            if result.outcome == "reached" or not self._goes_on(bool(codes & BUSY_COMPUTER), result.message):
                return handle

    def rest(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)
