"""Catalogue of all experiments of ``stereoservo reproduce``, by name."""

from __future__ import annotations

from pathlib import Path

from stereoservo_sim.experiments.experiment import Experiment, ExperimentError, Option, repetitions


def parse_tags(text: str) -> tuple[int, ...]:
    """Tag ids from ``0,2,3``; an empty text is no tag. Raises ExperimentError."""
    try:
        return tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise ExperimentError("option", f"--table-tags {text!r}; needed: ids by commas, like 0,2,3") from None


REAL_FRANKA_OPTIONS = (
    Option(
        "data", Path, "folder with ee_poses.csv and images", argument="directory",
        required="--data DIR, a folder with ee_poses.csv and images",
    ),
    Option("hand_tag", int, "id of the tag on the hand [default: 9]"),
    Option("table_tags", str, "ids of tags lying on the table, by commas [default: 0,2,3]", parse=parse_tags),
    Option("few_sets", int, "how many training sets of 12 poses predict the rest [default: 10]"),
)  # fmt: skip

EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for experiment in (
        Experiment(
            "real-franka",
            "a real arm before uncalibrated cameras: held-out poses predicted from recorded displacements",
            "real.real_franka",
            REAL_FRANKA_OPTIONS,
            "real.real_franka_report",
            "report_real_franka",
        ),
        Experiment(
            "gripper",
            "fig. 3.5: affine calibration from small translations of a gripper, over noise and number of motions",
            "translations.gripper",
            (repetitions(20),),
        ),
        Experiment(
            "grid",
            "fig. 3.6: affine calibration before a grid, single motions beside cumulative estimates",
            "translations.grid",
            (repetitions(20),),
        ),
        Experiment(
            "pan-tilt",
            "table 4.1, figs 4.8, 4.9: a pan-tilt head calibrates itself and predicts the image after a motion",
            "rotations.pan_tilt",
            (repetitions(20),),
        ),
        Experiment(
            "homing",
            "fig. 4.10: a pan-tilt head finds home from one point, its errors beside the Cramer-Rao bound",
            "rotations.homing",
            (repetitions(10),),
        ),
        Experiment(
            "house",
            "fig. 3.7: affine calibration from interest points of an unknown object, judged on the grid",
            "translations.house",
            (repetitions(50),),
        ),
        Experiment(
            "robot",
            "tables 5.1 to 5.4: self-calibration of a 6R arm from a turned plate; images, axes, links, intrinsics",
            "arms.robot_report",
            (repetitions(30),),
        ),
        Experiment(
            "random-rigs",
            "self-calibration from nothing on random rigs, arms, bodies and noise: how often it succeeds",
            "arms.random_rigs",
            (repetitions(12),),
        ),
        Experiment(
            "shipped-arms",
            "self-calibration of the shipped arms (panda, iiwa, xarm, scara, gantry, pan_tilt, rx90), near their bases",
            "arms.shipped_arms",
            (repetitions(5), Option("cell", str, "one of these arms alone")),
        ),
        Experiment(
            "random-lenses",
            "the random rigs behind lenses with k1, k2 and tangential terms: usable, wrong, refused by cause",
            "arms.random_lenses",
            (repetitions(12),),
        ),
        Experiment(
            "random-mechanics",
            "the random rigs with ripple, coarse encoders, play, sag or coupling: usable, refused, what ellipses hold",
            "arms.random_mechanics",
            (repetitions(10),),
        ),
        Experiment(
            "imperfect-arms",
            "goals of arms with play, sag, ripple, friction and shifted zeros: reached, and true errors of those",
            "arms.imperfect_arms",
            (
                repetitions(10),
                Option("model", str, "self (learnt by the arm) or exact (the true one, stating its errors)"),
            ),
        ),
        Experiment(
            "creeping-cameras",
            "a camera creeps by 0.5 px a minute: goals called reached beside their place, and goals held for nothing",
            "arms.creeping_cameras",
            (repetitions(10),),
        ),
        Experiment(
            "late-drives",
            "drives 100 to 200 ms late with friction, unstated: goals with the learnt model and with the true one",
            "arms.late_drives",
            (repetitions(10),),
        ),
        Experiment(
            "damped-drives",
            "thesis 9.3: drives that lag or obey late, goals with and without damping: time and overshoot",
            "arms.damped_drives",
            (repetitions(10),),
        ),
        Experiment(
            "preset-verdicts",
            "every preset of mechanics at work for ten virtual minutes: what the watch says where nothing has happened",
            "arms.preset_verdicts",
            (repetitions(1),),
        ),
        Experiment(
            "inverse-kinematics",
            "chapter 6: all solutions of every family of arms from operators alone, judged by a metric solver",
            "arms.inverse_kinematics",
            (repetitions(100),),
        ),
        Experiment(
            "tasks-abc",
            "figs 8.6 to 8.12: three alignments by image-based stereo control, projective and coarse calibration",
            "laws.tasks_abc",
            (repetitions(12),),
        ),
        Experiment(
            "benchmark-180",
            "figs 8.13 to 8.22: half a turn of a tilted face by the classical and the Cartesian laws",
            "laws.benchmark_180",
            figures="laws.benchmark_figures",
        ),
        Experiment(
            "projective-vs-euclidean",
            "thesis 9.3: the same tasks with a projective model and with metric ones of growing errors",
            "laws.projective_vs_euclidean",
            (repetitions(50),),
        ),
        Experiment(
            "unsynchronised",
            "cameras without a trigger beside the same with one: 15 ms skew, 40 ms latency, and a latency told wrongly",
            "cameras.unsynchronised",
            (repetitions(3),),
        ),
        Experiment(
            "late-pictures",
            "pictures that are later than their stamps tell: learnt in the trial motions, applied, goals with it",
            "cameras.late_pictures",
            (repetitions(10),),
        ),
        Experiment(
            "examined-recordings",
            "recordings with a bumped camera, drifted zero, late stamps, dropped frames or nothing: what examine tells",
            "cameras.examined_recordings",
            (repetitions(12),),
        ),
        Experiment(
            "mobile-cameras",
            "fig. 9.1: four cameras before one tool, two of them carried about: every pair, all, and all on the move",
            "cameras.mobile_cameras",
            (repetitions(3),),
        ),
        Experiment(
            "moving-targets",
            "targets that slide and swing, followed by cameras on the arm and before cameras that stand",
            "laws.moving_targets",
            (repetitions(3),),
        ),
        Experiment(
            "moving-faults",
            "cameras bumped, joint zeros off, markers slipped while moving targets are followed: what the watch names",
            "laws.moving_faults",
            (repetitions(3),),
        ),
        Experiment(
            "edge-parts",
            "a part without markers aligned by its edges, in rendered cells of other lights, lenses and distances",
            "laws.edge_parts",
            (repetitions(10),),
        ),
        Experiment(
            "changing-light",
            "detectors, their covariances and goals while light and exposure change: shadows, lamps, flicker, clipping",
            "pictures.changing_light",
            (repetitions(20),),
        ),
        Experiment(
            "edge-transfer",
            "goals carried over to a moved workpiece by its edges, beside the same by markers, from rendered pictures",
            "laws.edge_transfer",
            (repetitions(20),),
        ),
        Experiment(
            "singularities",
            "goals from wrist, elbow and shoulder singularities by every law: reached, refused, time-outs",
            "laws.singularities",
            (repetitions(12),),
        ),
        Experiment(
            "laws",
            "every law on three demanding tasks, and a sketch of every kind of goal: docs/goals-and-laws.md",
            "laws.laws_compared",
            figures="laws.laws_figures",
            reported_by="report_laws",
        ),
    )
}


def find_experiment(name: str) -> Experiment:
    """Experiment of that name. Raises ExperimentError, which lists the valid names."""
    if name not in EXPERIMENTS:
        known = ", ".join(sorted(EXPERIMENTS))
        raise ExperimentError(
            "experiment", f"no experiment {name!r}; known: {known}", known=sorted(EXPERIMENTS)
        )
    return EXPERIMENTS[name]
