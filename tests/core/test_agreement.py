"""Agreement of the cameras where a goal ends: its statistics hold as derived, and a creeping camera is told from noise
and from joints.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from scipy.stats import binom

from stereoservo.calibration.change.hypothesis_test import chi2_quantile
from stereoservo.core.sources import progress
from stereoservo.core.sources.progress import (
    AGREED,
    DISPLACED,
    DOUBTFUL,
    FREEDOMS,
    MOST_FRAMES,
    UNDECIDED,
    added_covariance,
    compare_causes,
    decide,
    model_parameters,
    pixel_slopes,
    significant_gain,
)
from stereoservo.geometry.distortion import undistort
from stereoservo.kinematics.covariance import displaced_model, predicted_pixels
from stereoservo.kinematics.kernels import chain_forward, image_jacobian, transform_points
from stereoservo.kinematics.model import CellModel, ModelCovariance
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.random_cells import random_case, random_lens_case

NOISE_PX, MODEL_PX = 0.2, 0.03
FRAMES = 5


def with_covariance(model: CellModel, rng: np.random.Generator, size: float) -> CellModel:
    """The model with a covariance of random directions of its parts, correlated, of about ``size`` of each."""

    def directions(array: FloatArray, count: int) -> FloatArray:
        drawn: FloatArray = rng.standard_normal((count, *array.shape)) * np.abs(array).max()
        return drawn

    distorts = model.cameras[0].lens[0] != 0.0
    lens = np.eye(len(model.cameras[0].lens))[: 1 if distorts else 0]
    parts = (
        tuple(directions(generator, 3) for generator in model.generators),
        tuple(directions(camera.matrix, 4) for camera in model.cameras),
        tuple(lens for _ in model.cameras),
        tuple(directions(point, 3) for point in model.marker_points),
    )
    count = sum(len(basis) for part in parts for basis in part)
    root = size * (np.eye(count) + 0.3 * rng.standard_normal((count, count)) / math.sqrt(count))
    return msgspec.structs.replace(model, covariance=ModelCovariance(*parts, root @ root.T))


def all_sights(model: CellModel) -> tuple[IntArray, IntArray]:
    """Cameras and markers (k,) of all sights, in the order of the cameras."""
    c, m = len(model.cameras), len(model.marker_ids)
    return np.repeat(np.arange(c), m), np.tile(np.arange(m), c)


def slopes_of(model: CellModel, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives (2 k, p) of the innovations of all sights by the model's parameters, and their covariance (p, p)."""
    found = model_parameters(model, tuple(camera.name for camera in model.cameras))
    assert found is not None
    kinds = np.array([kind == "prismatic" for kind in model.joint_kinds], dtype=np.uint8)
    slopes = pixel_slopes(
        (found.directions, found.part, found.index, found.covariance),
        (model.generators, kinds, model.zero, model.tip_first), q, model.marker_points,
        (
            np.array([camera.matrix for camera in model.cameras]),
            np.array([camera.lens for camera in model.cameras]),
        ),
        all_sights(model),
    )  # fmt: skip
    return slopes, found.covariance


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("tip_first", [False, True])
def test_slopes_are_those_of_the_displaced_model(seed: int, tip_first: bool) -> None:
    rng = np.random.default_rng([seed, 40])
    case = random_lens_case(seed)
    model = with_covariance(exact_model(case.cell), rng, 1e-4)
    if tip_first:
        model = msgspec.structs.replace(model, mount="eye_in_hand")
    q = model.zero + 0.3 * rng.uniform(-1.0, 1.0, len(model.zero)) * case.cell.ranges
    slopes, covariance = slopes_of(model, q)
    observed = predicted_pixels(model, q[None])[:, 0]

    def innovations(x: FloatArray) -> FloatArray:
        other = displaced_model(model, x)
        pixels = predicted_pixels(other, q[None])[:, 0]
        found = [
            undistort(camera.lens, raw) - undistort(camera.lens, seen)
            for camera, raw, seen in zip(other.cameras, observed, pixels, strict=True)
        ]
        return np.array(found).reshape(-1)

    for k, deviation in enumerate(np.sqrt(np.diag(covariance))):
        step = np.zeros(len(covariance))
        step[k] = 1e-2 * deviation
        expected = (innovations(step) - innovations(-step)) / (2e-2 * deviation)
        np.testing.assert_allclose(slopes[:, k], expected, atol=2e-5 * np.abs(slopes).max())


def example(seed: int) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Of a random cell: the covariance (2 k, 2 k) of mean innovations, the derivatives of the pixels by a displacement
    (2 k, 6) and by the joints (2 k, n), and where each camera's rows begin.
    """
    rng = np.random.default_rng([seed, 41])
    model = with_covariance(exact_model(random_case(seed).cell), rng, 1e-4)
    slopes, covariance = slopes_of(model, model.zero)
    C = np.zeros((len(slopes), len(slopes)))
    added_covariance(C, slopes, covariance)
    C *= MODEL_PX**2 / np.diag(C).mean()
    C += np.eye(len(slopes)) * (NOISE_PX**2 / FRAMES)
    C = np.tril(C) + np.tril(C, -1).T
    kinds = np.array([kind == "prismatic" for kind in model.joint_kinds], dtype=np.uint8)
    H, operators = chain_forward(model.generators, kinds, model.zero, model.zero, model.tip_first)
    matrices = np.array([camera.matrix for camera in model.cameras])
    points = transform_points(H, model.marker_points)
    to_model = model.projective_to_euclidean
    assert to_model is not None
    twists = np.zeros((6, 4, 4))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        twists[k, k, 3], twists[3 + k, j, i], twists[3 + k, i, j] = 1.0, 1.0, -1.0
    basis = np.linalg.inv(to_model) @ twists @ to_model
    displaced = image_jacobian(np.ascontiguousarray(basis), matrices, points).reshape(len(C), 6)
    jacobian = image_jacobian(operators, matrices, points).reshape(len(C), -1)
    rows = 2 * len(model.marker_ids)
    return C, displaced, jacobian, rows * np.arange(len(matrices) + 1)


def compared(
    d: FloatArray, C: FloatArray, displaced: FloatArray, jacobian: FloatArray, begins: IntArray
) -> tuple[FloatArray, FloatArray]:
    gains, effects = np.zeros(len(begins)), np.zeros(len(begins) - 1)
    assert compare_causes(d, C.copy(), displaced, jacobian, begins, (gains, effects))
    return gains, effects


def test_noise_calls_no_camera_displaced_more_often_than_derived() -> None:
    """Over 20 cells and 100 draws each: gains are chi-square of six freedoms, at 5 % and at 0.5 %."""
    draws, cells = 100, 20
    gains = []
    for seed in range(cells):
        C, displaced, jacobian, begins = example(seed)
        root = np.linalg.cholesky(C)
        rng = np.random.default_rng([seed, 42])
        for _ in range(draws):
            d = root @ rng.standard_normal(len(C))
            gains.append(compared(d, C, displaced, jacobian, begins)[0][:-1])
    alarms = np.array(gains).reshape(-1)
    for tail in (0.05, 0.005):
        low, high = binom.ppf((1e-6, 1.0 - 1e-6), alarms.size, tail)
        assert low <= (alarms > chi2_quantile(tail, FREEDOMS)).sum() <= high, tail
    assert alarms.max() < significant_gain(2)


@pytest.mark.parametrize("seed", range(6))
def test_a_displaced_camera_is_told_and_joints_are_not_blamed_on_it(seed: int) -> None:
    """A camera 0.4 px off is told, as itself or in doubt, once enough frames are averaged; joints that are off leave
    the cameras in agreement.
    """
    C, displaced, jacobian, begins = example(seed)
    root, rng = np.linalg.cholesky(C), np.random.default_rng([seed, 43])
    n, both = jacobian.shape[1], np.ones(2)

    def decided(d: FloatArray) -> tuple[int, list[int]]:
        noisy = d + root @ rng.standard_normal(len(d))
        found = decide(*compared(noisy, C, displaced, jacobian, begins), len(d), n, 0.125, both, may_wait=True)
        if found[0] != DOUBTFUL:
            return found
        more = C - np.eye(len(C)) * NOISE_PX**2 * (1.0 / FRAMES - 1.0 / MOST_FRAMES)
        noisy = d + np.linalg.cholesky(more) @ rng.standard_normal(len(d))
        return decide(*compared(noisy, more, displaced, jacobian, begins), len(d), n, 0.125, both)

    for camera in range(2):
        d = np.zeros(len(C))
        mine = slice(begins[camera], begins[camera + 1])
        columns = displaced[mine] / np.linalg.norm(displaced[mine], axis=0)
        d[mine] = columns @ rng.standard_normal(FREEDOMS)
        d *= 0.4 / math.sqrt(2.0 * (d[mine] ** 2).mean())
        found, cameras = decided(d)
        assert found in (DISPLACED, UNDECIDED)
        assert camera in cameras
        assert found == UNDECIDED or cameras == [camera]
    d = jacobian @ rng.standard_normal(n)
    assert decided(d * (2.0 / math.sqrt(2.0 * (d**2).mean()))) == (AGREED, [])


def test_a_camera_that_the_goal_does_not_use_holds_nothing() -> None:
    gains, effects = np.array([200.0, 0.0, 40.0]), np.array([0.5, 0.0])
    assert decide(gains, effects, 48, 6, 0.125, np.ones(2)) == (DISPLACED, [0])
    assert decide(gains, effects, 48, 6, 0.125, np.array([0.0, 1.0])) == (AGREED, [])
    assert decide(gains, effects, 48, 6, 0.6, np.ones(2)) == (AGREED, [])


def test_what_may_be_noise_waits_for_more_frames() -> None:
    gains, effects = np.array([30.0, 0.0, 4.0]), np.array([0.5, 0.0])
    assert decide(gains, effects, 48, 6, 0.125, np.ones(2), may_wait=True) == (DOUBTFUL, [0])
    assert decide(gains, effects, 48, 6, 0.125, np.ones(2)) == (AGREED, [])
    told = progress._reason(("left",), 0.3, 0.125, 0.25, DOUBTFUL)
    assert (told.code, told.level) == ("CAMERAS_COMPARED", "slow")


def test_what_joints_explain_as_well_is_told_as_not_decided() -> None:
    effects = np.array([0.5, 0.0])
    assert decide(np.array([200.0, 0.0, 198.0]), effects, 48, 6, 0.125, np.ones(2)) == (UNDECIDED, [0])
    assert decide(np.array([200.0, 0.0, 260.0]), effects, 48, 6, 0.125, np.ones(2)) == (AGREED, [])


def test_the_reason_says_what_it_may_be_and_what_to_do() -> None:
    told = progress._reason(("left",), 0.3, 0.125, 0.25, DISPLACED)
    assert (told.code, told.level, told.subject) == ("CAMERAS_DISAGREE", "hold", "left")
    assert (told.value, told.threshold, told.unit) == (0.3, 0.125, "px")
    assert "either" not in told.hint
    assert "calibrate --check" in told.hint
    doubted = progress._reason(("left", "right"), 0.3, 0.125, 0.25, UNDECIDED)
    assert "either camera left or right crept or was moved, or a joint's zero is off" in doubted.hint
