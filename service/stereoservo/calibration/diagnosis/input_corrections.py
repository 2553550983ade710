"""Hypothetical corrections of calibration data that may make the model fit: views, marker ids, joint kinds or the
order of joints exchanged back; and the fit of each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.diagnosis.epipolar_faults import (
    exchanged_ids,
    exchanged_views,
    with_ids_exchanged,
    with_views_exchanged,
)
from stereoservo.calibration.initial_reconstruction import initial_reconstruction
from stereoservo.calibration.joint_errors.variance_components import noise_of_accuracy, readings
from stereoservo.calibration.lens_estimation import prior_of_lenses, straight_lenses, undistorted
from stereoservo.calibration.rig_model import Measurements, expected_pixels, projective_rig, stratum_rig
from stereoservo.calibration.single_joint_fit import best_single_joint, own_trials
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.parameterization import Kind, lens_model_of
from stereoservo.numerics.arrays import FloatArray

KIND_BETTER = 1.25
"""How many times better a joint's trial must fit the other kind; the fit of all joints decides then."""


@dataclass(frozen=True)
class InputCorrection:
    """A hypothetical fault of the input, and the trials corrected for it."""

    code: str
    message: str
    data: dict[str, Any]
    trials: TrialData


def exchange_hypotheses(trials: TrialData) -> Iterator[InputCorrection]:
    """Corrections of views exchanged at some stops, and of ids exchanged at all stops."""
    for k in range(1, len(trials.cameras)):
        names = [trials.cameras[0].name, trials.cameras[k].name]
        stops = exchanged_views(trials, k)
        if len(stops):
            yield InputCorrection(
                "views_exchanged",
                f"the images of cameras {names[0]!r} and {names[1]!r} are exchanged at {len(stops)} of "
                f"{len(trials.positions)} stops: {stops.tolist()}. With them exchanged back the trials fit",
                {"stops": stops.tolist(), "cameras": names},
                with_views_exchanged(trials, k, stops),
            )
        pair = exchanged_ids(trials, k)
        if pair is not None:
            yield ids_exchanged(trials, k, pair)


def ids_exchanged(trials: TrialData, k: int, pair: tuple[int, int]) -> InputCorrection:
    """Correction of two markers (indices) exchanged at all stops in camera ``k`` or in the first one, which two
    cameras cannot distinguish.
    """
    a, b = (trials.marker_ids[i] for i in pair)
    names = [trials.cameras[0].name, trials.cameras[k].name]
    where = f"camera {names[1]!r} or {names[0]!r}" if k == 1 else f"camera {names[1]!r}"
    return InputCorrection(
        "markers_exchanged",
        f"markers {a} and {b} are exchanged in {where} at all stops: they fit the epipolar geometry the other way "
        "round",
        {"markers": [a, b], "cameras": names if k == 1 else names[1:]},
        with_ids_exchanged(trials, k, *pair),
    )


def kind_hypotheses(trials: TrialData, views: InitialViews) -> Iterator[InputCorrection]:
    """Corrections of a joint's kind where its own trial fits the other kind much better."""
    cameras, points, usable = views
    residuals_by_kind: dict[int, tuple[float, float, Kind]] = {}
    for joint, observations, displacement in own_trials(trials, points, usable):
        stated = trials.joint_kinds[joint]
        other: Kind = "prismatic" if stated == "revolute" else "revolute"
        as_stated, as_other = (
            best_single_joint(kind, cameras, observations, displacement, thorough=True)[1]
            for kind in (stated, other)
        )
        residuals_by_kind[joint] = as_stated, as_other, other
    # The other kind must reach what the other joints do; a joint that fits neither kind has another fault.
    floor = (
        float(np.median([min(least, instead) for least, instead, _ in residuals_by_kind.values()]))
        if residuals_by_kind
        else 0.0
    )
    for joint, (least, instead, other) in residuals_by_kind.items():
        if not instead < min(KIND_BETTER * floor, least / KIND_BETTER):
            continue
        name, stated = trials.joint_names[joint], trials.joint_kinds[joint]
        kinds = tuple(other if j == joint else kind for j, kind in enumerate(trials.joint_kinds))
        yield InputCorrection(
            "joint_kind",
            f"joint {name!r} is said to be {stated}, but is {other}: as such its trial fits to {instead:.3g} sigmas, "
            f"as stated to {least:.3g}",
            {"joint": name, "kind": other},
            msgspec.structs.replace(trials, joint_kinds=kinds),
        )


def order_hypotheses(trials: TrialData, refit: Refit, options: FitOptions) -> Iterator[InputCorrection]:
    """Corrections of the joints' order (two exchanged, or all reversed) where free poses contradict the order
    stated.
    """
    free = trials.trials < 0
    n = len(trials.joint_names)
    if not free.any() or n < 2:
        return
    alone = fit_of_correction(
        msgspec.structs.replace(
            trials,
            positions=trials.positions[~free],
            trials=trials.trials[~free],
            pixels=trials.pixels[:, ~free],
            sigmas=trials.sigmas[:, ~free],
        ),
        refit,
        options,
    )
    if alone is None:
        return
    rig, kept = projective_rig(alone.model), [trials.marker_ids.index(i) for i in alone.model.marker_ids]
    seen = trials.pixels[:, free][:, :, kept]
    orders = [np.arange(n)[::-1]]
    for a, b in combinations(range(n), 2):
        order = np.arange(n)
        order[[a, b]] = b, a
        orders.append(order)
    typical = []
    for order in orders:
        moved = replace(rig, kinds=tuple(rig.kinds[j] for j in order), generators=rig.generators[order])
        expected = expected_pixels(moved, (trials.positions[free] - alone.model.zero)[:, order])
        typical.append(float(np.nanmedian(np.linalg.norm(expected - seen, axis=-1))))
    order = orders[int(np.argmin(typical))]
    names = [trials.joint_names[j] for j in order]
    moved_ones = [name for name, own in zip(names, trials.joint_names, strict=True) if name != own]
    yield InputCorrection(
        "joint_order",
        f"the joints do not follow one another as listed: free poses fit with the order {names}, base first. "
        f"Exchanged are {moved_ones}",
        {"order": names, "joints": moved_ones},
        in_order(trials, order),
    )


def in_order(trials: TrialData, order: npt.NDArray[np.int64]) -> TrialData:
    """The trials with their joints in another ``order`` (n,), base first."""
    place = np.argsort(order)
    return msgspec.structs.replace(
        trials,
        joint_names=tuple(trials.joint_names[j] for j in order),
        joint_kinds=tuple(trials.joint_kinds[j] for j in order),
        positions=trials.positions[:, order],
        trials=np.where(trials.trials >= 0, place[trials.trials], trials.trials),
    )


InitialViews = tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]
Refit = Callable[[TrialData, FitOptions], CalibrationFit]

FEW_OUTLIERS = 0.1
"""Share of pixels that a fit may leave out for its hypothesis to count."""


def fit_of_correction(trials: TrialData, refit: Refit, options: FitOptions) -> CalibrationFit | None:
    """The fit of a hypothesis, or None where it does not make the data fit."""
    try:
        result = refit(trials, options)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        return None
    used = result.model.statistics
    assert used is not None
    pixels = used.measurements // 2 + used.outliers
    return result if used.outliers <= FEW_OUTLIERS * pixels else None


def pinhole_reconstruction(trials: TrialData) -> InitialViews:
    """Projective cameras, points and usable pixels by `initial_reconstruction`, with lens distortion removed."""
    return initial_reconstruction(undistorted(trials, straight_lenses(trials)))


def solution_of(trials: TrialData, result: CalibrationFit) -> Solution:
    """The final bundle of a fit, reconstructed from its model: linearised in the frame of its stratum, without a
    step.
    """
    model = result.model
    kept = [trials.marker_ids.index(i) for i in model.marker_ids]
    used = trials.visible[:, :, kept]
    names = [camera.name for camera in trials.cameras]
    for outlier in result.report.outliers:
        used[names.index(outlier.camera), outlier.stop, model.marker_ids.index(outlier.marker)] = False
    camera, stop, marker = np.nonzero(used)
    data = Measurements(
        trials.positions - model.zero,
        camera,
        stop,
        marker,
        trials.pixels[:, :, kept][used],
        trials.sigmas[:, :, kept][used],
        prior_of_lenses(trials, {}),
    )
    rig = stratum_rig(model)
    evaluations = 1
    if model.joint_accuracy is not None:
        noise = noise_of_accuracy(model.joint_accuracy, readings(trials.positions - model.zero))
        # The errors of the joints are not kept in the model: they take a step.
        data, evaluations = data.with_joint_noise(noise), 4
    lenses = lens_model_of(rig.lenses)
    return solve(rig, data, model.stratum, lenses=lenses, max_evaluations=evaluations)
