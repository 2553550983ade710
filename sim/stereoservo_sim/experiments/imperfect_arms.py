"""Experiments: goals in images for imperfect arms, or before a camera that creeps, by the servo core with its model
monitor and safety stage.

Cells are those of `random_rigs`; a range of seeds is continued by another: ``--seed 100 --seeds 100`` are the cases
after ``--seeds 100``.

``imperfect-arms``: number of goals reached, and true distance of those reported as reached from their set-points.
Every joint has play, sag, gear ripple and friction at once, and its zero is off by some tenths of a degree since
calibration. No camera moves. The model is learnt from the same arm's calibration motion (``self``), or the true
one, which states the errors of the readings caused by the mechanics (``exact``).

``creeping-cameras``: goals are sent, one a minute, while a random camera rotates and translates about random axes by
``CREEP_PX`` a minute, rms over the markers; or, in a healthy case, none does. Each case has one imperfection of the arm
or of the stamps, in turn, and a model learnt from the same cell's calibration motion. It ends with the first goal that
is refused, or waits without an end.

``preset-verdicts``: arms with the mechanics of each preset at work for ten virtual minutes, one goal after the other,
and every verdict of the model monitor. All verdicts are false, since nothing moves but the arm.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.experiment import ExperimentError, cases, crossed
from stereoservo_sim.experiments.figures import drawing_sorted
from stereoservo_sim.experiments.random_rigs import simulated_trials
from stereoservo_sim.kept_models import model_of_trials
from stereoservo_sim.progress import ProgressCall, counted, silent
from stereoservo_sim.summaries import count_row
from stereoservo_sim.tasks.driven_cell import RATE_HZ, TOLERANCE_PX, Creep, DrivenCell, GoalEnd, Imperfections
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.mechanical_trials import synthetic_load
from stereoservo_sim.world.mechanics import PRESETS, Mechanics, preset
from stereoservo_sim.world.presets import MechanicsPreset
from stereoservo_sim.world.random_cells import RandomCase, random_case
from stereoservo_sim.world.synthetic import SyntheticCell

MODELS = ("self", "exact")
PLAY, SAG = np.deg2rad(1.5), np.deg2rad(1.0)
"""Largest values of each joint [rad]."""
RIPPLES = (0.02e-3, 1e-3)
"""Range of the ripple [rad], log-uniform."""
FRICTION = 0.01
"""Largest value of each joint [rad/s]."""
ZERO_OFFSET = np.deg2rad(0.3)
"""Largest value of each joint [rad]."""
NOISES = (0.02, 0.2)
"""Range of the noise [px], log-uniform."""
GOALS = 2
"""Goals per case."""
SHARE = 0.5
"""Share of the calibration ranges in which goals are drawn."""
REST_S = 60.0
"""Time at rest after each goal that is reported as reached."""
AVERAGED_S = 1.0
"""Time over which the true error is averaged, at the beginning of this rest."""
FALSE = 2.0
"""Largest true error of a goal reported as reached, in tolerances."""
DRAWS = 200


class GoalVerdict(msgspec.Struct, frozen=True):
    """Outcome of a goal. ``outcome``: ``reached``, ``refused`` before motion, ``held``, ``aborted``. ``error_px``: the
    true one, ``later_px`` a minute later; ``reversals`` of commands in this minute. ``codes``, ``verdict``: reported by
    the core. ``zero_load``: joints whose load is too small at the goal to press their links against a flank.
    """

    seed: int
    goal: int
    outcome: str
    seconds: float
    error_px: float
    later_px: float
    reversals: int
    codes: tuple[str, ...]
    verdict: str
    zero_load: tuple[str, ...]


class CaseVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case: its goals, or the ``code`` and ``message`` of a failed calibration."""

    seed: int
    goals: tuple[GoalVerdict, ...] = ()
    code: str = ""
    message: str = ""


def imperfect_arm(seed: int) -> tuple[RandomCase, Imperfections]:
    """The rig of ``seed`` and the imperfections of its arm."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 6])
    n = len(case.cell.home)
    play, sag, friction = rng.uniform(0.0, 1.0, 3) * (PLAY, SAG, FRICTION)
    ripple = np.exp(rng.uniform(*np.log(RIPPLES)))
    gears = [
        Mechanics(
            play=float(play * rng.uniform(0.5, 1.0)),
            sag=float(sag),
            dead_speed=float(friction * rng.uniform(0.5, 1.0)),
            ripple=float(ripple),
            ripple_order=float(rng.uniform(100.0, 320.0)),
            ripple_phase=float(rng.uniform(0.0, 2.0 * np.pi)),
        )
        for _ in range(n)
    ]
    noise = float(np.exp(rng.uniform(*np.log(NOISES))))
    offset = rng.uniform(-1.0, 1.0, n) * rng.uniform(0.0, ZERO_OFFSET)
    return case, Imperfections(tuple(gears), offset, noise_px=noise)


def model_of(case: RandomCase, wrong: Imperfections, kind: str) -> CellModel:
    """The arm's model, with its zeros as at calibration. Raises CalibrationError."""
    gears = wrong.mechanics
    assert gears is not None
    if kind == "exact":
        play, sag, ripple = (np.array([getattr(g, name) for g in gears]) for name in ("play", "sag", "ripple"))
        random = np.hypot(0.5 * play, ripple / np.sqrt(2.0))
        off = np.full(len(gears), ZERO_OFFSET / np.sqrt(3.0))
        stated = np.sqrt(random**2 + sag**2 + off**2)
        return msgspec.structs.replace(
            exact_model(case.cell), joint_accuracy=JointAccuracy(random, np.hypot(sag, off), stated, sag)
        )
    return learnt_model(case, wrong)


def learnt_model(case: RandomCase, wrong: Imperfections) -> CellModel:
    """The model of the arm's own calibration motion. Raises CalibrationError."""
    assert wrong.mechanics is not None
    return model_of_trials(simulated_trials(case, wrong.mechanics, wrong.noise_px)).model


def places_in_view(
    case: RandomCase, rng: np.random.Generator, count: int | None, share: float = SHARE, draws: int = DRAWS
) -> FloatArray:
    """Configurations (k, n) of the links, k up to ``count``, with all markers in both images, from ``draws`` draws from
    a ``share`` of the calibration ranges. Raises CalibrationError for fewer.
    """
    drawn = case.cell.held_out(rng, draws, share)
    found = drawn[case.cell.in_view(drawn, 10.0).all(axis=(0, 2))][:count]
    if len(found) < (count or 2):
        raise CalibrationError("no_goals", f"{len(found)} places with all markers in view")
    return found


def outcome(end: GoalEnd) -> str:
    """The end of a goal as a word."""
    return {"goal_reached": "reached", "refused": "refused", "": "held"}.get(end.kind, "aborted")


def farthest(shown: FloatArray, wanted: FloatArray) -> float:
    """Largest distance [px] of markers (c, m, 2) from their set-points."""
    return float(np.linalg.norm(shown - wanted, axis=-1).max())


def judged_case(seed: int, model: str = "self", rest_s: float = REST_S) -> CaseVerdict:
    """Outcome of the case of ``seed``."""
    case, wrong = imperfect_arm(seed)
    try:
        learnt = model_of(case, wrong, model)
        places = places_in_view(case, np.random.default_rng([seed, 7]), GOALS + 1)
    except CalibrationError as error:
        return CaseVerdict(seed, code=error.code, message=error.message)
    driven = DrivenCell(case.cell, learnt, places[0], seed, wrong)
    goals = []
    for k, place in enumerate(places[1:]):
        goals.append(_judged_goal(driven, seed, k, place, rest_s))
        if goals[-1].outcome != "reached":
            break
    return CaseVerdict(seed, tuple(goals))


def _judged_goal(driven: DrivenCell, seed: int, number: int, place: FloatArray, rest_s: float) -> GoalVerdict:
    cell = driven.cell
    wanted = cell.pixels(place[None])[:, 0]
    end = driven.run_goal(wanted)
    reached = end.kind == "goal_reached"
    shown, first = driven.rest(min(AVERAGED_S, rest_s))
    further = max(rest_s - AVERAGED_S, 0.0) if reached else 0.0
    later, more = driven.rest(further) if further > 0.0 else (shown, 0)
    friction = np.array([joint.play_friction for joint in driven.mechanics])
    small = np.abs(synthetic_load(cell, place)) < friction
    return GoalVerdict(
        seed, number, outcome(end), end.seconds, farthest(shown, wanted), farthest(later, wanted), first + more,
        end.codes, end.verdict, tuple(np.array(cell.joint_names)[small].tolist()),
    )  # fmt: skip


def run_imperfect_arms(
    seeds: int, seed: int = 0, model: str = "self", progress: ProgressCall = silent
) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: outcomes with Wilson bounds, every goal that is not reached with the
    core's report, and every goal falsely reported as reached.

    Raises ExperimentError for an unknown ``model``.
    """
    if model not in MODELS:
        raise ExperimentError("option", f"--model {model!r}; known: {', '.join(MODELS)}")
    judged = cases(lambda k: judged_case(k, model), seeds, seed, progress)
    goals = [goal for case in judged for goal in case.goals]
    reached = [goal for goal in goals if goal.outcome == "reached"]
    false = [g for g in reached if max(g.error_px, g.later_px) > FALSE * TOLERANCE_PX]
    lost = [g for g in goals if g.outcome not in ("reached", "refused")]
    moved = len(reached) + len(lost)
    return {
        "model": model,
        "title": f"imperfect-arms: cases {seed} to {seed + seeds - 1}, model {model}, tolerance {TOLERANCE_PX:g} px",
        "rows": [
            count_row("reached", len(reached), moved),
            count_row("falsely called reached", len(false), len(reached)),
            count_row("reversal in 60 s", sum(goal.reversals > 0 for goal in reached), len(reached)),
        ],
        "errors_px": {
            "when reached": [goal.error_px for goal in reached],
            "a minute later": [goal.later_px for goal in reached],
        },
        "error_px": _spread([goal.error_px for goal in reached]),
        "later_px": _spread([goal.later_px for goal in reached]),
        "seconds": _spread([goal.seconds for goal in reached]),
        "refused_goals": dict(Counter(goal.codes[0] for goal in goals if goal.outcome == "refused" and goal.codes)),
        "no_model": dict(Counter(case.code for case in judged if case.code)),
        "false": [msgspec.to_builtins(goal) for goal in false],
        "lost": [msgspec.to_builtins(goal) for goal in lost],
        "thesis": {"note": "none: the thesis has joints without errors"},
    }


def _spread(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"median": float(np.median(values)), "p99": float(np.quantile(values, 0.99)), "max": max(values)}


draw_imperfect_arms = drawing_sorted("imperfect_arms", "errors_px", "true error [px]", FALSE * TOLERANCE_PX)
"""True errors of goals reported as reached, then and a minute later, beside the limit for false ones."""


def notes_imperfect_arms(answer: dict[str, Any]) -> Iterator[str]:
    """Spreads, and every goal that was lost or falsely reported as reached."""
    for name, unit in (("error_px", "px"), ("later_px", "px"), ("seconds", "s")):
        if answer[name] is not None:
            spread = ", ".join(f"{key} {value:.3g}" for key, value in answer[name].items())
            yield f"{name} of goals that were reached: {spread} {unit}"
    yield f"refused before motion: {answer['refused_goals']}; cases without a model: {answer['no_model']}"
    for kind in ("false", "lost"):
        for goal in answer[kind]:
            yield (
                f"{kind}: case {goal['seed']} goal {goal['goal']}: {goal['outcome']} after {goal['seconds']:.1f} s, "
                f"true error {goal['error_px']:.3g} px, {goal['later_px']:.3g} px later, watch {goal['verdict']}, "
                f"{', '.join(goal['codes'])}"
                + (f"; load near zero: {', '.join(goal['zero_load'])}" if goal["zero_load"] else "")
            )


# -- a camera that creeps --------------------------------------------------------------------------------------

KINDS = ("exact", "ripple", "play", "sag", "late")
"""Imperfection in the case of seed k: the one at k modulo their number."""
CREEP_PX = 0.5
"""Creep [px a minute], rms over the markers, at the case's home."""
TURNED = 0.7
"""Share of the creep due to rotation; the rest is due to translation."""


CREEP_GOALS = 3
EVERY_S = 60.0
"""Time from one goal to the next."""
LIMIT_S = 20.0
CREEP_AVERAGED_S = 0.5


CREEP_FALSE = 1.5
"""Largest true error in the images of static cameras, in tolerances, of a goal correctly reported as reached: its
tolerance, and the part of it by which cameras may be displaced (`core.sources.progress.SHARE`).
"""


class CreepVerdict(msgspec.Struct, frozen=True):
    """Outcome of a goal, sent ``minutes`` after the first step: ``outcome`` as reported by the core, ``codes`` and
    ``verdict`` of the core, the true ``error_px`` in the images of static cameras, the camera's displacement
    ``crept_px`` in its images there, and the distance of the body from its goal [mm].
    """

    seed: int
    kind: str
    goal: int
    outcome: str
    codes: tuple[str, ...]
    verdict: str
    error_px: float
    crept_px: float
    beside_mm: float


def creeping_case(seed: int) -> tuple[RandomCase, str, Imperfections]:
    """The rig of ``seed``, its imperfection, and the camera that creeps."""
    case, kind = random_case(seed), KINDS[seed % len(KINDS)]
    rng = np.random.default_rng([seed, 16])
    noise = float(np.exp(rng.uniform(*np.log(NOISES))))
    joints = [
        {
            "ripple": Mechanics(
                ripple=float(np.exp(rng.uniform(*np.log((0.02e-3, 1e-3))))),
                ripple_order=float(rng.uniform(100, 320)),
                ripple_phase=float(rng.uniform(0.0, 2.0 * np.pi)),
            ),
            "play": Mechanics(play=float(np.deg2rad(rng.uniform(0.0, 0.5)))),
            "sag": Mechanics(sag=float(np.deg2rad(rng.uniform(0.0, 1.0)))),
        }.get(kind, Mechanics())
        for _ in case.cell.home
    ]
    late_s, jitter_s = (float(rng.uniform(0.0, 0.03)), 0.01) if kind == "late" else (0.0, 0.0)
    creep = drawn_creep(case.cell, rng)
    return case, kind, Imperfections(joints, late_s=late_s, jitter_s=jitter_s, noise_px=noise, creep=creep)


def drawn_creep(cell: SyntheticCell, rng: np.random.Generator) -> Creep:
    """A random camera, and the direction in which it creeps by ``CREEP_PX`` a minute."""
    camera, directions = int(rng.integers(len(cell.poses))), rng.standard_normal((2, 3))
    sizes = []
    for k, direction in enumerate(directions):
        twist = np.zeros(6)
        twist[3 * (1 - k) : 3 * (2 - k)] = 1e-5 * direction
        sizes.append(twist * (TURNED, 1.0 - TURNED)[k] / _rms(cell, Creep(camera, twist), 1.0, cell.home))
    twist = sizes[0] + sizes[1]
    return Creep(camera, twist * CREEP_PX / 60.0 / _rms(cell, Creep(camera, 1e-3 * twist), 1.0, cell.home) * 1e-3)


def _rms(cell: SyntheticCell, creep: Creep, seconds: float, q: FloatArray) -> float:
    """Rms pixel change [px] of the creeping camera with the arm at ``q``."""
    off = creep.moved(cell, seconds).pixels(q[None]) - cell.pixels(q[None])
    return float(np.sqrt((off[creep.camera] ** 2).sum(axis=-1).mean()))


def judged_creep(seed: int, *, creeps: bool, goals: int = CREEP_GOALS) -> list[CreepVerdict]:
    """Outcome of the goals of the case of ``seed``. Raises CalibrationError."""
    case, kind, wrong = creeping_case(seed)
    cell, creep = case.cell, wrong.creep
    model = learnt_model(case, wrong)
    rng = np.random.default_rng([seed, 7])
    places = places_in_view(case, rng, goals + 1)
    assert creep is not None
    driven = DrivenCell(cell, model, places[0], seed, wrong if creeps else replace(wrong, creep=None))
    found = []
    first_s = float(rng.uniform(0.0, EVERY_S))
    for k, place in enumerate(places[1:]):
        driven.rest(max(0.0, first_s + k * EVERY_S - driven.seconds))
        wanted = cell.pixels(place[None])[:, 0]
        end = driven.run_goal(wanted, time_limit_s=LIMIT_S)
        crept = _rms(cell, creep, driven.seconds, driven.links) if creeps else 0.0
        ended = outcome(end)
        shown, _ = driven.rest(CREEP_AVERAGED_S)
        off = (cell.markers(driven.links[None]) - cell.markers(place[None]))[0, :, :3]
        beside_mm = 1e3 * float(np.linalg.norm(off, axis=1).max())
        found.append(
            CreepVerdict(seed, kind, k, ended, end.codes, end.verdict, farthest(shown, wanted), crept, beside_mm)
        )
        if ended in ("held", "refused"):
            break
    return found


def run_creeping_cameras(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``, with a creeping camera and without: goals reported as reached and held,
    with Wilson bounds, and every false report.
    """
    found: dict[bool, list[CreepVerdict]] = {True: [], False: []}
    no_model: Counter[str] = Counter()
    for k in counted(progress, "cases", seeds):
        for creeps in (True, False):
            try:
                found[creeps] += judged_creep(seed + k, creeps=creeps)
            except CalibrationError as error:
                no_model[error.code] += 1
    crept = [goal for goal in found[True] if goal.outcome == "reached"]
    healthy = [goal for goal in found[False] if goal.outcome != "refused"]
    false = [goal for goal in crept if goal.error_px > CREEP_FALSE * TOLERANCE_PX]
    held = [goal for goal in healthy if "CAMERAS_DISAGREE" in goal.codes]
    return {
        "title": f"creeping-cameras: cases {seed} to {seed + seeds - 1}, {CREEP_PX:g} px a minute, tolerance "
        f"{TOLERANCE_PX:g} px",
        "rows": [
            count_row("creep: called reached", len(crept), len(found[True])),
            count_row("creep: reached beyond tolerance", sum(g.error_px > TOLERANCE_PX for g in crept), len(crept)),
            count_row("creep: falsely called reached", len(false), len(crept)),
            count_row("healthy: called reached", sum(g.outcome == "reached" for g in healthy), len(healthy)),
            count_row("healthy: cameras said to disagree", len(held), len(healthy)),
        ],
        "errors_px": {
            "creeping camera": [goal.error_px for goal in crept],
            "healthy": [goal.error_px for goal in healthy if goal.outcome == "reached"],
        },
        "beside_mm": {"creeping camera": max((goal.beside_mm for goal in crept), default=None)},
        "no_model": dict(no_model),
        "false": [msgspec.to_builtins(goal) for goal in false],
        "held": [msgspec.to_builtins(goal) for goal in held],
        "thesis": {"note": "none: the thesis's cameras stand"},
    }


draw_creeping_cameras = drawing_sorted("creeping_cameras", "errors_px", "true error [px]", CREEP_FALSE * TOLERANCE_PX)
"""True errors of goals reported as reached, beside the limit for false ones."""


def notes_creeping_cameras(answer: dict[str, Any]) -> Iterator[str]:
    """Every goal that was falsely reported as reached or falsely held."""
    yield f"cases without a model: {answer['no_model']}"
    for kind in ("false", "held"):
        for goal in answer[kind]:
            yield (
                f"{kind}: case {goal['seed']} ({goal['kind']}) goal {goal['goal']}: {goal['outcome']}, true error "
                f"{goal['error_px']:.3g} px, {goal['beside_mm']:.2g} mm, creep {goal['crept_px']:.2g} px, "
                + ", ".join(goal["codes"])
            )


# -- presets of mechanics --------------------------------------------------------------------------------------

MINUTES = 10.0
NOISE_PX = 0.05
PAUSE_S = 1.0
"""Time between goals."""


class PresetVerdict(msgspec.Struct, frozen=True):
    """A case at work with a preset: ``minutes`` of virtual time, ends of its goals, durations [s] of those reached, and
    the ``verdicts`` of the model monitor. ``code``: why there is no model.
    """

    seed: int
    preset: str
    minutes: float = 0.0
    ends: dict[str, int] = {}
    seconds: tuple[float, ...] = ()
    verdicts: tuple[str, ...] = ()
    code: str = ""


def watched_preset(seed: int, name: MechanicsPreset, minutes: float = MINUTES) -> PresetVerdict:
    """The case of ``seed`` at work with the mechanics ``name``."""
    case = random_case(seed)
    wrong = Imperfections(preset(name, len(case.cell.home)), noise_px=NOISE_PX)
    try:
        model = learnt_model(case, wrong)
        places = places_in_view(case, np.random.default_rng([seed, 7]), None)
    except CalibrationError as error:
        return PresetVerdict(seed, name, code=error.code)
    driven = DrivenCell(case.cell, model, places[0], seed, wrong)
    driven.verdicts.clear()
    ends: list[str] = []
    seconds: list[float] = []
    cycles = round(60.0 * minutes * RATE_HZ)
    while len(driven.path) < cycles:
        wanted = case.cell.pixels(places[(len(ends) + 1) % len(places)][None])[:, 0]
        end = driven.run_goal(wanted)
        ends.append(end.kind if end.kind in ("goal_reached", "refused") else ", ".join(end.codes))
        if end.kind == "goal_reached":
            seconds.append(end.seconds)
        driven.rest(PAUSE_S)
    at_work = len(driven.path) / RATE_HZ / 60.0
    return PresetVerdict(seed, name, at_work, dict(Counter(ends)), tuple(seconds), tuple(driven.verdicts))


def run_preset_verdicts(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1`` with every preset: minutes at work, goals and verdicts of each."""
    found = crossed(lambda name, k: watched_preset(k, name), tuple(PRESETS), seeds, seed, progress, "presets")
    watched = [of_seed for several in zip(*found, strict=True) for of_seed in several]
    rows = [
        {
            "preset": case.preset,
            "seed": case.seed,
            "minutes": case.minutes,
            "goals": sum(case.ends.values()),
            "reached": case.ends.get("goal_reached", 0),
            "refused": case.ends.get("refused", 0),
            "verdicts": ", ".join(case.verdicts) or case.code or "none",
        }
        for case in watched
    ]
    return {
        "title": f"preset-verdicts: cases {seed} to {seed + seeds - 1}",
        "rows": rows,
        "ends": {f"{case.preset} {case.seed}": case.ends for case in watched},
        "seconds": {name: [s for c in watched if c.preset == name for s in c.seconds] for name in PRESETS},
        "thesis": {"note": "none: the thesis has joints without errors"},
    }


draw_preset_verdicts = drawing_sorted("preset_verdicts", "seconds", "time to the goal [s]")
"""Durations of reached goals, by preset."""


def notes_preset_verdicts(answer: dict[str, Any]) -> Iterator[str]:
    """Ends of the goals, by preset."""
    return (f"{name}: {ends}" for name, ends in answer["ends"].items())
