"""Fault trials of the core's inputs in virtual time: joint samples, camera frames and the clock, each wrong in one
respect from one moment on, while the arm moves to a goal by joints or by images in lockstep.

The time to rest is measured on the arm's true joints. ``bound_ms`` is the time limit for detection plus the ramp from
full speed; afterwards the cause is removed, an operator acts, and the arm must reach a goal again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from stereoservo.core.cycle import ModelUpdate, StepInputs, StepOutputs
from stereoservo.daemon.lockstep import LockstepCell, LockstepTimeoutError
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Enable, FeatureTarget, Goal, JointTarget, LawName, Reset, Resume, RunGoal
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation, JointState
from stereoservo_sim.benchmarks.soak import MOVING, fake_cell
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.demonstration.lockstep_operator import TERMINAL, LockstepOperator
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.experiments.lockstep_cells import lockstep
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import demo_cell

CELL_SEED = 5
LAWS: tuple[LawName, ...] = ("stereo", "image", "cartesian3")
FAST = 0.15
"""Speed of some joint at which the fault is injected [rad/s]."""
WATCHED_S = 2.0
OF_MOTION = {"ACCELERATION_LIMITED", "BRAKING", "NEAR_SINGULAR"}
"""Reasons that describe the arm's motion, not a fault."""
UPTIME_NS = 7_200_000_000_000
"""Uptime of the machine at the start of a trial, so that a clock that is set back does not become negative."""
REACHES_S = 30.0

Past = list[Any]
"""Samples of one input, oldest first: joint samples or frames."""


@dataclass(frozen=True)
class Draw:
    """Random choices of one trial's fault: a joint or marker, a share of a range, a sign."""

    which: int
    share: float
    sign: float

    def between(self, low: float, high: float) -> float:
        """A number in the range, uniform."""
        return low + self.share * (high - low)

    def time_ns(self, low_s: float, high_s: float) -> int:
        """A time in the range, log-uniform."""
        return round(1e9 * low_s * (high_s / low_s) ** self.share)


Alter = Callable[[Past, int, Draw], Any]
"""Returns the replacement of the newest sample from all up to it, the number since the fault (from 1), and the draw."""


class Input:
    """One input of the core: passes its samples on, altered from a moment on."""

    def __init__(self) -> None:
        self._past: Past = []
        self._since = 0
        self._alter: Alter | None = None
        self._draw = Draw(0, 0.0, 1.0)

    def fail(self, alter: Alter, draw: Draw) -> None:
        """Alter samples from now on."""
        self._alter, self._draw, self._since = alter, draw, 0

    def mend(self) -> None:
        """Pass samples on unchanged."""
        self._alter = None

    def passed(self, sample: Any) -> Any:
        """The sample passed to the service in place of ``sample``."""
        self._past.append(sample)
        self._since += 1
        return sample if self._alter is None else self._alter(self._past, self._since, self._draw)


class Inputs:
    """The inputs of a cell in lockstep, between its drivers and its loops."""

    def __init__(self, cell: LockstepCell) -> None:
        self.joints: Input = Input()
        self.cameras: list[Input] = [Input() for _ in cell.cameras]
        self.clock_ns = 0
        """Error of the core's time."""
        self.stamps_ns = 0
        """Error of the stamps of all inputs of the core."""
        read, advance = cell.joints.read_state, cell.core.advance
        cell.joints.read_state = lambda: self.joints.passed(read())  # type: ignore[method-assign]
        for camera, one in zip(cell.cameras, self.cameras, strict=True):
            camera.poll = _polled(camera.poll, one)  # type: ignore[method-assign,arg-type]
        cell.core.advance = lambda inputs: advance(self._shifted(inputs))  # type: ignore[method-assign]

    def _shifted(self, inputs: StepInputs) -> StepInputs:
        joints, d = inputs.joints, UPTIME_NS + self.stamps_ns
        return msgspec.structs.replace(
            inputs,
            now_ns=inputs.now_ns + UPTIME_NS + self.clock_ns,
            joints=None if joints is None else _restamped(joints, d),
            observations=tuple(_restamped(observation, d) for observation in inputs.observations),
        )

    def mend(self) -> None:
        """Correct all inputs; a clock common to all keeps its offset."""
        self.joints.mend()
        for camera in self.cameras:
            camera.mend()
        self.clock_ns = self.stamps_ns


def _polled(poll: Callable[[], list[CameraObservation]], camera: Input) -> Callable[[], list[CameraObservation]]:
    return lambda: [camera.passed(observation) for observation in poll()]


def _restamped(sample: Any, d_ns: int) -> Any:
    """The sample with its stamps ``d_ns`` later."""
    if isinstance(sample, JointState):
        return msgspec.structs.replace(sample, t_ns=sample.t_ns + d_ns)
    return msgspec.structs.replace(
        sample, t_shutter_ns=sample.t_shutter_ns + d_ns, t_received_ns=sample.t_received_ns + d_ns
    )


# -- faults of samples of either kind ---------------------------------------------------------------------------


def _frozen(past: Past, since: int, draw: Draw) -> Any:
    return past[-1 - since]


def _late(low: int, high: int) -> Alter:
    """Samples delayed by a random number from ``low`` to ``high``."""
    return lambda past, since, draw: past[-1 - round(draw.between(low, high))]


def _twice(past: Past, since: int, draw: Draw) -> Any:
    return past[-1 - since % 2]


def _reordered(past: Past, since: int, draw: Draw) -> Any:
    """Order 1, 3, 2, 4, 6, 5, …"""
    return past[-1 - (0, 2, 1)[since % 3]]


def _ahead(past: Past, since: int, draw: Draw) -> Any:
    return _restamped(past[-1], draw.time_ns(0.05, 3600.0))


def _behind(past: Past, since: int, draw: Draw) -> Any:
    return _restamped(past[-1], -draw.time_ns(1.0, 3600.0))


# -- joint samples --------------------------------------------------------------------------------------------


def _stuck(past: Past, since: int, draw: Draw) -> JointState:
    held = past[-1 - since]
    return msgspec.structs.replace(past[-1], positions=held.positions, velocities=np.zeros_like(held.velocities))


def _far(past: Past, since: int, draw: Draw) -> JointState:
    return _moved(past[-1], draw, draw.time_ns(0.01, 1e6))


def _jumped(past: Past, since: int, draw: Draw) -> JointState:
    return _moved(past[-1], draw, draw.between(0.1, 3.0))


def _moved(sample: JointState, draw: Draw, by: float) -> JointState:
    positions = sample.positions.copy()
    positions[draw.which % len(positions)] += draw.sign * by
    return msgspec.structs.replace(sample, positions=positions)


def _no_number(past: Past, since: int, draw: Draw) -> JointState:
    names = ("positions", "velocities", "efforts", "following_errors")
    name = names[draw.which // 7 % len(names)]
    values = getattr(past[-1], name).copy()
    values[draw.which % len(values)] = np.nan if draw.sign > 0 else np.inf
    return msgspec.structs.replace(past[-1], **{name: values})


def _wrong_length(past: Past, since: int, draw: Draw) -> JointState:
    positions = np.resize(past[-1].positions, (0, 1, 5, 7)[draw.which % 4])
    return msgspec.structs.replace(past[-1], positions=positions)


# -- camera frames --------------------------------------------------------------------------------------------


def _still_picture(past: Past, since: int, draw: Draw) -> CameraObservation:
    held = past[-1 - since]
    return msgspec.structs.replace(past[-1], ids=held.ids, pixels=held.pixels, covariances=held.covariances)


def _far_pixels(past: Past, since: int, draw: Draw) -> CameraObservation:
    pixels = past[-1].pixels.copy()
    pixels[draw.which % len(pixels)] += draw.sign * draw.time_ns(1e-5, 1.0)
    return msgspec.structs.replace(past[-1], pixels=pixels)


def _no_pixels(past: Past, since: int, draw: Draw) -> CameraObservation:
    name = "pixels" if draw.share < 0.5 else "covariances"
    values = getattr(past[-1], name).copy()
    values[draw.which % len(values)] = np.nan if draw.sign > 0 else np.inf
    return msgspec.structs.replace(past[-1], **{name: values})


def _pushed(past: Past, since: int, draw: Draw) -> CameraObservation:
    shift = draw.between(20.0, 60.0) * np.array([draw.sign, 1.0])
    return msgspec.structs.replace(past[-1], pixels=past[-1].pixels + shift)


def _fewer_pixels(past: Past, since: int, draw: Draw) -> CameraObservation:
    return msgspec.structs.replace(past[-1], pixels=past[-1].pixels[1:])


# -- the clock ------------------------------------------------------------------------------------------------


def _core_clock(sign: float) -> Callable[[Inputs, Draw], None]:
    """Error of the core's time alone."""

    def step(inputs: Inputs, draw: Draw) -> None:
        inputs.clock_ns = round(sign * draw.time_ns(0.2, 3600.0))

    return step


def _whole_clock(sign: float) -> Callable[[Inputs, Draw], None]:
    """Error of the time that the core, the drives and the cameras have in common."""

    def step(inputs: Inputs, draw: Draw) -> None:
        inputs.clock_ns = inputs.stamps_ns = round(sign * draw.time_ns(0.2, 3600.0))

    return step


def _joints(alter: Alter) -> Callable[[Inputs, Draw], None]:
    return lambda inputs, draw: inputs.joints.fail(alter, draw)


def _cameras(alter: Alter, *, both: bool = True) -> Callable[[Inputs, Draw], None]:
    def inject(inputs: Inputs, draw: Draw) -> None:
        for camera in inputs.cameras if both else inputs.cameras[draw.which % 2 :][:1]:
            camera.fail(alter, draw)

    return inject


RAMP_MS = 262.0
"""From full speed to rest at the cell's acceleration limit, plus three cycles."""
AT_ONCE_MS = 8.0
JOINT_TIMEOUT_MS = 100.0
COAST_MS = 550.0
"""The cell's ``coast_s``, plus a frame and its latency."""
FOLLOWING_MS = 300.0


@dataclass(frozen=True)
class InputFault:
    """A fault of an input while the arm moves to a goal by ``joints``, by ``images``, or by either, as the trial draws.

    ``notice_ms``: time limit until the arm must be braking; None if it continues and reaches the goal.
    """

    input: str
    name: str
    inject: Callable[[Inputs, Draw], None]
    notice_ms: float | None
    goal: str = "either"


def _camera_faults() -> tuple[InputFault, ...]:
    """Faults of cameras; they affect a goal by images, and not one by joints."""
    faults = (
        ("frozen: no new frame", _cameras(_frozen), COAST_MS),
        ("picture frozen, stamps go on", _cameras(_still_picture), COAST_MS),
        ("a frame or two late", _cameras(_late(1, 2)), None),
        ("a second late", _cameras(_late(25, 35)), COAST_MS),
        ("duplicated", _cameras(_twice), None),
        ("reordered", _cameras(_reordered), None),
        ("pixels out of range", _cameras(_far_pixels, both=False), AT_ONCE_MS),
        ("not a number", _cameras(_no_pixels, both=False), AT_ONCE_MS),
        ("from the future", _cameras(_ahead, both=False), AT_ONCE_MS),
        ("from the past", _cameras(_behind), COAST_MS),
        ("jumped by 20 to 60 px", _cameras(_pushed, both=False), None),
        ("wrong length", _cameras(_fewer_pixels), COAST_MS),
    )
    return tuple(
        InputFault("frames", name, inject, notice_ms if goal == "images" else None, goal)
        for name, inject, notice_ms in faults
        for goal in ("images", "joints")
    )


FAULTS = (
    InputFault("joints", "frozen: no new sample", _joints(_frozen), JOINT_TIMEOUT_MS),
    InputFault("joints", "positions frozen, stamps go on", _joints(_stuck), FOLLOWING_MS),
    InputFault("joints", "up to 40 ms late", _joints(_late(1, 10)), None),
    InputFault("joints", "0.12 to 0.3 s late", _joints(_late(30, 75)), JOINT_TIMEOUT_MS),
    InputFault("joints", "duplicated", _joints(_twice), None),
    InputFault("joints", "reordered", _joints(_reordered), None),
    InputFault("joints", "position out of range", _joints(_far), AT_ONCE_MS),
    InputFault("joints", "not a number", _joints(_no_number), AT_ONCE_MS),
    InputFault("joints", "from the future", _joints(_ahead), AT_ONCE_MS),
    InputFault("joints", "from the past", _joints(_behind), JOINT_TIMEOUT_MS),
    InputFault("joints", "jumped by 0.1 to 3 rad", _joints(_jumped), AT_ONCE_MS),
    InputFault("joints", "wrong length", _joints(_wrong_length), AT_ONCE_MS),
    *_camera_faults(),
    InputFault("clock", "the core's goes back", _core_clock(-1.0), AT_ONCE_MS),
    InputFault("clock", "the core's jumps on", _core_clock(1.0), AT_ONCE_MS),
    InputFault("clock", "everyone's goes back", _whole_clock(-1.0), AT_ONCE_MS),
    InputFault("clock", "everyone's jumps on", _whole_clock(1.0), AT_ONCE_MS),
)


def run_inputs(
    repetitions: int, seed: int, tell: Callable[[dict[str, Any]], None], faults: tuple[InputFault, ...] = FAULTS
) -> list[dict[str, Any]]:
    """Rows of all faults, ``repetitions`` trials each, reproducible for one seed; ``tell`` is called with each.

    Raises ExperimentError if a trial cannot begin.
    """
    rows = []
    model = exact_simulated_model(demo_cell(), CELL_SEED)
    for fault in faults:
        draws = [np.random.default_rng((seed, FAULTS.index(fault), k)) for k in range(repetitions)]
        rows.append(_row(fault, [_Trial(model, fault, rng).run() for rng in draws]))
        tell(rows[-1])
    return rows


def _row(fault: InputFault, trials: list[dict[str, Any]]) -> dict[str, Any]:
    rests = [trial["rest_ms"] for trial in trials if trial["rest_ms"] is not None]
    bound = None if fault.notice_ms is None else fault.notice_ms + RAMP_MS
    return {
        "input": fault.input,
        "fault": fault.name,
        "goal": fault.goal,
        "bound_ms": bound,
        "rest_ms": summary(rests) if rests else None,
        "within": sum(_is_within(trial, bound) for trial in trials),
        "after": sorted({trial["after"] for trial in trials}),
        "reasons": sorted({code for trial in trials for code in trial["reasons"]}),
        "outcomes": sorted({trial["outcome"] for trial in trials}),
        "terminal_events": sorted({trial["terminal"] for trial in trials}),
        "works_again": sum(trial["works_again"] for trial in trials),
        "fastest_of_limit": max(trial["fastest"] for trial in trials),
        "trials": len(trials),
    }


def _is_within(trial: dict[str, Any], bound_ms: float | None) -> bool:
    """Whether the arm rested in time, or, without a bound, continued and reached the goal."""
    if bound_ms is None:
        return bool(trial["outcome"] == "goal_reached")
    return trial["rest_ms"] is not None and trial["rest_ms"] <= bound_ms


class _Trial:
    """One fault on a new cell."""

    def __init__(self, model: CellModel, fault: InputFault, rng: np.random.Generator) -> None:
        self.model, self.fault, self.rng = model, fault, rng
        self.truth = TrueJointHistory.in_memory(len(demo_cell().base), 1 << 14)
        self.reasons: set[str] = set()

    def run(self) -> dict[str, Any]:
        """The result of the trial."""
        with lockstep(fake_cell(), int(self.rng.integers(1 << 31)), self.truth) as (cell, _):
            self.cell, self.inputs = cell, Inputs(cell)
            self.operator = LockstepOperator(cell)
            cell.run_for(0.5)
            self.operator.enable()
            cell.update_model(ModelUpdate(self.model))
            cell.run_for(0.3)
            goal = self._goal()
            if not (reply := cell.submit(RunGoal(goal))).accepted:
                raise ExperimentError("input_fault", f"{self.fault.name}: a goal was refused: {reply.message}")
            self._await_motion()
            cell.on_step = self._note
            start, t0_ns = self.truth.count, cell.clock.now_ns()
            self.fault.inject(self.inputs, self._draw())
            cell.run_for(WATCHED_S)
            rest_ms = self._rest_ms(start, t0_ns)
            if self.fault.notice_ms is None:
                rest_ms = None
                self._await_end(goal)
            assert cell.status is not None
            after = str(cell.status.lifecycle)
            ends = [e.kind for e in cell.events if e.id == goal.id and e.kind in TERMINAL]
            works_again = self._works_again()
        return {
            "rest_ms": rest_ms,
            "after": after,
            "reasons": self.reasons,
            "outcome": ends[0] if ends else "waits",
            "terminal": len([e for e in cell.events if e.id == goal.id and e.kind in TERMINAL]),
            "works_again": works_again,
            "fastest": self._fastest(start),
        }

    def _goal(self) -> Goal:
        """A goal near the base at which all markers are in both images."""
        q = self._posture()
        while not (seen := _as_seen(q)):
            q = self._posture()
        by_joints = self.fault.goal == "joints" or (self.fault.goal == "either" and self.rng.random() < 0.5)
        identity = f"{int(self.rng.integers(1 << 62)):016x}"
        if by_joints:
            joints = dict(zip(self.cell.settings.joint_names, q.tolist(), strict=True))
            return Goal(identity, JointTarget(joints))
        law = LAWS[int(self.rng.integers(len(LAWS)))]
        return Goal(identity, FeatureTarget(seen), law=law, time_limit_s=REACHES_S)

    def _posture(self) -> FloatArray:
        base = demo_cell().base
        return base + np.sign(self.rng.standard_normal(len(base))) * 0.2

    def _draw(self) -> Draw:
        return Draw(int(self.rng.integers(1 << 16)), float(self.rng.random()), float(self.rng.choice((-1.0, 1.0))))

    def _note(self, _inputs: StepInputs, outputs: StepOutputs) -> None:
        self.reasons |= {reason.code for reason in outputs.status.reasons} - OF_MOTION

    def _await_motion(self) -> None:
        """Run until the arm is fast, and for a random time longer."""
        for _ in range(500):
            self.cell.step()
            newest = self.truth.newest()
            if newest is not None and np.abs(newest[2]).max() > FAST:
                self.cell.run_for(float(self.rng.uniform(0.0, 0.1)))
                return
        raise ExperimentError("input_fault", f"{self.fault.name}: the arm did not move")

    def _await_end(self, goal: Goal) -> None:
        try:
            self.cell.wait_for(lambda e: e.id == goal.id and e.kind in TERMINAL, REACHES_S)
        except LockstepTimeoutError:
            return  # the row reports that it has no end

    def _rest_ms(self, start: int, t0_ns: int) -> float | None:
        """Time from the fault to the last motion; None if the arm keeps moving."""
        moving = [t for t, v in self._speeds(start) if v > MOVING]
        last_ns = max(moving, default=t0_ns)
        return None if last_ns - t0_ns > (WATCHED_S - 0.1) * 1e9 else max(last_ns - t0_ns, 0) * 1e-6

    def _fastest(self, start: int) -> float:
        """Largest true speed of any joint since the fault, as a share of its limit."""
        return max(v for _, v in self._speeds(start))

    def _speeds(self, start: int) -> list[tuple[int, float]]:
        """Time [ns] and the largest true speed, as a share of its joint's limit, of each sample since."""
        limit = self.cell.settings.limits.velocity_max
        samples = (self.truth.sample(index) for index in range(start, self.truth.count))
        return [(s[0], float((np.abs(s[2]) / limit).max())) for s in samples if s is not None]

    def _works_again(self) -> bool:
        """Whether the arm reaches a goal after the cause is removed and an operator has acted."""
        cell = self.cell
        cell.on_step = None
        self.inputs.mend()
        cell.run_for(0.3)
        assert cell.status is not None
        if cell.status.lifecycle == Lifecycle.FAULT:
            cell.submit(Reset())
            cell.run_for(0.3)
        if cell.status.lifecycle != Lifecycle.ACTIVE:
            cell.submit(Enable())
            cell.run_for(0.3)
        if any(reason.level == "hold" for reason in cell.status.reasons):
            cell.submit(Resume())
            cell.run_for(0.1)
        base = dict(zip(cell.settings.joint_names, demo_cell().base.tolist(), strict=True))
        goal = Goal("00000000000000ba", JointTarget(base))
        if not cell.submit(RunGoal(goal)).accepted:
            return False
        self._await_end(goal)
        newest = self.truth.newest()
        assert newest is not None
        reached = any(e.id == goal.id and e.kind == "goal_reached" for e in cell.events)
        return reached and bool(np.abs(newest[1] - demo_cell().base).max() < 0.01)


def _as_seen(q: FloatArray) -> dict[str, dict[int, tuple[float, float]]]:
    """The markers in each camera's image with the arm at ``q`` (n,); empty if one is outside."""
    world = demo_cell()
    seen = world.truth_pixels(q)
    for camera in world.rig.cameras:
        if (seen[camera.name] < 0.0).any() or (seen[camera.name] >= (camera.width, camera.height)).any():
            return {}
    return {
        name: {int(i): (float(u), float(v)) for i, (u, v) in zip(world.body.ids, pixels, strict=True)}
        for name, pixels in seen.items()
    }
