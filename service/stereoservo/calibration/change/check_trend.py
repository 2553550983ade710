"""Trends of a model over successive checks: weighted straight lines through the estimates of each change, the most
significant one, and the time when it reaches the limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import msgspec
import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.messages.check_report import CheckReport, Drift
from stereoservo.numerics.arrays import FloatArray

MIN_CHECKS = 3
ALPHA = 0.003
"""Probability that constant estimates are reported to grow, over all changes."""
DAY_S = 86_400.0
FAR_DAYS = 3650.0
"""Horizon beyond which no crossing is reported."""


class DriftTrend(msgspec.Struct, frozen=True):
    """A change that grows from check to check. ``ratio``: chi-square of its slope with ``freedoms``; ``px_a_day`` as
    it shows in the images; ``days``: until it reaches the limit, 0 where it has, None where it is too far away or
    shrinks.
    """

    kind: str
    subject: str
    checks: int
    ratio: float
    freedoms: int
    px_a_day: float
    days: float | None
    message: str


def find_trend(history: Sequence[CheckReport]) -> DriftTrend | None:
    """The most significant trend over the checks of the newest one's model, oldest first.

    Reports without a time, or of other models, do not count. None where nothing grows.
    """
    if not history:
        return None
    same = [check for check in history if check.model_epoch == history[-1].model_epoch and check.created]
    if len(same) < MIN_CHECKS:
        return None
    first = datetime.fromisoformat(same[0].created)
    days = np.array(
        [(datetime.fromisoformat(check.created) - first).total_seconds() / DAY_S for check in same]
    )
    if np.ptp(days) <= 0.0:
        return None
    price = np.log(float(sum(check.measurements for check in same)))
    found: list[tuple[float, DriftTrend]] = []
    subjects = [(drift.kind, drift.subject) for drift in same[-1].drifts]
    for kind, subject in subjects:
        line = [_drift_of(check, kind, subject) for check in same]
        if any(drift is None or len(drift.x) != len(line[-1].x) for drift in line if line[-1] is not None):
            continue
        grown = _fit_line([drift for drift in line if drift is not None], days, same[-1].limit_px)
        if grown is None:
            continue
        score = grown.ratio - grown.freedoms * price
        if score > 0 and chi2_distribution.sf(grown.ratio, grown.freedoms) < ALPHA / len(subjects):
            found.append((score, grown))
    return max(found, key=lambda entry: entry[0])[1] if found else None


def _drift_of(check: CheckReport, kind: str, subject: str) -> Drift | None:
    return next((drift for drift in check.drifts if (drift.kind, drift.subject) == (kind, subject)), None)


def _matrix(drift: Drift) -> FloatArray:
    q = len(drift.x)
    upper = np.zeros((q, q))
    upper[np.triu_indices(q)] = drift.information
    full: FloatArray = upper + upper.T - np.diag(np.diag(upper))
    return full


def _fit_line(line: list[Drift], days: FloatArray, limit_px: float) -> DriftTrend | None:
    """Weighted line ``x = a + b t`` through the estimates, and when it crosses the limit."""
    q = len(line[0].x)
    normal = np.zeros((2 * q, 2 * q))
    right = np.zeros(2 * q)
    for drift, day in zip(line, days, strict=True):
        information, x = _matrix(drift), np.array(drift.x)
        row = np.hstack([np.eye(q), day * np.eye(q)])
        normal += row.T @ information @ row
        right += row.T @ (information @ x)
    covariance = np.linalg.pinv(normal)
    both = covariance @ right
    a, b = both[:q], both[q:]
    ratio = float(b @ np.linalg.pinv(covariance[q:, q:]) @ b)
    last = line[-1]
    information = _matrix(last)
    size = float(np.sqrt(max(np.array(last.x) @ information @ np.array(last.x), 0.0)))
    if size == 0.0:
        return None
    # The information is, but for the model's own uncertainty, the pixels' quadratic form.
    scale = last.effect_px / size
    now = a + b * days[-1]
    aa, ab, bb = (float(u @ information @ v) * scale**2 for u, v in ((now, now), (now, b), (b, b)))
    left = _crossing(aa, ab, bb, limit_px)
    speed = float(np.sqrt(bb))
    what = {"joint": "the zero of joint {}", "camera": "the place of camera {}", "cameras": "the place of the cameras",
            "body": "the place of the marker body"}[last.kind].format(last.subject)  # fmt: skip
    text = f"{what} has changed steadily over {len(line)} checks, by {speed * 30:.3g} px a month"
    if left == 0.0:
        text += f"; it is beyond the limit of {limit_px:g} px"
    elif left is not None:
        text += f"; it will cross the limit of {limit_px:g} px in about {_span(left)}"
    return DriftTrend(last.kind, last.subject, len(line), ratio, q, speed, left, text)


def _crossing(aa: float, ab: float, bb: float, limit: float) -> float | None:
    """First time [days] from now at which ``|now + b t|`` reaches ``limit``."""
    if aa >= limit**2:
        return 0.0
    if bb <= 0.0:
        return None
    days = (-ab + np.sqrt(max(ab * ab - bb * (aa - limit**2), 0.0))) / bb
    return float(days) if 0.0 <= days < FAR_DAYS else None


def _span(days: float) -> str:
    if days < 2.0:
        return f"{days * 24:.0f} hours"
    return f"{days:.0f} days" if days < 60.0 else f"{days / 30:.0f} months"
