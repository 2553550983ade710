"""Goals of arms with other than six freedoms: redundant, deficient, prismatic; and bodies with several faces."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stereoservo.core.cycle import Event, ModelUpdate, StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.messages.goals import Enable, FeatureTarget, Goal, Request, RunGoal
from stereoservo.ports.devices import CameraObservation, JointState
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell, gantry_with_wrist, scara, seven

PERIOD_NS = 10_000_000


class Loop:
    """A core and a synthetic cell in virtual time: perfect joints, two cameras at 25 Hz without noise."""

    def __init__(self, cell: SyntheticCell, reach: float = 2.5) -> None:
        n = len(cell.kinds)
        self.cell, self.q, self.now_ns, self.seq = cell, cell.home.copy(), 10**9, 0
        wide = np.full(n, reach)
        limits = LimitSettings(
            cell.home - wide, cell.home + wide, np.full(n, 1.0), np.full(n, 4.0), 0.01, np.zeros((0, n, 2)), (), 0.5,
            0.1, 1.0,
        )  # fmt: skip
        self.model = exact_model(cell)
        cameras = tuple(
            CameraSettings(c.name, c.width, c.height, 25.0, "eye_to_hand", cell.marker_ids)
            for c in self.model.cameras
        )
        self.core = ServoCore(
            CoreSettings(
                cell="arm", joint_names=cell.joint_names, joint_kinds=cell.kinds, cameras=cameras, limits=limits,
                trials=None, home=None, rate_hz=100.0, law="cartesian3", points="predicted", gain=2.0,
                tolerance_px=0.1, hold_frames=3, time_limit_s=30.0, filter_s=0.2, gate_sigma=6.0,
            )
        )  # fmt: skip
        self.events: list[Event] = []
        self.step()
        self.step(model=self.model)
        self.step(Enable())
        for _ in range(20):
            self.step()

    def step(self, *commands: Any, model: Any = None) -> StepOutputs:
        self.now_ns += PERIOD_NS
        self.seq += 1
        observations = []
        if self.seq % 4 == 0:
            pixels, seen = self.cell.pixels(self.q[None])[:, 0], self.cell.in_view(self.q[None])[:, 0]
            for c, camera in enumerate(self.model.cameras):
                ids = np.array(self.cell.marker_ids)[seen[c]]
                covariances = np.tile(1e-4 * np.eye(2), (len(ids), 1, 1))
                observations.append(
                    CameraObservation(
                        camera.name, self.seq, self.now_ns, self.now_ns, ids, pixels[c, seen[c]], covariances
                    )
                )
        outputs = self.core.step(
            StepInputs(
                self.now_ns, PERIOD_NS, JointState(self.seq, self.now_ns, self.q.copy(), np.zeros_like(self.q)),
                tuple(observations),
                tuple(Request(self.seq, "tester", command) for command in commands),
                model_update=None if model is None else ModelUpdate(model), driver_active=True,
            )
        )  # fmt: skip
        self.events.extend(outputs.events)
        if outputs.command is not None:
            self.q = self.q + outputs.command * PERIOD_NS * 1e-9
        return outputs

    def features(self, q: np.ndarray) -> FeatureTarget:
        pixels = self.cell.pixels(q[None])[:, 0]
        return FeatureTarget(
            {
                camera.name: {
                    i: (float(u), float(v)) for i, (u, v) in zip(self.cell.marker_ids, pixels[c], strict=True)
                }
                for c, camera in enumerate(self.model.cameras)
            }
        )

    def run(self, target: FeatureTarget, seconds: float = 20.0, **options: Any) -> Event:
        """The goal's refusal, or its end."""
        since = len(self.events)
        self.step(RunGoal(Goal("0000000a", target, **options)))
        for _ in range(round(seconds * 100)):
            for event in self.events[since:]:
                if event.kind in ("goal_reached", "goal_aborted") or (
                    event.kind == "reply" and not event.accepted
                ):
                    return event
            self.step()
        raise AssertionError(f"nothing ended: {self.events[since:]}")

    def error_px(self, q: np.ndarray) -> float:
        return float(np.abs(self.cell.pixels(self.q[None]) - self.cell.pixels(q[None])).max())


@pytest.mark.parametrize("law", ["cartesian3", "trajectory", "stereo"])
def test_redundant_arm_reaches_and_leaves_its_limits(law: str) -> None:
    cell = seven()
    loop = Loop(cell)
    goal_q = cell.home + np.radians([8, -6, 7, 8, -6, 9, 12])
    loop.core.settings.limits.position_max[0] = cell.home[0] + 0.05  # joint 1 stands near its limit
    loop.core = ServoCore(loop.core.settings, loop.core.state)
    event = loop.run(loop.features(goal_q), law=law)
    assert event.kind == "goal_reached", event
    assert loop.error_px(goal_q) < 0.15
    if law != "trajectory":
        assert loop.q[0] < cell.home[0] + 0.02


def test_arm_of_four_freedoms_reaches_what_it_can() -> None:
    cell = scara()
    for law in ("cartesian3", "stereo", "trajectory"):
        loop = Loop(cell)
        goal_q = cell.home + np.array([0.15, -0.2, 0.04, 0.4])
        event = loop.run(loop.features(goal_q), law=law)
        assert event.kind == "goal_reached", (law, event)
        assert loop.error_px(goal_q) < 0.15


@pytest.mark.parametrize("law", ["cartesian3", "stereo", "trajectory"])
def test_missing_freedom_is_named_before_anything_moves(law: str) -> None:
    """A tilt of the body is nothing that four parallel axes can do."""
    cell = scara()
    loop = Loop(cell)
    tilt, c, s = np.eye(4), np.cos(0.3), np.sin(0.3)
    tilt[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    tilted = cell.with_body((np.hstack([cell.body, np.ones((len(cell.body), 1))]) @ tilt.T)[:, :3])
    other = Loop.__new__(Loop)
    other.cell, other.model = tilted, loop.model
    event = loop.run(other.features(cell.home), law=law)
    assert (event.kind, event.accepted) == ("reply", False)
    assert event.reasons[0].code == "NOT_REACHABLE", event
    assert event.reasons[0].subject
    assert np.array_equal(loop.q, cell.home)


def test_arm_with_prismatic_joints_reaches() -> None:
    cell = gantry_with_wrist()
    loop = Loop(cell)
    goal_q = cell.home + np.array([0.05, -0.04, 0.06, 0.2, -0.15, 0.4])
    event = loop.run(loop.features(goal_q), law="cartesian2")
    assert event.kind == "goal_reached", event
    assert loop.error_px(goal_q) < 0.15
