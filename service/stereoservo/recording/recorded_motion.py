"""The arm's motion in a flight recording: joint positions over time, intervals at rest, and straight motions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.core.cycle import decode_array
from stereoservo.core.settings import CoreSettings
from stereoservo.core.sources.measure_at_pose import AT_REST
from stereoservo.messages.decoding import cause_of
from stereoservo.messages.goals import Calibrate
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.recording.replay import RecordingError, recorded_messages
from stereoservo.recording.step_layout import StepRecord, decode_step

SPEED_OVER_NS = 50_000_000
"""Interval [ns] over which joint speeds are computed as differences: encoders do not resolve shorter ones."""
STRAIGHT, ALONE = 0.999, 0.9995
"""Least cosine between directions of motion, one interval apart, on a straight line in joint space; and least share of
one joint in a direction that counts as this joint moving alone.
"""
SHORTEST_NS = 300_000_000
"""Least duration [ns] of a straight motion."""


@dataclass(frozen=True)
class RestInterval:
    """An interval at rest: commanded from ``begin_ns`` on, and settled from ``settled_ns`` to ``end_ns``."""

    begin_ns: int
    settled_ns: int
    end_ns: int


@dataclass(frozen=True)
class StraightMotion:
    """A motion on a straight line in joint space, of ``joint`` alone, or of several: -1."""

    begin_ns: int
    end_ns: int
    joint: int


@dataclass(frozen=True)
class RecordedMotion:
    """Steps (s,) of a recording: ``now_ns``, ``step`` number, ``asked``, whether the core commanded zero velocity;
    joint samples (k,), (k, n) at their own times; ``calibration_ns``: time of the last request to calibrate, or
    -1.
    """

    settings: CoreSettings
    now_ns: IntArray
    step: IntArray
    asked: np.ndarray[tuple[int], np.dtype[np.bool_]]
    joint_ns: IntArray
    positions: FloatArray
    calibration_ns: int

    def joints_at(self, t_ns: int) -> FloatArray | None:
        """Joints (n,) at ``t_ns``, interpolated between two samples; None outside of the recording."""
        after = int(np.searchsorted(self.joint_ns, t_ns))
        if after == 0 or after == len(self.joint_ns):
            return None
        t0, t1 = int(self.joint_ns[after - 1]), int(self.joint_ns[after])
        a, b = self.positions[after - 1], self.positions[after]
        found: FloatArray = a + (t_ns - t0) / (t1 - t0) * (b - a)
        return found


def read_motion(path: Path) -> RecordedMotion:
    """The motion in a recording, of any version with the same step inputs as this one. Raises RecordingError."""
    settings: CoreSettings | None = None
    steps: list[tuple[int, int, bool]] = []
    joint_ns: list[int] = []
    positions: list[FloatArray] = []
    calibration_ns = -1
    for topic, data in recorded_messages(path):
        try:
            if topic == "header":
                header = msgspec.msgpack.decode(data)
                settings = msgspec.msgpack.decode(header["settings"], type=CoreSettings, dec_hook=decode_array)
            elif topic == "step":
                record = decode_step(data)
                inputs = record.inputs
                steps.append((inputs.now_ns, record.step, not record.raw.any()))
                joints = inputs.joints
                if joints is not None and (not joint_ns or joints.t_ns > joint_ns[-1]):
                    joint_ns.append(joints.t_ns)
                    positions.append(np.array(joints.positions, dtype=np.float64))
                if _calibrates(record):
                    calibration_ns = inputs.now_ns
        except Exception as error:  # a decoder may raise anything
            raise RecordingError(path, len(steps), f"{topic} record is damaged ({cause_of(error)})") from error
    if settings is None:
        raise RecordingError(path, len(steps), "holds no header; is it a flight recording?")
    if len(joint_ns) < 2:
        raise RecordingError(path, len(steps), "holds no joint samples")
    return RecordedMotion(
        settings,
        np.array([now for now, _, _ in steps], dtype=np.int64),
        np.array([number for _, number, _ in steps], dtype=np.int64),
        np.array([asked for _, _, asked in steps], dtype=np.bool_),
        np.array(joint_ns, dtype=np.int64),
        np.array(positions),
        calibration_ns,
    )


def _calibrates(record: StepRecord) -> bool:
    return any(
        isinstance(request.command, Calibrate) and not request.command.check for request in record.inputs.requests
    )


def rest_intervals(motion: RecordedMotion, settle_s: float) -> list[RestInterval]:
    """Intervals at rest in order; only those after the last calibration's start, if there was one.

    An interval starts where zero velocity is commanded and needs ``settle_s`` to settle, as in the calibration motion.
    It ends if a joint moves nevertheless (by hand, for example); the remainder needs ``settle_s`` again.
    """
    now, moving = motion.now_ns, _moving(motion)
    still = motion.asked & (now >= motion.calibration_ns)
    still[1:] &= (np.diff(motion.step) == 1) | ~still[:-1]  # where steps are missing, the arm may have moved
    found: list[RestInterval] = []
    k, count = 0, len(now)
    while k < count:
        if not still[k]:
            k += 1
            continue
        begin = k
        while k < count and still[k] and (now[k] - now[begin]) * 1e-9 < settle_s:
            k += 1
        settled = k
        while k < count and still[k] and not moving[k]:
            k += 1
        if k > settled:
            found.append(RestInterval(int(now[begin]), int(now[settled]), int(now[k - 1])))
        elif k < count and still[k]:
            k += 1
    return found


def straight_motions(motion: RecordedMotion) -> list[StraightMotion]:
    """Straight motions in order; only those after the last calibration's start, if there was one."""
    first = max(int(motion.joint_ns[0]), motion.calibration_ns)
    times = np.arange(first, int(motion.joint_ns[-1]), SPEED_OVER_NS // 2)
    sampled = np.array([np.interp(times - first, motion.joint_ns - first, q) for q in motion.positions.T]).T
    moves = sampled[2:] - sampled[:-2]
    lengths = np.linalg.norm(moves, axis=1)
    directions = moves / np.maximum(lengths, 1e-300)[:, None]
    fast = lengths > AT_REST * SPEED_OVER_NS * 1e-9
    straight = np.zeros(len(times), dtype=np.bool_)
    straight[2:-2] = fast[2:] & fast[:-2] & ((directions[2:] * directions[:-2]).sum(axis=1) > STRAIGHT)
    edges = np.flatnonzero(np.diff(straight.astype(np.int8), prepend=0, append=0))
    found = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if times[end - 1] - times[begin] < SHORTEST_NS:
            continue
        line = np.abs(sampled[end - 1] - sampled[begin])
        alone = line.max() > ALONE * np.linalg.norm(line)
        # What it is compared over ends it two intervals too early; an overlap belongs to the later one.
        begin_ns, end_ns = int(times[begin]) - 2 * SPEED_OVER_NS, int(times[end - 1]) + 2 * SPEED_OVER_NS
        found.append(StraightMotion(begin_ns, end_ns, int(line.argmax()) if alone else -1))
    return found


def _moving(motion: RecordedMotion) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether some joint is faster than ``AT_REST`` at each step (s,)."""
    newest = np.clip(np.searchsorted(motion.joint_ns, motion.now_ns, side="right") - 1, 0, len(motion.joint_ns) - 1)
    before = np.searchsorted(motion.joint_ns, motion.joint_ns[newest] - SPEED_OVER_NS, side="left")
    span_s = np.maximum(motion.joint_ns[newest] - motion.joint_ns[before], 1) * 1e-9
    speed = np.abs(motion.positions[newest] - motion.positions[before]).max(axis=1) / span_s
    fast: np.ndarray[tuple[int], np.dtype[np.bool_]] = (before < newest) & (speed > AT_REST)
    return fast
