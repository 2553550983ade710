"""``bench cycle``: duration of the stereo control step (kernels and numpy) and of whole steps of the servo core.

``bench scale``: growth of a core step's cost with markers, cameras and joints: microseconds back to back (tight) and
with pauses (paced), between frames and with them, and the exponent of a fitted power law along each axis.
"""

from __future__ import annotations

import dataclasses
import math
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stereoservo.control.law import Law, LawStep, Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.marker_groups import with_groups
from stereoservo.control.stereo_cycle import StereoCycle, stereo_step
from stereoservo.core import servo_core
from stereoservo.core.cycle import ModelUpdate, StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.core.state import CoreState, PlanJob, ServoGoal
from stereoservo.geometry.cameras import camera_centre, project_many
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import chain_forward, image_jacobian, project_points, transform_points
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Enable, FeatureTarget, Goal, LawName, Request, RunGoal, UpdateGoal
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.linear import PIVOT_TOLERANCE
from stereoservo.ports.devices import CameraObservation, JointState
from stereoservo.recording.step_layout import result_crc
from stereoservo_sim.benchmarks.timing import summary, timed
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SEVEN_ROWS, SyntheticCell, dh_link, placed, rotation, rx90, translation

# -- core loop -------------------------------------------------------------------------------------------------


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


# -- step and growth ------------------------------------------------------------------------------------------


GAIN, DAMPING = 1.0, 1e-6
"""Gain [1/s] and damping, relative to the largest diagonal of the normal matrix."""
WARM_UP = 100
"""Steps of the core that are not timed."""
LARGE_BODIES = ((8, 2, 6), (64, 2, 6), (256, 2, 6), (256, 8, 6), (256, 8, 12))
"""Markers, cameras, joints."""


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
    markers = np.array([(-0.05, -0.05, 1.2, 1), (0.05, -0.05, 1.2, 1), (0.05, 0.05, 1.22, 1), (-0.05, 0.05, 1.2, 1)])
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
    turned = transform_points(
        chain_forward(p["generators"], np.zeros(6, np.uint8), np.zeros(6), p["q"] + 0.1)[0], p["markers"]
    )
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
    return stereo_law(jacobian, project_many(p["Ps"], points), p["set_points"], np.ones((2, 4)), GAIN, DAMPING).velocity


def run_cycle(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Microseconds of a control step, and of steps of the core under each law."""
    problem = stereo_problem()
    count = max(200, 100 * repetitions)
    fused = timed(in_one_call(problem), count, warm_up=20)[0]
    kernels = timed(lambda _: with_kernels(problem), count, warm_up=20)[0]
    reference = timed(lambda _: with_reference(problem), count, warm_up=5)[0]
    progress("control step", 1, 1)
    core: dict[str, dict[str, Any]] = {}
    for law in LAWS:
        core[law] = core_steps(law, count // 2, seed)
        progress("core step", len(core), len(LAWS))
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
        "large_bodies": large_bodies(count, seed, progress),
        "core": {"joints": 6, "markers": 14, "cameras": 2, "rate_hz": RATE_HZ, "images_hz": RATE_HZ / FRAME_EVERY},
    }


PACED_S = 0.003
"""Sleep between two steps, as in operation: caches are cold then."""
KINDS = {"moving, between": "between frames", "moving, frames": "with frames"}


class ServoLoop(CoreLoop):
    """A loop that times the work of the servo process in every cycle: the step, its command, and its recorded data;
    status and priors are made when they are due.
    """

    def timed_step(self, inputs: StepInputs) -> StepOutputs:
        at = time.thread_time()
        self.core.advance(inputs)
        newest = self.core.newest
        newest.command, newest.moves, result_crc(newest)
        self.times.append((self.kind, time.thread_time() - at))
        return self.core.outputs()


def core_steps(law: LawName, count: int, seed: int) -> dict[str, Any]:
    """Microseconds of ``count`` steps between frames, and of those with frames of all cameras, of a core that drives
    the simulated arm to a goal by ``law``: back to back (``tight``), with a sleep before each (``paced``), and
    by stage (``stages``, medians, tight).
    """
    loop = ServoLoop(rx90(), seed)
    drive(loop, law, WARM_UP)
    found: dict[str, Any] = {}
    for name, pause_s in (("tight", 0.0), ("paced", PACED_S)):
        loop.times.clear()
        drive(loop, law, count, pause_s)
        found[name] = {label: summary(of_kind(loop.times, kind), 1e6) for kind, label in KINDS.items()}
    with timed_stages(loop) as stages:
        drive(loop, law, count)
    found["stages"] = {
        label: {stage: summary(of_kind(times, kind), 1e6)["median"] for stage, times in stages.items()}
        for kind, label in KINDS.items()
    }
    return found


def drive(loop: CoreLoop, law: LawName, count: int, pause_s: float = 0.0) -> None:
    """Run ``count`` steps between frames, and those with frames, while ``law`` drives the arm, back and forth when it
    reaches its goal; with a pause before each.
    """
    between = 0
    while between < count:
        if not isinstance(loop.core.state.source, ServoGoal):
            loop.start_goal(law, loop.seq, 0.3 if loop.seq == 0 or loop.q[0] <= loop.cell.home[0] else 0.0)
        if pause_s:
            time.sleep(pause_s)
        loop.step()
        between += loop.kind == "moving, between"


def of_kind(times: list[tuple[str, float]], kind: str) -> list[float]:
    """The durations of steps of a kind."""
    return [seconds for of, seconds in times if of == kind]


def _find_groups(model: CellModel, _: int) -> CellModel:
    return with_groups(model)


GOALS, UPDATES, UPDATED_STEPS = 20, 20, 7


def large_bodies(count: int, seed: int, progress: ProgressCall) -> list[dict[str, Any]]:
    """Microseconds of each kind of core step, by the number of markers, cameras and joints; with goals that preempt one
    another while the arm moves, and moved goals; and of finding the markers' planes.
    """
    rows = []
    for markers, cameras, joints in LARGE_BODIES:
        cell = rx90_with_facets(markers, cameras) if joints == 6 else largest_cell()
        bare = exact_model(cell)
        finding = timed(partial(_find_groups, bare), 2)[0]
        model = with_groups(bare)
        for _ in range(2):  # the first one compiles
            loop = CoreLoop(cell, seed, model)
            for number in range(GOALS):
                loop.start_goal("cartesian3", number)
                for _ in range(UPDATED_STEPS):
                    loop.step()
            for number in range(UPDATES):
                loop.move_goal(number)
            for _ in range(count):
                loop.step()
        by_kind: dict[str, list[float]] = {}
        for kind, seconds in loop.times:
            by_kind.setdefault(kind, []).append(seconds)
        rows.append(
            {
                "markers": markers,
                "cameras": cameras,
                "joints": joints,
                "groups_of_model_ms": 1e3 * min(finding),
                "step_us": {kind: summary(times, 1e6) for kind, times in by_kind.items()},
            }
        )
        progress("large bodies", len(rows), len(LARGE_BODIES))
    return rows


# -- growth of a step's cost ----------------------------------------------------------------------------------

LAW: LawName = "stereo"
MARKERS, CAMERAS, JOINTS = (4, 16, 64, 256), (1, 2, 4, 8), (1, 2, 4, 8, 12)
OTHER_MARKERS, OTHER_CAMERAS = 16, 2
"""Fixed sizes while another axis grows; six joints then."""


def run_scale(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Step costs along each axis, with the fitted exponents."""
    axes: dict[str, tuple[Sequence[int], Callable[[int], SyntheticCell]]] = {
        "markers": (MARKERS, with_markers),
        "cameras": (CAMERAS, lambda n: rx90_with_facets(OTHER_MARKERS, n)),
        "joints": (JOINTS, with_joints),
    }
    total, done = sum(len(sizes) for sizes, _ in axes.values()), 0
    found: dict[str, Any] = {}
    for axis, (sizes, cell_of) in axes.items():
        rows = []
        for size in sizes:
            rows.append({axis: size, **step_costs(cell_of(size), 40 * repetitions, seed)})
            done += 1
            progress("cells", done, total)
        found[axis] = {"steps": rows, "exponents": exponents(axis, rows)}
    return {"axes": found, "law": LAW, "at": {"markers": OTHER_MARKERS, "cameras": OTHER_CAMERAS, "joints": 6}}


def with_markers(count: int) -> SyntheticCell:
    """The body of `rx90_with_facets` before two cameras; a single facet is as large as a body of several."""
    cell = rx90_with_facets(count, OTHER_CAMERAS)
    return cell if count > 4 else dataclasses.replace(cell, body=cell.body * (5.0, 5.0, 1.0))


def with_joints(count: int) -> SyntheticCell:
    """The last links of the largest cell's arm, as many as requested, with the body of `rx90_with_facets` before two
    cameras.
    """
    small, large = rx90_with_facets(OTHER_MARKERS, OTHER_CAMERAS), largest_cell()
    return dataclasses.replace(
        large,
        base=large.frames(large.home)[len(large.kinds) - count],
        kinds=large.kinds[-count:],
        links=large.links[-count:],
        home=large.home[-count:],
        ranges=large.ranges[-count:],
        body=small.body,
        intrinsics=small.intrinsics,
        poses=small.poses,
        lenses=small.lenses,
    )


def step_costs(cell: SyntheticCell, count: int, seed: int) -> dict[str, Any]:
    """Microseconds of CPU of ``count`` steps between frames and of those with frames, tight and paced, while the law
    drives the arm.
    """
    loop = CoreLoop(cell, seed, with_groups(exact_model(cell)))
    drive(loop, LAW, 50)
    found: dict[str, Any] = {}
    for name, pause_s in (("tight", 0.0), ("paced", PACED_S)):
        loop.times.clear()
        drive(loop, LAW, count, pause_s)
        found[name] = {label: summary(of_kind(loop.times, kind), 1e6) for kind, label in KINDS.items()}
    return found


def exponents(axis: str, rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Exponents of power laws: ``all`` is fitted to all sizes, ``last`` to the two largest, where constant costs matter
    least.
    """
    sizes = [row[axis] for row in rows]
    found: dict[str, dict[str, float]] = {}
    for pace in ("tight", "paced"):
        for label in KINDS.values():
            costs = [row[pace][label]["median"] for row in rows]
            found[f"{pace}, {label}"] = {"all": power(sizes, costs), "last": power(sizes[-2:], costs[-2:])}
    return found


def power(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Exponent of the power law through the costs, by least squares of logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


# -- stereo reference ------------------------------------------------------------------------------------------


class StereoStep(NamedTuple):
    """Result of a step: joint velocity (n,) [rad/s or m/s], largest pixel error over seen markers [px],
    conditioning (0: singular).
    """

    velocity: FloatArray
    error_px: float
    conditioning: float


def stereo_law(
    jacobian: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    weights: FloatArray,
    gain: float,
    damping: float = DAMPING,
) -> StereoStep:
    """``q̇ = −gain·J⁺(s − s*)`` over all cameras stacked (8.36).

    ``jacobian`` (c, m, 2, n) [px/rad or px/m], ``pixels`` and ``set_points`` (c, m, 2) [px], ``weights`` (c,
    m) = 1/sigma [1/px], 0 for a missing marker (its rows are then not read and may be NaN).
    ``gain`` [1/s].
    """
    n = jacobian.shape[-1]
    error = np.where(weights[..., None] != 0.0, pixels - set_points, 0.0)
    step, conditioning = damped_least_squares_reference(
        jacobian.reshape(-1, n), error.reshape(-1), np.repeat(weights.reshape(-1), 2), damping
    )
    worst = float(np.sqrt((error**2).sum(axis=-1)).max(initial=0.0))
    return StereoStep(-gain * step, worst, conditioning)


def damped_least_squares_reference(
    J: FloatArray, e: FloatArray, weights: FloatArray, damping: float
) -> tuple[FloatArray, float]:
    """``x`` (n,) of least ``Σ w²(Jx − e)² + damping·d·|x|²``, ``d`` the largest diagonal of ``JᵀW²J``.

    ``J`` (r, n), ``e`` (r,), ``weights`` (r,) = 1/sigma, 0 where missing. ``damping`` >= 0, relative. Returns
    ``x`` and the conditioning: smallest Cholesky pivot of the damped normal matrix over its largest diagonal;
    0, with ``x = 0``, where that is singular.
    """
    n = J.shape[1]
    seen = weights != 0.0
    JW = J[seen] * weights[seen, None]
    N = JW.T @ JW
    N += damping * np.diag(N).max(initial=0.0) * np.eye(n)
    largest = float(np.diag(N).max(initial=0.0))
    if not (largest > 0.0 and np.isfinite(N).all()):
        return np.zeros(n), 0.0
    try:
        factor = np.linalg.cholesky(N)
    except np.linalg.LinAlgError:  # not positive definite: the answer of a singular system, as documented
        return np.zeros(n), 0.0
    conditioning = float((np.diag(factor) ** 2).min() / largest)
    if conditioning <= PIVOT_TOLERANCE:
        return np.zeros(n), 0.0
    x: FloatArray = np.linalg.solve(N, JW.T @ (e[seen] * weights[seen]))
    return x, conditioning
