"""One task in closed loop: the controller sees noisy pixels only, and is evaluated against ground truth.

Set-points are the exact projections of the goal (a goal is taught at rest, averaged over many frames); the target
points are computed from them with the controller's model.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal, Protocol

import msgspec
import numpy as np

from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.laws.image import image
from stereoservo.control.laws.points import step_by_points
from stereoservo.control.laws.stereo import NO_COMPONENTS, NO_STATUS, held_gain, limited
from stereoservo.control.marker_groups import with_groups
from stereoservo.core.cycle import ModelUpdate, StepInputs, StepOutputs
from stereoservo.core.goals.marker_body import goal_pose
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import project_points, transform_points, triangulate
from stereoservo.kinematics.model import CellModel, pinhole
from stereoservo.messages.goals import (
    DEFAULT_LAW,
    Command,
    Enable,
    FeatureTarget,
    Goal,
    LawName,
    Request,
    RunGoal,
)
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.plan import ClosestApproach, Plan, PlanLimits, PlanRequest
from stereoservo.planning.planner import plan
from stereoservo.planning.tracking import advance, planned_joints, sample_plan
from stereoservo.ports.devices import CameraObservation, DriverError, JointState
from stereoservo_sim.tasks.arms import ArmName, FreeArm, SerialArm, TaskArm, mechanics_of, rx90_reach
from stereoservo_sim.tasks.calibrations import (
    CalibrationName,
    Knowledge,
    TaskCalibration,
    calibrate,
    known_at_start,
)
from stereoservo_sim.tasks.ground_truth import error_px, in_images, line_deviations, noise_floor_px, sight
from stereoservo_sim.tasks.marker_estimate import MarkerEstimate, PointsName
from stereoservo_sim.tasks.options import DEFAULT_GAIN, DEFAULT_RATE_HZ
from stereoservo_sim.tasks.setting import FACE, HEIGHT, MAX_ITERATIONS, MIN_DEPTH, SUCCESS_PX, WIDTH
from stereoservo_sim.tasks.task_file import AlignmentTask
from stereoservo_sim.tasks.twist_arm import TwistArm, twist_start
from stereoservo_sim.world.presets import MechanicsPreset
from stereoservo_sim.world.synthetic import Kind

TIME_LIMIT_S = MAX_ITERATIONS / DEFAULT_RATE_HZ
REST_STEPS = 50
"""Steps at 25 Hz over which an error at rest is averaged, after it has held as long; at other rates the same time."""
LOST_S = 1.0
"""Time for which the arm may stand still without enough visible markers before the run has failed."""
STILL_FALLING = 0.75
"""A mean error below this share of the previous one is still decreasing: the task has not come to rest."""
NEGLIGIBLE_PX = 1e-4
"""A smaller error counts as settled, decreasing or not."""


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the tasks' execution.

    ``law``: of `LAWS`, `CLASSICAL`, or ``euclidean-points`` for metric models. ``first_order``: laws with a step
    correction do not use it. ``joint_speed`` [rad/s or m/s]: limit of the fastest joint, the others in proportion.
    ``drop_camera``: start and duration [s] of an interval without the second camera. ``centre``: ``middle``
    of the markers or the number of one. ``mechanics``: of the arm ``rx90``; None: perfect. ``core``: the servo
    core drives the arm, which needs joints and a model; else the law alone. ``coasts``: the law continues with the
    predicted pixels of invisible markers.
    """

    law: str = DEFAULT_LAW
    arm: ArmName = "free"
    calibration: CalibrationName = "self"
    jacobian: Literal["current", "desired", "mean", "fixed-depth"] = "mean"
    centre: str = "middle"
    points: PointsName = "predicted"
    gain: float = DEFAULT_GAIN
    rate_hz: float = DEFAULT_RATE_HZ
    noise_px: float = 0.1
    seed: int = 0
    drop_camera: tuple[float, float] | None = None
    first_order: bool = False
    joint_speed: float | None = None
    mechanics: MechanicsPreset | None = None
    core: bool = False
    coasts: bool = False


class PlateSight(Protocol):
    """Protocol of a source of the plate's pixels for the controller; default: its projections with noise
    (`Projections`).
    """

    def look(
        self, pose: FloatArray, time_s: float, expected: FloatArray | None, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray] | None:
        """Pixels (c, m, 2) and visibility (c, m), 1 or 0, with the plate at ``pose`` (4, 4).

        ``expected`` (c, m, 2): pixels expected by the controller, None at first. Returns None if too little is visible
        to continue.
        """
        ...


@dataclass(frozen=True)
class Projections:
    """Exact projections with the settings' noise, inside an image of a camera that is not dropped."""

    settings: LoopSettings

    def look(
        self, pose: FloatArray, time_s: float, expected: FloatArray | None, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """See `PlateSight`."""
        pixels = sight(pose).pixels
        seen = in_images(pixels).astype(np.float64)
        if self.settings.drop_camera is not None:
            start, duration = self.settings.drop_camera
            if start <= time_s < start + duration:
                seen[1] = 0.0
        return pixels + rng.normal(0.0, 1.0, pixels.shape) * self.settings.noise_px, seen


class TaskResult(msgspec.Struct, frozen=True):
    """Result of a task, evaluated on noise-free projections.

    ``success``: None if the arm cannot reach it. ``iterations``: until the error stayed below `SUCCESS_PX`, or all
    that were made. ``final_error_px``: mean over the last `REST_STEPS` of the largest error over markers and cameras
    used; ``floor_px``: the expected part of it due to image noise. ``line_deviation_mm``: the largest distance of
    the plate's centre from the straight path. ``rest_mm_s``, ``rest_mrad_s``: rms of the plate's velocity at rest.
    ``closest_view_px``: least distance of a marker from an image's border, on the whole path. ``reason``: why it
    failed; ``refused``, ``stopped``: message of the refusal, or of the arm's controller when it stopped.
    """

    id: int
    law: str
    success: bool | None
    iterations: int
    final_error_px: float | None
    back_face: bool
    out_of_view: bool
    line_deviation_mm: float | None
    floor_px: float | None
    rest_mm_s: float | None
    rest_mrad_s: float | None
    closest_view_px: float | None
    reason: str = ""
    refused: str = ""
    stopped: str = ""


@dataclass(frozen=True, eq=False)
class Trace:
    """Recorded path of a task: ``poses`` (k, 4, 4) of the plate, ``errors_px`` (k,), ``facing`` (k,) cosines.

    ``joints`` (k, n): the arm's readings. ``task_errors`` (k - 1, e): the law's error components at each step, NaN if
    it was not called.
    """

    poses: FloatArray
    errors_px: FloatArray
    facing: FloatArray
    joints: FloatArray
    task_errors: FloatArray


def run_task(
    task: AlignmentTask, calibration: TaskCalibration, settings: LoopSettings, shown: PlateSight | None = None
) -> tuple[TaskResult, Trace]:
    """Run one task with observations ``shown``; deterministic given task, calibration and settings."""
    arm = _placed_arm(task, calibration, settings)
    if arm is None:
        return _unreachable(task, settings)
    controller: Controller | CoreController
    if settings.core:
        assert calibration.model is not None
        controller = CoreController(
            calibration.model, task, arm, law=settings.law, points=settings.points, gain=settings.gain,
            rate_hz=settings.rate_hz, noise_px=settings.noise_px, time_limit_s=TIME_LIMIT_S,
        )  # fmt: skip
    else:
        joints = None if settings.arm == "free" else arm.joints
        controller = Controller(known_at_start(calibration, task, joints), task, settings, arm.limits)
    rng = np.random.default_rng([settings.seed, task.id])
    return _run(task, arm, controller, settings, rng, shown or Projections(settings))


def _placed_arm(task: AlignmentTask, calibration: TaskCalibration, settings: LoopSettings) -> TaskArm | None:
    """The arm with the plate at the task's start; None if it cannot execute the task."""
    if settings.arm == "free":
        return FreeArm(task.start)
    if settings.arm == "twist":
        start = twist_start(_way(task, settings))
        return None if start is None else TwistArm(start)
    reach = rx90_reach(calibration.cell, task.start, task.goal)
    return None if reach is None else SerialArm(calibration.cell, reach.start, mechanics_of(settings.mechanics))


def _way(task: AlignmentTask, settings: LoopSettings) -> FloatArray:
    """Path (k, 4, 4) of the plate under the law, with an unlimited arm and exact images; the straight path if the law
    does not reach the goal.
    """
    free = LoopSettings(law=settings.law, jacobian=settings.jacobian, noise_px=0.0, calibration="exact")
    result, trace = run_task(task, _known_free_arm(), free)
    return trace.poses if result.success else np.array([task.start, task.goal])


@cache
def _known_free_arm() -> TaskCalibration:
    return calibrate("free", "exact", 0.0, 0)


class Controller:
    """The controller: computes joint velocities from pixels and readings, with its `Knowledge` and the goal's pixels
    only.
    """

    def __init__(self, knowledge: Knowledge, task: AlignmentTask, settings: LoopSettings, limits: FloatArray) -> None:
        self._knowledge = knowledge
        self._dt_s = 1.0 / settings.rate_hz
        self._law = _law(settings.law, knowledge)
        self._joint_speed, self._coasts = settings.joint_speed, settings.coasts
        self.task_error = np.full(len(LAWS[settings.law].components) if settings.law in LAWS else 0, np.nan)
        self._options = Options(
            gain=settings.gain,
            dt_s=0.0 if settings.first_order else self._dt_s,
            jacobian=JacobianChoice[settings.jacobian.upper().replace("-", "_")],
        )
        self.estimate = MarkerEstimate(knowledge, settings.points, self._dt_s)
        self._set_points = sight(task.goal).pixels
        self._cameras = cameras_used(settings.law)
        self._wanted = np.ones(self._set_points.shape[:2])
        self._wanted[self._cameras :] = 0.0
        self._centre_weights = np.full(4, 0.25) if settings.centre == "middle" else np.eye(4)[int(settings.centre)]
        self._task: Task | None = None
        self._plans = settings.law in LAWS and LAWS[settings.law].planned
        self._look_steps = round(LOOK_S * settings.rate_hz) if self._plans else 0
        self._path: PlannedPath | None = None
        self._limits = limits
        self._operators = knowledge.basis

    def step(self, pixels: FloatArray, seen: FloatArray, joints: FloatArray) -> FloatArray:
        """Velocity (n,) from a frame (c, m, 2) with ``seen`` (c, m) 1 or 0, and the arm's readings (n,).

        Raises NoPathError if a path must be planned and there is none.
        """
        knowledge = self._knowledge
        self._operators = knowledge.operators(joints)
        self.estimate.seen(pixels, seen * self._wanted)
        if self._look_steps > 0:
            self._look_steps -= 1
            return np.zeros(len(joints))
        points = self.estimate.points
        if self._task is None:
            self._task = self._start(points)
        task = self._task._replace(centre=self._centre_weights @ points)
        scene = Scene(
            self._operators,
            int(knowledge.composition),
            knowledge.matrices,
            knowledge.camera_centres,
            points,
            self.estimate.pixels,
            self._wanted if self._coasts else seen * self._wanted,
        )
        if self._plans:
            if self._path is None:
                self._path = plan_task_path(scene, task, joints, self._limits, knowledge.kinds)
            task = self._path.task_now(scene, task, joints, self._dt_s)
        step = self._law(scene, task, self._options)
        self.task_error = step.error
        if self._joint_speed is None:
            return np.asarray(step.velocity)
        fastest = float(np.abs(step.velocity).max())
        return np.asarray(step.velocity * (self._joint_speed / max(fastest, self._joint_speed)))

    @property
    def expected(self) -> FloatArray | None:
        """Expected pixels (c, m, 2) of the markers; None while no point is known."""
        points = self.estimate.points
        return project_points(self._knowledge.matrices, points)[0] if len(points) else None

    def advance(self, pixels: FloatArray, seen: FloatArray, arm: TaskArm) -> str:
        """Move the arm for one step from a frame; returns why this is impossible, or ''. Raises NoPathError,
        DriverError.
        """
        velocity = self.step(pixels, seen, arm.joints)
        if not np.isfinite(velocity).all():
            return "NO_COMMAND"
        ahead = arm.joints + velocity * self._dt_s
        if (ahead < arm.limits[:, 0]).any() or (ahead > arm.limits[:, 1]).any():
            return "JOINT_LIMIT"
        arm.move(velocity, self._dt_s)
        self.estimate.moved(self._operators, velocity * self._dt_s)
        return ""

    def _start(self, points: FloatArray) -> Task:
        knowledge = self._knowledge
        every = np.ones(self._set_points.shape[:2])
        found, ok = triangulate(knowledge.matrices, self._set_points, every, 5)
        targets = found / (found @ knowledge.plane_at_infinity)[:, None]
        # Equal systematic errors of the triangulation at both poses then cancel.
        if knowledge.points is not None and not self.estimate.triangulates:
            pose = goal_pose(_arrays(knowledge), knowledge.basis, points, targets, ok, FACE, self._set_points, every)
            targets = pose.points
        return Task(
            set_points=self._set_points,
            wanted=self._wanted,
            rates=np.zeros_like(self._set_points),
            target_points=targets,
            target_known=np.ones(len(targets)),
            centre=self._centre_weights @ points,
            centre_target=self._centre_weights @ targets,
            face=FACE,
        )


def _law(name: str, knowledge: Knowledge) -> Callable[[Scene, Task, Options], LawStep]:
    if name in LAWS:
        return LAWS[name].step
    if name in CLASSICAL:
        return CLASSICAL[name]
    if name == "euclidean-points" and not knowledge.plane_at_infinity[:3].any():
        # A metric model is in the rig's frame.
        return euclidean_points(np.eye(4))
    known = ", ".join([*LAWS, *CLASSICAL, "euclidean-points (metric models)"])
    raise ValueError(f"no law {name!r} for this model; known: {known}")


def cameras_used(law: str) -> int:
    """Number of cameras that a law uses."""
    return 1 if law in LAWS and LAWS[law].one_camera == "suffices" else 2


def _arrays(knowledge: Knowledge) -> ModelArrays:
    """The model in the form used by the daemon's search for the goal pose."""
    n, m = len(knowledge.basis), len(FACE) + 1
    return ModelArrays(
        generators=knowledge.basis,
        kinds=np.zeros(n, dtype=np.uint8),
        zero=np.zeros(n),
        tip_first=False,
        composition=int(Composition.BASE_FIRST),
        matrices=knowledge.matrices,
        lenses=np.zeros((len(knowledge.matrices), 4)),
        marker_points=np.zeros((m, 4)),
        plane_at_infinity=knowledge.plane_at_infinity,
        camera_centres=knowledge.camera_centres,
        metric_basis=None,
        to_euclidean=None,
        marker_ids=tuple(range(m)),
        index={i: i for i in range(m)},
        scene_ids=(),
        scene_points=np.zeros((0, 4)),
        scene_pixels=np.zeros((len(knowledge.matrices), 0, 2)),
        row_ids=np.arange(m),
        row_of=np.arange(m),
        groups=None,
        observation_count=m * len(knowledge.matrices),
        joint_accuracy=None,
        joint_variances=np.zeros(n),
    )


def _run(
    task: AlignmentTask,
    arm: TaskArm,
    controller: Controller | CoreController,
    settings: LoopSettings,
    rng: np.random.Generator,
    shown: PlateSight,
) -> tuple[TaskResult, Trace]:
    dt_s = 1.0 / settings.rate_hz
    window = max(2, round(REST_STEPS * settings.rate_hz / DEFAULT_RATE_HZ))
    limit = round(TIME_LIMIT_S * settings.rate_hz)
    used = cameras_used(settings.law)
    set_points = sight(task.goal).pixels
    poses, errors, facing = np.empty((limit + 1, 4, 4)), np.full(limit + 1, np.nan), np.empty(limit + 1)
    joints, task_errors = (
        np.empty((limit + 1, len(arm.joints))),
        np.empty((limit, len(controller.task_error))),
    )
    margin, back_face, out_of_view, reason, refused, stopped = np.inf, False, False, "", "", ""
    steps, waited = 0, 0
    for k in range(limit + 1):
        truth = sight(arm.pose, used)
        steps = k + 1
        poses[k], facing[k], joints[k] = arm.pose, truth.facing, arm.joints
        margin = min(margin, truth.margin_px)
        back_face |= truth.facing <= 0.0
        out_of_view |= not truth.in_view
        if truth.depth_m <= MIN_DEPTH:
            reason = "BEHIND_CAMERA"
            break
        errors[k] = error_px(truth.pixels, set_points, used)
        if k == limit or _settled(errors, k, window):
            break
        frame = shown.look(arm.pose, k * dt_s, controller.expected, rng)
        waited = waited + 1 if frame is None else 0
        if waited > LOST_S * settings.rate_hz:
            reason = "EXTRACTION_LOST"
            break
        if frame is None:
            continue
        try:
            reason = controller.advance(*frame, arm)
        except NoPathError as error:
            reason, refused = "REFUSED", error.reason
        except DriverError as error:
            reason, stopped = error.code.upper(), str(error)
        if refused:
            break
        task_errors[k] = controller.task_error
        if reason:
            break
    trace = Trace(poses[:steps], errors[:steps], facing[:steps], joints[:steps], task_errors[: max(steps - 1, 0)])
    flags = (back_face, out_of_view)
    result = _judged(task, settings, trace, flags, margin, (reason, refused), window)
    return msgspec.structs.replace(result, stopped=stopped), trace


def _settled(errors: FloatArray, k: int, window: int) -> bool:
    """Whether the error has been small for two windows without a further decrease."""
    if k + 1 < 2 * window or not errors[k] < SUCCESS_PX or (k % max(window // 10, 1)):
        return False
    before, last = errors[k + 1 - 2 * window : k + 1 - window], errors[k + 1 - window : k + 1]
    if not (before.max() < SUCCESS_PX and last.max() < SUCCESS_PX):
        return False
    return bool(last.mean() < NEGLIGIBLE_PX or last.mean() > STILL_FALLING * before.mean())


def _judged(
    task: AlignmentTask,
    settings: LoopSettings,
    trace: Trace,
    flags: tuple[bool, bool],
    margin: float,
    reasons: tuple[str, str],
    window: int,
) -> TaskResult:
    back_face, out_of_view = flags
    reason, refused = reasons
    dt_s = 1.0 / settings.rate_hz
    last = trace.errors_px[-window:]
    converged = not reason and len(last) == window and bool((last < SUCCESS_PX).all())
    if not reason and not converged:
        reason = "NOT_CONVERGED"
    if back_face or out_of_view:
        reason = reason or ("BACK_FACE" if back_face else "OUT_OF_VIEW")
    above = np.flatnonzero(~(trace.errors_px < SUCCESS_PX))
    iterations = int(above[-1]) + 1 if converged and len(above) else (0 if converged else len(trace.poses) - 1)
    moves, turns = _rest_velocity(trace.poses[-window:], dt_s)
    finite = last[np.isfinite(last)]
    return TaskResult(
        id=task.id,
        law=settings.law,
        success=not reason,
        iterations=iterations,
        final_error_px=float(finite.mean()) if len(finite) else None,
        back_face=back_face,
        out_of_view=out_of_view,
        line_deviation_mm=1e3 * float(line_deviations(trace.poses, task.start, task.goal).max()),
        floor_px=noise_floor_px(task.goal, settings.noise_px, settings.gain, dt_s, cameras_used(settings.law)),
        rest_mm_s=1e3 * moves if converged else None,
        rest_mrad_s=1e3 * turns if converged else None,
        closest_view_px=float(margin) if np.isfinite(margin) else None,
        reason=reason,
        refused=refused,
    )


def _rest_velocity(poses: FloatArray, dt_s: float) -> tuple[float, float]:
    """Rms speed [m/s] and turn rate [rad/s] of the plate between poses (k, 4, 4)."""
    if len(poses) < 2:
        return 0.0, 0.0
    shift = np.diff(poses[:, :3, 3], axis=0) / dt_s
    turn = np.einsum("kji,kjl->kil", poses[:-1, :3, :3], poses[1:, :3, :3])
    odd = 0.5 * (turn - turn.transpose(0, 2, 1))
    rate = np.stack([odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]], axis=1) / dt_s
    return (
        float(np.sqrt((shift * shift).sum(axis=1).mean())),
        float(np.sqrt((rate * rate).sum(axis=1).mean())),
    )


def _unreachable(task: AlignmentTask, settings: LoopSettings) -> tuple[TaskResult, Trace]:
    result = TaskResult(task.id, settings.law, None, 0, None, False, False, None, None, None, None, None, "UNREACHABLE")
    none = np.zeros(0)
    return result, Trace(task.start[None], none, none, np.zeros((0, 6)), np.zeros((0, 0)))


# -- laws that are compared ----------------------------------------------------------------------------------
# Control laws for comparison only: per camera (8.37), and on metric points of a calibrated rig (8.17).


def stereo_block(scene: Scene, task: Task, options: Options) -> LawStep:
    """Mean of the laws of the single cameras that see the markers (8.37, halved for two: errata)."""
    velocity, conditioning, seeing = np.zeros(scene.operators.shape[0]), 1.0, 0
    for camera in range(scene.matrices.shape[0]):
        alone = np.zeros_like(task.wanted)
        alone[camera] = task.wanted[camera]
        if not (scene.weights * alone > 0.0).any():
            continue
        step = image(scene, task._replace(wanted=alone), options)
        velocity, conditioning, seeing = (
            velocity + step.velocity,
            min(conditioning, step.conditioning),
            seeing + 1,
        )
    if seeing == 0:
        return LawStep(velocity, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, 0.0)
    return LawStep(velocity / seeing, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, conditioning)


def euclidean_points(
    H_projective_to_euclidean: FloatArray,
) -> Callable[[Scene, Task, Options], LawStep]:
    """The law on points in metric coordinates (8.17), for a calibrated rig: the conventional method, for comparison.

    ``H_projective_to_euclidean`` (4, 4) maps the frame's points to the metric frame of that rig.
    """
    H = np.ascontiguousarray(H_projective_to_euclidean, dtype=np.float64)

    def step(scene: Scene, task: Task, options: Options) -> LawStep:
        X, X_star = scene.points @ H.T, task.target_points @ H.T
        known = task.target_known > 0.0
        X = X / X[:, 3:]
        X_star = np.where(known[:, None], X_star / np.where(known, X_star[:, 3], 1.0)[:, None], 0.0)
        metres = np.tile(np.eye(3, 4), (X.shape[0], 1, 1))
        operators = np.ascontiguousarray(H @ scene.operators @ np.linalg.inv(H))
        jacobian = JacobianChoice.CURRENT if options.jacobian == JacobianChoice.FIXED_DEPTH else options.jacobian
        seen = (_seen(scene, task) > 0.0).astype(np.float64)
        velocity, conditioning = step_by_points(
            operators, (X, X_star, seen, metres), (held_gain(options), int(jacobian), options.damping)
        )
        return limited(scene, task, options, velocity, conditioning)

    return step


def _seen(scene: Scene, task: Task) -> FloatArray:
    """Weights (m,) of the markers: of the camera that sees each best, 0 where the goal's point is unknown."""
    found: FloatArray = scene.weights.max(axis=0, initial=0.0) * (task.target_known > 0.0)
    return found


CLASSICAL: Mapping[str, Callable[[Scene, Task, Options], LawStep]] = {
    "stereo-block": stereo_block,
}
"""Laws by name. `euclidean_points` also needs a metric frame."""


# -- the core as a controller --------------------------------------------------------------------------------
# Tasks driven by the servo core: goal, planning, law, monitors and safety stage as they run in the daemon.
#
# The core runs at `CORE_RATE_HZ`, frames arrive at the rate of the tasks' loop, each one cycle after its
# shutter. The cell operator's actions (set a model, enable) are done before the first frame.


CORE_RATE_HZ = 250.0
TOLERANCE_PX = 0.6 * SUCCESS_PX
HOLD_FRAMES = 5
SPEED = {"revolute": 1.0, "prismatic": 0.25}
ACCELERATION = {"revolute": 4.0, "prismatic": 1.0}
"""Limits of every joint by its kind: [rad/s or m/s], [rad/s² or m/s²]."""
LEAST_SIGMA_PX = 0.01
LOST = ("goal_aborted", "goal_cancelled", "fault")


class CoreController:
    """A servo core that drives an arm to a task's goal; `closed_loop.Controller` runs a law alone."""

    def __init__(
        self, model: CellModel, task: AlignmentTask, arm: TaskArm, *,
        law: LawName, points: PointsName, gain: float, rate_hz: float, noise_px: float, time_limit_s: float,
    ) -> None:  # fmt: skip
        self.task_error, self.expected = np.zeros(0), None
        self._core = ServoCore(_settings(model, arm.limits, law, points, gain, rate_hz))
        self._period_ns = round(1e9 / CORE_RATE_HZ)
        self._cycles = max(1, round(CORE_RATE_HZ / rate_hz))
        self._cameras = tuple(camera.name for camera in model.cameras)
        self._ids = np.array(model.marker_ids)
        self._covariances = np.tile(max(noise_px, LEAST_SIGMA_PX) ** 2 * np.eye(2), (len(self._ids), 1, 1))
        self._now_ns, self._seq, self._active = 1_000_000_000, 0, False
        self._step(arm, model_update=ModelUpdate(with_groups(model)))
        self._step(arm, Enable())
        wanted = sight(task.goal).pixels
        target = FeatureTarget(
            {
                name: {int(i): (float(u), float(v)) for i, (u, v) in zip(self._ids, pixels, strict=True)}
                for name, pixels in zip(self._cameras, wanted, strict=True)
            }
        )
        self._goal = RunGoal(Goal(str(uuid.UUID(int=task.id + 1)), target, time_limit_s=time_limit_s))
        self._looks = round(LOOK_S * rate_hz)

    def advance(self, pixels: FloatArray, seen: FloatArray, arm: TaskArm) -> str:
        """Move the arm until the next frame after this one, (c, m, 2) with ``seen`` (c, m) 1 or 0; returns why the goal
        was
        lost, or ''. Raises NoPathError if it is refused, DriverError if the arm has stopped by itself.
        """
        frame = self._observations(pixels, seen)
        self._looks -= 1
        for cycle in range(self._cycles):
            requests = (self._goal,) if self._looks == 0 and cycle == 0 else ()
            outputs = self._step(arm, *requests, observations=frame if cycle == 0 else ())
            for event in outputs.events:
                if event.kind == "reply" and not event.accepted:
                    raise NoPathError(event.message)
                if event.kind in LOST:
                    return "; ".join(reason.code for reason in event.reasons) or event.kind
        return ""

    def _step(
        self,
        arm: TaskArm,
        *commands: Command,
        observations: tuple[CameraObservation, ...] = (),
        model_update: ModelUpdate | None = None,
    ) -> StepOutputs:
        self._now_ns += self._period_ns
        self._seq += 1
        requests = tuple(Request(self._seq, "task", command) for command in commands)
        joints = JointState(self._seq, self._now_ns, arm.joints.copy(), np.zeros(len(arm.joints)))
        outputs = self._core.step(
            StepInputs(
                self._now_ns,
                self._period_ns,
                joints,
                observations,
                requests,
                driver_active=self._active,
                model_update=model_update,
            )
        )
        if outputs.driver_request:
            self._active = outputs.driver_request == "activate"
        if outputs.command is not None:
            arm.move(outputs.command, 1e-9 * self._period_ns)
        return outputs

    def _observations(self, pixels: FloatArray, seen: FloatArray) -> tuple[CameraObservation, ...]:
        """Frames with shutters at this time, available in the next cycle."""
        received = self._now_ns + self._period_ns
        return tuple(
            CameraObservation(
                name,
                self._seq,
                self._now_ns,
                received,
                self._ids[there],
                pixels[c, there],
                self._covariances[there],
            )
            for c, name in enumerate(self._cameras)
            if (there := seen[c] > 0.0).any()
        )


def _settings(
    model: CellModel, limits: FloatArray, law: LawName, points: PointsName, gain: float, rate_hz: float
) -> CoreSettings:
    n = len(model.joint_names)
    return CoreSettings(
        cell="task",
        joint_names=model.joint_names,
        joint_kinds=model.joint_kinds,
        cameras=tuple(
            CameraSettings(camera.name, WIDTH, HEIGHT, rate_hz, "eye_to_hand", model.marker_ids)
            for camera in model.cameras
        ),
        limits=LimitSettings(
            limits[:, 0].copy(), limits[:, 1].copy(), np.array([SPEED[kind] for kind in model.joint_kinds]),
            np.array([ACCELERATION[kind] for kind in model.joint_kinds]), 0.01,
            np.zeros((0, n, 2)), (), 0.5, 0.1, 1.0,
        ),
        trials=None,
        home=None,
        rate_hz=CORE_RATE_HZ,
        law=law,
        points=points,
        gain=gain,
        tolerance_px=TOLERANCE_PX,
        hold_frames=HOLD_FRAMES,
        time_limit_s=1e6,
        filter_s=0.2,
        gate_sigma=6.0,
        reanchor=False,
    )  # fmt: skip


# -- planned paths -------------------------------------------------------------------------------------------
# The law ``trajectory`` in a campaign: the path is planned before the motion, or refused, and then tracked.


LOOK_S = 0.4
"""Time for which the controller observes the plate before it plans."""
VIEW_MARGIN_PX = 2.0
"""Planned distance from the images' borders, for noise and following error."""
JOINT_MARGIN = 0.02
"""Planned distance from the joints' limits [rad], likewise."""
LARGEST_LAG_PX = 20.0
"""Following error at which the plan waits for the body."""
SPEED_M, SPEED_RAD = 0.1, 0.6
"""Speeds [m/s], [rad/s]; reached by acceleration in half a second."""
ACCELERATION_S = 0.5


class NoPathError(Exception):
    """There is no path. ``reason``: why, and where on the path."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class PlannedPath:
    """A planned path during its execution."""

    def __init__(self, planned: Plan, start: FloatArray, task: Task) -> None:
        self.plan = planned
        self._start = start
        self._task = task
        self._time_s = 0.0

    def task_now(self, scene: Scene, task: Task, joints: FloatArray, dt_s: float) -> Task:
        """Current set-points of the plan, with their velocities as a difference over ``dt_s``.

        Likewise its joint positions, for an arm at ``joints`` (n,). The plan's time advances by ``dt_s``, or less if
        the body lags.
        """
        set_points = self._set_points(scene)
        apart = np.sqrt(((set_points - scene.pixels) ** 2).sum(axis=-1))
        lag = float(np.where(scene.weights > 0.0, apart, 0.0).max()) / LARGEST_LAG_PX
        begin_s, self._time_s = self._time_s, advance(self.plan, self._time_s, dt_s, lag)
        planned = planned_joints(self.plan, begin_s, self._time_s, dt_s, joints)
        return task._replace(
            set_points=set_points,
            rates=(self._set_points(scene) - set_points) / dt_s,
            joint_rates=planned.rates,
            joint_error=planned.error,
            joint_weight=planned.weight,
        )

    def _set_points(self, scene: Scene) -> FloatArray:
        points = transform_points(sample_plan(self.plan, self._time_s).displacement, self._start)
        pixels, _ = project_points(scene.matrices, points)
        length_s = float(self.plan.times[-1])
        share = min(1.0, self._time_s / length_s) if length_s > 0.0 else 1.0
        # The difference of the goal's pixels from the body's projections is added gradually along the path.
        goal, _ = project_points(scene.matrices, self._task.target_points)
        return np.asarray(pixels + share * (self._task.set_points - goal))


def plan_task_path(
    scene: Scene, task: Task, joints: FloatArray, limits: FloatArray, kinds: tuple[Kind, ...]
) -> PlannedPath:
    """Path from ``scene`` to ``task``; ``limits`` (n, 2) and ``kinds`` of the joints. Raises NoPathError."""
    n, cameras = len(joints), len(scene.matrices)
    speeds = np.array([SPEED_M if kind == "prismatic" else SPEED_RAD for kind in kinds])
    request = PlanRequest(
        operators=scene.operators,
        composition=scene.composition,
        joints=joints,
        matrices=scene.matrices,
        camera_centres=scene.camera_centres,
        points=scene.points,
        targets=task.target_points,
        must_stay_visible=np.ones(len(scene.points)),
        centre=task.centre,
        centre_target=task.centre_target,
        faces=FACE[None],
        limits=PlanLimits(
            position_min=limits[:, 0] + JOINT_MARGIN,
            position_max=limits[:, 1] - JOINT_MARGIN,
            velocity_max=speeds,
            acceleration_max=speeds / ACCELERATION_S,
            keep_outs=np.zeros((0, n, 2)),
            sizes=np.tile(np.array([WIDTH, HEIGHT], dtype=np.float64), (cameras, 1)),
            lenses=np.tile(pinhole(), (cameras, 1)),
            view_margin_px=VIEW_MARGIN_PX,
        ),
    )
    planning = plan(request)
    if planning.plan is None:
        raise NoPathError("; ".join(describe_failure(failure) for failure in planning.failure))
    return PlannedPath(planning.plan, scene.points.copy(), task)


def describe_failure(failure: ClosestApproach) -> str:
    """A failure as text."""
    marker = f" of marker {failure.marker}" if failure.marker >= 0 else ""
    return (
        f"{failure.kind} {failure.index}{marker} at {failure.path_parameter:.0%} of the path: {failure.value:.4g} "
        f"{failure.unit}, limit {failure.limit:.4g}"
    )
