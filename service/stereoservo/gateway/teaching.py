"""Registry of a cell's taught goals: stores them with their model, makes goals from CAD drawings, and resolves goals to
set-points for the current model.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from datetime import UTC, datetime

import msgspec
import numpy as np

from stereoservo.core.cycle import Event
from stereoservo.daemon.taught_goals import TaughtGoal, taught_goal, taught_model
from stereoservo.gateway.goal_transfer import TransferredGoal, resolve, resolve_step
from stereoservo.gateway.marker_views import model_frame, observed_views
from stereoservo.gateway.observation_cache import MarkerObservations, ObservationCache
from stereoservo.gateway.persistence import TaughtStore
from stereoservo.gateway.point_alignment import (
    MIN_MARKERS,
    Deviations,
    Pixels,
    TransferError,
    align_points,
    fixed_line,
    reproject_set_points,
    require_still,
)
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.validation import listed
from stereoservo.geometry.alignment import DRAWING, drawn_points, family_between
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.moved_cameras import carried_point_covariance
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import (
    Centre,
    Feature,
    FeatureTarget,
    IncidenceTarget,
    MarkerId,
    Pixel,
    StepTarget,
    TaughtTarget,
)
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
        known_length: str = "",
    ) -> None:
        self._known_length = known_length
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
        """Store the goal of a ``taught`` event; returns whether that succeeded. If not, a warning has the reason."""
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

    def resolve_step(self, step: StepTarget, centre: Centre | None) -> TransferredGoal:
        """A step in a person's frame as a displacement. Raises TransferError."""
        return resolve_step(step, centre, self._model(), self._seen(), self._known_length)

    def seen_when_taught(self, target: TaughtTarget, markers: tuple[MarkerId, ...]) -> dict[str, dict[int, Pixel]]:
        """Raw pixels, by camera, of the ``markers`` that are not on the body, as stored when the goal was taught.
        Raises KeyError.
        """
        return _visible_markers(markers, self._store.goals[target.name].others)

    def resolve_incidence(
        self, target: IncidenceTarget, follow: tuple[MarkerId, ...] = ()
    ) -> tuple[IncidenceTarget, dict[str, dict[int, Pixel]]]:
        """Incidences with markers of the scene replaced by their current pixels, and lines given by segments replaced
        by points in the model's frame; and, for replaced markers, the current pixels of those to ``follow`` (raw, by
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
                        f"the goal is stated with model epoch {epoch}, the cell has {model.epoch}: state it again"
                    )
                fixed, epoch = fixed_line(fixed, model), model.epoch
            incidences.append(msgspec.structs.replace(spec, fixed=fixed))
        resolved = msgspec.structs.replace(target, incidences=tuple(incidences), model_epoch=epoch)
        if not any(spec.fixed.markers for spec in target.incidences):
            return resolved, {}
        now = {camera: {m: one.pixel for m, one in shown.items()} for camera, shown in observations.items()}
        return resolved, _visible_markers(follow, now)

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
            "warning",
            message=f"taught goal {name!r} is not saved: {why}",
            name=name,
            request=request,
            accepted=False,
            origin="gateway",
        )
        return False


def _visible_markers(
    markers: tuple[MarkerId, ...], shown: Mapping[str, Mapping[int, Pixel]]
) -> dict[str, dict[int, Pixel]]:
    """The ``markers`` that are ``shown``, by camera and marker; cameras that show none are left out."""
    found = {
        camera: {marker: pixels[marker] for marker in markers if marker in pixels} for camera, pixels in shown.items()
    }
    return {camera: pixels for camera, pixels in found.items() if pixels}


def _scene_feature(feature: Feature, observations: MarkerObservations, may_move: bool) -> Feature:
    """Feature spanned by markers that are not on the body, from their current observations in two or more cameras."""
    pixels = {
        camera: tuple(seen[marker].pixel for marker in feature.markers)
        for camera, seen in observations.items()
        if all(marker in seen for marker in feature.markers)
    }
    text = ", ".join(str(marker) for marker in feature.markers)
    if len(pixels) < 2:
        cameras = ", ".join(pixels) or "no camera"
        raise TransferError(f"markers {text} of a fixed feature are all seen by {cameras} now; two cameras are needed")
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


# -- goals from drawings -------------------------------------------------------------------------------------
# Goals computed from CAD drawings: set-points in the current cameras for a tool's pose on a workpiece, with their
# accuracy (thesis 8.6).


def synthesise(
    request: Synthesise, model: CellModel | None, observations: MarkerObservations, created: str
) -> tuple[TaughtGoal, str]:
    """Goal from drawn points and the pose of the tool on the workpiece, and a description of its accuracy.

    The markers that the arm does not move must be visible now; they locate the drawing. Raises TransferError.
    """
    if model is None:
        raise TransferError("the cell has no model yet: calibrate first")
    fixed, moving = request.workpiece, request.tool
    pose = np.array(request.pose).reshape(4, 4)
    try:
        drawn_points(np.zeros((1, 3)), pose)
    except GeometryError as error:
        raise TransferError(f"pose: {error}") from error
    if model.mount == "eye_in_hand":  # here the workpiece carries the model's body, and the tool moves with the cameras
        fixed, moving, pose = moving, fixed, np.linalg.inv(pose)
    shared = sorted(set(fixed) & set(model.marker_ids))
    if shared:
        raise TransferError(
            f"markers {listed(shared)} are of the body that moves before the cameras; the drawing is placed by others"
        )
    static_markers, ids = sorted(fixed), sorted(moving)
    seen = {marker for points in observations.values() for marker in points}
    require_still(observations, static_markers, "markers")
    now = observed_views(observations, model, static_markers)
    frame = model_frame(model)
    missing = [marker for marker in static_markers if marker not in seen]
    if len(static_markers) - len(missing) < MIN_MARKERS:
        raise TransferError(f"markers {listed(missing)} of the drawing are not seen now; 3 or more are needed")
    drawn = drawn_points(np.array([fixed[m] for m in static_markers]))
    change, description = align_points(
        family_between(DRAWING, frame, False),
        DRAWING,
        frame,
        drawn,
        None,
        now,
        static_markers,
        "drawing placed",
    )
    points = drawn_points(np.array([moving[m] for m in ids]), pose)
    set_points, deviations, note = reproject_set_points(
        model, ids, move_points(change.H, points), carried_point_covariance(change, points), "drawn"
    )
    return _drawn_goal(
        model, set_points, deviations, ids, observations, static_markers, created
    ), f"{description}; {note}"


def _drawn_goal(
    model: CellModel,
    set_points: Pixels,
    sigmas: Deviations,
    ids: list[int],
    observations: MarkerObservations,
    static_markers: list[int],
    created: str,
) -> TaughtGoal:
    """Goal with the set-points of drawn markers, in the form of a taught one, and the markers that located them."""
    of_body = {c: {m: p for m, p in seen.items() if m in model.marker_ids} for c, seen in set_points.items()}
    others = {c: {m: p for m, p in seen.items() if m not in model.marker_ids} for c, seen in set_points.items()}
    for camera, seen in observations.items():
        for marker in static_markers:
            if marker in seen:
                others.setdefault(camera, {})[marker] = seen[marker].pixel
                sigmas.setdefault(camera, {})[marker] = seen[marker].sigma
    goal = TaughtGoal(
        FeatureTarget({c: seen for c, seen in of_body.items() if seen}, model.epoch),
        created=created,
        others={c: seen for c, seen in others.items() if seen},
        sigmas=sigmas,
        model=taught_model(model),
    )
    by_body = set(ids) <= set(model.marker_ids)
    return goal if by_body else msgspec.structs.replace(goal, tool=tuple(ids))
