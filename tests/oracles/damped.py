"""Damped least squares and null directions: the readable reference of `numerics.linear`."""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import FloatArray


def null_direction_reference(A: FloatArray) -> tuple[FloatArray, float, float, float]:
    """Unit ``x`` (n,) of least ``|A x|``, ``A`` (r, n), and smallest, second-smallest and largest singular
    value.
    """
    n = A.shape[1]
    _, values, rows = np.linalg.svd(A, full_matrices=True)
    padded = np.zeros(n)
    padded[: values.size] = values
    return rows[n - 1].copy(), float(padded[n - 1]), float(padded[max(n - 2, 0)]), float(padded[0])
