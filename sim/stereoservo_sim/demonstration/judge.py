"""Evaluation of the demonstration from its flight recording and the simulated ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stereoservo.calibration.trial_data import TrialData
from stereoservo.control.law_registry import LAWS
from stereoservo.core.cycle import Event, StepInputs, StepOutputs
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.recording.replay import ReplayResult, replay
from stereoservo_sim.demonstration.belt import Belt
from stereoservo_sim.world.simulated_cell import SimulatedCell

JUDGED_S = 1.0
TRACK_POINTS = 200


@dataclass
class Course:
    """Time series of a cell's run: times (k,), errors (k,), commands (k, n), ids of goals, and every event."""

    t_ns: IntArray
    error_px: FloatArray
    commands: FloatArray
    goal_ids: list[str]
    events: list[Event]


@dataclass
class RecordedDemonstration(Course):
    """Time series from a replayed recording, with the joints' velocity limits (n,) and the calibration's stops."""

    result: ReplayResult
    velocity_max: FloatArray
    trials: TrialData | None


@dataclass(frozen=True)
class Judgement:
    """Evaluation of one goal against ground truth. Errors are those of the mean over one second after the arm came to
    rest.
    """

    name: str
    law: str
    outcome: str
    final_error_px: float
    final_error_mm: float
    max_line_deviation_mm: float
    rotation_deg: float
    distance_mm: float
    steps: int
    seconds: float
    times_s: FloatArray = field(repr=False)
    error_px: FloatArray = field(repr=False)
    velocities: FloatArray = field(repr=False)
    path_m: FloatArray = field(repr=False)
    line_m: FloatArray = field(repr=False)
    tracks: Mapping[str, FloatArray] = field(repr=False)
    steady: Steady | None = None


@dataclass(frozen=True)
class Steady:
    """Accuracy of following a moving part, from when it was met, ``met_s`` after the goal's start, for ``seconds``,
    until the belt stopped.

    Distance of a marker from its position in the goal: rms and largest over markers, cameras and time, 99 % quantile
    over time, and the largest in space; the part's ``speed_mm_s``. NaN if it was not met.
    """

    speed_mm_s: float
    met_s: float
    seconds: float
    rms_px: float
    p99_px: float
    largest_px: float
    largest_mm: float


def read_flight(recording: Path) -> RecordedDemonstration:
    """Replay a recording and collect the data for the report. Raises RecordingError."""
    times: list[int] = []
    errors: list[float] = []
    commands: list[FloatArray] = []
    goals: list[str] = []
    events: list[Event] = []

    def observe(inputs: StepInputs, outputs: StepOutputs) -> None:
        times.append(inputs.now_ns)
        status = outputs.status
        errors.append(np.nan if status.error_px is None else status.error_px)
        commands.append(status.command)
        goals.append(status.goal)
        events.extend(outputs.events)

    settings: list[CoreSettings] = []
    result = replay(recording, observe=observe, header=settings.append)
    job = TrialCollector(settings[0])
    for event in events:
        job.add(event)
    return RecordedDemonstration(
        np.array(times),
        np.array(errors),
        np.array(commands),
        goals,
        events,
        result,
        settings[0].limits.velocity_max,
        job.trials() if job.stops else None,
    )


def judge_goal(
    name: str,
    law: str,
    outcome: str,
    flight: Course,
    truth_t: IntArray,
    truth_q: FloatArray,
    cell: SimulatedCell,
    belt: Belt | None = None,
) -> Judgement:
    """Evaluate the goal that was taught as ``name`` and executed with ``law``, on a part carried by a ``belt``.
    Raises LookupError if it was not executed.
    """
    taught = next((e for e in flight.events if e.kind == "taught" and e.name == name), None)
    if taught is None:
        raise LookupError(f"goal {name!r} was never taught")
    start, end = _flown(name, flight)
    shown = _during(truth_t, truth_q, taught.t_ns - int(0.5e9), taught.t_ns)
    reached = _during(truth_t, truth_q, end.t_ns + int(0.1e9), end.t_ns + int((0.1 + JUDGED_S) * 1e9))
    way = (truth_t >= start.t_ns) & (truth_t <= end.t_ns)
    places = _Places(cell, belt)
    seen = [
        (places.at(t), q)
        for t, q in zip(*(values[way][:: max(1, int(way.sum()) // 400)] for values in (truth_t, truth_q)), strict=True)
    ]
    path = np.array([here.marker_positions_rig(q).mean(axis=0) for here, q in seen])
    at_end = places.at(end.t_ns)
    shown_points = np.mean([cell.marker_positions_rig(q) for q in shown], axis=0)
    start_points = seen[0][0].marker_positions_rig(seen[0][1])
    reached_points = np.mean([at_end.marker_positions_rig(q) for q in reached], axis=0)
    line = np.array([path[0], shown_points.mean(axis=0)])
    steps = (flight.t_ns >= start.t_ns) & (flight.t_ns <= end.t_ns)
    pixels = [here.truth_pixels(q) for here, q in seen[:: max(1, len(seen) // TRACK_POINTS)]]
    return Judgement(
        name=name,
        law=law,
        outcome=outcome,
        final_error_px=_pixel_error(at_end, reached, cell, shown),
        final_error_mm=float(1e3 * np.linalg.norm(reached_points - shown_points, axis=1).max()),
        max_line_deviation_mm=float(1e3 * _line_distance(path, line).max()),
        rotation_deg=_rotation_deg(start_points, shown_points),
        distance_mm=float(1e3 * np.linalg.norm(line[1] - line[0])),
        steps=int(steps.sum()),
        seconds=(end.t_ns - start.t_ns) * 1e-9,
        times_s=(flight.t_ns[steps] - start.t_ns) * 1e-9,
        error_px=flight.error_px[steps],
        velocities=flight.commands[steps],
        path_m=path,
        line_m=line,
        tracks={camera.name: np.array([p[camera.name] for p in pixels]) for camera in cell.rig.cameras},
        steady=None if belt is None else _steady(start, flight, (truth_t, truth_q), shown, places, belt),
    )


class _Places:
    """The cell with its part at its pose on the belt over time."""

    def __init__(self, cell: SimulatedCell, belt: Belt | None) -> None:
        self.cell, self._belt = cell, belt

    def at(self, t_ns: int) -> SimulatedCell:
        return self.cell if self._belt is None else self._belt.cell_at(self.cell, int(t_ns))


def _steady(
    start: Event,
    flight: Course,
    truth: tuple[IntArray, FloatArray],
    shown: FloatArray,
    places: _Places,
    belt: Belt,
) -> Steady:
    """Following accuracy of a goal that started at ``start`` and was taught at joints ``shown`` (k, n)."""
    speed = 1e3 * float(np.linalg.norm(belt.conveyor.velocity_m_s))
    met = next((e for e in flight.events if e.kind == "target_met" and e.id == start.id), None)
    if met is None:
        return Steady(speed, *(6 * [np.nan]))
    stops_ns = belt.stops_ns(met.t_ns)
    times, positions = truth
    judged = (times >= met.t_ns) & (times <= stops_ns)
    cell = places.cell
    goal_points = np.mean([cell.marker_positions_rig(q) for q in shown], axis=0)
    goal_pixels = {
        camera.name: np.mean([cell.truth_pixels(q)[camera.name] for q in shown], axis=0) for camera in cell.rig.cameras
    }
    apart_px, apart_mm = [], 0.0
    for t, q in zip(times[judged][::5], positions[judged][::5], strict=True):
        here = places.at(t)
        pixels = here.truth_pixels(q)
        apart_px.append([np.linalg.norm(pixels[name] - goal, axis=1) for name, goal in goal_pixels.items()])
        apart_m = np.linalg.norm(here.marker_positions_rig(q) - goal_points, axis=1).max()
        apart_mm = max(apart_mm, float(1e3 * apart_m))
    found = np.array(apart_px)
    return Steady(
        speed,
        (met.t_ns - start.t_ns) * 1e-9,
        (stops_ns - met.t_ns) * 1e-9,
        float(np.sqrt((found**2).mean())),
        float(np.quantile(found.max(axis=(1, 2)), 0.99)),
        float(found.max()),
        apart_mm,
    )


def _flown(name: str, flight: Course) -> tuple[Event, Event]:
    """Start and end of the execution of the goal ``name``: goals are executed in the order of teaching, after all of
    it.
    """
    taught = [e.name for e in flight.events if e.kind == "taught"]
    begun = [e for e in flight.events if e.kind == "goal_started" and e.name in LAWS]
    order = taught.index(name)
    if order >= len(begun):
        raise LookupError(f"goal {name!r} was never started; visual goals started: {len(begun)}")
    start = begun[order]
    terminal = ("goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted")
    return start, next(e for e in flight.events if e.kind in terminal and e.id == start.id)


def _during(times: IntArray, positions: FloatArray, start_ns: int, end_ns: int) -> FloatArray:
    """Every fifth ground truth sample of an interval. Raises LookupError if there is none."""
    inside = positions[(times >= start_ns) & (times <= end_ns)]
    if len(inside) == 0:
        raise LookupError(f"no true joint position between {start_ns} and {end_ns} ns")
    return inside[::5]


def _pixel_error(place: SimulatedCell, reached: FloatArray, cell: SimulatedCell, shown: FloatArray) -> float:
    """Largest distance [px], over cameras and markers seen at the goal, of the mean noise-free reprojections at joints
    ``reached`` in ``place`` from those at joints ``shown`` in ``cell``.
    """
    worst = 0.0
    for camera in cell.rig.cameras:
        seen = cell.visible(shown[0], camera)
        a = np.mean([place.truth_pixels(q)[camera.name] for q in reached], axis=0)
        b = np.mean([cell.truth_pixels(q)[camera.name] for q in shown], axis=0)
        worst = max(worst, float(np.linalg.norm(a - b, axis=1)[seen].max()))
    return worst


def _line_distance(points: FloatArray, line: FloatArray) -> FloatArray:
    direction = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
    offset = points - line[0]
    distance: FloatArray = np.linalg.norm(offset - (offset @ direction)[:, None] * direction, axis=1)
    return distance


def _rotation_deg(start: FloatArray, goal: FloatArray) -> float:
    """Angle between two poses of one point set (Kabsch)."""
    u, _, vt = np.linalg.svd((goal - goal.mean(axis=0)).T @ (start - start.mean(axis=0)))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0))))
