"""Experiment: a part without markers is aligned by its edges, in rendered pictures.

Every cell differs in light, lens blur, noise, distance of the cameras and goal. The arm stands at the goal, which is
taught from the pictures, goes away, and is sent back. Errors are of noise-free projections of the part's vertices.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.core.cycle import ModelUpdate
from stereoservo.daemon.lockstep import LockstepCell, LockstepTimeoutError
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.goals import JointTarget
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator, LockstepRefusalError
from stereoservo_sim.experiments.experiment import draw_sorted
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world.body import LIGHT, part_text
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import SimulatedCell, solid_cell
from stereoservo_sim.world.workpiece import Moved

LIMIT_PX = 0.5
"""Of the error of an aligned part."""
START_PX = 3.0
"""How far the start of the part file is off, an axis, at most."""
LEAST_SEEN = 6
"""Vertices that each camera sees at the goal."""
TOLERANCE_PX = 0.25
HOLD_FRAMES = 6
RATE_HZ, CAMERA_HZ = 50.0, 10.0
TAUGHT_FRAMES = 10
LIMIT_S = 40.0
REST_S = 1.0


@dataclass(frozen=True, eq=False)
class EdgeSetting:
    """One cell: how far the cameras are from where the embedded ones are [m], lamp, lens and sensor, goal and law."""

    back_m: float
    light: tuple[float, float, float]
    blur_px: float
    noise_grey: float
    goal: FloatArray
    law: str
    seed: int


def run_edge_parts(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``seeds`` cells from ``seed`` on; the JSON object of the command."""
    rows = []
    for k in range(seeds):
        progress("cells", k, seeds)
        rows.append(align_part(draw_setting(seed + k)))
    within = sum(row["error_px"] is not None and row["error_px"] <= LIMIT_PX for row in rows)
    low, high = wilson(within, seeds)
    return {
        "experiment": "edge-parts",
        "title": f"edge-parts: {within} of {seeds} within {LIMIT_PX:g} px (Wilson {low:.3f} to {high:.3f})",
        "rows": rows,
        "thesis": {},
        "seed": seed,
        "seeds": seeds,
        "within": within,
        "limit_px": LIMIT_PX,
        "assumptions": [
            "the exact model in a random projective frame; goals taught and reached in rendered pictures alone",
            f"the part file's start is off by up to {START_PX:g} px",
        ],
    }


def draw_setting(seed: int) -> EdgeSetting:
    """A cell of this seed, whose goal shows enough vertices in both cameras."""
    rng = np.random.default_rng([seed, 19])
    light = rng.normal(size=3) * 0.4 + np.array(LIGHT)
    back_m, blur, noise = rng.uniform(-0.25, 0.35), rng.uniform(0.5, 1.2), rng.uniform(1.0, 4.0)
    law = ("cartesian3", "stereo")[seed % 2]
    while True:
        goal = solid_cell().base + rng.uniform(-1, 1, 6) * np.array([0.15, 0.15, 0.2, 0.5, 0.3, 0.8])
        setting = EdgeSetting(
            float(back_m), (float(light[0]), float(light[1]), float(light[2])), float(blur), float(noise), goal, law,
            seed,
        )  # fmt: skip
        world = true_world(setting)
        if all(int(world.visible(goal, camera).sum()) >= LEAST_SEEN for camera in world.rig.cameras):
            return setting


def true_world(setting: EdgeSetting) -> SimulatedCell:
    """The simulated cell of a setting, with its cameras where they are."""
    cell = solid_cell(setting.light)
    moved = Moved((0.0, 0.0, -setting.back_m))
    cameras = tuple(cell.camera(camera.name, 0.0, moved) for camera in cell.rig.cameras)
    return replace(cell, rig=replace(cell.rig, cameras=cameras))


def cell_of(setting: EdgeSetting) -> CellFile:
    """The shipped cell ``edges`` with an arm without physics, and the cameras of a setting."""
    cell = load_cell_file(shipped_cell_path("edges"))
    options = {
        "rate_hz": CAMERA_HZ, "latency_s": 0.012, "solid": True, "background": "arm", "light": list(setting.light),
        "noise": setting.noise_grey, "blur": setting.blur_px, "moved": {"shift_m": [0.0, 0.0, -setting.back_m]},
    }  # fmt: skip
    return msgspec.structs.replace(
        cell,
        camera=tuple(msgspec.structs.replace(camera, options=options) for camera in cell.camera),
        joints=msgspec.structs.replace(
            cell.joints, driver="fake", options={"rate_hz": RATE_HZ, "start": named(setting.goal)}
        ),
        servo=msgspec.structs.replace(cell.servo, rate_hz=RATE_HZ),
    )


def named(q: FloatArray) -> dict[str, float]:
    """Positions (n,) by joint name."""
    return dict(zip(solid_cell().robot.joint_names, q.tolist(), strict=True))


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
    history = TrueJointHistory.in_memory(6, capacity=1 << 14)
    with tempfile.TemporaryDirectory(prefix="stereoservo-edges-") as scratch:
        (Path(scratch) / "wedge.part").write_text(part_text(world.body, start), "utf-8")
        with LockstepCell(
            cell_of(setting), cell_dir=Path(scratch), runtime_dir=Path(scratch), seed=setting.seed,
            services={"world": history},
        ) as cell:  # fmt: skip
            end, reason, seen = _teach_and_reach(cell, setting, exact_simulated_model(world, setting.seed))
        newest = history.newest()
    assert newest is not None
    error = end_error(world, newest[1], setting.goal)
    return {
        "seed": setting.seed, "law": setting.law, "distance_m": 1.4 + setting.back_m, "blur_px": setting.blur_px,
        "noise_grey": setting.noise_grey, "vertices": seen, "end": end, "reason": reason,
        "error_px": error if end == "goal_reached" else None,
    }  # fmt: skip


def _teach_and_reach(cell: LockstepCell, setting: EdgeSetting, model: CellModel) -> tuple[str, str, int]:
    """The goal's end, in a word and the reason, and how many set-points were taught."""
    operator = LockstepOperator(cell, seed=setting.seed)
    cell.run_for(0.3)
    operator.enable()
    cell.update_model(ModelUpdate(model))
    cell.run_for(0.3)
    try:
        operator.teach("goal", TAUGHT_FRAMES)
        taught = msgspec.structs.replace(operator.taught["goal"], model_epoch=None)
        operator.goal(JointTarget(named(solid_cell(setting.light).base)))
        event = operator.goal(
            taught,
            law=setting.law,
            tolerance_px=TOLERANCE_PX,
            hold_frames=HOLD_FRAMES,
            time_limit_s=LIMIT_S,
            timeout_s=2 * LIMIT_S,
        )
        cell.run_for(REST_S)
    except LockstepRefusalError as error:
        return "refused", f"{error}", 0
    except LockstepTimeoutError as error:
        return "timeout", f"{error}", 0
    reasons = ", ".join(reason.code for reason in event.reasons)
    return event.kind, reasons, sum(map(len, taught.set_points.values()))


def end_error(world: SimulatedCell, q: FloatArray, goal: FloatArray) -> float:
    """Largest distance [px] of the vertices' projections at ``q`` (n,) from those at ``goal`` (n,)."""
    here, there = world.truth_pixels(q), world.truth_pixels(goal)
    return max(float(np.linalg.norm(here[name] - there[name], axis=1).max()) for name in here)


def draw_edge_parts(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Share of the cells with at most so much error. Raises OSError."""
    reached = [row["error_px"] for row in answer["rows"] if row["error_px"] is not None]
    return draw_sorted({"aligned": reached}, "error at the goal [px]", folder / "edge-parts.png", LIMIT_PX)
