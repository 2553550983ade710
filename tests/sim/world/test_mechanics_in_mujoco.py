"""The simulated mechanics against MuJoCo, which has models of play, friction and compliance of its own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo_sim.world.mechanics import Mechanics, Transmission, at_rest, gravity_torques
from stereoservo_sim.world.robots import RX90, joint_frames

MASS, ARM = 2.0, 0.3
"""Of the link [kg], and from its axis [m]."""
GRAVITY_MOMENT = MASS * 9.81 * ARM
PLAY = float(np.deg2rad(2.0))
FRICTION = 0.1
"""Of the link's bearing, as a share of the largest gravity moment."""
STEP_S = 5e-4
FAST, SLOW = 0.25, 0.02
"""Of the motor [rad/s]; where friction holds the link it must not get there by its own momentum."""
LIMITS = f'limited="true" range="{-0.5 * PLAY} {0.5 * PLAY}" solreflimit="0.004 1" solimplimit="0.95 0.99 0.001"'
"""A tendon whose ends may be the play apart."""

GEARED_LINK = """
<mujoco>
  <option timestep="{step}" gravity="0 0 -9.81" integrator="implicitfast" iterations="200" tolerance="1e-12"/>
  <default><joint type="hinge" axis="0 1 0" solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001"/></default>
  <worldbody>
    <body name="motor">
      <joint name="motor" damping="{motor_damping}" frictionloss="{motor_friction}"/>
      <inertial pos="0 0 0" mass="0.5" diaginertia="0.05 0.05 0.05"/>
    </body>
    <body name="link">
      <joint name="link" frictionloss="{friction}" damping="1.0"/>
      <inertial pos="{arm} 0 0" mass="{mass}" diaginertia="0.002 0.002 0.002"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="gear" {gear}>
      <joint joint="motor" coef="-1"/>
      <joint joint="link" coef="1"/>
    </fixed>
  </tendon>
  <actuator><position joint="motor" kp="{kp}" kv="{kv}"/></actuator>
</mujoco>
"""
"""A motor and a link on one horizontal axis, coupled by a tendon alone. Gravity turns the link in the positive
direction at its zero."""


class GearedLink:
    """A motor that is driven slowly to set-points, and the link that it turns."""

    def __init__(
        self,
        gear: str,
        *,
        friction: float = 0.0,
        motor_friction: float = 0.0,
        kp: float = 1e6,
        gravity: float = 9.81,
    ) -> None:
        text = GEARED_LINK.format(
            step=STEP_S, arm=ARM, mass=MASS, gear=gear, friction=friction, motor_friction=motor_friction,
            motor_damping=1.0, kp=kp, kv=2.0 * np.sqrt(0.05 * kp),
        )  # fmt: skip
        self.model = mujoco.MjModel.from_xml_string(text)
        self.model.opt.gravity[2] = -gravity
        self.data = mujoco.MjData(self.model)
        self.at, self.slow = 0.0, motor_friction > 0.0
        self.drive(0.0)

    def drive(self, to: float, rest_s: float = 0.6) -> tuple[float, float]:
        """Motor and link angle at rest after a way to ``to`` [rad], slow where friction may hold the link."""
        while self.at != to:
            speed = SLOW if self.slow or abs(self.at - 0.5 * np.pi) < 0.15 else FAST
            self.at += float(np.clip(to - self.at, -speed * STEP_S, speed * STEP_S))
            self.data.ctrl[0] = self.at
            mujoco.mj_step(self.model, self.data)
        for _ in range(round(rest_s / STEP_S)):
            mujoco.mj_step(self.model, self.data)
        assert np.abs(self.data.qvel).max() < 1e-3
        return float(self.data.qpos[0]), float(self.data.qpos[1])


def load(q: np.ndarray) -> np.ndarray:
    """Of the link: what turns it in the positive direction, over the largest."""
    return np.cos(q)


STOPS = np.deg2rad([-60.0, -20.0, 20.0, 60.0, 82.0, 88.0, 90.0, 98.0, 120.0, 92.0, 90.0, 82.0, 60.0, -60.0])
"""Where the load changes its sign, at 90°, friction holds the link within 5.7° to either side."""


def test_a_link_lies_in_its_play_where_load_and_friction_put_it() -> None:
    there = GearedLink(LIMITS, friction=FRICTION * GRAVITY_MOMENT)
    ours = Transmission([Mechanics(play=PLAY, play_friction=FRICTION)], np.zeros(1), load)
    at, offsets = 0.0, []
    for stop in STOPS:
        motor, link = there.drive(float(stop))
        for target in np.linspace(at, stop, max(2, round(abs(stop - at) / 2e-4))):
            ours.follow(np.array([target]), 1e-3)
        for _ in range(1000):
            ours.follow(np.array([stop]), 1e-3)
        at = stop
        offsets.append((link - motor, float(ours.link[0] - ours.motor[0])))
    theirs, own = np.array(offsets).T
    print(np.round(np.rad2deg(np.array(offsets)), 3).tolist())
    assert np.abs(theirs - own).max() < 0.03 * PLAY  # a soft limit of MuJoCo yields a hundredth
    assert {-1.0, 1.0} <= set(np.sign(own))  # both flanks were reached


def test_a_stop_is_where_the_table_of_stops_says() -> None:
    joint = [Mechanics(play=PLAY, play_friction=FRICTION)]
    for stop in np.deg2rad([-50.0, 30.0, 89.0, 91.0, 110.0]):
        for begin in (stop - 0.5, stop + 0.5):
            there = GearedLink(LIMITS, friction=FRICTION * GRAVITY_MOMENT)
            there.drive(float(begin))
            motor, link = there.drive(float(stop))
            approach = np.array([[np.sign(stop - begin)]])
            own, _ = at_rest(joint, np.array([[stop]]), load(np.array([[stop]])), approach)
            assert link - motor == pytest.approx(float(own[0, 0] - stop), abs=0.03 * PLAY), (stop, begin)


def test_a_gear_that_yields_sags_with_its_posture() -> None:
    sag = float(np.deg2rad(2.0))
    there = GearedLink(f'stiffness="{GRAVITY_MOMENT / sag}" damping="4"')
    ours = Transmission([Mechanics(sag=sag)], np.zeros(1), load)
    for stop in np.deg2rad([-70.0, -10.0, 45.0, 100.0, 170.0]):
        motor, link = there.drive(float(stop), rest_s=3.0)
        for _ in range(3000):
            ours.follow(np.array([stop]), 1e-3)
        # Ours takes the load at the motor's angle, nature at the link's: apart by the square of the sag.
        assert link - motor == pytest.approx(float(ours.link[0] - ours.motor[0]), abs=1.5 * sag**2)


def test_friction_holds_a_motor_within_its_dead_band() -> None:
    kp, friction = 200.0, 2.0
    band = 2.0 * friction / kp
    there = GearedLink('stiffness="1e4" damping="10"', motor_friction=friction, kp=kp, gravity=0.0)
    ours = Transmission([Mechanics(dead_band=band)], np.zeros(1), np.zeros_like)
    at = 0.0
    for stop in (0.1, 0.11, 0.095, 0.085, 0.05, 0.065, 0.2):
        motor, _ = there.drive(stop)
        for target in np.linspace(at, stop, 200):
            ours.follow(np.array([target]), 1e-3)
        at = stop
        assert motor == pytest.approx(float(ours.motor[0]), abs=0.05 * band), stop


@pytest.mark.parametrize("seed", range(3))
def test_gravity_loads_of_an_arm(seed: int) -> None:
    centres, masses = RX90.centres, RX90.masses
    model = mujoco.MjModel.from_xml_string(_arm(centres, masses))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        q = np.array([rng.uniform(joint.position_min, joint.position_max) for joint in RX90.joints])
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        frames, _ = joint_frames(RX90, q)
        places = np.einsum("nij,nj->ni", frames[:, :3, :3], centres) + frames[:, :3, 3]
        own = gravity_torques(frames[:, :3, 3], frames[:, :3, 2], places, masses)
        assert np.allclose(own, -data.qfrc_bias, atol=1e-8), (seed, q)


def _arm(centres: np.ndarray, masses: np.ndarray) -> str:
    """The arm as nested bodies of MuJoCo; a body stands at its joint, turned as the row before it leaves it."""
    opening, closing, tail = "", "", np.eye(4)
    for link, centre, mass in zip(RX90.links, centres, masses, strict=True):
        x, y, z, w = Rotation.from_matrix(tail[:3, :3]).as_quat()
        opening += (
            f'<body pos="{_text(tail[:3, 3])}" quat="{_text(w, x, y, z)}"><joint type="hinge" axis="0 0 1"/>'
            f'<inertial pos="{_text(centre)}" mass="{_text(mass)}" diaginertia="0.01 0.01 0.01"/>'
        )
        closing += "</body>"
        tail = link
    world = f"<worldbody>{opening}{closing}</worldbody>"
    return f'<mujoco><compiler autolimits="false"/><option gravity="0 0 -9.81"/>{world}</mujoco>'


def _text(*numbers: np.ndarray | float) -> str:
    return " ".join(f"{value:.17g}" for value in np.hstack(numbers))
