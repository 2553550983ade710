"""Experiment: detectors under varying light and exposure: their centres, their stated covariances, and
goals reached meanwhile.

The detectors `dots`, `aruco`, `edges`, and the alignment used by `corners`, are applied to rendered scenes with known
true pixels, with a prior like the core's. Goals are those of an arm before two rendered cameras, in lockstep, with
the detector `dots`; they are taught and reached while the light changes, and evaluated on noise-free projections.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from rich.console import Console
from scipy.ndimage import shift as shifted

from stereoservo.core.cycle import Event
from stereoservo.daemon.lockstep import LockstepCell, LockstepTimeoutError
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.devices import Detector, Frame
from stereoservo_drivers.detectors.aruco import TagDetector
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_drivers.detectors.patch_alignment import ReferencePatches, build_pyramid
from stereoservo_drivers.edges import EdgeDetector
from stereoservo_sim.benchmarks.features import DICTIONARY, TAG_COLUMNS, TAG_NOISE, TAG_ROWS, tag_scene
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.lockstep_operator import LockstepRefusalError
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.experiments.experiment import show_rows, show_table
from stereoservo_sim.experiments.figures import Figures, sorted_values
from stereoservo_sim.experiments.lockstep_cells import (
    enabled,
    end_error,
    lockstep,
    taught_and_reached,
    with_rendered_cameras,
)
from stereoservo_sim.experiments.textured import context_of, prior_at, texture
from stereoservo_sim.progress import ProgressCall, counted
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world.body import SolidBody, part_text
from stereoservo_sim.world.camera_rig import PinholeCamera
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.lighting import Lighting
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import SimulatedCell, demo_cell, solid_cell

STEPS = ((1.0, 0.45), (2.5, 1.1), (4.0, 0.6), (6.0, 1.0), (8.0, 0.5), (11.0, 1.0), (14.0, 0.6), (17.0, 1.1))
LIGHTS: dict[str, Lighting] = {
    "steady": Lighting(),
    "ambient steps 0.45 to 1.1": Lighting(steps=STEPS),
    "the same, automatic exposure": Lighting(steps=STEPS, adapt_s=0.5),
    "exposure ±50 %": Lighting(level=0.75, swing=0.5),
    "soft shadow, 70 %": Lighting(shadow=0.7),
    "sharp shadow, 70 %": Lighting(shadow=0.7, soft_px=1.5),
    "a lamp's reflection, 120 levels": Lighting(spot=120.0),
    "clipped white, x 1.6": Lighting(level=1.6),
    "flicker 30 %, 100 Hz bands": Lighting(flicker=0.3),
    "all of it": Lighting(level=0.9, swing=0.2, shadow=0.5, spot=60.0, flicker=0.15),
    "dark for a second": Lighting(steps=((6.0, 0.05), (7.0, 1.0))),
    "dark from 6 s on": Lighting(steps=((6.0, 0.05),)),
    "dark, x 0.08": Lighting(level=0.08),
}
PICTURES, PERIOD_S = 40, 0.15
"""Number of images of each detector and light; time between them."""
PRIOR_PX = 0.5
WRONG_PX = 2.0
BEYOND = 0.999
"""Share of correct observations whose squared distance in the stated covariance is below its chi-square bound."""


LIMIT_PX = 0.5
"""Largest true error of a goal that counts as truly reached."""


Look = tuple[FloatArray, FloatArray, int]
"""Errors (n, 2) [px] of the reported markers, their covariances (n, 2, 2), and number of markers that face the camera.
"""
Looks = Callable[[Lighting, int], Iterator[Look]]


def exposed(image: FloatArray, light: Lighting, t_s: float, rng: np.random.Generator) -> ImageArray:
    """``image`` (h, w) [grey levels] under the light at ``t_s`` [s], with the sensor's noise."""
    lit = light.lit(np.asarray(image, dtype=np.float32), t_s)
    return np.clip(np.rint(lit + rng.normal(0.0, TAG_NOISE, lit.shape)), 0, 255).astype(np.uint8)


def _seen(
    detector: Detector, image: ImageArray, k: int, ids: Any, truth: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 2) and covariances (n, 2, 2) of the markers ``ids`` at ``truth`` (m, 2) reported by ``detector``."""
    stamp = 1_000_000_000 + round(k * PERIOD_S * 1e9)
    off = truth + rng.normal(0.0, PRIOR_PX, truth.shape)
    prior = prior_at("left", stamp, ids, off, PRIOR_PX**2)
    found = detector.detect(Frame("left", k, stamp, stamp, image), prior)
    return found.pixels - truth[np.searchsorted(ids, found.ids)], found.covariances


def look_at_body(cell: SimulatedCell, detector: Detector, light: Lighting, seed: int) -> Iterator[Look]:
    """Images of the cell's body at postures about its base."""
    rng = np.random.default_rng([seed, 20])
    camera = cell.rig.cameras[0]
    renderer = Renderer(cell, camera, RenderSettings(lighting=light))
    for k in range(PICTURES):
        q = cell.base + rng.uniform(-0.1, 0.1, len(cell.base))
        image = renderer.render(q, rng, t_s=k * PERIOD_S)
        errors = _seen(detector, image, k, cell.body.ids, cell.truth_pixels(q)[camera.name], rng)
        yield *errors, facing(cell, q, camera)


def facing(cell: SimulatedCell, q: FloatArray, camera: PinholeCamera) -> int:
    """Number of markers that face the camera (of a solid, vertices of such faces) with the arm at ``q`` (n,)."""
    body, pose, centre = cell.body, cell.body_pose(q), cell.in_world(camera, q).centre
    if not isinstance(body, SolidBody):
        return int(cell.visible(q, camera).sum())
    placed = body.vertices @ pose[:3, :3].T + pose[:3, 3]
    normals = body.face_normals @ pose[:3, :3].T
    faces = zip(body.outlines, normals, strict=True)
    return len({i for face, normal in faces if normal @ (centre - placed[face[0]]) > 0.0 for i in face})


def dots(light: Lighting, seed: int) -> Iterator[Look]:
    """Observations of the demo's plate by the detector `dots`."""
    yield from look_at_body(demo_cell(), DotDetector({}, context_of("left")), light, seed)


def edges(light: Lighting, seed: int) -> Iterator[Look]:
    """Observations of the vertices of the cell ``edges`` by the detector `edges`."""
    cell = solid_cell()
    start = {"left": dict(zip(cell.body.ids.tolist(), cell.truth_pixels(cell.base)["left"].tolist(), strict=True))}
    with tempfile.TemporaryDirectory(prefix="stereoservo-light-") as folder:
        (Path(folder) / "wedge.part").write_text(part_text(cell.body, start), "utf-8")
        detector = EdgeDetector({"part": "wedge.part"}, context_of("left", Path(folder)))
        yield from look_at_body(cell, detector, light, seed)


def aruco(light: Lighting, seed: int) -> Iterator[Look]:
    """Observations of twelve tags by the detector `aruco`."""
    rng = np.random.default_rng([seed, 21])
    count = TAG_COLUMNS * TAG_ROWS
    options = {"tags": list(range(count)), "dictionary": DICTIONARY}
    detector = TagDetector(options, context_of("left"))
    for k in range(PICTURES):
        scene, truth = tag_scene(rng)
        image = exposed(scene, light, k * PERIOD_S, rng)
        yield *_seen(detector, image, k, np.arange(4 * count), truth, rng), len(truth)


def corners(light: Lighting, seed: int) -> Iterator[Look]:
    """Observations of a shifted texture, by the alignment of reference patches that `corners` reports."""
    rng = np.random.default_rng([seed, 22])
    scene = texture(rng, 480, 2.0)
    steady = exposed(scene, Lighting(), 0.0, rng)
    places = cv2.goodFeaturesToTrack(steady[40:-40, 40:-40], 40, 0.05, 25)[:, 0].astype(np.float64) + 40.0
    patches = ReferencePatches(steady, places, 10)
    rows, shapes = np.arange(len(places)), np.tile(np.eye(2), (len(places), 1, 1))
    for k in range(PICTURES):
        off = rng.uniform(-4.0, 4.0, 2)
        image = exposed(shifted(scene, off[::-1], order=5, mode="nearest"), light, k * PERIOD_S, rng)
        start = places + off + rng.normal(0.0, PRIOR_PX, places.shape)
        found = patches.align(build_pyramid(image, 3), rows, shapes, start, 0)
        good = found.found & (found.correlations > 0.8)
        yield (found.pixels - places - off)[good], found.covariances[good], len(places)


DETECTORS: dict[str, Looks] = {"dots": dots, "aruco": aruco, "corners": corners, "edges": edges}


def detector_row(name: str, light_name: str, seed: int) -> dict[str, Any]:
    """One detector under one light: share found, bias, rms, chi-square per degree of freedom, share beyond its 0.999
    bound.
    """
    errors, squares, shown = [], [], 0
    for error, covariance, count in DETECTORS[name](LIGHTS[light_name], seed):
        shown += count
        errors.append(error)
        squares.append(np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1))
    error, square = np.concatenate(errors), np.concatenate(squares)
    right = np.hypot(*error.T) < WRONG_PX
    row: dict[str, Any] = {
        "detector": name, "light": light_name, "shown": shown, "found": int(right.sum()),
        "wrong": int((~right).sum()), "rms_px": None, "bias_px": None, "chi2_per_freedom": None,
        "beyond_0.999": None,
    }  # fmt: skip
    if right.any():
        row["rms_px"] = float(np.sqrt(np.mean(error[right] ** 2)))
        row["bias_px"] = float(np.hypot(*error[right].mean(axis=0)))
        row["chi2_per_freedom"] = float(square[right].mean() / 2.0)
        row["beyond_0.999"] = float(np.mean(square > -2.0 * np.log(1.0 - BEYOND)))
    return row


def goal_run(light_name: str, seed: int) -> dict[str, Any]:
    """Teach and reach one goal; deterministic given light and seed."""
    lighting = {"lighting": msgspec.to_builtins(LIGHTS[light_name])}
    file = with_rendered_cameras(load_cell_file(shipped_cell_path("demo")), lighting)
    world = true_cell(file)
    rng = np.random.default_rng([seed, 23])
    goal = world.base + rng.uniform(-1.0, 1.0, 6) * np.array([0.12, 0.1, 0.12, 0.4, 0.25, 0.5])
    history = TrueJointHistory.in_memory(6, capacity=1 << 14)
    with lockstep(file, seed, history) as (cell, _):
        model = exact_simulated_model(world, seed)
        end, said = _taught_and_reached(cell, model, world, goal, seed)
        verdicts = {e.name for e in cell.events if e.kind == "health" and e.name != "ok"}
        told = {kind for kind, _ in cell.reports}
    error = end_error(world, history, goal)
    return {"end": end, "said": said, "error_px": error, "verdicts": verdicts, "told": told}


def _taught_and_reached(
    cell: LockstepCell, model: CellModel, world: SimulatedCell, goal: FloatArray, seed: int
) -> tuple[str, str]:
    """The goal's end, and its message."""
    try:
        operator = enabled(cell, model, seed, 0.3)
        event, _ = taught_and_reached(operator, world.base, ("cartesian3", "stereo")[seed % 2], goal)
    except LockstepRefusalError as error:
        return "refused", _said(error.event)
    except LockstepTimeoutError as error:
        return "timeout", str(error)
    return event.kind, _said(event)


def _said(event: Event) -> str:
    """An event's reasons as text."""
    return "; ".join(str(getattr(reason, "message", "") or reason.code) for reason in event.reasons) or event.message


def goal_row(light_name: str, seeds: int, seed: int) -> dict[str, Any]:
    """Goals under one light: truly reached, reached with an error, not reached with the message, verdicts of the
    monitor.
    """
    runs = [goal_run(light_name, seed + k) for k in range(seeds)]
    reached = [run for run in runs if run["end"] == "goal_reached"]
    truly = [run["error_px"] for run in reached if run["error_px"] <= LIMIT_PX]
    low, high = wilson(len(truly), seeds)
    return {
        "light": light_name,
        "goals": seeds,
        "reached_truly": len(truly),
        "wilson_95": f"{low:.2f} to {high:.2f}",
        "reached_falsely": len(reached) - len(truly),
        "worst_px": max((run["error_px"] for run in reached), default=None),
        "verdicts": ", ".join(sorted(set().union(*(run["verdicts"] for run in runs)))),
        "told": ", ".join(sorted(set().union(*(run["told"] for run in runs)))),
        "said": " | ".join(sorted({run["said"] for run in runs if run["end"] != "goal_reached"})),
    }


def run_changing_light(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Run all detectors and ``seeds`` goals under all lights; returns the JSON object of the command."""
    pairs = [(name, light) for name in DETECTORS for light in LIGHTS]
    looked = [detector_row(*pairs[k], seed) for k in counted(progress, "detectors and lights", len(pairs))]
    lights = list(LIGHTS)
    rows = [goal_row(lights[k], seeds, seed) for k in counted(progress, "goals in lights", len(lights))]
    return {
        "title": f"goals in the cell `demo` by `dots`, {seeds} seeds; reached truly: within {LIMIT_PX:g} px",
        "rows": rows,
        "detectors": looked,
        "thesis": {},
        "assumptions": [
            f"{PICTURES} pictures of 640x480 a detector and light, 2 grey levels of noise, 0.7 px of blur",
            f"a prior off by {PRIOR_PX:g} px; bias: length of the mean error",
            "goals: the exact model in a random projective frame; taught and reached while the light changes",
        ],
    }


def show_changing_light(answer: dict[str, Any], console: Console) -> None:
    """Print both tables."""
    show_table(answer["detectors"], "detectors", console)
    show_rows(answer, console)


def draw_changing_light(answer: dict[str, Any]) -> Figures:
    """Chi-square per degree of freedom of each detector over the lights, in order."""
    curves = {
        name: [row["chi2_per_freedom"] for row in answer["detectors"] if row["detector"] == name and row["found"]]
        for name in DETECTORS
    }
    return {"changing-light": sorted_values(curves, "chi-square a freedom", 1.0)}
