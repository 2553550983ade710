"""What is summed up while the arm rests, as a part of the core's state; see `averaging`."""

from __future__ import annotations

import msgspec

from stereoservo.runtime.ports import FloatArray, IntArray


class Sums(msgspec.Struct, eq=False, kw_only=True):
    """Sights of the markers, summed up while the arm rests; see ``averaging``."""

    counts: FloatArray
    """Sights of each marker in each camera, (c, m)."""
    sums: FloatArray
    """(c, m, 2)"""
    first: FloatArray
    """Pixels at the first sight (c, m, 2), against which the scatter is taken."""
    deviation_sums: FloatArray
    """(c, m, 2)"""
    square_sums: FloatArray
    """(c, m)"""
    covariance_sums: FloatArray
    """(c, m, 2, 2)"""
    frames: IntArray
    """Frames taken, by camera."""
