"""Catalogue of all experiments of ``stereoservo reproduce``, by name, and the tables and figures of the thesis: which
experiment reproduces each, which are drawings.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from stereoservo_sim.experiments.experiment import Experiment, ExperimentError, Option

REPRODUCED = (
    "gripper",
    "grid",
    "house",
    "pan-tilt",
    "homing",
    "robot",
    "inverse-kinematics",
    "tasks-abc",
    "benchmark-180",
    "projective-vs-euclidean",
    "mobile-cameras",
)
"""Experiments of the thesis, in its order, which ``reproduce all`` runs."""


class ThesisItem(NamedTuple):
    """Tables or figures by ``number``, their content, and the ``experiment`` that reproduces them, or the reason for
    none (``instead``).
    """

    number: str
    shows: str
    experiment: str = ""
    instead: str = ""


DRAWN = "a drawing or a photograph: nothing to measure"
DERIVED = "derived in the thesis, which measures nothing of it; not compared here"
CONTENTS = (
    ThesisItem("figs 1.1 to 2.16", "hand-eye coordination, cameras, frames, displacements", instead=DRAWN),
    ThesisItem("figs 3.1 to 3.4", "geometry of translations; the set-ups", instead=DRAWN),
    ThesisItem("fig. 3.5", "gripper: error over noise and number of motions", "gripper"),
    ThesisItem("fig. 3.6", "grid: single and cumulative estimates", "grid"),
    ThesisItem("fig. 3.7", "house: motion field, rectification of the grid", "house"),
    ThesisItem("figs 4.1 to 4.6", "geometry of rotations; set-up", instead=DRAWN),
    ThesisItem("fig. 4.7", "backprojected and extracted points, of which table 4.1 is the summary", "pan-tilt"),
    ThesisItem("table 4.1", "image errors in calibration and prediction", "pan-tilt"),
    ThesisItem("fig. 4.8", "histograms of the calibration errors", "pan-tilt"),
    ThesisItem("fig. 4.9", "feed-forward prediction over 35 trials", "pan-tilt"),
    ThesisItem("fig. 4.10", "homing by one point over 35 trials", "homing"),
    ThesisItem("figs 5.1 to 5.13", "kinematics, joint operators, trial motions", instead=DRAWN),
    ThesisItem("figs 5.14, 5.15", "distribution and tracks of the markers in the images", "robot"),
    ThesisItem("fig. 5.16", "16 points from four positions of the plate", instead=DRAWN),
    ThesisItem("table 5.1", "image errors with fixed and free points", "robot"),
    ThesisItem("table 5.2", "intrinsic parameters", "robot"),
    ThesisItem("table 5.3", "angles between axes", "robot"),
    ThesisItem("table 5.4", "link lengths", "robot"),
    ThesisItem("figs 6.1 to 6.7", "inverse kinematics, derived", "inverse-kinematics"),
    ThesisItem("6.8", "refinement of the algebraic solution on image points", instead=DERIVED),
    ThesisItem("figs 7.1 to 7.13", "tasks, Cartesian motions, visibility", instead=f"{DERIVED}; its paths: fig. 8.15"),
    ThesisItem("table 8.1, figs 8.1 to 8.4", "hand-eye beside base-eye, block schemas, set-points", instead=DRAWN),
    ThesisItem(
        "fig. 8.5", "set-points reprojected into other images", instead="an experiment that is not repeated here"
    ),
    ThesisItem("figs 8.6 to 8.12", "tasks A, B, C: decay, image and joint motion", "tasks-abc"),
    ThesisItem("figs 8.13 to 8.22", "the benchmark of half a turn", "benchmark-180"),
    ThesisItem("8.7, 9.3", "projective beside Euclidean modelling", "projective-vs-euclidean"),
    ThesisItem("fig. 9.1", "several, mobile cameras before one tool (further work)", "mobile-cameras"),
)
"""Tables and figures in the thesis's order."""


def parse_tags(text: str) -> tuple[int, ...]:
    """Tag ids from ``0,2,3``; an empty text is no tag. Raises ExperimentError."""
    try:
        return tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise ExperimentError("option", f"--table-tags {text!r}; needed: ids by commas, like 0,2,3") from None


REAL_FRANKA = (
    Option(
        "data",
        Path,
        "folder with ee_poses.csv and images",
        argument="directory",
        required="--data DIR, a folder with ee_poses.csv and images",
    ),
    Option("hand_tag", int, "id of the tag on the hand [default: 9]"),
    Option("table_tags", str, "ids of tags lying on the table, by commas [default: 0,2,3]", parse=parse_tags),
    Option("few_sets", int, "how many training sets of 12 poses predict the rest [default: 10]"),
)

DECLARED = (
    Experiment("real-franka", 0, "real_franka",
        "a real arm before uncalibrated cameras: held-out poses predicted from recorded displacements",
        own=REAL_FRANKA),
    Experiment("gripper", 20, "gripper",
        "fig. 3.5: affine calibration from small translations of a gripper, over noise and number of motions"),
    Experiment("grid", 20, "grid",
        "fig. 3.6: affine calibration before a grid, single motions beside cumulative estimates"),
    Experiment("pan-tilt", 20, "pan_tilt",
        "table 4.1, figs 4.8, 4.9: a pan-tilt head calibrates itself and predicts the image after a motion"),
    Experiment("homing", 10, "homing",
        "fig. 4.10: a pan-tilt head finds home from one point, its errors beside the Cramer-Rao bound"),
    Experiment("house", 50, "grid",
        "fig. 3.7: affine calibration from interest points of an unknown object, judged on the grid"),
    Experiment("robot", 30, "robot",
        "tables 5.1 to 5.4: self-calibration of a 6R arm from a turned plate; images, axes, links, intrinsics"),
    Experiment("random-rigs", 12, "random_rigs",
        "self-calibration from nothing on random rigs, arms, bodies and noise: how often it succeeds"),
    Experiment("shipped-arms", 5, "random_rigs",
        "self-calibration of the shipped arms (panda, iiwa, xarm, scara, gantry, pan_tilt, rx90), near their bases",
        own=(Option("cell", str, "one of these arms alone"),)),
    Experiment("random-lenses", 12, "random_rigs",
        "the random rigs behind lenses with k1, k2 and tangential terms: usable, wrong, refused by cause"),
    Experiment("random-mechanics", 10, "random_rigs",
        "the random rigs with ripple, coarse encoders, play, sag or coupling: usable, refused, what ellipses hold"),
    Experiment("imperfect-arms", 10, "imperfect_arms",
        "goals of arms with play, sag, ripple, friction and shifted zeros: reached, and true errors of those",
        own=(Option("model", str, "self (learnt by the arm) or exact (the true one, stating its errors)"),),
        timed=True),
    Experiment("creeping-cameras", 10, "imperfect_arms",
        "a camera creeps by 0.5 px a minute: goals called reached beside their place, and goals held for nothing"),
    Experiment("late-drives", 10, "late_drives",
        "drives 100 to 200 ms late with friction, unstated: goals with the learnt model and with the true one",
        timed=True),
    Experiment("damped-drives", 10, "late_drives",
        "thesis 9.3: drives that lag or obey late, goals with and without damping: time and overshoot",
        timed=True),
    Experiment("preset-verdicts", 1, "imperfect_arms",
        "every preset of mechanics at work for ten virtual minutes: what the watch says where nothing has happened",
        timed=True),
    Experiment("inverse-kinematics", 100, "inverse_kinematics",
        "chapter 6, and three families beside it: all solutions from operators alone, judged by a metric solver"),
    Experiment("tasks-abc", 12, "tasks_abc",
        "figs 8.6 to 8.12: three alignments by image-based stereo control, projective and coarse calibration"),
    Experiment("benchmark-180", 0, "benchmark_180",
        "figs 8.13 to 8.22: half a turn of a tilted face by the classical and the Cartesian laws"),
    Experiment("projective-vs-euclidean", 50, "projective_vs_euclidean",
        "thesis 9.3: the same tasks with a projective model and with metric ones of growing errors"),
    Experiment("unsynchronised", 3, "unsynchronised",
        "cameras without a trigger beside the same with one: 15 ms skew, 40 ms latency, and a latency told wrongly"),
    Experiment("late-pictures", 10, "late_drives",
        "pictures that are later than their stamps tell: learnt in the trial motions, applied, goals with it",
        timed=True),
    Experiment("examined-recordings", 12, "examined_recordings",
        "recordings with a bumped camera, drifted zero, late stamps, dropped frames or nothing: what examine tells"),
    Experiment("mobile-cameras", 3, "mobile_cameras",
        "fig. 9.1: four cameras before one tool, two of them carried about: every pair, all, and all on the move"),
    Experiment("moving-targets", 3, "moving_targets",
        "targets that slide and swing, followed by cameras on the arm and before cameras that stand"),
    Experiment("moving-faults", 3, "moving_targets",
        "cameras bumped, joint zeros off, markers slipped while moving targets are followed: what the watch names"),
    Experiment("edge-parts", 10, "edge_parts",
        "a part without markers aligned by its edges, in rendered cells of other lights, lenses and distances"),
    Experiment("changing-light", 20, "changing_light",
        "detectors, their covariances and goals while light and exposure change: shadows, lamps, flicker, clipping"),
    Experiment("edge-transfer", 20, "edge_parts",
        "goals carried over to a moved workpiece by its edges, beside the same by markers, from rendered pictures"),
    Experiment("singularities", 12, "singularities",
        "goals from wrist, elbow and shoulder singularities by every law: reached, refused, time-outs",
        timed=True),
    Experiment("laws", 0, "laws_compared",
        "every law on three demanding tasks, and a sketch of every kind of goal: docs/goals-and-laws.md"),
)  # fmt: skip
EXPERIMENTS = {experiment.name: experiment for experiment in DECLARED}
"""Experiments by name."""


def find_experiment(name: str) -> Experiment:
    """Experiment of that name. Raises ExperimentError, which lists the valid names."""
    if name not in EXPERIMENTS:
        known = ", ".join(sorted(EXPERIMENTS))
        raise ExperimentError("experiment", f"no experiment {name!r}; known: {known}", known=sorted(EXPERIMENTS))
    return EXPERIMENTS[name]
