"""Experiment ``laws``: every law on three demanding tasks, and a sketch of every kind of goal.

Figures of `docs/goals-and-laws.md`, small enough for the repository. Laws run as in ``stereoservo simulate``: the
free arm, self-calibrated; the controller sees noisy pixels, the table and the figures show the truth. Sketches are
short motions of the free arm with its exact model, without noise.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image
from rich.console import Console

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
from stereoservo.planning.motion_frame import progress
from stereoservo.planning.path_search import SHAPES
from stereoservo_sim.experiments.experiment import whole_table
from stereoservo_sim.experiments.figures import picture
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.tasks.arms import FreeArm
from stereoservo_sim.tasks.calibrations import Knowledge, TaskCalibration, calibrate, known_at_start
from stereoservo_sim.tasks.closed_loop import LoopSettings, TaskResult, Trace, run_task
from stereoservo_sim.tasks.ground_truth import MATRICES, sight
from stereoservo_sim.tasks.hard_tasks import shipped_tasks_path
from stereoservo_sim.tasks.options import DEFAULT_RATE_HZ
from stereoservo_sim.tasks.setting import FACE, HEIGHT, WIDTH
from stereoservo_sim.tasks.task_file import AlignmentTask, read_tasks
from stereoservo_sim.world.synthetic import rotation, translation

NOISE_PX = 0.1
LARGE_ID, BENT_ID = 5032, 5116
"""Two of the shipped hard tasks: one whose rotation swings corners out of the image, one whose straight path leaves
it.
"""
ROLL_ID = 1
CURRENT = "stereo, current"
VARIANTS = ("stereo", CURRENT, *(law for law in LAWS if law != "stereo"))
"""The laws by name, and the classical one, linearised at the current points; else at the mean (8.1.1)."""
THESIS = {
    "roll": "8.7: of three classical laws one diverges, two show the plate's back before they converge; "
    "both Cartesian ones converge with the face in view"
}


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """A law on a task: its evaluation, and its path."""

    name: str
    task: AlignmentTask
    result: TaskResult
    trace: Trace


@dataclass(frozen=True, eq=False)
class LawComparison:
    """All runs, by task name and law."""

    seed: int
    runs: dict[str, dict[str, ComparedRun]]


def compared_tasks() -> dict[str, AlignmentTask]:
    """``large`` 132° and 0.32 m, ``roll`` thesis 8.7, ``bent`` 117° and 0.39 m near the images' borders."""
    shipped = {task.id: task for task in read_tasks(shipped_tasks_path())}
    return {"large": shipped[LARGE_ID], "roll": tilted_roll(), "bent": shipped[BENT_ID]}


def tilted_roll() -> AlignmentTask:
    """Half a turn about the rig's line of sight, the face tilted by 60° (thesis 8.7)."""
    goal = translation(0.0, 0.0, 1.0) @ rotation("y", 60)
    start = translation(0.0, 0.0, 1.0) @ rotation("z", 180) @ rotation("y", 60)
    return AlignmentTask(ROLL_ID, 0, 180.0, 0.0, np.array([1.0, 0.0, 0.0]), start, goal)


def run_laws(
    seed: int,
    progress: ProgressCall,
    laws: tuple[str, ...] = VARIANTS,
    calibration: TaskCalibration | None = None,
) -> LawComparison:
    """Run each of ``laws`` on every task; the arm is calibrated first if no ``calibration`` is given."""
    tasks = compared_tasks()
    total = len(tasks) * len(laws)
    progress("laws", 0, total)
    known = calibration or calibrate("free", "self", NOISE_PX, seed)
    runs: dict[str, dict[str, ComparedRun]] = {name: {} for name in tasks}
    for name, task in tasks.items():
        for law in laws:
            settings = LoopSettings(
                law=law.partition(",")[0],
                jacobian="current" if law == CURRENT else "mean",
                noise_px=NOISE_PX,
                seed=seed,
            )
            result, trace = run_task(task, known, settings)
            runs[name][law] = ComparedRun(name, task, result, trace)
            progress("laws", sum(len(of_task) for of_task in runs.values()), total)
    return LawComparison(seed, runs)


def report_laws(comparison: LawComparison) -> dict[str, Any]:
    """JSON report: a row per task and law."""
    rows = [_row(law, run) for runs in comparison.runs.values() for law, run in runs.items()]
    return {
        "experiment": "laws",
        "rows": rows,
        "thesis": THESIS,
        "seed": comparison.seed,
        "noise_px": NOISE_PX,
        "calibration": "self",
    }


def _row(law: str, run: ComparedRun) -> dict[str, Any]:
    result, task = run.result, run.task
    facing = float(np.degrees(np.arccos(np.clip(run.trace.facing.min(), -1.0, 1.0))))
    return {
        "task": run.name, "angle_deg": round(task.angle_deg, 1), "distance_m": round(task.distance_m, 3),
        "law": law, "success": bool(result.success), "reason": result.reason, "refused": result.refused,
        "iterations": result.iterations, "final_error_px": result.final_error_px,
        "line_deviation_mm": result.line_deviation_mm, "worst_view_angle_deg": facing,
        "closest_view_px": result.closest_view_px,
    }  # fmt: skip


def show_laws(answer: dict[str, Any], console: Console) -> None:
    """Print the rows; a view angle of 90° and more shows the back, a negative margin is outside the image."""
    numbers = {
        "error [px]": ("final_error_px", ".3f"),
        "off the line [mm]": ("line_deviation_mm", ".2f"),
        "view angle [°]": ("worst_view_angle_deg", ".0f"),
        "room [px]": ("closest_view_px", ".0f"),
    }
    lines = [
        [
            f"{row['task']}, {row['angle_deg']:.0f}°, {row['distance_m']:.2f} m",
            row["law"],
            "the goal" if row["success"] else row["reason"],
            str(row["iterations"]),
            *("-" if row[key] is None else format(row[key], form) for key, form in numbers.values()),
        ]
        for row in answer["rows"]
    ]
    columns = dict.fromkeys(("task", "law", "comes to"), "left") | dict.fromkeys(("steps", *numbers), "right")
    whole_table(console, "laws on demanding tasks, self-calibrated, 25 Hz", columns, lines)
    console.print(f"thesis: {answer['thesis']['roll']}")


# -- sketches of goals -----------------------------------------------------------------------------------------

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
"""Radius of a streamed target's circle, and time of one revolution."""


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
    """The arm at a start pose, with its controller's model."""

    def __init__(self, calibration: TaskCalibration, start: FloatArray) -> None:
        self._calibration = calibration
        self.start = start
        self.knowledge: Knowledge = self._known(start)
        assert self.knowledge.points is not None  # an exact model has the body's points
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
            knowledge.basis,
            int(knowledge.composition),
            knowledge.matrices,
            knowledge.camera_centres,
            points,
            pixels,
            np.ones(pixels.shape[:2]),
        )

    def _known(self, pose: FloatArray) -> Knowledge:
        task = AlignmentTask(0, 0, 0.0, 0.0, np.array([1.0, 0.0, 0.0]), pose, pose)
        return known_at_start(self._calibration, task, None)


def shown(calibration: TaskCalibration, law: str = "stereo") -> Drive:
    """``features`` (law stereo), ``points`` (law cartesian3): to the goal of the sketches."""
    world = World(calibration, start_pose())
    return world.servo(law, world.points_at(goal_pose()))


def displaced_twice(calibration: TaskCalibration) -> tuple[Drive, Drive]:
    """Goal ``displacement``: the same matrix twice, each from the body's current pose."""
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
    """Points (5, 4) fixed to a body at ``pose``, in the model's frame, of scale 1, which determine its displacement."""
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
    """Motions onto ``line`` (2, 2, 2), pixels of two of its points, with the remaining degrees of freedom unused, and
    used.
    """

    line: FloatArray
    alone: Drive
    with_second: Drive
    set_points: FloatArray


def point_on_line(calibration: TaskCalibration) -> OnLine:
    """Goal ``incidence``: marker 0 onto a line; the remaining degrees of freedom unused, or used for set-points."""
    world = World(calibration, start_pose())
    line_pixels, line_points = world.seen_points(np.array([(-0.2, -0.15, 1.05, 1.0), (0.3, -0.05, 1.0, 1.0)]))
    on_line = incidence_task(("point-on-line",), ((0,),), (line_points,), world.knowledge.plane_at_infinity, 0.01)
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
    """A target on a circle, one revolution after the arm has caught up."""
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


# -- figures ---------------------------------------------------------------------------------------------------

DPI = 100
COLOURS_KEPT = 160
COLOURS = {"stereo, current": "#56b4e9", **{name: law.colour for name, law in LAWS.items()}}
ENDINGS = {
    "OUT_OF_VIEW": "leaves the image",
    "BACK_FACE": "shows its back",
    "NOT_CONVERGED": "does not arrive",
}
AROUND_PX = 25.0
"""Margin drawn around the markers' tracks, so that parts outside the image show beside its border."""
LONGEST_S, EVERY = 16.0, 5
"""Length of the curves over time, and number of steps between drawn points."""
TASKS = {"large": "132° and 0.32 m", "roll": "half a turn, the face tilted by 60°", "bent": "117° and 0.39 m"}


def draw_laws(comparison: LawComparison) -> dict[str, bytes]:
    """All figures, small enough for the repository."""
    figures = {
        "laws-large": _tracks(comparison, "large"),
        "laws-roll": _tracks(comparison, "roll"),
        "laws-errors": _errors(comparison),
        "bent-way": _bent(comparison),
        "profiles": _profiles(),
        "goal-kinds": _goal_kinds(calibrate("free", "exact", 0.0, comparison.seed)),
    }
    return {name: _small(figure) for name, figure in figures.items()}


def _small(figure: Figure) -> bytes:
    """The PNG file with a palette, to keep the repository small."""
    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, dpi=DPI)
    Image.open(drawn).convert("RGB").quantize(COLOURS_KEPT).save(small, "PNG", optimize=True)
    return small.getvalue()


def _image(axis: Axes, title: str, around: FloatArray | None = None) -> None:
    """An empty left image with its border; cropped to ``around`` (2, 2), least and largest, if given."""
    axis.add_patch(Rectangle((0, 0), WIDTH, HEIGHT, facecolor="#f4f4f4", edgecolor="#888888", linewidth=0.8))
    low, high = np.array([(-10.0, -10.0), (WIDTH + 10.0, HEIGHT + 10.0)]) if around is None else around
    axis.set_xlim(low[0], high[0])
    axis.set_ylim(high[1], low[1])
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_frame_on(False)
    axis.set_title(title, fontsize=9)


def _outline(axis: Axes, pixels: FloatArray, colour: str, style: str = "-", width: float = 1.2) -> None:
    """A plate's outline from its markers (4, 2); a dot on the first."""
    closed = np.vstack([pixels, pixels[:1]])
    axis.plot(closed[:, 0], closed[:, 1], style, color=colour, linewidth=width)
    axis.plot(*pixels[0], "o", color=colour, markersize=3)


def _marker_tracks(axis: Axes, pixels: FloatArray, colour: str, style: str = "-") -> None:
    """Draw tracks (k, 4, 2)."""
    for marker in range(pixels.shape[1]):
        axis.plot(pixels[:, marker, 0], pixels[:, marker, 1], style, color=colour, linewidth=0.9)


def _left(run: ComparedRun) -> FloatArray:
    """Left image (k, 4, 2) of a run."""
    return np.array([sight(pose).pixels[0] for pose in run.trace.poses])


def _around(runs: list[ComparedRun]) -> FloatArray:
    """Bounds (2, 2) of the markers' tracks without the most extreme ones."""
    pixels = np.concatenate([_left(run).reshape(-1, 2) for run in runs])
    ends = np.concatenate([sight(pose).pixels[0] for run in runs for pose in (run.task.start, run.task.goal)])
    least = np.minimum(np.percentile(pixels, 0.5, axis=0), ends.min(axis=0))
    largest = np.maximum(np.percentile(pixels, 99.5, axis=0), ends.max(axis=0))
    return np.array([least - AROUND_PX, largest + AROUND_PX])


def _ending(run: ComparedRun) -> str:
    result = run.result
    if result.refused:
        return "refused"
    return "arrives" if result.success else ENDINGS.get(result.reason, result.reason)


def _tracks(comparison: LawComparison, task: str) -> Figure:
    runs = comparison.runs[task]
    around = _around(list(runs.values()))
    figure = picture(10.0, 5.6)
    axes = figure.subplots(2, 4)
    for axis, (law, run) in zip(axes.flat, runs.items(), strict=False):
        _image(axis, f"{law}: {_ending(run)}", around)
        pixels = _left(run)
        _marker_tracks(axis, pixels, COLOURS[law])
        _outline(axis, sight(run.task.start).pixels[0], "#888888")
        _outline(axis, sight(run.task.goal).pixels[0], "black")
    for axis in axes.flat[len(runs) :]:
        axis.set_axis_off()
        text = (
            f"{TASKS[task]}\n\ngrey field: left image (a part),\nwhite: beside it\n\n"
            "grey outline: start\nblack outline: goal\ndot: marker 0\ncoloured: the markers' ways"
        )
        axis.text(0.02, 0.95, text, fontsize=9, va="top", transform=axis.transAxes)
    return figure


def _off_line_mm(run: ComparedRun) -> FloatArray:
    """Distances (k,) of the plate's centre from the straight line through start and goal."""
    begin, end = run.task.start[:3, 3], run.task.goal[:3, 3]
    offset = run.trace.poses[:, :3, 3] - begin
    length = float(np.linalg.norm(end - begin))
    if length > 0.0:
        along = (end - begin) / length
        offset = offset - (offset @ along)[:, None] * along
    return np.asarray(1e3 * np.linalg.norm(offset, axis=1))


def _left_deg(run: ComparedRun) -> FloatArray:
    """Remaining angle (k,) [°] between the plate and its goal."""
    trace = np.einsum("kij,ij->k", run.trace.poses[:, :3, :3], run.task.goal[:3, :3])
    return np.asarray(np.degrees(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))))


def _errors(comparison: LawComparison) -> Figure:
    figure = picture(10.0, 5.0)
    axes = figure.subplots(2, 3)
    for row, task in zip(axes, ("large", "roll"), strict=True):
        runs = comparison.runs[task]
        for law, run in runs.items():
            style = {"color": COLOURS[law], "linewidth": 1.1, "label": law}
            poses = run.trace.poses
            drawn = slice(None, round(LONGEST_S * DEFAULT_RATE_HZ), EVERY)
            seconds = np.arange(len(poses))[drawn] / DEFAULT_RATE_HZ
            row[0].semilogy(seconds, np.maximum(_left_deg(run)[drawn], 1e-3), **style)
            row[1].semilogy(seconds, np.maximum(_off_line_mm(run)[drawn], 1e-3), **style)
            row[2].semilogy(seconds, run.trace.errors_px[drawn], **style)
        row[0].set_title(f"{task}: turn still to be made [°]", fontsize=9)
        row[1].set_title("off its straight line [mm]", fontsize=9)
        row[2].set_title("largest error in the images [px]", fontsize=9)
        for axis in row:
            axis.set_xlim(0.0, LONGEST_S)
            axis.set_xlabel("s", fontsize=8)
            axis.tick_params(labelsize=7)
        row[0].set_ylim(3e-2, 3e2)
        row[1].set_ylim(3e-2, 1e3)
        row[2].set_ylim(3e-2, 1e3)
    axes[0, 2].legend(fontsize=7, loc="upper right")
    return figure


def _bent(comparison: LawComparison) -> Figure:
    figure = picture(11.0, 3.2)
    axes = figure.subplots(1, 3)
    runs = comparison.runs["bent"]
    around = _around([runs["cartesian3"], runs["trajectory"]])
    for axis, law in zip(axes, ("cartesian3", "trajectory"), strict=False):
        run = runs[law]
        kind = "the straight way" if law == "cartesian3" else "the way bent in view"
        _image(axis, f"{kind} ({law}): {_ending(run)}", around)
        _marker_tracks(axis, _left(run), COLOURS[law])
        _outline(axis, sight(run.task.start).pixels[0], "#888888")
        _outline(axis, sight(run.task.goal).pixels[0], "black")
        poses = 1e3 * run.trace.poses[:, :3, 3]
        axes[2].plot(poses[:, 0], poses[:, 2], color=COLOURS[law], linewidth=1.3, label=law)
    axes[2].set_title("the centre from above [mm]", fontsize=9)
    axes[2].set_aspect("equal")
    axes[2].tick_params(labelsize=7)
    axes[2].legend(fontsize=8, loc="lower left", bbox_to_anchor=(1.0, 0.0))
    return figure


def _profiles() -> Figure:
    figure = picture(10.0, 2.0)
    axes = figure.subplots(1, len(SHAPES), sharey=True)
    shares = np.linspace(0.0, 1.0, 101)
    names = {
        "translation": ("#d55e00", "-"),
        "hinge": ("#0072b2", "--"),
        "turn in the plane": ("#009e73", ":"),
    }
    for axis, (profile, shapes) in zip(axes, SHAPES.items(), strict=True):
        for (name, (colour, style)), shape in zip(names.items(), shapes, strict=True):
            axis.plot(shares, [progress(shape, s) for s in shares], style, color=colour, linewidth=2.0, label=name)
        axis.set_title(profile, fontsize=9)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("done of each component", fontsize=8)
    axes[0].legend(fontsize=7, loc="upper left")
    return figure


def _goal_kinds(calibration: TaskCalibration) -> Figure:
    figure = picture(11.0, 5.4)
    axes = figure.subplots(2, 3)
    _features(axes[0, 0], shown(calibration))
    _points(axes[0, 1], shown(calibration, "cartesian3"))
    _displacement(axes[0, 2], *displaced_twice(calibration))
    _taught(axes[1, 0], carried_over(calibration))
    _incidence(axes[1, 1], point_on_line(calibration))
    _streamed(axes[1, 2], streamed(calibration))
    return figure


def _features(axis: Axes, drive: Drive) -> None:
    _image(axis, "features: markers at these pixels")
    pixels = drive.pixels[:, 0]
    _marker_tracks(axis, pixels, COLOURS["stereo"])
    _outline(axis, pixels[0], "#888888")
    _outline(axis, pixels[-1], "black", width=0.6)
    axis.plot(pixels[-1, :, 0], pixels[-1, :, 1], "+", color="black", markersize=9)


def _points(axis: Axes, drive: Drive) -> None:
    """Top view, with the plate as a bar of its first two markers."""
    middles = drive.poses[:, :3, 3]
    axis.plot(1e3 * middles[:, 0], 1e3 * middles[:, 2], color=COLOURS["cartesian3"], linewidth=1.2)
    for k, colour in ((0, "#888888"), (8, "#cccccc"), (20, "#cccccc"), (40, "#cccccc"), (-1, "black")):
        corners = drive.poses[k] @ np.array([(-0.05, 0.05), (0.0, 0.0), (0.0, 0.0), (1.0, 1.0)])
        axis.plot(1e3 * corners[0], 1e3 * corners[2], color=colour, linewidth=2.5)
    axis.set_aspect("equal", adjustable="datalim")
    axis.tick_params(labelsize=7)
    axis.set_title("points: they shall be there in space (from above)", fontsize=9)


def _displacement(axis: Axes, first: Drive, second: Drive) -> None:
    _image(axis, "displacement: from where it is (here twice)")
    for drive, colour in ((first, COLOURS["cartesian3"]), (second, COLOURS["cartesian2"])):
        _marker_tracks(axis, drive.pixels[:, 0], colour)
        _outline(axis, drive.pixels[-1, 0], "black")
    _outline(axis, first.pixels[0, 0], "#888888")


def _taught(axis: Axes, carried: GoalSketch) -> None:
    _image(axis, "taught, relative to the workpiece")
    for pixels, goal, colour in (
        (carried.workpiece_then[0], carried.taught[0], "#bbbbbb"),
        (carried.workpiece_now[0], carried.set_points[0], "black"),
    ):
        axis.plot(pixels[:, 0], pixels[:, 1], "^", color=colour, markersize=6)
        _outline(axis, goal, colour)
    _marker_tracks(axis, carried.drive.pixels[:, 0], COLOURS["cartesian3"])
    _outline(axis, carried.drive.pixels[0, 0], "#888888")
    axis.text(10, 470, "triangles: workpiece; grey: as taught", fontsize=8)


def _incidence(axis: Axes, on_line: OnLine) -> None:
    _image(axis, "incidence: marker 0 on the line, the rest free")
    a, b = on_line.line[0]
    axis.axline(a, b, color="#888888", linestyle="--", linewidth=1.0)
    for drive, colour in ((on_line.alone, COLOURS["points"]), (on_line.with_second, COLOURS["cartesian2"])):
        _marker_tracks(axis, drive.pixels[:, 0], colour)
        _outline(axis, drive.pixels[-1, 0], colour)
    _outline(axis, on_line.alone.pixels[0, 0], "#888888")
    axis.plot(on_line.set_points[0, :, 0], on_line.set_points[0, :, 1], "+", color="black", markersize=8)
    axis.text(10, 470, "green: alone; orange: second task, the crosses", fontsize=8)


def _streamed(axis: Axes, streamed: Streamed) -> None:
    _image(axis, "streamed: the target moves (marker 0)")
    axis.plot(streamed.target[:, 0, 0, 0], streamed.target[:, 0, 0, 1], "--", color="black", linewidth=1.0)
    for drive, colour in ((streamed.fed_forward, COLOURS["stereo"]), (streamed.without, COLOURS["image"])):
        pixels = drive.pixels[:, 0, 0]
        axis.plot(pixels[:, 0], pixels[:, 1], color=colour, linewidth=1.2)
        axis.plot(*pixels[-1], "o", color=colour, markersize=5)
    axis.plot(*streamed.target[-1, 0, 0], "+", color="black", markersize=10)
    axis.text(10, 470, "blue: velocity fed forward; pink: without", fontsize=8)
