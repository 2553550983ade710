"""Control law ``stereo``: image-based servoing on the pixel errors of all cameras, stacked (thesis 8.26 to 8.36). Also
the damped least-squares step in the images, with rate limits, shared by `image`, `points` and `trajectory`.
"""

from __future__ import annotations

import math
from functools import lru_cache
from math import inf
from typing import NamedTuple

import numpy as np

from stereoservo.control.law import (
    DAMPING,
    JacobianChoice,
    Law,
    LawProperties,
    LawStep,
    Options,
    Scene,
    Task,
)
from stereoservo.messages.goals import DEFAULT_LAW
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import Fields, kernel
from stereoservo.numerics.linear import NormalSystem, add_pixel_equations, damped_solve

ILL_CONDITIONED = 1e-5
NO_COMPONENTS = np.zeros(0)
NO_STATUS = np.zeros(0, dtype=np.int64)

DESIRED = int(JacobianChoice.DESIRED)
MEAN = int(JacobianChoice.MEAN)
FIXED_DEPTH = int(JacobianChoice.FIXED_DEPTH)


class View(NamedTuple):
    """``matrices`` (c, 3, 4) and ``camera_centres`` (c, 4) of the cameras; of their markers ``pixels``, ``set_points``
    and the set-points' ``rates`` [px/s], (c, m, 2) each, ``weights`` (c, m) [1/px] and ``required`` (c, m).
    """

    matrices: FloatArray
    camera_centres: FloatArray
    pixels: FloatArray
    set_points: FloatArray
    rates: FloatArray
    weights: FloatArray
    required: FloatArray


class Body(NamedTuple):
    """Marker ``points`` (m, 4) at present, and ``target_points`` (m, 4) at the goal where
    ``target_known`` (m,) is 1.
    """

    points: FloatArray
    target_points: FloatArray
    target_known: FloatArray


class Gains(NamedTuple):
    """Parameters of a law in the images: ``gain`` [1/s] of a velocity as it is held, ``choice`` of the Jacobian
    (`JacobianChoice`), ``damping`` relative to the largest diagonal element of the normal matrix.
    """

    gain: float
    choice: int
    damping: float


@kernel
def velocities_into(operators: FloatArray, M: FloatArray, out: FloatArray) -> None:
    """Write ``Ĥ_j M`` of one point (4,) to (n, 4)."""
    for j in range(operators.shape[0]):
        G = operators[j]
        for i in range(4):
            out[j, i] = G[i, 0] * M[0] + G[i, 1] * M[1] + G[i, 2] * M[2] + G[i, 3] * M[3]


@kernel
def pixel_gradients(matrices: FloatArray, X: FloatArray) -> FloatArray:
    """``J_G P`` (2c, 4) [px]: gradient of the pixels of ``X`` (4,) in cameras (c, 3, 4) (8.8); NaN in a focal plane."""
    cameras = matrices.shape[0]
    A = np.empty((2 * cameras, 4))
    for c in range(cameras):
        P = matrices[c]
        d = P[2, 0] * X[0] + P[2, 1] * X[1] + P[2, 2] * X[2] + P[2, 3] * X[3]
        scale = 1.0 / d if d != 0.0 else math.nan
        for r in range(2):
            pixel = (P[r, 0] * X[0] + P[r, 1] * X[1] + P[r, 2] * X[2] + P[r, 3] * X[3]) * scale
            for i in range(4):
                A[2 * c + r, i] = (P[r, i] - pixel * P[2, i]) * scale
    return A


@kernel
def add_rows(P: FloatArray, M: FloatArray, velocity: FloatArray, share: float, rows: FloatArray) -> None:
    """Add ``share`` times ``J_G P Ĥ_j M`` (8.33) to ``rows`` (2, n), for velocities ``Ĥ_j M`` (n, 4);
    NaN at depth 0.
    """
    d = P[2, 0] * M[0] + P[2, 1] * M[1] + P[2, 2] * M[2] + P[2, 3] * M[3]
    scale = 1.0 / d if d != 0.0 else math.nan
    for r in range(2):
        pixel = (P[r, 0] * M[0] + P[r, 1] * M[1] + P[r, 2] * M[2] + P[r, 3] * M[3]) * scale
        g0 = (P[r, 0] - pixel * P[2, 0]) * scale
        g1 = (P[r, 1] - pixel * P[2, 1]) * scale
        g2 = (P[r, 2] - pixel * P[2, 2]) * scale
        g3 = (P[r, 3] - pixel * P[2, 3]) * scale
        for j in range(rows.shape[1]):
            v = velocity[j]
            rows[r, j] += share * (g0 * v[0] + g1 * v[1] + g2 * v[2] + g3 * v[3])


@kernel
def image_equations_into(
    operators: FloatArray, view: View, body: Body, gain: float, choice: int, equations: NormalSystem
) -> None:
    """Write the normal equations of `image_step`, undamped; of the matrix only the lower triangle."""
    matrices, camera_centres, pixels, set_points, rates, weights, required = view
    points, target_points, target_known = body
    N, b = equations
    n, cameras, markers = operators.shape[0], matrices.shape[0], points.shape[0]
    for i in range(n):
        b[i] = 0.0
        for k in range(n):
            N[i, k] = 0.0
    rows = np.empty((2, n))
    now = np.empty((n, 4))
    then = np.empty((n, 4))
    moved = np.empty(4)
    for p in range(markers):
        seen = False
        for c in range(cameras):
            seen = seen or weights[c, p] * required[c, p] > 0.0
        if not seen:
            continue
        kind = choice if target_known[p] > 0.0 else 0
        if kind in (0, MEAN):
            velocities_into(operators, points[p], now)
        if kind in (DESIRED, MEAN):
            velocities_into(operators, target_points[p], then)
        for c in range(cameras):
            w = weights[c, p] * required[c, p]
            if not w > 0.0:
                continue
            P = matrices[c]
            for j in range(n):
                rows[0, j] = 0.0
                rows[1, j] = 0.0
            if kind == MEAN:
                add_rows(P, points[p], now, 0.5, rows)
                add_rows(P, target_points[p], then, 0.5, rows)
            elif kind == DESIRED:
                add_rows(P, target_points[p], then, 1.0, rows)
            elif kind == FIXED_DEPTH:
                # On the ray of the current point, at the depth of the target: P maps the centre to zero.
                M, T = points[p], target_points[p]
                depth = P[2, 0] * M[0] + P[2, 1] * M[1] + P[2, 2] * M[2] + P[2, 3] * M[3]
                goal_depth = P[2, 0] * T[0] + P[2, 1] * T[1] + P[2, 2] * T[2] + P[2, 3] * T[3]
                for i in range(4):
                    centre = camera_centres[c, i]
                    moved[i] = centre + (goal_depth / depth) * (M[i] - centre)
                velocities_into(operators, moved, now)
                add_rows(P, moved, now, 1.0, rows)
            else:
                add_rows(P, points[p], now, 1.0, rows)
            u = gain * (set_points[c, p, 0] - pixels[c, p, 0]) + rates[c, p, 0]
            v = gain * (set_points[c, p, 1] - pixels[c, p, 1]) + rates[c, p, 1]
            add_pixel_equations(rows, u, v, w * w, N, b)


@kernel
def image_step(operators: FloatArray, view: View, body: Body, gains: Gains) -> tuple[FloatArray, float]:
    """Velocity (n,) that minimises ``Σ w²|J q̇ − gain (s* − s) − ṡ*|²``, damped, and the conditioning; see
    `control.law`.
    """
    gain, choice, damping = gains
    n = operators.shape[0]
    N, b, x = np.empty((n, n)), np.empty(n), np.zeros(n)
    image_equations_into(operators, view, body, gain, choice, NormalSystem(N, b))
    conditioning = damped_solve(N, b, damping, x)
    return x, conditioning


@kernel
def _image_step_into(operators: FloatArray, view: View, body: Body, gains: Gains, velocity: FloatArray) -> float:
    """Write `image_step` to ``velocity`` (n,); returns the conditioning."""
    x, conditioning = image_step(operators, view, body, gains)
    velocity[:] = x
    return conditioning


@kernel
def _image_step(operators: FloatArray, view: Fields, body: Fields, gains: Fields, velocity: FloatArray) -> float:
    """`_image_step_into` for Python, with the fields of a `View`, a `Body` and of `Gains`."""
    return _image_step_into(operators, View(*view), Body(*body), Gains(*gains), velocity)


@kernel
def image_kernel(workspace: Record) -> None:
    """`image_step` for static set-points, as the ``kernel`` of a law."""
    work = workspace[0]
    n, c, m = work.joints, work.cameras, work.markers
    view = View(
        work.matrices[: 12 * c].reshape((c, 3, 4)),
        work.camera_centres[: 4 * c].reshape((c, 4)),
        work.pixels[: 2 * c * m].reshape((c, m, 2)),
        work.set_points[: 2 * c * m].reshape((c, m, 2)),
        work.no_rates[: 2 * c * m].reshape((c, m, 2)),
        work.usable[: c * m].reshape((c, m)),
        work.wanted[: c * m].reshape((c, m)),
    )
    body = Body(work.body[: 4 * m].reshape((m, 4)), work.target_points[: 4 * m].reshape((m, 4)), work.target_known[:m])
    operators = work.operators[: 16 * n].reshape((n, 4, 4))
    gains = Gains(gain_held(work.gain, work.dt_s), work.jacobian_choice, DAMPING)
    work.conditioning = _image_step_into(operators, view, body, gains, work.velocity[:n])


@kernel
def gain_held(gain: float, dt_s: float) -> float:
    """`held_gain` as a kernel."""
    return -math.expm1(-gain * dt_s) / dt_s if dt_s > 0.0 else gain


@kernel
def limit_into(
    operators: FloatArray, centre: FloatArray, rotation_rate: float, translation_rate: float, x: FloatArray
) -> None:
    """Scale a velocity ``x`` (n,) so that the body rotates no faster than ``rotation_rate`` [rad/s] and its centre (4,)
    moves no faster than ``translation_rate`` [lengths of the frame's coordinates a second].
    """
    square, speed = 0.0, 0.0
    twist = np.zeros((4, 4))
    for j in range(x.shape[0]):
        for i in range(4):
            for k in range(4):
                twist[i, k] += x[j] * operators[j, i, k]
    for i in range(4):
        s = 0.0
        for k in range(4):
            square -= 0.5 * twist[i, k] * twist[k, i]
            s += twist[i, k] * centre[k]
        speed += s * s
    factor = 1.0
    turn, speed = math.sqrt(max(0.0, square)), math.sqrt(speed)
    if turn > rotation_rate:
        factor = rotation_rate / turn
    if speed > translation_rate:
        factor = min(factor, translation_rate / speed)
    for j in range(x.shape[0]):
        x[j] *= factor


def held_gain(options: Options) -> float:
    """The gain [1/s] of a velocity held for ``dt_s``, for which an error decays by ``exp(−gain dt_s)``."""
    return float(gain_held(options.gain, options.dt_s))


def image_velocity_step(scene: Scene, task: Task, options: Options, jacobian: int, rates: FloatArray) -> LawStep:
    """The kernel's step for a choice of the Jacobian and a feed-forward (c, m, 2) [px/s]."""
    view = (scene.matrices, scene.camera_centres, scene.pixels, task.set_points, rates, scene.weights, task.wanted)
    body = (scene.points, task.target_points, task.target_known)
    gains = (held_gain(options), int(jacobian), options.damping)
    velocity = np.empty(len(scene.operators))
    conditioning = _image_step(scene.operators, view, body, gains, velocity)
    return limited(scene, task, options, velocity, conditioning)


def limited(scene: Scene, task: Task, options: Options, velocity: FloatArray, conditioning: float) -> LawStep:
    """The step of a law without components, its velocity scaled to the rates of ``options`` (in place)."""
    if options.rotation_rate < inf or options.translation_rate < inf:
        centre = task.centre if task.centre.any() else scene.points.mean(axis=0)
        limit_into(scene.operators, centre, options.rotation_rate, options.translation_rate, velocity)
    return LawStep(velocity, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, conditioning)


def image_reasons(step: LawStep) -> tuple[Reason, ...]:
    """Reasons of a step of a law in the images."""
    if step.conditioning >= ILL_CONDITIONED:
        return ()
    hint = f"the arm is near a singularity, or the markers do not fix its pose: jog away, or use {DEFAULT_LAW}"
    return (Reason("JACOBIAN_ILL_CONDITIONED", "slow", "", step.conditioning, ILL_CONDITIONED, "", hint),)


def stereo(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(s* − s)``, all cameras stacked (8.36); with one camera left it equals the law of one camera."""
    return image_velocity_step(scene, task, options, options.jacobian, standing(task.rates.shape))


@lru_cache(maxsize=8)
def standing(shape: tuple[int, ...]) -> FloatArray:
    """Rates of static set-points (zeros); read-only."""
    return np.zeros(shape)


LAW = Law(
    stereo,
    "image-based, in two cameras or more",
    one_camera="refused",
    options=("jacobian",),
    reasons=image_reasons,
    kernel=image_kernel,
    properties=LawProperties(
        centre="aside",
        face="not kept",
        works_on="pixels of two cameras or more",
        noise_at_rest="low",
        one_camera="use `image`",
        fails_when="large turns leave the image, or rest in a minimum; singular arm",
    ),
    colour="#0072b2",
    rank=10,
)
