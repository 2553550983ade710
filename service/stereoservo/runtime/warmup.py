"""Compiles the kernels of the loop into numba's cache, so that a process that starts later finds them
compiled.

A made-up arm with two cameras runs some steps of each law; kernels are compiled by types, not by sizes. The
cameras' lenses bend, so that the lens's kernels run too.
"""

from __future__ import annotations

from typing import get_args

import msgspec
import numpy as np

from stereoservo.control.incidence_rehearsal import rehearse_incidences
from stereoservo.control.laws_rehearsal import rehearse_laws
from stereoservo.control.mobility_kernel import self_motion_from_limits
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.model import MODEL_SCHEMA, CameraModel, CellModel
from stereoservo.runtime.commands import (
    Command,
    FeatureTarget,
    Goal,
    LawName,
    PointSource,
    Request,
    RunGoal,
    UpdateGoal,
)
from stereoservo.runtime.core import ServoCore
from stereoservo.runtime.cycle import ModelUpdate, StepInputs
from stereoservo.runtime.mobile import rehearse as rehearse_mobile
from stereoservo.runtime.ports import CameraObservation, FloatArray, JointState
from stereoservo.runtime.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.trajectory.rehearsal import rehearse_planning

WIDTH, HEIGHT, FOCAL = 640, 480, 600.0
JOINTS = tuple(f"j{k}" for k in range(1, 7))
CAMERAS = ("left", "right")
MARKERS = tuple(range(6))
STEPS = 40  # the plan of a short way is done in a third of them
PERIOD_NS = 4_000_000
LENS = np.array([-0.02, 0.5 * WIDTH, 0.5 * HEIGHT, 0.5 * WIDTH])


def warm_up() -> None:
    """Run each law on the made-up cell."""
    rehearse_incidences()
    rehearse_laws()
    rehearse_planning()
    rehearse_mobile()
    model = _model()
    pixels = np.stack(
        [distort(LENS, _project(camera.matrix, model.marker_points)) for camera in model.cameras]
    )
    seven = np.ones(7)  # a redundant arm's self-motion
    self_motion_from_limits(np.ones((8, 7)), 0.5 * seven, -seven, seven, 1.0)
    runs: list[tuple[LawName, PointSource]] = [("stereo", "triangulated")]
    runs.extend((law, "predicted") for law in get_args(LawName))
    for law, points in runs:
        core = ServoCore(_settings())
        target = FeatureTarget(
            {
                name: {
                    marker: (float(u) + 3.0, float(v) - 2.0)
                    for marker, (u, v) in zip(MARKERS, pixels[c], strict=True)
                }
                for c, name in enumerate(CAMERAS)
            }
        )
        goal_id = "00000000-0000"
        for step in range(1, STEPS):
            now_ns = 1_000_000_000 + step * PERIOD_NS
            command: Command | None = None
            if step == 5:
                command = RunGoal(Goal(goal_id, target, law=law, points=points))
            elif step == STEPS - 5:
                command = UpdateGoal(goal_id, target)
            core.step(
                StepInputs(
                    now_ns=now_ns,
                    period_ns=PERIOD_NS,
                    joints=JointState(step, now_ns, np.zeros(6), np.zeros(6)),
                    observations=tuple(
                        _sight(name, pixels[c], step, now_ns) for c, name in enumerate(CAMERAS)
                    ),
                    requests=() if command is None else (Request(1, "warmup", command),),
                    model_update=ModelUpdate(model) if step == 2 else None,
                    driver_active=True,
                )
            )
    _rehearse_health(model, pixels)


def _rehearse_health(model: CellModel, pixels: FloatArray) -> None:
    """Frames of a camera that was moved: what explains them is asked for at no other time."""
    settings = _settings()
    standing = tuple(msgspec.structs.replace(camera, mobile=False) for camera in settings.cameras)
    core = ServoCore(msgspec.structs.replace(settings, cameras=standing))
    moved = pixels + np.array([30.0, 0.0]) * np.array([1.0, 0.0])[:, None, None]
    for step in range(1, 12):
        now_ns = 1_000_000_000 + step * PERIOD_NS
        seen = moved if step > 6 else pixels
        core.step(
            StepInputs(
                now_ns=now_ns,
                period_ns=PERIOD_NS,
                joints=JointState(step, now_ns, np.zeros(6), np.zeros(6)),
                observations=tuple(_sight(name, seen[c], step, now_ns) for c, name in enumerate(CAMERAS)),
                model_update=ModelUpdate(model) if step == 2 else None,
            )
        )
    if core.state.reanchoring is None:
        raise AssertionError("the rehearsal's camera was moved, and nothing was said of it")


def _sight(camera: str, pixels: FloatArray, step: int, now_ns: int) -> CameraObservation:
    covariances = np.tile(0.01 * np.eye(2), (len(MARKERS), 1, 1))
    shutter_ns = now_ns - PERIOD_NS // 2
    return CameraObservation(camera, step, shutter_ns, now_ns, np.array(MARKERS), pixels.copy(), covariances)


def _project(matrix: FloatArray, points: FloatArray) -> FloatArray:
    m = points @ matrix.T
    pixels: FloatArray = m[:, :2] / m[:, 2:]
    return pixels


def _model() -> CellModel:
    axes = np.array([(0, 0, 1), (0, 1, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0)], dtype=float)
    feet = np.array(
        [(-0.8, 0, 1.6), (-0.7, 0, 1.5), (-0.4, 0, 1.5), (-0.2, 0, 1.4), (-0.1, 0, 1.3), (0, 0.05, 1.25)]
    )
    generators = np.zeros((6, 4, 4))
    for generator, (x, y, z), foot in zip(generators, axes, feet, strict=True):
        generator[:3, :3] = [(0, -z, y), (z, 0, -x), (-y, x, 0)]
        generator[:3, 3] = -generator[:3, :3] @ foot
    K = np.array([(FOCAL, 0, 0.5 * WIDTH), (0, FOCAL, 0.5 * HEIGHT), (0, 0, 1)])
    left = K @ np.eye(3, 4)
    right = left.copy()
    right[:, 3] = K @ (-0.2, 0.0, 0.0)
    markers = np.array(
        [
            (0, 0, 1.2, 1),
            (0.1, 0, 1.2, 1),
            (0.1, 0.1, 1.2, 1),
            (0, 0.1, 1.22, 1),
            (0.05, 0.03, 1.25, 1),
            (0.02, 0.08, 1.3, 1),
        ]
    )
    return CellModel(
        schema=MODEL_SCHEMA,
        epoch=1,
        joint_names=JOINTS,
        joint_kinds=("revolute",) * 6,
        zero=np.zeros(6),
        generators=generators,
        cameras=(
            CameraModel("left", left, WIDTH, HEIGHT, LENS),
            CameraModel("right", right, WIDTH, HEIGHT, LENS),
        ),
        marker_ids=MARKERS,
        marker_points=markers,
        plane_at_infinity=np.array([0.0, 0.0, 0.0, 1.0]),
        stratum="metric",
        projective_to_euclidean=np.eye(4),
        statistics=None,
    )


def _settings() -> CoreSettings:
    ones = np.ones(6)
    return CoreSettings(
        cell="warmup",
        joint_names=JOINTS,
        joint_kinds=("revolute",) * 6,
        cameras=tuple(
            CameraSettings(name, WIDTH, HEIGHT, 30.0, "eye_to_hand", MARKERS, mobile=True) for name in CAMERAS
        ),
        limits=LimitSettings(
            -2 * ones, 2 * ones, ones, 4 * ones, 0.01, np.zeros((0, 6, 2)), (), 0.5, 0.1, 1.0
        ),
        trials=None,
        home=None,
        rate_hz=250.0,
        law="stereo",
        points="predicted",
        gain=1.0,
        tolerance_px=0.1,
        hold_frames=10,
        time_limit_s=10.0,
        filter_s=0.2,
        gate_sigma=6.0,
    )
