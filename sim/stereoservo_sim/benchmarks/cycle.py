"""``bench cycle``: duration of the stereo control step (kernels and numpy) and of whole steps of the servo core.

``bench scale``: growth of a core step's cost with markers, cameras and joints: microseconds back to back (tight) and
with pauses (paced), between frames and with them, and the exponent of a fitted power law along each axis.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from stereoservo.control.law import Law, LawStep, Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.marker_groups import with_groups
from stereoservo.control.stereo_cycle import StereoCycle, stereo_step
from stereoservo.core.cycle import StepInputs, StepOutputs
from stereoservo.core.state import ServoGoal
from stereoservo.geometry.cameras import camera_centre, project_many
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import chain_forward, image_jacobian, project_points, transform_points
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import LawName
from stereoservo.numerics.arrays import FloatArray
from stereoservo.recording.step_layout import result_crc
from stereoservo_sim.benchmarks.core_loop import (
    FRAME_EVERY,
    RATE_HZ,
    CoreLoop,
    largest_cell,
    rx90_with_facets,
    timed_stages,
)
from stereoservo_sim.benchmarks.stereo_reference import stereo_law
from stereoservo_sim.benchmarks.timing import summary, timed
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell, rx90

GAIN, DAMPING = 1.0, 1e-6
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
        "core": {
            "joints": 6,
            "markers": 14,
            "cameras": 2,
            "rate_hz": RATE_HZ,
            "images_hz": RATE_HZ / FRAME_EVERY,
        },
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
    return {
        "axes": found,
        "law": LAW,
        "at": {"markers": OTHER_MARKERS, "cameras": OTHER_CAMERAS, "joints": 6},
    }


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
            found[f"{pace}, {label}"] = {
                "all": power(sizes, costs),
                "last": power(sizes[-2:], costs[-2:]),
            }
    return found


def power(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Exponent of the power law through the costs, by least squares of logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])
