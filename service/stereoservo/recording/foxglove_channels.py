"""Activity of a cell as messages with Foxglove's well-known schemas: joints, commands, status, log, markers in the
pictures, and, if the model is metric, arm, cameras and markers in space.

Times are nanoseconds of the wall clock. The functions take plain arrays and names, so that a recording and a live cell
have the same channels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from foxglove.messages import (
    Color,
    FrameTransform,
    FrameTransforms,
    ImageAnnotations,
    JointState,
    JointStates,
    LinePrimitive,
    LinePrimitiveLineType,
    Log,
    LogLevel,
    Point2,
    Point3,
    PointsAnnotation,
    PointsAnnotationType,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)
from scipy.spatial.transform import Rotation

from stereoservo.core.cycle import Status
from stereoservo.geometry.strata import upper_triangular
from stereoservo.kinematics.axes import euclidean_centres, joint_axes, stratum_frame
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import StateMessage
from stereoservo.numerics.arrays import FloatArray

CELL_FRAME = "cell"
SEEN = Color(r=0.1, g=0.9, b=0.2, a=1.0)
PREDICTED = Color(r=1.0, g=0.6, b=0.0, a=1.0)
SET_POINTS = Color(r=1.0, g=0.1, b=0.3, a=1.0)
AXIS = Color(r=0.2, g=0.5, b=1.0, a=1.0)
FAULTS = {"fault", "goal_aborted", "reanchor_failed", "calibration_aborted"}
"""Events that a log shows as errors."""
WARNINGS = {"warning", "stopped", "health", "held", "goal_cancelled", "goal_preempted"}


class CellStatus(msgspec.Struct, frozen=True):
    """Quantities judged by the loop, for plots: errors [px], completed fraction of the path, codes of the reasons."""

    lifecycle: str
    source: str
    goal: str
    law: str
    level: str
    reasons: tuple[str, ...]
    error_px: float | None
    progress: float | None
    seconds_left: float | None
    task_error: tuple[float, ...]
    innovation_px: dict[str, float]
    visible: dict[str, int]


def cell_status(status: Status | StateMessage) -> CellStatus:
    """The plotted values of a step's status, or of a live cell's state."""
    return CellStatus(
        lifecycle=status.lifecycle,
        source=status.source,
        goal=status.goal,
        law=status.law,
        level=status.level,
        reasons=tuple(reason.code for reason in status.reasons),
        error_px=status.error_px,
        progress=status.progress,
        seconds_left=status.seconds_left,
        task_error=tuple(float(value) for value in status.task_error),
        innovation_px=status.innovation_px,
        visible=status.visible,
    )


class Published(NamedTuple):
    """A message for a file or viewer: ``content`` is one of foxglove's messages, or a `CellStatus`."""

    topic: str
    t_ns: int
    content: Any

    def encode(self) -> bytes:
        """The bytes of the message, according to the schema of its channel."""
        if isinstance(self.content, CellStatus):
            return msgspec.json.encode(self.content)
        return bytes(self.content.encode())


class ChannelSchema(NamedTuple):
    """Schema of a channel, as MCAP keeps it: ``encoding`` of the schema, ``message`` encoding."""

    name: str
    encoding: str
    data: bytes
    message: str


def schema_of(content: Any) -> ChannelSchema:
    """The schema of a message's channel."""
    if isinstance(content, CellStatus):
        return ChannelSchema(
            "stereoservo.CellStatus",
            "jsonschema",
            msgspec.json.encode(msgspec.json.schema(CellStatus)),
            "json",
        )
    found = type(content).get_schema()
    return ChannelSchema(found.name, found.encoding, found.data, "protobuf")


def stamp(t_ns: int) -> Timestamp:
    """A time [ns since 1970] as Foxglove writes it."""
    return Timestamp(t_ns // 1_000_000_000, t_ns % 1_000_000_000)


def joints(
    topic: str,
    t_ns: int,
    names: Sequence[str],
    *,
    positions: Sequence[float] | FloatArray | None = None,
    velocities: Sequence[float] | FloatArray | None = None,
    efforts: Sequence[float] | FloatArray | None = None,
) -> Published:
    """Joints [rad, rad/s, N m; or m, m/s, N] by name, with the known values."""

    def value(array: Sequence[float] | FloatArray | None, j: int) -> float | None:
        return None if array is None else float(array[j])

    states = [
        JointState(name=name, position=value(positions, j), velocity=value(velocities, j), effort=value(efforts, j))
        for j, name in enumerate(names)
    ]
    return Published(topic, t_ns, JointStates(timestamp=stamp(t_ns), joints=states))


def log(t_ns: int, kind: str, message: str, origin: str) -> Published:
    """An event as a line of a log."""
    level = LogLevel.Error if kind in FAULTS else LogLevel.Warning if kind in WARNINGS else LogLevel.Info
    text = f"{kind}: {message}" if message else kind
    return Published("/log", t_ns, Log(timestamp=stamp(t_ns), level=level, message=text, name=origin))


def reasons(t_ns: int, found: Sequence[Reason]) -> Published:
    """The reasons that limit the arm's motion, as a line of a log."""
    text = "; ".join(f"{reason.code} {reason.subject}: {reason.hint}" for reason in found) or "none"
    level = LogLevel.Warning if found else LogLevel.Info
    return Published("/reasons", t_ns, Log(timestamp=stamp(t_ns), level=level, message=text, name="reasons"))


def markers_seen(
    camera: str,
    t_ns: int,
    seen: FloatArray,
    predicted: FloatArray | None = None,
    set_points: FloatArray | None = None,
) -> Published:
    """Markers in a camera's picture: ``seen``, ``predicted`` and set-points ``set_points``, each (k, 2) raw pixels
    [px].

    Foxglove counts pixels from the corner of a picture, this project from the centre of its first pixel.
    """
    drawn = []
    for pixels, colour, size in ((seen, SEEN, 5.0), (predicted, PREDICTED, 3.0), (set_points, SET_POINTS, 7.0)):
        if pixels is None or not len(pixels):
            continue
        points = [Point2(x=float(u) + 0.5, y=float(v) + 0.5) for u, v in pixels if np.isfinite(u + v)]
        drawn.append(
            PointsAnnotation(
                timestamp=stamp(t_ns),
                type=PointsAnnotationType.Points,
                points=points,
                outline_color=colour,
                thickness=size,
            )
        )
    return Published(f"/camera/{camera}/annotations", t_ns, ImageAnnotations(timestamp=stamp(t_ns), points=drawn))


# -- in space -----------------------------------------------------------------------------------------------


class MetricScene:
    """Arm, cameras and markers of a ``model`` in space, in the Euclidean frame of its first camera.

    The unit of length is the distance between the first two cameras (the first camera's focal length if there is only
    one camera), because a model from pictures alone has no other. Raises ValueError for a model that is not metric.
    """

    def __init__(self, model: CellModel) -> None:
        if model.stratum != "metric" or model.projective_to_euclidean is None:
            raise ValueError(f"a model of stratum {model.stratum!r} has no place in Euclidean space")
        frame = stratum_frame("metric", model.plane_at_infinity, model.projective_to_euclidean)
        back = np.linalg.inv(frame)
        cameras = np.array([camera.matrix for camera in model.cameras]) @ back
        centres = euclidean_centres(cameras)
        baseline = float(np.linalg.norm(centres[1] - centres[0])) if len(centres) > 1 else 1.0
        self._model = model
        self._frame = np.diag([1.0, 1.0, 1.0, baseline]) @ frame
        self._back = np.linalg.inv(self._frame)
        self._chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
        self.centres = centres / baseline
        self.rotations = np.array([_rotation(camera) for camera in cameras])

    def markers(self, positions: FloatArray) -> FloatArray:
        """Markers (m, 3) at joint ``positions`` (n,)."""
        points = self._model.marker_points @ (self._frame @ self._chain.displacement(positions)).T
        return np.asarray(points[:, :3] / points[:, 3:])

    def axes(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Directions (n, 3) of the joints' axes at ``positions`` (n,), and a point (n, 3) of each near the markers."""
        operators = self._frame @ self._chain.operators_at(positions) @ self._back
        found = joint_axes(self._model.joint_kinds, operators)
        centroid = self.markers(positions).mean(axis=0)
        points = np.where(np.isnan(found.points), centroid, found.points)
        along = np.sum((centroid - points) * found.directions, axis=1, keepdims=True)
        return found.directions, points + along * found.directions

    def transforms(self, t_ns: int) -> Published:
        """The cameras' frames (z forwards, y down) in that of the cell."""
        found = []
        for camera, centre, rotation in zip(self._model.cameras, self.centres, self.rotations, strict=True):
            x, y, z, w = Rotation.from_matrix(rotation.T).as_quat()
            found.append(
                FrameTransform(
                    timestamp=stamp(t_ns),
                    parent_frame_id=CELL_FRAME,
                    child_frame_id=camera.name,
                    translation=_vector(centre),
                    rotation=Quaternion(x=x, y=y, z=z, w=w),
                )
            )
        return Published("/tf", t_ns, FrameTransforms(transforms=found))

    def update(self, t_ns: int, positions: FloatArray) -> Published:
        """The scene with the joints at ``positions`` (n,)."""
        markers = self.markers(positions)
        directions, points = self.axes(positions)
        size = 0.02
        arm = [
            LinePrimitive(
                type=LinePrimitiveLineType.LineStrip,
                pose=_pose(np.zeros(3)),
                thickness=0.3 * size,
                color=AXIS,
                points=[_point(point - 0.2 * direction), _point(point + 0.2 * direction)],
            )
            for direction, point in zip(directions, points, strict=True)
        ]
        cameras = [_camera(c, r) for c, r in zip(self.centres, self.rotations, strict=True)]
        entities = [
            _entity(t_ns, "arm", lines=arm, texts=_names(self._model.joint_names, points, size, AXIS)),
            _entity(t_ns, "markers", spheres=[_sphere(marker, size) for marker in markers]),
            _entity(
                t_ns,
                "cameras",
                lines=cameras,
                texts=_names([camera.name for camera in self._model.cameras], self.centres, size, SET_POINTS),
            ),
        ]
        return Published("/scene", t_ns, SceneUpdate(entities=entities))


def _rotation(camera: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the cell's frame into that of a camera (3, 4), whose x and y run along u and v."""
    _, rotation = upper_triangular(camera[:, :3] * np.sign(np.linalg.det(camera[:, :3])))
    return rotation


def _vector(v: FloatArray) -> Vector3:
    return Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _point(v: FloatArray) -> Point3:
    return Point3(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _pose(v: FloatArray) -> Pose:
    return Pose(position=_vector(v), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))


def _sphere(v: FloatArray, size: float) -> SpherePrimitive:
    return SpherePrimitive(pose=_pose(v), size=Vector3(x=size, y=size, z=size), color=SEEN)


def _camera(centre: FloatArray, rotation: FloatArray) -> LinePrimitive:
    """A pyramid from a camera's centre in its viewing direction."""
    corners = [centre + 0.1 * np.array([x, y, 1.5]) @ rotation for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    strip = [corners[0]]
    for corner, following in zip(corners, [*corners[1:], corners[0]], strict=True):
        strip += [corner, centre, corner, following]
    return LinePrimitive(
        type=LinePrimitiveLineType.LineStrip,
        pose=_pose(np.zeros(3)),
        thickness=0.005,
        color=SET_POINTS,
        points=[_point(place) for place in strip],
    )


def _names(names: Sequence[str], places: FloatArray, size: float, colour: Color) -> list[TextPrimitive]:
    return [
        TextPrimitive(pose=_pose(place), billboard=True, font_size=2.0 * size, color=colour, text=name)
        for name, place in zip(names, places, strict=True)
    ]


def _entity(t_ns: int, name: str, **primitives: Any) -> SceneEntity:
    return SceneEntity(timestamp=stamp(t_ns), frame_id=CELL_FRAME, id=name, **primitives)


def set_points_of(target: Any, camera: str) -> FloatArray | None:
    """Set-points (k, 2) [px] of a goal's target in a camera, if they are stated as pixels."""
    stated: Mapping[str, Mapping[int, tuple[float, float]]] = getattr(target, "set_points", {})
    found = stated.get(camera)
    return None if not found else np.array(list(found.values()), dtype=np.float64)
