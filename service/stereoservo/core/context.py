"""Data types that the stages of one core step share: accepted inputs, robot and camera state, monitors' findings,
velocity output, refused requests.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.control.law import Law
from stereoservo.core.camera_state import CameraEstimate
from stereoservo.core.cycle import StepInputs
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitor_state import ModelDiagnosis
from stereoservo.core.prediction import Prediction
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState
from stereoservo.core.workspace import Workspace
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import PlanReport
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Health
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation, JointState

Emit = Callable[..., None]
"""Appends an event to the step's outputs: its kind, and the event's other fields by keyword."""


@dataclass
class Derived:
    """Values that follow from the settings and the model in use: kept from step to step, but no part of the state.

    ``nominal_period_ns``: of the loop. ``longest_gap_s``: time without a step after which the arm is stopped.
    ``frame_timeout_s``: age from which on a frame is refused; ``features_fresh_s``: up to which features are fresh
    enough not to coast. ``prior_every``: steps between priors. ``laws``: those
    that are installed, by name. ``cameras``: indices by name. ``room``: for the results of kernels, with the constants
    that they take. ``load_limits``:
    collision thresholds of efforts and following errors, (n,) each; None: collisions are not monitored.
    """

    nominal_period_ns: int
    longest_gap_s: float
    frame_timeout_s: float
    features_fresh_s: float
    prior_every: int
    laws: Mapping[str, Law]
    cameras: Mapping[str, int]
    room: Workspace
    arrays: ModelArrays | None = None
    load_limits: tuple[FloatArray, FloatArray] | None = None
    health: tuple[tuple[Any, ...], Health] | None = None
    """What the status last said of the model's health, and of what."""
    seen: tuple[list[CameraEstimate], dict[str, float], dict[str, int]] | None = None
    """What the status last said of each camera, by name: of which estimates, their innovation, the markers visible."""
    friction_bounds: tuple[CellModel | None, FloatArray, FloatArray] | None = None
    """Largest compensation and least travel of the joints (n,), as of `core.move`, and the model by which they are."""
    monitors: tuple[tuple[Any, ...], bool] | None = None
    """`core.monitor.MONITORS` as they last were, and whether `core.fast_path` knows them all."""
    parameters: tuple[CellModel, Any] | None = None
    """The model whose parameters `core.monitors.agreement` has, and these."""
    model_health: tuple[tuple[object, ...], bytes, tuple[ModelDiagnosis, Health]] | None = None
    """The diagnosis and the health that the status last showed: of what, and with which markers left out."""

    def use(self, arrays: ModelArrays) -> None:
        """Work with a model from here on."""
        self.arrays = arrays
        self.room.use(arrays)


class Ingested(msgspec.Struct, frozen=True, eq=False):
    """What passed the gate in one step, and why the rest did not.

    ``joints``: the sample, if it is new. ``observations``: new ones, each with the index of its camera. ``elapsed_s``:
    since the last step. ``refused_joints`` and ``refused_frames`` (index of the camera, reason): of refused samples;
    ``gap``: of a loop that stood still for too long. ``stops``: those of these reasons that stop the arm.
    """

    joints: JointState | None
    observations: tuple[tuple[int, CameraObservation], ...]
    elapsed_s: float
    refused_joints: Reason | None
    refused_frames: tuple[tuple[int, Reason], ...]
    gap: Reason | None
    stops: tuple[Reason, ...]


class StepContext(msgspec.Struct, eq=False):
    """One step as its stages and the motion sources see it.

    `ingest` sets ``ingested`` and the measured joints ``q`` (n,); `estimate` the rest, of which ``prediction``,
    ``weights`` (c, m) [1/px] and ideal ``pixels`` (c, m, 2) need a model. `move` sets ``paused``: the active source had
    to wait, and ``outermost`` (n,): where joints are, or with late drives will be, farthest towards where they go.
    `core.fast_path` has ``looked`` at the step, which was ``plain``: nothing stands that is to be told in every step.
    ``features_ns``: shutter time of the newest frame with accepted markers, 0 before the first.
    ``goals_read``: ids of the goals that were looked at in this step: one at most, for it is work.
    """

    inputs: StepInputs
    now_ns: int
    dt_s: float
    state: CoreState
    settings: CoreSettings
    derived: Derived
    emit: Emit
    q: FloatArray
    ingested: Ingested
    observations: tuple[CameraObservation, ...] = ()
    arrays: ModelArrays | None = None
    prediction: Prediction | None = None
    weights: FloatArray | None = None
    pixels: FloatArray | None = None
    paused: bool = False
    looked: bool = False
    plain: bool = False
    outermost: FloatArray | None = None
    features_ns: int = 0
    goals_read: list[str] = []


class Finding(msgspec.Struct, frozen=True):
    """What a monitor has found, as the stage `monitor` acts on it.

    ``stop``: the arm brakes and holds, every goal ends; ``fault``: likewise, and the drives go off until a reset;
    ``abort``: the active goal ends. ``ended``: message of the goals that end; ``message``: of the event of the stop or
    fault. ``latched``: whether ``reason`` is shown until the cell is resumed.
    """

    effect: Literal["stop", "fault", "abort"]
    reason: Reason
    ended: str
    message: str = ""
    latched: bool = True


class SourceOutput(msgspec.Struct, frozen=True, eq=False):
    """The output of a motion source: joint velocity (n,), whether it may not go on without features, whether it has
    finished, and whether because its goal is ``reached``.
    """

    velocity: FloatArray
    needs_features: bool = False
    speed_scale: float = 1.0
    finished: bool = False
    reached: bool = False
    error_px: float | None = None
    task_error: FloatArray = msgspec.field(default_factory=partial(np.zeros, 0))
    reasons: tuple[Reason, ...] = ()


class RefusalError(Exception):
    """A request is refused: the reason, ``further`` ones, and of a goal without a path the ``plan`` that was tried."""

    def __init__(
        self,
        code: str,
        hint: str,
        *,
        subject: str = "",
        value: float | None = None,
        threshold: float | None = None,
        unit: str = "",
        further: tuple[Reason, ...] = (),
        plan: PlanReport | None = None,
    ) -> None:
        super().__init__(hint)
        self.reason = Reason(code, "info", subject, value, threshold, unit, hint)
        self.reasons = (self.reason, *further)
        self.plan = plan


COMPILING = (
    "first start of this version on this computer: control laws, path planner and the watch over the model are still "
    "being compiled, which takes a minute or two. Calibration, jog, home and joint goals work already; a model waits, "
    "and goals in the images, teaching and checks are refused: ask again when this reason has gone from the status"
)
"""What is not ready, and what is."""


def no_model(context: StepContext, hint: str) -> RefusalError:
    """The refusal of what needs a model, where none is in use; ``hint``: how to get one."""
    if context.inputs.compiling:
        return RefusalError("COMPILING", COMPILING)
    return RefusalError("NO_MODEL", hint)
