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
from stereoservo_sim.world.synthetic import SyntheticCell, gantry, gantry_with_wrist, pan_tilt, scara, seven

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
            CameraSettings(c.name, c.width, c.height, 25.0, cell.mount, cell.marker_ids) for c in self.model.cameras
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
                if event.kind in ("goal_reached", "goal_aborted") or (event.kind == "reply" and not event.accepted):
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


@pytest.mark.parametrize(("law", "able"), [("cartesian3", False), ("cartesian2", False), ("stereo", True)])
def test_a_law_of_components_that_the_arm_makes_only_together_is_refused_before_anything_moves(
    law: str, able: bool
) -> None:
    """A face that is not square to a SCARA's axes: turned about them it revolves about its hinge and in its plane."""
    level = scara()
    c, s = np.cos(0.9), np.sin(0.9)
    cell = level.with_body(level.body @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T)
    loop = Loop(cell)
    goal_q = cell.home + np.array([0.15, -0.2, 0.04, 0.4])
    event = loop.run(loop.features(goal_q), law=law)
    if able:
        assert event.kind == "goal_reached", event
        return
    assert (event.kind, event.accepted, event.reasons[0].code) == ("reply", False, "NOT_REACHABLE"), event
    assert "'stereo', 'image', 'points', 'trajectory'" in event.reasons[0].hint
    assert np.array_equal(loop.q, cell.home)


def of_markers(target: FeatureTarget, ids: tuple[int, ...]) -> FeatureTarget:
    """The same goal, shown by these markers only."""
    return FeatureTarget({camera: {i: pixels[i] for i in ids} for camera, pixels in target.set_points.items()})


@pytest.mark.parametrize("law", ["stereo", "image", "cartesian3"])
@pytest.mark.parametrize("shown", [1, 2])
@pytest.mark.parametrize("arm", [scara, gantry])
def test_one_point_and_two_are_goals_of_an_arm_of_few_freedoms(arm: Any, shown: int, law: str) -> None:
    cell = arm()
    loop = Loop(cell)
    goal_q = cell.home + np.resize([0.15, -0.1, 0.04, 0.4], len(cell.home))
    ids = cell.marker_ids[2 : 2 + shown]
    event = loop.run(of_markers(loop.features(goal_q), ids), law=law)
    assert event.kind == "goal_reached", event
    apart = loop.cell.pixels(np.array([loop.q, goal_q]))[:, :, 2 : 2 + shown]
    assert np.abs(apart[:, 0] - apart[:, 1]).max() < 0.15
    moved = np.abs(loop.q - cell.home)
    assert moved.max() < 2.0 * np.abs(goal_q - cell.home).max()  # and what a point leaves open is not driven about


@pytest.mark.parametrize("law", ["stereo", "image"])
def test_a_pan_tilt_head_turns_to_one_point(law: str) -> None:
    cell = pan_tilt()
    loop = Loop(cell)
    goal_q = cell.home + np.array([0.12, -0.08])
    event = loop.run(of_markers(loop.features(goal_q), cell.marker_ids[:1]), law=law)
    assert event.kind == "goal_reached", event
    assert np.abs(loop.q - goal_q).max() < 1e-3  # two angles, which one point in two cameras fixes


def test_a_point_beyond_an_arms_freedoms_is_refused_with_the_nearest_that_it_reaches() -> None:
    cell = pan_tilt()
    loop = Loop(cell)
    marker = cell.marker_ids[0]
    shown = of_markers(loop.features(cell.home), (marker,))
    apart = {
        camera: {marker: (u + (20.0 if k else -20.0), v)}  # nearer than any turn of the head brings it
        for k, (camera, pixels) in enumerate(shown.set_points.items())
        for u, v in pixels.values()
    }
    event = loop.run(FeatureTarget(apart), law="stereo")
    assert (event.kind, event.accepted) == ("reply", False)
    assert event.reasons[0].code == "NOT_REACHABLE", event
    assert event.reasons[0].value == pytest.approx(20.0, rel=0.2)
    assert "nearest that they reach" in event.reasons[0].hint
    assert np.array_equal(loop.q, cell.home)


def test_an_arm_of_six_joints_needs_three_markers_still() -> None:
    loop = Loop(gantry_with_wrist())
    event = loop.run(of_markers(loop.features(loop.cell.home), loop.cell.marker_ids[:2]), law="stereo")
    assert event.reasons[0].code == "TOO_FEW_MARKERS", event
