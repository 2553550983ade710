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
from stereoservo.core.cycle import Event, StepInputs
from stereoservo.core.model_arrays import ModelArrays
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

Motion = tuple[Callable[[Any, "StepContext"], "SourceOutput | None"], str]
"""The step of a motion source, and the id of the goal that it works on, '' where there is none."""
Emit = Callable[..., None]
"""Appends an event to the step's outputs: its kind, and the event's other fields by keyword."""


@dataclass
class Derived:
    """Values that follow from the settings and the model in use: kept from step to step, but no part of the state.

    ``nominal_period_ns``: of the loop. ``longest_gap_s``: time without a step after which the arm is stopped.
    ``frame_timeout_s``: age from which on a frame is refused; ``features_fresh_s``: up to which features are fresh
    enough not to coast. ``prior_every``: steps between priors; ``look_every``: between two
    examinations of why a law is slow or stuck. ``laws``: those
    that are installed, by name. ``cameras``: indices by name. ``room``: for the results of kernels, with the constants
    that they take. ``load_limits``:
    collision thresholds of efforts and following errors, (n,) each; None: collisions are not monitored.
    """

    nominal_period_ns: int
    longest_gap_s: float
    frame_timeout_s: float
    features_fresh_s: float
    prior_every: int
    look_every: int
    laws: Mapping[str, Law]
    cameras: Mapping[str, int]
    room: Workspace
    arrays: ModelArrays | None = None
    load_limits: tuple[FloatArray, FloatArray] | None = None
    health: tuple[tuple[Any, ...], Health] | None = None
    """What the status last said of the model's health, and of what."""
    motion: Motion = (lambda source, context: None, "")
    """Of the active source, as `core.move` arranges it."""
    parameters: tuple[CellModel, Any] | None = None
    """The model whose parameters `core.monitors.agreement` has, and these."""

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


NOTHING = Ingested(None, (), 0.0, None, (), None, ())


class StepContext:
    """A step as Python sees it: its inputs, the state, and views of what kernels have found so far. One object serves
    all steps of a core; what a goal is to keep of a step, it copies. ``ingested``: what of the inputs has passed, in
    steps in which Python looks at them.

    `core.observe` sets ``arrays`` and ``prediction``, ``weights`` (c, m) [1/px] and ideal ``pixels`` (c, m, 2) of
    the markers, which need a model. ``goals_read``: ids of the goals that were looked at in this step: one at most,
    for it is work. ``goes_on``: the active goal's law has a kernel, and the goal has neither ended nor too few
    markers. ``output``: what a motion source in Python has given; None where a kernel has moved the arm, or nothing
    did. ``moved_arrays``: the model with a body that is a target where it is now.
    """

    def __init__(
        self, state: CoreState, settings: CoreSettings, derived: Derived, inputs: StepInputs
    ) -> None:
        self.state, self.settings, self.derived = state, settings, derived
        self.events: list[Event] = []
        self.goals_read: list[str] = []
        self.begin(inputs)

    def begin(self, inputs: StepInputs) -> None:
        """Nothing is known yet of a step but its inputs."""
        self.inputs, self.now_ns = inputs, inputs.now_ns
        # Whatever the last period was, a command may change by one step of the next.
        self.dt_s = min(inputs.period_ns, self.derived.nominal_period_ns) * 1e-9
        self._q: FloatArray | None = None
        self.ingested = NOTHING
        self.arrays: ModelArrays | None = None
        self.moved_arrays: ModelArrays | None = None
        self.prediction: Prediction | None = None
        self.weights: FloatArray | None = None
        self.pixels: FloatArray | None = None
        self.output: SourceOutput | None = None
        self.goes_on = False
        if self.goals_read:
            self.goals_read = []
        if self.events:
            self.events = []

    def emit(self, kind: str, **fields: Any) -> None:
        """Append an event to the step's outputs: its kind, and the event's other fields by keyword."""
        self.state.event_seq += 1
        self.events.append(Event(self.state.event_seq, self.now_ns, kind, **fields))  # type: ignore[arg-type]

    @property
    def q(self) -> FloatArray:
        """The measured joints (n,), of this step alone."""
        if self._q is None:
            self._q = self.derived.room.q.copy()
        return self._q

    @property
    def observations(self) -> tuple[CameraObservation, ...]:
        """The frames that have passed, where Python looks at the step's inputs."""
        return tuple([observation for _, observation in self.ingested.observations])

    @property
    def paused(self) -> bool:
        """Whether the active source has to wait in this step."""
        return bool(self.derived.room.numbers.paused)


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
