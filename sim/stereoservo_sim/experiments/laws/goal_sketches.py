"""Short motions towards every kind of goal, for figures: the free arm with its exact model, without noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stereoservo.control.incidence import image_task, incidence_step, incidence_task
from stereoservo.control.incidence_kernel import SecondTask
from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.core.model_arrays import with_unit_height
from stereoservo.core.sources.streaming import FEED_FORWARD_DAMPING
from stereoservo.geometry.alignment import AlignmentFrame, align
from stereoservo.kinematics.composition import displace
from stereoservo.kinematics.kernels import image_jacobian, project_points, transform_points, triangulate
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.linear import damped_least_squares
from stereoservo_sim.tasks.arms import FreeArm
from stereoservo_sim.tasks.calibrations import Knowledge, TaskCalibration, known_at_start
from stereoservo_sim.tasks.ground_truth import MATRICES, sight
from stereoservo_sim.tasks.setting import FACE
from stereoservo_sim.tasks.task_file import AlignmentTask
from stereoservo_sim.world.synthetic import rotation, translation

Commanded = Callable[[Scene, float], FloatArray]

DT_S, GAIN, SECONDS = 0.04, 1.0, 8.0
SIGMA_PX = 0.1
"""Stated standard deviation of the pixels."""
MARKERS = 4
WORKPIECE = np.array(
    [
        (-0.12, 0.1, 0.0, 1.0),
        (0.12, 0.1, 0.0, 1.0),
        (0.12, -0.02, -0.06, 1.0),
        (-0.12, -0.02, 0.0, 1.0),
        (0.0, 0.1, -0.1, 1.0),
    ]
)
"""(5, 4) markers of a workpiece in its own frame [m], no four in a plane."""
CIRCLE_M, TURN_S = 0.1, 8.0
"""Of a streamed target: radius, and time for a turn."""


class Drive(NamedTuple):
    """A recorded motion: ``poses`` (k, 4, 4) of the plate, ``pixels`` (k, 2, 4, 2) noise-free."""

    poses: FloatArray
    pixels: FloatArray


def start_pose() -> FloatArray:
    """Start pose (4, 4) of the sketches."""
    return translation(-0.14, 0.06, 1.1) @ rotation("y", 20) @ rotation("x", -15)


def goal_pose() -> FloatArray:
    """Goal pose (4, 4) of the sketches."""
    return translation(0.12, -0.08, 1.0) @ rotation("z", 60) @ rotation("y", -20)


class World:
    """The arm at a start pose, with its controller's knowledge."""

    def __init__(self, calibration: TaskCalibration, start: FloatArray) -> None:
        self._calibration = calibration
        self.start = start
        self.knowledge: Knowledge = self._known(start)
        assert self.knowledge.points is not None  # an exact model knows its body
        self.points: FloatArray = self.knowledge.points

    def points_at(self, pose: FloatArray) -> FloatArray:
        """Points (4, 4) of the plate at ``pose``, in the model's frame, of scale 1."""
        found = self._known(pose).points
        assert found is not None
        return found

    def seen_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (2, n, 2) of points (n, 4) of the rig, and the points (n, 4) in the model's frame, of scale 1."""
        pixels, _ = project_points(MATRICES, points)
        found, _ = triangulate(self.knowledge.matrices, pixels, np.ones(pixels.shape[:2]), 5)
        return pixels, with_unit_height(found, self.knowledge.plane_at_infinity)

    def towards(self, targets: FloatArray) -> Task:
        """Task of moving the plate to ``targets`` (4, 4), points in the model's frame."""
        set_points, _ = project_points(self.knowledge.matrices, targets)
        return Task(
            set_points, np.ones((2, MARKERS)), np.zeros_like(set_points), targets,
            np.ones(MARKERS), self.points.mean(axis=0), targets.mean(axis=0), FACE,
        )  # fmt: skip

    def drive(self, command: Commanded, seconds: float) -> Drive:
        """Run ``command(scene, t)`` for some time."""
        arm, points = FreeArm(self.start), self.points
        poses = [arm.pose]
        for k in range(round(seconds / DT_S)):
            velocity = command(self._scene(points), k * DT_S)
            points = transform_points(
                displace(self.knowledge.basis, int(self.knowledge.composition), velocity * DT_S), points
            )
            arm.move(velocity, DT_S)
            poses.append(arm.pose)
        return Drive(np.array(poses), np.array([sight(pose).pixels for pose in poses]))

    def servo(self, law: str, targets: FloatArray) -> Drive:
        """Run a law until the plate is at ``targets`` (4, 4)."""
        task = self.towards(targets)

        def command(scene: Scene, time_s: float) -> FloatArray:
            now = task._replace(centre=scene.points.mean(axis=0))
            return np.asarray(LAWS[law].step(scene, now, Options(GAIN, DT_S)).velocity)

        return self.drive(command, SECONDS)

    def _scene(self, points: FloatArray) -> Scene:
        knowledge = self.knowledge
        pixels, _ = project_points(knowledge.matrices, points)
        return Scene(
            knowledge.basis, int(knowledge.composition), knowledge.matrices, knowledge.camera_centres, points, pixels,
            np.ones(pixels.shape[:2]),
        )  # fmt: skip

    def _known(self, pose: FloatArray) -> Knowledge:
        task = AlignmentTask(0, 0, 0.0, 0.0, np.array([1.0, 0.0, 0.0]), pose, pose)
        return known_at_start(self._calibration, task, None)


def shown(calibration: TaskCalibration, law: str = "stereo") -> Drive:
    """``features`` (law stereo), ``points`` (law cartesian3): to the goal of the sketches."""
    world = World(calibration, start_pose())
    return world.servo(law, world.points_at(goal_pose()))


def displaced_twice(calibration: TaskCalibration) -> tuple[Drive, Drive]:
    """Goal ``displacement``: the same matrix twice, each from the body's present pose."""
    pose, drives = start_pose(), []
    first = World(calibration, pose)
    step = translation(0.13, -0.09, 0.0) @ _about(pose, rotation("z", 35))
    matrix = np.linalg.lstsq(_frame(first, pose), _frame(first, step @ pose), rcond=None)[0].T
    for world in (first, World(calibration, step @ pose)):
        targets = with_unit_height(world.points @ matrix.T, world.knowledge.plane_at_infinity)
        drives.append(world.servo("cartesian3", targets))
    return drives[0], drives[1]


def _about(pose: FloatArray, turn: FloatArray) -> FloatArray:
    """Displacement ``turn`` (4, 4) about the centre of the plate at ``pose``."""
    middle = translation(*pose[:3, 3])
    return np.asarray(middle @ turn @ np.linalg.inv(middle))


def _frame(world: World, pose: FloatArray) -> FloatArray:
    """Points (5, 4) fixed to a body at ``pose``, in the model's frame, of scale 1, which determine its
    displacement.
    """
    corners = np.vstack([np.eye(4) * 0.1, [[0.1, 0.1, 0.1, 0.0]]])
    corners[:, 3] = 1.0
    return world.seen_points(corners @ pose.T)[1]


class GoalSketch(NamedTuple):
    """A goal transferred to a moved workpiece; pixels (2, n, 2)."""

    taught: FloatArray
    workpiece_then: FloatArray
    workpiece_now: FloatArray
    set_points: FloatArray
    drive: Drive


def carried_over(calibration: TaskCalibration) -> GoalSketch:
    """Goal ``taught``: relative to five markers of the workpiece, by a homography of space alone."""
    world = World(calibration, start_pose())
    then = translation(0.06, 0.06, 1.12) @ rotation("x", 10)
    now = translation(0.12, -0.02, 1.05) @ rotation("z", -25) @ rotation("y", 15)
    goal = then @ translation(0.0, -0.1, -0.03)
    old_pixels, old_points = world.seen_points(WORKPIECE @ then.T)
    new_pixels, _ = world.seen_points(WORKPIECE @ now.T)
    frame = AlignmentFrame(world.knowledge.matrices)
    change = align("projective", frame, frame, old_points, new_pixels, SIGMA_PX)
    targets = with_unit_height(world.points_at(goal) @ change.H.T, world.knowledge.plane_at_infinity)
    drive = world.servo("cartesian3", targets)
    return GoalSketch(sight(goal).pixels, old_pixels, new_pixels, world.towards(targets).set_points, drive)


class OnLine(NamedTuple):
    """Motions onto ``line`` (2, 2, 2), pixels of two of its points, with the remaining freedoms unused, and used."""

    line: FloatArray
    alone: Drive
    with_second: Drive
    set_points: FloatArray


def point_on_line(calibration: TaskCalibration) -> OnLine:
    """Goal ``incidence``: marker 0 onto a line; the remaining freedoms unused, or used for set-points."""
    world = World(calibration, start_pose())
    line_pixels, line_points = world.seen_points(np.array([(-0.2, -0.15, 1.05, 1.0), (0.3, -0.05, 1.0, 1.0)]))
    on_line = incidence_task(
        ("point-on-line",), ((0,),), (line_points,), world.knowledge.plane_at_infinity, 0.01
    )
    targets = world.points_at(goal_pose())
    set_points, _ = project_points(world.knowledge.matrices, targets)

    def command(scene: Scene, second: SecondTask | None) -> FloatArray:
        return np.asarray(incidence_step(scene, on_line, Options(GAIN, DT_S), second).velocity)

    def second_task(scene: Scene) -> SecondTask:
        weights = np.ones(set_points.shape[:2])
        return image_task(scene.operators, scene.matrices, scene.points, set_points, weights, GAIN)

    alone = world.drive(lambda scene, time_s: command(scene, None), 6.0)
    given = world.drive(lambda scene, time_s: command(scene, second_task(scene)), 10.0)
    return OnLine(line_pixels, alone, given, set_points)


class Streamed(NamedTuple):
    """``target`` (k, 2, 4, 2) pixels; tracked with velocity feedforward, and without."""

    target: FloatArray
    fed_forward: Drive
    without: Drive


def streamed(calibration: TaskCalibration) -> Streamed:
    """A target on a circle, one turn after the arm has caught up."""
    world = World(calibration, start_pose())

    def pose_at(k: int) -> FloatArray:
        angle = 2.0 * np.pi * k * DT_S / TURN_S
        return translation(CIRCLE_M * np.cos(angle), CIRCLE_M * np.sin(angle), 1.05) @ rotation("y", 15)

    seconds = 2.0 * TURN_S
    poses = [pose_at(k) for k in range(round(seconds / DT_S) + 2)]
    target = np.array([sight(pose).pixels for pose in poses])
    bodies = [world.points_at(pose) for pose in poses]

    def command(scene: Scene, time_s: float, fed: bool) -> FloatArray:
        k = round(time_s / DT_S)
        task = world.towards(bodies[k])._replace(centre=scene.points.mean(axis=0))
        velocity = np.asarray(LAWS["stereo"].step(scene, task, Options(GAIN, DT_S)).velocity)
        if fed:
            rates = (target[k + 1] - target[k]) / DT_S
            J = np.ascontiguousarray(image_jacobian(scene.operators, scene.matrices, scene.points))
            ahead, _ = damped_least_squares(
                J.reshape(rates.size, -1), rates.reshape(-1), np.ones(rates.size), FEED_FORWARD_DAMPING
            )
            velocity = velocity + ahead
        return velocity

    fed = world.drive(lambda scene, time_s: command(scene, time_s, True), seconds)
    without = world.drive(lambda scene, time_s: command(scene, time_s, False), seconds)
    return Streamed(target[:-1], fed, without)
