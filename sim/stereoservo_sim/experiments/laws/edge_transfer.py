"""Experiment: a taught goal is carried over to a workpiece that was moved, by its edges, beside the same by markers.

The workpiece is rendered twice, as plates with dots and as a solid without markers of the same extent, where the goal
was taught and where it is sent; the detectors `dots` and `edges` find them. The set-points that each gives are
compared with the true ones. Edges count as lines alone: no vertex is used as a point; or as both, with a face.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stereoservo.core.cycle import Event, Sample
from stereoservo.daemon.taught_goals import TaughtGoal, taught_goal
from stereoservo.gateway.goal_transfer import resolve
from stereoservo.gateway.observation_cache import MarkerObservation
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import TaughtTarget
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import Detector, DriverContext, Frame
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_drivers.edges.detector import EdgeDetector
from stereoservo_sim.experiments.experiment import draw_sorted
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.body import MarkerBody, SolidBody, part_text, wedge
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, SimulatedCell, workpiece_cell
from stereoservo_sim.world.synthetic import rotation
from stereoservo_sim.world.workpiece import Moved, Workpiece

ALLOWED = 1.5
"""Error by edges over that by markers, rms over all cells."""
BODY_PX = 0.05
"""Noise of the body's set-points, which are the same for both."""
FRAMES = 4
START_PX = 3.0
FIRST_ID = 500
FACING_DEG = (6.0, -25.0)
"""Turns about the plates' x and then y [degrees] that let the solid's top look at the cameras."""
HEIGHT = (0.0, 0.045)
"""Of the solid's base and top, before it is scaled [m]: no face is seen at a grazing angle."""
WAYS = ("markers", "edges", "mixed")

Seen = dict[str, dict[int, tuple[FloatArray, FloatArray]]]
"""By camera and marker: mean pixel (2,) and its covariance (2, 2)."""


@dataclass(frozen=True, eq=False)
class _CarryScene:
    """A cell, the poses (4, 4) of its workpiece then and now, and where its arm is away from it."""

    cell: SimulatedCell
    then: FloatArray
    now: FloatArray
    settings: RenderSettings


def run_edge_transfer(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``seeds`` goals from ``seed`` on; the JSON object of the command."""
    rows = []
    for k in range(seeds):
        progress("goals", k, seeds)
        rows.append(carry(seed + k))
    done = [row for row in rows if all(row[f"{way}_px"] is not None for way in WAYS)]
    rms = {way: float(np.sqrt(np.mean([row[f"{way}_px"] ** 2 for row in done]))) for way in WAYS if done}
    ratios = {way: rms[way] / rms["markers"] for way in WAYS[1:] if done}
    return {
        "experiment": "edge-transfer",
        "title": f"edge-transfer: {len(done)} of {seeds} goals carried over every way; errors of set-points, rms "
        + ", ".join(f"{way} {value:.3f} px" for way, value in rms.items())
        + "; over markers: "
        + ", ".join(f"{way} {value:.2f}" for way, value in ratios.items()),
        "rows": rows,
        "thesis": {},
        "seed": seed,
        "seeds": seeds,
        "rms_px": rms,
        "ratios": ratios,
        "allowed": ALLOWED,
        "assumptions": [
            f"{FRAMES} frames averaged, {BODY_PX:g} px noise of the body's own set-points, the exact model",
            "the solid is as large as the plates; edges: lines alone; mixed: lines, vertices and the top face",
        ],
    }


def carry(seed: int) -> dict[str, Any]:
    """Errors [px] of a goal's set-points carried over each way, rms; None with the reason where it was refused."""
    rng = np.random.default_rng([seed, 21])
    plates = workpiece_cell()
    assert plates.workpiece is not None
    solid = wedge(FIRST_ID, height=HEIGHT)
    solid = wedge(
        FIRST_ID, scale=_extent(_corners(plates.workpiece.body)) / _extent(solid.vertices), height=HEIGHT
    )
    # The plates' front is their -z, the solid's its top at +z: half a turn about x.
    turned = solid.vertices * np.array([1.0, -1.0, -1.0]) + np.array([0.0, 0.0, solid.vertices[:, 2].max()])
    turned = turned @ (rotation("y", FACING_DEG[1]) @ rotation("x", FACING_DEG[0]))[:3, :3].T
    light = rng.normal(size=3) * 0.3 + np.array([-0.6, -0.6, 0.8])
    solid = replace(solid, vertices=turned, light=light)
    edges = replace(plates, workpiece=Workpiece(solid, plates.workpiece.stand))
    moves = [
        Moved(tuple(rng.uniform(-0.03, 0.03, 3).tolist()), tuple(rng.uniform(-15, 15, 3).tolist()))
        for _ in range(2)
    ]
    then, now = (plates.workpiece.pose(moved) for moved in moves)
    settings = RenderSettings(float(rng.uniform(0.5, 1.2)), float(rng.uniform(1.0, 4.0)))
    model = exact_simulated_model(plates, seed)
    goal = DEMO_GOALS["near"]
    row: dict[str, Any] = {"seed": seed, "blur_px": settings.blur_px, "noise_grey": settings.noise_grey}
    body = _body_seen(plates, goal, rng)
    truth = _carried_truth(plates, goal, now @ np.linalg.inv(then))
    by_dots = _seen_twice(_CarryScene(plates, then, now, settings), rng, None)
    by_edges = _seen_twice(_CarryScene(edges, then, now, settings), rng, solid)
    row["markers_px"], row["refused"] = _error(
        model, body, *by_dots, TaughtTarget("goal", "workpiece"), truth
    )
    lines = _common_edges(solid, *by_edges)
    row["edges"] = len(lines)
    target = TaughtTarget("goal", "workpiece", (), lines)
    row["edges_px"], refused = _error(model, body, *by_edges, target, truth)
    row["refused"] += refused
    points = tuple(sorted(set.intersection(*(set(seen[name]) for seen in by_edges for name in seen))))
    top = tuple(FIRST_ID + k for k in range(5, 10))
    target = TaughtTarget("goal", "workpiece", points, lines, (top,))
    row["mixed_px"], refused = _error(model, body, *by_edges, target, truth)
    row["refused"] += refused
    return row


def _corners(body: MarkerBody) -> FloatArray:
    """Corners (4 f, 3) [m] of a body's plates."""
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return np.concatenate(
        [
            face.half_side * square @ pose[:3, :2].T + pose[:3, 3]
            for face, pose in zip(body.faces, body.flange_to_face, strict=True)
        ]
    )


def _extent(points: FloatArray) -> float:
    """The largest distance of two of the points (n, 3)."""
    return float(np.linalg.norm(points[:, None] - points, axis=2).max())


def _body_seen(cell: SimulatedCell, q: FloatArray, rng: np.random.Generator) -> Seen:
    ids = cell.body.ids.tolist()
    return {
        name: {
            marker: (pixel + BODY_PX * rng.normal(size=2), BODY_PX**2 * np.eye(2))
            for marker, pixel in zip(ids, pixels, strict=True)
        }
        for name, pixels in cell.truth_pixels(q).items()
    }


def _carried_truth(cell: SimulatedCell, q: FloatArray, moved: FloatArray) -> dict[str, dict[int, FloatArray]]:
    """Pixels of the body's markers when it has gone along with the workpiece by ``moved`` (4, 4)."""
    points = cell.marker_positions(q) @ moved[:3, :3].T + moved[:3, 3]
    return {
        camera.name: dict(zip(cell.body.ids.tolist(), camera.image_of(points)[0], strict=True))
        for camera in cell.rig.cameras
    }


def _seen_twice(scene: _CarryScene, rng: np.random.Generator, solid: SolidBody | None) -> tuple[Seen, Seen]:
    """The workpiece's features when the goal is taught and when it is sent."""
    return _seen(scene, scene.then, rng, solid), _seen(scene, scene.now, rng, solid)


def _seen(scene: _CarryScene, pose: FloatArray, rng: np.random.Generator, solid: SolidBody | None) -> Seen:
    seen: Seen = {}
    part = scene.cell.workpiece
    assert part is not None
    known = set(part.body.ids.tolist())
    for camera in scene.cell.rig.cameras:
        pixels = camera.image_of(part.marker_positions(pose))[0] + rng.uniform(-START_PX, START_PX)
        detector = _detector(
            camera.name, solid, dict(zip(part.body.ids.tolist(), pixels.tolist(), strict=True))
        )
        renderer = Renderer(scene.cell, camera, scene.settings)
        found: dict[int, list[tuple[FloatArray, FloatArray]]] = {}
        for k in range(FRAMES):
            t_ns = (k + 1) * 33_000_000
            frame = Frame(camera.name, k + 1, t_ns, t_ns, renderer.render(scene.cell.base, rng, pose))
            one = detector.detect(frame, None)
            for marker, pixel, covariance in zip(one.ids.tolist(), one.pixels, one.covariances, strict=True):
                if marker in known:
                    found.setdefault(marker, []).append((pixel, covariance))
        seen[camera.name] = {
            marker: (
                np.mean([p for p, _ in several], axis=0),
                np.mean([c for _, c in several], axis=0) / FRAMES,
            )
            for marker, several in found.items()
            if len(several) == FRAMES
        }
    return seen


def _detector(camera: str, solid: SolidBody | None, start: Mapping[int, tuple[float, float]]) -> Detector:
    with tempfile.TemporaryDirectory(prefix="stereoservo-edges-") as scratch:
        context = DriverContext(VirtualClock(), "edges", Path(scratch), Path(scratch), camera)
        if solid is None:
            return DotDetector({"beside": ["c", "d"]}, context)
        (Path(scratch) / "wedge.part").write_text(part_text(solid, {camera: start}), "utf-8")
        return EdgeDetector({"part": "wedge.part"}, context)


def _common_edges(solid: SolidBody, then: Seen, now: Seen) -> tuple[tuple[int, int], ...]:
    """Edges whose two vertices are seen in both cameras, then and now."""
    both = set.intersection(*(set(seen[name]) for seen in (then, now) for name in seen))
    pairs = {
        (min(a, b), max(a, b))
        for outline in solid.outlines
        for a, b in zip(outline, (*outline[1:], outline[0]), strict=True)
    }
    ids = solid.ids
    return tuple(
        (int(ids[a]), int(ids[b])) for a, b in sorted(pairs) if int(ids[a]) in both and int(ids[b]) in both
    )


def _error(
    model: CellModel,
    body: Seen,
    then: Seen,
    now: Seen,
    target: TaughtTarget,
    truth: Mapping[str, Mapping[int, FloatArray]],
) -> tuple[float | None, str]:
    """Rms error [px] of the set-points, or None and why there are none."""
    goal = _taught(model, {name: body[name] | then[name] for name in body})
    observations = {
        name: {
            marker: MarkerObservation(
                (float(pixel[0]), float(pixel[1])), float(np.sqrt(0.5 * np.trace(covariance))), False
            )
            for marker, (pixel, covariance) in seen.items()
        }
        for name, seen in now.items()
    }
    try:
        found = resolve(target, goal, model, observations)
    except TransferError as error:
        return None, str(error)
    away = [
        np.array(pixel) - truth[name][marker]
        for name, seen in found.target.set_points.items()
        for marker, pixel in seen.items()
    ]
    return float(np.sqrt((np.array(away) ** 2).sum(axis=1).mean())), ""


def _taught(model: CellModel, seen: Seen) -> TaughtGoal:
    samples = tuple(
        Sample(
            name,
            np.array(list(markers)),
            np.array([pixel for pixel, _ in markers.values()]),
            np.array([covariance for _, covariance in markers.values()]),
            FRAMES,
            np.full(len(markers), float(FRAMES)),
            np.zeros(len(markers)),
        )
        for name, markers in seen.items()
    )
    return taught_goal(Event(1, 1, "taught", name="goal", samples=samples), model, "", ())


def draw_edge_transfer(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Share of the goals with at most so much error. Raises OSError."""
    curves = {
        way: [row[f"{way}_px"] for row in answer["rows"] if row[f"{way}_px"] is not None] for way in WAYS
    }
    return draw_sorted(curves, "error of the set-points [px]", folder / "edge-transfer.png")
