"""Experiments: success rate of self-calibration, and correctness of its reported accuracy, on random rigs, arms, bodies
and noise (``random-rigs``), with lens distortion (``random-lenses``), of imperfect arms (``random-mechanics``), and
of the shipped arms before their cells' cameras (``shipped-arms``).

Each case is evaluated against the ground truth, which the calibration does not use. *Success*: a model whose
prediction errors of held-out configurations agree with its own covariance, and whose stated focal lengths and principal
point are true within their standard deviations. *Failure*: a CalibrationError. *Wrong*: a model that fails this test. A
range of seeds is continued by another: ``--seed 100 --seeds 100`` are the cases after ``--seeds 100``.

Lenses are those of `world.random_cells.random_lenses`: radial terms k1 -0.4 to 0.1 and k2 -0.05 to 0.2, tangential ones
up to 0.001. Mechanics have noise of 0.01 to 0.5 px and one mechanism each, all joints alike: gear ripple of 0.02 to
1 mrad, encoders of 4096 counts a turn, play up to 1.5°, sag up to 2.5°, a wrist coupled by up to 5 %. Of a shipped arm
a seed draws the configuration, near the cell's base, the noise and the number of stops; each joint moves as far as both
images allow.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal

import msgspec
import numpy as np
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import norm

from stereoservo.calibration.bundle_adjustment import jacobian
from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.diagnosis.input_corrections import solution_of
from stereoservo.calibration.fit_assessment import assess_fit
from stereoservo.calibration.rig_model import Measurements, residuals, reversed_trials, with_joints_reversed
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.core.sources.calibration import combined_offsets, in_view_at, stop_offset
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.kinematics.model import CellModel, pinhole
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_drivers.twist import TwistJointDriver, seen_as_joints
from stereoservo_sim.cells import ARMS, shipped_cell_path
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.experiments.experiment import ExperimentError, cases, crossed
from stereoservo_sim.experiments.figures import Figures, picture, stacked_bars
from stereoservo_sim.progress import ProgressCall, silent
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world.camera_rig import inverse_pose
from stereoservo_sim.world.mechanical_trials import links_and_readings, mechanical_trials
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.random_cells import (
    BODIES,
    MIN_SHOWN,
    NOISES,
    STOPS,
    RandomCase,
    hidden_out_of_view,
    random_case,
    random_lens_case,
    visible_ranges,
)
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.synthetic import FIRST_MARKER, SyntheticCell

Outcome = Literal["success", "failure", "wrong"]

TAIL = 1e-6
"""Probability that a true model is called wrong, for each of the two tests."""


PROMISED = 0.995
"""Required share of successes."""


class Verdict(msgspec.Struct, frozen=True):
    """Outcome of a case.

    ``error_ratio``: squared errors of held-out pixels over those that the model's covariance states; with
    ``freedom`` effective degrees of freedom it must not exceed ``limit``. ``intrinsics_sigmas``: largest error of the
    left camera's intrinsics in stated deviations (0 below the metric stratum).
    """

    seed: int
    outcome: Outcome
    arm: str
    body: str
    sigma_px: float
    stratum: str = ""
    code: str = ""
    message: str = ""
    error_ratio: float = 0.0
    freedom: float = 0.0
    limit: float = 0.0
    rms_px: float = 0.0
    intrinsics_sigmas: float = 0.0
    seconds: float = 0.0


def judged_case(case: RandomCase) -> Verdict:
    """Outcome of a case, calibrated without prior knowledge."""
    trials = case.trials()
    about: dict[str, Any] = {"seed": case.seed, "arm": case.arm, "body": case.body, "sigma_px": case.sigma}
    begin = time.process_time()
    try:
        result = fit_model(trials, epoch=1)
    except CalibrationError as error:
        about["seconds"] = time.process_time() - begin
        return Verdict(outcome="failure", code=error.code, message=error.message, **about)
    about["seconds"] = time.process_time() - begin
    ratio, freedom, rms = held_out_ratio(case, trials, result)
    limit = float(chi2_distribution.isf(TAIL, freedom)) / freedom
    intrinsics = intrinsics_sigmas(case, result)
    true = ratio <= limit and intrinsics <= float(norm.isf(0.5 * TAIL))
    return Verdict(
        outcome="success" if true else "wrong", stratum=result.model.stratum, error_ratio=ratio, freedom=freedom,
        limit=limit, rms_px=rms, intrinsics_sigmas=intrinsics, **about,
    )  # fmt: skip


def held_out_ratio(case: RandomCase, trials: TrialData, result: CalibrationFit) -> tuple[float, float, float]:
    """Squared errors of held-out pixels over their stated sum, its effective degrees of freedom, the rms error [px].

    With the errors ``L z``, ``z`` standard normal, the sum of squares has mean ``tr LᵀL`` and is approximated by a
    chi-square of ``(tr LᵀL)² / tr (LᵀL)²`` degrees of freedom of the same mean (Satterthwaite). With cameras on the arm
    its joints are counted from the cameras.
    """
    positions = order = case.held_out()
    if case.cell.mount == "eye_in_hand":
        trials, order = reversed_trials(trials), positions[:, ::-1]
        result = msgspec.structs.replace(result, model=with_joints_reversed(result.model))
    solution = solution_of(trials, result)
    kept = [i - FIRST_MARKER for i in result.model.marker_ids]
    seen = case.cell.in_view(positions)[:, :, kept]
    camera, stop, marker = np.nonzero(seen)
    exact = case.cell.pixels(positions)[:, :, kept][seen]
    data = Measurements(order - result.model.zero, camera, stop, marker, exact, np.ones(len(exact)))
    errors = residuals(solution.rig, data)
    roots = jacobian(solution.rig, solution.charts, np.zeros(solution.charts.size), data) @ solution.statistics.root
    moments = roots.T @ roots * max(1.0, solution.statistics.variance)
    mean = float(np.trace(moments))
    freedom = mean**2 / float((moments**2).sum())
    return float(errors @ errors) / mean, freedom, float(np.sqrt((errors**2).mean()))


def intrinsics_sigmas(case: RandomCase, result: CalibrationFit) -> float:
    """Largest error of the left camera's fx, skew, fy, u0, v0 in stated deviations; 0 below the metric stratum."""
    stated, deviations = result.report.cameras[0].intrinsics, result.report.left_intrinsics_std
    if stated is None or deviations is None:
        return 0.0
    K = case.cell.intrinsics[0]
    true = np.array([K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2]])
    return float(np.max(np.abs(np.array(stated) - true) / np.array(deviations)))


# -- random rigs -----------------------------------------------------------------------------------------------


def run_random_rigs(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: counts, Wilson's 95 % interval of the success rate, rows over noise, and
    every case that is not a success. Raises ValueError for fewer than one case.
    """
    verdicts = cases(lambda k: judged_case(random_case(k)), seeds, seed, progress)
    counts = Counter(verdict.outcome for verdict in verdicts)
    low, high = wilson(counts["success"], seeds)
    return {
        "success": counts["success"],
        "failure": counts["failure"],
        "wrong": counts["wrong"],
        "success_rate": counts["success"] / seeds,
        "wilson_95": [low, high],
        "promised": PROMISED,
        **_strata_and_seconds(verdicts),
        "rows": _rows(verdicts),
        "failures_by_cause": _causes(verdicts),
        "not_successes": _no_successes(verdicts),
        "thesis": {"note": "none: the thesis starts from a good guess (5.4.4) and calibrates one robot (5.5)"},
    }


def _strata_and_seconds(verdicts: list[Verdict]) -> dict[str, Any]:
    return {
        "strata": dict(Counter(verdict.stratum for verdict in verdicts if verdict.stratum)),
        "seconds_median": float(np.median([verdict.seconds for verdict in verdicts])),
    }


def _causes(verdicts: list[Verdict]) -> dict[str, int]:
    return dict(Counter(verdict.code for verdict in verdicts if verdict.outcome == "failure"))


def _no_successes(verdicts: list[Verdict]) -> list[dict[str, Any]]:
    return [msgspec.structs.asdict(verdict) for verdict in verdicts if verdict.outcome != "success"]


def _rows(verdicts: list[Verdict]) -> list[dict[str, Any]]:
    """One object for each decade of noise and each body: successes, and the errors of held-out pixels in sigmas."""
    rows = []
    for low, high in ((0.01, 0.1), (0.1, 1.0)):
        for body in BODIES:
            own = [v for v in verdicts if low <= v.sigma_px < high and v.body == body]
            good = [v for v in own if v.outcome == "success"]
            if not own:
                continue
            errors = [v.rms_px / v.sigma_px for v in good]
            low_error, median, high_error = np.quantile(errors, [0.16, 0.5, 0.84]) if good else [np.nan] * 3
            rows.append(
                {
                    "condition": f"{body}, {low:g} to {high:g} px",
                    "cases": len(own),
                    "success": len(good),
                    "held_out_error_sigmas": float(median) if good else None,
                    "spread": [float(low_error), float(high_error)] if good else None,
                }
            )
    return rows


def draw_random_rigs(answer: dict[str, Any]) -> Figures:
    """Successes by body and noise, as bars with the number of cases."""
    rows = answer["rows"]
    figure = picture(8, 4, dpi=150)
    axes = figure.subplots()
    names = [row["condition"] for row in rows]
    axes.barh(names, [row["cases"] for row in rows], color="0.85", label="cases")
    axes.barh(names, [row["success"] for row in rows], height=0.5, label="model true within its covariance")
    axes.invert_yaxis()
    low, high = answer["wilson_95"]
    axes.set_title(
        f"{answer['success']} of {answer['seeds']} random rigs calibrated, {answer['wrong']} wrong "
        f"(95 %: {low:.2%} to {high:.2%})"
    )
    axes.legend()
    return {"random_rigs": figure}


def notes_random_rigs(answer: dict[str, Any]) -> Iterator[str]:
    """The rate with its interval, and the failures."""
    low, high = answer["wilson_95"]
    yield (
        f"{answer['success']} of {answer['seeds']} succeeded ({answer['success_rate']:.2%}; Wilson 95 %: {low:.2%} to "
        f"{high:.2%}; promised {answer['promised']:.1%}), {answer['failure']} refused, {answer['wrong']} wrong"
    )
    for case in answer["not_successes"]:
        yield f"case {case['seed']}: {case['outcome']} {case['code']} {case['message']}"


# -- lens distortion -------------------------------------------------------------------------------------------

BENDS = ((-0.4, -0.2), (-0.2, -0.05), (-0.05, 0.1))
"""Ranges of k1 of the rows."""


def run_random_lenses(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: counts of usable, wrong and refused ones, the refusals by cause, rows
    over the first radial term, and every case that is not usable. Raises ValueError for fewer than one case.
    """
    verdicts = cases(lambda k: judged_case(random_lens_case(k)), seeds, seed, progress)
    bends = [_bend(random_lens_case(verdict.seed)) for verdict in verdicts]
    counts = Counter(verdict.outcome for verdict in verdicts)
    return {
        "title": f"random-lenses: cases {seed} to {seed + seeds - 1} by k1 of the left lens",
        "usable": counts["success"],
        "wrong": counts["wrong"],
        "refused": counts["failure"],
        "refused_by_cause": _causes(verdicts),
        **_strata_and_seconds(verdicts),
        "rows": _lens_rows(verdicts, bends),
        "not_usable": [
            {"k1": bend} | msgspec.structs.asdict(v)
            for v, bend in zip(verdicts, bends, strict=True)
            if v.outcome != "success"
        ],
        "thesis": {"note": "none: the thesis has lenses without distortion"},
    }


def _bend(case: RandomCase) -> float:
    """k1 of the left lens."""
    K, lens = case.cell.intrinsics[0], case.cell.lenses[0]
    return float(lens[0] * K[0, 0] * K[1, 1] / lens[3] ** 2)


def _lens_rows(verdicts: list[Verdict], bends: list[float]) -> list[dict[str, Any]]:
    """One object for each range of k1."""
    rows = []
    for low, high in BENDS:
        own = Counter(v.outcome for v, bend in zip(verdicts, bends, strict=True) if low <= bend < high)
        rows.append(
            {
                "k1": f"{low:g} to {high:g}",
                "cases": own.total(),
                "usable": own["success"],
                "wrong": own["wrong"],
                "refused": own["failure"],
            }
        )
    return rows


def draw_random_lenses(answer: dict[str, Any]) -> Figures:
    """Usable, wrong and refused cases by k1, as bars."""
    rows = answer["rows"]
    names = [f"k1 {row['k1']}" for row in rows]
    return {"random_lenses": stacked_bars(rows, names, ("usable", "wrong", "refused"))}


def notes_random_lenses(answer: dict[str, Any]) -> Iterator[str]:
    """Counts, and every case that is not usable."""
    causes = ", ".join(f"{code} {count}" for code, count in sorted(answer["refused_by_cause"].items()))
    yield (
        f"{answer['usable']} of {answer['seeds']} usable, {answer['wrong']} wrong, {answer['refused']} refused"
        + (f" ({causes})" if causes else "")
    )
    for case in answer["not_usable"]:
        yield (
            f"case {case['seed']}: k1 {case['k1']:.2f}, {case['sigma_px']:.3f} px, {case['outcome']} {case['code']} "
            f"{case['message']}"
        )


# -- shipped arms ----------------------------------------------------------------------------------------------

AROUND = {"revolute": 0.2, "prismatic": 0.05}
"""Largest distance of the drawn configuration from the cell's base [rad or m]."""


def run_shipped_arms(seeds: int, cell: str = "", seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1`` of every shipped arm, or of ``cell`` alone: rows, and all that fail.

    Raises ExperimentError for a cell that is not one of these, ValueError for fewer than one case.
    """
    if cell and cell not in ARMS:
        raise ExperimentError("option", f"--cell {cell!r}: no arm of that name is shipped; there are {', '.join(ARMS)}")
    names = (cell,) if cell else ARMS
    found = crossed(lambda name, k: judged_case(arm_case(name, k)), names, seeds, seed, progress, "cases")
    rows = []
    for name, verdicts in zip(names, found, strict=True):
        good = [verdict for verdict in verdicts if verdict.outcome == "success"]
        errors = [verdict.rms_px / verdict.sigma_px for verdict in good]
        rows.append(
            {
                "condition": name,
                "joints": len(_cell(name).base),
                "cases": seeds,
                "success": len(good),
                "wilson_95": list(wilson(len(good), seeds)),
                "strata": dict(Counter(verdict.stratum for verdict in good)),
                "held_out_error_sigmas": _median(errors),
                "seconds_median": _median([verdict.seconds for verdict in verdicts]),
            }
        )
    return {
        "rows": rows,
        "not_successes": [one for verdicts in found for one in _no_successes(verdicts)],
        "thesis": {"note": "none: the thesis calibrates one robot (5.5)"},
    }


def arm_case(name: str, seed: int) -> RandomCase:
    """Case ``seed`` of the shipped cell ``name``, reproducible bit for bit."""
    cell = _cell(name)
    rng = np.random.default_rng([seed, 7])
    low, high = (np.array([getattr(j, f"position_{side}") for j in cell.robot.joints]) for side in ("min", "max"))
    around = np.array([AROUND[joint.kind] for joint in cell.robot.joints])
    redraws = 0
    while True:
        home = np.clip(cell.base + rng.uniform(-1.0, 1.0, len(around)) * around, low + around, high - around)
        found = twin(cell, home)
        if found.in_view(home[None], 4.0).all():
            break
        redraws += 1
    ranges = np.minimum(visible_ranges(found), np.minimum(home - low, high - home))
    sigma = float(np.exp(rng.uniform(*np.log(NOISES))))
    stops = int(rng.integers(STOPS[0], STOPS[1] + 1))
    return RandomCase(seed, replace(found, ranges=ranges), sigma, stops, name, "two_faces", redraws)


def twin(cell: SimulatedCell, home: FloatArray) -> SyntheticCell:
    """The cell around ``home`` (n,) as a synthetic one: the same pixels of the same markers, visible or not."""
    stands = cell.stand is None
    in_rig = cell.rig.world_to_rig if cell.stand is None else inverse_pose(cell.stand)
    poses = [
        camera.world_to_camera @ inverse_pose(in_rig) if stands else camera.world_to_camera
        for camera in cell.rig.cameras
    ]
    return SyntheticCell(
        base=in_rig @ cell.robot.base,
        kinds=tuple(joint.kind for joint in cell.robot.joints),
        links=tuple(cell.robot.links),
        body=cell.body.marker_points,
        intrinsics=np.array([camera.K for camera in cell.rig.cameras]),
        poses=np.array(poses),
        home=home,
        ranges=np.zeros(len(home)),
        lenses=np.tile(pinhole(), (len(poses), 1)),
        mount="eye_to_hand" if stands else "eye_in_hand",
    )


def _cell(name: str) -> SimulatedCell:
    path = shipped_cell_path(name)
    file = load_cell_file(path)
    cell = true_cell(file, path.parent)
    return seen_as_joints(file.joints.options, cell) if file.joints.driver == TwistJointDriver.driver else cell


def notes_shipped_arms(answer: dict[str, Any]) -> Iterator[str]:
    """The failed cases."""
    for case in answer["not_successes"]:
        yield f"{case['arm']}, seed {case['seed']}: {case['outcome']} {case['code']} {case['message']}"


# -- imperfect arms --------------------------------------------------------------------------------------------

MECHANICS_NOISES = (0.01, 0.5)
"""Range of the noise [px], log-uniform."""
MECHANISMS = ("ripple", "encoder", "play", "sag", "coupling")
"""Mechanism of seed k: the one at k modulo their number."""
TOGETHER = 16
"""Stops of all joints at once, the default of a cell file."""
INSIDE = 5.991
"""Squared distance that holds 95 % of two Gaussian coordinates."""
WELL = 0.85
"""Least share inside their ellipses of a good model."""


class MechanicsVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case: ``size`` of its mechanism [rad or share], ``inside``: share of held-out markers inside their
    95 % ellipses, ``code`` and ``message`` of a refusal.

    ``over_told``: ratio of the error of these markers to that of a fit given the true joints in the trials (of a
    perfect arm), and ``seconds_told`` of its CPU time beside our ``seconds``; 0 if it fails.
    """

    seed: int
    mechanism: str
    size: float
    sigma_px: float
    usable: bool
    inside: float = 0.0
    grade: str = ""
    stratum: str = ""
    code: str = ""
    message: str = ""
    seconds: float = 0.0
    over_told: float = 0.0
    seconds_told: float = 0.0


def random_mechanics(seed: int) -> tuple[RandomCase, str, float, tuple[Mechanics, ...], float]:
    """Case of ``seed``, its mechanism with its size, the mechanics of all joints, and the noise [px]."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 4])
    sigma = float(np.exp(rng.uniform(*np.log(MECHANICS_NOISES))))
    mechanism, n = MECHANISMS[seed % len(MECHANISMS)], len(case.cell.home)
    if mechanism == "ripple":
        size = float(np.exp(rng.uniform(*np.log((0.02e-3, 1e-3)))))
        orders, phases = rng.uniform(100.0, 320.0, n), rng.uniform(0.0, 2.0 * np.pi, n)
        gears = [
            Mechanics(ripple=size, ripple_order=order, ripple_phase=phase)
            for order, phase in zip(orders.tolist(), phases.tolist(), strict=True)
        ]
    elif mechanism == "encoder":
        size = float(2.0 * np.pi / 4096)
        gears = [Mechanics(encoder_step=size, encoder_side="joint")] * n
    elif mechanism == "play":
        size = float(np.deg2rad(rng.uniform(0.0, 1.5)))
        gears = [Mechanics(play=size)] * n
    elif mechanism == "sag":
        size = float(np.deg2rad(rng.uniform(0.0, 2.5)))
        gears = [Mechanics(sag=size)] * n
    else:
        size = float(rng.uniform(0.0, 0.05))
        gears = [*[Mechanics()] * (n - 1), Mechanics(coupling=size)]
    return case, mechanism, size, tuple(gears), sigma


def judged_mechanics(seed: int) -> MechanicsVerdict:
    """Outcome of the case of ``seed``, calibrated without prior knowledge."""
    case, mechanism, size, gears, sigma = random_mechanics(seed)
    trials = simulated_trials(case, gears, sigma)
    begin = time.process_time()
    try:
        result = fit_model(trials, epoch=1)
    except CalibrationError as error:
        seconds = time.process_time() - begin
        return MechanicsVerdict(
            seed, mechanism, size, sigma, False, code=error.code, message=error.message, seconds=seconds
        )
    seconds = time.process_time() - begin
    error_px, inside = unseen(case, gears, result.model)
    told_px, seconds_told = _told(case, gears, sigma)
    grade = assess_fit(result.model, result.report).grade
    return MechanicsVerdict(
        seed, mechanism, size, sigma, True, inside, grade, result.model.stratum, seconds=seconds,
        over_told=error_px / told_px if told_px else 0.0, seconds_told=seconds_told,
    )  # fmt: skip


def simulated_trials(case: RandomCase, gears: Sequence[Mechanics], sigma: float) -> TrialData:
    """Trials of a case whose joints have these ``gears``, with noise ``sigma`` [px]."""
    rng = np.random.default_rng([case.seed, 1])
    trials = mechanical_trials(case.cell, gears, sigma, rng, positions=driven_stops(case))
    return hidden_out_of_view(case.cell, trials)


def _told(case: RandomCase, gears: tuple[Mechanics, ...], sigma: float) -> tuple[float, float]:
    """Error [px] of held-out markers, at reported joints with these ``gears``, of a fit given the true joints of the
    trials (of a perfect arm, with the same noise); and its CPU time [s]. Zeros if it fails.
    """
    trials = simulated_trials(case, (Mechanics(),) * len(gears), sigma)
    begin = time.process_time()
    try:
        model = fit_model(trials, epoch=1).model
    except CalibrationError:
        return 0.0, 0.0
    seconds = time.process_time() - begin
    return unseen(case, gears, model)[0], seconds


def driven_stops(case: RandomCase) -> tuple[FloatArray, IntArray]:
    """Positions (s, n) of the case's trials and the joint (s,) that moves, as driven by the calibration motion: each
    joint from its base to one end, then beyond the base to the other; finally all at once (-1), if enough markers
    stay in view.
    """
    home, ranges = case.cell.home, case.cell.ranges
    counts = ((1, case.stops // 2), (-1, case.stops - 1 - case.stops // 2))
    shares = [0.0] + [stop_offset(side, k, count, 1.0 / count) for side, count in counts for k in range(1, count + 1)]
    motors, moved = [], []
    for joint in range(len(home)):
        for share in shares:
            stop = home.copy()
            stop[joint] += share * ranges[joint]
            motors.append(stop)
            moved.append(joint)
    for k in range(TOGETHER):
        offsets = in_view_at(
            combined_offsets(k, -ranges, ranges),
            lambda at: bool(case.cell.in_view((home + at)[None]).all(axis=0).sum() >= MIN_SHOWN),
        )
        if offsets is not None:
            motors.append(home + offsets)
            moved.append(-1)
    return np.array(motors), np.array(moved, dtype=np.int64)


def unseen(case: RandomCase, gears: tuple[Mechanics, ...], model: CellModel) -> tuple[float, float]:
    """Root mean square error [px] of the markers in view, at reported joints in held-out poses, and their share inside
    the ellipses stated by the model.
    """
    links, readings = links_and_readings(case.cell, gears, case.held_out())
    kept = [i - FIRST_MARKER for i in model.marker_ids]
    pixels, covariances = pixel_covariances(model, readings)
    off = pixels - case.cell.pixels(links)[:, :, kept]
    squares = np.einsum("csma,csmab,csmb->csm", off, np.linalg.inv(covariances), off)
    shown = case.cell.in_view(links)[:, :, kept]
    return float(np.sqrt((off[shown] ** 2).sum(axis=1).mean())), float((squares[shown] < INSIDE).mean())


def run_random_mechanics(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: a row for each mechanism, the refusals by cause, every case that is not
    usable, and those called good whose ellipses hold less than ``WELL``. Raises ValueError for fewer than one case.
    """
    verdicts = cases(judged_mechanics, seeds, seed, progress)
    refused = [verdict for verdict in verdicts if not verdict.usable]
    praised = [v for v in verdicts if v.usable and v.grade == "good" and v.inside < WELL]
    low, high = wilson(len(verdicts) - len(refused), len(verdicts))
    return {
        "title": f"random-mechanics: cases {seed} to {seed + seeds - 1} by mechanism",
        "usable": len(verdicts) - len(refused),
        "usable_low": low,
        "usable_high": high,
        "refused_by_cause": dict(Counter(verdict.code for verdict in refused)),
        "rows": [_mechanism_row(name, [v for v in verdicts if v.mechanism == name]) for name in MECHANISMS],
        "refused": [msgspec.structs.asdict(verdict) for verdict in refused],
        "good_and_not_true": [msgspec.structs.asdict(verdict) for verdict in praised],
        "thesis": {"note": "none: the thesis has joints without errors"},
    }


def _mechanism_row(name: str, verdicts: list[MechanicsVerdict]) -> dict[str, Any]:
    usable = [verdict for verdict in verdicts if verdict.usable]
    shares = [verdict.inside for verdict in usable]
    return {
        "mechanism": name,
        "cases": len(verdicts),
        "usable": len(usable),
        "good": sum(verdict.grade == "good" for verdict in usable),
        "inside_mean": float(np.mean(shares)) if shares else None,
        "inside_least": min(shares, default=None),
        "over_told_median": _median([verdict.over_told for verdict in usable if verdict.over_told]),
        "seconds_median": _median([verdict.seconds for verdict in verdicts]),
        "seconds_over_told_median": _median(
            [verdict.seconds / verdict.seconds_told for verdict in usable if verdict.seconds_told]
        ),
    }


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def draw_random_mechanics(answer: dict[str, Any]) -> Figures:
    """Usable and refused cases by mechanism, as bars."""
    rows = [row | {"refused": row["cases"] - row["usable"]} for row in answer["rows"]]
    names = [row["mechanism"] for row in rows]
    return {"random_mechanics": stacked_bars(rows, names, ("usable", "refused"))}


def notes_random_mechanics(answer: dict[str, Any]) -> Iterator[str]:
    """Counts, every refused case, and every one that is falsely called good."""
    causes = ", ".join(f"{code} {count}" for code, count in sorted(answer["refused_by_cause"].items()))
    yield (
        f"{answer['usable']} of {answer['seeds']} usable ({answer['usable_low']:.1%} to {answer['usable_high']:.1%})"
        + (f"; refused: {causes}" if causes else "")
    )
    ends = [(case, f"{case['code']} {case['message']}") for case in answer["refused"]]
    ends += [(case, f"called good; {case['inside']:.0%} inside") for case in answer["good_and_not_true"]]
    for case, end in ends:
        yield f"case {case['seed']}: {case['mechanism']} {case['size']:.2g}, {case['sigma_px']:.3f} px, {end}"
