"""New start values for a metric bundle adjustment in a local minimum (which planar targets cause): joint axes refitted,
each to its own joint's trial from 26 directions, kept where the fit is significantly better.

A plate that rotates nearly in its own plane determines its axis by small perspective effects only, and two axes may
explain it almost alike. With cameras and markers known, each joint's trial is searched over all directions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.generator_initialization import DIRECTIONS, twist_about
from stereoservo.calibration.rig_model import Measurements, RigModel, partial_products
from stereoservo.numerics.arrays import FloatArray

STILL = 2e-3
"""How far other joints may stray [rad or m] at the stops of a joint's own trial."""
GAIN = 8.0
"""Chi-square by which another axis must explain a joint's trial better to be tried in the whole bundle."""


def with_other_axes(solution: Solution) -> list[RigModel]:
    """Metric rigs to start from again: revolute joints get the axes that fit their own trials better, most joints
    first.

    Empty where no joint has a better one.
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
    """Generator (4, 4) that fits a joint's own trial better, with cameras and markers fixed; None where there is
    none.
    """
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
    centroids = [
        _centroid(single, float(end)) for end in (displacement[still].min(), displacement[still].max())
    ]
    best: Solution | None = None
    for direction in DIRECTIONS:
        start = replace(single, generators=twist_about(direction, centroids, span)[None])
        try:
            fit = _solved(start, own)
        except np.linalg.LinAlgError:
            continue  # the axis takes a marker into a focal plane
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
