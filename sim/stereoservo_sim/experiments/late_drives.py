"""Experiments: delayed drives and images, on the cells of `random_rigs`, with equal joints, by the servo core; a
range of seeds is continued by another.

``late-drives``: drives obey commands 100 to 200 ms late and are held by friction of up to 10 mrad/s, both unreported.
Goals use the model fitted to the arm's own calibration motion, and beside it the true one. Each goal is run by a newly
started core, which knows no delay: the delay measured in the calibration motion is discarded.

``damped-drives`` (thesis 9.3): drives follow their velocity with a lag, or obey late; goals with and without damping,
with the true model, over paths so short that gain and lag are decisive, not the joints' limits.

``late-pictures``: images are 0 to 150 ms older than their stamps, with up to 20 ms of jitter, unreported. The core's
calibration motion shows the offset, and the model states it. A goal is run with the fitted model, with the true offset
in its place, and with none.

The overshoot is the largest distance of a marker beyond its set-point in an image, along its path, as a share of the
longest path of a marker.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.model import CellModel, ShutterOffset
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.experiment import cases, crossed
from stereoservo_sim.experiments.figures import Figures, drawing_sorted, sorted_values
from stereoservo_sim.experiments.imperfect_arms import farthest, places_in_view
from stereoservo_sim.kept_models import kept_model
from stereoservo_sim.progress import ProgressCall, silent
from stereoservo_sim.summaries import count_row
from stereoservo_sim.tasks.driven_cell import TOLERANCE_PX, DrivenCell, GoalEnd, Imperfections
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.random_cells import RandomCase, random_case
from stereoservo_sim.world.synthetic import SyntheticCell

DELAYS_S, FRICTION = (0.1, 0.2), 0.01
"""Ranges of the delay [s] and the friction [rad/s]."""
NOISE_PX = 0.05


WITHIN = 2.0
"""Largest true error at rest, in tolerances."""
MORE = 0.01
"""Excess over the true model's overshoot that counts, as a share of the longest path."""
LONG = 0.5
"""Least length of a path whose overshoot counts, as a share of the longest path in the images."""
MODELS = ("learnt", "true")


class DriveVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case: by model, the goal's end, its true error [px] at rest and the overshoot. ``code``: why there
    is none.
    """

    seed: int
    delay_s: float
    friction: float
    ends: dict[str, str] = {}
    errors_px: dict[str, float] = {}
    overshoot: dict[str, float] = {}
    code: str = ""


def judged_drives(seed: int) -> DriveVerdict:
    """Outcome of the case of ``seed``."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 10])
    delay_s, friction = float(rng.uniform(*DELAYS_S)), float(rng.uniform(0.0, FRICTION))
    gears = [Mechanics(delay_s=delay_s, dead_speed=friction)] * len(case.cell.home)
    wrong = Imperfections(gears, noise_px=NOISE_PX)
    verdict = DriveVerdict(seed, delay_s, friction, {}, {}, {})
    try:
        start, goal = places_in_view(case, rng, 2)
        learnt = _learnt_by_core(case, wrong)
    except CalibrationError as error:
        return msgspec.structs.replace(verdict, code=error.code)
    for name, model in zip(MODELS, (learnt, exact_model(case.cell)), strict=True):
        driven = DrivenCell(case.cell, model, start, seed, wrong)
        verdict.ends[name], verdict.errors_px[name] = _driven_to(driven, goal)
        verdict.overshoot[name] = overshoot_of(case.cell, driven, goal)
    return verdict


def _learnt_by_core(case: RandomCase, wrong: Imperfections) -> CellModel:
    """The model of the calibration motion driven by the servo core. Raises CalibrationError."""

    def learn() -> CellModel:
        return fit_model(DrivenCell(case.cell, None, case.cell.home, case.seed, wrong).trials(), epoch=1).model

    return kept_model(("driven by the core", case.cell, case.seed, wrong), learn).model


def _driven_to(driven: DrivenCell, goal: FloatArray) -> tuple[str, float]:
    """The end of a goal at the configuration ``goal`` (n,), and its true error [px] after a second of rest."""
    wanted = driven.cell.pixels(goal[None])[:, 0]
    end = driven.run_goal(wanted)
    shown, _ = driven.rest(1.0)
    return end.kind if end.kind == "goal_reached" or not end.codes else end.codes[0], farthest(shown, wanted)


def overshoot_of(cell: SyntheticCell, driven: DrivenCell, goal: FloatArray) -> float:
    """Overshoot of the arm's motion to the configuration ``goal`` (n,), as a share of the longest path of a marker."""
    pixels, wanted = cell.pixels(np.array(driven.path)), cell.pixels(goal[None])[:, 0]
    way = wanted - pixels[:, 0]
    length = np.linalg.norm(way, axis=-1)
    beyond = ((pixels - wanted[:, None]) * (way / np.maximum(length, 1e-9)[..., None])[:, None]).sum(axis=-1)
    most = beyond.max(axis=1)[length >= LONG * length.max()]
    return max(0.0, float(most.max() / length.max()))


def run_late_drives(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: goals within tolerance and overshoot beside that of the true model."""
    judged = cases(judged_drives, seeds, seed, progress)
    known = [case for case in judged if not case.code]
    driven = [case for case in known if case.ends["true"] == "goal_reached"]
    within = [
        c for c in driven if c.ends["learnt"] == "goal_reached" and c.errors_px["learnt"] <= WITHIN * TOLERANCE_PX
    ]
    more = [case for case in within if case.overshoot["learnt"] > case.overshoot["true"] + MORE]
    return {
        "title": f"late-drives: cases {seed} to {seed + seeds - 1}, of those that the true model reaches",
        "rows": [
            count_row("reached, within tolerance", len(within), len(driven)),
            count_row("more overshoot", len(more), len(within)),
        ],
        "overshoot": {
            name: float(np.max([case.overshoot[name] for case in within])) if within else None for name in MODELS
        },
        "overshoots": {name: [case.overshoot[name] for case in within] for name in MODELS},
        "ends": {name: dict(Counter(case.ends[name] for case in known)) for name in MODELS},
        "no_case": dict(Counter(case.code for case in judged if case.code)),
        "lost": [msgspec.to_builtins(case) for case in driven if case not in within]
        + [msgspec.to_builtins(c) for c in more],
        "thesis": {"note": "none: the thesis has drives without delay"},
    }


draw_late_drives = drawing_sorted("late_drives", "overshoots", "overshoot, of the longest way")
"""Overshoots with the learnt model and with the true one."""


def notes_late_drives(answer: dict[str, Any]) -> Iterator[str]:
    """The largest overshoots, the ends of goals, and every case beyond the limits."""
    yield f"largest overshoot, of the way: {answer['overshoot']}; ends: {answer['ends']}; {answer['no_case']}"
    yield from map(str, answer["lost"])


# -- damping ---------------------------------------------------------------------------------------------------

DRIVES = {"lag 0.1 s": Mechanics(lag_s=0.1), "lag 0.2 s": Mechanics(lag_s=0.2), "0.1 s late": Mechanics(delay_s=0.1)}
SETTINGS = ((2.0, 0.0), (4.0, 0.0), (8.0, 0.0), (4.0, 0.5), (8.0, 0.5), (8.0, 0.7))
"""Gains [1/s] and damping."""


DAMPED_SHARE = 0.08
"""Share of the joints' ranges from which goals are drawn."""
TIME_LIMIT_S = 20.0
LAW = "stereo"


def damped_goal(seed: int, drive: str, gain: float, damping: float) -> tuple[GoalEnd, float] | None:
    """The end of a goal of the case of ``seed`` and its overshoot; None if the case has no goal in view."""
    case = random_case(seed)
    try:
        start, goal = places_in_view(case, np.random.default_rng([seed, 19]), 2, DAMPED_SHARE)
    except CalibrationError:
        return None
    wrong = Imperfections([DRIVES[drive]] * len(case.cell.home), noise_px=NOISE_PX)
    driven = DrivenCell(case.cell, exact_model(case.cell), start, seed, wrong, law=LAW)
    wanted = case.cell.pixels(goal[None])[:, 0]
    end = driven.run_goal(wanted, gain=gain, damping=damping, time_limit_s=TIME_LIMIT_S)
    return end, overshoot_of(case.cell, driven, goal)


def run_damped_drives(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Run cases ``seed`` to ``seed + seeds - 1`` with every drive, gain and damping; returns the JSON object of the
    command.
    """
    rows: list[dict[str, Any]] = []
    curves: dict[str, list[float]] = {}
    conditions = [(drive, *setting) for drive in DRIVES for setting in SETTINGS]
    found = crossed(lambda condition, k: damped_goal(k, *condition), conditions, seeds, seed, progress)
    for (drive, gain, damping), flown in zip(conditions, found, strict=True):
        known = [one for one in flown if one is not None]
        reached = [(end, beyond) for end, beyond in known if end.kind == "goal_reached"]
        lost = Counter(end.codes[0] if end.codes else "-" for end, _ in known if end.kind != "goal_reached")
        beyond = [over for _, over in known]
        curves[f"{drive}, gain {gain:g}, damping {damping:g}"] = beyond
        rows.append(
            {
                "drives": drive,
                "gain": gain,
                "damping": damping,
                "reached": f"{len(reached)} of {len(known)}",
                "seconds": float(np.median([end.seconds for end, _ in reached])) if reached else None,
                "overshoot": float(np.median(beyond)) if beyond else None,
                "largest": max(beyond, default=None),
                "not_reached": ", ".join(f"{count} {code}" for code, count in lost.items()),
            }
        )
    return {
        "title": f"damped-drives: cases {seed} to {seed + seeds - 1}, law {LAW}; seconds and overshoot: medians",
        "rows": rows,
        "overshoots": curves,
        "thesis": {"note": "9.3 proposes PD control for tracking; it gives no figures"},
    }


draw_damped_drives = drawing_sorted("damped_drives", "overshoots", "overshoot, of the longest way")
"""Overshoots by drive, gain and damping."""


# -- late pictures ---------------------------------------------------------------------------------------------

LATEST_S, JITTER_S = 0.15, 0.02
"""Largest offset and jitter [s]."""


WITHIN_S = 0.002
"""Largest error of the mean offset [s]."""


PICTURE_DRAWS = 100
KNOWLEDGE = ("learnt", "true", "none")


class LateVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case: true mean offset and jitter [s], error of the model's offset (``residual_s``, the worst
    camera), and for each offset used the goal's end and its true error [px]. ``code``: no model.
    """

    seed: int
    late_s: float
    jitter_s: float
    residual_s: float = np.inf
    deviation_s: float = 0.0
    ends: dict[str, str] = {}
    errors_px: dict[str, float] = {}
    code: str = ""


def judged_late(seed: int, drive: bool = True) -> LateVerdict:
    """Outcome of the case of ``seed``; without goals unless ``drive``."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 9])
    late_s, jitter_s = rng.uniform(0.0, LATEST_S), rng.uniform(0.0, JITTER_S)
    wrong = Imperfections(late_s=late_s, jitter_s=jitter_s, noise_px=NOISE_PX)
    try:
        model = _learnt_by_core(case, wrong)
    except CalibrationError as error:
        return LateVerdict(seed, late_s, jitter_s, code=error.code)
    mean_s = -(late_s + 0.5 * jitter_s)
    found = {offset.camera: offset for offset in model.shutter_offsets}
    residual = max((abs(o.offset_s - mean_s) for o in found.values()), default=np.inf)
    residual = residual if len(found) == len(model.cameras) else np.inf
    deviation = max((o.deviation_s for o in found.values()), default=0.0)
    verdict = LateVerdict(seed, late_s, jitter_s, residual, deviation, {}, {})
    if drive:
        true = tuple(ShutterOffset(camera.name, mean_s, 1e-4) for camera in model.cameras)
        (goal,) = places_in_view(case, rng, 1, draws=PICTURE_DRAWS)
        for name, offsets in zip(KNOWLEDGE, (model.shutter_offsets, true, ()), strict=True):
            known = msgspec.structs.replace(model, shutter_offsets=offsets)
            driven = DrivenCell(case.cell, known, case.cell.home, seed, wrong)
            verdict.ends[name], verdict.errors_px[name] = _driven_to(driven, goal)
    return verdict


def run_late_pictures(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: number of offsets known to ``WITHIN_S``, ends of the goals by the offset
    used, and every case beyond the limits.
    """
    judged = cases(judged_late, seeds, seed, progress)
    known = [case for case in judged if not case.code]
    rows = [count_row("offset within 2 ms", sum(case.residual_s <= WITHIN_S for case in known), len(known))]
    for name in KNOWLEDGE:
        reached = sum(case.ends[name] == "goal_reached" for case in known)
        rows.append(count_row(f"goal reached, offset {name}", reached, len(known)))
    both = [c for c in known if c.ends["learnt"] == c.ends["true"] == "goal_reached"]
    errors = {name: float(np.mean([c.errors_px[name] for c in both])) if both else None for name in KNOWLEDGE[:2]}
    return {
        "title": f"late-pictures: cases {seed} to {seed + seeds - 1}",
        "rows": rows,
        "mean_error_px": errors,
        "residual_ms": [round(1e3 * case.residual_s, 3) for case in known if np.isfinite(case.residual_s)],
        "ends": {name: dict(Counter(case.ends[name] for case in known)) for name in KNOWLEDGE},
        "no_model": dict(Counter(case.code for case in judged if case.code)),
        "beyond": [_plain(case) for case in known if not case.residual_s <= WITHIN_S],
        "thesis": {"note": "none: 8.5 has cameras with a trigger"},
    }


def _plain(case: LateVerdict) -> dict[str, Any]:
    found: dict[str, Any] = msgspec.to_builtins(case)
    return found | {"residual_s": case.residual_s if np.isfinite(case.residual_s) else None}


def draw_late_pictures(answer: dict[str, Any]) -> Figures:
    """Errors of the model's offsets, beside the limit."""
    residuals = {"worst camera": answer["residual_ms"]}
    return {"late_pictures": sorted_values(residuals, "residual offset [ms]", 1e3 * WITHIN_S)}


def notes_late_pictures(answer: dict[str, Any]) -> Iterator[str]:
    """Ends of the goals, and every case with an unknown offset."""
    yield f"true error at rest, mean [px]: {answer['mean_error_px']}; residuals [ms]: {answer['residual_ms']}"
    yield f"ends by what is known: {answer['ends']}; cases without a model: {answer['no_model']}"
    for case in answer["beyond"]:
        yield f"case {case['seed']}: late {case['late_s']:.4f} s, residual {case['residual_s']} s"
