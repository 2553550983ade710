"""Tables and figures of the thesis: which experiment reproduces each, which are drawings."""

from __future__ import annotations

from typing import NamedTuple

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
"""Experiments of the thesis, in its order: what ``reproduce all`` runs."""


class ThesisItem(NamedTuple):
    """Tables or figures by ``number``, what they show, and the ``experiment`` that has them, or why none has
    (``instead``)."""

    number: str
    shows: str
    experiment: str = ""
    instead: str = ""


DRAWN = "a drawing or a photograph: nothing to measure"
CONTENTS = (
    ThesisItem("figs 1.1 to 2.16", "hand-eye coordination, cameras, frames, displacements", instead=DRAWN),
    ThesisItem("figs 3.1 to 3.4", "geometry of translations; the set-ups", instead=DRAWN),
    ThesisItem("fig. 3.5", "gripper: error over noise and number of motions", "gripper"),
    ThesisItem("fig. 3.6", "grid: single and cumulative estimates", "grid"),
    ThesisItem("fig. 3.7", "house: motion field, rectification of the grid", "house"),
    ThesisItem(
        "figs 4.1 to 4.7", "geometry of rotations; set-up, trajectories in a photograph", instead=DRAWN
    ),
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
    ThesisItem(
        "figs 6.1 to 6.7", "inverse kinematics: drawings; its solutions are counted", "inverse-kinematics"
    ),
    ThesisItem("figs 7.1 to 7.13", "tasks, Cartesian motions, visibility", instead=DRAWN),
    ThesisItem(
        "table 8.1, figs 8.1 to 8.5", "hand-eye beside base-eye, block schemas, set-points", instead=DRAWN
    ),
    ThesisItem("figs 8.6 to 8.12", "tasks A, B, C: decay, image and joint motion", "tasks-abc"),
    ThesisItem("figs 8.13 to 8.22", "the benchmark of half a turn", "benchmark-180"),
    ThesisItem("8.7, 9.3", "projective beside Euclidean modelling", "projective-vs-euclidean"),
    ThesisItem("fig. 9.1", "several, mobile cameras before one tool (further work)", "mobile-cameras"),
)
"""In the thesis's order."""
