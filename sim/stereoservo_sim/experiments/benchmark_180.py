"""Experiment: the benchmark of thesis 8.7 (180° about the roll axis, face tilted by 60°), and an arm that reaches
it; figures 8.14 to 8.22, and the thesis's statements on them beside our results.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from stereoservo.control.law_registry import LAWS
from stereoservo.kinematics.kernels import project_points, triangulate
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.cartesian_path import CartesianPath, cartesian_path
from stereoservo.planning.plan import Profile
from stereoservo.planning.three_point_decomposition import decompose
from stereoservo_sim.experiments.driven_tasks import decay, image_errors, images, thinned
from stereoservo_sim.experiments.experiment import Comparison, not_comparable, of_statement
from stereoservo_sim.experiments.figures import COLOURS, Figures, draw_images, labelled, picture
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.tasks.arms import (
    MID_RANGE,
    PLATE_ON_FLANGE,
    RX90_LIMITS,
    ArmName,
    free_cell,
    inverse_kinematics,
    rx90_cell,
)
from stereoservo_sim.tasks.calibrations import (
    Knowledge,
    TaskCalibration,
    known_at_start,
    metric_model,
    self_calibrated,
)
from stereoservo_sim.tasks.closed_loop import LoopSettings, Projections, TaskResult, Trace, run_task
from stereoservo_sim.tasks.ground_truth import MATRICES, line_deviations, sight
from stereoservo_sim.tasks.setting import (
    FACE,
    FOCAL,
    HEIGHT,
    HOMOGENEOUS_MARKERS,
    WIDTH,
    camera_poses,
    cartesian_twists,
)
from stereoservo_sim.tasks.task_file import AlignmentTask
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell, rotation, translation

Curve = dict[str, Any]


def draw_benchmark_180(answer: dict[str, Any]) -> Figures:
    """Figures of classical laws, control errors, paths of the centre, image errors, joint motions."""
    curves = answer["curves"]
    found = {
        "laws": _draw_classical(_of(curves, scene="aside", arm="free")),
        "control-errors": _control_errors(curves),
        "centre": _centres(_of(curves, scene="aside", arm="rx90")),
        "joints": _images_and_joints(_of(curves, scene="aside", arm="rx90", law="cartesian3")),
    }
    return {f"benchmark-180-{name}": figure for name, figure in found.items()}


def compare_benchmark_180(answer: dict[str, Any]) -> list[Comparison]:
    """Statements of the thesis on figs 8.14 to 8.22, beside our runs."""
    rows, summary, curves = answer["rows"], answer["beside_thesis"], answer["curves"]
    return [
        *(_classical_compared(row) for row in rows if row["law"] in CLASSICAL),
        *(_planned_compared(item) for item in summary if "planned" in item),
        _tracks_compared(curves),
        *(row for law in CARTESIAN[:2] for row in _line_compared(law, rows)),
        _rates_compared("fig. 8.19", "cartesian2", rows),
        _rates_compared("fig. 8.20", "cartesian3", rows),
        *_curves_compared(rows, summary, curves),
    ]


def _classical_compared(row: Curve) -> Comparison:
    """A run of a classical law (fig. 8.14)."""
    lost = row["reason"] == "EXTRACTION_LOST"
    end = f"lost {row['farthest_m']:.1f} m away"
    if not lost:
        end = f"stalled {row['stalled_s']:.1f} s, {row['final_error_px']:.2g} px at the end"
    ours = f"{'keeps the face' if row['face_visible'] else 'shows the back'}, {end}"
    said, criterion = "self-occlusion, trapped, escapes, converges", "it shows the back, stalls for 1 s and converges"
    seen = not lost and not row["face_visible"] and row["final_error_px"] < 1.0 and row["stalled_s"] > 1.0
    why = f"it is not trapped: its image error never falls at less than {SLOW:g} of the gain, as the centre moves too"
    if row["law"] == "stereo-block":
        said, seen, why = "diverges while moving towards infinity", lost, ""
        criterion = f"it goes out until dots of {100 * DOT_M:g} cm are below {DOT_PX:g} px, where they are lost"
    return of_statement("fig. 8.14", f"{CLASSICAL[row['law']][0]}, {row['scene']}", said, ours, criterion, seen, why)


def _planned_compared(item: Curve) -> Comparison:
    """A planned path (figs 8.15, 8.16)."""
    figure, facing = "fig. 8.15" if item["planned"] == "linear" else "fig. 8.16", item["smallest_facing"]
    what, ours = f"planned, {item['planned']}, {item['scene']}", f"cosine to the face from {facing:.2f}"
    return of_statement(figure, what, "self-occlusion avoided", ours, "above 0 on the whole path", facing > 0.0)


def _tracks_compared(curves: list[Curve]) -> Comparison:
    """Markers' tracks of both Cartesian laws, with the thesis's step (fig. 8.17)."""
    runs = _of(curves, scene="aside", gain=GAIN, step="first order", joint_speed_deg_s=None)
    three, two = (np.array(_of(runs, law=law)[0]["pixels"]) for law in CARTESIAN[:2])
    tracks = [(three[:, c, p], two[:, c, p]) for c in range(three.shape[1]) for p in range(three.shape[2])]
    apart = max(float(distances_from_track(*pair).max()) for pair in tracks)
    length = float(np.linalg.norm(np.diff(three, axis=0), axis=-1).sum(axis=0).max())
    return of_statement(
        "fig. 8.17",
        "image tracks of directTHREE beside those of directTWO",
        "very small deviation",
        f"{apart:.0f} px at most, of a track of {length:.0f} px",
        "a twentieth of the track at most",
        apart < 0.05 * length,
        "directTHREE turns about two axes at once, directTWO about one; the thesis prints no value",
    )


def distances_from_track(points: FloatArray, track: FloatArray) -> FloatArray:
    """Distances (k,) of ``points`` (k, 2) from the nearest segment of a ``track`` (n, 2)."""
    start, along = track[:-1], np.diff(track, axis=0)
    offset = points[:, None] - start
    share = np.clip((offset * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * along, axis=-1).min(axis=1))


def _line_compared(law: str, rows: list[Curve]) -> list[Comparison]:
    """Path of the centre of the RX 90's plate beside its line (fig. 8.18)."""
    mine = _of(rows, law=law, arm="rx90", scene="aside")
    slow = [row["line_deviation_mm"] for row in mine if row["joint_speed_deg_s"] is not None]
    first, corrected = (
        [row["line_deviation_mm"] for gain in GAINS for row in _of(mine, gain=gain, step=step, joint_speed_deg_s=None)]
        for step in ("first order", "corrected")
    )
    if not slow or len(first) < len(GAINS):
        return []
    before_text, after_text = (
        ", ".join(f"{value:.2g}" for value in values) + " mm at gains " + GAINS_TEXT for values in (first, corrected)
    )
    grows, least = first == sorted(first), slow[0] < first[0]
    without = all(after <= 0.1 * before for after, before in zip(corrected, first, strict=True))
    return [
        of_statement("fig. 8.18", f"{law}, centre beside its line", "less at smaller gains, least with limited joints",
                     f"{before_text}; limited to {JOINT_SPEED_DEG_S:g}°/s {slow[0]:.2g} mm",
                     "it grows from gain to gain; limited below all", grows and least),
        of_statement("fig. 8.18", f"{law}, cause of the deviation", "integration error of the joint velocities",
                     f"{after_text} with the corrected step", "a tenth or less is left at each gain", without),
    ]  # fmt: skip


def _rates_compared(figure: str, law: str, rows: list[Curve]) -> Comparison:
    """Decay of the control errors (figs 8.19, 8.20)."""
    mine = _of(rows, scene="aside", law=law, model="projective", joint_speed_deg_s=None)

    def rates(step: str, gain: float) -> list[float]:
        of_runs = [row[f"{name}_rate"] for row in _of(mine, step=step, gain=gain) for name in COMPONENTS]
        return sorted(rate for rate in of_runs if rate is not None)

    first, corrected = rates("first order", GAIN), rates("corrected", GAIN)
    highest = rates("first order", max(row["gain"] for row in mine))[-1]
    return of_statement(
        figure,
        f"{law}, control errors, first-order step as in the thesis",
        "exponential convergence",
        f"rates {first[0]:.3f} to {first[-1]:.3f} of the gain {GAIN:g}/s, up to {highest:.3f} of the largest; "
        f"with the corrected step {corrected[0]:.3f} to {corrected[-1]:.3f} of the gain {GAIN:g}/s",
        f"0.95 to 1.05 of the gain {GAIN:g}/s",
        first[0] > 0.95 and first[-1] < 1.05,
    )


def _curves_compared(rows: list[Curve], summary: list[Curve], curves: list[Curve]) -> list[Comparison]:
    """Angles and translation (figs 8.19, 8.20); image errors and joints of the RX 90, first-order step (8.21, 8.22)."""
    starts = sorted(row["theta_start_deg"][0] for row in _of(rows, scene="aside", law="cartesian2"))
    (overlap,) = [item for item in summary if "overlap" in item]
    angle, tau = max(overlap["theta_r_apart_deg"], overlap["theta_p_apart_deg"]), overlap["tau_from_truth_of_100"]
    chosen = _of(curves, scene="aside", law="cartesian3", gain=GAIN, step="first order", joint_speed_deg_s=None)
    (curve,) = chosen
    errors = np.abs(np.array(curve["image_errors_px"])).reshape(len(curve["image_errors_px"]), -1)
    rises = [float(np.maximum(np.diff(column), 0.0).sum()) for column in errors.T]
    centre = np.array(curve["centre_px"])
    length, beside = float(np.ptp(centre[:, 0])), float(np.abs(centre[:, 1] - centre[-1, 1]).max())
    speeds = np.abs(np.diff(curve["joints_deg"][:2], axis=0)[0]) / (curve["seconds"][1] - curve["seconds"][0])
    fastest = " and ".join(f"q{j + 1} ({speeds[j]:.0f}°/s)" for j in np.argsort(-speeds)[:2])
    return [
        of_statement("fig. 8.19", "theta_s at the start, with and without limited joints", "180°",
                     f"{starts[0]:.1f} to {starts[-1]:.1f}°", "within 0.5°", 179.5 < starts[0] <= starts[-1] < 180.5),
        of_statement("fig. 8.20", "projective beside Euclidean model", "almost perfect overlap of the angles",
                     f"{angle:.2g}° apart at most", "0.5° at most", angle < 0.5),
        of_statement("fig. 8.20", "tau, normalised to 100, beside Euclidean truth", "differs by its scale only",
                     f"{tau:.2g} of 100 apart at most, scale {overlap['tau_scale']:.2g}", "1 of 100 at most", tau < 1),
        of_statement("fig. 8.21", "errors of the markers' images", "neither exponential nor monotonic",
                     f"they rise by {max(rises):.0f} px on the path", "a rise of 10 px or more", max(rises) > 10.0),
        of_statement("fig. 8.21", "zero line: image of the centre's path", "straight and horizontal",
                     f"{beside:.1f} px off the horizontal on {length:.0f} px", "a fiftieth of its length at most",
                     beside < 0.02 * length),
        not_comparable("fig. 8.22", "joints that are fastest at the start", "q1 and q3, the cause of fig. 8.18",
                       f"{fastest} at gain {GAIN:g}/s",
                       "the thesis does not print where its arm stands: in other postures other joints are fast"),
    ]  # fmt: skip


def _of(curves: list[Curve], **wanted: Any) -> list[Curve]:
    return [curve for curve in curves if all(curve[key] == value for key, value in wanted.items())]


def _draw_classical(curves: list[Curve]) -> Figure:
    """Left image and visibility of the face, one column a law (figs 8.14, 8.15)."""
    laws = [curve for curve in curves if curve["model"] == "projective" or curve["law"] == "euclidean-points"]
    figure = picture(2.6 * max(len(laws), 1), 5.5)
    axes = figure.subplots(2, max(len(laws), 1), squeeze=False)
    for k, curve in enumerate(laws):
        draw_images(axes[0, k], np.array(curve["pixels"])[:, 0], COLOURS[k], curve["law"])
        axes[0, k].set_xlim(0, WIDTH)
        axes[0, k].set_ylim(HEIGHT, 0)
        labelled(axes[0, k], f"{curve['law']}, left image", "u [px]", "v [px]")
        axes[1, k].plot(curve["seconds"], curve["facing"], color=COLOURS[k])
        axes[1, k].axhline(0.0, color="black", linewidth=0.6)
        axes[1, k].set_ylim(-1.0, 1.0)
        labelled(axes[1, k], "below 0: the back is seen", "[s]", "cosine to the face's normal")
    return figure


def _control_errors(curves: list[Curve]) -> Figure:
    """Control errors of both Cartesian laws, with and without limited joints; metric beside projective (figs 8.19,
    8.20).
    """
    figure = picture(11, 4.2)
    axes = figure.subplots(1, 3)
    panels = (
        ("cartesian3", "free", "cartesian3; dashed: metric model", ("τ [of 100]", "θ_r [deg]", "θ_p [deg]")),
        ("cartesian3", "rx90", "cartesian3, RX 90; dashed: 5°/s", ("τ [of 100]", "θ_r [deg]", "θ_p [deg]")),
        ("cartesian2", "rx90", "cartesian2, RX 90; dashed: 5°/s", ("τ [of 100]", "θ_s [deg]")),
    )
    for axis, (law, arm, title, names) in zip(axes, panels, strict=True):
        for curve in _of(curves, scene="aside", law=law, arm=arm):
            limited = curve["joint_speed_deg_s"] is not None or curve["model"] == "metric"
            if not limited and (curve["gain"] != 0.5 or curve["step"] != "corrected"):
                continue
            errors = np.array(curve["task_errors"])
            t = np.linspace(curve["seconds"][0], curve["seconds"][-1], len(errors))
            for i, name in enumerate(names):
                values = 100.0 * errors[:, 0] / errors[0, 0] if i == 0 else np.degrees(errors[:, i])
                axis.plot(t, values, "--" if limited else "-", color=COLOURS[i], label=None if limited else name)
        labelled(axis, title, "[s]", "still to be made")
        if axis.lines:
            axis.legend(fontsize=7)
    return figure


def _centres(curves: list[Curve]) -> Figure:
    """Path of the centre beside its line for several gains (figs 8.17, 8.18)."""
    figure = picture(11, 6)
    for line, law in zip(figure.subplots(2, 2, sharey=True), ("cartesian3", "cartesian2"), strict=True):
        for axis, step in zip(line, ("first order", "corrected"), strict=True):
            for colour, curve in zip(COLOURS, _of(curves, law=law, step=step), strict=False):
                limit = curve["joint_speed_deg_s"]
                name = f"gain {curve['gain']:g}/s" + ("" if limit is None else f", {limit:g}°/s")
                centre = np.array(curve["centre_mm"])
                axis.plot(centre[:, 0], centre[:, 1], color=colour, linewidth=0.9, label=name)
            labelled(axis, f"{law}, {step}", "along the line [mm]", "beside it [mm]")
            if axis.lines:
                axis.legend(fontsize=6)
    return figure


def _images_and_joints(curves: list[Curve]) -> Figure:
    """Image errors of the markers (fig. 8.21) and joints (fig. 8.22), free and with limited joint speed."""
    chosen = [
        *_of(curves, gain=0.5, step="corrected"),
        *[curve for curve in curves if curve["joint_speed_deg_s"] is not None],
    ]
    figure = picture(11, 3.6 * max(len(chosen), 1))
    axes = figure.subplots(max(len(chosen), 1), 2, squeeze=False)
    for line, curve in zip(axes, chosen, strict=False):
        limit = curve["joint_speed_deg_s"]
        name = f"gain {curve['gain']:g}/s" + ("" if limit is None else f", {limit:g}°/s")
        errors, joints = np.array(curve["image_errors_px"]), np.array(curve["joints_deg"])
        for p in range(errors.shape[1]):
            for i, dash in enumerate(("-", "--")):
                line[0].plot(curve["seconds"], errors[:, p, i], dash, color=COLOURS[p], linewidth=0.9)
        for j, q in enumerate(joints.T):
            line[1].plot(curve["seconds"], q, color=COLOURS[j], linewidth=0.9, label=f"joint {j + 1}")
        labelled(line[0], f"{name}: markers, left (dashed: v)", "[s]", "image error [px]")
        labelled(line[1], name, "[s]", "joint [deg]")
        line[1].legend(fontsize=6)
    return figure


# -- the task and its runs -------------------------------------------------------------------------------------

TILT_DEG, DEPTH_M = 60.0, 1.0
ASIDE_M = {"centred": 0.0, "aside": 0.15}
"""Distance of the plate's centre from the roll axis at the goal, on the side from which its face is turned away."""
LIMIT_MARGIN = np.radians(5.0)
WAY_STEPS = 25
LARGEST_JOINT_STEP = np.radians(25.0)
"""Largest step between two samples of the path: a larger one is a change of posture."""
TRIED_GAIN, TRIED_SEEDS = 1.0, 4


def benchmark_task(where: str) -> AlignmentTask:
    """The benchmark's task. ``centred``: only the rotation; ``aside``: the plate's centre moves from one side of the
    axis to the other.
    """
    goal = translation(ASIDE_M[where], 0.0, DEPTH_M) @ rotation("y", TILT_DEG)
    start = rotation("z", 180.0) @ goal
    number = list(ASIDE_M).index(where)
    return AlignmentTask(number, 0, 180.0, 2.0 * ASIDE_M[where], np.array([1.0, 0.0, 0.0]), start, goal)


def true_path(task: AlignmentTask, profile: Profile = "linear") -> CartesianPath:
    """Cartesian path (7.25) of the plate in the rig's own frame."""
    camera_centres = np.hstack([camera_poses()[:, :3, 3], np.ones((2, 1))])
    A, A_star = (HOMOGENEOUS_MARKERS @ pose.T for pose in (task.start, task.goal))
    return _path(cartesian_twists(task.start[:3, 3]), A, A_star, camera_centres, profile)


def _path(
    basis: FloatArray, A: FloatArray, A_star: FloatArray, camera_centres: FloatArray, profile: Profile
) -> CartesianPath:
    """Path of markers from ``A`` (m, 4) to ``A_star`` (m, 4)."""
    middles = A.mean(axis=0), A_star.mean(axis=0)
    return cartesian_path(decompose(basis, A[FACE], A_star[FACE], *middles, camera_centres), profile)


def known_path(
    knowledge: Knowledge, targets: FloatArray, profile: Profile = "linear"
) -> tuple[CartesianPath, FloatArray]:
    """Cartesian path in a controller's model, towards points ``targets`` (m, 4); and the current points (m, 4).

    Raises ValueError if the markers' positions on the body are unknown.
    """
    if knowledge.points is None:
        raise ValueError("a model that knows the markers' places on the body is needed")
    A = knowledge.points
    return _path(knowledge.basis, A, targets, knowledge.camera_centres, profile), A


def placed_rx90(task: AlignmentTask, seed: int, tries: int = 2000) -> SyntheticCell | None:
    """RX 90 with its base placed such that it follows the whole Cartesian path of ``task`` within its limits; None
    if not found.

    Configurations at the start are drawn by seed. The Cartesian laws must then drive it with an exact model, for
    several seeds of the noise, which decides the sense of half a turn. Home is the configuration nearest to the start
    in which the plate is at mid-range.
    """
    rng, cell = np.random.default_rng([seed, 90]), rx90_cell()
    low, high = RX90_LIMITS[:, 0] + LIMIT_MARGIN, RX90_LIMITS[:, 1] - LIMIT_MARGIN
    limits = np.stack([low, high], axis=1)
    back = np.linalg.inv(PLATE_ON_FLANGE)
    path = true_path(task)
    poses = [path.displacement(s) @ task.start @ back for s in np.linspace(0.0, 1.0, WAY_STEPS)]
    for _ in range(tries):
        q = rng.uniform(low, high)
        base = poses[0] @ np.linalg.inv(np.linalg.inv(cell.base) @ cell.flange(q))
        inverse = np.linalg.inv(base)
        home = _nearest(inverse_kinematics(inverse @ MID_RANGE @ back, limits), q)
        if home is not None and _follows(inverse, poses, q, limits):
            found = replace(cell, base=base, home=home)
            if _drives(found, task):
                return found
    return None


def _drives(cell: SyntheticCell, task: AlignmentTask) -> bool:
    exact = TaskCalibration("rx90", cell, exact_model(cell), {})
    return all(
        run_task(task, exact, LoopSettings(law=law, arm="rx90", gain=TRIED_GAIN, seed=seed))[0].success
        for law in ("cartesian3", "cartesian2")
        for seed in range(TRIED_SEEDS)
    )


def _follows(inverse: FloatArray, poses: list[FloatArray], q: FloatArray, limits: FloatArray) -> bool:
    """Whether the arm follows the flange's poses from ``q`` (6,) in one posture within the limits."""
    for pose in poses[1:]:
        following = _nearest(inverse_kinematics(inverse @ pose, limits), q)
        if following is None or float(np.abs(following - q).max()) > LARGEST_JOINT_STEP:
            return False
        q = following
    return True


def _nearest(found: FloatArray, q: FloatArray) -> FloatArray | None:
    return None if len(found) == 0 else found[int(np.abs(found - q).max(axis=1).argmin())]


GAINS = (0.5, 1.0, 2.0, 4.0)
"""Gains [1/s]."""
GAINS_TEXT = ", ".join(f"{gain:g}" for gain in GAINS)
GAIN = 0.5
NOISE_PX = 0.1
JOINT_SPEED_DEG_S = 5.0
FITTED = 0.02
"""Remaining share of a component down to which its decay is fitted."""
SLOW, FAR_PX = 0.1, 20.0
"""Decay rate as a share of the gain, and total image error, at which a law counts as stalled."""
LEAST_ANGLE = 0.05
"""Least initial angle [rad] whose decay is fitted."""
CLASSICAL = {
    "stereo": ("stacked Jacobians", "projective"),
    "stereo-block": ("block-wise pseudo-inverse", "projective"),
    "euclidean-points": ("Jacobian for 3D Euclidean points", "metric"),
}
"""The classical laws by their name in the thesis, with the model they need."""
COMPONENTS = ("tau", "theta_r", "theta_p", "theta_s")
DOT_M, DOT_PX = 0.01, 2.0
"""Diameter of a dot [m], and the least one [px] that is extracted."""
CARTESIAN = ("cartesian3", "cartesian2", "trajectory")
PLANNED: tuple[tuple[str, Profile], ...] = (("centred", "linear"), ("aside", "linear"), ("aside", "translation-first"))
THESIS = {
    "figures": "8.13 to 8.22",
    "classical laws": "trapped or diverging (fig. 8.14)",
    "planned ways": "self-occlusion avoided, all components linear and with steep translation (figs 8.15, 8.16)",
    "centre": "leaves its straight line less at smaller gains, least with joints limited to 5°/s (fig. 8.18)",
    "control errors": "decay exponentially; theta_s starts at 180° (figs 8.19, 8.20)",
    "projective and Euclidean model": "almost perfect overlap of theta_r and theta_p (fig. 8.20)",
    "image errors": "neither exponential nor monotonic (fig. 8.21)",
}
ASSUMPTIONS = [
    "centred: the plate's middle stays on the roll axis, 1 m off; aside: it goes from 15 cm on one side to 15 cm on "
    "the other, so that there is a line to leave (the thesis shows one, and prints no poses)",
    "the arms are a virtual arm of six Cartesian generators, and an RX 90 whose base is placed, by seeded search, "
    "where the Cartesian laws drive the task within its limits; the thesis's arm is the RX 90 at INRIA",
    f"self-calibrated, {NOISE_PX} px noise, 25 Hz; markers count as seen from behind, as in the thesis's simulation; "
    f"dots of {100 * DOT_M:g} cm are lost where they are smaller than {DOT_PX:g} px",
    "classical laws around the current points; the block-wise sum is halved (errata)",
    "half a turn has two senses: noise may decide which one is taken",
]
TITLE = "benchmark-180: half a turn, face tilted by 60°; rates over the gain: 1 expected"


class SmallDotsLost(NamedTuple):
    """The plate's projections, of which nothing is extracted while dots are smaller than ``DOT_PX``."""

    shown: Projections

    def look(
        self, pose: FloatArray, time_s: float, expected: FloatArray | None, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray] | None:
        """See `PlateSight`."""
        found = self.shown.look(pose, time_s, expected, rng)
        return None if DOT_PX * sight(pose).depth_m > FOCAL * DOT_M else found


class BenchmarkRun(NamedTuple):
    """Specification of one run."""

    scene: str
    arm: ArmName
    law: str
    model: str = "projective"
    gain: float = GAIN
    step: Literal["corrected", "first order"] = "corrected"
    joint_speed_deg_s: float | None = None


COMPARED = (
    BenchmarkRun("aside", "free", "cartesian3"),
    BenchmarkRun("aside", "free", "cartesian3", "metric"),
)
"""Runs compared in fig. 8.20."""


def asked() -> list[BenchmarkRun]:
    """Specifications of all runs: classical laws, Cartesian laws on both arms, several gains on the RX 90, the
    metric model.
    """
    arms: tuple[ArmName, ...] = ("free", "rx90")
    return [
        *(BenchmarkRun(scene, "free", law, model) for scene in ASIDE_M for law, (_, model) in CLASSICAL.items()),
        *(BenchmarkRun(scene, arm, law) for scene in ASIDE_M for arm in arms for law in CARTESIAN),
        *(
            BenchmarkRun("aside", "rx90", law, gain=gain, step=step)
            for law in CARTESIAN[:2]
            for gain in GAINS
            for step in ("corrected", "first order")
            if (gain, step) != (GAIN, "corrected")
        ),
        *(
            BenchmarkRun("aside", "rx90", law, gain=1.0, step="first order", joint_speed_deg_s=JOINT_SPEED_DEG_S)
            for law in CARTESIAN[:2]
        ),
        COMPARED[1],
    ]


def run_benchmark_180(*, seed: int, progress: ProgressCall, runs: list[BenchmarkRun] | None = None) -> dict[str, Any]:
    """Run all laws and planned paths. Raises CalibrationError."""
    runs = asked() if runs is None else runs
    tasks = {scene: benchmark_task(scene) for scene in ASIDE_M}
    known = _calibrations(runs, tasks, seed)
    rows, curves = [], []
    for i, run in enumerate(runs):
        progress("benchmark-180", i, len(runs))
        calibration = known.get((run.scene if run.arm == "rx90" else "", run.arm, run.model))
        if calibration is None:
            continue
        task = tasks[run.scene]
        settings = _settings(run, seed)
        result, trace = run_task(task, calibration, settings, SmallDotsLost(Projections(settings)))
        rows.append(_row(run, task, result, trace))
        curves.append(_curve(run, task, trace))
    progress("benchmark-180", len(runs), len(runs))
    ways = [_planned(scene, tasks[scene], known["", "free", "projective"], profile) for scene, profile in PLANNED]
    return {
        "title": TITLE,
        "noise_px": NOISE_PX,
        "rows": rows,
        "beside_thesis": [*ways, _overlap(tasks["aside"], known, seed)],
        "thesis": THESIS,
        "assumptions": ASSUMPTIONS,
        "not_placed": [scene for scene in ASIDE_M if known.get((scene, "rx90", "projective"), 0) is None],
        "curves": curves,
    }


def _calibrations(
    runs: list[BenchmarkRun], tasks: dict[str, AlignmentTask], seed: int
) -> dict[tuple[str, ArmName, str], TaskCalibration | None]:
    """Calibrations by scene (of the placed arm), arm and model; None if no placement was found."""
    free = free_cell()
    known: dict[tuple[str, ArmName, str], TaskCalibration | None] = {
        ("", "free", "projective"): self_calibrated("free", free, NOISE_PX, seed),
        ("", "free", "metric"): metric_model("free", free, 0.0, 0.0),
    }
    for scene in dict.fromkeys(run.scene for run in runs if run.arm == "rx90"):
        cell = placed_rx90(tasks[scene], seed)
        known[scene, "rx90", "projective"] = None if cell is None else self_calibrated("rx90", cell, NOISE_PX, seed)
    return known


def _settings(run: BenchmarkRun, seed: int) -> LoopSettings:
    return LoopSettings(
        law=run.law,
        arm=run.arm,
        jacobian="current",
        gain=run.gain,
        noise_px=NOISE_PX,
        seed=seed,
        first_order=run.step == "first order",
        joint_speed=None if run.joint_speed_deg_s is None else float(np.radians(run.joint_speed_deg_s)),
    )


def _row(run: BenchmarkRun, task: AlignmentTask, result: TaskResult, trace: Trace) -> dict[str, Any]:
    components = ("tau", "theta_s") if run.law == "cartesian2" else ("tau", "theta_r", "theta_p")
    errors = trace.task_errors
    row: dict[str, Any] = {
        **run._asdict(),
        "converged": bool(result.success),
        "reason": result.reason,
        "face_visible": not result.back_face,
        "smallest_facing": float(trace.facing.min()),
        "iterations": result.iterations,
        "final_error_px": result.final_error_px,
        "line_deviation_mm": result.line_deviation_mm,
        "farthest_m": float(np.linalg.norm(trace.poses[:, :3, 3], axis=1).max()),
        "stalled_s": stalled_s(image_errors(trace.poses, task.goal), run.gain, 1.0 / 25.0),
    }
    for name in COMPONENTS:
        i = components.index(name) if name in components and errors.shape[1] else -1
        asks = i >= 0 and (task.distance_m > 0.0 if i == 0 else errors[0, i] > LEAST_ANGLE)
        fit = decay(errors[:, i], 1.0 / 25.0, FITTED) if asks and run.joint_speed_deg_s is None else None
        row[f"{name}_rate"] = None if fit is None else fit.rate / run.gain
        row[f"{name}_r2"] = None if fit is None else fit.r_squared
    row["theta_start_deg"] = [round(float(v), 2) for v in np.degrees(errors[0, 1:])] if errors.size else None
    return row


def stalled_s(errors: FloatArray, gain: float, dt_s: float) -> float:
    """Time [s] for which a large image error (k,) [px] decays at less than a tenth of the gain."""
    rates = -np.diff(np.log(np.maximum(errors, 1e-9))) / dt_s
    return dt_s * int(((rates < SLOW * gain) & (errors[:-1] > FAR_PX)).sum())


def _curve(run: BenchmarkRun, task: AlignmentTask, trace: Trace) -> dict[str, Any]:
    """Data of a run for the figures."""
    pixels = images(trace.poses)
    return {
        **run._asdict(),
        "seconds": thinned(np.arange(len(trace.poses)) / 25.0),
        "task_errors": thinned(np.nan_to_num(trace.task_errors), 6) if run.law in LAWS else [],
        "centre_mm": thinned(1e3 * (trace.poses[:, :3, 3] - task.goal[:3, 3]), 4),
        "centre_px": thinned(_centre_px(trace.poses), 3),
        "facing": thinned(trace.facing),
        "pixels": thinned(pixels, 2),
        "image_errors_px": thinned((pixels - sight(task.goal).pixels)[:, 0], 2),
        "joints_deg": thinned(np.degrees(trace.joints), 3),
    }


def _centre_px(poses: FloatArray) -> FloatArray:
    """Left image (k, 2) of the plate's centre."""
    x = poses[:, :, 3] @ MATRICES[0].T
    return np.asarray(x[:, :2] / x[:, 2:])


def _planned(scene: str, task: AlignmentTask, calibration: TaskCalibration | None, profile: Profile) -> dict[str, Any]:
    """A planned path (figs 8.15, 8.16): ground truth, and the projective model's path beside it in the images."""
    assert calibration is not None
    knowledge = known_at_start(calibration, task, None)
    set_points = sight(task.goal).pixels
    found, _ = triangulate(knowledge.matrices, set_points, np.ones(set_points.shape[:2]), 5)
    path, points = known_path(knowledge, found / (found @ knowledge.plane_at_infinity)[:, None], profile)
    sigmas = np.linspace(0.0, 1.0, 101)
    planned = np.array([project_points(knowledge.matrices, points @ path.displacement(s).T)[0] for s in sigmas])
    truth = true_path(task, profile)
    parts = truth.decomposition
    # Half a turn has two senses: the model's path is compared with the nearer one.
    other = CartesianPath(replace(parts, planar=replace(parts.planar, operator=-parts.planar.operator)), profile)
    apart, poses = np.inf, np.zeros((0, 4, 4))
    for sense in (truth, other):
        tried = np.array([sense.displacement(s) @ task.start for s in sigmas])
        distance = float(np.linalg.norm(images(tried) - planned, axis=-1).max())
        if distance < apart:
            apart, poses = distance, tried
    return {
        "planned": profile,
        "scene": scene,
        "smallest_facing": min(sight(pose).facing for pose in poses),
        "line_deviation_mm": 1e3 * float(line_deviations(poses, task.start, task.goal).max()),
        "model_from_truth_px": apart,
    }


def _overlap(
    task: AlignmentTask, known: dict[tuple[str, ArmName, str], TaskCalibration | None], seed: int
) -> dict[str, Any]:
    """Difference of the control errors of projective and metric model, and of the former from the true distance, with
    noise-free images (fig. 8.20).
    """
    found = []
    for run in COMPARED:
        calibration = known["", run.arm, run.model]
        assert calibration is not None
        found.append(run_task(task, calibration, replace(_settings(run, seed), noise_px=0.0))[1])
    k = min(len(trace.task_errors) for trace in found)
    a, b = (trace.task_errors[:k] for trace in found)
    left = np.linalg.norm(found[0].poses[:k, :3, 3] - task.goal[:3, 3], axis=1)
    apart = np.degrees(np.abs(a - b)).max(axis=0)
    return {
        "overlap": "projective and metric model",
        "theta_r_apart_deg": float(apart[1]),
        "theta_p_apart_deg": float(apart[2]),
        "tau_apart_of_100": 100.0 * float(np.abs(a[:, 0] / a[0, 0] - b[:, 0] / b[0, 0]).max()),
        "tau_from_truth_of_100": 100.0 * float(np.abs(a[:, 0] / a[0, 0] - left / left[0]).max()),
        "tau_scale": float(a[0, 0] / b[0, 0]),
    }
