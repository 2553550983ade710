"""Selection of the highest stratum that the data identify: metric, affine or projective (thesis 5.4.3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Literal, NamedTuple

import numpy as np
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import f as f_distribution

from stereoservo.calibration import initial_reconstruction
from stereoservo.calibration.bundle_adjustment import Solution, generator_noise, solve
from stereoservo.calibration.least_squares import RobustLoss
from stereoservo.calibration.lens_estimation import required_lens_model
from stereoservo.calibration.rig_model import Measurements, RigModel, partial_products
from stereoservo.calibration.single_joint_fit import DIRECTIONS, twist_about
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.parameterization import LensModel
from stereoservo.numerics.arrays import FloatArray

STILL = 2e-3
"""Largest motion of other joints [rad or m] at the stops of a joint's own trial."""
GAIN = 8.0
"""Least gain in chi-square of a joint's trial from a different axis for that axis to be tried in the whole bundle."""


def with_other_axes(solution: Solution) -> list[RigModel]:
    """Metric rigs for a new start: revolute joints get the axes that fit their own trials better, the rig with the most
    changed joints first.

    Empty if no joint has a better axis.
    """
    better: dict[int, FloatArray] = {}
    for joint, kind in enumerate(solution.rig.kinds):
        if kind == "revolute":
            generator = _better_generator(solution, joint)
            if generator is not None:
                better[joint] = generator
    rigs = []
    for joints in [tuple(better), *([(joint,) for joint in better] if len(better) > 1 else [])]:
        if joints:
            generators = solution.rig.generators.copy()
            for joint in joints:
                generators[joint] = better[joint]
            rigs.append(replace(solution.rig, generators=generators))
    return rigs


def _better_generator(solution: Solution, joint: int) -> FloatArray | None:
    """Generator (4, 4) that fits a joint's own trial better, with cameras and markers fixed; None if there is none."""
    rig, data = solution.rig, solution.data
    used = np.unique(data.stop)
    reported = data.corrected(None).offsets
    base = np.median(reported[used], axis=0)
    still = np.asarray((np.delete(np.abs(reported - base), joint, axis=1) <= STILL).all(axis=1))
    own = data.select(still[data.stop])
    displacement = data.offsets[:, joint]
    span = float(np.ptp(displacement[still])) if still.any() else 0.0
    if span == 0.0:
        return None
    base[joint] = 0.0
    before, after = partial_products(rig, base[None])
    single = RigModel(
        ("revolute",),
        rig.generators[joint : joint + 1],
        rig.cameras @ before[joint, 0],
        rig.points @ after[joint + 1, 0].T,
        rig.lenses,
    )
    own = replace(
        own,
        offsets=data.offsets[:, joint : joint + 1],
        lens_priors=None,
        joint_noise=None,
        joint_errors=None,
    )
    now = _solved(single, own)
    centroids = [_centroid(single, float(end)) for end in (displacement[still].min(), displacement[still].max())]
    best: Solution | None = None
    for direction in DIRECTIONS:
        start = replace(single, generators=twist_about(direction, centroids, span)[None])
        try:
            fit = _solved(start, own)
        except np.linalg.LinAlgError:
            continue  # the axis moves a marker into a focal plane
        if best is None or fit.cost < best.cost:
            best = fit
    return best.rig.generators[0] if best is not None and best.cost < now.cost - GAIN else None


def _solved(rig: RigModel, data: Measurements) -> Solution:
    return solve(rig, data, "metric", cameras=False, points=False, max_evaluations=40, tolerance=1e-4)


def _centroid(rig: RigModel, angle: float) -> FloatArray:
    """Centroid (3,) of a single joint's markers at ``angle``."""
    _, after = partial_products(rig, np.array([[angle]]))
    points = rig.points @ after[0, 0].T
    return np.asarray((points[:, :3] / points[:, 3:]).mean(axis=0))


@dataclass(frozen=True)
class FitOptions:
    """Thresholds of the fit.

    ``outlier_chi2``: a pixel (2 degrees of freedom) farther than this from the model is left out; 25 loses 4
    in a million good ones. ``max_outliers``, ``max_trial_outliers``: largest share of pixels left out of
    all, and of one joint's trial. ``max_sigma_factor``: largest ratio of the residuals to the stated sigmas
    before the fit is refused; detectors misjudge their noise, a wrong model exceeds it by far more.
    ``metric_loss``: how much worse, in variance, the metric bundle may fit than the projective one if it
    is not certain that the metric stratum is identifiable. ``max_spread``: largest relative standard deviation of
    focal lengths (metric) and depths (metric, affine) with which a stratum is accepted. ``lens``: free lens
    parameters; ``auto`` lets the data decide between none, the radial parameter with its centre, and more terms.
    """

    outlier_chi2: float = 25.0
    max_outliers: float = 0.4
    max_trial_outliers: float = 0.5
    max_sigma_factor: float = 3.0
    metric_loss: float = 1.3
    max_spread: float = 0.1
    lens: Literal["auto"] | LensModel = "auto"


DEFAULTS = FitOptions()

NOMINAL_PLANE = np.array([0.0, 0.0, 0.0, 1.0])
"""Plane at infinity of the canonical frame's nominal cameras."""
FINISHED, FINISH_EVALUATIONS = 4, 400
"""Most unconverged bundles that are solved to convergence, and the limit of evaluations of each."""
MOST_TIMES = 5.0
"""Largest ratio of a deviation to the required one at which its first-order value predicts the measurements needed."""
LOOSE_DEVIATION = 0.75
"""Relative deviation of depths and focal lengths beyond which first-order statistics are meaningless."""
PLAUSIBLE_TAIL, NESTED_TAIL = 1e-3, 1e-6
"""Probabilities with which a true constraint raises chi-square so much that other starts are tried, and that it is
rejected."""


@dataclass
class StratumSelector:
    """Accepts or rejects bundles of higher strata against the ``projective`` one; keeps the rejected ones by
    reason.

    A bundle is accepted immediately if its constraints raise chi-square no more than expected. Otherwise it is
    kept in ``reserve``: another start may find a better minimum, or the constraints may hold only
    approximately. ``bent``: a richer lens model would have satisfied them. ``tolerable``: bundles with a significant
    rise, used if no start finds a better one; ``unfinished``: bundles that may still converge; ``loose``: good fits
    that hardly determine the stratum.
    """

    projective: Solution
    options: FitOptions
    notes: list[str] = field(default_factory=list)
    reserve: list[tuple[Solution, FloatArray]] = field(default_factory=list)
    tolerable: list[tuple[Solution, FloatArray]] = field(default_factory=list)
    unfinished: list[tuple[Solution, FloatArray]] = field(default_factory=list)
    loose: list[tuple[Solution, FloatArray]] = field(default_factory=list)
    hopeless: bool = False
    bent: bool = False

    def passes(self, solution: Solution, plane: FloatArray) -> bool:
        """Whether ``solution`` is acceptable. Sets ``hopeless`` if another start will not help."""
        problem = self._unidentified(solution)
        if problem:
            self._note(solution, problem)
            # A good fit with undetermined directions, converged along them or not: any other will have them, too.
            open_ones = solution.statistics.rank < solution.charts.size
            wide = open_ones or max(_relative_deviations(solution).values()) > LOOSE_DEVIATION
            done = solution.converged and not self._worse(solution, PLAUSIBLE_TAIL)
            self.hopeless = self._close(solution) and (wide or done)
            kept = self.loose if self.hopeless or solution.converged else self.unfinished
            kept.append((solution, plane))
            return False
        if not solution.converged:
            self._note(solution, f"no convergence in {solution.evaluations} evaluations")
            self.unfinished.append((solution, plane))
            return False
        if not self._worse(solution, PLAUSIBLE_TAIL):
            return True
        if not self._worse(solution, NESTED_TAIL):
            self.tolerable.append((solution, plane))
            return False
        self.bent = self.bent or required_lens_model(solution) != solution.lenses
        # Two starts at one minimum: the constraints hold only approximately, and there is no better minimum.
        self.hopeless = any(abs(other.cost - solution.cost) < 1e-3 * solution.cost for other, _ in self.reserve)
        self.reserve.append((solution, plane))
        return False

    def finished(self, data: Measurements) -> tuple[Solution, FloatArray] | None:
        """First of the unconverged bundles that is acceptable after it is solved to convergence."""
        candidates, self.unfinished = sorted(self.unfinished, key=lambda entry: entry[0].cost)[:FINISHED], []
        for solution, plane in candidates:
            if self.hopeless:
                break
            final = _solve_to_convergence(solution, data)
            if self.passes(final, plane):
                return final, plane
        return None

    def best_tolerable(self) -> tuple[Solution, FloatArray] | None:
        """Best of the bundles whose constraints raise chi-square significantly, but tolerably."""
        tolerable, self.tolerable = self.tolerable, []
        return min(tolerable, key=lambda entry: entry[0].cost) if tolerable else None

    def with_other_axes(self, data: Measurements) -> tuple[Solution, FloatArray] | None:
        """Bundle from the best one so far, with different axes for single joints, if one is then acceptable."""
        reached = [entry for entry in (*self.reserve, *self.loose, *self.tolerable) if entry[0].converged]
        if not reached:
            return None
        solution, plane = min(reached, key=lambda entry: entry[0].cost)
        if not self._worse(solution, PLAUSIBLE_TAIL) or not self._close(solution):
            return None
        for rig in with_other_axes(solution):
            try:
                again = solve(rig, data, "metric", lenses=solution.lenses, max_evaluations=FINISH_EVALUATIONS)
            except np.linalg.LinAlgError:
                continue  # the new axis moves a marker into a focal plane
            if self.passes(again, plane):
                return again, plane
        return None

    def last_resort(self, data: Measurements) -> tuple[Solution, FloatArray] | None:
        """A good fit that hardly determines its stratum, if the projective bundle has undetermined directions.

        Its covariance is large; predictions are as good as the trials allow.
        """
        projective = solve(self.projective.rig, data, "projective", lenses=self.projective.lenses)
        if projective.converged and projective.statistics.rank == projective.charts.size:
            return None
        for solution, plane in sorted(self.loose, key=lambda entry: entry[0].cost):
            final = _solve_to_convergence(solution, data)
            deviation = (
                max(_relative_deviations(final).values()) if final.statistics.rank == final.charts.size else np.inf
            )
            if final.converged and deviation <= LOOSE_DEVIATION and not self._worse(final, PLAUSIBLE_TAIL, projective):
                self.notes.append(
                    f"the {final.stratum} stratum is taken because the projective bundle leaves directions open; "
                    f"{self._unidentified(final) or 'its spread is small'}"
                )
                return final, plane
        return None

    def second_best(self, certain: bool) -> tuple[Solution, FloatArray] | None:
        """Best of the rejected but tolerable bundles, with a note of its extra residuals; None if none may be used.

        ``certain``: the data identify the stratum beyond doubt, so that a misfit is due to errors of the data, not
        to the stratum.
        """
        if not self.reserve:
            return None
        solution, plane = min(self.reserve, key=lambda entry: entry[0].cost)
        self.notes.append(
            f"the {solution.stratum} constraints cost a chi-square of "
            f"{solution.cost - self.projective.cost:.4g} for "
            f"{self.projective.charts.size - solution.charts.size} parameters: cameras or joints follow "
            "the model only nearly (lens distortion, play, positions)"
        )
        return (solution, plane) if certain or self._close(solution) else None

    def _worse(self, solution: Solution, tail: float, projective: Solution | None = None) -> bool:
        """Whether the constraints raise chi-square by more than true ones do with probability ``tail``.

        With joint noise by Fisher's distribution: the variances of the joints' errors, and the projective bundle's, are
        known with few degrees of freedom, those of a joint's own trial.
        """
        beside = projective or self.projective
        fewer = max(1, beside.charts.size - solution.charts.size)
        if solution.data.joint_noise is None:
            allowed = float(chi2_distribution.isf(tail, fewer))
        else:
            stops, joints = solution.data.offsets.shape
            allowed = fewer * float(f_distribution.isf(tail, fewer, max(stops // joints - 3, 1)))
        return solution.cost - beside.cost > allowed * max(1.0, beside.statistics.variance)

    def _close(self, solution: Solution) -> bool:
        beside = max(1.0, self.projective.statistics.variance)
        return solution.statistics.variance <= self.options.metric_loss * beside

    def _unidentified(self, solution: Solution) -> str:
        rank = solution.statistics.rank
        if rank < solution.charts.size:
            return f"the trials determine {rank} of {solution.charts.size} parameters"
        limit = self.options.max_spread
        return "; ".join(
            f"{what} known to {deviation:.0%} only, {limit:.0%} needed: larger motions, or "
            f"{_as_many(deviation / limit)} stops or frames"
            for what, deviation in _relative_deviations(solution).items()
            if deviation > limit
        )

    def _note(self, solution: Solution, text: str) -> None:
        note = f"{solution.stratum} stratum refused: {text}"
        if note not in self.notes:
            self.notes.append(note)


def _as_many(ratio: float) -> str:
    """Text: how many more measurements reduce a deviation by ``ratio``."""
    return f"{ceil(ratio**2)} times as many" if ratio <= MOST_TIMES else "many more"


def _solve_to_convergence(solution: Solution, data: Measurements) -> Solution:
    """The bundle solved again with a much larger limit of evaluations."""
    return solve(solution.rig, data, solution.stratum, lenses=solution.lenses, max_evaluations=FINISH_EVALUATIONS)


def _relative_deviations(solution: Solution) -> dict[str, float]:
    """Largest relative standard deviation of depths and, in the metric stratum, of focal lengths."""
    factor = max(1.0, solution.statistics.variance)
    deviations = np.sqrt((solution.statistics.root**2).sum(axis=1) * factor)
    m = len(solution.rig.points)
    scale = np.array([basis[2, 2] for basis in solution.charts.points])
    depths = deviations[-3 * m :].reshape(m, 3)[:, 2] * scale / np.abs(solution.rig.points[:, 2])
    largest = {"depths are": float(depths.max())}
    if solution.stratum == "metric":
        at = solution.charts.start(1)
        scale = np.array([solution.charts.cameras[0][k, i, i] for k, i in ((0, 0), (3, 1))])
        focal = deviations[[at, at + 3]] * scale / np.abs(np.diag(solution.rig.cameras[0][:2, :2]))
        largest["the focal length is"] = float(focal.max())
    return largest


class StratumSelection(NamedTuple):
    """The bundle of the highest stratum that the data identify, its ``plane`` (4,) at infinity in the projective
    frame, notes, and whether lens distortion prevents a higher stratum (``bent``).
    """

    solution: Solution
    plane: FloatArray
    notes: tuple[str, ...]
    bent: bool


def select_stratum(solution: Solution, data: Measurements, options: FitOptions) -> StratumSelection:
    """Bundle of the highest stratum that the data identify.

    Metric and affine bundles start from the linear estimates and, if those fail, from nominal cameras;
    acceptance is decided on the constrained bundle itself, which is far better conditioned than
    the projective one.
    """
    noise = generator_noise(solution)
    # If joints have errors, those of the projective bundle reach most of the way to a start's minimum, in a tenth of
    # the time.
    exact = data.with_errors_removed()
    selector = StratumSelector(solution, options)
    least, nearest, unique = initial_reconstruction.planes_at_infinity(solution.rig.generators, noise)
    finite: list[FloatArray] = []
    for candidate in (nearest, least, NOMINAL_PLANE):
        scaled = initial_reconstruction.scaled_plane(candidate, solution.rig.points)
        if scaled is not None and not any(np.allclose(scaled, p, rtol=1e-3, atol=1e-6) for p in finite):
            finite.append(scaled)
    if not finite:
        raise CalibrationError(
            "views_degenerate", "every candidate for the plane at infinity passes between the markers"
        )
    for start, plane in _metric_starts(solution.rig, finite, noise, np.ptp(data.offsets, axis=0)):
        # Inaccurate cameras must not be fitted to an inaccurate chain: let the chain converge first.
        try:
            chain = solve(
                start,
                exact,
                "metric",
                cameras=False,
                loss=RobustLoss("soft_l1"),
                max_evaluations=20,
                tolerance=1e-2,
            )
            metric = solve(chain.rig, exact, "metric", lenses=solution.lenses, max_evaluations=80)
            if data.joint_noise is not None:
                metric = solve(metric.rig, data, "metric", lenses=solution.lenses, max_evaluations=80)
        except np.linalg.LinAlgError as error:
            selector.notes.append(f"no metric start: {error}")
            continue
        if selector.passes(metric, plane):
            return StratumSelection(metric, plane, (), False)
        if selector.hopeless:
            break
    done = selector.finished(data) or selector.with_other_axes(data) or selector.best_tolerable()
    if done is not None:
        return StratumSelection(*done, (), False)
    second = selector.second_best(unique and _several_directions(solution.rig, finite[0], noise))
    if second is None:
        selector.hopeless, selector.reserve = False, []
        for plane in finite:
            try:
                affine = solve(
                    initial_reconstruction.affine_rig(solution.rig, plane),
                    data,
                    "affine",
                    lenses=solution.lenses,
                    max_evaluations=80,
                )
            except (GeometryError, np.linalg.LinAlgError) as error:
                selector.notes.append(f"no affine start: {error}")
                continue
            if selector.passes(affine, plane):
                return StratumSelection(affine, plane, tuple(selector.notes), selector.bent)
            if selector.hopeless:
                break
        done = selector.finished(data) or selector.best_tolerable()
        if done is not None:
            return StratumSelection(*done, tuple(selector.notes), selector.bent)
        second = selector.second_best(unique) or selector.last_resort(data)
    best, plane = second or (solution, finite[0])
    return StratumSelection(best, plane, tuple(selector.notes), selector.bent)


def _several_directions(rig: RigModel, plane: FloatArray, noise: FloatArray) -> bool:
    """Whether rotation axes of different directions determine the intrinsics reliably."""
    revolute = np.array([kind == "revolute" for kind in rig.kinds])
    try:
        return initial_reconstruction.intrinsics_linear(
            initial_reconstruction.affine_rig(rig, plane).generators, revolute, noise
        )[1]
    except GeometryError:
        return False


def _metric_starts(
    rig: RigModel, planes: list[FloatArray], noise: FloatArray, spans: FloatArray
) -> Iterator[tuple[RigModel, FloatArray]]:
    """Initial metric rigs and their planes: with the linear estimate of the intrinsics, then nominal ones."""
    revolute = np.array([kind == "revolute" for kind in rig.kinds])
    if int(revolute.sum()) < 2:
        return
    for plane in planes:
        try:
            affine = initial_reconstruction.affine_rig(rig, plane)
            linear, _ = initial_reconstruction.intrinsics_linear(affine.generators, revolute, noise)
        except GeometryError:
            linear = None  # no linear estimate from this plane; nominal cameras follow
        if linear is not None:
            yield initial_reconstruction.metric_rig(rig, plane, linear, spans), plane
        for focal in initial_reconstruction.NOMINAL_FOCALS:
            yield (
                initial_reconstruction.metric_rig(rig, plane, initial_reconstruction.nominal_intrinsics(focal), spans),
                plane,
            )
