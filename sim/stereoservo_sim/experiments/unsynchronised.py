"""Experiment: servoing accuracy with unsynchronised cameras, or a wrong latency, against triggered cameras.

The demo's cell in lockstep, with cameras at 30 Hz whose images arrive 40 ms after their shutters, with the noise of
rendered dots. Four conditions, each with its own calibration: a trigger; 15 ms between the shutters; the same with a
stated latency 10 ms too short and too long. The same goals by law ``cartesian3``, the same noise, evaluated against
ground truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from stereoservo.core.cycle import Event, StepInputs, StepOutputs
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.cells import demo_cell_path
from stereoservo_sim.demonstration.judge import Course, Judgement, judge_goal
from stereoservo_sim.demonstration.runner import LockstepDemonstrator
from stereoservo_sim.demonstration.scenario import ShownGoal, perform
from stereoservo_sim.demonstration.truth import TruthLog, true_cell
from stereoservo_sim.experiments.experiment import crossed
from stereoservo_sim.experiments.figures import Figures, by_condition, draw_points, picture
from stereoservo_sim.experiments.lockstep_cells import lockstep, with_fake_arm
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import spread
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import DEMO_GOALS

RATE_HZ = 30.0
LATENCY_S = 0.04
SKEW_S = 0.015
WRONG_S = 0.010
NOISE_PX = 0.005
"""Error of a rendered dot's centre due to noise of two grey levels."""
GOALS = tuple(ShownGoal(name, "cartesian3") for name in DEMO_GOALS)
TAKE_STEPS = 2000
MOVING = 1e-3
"""Commanded speed above which a joint counts as moving [rad/s]."""
MEASURES = ("final_error_px", "final_error_mm", "line_deviation_mm", "innovation_px")


@dataclass(frozen=True)
class TimingCondition:
    """An experimental condition. ``skew_s`` of the right camera's shutter; ``told_s``: the latency assumed in its
    stamps.
    """

    name: str
    skew_s: float
    told_s: float


CONDITIONS = (
    TimingCondition("trigger", 0.0, LATENCY_S),
    TimingCondition("no trigger", SKEW_S, LATENCY_S),
    TimingCondition("no trigger, latency told 10 ms short", SKEW_S, LATENCY_S - WRONG_S),
    TimingCondition("no trigger, latency told 10 ms long", SKEW_S, LATENCY_S + WRONG_S),
)


@dataclass(frozen=True)
class TimedGoalResult:
    """Result of one goal: its evaluation against ground truth, and the rms innovation in motion [px]."""

    goal: Judgement
    innovation_px: float


def run_unsynchronised(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Run every condition with ``seeds`` seeds from ``seed`` on; returns the JSON object of the command."""
    found = crossed(fly, CONDITIONS, seeds, seed, progress)
    flown = {
        condition.name: [one for goals in of_seeds for one in goals]
        for condition, of_seeds in zip(CONDITIONS, found, strict=True)
    }
    rows = [_row(condition, flown[condition.name], flown[CONDITIONS[0].name]) for condition in CONDITIONS]
    return {
        "rows": rows,
        "thesis": {"cameras": "triggered together"},
        "goals": [
            {"condition": name, **_figures(one), "goal": one.goal.name, "outcome": one.goal.outcome}
            for name, several in flown.items()
            for one in several
        ],
        "assumptions": [
            f"{RATE_HZ:g} Hz, {LATENCY_S * 1e3:g} ms latency, {SKEW_S * 1e3:g} ms skew, {NOISE_PX:g} px noise a marker",
            "ratio: median over goals and seeds of the pairs of equal noise, this condition over the trigger",
        ],
    }


def fly(condition: TimingCondition, seed: int) -> list[TimedGoalResult]:
    """Calibrate a cell of ``condition`` and servo its arm to every goal; deterministic given the seed."""
    cell = cell_of(condition)
    history = TrueJointHistory.in_memory(len(cell.safety.limit), capacity=1 << 16)
    watch = _Watch(TruthLog(history))
    with lockstep(cell, seed, history, watch.see) as (running, _):
        demonstrator = LockstepDemonstrator(running, seed, lambda fraction: None)
        names = running.settings.joint_names
        _, outcomes = perform(demonstrator, names, DEMO_GOALS, lambda text: None, GOALS)
    course = watch.course()
    times, positions = watch.log.end()
    truth = true_cell(cell)
    judged = [judge_goal(goal.name, goal.law, outcomes[goal.name], course, times, positions, truth) for goal in GOALS]
    started = [event.id for event in course.events if event.kind == "goal_started" and event.name == "cartesian3"]
    return [TimedGoalResult(one, watch.innovation(goal_id)) for one, goal_id in zip(judged, started, strict=True)]


def cell_of(condition: TimingCondition) -> CellFile:
    """The demo's cell with fakes for arm and cameras, and a short calibration."""
    cell = load_cell_file(demo_cell_path())
    options = {"rate_hz": RATE_HZ, "latency_s": LATENCY_S, "told_latency_s": condition.told_s, "noise_px": NOISE_PX}
    cameras = (
        msgspec.structs.replace(
            camera, driver="fake", detector="", options={**options, "phase_s": k * condition.skew_s}
        )
        for k, camera in enumerate(cell.camera)
    )
    return with_fake_arm(cell, cameras, calibrates_fast=True)


class _Watch:
    """Log of every step, for the evaluation."""

    def __init__(self, log: TruthLog) -> None:
        self.log = log
        self._times: list[int] = []
        self._errors: list[float] = []
        self._commands: list[FloatArray] = []
        self._goals: list[str] = []
        self._events: list[Event] = []
        self._innovations: dict[str, list[float]] = {}

    def see(self, inputs: StepInputs, outputs: StepOutputs) -> None:
        """Log one step."""
        status = outputs.status
        self._times.append(inputs.now_ns)
        self._errors.append(np.nan if status.error_px is None else status.error_px)
        self._commands.append(status.command)
        self._goals.append(status.goal)
        self._events.extend(outputs.events)
        if inputs.observations and status.goal and float(np.abs(status.command).max()) > MOVING:
            self._innovations.setdefault(status.goal, []).extend(status.innovation_px.values())
        if len(self._times) % TAKE_STEPS == 0:
            self.log.take()

    def course(self) -> Course:
        """Time series of all steps."""
        return Course(
            np.array(self._times), np.array(self._errors), np.array(self._commands), self._goals, self._events
        )

    def innovation(self, goal_id: str) -> float:
        """Rms over cameras and frames in motion [px]."""
        return float(np.sqrt(np.mean(np.square(self._innovations[goal_id]))))


def _figures(one: TimedGoalResult) -> dict[str, float]:
    goal = one.goal
    return {
        "final_error_px": goal.final_error_px,
        "final_error_mm": goal.final_error_mm,
        "line_deviation_mm": goal.max_line_deviation_mm,
        "innovation_px": one.innovation_px,
    }


def _row(condition: TimingCondition, flown: list[TimedGoalResult], trigger: list[TimedGoalResult]) -> dict[str, Any]:
    figures = [_figures(one) for one in flown]
    beside = [_figures(one) for one in trigger]
    row: dict[str, Any] = {
        "condition": condition.name,
        "reached": f"{sum(one.goal.outcome == 'reached' for one in flown)} of {len(flown)}",
    }
    for measure in MEASURES:
        values = [one[measure] for one in figures]
        row[measure] = spread(values)
        ratios = [value / other[measure] for value, other in zip(values, beside, strict=True)]
        row[f"{measure}_ratio"] = float(np.median(ratios))
    return row


def draw_unsynchronised(answer: dict[str, Any]) -> Figures:
    """Final errors and deviations from the line, one column per condition."""
    figure = picture(9, 4)
    measures = (("final_error_px", "[px]"), ("line_deviation_mm", "[mm]"))
    for axis, (measure, unit) in zip(figure.subplots(1, 2), measures, strict=True):
        draw_points(axis, by_condition(answer, "condition", measure), measure.replace("_", " "), unit)
    return {"unsynchronised": figure}
