"""A simulated arm whose drives take positions: it goes as commanded though its joints sag and have play, and no further
than lead and load offset when the computer is killed.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext
from stereoservo_drivers.fake import FakeJointDriver
from stereoservo_drivers.position_output import LEAD_S, LOAD_OFFSET
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.robots import flange_pose
from stereoservo_sim.world.simulated_cell import demo_cell

PERIOD_NS = 4_000_000
CHEAP = {
    "sag": math.radians(2.5), "play": math.radians(1.0), "encoder_side": "joint", "encoder_step": 2 * math.pi / 4096,
    "dead_band": 2 * math.pi / 4096, "lag_s": 0.02, "delay_s": 0.005,
}  # fmt: skip
ROBOT = demo_cell().robot
BOUND = np.array([LEAD_S * joint.velocity_max + LOAD_OFFSET[joint.kind] for joint in ROBOT.joints])


class Arm:
    """The demonstration's arm on position drives, enabled and settled; ``links``: where it truly stands."""

    def __init__(self, tmp_path, mechanics=CHEAP):
        self.clock, self._world = VirtualClock(), TrueJointHistory.in_memory(6)
        context = DriverContext(self.clock, "t", tmp_path, tmp_path, services={"world": self._world})
        options = {"drives": "position", "mechanics": dict.fromkeys(ROBOT.joint_names, mechanics)}
        self.driver = FakeJointDriver(options, context)
        self.driver.configure()
        self.driver.activate()
        self.run(1.5, np.zeros(6))

    def run(self, seconds, velocities=None):
        """At ``velocities`` (6,), or with the computer killed; returns the links (k, 6) in every period."""
        path = [self.links]
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            if velocities is not None:
                self.driver.write_velocity(velocities)
            self.clock.advance_to(self.clock.now_ns() + PERIOD_NS)
            self.driver.read_state()
            path.append(self.links)
        return np.array(path)

    @property
    def links(self):
        return self._world.newest()[1].copy()

    def wall(self, joint, side, place):
        """Something that ``joint`` cannot pass from here on; None: it is taken away."""
        walls = self.driver._plant.walls
        walls[:, joint] = (-np.inf, np.inf)
        if place is not None:
            walls[int(side > 0), joint] = place


def flange_mm(path):
    """Farthest from its first place that the flange is on a path (k, 6) [mm]."""
    places = np.array([flange_pose(ROBOT, q)[:3, 3] for q in path])
    return 1e3 * float(np.linalg.norm(places - places[0], axis=1).max())


@pytest.mark.parametrize("speed", [0.05, -0.3])
def test_each_joint_goes_as_far_as_commanded_though_it_sags_and_has_play(tmp_path, speed):
    arm = Arm(tmp_path)
    velocities = np.full(6, speed)
    arm.run(0.5, velocities)  # play is taken up
    arm.run(1.0, np.zeros(6))
    before = arm.links
    arm.run(0.1 / abs(speed), velocities)
    arm.run(1.0, np.zeros(6))
    # What the load changes on the way and a count of the encoder are the rest.
    assert arm.links - before == pytest.approx(np.copysign(0.1, speed) * np.ones(6), abs=0.012)


@pytest.mark.slow
def test_a_killed_computer_leaves_no_more_travel_than_lead_and_offset(tmp_path):
    """Free joints go on by what they lag; one that is freed as it presses, by nearly all of the bound. A load's offset
    may have changed since the joint stood, by the sag times what joints have turned, and by the play.
    """
    random = np.random.default_rng(17)
    free, freed = [], []
    for case in range(12):
        arm = Arm(tmp_path)
        stood = arm.links
        if case % 2:
            joint, velocities = case // 2, np.zeros(6)
            velocities[joint] = random.choice([-0.8, 0.8])
            arm.run(0.1, velocities)
            arm.wall(joint, velocities[joint], arm.links[joint])
            arm.run(0.6, velocities)
            arm.wall(joint, 0.0, None)
        else:
            arm.run(random.uniform(0.1, 0.5), random.uniform(-1.0, 1.0, 6) * random.choice([0.1, 0.5, 1.0]))
        path = arm.run(0.5)
        travel = np.abs(path - path[0]).max(axis=0)
        changed = CHEAP["sag"] * np.abs(arm.links - stood).sum() + CHEAP["play"]
        assert (travel <= BOUND + changed).all(), (case, travel)
        assert np.array_equal(path[-1], path[-5])  # it stands
        (freed if case % 2 else free).append((travel.max(), flange_mm(path)))
    for name, found in (("free", free), ("freed", freed)):
        rad, mm = np.array(found).max(axis=0)
        print(f"{name}: {rad:.3f} rad of {BOUND.max():.3f}, {mm:.0f} mm at the flange")
    assert max(rad for rad, _ in free) < 0.06
    assert max(rad for rad, _ in freed) > 0.9 * LEAD_S  # else the bound is not tried
