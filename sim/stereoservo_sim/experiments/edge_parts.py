"""Experiments: edges in place of markers, in rendered images.

``edge-parts``: a part without markers is aligned by its edges. Every cell differs in light, lens blur, noise, distance
of the cameras and goal. The goal is taught from images with the arm there; then the arm moves away, and back to the
goal. Errors are of noise-free projections of the part's vertices.

``edge-transfer``: a taught goal is transferred to a moved workpiece by its edges, beside the same by
markers. The workpiece is rendered twice, as plates with dots and as a solid without markers of the same extent, at
its poses when the goal is taught and when it is sent; the detectors `dots` and `edges` find them. The set-points of
both are compared with the true ones. Edges count as lines alone (no vertex is used as a point); or as both, with a
face.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stereoservo.core.cycle import Event, Sample
from stereoservo.daemon.lockstep import LockstepTimeoutError
from stereoservo.daemon.taught_goals import TaughtGoal, taught_goal
from stereoservo.gateway.goal_transfer import resolve
from stereoservo.gateway.observation_cache import MarkerObservation
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.goals import TaughtTarget
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import Detector, Frame
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_drivers.edges import EdgeDetector
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator, LockstepRefusalError
from stereoservo_sim.experiments.experiment import cases
from stereoservo_sim.experiments.figures import Figures, sorted_values
from stereoservo_sim.experiments.lockstep_cells import (
    enabled,
    end_error,
    lockstep,
    taught_and_reached,
    with_rendered_cameras,
)
from stereoservo_sim.experiments.textured import context_of
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world.body import LIGHT, MarkerBody, SolidBody, part_text, wedge
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, SimulatedCell, solid_cell, workpiece_cell
from stereoservo_sim.world.synthetic import rotation
from stereoservo_sim.world.workpiece import Moved, Workpiece

LIMIT_PX = 0.5
"""Largest error of an aligned part."""
START_PX = 3.0
"""Largest error per axis of the start in the part file."""
LEAST_SEEN = 6
"""Least number of vertices that each camera sees at the goal."""


@dataclass(frozen=True, eq=False)
class EdgeSetting:
    """One cell: distances of the cameras from the embedded ones' poses [m], lamp, lens and sensor, goal and law."""

    back_m: float
    light: tuple[float, float, float]
    blur_px: float
    noise_grey: float
    goal: FloatArray
    law: str
    seed: int


def run_edge_parts(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Run ``seeds`` cells from ``seed`` on; returns the JSON object of the command."""
    rows = cases(lambda k: align_part(draw_setting(k)), seeds, seed, progress, "cells")
    within = sum(row["error_px"] is not None and row["error_px"] <= LIMIT_PX for row in rows)
    low, high = wilson(within, seeds)
    return {
        "title": f"edge-parts: {within} of {seeds} within {LIMIT_PX:g} px (Wilson {low:.3f} to {high:.3f})",
        "rows": rows,
        "thesis": {},
        "within": within,
        "limit_px": LIMIT_PX,
        "assumptions": [
            "the exact model in a random projective frame; goals taught and reached in rendered pictures alone",
            f"the part file's start is off by up to {START_PX:g} px",
        ],
    }


def draw_setting(seed: int) -> EdgeSetting:
    """A cell of this seed whose goal shows enough vertices in both cameras."""
    rng = np.random.default_rng([seed, 19])
    light = rng.normal(size=3) * 0.4 + np.array(LIGHT)
    back_m, blur, noise = rng.uniform(-0.25, 0.35), rng.uniform(0.5, 1.2), rng.uniform(1.0, 4.0)
    law = ("cartesian3", "stereo")[seed % 2]
    while True:
        goal = solid_cell().base + rng.uniform(-1, 1, 6) * np.array([0.15, 0.15, 0.2, 0.5, 0.3, 0.8])
        setting = EdgeSetting(
            float(back_m),
            (float(light[0]), float(light[1]), float(light[2])),
            float(blur),
            float(noise),
            goal,
            law,
            seed,
        )
        world = true_world(setting)
        if all(int(world.visible(goal, camera).sum()) >= LEAST_SEEN for camera in world.rig.cameras):
            return setting


def true_world(setting: EdgeSetting) -> SimulatedCell:
    """The simulated cell of a setting, with its displaced cameras."""
    cell = solid_cell(setting.light)
    moved = Moved((0.0, 0.0, -setting.back_m))
    cameras = tuple(cell.camera(camera.name, 0.0, moved) for camera in cell.rig.cameras)
    return replace(cell, rig=replace(cell.rig, cameras=cameras))


def align_part(setting: EdgeSetting) -> dict[str, Any]:
    """Teach and reach the goal of one cell; deterministic given the setting."""
    world = true_world(setting)
    rng = np.random.default_rng([setting.seed, 20])
    start = {
        name: {
            marker: tuple((pixel + rng.uniform(-START_PX, START_PX, 2)).tolist())
            for marker, pixel in zip(world.body.ids.tolist(), pixels, strict=True)
        }
        for name, pixels in world.truth_pixels(setting.goal).items()
    }
    pictures = {
        "solid": True,
        "light": list(setting.light),
        "noise": setting.noise_grey,
        "blur": setting.blur_px,
        "moved": {"shift_m": [0.0, 0.0, -setting.back_m]},
    }
    joints = dict(zip(world.robot.joint_names, setting.goal.tolist(), strict=True))
    file = with_rendered_cameras(load_cell_file(shipped_cell_path("edges")), pictures, start=joints)
    history = TrueJointHistory.in_memory(6, capacity=1 << 14)
    with lockstep(file, setting.seed, history, files={"wedge.part": part_text(world.body, start)}) as (
        cell,
        _,
    ):
        operator = enabled(cell, exact_simulated_model(world, setting.seed), setting.seed, 0.3)
        end, reason, seen = _reached(operator, world.base, setting.law)
    error = end_error(world, history, setting.goal)
    return {
        "seed": setting.seed, "law": setting.law, "distance_m": 1.4 + setting.back_m, "blur_px": setting.blur_px,
        "noise_grey": setting.noise_grey, "vertices": seen, "end": end, "reason": reason,
        "error_px": error if end == "goal_reached" else None,
    }  # fmt: skip


def _reached(operator: LockstepOperator, away: FloatArray, law: str) -> tuple[str, str, int]:
    """The goal's end as a word with the reason, and the number of taught set-points."""
    try:
        event, taught = taught_and_reached(operator, away, law)
    except LockstepRefusalError as error:
        return "refused", f"{error}", 0
    except LockstepTimeoutError as error:
        return "timeout", f"{error}", 0
    reasons = ", ".join(reason.code for reason in event.reasons)
    return event.kind, reasons, sum(map(len, taught.set_points.values()))


def draw_edge_parts(answer: dict[str, Any]) -> Figures:
    """Share of the cells over the error."""
    reached = [row["error_px"] for row in answer["rows"] if row["error_px"] is not None]
    return {"edge-parts": sorted_values({"aligned": reached}, "error at the goal [px]", LIMIT_PX)}


# -- transferred goals ----------------------------------------------------------------------------------------

ALLOWED = 1.5
"""Allowed ratio of the error by edges to that by markers, rms over all cells."""
BODY_PX = 0.05
"""Noise of the body's set-points, equal for both."""
FRAMES = 4


FIRST_ID = 500
FACING_DEG = (6.0, -25.0)
"""Rotations about the plates' x and then y [degrees] that turn the solid's top to the cameras."""
HEIGHT = (0.0, 0.045)
"""Heights of the solid's base and top, before scaling [m]: no face is seen at a grazing angle."""
WAYS = ("markers", "edges", "mixed")

Seen = dict[str, dict[int, tuple[FloatArray, FloatArray]]]
"""Mean pixel (2,) and its covariance (2, 2) by camera and marker."""


@dataclass(frozen=True, eq=False)
class _CarryScene:
    """A cell, the poses (4, 4) of its workpiece at teaching and now, and the arm's joints away from it."""

    cell: SimulatedCell
    then: FloatArray
    now: FloatArray
    settings: RenderSettings


def run_edge_transfer(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Run ``seeds`` goals from ``seed`` on; returns the JSON object of the command."""
    rows = cases(carry, seeds, seed, progress, "goals")
    done = [row for row in rows if all(row[f"{way}_px"] is not None for way in WAYS)]
    rms = {way: float(np.sqrt(np.mean([row[f"{way}_px"] ** 2 for row in done]))) for way in WAYS if done}
    ratios = {way: rms[way] / rms["markers"] for way in WAYS[1:] if done}
    return {
        "title": f"edge-transfer: {len(done)} of {seeds} goals carried over every way; errors of set-points, rms "
        + ", ".join(f"{way} {value:.3f} px" for way, value in rms.items())
        + "; over markers: "
        + ", ".join(f"{way} {value:.2f}" for way, value in ratios.items()),
        "rows": rows,
        "thesis": {},
        "rms_px": rms,
        "ratios": ratios,
        "allowed": ALLOWED,
        "assumptions": [
            f"{FRAMES} frames averaged, {BODY_PX:g} px noise of the body's own set-points, the exact model",
            "the solid is as large as the plates; edges: lines alone; mixed: lines, vertices and the top face",
        ],
    }


def carry(seed: int) -> dict[str, Any]:
    """Errors [px] of a goal's set-points transferred by each method, rms; None with the reason if it was refused."""
    rng = np.random.default_rng([seed, 21])
    plates = workpiece_cell()
    assert plates.workpiece is not None
    solid = wedge(FIRST_ID, height=HEIGHT)
    solid = wedge(FIRST_ID, scale=_extent(_corners(plates.workpiece.body)) / _extent(solid.vertices), height=HEIGHT)
    # The plates' front is their -z, the solid's its top at +z: half a turn about x.
    turned = solid.vertices * np.array([1.0, -1.0, -1.0]) + np.array([0.0, 0.0, solid.vertices[:, 2].max()])
    turned = turned @ (rotation("y", FACING_DEG[1]) @ rotation("x", FACING_DEG[0]))[:3, :3].T
    light = rng.normal(size=3) * 0.3 + np.array([-0.6, -0.6, 0.8])
    solid = replace(solid, vertices=turned, light=light)
    edges = replace(plates, workpiece=Workpiece(solid, plates.workpiece.stand))
    moves = [
        Moved(tuple(rng.uniform(-0.03, 0.03, 3).tolist()), tuple(rng.uniform(-15, 15, 3).tolist())) for _ in range(2)
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
    row["markers_px"], row["refused"] = _error(model, body, *by_dots, TaughtTarget("goal", "workpiece"), truth)
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
    """Pixels of the body's markers after it has moved with the workpiece by ``moved`` (4, 4)."""
    points = cell.marker_positions(q) @ moved[:3, :3].T + moved[:3, 3]
    return {
        camera.name: dict(zip(cell.body.ids.tolist(), camera.image_of(points)[0], strict=True))
        for camera in cell.rig.cameras
    }


def _seen_twice(scene: _CarryScene, rng: np.random.Generator, solid: SolidBody | None) -> tuple[Seen, Seen]:
    """Observations of the workpiece's features when the goal is taught and when it is sent."""
    return _seen(scene, scene.then, rng, solid), _seen(scene, scene.now, rng, solid)


def _seen(scene: _CarryScene, pose: FloatArray, rng: np.random.Generator, solid: SolidBody | None) -> Seen:
    seen: Seen = {}
    part = scene.cell.workpiece
    assert part is not None
    known = set(part.body.ids.tolist())
    for camera in scene.cell.rig.cameras:
        pixels = camera.image_of(part.marker_positions(pose))[0] + rng.uniform(-START_PX, START_PX)
        detector = _detector(camera.name, solid, dict(zip(part.body.ids.tolist(), pixels.tolist(), strict=True)))
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
        context = context_of(camera, Path(scratch))
        if solid is None:
            return DotDetector({"beside": ["c", "d"]}, context)
        (Path(scratch) / "wedge.part").write_text(part_text(solid, {camera: start}), "utf-8")
        return EdgeDetector({"part": "wedge.part"}, context)


def _common_edges(solid: SolidBody, then: Seen, now: Seen) -> tuple[tuple[int, int], ...]:
    """Edges whose two vertices are seen in both cameras, at teaching and now."""
    both = set.intersection(*(set(seen[name]) for seen in (then, now) for name in seen))
    pairs = {
        (min(a, b), max(a, b))
        for outline in solid.outlines
        for a, b in zip(outline, (*outline[1:], outline[0]), strict=True)
    }
    ids = solid.ids
    return tuple((int(ids[a]), int(ids[b])) for a, b in sorted(pairs) if int(ids[a]) in both and int(ids[b]) in both)


def _error(
    model: CellModel,
    body: Seen,
    then: Seen,
    now: Seen,
    target: TaughtTarget,
    truth: Mapping[str, Mapping[int, FloatArray]],
) -> tuple[float | None, str]:
    """Rms error [px] of the set-points, or None and the reason for their absence."""
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


def draw_edge_transfer(answer: dict[str, Any]) -> Figures:
    """Share of the goals over the error."""
    curves = {way: [row[f"{way}_px"] for row in answer["rows"] if row[f"{way}_px"] is not None] for way in WAYS}
    return {"edge-transfer": sorted_values(curves, "error of the set-points [px]")}
