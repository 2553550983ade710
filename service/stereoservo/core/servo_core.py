"""`ServoCore`, the control algorithm of the servo loop: one step maps joint samples, camera observations and requests
to a joint velocity. Deterministic given its state: no clock, no I/O, no random number.

A step observes, moves and commands, by kernels on one flat record:

1. `observe`: `ingest` checks stamps before anything is used; `estimate` compares frames at their own stamps, then
   predicts the present; `detect` looks for what must stop the arm; the progress of the active goal is measured.
2. `decide`, only where something is asked, found, or to be looked after: the stop, then requests, then what the
   monitors make of what was found, before a goal is advanced or anything moves; then plans, queued goals and leases.
3. `move`: the active motion source's velocity.
4. `command`: friction, late drives and the safety stage; nothing changes a command after it.
5. `finish_step`: what has ended, ends. Status, reasons and detector priors are made of the step when they are asked
   for.
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
    place_unknown,
    take_frames_apart,
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
from stereoservo.core.monitor import NOISE, QUIET, detect, looks_apart, monitor, monitors_attend
from stereoservo.core.monitors import moving_camera
from stereoservo.core.move import MOTION_SOURCES, arrange_motion, move, paused
from stereoservo.core.report import finish_step, priors_of, status_of
from stereoservo.core.settings import CoreSettings
from stereoservo.core.sources.law import aim_at, by_kernel, follow_goal
from stereoservo.core.state import (
    CalibrationMotion,
    CoreState,
    Holding,
    Leased,
    ServoGoal,
    Source,
    initial_state,
)
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import Prior


def observe(context: StepContext, *, decides: bool) -> int:
    """What the stages have found, as bits of a number (`ingest`, `monitor`); the present, where there is a model.

    The goal's progress is looked at here in steps in which nothing is decided before the motion; where Python
    ``decides``, or anything is found, the goal may be another one then, and its law looks itself.
    """
    derived = context.derived
    room, block = derived.room, context.state.block
    work, record, space = room.numbers, block.record, room.record
    found = ingest(record, space)
    if work.frames_apart:
        take_frames_apart(context)
    if derived.arrays is None:
        note_frames(record, space)
    else:
        estimate(record, space)
        if block.numbers.history_count:
            context.arrays = context.moved_arrays or derived.arrays
            context.prediction, context.weights, context.pixels = room.prediction, room.weights, room.pixels
    found |= detect(record, space)
    context.goes_on = bool(work.aims) and not found and not decides and follow_goal(record, space)
    return found


PRIOR_RATE_HZ = 125.0
LOOK_EVERY_S = 0.2
"""Between two examinations of why a law is slow or stuck."""
BY_KERNELS = (ServoGoal, Holding)
"""Motion sources whose steps do not read the inputs."""
NO_INPUTS = StepInputs(0, 0, None)


class NewestStep:
    """The newest step of a core: what it has come to, of which nothing is made before it is asked for. Its arrays are
    the core's own, and of the next step after that.
    """

    def __init__(self, context: StepContext, limits: SafetyLimits) -> None:
        self._context, self._limits = context, limits

    @property
    def command(self) -> FloatArray | None:
        """Joint velocities (n,) to write; None where nothing may be written."""
        state = self._context.state
        return state.block.command if state.lifecycle is Lifecycle.ACTIVE else None

    @property
    def moves(self) -> bool:
        """Whether the arm moves, or may with the next step."""
        state = self._context.state
        return not isinstance(state.source, Holding) or bool(state.block.command.any())

    @property
    def events(self) -> tuple[Event, ...]:
        """The step's events."""
        return tuple(self._context.events)

    @property
    def driver_request(self) -> str:
        """What the core asks of the joint driver."""
        return self._context.state.driver_request

    @property
    def step(self) -> int:
        """Number of the step."""
        return self._context.state.step

    @property
    def raw(self) -> FloatArray:
        """Velocity (n,) before the safety stage."""
        return self._context.derived.room.raw

    @property
    def values(self) -> FloatArray:
        """As in `core.cycle.StepResult`."""
        return self._context.derived.room.result

    @property
    def priors(self) -> tuple[Prior, ...]:
        """What the detectors are to expect, in steps that send it."""
        return priors_of(self._context)

    @property
    def status(self) -> Status:
        """The status after the step."""
        return status_of(self._context, self._limits)


class ServoCore:
    """The servo loop's algorithm. ``state`` is all that it remembers."""

    def __init__(self, settings: CoreSettings, state: CoreState | None = None) -> None:
        self.settings = settings
        self.state = initial_state(settings) if state is None else state
        block, past = self.state.block, steps_of_delay(settings.rate_hz)
        if block.numbers.past != past:  # of a state that was written before drives were known to be late
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
            room=workspace(settings, model),
            prior_every=max(1, round(settings.rate_hz / PRIOR_RATE_HZ)),
            look_every=max(1, round(settings.rate_hz * LOOK_EVERY_S)),
            load_limits=load_limits(settings, model),
        )
        if model is not None:
            self._derived.use(model_arrays(model, settings))
        self._limits = safety_limits(settings, fresh_s)
        self._put_limits()
        self._context = StepContext(self.state, settings, self._derived, NO_INPUTS)
        self.newest = NewestStep(self._context, self._limits)
        self._arranged: Source | None = None
        """The source for which the workspace is arranged; None: it may be out of date."""
        self._attends = False
        self._lease_until_ns = 0

    def _put_limits(self) -> None:
        """Write the limits of the safety stage and the longest ages of inputs into the workspace."""
        derived, given = self._derived, self._derived.room.arrays
        work, limits = derived.room.numbers, self._limits
        given["limits"][:], given["bounds"][:] = limits.table, limits.bounds
        work.nominal_s, work.longest_gap_s = derived.nominal_period_ns * 1e-9, derived.longest_gap_s
        work.frame_timeout_s = derived.frame_timeout_s

    def step(self, inputs: StepInputs) -> StepOutputs:
        """One cycle, and all that there is to tell of it."""
        self.advance(inputs)
        return self.outputs()

    def outputs(self) -> StepOutputs:
        """All outputs of the newest step."""
        newest = self.newest
        command = None if newest.command is None else newest.command.copy()
        return StepOutputs(command, newest.status, newest.priors, newest.events, newest.driver_request)  # type: ignore[arg-type]

    def advance(self, inputs: StepInputs) -> None:
        """One cycle."""
        context, state = self._context, self.state
        context.begin(inputs)
        state.driver_request = ""
        self._prepare(context)
        put_inputs(context)
        decides = bool(
            self._attends or inputs.requests or inputs.stop or inputs.now_ns > self._lease_until_ns
        )
        if observe(context, decides=decides) or decides:
            self._decide(context)
        if context.ingested is NOTHING and not isinstance(state.source, BY_KERNELS):
            context.ingested = account_inputs(context)
        move(context)
        room = self._derived.room
        command(state.block.record, room.record, self._limits.keep_outs)
        finish_step(context, self._limits)
        if context.output is not None:  # Python has moved the arm, and may have changed what it likes
            self._arranged = None

    def _prepare(self, context: StepContext) -> None:
        """What comes before a step: the driver's lifecycle is followed, and a model that waits is taken."""
        state, inputs, work = context.state, context.inputs, self._derived.room.numbers
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
        """Act on what was asked and found, and advance goals."""
        context.ingested = account_inputs(context)
        if any(context.state.mobile):
            moving_camera.step(context)
        monitor(context)
        execute_goals(context)
        self._arrange(context)
        self._arranged = None  # what is decided may bring something with the next step

    def _arrange(self, context: StepContext) -> None:
        arrange(context)
        self._attends, self._lease_until_ns = attends(context), lease_until_ns(context.state.source)
        self._arranged = context.state.source


FAULTY = (Lifecycle.FAULT, Lifecycle.UNCONFIGURED)
"""In which joints are no measure of cameras."""


def arrange(context: StepContext) -> None:
    """Write what stands into the workspace."""
    state, settings, derived = context.state, context.settings, context.derived
    room, watching, kind = derived.room, state.watching, MOTION_SOURCES[type(state.source)]
    work, given = room.numbers, room.arrays
    work.active, work.faulty = state.lifecycle is Lifecycle.ACTIVE, state.lifecycle in FAULTY
    work.stopped, work.by_images = state.stopped, kind.by_images
    work.learning = isinstance(state.source, CalibrationMotion)
    work.rounds_apart = looks_apart(state)
    work.frames_apart = any(state.mobile) or state.target is not None
    work.quiet = watching.last == QUIET and watching.verdict == NOISE
    work.paused = paused(state)
    if derived.arrays is not None:
        given["masked"][:] = watching.masked
    for c, (rule, stated_ns) in enumerate(offset_rules(state, settings)):
        given["unknown"][c] = place_unknown(c, state, settings)
        given["offset_rule"][c], given["stated_offset_ns"][c] = rule, stated_ns
    inexact = state.model is not None and state.model.joint_accuracy is not None
    given["friction_most"][:], given["friction_travel"][:] = friction_bounds(
        settings.joint_kinds, settings.resolution, inexact
    )
    source = state.source
    work.aims = (
        isinstance(source, ServoGoal)
        and derived.arrays is not None
        and by_kernel(source, derived.laws[source.law])
        and bool(work.active)
        and not work.paused
    )
    if work.aims and isinstance(source, ServoGoal):
        aim_at(room, source)
    arrange_motion(context)


def attends(context: StepContext) -> bool:
    """Whether Python has to look after the state in every step: a monitor asks for it, or a goal that is planned,
    queued, waits, or cannot go on.
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
    """When the lease of the active source runs out; `NEVER_NS` where it has none."""
    if not isinstance(source, Leased) or source.lease_s is None:
        return NEVER_NS
    return source.lease_until_ns
