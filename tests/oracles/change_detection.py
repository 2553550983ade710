"""Readable NumPy twin of `change_detection_kernel`: the same hypotheses, estimates and decision, written apart from it.

Every estimate is Gauss and Newton's: ``chi2(x) = Σ w² |observed - predicted(x)|²``, at most `ROUNDS` steps, none of
which may raise chi-square. Hypotheses are numbered as in `change_detection.hypothesis_subject`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereoservo.calibration.change.change_detection_kernel import (
    DAMPING,
    EXPLAINED,
    ROUNDS,
    SCREEN,
    SETTLED,
    SPARE,
)
from stereoservo.calibration.change.hypothesis_test import MAX_SIZE, REFINED, UNCLEAR, Thresholds, chi2_tail
from stereoservo.geometry.cameras import project_many, projection_jacobian_many
from stereoservo.numerics.arrays import FloatArray

Equations = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""State to errors (r,), their weights (r,) and the derivative (r, d) of the prediction by a step."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """What is seen: matrices (c, 3, 4), points (p, 4), the first ``markers`` of them on the arm, ``pixels`` as
    predicted and ``observed`` (c, p, 2), ``weights`` (c, p), operators (n, 4, 4), ``twists`` (6, 4, 4) or None.
    """

    matrices: FloatArray
    points: FloatArray
    markers: int
    pixels: FloatArray
    observed: FloatArray
    weights: FloatArray
    operators: FloatArray
    twists: FloatArray | None

    @property
    def names(self) -> list[tuple[str, int]]:
        """Kind and index of each hypothesis."""
        return [
            ("nothing", -1),
            *(("camera", c) for c in range(len(self.matrices))),
            ("cameras", -1),
            *(("marker", p) for p in range(self.markers)),
            *(("joint", j) for j in range(len(self.operators))),
            ("joints", -1),
        ]


@dataclass(frozen=True)
class Reference:
    """As the kernel's answer: ``kind`` (0 nothing … 6 unexplained), hypothesis and runner-up, with all ``chi2``."""

    kind: int
    best: int
    runner_up: int
    sizes: tuple[int, ...]
    chi2: tuple[float, ...]
    amounts: tuple[float, ...]
    effects: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Of one hypothesis: chi-square of what it concerns, ``now`` and ``left``; ``gain`` to first order, ``amount``,
    ``effect`` [px].
    """

    now: float
    left: float
    gain: float
    amount: float
    effect: float


def iterate(
    equations: Equations, step: Callable[[FloatArray, FloatArray], FloatArray], state: FloatArray, rounds: int
) -> tuple[FloatArray, float, float, float, FloatArray]:
    """Best state, chi-square before and after, gain to first order of the first step, sum of the steps."""
    first = best = np.inf
    linear, found = 0.0, state
    total: FloatArray = np.zeros(0)
    tried: FloatArray = np.zeros(0)
    for turn in range(rounds + 1):
        error, weights, J = equations(state)
        chi2 = float((weights**2 * error**2).sum())
        if turn == 0:
            first, tried = chi2, np.zeros(J.shape[1])
        if not np.isfinite(chi2) or (turn > 0 and not chi2 <= best):
            break
        best, found, total = chi2, state, tried
        N = (J * weights[:, None] ** 2).T @ J
        b = (J * weights[:, None] ** 2).T @ error
        if float(np.diag(N).max(initial=0.0)) == 0.0:
            break
        x = np.linalg.solve(N + DAMPING * np.diag(N).max() * np.eye(len(N)), b)
        gain = float(b @ x)
        linear = gain if turn == 0 else linear
        if turn == rounds or gain < SETTLED:
            break
        state, tried = step(state, x), tried + x
    return found, first, best, linear, total


def displaced(moment: Measurement, cameras: list[int], algebra: FloatArray, count: int, rounds: int) -> Estimate:
    """The first ``count`` points moved by an element of the group of ``algebra`` (d, 4, 4), as ``cameras`` see them.

    Moving the points by D is moving the cameras to ``P D``.
    """
    Ps, X = moment.matrices[cameras], moment.points[:count]
    weights = moment.weights[cameras][:, :count]
    seen = weights > 0.0

    def equations(D: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        moved = X @ D.T
        error = (moment.observed[cameras][:, :count] - project_many(Ps, moved))[seen]
        velocities = np.einsum("dij,pj->pid", algebra, moved)
        J = np.einsum("cpri,pid->cprd", projection_jacobian_many(Ps, moved), velocities)[seen]
        return error.ravel(), np.repeat(weights[seen], 2), J.reshape(-1, len(algebra))

    def step(D: FloatArray, x: FloatArray) -> FloatArray:
        return np.asarray(_exponential(np.tensordot(x, algebra, axes=1)) @ D)

    D, now, left, gain, total = iterate(equations, step, np.eye(4), rounds)
    way = (project_many(Ps, X @ D.T) - moment.pixels[cameras][:, :count])[seen]
    effect = float(np.sqrt((way**2).sum() / max(len(way), 1)))
    largest = float(total[np.abs(total).argmax()]) if total.size else 0.0
    return Estimate(now, left, gain, largest if algebra is not moment.twists else _angle(D), effect)


def image_moved(moment: Measurement, camera: int, size: int, rounds: int) -> Estimate:
    """The image of one camera moved by a homography (``size`` 8) or a shift (2), in coordinates about its points."""
    seen = moment.weights[camera] > 0.0
    pixels, observed = moment.pixels[camera][seen], moment.observed[camera][seen]
    centre = pixels.mean(axis=0)
    spread = float(np.sqrt(((pixels - centre) ** 2).sum(axis=1).mean())) or 1.0
    weights = np.repeat(moment.weights[camera][seen] * spread, 2)
    target = (observed - centre) / spread

    def equations(at: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        x, y = at.reshape(-1, 2).T
        one, none = np.ones_like(x), np.zeros_like(x)
        u = np.stack([one, none, x, y, none, none, x * x, x * y], axis=-1)
        v = np.stack([none, one, none, none, x, y, x * y, y * y], axis=-1)
        J = np.stack([u, v], axis=1).reshape(-1, 8)[:, :size]
        return (target.ravel() - at), weights, J

    def step(at: FloatArray, a: FloatArray) -> FloatArray:
        x, y = at.reshape(-1, 2).T
        if size == 2:
            return (at.reshape(-1, 2) + a).ravel()
        H = np.array([(1 + a[2], a[3], a[0]), (a[4], 1 + a[5], a[1]), (-a[6], -a[7], 1.0)])
        image = np.stack([x, y, np.ones_like(x)], axis=-1) @ H.T
        return np.asarray((image[:, :2] / image[:, 2:]).ravel())

    start = ((pixels - centre) / spread).ravel()
    at, now, left, gain, _ = iterate(equations, step, start, rounds)
    effect = spread * float(np.sqrt(((at - start) ** 2).sum() / max(len(pixels), 1)))
    return Estimate(now, left, gain, np.nan, effect)


def point_moved(moment: Measurement, p: int, size: int, rounds: int) -> Estimate:
    """Marker ``p`` at another place: three of its coordinates are free, all but the largest; one view fits as it is."""
    seen = np.flatnonzero(moment.weights[:, p] > 0.0)
    way = moment.observed[seen, p] - moment.pixels[seen, p]
    effect = float(np.sqrt((way**2).sum() / max(len(seen), 1)))
    weights = np.repeat(moment.weights[seen, p], 2)
    if size == 2:
        chi2 = float((weights**2 * way.ravel() ** 2).sum())
        return Estimate(chi2, 0.0, chi2, 0.0, effect)
    free = [i for i in range(4) if i != int(np.abs(moment.points[p]).argmax())]

    def equations(X: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        Ps = moment.matrices[seen]
        error = moment.observed[seen, p] - project_many(Ps, X[None])[:, 0]
        return (
            error.ravel(),
            weights,
            projection_jacobian_many(Ps, X[None])[:, 0, :, free].transpose(1, 2, 0).reshape(-1, 3),
        )

    def step(X: FloatArray, x: FloatArray) -> FloatArray:
        moved = X.copy()
        moved[free] += x
        return moved

    _, now, left, gain, _ = iterate(equations, step, moment.points[p], rounds)
    return Estimate(now, left, gain, 0.0, effect)


def sizes_of(moment: Measurement) -> list[int]:
    """Parameters of each hypothesis, 0 where it cannot be tested."""
    seen = moment.weights > 0.0
    metric = moment.twists is not None
    full, of_arm, n = 6 if metric else 8, 2 * int(seen[:, : moment.markers].sum()), len(moment.operators)
    sizes = [0]
    for count in 2 * seen.sum(axis=1):
        sizes.append(full if count >= full + SPARE else 2 if count >= 2 + SPARE else 0)
    together = metric and len(seen) > 1 and 2 * seen.sum() >= 6 + SPARE
    sizes.append(6 if together else 0)
    sizes += [min(3, 2 * int(views)) for views in seen[:, : moment.markers].sum(axis=0)]
    sizes += [1 if of_arm >= 1 + SPARE else 0] * n
    sizes.append(n if 1 < n <= MAX_SIZE and of_arm >= n + SPARE else 0)
    return sizes


def estimated(moment: Measurement, h: int, size: int, rounds: int) -> Estimate:
    """Hypothesis ``h`` of ``size`` parameters."""
    kind, index = moment.names[h]
    every = list(range(len(moment.matrices)))
    if kind in ("camera", "cameras"):
        cameras = every if kind == "cameras" else [index]
        if moment.twists is not None and size == 6:
            return displaced(moment, cameras, moment.twists, len(moment.points), rounds)
        return image_moved(moment, index, size, rounds)
    if kind == "marker":
        return point_moved(moment, index, size, rounds)
    algebra = moment.operators if kind == "joints" else moment.operators[index : index + 1]
    return displaced(moment, every, algebra, moment.markers, rounds)


def explain(moment: Measurement, thresholds: Thresholds) -> Reference:
    """Estimates to first order; in full those of the best; the choice among those."""
    names, sizes = moment.names, sizes_of(moment)
    seen = moment.weights > 0.0
    errors = np.where(seen[..., None], moment.observed - moment.pixels, 0.0)
    whole = float((moment.weights[..., None] ** 2 * errors**2).sum())
    total = 2 * int(seen.sum())
    rms = float(np.sqrt((errors**2).sum() / max(seen.sum(), 1)))
    price = float(np.log(max(total, 2)))
    chi2, amounts, effects = [whole] + [np.inf] * (len(names) - 1), [0.0] * len(names), [0.0] * len(names)
    testable = [h for h in range(1, len(names)) if sizes[h] > 0]
    linear = {h: estimated(moment, h, sizes[h], 0).gain for h in testable}
    for h in testable:
        chi2[h] = whole - linear[h]

    def answer(kind: int, best: int = 0, runner_up: int = -1) -> Reference:
        return Reference(kind, best, runner_up, tuple(sizes), tuple(chi2), tuple(amounts), tuple(effects))

    noisy = chi2_tail(whole, total) < np.exp(thresholds.log_alpha) and rms >= thresholds.least_px
    if not any(linear[h] > SCREEN * thresholds.ratios[sizes[h]] for h in testable):
        return answer(6 if noisy else 0)
    refined = sorted(testable, key=lambda h: -(linear[h] - sizes[h] * price))[:REFINED]
    for h in refined:
        one = estimated(moment, h, sizes[h], ROUNDS)
        chi2[h], amounts[h], effects[h] = whole - one.now + one.left, one.amount, one.effect
    noise = max(1.0, min(chi2[h] / max(total - sizes[h], 1) for h in refined))
    score = {h: chi2[h] / noise + sizes[h] * price for h in refined}
    telling = [
        h
        for h in refined
        if (whole - chi2[h]) / noise > thresholds.ratios[sizes[h]] and effects[h] >= thresholds.least_px
    ]
    if not telling:
        return answer(6 if noisy else 0)
    best, *others = sorted(telling, key=lambda h: score[h])
    left = chi2[best]
    freedom = total - sizes[best]
    kind = ("nothing", "camera", "cameras", "marker", "joint", "joints").index(names[best][0])
    if chi2_tail(left, freedom + freedom % 2) < np.exp(thresholds.log_alpha) and not left <= EXPLAINED * whole:
        kind = 6
    if kind == 4 and others and sizes[others[0]] > 1 and names[others[0]][0] != "marker":
        others = []
    rival = others[0] if others and score[others[0]] - score[best] < UNCLEAR else -1
    return answer(kind, best, rival)


def _exponential(G: FloatArray) -> FloatArray:
    """``exp(G)`` (4, 4) by squaring a Taylor series."""
    scaled = G / 2.0**8
    term = total = np.eye(4)
    for n in range(1, 14):
        term = term @ scaled / n
        total = total + term
    for _ in range(8):
        total = total @ total
    return np.asarray(total)


def _angle(D: FloatArray) -> float:
    """Angle [rad] of a displacement, by its trace 2 + 2 cos."""
    return float(2.0 * np.arcsin(np.sqrt(np.clip((4.0 - np.trace(D)) / 4.0, 0.0, 1.0))))
