"""Experiment ``robot`` (tables 5.1 to 5.4): self-calibration of a 6R arm from a moving plate; images, axes, links,
intrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from scipy.special import ellipe
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import norm

from stereoservo.calibration.bundle_adjustment import jacobian, solve
from stereoservo.calibration.rig_model import Measurements, RigModel, full_charts, residuals, rig_at
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.single_joint_fit import measurements
from stereoservo.calibration.trial_data import TrialData
from stereoservo.geometry.cameras import projection_jacobian_many, triangulate
from stereoservo.geometry.distortion import undistort
from stereoservo.kinematics.axes import FramedModel, axis_angle, camera_intrinsics, framed_model, joint_axes
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import propagate_covariance
from stereoservo.kinematics.denavit_hartenberg import conventions, dh_values
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.known_length import KnownLength
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.experiments.experiment import Comparison, not_comparable, of_error, whole_table
from stereoservo_sim.experiments.figures import Figures, picture
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell, dh_link, flat_plate, placed, rotation, translation

SIGMA = 0.05
"""Noise of a dot's centre [px] an axis."""
IMPLIED_SIGMA, IMPLIED_BASELINE = 0.094, 0.20
"""Noise [px] per axis implied by the mean image error of table 5.1 with free points (0.117 px is the mean length of
the residual after the fit), and the baseline [m] stated in 8.6 for the same robot.
"""
STOPS = 20
"""Stops per stroke of each joint, for each position of the plate."""
PLATE_TURNS_DEG = (-135.0, -67.5, 0.0, 67.5)
"""Angles of the last joint from home while the others move: 4 dots become 16 rigid points, every 22.5° of a circle
(fig. 5.16). Quarter turns would map the square onto itself.
"""
ROWS = (
    (0.0, -90.0, 0.42),
    (0.400, 0.0, 0.0),
    (0.0, 90.0, 0.0),
    (0.0, -90.0, 0.800),
    (0.0, 90.0, 0.0003),
    (0.0, 0.0, 0.085),
)
"""a [m], alpha [°], d [m] of table 5.4: link 2 is a of joint 2, link 3 the offset from axis 3 to the wrist along axis
4; axes 4 and 6 miss each other by 0.3 mm along axis 5. Base height and flange are neither stated nor identifiable."""
HOME_DEG = (10.0, -60.0, 120.0, 20.0, 40.0, 15.0)
STROKES_DEG = (8.0, 8.0, 8.0, 30.0, 25.0, 170.0)
"""Strokes: each joint moves from minus to plus this about home."""
DISTANCE, BASELINE = 1.3, 0.46
"""Distance of the plate from the rig, and between the cameras, which are aimed at it [m]."""
SIZE = 512
"""Width and height of the images [px]."""

THESIS: dict[str, Any] = {
    "5.1": {
        "what": "mean image error [px] over the trial motion of each axis, (5.53) and (5.55)",
        "fixed": [0.55, 0.14, 0.15, 0.16, 0.16, 0.24],
        "free": [0.13, 0.10, 0.09, 0.12, 0.10, 0.16],
    },
    "5.2": {
        "what": "intrinsics [px], off-line calibration and experiment; the horizontal one is counted backwards",
        "right": {"fx": [1516.1, 1505.9], "fy": [1521.5, 1501.9], "u0": [260.5, 260.6], "v0": [252.6, 245.8]},
        "left": {"fx": [1534.3, 1512.7], "fy": [1539.6, 1507.5], "u0": [255.5, 250.4], "v0": [266.8, 254.6]},
    },
    "5.3": {
        "what": "angles between successive axes [°], factory and experiment",
        "axes 1, 2": [90.0, 89.72],
        "axes 2, 3": [0.0, 0.28],
        "axes 3, 4": [90.0, 89.71],
        "axes 4, 5": [90.0, 90.002],
        "axes 5, 6": [90.0, 90.10],
    },
    "5.4": {
        "what": "link lengths [mm], factory and experiment; link 2 gives the scale",
        "link 1": [0.0, 0.5522],
        "link 2": [400.0, 400.0],
        "link 3": [800.0, 800.5457],
        "link 4": [0.0, 0.0633],
        "link 5": [0.0, 0.0347],
        "axes 4, 6": [0.3, 0.1895],
    },
}
ASSUMPTIONS = [
    f"images of {SIZE}x{SIZE} px, off-line intrinsics of table 5.2 without the mirrored axis, left camera first",
    f"cameras {BASELINE} m apart, both looking at the plate {DISTANCE} m away; 4 dots at the corners of 10 cm",
    f"noise of {SIGMA} px an axis in every dot's centre; joint angles exact",
    f"implied: the same with {IMPLIED_SIGMA} px, from the mean of table 5.1 with free points, and the baseline of 8.6, "
    f"{IMPLIED_BASELINE} m; 8.6 has the cameras 1 m away, from where these strokes leave the images",
    f"home {list(HOME_DEG)} deg, strokes of plus and minus {list(STROKES_DEG)} deg, {STOPS} stops each",
    f"joints 1 to 5 are driven {len(PLATE_TURNS_DEG)} times, the last joint at {list(PLATE_TURNS_DEG)} deg from home",
    "link 3 is read as the offset from axis 3 to the wrist along axis 4, axes 4, 6 as their distance along axis 5",
]


def thesis_cell(baseline: float = BASELINE) -> SyntheticCell:
    """The arm with its plate before the two cameras, ``baseline`` [m] apart."""
    left = [[1534.3, 0.0, 255.5], [0.0, 1539.6, 266.8], [0.0, 0.0, 1.0]]
    right = [[1516.1, 0.0, 260.5], [0.0, 1521.5, 252.6], [0.0, 0.0, 1.0]]
    aside = float(np.degrees(np.arctan2(0.5 * baseline, DISTANCE)))
    poses = np.array(
        [
            rotation("y", -aside) @ translation(0.5 * baseline, 0.0, 0.0),
            rotation("y", aside) @ translation(-0.5 * baseline, 0.0, 0.0),
        ]
    )
    cell = placed(
        ("revolute",) * 6,
        tuple(dh_link(*row) for row in ROWS),
        flat_plate(),
        np.radians(HOME_DEG),
        np.radians(STROKES_DEG),
        rotation("x", 180) @ rotation("y", 15) @ rotation("x", 10),
        cameras=(np.array([left, right]), poses),
        distance=DISTANCE,
    )
    return replace(cell, width=SIZE, height=SIZE)


def trial_motions(
    cell: SyntheticCell, stops: int = STOPS, turns_deg: tuple[float, ...] = PLATE_TURNS_DEG
) -> tuple[FloatArray, IntArray]:
    """Positions (s, n) and the joint that moves (s,): strokes, except the last joint's, at each angle of the plate."""
    positions, trials = [], []
    last = len(cell.kinds) - 1
    for j in range(last + 1):
        for turn in turns_deg if j < last else (0.0,):
            for share in np.linspace(-1.0, 1.0, stops):
                q = cell.home.copy()
                q[last] += np.radians(turn)
                q[j] += share * cell.ranges[j]
                positions.append(q)
                trials.append(j)
    return np.array(positions), np.array(trials, dtype=np.int64)


# -- tables ----------------------------------------------------------------------------------------------------

LINK_2 = KnownLength("a", ("j2",), 0.4)
"""The scale, as in table 5.4."""


@dataclass(frozen=True)
class TableQuantity:
    """A quantity of a table: its place, name and unit."""

    table: str
    name: str
    unit: str


INTRINSICS = ("fx", "skew", "fy", "u0", "v0")
QUANTITIES = (
    *(TableQuantity("5.2", f"{side} {name}", "px") for side in ("left", "right") for name in INTRINSICS),
    TableQuantity("5.3", "axes 1, 2", "°"),
    TableQuantity("5.3", "axes 2, 3 about their normal", "°"),
    TableQuantity("5.3", "axes 2, 3 in their plane", "°"),
    TableQuantity("5.3", "axes 3, 4", "°"),
    TableQuantity("5.3", "axes 4, 5", "°"),
    TableQuantity("5.3", "axes 5, 6", "°"),
    TableQuantity("5.4", "link 1", "mm"),
    TableQuantity("5.4", "link 3", "mm"),
    TableQuantity("5.4", "link 4", "mm"),
    TableQuantity("5.4", "link 5", "mm"),
    TableQuantity("5.4", "axes 4, 6", "mm"),
)
"""Quantities of `tables`, in its order. Angle 2, 3 is 0: its two components are signed, so their errors are Gaussian.
"""


def tables(model: CellModel) -> FloatArray:
    """Tables 5.2 to 5.4 (21,) of a metric ``model`` of the robot: see ``QUANTITIES``."""
    return tables_of(framed_model(model), model)


def tables_of(parts: FramedModel, names: CellModel) -> FloatArray:
    """`tables` of a model's parts in a Euclidean frame; ``names``: a model with the same joints."""
    axes = joint_axes(parts.kinds, parts.generators)
    a, alpha, beta, d = dh_values(parts, conventions(parts), LINK_2, names)[:, :4].T
    angles = [axis_angle(axes.directions[j], axes.directions[j + 1]) for j in (0, 2, 3, 4)]
    return np.concatenate(
        [
            *(camera_intrinsics(P) for P in parts.cameras),
            np.degrees([angles[0], alpha[1], beta[1], *angles[1:]]),
            1e3 * np.array([a[0], d[3], a[3], a[4], abs(d[4])]),
        ]
    )


def cramer_rao(cell: SyntheticCell, trials: TrialData) -> FloatArray:
    """Least covariance (21, 21) of `tables` from ``trials``: information of the pixels at the truth, metric bundle."""
    exact = exact_model(cell)
    parts = framed_model(exact)
    rig = RigModel(cell.kinds, parts.generators, parts.cameras, parts.points, parts.lenses)
    data = measurements(trials, trials.visible, trials.positions - cell.home)
    charts = full_charts(rig, "metric")
    slope = jacobian(rig, charts, np.zeros(charts.size), data)
    sizes = np.linalg.norm(slope, axis=0)
    root = np.linalg.inv(np.linalg.qr(slope / sizes, mode="r")) / sizes[:, None]

    def at(x: FloatArray) -> FloatArray:
        there = rig_at(rig, charts, x)
        return tables_of(replace(parts, generators=there.generators, cameras=there.cameras, points=there.points), exact)

    # A hundredth of a standard deviation to either side of the truth.
    slopes = np.array([(at(0.01 * axis) - at(-0.01 * axis)) / 0.02 for axis in root.T])
    result: FloatArray = slopes.T @ slopes
    return result


@dataclass(frozen=True)
class ImageErrors:
    """Mean image distances (n,) [px] of each axis's trial and their expectation from noise alone, both with the points
    fixed (5.53) and free (5.55); ``residuals`` (k, 2) [sigmas] of the free ones, ``joint`` (k,).
    """

    fixed: FloatArray
    fixed_floor: FloatArray
    free: FloatArray
    free_floor: FloatArray
    residuals: FloatArray
    joint: npt.NDArray[np.int64]


def image_errors(model: CellModel, trials: TrialData, home: FloatArray, home_pixels: FloatArray) -> ImageErrors:
    """Table 5.1 of a fitted model: image distances of its trials.

    Fixed points are triangulated from one stereo image, ``home_pixels`` (c, m, 2) taken at ``home`` (n,), with the
    model's cameras; then the generators are fitted to the trials with fixed points and cameras.
    """
    parts = framed_model(model)
    chain = ProjectiveChain(parts.kinds, parts.generators, parts.zero)
    operators, ahead = chain.operators_at(home), chain.displacement(home)
    rig = _rig(parts, operators, parts.points @ ahead.T)
    data = measurements(trials, trials.visible, trials.positions - home)
    of_joint = trials.trials[data.stop]
    free = residuals(rig, data).reshape(-1, 2)
    free_spread = _remaining(jacobian_at(rig, data))
    ideal = np.array([undistort(lens, pixels) for lens, pixels in zip(parts.lenses, home_pixels, strict=True)])
    seen = triangulate(parts.cameras, ideal)
    points = seen / seen[:, 3:]
    given = RigModel(rig.kinds, rig.generators, rig.cameras, points, rig.lenses)
    fixed = solve(given, data, "metric", cameras=False, points=False)
    of_points = _points_noise(fixed.rig, data, trials.sigmas[:, 0])
    fixed_spread = _remaining(jacobian_at(fixed.rig, data, points=False, cameras=False), of_points)
    n = len(trials.joint_names)
    return ImageErrors(
        _means(np.linalg.norm(fixed.residuals.reshape(-1, 2), axis=1) * data.sigmas, of_joint, n),
        _means(mean_length(fixed_spread) * data.sigmas, of_joint, n),
        _means(np.linalg.norm(free, axis=1) * data.sigmas, of_joint, n),
        _means(mean_length(free_spread) * data.sigmas, of_joint, n),
        free,
        of_joint,
    )


def _rig(parts: FramedModel, generators: FloatArray, points: FloatArray) -> RigModel:
    return RigModel(parts.kinds, generators, parts.cameras, points, parts.lenses)


def jacobian_at(rig: RigModel, data: Measurements, *, cameras: bool = True, points: bool = True) -> FloatArray:
    """Jacobian (2 k, p) of the metric bundle at ``rig``."""
    charts = full_charts(rig, "metric", cameras=cameras, points=points)
    return jacobian(rig, charts, np.zeros(charts.size), data)


def _points_noise(rig: RigModel, data: Measurements, sigmas: FloatArray) -> FloatArray:
    """Derivative of the residuals with respect to the noise of points triangulated at the rig's zero from pixels with
    ``sigmas`` (c, m).

    Columns (2 k, 3 m), one standard deviation each.
    """
    charts = full_charts(rig, "metric", cameras=False)
    slopes = jacobian(rig, charts, np.zeros(charts.size), data)[:, -3 * len(rig.points) :]
    through = projection_jacobian_many(rig.cameras, rig.points)
    columns = []
    for i, basis in enumerate(charts.points):
        rows = (through[:, i] @ basis.T / sigmas[:, i, None, None]).reshape(-1, 3)
        columns.append(slopes[:, 3 * i : 3 * i + 3] @ np.linalg.inv(np.linalg.qr(rows, mode="r")))
    return np.hstack(columns)


def _remaining(jacobian: FloatArray, disturbance: FloatArray | None = None) -> FloatArray:
    """Covariances (k, 2, 2) [sigmas²] of the residuals of a fit by ``jacobian`` (2 k, p) to unit noise, and to
    a ``disturbance`` (2 k, r) of one standard deviation per column.
    """
    basis = np.linalg.qr(jacobian)[0]
    rows = basis.reshape(-1, 2, basis.shape[1])
    result: FloatArray = np.eye(2) - rows @ rows.transpose(0, 2, 1)
    if disturbance is not None:
        left = (disturbance - basis @ (basis.T @ disturbance)).reshape(-1, 2, disturbance.shape[1])
        result = result + left @ left.transpose(0, 2, 1)
    return result


def mean_length(covariances: FloatArray) -> FloatArray:
    """Mean length (k,) of Gaussian vectors with covariances (k, 2, 2): ``√(2 λ₁/π) E(1 - λ₂/λ₁)``."""
    values = np.maximum(np.linalg.eigvalsh(covariances), 0.0)
    return np.asarray(np.sqrt(2 * values[:, 1] / np.pi) * ellipe(1.0 - values[:, 0] / values[:, 1]))


def _means(values: FloatArray, groups: npt.NDArray[np.int64], count: int) -> FloatArray:
    return np.array([values[groups == j].mean() for j in range(count)])


@dataclass(frozen=True)
class RobotRuns:
    """All seeds of the experiment: ``values`` (s, 21) of `tables`, their standard deviations ``reported`` by the fits
    (s, 21), ``truth`` (21,), the Cramér-Rao ``bound`` (21, 21), ``images`` one a seed; ``chi2`` (s,) of the fits with
    ``freedom`` each."""

    cell: SyntheticCell
    values: FloatArray
    reported: FloatArray
    truth: FloatArray
    bound: FloatArray
    images: tuple[ImageErrors, ...]
    chi2: FloatArray
    freedom: int
    sigma: float


def simulate(
    seeds: int, seed: int, progress: ProgressCall, sigma: float = SIGMA, baseline: float = BASELINE
) -> RobotRuns:
    """Calibrate the thesis's robot ``seeds`` times with fresh noise ``sigma`` [px] and this ``baseline`` [m]."""
    cell = thesis_cell(baseline)
    motions = trial_motions(cell)
    bound = cramer_rao(cell, cell.trials(sigma, np.random.default_rng(seed), positions=motions))
    values, reported, images, chi2 = [], [], [], []
    freedom = 0
    for k in range(seeds):
        rng = np.random.default_rng([seed, k])
        trials = cell.trials(sigma, rng, positions=motions)
        model = fit_model(trials, epoch=1).model
        home_pixels = cell.pixels(cell.home[None])[:, 0]
        home_pixels = home_pixels + rng.normal(0.0, sigma, home_pixels.shape)
        found, covariance = propagate_covariance(model, tables)
        values.append(found)
        reported.append(np.sqrt(np.diag(covariance)))
        images.append(image_errors(model, trials, cell.home, home_pixels))
        if model.statistics is not None:
            chi2.append(model.statistics.chi2)
            freedom = model.statistics.degrees_of_freedom
        progress(f"calibrations at {sigma:g} px, {100 * baseline:.0f} cm", k + 1, seeds)
    truth = tables(exact_model(cell))
    return RobotRuns(
        cell,
        np.array(values),
        np.array(reported),
        truth,
        bound,
        tuple(images),
        np.array(chi2),
        freedom,
        sigma,
    )


# -- report and figures ----------------------------------------------------------------------------------------

BINS = np.linspace(-4.0, 4.0, 41)
"""Edges of the residual histograms [sigmas]."""
TAIL = 0.005
"""Tail probability on each side of the chi-square interval of 99 %."""
PARTS_OF_AXES_2_3 = ("axes 2, 3 about their normal", "axes 2, 3 in their plane")


def run_robot(seeds: int = 30, seed: int = 0, progress: ProgressCall = lambda *_: None) -> dict[str, Any]:
    """Run ``seeds`` simulated calibrations of each setting; tables 5.1 to 5.4 beside the thesis's."""
    implied = simulate(seeds, seed, progress, IMPLIED_SIGMA, IMPLIED_BASELINE)
    return answer(simulate(seeds, seed, progress), implied)


def answer(runs: RobotRuns, implied: RobotRuns) -> dict[str, Any]:
    """The JSON object of ``reproduce robot``: ``rows`` with the assumed cameras and noise, ``implied`` with
    those implied by the thesis.
    """
    positions, _ = trial_motions(runs.cell)
    images = len(positions) * len(runs.cell.poses)
    return {
        "seeds": len(runs.values),
        "sigma_px": SIGMA,
        "trial_motions": {
            "home_deg": list(HOME_DEG),
            "strokes_deg": list(STROKES_DEG),
            "stops_per_stroke": STOPS,
            "plate_turns_deg": list(PLATE_TURNS_DEG),
            "stops": len(positions),
            "images": images,
        },
        "rows": [*_image_rows(runs), *_metric_rows(runs)],
        "implied": {
            "sigma_px": implied.sigma,
            "baseline_m": IMPLIED_BASELINE,
            "rows": [*_image_rows(implied), *_metric_rows(implied)],
            "efficiency": _efficiency(implied),
        },
        "efficiency": _efficiency(runs),
        "residual_chi2": _chi2(float(runs.chi2.sum()), runs.freedom * len(runs.chi2)),
        "histograms": {
            "edges_sigmas": BINS.tolist(),
            "axes": [_histogram(runs, j) for j in range(len(runs.cell.kinds))],
        },
        "thesis": THESIS,
        "assumptions": ASSUMPTIONS,
    }


def _image_rows(runs: RobotRuns) -> list[dict[str, Any]]:
    rows = []
    for kind, told in (("fixed", "fixed points (5.53)"), ("free", "free points (5.55)")):
        found = np.array([getattr(images, kind) for images in runs.images])
        floors = np.array([getattr(images, f"{kind}_floor") for images in runs.images])
        for j, thesis in enumerate(THESIS["5.1"][kind]):
            rows.append(
                {
                    "table": "5.1",
                    "condition": f"axis {j + 1}, {told}",
                    "unit": "px",
                    "true": None,
                    "ours": _spread(found[:, j]),
                    "rms_error": None,
                    "bound": float(floors[:, j].mean()),
                    "thesis": thesis,
                    "thesis_error": None,
                }
            )
    return rows


def _metric_rows(runs: RobotRuns) -> list[dict[str, Any]]:
    """Tables 5.2 to 5.4; the angle of axes 2 and 3, which is 0, from its two components."""
    bounds = np.sqrt(np.diag(runs.bound))
    names = [quantity.name for quantity in QUANTITIES]
    rows = []
    for k, quantity in enumerate(QUANTITIES):
        values, truth, bound, name = runs.values[:, k], float(runs.truth[k]), float(bounds[k]), quantity.name
        if name == PARTS_OF_AXES_2_3[1]:
            continue
        if name == PARTS_OF_AXES_2_3[0]:
            other = names.index(PARTS_OF_AXES_2_3[1])
            values = np.hypot(values, runs.values[:, other])
            bound, name, truth = float(np.hypot(bound, bounds[other])), "axes 2, 3", 0.0
        factory, experiment = _thesis_values(quantity.table, name)
        rows.append(
            {
                "table": quantity.table,
                "condition": name,
                "unit": quantity.unit,
                "true": _clean(truth),
                "ours": _spread(values),
                "rms_error": float(np.sqrt(np.mean((values - truth) ** 2))),
                "bound": bound,
                "thesis": experiment,
                "thesis_error": None if factory is None else abs(experiment - factory),
            }
        )
    return rows


def _clean(value: float) -> float:
    """A zero with rounding errors as exactly zero."""
    return 0.0 if abs(value) < 1e-9 else value


def _thesis_values(table: str, name: str) -> tuple[Any, Any]:
    """Published reference (factory or off-line) value and the experiment's, None if the thesis has none."""
    if table == "5.2":
        side, part = name.split()
        return tuple(THESIS["5.2"][side].get(part, (None, None)))
    return tuple(THESIS[table][name])


DIMENSIONS = (
    "thesis: one difference from the factory's dimensions, with real lenses and joints, no precise ground truth (5.5.1)"
)
REFERENCES = {
    "5.2": "thesis: one difference from an off-line calibration by a grid, with real lenses",
    "5.3": DIMENSIONS,
    "5.4": DIMENSIONS,
}


def compare_robot(answer: dict[str, Any]) -> list[Comparison]:
    """Tables 5.1 to 5.4 beside our errors with the noise and the baseline implied by the thesis."""
    implied, seeds = answer["implied"], answer["seeds"]
    setting = f"{implied['sigma_px']:g} px, baseline {100 * implied['baseline_m']:.0f} cm, {DISTANCE:g} m away"
    found = [
        not_comparable(
            "figs 5.14, 5.15", "tracks of the markers in the images", "plotted", "drawn", "the thesis prints no values"
        )
    ]
    for row in implied["rows"]:
        item, what, bound, unit = f"table {row['table']}", row["condition"], row["bound"], row.get("unit", "px")
        if row["table"] == "5.1":
            values = row["thesis"], row["ours"]["median"]
            why = f"the noise alone gives {bound:.2g} px, of one stereo image at home"
            if "fixed" in what:
                found.append(of_error(item, what, *values, unit, why))
                continue
            why = "the noise is chosen such that the mean of this column is met"
        elif row["thesis_error"] is None or not bound:
            continue
        else:
            what, values = f"{what}, error", (row["thesis_error"], row["rms_error"])
            why = f"{REFERENCES[row['table']]}; ours: rms of {seeds} seeds against the simulation's truth"
            why += f", larger; its bound is {bound:.2g} {unit} at {setting}" * (values[1] > values[0])
        thesis, ours = (f"{value:.4g} {unit}" for value in values)
        found.append(not_comparable(item, what, thesis, ours, why))
    return found


def _efficiency(runs: RobotRuns) -> dict[str, Any]:
    """Errors of all quantities against the Cramér-Rao covariance, pooled over the seeds."""
    errors = runs.values - runs.truth
    normalised = np.linalg.solve(np.linalg.cholesky(runs.bound), errors.T)
    single = np.abs(errors) / np.sqrt(np.diag(runs.bound))
    result = _chi2(float((normalised**2).sum()), errors.size)
    result["largest_error_in_sigmas"] = float(single.max())
    result["beyond_three_sigmas"] = int((single > 3.0).sum())
    result["expected_beyond_three_sigmas"] = float(2 * norm.sf(3.0) * errors.size)
    result["reported_over_bound"] = float((runs.reported / np.sqrt(np.diag(runs.bound))).mean())
    return result


def _chi2(value: float, freedom: int) -> dict[str, Any]:
    low, high = chi2_distribution.ppf([TAIL, 1.0 - TAIL], freedom)
    return {
        "chi2": value,
        "freedom": freedom,
        "interval": [float(low), float(high)],
        "inside": bool(low <= value <= high),
    }


def _spread(values: FloatArray) -> dict[str, float]:
    low, middle, high = np.percentile(values, [16, 50, 84])
    return {"median": float(middle), "p16": float(low), "p84": float(high)}


def _histogram(runs: RobotRuns, joint: int) -> list[int]:
    residuals = np.concatenate([images.residuals[images.joint == joint].ravel() for images in runs.images])
    return [int(count) for count in np.histogram(residuals, BINS)[0]]


def show_robot(answer: dict[str, Any], console: Console) -> None:
    """Print one table for each of the thesis's in both settings, then the summary."""
    implied = answer["implied"]
    _show_tables(answer["rows"], f"{answer['sigma_px']:g} px, {100 * BASELINE:.0f} cm", console)
    _show_tables(implied["rows"], f"{implied['sigma_px']:g} px, {100 * implied['baseline_m']:.0f} cm", console)
    motions = answer["trial_motions"]
    for setting, test in (("assumed", answer["efficiency"]), ("implied", implied["efficiency"])):
        console.print(
            f"{setting} noise and baseline: {answer['seeds']} seeds, {motions['images']} images each: squared errors "
            f"over the bound {test['chi2']:.0f} for {test['freedom']}, 99 % interval {test['interval'][0]:.0f} to "
            f"{test['interval'][1]:.0f}; reported deviations {test['reported_over_bound']:.4f} of the bound"
        )


def _show_tables(rows: list[dict[str, Any]], setting: str, console: Console) -> None:
    for number, what in (
        ("5.1", "mean image distance [px], with what the noise alone gives"),
        ("5.2", "intrinsics [px]"),
        ("5.3", "angles between axes [°]"),
        ("5.4", "links [mm]"),
    ):
        first = number == "5.1"
        names = ("", "ours", "noise", "thesis") if first else ("", "true", "rms error", "bound", "thesis", "error")
        lines = []
        for row in rows:
            if row["table"] != number:
                continue
            ours = row["ours"]["median"] if first else row["rms_error"]
            shown = [ours, row["bound"], row["thesis"]]
            if not first:
                shown = [row["true"], *shown, row["thesis_error"]]
            lines.append([row["condition"], *("-" if value is None else f"{value:.4g}" for value in shown)])
        columns = {name: "right" if name else "left" for name in names}
        whole_table(console, f"table {number}: {what}; {setting}", columns, lines)


def draw_robot(answer: dict[str, Any]) -> Figures:
    """Tracks, residuals and errors."""
    painters = {
        "tracks": (_draw_tracks, 5.8, 11),
        "residuals": (_draw_residuals, 6, 11),
        "errors": (_draw_errors, 5, 12),
    }
    found = {}
    for name, (painter, height, width) in painters.items():
        found[f"robot-{name}"] = picture(width, height)
        painter(answer, found[f"robot-{name}"])
    return found


def _draw_tracks(answer: dict[str, Any], figure: Any) -> None:
    """Figure of the dots in both images over all trial motions (figs 5.14, 5.15)."""
    cell = thesis_cell()
    positions, trials = trial_motions(cell)
    pixels = cell.pixels(positions)
    for axis, side, seen in zip(figure.subplots(1, 2), ("left", "right"), pixels, strict=True):
        for j in range(len(cell.kinds)):
            axis.plot(*seen[trials == j].reshape(-1, 2).T, ".", markersize=2, label=f"axis {j + 1}")
        axis.set(
            xlim=(0, cell.width),
            ylim=(cell.height, 0),
            aspect="equal",
            xlabel="u [px]",
            ylabel="v [px]",
            title=f"{side} camera: {answer['trial_motions']['stops']} stops",
        )
        axis.legend(markerscale=4, fontsize=8)


def _draw_residuals(answer: dict[str, Any], figure: Any) -> None:
    edges = np.array(answer["histograms"]["edges_sigmas"])
    middle, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    for j, (axis, counts) in enumerate(zip(figure.subplots(2, 3).ravel(), answer["histograms"]["axes"], strict=True)):
        total = max(1, sum(counts))
        axis.bar(middle, np.array(counts) / (total * width), width=width, alpha=0.6)
        axis.plot(middle, norm.pdf(middle), color="black", linewidth=1)
        axis.set(title=f"axis {j + 1}: {total} residuals", xlabel=f"residual [{answer['sigma_px']} px]")


def _draw_errors(answer: dict[str, Any], figure: Any) -> None:
    """Figure of the errors of the thesis, ours and the bound, by table."""
    panels = figure.subplots(1, 3, width_ratios=[8, 5, 5])
    for axis, table, unit in zip(panels, ("5.2", "5.3", "5.4"), ("px", "deg", "mm"), strict=True):
        rows = [row for row in answer["rows"] if row["table"] == table and row["thesis_error"] is not None]
        rows = [row for row in rows if row["bound"] > 0.0]
        places = np.arange(len(rows))
        for k, (key, label) in enumerate((("thesis_error", "thesis"), ("rms_error", "ours, rms"), ("bound", "bound"))):
            axis.bar(places + 0.27 * (k - 1), [max(row[key], 1e-4) for row in rows], 0.27, label=label)
        axis.set_xticks(places, [row["condition"] for row in rows], rotation=60, ha="right")
        axis.set(yscale="log", ylabel=f"error [{unit}]", title=f"table {table}")
        axis.legend(fontsize=8)
