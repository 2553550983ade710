"""Collection of the demonstration report's data from the recording, the model and the evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stereoservo.calibration.trial_data import TrialData
from stereoservo.geometry.cameras import project_many
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.demonstration.judge import Judgement, RecordedDemonstration
from stereoservo_sim.demonstration.report import CalibrationPlots, GoalPlots, ReportData, write_report
from stereoservo_sim.demonstration.runner import Demonstration


def write_pages(
    path: Path, demonstration: Demonstration, flight: RecordedDemonstration, goals: Sequence[Judgement]
) -> None:
    """Write the report. Raises OSError."""
    cell = demonstration.cell
    mode = "lockstep, virtual time" if demonstration.lockstep else "real processes over zenoh"
    facts = {
        "mode": mode,
        "seed": str(demonstration.seed),
        "loop": f"{cell.servo.rate_hz:g} Hz",
        "replay": f"identical: {flight.result.identical} over {flight.result.steps} steps",
    }
    if demonstration.loop is not None:
        lateness = demonstration.loop.lateness_us
        facts["lateness"] = (
            f"p50 {lateness['p50']:.0f} µs, p99 {lateness['p99']:.0f} µs, max {lateness['max']:.0f} µs"
        )
        facts["overruns"] = f"{demonstration.loop.overruns} of {demonstration.loop.cycles} cycles"
    data = ReportData(
        title="stereoservo demonstration",
        joints=demonstration.joint_names,
        calibration=None if flight.trials is None else _calibration(demonstration, flight.trials),
        goals=tuple(_goal(goal, cell.servo.gain) for goal in goals),
        tolerance_px=cell.servo.tolerance_px,
        velocity_limits=flight.velocity_max,
        summary="An arm that nobody calibrated learnt itself through two cameras that nobody calibrated, and reached "
        "goals that were only shown to it. Errors are against the simulated truth.",
        facts=facts,
    )
    write_report(data, path)


def _calibration(demonstration: Demonstration, trials: TrialData) -> CalibrationPlots:
    model = demonstration.calibrated.model
    statistics = model.statistics
    figures = {}
    if statistics is not None:
        figures = {
            "chi-square": f"{statistics.chi2:.0f} for {statistics.degrees_of_freedom} degrees of freedom "
            f"({'as' if statistics.chi2_ok else 'not as'} the measurement noise explains)",
            "parameters": f"{statistics.parameters} net of gauge, {statistics.measurements} measurements",
            "stratum": model.stratum,
        }
    sizes = np.array([(camera.width, camera.height) for camera in trials.cameras])
    return CalibrationPlots(
        cameras=tuple(camera.name for camera in trials.cameras),
        joints=trials.joint_names,
        sizes=sizes,
        joint=trials.trials,
        pixels=trials.pixels,
        residuals=residuals(model, trials),
        rms_px=statistics.rms_px if statistics is not None else float("nan"),
        images=statistics.images if statistics is not None else trials.images,
        seconds=demonstration.calibrated.seconds,
        sigma_px=float(np.sqrt(np.nanmean(trials.sigmas**2))),
        figures=figures,
    )


def residuals(model: CellModel, trials: TrialData) -> FloatArray:
    """Measured minus predicted raw pixels (c, s, m, 2), NaN where a marker was not seen."""
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
    matrices = np.array([camera.matrix for camera in model.cameras])
    rows = [model.marker_ids.index(marker) for marker in trials.marker_ids]
    predicted = np.array(
        [
            project_many(matrices, model.marker_points[rows] @ chain.displacement(q).T)
            for q in trials.positions
        ]
    )
    raw = [
        distort(camera.lens, ideal)
        for camera, ideal in zip(model.cameras, predicted.transpose(1, 0, 2, 3), strict=True)
    ]
    found: FloatArray = trials.pixels - np.array(raw)
    return found


def _goal(goal: Judgement, gain: float) -> GoalPlots:
    return GoalPlots(
        name=goal.name,
        law=goal.law,
        outcome=goal.outcome,
        times_s=goal.times_s,
        error_px=goal.error_px,
        velocities=goal.velocities,
        path_m=goal.path_m,
        line_m=goal.line_m,
        final_error_px=goal.final_error_px,
        final_error_mm=goal.final_error_mm,
        max_line_deviation_mm=goal.max_line_deviation_mm,
        rotation_deg=goal.rotation_deg,
        distance_mm=goal.distance_mm,
        steps=goal.steps,
        seconds=goal.seconds,
        gain=gain,
        tracks=goal.tracks,
    )
