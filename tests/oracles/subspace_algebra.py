"""Join, meet and inclusion of linear subspaces given as multi-columns (thesis 2.5.3)."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.incidences import TOLERANCE, _same_space, basis, dual, relation
from stereoservo.numerics.arrays import FloatArray


def join(*subspaces: FloatArray, tolerance: float = TOLERANCE) -> FloatArray:
    """Smallest subspace that holds all of the multi-columns ``(m_i, N)``: a multi-column ``(K, N)`` (2.62).

    Raises GeometryError where none is given or their N differ.
    """
    _same_space(*subspaces)
    return basis(np.concatenate([basis(points, tolerance) for points in subspaces]), tolerance)


def meet(*subspaces: FloatArray, tolerance: float = TOLERANCE) -> FloatArray:
    """Largest subspace that lies in all of the multi-columns ``(m_i, N)``: a multi-column ``(K, N)``, K = 0 if none.

    The dual of the join of the duals. Raises GeometryError where none is given or their N differ.
    """
    _same_space(*subspaces)
    return dual(np.concatenate([dual(points, tolerance) for points in subspaces]), tolerance)


def included(inner: FloatArray, outer: FloatArray, tolerance: float = TOLERANCE) -> bool:
    """Whether the span of ``inner`` (m, N) lies in that of ``outer`` (m', N): the weak form of (2.77)."""
    return relation(inner, outer, tolerance).position in ("first_in_second", "coincident")
