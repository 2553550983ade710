"""Summaries over repetitions: percentiles, and the interval of a rate."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import norm


def spread(values: npt.ArrayLike) -> dict[str, Any]:
    """Median, 16th and 84th percentile and mean over seeds; null if no seed has a value."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return {"median": None, "p16": None, "p84": None, "mean": None}
    low, middle, high = np.percentile(finite, [16, 50, 84])
    return {"median": float(middle), "p16": float(low), "p84": float(high), "mean": float(finite.mean())}


def wilson(successes: int, cases: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's confidence interval of a share."""
    z = float(norm.isf(0.5 * (1.0 - confidence)))
    share = successes / cases
    middle = (share + z**2 / (2 * cases)) / (1 + z**2 / cases)
    half = z / (1 + z**2 / cases) * float(np.sqrt(share * (1 - share) / cases + z**2 / (4 * cases**2)))
    return max(0.0, middle - half), min(1.0, middle + half)


def count_row(what: str, count: int, of: int) -> dict[str, Any]:
    """A row of counts with its Wilson bounds at 95 %."""
    low, high = wilson(count, of) if of else (0.0, 1.0)
    return {"goals": what, "count": count, "of": of, "wilson_low": low, "wilson_high": high}
