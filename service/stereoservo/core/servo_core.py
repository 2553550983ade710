"""`ServoCore`, the control algorithm of the servo loop: one step maps joint samples, camera observations and requests
to a joint velocity. It is deterministic given its state: no clock, no I/O, no random numbers.

A step has five parts. Observation, motion and command run in kernels on one flat record:

1. `observe`: `ingest` checks time stamps before an input is used. `estimate` compares each frame with the prediction at
   the frame's own stamp, then predicts the current markers. `detect` checks for conditions that must stop the arm. Then
   the progress of the active goal is measured.
2. `decide` (Python; only if there are requests, detections, or state that needs attention): the stop is handled first,
   then requests, then the monitors' findings, before a goal is advanced or anything moves; then plans, queued goals and
   leases.
3. `move`: computes the velocity of the active motion source.
4. `command`: friction compensation, look-ahead for late drives, and the safety stage. Nothing changes a command after
   it.
5. `finish_step`: ends motions that have finished. Status, reasons and detector priors are built only when they are
   requested.
"""

from __future__ import annotations

import sys

from stereoservo.control.law_registry import LAWS
from stereoservo.core.block import steps_of_delay
from stereoservo.core.command import SafetyLimits, command, friction_bounds, safety_limits
from stereoservo.core.context import NOTHING, Derived, StepContext
from stereoservo.core.cycle import Event, Status, StepInputs, StepOutputs
from stereoservo.core.estimate import (
    estimate,
    load_limits,
    note_frames,
    offset_rules,
    pose_unknown,
    take_frames_in_python,
    take_model,
    workspace,
)
from stereoservo.core.execute_goals import execute_goals
from stereoservo.core.ingest import (
    account_inputs,
    features_fresh_s,
    follow_driver,
    frame_timeout_s,
    ingest,
    longest_gap_s,
    nominal_period_ns,
    put_inputs,
)
from stereoservo.core.model_arrays import model_arrays
from stereoservo.core.monitor import NOISE, QUIET, detect, monitor, monitors_attend, rounds_in_python
from stereoservo.core.monitors import moving_camera
from stereoservo.core.move import MOTION_SOURCES, arrange_motion, move, paused
from stereoservo.core.report import finish_step, priors_of, status_of
from stereoservo.core.settings import CoreSettings
from stereoservo.core.sources.law import by_kernel, follow_goal, set_goal
from stereoservo.core.state import (
    CoreState,
    Holding,
    Leased,
    ServoGoal,
    Source,
    TrialMotion,
    initial_state,
)
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import Prior


def observe(context: StepContext, *, decides: bool) -> int:
    """Observe the inputs of a step; returns the detections of `ingest` and `detect` as a bit mask. If there is a model,
    the context holds the current prediction afterwards.

    The goal's progress is measured here only in steps in which nothing is decided before the motion. If Python
    ``decides`` or anything was detected, the active goal may change, so its law measures the progress itself.
    """
    derived = context.derived
    workspace, block = derived.workspace, context.state.block
    work, record, space = workspace.numbers, block.record, workspace.record
    found = ingest(record, space)
    if work.frames_as_stops:
        take_frames_in_python(context)
    if derived.arrays is None:
        note_frames(record, space)
    else:
        estimate(record, space)
        if block.numbers.history_count:
            context.arrays = context.moved_arrays or derived.arrays
            context.prediction, context.weights = workspace.prediction, workspace.weights
            context.pixels = workspace.pixels
    found |= detect(record, space)
    context.stays_active = bool(work.has_goal) and not found and not decides and follow_goal(record, space)
    return found


PRIOR_RATE_HZ = 125.0
CHECK_EVERY_S = 0.2
"""Interval between two examinations of why a law is slow or stuck [s]."""
BY_KERNELS = (ServoGoal, Holding)
"""Motion sources whose steps do not read the inputs."""
NO_INPUTS = StepInputs(0, 0, None)


class NewestStep:
    """The results of a core's newest step. Outputs are built only when they are requested. The arrays belong to the
    core and are overwritten by the next step.
    """

    def __init__(self, context: StepContext, limits: SafetyLimits) -> None:
        self._context, self._limits = context, limits

    @property
    def command(self) -> FloatArray | None:
        """Joint velocities (n,) to write; None if nothing may be written."""
        state = self._context.state
        return state.block.command if state.lifecycle is Lifecycle.ACTIVE else None

    @property
    def moves(self) -> bool:
        """Whether the arm moves, or may move in the next step."""
        state = self._context.state
        return not isinstance(state.source, Holding) or bool(state.block.command.any())

    @property
    def events(self) -> tuple[Event, ...]:
        """The step's events."""
        return tuple(self._context.events)

    @property
    def driver_request(self) -> str:
        """The core's request to the joint driver."""
        return self._context.state.driver_request

    @property
    def step(self) -> int:
        """Number of the step."""
        return self._context.state.step

    @property
    def raw(self) -> FloatArray:
        """Velocity (n,) before the safety stage."""
        return self._context.derived.workspace.raw

    @property
    def values(self) -> FloatArray:
        """As in `core.cycle.StepResult`."""
        return self._context.derived.workspace.result

    @property
    def priors(self) -> tuple[Prior, ...]:
        """The detectors' priors, in steps that send them."""
        return priors_of(self._context)

    @property
    def status(self) -> Status:
        """The status after the step."""
        return status_of(self._context, self._limits)


class ServoCore:
    """The servo loop's algorithm. ``state`` is its complete memory."""

    def __init__(self, settings: CoreSettings, state: CoreState | None = None) -> None:
        self.settings = settings
        self.state = initial_state(settings) if state is None else state
        block, past = self.state.block, steps_of_delay(settings.rate_hz)
        if block.numbers.past != past:  # state written before delays were recorded
            block.remember_steps(past)
        model = self.state.model
        fresh_s = features_fresh_s(settings)
        self._derived = Derived(
            nominal_period_ns=nominal_period_ns(settings),
            longest_gap_s=longest_gap_s(settings),
            frame_timeout_s=frame_timeout_s(settings),
            features_fresh_s=fresh_s,
            laws=LAWS.usable(),
            cameras={camera.name: k for k, camera in enumerate(settings.cameras)},
            workspace=workspace(settings, model),
            prior_every=max(1, round(settings.rate_hz / PRIOR_RATE_HZ)),
            check_every=max(1, round(settings.rate_hz * CHECK_EVERY_S)),
            load_limits=load_limits(settings, model),
        )
        if model is not None:
            self._derived.use(model_arrays(model, settings))
        self._limits = safety_limits(settings, fresh_s)
        self._put_limits()
        self._context = StepContext(self.state, settings, self._derived, NO_INPUTS)
        self.newest = NewestStep(self._context, self._limits)
        self._arranged: Source | None = None
        """The source for which the workspace is arranged; None: the workspace may be out of date."""
        self._attends = False
        self._lease_until_ns = 0

    def _put_limits(self) -> None:
        """Write the limits of the safety stage and the longest ages of inputs into the workspace."""
        derived, given = self._derived, self._derived.workspace.arrays
        work, limits = derived.workspace.numbers, self._limits
        given["limits"][:], given["bounds"][:] = limits.table, limits.bounds
        work.nominal_s, work.longest_gap_s = derived.nominal_period_ns * 1e-9, derived.longest_gap_s
        work.frame_timeout_s = derived.frame_timeout_s

    def step(self, inputs: StepInputs) -> StepOutputs:
        """Run one cycle and return all of its outputs."""
        self.advance(inputs)
        return self.outputs()

    def outputs(self) -> StepOutputs:
        """All outputs of the newest step."""
        newest = self.newest
        command = None if newest.command is None else newest.command.copy()
        return StepOutputs(command, newest.status, newest.priors, newest.events, newest.driver_request)  # type: ignore[arg-type]

    def advance(self, inputs: StepInputs) -> None:
        """Run one cycle."""
        context, state = self._context, self.state
        context.begin(inputs)
        state.driver_request = ""
        self._prepare(context)
        put_inputs(context)
        decides = bool(self._attends or inputs.requests or inputs.stop or inputs.now_ns > self._lease_until_ns)
        if observe(context, decides=decides) or decides:
            self._decide(context)
        if context.ingested is NOTHING and not isinstance(state.source, BY_KERNELS):
            context.ingested = account_inputs(context)
        move(context)
        workspace = self._derived.workspace
        command(state.block.record, workspace.record, self._limits.keep_outs)
        finish_step(context, self._limits)
        if context.output is not None:  # Python has moved the arm, and may have changed any state
            self._arranged = None

    def _prepare(self, context: StepContext) -> None:
        """Prepare a step: update the driver's lifecycle, and put a pending model in use."""
        state, inputs, work = context.state, context.inputs, self._derived.workspace.numbers
        if state.source is not self._arranged:
            self._arrange(context)
        work.active_before = work.active
        lifecycle = Lifecycle.ACTIVE if inputs.driver_active else Lifecycle.INACTIVE
        follows = state.lifecycle is lifecycle and inputs.driver_configured and inputs.driver_fault is None
        if not follows:
            follow_driver(context)
        takes = inputs.model_update is not None or state.pending_model is not None
        if takes:
            take_model(context)
        if takes or not follows:
            self._arrange(context)

    def _decide(self, context: StepContext) -> None:
        """Handle requests and detections, and advance goals."""
        context.ingested = account_inputs(context)
        if any(context.state.mobile):
            moving_camera.step(context)
        monitor(context)
        execute_goals(context)
        self._arrange(context)
        self._arranged = None  # a decision may change the state for the next step

    def _arrange(self, context: StepContext) -> None:
        arrange(context)
        self._attends, self._lease_until_ns = attends(context), lease_until_ns(context.state.source)
        self._arranged = context.state.source


FAULTY = (Lifecycle.FAULT, Lifecycle.UNCONFIGURED)
"""Lifecycles in which joint readings must not be used to judge the cameras."""


def arrange(context: StepContext) -> None:
    """Write the state that holds until the next decision into the workspace."""
    state, settings, derived = context.state, context.settings, context.derived
    workspace, watching, kind = derived.workspace, state.watching, MOTION_SOURCES[type(state.source)]
    work, given = workspace.numbers, workspace.arrays
    work.active, work.faulty = state.lifecycle is Lifecycle.ACTIVE, state.lifecycle in FAULTY
    work.stopped, work.by_images = state.stopped, kind.by_images
    work.learning = isinstance(state.source, TrialMotion)
    work.rounds_in_python = rounds_in_python(state)
    work.frames_as_stops = any(state.mobile) or state.target is not None
    work.quiet = watching.last == QUIET and watching.verdict == NOISE
    work.paused = paused(state)
    if derived.arrays is not None:
        given["masked"][:] = watching.masked
    for c, (rule, stated_ns) in enumerate(offset_rules(state, settings)):
        given["unknown"][c] = pose_unknown(c, state, settings)
        given["offset_rule"][c], given["stated_offset_ns"][c] = rule, stated_ns
    inexact = state.model is not None and state.model.joint_accuracy is not None
    given["friction_most"][:], given["friction_travel"][:] = friction_bounds(
        settings.joint_kinds, settings.resolution, inexact
    )
    source = state.source
    work.has_goal = (
        isinstance(source, ServoGoal)
        and derived.arrays is not None
        and by_kernel(source, derived.laws[source.law])
        and bool(work.active)
        and not work.paused
    )
    if work.has_goal and isinstance(source, ServoGoal):
        set_goal(workspace, source)
    arrange_motion(context)


def attends(context: StepContext) -> bool:
    """Whether Python has to examine the state in every step: a monitor requires it, or a goal is being planned, queued,
    waiting, or unable to continue.
    """
    state, source = context.state, context.state.source
    return (
        monitors_attend(state)
        or any(state.mobile)
        or bool(state.queue or state.waiting or state.queued_until_ns)
        or state.planning is not None
        or state.ahead is not None
        or MOTION_SOURCES[type(source)].waits(source, context)
        or (state.lifecycle is not Lifecycle.ACTIVE and not isinstance(source, Holding))
    )


NEVER_NS = sys.maxsize


def lease_until_ns(source: Source) -> int:
    """Time at which the lease of the active source expires [ns]; `NEVER_NS` if it has none."""
    if not isinstance(source, Leased) or source.lease_s is None:
        return NEVER_NS
    return source.lease_until_ns
