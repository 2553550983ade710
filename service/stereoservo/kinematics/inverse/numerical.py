"""Chains without a closed form: every solution that descents from many starts find."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.inverse.descent import descended, linearised
from stereoservo.kinematics.inverse.solutions import InverseKinematicsError, distinct, nearest_turns

BATCH = 64
FEWEST = 256
MOST = 4096
"""Starts of a search: in batches, at least, at most."""
HITS = 4
"""Starts that have to come to each solution before a search ends: what was found once may have unseen company."""
TWINS = np.array([0.05, 0.2, 0.6])
"""Steps [rad] from a solution along its weakest direction, where the other one of a close pair lies."""
CLOSE = 1e-5
"""Largest difference of joints [rad or m] of two descents that came to one solution."""


def even_starts(chain: ProjectiveChain, limits: FloatArray | None, count: int, skip: int = 0) -> FloatArray:
    """Starts (count, n) spread evenly over the joints: a whole turn, or limits (n, 2) for prismatic ones.

    An additive recurrence, by powers of the root of ``x^(n+1) = x + 1``. Raises InverseKinematicsError, ``limits``,
    where a prismatic joint has none.
    """
    n = chain.joints
    ranges = np.array([[z - np.pi, z + np.pi] for z in chain.zero])
    slides = [j for j, kind in enumerate(chain.kinds) if kind == "prismatic"]
    if slides and (limits is None or not np.isfinite(limits[slides]).all()):
        raise InverseKinematicsError(
            "limits",
            f"prismatic joints {slides} need finite limits: a chain without a closed form is searched",
            joints=slides,
        )
    if limits is not None:
        ranges[slides] = limits[slides]
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (n + 1))
    steps = root ** -np.arange(1.0, n + 1)
    unit = np.mod(0.5 + np.arange(skip + 1, skip + count + 1)[:, None] * steps, 1.0)
    return np.asarray(ranges[:, 0] + unit * (ranges[:, 1] - ranges[:, 0]), dtype=np.float64)


def all_solutions(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    *,
    limits: FloatArray | None,
    tolerance: float,
    seed: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Isolated solutions (s, n) of ``H(q)M = M*`` with residuals (s,), and the best approach (n,) there was.

    The search ends when every solution has been come to from ``HITS`` starts; a pair that is close to merging is
    looked for from its one half. That all are found is likely, not certain.
    """
    known = _Known(chain, tolerance)
    best, least = seed, np.inf
    tried = 0
    while tried < MOST:
        starts = even_starts(chain, limits, BATCH, tried)
        if tried == 0:
            starts[0] = seed
        ends, left = descended(chain, points, targets, starts)
        tried += BATCH
        if left.min() < least:
            best, least = ends[int(np.argmin(left))], float(left.min())
        for i in known.add(ends, left, 1):
            twins = _twins(chain, points, known.joints[i])
            known.add(*descended(chain, points, targets, twins, damping=1e-6), 0)
        if tried >= FEWEST and min(known.hits, default=HITS) >= HITS:
            break
    return np.array(known.joints).reshape(-1, chain.joints), np.array(known.residuals), best


class _Known:
    """Solutions so far, and how many starts came to each."""

    def __init__(self, chain: ProjectiveChain, tolerance: float) -> None:
        self.kinds, self.tolerance = chain.kinds, tolerance
        self.joints: list[FloatArray] = []
        self.residuals: list[float] = []
        self.hits: list[int] = []

    def add(self, ends: FloatArray, left: FloatArray, count: int) -> list[int]:
        """Take in those of ``ends`` (s, n) that solve the problem, each worth ``count`` hits; which are new."""
        fresh = []
        solved = left <= self.tolerance
        ends, left = ends[solved], left[solved]
        while len(ends):
            # All descents that came to where the best of those left did; a pair of solutions is farther apart.
            best = int(np.argmin(left))
            here = self._near(ends, ends[best])
            known = self._near(np.array(self.joints).reshape(-1, ends.shape[1]), ends[best])
            if known.any():
                i = int(np.argmax(known))
                self.hits[i] += count * int(here.sum())
                if left[best] < self.residuals[i]:
                    self.joints[i], self.residuals[i] = ends[best], float(left[best])
            else:
                fresh.append(len(self.joints))
                self.joints.append(ends[best])
                self.residuals.append(float(left[best]))
                self.hits.append(count * int(here.sum()))
            ends, left = ends[~here], left[~here]
        return fresh

    def _near(self, rows: FloatArray, q: FloatArray) -> npt.NDArray[np.bool_]:
        apart = nearest_turns(self.kinds, rows - q, np.zeros(len(q)))
        return np.asarray(np.abs(apart).max(axis=1, initial=0.0) <= CLOSE, dtype=bool)


def _twins(chain: ProjectiveChain, points: FloatArray, q: FloatArray) -> FloatArray:
    weakest = np.linalg.svd(linearised(chain, points, q)[1])[2][-1]
    steps = np.concatenate([TWINS, -TWINS])
    return np.asarray(q + steps[:, None] * weakest, dtype=np.float64)


def one_solution(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    *,
    limits: FloatArray | None,
    tolerance: float,
    seed: FloatArray,
    count: int = BATCH,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solutions of a goal that leaves joints free, from the ``seed`` (n,) first and from ``count`` other starts.

    As `all_solutions`: (s, n), residuals (s,), best approach (n,); none of them twice.
    """
    starts = np.concatenate([seed[None], even_starts(chain, limits, count - 1)])
    ends, left = descended(chain, points, targets, starts)
    best = ends[int(np.argmin(left))]
    solved = left <= tolerance
    kept = distinct(chain.kinds, ends[solved], CLOSE)
    return ends[solved][kept], left[solved][kept], best
