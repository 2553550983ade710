"""Emulated cameras on a virtual clock, before an arm whose history is in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo_sim.emulators.cameras.camera_emulator import CameraEmulator
from stereoservo_sim.emulators.cameras.emulated_camera import EmulatedCamera, StreamPicture
from stereoservo_sim.emulators.cameras.stream_settings import CamerasSettings, StreamSettings
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import demo_cell

MS = 1_000_000
SPEED = 0.2
"""[rad/s] of the arm's first joint."""


class Bench:
    """A camera emulator in virtual time; ``sent`` has what went out: time, stream, picture."""

    def __init__(self, streams: tuple[StreamSettings, ...], **settings: Any) -> None:
        self.clock = VirtualClock()
        self.history = TrueJointHistory.in_memory(6)
        self.settings = CamerasSettings(camera=streams, background="plain", **settings)
        self.emulator = CameraEmulator(
            [
                EmulatedCamera(stream, self.settings, clock=self.clock, services={"world": self.history})
                for stream in streams
            ],
            self.clock.now_ns(),
        )
        self.sent: list[tuple[int, str, StreamPicture]] = []
        self.arm_at(0)
        self.emulator.open()

    def arm_at(self, t_ns: int) -> None:
        """The arm's truth up to ``t_ns``."""
        q = demo_cell().base.copy()
        q[0] += SPEED * t_ns * 1e-9
        self.history.append(t_ns, q, np.eye(6)[0] * SPEED)

    def run(self, seconds: float) -> list[tuple[int, str, StreamPicture]]:
        """A millisecond at a time; what was sent meanwhile."""
        first = len(self.sent)
        for _ in range(round(seconds * 1e3)):
            now = self.clock.now_ns() + MS
            self.clock.advance_to(now)
            self.arm_at(now)
            self.emulator.run_until(now)
            self.emulator.take(now)
            self.sent += [(now, stream, picture) for stream, picture in self.emulator.sent(now)]
        return self.sent[first:]

    def order(self, text: str) -> str:
        """An order, now."""
        return self.emulator.order(text, self.clock.now_ns())


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    """Benches of given streams (default: left and right, 15 ms apart); released at the end."""
    made: list[Bench] = []

    def make(*streams: StreamSettings, **settings: Any) -> Bench:
        given = streams or (StreamSettings(name="left"), StreamSettings(name="right", skew_ms=15.0))
        made.append(Bench(given, **settings))
        return made[-1]

    yield make
    for bench in made:
        bench.emulator.close()
