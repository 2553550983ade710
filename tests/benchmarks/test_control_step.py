"""Speed of the stereo control step, kernels beside the reference: ``pytest tests/benchmarks --benchmark-enable``.

Without that option each runs once and only the results are compared. Figures are medians; times are never asserted.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stereoservo.control.kernels import stereo_step
from stereoservo.control.stereo import stereo_law
from stereoservo.geometry.cameras import project_many
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.kernels import chain_forward, image_jacobian, project_points, transform_points

GAIN, DAMPING = 1.0, 1e-6


def problem() -> dict[str, Any]:
    """Six revolute joints, four markers, two cameras, in a Euclidean frame (any frame costs the same)."""
    rng = np.random.default_rng(0)
    generators = np.zeros((6, 4, 4))
    for G in generators:
        axis, foot = rng.standard_normal(3), rng.uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0))
        x, y, z = axis / np.linalg.norm(axis)
        G[:3, :3] = [(0, -z, y), (z, 0, -x), (-y, x, 0)]
        G[:3, 3] = -G[:3, :3] @ foot
    K = np.array([(800.0, 0, 320), (0, 800, 240), (0, 0, 1)])
    left = K @ np.eye(3, 4)
    right = left + np.column_stack([np.zeros((3, 3)), K @ (-0.2, 0.0, 0.0)])
    markers = np.array(
        [(-0.05, -0.05, 1.2, 1), (0.05, -0.05, 1.2, 1), (0.05, 0.05, 1.22, 1), (-0.05, 0.05, 1.2, 1)]
    )
    Ps = np.array([left, right])
    set_points = project_many(Ps, markers) + rng.uniform(-20, 20, (2, 4, 2))
    return {
        "generators": generators,
        "Ps": Ps,
        "markers": markers,
        "set_points": set_points,
        "q": rng.uniform(-0.1, 0.1, 6),
    }


def with_kernels(p: dict[str, Any]) -> np.ndarray:
    H, operators = chain_forward(p["generators"], np.zeros(6, np.uint8), np.zeros(6), p["q"])
    points = transform_points(H, p["markers"])
    pixels, _ = project_points(p["Ps"], points)
    jacobian = image_jacobian(operators, p["Ps"], points)
    return stereo_step(jacobian, pixels, p["set_points"], np.ones((2, 4)), GAIN, DAMPING)[0]


def with_reference(p: dict[str, Any]) -> np.ndarray:
    chain = ProjectiveChain(("revolute",) * 6, p["generators"], np.zeros(6))
    points = p["markers"] @ chain.displacement(p["q"]).T
    jacobian = chain.image_jacobian(p["Ps"], p["q"], points)
    return stereo_law(
        jacobian, project_many(p["Ps"], points), p["set_points"], np.ones((2, 4)), GAIN, DAMPING
    ).velocity


@pytest.mark.parametrize("step", [with_kernels, with_reference], ids=["kernels", "reference"])
def test_stereo_control_step(benchmark: Any, step: Any) -> None:
    p = problem()
    velocity = benchmark(step, p)
    np.testing.assert_allclose(velocity, with_reference(p), rtol=1e-9, atol=1e-12)
