"""Assessment of a calibration for the operator: grade, reasons and advice, for a fitted model or a failure."""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np

from stereoservo.kinematics.model import CellModel, Stratum

if TYPE_CHECKING:
    from stereoservo.calibration.calibration_result import CalibrationReport
    from stereoservo.calibration.trial_data import TrialData


Grade = Literal["good", "usable", "not usable"]

NOTABLE_NOISE = 1.1
"""Ratio of residuals to stated noise up to which a failed chi-square test is not reported."""
NOTABLE_OUTLIERS = 0.02
"""Share of rejected pixels from which it is reported."""
NOTABLE_JOINT = 1.3
"""Ratio of one joint's residual to the overall one from which it is reported."""
SHORT_DEG, SHORT_M = 5.0, 0.02
"""Trial motions [°, m] below which a large standard deviation is attributed to them."""
NOTABLE_SHARE = 0.1
"""Errors of a joint's readings, relative to the largest one in the images, from which they are reported."""
SEEN = 2.0
"""Errors of a joint's readings, in their own standard deviation, from which they are named."""
NOTABLE_DEVIATION_PX = 0.5
"""Standard deviation of predicted pixels from which it is reported."""
NOTABLE_DEPTH_DEVIATION = 0.05
"""Relative standard deviation of depths from which it is reported."""

STRATA: dict[Stratum, str] = {
    "metric": "metric: angles, ratios of lengths and the cameras' intrinsics are known; every law works",
    "affine": "affine: parallels and ratios along them are known, angles are not; image laws and goals shown to the "
    "cell work, straight lines are straight, angles of Cartesian paths are not kept",
    "projective": "projective: what the cameras see is predicted, but nothing of lengths, angles or parallels is "
    "known; image laws and goals shown to the cell work, Cartesian paths are not straight",
}
"""Meaning of a stratum for the operator."""

REMEDIES = {
    "too_few_points": "show the moved camera more markers, or static ones ([scene] static), or move the arm before it",
    "points_coplanar": "show the moved camera markers off one plane: a second face, static ones, another pose",
    "not_explained": "did markers slip, did a joint's zero or another camera move as well? Calibrate, or check, again",
    "too_uncertain": "let the moved camera see more: more markers, static ones ([scene] static), another pose",
    "bad_data": "the data are damaged or not of this cell: read the text, record again",
    "bad_file": "the file holds no cameras, or what the wished format cannot hold: read the text",
    "length": "state the distance of two markers that were seen, in metres",
    "model_does_not_fit": "the model was not refined on-line: `calibrate --check` reports what changed",
    "step_too_large": "the model was not refined on-line: `calibrate --check` reports what changed; else calibrate",
    "not_better": "the model in use stays: nothing is to be done",
    "no_covariance": "calibrate again: a refinement starts from the covariance of a calibration",
    "too_few_cameras": "connect a second camera that sees the markers at the same time",
    "too_few_markers": "show more markers to both cameras at once: at least 4 at every stop; larger or sharper dots, "
    "another calibration.base",
    "too_few_views": "take more pictures in which all of the board is seen; check its counts and dictionary",
    "too_few_stops": "raise calibration.stops, or give the joint more range: calibration.base, calibration.range",
    "joint_did_not_move": "the encoder reported no motion: is the joint's brake released, is its name the right one?",
    "joint_without_effect": "the markers did not move with this joint: do they sit behind it, does its drive turn? If "
    "it does, the motion is too small for the noise: raise calibration.range, or calibration.frames",
    "joint_kind": "correct the joint's kind in its driver's description: revolute or prismatic",
    "views_degenerate": "set the cameras apart (a baseline of a tenth of the distance at least) and show markers that "
    "do not stay in one plane: two faces, or calibration.spread for a flat plate",
    "not_identifiable": "larger motions (calibration.range), markers off one plane (a second face, "
    "calibration.spread); where the range is too small, more stops (calibration.stops) or frames at each "
    "(calibration.frames)",
    "no_convergence": "check the tracks: did a camera move, are markers mixed up, are joint positions right?",
    "too_many_outliers": "check the tracks of the joint named: reflections, mixed-up markers, another joint moving",
    "residual_above_floor": "something is not rigid or not as stated: a loose marker body, play in a joint, a moved "
    "camera, a wrong joint scale, a detector that understates its noise",
    "noise_understated": "raise the detector's sigma to the value in the text; are the images dark or blurred?",
    "joints_inexact": "check for play, a loose coupling or a damaged encoder in the joints named; larger motions "
    "(calibration.range) make such errors smaller beside them",
    "encoder_frozen": "this joint's encoder stood still while the joint moved: its cable, its supply, its driver",
    "lens_implausible": "show markers all over the images, or straight edges (--lines); larger motions, more stops",
    "wrong_scale": "correct the drive's scale: revolute joints report rad, with the gear taken into account",
    "joints_exchanged": "two joints answer under each other's names: correct the order in the joint driver's options",
    "joint_order": "list the joints base first: correct the order in the joint driver's options",
    "moved_together": "something under all the cameras, or the marker body itself, was moved during the trials: fasten "
    "it, calibrate again. Where it happens at the same stop again it is the play of a joint: take another base",
    "camera_moved": "a camera was moved during the trials: fasten it, calibrate again",
    "camera_or_body_moved": "something moved during the trials, and they do not determine what: check whether "
    "cameras, body and the arm's base are fast, calibrate again. At the same stop again it is the play of a joint; "
    "[scene] static markers distinguish a camera from the rest",
    "marker_slipped": "a marker slipped during the trials: fasten it, calibrate again",
    "markers_disagree": "run the trials again, with larger motions (calibration.range) or less noise; check whether "
    "the markers named sit on the same rigid body as the others",
    "markers_collinear": "put markers off their common line: at least one well beside it",
    "markers_exchanged": "the detector of one camera takes two markers for each other: correct its pattern or the ids",
    "views_exchanged": "images of two cameras come under each other's names at times: check their drivers and cables",
    "views_unrelated": "the cameras do not see the same thing at the same time: check which arm they see, the "
    "markers' ids, and that images are not late",
    "no_baseline": "move the cameras apart, by a tenth of their distance to the markers at least",
    "mixed_mounts": "calibrate static cameras and cameras on the tip each on their own",
    "check_holds": "leave the zeros as they are: there is nothing to reset",
    "other_cause": "remove the cause that the check names, or calibrate again: a reset of zeros would hide it",
    "not_observable": "take a calibration.base where the axes of the joints named are different lines, put the markers "
    "farther from them, or calibrate again",
}
"""Advice for each cause of a failed calibration, by the code of its CalibrationError."""


JOINT_ERRORS = (
    "Standard deviations of where the joints are beside what they report. Repeatable errors are the same whenever a "
    "joint reads the same: gear ripple, play that is driven from one side. Random ones change from stop to stop: the "
    "encoder's step, friction, play whose flank changes. Those by posture change slowly with the positions of all "
    "joints: sag under the arm's weight, a joint that turns with another. The deviations that are stated contain them"
)
"""Explanation of the errors of joint readings in the report."""


class Acceptance(msgspec.Struct, frozen=True):
    """Grade of a calibration; ``text`` in a few sentences, ``reasons`` and ``advice`` are its parts."""

    grade: Grade
    text: str
    reasons: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()


def assess_fit(model: CellModel, report: CalibrationReport, depth_deviation: float | None = None) -> Acceptance:
    """Assessment of a fitted model. ``depth_deviation``: largest relative deviation of a marker's depth, if known."""
    reasons: list[str] = []
    advice: list[str] = []
    statistics = model.statistics
    if statistics is None:
        return Acceptance("usable", "usable: the model carries no statistics", ("no statistics",))
    _residuals(model, report, reasons, advice)
    _left_out(model, report, reasons, advice)
    _errors_of_readings(report, reasons, advice)
    if report.untested:
        reasons.append(
            "joints moved one at a time from one configuration only: what sag, or joints that turn with others, do to "
            "several at once is untested"
        )
        advice.append("stops of all joints at once (calibration.together) test it; do the markers stay in view there?")
    _identified(model, report, depth_deviation, reasons, advice)
    grade: Grade = "usable" if reasons else "good"
    summary = f"residual {statistics.rms_px:.3g} px rms" + (
        ", as the measurement noise explains" if statistics.chi2_ok else ""
    )
    stratum = STRATA[model.stratum]
    text = f"{grade}: {'; '.join(reasons)}" if reasons else f"good: {summary}"
    text += f". Stratum {stratum}."
    if report.joints:
        text += f" {_joint_errors(report)}."
    if advice:
        text += " " + " ".join(f"{line[0].upper()}{line[1:]}." for line in advice)
    return Acceptance(grade, text, tuple(reasons), tuple(advice))


def assess_failure(code: str, message: str) -> Acceptance:
    """Assessment of a calibration that gave no model."""
    remedy = REMEDIES.get(code, "check the tracks in the report")
    summary = message if message.endswith((".", "?")) else f"{message}."
    return Acceptance("not usable", f"not usable: {summary} What to do: {remedy}.", (message,), (remedy,))


def _residuals(model: CellModel, report: CalibrationReport, reasons: list[str], advice: list[str]) -> None:
    statistics = model.statistics
    if statistics is None or statistics.chi2_ok:
        return
    factor = report.sigma_factor
    if factor < 1.0:
        reasons.append(
            f"residuals are only {factor:.2f} times the stated noise: the detector states too much of it, and "
            "deviations here are too large by as much"
        )
        return
    if factor <= NOTABLE_NOISE:
        return
    reasons.append(f"residuals are {factor:.2f} times the stated noise: lens, play, or positions")
    advice.append(
        "see the residual vectors in the report: a pattern over the image is the lens, one joint alone is that joint's "
        "play or encoder, all alike is a detector that understates its noise"
    )
    worst = max(statistics.joints, key=lambda joint: joint.rms_px)
    if worst.rms_px > NOTABLE_JOINT * statistics.rms_px:
        reasons.append(f"joint {worst.name} is worst with {worst.rms_px:.3g} px")


def _joint_errors(report: CalibrationReport) -> str:
    """Text on the errors of the joints' readings, the largest in the images first, if visible there."""
    seen = sorted(report.joints, key=lambda joint: joint.pixels, reverse=True)
    named = [joint for joint in seen if joint.pixels > NOTABLE_SHARE * seen[0].pixels]
    parts = []
    for joint in named:
        unit = "mrad" if joint.kind == "revolute" else "mm"
        found = [
            f"{what} {1e3 * value:.2g} ± {1e3 * deviation:.1g} {unit}"
            for what, value, deviation in (
                ("repeatable", joint.repeatable, joint.repeatable_std),
                ("random", joint.random, joint.random_std),
                ("by posture", joint.posture, joint.posture_std),
            )
            if value > SEEN * deviation
        ]
        both = float(np.linalg.norm([joint.repeatable, joint.random, joint.posture]))
        text = ", ".join(found) if found else f"in all {1e3 * both:.2g} {unit}"
        parts.append(f"joint {joint.name} {text} ({joint.pixels:.2g} px)")
    have = "may have" if report.exact_joints_chance else "have"
    return f"Joint readings {have} errors, as standard deviations: {'; '.join(parts)}"


def _errors_of_readings(report: CalibrationReport, reasons: list[str], advice: list[str]) -> None:
    if report.exact_joints_chance:
        reasons.append(
            "joint readings are likely to have errors, which the trials do not prove (exact ones show as much in "
            f"{report.exact_joints_chance:.1g} of the fits at most); stated deviations contain them"
        )
        advice.append(
            "more stops (calibration.stops) or frames at each (calibration.frames) show whether the joints have errors"
        )
        return
    giving = [joint.name for joint in report.joints if joint.posture > SEEN * joint.posture_std]
    if giving:
        reasons.append(
            f"joint {', '.join(giving)} is off by an amount that changes with the posture: how much where several "
            "joints are away from the base, the trials show in part only"
        )


def _left_out(model: CellModel, report: CalibrationReport, reasons: list[str], advice: list[str]) -> None:
    statistics = model.statistics
    if statistics is None:
        return
    pixels = statistics.measurements / 2 + statistics.outliers
    share = statistics.outliers / max(pixels, 1.0)
    if share > NOTABLE_OUTLIERS:
        reasons.append(f"{share:.0%} of the pixels do not fit and were left out")
        advice.append("check the tracks in the report for reflections and mixed-up markers")
    if report.markers_left_out:
        markers = ", ".join(str(marker) for marker in report.markers_left_out)
        reasons.append(f"marker {markers} was seen by two cameras too rarely and is not in the model")


def _identified(
    model: CellModel, report: CalibrationReport, depth: float | None, reasons: list[str], advice: list[str]
) -> None:
    statistics = model.statistics
    if statistics is None:
        return
    loose = depth is not None and depth > NOTABLE_DEPTH_DEVIATION
    if depth is not None and loose:
        reasons.append(f"depths are known to {depth:.0%} only")
    if report.prediction_max_px > NOTABLE_DEVIATION_PX:
        reasons.append(f"predicted pixels are known to {report.prediction_max_px:.2g} px at worst only")
        loose = True
    if model.stratum != "metric":
        reasons.append(f"the data identify the {model.stratum} stratum only")
        why = [note for note in report.notes if "refused" in note]
        if why:
            # The last attempt at the required stratum is nearest to the truth.
            missing = why[0].split()[0]
            reasons.append([note for note in why if note.startswith(missing)][-1])
    if not loose and model.stratum == "metric":
        return
    short = False
    for joint, kind in zip(statistics.joints, model.joint_kinds, strict=True):
        small = np.degrees(joint.range) < SHORT_DEG if kind == "revolute" else joint.range < SHORT_M
        if small:
            moved = f"{np.degrees(joint.range):.1f}°" if kind == "revolute" else f"{joint.range:.3f} m"
            reasons.append(f"joint {joint.name} moved {moved} only")
            advice.append(f"raise calibration.range.{joint.name}")
            short = True
    if short:
        ratio = 1.0 if depth is None else depth / NOTABLE_DEPTH_DEVIATION
        times = f", {ceil(ratio**2)} times as many in all," if ratio > 1.0 else ""
        advice.append(
            f"where the range is too small, more stops (calibration.stops) or frames at each "
            f"(calibration.frames){times} do the same"
        )
    if not advice and loose:
        advice.append("larger trial motions, markers larger in the image or more stops make it better")


def depth_deviation(model: CellModel, trials: TrialData) -> float | None:
    """Largest relative standard deviation of a marker's depth in the left camera; None in the projective stratum.

    From the curvature of the fit at the model, over the trials' own stops and sigmas.
    """
    from stereoservo.calibration.change.model_changes import known_measurements
    from stereoservo.calibration.least_squares import column_root
    from stereoservo.calibration.normal_equations import triangle_of
    from stereoservo.calibration.rig_model import acting_order, acting_rig, full_charts

    if model.stratum == "projective":
        return None
    rig, order = acting_rig(model), acting_order(model)
    data = known_measurements(model, trials, order)
    charts = full_charts(rig, model.stratum)
    triangle = triangle_of(rig, charts, data)[:-1, :-1]
    if not triangle.any(axis=0).all():
        return None
    root = column_root(triangle, bounded=True)
    at = charts.start(3)
    depths = rig.points @ rig.cameras[0][2]
    deviations = []
    for i, basis in enumerate(charts.points):
        rows = basis @ rig.cameras[0][2] @ root[at + 3 * i : at + 3 * i + 3]
        deviations.append(float(np.linalg.norm(rows)) / abs(float(depths[i])))
    return max(deviations)
