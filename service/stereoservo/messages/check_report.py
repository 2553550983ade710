"""Reports of jobs on a model as structs: of a check (residuals, detected changes, estimates of drifts), of joint zeros
that were reset, of a refinement and of a relocalization.
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


class RefinementReport(msgspec.Struct, frozen=True):
    """Result of a refinement of model ``base_epoch`` by ``poses`` (their number).

    ``before_px``, ``after_px``: rms distance, per coordinate, of the pixels from the prediction of the model in use,
    and of one refined by the other poses. ``score``: improvement in standard deviations; ``limit``: required score.
    ``step_chi2``: chi-square of the step from the calibrated model, below ``step_limit``. ``predicted_before_px``,
    ``predicted_after_px``: rms deviation, per coordinate, of predicted pixels at the poses by the model's covariance.
    """

    base_epoch: int
    poses: int
    before_px: float
    after_px: float
    score: float
    limit: float
    step_chi2: float
    step_limit: float
    predicted_before_px: float
    predicted_after_px: float

    @property
    def message(self) -> str:
        """The result as text."""
        return (
            f"refined from epoch {self.base_epoch} by {self.poses} rest poses: at poses held out, predictions are "
            f"{self.after_px:.3g} px rms off instead of {self.before_px:.3g} "
            f"({self.score:.1f} deviations of chance, {self.limit:.1f} needed); by covariance the deviation of a "
            f"predicted pixel falls from {self.predicted_before_px:.2g} to {self.predicted_after_px:.2g} px; "
            f"chi-square of the step {self.step_chi2:.0f} of {self.step_limit:.0f} allowed"
        )


class RelocalizationReport(msgspec.Struct, frozen=True):
    """Result of a relocalization. ``cameras``: names and descriptions of the motions; ``predicted_px``: largest
    standard deviation of a predicted pixel over the range of the joints.
    """

    epoch: int
    model: str
    cameras: dict[str, str]
    chi2: float
    degrees_of_freedom: int
    predicted_px: float
    notes: tuple[str, ...] = ()

    @property
    def message(self) -> str:
        """The result as text."""
        described = "; ".join([*self.cameras.values(), *self.notes])
        return f"model epoch {self.epoch}: {described}; predictions are good to {self.predicted_px:.2g} px"
