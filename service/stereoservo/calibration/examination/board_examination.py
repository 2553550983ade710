"""Examination of pictures of a known board at reported poses of an arm: what was fitted, with deviations, how well
left-out poses are predicted, and the mistakes found in poses, pictures and board.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import msgspec
import numpy as np
from scipy.stats import norm

from stereoservo.calibration.examination.hand_eye_fit import (
    DEGREE,
    FALSE_ALARM,
    INTRINSICS,
    BoardViews,
    HandEye,
    HandEyeFit,
    fit_board,
    motion_vector,
    predicted_errors,
)
from stereoservo.calibration.examination.hand_eye_start import (
    LEAST_ODDS,
    LEAST_TURN_DEG,
    LEAST_VIEWS,
    Explained,
    board_poses,
    explanations,
    half_turn,
    log_odds,
    rotations_of,
)
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import FloatArray

SIZE_TOLERANCE = 0.02
"""Relative error of a printed and measured square up to which its size is not reported as wrong: a ruler's."""
LEAST_BOARD_DEG = 5.0
"""Rotation of the board in the pictures below which they do not distinguish readings of the poses' rotations."""
SAME_POSE = 1e-5
"""Largest difference [rad, m] of reported poses that are the same: below the resolution of every arm."""
PLACES = {"eye_in_hand": "in the hand", "eye_to_hand": "static"}


class Finding(msgspec.Struct, frozen=True):
    """Something found in a recording: its ``kind``, the view or quantity concerned, a sentence and a ``remedy``;
    ``value`` with ``deviation`` and ``limit`` [``unit``]; ``or_else``: what the data do not distinguish from it.
    """

    kind: str
    subject: str
    message: str
    remedy: str
    value: float | None = None
    deviation: float | None = None
    limit: float | None = None
    unit: str = ""
    or_else: str = ""


class Transform(msgspec.Struct, frozen=True):
    """A rigid transform: rotation vector [deg] and translation [mm] with their standard deviations."""

    rotation_deg: tuple[float, ...]
    translation_mm: tuple[float, ...]
    rotation_deviation_deg: tuple[float, ...]
    translation_deviation_mm: tuple[float, ...]


class BoardReport(msgspec.Struct, frozen=True):
    """Result of an examination. ``mount`` with ``mount_odds``, the logarithm of its odds against the other one.

    ``camera``: in the hand, or in the base if it is static; ``board``: in the base, or in the hand. ``intrinsics`` by
    name with deviations. Deviations of single views: ``corner_px``, ``smooth_px`` (errors that are smooth over the
    board, rms), ``pose_deg``, ``pose_mm``. ``held_out_px``: rms error of the predicted pixels of every second
    view by a fit of the others, and the reverse, without the views that are left out by name.
    """

    mount: Mount | None
    mount_odds: float | None
    views: int
    used: int
    camera: Transform | None
    board: Transform | None
    intrinsics: dict[str, tuple[float, float]]
    scale: tuple[float, float] | None
    corner_px: float | None
    smooth_px: float | None
    pose_deg: float | None
    pose_mm: float | None
    held_out_px: tuple[float, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    false_alarm: float = FALSE_ALARM


def examine_board(
    views: BoardViews, stated: Mount | None = None, ordered: bool = False, held_out: bool = True
) -> BoardReport:
    """The report on views of a board; ``stated``: mount of the camera by its owner. ``ordered``: whether the
    identity of the corners is certain, as with a tag or a board of odd and even counts. ``held_out``: whether
    halves of the views are learnt to predict the others. Raises CalibrationError (``too_few_views``).
    """
    board = board_poses(views, 0)
    seen = int(np.isfinite(board.poses[:, 0, 0, 0]).sum())
    if seen < LEAST_VIEWS:
        raise CalibrationError(
            "too_few_views",
            f"the board is found in {seen} of {len(views.names)} pictures; {LEAST_VIEWS} are needed: check the "
            f"counts of "
            "its corners, its dictionary, and that all of it is in the picture",
            value=seen,
            limit=LEAST_VIEWS,
        )
    findings = _same_poses(views)
    found = explanations(board, views.poses, turns=True)
    given = next(one for one in found if one.reading.kind == "as_given")
    turning = rotations_of(board.poses[given.rows, given.choice]).extent_deg[0] > LEAST_BOARD_DEG
    best = found[0] if turning and log_odds(found[0], given) > LEAST_ODDS else given
    if best is not given:
        findings.append(_of_reading(best, given, found))
    other = next(one for one in found if one.reading is best.reading and one.mount != best.mount)
    odds = log_odds(best, other)
    turns = rotations_of(best.poses)
    travel = float(np.linalg.norm(np.ptp(best.poses[:, :3, 3], axis=0)))
    if turns.extent_deg[1] < LEAST_TURN_DEG:
        findings.append(_little_rotation(turns.extent_deg, turns.main_axis))
    findings += _of_mount(best.mount, stated, odds)
    used, flipped = _ordered_views(views, best)
    if flipped:
        findings += _half_turns(flipped, ordered)
    if any(one.kind == "translations_only" for one in findings):
        return _report(views, best, odds, None, findings)
    fit = fit_board(used, best.mount, _start(best, board.matrix))
    if not fit.converged:
        findings.append(
            Finding(
                "not_fitted",
                "",
                f"the fit did not converge; the poses explain the board to "
                f"{1e3 * np.median(best.form.shifts):.3g}"
                f" mm and {np.degrees(np.median(best.form.turns)):.3g} deg (median)",
                "see the other findings first; else take twenty views that turn the hand about two axes",
            )
        )
        return _report(views, best, odds, None, findings)
    findings += _of_scale(fit) + _of_views(fit)
    findings += _undetermined(fit, travel)
    report = _report(views, best, odds, fit, findings)
    return msgspec.structs.replace(report, held_out_px=held_out_px(fit)) if held_out else report


def _start(best: Explained, matrix: FloatArray) -> HandEye:
    intrinsics = np.array([[matrix[0, 0], 1.0, matrix[0, 2], matrix[1, 2], *np.zeros(5)]])
    scale = float(np.log(best.form.scale)) if best.form.scale > 0.0 else 0.0
    return HandEye(intrinsics, best.form.A[None], best.form.C, scale, np.tile(np.eye(4), (len(best.rows), 1, 1)))


def _ordered_views(views: BoardViews, best: Explained) -> tuple[BoardViews, list[str]]:
    """The views of an explanation with its poses, corners in one order, and the names of those that were turned."""
    used = replace(
        views,
        names=tuple(views.names[k] for k in best.rows),
        poses=best.poses,
        pixels=views.pixels[:, best.rows].copy(),
    )
    order = half_turn(views.layout)[1]
    turned = np.flatnonzero(best.choice >= 2)
    if order is not None:
        used.pixels[:, turned] = used.pixels[:, turned][:, :, order]
    return used, [used.names[k] for k in turned]


def _same_poses(views: BoardViews) -> list[Finding]:
    pairs = [
        (views.names[i], views.names[j])
        for i, j in combinations(range(len(views.names)), 2)
        if np.abs(views.poses[i] - views.poses[j]).max() < SAME_POSE
    ]
    if not pairs:
        return []
    text = ", ".join(f"{one} and {other}" for one, other in pairs[:5]) + (", …" if len(pairs) > 5 else "")
    return [
        Finding(
            "same_pose",
            pairs[0][1],
            f"the same pose stands at views {text}",
            "if the arm had moved between the pictures, the pose was read before it arrived: read it at rest; if "
            "not, one of "
            "the two views adds nothing",
            len(pairs),
        )
    ]


def _of_reading(best: Explained, given: Explained, found: list[Explained]) -> Finding:
    alike = [
        one.reading.sentence
        for one in found
        if one.reading not in (best.reading, given.reading) and log_odds(best, one) < LEAST_ODDS
    ]
    either = (
        f"either {best.reading.sentence}, or {' or '.join(dict.fromkeys(alike))}" if alike else best.reading.sentence
    )
    odds = log_odds(best, given)
    return Finding(
        best.reading.kind,
        "",
        f"{either}: so read, the poses explain those of the board to {_rest(best)} (median), as given to "
        f"{_rest(given)}",
        best.reading.remedy,
        odds,
        None,
        LEAST_ODDS,
        "log-odds",
        "; ".join(dict.fromkeys(alike)),
    )


def _rest(one: Explained) -> str:
    return f"{np.degrees(np.median(one.form.turns)):.2g} deg and {1e3 * np.median(one.form.shifts):.2g} mm"


def _little_rotation(extent: FloatArray, axis: str) -> Finding:
    kind, text = "little_rotation", f"about {axis} by {extent[0]:.0f} deg, about a second axis by {extent[1]:.0f} deg"
    if extent[0] < 1.0:
        kind, text = "translations_only", "nowhere by more than 1 deg: the hand only translates"
    elif extent[1] < 2.0:
        kind, text = "one_axis", f"about one axis only ({axis}, {extent[0]:.0f} deg)"
    return Finding(
        kind,
        "",
        f"the hand turns {text}; the translation of the hand-eye transform needs {LEAST_TURN_DEG:.0f} "
        f"deg about two axes",
        f"turn the hand by {LEAST_TURN_DEG:.0f} deg or more about two axes; further views like these do not help",
        float(extent[1]),
        None,
        LEAST_TURN_DEG,
        "deg",
    )


def _of_mount(mount: Mount, stated: Mount | None, odds: float) -> list[Finding]:
    if stated is None or stated == mount or odds < LEAST_ODDS:
        return []
    return [
        Finding(
            "mount",
            "",
            f"the camera is stated as {PLACES[stated]}; the pictures fit only one that is "
            f"{PLACES[mount]} (log-odds {odds:.0f}), or else the poses are inverted, of the base in the hand: the data "
            "do not distinguish the two",
            "correct the mount, or invert the poses",
            odds,
            None,
            LEAST_ODDS,
            "",
            "inverted_poses",
        )
    ]


def _half_turns(flipped: list[str], ordered: bool) -> list[Finding]:
    text = (
        f"views {', '.join(flipped)}: the corners are counted from the other end of the board than in the other views"
    )
    if ordered:
        text += ", though its pattern tells the ends apart: the board was turned by half a turn, or the corners "
        "are mistaken"
    else:
        text += "; the board looks alike after half a turn, and the poses decide which it is"
    remedy = (
        "use a board with an odd and an even count of corners, or a ChArUco board"
        if not ordered
        else ("leave these views out, or take them again")
    )
    return [Finding("half_turn", ",".join(flipped), text, remedy, len(flipped))]


def _of_scale(fit: HandEyeFit) -> list[Finding]:
    if not fit.problem.scaled:
        return []
    scale, deviation = np.exp(fit.state.scale), np.exp(fit.state.scale) * fit.deviations[-1]
    if abs(scale - 1.0) < SIZE_TOLERANCE:
        return []
    for factor in (1e3, 1e-3):
        if abs(np.log(scale / factor)) < np.log(2.0):
            arm, board = ("millimetres", "metres") if factor > 1.0 else ("metres", "millimetres")
            text = (
                f"the arm's positions are {scale:.4g} ± {deviation:.2g} times the board's lengths: either the "
                f"poses are in "
                f"{arm}, or the board's size is in {board} and was read as the other unit"
            )
            return [
                Finding(
                    "unit",
                    "",
                    text,
                    "state poses and sizes in metres",
                    float(scale),
                    float(deviation),
                    1.0,
                    "",
                    "square",
                )
            ]
    layout = fit.problem.views.layout
    side = 1e3 * float(np.linalg.norm(layout[1] - layout[0]))
    return [
        Finding(
            "square",
            "",
            f"the board's square (or tag) is {scale * side:.4g} ± {deviation * side:.2g} mm by the "
            f"arm's metres, not "
            f"{side:.4g} mm",
            f"measure it, over several squares, and state {scale * side:.4g} mm if that is so",
            float(scale * side),
            float(deviation * side),
            side,
            "mm",
        )
    ]


def _of_views(fit: HandEyeFit) -> list[Finding]:
    """Views whose pose does not fit the others, and views with blurred corners."""
    problem, found = fit.problem, []
    errors = np.sqrt(np.nanmean((predicted_errors(fit, problem.views) ** 2).sum(axis=-1), axis=(0, 2)))
    usual = float(np.median(errors[problem.trusted]))
    for k in np.flatnonzero(~problem.trusted):
        found.append(
            Finding(
                "view",
                problem.views.names[k],
                f"view {problem.views.names[k]} does not fit: {errors[k]:.3g} px, "
                f"the others {usual:.3g} "
                "px (median); it is left out",
                "was the arm still moving, or the pose of another picture? Take it again",
                float(errors[k]),
                None,
                usual,
                "px",
            )
        )
    logs = np.log(problem.blur)
    spread = 1.4826 * float(np.median(np.abs(logs - np.median(logs)))) + 0.05
    limit = float(norm.isf(FALSE_ALARM / len(logs)))
    for k in np.flatnonzero((logs - np.median(logs)) / spread > limit):
        found.append(
            Finding(
                "blurred",
                problem.views.names[k],
                f"view {problem.views.names[k]}: its corners are uncertain by "
                f"{problem.noise[0] * problem.blur[k]:.2g} px, those of the others by {problem.noise[0]:.2g} px "
                f"(blurred, overexposed, or "
                "drawn over); it counts less",
                "take it again, sharp and without drawings",
                float(problem.noise[0] * problem.blur[k]),
                None,
                float(problem.noise[0] * np.exp(limit * spread)),
                "px",
            )
        )
    return found


def _undetermined(fit: HandEyeFit, travel: float) -> list[Finding]:
    q = len(fit.problem.free)
    deviation = np.sqrt(np.linalg.eigvalsh(fit.covariance[q + 3 : q + 6, q + 3 : q + 6])[-1])
    if deviation < travel:
        return []
    return [
        Finding(
            "undetermined",
            "",
            f"the camera's place is not determined along one direction: {1e3 * deviation:.3g} "
            f"mm, the hand moved by "
            f"{1e3 * travel:.3g} mm in all; intrinsics, errors and predictions hold all the same",
            f"turn the hand by {LEAST_TURN_DEG:.0f} deg or more about two axes",
            1e3 * float(deviation),
            None,
            1e3 * travel,
            "mm",
        )
    ]


def _report(
    views: BoardViews, best: Explained, odds: float, fit: HandEyeFit | None, findings: list[Finding]
) -> BoardReport:
    notes = []
    missing = [views.names[k] for k in range(len(views.names)) if k not in best.rows]
    if missing:
        notes.append(f"views without a board: {', '.join(missing)}")
    if odds < LEAST_ODDS:
        notes.append(f"the mount is not certain: log-odds {odds:.1f}, {LEAST_ODDS:.1f} are needed")
    if fit is None:
        return BoardReport(
            best.mount,
            odds,
            len(views.names),
            0,
            None,
            None,
            {},
            None,
            None,
            None,
            None,
            None,
            (),
            tuple(findings),
            tuple(notes),
        )
    q, problem, state = len(fit.problem.free), fit.problem, fit.state
    deviations = fit.deviations
    scale = float(np.exp(state.scale))
    count = (DEGREE + 1) * (DEGREE + 2) // 2
    own = np.sqrt(count / max(len(views.layout), count)) * problem.noise[1]
    return BoardReport(
        best.mount,
        odds,
        len(views.names),
        int(problem.trusted.sum()),
        _transform(np.linalg.inv(state.A[0]), deviations[q : q + 6]),
        _transform(state.C, deviations[q + 6 : q + 12]),
        {INTRINSICS[k]: (float(state.intrinsics[0, k]), float(deviations[i])) for i, k in enumerate(problem.free)},
        (scale, scale * float(deviations[-1]) if problem.scaled else 0.0),
        float(problem.noise[0]),
        float(own),
        0.0 if problem.exact else float(np.degrees(problem.noise[2])),
        0.0 if problem.exact else 1e3 * float(problem.noise[3]),
        (),
        tuple(findings),
        tuple(notes),
    )


def _transform(T: FloatArray, deviations: FloatArray) -> Transform:
    vector = motion_vector(T)
    return Transform(
        tuple(np.degrees(vector[:3]).tolist()),
        tuple((1e3 * vector[3:]).tolist()),
        tuple(np.degrees(deviations[:3]).tolist()),
        tuple((1e3 * deviations[3:]).tolist()),
    )


def held_out_px(fit: HandEyeFit) -> tuple[float, ...]:
    """Error [px rms] of predicted views, every second one learnt alone, and the reverse; trusted views only."""
    views, trusted = fit.problem.views, fit.problem.trusted
    found = []
    for half in (0, 1):
        learnt = (np.arange(len(views.names)) % 2 == half) & trusted
        left = (np.arange(len(views.names)) % 2 != half) & trusted
        if min(learnt.sum(), left.sum()) < LEAST_VIEWS:
            return ()
        again = fit_board(views.select(learnt), fit.problem.mount, replace(fit.state, errors=fit.state.errors[learnt]))
        errors = predicted_errors(again, views.select(left))
        found.append(float(np.sqrt(2.0 * np.nanmean(errors**2))))
    return tuple(found)
