"""Playback of episodes of LeRobot data sets: their times, common to cameras and joints, and the joint driver
``lerobot``. The cameras use the driver ``video``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.ports import lerobot
from stereoservo.ports.devices import (
    CommandReport,
    DriverContext,
    DriverError,
    JointDriverDescription,
    JointSpec,
    JointState,
)
from stereoservo.ports.plugins import missing_extra
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState
from stereoservo_drivers.options import decode_options

DRIVER = "lerobot"
EpisodeNumber = Annotated[int, Meta(ge=0, le=lerobot.MOST_COUNTED)]
SLOWEST_HZ, FASTEST_HZ = 0.1, 1000.0
"""Range of rates of data sets that are played back, as for any camera."""
AROUND = {"revolute": 0.2, "prismatic": 0.05}
"""Margin of a joint's limits beyond the range of the episode [rad or m]."""
LEAST_VELOCITY = 0.1
"""Velocity limit of a joint that does not move in the episode [rad/s or m/s]."""


@contextmanager
def refused(what: str) -> Iterator[None]:
    """Context manager around the reader of ``what``: raises its errors, and a missing extra, as DriverError."""
    try:
        yield
    except lerobot.DataSetError as error:
        raise DriverError(error.code, str(error), source=what) from error
    except ModuleNotFoundError as error:
        missing = missing_extra(error) or f"{error.name} is not installed"
        raise DriverError("not_installed", f"{what}: {missing}", source=what) from error


@dataclass(frozen=True)
class Episode:
    """An episode's ``rows``, their ``stamps_ns`` (r,) from 0 on, and the ``period_ns`` after which it restarts.

    In repeated playback it restarts at each whole multiple of its period on the monotonic clock: cameras and joints in
    separate processes play it at the same times, and continue there after a restart.
    """

    info: lerobot.Info
    rows: lerobot.EpisodeRows
    stamps_ns: IntArray
    period_ns: int


def episode_of(folder: Path, number: int) -> Episode:
    """An episode of the data set in ``folder``. Raises DataSetError, ModuleNotFoundError."""
    info = lerobot.read_info(folder)
    if not SLOWEST_HZ <= info.fps <= FASTEST_HZ:
        raise lerobot.DataSetError(
            "dataset",
            f"LeRobot data set {folder}: fps = {info.fps:g}; from {SLOWEST_HZ:g} to {FASTEST_HZ:g} can be played back",
        )
    rows = lerobot.read_rows(folder, info, number)
    stamps_ns = np.rint((rows.stamp - rows.stamp[0]) * 1e9).astype(np.int64)
    return Episode(info, rows, stamps_ns, int(stamps_ns[-1]) + round(1e9 / info.fps))


class EpisodeOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of joints that are played back.

    ``dataset``: the folder of a LeRobot data set, relative to the cell file's directory; ``episode``: its number.
    ``units``: of its states, such as ``deg,gripper.pos=none``.
    ``rate_hz``: of the samples; positions are interpolated between those of the data set.
    """

    dataset: str
    episode: EpisodeNumber
    units: str
    rate_hz: Annotated[float, Meta(ge=10, le=1000)] = 250.0


class EpisodeJointDriver:
    """Joints of an episode in repeated playback. They are read-only: :meth:`activate` refuses."""

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self._options = decode_options(EpisodeOptions, options, DRIVER)
        self._clock = context.clock
        self._life = DriverLifecycle(f"joint driver {DRIVER!r}")
        self._seq = 0
        folder = context.cell_dir / self._options.dataset
        with refused(str(folder)):
            self._episode = episode_of(folder, self._options.episode)
            states = lerobot.state_names(self._episode.info, folder)
            joints = lerobot.joints_of(states, self._options.units)
        self._names, self._kinds, scales, columns = joints
        self._positions: FloatArray = self._episode.rows.state[:, columns] * scales

    def describe(self) -> JointDriverDescription:
        """The joints; their limits are the range of the episode plus a margin. Works unconnected."""
        positions, stamps_s = self._positions, self._episode.stamps_ns * 1e-9
        fastest = np.full(len(self._names), LEAST_VELOCITY)
        if len(stamps_s) > 1:
            elapsed = np.maximum(np.diff(stamps_s), 1e-3)[:, None]
            fastest = np.maximum(fastest, np.abs(np.diff(positions, axis=0) / elapsed).max(axis=0))
        low, high = positions.min(axis=0), positions.max(axis=0)
        return JointDriverDescription(
            driver=DRIVER,
            joints=tuple(
                JointSpec(name, kind, low[k] - AROUND[kind], high[k] + AROUND[kind], fastest[k], 4.0 * fastest[k])
                for k, (name, kind) in enumerate(zip(self._names, self._kinds, strict=True))
            ),
            rate_hz=self._options.rate_hz,
            pacing="clock",
            command_timeout_s=0.1,
            call_budget_us=500.0,
            home=tuple(positions[0].tolist()),
            lacks=("efforts", "following_errors"),
            simulated=True,
        )

    def configure(self) -> None:
        """Start to provide positions. Raises DriverError."""
        self._life.require("configure()", LifecycleState.CREATED, LifecycleState.CONFIGURED)
        self._life.state = LifecycleState.CONFIGURED

    def activate(self) -> None:
        """Raises DriverError: nothing can be moved."""
        self._life.require("activate()", LifecycleState.CONFIGURED)
        raise self._no_commands()

    def _no_commands(self) -> DriverError:
        return DriverError(
            "playback",
            f"episode {self._options.episode} of {self._options.dataset} is played back: its joints are read, and take "
            "no commands. Leave the drives disabled",
        )

    def read_state(self) -> JointState:
        """Positions and velocities at the clock's time in the episode. Raises DriverError."""
        self._life.require("read_state()", LifecycleState.CONFIGURED)
        now_ns = self._clock.now_ns()
        positions, velocities = self._at(now_ns % self._episode.period_ns)
        self._seq += 1
        return JointState(self._seq, now_ns, positions, velocities)

    def _at(self, into_ns: int) -> tuple[FloatArray, FloatArray]:
        stamps_ns, positions = self._episode.stamps_ns, self._positions
        row = int(np.searchsorted(stamps_ns, into_ns, side="right")) - 1
        if row + 1 == len(stamps_ns):
            return positions[row].copy(), np.zeros(positions.shape[1])
        elapsed_s = float(stamps_ns[row + 1] - stamps_ns[row]) * 1e-9
        velocities = (positions[row + 1] - positions[row]) / elapsed_s
        return positions[row] + velocities * (float(into_ns - stamps_ns[row]) * 1e-9), velocities

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        """Raises DriverError: nothing can be moved."""
        raise self._no_commands()

    def stop(self) -> None:
        """No effect: nothing is moved. Never raises."""

    def deactivate(self) -> None:
        """No effect: never active."""

    def close(self) -> None:
        """Stop to provide positions. Idempotent; never raises."""
        self._life.state = LifecycleState.CLOSED
