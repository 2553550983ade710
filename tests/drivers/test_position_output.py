"""Drives that take positions only, led by velocities: they go as far as commanded, whatever their load, and no further
than the lead once orders end.
"""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_drivers.position_output import PositionOutput

PERIOD, LAG = 0.004, 0.03
LIMITS = np.array([-3.0]), np.array([3.0])


class Servo:
    """A joint behind a stiff position loop: a lag, a load that holds it off its order, and play that it must cross."""

    def __init__(self, output: PositionOutput, sag: float = 0.0) -> None:
        self.output, self.sag = output, sag
        self.position = 0.0
        self.order = float(output.follow(np.zeros(1), np.zeros(1, dtype=bool))[0])

    def run(self, seconds: float, velocity: float | None = 0.0) -> None:
        """Commanded, or with no orders any more."""
        for _ in range(round(seconds / PERIOD)):
            if velocity is not None:
                order = self.output.step(np.array([velocity]), np.array([self.position]), *LIMITS)
                self.order = float(order[0])
            self.position += (self.order - self.sag - self.position) * PERIOD / LAG


def output(lead: float = 0.1, largest_offset: float = 0.06) -> PositionOutput:
    return PositionOutput(np.array([lead]), np.array([largest_offset]), np.array([1.0]), PERIOD)


@pytest.mark.parametrize("sag", [0.0, np.radians(2.5), -np.radians(2.5)])
@pytest.mark.parametrize("lead", [0.03, 0.1])
@pytest.mark.parametrize("velocity", [0.02, -0.4])
def test_a_joint_goes_as_far_as_commanded_under_load(sag, lead, velocity):
    servo = Servo(output(lead), sag)
    servo.run(3.0)
    start = servo.position
    servo.run(0.2 / abs(velocity), velocity)
    servo.run(2.0)
    assert servo.position - start == pytest.approx(np.copysign(0.2, velocity), abs=0.002)
    rest = servo.position
    servo.run(20.0)
    assert servo.position == pytest.approx(rest, abs=1e-4)


@pytest.mark.parametrize("sag", [0.0, np.radians(2.5)])
def test_without_orders_a_joint_goes_no_further_than_its_lead(sag):
    servo = Servo(output(0.03), sag)
    servo.run(3.0)
    servo.run(0.5, 0.4)
    at = servo.position
    servo.run(2.0, None)
    assert abs(servo.position - at) <= 0.03 + 1e-6


def test_a_joint_that_is_blocked_is_pressed_no_harder_than_lead_and_offset_allow():
    servo = output(0.03, 0.06)
    servo.follow(np.zeros(1), np.zeros(1, dtype=bool))
    for _ in range(5000):
        order = servo.step(np.array([0.4]), np.zeros(1), *LIMITS)
    assert float(order[0]) == pytest.approx(0.09)


@pytest.mark.parametrize("sag", [0.0, np.radians(2.5), -np.radians(2.5)])
@pytest.mark.parametrize("blocked_s", [0.3, 5.0])
def test_a_joint_that_is_freed_when_orders_have_ended_goes_no_further_than_lead_and_offset(sag, blocked_s):
    """What blocks a joint that its load pulls along bears that load: it went 0.2 rad, and not 0.16."""
    servo = Servo(output(), sag)
    servo.run(3.0)
    servo.run(0.5, 0.4)
    for _ in range(round(blocked_s / PERIOD)):
        order = servo.output.step(np.array([0.4]), np.array([servo.position]), *LIMITS)
    servo.order, at = float(order[0]), servo.position
    servo.run(2.0, None)
    assert 0.08 < servo.position - at <= 0.16 + 1e-3


@pytest.mark.parametrize("sag", [0.0, np.radians(2.5)])
@pytest.mark.parametrize("then", [-0.05, 0.0], ids=["reversed", "stopped"])
@pytest.mark.parametrize("blocked_s", [0.5, 5.0])
def test_a_joint_that_was_blocked_is_let_go_when_its_command_ends_or_turns(sag, then, blocked_s):
    """Led by 0.1 rad and 0.06 of a load that it is not, it pressed on for 3 s at 0.05 rad/s."""
    servo = Servo(output(), sag)
    servo.run(3.0)
    servo.run(0.5, 0.4)
    for _ in range(round(blocked_s / PERIOD)):
        order = servo.output.step(np.array([0.4]), np.array([servo.position]), *LIMITS)
    assert float(order[0]) - servo.position >= 0.099 + sag
    pressed = float(order[0])
    for _ in range(200):
        before = float(order[0])
        order = servo.output.step(np.array([then]), np.array([servo.position]), *LIMITS)
        assert abs(float(order[0]) - before) < 0.4 * PERIOD, "a position that jumps is a fault of many a drive"
        if float(order[0]) - servo.position <= sag + 2e-3:
            break
    assert float(order[0]) < pressed
    assert float(order[0]) - servo.position == pytest.approx(sag, abs=2e-3)
    start = servo.position
    servo.run(2.0, -0.1)
    servo.run(1.0)
    assert servo.position - start == pytest.approx(-0.2, abs=0.004)


def test_a_joint_with_a_coarse_encoder_is_let_go_too():
    """Its reading flickers by a step, at rest as well."""
    servo, step, k = output(lead=0.3), 0.0015, 0
    order = servo.follow(np.zeros(1), np.zeros(1, dtype=bool))
    for velocity, cycles in ((0.0, 500), (0.4, 500), (0.0, 500)):
        for k in range(cycles):
            order = servo.step(np.array([velocity]), np.array([step * (k % 3 == 0)]), *LIMITS)
        if velocity > 0.0:
            assert float(order[0]) > 0.29
    assert abs(float(order[0])) < 3 * step


class Vertical(Servo):
    """Under a load that a part adds to while it moves up, or against something that is not quite hard."""

    stiffness, touches_at = 0.0, np.inf

    def run(self, seconds: float, velocity: float | None = 0.0) -> None:
        for _ in range(round(seconds / PERIOD)):
            order = self.output.step(np.array([velocity]), np.array([self.position]), *LIMITS)
            self.order = float(order[0])
            push = self.stiffness * max(self.position - self.touches_at, 0.0)
            self.position += (self.order - self.sag - push - self.position) * PERIOD / LAG


@pytest.mark.parametrize("load", [0.05, 0.12, 0.16])
@pytest.mark.parametrize("then", [0.0, -0.02], ids=["stopped", "reversed"])
def test_a_joint_that_is_overloaded_does_not_fall_when_its_command_ends_or_turns(load, then):
    """A part of more than lead and offset can hold: at each turn of its command the joint fell by 0.14 rad."""
    servo = Vertical(output(), 0.02)
    servo.run(3.0)
    servo.run(0.5, 0.4)
    servo.sag = load
    for _ in range(5):
        servo.run(1.0, 0.4)
        at = servo.position
        servo.run(1.0, then)
        assert servo.position - at > then - 0.045
    servo.run(3.0)
    at = servo.position
    servo.run(5.0)
    assert servo.position == pytest.approx(at, abs=2e-3)


def test_what_gives_in_a_little_is_let_go_too():
    servo = Vertical(output(), 0.02)
    servo.run(3.0)
    servo.run(0.5, 0.4)
    servo.touches_at, servo.stiffness = servo.position, 10.0
    servo.run(2.0, 0.4)
    pressed = servo.order - servo.position
    servo.run(2.0)
    assert servo.order - servo.position < 0.5 * pressed


@pytest.mark.parametrize("sag", [0.0, np.radians(2.5)])
@pytest.mark.parametrize("noise", [1e-4, 2e-4])
def test_a_joint_whose_reading_flickers_is_let_go_too(sag, noise):
    random, servo = np.random.default_rng(0), Servo(output(), sag)
    blocked = np.inf
    for velocity, seconds in ((0.0, 5.0), (0.4, 0.5), (0.4, 1.0), (0.0, 1.0)):
        for _ in range(round(seconds / PERIOD)):
            read = servo.position + random.normal(0.0, noise)
            servo.order = float(servo.output.step(np.array([velocity]), np.array([read]), *LIMITS)[0])
            servo.position += (servo.order - sag - servo.position) * PERIOD / LAG
            servo.position = min(servo.position, blocked)
        blocked = servo.position if velocity else blocked
    assert servo.order - servo.position == pytest.approx(sag, abs=5e-3)


def test_a_joint_whose_load_is_not_known_yet_is_not_let_go():
    servo = Servo(output(lead=0.03), np.radians(2.5))
    servo.run(0.1)
    servo.run(0.1, 0.4)
    stands_off = servo.order - servo.position
    servo.run(PERIOD, -0.05)
    assert servo.order - servo.position == pytest.approx(stands_off, abs=2e-3)


def test_orders_end_at_a_limit_and_lead_back_from_beyond_it():
    servo = Servo(output())
    low, high = np.array([-3.0]), np.array([0.1])
    for _ in range(500):
        servo.order = float(servo.output.step(np.array([0.4]), np.array([servo.position]), low, high)[0])
        servo.position += (servo.order - servo.position) * PERIOD / LAG
    assert servo.position == pytest.approx(0.1, abs=1e-3)
    assert float(servo.output.step(np.array([-0.4]), np.array([0.3]), low, high)[0]) < 0.3


def test_an_enabled_joint_keeps_its_order_and_a_free_one_stands_where_it_is():
    servo = output()
    servo.follow(np.array([0.5]), np.array([False]))
    assert float(servo.follow(np.array([0.4]), np.array([True]))[0]) == 0.5
    assert float(servo.follow(np.array([0.4]), np.array([False]))[0]) == 0.4
