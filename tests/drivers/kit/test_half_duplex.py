"""Answers of servos on one line that come one after the other."""

from __future__ import annotations

import pytest

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.kit import half_duplex
from stereoservo_drivers.kit.half_duplex import HalfDuplexBus, open_serial

ANSWER_S = 0.05


class Time:
    """Time that passes in sleep only."""

    now = 0.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture(autouse=True)
def passing(monkeypatch):
    time = Time()
    monkeypatch.setattr(half_duplex, "time", time)
    return time


class Line:
    """Servos that answer a question with one byte each, ``after`` so many seconds (one number a servo)."""

    def __init__(self, time, after):
        self.time, self.after, self.due = time, after, []

    def write(self, data):
        self.due = [self.time.now + delay for delay in self.after]

    def read(self, size):
        came = sum(due <= self.time.now for due in self.due)
        self.due = self.due[came:]
        return b"a" * came

    def close(self):
        self.due = []


def split(data):
    return data[:1], 1


def test_each_servo_has_its_time(passing):
    late = [0.8 * ANSWER_S * k for k in range(1, 5)]
    bus = HalfDuplexBus(Line(passing, late), split, answer_s=ANSWER_S)
    assert bus.ask(b"?", 4) == [b"a"] * 4


def test_a_servo_that_does_not_answer_is_left_out_and_a_dead_line_is_told(passing):
    bus = HalfDuplexBus(Line(passing, [0.0, 0.0, 60.0]), split, answer_s=ANSWER_S, lost_after=3)
    assert bus.ask(b"?", 3) == [b"a"] * 2
    assert bus.ask(b"?", 3) == [b"a"] * 2
    with pytest.raises(DriverError, match="3 questions in a row without all 3 answers, the last had 2"):
        bus.ask(b"?", 3)


def test_a_serial_port_on_a_network_is_told_without_its_password() -> None:
    with pytest.raises(DriverError, match="serial port") as caught:
        open_serial("socket://operator:Tulpe@127.0.0.1:1", 115200)
    assert "Tulpe" not in str(caught.value) + repr(caught.value.data)
    assert caught.value.data["port"] == "socket://***@127.0.0.1:1"
