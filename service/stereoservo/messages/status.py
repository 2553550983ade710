"""Lifecycle, model readiness, model health and refinement of a cell, as the core writes them and clients read them."""

from __future__ import annotations

from enum import StrEnum

import msgspec


class Lifecycle(StrEnum):
    """Lifecycle of the arm's drives. FAULT is latched until an explicit reset."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"
    FAULT = "fault"


class ModelReadiness(StrEnum):
    """State of the model of arm and cameras."""

    NONE = "none"
    CANDIDATE = "candidate"
    VALID = "valid"
    SUSPECT = "suspect"


class CameraHealth(msgspec.Struct, frozen=True):
    """Agreement of one camera's newest frame with the model.

    Chi-square per degree of freedom, rms innovation [px], the ``worst`` marker (-1: none) and its innovation.
    ``place`` of a mobile camera: ``stands``, ``moving``, ``lost``. ``timing``: as text, where the stamps are
    seen to be wrong.
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
    ``joint_zero``, ``unclear``, or ``unknown`` without a model; ``subjects`` names the cameras, the marker or the
    joint; ``size`` in ``unit`` with its standard ``deviation``; ``text``: with what to do. ``masked``: markers that are
    not used. ``reanchoring``: what is being done for cameras that have moved, in a word.
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


class Halt(msgspec.Struct, frozen=True):
    """Who stopped or held the arm, in words ("stopped by ann"), and when [s since 1970]."""

    words: str
    t_wall: float


class RefinementState(msgspec.Struct, frozen=True):
    """How far on-line refinement of the model in use is."""

    poses: int
    """Different rest poses that are collected."""
    due: int | None
    """Number of poses at which a model is estimated next; None: not before the next calibration or start."""
    doing: str = "collecting"
    """``collecting``, ``refining``, or ``waiting``: for the arm to rest without a goal, to use a refined model."""
    refined_from: int = 0
    """Epoch of the calibrated model that the one in use was refined from; 0: it is a calibrated one."""

    @property
    def text(self) -> str:
        """How far it is, and how a refined model is undone, in words."""
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
