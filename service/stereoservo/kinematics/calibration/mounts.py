"""Cameras that stand and cameras on the tip: the same fit, with the joints counted from the other end."""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData
from stereoservo.kinematics.model import CellModel, ModelCovariance, Mount, check_model


def common_mount(trials: TrialData) -> Mount:
    """How all cameras of the trials are mounted. Raises CalibrationError (``mixed_mounts``)."""
    mounts = {camera.name: camera.mount for camera in trials.cameras}
    if len(set(mounts.values())) > 1:
        told = ", ".join(f"{name!r} {mount}" for name, mount in mounts.items())
        raise CalibrationError(
            "mixed_mounts",
            f"the cameras are mounted differently: {told}. One model needs cameras that see one motion: "
            "calibrate those that stand and those on the tip each on their own",
            mounts=mounts,
        )
    return trials.cameras[0].mount


def reversed_trials(trials: TrialData) -> TrialData:
    """Trials with the joints counted from the other end: from cameras on the tip, the base's joint is the
    last before the markers.
    """
    last = len(trials.joint_names) - 1
    return msgspec.structs.replace(
        trials,
        joint_names=trials.joint_names[::-1],
        joint_kinds=trials.joint_kinds[::-1],
        positions=trials.positions[:, ::-1],
        trials=np.where(trials.trials >= 0, last - trials.trials, trials.trials),
    )


def restored(model: CellModel) -> CellModel:
    """The model of reversed trials with its joints base first again, mounted eye-in-hand."""
    statistics = model.statistics
    if statistics is not None:
        statistics = msgspec.structs.replace(statistics, joints=statistics.joints[::-1])
    whole = msgspec.structs.replace(
        model,
        joint_names=model.joint_names[::-1],
        joint_kinds=model.joint_kinds[::-1],
        zero=model.zero[::-1].copy(),
        generators=model.generators[::-1].copy(),
        statistics=statistics,
        mount="eye_in_hand",
        covariance=None if model.covariance is None else _reversed_covariance(model.covariance),
    )
    check_model(whole)
    return whole


def _reversed_covariance(given: ModelCovariance) -> ModelCovariance:
    """The covariance with the joints' blocks in the opposite order."""
    sizes = [len(basis) for basis in given.generators]
    starts = np.cumsum([0, *sizes])
    order = [i for j in reversed(range(len(sizes))) for i in range(starts[j], starts[j + 1])]
    order += list(range(starts[-1], len(given.covariance)))
    return msgspec.structs.replace(
        given, generators=given.generators[::-1], covariance=given.covariance[np.ix_(order, order)]
    )
