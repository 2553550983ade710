"""Separate joints (5.52): each joint's generator from its own trial, at the configuration of that trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.calibration.bundle import Measurements, Rig, solve
from stereoservo.kinematics.calibration.starts import common_points, linear_generator, nominal_generator
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData, finite_rows

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

MIN_STOPS = 4
"""Different positions, at which markers are shown, that a joint's trial needs."""
MIN_SHOWN = 2
"""Markers that two cameras must see for a stop to count."""
MIN_MARKERS = 3
"""Markers that a trial must show."""
MIN_RANGE = 0.02
"""Smallest motion of a joint in its trial [rad or m]."""
MIN_IMAGE_MOTION = 10.0
"""Smallest motion of the markers over a trial [sigmas]."""
STILL = 2e-3
"""How far other joints may stray during a trial [rad or m] and still count as locked."""
GOOD_FIT = 3.0
"""Median residual [sigmas] of a joint's own trial at which no other start is tried."""
MISFIT = 20.0
"""Median residual [sigmas] of a joint's own trial above which the joint is not what it is said to be."""


@dataclass(frozen=True)
class JointTrial:
    """A joint's own trial: ``stops`` (k,), ``base`` (n,) the locked configuration, ``reference`` its middle
    position.

    ``generator`` (4, 4) at the base; ``points`` (m, 4) at the base with the joint at ``reference``, NaN for
    markers that the trial does not show.
    """

    joint: int
    stops: IntArray
    base: FloatArray
    generator: FloatArray
    points: FloatArray


def measurements(trials: TrialData, usable: BoolArray, offsets: FloatArray) -> Measurements:
    """The usable pixels (c, s, m) as a flat list."""
    camera, stop, marker = np.nonzero(usable)
    return Measurements(
        offsets, camera, stop, marker, trials.pixels[usable].reshape(-1, 2), trials.sigmas[usable].ravel()
    )


def trial_stops(trials: TrialData, points: FloatArray, joint: int) -> tuple[IntArray, FloatArray]:
    """Stops (k,) at which only ``joint`` differs from the trial's base (n,). Raises CalibrationError.

    Stops of other trials that happen to stand on the base belong to it, too.
    """
    name, unit = trials.joint_names[joint], _unit(trials, joint)
    own = trials.trials == joint
    positions = trials.positions
    if not own.any():
        raise CalibrationError(
            "too_few_stops",
            f"joint {name!r} has no trial stops; at least {MIN_STOPS} are needed",
            joint=name,
            stops=0,
            minimum=MIN_STOPS,
        )
    moved = float(np.ptp(positions[own, joint]))
    if moved < MIN_RANGE:
        raise CalibrationError(
            "joint_did_not_move",
            f"joint {name!r} moved {moved:.4g} {unit} in its trial; at least {MIN_RANGE:g} {unit} is needed",
            joint=name,
            range=moved,
            minimum=MIN_RANGE,
        )
    base = np.median(positions[own], axis=0)
    others = np.delete(np.abs(positions - base), joint, axis=1).max(axis=1, initial=0.0)
    still = others <= STILL
    shown = finite_rows(points).sum(axis=1) >= MIN_SHOWN
    stops = np.flatnonzero(still & shown)
    distinct = len(np.unique(np.round(positions[stops, joint] / STILL)))
    if distinct < MIN_STOPS:
        lost, strayed = int((own & ~shown).sum()), int((own & ~still).sum())
        raise CalibrationError(
            "too_few_stops",
            f"joint {name!r}: {distinct} different usable stops; at least {MIN_STOPS} are needed. Of "
            f"{int(own.sum())} stops, {lost} show fewer than {MIN_SHOWN} markers that two cameras agree "
            f"on, and at {strayed} other joints strayed by more than {STILL:g}",
            joint=name,
            stops=distinct,
            minimum=MIN_STOPS,
            markers_lost=lost,
            strayed=strayed,
        )
    if float(np.ptp(positions[stops, joint])) < MIN_RANGE:
        raise CalibrationError(
            "joint_did_not_move",
            f"joint {name!r}: the stops that show markers span {np.ptp(positions[stops, joint]):.4g} "
            f"{unit}; at least {MIN_RANGE:g} {unit} is needed",
            joint=name,
            range=float(np.ptp(positions[stops, joint])),
            minimum=MIN_RANGE,
        )
    _check_effect(trials, stops, joint)
    return stops, base


def separate_joint(
    trials: TrialData, cameras: FloatArray, points: FloatArray, usable: BoolArray, joint: int
) -> JointTrial:
    """Generator of ``joint`` and the markers from its own trial, cameras (c, 3, 4) fixed (5.52).

    ``points`` (s, m, 4) triangulated, ``usable`` (c, s, m). A linear start over all pairs of stops, then
    least squares with free markers; a start as if the cameras were nominal ones where that does not fit.
    Raises CalibrationError naming the joint.
    """
    name, kind = trials.joint_names[joint], trials.joint_kinds[joint]
    stops, base = trial_stops(trials, points, joint)
    angles = trials.positions[stops, joint] - base[joint]
    here: BoolArray = usable[:, stops] & finite_rows(points[stops])
    shown: BoolArray = np.asarray(here.any(axis=(0, 1)), dtype=bool)
    if int(shown.sum()) < MIN_MARKERS:
        raise CalibrationError(
            "too_few_markers",
            f"joint {name!r}: {int(shown.sum())} markers are seen by two cameras in its trial; at least "
            f"{MIN_MARKERS} are needed",
            joint=name,
            markers=int(shown.sum()),
            minimum=MIN_MARKERS,
        )
    offsets = np.zeros((len(trials.positions), 1))
    offsets[stops, 0] = angles
    mask: BoolArray = np.zeros(usable.shape, dtype=bool)
    mask[:, stops] = here
    data = measurements(trials, mask, offsets)
    best, least = None, np.inf
    for start in (linear_generator, nominal_generator):
        generator = start(
            kind, cameras, points[stops], here, trials.pixels[:, stops], trials.sigmas[:, stops], angles
        )
        if generator is None:
            continue
        structure = common_points(generator, kind, points[stops], angles)
        structure[~shown] = [0.0, 0.0, 1.0, 1.0]
        rig = Rig((kind,), generator[None], cameras, structure)
        fit = solve(
            rig,
            data,
            "projective",
            cameras=False,
            loss="soft_l1",
            loss_scale=3.0,
            max_evaluations=40,
        )
        # The median of a chi-square with two degrees of freedom is ln 4.
        squares = (fit.residuals.reshape(-1, 2) ** 2).sum(axis=1)
        typical = float(np.sqrt(np.median(squares) / np.log(4.0)))
        if typical < least:
            best, least = fit.rig, typical
        if least < GOOD_FIT:
            break
    if best is None or not least < MISFIT:
        raise CalibrationError(
            "joint_kind",
            f"joint {name!r}: its trial does not look like a "
            f"{'rotation' if kind == 'revolute' else 'translation'} by the reported positions: typical "
            f"residual {least:.3g} sigmas, at most {MISFIT:g} expected. Is the joint {kind}, are its "
            "positions right, did only it move?",
            joint=name,
            residual_sigmas=least,
            maximum=MISFIT,
        )
    return JointTrial(joint, stops, base, best.generators[0], np.where(shown[:, None], best.points, np.nan))


def _check_effect(trials: TrialData, stops: IntArray, joint: int) -> None:
    """Refuse a joint whose trial leaves the images as they are: nothing can be learnt of it."""
    name = trials.joint_names[joint]
    visible = trials.visible[:, stops]
    motions = []
    for c, i in zip(*np.nonzero(visible.sum(axis=1) >= 2), strict=True):
        # Inner quantiles of stops and an upper one of markers: single wrong pixels must not look like motion.
        pixels = trials.pixels[c, stops[visible[c, :, i]], i]
        sigma = np.median(trials.sigmas[c, stops[visible[c, :, i]], i])
        motions.append(float(np.linalg.norm(np.ptp(np.quantile(pixels, [0.1, 0.9], axis=0), axis=0)) / sigma))
    largest = float(np.quantile(motions, 0.8)) if motions else 0.0
    if largest < MIN_IMAGE_MOTION:
        raise CalibrationError(
            "joint_without_effect",
            f"joint {name!r} reports motion, but the markers moved by {largest:.3g} sigmas only in the "
            f"images; at least {MIN_IMAGE_MOTION:g} are needed. Does it drive what the cameras see?",
            joint=name,
            motion_sigmas=largest,
            minimum=MIN_IMAGE_MOTION,
        )


def _unit(trials: TrialData, joint: int) -> str:
    return "rad" if trials.joint_kinds[joint] == "revolute" else "m"
