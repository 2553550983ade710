"""Variance components of a calibration by restricted maximum likelihood: pixels, and for each joint a random error of
each stop, a repeatable one of each reading and one that changes slowly with the posture (Searle, Casella, McCulloch,
Variance Components, 2006, ch. 6).

A repeatable error is the same at equal readings of the joint: gear ripple, play driven from one side. The error by
posture is due to compliance under load (sag) or to other joints (coupling): a Gaussian process over the positions of
all joints. The model's parameters enter the likelihood linearised; effects that they can imitate count as theirs.

Score tests of the components at a bundle with exact readings detect errors that are likely although the likelihood does
not prove them (Lin, Variance component testing in generalised linear models, Biometrika 84, 1997): a score is a
quadratic form of the residuals, which under exact readings is distributed as a weighted sum of chi-squares, whose
tail is computed by the saddlepoint approximation (Kuonen, Biometrika 86, 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import norm

from stereoservo.calibration.bundle_adjustment import Solution
from stereoservo.calibration.joint_noise import stop_rows
from stereoservo.calibration.least_squares import estimate_beside
from stereoservo.calibration.normal_equations import by_stop, prior_rows
from stereoservo.calibration.rig_model import JointNoise
from stereoservo.kinematics.joint_accuracy import JointAccuracy, posture_correlation
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

FALSE_ALARM = 1e-4
"""Probability of reporting errors of joints that have none."""
SAME_READING, SAME_SHARE = 2e-3, 0.05
"""Readings nearer than this [rad or m], and than this share of the joint's range, have the same repeatable error."""
LEAST_FEATURE = 1e-4
"""Variance of a posture feature, relative to the largest, below which it is left out."""
MOST_STOPS = 120
"""Most stops, evenly spread, from which the components are estimated: with more, the stated accuracy would exceed that
of the error model itself."""
MOST_SHARED = 120
"""Most repeated readings whose errors are columns of the bundle; those of further ones count as each stop's own."""
ROUNDS = 40
"""Most rounds of Fisher scoring."""
SETTLED = 1e-3
"""Gain in log-likelihood below which the components have converged."""
FIXED = 0.01
"""Length of a unit parameter direction, in the rows without joint errors, from which these determine the direction."""
RANK_TOLERANCE = 1e-9
"""Singular value of the unit columns below which a direction of the parameters is undetermined."""


class Readings(NamedTuple):
    """Joint readings at s stops: ``places`` (s, n), the number of each distinct reading, counted from 0; ``features``
    (s, r) that span the errors by posture, all zero at the zero position.
    """

    places: IntArray
    features: FloatArray


def readings(offsets: FloatArray) -> Readings:
    """Readings of joints at positions ``offsets`` (s, n) from the zero."""
    places = np.empty(offsets.shape, dtype=np.int64)
    for joint, values in enumerate(offsets.T):
        order = np.argsort(values, kind="stable")
        distinct = np.diff(values[order]) > min(SAME_READING, SAME_SHARE * float(np.ptp(values)))
        places[order, joint] = np.concatenate([[0], np.cumsum(distinct)])
    at_zero = posture_correlation(offsets, np.zeros((1, offsets.shape[1])))
    values, vectors = np.linalg.eigh(posture_correlation(offsets, offsets) - at_zero @ at_zero.T)
    kept = values > LEAST_FEATURE * max(float(values[-1]), LEAST_FEATURE)
    return Readings(places, vectors[:, kept] * np.sqrt(values[kept]))


@dataclass(frozen=True)
class VarianceComponents:
    """Estimated variances: ``pixels`` over the stated ones; ``random``, ``repeatable`` and ``posture`` (n,) of the
    joints' errors [rad² or m²], with their ``covariance`` (3 n, 3 n). ``gain``: twice the log-likelihood ratio to
    joints without errors. ``scales`` (r,), ``scale_deviations`` (r,): logarithms of the
    revolute joints' scale factors.
    """

    pixels: float
    random: FloatArray
    repeatable: FloatArray
    posture: FloatArray
    covariance: FloatArray
    gain: float
    scales: FloatArray
    scale_deviations: FloatArray

    @property
    def significant(self) -> bool:
        """Whether the hypothesis of joints without errors is rejected."""
        return self.gain > float(chi2_distribution.isf(FALSE_ALARM, 3 * len(self.random)))

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations (n, 3) of each joint's errors, random, repeatable and by posture [rad or m]."""
        return np.sqrt(np.stack([self.random, self.repeatable, self.posture], axis=1))

    @property
    def deviations_of_deviations(self) -> FloatArray:
        """Standard deviations (n, 3) of `deviations`, to first order; for components estimated as zero, the largest
        likely deviation.
        """
        sigmas = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).reshape(3, -1).T
        found = self.deviations
        return np.where(found**2 > sigmas, sigmas / (2.0 * np.maximum(found, 1e-300)), np.sqrt(sigmas))

    @property
    def _variance_of_total(self) -> FloatArray:
        """Variance (n,) of the sum of a joint's random and repeatable variance."""
        n = len(self.random)
        blocks = self.covariance[: 2 * n, : 2 * n].reshape(2, n, 2, n).sum(axis=(0, 2))
        return np.maximum(np.diag(blocks), 0.0)

    @property
    def stated(self) -> FloatArray:
        """Standard deviation (n,) of a joint's error at another reading. For a variance known with ν degrees of freedom
        its expectation is ν / (ν - 2) times the estimate, for one that may be zero about its own standard deviation.
        """
        return _stated(self.random + self.repeatable, self._variance_of_total)

    @property
    def stated_posture(self) -> FloatArray:
        """Likewise (n,) of the error by posture; zero if none was found."""
        n = len(self.random)
        variance = np.maximum(np.diag(self.covariance)[2 * n :], 0.0)
        return np.where(self.posture > 0.0, _stated(self.posture, variance), 0.0)

    def is_close_to(self, other: VarianceComponents) -> bool:
        """Whether the joints' errors equal those of another estimate, to a tenth of their standard deviations."""
        off = np.concatenate(
            [self.random - other.random, self.repeatable - other.repeatable, self.posture - other.posture]
        )
        return bool((np.abs(off) <= 0.1 * np.sqrt(np.maximum(np.diag(self.covariance), 0.0))).all())

    def noise(self, at: Readings) -> JointNoise:
        """Noise of the joints at stops with these readings."""
        return joint_noise_of(np.sqrt(self.random), np.sqrt(self.repeatable), np.sqrt(self.posture), at)


def _stated(variances: FloatArray, uncertainties: FloatArray) -> FloatArray:
    """Standard deviations (n,) of errors whose estimated ``variances`` (n,) have variance ``uncertainties`` (n,)."""
    relative_variance = np.minimum(uncertainties, 0.5 * variances**2) / np.where(variances > 0.0, variances**2, 1.0)
    return np.sqrt(np.maximum(variances / (1.0 - relative_variance), NONE_SEEN * np.sqrt(uncertainties)))


def joint_noise_of(random: FloatArray, repeatable: FloatArray, posture: FloatArray, at: Readings) -> JointNoise:
    """Noise at stops with the readings ``at``, for joints whose errors have these standard deviations (n,)."""
    places = at.places
    own, shared = np.tile(random**2, (len(places), 1)), np.full(places.shape, -1)
    common = [
        (int(count), int(joint), place)
        for joint in np.flatnonzero(repeatable > 0.0)
        for place, count in enumerate(np.bincount(places[:, joint]))
        if count > 1
    ]
    common = sorted(common, reverse=True)[:MOST_SHARED]
    for k, (_, joint, place) in enumerate(common):
        shared[places[:, joint] == place, joint] = k
    own += np.where(shared < 0, repeatable**2, 0.0)
    deviations = np.array([repeatable[joint] for _, joint, _ in common])
    return JointNoise(np.sqrt(own), shared, deviations, at.features, posture)


def noise_of_accuracy(accuracy: JointAccuracy, at: Readings) -> JointNoise:
    """Noise at stops with the readings ``at``, for joints with the errors stated by a model."""
    return joint_noise_of(accuracy.random, accuracy.repeatable, accuracy.posture, at)


class ReducedRows(NamedTuple):
    """Rows that contain the components of ``joints`` joints: ``y`` (N,), ``X`` (N, p) of the parameters, ``scales``
    (N, r), ``slopes`` (N, n) by the errors of the joints at the row's own stop, which begins at row ``begins`` (s,);
    rows before the first stop have none. ``pixels`` (N, N): covariance for a unit variance of the pixels, including
    that of the rows by which parameters were fixed. ``at``: the stops' readings. ``squares`` of the ``freedom``
    remaining rows, which contain pixel noise only.
    """

    y: FloatArray
    X: FloatArray
    scales: FloatArray
    pixels: FloatArray
    slopes: FloatArray
    begins: IntArray
    at: Readings
    squares: float
    freedom: int

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.slopes.shape[1])

    def shared(self, joint: int) -> tuple[FloatArray, FloatArray]:
        """Errors of a joint that stops share: the repeatable ones (s, places), none if every stop or no stop shares
        one, and those by posture (s, r).
        """
        places, where = np.unique(self.at.places[:, joint], return_inverse=True)
        own = np.arange(len(places)) if 1 < len(places) < len(self.begins) else np.zeros(0)
        return (where[:, None] == own).astype(np.float64), self.at.features

    def by_stop(self, rows: FloatArray) -> FloatArray:
        """Sums (s, ...) of ``rows`` (N, ...) over each stop's own rows."""
        return np.asarray(np.add.reduceat(rows, self.begins, axis=0))

    def columns(self) -> tuple[FloatArray, IntArray]:
        """All joint errors as columns (N, e), and the component (e,) of each, numbered by joint: first the
        random ones, then the repeatable ones, then those by posture.
        """
        stops, n = len(self.begins), self.joints
        at = np.searchsorted(self.begins, np.arange(len(self.y)), side="right") - 1
        own = (at[:, None] == np.arange(stops)).astype(np.float64)
        columns, component = [], []
        for joint in range(n):
            of_joint = own * self.slopes[:, joint, None]
            for kind, covariance in enumerate((np.eye(stops), *self.shared(joint))):
                columns.append(of_joint @ covariance)
                component += [kind * n + joint] * covariance.shape[1]
        return np.hstack(columns), np.array(component, dtype=np.int64)


def reduced_rows(solution: Solution, at_stops: Readings) -> ReducedRows:
    """Linearised rows of a bundle whose stops have the readings ``at_stops``, without its current joint noise,
    reduced by reflections to one row per stop and joint error.
    """
    rig, charts = solution.rig, solution.charts
    data, _ = by_stop(solution.data)
    used = np.unique(data.stop)
    if len(used) > MOST_STOPS:
        used = used[np.linspace(0, len(used) - 1, MOST_STOPS).astype(np.int64)]
        data = data.select(np.isin(data.stop, used))
    offsets = data.offsets - data.corrections
    revolute = [j for j, kind in enumerate(rig.kinds) if kind == "revolute"]
    n, p, count = len(rig.kinds), charts.size, len(revolute)
    prior = prior_rows(rig, charts, data)
    beside = np.zeros((len(prior), p + count + 1))
    beside[:, :p], beside[:, -1] = prior[:, :p], prior[:, -1]
    rest, freedom, tops, blocks = [beside], len(prior), [], []
    for one in stop_rows(rig, charts, data):
        scales = -one.joints[:, revolute] * offsets[one.stop, revolute]
        rows = np.hstack([one.rows[:, :-1], scales, one.rows[:, -1:]])
        basis, block = np.linalg.qr(one.joints)
        top = basis.T @ rows
        rest.append(rows - basis @ top)
        freedom += len(rows) - len(top)
        tops.append(top)
        blocks.append(block)
    triangle = np.asarray(np.linalg.qr(np.vstack(rest), mode="r"))
    lengths = np.linalg.norm(triangle[:, :p], axis=0)
    carries = np.linalg.norm(triangle[:, :p] / np.where(lengths > 0.0, lengths, 1.0), axis=1) > 1e-10
    whole = np.vstack([triangle[carries], *tops])
    at = int(carries.sum()) + np.concatenate([[0], np.cumsum([len(top) for top in tops])])
    slopes = np.vstack([np.zeros((int(carries.sum()), n)), *blocks])
    X = whole[:, :p]
    size = np.linalg.norm(X, axis=0)
    _, values, vectors = np.linalg.svd(X / np.where(size > 0.0, size, 1.0), full_matrices=False)
    known = values > RANK_TOLERANCE * values[0]
    X = (X / np.where(size > 0.0, size, 1.0)) @ (vectors[known].T / values[known])
    reduced = ReducedRows(
        whole[:, -1],
        X,
        whole[:, p:-1],
        np.eye(len(whole)),
        slopes,
        at[:-1],
        Readings(at_stops.places[used], at_stops.features[used]),
        float((triangle[~carries, -1] ** 2).sum()),
        freedom - int(carries.sum()),
    )
    return _condensed(reduced)


def _condensed(reduced: ReducedRows) -> ReducedRows:
    """The rows without those before the first stop, as far as these determine parameters well: their information on a
    parameter becomes prior, with the pixels' variance (a recursive least squares step; same restricted likelihood).
    """
    first = int(reduced.begins[0])
    beside = np.column_stack([reduced.y, reduced.scales])
    left, values, right = np.linalg.svd(reduced.X[:first])
    sizes = np.zeros(len(right))
    sizes[: len(values)] = values
    fixed = sizes > FIXED
    known, ahead = int(fixed.sum()), left.T @ beside[:first]
    rotated = reduced.X[first:] @ right.T
    moved = rotated[:, fixed] / sizes[fixed]
    below = beside[first:] - moved @ ahead[:known]
    weak = len(values) - known
    rows = np.vstack([ahead[known : known + weak], below])
    X = np.vstack([np.diag(sizes[known : known + weak], 0) @ np.eye(weak, len(sizes) - known), rotated[:, ~fixed]])
    pixels = np.eye(len(rows))
    pixels[weak:, weak:] += moved @ moved.T
    slopes = np.vstack([np.zeros((weak, reduced.joints)), reduced.slopes[first:]])
    return reduced._replace(
        y=rows[:, 0],
        X=X,
        scales=rows[:, 1:],
        pixels=pixels,
        slopes=slopes,
        begins=reduced.begins - first + weak,
        squares=reduced.squares + float((ahead[known + weak :, 0] ** 2).sum()),
        freedom=reduced.freedom + first - known - weak,
    )


class _Likelihood:
    """Restricted likelihood of a reduced problem at variances (1 + 3 n,): pixels, random, repeatable, posture."""

    def __init__(self, reduced: ReducedRows, X: FloatArray, variances: FloatArray) -> None:
        self.reduced, self.variances = reduced, variances
        n, first = reduced.joints, int(reduced.begins[0])
        counts = np.diff(np.append(reduced.begins, len(reduced.y)))
        matrix = variances[0] * reduced.pixels
        for joint in np.flatnonzero(variances[1:].reshape(3, n).any(axis=0)):
            slopes = reduced.slopes[first:, joint]
            places, features = reduced.shared(int(joint))
            own, repeatable, posture = variances[1 + joint :: n]
            errors = repeatable * places @ places.T + posture * features @ features.T
            errors[np.diag_indices(len(errors))] += own
            errors = np.repeat(np.repeat(errors, counts, axis=0), counts, axis=1)
            matrix[first:, first:] += slopes[:, None] * slopes * errors
        self.root = np.linalg.cholesky(matrix)
        self.basis, triangle = np.linalg.qr(solve_triangular(self.root, X, lower=True))
        white = solve_triangular(self.root, reduced.y, lower=True)
        self.white = white - self.basis @ (self.basis.T @ white)
        logs = np.log(np.diag(self.root)).sum() + np.log(np.abs(np.diag(triangle))).sum()
        left = float(self.white @ self.white) + reduced.squares / variances[0]
        self.value = -float(logs) - 0.5 * (reduced.freedom * float(np.log(variances[0])) + left)

    def score(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivative by the variances, the expected information, and the factor on each variance in a
        minorise-maximise step, which never lowers the likelihood.
        """
        reduced, pixels, n = self.reduced, self.variances[0], self.reduced.joints
        half = solve_triangular(self.root, np.eye(len(self.root)), lower=True)
        half -= self.basis @ (self.basis.T @ half)
        P = half.T @ half
        Py = half.T @ self.white
        shared = [reduced.shared(joint) for joint in range(n)]
        # P times the columns of each joint's errors at each stop, (N, s).
        by_own = [reduced.by_stop(reduced.slopes[:, joint, None] * P).T for joint in range(n)]
        up, down = np.zeros(1 + 3 * n), np.zeros(1 + 3 * n)
        information = np.zeros((1 + 3 * n, 1 + 3 * n))
        for joint, whole in enumerate(by_own):
            pulled = reduced.by_stop(reduced.slopes[:, joint] * Py)
            within = reduced.by_stop(reduced.slopes[:, joint, None] * whole)
            mine = slice(1 + joint, None, n)
            up[mine] = _squares([pulled, *(covariance.T @ pulled for covariance in shared[joint])])
            down[mine] = np.trace(within), *((covariance * (within @ covariance)).sum() for covariance in shared[joint])
            for other in range(joint, n):
                inner = reduced.by_stop(reduced.slopes[:, joint, None] * by_own[other])
                ahead = [inner, *(inner @ covariance for covariance in shared[other])]
                rows = [ahead, *([covariance.T @ one for one in ahead] for covariance in shared[joint])]
                block = np.array([_squares(row) for row in rows])
                information[mine, 1 + other :: n] = block
                information[1 + other :: n, mine] = block.T
        # Derivative by the pixels' variance from those by all variances together: P V P = P.
        freedom = len(Py) - self.basis.shape[1]
        up[0] = (float(self.white @ self.white) - self.variances[1:] @ up[1:]) / pixels
        down[0] = (freedom - self.variances[1:] @ down[1:]) / pixels
        information[0] = (down - self.variances[1:] @ information[1:]) / pixels
        information[1:, 0] = information[0, 1:]
        information[0, 0] = (down[0] - self.variances[1:] @ information[1:, 0]) / pixels
        up[0] += reduced.squares / pixels**2
        down[0] += reduced.freedom / pixels
        information[0, 0] += reduced.freedom / pixels**2
        factors = np.sqrt(up / np.where(down > 0.0, down, 1.0))
        return 0.5 * (up - down), 0.5 * information, np.where(down > 0.0, factors, 1.0)


def _squares(arrays: list[FloatArray]) -> list[float]:
    """Sum of the squares of each array."""
    return [float((one**2).sum()) for one in arrays]


def _maximised(reduced: ReducedRows, X: FloatArray, start: FloatArray) -> tuple[_Likelihood, FloatArray]:
    """Likelihood at its maximum over nonnegative variances, and the information there."""
    here = _Likelihood(reduced, X, start)
    for _ in range(ROUNDS):
        score, information, factors = here.score()
        size = np.sqrt(np.maximum(np.diag(information), 1e-300))
        free = ((here.variances > 0.0) | (score > 0.0)) & (np.diag(information) > 0.0)
        scaled = information / np.outer(size, size)
        step = np.zeros_like(score)
        step[free] = np.linalg.pinv(scaled[np.ix_(free, free)], rcond=1e-8) @ (score / size)[free] / size[free]
        better = None
        for fraction in (1.0, 0.5, 0.2):
            tried = np.maximum(here.variances + fraction * step, 0.0)
            if tried[0] <= 0.1 * here.variances[0]:
                continue
            trial = _Likelihood(reduced, X, tried)
            if trial.value > here.value:
                better = trial
                break
        if better is None:
            better = _Likelihood(reduced, X, here.variances * factors)
        gain, here = better.value - here.value, better if better.value > here.value else here
        if gain < SETTLED:
            break
    return here, here.score()[1]


class ExactReadings(NamedTuple):
    """Reduced rows under exact joint readings, whitened by the ``root`` (N, N) of the pixels: orthonormal ``basis``
    (N, p) of the parameters, residuals ``left`` (N,) orthogonal to it, and the variance of ``pixels`` over the stated
    one.
    """

    root: FloatArray
    basis: FloatArray
    left: FloatArray
    pixels: float


def exact_readings(reduced: ReducedRows, X: FloatArray) -> ExactReadings | None:
    """The rows with parameters ``X`` (N, p) alone; None if these leave no degrees of freedom."""
    freedom = len(reduced.y) - X.shape[1] + reduced.freedom
    if freedom <= 0 or len(reduced.y) <= X.shape[1]:
        return None
    root = np.asarray(np.linalg.cholesky(reduced.pixels), dtype=np.float64)
    basis = np.linalg.qr(solve_triangular(root, X, lower=True))[0]
    left = solve_triangular(root, reduced.y, lower=True)
    left -= basis @ (basis.T @ left)
    return ExactReadings(root, basis, left, max((float(left @ left) + reduced.squares) / freedom, 1e-12))


def estimate_components(
    reduced: ReducedRows, *, scales: bool, near: VarianceComponents | None = None, screened: bool = True
) -> VarianceComponents | None:
    """Variance components of a bundle by its `reduced_rows`. ``near``: an earlier estimate to start from.

    ``scales``: the parameters include scale factors of the revolute joints, so that errors proportional to the
    reading count as scales. None if no residuals indicate joint errors, unless ``screened`` is false.
    """
    n = reduced.joints
    X = np.hstack([reduced.X, _unit(reduced.scales)]) if scales else reduced.X
    exact = exact_readings(reduced, X)
    if exact is None:
        return None
    pixels = exact.pixels
    none = _Likelihood(reduced, X, np.append(pixels, np.zeros(3 * n)))
    score, information, _ = none.score()
    if screened and not (score[1:] > SCREEN * np.sqrt(np.maximum(np.diag(information)[1:], 0.0))).any():
        return None
    identifiable = np.diag(information)[1:] > 0.0
    guess = np.zeros(3 * n)
    guess[identifiable] = pixels / _mean_squares(reduced)[identifiable]
    first = np.append(min(pixels, 1.0), guess)
    if near is not None:
        first = np.concatenate([[near.pixels], near.random, near.repeatable, near.posture])
    best, information = _maximised(reduced, X, first)
    # A component that appears at no stop is undetermined, and estimated as zero.
    shown = np.flatnonzero(np.diag(information) > 0.0)
    size = np.sqrt(np.diag(information)[shown])
    covariance = np.zeros_like(information)
    covariance[np.ix_(shown, shown)] = np.linalg.pinv(
        information[np.ix_(shown, shown)] / np.outer(size, size), rcond=1e-8
    ) / np.outer(size, size)
    logs, deviations = _scale_estimates(best, reduced) if scales else (np.zeros(0), np.zeros(0))
    return VarianceComponents(
        float(best.variances[0]),
        best.variances[1 : 1 + n],
        best.variances[1 + n : 1 + 2 * n],
        best.variances[1 + 2 * n :],
        covariance[1:, 1:],
        2.0 * (best.value - none.value),
        logs,
        deviations,
    )


NONE_SEEN = 0.8
"""Posterior mean, in standard deviations, of a variance that was estimated as zero, with a flat prior."""
SCREEN = 3.0
"""Standardised score of a component above which the likelihood is maximised."""


def _unit(columns: FloatArray) -> FloatArray:
    sizes = np.linalg.norm(columns, axis=0)
    return np.asarray(columns / np.where(sizes > 0.0, sizes, 1.0))


def _mean_squares(reduced: ReducedRows) -> FloatArray:
    """Mean squared length (3 n,) of each component's columns: variance added by a unit error, summed over its rows."""
    columns, component = reduced.columns()
    counts = np.bincount(component, minlength=3 * reduced.joints)
    sums = np.bincount(component, (columns**2).sum(axis=0), 3 * reduced.joints)
    return np.asarray(sums / np.maximum(counts, 1))


def _scale_estimates(best: _Likelihood, reduced: ReducedRows) -> tuple[FloatArray, FloatArray]:
    """Logarithms (r,) of the scale factors by generalised least squares, and their standard deviations."""
    rows = np.hstack([reduced.X, reduced.scales, reduced.y[:, None]])
    white = solve_triangular(best.root, rows, lower=True)
    at = reduced.X.shape[1]
    triangle = np.asarray(np.linalg.qr(white, mode="r"))
    found = estimate_beside(triangle[at:, at:])
    return found.x, np.sqrt(np.diag(found.covariance))


LIKELY = 0.02
"""Probability of reporting likely errors for exact joint readings."""
ONE_JOINT = 0.2
"""Share of it that is used for tests of single joints; the rest is for tests of all joints alike."""
SHOWN = 3.0
"""Standard deviations of a test's statistic that correspond to the variance for which the test is optimal."""
LEAST_CHANCE = 1e-12
"""Probability that is reported if the computed one is zero to rounding."""
NEGLIGIBLE = 1e-10
"""Weight of a chi-square, relative to the largest, below which it is left out."""


class ScoreTests(NamedTuple):
    """Probabilities with which exact readings give scores as large as the observed ones, for errors that are random,
    repeatable or by posture: of ``single`` joints (3, n), and of all joints ``alike`` (3,); 1 if not testable.
    """

    single: FloatArray
    alike: FloatArray

    @property
    def chance(self) -> float:
        """Upper bound (Bonferroni) of the probability that exact readings reach as much in any of the tests."""
        one = float(self.single.min()) * self.single.size / ONE_JOINT
        all_joints = float(self.alike.min()) * self.alike.size / (1.0 - ONE_JOINT)
        return min(one, all_joints, 1.0)


def likely_errors(reduced: ReducedRows) -> tuple[VarianceComponents | None, float]:
    """Variance components of joint readings that are likely to have errors, and the upper bound of the probability that
    exact ones show as much, by the `reduced_rows` of a bundle with exact ones; None and 0 if no errors are likely.
    """
    tests = score_tests(reduced)
    if tests is None or tests.chance > LIKELY:
        return None, 0.0
    components = estimate_components(reduced, scales=False, screened=False)
    return components, 0.0 if components is None else max(tests.chance, LEAST_CHANCE)


def score_tests(reduced: ReducedRows) -> ScoreTests | None:
    """Score tests by the `reduced_rows` of a bundle; None if its parameters leave no degrees of freedom."""
    exact = exact_readings(reduced, reduced.X)
    if exact is None:
        return None
    n = reduced.joints
    columns, component = reduced.columns()
    columns = solve_triangular(exact.root, columns, lower=True)
    columns -= exact.basis @ (exact.basis.T @ columns)
    scores = (exact.left @ columns) / np.sqrt(exact.pixels)
    products = columns.T @ columns

    def probability(members: BoolArray) -> float:
        here = np.flatnonzero(members)
        if not len(here):
            return 1.0
        sizes, axes = np.linalg.eigh(products[np.ix_(here, here)])
        kept = sizes > NEGLIGIBLE * max(float(sizes[-1]), 0.0)
        squares = (scores[here] @ axes[:, kept]) ** 2 / sizes[kept]
        weights = point_optimal_weights(sizes[kept])
        return weighted_chi2_tail(float(weights @ squares), weights)

    kinds = np.arange(3)
    single = [[probability(component == kind * n + joint) for joint in range(n)] for kind in kinds]
    return ScoreTests(np.array(single), np.array([probability(component // n == kind) for kind in kinds]))


def point_optimal_weights(sizes: FloatArray) -> FloatArray:
    """Weights (k,) of squared normal variates with variances ``1 + v sizes`` (k,) whose sum is the best test of a
    small variance ``v``: one at which it shifts by ``SHOWN`` of the sum's standard deviations at ``v`` = 0.
    """
    if not len(sizes):
        return sizes

    def shown(log_v: float) -> float:
        v = float(np.exp(log_v))
        weights = v * sizes / (1.0 + v * sizes)
        return float(v * (weights @ sizes)) - SHOWN * float(np.sqrt(2.0 * (weights @ weights)))

    about = -float(np.log(sizes.mean()))
    v = float(np.exp(brentq(shown, about - 20.0, about + 20.0, xtol=1e-3)))
    return np.asarray(v * sizes / (1.0 + v * sizes))


def weighted_chi2_tail(value: float, weights: FloatArray) -> float:
    """Probability that a sum of independent chi-squares with one degree of freedom and ``weights`` (k,) exceeds
    ``value``; 1 if no weight is above zero.
    """
    largest = float(weights.max(initial=0.0))
    if largest <= 0.0:
        return 1.0
    w = weights[weights > NEGLIGIBLE * largest] / largest
    q = value / largest
    if q <= 0.0:
        return 1.0

    def excess(z: float) -> float:
        return float((w / (1.0 - 2.0 * z * w)).sum()) - q

    # The slope of the cumulant function increases from 0 to infinity up to 1/2.
    z = float(brentq(excess, -0.5 * len(w) / q - 1.0, 0.5 * (1.0 - 1.0 / (2.0 * q + 2.0 * len(w)))))
    cumulant = -0.5 * float(np.log1p(-2.0 * z * w).sum())
    curvature = float((2.0 * (w / (1.0 - 2.0 * z * w)) ** 2).sum())
    if abs(z) * np.sqrt(curvature) < 1e-4:
        # At the mean the tail's formula is 0 / 0; its limit contains the skewness.
        third = float((8.0 * w**3).sum())
        return float(0.5 - third / (6.0 * np.sqrt(2.0 * np.pi) * curvature**1.5))
    root = np.sign(z) * np.sqrt(2.0 * (z * q - cumulant))
    return float(norm.sf(root + np.log(z * np.sqrt(curvature) / root) / root))
