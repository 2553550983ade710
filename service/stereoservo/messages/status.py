"""Lifecycle, model readiness, model health, status and refinement of a cell, as the core writes them and clients read
them.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Generic, TypeVar

import msgspec

from stereoservo.messages.reasons import Reason

Values = TypeVar("Values")
"""Type of an array: of numpy in the core, of plain numbers if numpy is not loaded."""


class Lifecycle(StrEnum):
    """Lifecycle of the arm's drives. FAULT is latched until an explicit reset."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"
    FAULT = "fault"


class ModelReadiness(StrEnum):
    """State of the model of arm and cameras. UNCONFIRMED: kept from an earlier run; no frames have confirmed it yet."""

    NONE = "none"
    UNCONFIRMED = "unconfirmed"
    CANDIDATE = "candidate"
    VALID = "valid"
    SUSPECT = "suspect"


class CameraHealth(msgspec.Struct, frozen=True):
    """Agreement of one camera's newest frame with the model.

    Chi-square per degree of freedom, rms innovation [px], the ``worst`` marker (-1: none) and its innovation.
    ``place`` of a mobile camera: ``stands``, ``moving``, ``lost``. ``timing``: as text, if the stamps are found to be
    wrong.
    """

    chi2: float = 0.0
    rms_px: float = 0.0
    worst: int = -1
    worst_px: float = 0.0
    place: str = ""
    timing: str = ""


class Health(msgspec.Struct, frozen=True):
    """Health of the model, by the model monitor.

    ``verdict``: ``ok``, ``camera_moved``, ``cameras_moved_together``, ``cameras_or_arm``, ``marker_slipped``,
    ``joint_zero``, ``unclear``, or ``unknown`` without a model.
    ``subjects``: names the cameras, the marker or the joint.
    ``size``: in ``unit`` with its standard ``deviation``.
    ``text``: description with a remedy.
    ``masked``: markers that are not used.
    ``reanchoring``: phase of the relocalization of moved cameras, in a word.
    """

    verdict: str = "unknown"
    subjects: tuple[str, ...] = ()
    size: float = 0.0
    deviation: float = 0.0
    unit: str = ""
    text: str = ""
    cameras: dict[str, CameraHealth] = {}
    masked: tuple[int, ...] = ()
    reanchoring: str = ""


class StatusHeader(msgspec.Struct, frozen=True):
    """Activity of the core and its reasons, as every process and every client reads it, after ``step`` at ``t_ns``
    (monotonic).
    """

    t_ns: int
    step: int
    lifecycle: str
    model: str
    model_epoch: int
    source: str
    goal: str
    law: str
    level: str
    reasons: tuple[Reason, ...]


class CoreStatus(StatusHeader, Generic[Values], frozen=True, eq=False):
    """The state of the core after a step; arrays are of the joints (n,)."""

    positions: Values
    velocities: Values
    command_raw: Values
    """Velocity before the safety stage."""
    command: Values
    error_px: float | None
    task_error: Values
    """Errors of the law's components, `control.law.Law.components`; empty if it has none."""
    innovation_px: dict[str, float]
    visible: dict[str, int]
    progress: float | None = None
    """Completed fraction [0, 1] of the goal's path."""
    seconds_left: float | None = None
    efforts: Values | None = None
    """As the driver reports them."""
    following_errors: Values | None = None
    effort_limits: Values | None = None
    """Largest permitted deviation of an effort from its moving mean, infinite if unknown; None: collisions are not
    monitored.
    """
    following_limits: Values | None = None
    """The same for following errors, from zero."""
    health: Health = Health()


class Halt(msgspec.Struct, frozen=True):
    """Who stopped or held the arm, as text ("stopped by ann"), and when [s since 1970]."""

    words: str
    t_wall: float


class RefinementState(msgspec.Struct, frozen=True):
    """Progress of the on-line refinement of the model in use."""

    poses: int
    """Number of different rest poses collected."""
    due: int | None
    """Number of poses at which a model is estimated next; None: not before the next calibration or start."""
    doing: str = "collecting"
    """``collecting``, ``refining``, or ``waiting``: for the arm to rest without a goal, to use a refined model."""
    refined_from: int = 0
    """Epoch of the calibrated model that the one in use was refined from; 0: the model in use is a calibrated one."""

    @property
    def text(self) -> str:
        """Progress, and how a refined model is undone, as text."""
        words = f"{self.poses} rest poses"
        if self.doing == "refining":
            words += ", a model is being estimated from them"
        elif self.doing == "waiting":
            words += ", a refined model is used as soon as the arm rests without a goal"
        elif self.due is not None:
            words += f", a model is estimated from {self.due} on"
        else:
            words += ", no model is estimated before the next calibration or start"
        if self.refined_from:
            words += (
                f"; the model in use is refined from epoch {self.refined_from} "
                "(`calibrate CELL --undo-refinement` brings that back)"
            )
        return words
