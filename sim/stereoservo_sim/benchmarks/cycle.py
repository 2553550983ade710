"""``bench cycle``: duration of the stereo control step (kernels and numpy) and of whole steps of the servo core."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from stereoservo.control.law import Law, LawStep, Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.stereo_cycle import StereoCycle, stereo_step
from stereoservo.core.cycle import ModelUpdate, StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.geometry.cameras import camera_centre, project_many
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import chain_forward, image_jacobian, project_points, transform_points
from stereoservo.messages.goals import Enable, FeatureTarget, Goal, LawName, Request, RunGoal
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation, JointState
from stereoservo_sim.benchmarks.stereo_reference import stereo_law
from stereoservo_sim.benchmarks.timing import summary, timed
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell, rx90

GAIN, DAMPING = 1.0, 1e-6
RATE_HZ, FRAME_EVERY = 250.0, 10
"""Of the loop, and steps between images."""
WARM_UP = 100
"""Steps of the core that do not count."""
PLANNING = 5000
"""Steps in which a goal must be answered."""


def stereo_problem() -> dict[str, Any]:
    """Six revolute joints, four markers, two cameras, in a Euclidean frame (any frame costs the same)."""
    rng = np.random.default_rng(0)
    generators = np.zeros((6, 4, 4))
    for G in generators:
        axis, foot = rng.standard_normal(3), rng.uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0))
        x, y, z = axis / np.linalg.norm(axis)
        G[:3, :3] = [(0, -z, y), (z, 0, -x), (-y, x, 0)]
        G[:3, 3] = -G[:3, :3] @ foot
    K = np.array([(800.0, 0, 320), (0, 800, 240), (0, 0, 1)])
    left = K @ np.eye(3, 4)
    right = left + np.column_stack([np.zeros((3, 3)), K @ (-0.2, 0.0, 0.0)])
    markers = np.array(
        [(-0.05, -0.05, 1.2, 1), (0.05, -0.05, 1.2, 1), (0.05, 0.05, 1.22, 1), (-0.05, 0.05, 1.2, 1)]
    )
    Ps = np.array([left, right])
    set_points = project_many(Ps, markers) + rng.uniform(-20, 20, (2, 4, 2))
    return {
        "generators": generators,
        "Ps": Ps,
        "markers": markers,
        "set_points": set_points,
        "q": rng.uniform(-0.1, 0.1, 6),
    }


def with_kernels(p: dict[str, Any]) -> FloatArray:
    """Joint velocities (6,) of the stereo law (8.36), by the kernels of the loop."""
    H, operators = chain_forward(p["generators"], np.zeros(6, np.uint8), np.zeros(6), p["q"])
    points = transform_points(H, p["markers"])
    pixels, _ = project_points(p["Ps"], points)
    jacobian = image_jacobian(operators, p["Ps"], points)
    velocity: FloatArray = stereo_step(jacobian, pixels, p["set_points"], np.ones((2, 4)), GAIN, DAMPING)[0]
    return velocity


def in_one_call(p: dict[str, Any]) -> Callable[[int], object]:
    """Joint velocities (6,) in one kernel call from joints and pixels."""
    cycle = StereoCycle(p["generators"], np.zeros(6, np.uint8), np.zeros(6), p["Ps"], p["markers"])
    H, _ = chain_forward(p["generators"], np.zeros(6, np.uint8), np.zeros(6), p["q"])
    pixels, _ = project_points(p["Ps"], transform_points(H, p["markers"]))
    q, set_points, weights = p["q"], p["set_points"], np.ones((2, 4))
    return lambda _: cycle.step(q, pixels, set_points, weights, GAIN, DAMPING)


def law_calls(p: dict[str, Any]) -> dict[str, Callable[[int], object]]:
    """One step of every law on the same problem, called as the loop does."""
    H, operators = chain_forward(p["generators"], np.zeros(6, np.uint8), np.zeros(6), p["q"])
    points = transform_points(H, p["markers"])
    pixels, _ = project_points(p["Ps"], points)
    centres = np.array([camera_centre(P) / camera_centre(P)[3] for P in p["Ps"]])
    ones = np.ones((2, 4))
    scene = Scene(operators, int(Composition.BASE_FIRST), p["Ps"], centres, points, pixels, ones)
    turned = transform_points(chain_forward(p["generators"], np.zeros(6, np.uint8), np.zeros(6), p["q"] + 0.1)[0],
                              p["markers"])  # fmt: skip
    task = Task(
        project_points(p["Ps"], turned)[0], ones, np.zeros((2, 4, 2)), turned, np.ones(4), points.mean(axis=0),
        turned.mean(axis=0), np.arange(3),
    )  # fmt: skip
    options = Options(GAIN, 1.0 / RATE_HZ)
    return {name: partial(_law_step, law, scene, task, options) for name, law in LAWS.items()}


def _law_step(law: Law, scene: Scene, task: Task, options: Options, _: int) -> LawStep:
    return law.step(scene, task, options)


def with_reference(p: dict[str, Any]) -> FloatArray:
    """Joint velocities (6,) of the same step by the numpy reference."""
    chain = ProjectiveChain(("revolute",) * 6, p["generators"], np.zeros(6))
    points = p["markers"] @ chain.displacement(p["q"]).T
    jacobian = chain.image_jacobian(p["Ps"], p["q"], points)
    return stereo_law(
        jacobian, project_many(p["Ps"], points), p["set_points"], np.ones((2, 4)), GAIN, DAMPING
    ).velocity


def run_cycle(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Microseconds of a control step and of a core step under each Cartesian and image law."""
    problem = stereo_problem()
    count = max(200, 100 * repetitions)
    fused = timed(in_one_call(problem), count, warm_up=20)[0]
    kernels = timed(lambda _: with_kernels(problem), count, warm_up=20)[0]
    reference = timed(lambda _: with_reference(problem), count, warm_up=5)[0]
    progress("control step", 1, 3)
    laws: tuple[LawName, ...] = ("stereo", "cartesian3")
    core = {}
    for k, law in enumerate(laws):
        core[law] = summary(core_steps(law, count, seed), 1e6)
        progress("control step", 2 + k, 3)
    return {
        "stereo_step_us": {
            "one_call": summary(fused, 1e6),
            "kernels": summary(kernels, 1e6),
            "numpy_reference": summary(reference, 1e6),
        },
        "reference_over_kernels": float(np.median(reference) / np.median(kernels)),
        "kernels_over_one_call": float(np.median(kernels) / np.median(fused)),
        "law_step_us": {
            name: summary(timed(call, count, warm_up=20)[0], 1e6) for name, call in law_calls(problem).items()
        },
        "core_step_us": core,
        "core": {
            "joints": 6,
            "markers": 14,
            "cameras": 2,
            "rate_hz": RATE_HZ,
            "images_hz": RATE_HZ / FRAME_EVERY,
        },
    }


def core_steps(law: LawName, count: int, seed: int) -> list[float]:
    """Durations [s] of ``count`` steps of a core that drives the simulated arm to a goal by ``law``."""
    loop = _Loop(rx90(), seed)
    loop.step(model_update=ModelUpdate(exact_model(loop.cell)))
    loop.step(requests=(Request(1, "bench", Enable()),))
    # Far enough that the arm is under way all the time.
    goal = loop.cell.home + 0.3 * loop.cell.ranges
    target = FeatureTarget(
        {
            name: {i: (float(u), float(v)) for i, (u, v) in zip(loop.cell.marker_ids, seen, strict=True)}
            for name, seen in zip(("cam0", "cam1"), loop.cell.pixels(goal[None])[:, 0], strict=True)
        }
    )
    run = RunGoal(Goal(str(uuid.UUID(int=seed + 1)), target, law=law, gain=0.2))
    outputs = loop.step(requests=(Request(2, "bench", run),))
    for _ in range(PLANNING):  # it is planned, a slice a step, before it is answered
        replies = [event for event in outputs.events if event.kind == "reply"]
        if replies:
            break
        outputs = loop.step()
    if not (replies and replies[0].accepted):
        raise RuntimeError(f"the core did not take the bench's goal: {[event.message for event in replies]}")
    for _ in range(WARM_UP):
        loop.step()
    loop.times.clear()
    for _ in range(count):
        loop.step()
    return loop.times


class _Loop:
    """A core in virtual time with perfect joints, and noise-free images that are one frame late."""

    def __init__(self, cell: SyntheticCell, seed: int) -> None:
        self.cell, self.seed = cell, seed
        self.core = ServoCore(_settings(cell))
        self.q, self.now_ns, self.seq, self.active = cell.home.copy(), 1_000_000_000, 0, False
        self.pending: tuple[CameraObservation, ...] = ()
        self.times: list[float] = []

    def step(self, **inputs: Any) -> StepOutputs:
        """Run and time one step; then the arm moves as commanded."""
        period_ns = round(1e9 / RATE_HZ)
        self.now_ns += period_ns
        self.seq += 1
        joints = JointState(self.seq, self.now_ns, self.q.copy(), np.zeros(len(self.q)))
        observations, self.pending = self.pending, ()
        given = {"requests": (), **inputs}
        cycle = StepInputs(self.now_ns, period_ns, joints, observations, driver_active=self.active, **given)
        at = time.perf_counter()
        outputs = self.core.step(cycle)
        self.times.append(time.perf_counter() - at)
        if outputs.driver_request:
            self.active = outputs.driver_request == "activate"
        if self.seq % FRAME_EVERY == 0:
            self.pending = self._images()
        if outputs.command is not None:
            self.q = self.q + outputs.command / RATE_HZ
        return outputs

    def _images(self) -> tuple[CameraObservation, ...]:
        ids = np.array(self.cell.marker_ids)
        covariances = np.tile(1e-4 * np.eye(2), (len(ids), 1, 1))
        received = self.now_ns + round(1e9 / RATE_HZ)
        return tuple(
            CameraObservation(f"cam{c}", self.seq, self.now_ns, received, ids, pixels, covariances)
            for c, pixels in enumerate(self.cell.pixels(self.q[None])[:, 0])
        )


def _settings(cell: SyntheticCell) -> CoreSettings:
    n = len(cell.kinds)
    return CoreSettings(
        cell="bench",
        joint_names=cell.joint_names,
        joint_kinds=cell.kinds,
        cameras=tuple(
            CameraSettings(f"cam{c}", cell.width, cell.height, RATE_HZ / FRAME_EVERY, cell.mount, cell.marker_ids)
            for c in range(len(cell.poses))
        ),
        limits=LimitSettings(
            np.full(n, -6.0), np.full(n, 6.0), np.full(n, 1.0), np.full(n, 4.0), 0.01, np.zeros((0, n, 2)), (), 0.5,
            0.1, 1.0,
        ),
        trials=None,
        home=cell.home,
        rate_hz=RATE_HZ,
        law="cartesian3",
        points="predicted",
        gain=1.0,
        tolerance_px=1e-3,
        hold_frames=5,
        time_limit_s=1e6,
        filter_s=0.2,
        gate_sigma=6.0,
    )  # fmt: skip
