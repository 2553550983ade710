"""Taught goals on their way in and out: what the core saw is stored with its model, drawings become goals, and a goal
that is sent is resolved to set-points for the model and the workpiece of now.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from datetime import UTC, datetime

import msgspec

from stereoservo.gateway.drawings import synthesise
from stereoservo.gateway.matching import TransferError
from stereoservo.gateway.messages import Synthesise
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.sights import NewestSights, Sights
from stereoservo.gateway.stores import TaughtStore
from stereoservo.gateway.transfer import Resolved, resolve
from stereoservo.kinematics.model import CellModel
from stereoservo.runtime.commands import Feature, IncidenceTarget, TaughtTarget
from stereoservo.runtime.cycle import Event
from stereoservo.runtime.taught import TaughtGoal, taught_goal

KNOWN_TOOLS = 100


class Teaching:
    """The cell's taught goals, the model that reads them, and what the cameras see now."""

    def __init__(
        self, store: TaughtStore, sights: NewestSights, model: Callable[[], CellModel | None], log: EventLog
    ) -> None:
        self._store = store
        self._sights = sights
        self._model = model
        self._log = log
        self._tools: OrderedDict[int, tuple[int, ...]] = OrderedDict()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the goals, sorted."""
        return self._store.names

    @property
    def goals(self) -> dict[str, TaughtGoal]:
        """The goals by name."""
        return self._store.goals

    def expect(self, request: int, tool: tuple[int, ...]) -> None:
        """What ``request`` will teach is meant by the markers ``tool``."""
        if tool:
            self._tools[request] = tool
            while len(self._tools) > KNOWN_TOOLS:
                self._tools.popitem(last=False)

    def taught(self, event: Event) -> None:
        """Store what a ``taught`` event carries."""
        model = self._model()
        tool = self._tools.pop(event.request, ())
        if model is None:
            self._warn(event.name, "the model that it was seen with is gone")
            return
        missing = [m for m in tool if not any(m in sample.ids for sample in event.samples)]
        if missing:
            text = ", ".join(str(marker) for marker in missing)
            self._warn(event.name, f"no camera saw markers {text} of the tool")
            return
        self._keep(event.name, taught_goal(event, model, _now(), tool))

    def synthesise(self, wanted: Synthesise) -> str:
        """Store a goal made from drawings; gives in words how well it is known. Raises TransferError."""
        goal, note = synthesise(wanted, self._model(), self._seen(), _now())
        if not self._keep(wanted.name, goal):
            raise TransferError(f"goal {wanted.name!r} could not be saved; see the events")
        message = f"goal {wanted.name!r} made from drawings: {note}"
        self._log.add("taught", message=message, name=wanted.name, origin="gateway")
        return message

    def resolve(self, target: TaughtTarget) -> Resolved:
        """A taught goal as set-points. Raises KeyError, TransferError."""
        return resolve(target, self._store.goals[target.name], self._model(), self._seen())

    def resolve_incidence(self, target: IncidenceTarget) -> IncidenceTarget:
        """Incidences with standing markers replaced by their pixels of now. Raises TransferError."""
        sights = self._seen()
        incidences = tuple(
            msgspec.structs.replace(spec, fixed=_standing(spec.fixed, sights)) if spec.fixed.markers else spec
            for spec in target.incidences
        )
        return msgspec.structs.replace(target, incidences=incidences)

    def _seen(self) -> Sights:
        return self._sights.now(time.monotonic_ns())

    def _keep(self, name: str, goal: TaughtGoal) -> bool:
        try:
            self._store.add(name, goal)
        except OSError as error:
            self._warn(name, str(error))
            return False
        return True

    def _warn(self, name: str, why: str) -> None:
        self._log.add(
            "warning", message=f"taught goal {name!r} is not saved: {why}", name=name, origin="gateway"
        )


def _standing(feature: Feature, sights: Sights) -> Feature:
    """A feature spanned by markers beside the body, by where two or more cameras see them now."""
    pixels = {
        camera: tuple(seen[marker].pixel for marker in feature.markers)
        for camera, seen in sights.items()
        if all(marker in seen for marker in feature.markers)
    }
    text = ", ".join(str(marker) for marker in feature.markers)
    if len(pixels) < 2:
        cameras = ", ".join(pixels) or "no camera"
        raise TransferError(
            f"markers {text} of a fixed feature are all seen by {cameras} now; two cameras are needed"
        )
    if any(seen[marker].moves for seen in sights.values() for marker in feature.markers if marker in seen):
        raise TransferError(
            f"markers {text} of a fixed feature move now; send the goal when they stand still"
        )
    return Feature(pixels=pixels)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
