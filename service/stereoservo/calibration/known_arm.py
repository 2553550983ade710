"""Calibration with a known arm: cameras, lenses and markers from pixels at known displacements, such as the hand poses
that a robot reports (`free_arm`); errors of the displacements are estimated.

Known twists define the frame, including metres, and any motion is sufficient: no joint has to move alone. Each camera
is a free matrix without assumptions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.bundle_inliers import (
    refine_to_convergence,
    refuse_undetermined,
    with_whole_stops,
)
from stereoservo.calibration.calibration_result import CalibrationFit, FitHistory, ModelFrame, build_fit
from stereoservo.calibration.joint_noise import StopFactor, orthogonal_factor
from stereoservo.calibration.least_squares import RobustLoss
from stereoservo.calibration.lens_estimation import (
    prior_of_lenses,
    required_lens_model,
    starting_lenses,
    undistorted_lenses,
    with_pinhole_cameras,
)
from stereoservo.calibration.rig_model import Measurements, RigModel, displacements, residuals
from stereoservo.calibration.single_joint_fit import measurements
from stereoservo.calibration.stratum_selection import NOMINAL_PLANE, FitOptions
from stereoservo.calibration.trial_data import CalibrationError, TrialCamera, TrialData
from stereoservo.calibration.variance_components import (
    Readings,
    VarianceComponents,
    estimate_components,
    joint_noise_of,
    readings,
    reduced_rows,
)
from stereoservo.geometry.cameras import from_pixels, pixel_normaliser, resection
from stereoservo.geometry.distortion import LensEstimate
from stereoservo.geometry.homogeneous import GeometryError, to_homogeneous
from stereoservo.geometry.screws import screw_twist
from stereoservo.geometry.strata import decompose_camera
from stereoservo.kinematics.model import CellModel
from stereoservo.kinematics.parameterization import Kind, LensModel
from stereoservo.numerics.arrays import BoolArray, FloatArray

NAMES = ("x", "y", "z", "rz", "ry", "rx")
"""Joints of a free arm, base first."""
KINDS: tuple[Kind, ...] = ("prismatic", "prismatic", "prismatic", "revolute", "revolute", "revolute")
RIGID = 1e-6
"""Largest entry of RᵀR - 1 up to which a displacement counts as rigid."""


def free_arm(displacements: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions (s, 6) [m, rad] and generators (6, 4, 4) of a free arm that makes ``displacements`` (s, 4, 4) [m] of a
    body, and the displacement (4, 4) at its zero: their mean.

    ``D = E_x E_y E_z E_rz E_ry E_rx D_zero``, with the rotations about the zero's origin. Raises CalibrationError
    (``bad_data``) for a displacement that is not rigid.
    """
    D = np.asarray(displacements, dtype=np.float64)
    _check_rigid(D)
    zero = np.eye(4)
    zero[:3, :3] = Rotation.from_matrix(D[:, :3, :3]).mean().as_matrix()
    zero[:3, 3] = D[:, :3, 3].mean(axis=0)
    rotations = Rotation.from_matrix(D[:, :3, :3] @ zero[:3, :3].T)
    positions = np.hstack([D[:, :3, 3] - zero[:3, 3], rotations.as_euler("ZYX")])
    generators = np.zeros((6, 4, 4))
    generators[[0, 1, 2], [0, 1, 2], 3] = 1.0
    generators[3:] = [screw_twist(axis, zero[:3, 3]) for axis in np.eye(3)[::-1]]
    return positions, generators, zero


def _check_rigid(D: FloatArray) -> None:
    if D.ndim != 3 or D.shape[1:] != (4, 4) or not len(D):
        raise CalibrationError("bad_data", f"displacements of shape {D.shape}; (s, 4, 4) with at least one are needed")
    off = np.abs(D[:, :3, :3].transpose(0, 2, 1) @ D[:, :3, :3] - np.eye(3)).max(axis=(1, 2))
    off = np.maximum(off, np.abs(D[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1))
    wrong = ~(off <= RIGID) | ~(np.linalg.det(D[:, :3, :3]) > 0.0) | ~np.isfinite(D).all(axis=(1, 2))
    if wrong.any():
        stop = int(np.flatnonzero(wrong)[0])
        raise CalibrationError(
            "bad_data",
            f"displacement {stop} is not rigid: RᵀR differs from 1 by {off[stop]:.3g}, at most {RIGID:g} is taken, and "
            "its last row must be 0 0 0 1",
            stop=stop,
        )


def trials_of_poses(
    displacements: FloatArray,
    cameras: Sequence[TrialCamera],
    marker_ids: Sequence[int],
    pixels: FloatArray,
    sigmas: FloatArray,
) -> TrialData:
    """Trial data of a body with markers at known ``displacements`` (s, 4, 4) [m], such as the hand poses that a robot
    reports; ``pixels`` (c, s, m, 2) and ``sigmas`` (c, s, m) as in `TrialData`.

    Raises CalibrationError (``bad_data``).
    """
    positions, generators, _ = free_arm(displacements)
    return TrialData(
        joint_names=NAMES,
        joint_kinds=KINDS,
        cameras=tuple(cameras),
        marker_ids=tuple(marker_ids),
        positions=positions,
        trials=np.full(len(positions), -1),
        pixels=pixels,
        sigmas=sigmas,
        images=int(np.isfinite(pixels).all(axis=-1).any(axis=-1).sum()),
        generators=generators,
    )


LEAST_VIEWS = 6
"""Stops at which a camera must see markers: it has 11 unknowns, and close markers of unknown positions determine
little more than one point."""
LEAST_MOTION = 1e-6
"""Spread of the body's origin [m] below which it counts as not moved."""
RADII = (0.5, 1.0, 2.0)
DIRECTIONS = 12
"""Initial marker positions relative to the body's origin: directions on spheres [spreads of the motion]."""
ALTERNATIONS, BUNDLES = 4, 4
AGREEMENT = 1e-4
"""At most ``BUNDLES`` of the best guesses are bundled; fewer if two converge to the same cost."""
MISJUDGED = 1.1
"""Factor on the stated sigmas above which a note reports it."""
ROUGHLY = 1e-6
"""Relative decrease of the cost at which all bundles but the last one stop."""
AS_GOOD = 1.1
"""Ratio of variances up to which a simpler lens model replaces an undetermined one."""
ROUNDS = 5
"""Most rounds of estimating the errors of the displacements, and with them the lens model."""


class _BundleWithErrors(NamedTuple):
    """A bundle, all its measurements, mask of their ``inliers`` (k,), and the errors of the displacements that
    whiten it, None if none are significant.
    """

    solution: Solution
    every: Measurements
    inliers: BoolArray
    components: VarianceComponents | None


def fit_with_known_arm(
    trials: TrialData,
    options: FitOptions,
    priors: Mapping[str, LensEstimate],
    *,
    epoch: int,
    created: str = "",
) -> CalibrationFit:
    """Metric model of trials with known generators, in the frame of the first camera, and its report.

    Pixels are weighted by the noise that they show beside the errors of the displacements, if it is above the stated
    one: the report's ``sigma_factor``. ``priors``: of the lenses, by camera. Raises CalibrationError (``bad_data``,
    ``too_few_stops``, ``too_few_markers``, ``joint_did_not_move``, ``no_convergence``, ``not_identifiable``).
    """
    if any(camera.mount != "eye_to_hand" for camera in trials.cameras):
        raise CalibrationError(
            "bad_data",
            "generators are given with cameras on the tip; known displacements are those of markers before cameras "
            "that stand: give the scene's as the hand sees them, the inverses of the hand's, and eye_to_hand cameras",
            key="generators",
        )
    found = _bundled(trials, options, priors)
    every = found.every
    factor = float(np.median(every.sigmas / trials.sigmas[every.camera, every.stop, every.marker]))
    result = build_fit(
        trials,
        in_first_camera(found.solution),
        every,
        found.inliers,
        ModelFrame(np.zeros(len(trials.joint_names)), NOMINAL_PLANE),
        FitHistory((found.solution.cost, found.solution.statistics.freedom), _notes(factor)),
        epoch=epoch,
        created=created,
        components=found.components,
    )
    return CalibrationFit(result.model, msgspec.structs.replace(result.report, sigma_factor=factor))


def _notes(factor: float) -> tuple[str, ...]:
    if factor <= MISJUDGED:
        return ()
    return (
        f"pixels scatter {factor:.3g} times as much as stated, beside the errors of the displacements: chi-square and "
        "deviations are those of the larger sigmas",
    )


def _bundled(trials: TrialData, options: FitOptions, priors: Mapping[str, LensEstimate]) -> _BundleWithErrors:
    """The metric bundle in the generators' frame. Raises CalibrationError."""
    _check_views(trials)
    every = measurements(trials, trials.visible, trials.positions)
    at = readings(trials.positions)
    # No two poses share a repeatable error, unlike equal readings of a joint's gear.
    at = Readings(np.broadcast_to(np.arange(len(trials.positions))[:, None], trials.positions.shape), at.features)
    rig = _start(trials, every)
    lenses: LensModel = "none" if options.lens == "auto" else options.lens
    if priors:
        # Otherwise none: known displacements separate lenses from cameras, and no centre has to be assumed.
        every = replace(every, lens_priors=prior_of_lenses(trials, priors))
        bent, lenses = starting_lenses(trials, options.lens, priors)
        rig = replace(rig, lenses=np.pad(bent, ((0, 0), (0, 7 - bent.shape[1]))))
    try:
        robust = solve(rig, every, "metric", lenses=lenses, loss=RobustLoss("soft_l1", 2.0), tolerance=1e-6)
        solution, inliers = refine_to_convergence(robust.rig, every, "metric", options, lenses, ROUGHLY)
        found = _with_errors(_BundleWithErrors(solution, every, inliers, None), at, options)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            "no_convergence",
            f"the bundle broke down: {error}. Are displacements and markers what they are said to be?",
        ) from error
    refuse_undetermined(found.solution, ())
    return found if found.components is None else found._replace(solution=_with_errors_stated(found, at))


def _with_errors_stated(found: _BundleWithErrors, at: Readings) -> Solution:
    """The solution with the covariance of its parameters under the stated errors of the displacements, which exceed
    the estimated ones because few displacements determine these poorly.
    """
    solution, components = found.solution, found.components
    assert components is not None
    noise = joint_noise_of(components.stated, np.zeros(len(components.random)), components.stated_posture, at)
    data = solution.data.with_joint_noise(noise)
    factor = orthogonal_factor(solution.rig, solution.charts, data)
    return replace(solution, stated_factor=factor) if isinstance(factor, StopFactor) else solution


def _with_errors(found: _BundleWithErrors, at: Readings, options: FitOptions) -> _BundleWithErrors:
    """The bundle whitened by the estimated errors of the displacements, with the lenses that it then requires,
    repeated until both stay the same.
    """
    solution, every, inliers, components = found
    stated, total = every.sigmas, 1.0
    for _ in range(ROUNDS):
        before, lenses = components, solution.lenses
        components = estimate_components(reduced_rows(solution, at), scales=False, near=before)
        if components is None or not components.significant:
            components, factor, every = None, solution.statistics.variance, every.with_joint_noise(None)
        else:
            factor, every = components.pixels, every.with_joint_noise(components.noise(at))
            inliers = with_whole_stops(every, inliers) if before is None else inliers
        total = max(total * factor, 1.0)
        every = replace(every, sigmas=stated * np.sqrt(total))
        solution, inliers = refine_to_convergence(solution.rig, every, "metric", options, lenses, ROUGHLY, inliers)
        required = required_lens_model(solution) if options.lens == "auto" else lenses
        if required != lenses:
            solution, inliers = refine_to_convergence(solution.rig, every, "metric", options, required, ROUGHLY)
        elif components is None or (before is not None and components.is_close_to(before)):
            break
    solution, inliers = refine_to_convergence(solution.rig, every, "metric", options, solution.lenses)
    if options.lens == "auto" and every.lens_priors is None and not solution.converged:
        solution, inliers = _simpler_lenses(solution, every, inliers, options)
    return _BundleWithErrors(solution, every, inliers, components)


def _simpler_lenses(
    open_one: Solution, every: Measurements, inliers: BoolArray, options: FitOptions
) -> tuple[Solution, BoolArray]:
    """The first converging bundle with fewer lens terms, if those of ``open_one`` are undetermined and explain next to
    nothing; else ``open_one`` with its ``inliers`` (k,).
    """
    most = AS_GOOD * open_one.statistics.variance
    simpler: tuple[LensModel, ...] = ("radial_centre", "radial", "none")
    for lenses in simpler[simpler.index(open_one.lenses) + 1 if open_one.lenses in simpler else 0 :]:
        rig = with_pinhole_cameras(open_one.rig, every)
        found, kept = refine_to_convergence(rig, every, "metric", options, lenses)
        if found.converged and found.statistics.variance <= most:
            return found, kept
    return open_one, inliers


def in_first_camera(solution: Solution) -> Solution:
    """A metric solution with its rig and charts in the frame in which the first camera is ``K [I | 0]``."""
    rig, charts = solution.rig, solution.charts
    K, R, t = decompose_camera(rig.cameras[0])
    frame, back = np.eye(4), np.eye(4)
    frame[:3, :3], frame[:3, 3] = R, t
    back[:3, :3], back[:3, 3] = R.T, -R.T @ t
    cameras = rig.cameras @ back
    scale = float(cameras[0, 2, 2])
    cameras[0] = scale * np.hstack([K, np.zeros((3, 1))])
    return replace(
        solution,
        rig=replace(rig, generators=frame @ rig.generators @ back, cameras=cameras, points=rig.points @ frame.T),
        charts=replace(
            charts,
            cameras=tuple(basis @ back for basis in charts.cameras),
            points=tuple(basis @ frame.T for basis in charts.points),
        ),
    )


def frame_of_known_arm(model: CellModel, generators: FloatArray) -> FloatArray:
    """Rigid ``H`` (4, 4) [m] from the frame of the known ``generators`` (n, 4, 4) to the Euclidean frame of a metric
    ``model`` that was fitted with them, the first camera's.

    Raises CalibrationError (``bad_data``) if the model is not metric or the generators do not determine the frame.
    """
    upgrade = model.projective_to_euclidean
    if upgrade is None:
        raise CalibrationError("bad_data", f"the model is {model.stratum}; a metric one is needed", key="stratum")
    transformed = upgrade @ model.generators @ np.linalg.inv(upgrade)
    # H G = G' H, row by row; the last row of H is (0, 0, 0, 1).
    system = np.vstack(
        [
            np.kron(np.eye(4), one.T) - np.kron(other, np.eye(4))
            for one, other in zip(generators, transformed, strict=True)
        ]
    )
    found, _, rank, _ = np.linalg.lstsq(system[:, :12], -system[:, 15], rcond=1e-9)
    if rank < 12:
        raise CalibrationError("bad_data", f"the generators fix {rank} of 12 numbers of the frame", key="generators")
    return np.vstack([found.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


def _check_views(trials: TrialData) -> None:
    stops = trials.visible.any(axis=2).sum(axis=1)
    if (stops < LEAST_VIEWS).any():
        counts = ", ".join(f"{camera.name!r} {int(count)}" for camera, count in zip(trials.cameras, stops, strict=True))
        raise CalibrationError(
            "too_few_stops",
            f"cameras see markers at so many poses: {counts}; each needs at least {LEAST_VIEWS}",
            views=stops.tolist(),
            minimum=LEAST_VIEWS,
        )
    shown = np.atleast_1d(trials.visible.any(axis=(0, 1)))
    unseen = [i for i, seen in zip(trials.marker_ids, shown, strict=True) if not seen]
    if unseen:
        raise CalibrationError("too_few_markers", f"markers {unseen} are seen by no camera", markers=unseen)


class _Normalised(NamedTuple):
    """Displacements (s, 4, 4) in spreads of the motion, normalised pixels (c, s, m, 2), and half widths (c,) [px]."""

    moved: FloatArray
    pixels: FloatArray
    halves: FloatArray

    def errors(self, cameras: FloatArray, points: FloatArray) -> FloatArray:
        """Distances (c, s, m) [px] of the predicted pixels from the measured ones; NaN where there are none."""
        images = np.einsum("cij,sjk,mk->csmi", cameras, self.moved, to_homogeneous(points))
        ideal = images[..., :2] / images[..., 2:]
        return np.asarray(np.linalg.norm(ideal - self.pixels, axis=-1) * self.halves[:, None, None])


def _start(trials: TrialData, every: Measurements) -> RigModel:
    """Rig in the generators' frame: for several guesses of the markers' position, linear cameras and points in turn,
    then bundles of the best few. Raises CalibrationError (``joint_did_not_move``, ``no_convergence``).
    """
    assert trials.generators is not None
    n, m, c = len(trials.joint_names), len(trials.marker_ids), len(trials.cameras)
    rig = RigModel(
        trials.joint_kinds,
        trials.generators,
        np.zeros((c, 3, 4)),
        np.zeros((m, 4)),
        undistorted_lenses(trials),
        True,
    )
    moved = displacements(rig, trials.positions)
    origin = _body_origin(trials.generators)
    path = moved[:, :3, :3] @ origin + moved[:, :3, 3]
    size = float(np.sqrt(path.var(axis=0).sum()))
    if not size > LEAST_MOTION:
        raise CalibrationError(
            "joint_did_not_move",
            f"the body moved by {size:.2g} m over all {len(moved)} poses; a fit needs centimetres in several "
            "directions",
            spread_m=size,
            joints=n,
        )
    to_unit = np.eye(4) / size
    to_unit[:3, 3], to_unit[3, 3] = -origin / size, 1.0
    N = np.array([pixel_normaliser(camera.width, camera.height) for camera in trials.cameras])
    data = _Normalised(
        to_unit @ moved @ np.linalg.inv(to_unit),
        np.array([from_pixels(one, pixels) for one, pixels in zip(N, trials.pixels, strict=True)]),
        np.array([camera.width / 2.0 for camera in trials.cameras]),
    )
    found = [one for one in (_linear(data, guess, m) for guess in _guesses()) if one is not None]
    best: Solution | None = None
    costs: list[float] = []
    for _, cameras, points in sorted(found, key=lambda one: one[0])[:BUNDLES]:
        start = replace(
            rig,
            cameras=np.linalg.inv(N) @ cameras @ to_unit,
            points=to_homogeneous(points) @ np.linalg.inv(to_unit).T,
        )
        try:
            solution = solve(start, every, "metric", loss=RobustLoss("soft_l1", 2.0), tolerance=1e-6)
        except np.linalg.LinAlgError:
            continue  # a guess with points in a focal plane
        robust = float(np.sqrt(1.0 + residuals(solution.rig, every) ** 2).sum())
        best = solution if best is None or robust < min(costs) else best
        costs.append(robust)
        if len(costs) > 1 and max(costs) < (1.0 + AGREEMENT) * min(costs):
            break
    if best is None:
        raise CalibrationError(
            "no_convergence",
            f"none of {len(RADII) * DIRECTIONS} guesses of the markers' place on the body leads to cameras. Are the "
            "displacements those of what carries the markers?",
            guesses=len(RADII) * DIRECTIONS,
        )
    return best.rig


def _body_origin(generators: FloatArray) -> FloatArray:
    """The point (3,) nearest to all axes of rotation, for a free arm the body's origin at its zero: the centre of the
    guesses.
    """
    rotations = generators[np.abs(generators[:, :3, :3]).any(axis=(1, 2))]
    if not len(rotations):
        return np.zeros(3)
    return np.asarray(np.linalg.lstsq(rotations[:, :3, :3].reshape(-1, 3), -rotations[:, :3, 3].ravel(), rcond=1e-9)[0])


def _guesses() -> FloatArray:
    """Offsets (g, 3) [spreads]: an even spiral of directions on each of ``RADII``."""
    i = np.arange(DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * i / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * i
    ring = np.sqrt(1.0 - z**2)
    sphere = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
    return np.concatenate([radius * Rotation.from_euler("x", k).apply(sphere) for k, radius in enumerate(RADII)])


def _linear(data: _Normalised, guess: FloatArray, m: int) -> tuple[float, FloatArray, FloatArray] | None:
    """Median error [px], cameras (c, 3, 4) and points (m, 3) from all markers at one ``guess`` (3,); None if it is
    degenerate.
    """
    points = np.tile(guess, (m, 1))
    seen = np.isfinite(data.pixels)
    count = np.maximum(seen.sum(axis=2, keepdims=True), 1)
    centroids = np.where(seen, np.where(seen, data.pixels, 0.0).sum(axis=2, keepdims=True) / count, np.nan)
    try:
        for iteration in range(ALTERNATIONS):
            cameras = _resected(data.moved, points, centroids if iteration == 0 else data.pixels)
            points = _linear_points(data, cameras)
        cameras = _resected(data.moved, points, data.pixels)
    except (GeometryError, np.linalg.LinAlgError):
        return None
    errors = data.errors(cameras, points)[np.isfinite(data.pixels).all(axis=-1)]
    return (float(np.median(errors)), cameras, points) if np.isfinite(errors).all() else None


def _resected(moved: FloatArray, points: FloatArray, pixels: FloatArray) -> FloatArray:
    world = to_homogeneous(points) @ moved.transpose(0, 2, 1)
    return np.array([resection(world.reshape(-1, 4), one.reshape(-1, 2), refine=False) for one in pixels])


def _linear_points(data: _Normalised, cameras: FloatArray) -> FloatArray:
    """Points (m, 3) that satisfy ``(P₁₂ - u P₃) D X = 0`` over all views, by depth-weighted least squares."""
    rows = cameras[:, None, None, :2] - data.pixels[..., None] * cameras[:, None, None, 2:]
    depths = np.einsum("cj,sj->cs", cameras[:, 2], data.moved[:, :, 3])
    rows = np.einsum("csmaj,sjk->csmak", rows, data.moved) / depths[:, :, None, None, None]
    found = []
    for k in range(rows.shape[2]):
        own = rows[:, :, k].reshape(-1, 4)
        own = own[np.isfinite(own).all(axis=1)]
        found.append(np.linalg.lstsq(own[:, :3], -own[:, 3], rcond=1e-9)[0])
    return np.array(found)
