"""Fit of cameras, hand-eye transform and board to pictures of a known board at reported poses of an arm's hand.

A board point ``x`` is seen at ``A G C s x``: ``C`` places the board in its frame, ``G`` is the reported pose or its
inverse, ``A`` leads into the camera, and ``s`` is the arm's length of the board's unit. With a static camera ``G`` is
the hand in the base and ``C`` the board on the hand; with a camera in the hand ``G`` is the base in the hand and ``C``
the board in the base. Reported poses have errors: a small motion of the hand at each view with a normal prior, whose
deviations are estimated with that of the pixels. Nothing depends on the choice of the base's frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution

from stereoservo.calibration.least_squares import Limits, NormalEquations, minimise
from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import BoolArray, FloatArray

LENSES: tuple[tuple[int, ...], ...] = (
    (0, 2, 3),
    (0, 2, 3, 4),
    (0, 2, 3, 4, 5),
    (0, 2, 3, 4, 5, 6, 7),
    (0, 1, 2, 3, 4, 5, 6, 7, 8),
)
"""Free intrinsics of the nested lens models, out of `INTRINSICS`."""
INTRINSICS = ("focal length", "aspect", "cu", "cv", "k1", "k2", "p1", "p2", "k3")
LEAST_NOISE = np.array([1e-3, 1e-3, 1e-6, 1e-6])
"""Least deviations of pixels [px], and of poses [rad, m]: smaller ones have no effect on any result."""
OFF_CENTRE = 0.02
"""Prior deviation of the principal point from the middle of the picture [image widths], as cameras are built."""
LEAST_TRUSTED = 6
"""Number of views from which one may be left out."""
NOISE_ROUNDS, NOISE_SETTLED = 15, 0.03
"""Most rounds of estimating the deviations, and their relative change at which they have converged."""
DEGREE = 4
"""Degree over the board of errors that count as smooth."""
FALSE_ALARM = 1e-3
"""Probability that a test names anything in data without a fault."""
SIGNIFICANT = 3.3
"""Standard deviations beyond which a value differs from another: once in a thousand by chance."""
BLUR_PRIOR = 8.0
"""Weight, in pixel coordinates, of all views' common deviation in that of one view."""
LIMITS = Limits(60, 1e-7, 1e-3)


@dataclass(frozen=True)
class BoardViews:
    """A board of known ``layout`` (m, 3) [m] in ``pixels`` (c, s, m, 2), NaN if not seen, of cameras with ``sizes``
    (c, 2) [px], at reported ``poses`` (s, 4, 4) of the hand in the base [m]; ``names`` (s,) of the views.
    """

    names: tuple[str, ...]
    poses: FloatArray
    layout: FloatArray
    pixels: FloatArray
    sizes: FloatArray

    @property
    def seen(self) -> BoolArray:
        """Mask (c, s, m) of the available pixels."""
        return np.asarray(np.isfinite(self.pixels).all(axis=-1))

    def select(self, views: BoolArray) -> BoardViews:
        """Some of the views."""
        names = tuple(name for name, keep in zip(self.names, views, strict=True) if keep)
        return replace(self, names=names, poses=self.poses[views], pixels=self.pixels[:, views])


@dataclass(frozen=True)
class HandEye:
    """Cameras and transforms: ``intrinsics`` (c, 9) as `INTRINSICS`, ``A`` (c, 4, 4), ``C`` (4, 4), logarithm of the
    ``scale``, errors ``errors`` (s, 4, 4) of the poses.
    """

    intrinsics: FloatArray
    A: FloatArray
    C: FloatArray
    scale: float
    errors: FloatArray

    def matrices(self, c: int) -> tuple[FloatArray, FloatArray]:
        """Camera matrix (3, 3) and OpenCV's distortion (5,) of camera c."""
        f, aspect, cu, cv, *lens = self.intrinsics[c]
        return np.array([[f, 0.0, cu], [0.0, f * aspect, cv], [0.0, 0.0, 1.0]]), np.array(lens)


def motions(poses: FloatArray, mount: Mount) -> FloatArray:
    """The known motions ``G`` (s, 4, 4) of hand ``poses`` (s, 4, 4)."""
    return np.asarray(poses if mount == "eye_to_hand" else np.linalg.inv(poses))


def small_motion(x: FloatArray) -> FloatArray:
    """Motions (..., 4, 4) of rotation vectors and translations ``x`` (..., 6)."""
    T = np.zeros((*x.shape[:-1], 4, 4))
    T[..., :3, :3] = Rotation.from_rotvec(x[..., :3].reshape(-1, 3)).as_matrix().reshape(*x.shape[:-1], 3, 3)
    T[..., :3, 3], T[..., 3, 3] = x[..., 3:], 1.0
    return T


def motion_vector(T: FloatArray) -> FloatArray:
    """Rotation vectors and translations (..., 6) of motions (..., 4, 4)."""
    turns = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec()
    return np.concatenate([turns.reshape(*T.shape[:-2], 3), T[..., :3, 3]], axis=-1)


def _cross(points: FloatArray) -> FloatArray:
    """Derivatives (..., 3, 6) of points (..., 3) by a small motion of them: ``[-[p]x, 1]``."""
    rows = np.zeros((*points.shape[:-1], 3, 6))
    x, y, z = np.moveaxis(points, -1, 0)
    rows[..., 0, 1], rows[..., 0, 2], rows[..., 1, 2] = z, -y, x
    rows[..., 1, 0], rows[..., 2, 0], rows[..., 2, 1] = -z, y, -x
    rows[..., 3:] = np.eye(3)
    return rows


@dataclass(frozen=True)
class HandEyeProblem:
    """The least-squares fit (:func:`stereoservo.calibration.least_squares.minimise`) of a `HandEye` to views with a
    ``mount``; ``noise`` (4,): deviations of pixels [px], of their errors that are smooth over the board [px],
    such as those of a lens and a bent board, and of rotation [rad] and translation [m] of the poses.
    ``free``: indices of the free intrinsics; ``scaled``: whether the board's scale is free. ``trusted`` (s,): views
    whose reported pose counts; of others only the picture does. ``blur`` (s,): deviation of each view's pixels
    relative to ``noise``.
    """

    views: BoardViews
    mount: Mount
    noise: FloatArray
    free: tuple[int, ...]
    scaled: bool
    trusted: BoolArray
    blur: FloatArray

    @cached_property
    def smooth(self) -> FloatArray:
        """Orthonormal polynomials (c, s, m, k) over the markers that each view shows; zero if they are fewer."""
        flat = self.views.layout[:, :2] - self.views.layout[:, :2].mean(axis=0)
        x, y = (flat / np.abs(flat).max(axis=0)).T
        terms = np.stack([x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1)
        U, sizes, _ = np.linalg.svd(self.views.seen[..., None] * terms, full_matrices=False)
        functions = np.zeros((*self.views.seen.shape, terms.shape[1]))
        functions[..., : U.shape[-1]] = U * (sizes > 1e-6 * np.maximum(sizes[..., :1], 1e-9))[..., None, :]
        return functions

    def whitened(self, rows: FloatArray) -> FloatArray:
        """Rows (c, s, m, 2, k) [px], zero where a marker was not seen, divided by the deviations of their smooth part
        and of the rest.
        """
        shape = rows.shape
        flat = rows.reshape(*shape[:3], -1)
        part = self.smooth @ (self.smooth.swapaxes(2, 3) @ flat)
        own = (self.noise[0] * self.blur)[:, None, None]
        return np.asarray((flat - part) / own + part / np.hypot(own, self.noise[1])).reshape(shape)

    @property
    def exact(self) -> bool:
        """Whether the reported poses count as exact: all errors are then smooth ones of the pixels."""
        return bool((self.noise[2:] <= LEAST_NOISE[2:]).all())

    @cached_property
    def prior(self) -> FloatArray:
        """Inverse deviations (s, 6) of the poses' errors."""
        own = np.repeat(1.0 / self.noise[2:], 3)
        return np.where(self.trusted[:, None], own, 1e-3)

    @cached_property
    def counts(self) -> tuple[FloatArray, FloatArray]:
        """Numbers (s,) of smooth and other pixel coordinates of each view."""
        smooth = 2.0 * (self.smooth**2).sum(axis=(0, 2, 3))
        return smooth, 2.0 * self.views.seen.sum(axis=(0, 2)) - smooth

    def projected(self, state: HandEye) -> tuple[FloatArray, FloatArray]:
        """Predicted pixels (c, s, m, 2), and points (c, s, m, 3) in the camera."""
        _, _, _, y = self._points(state)
        shape = y.shape[:-1]
        pixels = np.empty((*shape, 2))
        for c in range(len(y)):
            found = cv2.projectPoints(y[c].reshape(-1, 3), np.zeros(3), np.zeros(3), *state.matrices(c))[0]
            pixels[c] = np.asarray(found).reshape(*shape[1:], 2)
        return pixels, y

    def _points(self, state: HandEye) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Points of the board (m, 3) and (s, m, 3) where the error of the pose acts, and after all of it, and in the
        cameras (c, s, m, 3).
        """
        G, E = motions(self.views.poses, self.mount), state.errors
        x = np.exp(state.scale) * self.views.layout
        w = x @ state.C[:3, :3].T + state.C[:3, 3]
        first, then = (G, E) if self.mount == "eye_in_hand" else (E, G)
        v = w @ first[:, :3, :3].swapaxes(1, 2) + first[:, None, :3, 3]
        z = v @ then[:, :3, :3].swapaxes(1, 2) + then[:, None, :3, 3]
        y = z @ state.A[:, None, :3, :3].swapaxes(2, 3) + state.A[:, None, None, :3, 3]
        return x, z if self.mount == "eye_in_hand" else v, z, y

    def residuals(self, state: HandEye) -> FloatArray:
        """Residuals (c, s, m, 2) [sigmas]; zero where a marker was not seen."""
        predicted, _ = self.projected(state)
        return self.whitened(np.where(self.views.seen[..., None], predicted - self.views.pixels, 0.0)[..., None])[
            ..., 0
        ]

    def prior_residuals(self, state: HandEye) -> FloatArray:
        """Errors (s, 6) of the poses [sigmas]."""
        return motion_vector(state.errors) * self.prior

    def cost(self, state: HandEye) -> float:
        """Sum of squares; infinite if a point lies behind a camera."""
        predicted, y = self.projected(state)
        seen = self.views.seen
        if (y[..., 2][seen] <= 0.0).any() or not np.isfinite(predicted[seen]).all():
            return np.inf
        errors = self.whitened(np.where(seen[..., None], predicted - self.views.pixels, 0.0)[..., None])
        priors = float((self.prior_residuals(state) ** 2).sum() + self.centre_prior(state)[-1, -1])
        return float((errors**2).sum()) + priors

    def columns(self, state: HandEye, plain: bool = False) -> tuple[FloatArray, FloatArray]:
        """Derivatives (s, k, p) and (s, k, 6) of the residuals of each view by the shared parameters and by the errors
        of its pose; shared are, by camera, free intrinsics and A, then C and the scale. ``plain``: of the
        pixels [px], not whitened.
        """
        x, moved, _, y = self._points(state)
        c, s, m, _ = y.shape
        q = len(self.free)
        G = motions(self.views.poses, self.mount)
        after = G if self.mount == "eye_to_hand" else np.broadcast_to(np.eye(4), G.shape)
        shared = np.zeros((c, s, m, 2, c * (q + 6) + 6 + self.scaled))
        own = np.zeros((c, s, m, 2, 6))
        board = _cross(x)
        for k in range(c):
            slopes = np.asarray(
                cv2.projectPoints(y[k].reshape(-1, 3), np.zeros(3), np.zeros(3), *state.matrices(k))[1]
            ).reshape(s, m, 2, -1)
            at, aspect = slopes[..., 3:6], state.intrinsics[k, 1]
            focal = slopes[..., 6] + aspect * slopes[..., 7], state.intrinsics[k, 0] * slopes[..., 7]
            by_camera = np.concatenate([np.stack(focal, axis=-1), slopes[..., 8:15]], axis=-1)
            begin = k * (q + 6)
            shared[k, ..., begin : begin + q] = by_camera[..., self.free]
            shared[k, ..., begin + q : begin + q + 6] = at @ _cross(y[k])
            R = state.A[k, :3, :3]
            onto = at @ (R @ (G @ state.errors if self.mount == "eye_to_hand" else state.errors @ G)[:, None, :3, :3])
            onto = onto @ state.C[:3, :3]
            shared[k, ..., c * (q + 6) : c * (q + 6) + 6] = onto @ board
            if self.scaled:
                shared[k, ..., -1] = (onto @ x[:, :, None])[..., 0]
            own[k] = at @ (R @ after[:, None, :3, :3]) @ _cross(moved)
        mask = self.views.seen[..., None, None]
        both = np.where(mask, np.concatenate([shared, own], axis=-1), 0.0)
        rows = np.moveaxis(both if plain else self.whitened(both), 0, 1).reshape(s, c * m * 2, -1)
        return rows[..., :-6], rows[..., -6:]

    def centre_prior(self, state: HandEye) -> FloatArray:
        """Prior information (p + 1, p + 1) on the principal points, residuals last; p as in `columns`."""
        q, c = len(self.free), len(state.A)
        rows = np.zeros((2 * c, c * (q + 6) + 6 + self.scaled + 1))
        for k in range(c):
            inverse = 1.0 / (OFF_CENTRE * self.views.sizes[k, 0])
            away = state.intrinsics[k, 2:4] - 0.5 * (self.views.sizes[k] - 1.0)
            for axis in (0, 1):
                rows[2 * k + axis, [k * (q + 6) + self.free.index(2 + axis), -1]] = inverse, inverse * away[axis]
        return np.asarray(rows.T @ rows)

    def blocks(self, state: HandEye) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal equations: ``core`` (p + 1, p + 1), ``cross`` (s, 6, p + 1) and ``square`` (s, 6, 6)."""
        shared, own = self.columns(state)
        s = len(own)
        rest = np.moveaxis(self.residuals(state), 0, 1).reshape(s, -1, 1)
        rows = np.concatenate([shared, rest], axis=2)
        cross = own.swapaxes(1, 2) @ rows
        priors = self.prior_residuals(state)
        cross[:, :, -1] += self.prior * priors
        square = own.swapaxes(1, 2) @ own + self.prior[:, :, None] ** 2 * np.eye(6)
        flat = rows.reshape(-1, rows.shape[2])
        core = flat.T @ flat + self.centre_prior(state)
        core[-1, -1] += float((priors**2).sum())
        return core, cross, square

    def equations(self, state: HandEye) -> NormalEquations:
        """The normal equations on unit columns."""
        core, cross, square = self.blocks(state)
        width = np.sqrt(np.maximum(np.diag(core)[:-1], 1e-30))
        inner = np.sqrt(np.diagonal(square, axis1=1, axis2=2))
        outer = np.append(width, 1.0)
        return NormalEquations(
            core / np.outer(outer, outer),
            cross / (inner[:, :, None] * outer),
            square / (inner[:, :, None] * inner[:, None]),
            np.concatenate([width, inner.ravel()]),
            float(core[-1, -1]),
        )

    def retract(self, state: HandEye, x: FloatArray) -> HandEye:
        """The state after steps ``x``: small motions of A and of the errors from the left, of C from the right."""
        c, q = len(state.A), len(self.free)
        per = x[: c * (q + 6)].reshape(c, q + 6)
        intrinsics = state.intrinsics.copy()
        intrinsics[:, self.free] += per[:, :q]
        at = c * (q + 6)
        errors = x[at + 6 + self.scaled :].reshape(-1, 6)
        return HandEye(
            intrinsics,
            small_motion(per[:, q:]) @ state.A,
            state.C @ small_motion(x[at : at + 6]),
            state.scale + (float(x[at + 6]) if self.scaled else 0.0),
            small_motion(errors) @ state.errors,
        )


@dataclass(frozen=True)
class HandEyeFit:
    """A converged (or not) fit: its problem, state, and ``covariance`` (p, p) of the shared parameters, with that of
    each pose's error, ``posterior`` (s, 6, 6).
    """

    problem: HandEyeProblem
    state: HandEye
    cost: float
    converged: bool
    covariance: FloatArray
    posterior: FloatArray

    @cached_property
    def log_likelihood(self) -> float:
        """Logarithm of the likelihood, the errors of the poses integrated out (Laplace), up to a constant."""
        problem = self.problem
        _, _, square = problem.blocks(self.state)
        free = 0.5 * np.linalg.slogdet(square)[1].sum() - np.log(problem.prior).sum()
        smooth, plain = problem.counts
        own = problem.noise[0] * problem.blur
        return float(-0.5 * self.cost - free - plain @ np.log(own) - smooth @ np.log(np.hypot(own, problem.noise[1])))

    @cached_property
    def deviations(self) -> FloatArray:
        """Standard deviations (p,) of the shared parameters; if poses count as exact, at least those by
        leaving out each view (jackknife), since the errors of real ones are no noise of the pixels.
        """
        variances = np.diag(self.covariance)
        if self.problem.exact:
            steps = deletion_steps(self)[self.problem.trusted, :, 0]
            variances = np.maximum(variances, (steps**2).sum(axis=0) * (1.0 - 1.0 / len(steps)))
        return np.sqrt(variances)

    def misfits(self) -> FloatArray:
        """Decrease (s,) of the cost if a view's pose were free [sigmas²], all else fitted; zero if not trusted."""
        problem = self.problem
        _, cross, square = problem.blocks(self.state)
        prior = problem.prior**2
        data = square - prior[:, :, None] * np.eye(6)
        inverse = np.linalg.inv(square)
        by_shared = cross[..., :-1] - data @ (inverse @ cross[..., :-1])
        known = by_shared @ self.covariance @ by_shared.swapaxes(1, 2) + data @ inverse @ data
        gradient = cross[:, :, -1] - prior * motion_vector(self.state.errors)
        free = np.linalg.pinv(data - known, rcond=1e-9, hermitian=True)
        return np.where(problem.trusted, np.einsum("si,sij,sj->s", gradient, free, gradient), 0.0)


def solved(problem: HandEyeProblem, state: HandEye) -> HandEyeFit:
    """The fit from a start, with its covariance; undetermined directions get a very large one."""
    found = minimise(problem, state, LIMITS)
    core, cross, square = problem.blocks(found.state)
    inverse = np.linalg.inv(square)
    reduced = core[:-1, :-1] - np.einsum("sqp,sqr,srt->pt", cross[..., :-1], inverse, cross[..., :-1])
    sizes = np.sqrt(np.maximum(np.diag(core)[:-1], 1e-30))
    values, vectors = np.linalg.eigh(reduced / np.outer(sizes, sizes))
    # Rounding of the blocks hides what is smaller: such a direction is undetermined.
    root = vectors / np.sqrt(np.maximum(values, 1e-13))
    covariance = (root @ root.T) / np.outer(sizes, sizes)
    back = inverse @ cross[..., :-1]
    posterior = inverse + back @ covariance @ back.swapaxes(1, 2)
    return HandEyeFit(problem, found.state, found.cost, found.converged, covariance, posterior)


def with_estimated_noise(fit: HandEyeFit) -> HandEyeFit:
    """The fit with the deviations of pixels and poses estimated from the data (variance components); poses
    that count as exact remain so.
    """
    for _ in range(NOISE_ROUNDS):
        problem = fit.problem
        errors = motion_vector(fit.state.errors)[problem.trusted]
        kept = np.diagonal(fit.posterior[problem.trusted], axis1=1, axis2=2)
        noise = problem.noise.copy()
        effective = len(fit.covariance) + 6.0 * len(problem.trusted)
        for k, part in ((2, slice(0, 3)), (3, slice(3, 6))):
            left = 3.0 * len(errors) - float(kept[:, part].sum()) / noise[k] ** 2
            effective -= left
            if not problem.exact:
                noise[k] = np.sqrt((errors[:, part] ** 2).sum() / max(left, 1e-3))
        noise[:2], blur = _pixel_noise(fit, effective)
        noise = np.maximum(noise, LEAST_NOISE)
        change = float(np.abs(np.log(noise / problem.noise)).max())
        fit = solved(replace(problem, noise=noise, blur=blur), fit.state)
        if change < NOISE_SETTLED:
            break
    return fit


def _pixel_noise(fit: HandEyeFit, effective: float) -> tuple[FloatArray, FloatArray]:
    """Deviations (2,) of the pixels and of their smooth errors, and relative deviations (s,) by view. The ``effective``
    number of parameters fits smooth errors; the rest of the residuals is noise of the corners.
    """
    problem = fit.problem
    smooth, plain = problem.counts
    own = (problem.noise[0] * problem.blur)[:, None, None]
    rest = problem.residuals(fit.state)
    parts = problem.smooth.swapaxes(2, 3) @ rest
    rest = (rest - problem.smooth @ parts) * own
    waves = float(((parts * np.hypot(own, problem.noise[1])) ** 2).sum()) / max(float(smooth.sum()) - effective, 1.0)
    if plain.sum() < 1.0:
        return np.array([np.sqrt(waves), 0.0]), problem.blur
    squares = (rest**2).sum(axis=(0, 2, 3))
    common = float(squares.sum() / plain.sum())
    views = np.sqrt((squares + BLUR_PRIOR * common) / (plain + BLUR_PRIOR))
    noise = float(np.median(views))
    return np.array([noise, np.sqrt(max(waves - noise**2, 0.0))]), views / noise


def without_misfits(fit: HandEyeFit) -> HandEyeFit:
    """The fit with those views' poses not trusted that do not fit the others: one after the other, by the F test of a
    free pose against the errors of the others, of false-alarm probability `FALSE_ALARM` over all views. Views that were
    not trusted before are tested again.
    """
    for k in np.flatnonzero(~fit.problem.trusted):
        again = solved(_trusting(fit.problem, int(k), True), fit.state)
        if _misfit_probability(again, int(k)) > FALSE_ALARM:
            fit = with_estimated_noise(again)
    while fit.problem.trusted.sum() > LEAST_TRUSTED:
        worst = int(fit.misfits().argmax())
        if _misfit_probability(fit, worst) > FALSE_ALARM:
            break
        fit = with_estimated_noise(solved(_trusting(fit.problem, worst, False), fit.state))
    return fit


def _trusting(problem: HandEyeProblem, view: int, trust: bool) -> HandEyeProblem:
    trusted = problem.trusted.copy()
    trusted[view] = trust
    return replace(problem, trusted=trusted)


def _misfit_probability(fit: HandEyeFit, view: int) -> float:
    """Probability that any view of a set without a fault misfits as much as one does."""
    gains = fit.misfits()
    count = int(fit.problem.trusted.sum())
    rest = max(float(gains.sum() - gains[view]), 1e-9) / (6.0 * (count - 1))
    return float(f_distribution.sf(gains[view] / 6.0 / rest, 6, 6 * (count - 1)) * count)


START_NOISE = np.array([0.5, 3.0, 2e-3, 2e-3])
"""Deviations from which they are estimated."""


def fit_board(views: BoardViews, mount: Mount, state: HandEye) -> HandEyeFit:
    """Fit of a board's views from a start. The board's scale is free if it differs significantly from 1. Lens
    terms, and whether the poses count as exact, are those that predict left-out poses best; views that do not
    fit are not trusted.
    """
    s = len(views.names)
    noise = np.append(START_NOISE[:2], LEAST_NOISE[2:])
    problem = HandEyeProblem(views, mount, noise, LENSES[0], True, np.ones(s, dtype=np.bool_), np.ones(s))
    fit = _of_known_size(without_misfits(with_estimated_noise(solved(problem, state))))
    fits = []
    for free in LENSES:
        fit = with_estimated_noise(solved(replace(fit.problem, free=free), fit.state))
        fits.append(fit)
    best = without_misfits(_preferred(fits))
    noise = np.append(best.problem.noise[:2], START_NOISE[2:])
    noisy = with_estimated_noise(solved(replace(best.problem, noise=noise), best.state))
    noisier = [with_estimated_noise(solved(replace(noisy.problem, free=free), noisy.state)) for free in LENSES]
    return _of_known_size(without_misfits(_preferred([best, *noisier])))


def _of_known_size(fit: HandEyeFit) -> HandEyeFit:
    """The fit without a scale of the board that is not significant."""
    if not fit.problem.scaled or abs(fit.state.scale) > SIGNIFICANT * fit.deviations[-1]:
        return fit
    return with_estimated_noise(solved(replace(fit.problem, scaled=False), replace(fit.state, scale=0.0)))


def _preferred(fits: list[HandEyeFit]) -> HandEyeFit:
    """The likeliest of the fits, by the Bayesian information criterion, among those that predict left-out views as well
    as the best one, within the standard error of the difference.
    """
    fits = [fit for fit in fits if fit.converged] or fits
    squares = np.array([left_out_squares(fit) for fit in fits])
    worse = squares - squares[squares.mean(axis=1).argmin()]
    alike = worse.mean(axis=1) <= worse.std(axis=1) / np.sqrt(worse.shape[1])
    rows = 2.0 * fits[0].problem.views.seen.sum()
    scores = [fit.log_likelihood - 0.5 * len(fit.covariance) * np.log(rows) for fit in fits]
    return fits[int(np.where(alike, scores, -np.inf).argmax())]


def deletion_steps(fit: HandEyeFit) -> FloatArray:
    """Changes (s, p, 1) of the shared parameters if a view is left out, to first order."""
    problem = fit.problem
    core, cross, square = problem.blocks(fit.state)
    shared, own = problem.columns(fit.state)
    rows = np.concatenate([shared, np.moveaxis(problem.residuals(fit.state), 0, 1).reshape(len(own), -1, 1)], axis=2)
    eliminated = cross.swapaxes(1, 2) @ np.linalg.inv(square) @ cross
    others = core - eliminated.sum(axis=0) - (rows.swapaxes(1, 2) @ rows - eliminated)
    sizes = np.sqrt(np.maximum(np.diagonal(others, axis1=1, axis2=2)[:, :-1], 1e-30))
    unit = others[:, :-1, :-1] / (sizes[:, :, None] * sizes[:, None])
    unit = np.linalg.pinv(unit, rcond=1e-10, hermitian=True)
    return np.asarray(-(unit @ (others[:, :-1, -1:] / sizes[..., None])) / sizes[..., None])


def left_out_squares(fit: HandEyeFit) -> FloatArray:
    """Mean squared error (k,) [px²] of the pixels of each trusted view, predicted at its reported pose by the
    other views' fit, which is found to first order.
    """
    problem = fit.problem
    still = replace(fit.state, errors=np.tile(np.eye(4), (len(problem.trusted), 1, 1)))
    errors = np.moveaxis(problem.projected(still)[0] - problem.views.pixels, 0, 1)
    errors = errors + (problem.columns(still, plain=True)[0] @ deletion_steps(fit)).reshape(errors.shape)
    squares = 2.0 * np.nanmean(errors**2, axis=(1, 2, 3))
    return np.asarray(squares[problem.trusted])


def predicted_errors(fit: HandEyeFit, views: BoardViews) -> FloatArray:
    """Errors (c, s, m, 2) [px] of the pixels that the fit predicts at reported poses alone."""
    still = replace(fit.state, errors=np.tile(np.eye(4), (len(views.poses), 1, 1)))
    problem = replace(fit.problem, views=views, trusted=np.ones(len(views.poses), dtype=np.bool_))
    return np.asarray(problem.projected(still)[0] - views.pixels)
