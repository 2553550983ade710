"""Cells in lockstep shared by experiments: shipped ones with a fake arm, and a goal that is taught and reached."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.core.cycle import Event, ModelUpdate, StepInputs, StepOutputs
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CameraSection, CellFile
from stereoservo.messages.goals import FeatureTarget, JointTarget
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import SimulatedCell

RATE_HZ, CAMERA_HZ = 50.0, 10.0
"""Rates of cells with rendered images."""
LATENCY_S = 0.012
TOLERANCE_PX, HOLD_FRAMES, TAUGHT_FRAMES = 0.25, 6, 10
LIMIT_S, REST_S = 40.0, 1.0


@contextmanager
def lockstep(
    cell: CellFile,
    seed: int,
    history: TrueJointHistory | None = None,
    on_step: Callable[[StepInputs, StepOutputs], None] | None = None,
    files: dict[str, str] | None = None,
    recording: Path | None = None,
) -> Iterator[tuple[LockstepCell, Path]]:
    """The cell and its folder, which contains ``files``; the arm's true joints are written to ``history``."""
    with tempfile.TemporaryDirectory(prefix="stereoservo-experiment-") as scratch:
        folder = Path(scratch)
        for name, text in (files or {}).items():
            (folder / name).write_text(text, "utf-8")
        with LockstepCell(
            cell,
            cell_dir=folder,
            runtime_dir=folder,
            seed=seed,
            recording=recording,
            on_step=on_step,
            services=None if history is None else {"world": history},
        ) as running:
            yield running, folder


def with_fake_arm(
    cell: CellFile,
    cameras: Iterable[CameraSection],
    options: dict[str, Any] | None = None,
    *,
    calibrates_fast: bool = False,
    rate_hz: float | None = None,
) -> CellFile:
    """The cell with these cameras, and an arm without physics."""
    changes: dict[str, Any] = {}
    if calibrates_fast:
        assert cell.calibration is not None
        changes["calibration"] = msgspec.structs.replace(cell.calibration, stops=7, frames=2, speed_scale=1.0)
    if rate_hz is not None:
        changes["servo"] = msgspec.structs.replace(cell.servo, rate_hz=rate_hz)
    joints = msgspec.structs.replace(cell.joints, driver="fake", options=options or {})
    return msgspec.structs.replace(cell, camera=tuple(cameras), joints=joints, **changes)


def with_rendered_cameras(cell: CellFile, options: dict[str, Any], **of_arm: Any) -> CellFile:
    """The cell with a fake arm before cameras that render images with these ``options``."""
    options = {"rate_hz": CAMERA_HZ, "latency_s": LATENCY_S, "background": "arm", **options}
    cameras = (msgspec.structs.replace(camera, options=options) for camera in cell.camera)
    return with_fake_arm(cell, cameras, {"rate_hz": RATE_HZ, **of_arm}, rate_hz=RATE_HZ)


def enabled(cell: LockstepCell, model: CellModel, seed: int, settle_s: float) -> LockstepOperator:
    """The operator of a newly enabled cell with its model."""
    operator = LockstepOperator(cell, seed=seed)
    cell.run_for(settle_s)
    operator.enable()
    cell.update_model(ModelUpdate(model))
    cell.run_for(settle_s)
    return operator


def taught_and_reached(
    operator: LockstepOperator, away: FloatArray, law: str, shown: FloatArray | None = None
) -> tuple[Event, FeatureTarget]:
    """The end of a goal taught at the arm's position, or with its joints at ``shown`` (n,), with the arm sent
    ``away`` (n,) before; and the goal. Raises LockstepRefusalError, LockstepTimeoutError.
    """
    names = operator.cell.settings.joint_names
    if shown is not None:
        operator.goal(JointTarget(dict(zip(names, shown.tolist(), strict=True))))
        operator.cell.run_for(0.4)
    operator.teach("goal", TAUGHT_FRAMES)
    taught = msgspec.structs.replace(operator.taught["goal"], model_epoch=None)
    operator.goal(JointTarget(dict(zip(names, away.tolist(), strict=True))))
    event = operator.goal(
        taught, law=law, tolerance_px=TOLERANCE_PX, hold_frames=HOLD_FRAMES, time_limit_s=LIMIT_S, timeout_s=2 * LIMIT_S
    )
    operator.cell.run_for(REST_S)
    return event, taught


def end_error(world: SimulatedCell, history: TrueJointHistory, goal: FloatArray) -> float:
    """Largest distance [px] of the markers' projections at the arm's last position from those at ``goal`` (n,)."""
    newest = history.newest()
    assert newest is not None  # the arm was enabled
    here, there = world.truth_pixels(newest[1]), world.truth_pixels(goal)
    return max(float(np.linalg.norm(here[name] - there[name], axis=1).max()) for name in here)
