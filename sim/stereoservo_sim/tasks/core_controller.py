"""Tasks driven by the servo core: goal, planning, law, monitors and safety stage as they run in the daemon.

The core runs at `CORE_RATE_HZ`, the frames come at the rate of the tasks' loop; each is in hand a cycle after its
shutter. What the cell's operator does (a model, enable) is done before the first frame.
"""

from __future__ import annotations

import uuid

import numpy as np

from stereoservo.control.marker_groups import with_groups
from stereoservo.core.cycle import ModelUpdate, StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Command, Enable, FeatureTarget, Goal, LawName, Request, RunGoal
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation, JointState
from stereoservo_sim.tasks.arms import TaskArm
from stereoservo_sim.tasks.ground_truth import sight
from stereoservo_sim.tasks.marker_estimate import PointsName
from stereoservo_sim.tasks.planned_path import LOOK_S, NoPathError
from stereoservo_sim.tasks.setting import HEIGHT, SUCCESS_PX, WIDTH
from stereoservo_sim.tasks.task_file import AlignmentTask

CORE_RATE_HZ = 250.0
TOLERANCE_PX = 0.6 * SUCCESS_PX
HOLD_FRAMES = 5
SPEED = {"revolute": 1.0, "prismatic": 0.25}
ACCELERATION = {"revolute": 4.0, "prismatic": 1.0}
"""Of every joint at most, by its kind: [rad/s or m/s], [rad/s² or m/s²]."""
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
        """Move the arm until the next frame after this one, (c, m, 2) with ``seen`` (c, m) 1 or 0; why the goal was
        lost, or ''. Raises NoPathError where it is refused, DriverError where the arm has stopped by itself.
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
        self, arm: TaskArm, *commands: Command, observations: tuple[CameraObservation, ...] = (),
        model_update: ModelUpdate | None = None,
    ) -> StepOutputs:  # fmt: skip
        self._now_ns += self._period_ns
        self._seq += 1
        requests = tuple(Request(self._seq, "task", command) for command in commands)
        joints = JointState(self._seq, self._now_ns, arm.joints.copy(), np.zeros(len(arm.joints)))
        outputs = self._core.step(
            StepInputs(
                self._now_ns, self._period_ns, joints, observations, requests, driver_active=self._active,
                model_update=model_update,
            )
        )  # fmt: skip
        if outputs.driver_request:
            self._active = outputs.driver_request == "activate"
        if outputs.command is not None:
            arm.move(outputs.command, 1e-9 * self._period_ns)
        return outputs

    def _observations(self, pixels: FloatArray, seen: FloatArray) -> tuple[CameraObservation, ...]:
        """Frames whose shutters open now, in hand in the next cycle."""
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
