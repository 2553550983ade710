"""`ServoCore`, the control algorithm of the servo loop: one step maps joint samples, camera observations and requests
to a joint velocity, by seven stages. Deterministic given its state: no clock, no I/O, no random number.

A step is seven stages, each a module of `core`, in this order:

1. `ingest`: stamps are checked before anything is used; the joints and the driver's lifecycle are those of now.
2. `estimate`: a model that waited is taken, frames are compared at their own stamps, then the present is predicted:
   all that follows works on one and the same present.
3. `monitor`: the stop, then requests, then what the monitors find: before a goal is advanced or anything moves, so that
   what must stop the arm stops it in this step, and requests are in force for the monitors (see there).
4. `execute_goals`: plans go on, the next goal begins or is blended into, leases are watched; after the monitors, for
   what they ended makes room for the next goal, and before the motion, so that a goal moves in the step it begins.
5. `move`: the active motion source's velocity.
6. `limit`: the safety stage; nothing changes a command after it.
7. `report`: what became of it all, after the command is fixed: status, reasons, events, priors of the detectors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo.control.law_registry import LAWS
from stereoservo.core.block import steps_of_delay
from stereoservo.core.context import Derived, Ingested, StepContext
from stereoservo.core.cycle import Event, StepInputs, StepOutputs
from stereoservo.core.estimate import estimate, load_limits, workspace
from stereoservo.core.execute_goals import execute_goals
from stereoservo.core.fast_path import fast_path
from stereoservo.core.ingest import (
    features_fresh_s,
    frame_timeout_s,
    ingest,
    longest_gap_s,
    nominal_period_ns,
)
from stereoservo.core.limit import limit, safety_limits
from stereoservo.core.model_arrays import model_arrays
from stereoservo.core.monitor import monitor
from stereoservo.core.move import move
from stereoservo.core.report import report
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState, initial_state

PRIOR_RATE_HZ = 125.0
NOTHING = Ingested(None, (), 0.0, None, (), None, ())


class ServoCore:
    """The servo loop's algorithm. ``state`` is all that it remembers; ``fast``: whether ordinary steps go by
    `core.fast_path`, with the same bits.
    """

    def __init__(self, settings: CoreSettings, state: CoreState | None = None, *, fast: bool = True) -> None:
        self.settings, self.fast = settings, fast
        self.state = initial_state(settings) if state is None else state
        block, past = self.state.block, steps_of_delay(settings.rate_hz)
        if block.numbers.past != past:  # of a state that was written before drives were known to be late
            block.remember_steps(past)
        model = self.state.model
        self._derived = Derived(
            nominal_period_ns=nominal_period_ns(settings),
            longest_gap_s=longest_gap_s(settings),
            frame_timeout_s=frame_timeout_s(settings),
            features_fresh_s=features_fresh_s(settings),
            laws=LAWS.usable(),
            cameras={camera.name: k for k, camera in enumerate(settings.cameras)},
            room=workspace(settings, model),
            prior_every=max(1, round(settings.rate_hz / PRIOR_RATE_HZ)),
            load_limits=load_limits(settings, model),
        )
        if model is not None:
            self._derived.use(model_arrays(model, settings))
        self._limits = safety_limits(settings, self._derived.features_fresh_s)

    def step(self, inputs: StepInputs) -> StepOutputs:
        """One cycle: the seven stages, in their order."""
        events: list[Event] = []
        context = self._context(inputs, events)
        asked = inputs.requests or self.state.planning is not None
        done = fast_path(context, self._limits) if self.fast and not asked else None
        if done is not None:
            motion, limited = done
        else:
            ingest(context)
            context = estimate(context)
            monitor(context)
            execute_goals(context)
            motion = move(context)
            limited = limit(context, motion, self._limits)
        return report(context, motion, limited, events)

    def _context(self, inputs: StepInputs, events: list[Event]) -> StepContext:
        """The context before the first stage: nothing is known yet but the inputs and the state."""
        state = self.state
        state.driver_request = ""

        def emit(kind: str, **fields: Any) -> None:
            state.event_seq += 1
            events.append(Event(state.event_seq, inputs.now_ns, kind, **fields))  # type: ignore[arg-type]

        # Whatever the last period was, a command may change by one step of the next.
        period_ns = min(inputs.period_ns, self._derived.nominal_period_ns)
        return StepContext(
            inputs,
            inputs.now_ns,
            period_ns * 1e-9,
            state,
            self.settings,
            self._derived,
            emit,
            np.empty(state.block.command.size),
            NOTHING,
        )
