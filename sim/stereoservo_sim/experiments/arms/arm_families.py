"""Random arms of the families of thesis chapter 6, their singular configurations, and their Euclidean reference
solvers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.arms import euclidean_inverse as metric
from stereoservo_sim.experiments.arms import euclidean_search
from stereoservo_sim.experiments.arms.euclidean_inverse import EuclideanAxes
from stereoservo_sim.world.synthetic import SEVEN_ROWS, dh_link

SEARCH = 400
"""Starts of the metric search for each pose of an arm without a closed form."""
PUMA_ROWS = ((0, -90, 0), (0.4318, 0, 0.15), (0.0203, -90, 0), (0, 90, 0.4318), (0, -90, 0), (0, 0, 0.05))
"""The PUMA 560's geometry: rows (a [m], alpha [°], d [m])."""


@dataclass(frozen=True, eq=False)
class SingularPose:
    """Joints (n,) at a singular configuration. ``free``: a joint that the goal leaves free, None where two
    solutions coincide instead. ``point`` (3,) where the goal is that of a single one.
    """

    joints: FloatArray
    free: int | None
    point: FloatArray | None


Judge = Callable[[EuclideanAxes, FloatArray, FloatArray | None, np.random.Generator], FloatArray | None]


@dataclass(frozen=True, eq=False)
class ArmFamily:
    """A family of arms. ``axes`` draws an arm; ``judge`` solves poses (N, 4, 4), or what they do to points (N, 3),
    for an arm: (N, s, n); None of a redundant arm. ``single_point``: whether the goals are those of one point.
    ``singular`` draws a singular pose. ``bounded``: whether goals 5 m away are out of reach.
    """

    axes: Callable[[np.random.Generator], EuclideanAxes]
    judge: Judge
    single_point: bool
    singular: Callable[[EuclideanAxes, np.random.Generator], SingularPose] | None = None
    bounded: bool = True


def unit(rng: np.random.Generator) -> FloatArray:
    """A random direction (3,)."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v), dtype=np.float64)


def _revolute(directions: list[FloatArray], points: list[FloatArray]) -> EuclideanAxes:
    return EuclideanAxes(np.array(directions), np.array(points), np.ones(len(directions), dtype=bool))


def _place(rng: np.random.Generator) -> FloatArray:
    return rng.uniform(-0.4, 0.4, 3)


def _directions(rng: np.random.Generator, count: int, least: float = 0.3) -> FloatArray:
    """Directions (count, 3) with a minimum angle between them."""
    while True:
        directions = np.array([unit(rng) for _ in range(count)])
        if np.linalg.svd(directions, compute_uv=False)[-1] > least:
            return directions


def sliding(count: int) -> Callable[[np.random.Generator], EuclideanAxes]:
    """Arm of prismatic joints in general directions."""
    return lambda rng: EuclideanAxes(
        _directions(rng, count), np.zeros((count, 3)), np.zeros(count, dtype=bool)
    )


def one(rng: np.random.Generator) -> EuclideanAxes:
    return _revolute([unit(rng)], [_place(rng)])


def two(rng: np.random.Generator) -> EuclideanAxes:
    return _revolute(list(_directions(rng, 2)), [_place(rng), _place(rng)])


def parallel_pair(rng: np.random.Generator) -> EuclideanAxes:
    """Arm of two parallel axes, of either sense, 0.2 to 0.5 m apart."""
    w = unit(rng)
    across = np.cross(w, unit(rng))
    across /= np.linalg.norm(across)
    first = _place(rng)
    second = first + rng.uniform(0.2, 0.5) * across + rng.uniform(-0.2, 0.2) * w
    return _revolute([w, w * rng.choice([-1.0, 1.0])], [first, second])


def shoulder_and_elbow(rng: np.random.Generator) -> EuclideanAxes:
    """Arm with the elbow's axes parallel, the first axis at 30° to 150° to the others."""
    while True:
        first, rest = unit(rng), parallel_pair(rng)
        if abs(first @ rest.directions[0]) < 0.87:
            return _revolute([first, *rest.directions], [_place(rng), *rest.points])


def concurrent(rng: np.random.Generator) -> EuclideanAxes:
    """Wrist of three concurrent axes at any angles."""
    return _revolute(list(_directions(rng, 3)), [_place(rng)] * 3)


def square_wrist(rng: np.random.Generator) -> EuclideanAxes:
    """Wrist with axes 1 and 3 normal to axis 2, so that they can coincide; points anywhere on the axes."""
    w1, centre = unit(rng), _place(rng)
    w2 = np.cross(w1, unit(rng))
    w2 /= np.linalg.norm(w2)
    w3 = metric.turned(w2, rng.uniform(-np.pi, np.pi, 1), w1[None])[0]
    return _revolute([w1, w2, w3], [centre + rng.uniform(-0.2, 0.2) * w for w in (w1, w2, w3)])


def joined(first: EuclideanAxes, second: EuclideanAxes) -> EuclideanAxes:
    """Arm with the joints of ``second`` after those of ``first``."""
    return EuclideanAxes(
        np.vstack([first.directions, second.directions]),
        np.vstack([first.points, second.points]),
        np.concatenate([first.revolute, second.revolute]),
    )


def from_rows(rows: tuple[tuple[float, float, float], ...]) -> EuclideanAxes:
    """A revolute arm of Denavit-Hartenberg rows (a [m], alpha [°], d [m])."""
    T, directions, points = np.eye(4), [], []
    for row in rows:
        directions.append(T[:3, 2].copy())
        points.append(T[:3, 3].copy())
        T = T @ dh_link(*row)
    return _revolute(directions, points)


def offset(rng: np.random.Generator) -> EuclideanAxes:
    """Arm with axes 2, 3, 4 parallel, the last three without a common point."""
    a2, a3 = rng.uniform(0.3, 0.5, 2)
    d2, d4, d5 = rng.uniform(0.05, 0.15, 3)
    rows = (
        (0.0, -90.0, 0.3),
        (a2, 0.0, d2),
        (a3, 0.0, 0.0),
        (0.0, -90.0, d4),
        (0.0, 90.0, d5),
        (0.0, 0.0, 0.1),
    )
    return from_rows(rows)


def general(rng: np.random.Generator) -> EuclideanAxes:
    """Arm of six axes without special geometry, half of the angles right: up to 16 solutions."""
    rows = []
    for _ in range(6):
        alpha = rng.choice([-90.0, 90.0]) if rng.random() < 0.5 else rng.uniform(-150.0, 150.0)
        rows.append((rng.uniform(0.0, 0.5), float(alpha), rng.uniform(-0.3, 0.3)))
    return from_rows(tuple(rows))


def _on_axis(axes: EuclideanAxes, j: int, rng: np.random.Generator) -> FloatArray:
    return np.asarray(axes.points[j] + rng.uniform(-0.4, 0.4) * axes.directions[j], dtype=np.float64)


def point_on_first_axis(axes: EuclideanAxes, rng: np.random.Generator) -> SingularPose:
    """Random joints, and the point that they move onto the first axis: that joint is free."""
    q = rng.uniform(-np.pi, np.pi, len(axes.directions))
    outer = axes.part(slice(1, None)).displacements(q[None, 1:])[0]
    return SingularPose(q, 0, (np.linalg.inv(outer) @ np.append(_on_axis(axes, 0, rng), 1.0))[:3])


def stretched(axes: EuclideanAxes, point: FloatArray, upper: int, q: FloatArray, sense: float) -> FloatArray:
    """Configuration ``q`` (n,) with elbow ``upper + 1`` such that ``point`` (3,) is farthest from axis ``upper``,
    or nearest.
    """
    w, c = axes.directions[upper + 1], axes.points[upper + 1]
    between = sense * (c - axes.points[upper])
    q = q.copy()
    q[upper + 1] = metric.angle_between(w, (point - c)[None], between[None])[0]
    return q


def stretched_point(axes: EuclideanAxes, rng: np.random.Generator) -> SingularPose:
    """Configuration of two parallel joints, stretched or folded towards a point: two solutions coincide."""
    point = rng.uniform(-0.5, 0.5, 3)
    n = len(axes.directions)
    q = rng.uniform(-np.pi, np.pi, n)
    return SingularPose(stretched(axes, point, n - 2, q, rng.choice([-1.0, 1.0])), None, point)


def aligned_wrist(axes: EuclideanAxes, rng: np.random.Generator) -> SingularPose:
    """Configuration of a square wrist whose outer axes coincide: its first and last joint rotate against each
    other.
    """
    n = len(axes.directions)
    q = rng.uniform(-np.pi, np.pi, n)
    q[~axes.revolute] *= 0.1
    w1, w2, w3 = axes.directions[n - 3 :]
    q[n - 2] = metric.angle_between(w2, w3[None], rng.choice([-1.0, 1.0]) * w1[None])[0]
    return SingularPose(q, n - 3, None)


def arm_singularity(axes: EuclideanAxes, rng: np.random.Generator) -> SingularPose:
    """Configuration with the elbow stretched, or the wrist aligned, at random."""
    if rng.random() < 0.5:
        return aligned_wrist(axes, rng)
    q = rng.uniform(-np.pi, np.pi, 6)
    q = stretched(axes, metric.crossing(axes, 3, 4), 1, q, 1.0)
    return SingularPose(q, None, None)


def point_singularity(axes: EuclideanAxes, rng: np.random.Generator) -> SingularPose:
    """Singular configuration of an arm: elbow stretched, or the point on the first axis."""
    return (stretched_point if rng.random() < 0.5 else point_on_first_axis)(axes, rng)


def _by_points(solver: Callable[[EuclideanAxes, FloatArray, FloatArray], FloatArray]) -> Judge:
    def judge(
        axes: EuclideanAxes, H: FloatArray, points: FloatArray | None, rng: np.random.Generator
    ) -> FloatArray:
        assert points is not None
        return solver(axes, points, np.einsum("nij,nj->ni", H[:, :3, :3], points) + H[:, :3, 3])

    return judge


def _by_poses(solver: Callable[[EuclideanAxes, FloatArray], FloatArray]) -> Judge:
    return lambda axes, H, points, rng: solver(axes, H)


def _searched(
    axes: EuclideanAxes, H: FloatArray, points: FloatArray | None, rng: np.random.Generator
) -> FloatArray:
    found = [euclidean_search.all_solutions(axes, goal, SEARCH, rng) for goal in H]
    wide = np.full((len(H), max(map(len, found)), len(axes.directions)), np.nan)
    for row, solutions in zip(wide, found, strict=True):
        row[: len(solutions)] = solutions
    return wide


FAMILIES: dict[str, ArmFamily] = {
    "prismatic 1": ArmFamily(sliding(1), _by_points(metric.prismatic), True),
    "prismatic 2": ArmFamily(sliding(2), _by_points(metric.prismatic), True),
    "prismatic 3": ArmFamily(sliding(3), _by_points(metric.prismatic), True, bounded=False),
    "revolute": ArmFamily(one, _by_points(metric.revolute), True, point_on_first_axis),
    "two revolute, general": ArmFamily(two, _by_points(metric.two_revolute), True, point_on_first_axis),
    "two revolute, parallel": ArmFamily(
        parallel_pair, _by_points(metric.two_parallel), True, stretched_point
    ),
    "arm": ArmFamily(shoulder_and_elbow, _by_points(metric.arm), True, point_singularity),
    "wrist, square": ArmFamily(
        square_wrist, _by_poses(lambda axes, H: metric.wrist(axes, H[:, :3, :3])), False, aligned_wrist
    ),
    "wrist, any angles": ArmFamily(
        concurrent, _by_poses(lambda axes, H: metric.wrist(axes, H[:, :3, :3])), False
    ),
    "PUMA": ArmFamily(lambda rng: from_rows(PUMA_ROWS), _by_poses(metric.with_wrist), False, arm_singularity),
    "arm with wrist": ArmFamily(
        lambda rng: joined(shoulder_and_elbow(rng), square_wrist(rng)),
        _by_poses(metric.with_wrist),
        False,
        arm_singularity,
    ),
    "gantry with wrist": ArmFamily(
        lambda rng: joined(sliding(3)(rng), square_wrist(rng)),
        _by_poses(metric.with_wrist),
        False,
        aligned_wrist,
        bounded=False,
    ),
    "offset wrist": ArmFamily(offset, _by_poses(metric.three_parallel), False),
    "six revolute, general": ArmFamily(general, _searched, False),
    "seven revolute": ArmFamily(lambda rng: from_rows(SEVEN_ROWS), lambda axes, H, points, rng: None, False),
}
"""By the name in the table."""
