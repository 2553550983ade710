"""Results of a demonstration: evaluation, report, summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np

from stereoservo.kinematics.model import CellModel
from stereoservo_sim.demonstration.judge import Judgement, Steady, judge_goal, read_flight
from stereoservo_sim.demonstration.overview import write_overview
from stereoservo_sim.demonstration.report_pages import write_pages
from stereoservo_sim.demonstration.runner import Demonstration

MAX_ERROR_PX = 0.3
MAX_ERROR_MM = 0.5
MAX_STEADY_PX = 1.0
"""While a part moves at a steady speed, for 99 % of the time: a busy computer may hold the arm for a moment."""
MAX_MET_PX = 0.5
"""Of a part that was met while it moved, when it stands: the cell's tolerance."""
MAX_MET_MM = 2.0
"""Depth is seen ten times less than the rest."""


def summary(demonstration: Demonstration, seconds: float) -> dict[str, Any]:
    """Evaluate, write ``report.html`` and ``overview.png``; returns what ``demo --json`` prints.

    ``seconds``: how long the demonstration took. Raises RecordingError, LookupError where a goal was never flown.
    """
    flight = read_flight(demonstration.recording)
    truth = demonstration.truth
    goals = [
        judge_goal(
            goal.name, goal.law, demonstration.outcomes[goal.name], flight, demonstration.truth_t,
            demonstration.truth_q, truth, demonstration.belt,
        )
        for goal in demonstration.goals
    ]  # fmt: skip
    verdicts = sorted({e.name for e in flight.events if e.kind == "health" and e.name != "ok"})
    report = demonstration.out / "report.html"
    write_pages(report, demonstration, flight, goals)
    write_overview(demonstration.out / "overview.png", goals, truth, demonstration.cell.servo.tolerance_px)
    model = demonstration.calibrated.model
    return {
        "converged": not (found := [*problems(model, goals), *false_verdicts(verdicts)]),
        "problems": found,
        "goals": [_row(goal) for goal in goals],
        "verdicts": verdicts,
        "calibration": _calibration(model, demonstration.calibrated.seconds),
        "loop": _loop(demonstration),
        "replay": {
            "identical": flight.result.identical,
            "steps": flight.result.steps,
            "gaps": flight.result.gaps,
            "max_relative_error": flight.result.max_relative_error,
        },
        "report": str(report),
        "recording": str(demonstration.recording),
        "model": str(demonstration.out / "model.json"),
        "seed": demonstration.seed,
        "lockstep": demonstration.lockstep,
        "seconds": seconds,
    }


def problems(model: CellModel, goals: Sequence[Judgement]) -> list[str]:
    """Reasons why a demonstration has not converged: the residual's chi-square at 99.9 %, goals, errors."""
    found = []
    statistics = model.statistics
    if statistics is None or not statistics.chi2_ok:
        values = (
            ""
            if statistics is None
            else f" (chi-square {statistics.chi2:.0f}, {statistics.degrees_of_freedom} expected)"
        )
        found.append(f"the calibration's residual is not what the measurement noise explains{values}")
    for goal in goals:
        if goal.outcome != "reached":
            found.append(f"goal {goal.name}: {goal.outcome}")
        most_px, most_mm = (MAX_ERROR_PX, MAX_ERROR_MM) if goal.steady is None else (MAX_MET_PX, MAX_MET_MM)
        if goal.final_error_px > most_px:
            found.append(f"goal {goal.name}: {goal.final_error_px:.3f} px off, {most_px} px allowed")
        if goal.final_error_mm > most_mm:
            found.append(f"goal {goal.name}: {goal.final_error_mm:.3f} mm off, {most_mm} mm allowed")
        if goal.steady is not None:
            found.extend(f"goal {goal.name}: {what}" for what in _unsteady(goal.steady))
    return found


def _unsteady(steady: Steady) -> list[str]:
    if not np.isfinite(steady.met_s):
        return ["the part was not met while the belt carried it"]
    if steady.p99_px > MAX_STEADY_PX:
        return [f"up to {steady.p99_px:.2f} px off while the part moved, {MAX_STEADY_PX} px allowed"]
    return []


def false_verdicts(verdicts: Sequence[str]) -> list[str]:
    """Nothing is wrong with a simulated arm: whatever the watch over the model named is a problem."""
    return [f"the watch over the model named {verdict!r}, and nothing had changed" for verdict in verdicts]


def _row(goal: Judgement) -> dict[str, Any]:
    plain = ("name", "law", "outcome", "final_error_px", "final_error_mm", "max_line_deviation_mm", "rotation_deg",
             "distance_mm", "steps", "seconds")  # fmt: skip
    steady = (
        None
        if goal.steady is None
        else {k: v if np.isfinite(v) else None for k, v in asdict(goal.steady).items()}
    )
    return {**{name: getattr(goal, name) for name in plain}, **({} if steady is None else {"steady": steady})}


def _calibration(model: CellModel, seconds: float) -> dict[str, Any]:
    statistics = model.statistics
    if statistics is None:
        raise AssertionError("a fitted model has statistics")
    return {
        "rms_px": statistics.rms_px,
        "joints": len(model.joint_names),
        "images": statistics.images,
        "seconds": seconds,
        "chi2": statistics.chi2,
        "degrees_of_freedom": statistics.degrees_of_freedom,
        "chi2_ok": statistics.chi2_ok,
        "measurements": statistics.measurements,
        "parameters": statistics.parameters,
        "outliers": statistics.outliers,
        "per_joint_px": {joint.name: joint.rms_px for joint in statistics.joints},
        "stratum": model.stratum,
    }


def _loop(demonstration: Demonstration) -> dict[str, Any]:
    if demonstration.loop is None:  # virtual time is never late
        return {
            "rate_hz": demonstration.cell.servo.rate_hz, "overruns": 0,
            "lateness_us": {"p50": 0.0, "p99": 0.0, "max": 0.0}, "virtual": True,
        }  # fmt: skip
    return {**msgspec.to_builtins(demonstration.loop), "virtual": False}
