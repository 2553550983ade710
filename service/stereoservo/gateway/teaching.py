"""Registry of a cell's taught goals: stores them with their model, makes goals from CAD drawings, and resolves goals
to set-points for the current model.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from datetime import UTC, datetime

import msgspec

from stereoservo.core.cycle import Event
from stereoservo.daemon.taught_goals import TaughtGoal, taught_goal
from stereoservo.gateway.cad_goals import synthesise
from stereoservo.gateway.goal_transfer import TransferredGoal, resolve
from stereoservo.gateway.observation_cache import MarkerObservations, ObservationCache
from stereoservo.gateway.persistence import TaughtStore
from stereoservo.gateway.point_alignment import TransferError, fixed_line
from stereoservo.gateway.publisher import EventLog
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Feature, IncidenceTarget, MarkerId, Pixel, TaughtTarget
from stereoservo.messages.wire import Synthesise

KNOWN_TOOLS = 100


class TaughtGoalRegistry:
    """The cell's taught goals, with access to the current model and observations that resolve them."""

    def __init__(
        self,
        store: TaughtStore,
        observations: ObservationCache,
        model: Callable[[], CellModel | None],
        log: EventLog,
    ) -> None:
        self._store = store
        self._marker_cache = observations
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
        """Set the tool's markers of the goal that ``request`` will teach."""
        if tool:
            self._tools[request] = tool
            while len(self._tools) > KNOWN_TOOLS:
                self._tools.popitem(last=False)

    def taught(self, event: Event) -> bool:
        """Store the goal of a ``taught`` event; returns whether that was possible. A warning has the reason if not."""
        model = self._model()
        tool = self._tools.pop(event.request, ())
        if model is None:
            return self._warn(event.name, "the model that it was seen with is gone", event.request)
        missing = [m for m in tool if not any(m in sample.ids for sample in event.samples)]
        if missing:
            text = ", ".join(str(marker) for marker in missing)
            return self._warn(event.name, f"no camera saw markers {text} of the tool", event.request)
        return self._save(event.name, taught_goal(event, model, _now(), tool), event.request)

    def synthesise(self, drawing: Synthesise) -> str:
        """Store a goal made from CAD drawings; returns a description of its accuracy. Raises TransferError."""
        goal, note = synthesise(drawing, self._model(), self._seen(), _now())
        if not self._save(drawing.name, goal):
            raise TransferError(f"goal {drawing.name!r} could not be saved; see the events")
        message = f"goal {drawing.name!r} made from drawings: {note}"
        self._log.add("taught", message=message, name=drawing.name, origin="gateway")
        return message

    def resolve(self, target: TaughtTarget) -> TransferredGoal:
        """Set-points of a taught goal. Raises KeyError, TransferError."""
        return resolve(target, self._store.goals[target.name], self._model(), self._seen())

    def seen_when_taught(
        self, target: TaughtTarget, markers: tuple[MarkerId, ...]
    ) -> dict[str, dict[int, Pixel]]:
        """Raw pixels of those of the ``markers`` that are not on the body, by camera, when it was taught. Raises
        KeyError.
        """
        return _where(markers, self._store.goals[target.name].others)

    def resolve_incidence(
        self, target: IncidenceTarget, follow: tuple[MarkerId, ...] = ()
    ) -> tuple[IncidenceTarget, dict[str, dict[int, Pixel]]]:
        """Incidences with markers of the scene replaced by their current pixels, and lines by segments by points in
        the model's frame; and, where markers were, where those to ``follow`` are in these pictures (raw pixels by
        camera). Raises TransferError.
        """
        observations, epoch, incidences = self._seen(), target.model_epoch, []
        for spec in target.incidences:
            fixed = spec.fixed
            if fixed.markers:
                fixed = _scene_feature(fixed, observations, bool(follow))
            elif fixed.segments:
                model = self._model()
                if model is None:
                    raise TransferError("the cell has no model yet: calibrate first")
                if epoch not in (None, model.epoch):
                    raise TransferError(
                        f"the goal is stated with model epoch {epoch}, the cell has {model.epoch}: state it anew"
                    )
                fixed, epoch = fixed_line(fixed, model), model.epoch
            incidences.append(msgspec.structs.replace(spec, fixed=fixed))
        resolved = msgspec.structs.replace(target, incidences=tuple(incidences), model_epoch=epoch)
        if not any(spec.fixed.markers for spec in target.incidences):
            return resolved, {}
        now = {camera: {m: one.pixel for m, one in shown.items()} for camera, shown in observations.items()}
        return resolved, _where(follow, now)

    def _seen(self) -> MarkerObservations:
        return self._marker_cache.now(time.monotonic_ns())

    def _save(self, name: str, goal: TaughtGoal, request: int = -1) -> bool:
        try:
            self._store.add(name, goal)
        except OSError as error:
            return self._warn(name, str(error), request)
        return True

    def _warn(self, name: str, why: str, request: int) -> bool:
        self._log.add(
            "warning", message=f"taught goal {name!r} is not saved: {why}", name=name, request=request,
            accepted=False, origin="gateway",
        )  # fmt: skip
        return False


def _where(
    markers: tuple[MarkerId, ...], shown: Mapping[str, Mapping[int, Pixel]]
) -> dict[str, dict[int, Pixel]]:
    """Those of the ``markers`` that are ``shown``, by camera and marker; cameras that show none are not in it."""
    found = {
        camera: {marker: pixels[marker] for marker in markers if marker in pixels}
        for camera, pixels in shown.items()
    }
    return {camera: pixels for camera, pixels in found.items() if pixels}


def _scene_feature(feature: Feature, observations: MarkerObservations, may_move: bool) -> Feature:
    """Feature spanned by markers that are not on the body, by their current observations in two or more cameras."""
    pixels = {
        camera: tuple(seen[marker].pixel for marker in feature.markers)
        for camera, seen in observations.items()
        if all(marker in seen for marker in feature.markers)
    }
    text = ", ".join(str(marker) for marker in feature.markers)
    if len(pixels) < 2:
        cameras = ", ".join(pixels) or "no camera"
        raise TransferError(
            f"markers {text} of a fixed feature are all seen by {cameras} now; two cameras are needed"
        )
    if not may_move and any(
        seen[marker].moves for seen in observations.values() for marker in feature.markers if marker in seen
    ):
        raise TransferError(
            f"markers {text} of a fixed feature move now; send the goal when they stand still, or go with them: name "
            "the markers of their body in follow_markers"
        )
    return Feature(pixels=pixels)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
