"""Report of a model check as structs: residuals, detected changes, estimates of drifts, and joint zeros that were
reset.
"""

from __future__ import annotations

from typing import Literal

import msgspec

CauseKind = Literal["camera", "cameras", "body", "marker", "joint"]
Status = Literal["holds", "drifting", "recalibrate"]


class FoundCause(msgspec.Struct, frozen=True):
    """A detected change.

    ``ratio``: twice the log of its likelihood ratio, chi-square with ``freedoms`` degrees of freedom if nothing
    changed.
    ``effect_px``: rms change of the pixels.
    ``value``, ``deviation``: drift of a joint's zero [rad or m]; of a camera or body the rotation angle [rad].
    """

    kind: Literal["camera", "cameras", "body", "marker", "joint", "unexplained"]
    subject: str
    ratio: float
    freedoms: int
    effect_px: float
    message: str
    value: float | None = None
    deviation: float | None = None


class Drift(msgspec.Struct, frozen=True):
    """Estimate of one cause alone, significant or not, for the trend: parameters (q,), the upper triangle of their
    information (q (q + 1) / 2,), and the rms change of the pixels that they cause [px].
    """

    kind: CauseKind
    subject: str
    x: tuple[float, ...]
    information: tuple[float, ...]
    effect_px: float


class CheckReport(msgspec.Struct, frozen=True):
    """Result of a model check.

    Residuals rms in expected sigmas: in total, ``sigmas``, and by joint, camera and marker (joint: over the stops at
    which it was away from the base). ``chi2`` is expected to equal ``measurements``; ``explained_chi2``:
    the remainder after the ``causes``. ``limit_px``: tolerated change of the pixels.
    """

    status: Status
    message: str
    model_epoch: int
    stops: int
    measurements: int
    chi2: float
    explained_chi2: float
    sigmas: float
    rms_px: float
    limit_px: float
    per_joint: dict[str, float]
    per_camera: dict[str, float]
    per_marker: dict[str, float]
    causes: tuple[FoundCause, ...]
    drifts: tuple[Drift, ...]
    left_out: int
    created: str = ""
    trend: str = ""


class JointReset(msgspec.Struct, frozen=True):
    """A joint whose zero was reset: its encoder was off by ``drift``, with standard deviation ``deviation``; the
    model's zero before and after [rad or m].
    """

    joint: str
    kind: Literal["revolute", "prismatic"]
    drift: float
    deviation: float
    zero_before: float
    zero_after: float


class ZeroReset(msgspec.Struct, frozen=True):
    """Joint zeros reset in a new model: ``epoch``, from model ``from_epoch``. Residuals of the check rms in expected
    sigmas before and after. ``model``: the new file.
    """

    epoch: int
    from_epoch: int
    joints: tuple[JointReset, ...]
    sigmas_before: float
    sigmas_after: float
    message: str
    model: str = ""
