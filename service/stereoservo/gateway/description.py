"""What does not change from step to step, for clients: the cell's joints, cameras, laws, model and taught goals."""

from __future__ import annotations

from pathlib import Path

import stereoservo
from stereoservo.gateway.messages import CameraInfo, CellInfo, JointInfo, ModelInfo, TaughtInfo
from stereoservo.kinematics.model import CellModel
from stereoservo.runtime.commands import LAWS
from stereoservo.runtime.interprocess import RunPlan
from stereoservo.runtime.settings import CoreSettings
from stereoservo.runtime.taught import TaughtGoal


def cell_info(
    plan: RunPlan,
    settings: CoreSettings,
    boot: str,
    model: CellModel | None,
    model_path: Path | None,
    taught: dict[str, TaughtGoal],
    recording: str,
) -> CellInfo:
    """What the cell is."""
    limits = settings.limits
    return CellInfo(
        cell=settings.cell,
        version=stereoservo.__version__,
        boot=boot,
        joints=tuple(
            JointInfo(
                name,
                kind,
                float(limits.position_min[i]),
                float(limits.position_max[i]),
                float(limits.velocity_max[i]),
            )
            for i, (name, kind) in enumerate(zip(settings.joint_names, settings.joint_kinds, strict=True))
        ),
        cameras=tuple(
            CameraInfo(
                camera.name, camera.width, camera.height, camera.rate_hz, camera.mount, camera.marker_ids
            )
            for camera in settings.cameras
        ),
        laws=LAWS,
        law=settings.law,
        tolerance_px=settings.tolerance_px,
        model=None
        if model is None
        else ModelInfo(
            model.epoch,
            model.stratum,
            model.marker_ids,
            model.created,
            None if model.statistics is None else model.statistics.rms_px,
            str(model_path),
        ),
        taught=tuple(
            TaughtInfo(
                name,
                goal.target.model_epoch or 0,
                goal.created,
                tuple(sorted({marker for seen in goal.others.values() for marker in seen} - set(goal.tool))),
                goal.tool,
            )
            for name, goal in sorted(taught.items())
        ),
        can_calibrate=settings.trials is not None,
        can_home=settings.home is not None,
        dry_run=plan.dry_run,
        commissioning=plan.commissioning,
        recording=recording,
    )
