"""Corrupted samples, frames, models and time, in virtual time: no command passes a limit by the true joints, the arm
comes to rest, and the core forgets what was wrong.
"""

from __future__ import annotations

import os
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from stereoservo.core.cycle import ModelUpdate, StepInputs, StepOutputs
from stereoservo.messages.goals import Disable, Enable, FeatureTarget, Jog, Reset, Resume
from stereoservo.ports.devices import CameraObservation, JointState

from .conftest import NAMES, make_bench

WATCHDOG_S = 0.1
"""After which the bench's drives rest without a new command."""
ODD = st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e9])
LATE_NS = st.sampled_from([-(10**18), -3_600_000_000_000, -200_000_000, 1, 20_000_000, 3_600_000_000_000, 2**62])


def replaced(struct: Any, **fields: Any) -> Any:
    return msgspec.structs.replace(struct, **fields)


@st.composite
def joint_corruptions(draw: st.DrawFn) -> Any:
    """A function of a joint sample that makes another of it; None: it is lost."""
    kind = draw(st.sampled_from(["value", "velocity", "effort", "length", "jump", "stamp", "number", "none", "type"]))
    j, odd, late = draw(st.integers(0, 5)), draw(ODD), draw(LATE_NS)
    size = draw(st.integers(0, 9).filter(lambda n: n != 6))
    jump = draw(st.sampled_from([0.3, -0.3, 1.0, -6.0, 100.0]))

    def with_value(values: np.ndarray, value: float) -> np.ndarray:
        values = values.copy()
        values[j] = value
        return values

    def corrupt(sample: JointState) -> JointState | None:
        match kind:
            case "value":
                return replaced(sample, positions=with_value(sample.positions, odd))
            case "velocity":
                return replaced(sample, velocities=with_value(sample.velocities, np.nan))
            case "effort":
                return replaced(sample, efforts=with_value(np.zeros(6), np.nan))
            case "length":
                return replaced(sample, positions=np.zeros(size))
            case "jump":
                return replaced(sample, positions=with_value(sample.positions, sample.positions[j] + jump))
            case "stamp":
                return replaced(sample, t_ns=sample.t_ns + late)
            case "number":
                return replaced(sample, seq=2**62)
            case "type":
                return replaced(sample, positions=np.array([["?"]]))
        return None

    corrupt.__name__ = f"{kind} {j} {odd} {late} {size} {jump}"
    return corrupt


@st.composite
def frame_corruptions(draw: st.DrawFn) -> Any:
    """A function of a frame that makes a list of frames of it."""
    kind = draw(
        st.sampled_from(
            ["number", "value", "covariance", "shape", "stamp", "lost", "twice", "swarm", "stranger", "ids"]
        )
    )
    odd, late = draw(ODD), draw(LATE_NS)
    number = draw(st.sampled_from([2**62, 2**31, 0, -5]))

    def corrupt(frame: CameraObservation) -> list[CameraObservation]:
        count = len(frame.ids)
        match kind:
            case "number":
                return [replaced(frame, seq=number)]
            case "value":
                return [replaced(frame, pixels=np.full((count, 2), odd))]
            case "covariance":
                return [replaced(frame, covariances=np.full((count, 2, 2), odd))]
            case "shape":
                return [replaced(frame, pixels=np.zeros((count + 1, 3)))]
            case "stamp":
                return [replaced(frame, t_shutter_ns=frame.t_shutter_ns + late)]
            case "twice":
                return [frame, frame, replaced(frame, seq=frame.seq - 3)]
            case "swarm":
                many = 100_000
                return [
                    replaced(
                        frame,
                        ids=np.arange(many),
                        pixels=np.ones((many, 2)),
                        covariances=np.tile(np.eye(2), (many, 1, 1)),
                    )
                ]
            case "stranger":
                return [replaced(frame, camera="nobody"), frame]
            case "ids":
                return [replaced(frame, ids=frame.ids[::-1] - 2**40)]
        return []

    corrupt.__name__ = f"{kind} {number} {odd} {late}"
    return corrupt


class CorruptedCell(RuleBasedStateMachine):
    """A cell of which any input may be wrong at any time, and a person who tries to work with it."""

    corrupted = 0
    """Inputs, in all runs."""

    @initialize(seed=st.integers(0, 2**16))
    def start(self, seed: int) -> None:
        self.bench = make_bench(seed)
        self.bench.now_ns = 3_600_000_000_000  # a computer that has run for an hour: its clock is never negative
        self.core = self.bench.core
        self.bench.core = self  # type: ignore[assignment]
        self.corrupt_joints = self.corrupt_frames = None
        self.first_after_gap = False
        self.previous = np.zeros(6)
        self.bench.ready()

    # -- between the bench and the core ---------------------------------------------------------------------

    @property
    def state(self) -> Any:
        return self.core.state

    def step(self, inputs: StepInputs) -> StepOutputs:
        """One step of the core with what has become of its inputs."""
        if self.corrupt_joints is not None and inputs.joints is not None:
            inputs = replaced(inputs, joints=self.corrupt_joints(inputs.joints))
            CorruptedCell.corrupted += 1
        if self.corrupt_frames is not None and inputs.observations:
            frames = [made for frame in inputs.observations for made in self.corrupt_frames(frame)]
            inputs = replaced(inputs, observations=tuple(frames))
            CorruptedCell.corrupted += len(frames)
        outputs = self.core.step(inputs)
        self.check(outputs)
        return outputs

    def check(self, outputs: StepOutputs) -> None:
        """The command within all limits, and the true arm within its range."""
        limits = self.bench.settings.limits
        command = np.zeros(6) if outputs.command is None else outputs.command
        assert np.isfinite(command).all()
        assert (np.abs(command) <= limits.velocity_max * (1 + 1e-9)).all()
        step = limits.acceleration_max / self.bench.settings.rate_hz * (1 + 1e-9) + 1e-12
        if outputs.command is not None:
            before = np.zeros(6) if self.first_after_gap else self.previous
            after_fault = not command.any()
            assert after_fault or (np.abs(command - before) <= step).all()
        self.previous, self.first_after_gap = command, False
        q = self.bench.q
        assert (q <= limits.position_max + 1e-9).all()
        assert (q >= limits.position_min - 1e-9).all()

    # -- what goes wrong ------------------------------------------------------------------------------------

    @rule(corruption=joint_corruptions(), steps=st.integers(1, 12))
    def joints_are_corrupted(self, corruption: Any, steps: int) -> None:
        self.corrupt_joints = corruption
        for _ in range(steps):
            self.bench.step()
        self.corrupt_joints = None

    @rule(corruption=frame_corruptions(), steps=st.integers(4, 30))
    def frames_are_corrupted(self, corruption: Any, steps: int) -> None:
        self.corrupt_frames = corruption
        for _ in range(steps):
            self.bench.step()
        self.corrupt_frames = None

    @rule(joints=joint_corruptions(), frames=frame_corruptions())
    def all_is_corrupted_until_the_arm_rests(self, joints: Any, frames: Any) -> None:
        limits, rate_hz = self.bench.settings.limits, self.bench.settings.rate_hz
        self.corrupt_joints, self.corrupt_frames = joints, frames
        ramp_s = float((limits.velocity_max / limits.acceleration_max).max())
        for _ in range(round((limits.joint_timeout_s + ramp_s) * rate_hz) + 3):
            self.bench.step()
        state = self.core.state
        stopped = state.refused_joints.reason is not None or state.stopped
        silent = self.bench.now_ns - state.block.numbers.last_joints_ns > limits.joint_timeout_s * 1e9
        rests = not self.previous.any()
        self.corrupt_joints = self.corrupt_frames = None
        assert rests or not (stopped or silent)

    @rule(gap_s=st.sampled_from([0.005, 0.05, 0.11, 0.6, 10.0, -0.02, -5.0]))
    def time_jumps(self, gap_s: float) -> None:
        self.bench.q = self.bench.q + self.previous * min(max(gap_s, 0.0), WATCHDOG_S)
        self.bench.now_ns += round(gap_s * 1e9)
        self.first_after_gap = gap_s < 0.0 or gap_s + 0.01 > WATCHDOG_S
        self.bench.pending = []
        self.bench.step()

    @rule(kind=st.sampled_from(["nan", "names", "camera", "swapped"]))
    def a_wrong_model_comes(self, kind: str) -> None:
        model = self.bench.truth.model
        if kind == "nan":
            model = replaced(model, marker_points=model.marker_points * np.nan)
        elif kind == "names":
            model = replaced(model, joint_names=tuple(reversed(NAMES)))
        elif kind == "camera":
            model = replaced(model, cameras=model.cameras[:1])
        else:
            first, second = model.cameras
            model = replaced(
                model, cameras=(replaced(first, matrix=second.matrix), replaced(second, matrix=first.matrix))
            )
        self.bench.step(model_update=ModelUpdate(model))

    # -- what a person does ---------------------------------------------------------------------------------

    @rule(j=st.integers(0, 5), speed=st.sampled_from([-1.0, 1.0, 50.0]), seconds=st.sampled_from([0.1, 1.0]))
    def jog(self, j: int, speed: float, seconds: float) -> None:
        self.bench.step(Jog({NAMES[j]: speed}, 1.0))
        self.bench.run(seconds)

    @rule(law=st.sampled_from(["stereo", "image", "cartesian3"]), seed=st.integers(0, 99))
    def goal(self, law: str, seed: int) -> None:
        away = np.random.default_rng(seed).uniform(-0.3, 0.3, 6)
        target = FeatureTarget(self.bench.features(self.bench.q + away))
        self.bench.step(self.bench.goal(target, law=law))
        self.bench.run(0.2)

    @rule()
    def stop(self) -> None:
        self.bench.step(stop=True)

    @rule()
    def recover(self) -> None:
        self.bench.run(0.4)
        for act in (Reset(), Enable(), Resume()):
            self.bench.step(act)
            self.bench.run(0.02)

    @rule()
    def disable(self) -> None:
        self.bench.step(Disable())

    # -- what holds -----------------------------------------------------------------------------------------

    @invariant()
    def nothing_that_is_kept_is_not_finite(self) -> None:
        state = self.core.state
        for values in (state.block.velocities, state.block.command, state.history.positions):
            assert np.isfinite(values).all()
        for estimate in state.cameras:
            assert np.isfinite(estimate.innovation).all()

    def teardown(self) -> None:
        """After everything the cell works again, with its own model."""
        if not hasattr(self, "bench"):
            return
        self.recover()
        self.bench.step(Disable())
        self.bench.run(0.1)
        self.bench.step(model_update=ModelUpdate(self.bench.truth.model))
        self.bench.step(Enable())
        self.bench.run(0.4)
        limits = self.bench.settings.limits
        way = -1.0 if self.bench.q[3] > 0.5 * (limits.position_min[3] + limits.position_max[3]) else 1.0
        self.bench.step(Jog({NAMES[3]: way}, 1.0))
        self.bench.run(0.3)
        reasons = [reason.code for reason in self.bench.log[-1][1].status.reasons]
        assert self.previous[3] * way > 0.5, reasons


@pytest.mark.parametrize(
    ("examples", "inputs"), [(140, 5_000), pytest.param(10_000, 1_000_000, marks=pytest.mark.slow)]
)
def test_no_corruption_of_inputs_moves_the_arm_beyond_its_limits(examples: int, inputs: int) -> None:
    CorruptedCell.corrupted = 0
    run_state_machine_as_test(
        CorruptedCell,
        settings=settings(
            max_examples=int(os.environ.get("STEREOSERVO_EXAMPLES", examples)),
            stateful_step_count=20,
            deadline=None,
            derandomize=examples == 140,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        ),
    )
    assert CorruptedCell.corrupted > inputs
