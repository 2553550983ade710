"""A synthetic cell in virtual time, driven by the servo core: mechanics between drive and link, encoders with zero
errors, images with an unreported delay. Evaluated against ground truth, which the core never sees.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.control.marker_groups import with_groups
from stereoservo.core.cycle import Event, ModelUpdate, StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings, TrialSettings
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import (
    Calibrate,
    Command,
    Enable,
    FeatureTarget,
    Goal,
    LawName,
    Request,
    RunGoal,
)
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation, JointState
from stereoservo_sim.world.mechanical_trials import synthetic_load
from stereoservo_sim.world.mechanics import Mechanics, Transmission, quantised
from stereoservo_sim.world.synthetic import SyntheticCell

RATE_HZ, CAMERA_HZ = 100.0, 25.0
BEGIN_NS = 1_000_000_000
TOLERANCE_PX = 0.25
HOLD_FRAMES = 5
TIME_LIMIT_S = 60.0
SPEED, ACCELERATION = 1.0, 4.0
"""Limits of every joint [rad/s], [rad/s²]."""
TRANSFER_S = 0.02
"""Time from an image's stamp until the core receives it."""
LEAST_SIGMA_PX = 0.01
FIRST_FRAMES_S = 0.5
"""Time for which the core observes the arm at rest before it is given a goal."""
STOPS, FRAMES = 7, 4
"""Stops per joint of the calibration motion, and frames averaged at a stop."""
LONGEST_TRIALS_S = 600.0
ENDS = ("goal_reached", "goal_aborted", "goal_cancelled")


@dataclass(frozen=True)
class Creep:
    """A camera that moves at a constant rate from the first step on: the ``twist`` (6,) [m/s, rad/s] of its
    translation and its rotation vector, in the camera's own frame.
    """

    camera: int
    twist: FloatArray

    def moved(self, cell: SyntheticCell, seconds: float) -> SyntheticCell:
        """The cell with the camera at its pose after this time."""
        turn, angle = np.eye(4), float(np.linalg.norm(self.twist[3:])) * seconds
        if angle > 0.0:
            x, y, z = self.twist[3:] / np.linalg.norm(self.twist[3:])
            cross = np.array([(0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)])
            turn[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        turn[:3, 3] = self.twist[:3] * seconds
        poses = cell.poses.copy()
        poses[self.camera] = turn @ poses[self.camera]
        return replace(cell, poses=poses)


@dataclass(frozen=True)
class Imperfections:
    """Deviations of the cell from the core's assumptions.

    ``mechanics`` of each joint, None: perfect. ``zero_offset`` (n,) [rad or m]: change of the encoder readings since
    calibration; None: none. ``late_s``: unreported age of images at their stamp, with ``jitter_s`` uniform in addition.
    ``noise_px``: of each coordinate. ``creep``: a camera that has moved since calibration.
    """

    mechanics: Sequence[Mechanics] | None = None
    zero_offset: FloatArray | None = None
    late_s: float = 0.0
    jitter_s: float = 0.0
    noise_px: float = 0.05
    creep: Creep | None = None


@dataclass(frozen=True)
class GoalEnd:
    """How a goal ended: the ``kind`` of its last event ("" if none came in time), the reasons' ``codes``, the
    core's ``verdict`` on its images, and its duration in ``seconds``.
    """

    kind: str
    codes: tuple[str, ...]
    verdict: str
    seconds: float


class DrivenCell:
    """A cell with its arm at ``q`` (n,), enabled, with ``model`` in use, if any; ``links``: true joint positions,
    ``path``: these after each cycle, ``verdicts``: reports of the model monitor.
    """

    def __init__(
        self, cell: SyntheticCell, model: CellModel | None, q: FloatArray, seed: int,
        imperfections: Imperfections = Imperfections(), *, law: LawName = "cartesian3", limit: float = np.pi,
    ) -> None:  # fmt: skip
        self.cell, self._wrong = cell, imperfections
        self._rng = np.random.default_rng([seed, 15])
        self._gears: Transmission | None = None
        self.links = q.copy()
        if imperfections.mechanics is not None:
            self._gears = Transmission(imperfections.mechanics, q, partial(synthetic_load, cell))
            self._set_positions = self._gears.motor.copy()
        self._offset = np.zeros_like(q) if imperfections.zero_offset is None else imperfections.zero_offset
        self.settings = _settings(cell, q, imperfections.mechanics, law, limit)
        self.core = ServoCore(self.settings)
        self._period_ns = round(1e9 / RATE_HZ)
        self._now_ns, self._seq, self._active = BEGIN_NS, 0, False
        self._pending: list[CameraObservation] = []
        self._past: list[tuple[int, FloatArray]] = []
        self.command = np.zeros_like(q)
        self.path: list[FloatArray] = []
        self.verdicts: list[str] = []
        self.step(model_update=None if model is None else ModelUpdate(with_groups(model)))
        self.step(Enable())
        for _ in range(round(FIRST_FRAMES_S * RATE_HZ)):
            self.step()

    @property
    def mechanics(self) -> Sequence[Mechanics]:
        """Mechanics of the joints, perfect if none were given."""
        return self._wrong.mechanics or [Mechanics()] * len(self.links)

    @property
    def seconds(self) -> float:
        """Time since the beginning."""
        return 1e-9 * (self._now_ns - BEGIN_NS)

    @property
    def readings(self) -> FloatArray:
        """Encoder readings (n,)."""
        if self._gears is None:
            return self.links + self._offset
        return quantised(self._gears.readings + self._offset, self._gears.encoder_step)

    def pixels(self) -> FloatArray:
        """Current exact pixels (c, m, 2) of the markers, with the cameras at their initial poses."""
        return self.cell.pixels(self.links[None])[:, 0]

    def step(self, *commands: Command, model_update: ModelUpdate | None = None) -> StepOutputs:
        """Run one cycle of the core and move the arm by its command."""
        self._now_ns += self._period_ns
        self._seq += 1
        self._past = [*self._past[-64:], (self._now_ns, self.links.copy())]
        joints = JointState(self._seq, self._now_ns, self.readings, np.zeros_like(self.links))
        due = tuple(o for o in self._pending if o.t_received_ns <= self._now_ns)
        self._pending = [o for o in self._pending if o.t_received_ns > self._now_ns]
        requests = tuple(Request(self._seq, "campaign", command) for command in commands)
        outputs = self.core.step(
            StepInputs(
                self._now_ns,
                self._period_ns,
                joints,
                due,
                requests,
                driver_active=self._active,
                model_update=model_update,
            )
        )
        self.verdicts += [event.name for event in outputs.events if event.kind == "health" and event.name != "ok"]
        if outputs.driver_request:
            self._active = outputs.driver_request == "activate"
        if self._seq % round(RATE_HZ / CAMERA_HZ) == 0:
            self._expose()
        self.command = np.zeros_like(self.links) if outputs.command is None else outputs.command
        self._drive(self.command, 1.0 / RATE_HZ)
        self.path.append(self.links.copy())
        return outputs

    def run_goal(
        self,
        wanted: FloatArray,
        *,
        law: LawName | None = None,
        time_limit_s: float = TIME_LIMIT_S,
        gain: float | None = None,
        damping: float | None = None,
    ) -> GoalEnd:
        """Drive to set-points (c, m, 2) [px], of which only markers in view are used, until an event ends the goal."""
        ids = self.cell.marker_ids
        inside = (wanted > -0.5).all(axis=-1) & (wanted < (self.cell.width - 0.5, self.cell.height - 0.5)).all(axis=-1)
        target = FeatureTarget(
            {
                f"cam{c}": {ids[i]: (float(pixels[i, 0]), float(pixels[i, 1])) for i in np.flatnonzero(inside[c])}
                for c, pixels in enumerate(wanted)
            }
        )
        name = str(uuid.UUID(int=self._seq + 1))
        outputs = self.step(RunGoal(Goal(name, target, law=law, gain=gain, damping=damping, time_limit_s=time_limit_s)))
        limit = round(2.0 * time_limit_s * RATE_HZ)  # the core has no time limit while it waits for cameras
        for cycle in range(limit):
            for event in outputs.events:
                if event.kind == "reply" and not event.accepted:
                    return GoalEnd("refused", _codes(event), self._verdict(outputs), 0.0)
                if event.kind in ENDS and event.id == name:
                    return GoalEnd(event.kind, _codes(event), self._verdict(outputs), cycle / RATE_HZ)
            outputs = self.step()
        held = tuple(reason.code for reason in outputs.status.reasons)
        return GoalEnd("", held, self._verdict(outputs), limit / RATE_HZ)

    def trials(self) -> TrialData:
        """Observations of the core's calibration motion. Raises CalibrationError."""
        collector = TrialCollector(self.settings)
        outputs = self.step(Calibrate(str(uuid.UUID(int=self._seq + 1))))
        for _ in range(round(LONGEST_TRIALS_S * RATE_HZ)):
            for event in outputs.events:
                collector.add(event)
                if event.kind == "calibration_finished":
                    return collector.trials()
                if event.kind == "calibration_aborted" or event.accepted is False:
                    raise CalibrationError("aborted", event.message)
            outputs = self.step()
        raise CalibrationError("aborted", f"trial motions take more than {LONGEST_TRIALS_S:g} s")

    def rest(self, seconds: float) -> tuple[FloatArray, int]:
        """Pixels (c, m, 2) averaged over a time without a goal, and number of sign changes of a joint's command."""
        total, reversals = np.zeros_like(self.pixels()), 0
        last = np.zeros_like(self.links)
        cycles = round(seconds * RATE_HZ)
        shown, there = self.pixels(), self.links
        for _ in range(cycles):
            self.step()
            if not np.array_equal(self.links, there):
                shown, there = self.pixels(), self.links
            reversals += int((self.command * last < 0.0).sum())
            last = np.where(self.command != 0.0, self.command, last)
            total += shown
        return total / cycles, reversals

    @staticmethod
    def _verdict(outputs: StepOutputs) -> str:
        health = outputs.status.health
        return "" if health is None else health.verdict

    def _drive(self, velocity: FloatArray, dt_s: float) -> None:
        if self._gears is None:
            self.links = self.links + velocity * dt_s
            return
        if not velocity.any() and self._gears.rest(dt_s):
            return
        self._set_positions = self._set_positions + velocity * dt_s
        self._gears.follow(self._set_positions, dt_s)
        self.links = self._gears.link.copy()

    def _expose(self) -> None:
        """Images stamped now, of the arm as it was ``late_s`` ago."""
        wrong = self._wrong
        late_ns = round(1e9 * (wrong.late_s + wrong.jitter_s * self._rng.uniform()))
        now = self.cell if wrong.creep is None else wrong.creep.moved(self.cell, self.seconds)
        exact = now.pixels(self._links_at(self._now_ns - late_ns)[None])[:, 0]
        inside = (exact > -0.5).all(axis=-1) & (exact < (self.cell.width - 0.5, self.cell.height - 0.5)).all(axis=-1)
        covariance = max(wrong.noise_px, LEAST_SIGMA_PX) ** 2 * np.eye(2)
        ids = np.array(self.cell.marker_ids)
        for c, there in enumerate(inside):
            if not there.any():
                continue
            seen = exact[c, there] + wrong.noise_px * self._rng.standard_normal((int(there.sum()), 2))
            self._pending.append(
                CameraObservation(
                    f"cam{c}",
                    self._seq,
                    self._now_ns,
                    self._now_ns + round(1e9 * TRANSFER_S),
                    ids[there],
                    seen,
                    np.tile(covariance, (len(seen), 1, 1)),
                )
            )

    def _links_at(self, t_ns: int) -> FloatArray:
        times = np.array([t for t, _ in self._past], dtype=np.float64)
        links = np.array([q for _, q in self._past])
        return np.array([np.interp(t_ns, times, links[:, j]) for j in range(links.shape[1])])


def _codes(event: Event) -> tuple[str, ...]:
    return tuple(reason.code for reason in event.reasons) or ((event.message,) if event.message else ())


def _settings(
    cell: SyntheticCell, q: FloatArray, mechanics: Sequence[Mechanics] | None, law: LawName, limit: float
) -> CoreSettings:
    n = len(cell.home)
    low, high = cell.home - limit, cell.home + limit
    trials = TrialSettings(
        q.copy(), np.where(cell.ranges > 0.0, cell.ranges, np.nan), STOPS, FRAMES, 0.2, 1.0, 4, 0.05, 1.0
    )
    return CoreSettings(
        cell="campaign",
        joint_names=cell.joint_names,
        joint_kinds=cell.kinds,
        cameras=tuple(
            CameraSettings(f"cam{c}", cell.width, cell.height, CAMERA_HZ, cell.mount, cell.marker_ids)
            for c in range(len(cell.poses))
        ),
        limits=LimitSettings(
            low, high, np.full(n, SPEED), np.full(n, ACCELERATION), 0.01, np.zeros((0, n, 2)), (), 0.5, 0.1, 1.0
        ),
        trials=trials,
        home=None,
        rate_hz=RATE_HZ,
        law=law,
        points="predicted",
        gain=1.5,
        tolerance_px=TOLERANCE_PX,
        hold_frames=HOLD_FRAMES,
        time_limit_s=1e6,
        filter_s=0.2,
        gate_sigma=6.0,
        resolution=() if mechanics is None else tuple(joint.encoder_step for joint in mechanics),
    )
