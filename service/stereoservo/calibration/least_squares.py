"""Least-squares solver shared by all fits: the interface of a fit, Levenberg-Marquardt, normal equations by blocks, and
the statistics of the determined parameters.

A fit provides its cost in a state, the normal equations there, and the state after a step (its charts). A fit of few
parameters (`DenseFit`) gives residuals and their derivatives; the bundle gives blocks, in which each point is
eliminated separately (Schur complement). Priors are rows that no robust loss weights down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.numerics.arrays import FloatArray

GRADIENT = 1e-6
"""Largest entry of the gradient on unit columns at which a fit has converged: no parameter moves by a notable part
of its standard deviation."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-14, 1e10
"""Levenberg-Marquardt damping, added to the unit diagonal."""
FREE_DAMPING = 1e-2
"""Damping up to which a step's predicted decrease estimates the distance to the minimum."""
CHI2_TAIL = 0.0005
"""Probability of each tail outside the two-sided 99.9 % interval."""
OVERSTATED = 1.1
"""Factor by which stated sigmas may be too large without counting as a misfit: deviations are too large by as much."""
RANK_TOLERANCE = 1e-9
"""Singular value of the unit columns, relative to the largest, below which a direction is undetermined."""

LEAST_KNOWN = 1e-7
"""Length, relative to its column, at which an undetermined direction is bounded."""

S = TypeVar("S")


class RobustLoss(NamedTuple):
    """Loss by iteratively re-weighted least squares: residuals beyond ``scale`` [sigmas] are weighted down."""

    kind: Literal["soft_l1", "cauchy"]
    scale: float = 1.0

    def cost(self, squares: FloatArray) -> float:
        """``Σ s² ρ(e²/s²)`` of squared residuals ``squares`` (k,)."""
        scaled = squares / self.scale**2
        if self.kind == "soft_l1":
            return float(2.0 * self.scale**2 * (np.sqrt(1.0 + scaled) - 1.0).sum())
        return float(self.scale**2 * np.log1p(scaled).sum())

    def weights(self, squares: FloatArray) -> FloatArray:
        """IRLS weights ``ρ'(e²/s²)`` (k,) of squared residuals."""
        scaled = squares / self.scale**2
        return np.asarray(1.0 / (np.sqrt(1.0 + scaled) if self.kind == "soft_l1" else 1.0 + scaled))


# -- normal equations -------------------------------------------------------------------------------------------


class Equations(Protocol):
    """Normal equations of a fit in one state, on unit columns."""

    @property
    def gradient(self) -> FloatArray:
        """``Jᵀ W r`` (p,) on unit columns."""

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """Damped step (p,), not on unit columns, and its predicted decrease of the cost. Raises LinAlgError."""


@dataclass(frozen=True)
class NormalEquations:
    """``Jᵀ W J`` and ``Jᵀ W r`` by blocks: ``core`` (p_core + 1, p_core + 1) with the residuals as its last row and
    column, ``cross`` (m, q, p_core + 1), ``square`` (m, q, q) of points that no rows share. Columns have unit length;
    ``sizes`` (p,) are their original lengths. ``cost``: current one; exceeds ``core[-1, -1]`` by the eliminated part.
    """

    core: FloatArray
    cross: FloatArray
    square: FloatArray
    sizes: FloatArray
    cost: float

    @property
    def gradient(self) -> FloatArray:
        """``Jᵀ W r`` (p,) on unit columns."""
        return np.concatenate([self.core[:-1, -1], self.cross[:, :, -1].ravel()])

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """Damped step ``-(Jᵀ W J + λ I)⁻¹ Jᵀ W r`` (p,), not on unit columns, and its predicted decrease of the cost.

        Raises LinAlgError if rounding leaves the matrix indefinite.
        """
        m, q, width = self.cross.shape
        width -= 1
        matrix = self.core[:-1, :-1] + damping * np.eye(width)
        right = -self.core[:-1, -1]
        if q:
            inverse = np.linalg.inv(np.linalg.cholesky(self.square + damping * np.eye(q)))
            half = (inverse @ self.cross).reshape(m * q, width + 1)
            matrix = matrix - half[:, :-1].T @ half[:, :-1]
            right = right + half[:, :-1].T @ half[:, -1]
        root = np.linalg.cholesky(matrix)
        x = core = np.linalg.solve(root.T, np.linalg.solve(root, right))
        if q:
            back = -(half[:, -1] + half[:, :-1] @ core).reshape(m, q, 1)
            x = np.append(core, inverse.transpose(0, 2, 1) @ back)
        eliminated = self.cost - float(self.core[-1, -1])
        return x / self.sizes, float(damping * (x @ x) - self.gradient @ x) + eliminated


@dataclass(frozen=True)
class DenseEquations:
    """Equations of few parameters: orthogonal factor ``triangle`` (.., p + 1) of the rows and their residuals, which
    avoids squaring the condition; columns of unit length, ``sizes`` (p,) their original lengths.
    """

    triangle: FloatArray
    sizes: FloatArray

    @classmethod
    def of(cls, rows: FloatArray) -> DenseEquations:
        """Equations of weighted ``rows`` (k, p + 1), residuals last."""
        sizes = column_sizes(rows[:, :-1])
        return cls(np.asarray(np.linalg.qr(rows / np.append(sizes, 1.0), mode="r")), sizes)

    @property
    def gradient(self) -> FloatArray:
        """``Jᵀ W r`` (p,) on unit columns."""
        return np.asarray(self.triangle[:, :-1].T @ self.triangle[:, -1])

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """Damped step (p,), not on unit columns, and its predicted decrease of the cost. Raises LinAlgError."""
        p = len(self.sizes)
        padded = np.vstack([self.triangle[:, :-1], np.sqrt(damping) * np.eye(p)])
        basis, triangle = np.linalg.qr(padded)
        x = -np.linalg.solve(triangle, basis[: len(self.triangle)].T @ self.triangle[:, -1])
        return x / self.sizes, float(damping * (x @ x) - self.gradient @ x)


def column_sizes(rows: FloatArray) -> FloatArray:
    """Lengths (p,) of the columns of ``rows`` (k, p); 1 where a column is zero."""
    sizes = np.linalg.norm(rows, axis=0)
    return np.where(sizes > 0.0, sizes, 1.0)


def column_root(triangle: FloatArray, *, bounded: bool = False) -> FloatArray:
    """``R⁻¹`` of a root (p, p) of an information matrix, computed on unit columns: ``R⁻¹ R⁻ᵀ`` is the covariance.

    ``bounded``: undetermined directions get a large finite variance, and the root may have any number of
    rows. Otherwise raises LinAlgError for them.
    """
    sizes = column_sizes(triangle)
    unit = triangle / sizes
    if bounded:
        unit = np.asarray(np.linalg.qr(np.vstack([unit, LEAST_KNOWN * np.eye(len(sizes))]), mode="r"))
    return np.asarray(np.linalg.inv(unit) / sizes[:, None])


# -- the fit ----------------------------------------------------------------------------------------------------


class Fit(Protocol[S]):
    """Interface of a fit; a state is the parameters in any representation of the fit."""

    def cost(self, state: S) -> float:
        """Sum of squares or of a robust loss, priors included; not finite if the state is impossible."""

    def equations(self, state: S) -> Equations:
        """The normal equations at a state."""

    def retract(self, state: S, x: FloatArray) -> S:
        """The state at parameters ``x`` (p,) of the charts about ``state``."""


class Limits(NamedTuple):
    """Termination of a fit: after ``evaluations`` of the cost; converged if the predicted decrease of the cost by a
    step is at most a share ``tolerance`` of the cost, or at most ``settled`` [sigmas²].
    """

    evaluations: int = 100
    tolerance: float = 1e-10
    settled: float = 0.0


LIMITS = Limits()


@dataclass(frozen=True)
class Minimum(Generic[S]):
    """Result of a fit: final state, its cost and whether it has converged."""

    state: S
    cost: float
    converged: bool
    evaluations: int


def minimise(fit: Fit[S], state: S, limits: Limits = LIMITS) -> Minimum[S]:
    """Minimum of the cost from ``state`` by Levenberg-Marquardt, linearised again at every step.

    Never raises on a bad fit: check ``converged``, and the cost, which is infinite if the start is impossible.
    """
    cost = fit.cost(state)
    if not np.isfinite(cost):
        return Minimum(state, np.inf, False, 1)
    damping, evaluations, converged = FIRST_DAMPING, 1, False
    while not converged:
        equations = fit.equations(state)
        if float(np.abs(equations.gradient).max(initial=0.0)) <= GRADIENT:
            return Minimum(state, cost, True, evaluations)
        while True:
            if evaluations >= limits.evaluations or damping > MOST_DAMPING:
                return Minimum(state, cost, False, evaluations)
            try:
                x, expected = equations.step(damping)
            except np.linalg.LinAlgError:
                damping = max(10.0 * damping, 1e-12)
                continue
            trial = fit.retract(state, x)
            least = fit.cost(trial)
            evaluations += 1
            gain = (cost - least) / expected if expected > 0.0 else 0.0
            converged = damping <= FREE_DAMPING and expected <= max(limits.tolerance * cost, limits.settled)
            if gain > 1e-3:
                state, cost = trial, least
                damping = max(damping * (0.03 if gain > 0.75 else 0.3 if gain > 0.25 else 2.0), LEAST_DAMPING)
                break
            if converged:
                break
            damping = 10.0 * max(damping, 1e-12)
    return Minimum(state, cost, True, evaluations)


@dataclass(frozen=True)
class DenseFit(Generic[S]):
    """A fit of few parameters: ``residuals`` (k, d) [sigmas] at a state, in groups of d that share a weight, their
    ``jacobian`` (k, d, p) by the parameters of the charts, and the state after a ``step`` (p,) of these. ``prior``:
    rows (r, p + 1) of prior information, residuals last.
    """

    residuals: Callable[[S], FloatArray]
    jacobian: Callable[[S], FloatArray]
    step: Callable[[S, FloatArray], S]
    loss: RobustLoss | None = None
    prior: Callable[[S], FloatArray] | None = None

    def cost(self, state: S) -> float:
        """Sum of the loss and of the squares of the prior's residuals."""
        squares = (self.residuals(state) ** 2).sum(axis=1)
        known = 0.0 if self.prior is None else float((self.prior(state)[:, -1] ** 2).sum())
        return known + (float(squares.sum()) if self.loss is None else self.loss.cost(squares))

    def rows(self, state: S) -> FloatArray:
        """Weighted rows (.., p + 1), residuals last, those of the prior below."""
        error = self.residuals(state)
        rows = np.concatenate([self.jacobian(state), error[..., None]], axis=2)
        if self.loss is not None:
            rows = rows * np.sqrt(self.loss.weights((error**2).sum(axis=1)))[:, None, None]
        rows = rows.reshape(error.size, rows.shape[2])
        return rows if self.prior is None else np.vstack([rows, self.prior(state)])

    def equations(self, state: S) -> DenseEquations:
        """The normal equations at a state."""
        return DenseEquations.of(self.rows(state))

    def retract(self, state: S, x: FloatArray) -> S:
        """The state at parameters ``x`` (p,)."""
        return self.step(state, x)

    def statistics(self, state: S) -> EstimationStatistics:
        """Statistics of the parameters determined at a state."""
        rows = self.rows(state)
        return EstimationStatistics(
            self.cost(state), len(rows), rows.shape[1] - 1, lambda: np.asarray(np.linalg.qr(rows[:, :-1], mode="r"))
        )


def numeric_jacobian(
    residuals: Callable[[S], FloatArray], step: Callable[[S, FloatArray], S], size: int, width: float
) -> Callable[[S], FloatArray]:
    """Slopes (k, d, p) of `DenseFit` by forward differences of ``width``, of ``size`` parameters."""

    def slopes(state: S) -> FloatArray:
        here = residuals(state)
        ends = [residuals(step(state, one)) for one in width * np.eye(size)]
        return np.stack([(end - here) / width for end in ends], axis=-1)

    return slopes


# -- statistics of the determined parameters --------------------------------------------------------------------


def chi2_within(chi2: float, freedom: int) -> bool:
    """Whether ``chi2`` lies inside the two-sided 99.9 % interval of ``freedom`` degrees of freedom, for sigmas that are
    as stated or up to `OVERSTATED` times smaller.
    """
    low = float(chi2_distribution.ppf(CHI2_TAIL, freedom)) / OVERSTATED**2
    high = float(chi2_distribution.isf(CHI2_TAIL, freedom))
    return bool(low <= chi2 <= high)


@dataclass(frozen=True)
class EstimationStatistics:
    """Statistics of a fit with ``rows`` equations and ``parameters``, net of gauge, at a ``cost``; ``factor`` computes
    a root (.., p) of its information matrix.
    """

    cost: float
    rows: int
    parameters: int
    factor: Callable[[], FloatArray]

    @property
    def freedom(self) -> int:
        """Degrees of freedom."""
        return self.rows - self.parameters

    @property
    def variance(self) -> float:
        """Variance factor: estimated over stated variance."""
        return self.cost / max(1, self.freedom)

    @property
    def noise(self) -> float:
        """Factor on variances: the variance factor if residuals significantly exceed the stated sigmas, else 1."""
        factor = self.variance
        return factor if factor > 1.0 and not chi2_within(self.cost, self.freedom) else 1.0

    @cached_property
    def triangle(self) -> FloatArray:
        """Root (p, p) of the information matrix, ``triangleᵀ triangle = Jᵀ J``, to the accuracy of QR."""
        return self.factor()

    @cached_property
    def sizes(self) -> FloatArray:
        """Lengths (p,) of the Jacobian's columns; 1 where a column is zero."""
        return column_sizes(self.triangle)

    @property
    def rank(self) -> int:
        """Number of parameter directions that the data determine."""
        values = np.linalg.svd(self.triangle / self.sizes, compute_uv=False)
        return int((values > RANK_TOLERANCE * values[0]).sum())

    @cached_property
    def root(self) -> FloatArray:
        """``R⁻¹`` (p, p) with ``R⁻¹ R⁻ᵀ`` the parameters' covariance at the stated sigmas. Raises LinAlgError."""
        return column_root(self.triangle)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (p, p) of the chart coordinates at the larger of the stated and the estimated noise. Outliers
        count in the noise of a fit with a robust loss: ``root @ root.T`` is the covariance at the stated sigmas.
        """
        return np.asarray(self.root @ self.root.T * self.noise)


def with_rows(triangle: FloatArray, rows: FloatArray) -> FloatArray:
    """Root (p, p) of the information with further ``rows`` (k, p), such as those of a planned motion."""
    return np.asarray(np.linalg.qr(np.vstack([triangle, rows]), mode="r"))


def deviation_of(triangle: FloatArray, slope: FloatArray) -> float:
    """Standard deviation, at the stated sigmas, of a quantity with derivative ``slope`` (p,) by the parameters."""
    return float(np.linalg.norm(slope @ column_root(triangle, bounded=True)))


class Estimate(NamedTuple):
    """Additional parameters beside those of a fit, to first order about it: ``x`` (e,), their ``covariance`` (e, e) at
    the stated sigmas, and the ``gain`` in chi-square.
    """

    x: FloatArray
    covariance: FloatArray
    gain: float


def estimate_beside(triangle: FloatArray) -> Estimate:
    """Estimate of additional parameters from the ``triangle`` (.., e + 1) of their columns and the residuals, with the
    fit's own parameters projected out. A hypothesis about a fit is given by such columns.
    """
    moments, rest = triangle[:, :-1], triangle[:, -1]
    sizes = np.maximum(np.linalg.norm(moments, axis=0), 1e-150)
    unit = moments / sizes
    covariance = np.linalg.pinv(unit.T @ unit, rcond=1e-10, hermitian=True) / np.outer(sizes, sizes)
    x = -covariance @ (moments.T @ rest)
    return Estimate(x, covariance, float(-(moments.T @ rest) @ x))
