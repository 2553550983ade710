"""A servo core in virtual time before a synthetic cell, and bodies of many markers, for benchmarks and for tests of
the growth of a step's cost.
"""

from __future__ import annotations

import dataclasses
import math
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from stereoservo.core import servo_core
from stereoservo.core.cycle import ModelUpdate, StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.core.state import CoreState, PlanJob, ServoGoal
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Enable, FeatureTarget, Goal, LawName, Request, RunGoal, UpdateGoal
from stereoservo.ports.devices import CameraObservation, JointState
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import (
    SEVEN_ROWS,
    SyntheticCell,
    dh_link,
    placed,
    rotation,
    rx90,
    translation,
)

RATE_HZ, FRAME_EVERY = 250.0, 10
"""Rate of the loop, and steps between images."""
PLANNING = 5000
"""Number of steps in which a goal must be accepted or refused."""


class CoreLoop:
    """A core in virtual time with perfect joints, and noise-free images that are one frame late.

    ``times``: kind (`kind_of_step`) and CPU time [s] of each step, independent of other load on the machine.
    """

    def __init__(self, cell: SyntheticCell, seed: int, model: CellModel | None = None) -> None:
        self.cell, self.seed = cell, seed
        self.model = exact_model(cell) if model is None else model
        self.core = ServoCore(_settings(cell))
        self.q, self.now_ns, self.seq, self.active = cell.home.copy(), 1_000_000_000, 0, False
        self.pending: tuple[CameraObservation, ...] = ()
        self.times: list[tuple[str, float]] = []
        self.kind = ""
        """Kind of the newest step."""
        self.shift_px = 0.0
        """Shift of the first camera's pixels, as if it had been pushed."""

    def step(self, **inputs: Any) -> StepOutputs:
        """Run and time one step; then the arm moves as commanded."""
        period_ns = round(1e9 / RATE_HZ)
        self.now_ns += period_ns
        self.seq += 1
        joints = JointState(self.seq, self.now_ns, self.q.copy(), np.zeros(len(self.q)))
        observations, self.pending = self.pending, ()
        given = {"requests": (), **inputs}
        cycle = StepInputs(self.now_ns, period_ns, joints, observations, driver_active=self.active, **given)
        self.kind = kind_of_step(cycle, self.core.state)
        self.before(self.kind, cycle)
        outputs = self.timed_step(cycle)
        if outputs.driver_request:
            self.active = outputs.driver_request == "activate"
        if self.seq % FRAME_EVERY == 0:
            self.pending = self._images()
        if outputs.command is not None:
            self.q = self.q + outputs.command / RATE_HZ
        return outputs

    def timed_step(self, inputs: StepInputs) -> StepOutputs:
        """A step with all its outputs, timed."""
        at = time.thread_time()
        outputs = self.core.step(inputs)
        self.times.append((self.kind, time.thread_time() - at))
        return outputs

    def before(self, kind: str, inputs: StepInputs) -> None:
        """Hook for tests, called before a step of this ``kind``; does nothing here."""

    def take_model(self) -> None:
        """Set the model, and enable."""
        self.step(model_update=ModelUpdate(self.model))
        self.step(requests=(Request(1, "bench", Enable()),))

    def target_at(self, share: float) -> FeatureTarget:
        """Set-points of the markers at home plus a ``share`` of the ranges."""
        seen = self.cell.pixels((self.cell.home + share * self.cell.ranges)[None])[:, 0]
        return FeatureTarget(
            {
                f"cam{c}": {i: (float(u), float(v)) for i, (u, v) in zip(self.cell.marker_ids, pixels, strict=True)}
                for c, pixels in enumerate(seen)
            }
        )

    def start_goal(self, law: LawName, number: int = 0, share: float = 0.3) -> None:
        """Start a goal at a ``share`` of the ranges, far enough that the arm moves for long; sets the model before the
        first.

        Later goals preempt the previous one.
        """
        if number == 0:
            self.take_model()
        goal = Goal(str(uuid.UUID(int=self.seed + 1 + number)), self.target_at(share), law=law, gain=0.2)
        outputs = self.step(requests=(Request(2 + number, "bench", RunGoal(goal)),))
        for _ in range(PLANNING):  # planning takes a slice per step; the reply follows
            replies = [event for event in outputs.events if event.kind == "reply"]
            if replies:
                break
            outputs = self.step()
        if not (replies and replies[0].accepted):
            raise RuntimeError(f"the core did not take the goal: {[event.message for event in replies]}")

    def move_goal(self, number: int) -> None:
        """Move the active goal's set-points a little, and run a step."""
        goal = self.core.state.source
        if not isinstance(goal, ServoGoal):
            raise RuntimeError("no goal is active")
        move = UpdateGoal(goal.goal.id, self.target_at(0.3 + 1e-4 * number))
        outputs = self.step(requests=(Request(1000 + number, "bench", move),))
        replies = [event for event in outputs.events if event.kind == "reply"]
        if not replies[0].accepted:
            raise RuntimeError(f"the core did not move the goal: {replies[0].message}")

    def _images(self) -> tuple[CameraObservation, ...]:
        ids = np.array(self.cell.marker_ids)
        covariances = np.tile(1e-4 * np.eye(2), (len(ids), 1, 1))
        received = self.now_ns + round(1e9 / RATE_HZ)
        seen = self.cell.pixels(self.q[None])[:, 0]
        seen[0] += self.shift_px
        return tuple(
            CameraObservation(f"cam{c}", self.seq, self.now_ns, received, ids, pixels, covariances)
            for c, pixels in enumerate(seen)
        )


CORE_STAGES = ("put_inputs", "observe", "move", "command", "finish_step", "status_of", "priors_of")


@contextmanager
def timed_stages(loop: CoreLoop) -> Iterator[dict[str, list[tuple[str, float]]]]:
    """Context manager: kind and CPU time [s] of every part of the steps of ``loop``, by part; the clock itself costs
    some 0.3 µs a part.
    """
    stages = {name: getattr(servo_core, name) for name in CORE_STAGES}
    found: dict[str, list[tuple[str, float]]] = {name: [] for name in CORE_STAGES}

    def timed(name: str) -> Callable[..., Any]:
        stage, times = stages[name], found[name]

        def run(*arguments: Any, **options: Any) -> Any:
            at = time.thread_time()
            result = stage(*arguments, **options)
            times.append((loop.kind, time.thread_time() - at))
            return result

        return run

    try:
        for name in stages:
            setattr(servo_core, name, timed(name))
        yield found
    finally:
        for name, stage in stages.items():
            setattr(servo_core, name, stage)


PARTS = ("read", "face", "start", "fit")
STAGES = ("way in images", "arm on way", "arm without limits", "straight in joints", "seeds")


def kind_of_step(inputs: StepInputs, state: CoreState) -> str:
    """Kind of a step, by its work: ``model`` (set), ``goal`` (examined), ``update`` (of its set-points); of an examined
    goal a part of ``PARTS``, ``way begun``, a stage of ``STAGES``, ``told`` (its plan, and its start); ``frames``
    (of all cameras), ``between`` them. While a law drives the arm they begin with ``moving``.
    """
    moving = "moving, " if isinstance(state.source, ServoGoal) else ""
    return moving + _work(inputs, state.planning)


def _work(inputs: StepInputs, job: PlanJob | None) -> str:
    if inputs.model_update is not None:
        return "model"
    if any(isinstance(request.command, RunGoal) for request in inputs.requests):
        return "goal"
    if any(isinstance(request.command, UpdateGoal) for request in inputs.requests):
        return "update"
    if job is None:
        return "frames" if inputs.observations else "between"
    if job.planning is not None:
        return "told" if job.planning.finished else STAGES[job.planning.stage]
    return "way begun" if job.resolution is None else PARTS[job.resolution.part]


def largest_cell() -> SyntheticCell:
    """A cell of 256 markers, 8 cameras and 12 joints, the largest allowed: the body of `rx90_with_facets`."""
    small = rx90_with_facets(256, 8)
    rows = [(0.7 * a, alpha, 0.7 * d) for a, alpha, d in SEVEN_ROWS[:-1]]
    wrist = [(0, 90, 0.08), (0, 90, 0.05), (0, -90, 0.05), (0.05, 90, 0), (0, -90, 0.05), (0, 0, 0.05)]
    home = np.radians((10, 30, 10, -70, 20, 50, 15, 20, 30, -25, 30, 10))
    ranges = np.radians((5, 5, 6, 6, 8, 8, 10, 10, 10, 10, 15, 20))
    facing = rotation("x", 180) @ rotation("y", 15) @ rotation("x", 10)
    links = tuple(dh_link(*row) for row in (*rows, *wrist))
    cell = placed(("revolute",) * 12, links, small.body, home, ranges, facing)
    return dataclasses.replace(cell, intrinsics=small.intrinsics, poses=small.poses, lenses=small.lenses)


def rx90_with_facets(markers: int, cameras: int) -> SyntheticCell:
    """The 6R cell with a body of small facets of four markers each on a dome, before the given number of cameras."""
    side = math.ceil(math.sqrt(markers / 4))
    offsets = (np.arange(side) - 0.5 * (side - 1)) * min(0.03, 0.24 / side)
    dots = np.array([(-9, -8), (8, -9), (9, 8), (-8, 9)]) / 1000 * min(1.0, 8 / side)
    facets = []
    for x in offsets:
        for y in offsets:
            tilt = (rotation("y", 200.0 * float(x)) @ rotation("x", -200.0 * float(y)))[:3, :3]
            here = np.hstack([dots, np.zeros((4, 1))]) @ tilt.T
            facets.append(here + np.array((x, y, 0.08 - 1.7 * (x * x + y * y))))
    cell = rx90(np.concatenate(facets)[:markers])
    poses = np.array([translation(0.0, 0.03 * (c // 2), 0.0) @ cell.poses[c % 2] for c in range(cameras)])
    return dataclasses.replace(
        cell,
        intrinsics=cell.intrinsics[np.arange(cameras) % 2],
        poses=poses,
        lenses=cell.lenses[np.arange(cameras) % 2],
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
