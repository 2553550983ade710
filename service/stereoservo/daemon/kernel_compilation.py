"""Compiles all numba kernels of a servo process (core, laws, planner, monitors) into the cache on disk, in parallel
processes, by running an example cell.

An example arm with two cameras runs some steps of each law; kernels are compiled by types, not by sizes. The
cameras' lenses bend, so that the lens's kernels run too.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.control.law_registry import LAWS
from stereoservo.control.law_warmup import warm_up_incidences, warm_up_laws
from stereoservo.control.laws.cartesian3 import cartesian_step
from stereoservo.control.marker_groups import FLAT_PX, find_groups
from stereoservo.control.mobility_kernel import self_motion_from_limits
from stereoservo.core.cycle import ModelUpdate, StepInputs
from stereoservo.core.monitors.moving_camera import rehearse as rehearse_mobile
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.daemon.process_control import die_with_parent
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.kernels import distort_pixel
from stereoservo.kinematics.model import MODEL_SCHEMA, CameraModel, CellModel
from stereoservo.messages.goals import (
    DEFAULT_LAW,
    Command,
    FeatureTarget,
    Goal,
    PointSource,
    PointTarget,
    Request,
    RunGoal,
    UpdateGoal,
)
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.planner_warmup import warm_up_planner
from stereoservo.ports.devices import CameraObservation, JointState

WIDTH, HEIGHT, FOCAL = 640, 480, 600.0
JOINTS = tuple(f"j{k}" for k in range(1, 7))
CAMERAS = ("left", "right")
MARKERS = tuple(range(6))
STEPS = 40  # a short plan is executed in a third of them
PERIOD_NS = 4_000_000
LENS = np.array([-0.02, 0.5 * WIDTH, 0.5 * HEIGHT, 0.5 * WIDTH])


def warm_up() -> None:
    """Run each law, the planner and fault isolation on the example cell, which compiles their kernels."""
    warm_up_incidences()
    warm_up_laws()
    warm_up_planner()
    rehearse_mobile()
    model = example_model()
    pixels = np.stack(
        [distort(LENS, _project(camera.matrix, model.marker_points)) for camera in model.cameras]
    )
    seven = np.ones(7)  # a redundant arm's self-motion
    distort_pixel(LENS, 1.0, 1.0)  # for set-points that are said anew in a moved camera
    self_motion_from_limits(np.ones((8, 7)), 0.5 * seven, -seven, seven, 1.0)
    runs: list[tuple[str, PointSource]] = [(DEFAULT_LAW, "triangulated")]
    runs.extend((law, "predicted") for law in LAWS)
    for law, points in runs:
        core = ServoCore(example_settings())
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
            command: Command | None = None
            if step == 5:
                command = RunGoal(Goal(goal_id, target, law=law, points=points))
            elif step == STEPS - 5:
                command = UpdateGoal(goal_id, target)
            elif step == STEPS - 3:
                points_now = zip(MARKERS, model.marker_points.tolist(), strict=True)
                body = PointTarget({marker: tuple(point) for marker, point in points_now}, model.epoch)
                command = RunGoal(Goal(f"{goal_id}-0001", body, check=True))
            requests = () if command is None else (Request(1, "warmup", command),)
            inputs = _inputs(step, pixels, model)
            core.step(msgspec.structs.replace(inputs, requests=requests, driver_active=True))
    _warm_up_fault_isolation(model, pixels)
    matrices = np.array([camera.matrix for camera in model.cameras])
    find_groups(model.marker_points, matrices, FLAT_PX, model.generators, exhaustive=0)


def _warm_up_fault_isolation(model: CellModel, pixels: FloatArray) -> None:
    """Run the core on frames of a camera that was moved: fault isolation runs at no other time."""
    settings = example_settings()
    static_cameras = tuple(msgspec.structs.replace(camera, mobile=False) for camera in settings.cameras)
    core = ServoCore(msgspec.structs.replace(settings, cameras=static_cameras))
    moved = pixels + np.array([30.0, 0.0]) * np.array([1.0, 0.0])[:, None, None]
    for step in range(1, 12):
        core.step(_inputs(step, moved if step > 6 else pixels, model))
    if core.state.reanchoring is None:
        raise AssertionError("the example cell's camera was moved, and the core did not detect it")


def _inputs(step: int, pixels: FloatArray, model: CellModel) -> StepInputs:
    """Inputs of a step: the arm at rest, a frame (c, m, 2) of every camera, the model in the second step."""
    now_ns = 1_000_000_000 + step * PERIOD_NS
    frames = tuple(_observation(name, seen, step, now_ns) for name, seen in zip(CAMERAS, pixels, strict=True))
    return StepInputs(
        now_ns=now_ns,
        period_ns=PERIOD_NS,
        joints=JointState(step, now_ns, np.zeros(6), np.zeros(6)),
        observations=frames,
        model_update=ModelUpdate(model) if step == 2 else None,
    )


def _observation(camera: str, pixels: FloatArray, step: int, now_ns: int) -> CameraObservation:
    covariances = np.tile(0.01 * np.eye(2), (len(MARKERS), 1, 1))
    shutter_ns = now_ns - PERIOD_NS // 2
    return CameraObservation(camera, step, shutter_ns, now_ns, np.array(MARKERS), pixels.copy(), covariances)


def _project(matrix: FloatArray, points: FloatArray) -> FloatArray:
    m = points @ matrix.T
    pixels: FloatArray = m[:, :2] / m[:, 2:]
    return pixels


def example_model() -> CellModel:
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


def example_settings() -> CoreSettings:
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
        law=DEFAULT_LAW,
        points="predicted",
        gain=1.0,
        tolerance_px=0.1,
        hold_frames=10,
        time_limit_s=10.0,
        filter_s=0.2,
        gate_sigma=6.0,
    )


WARM_UPS: Mapping[str, Callable[[], None]] = {
    "laws": warm_up_laws,
    "planning": warm_up_planner,
    "incidences": warm_up_incidences,
}
"""The longest first."""


def compile_in_parallel() -> None:
    """Compile the kernels of ``WARM_UPS`` in parallel processes, unless those of the largest are already compiled."""
    if _compiled() or len(os.sched_getaffinity(0)) < 2:
        return
    command = [sys.executable, "-m", "stereoservo.daemon.kernel_compilation", str(os.getpid())]
    children = [subprocess.Popen([*command, name]) for name in WARM_UPS]
    for child in children:
        child.wait()


def _compiled() -> bool:
    name = cartesian_step.__name__
    cache = Path(cartesian_step.stats.cache_path)  # type: ignore[attr-defined]
    return any(cache.glob(f"*.{name}-*.nbc"))


def main() -> int:
    """Entry of a process; its arguments are the parent's id and a key of ``WARM_UPS``."""
    die_with_parent(int(sys.argv[1]), signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    WARM_UPS[sys.argv[2]]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
