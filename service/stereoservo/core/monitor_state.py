"""State of the monitors between steps: fault diagnosis of the model, moving cameras, relocalization of cameras,
averages of pixels at rest.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import msgspec
import numpy as np

from stereoservo.core.camera_state import CameraMonitor
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray

LOST_FRAMES = 3
"""Frames in a row that nothing explains, after which nobody knows where a moving camera is."""


STALE_PERIODS = 2.5
"""Frames that are older than so many periods of their camera are left out of a round."""
LATE_S = 0.02
"""By which a busy computer may get a stamp wrong."""


VerdictKind = Literal[
    "ok",
    "camera_moved",
    "cameras_moved_together",
    "cameras_or_arm",
    "marker_slipped",
    "joint_zero",
    "unclear",
]
MOVED = ("camera_moved", "cameras_moved_together")
"""Verdicts by which cameras, and not the arm, have moved."""


class ModelDiagnosis(msgspec.Struct, frozen=True):
    """What explains the innovations: ``subjects`` names cameras, the marker or the joint; ``size`` in ``unit``, its
    standard ``deviation``; ``moved_px``: what it moves in the images, rms; ``text`` in words.
    """

    kind: VerdictKind = "ok"
    subjects: tuple[str, ...] = ()
    size: float = 0.0
    deviation: float = 0.0
    unit: str = ""
    moved_px: float = 0.0
    text: str = ""


class ModelMonitor(msgspec.Struct, eq=False):
    """The watch over the model. ``last``: verdicts of the last rounds of frames, newest last. ``masked`` (m,): 1 for
    markers that have slipped and are not used; ``back`` (m,): rounds in a row in which such a one was in its place.
    """

    sightings: list[CameraMonitor]
    masked: FloatArray
    back: IntArray
    verdict: ModelDiagnosis = msgspec.field(default_factory=ModelDiagnosis)
    last: list[ModelDiagnosis] = []


class MobileCamera(msgspec.Struct, eq=False):
    """A camera declared mobile; see `moving_camera`. While it is ``moving``, the model has it where it stood last.

    ``way`` (4, 4): from there to where its newest frame has it, ``P way``. ``reference`` (4, 4): likewise of the first
    of the ``still`` frames that agree with each other; ``twists`` (6,): sum of theirs from there, in the metric basis.
    ``lost``: frames in a row that nothing explained; ``moved_px``: from where it stood last, rms.
    """

    way: FloatArray
    reference: FloatArray
    twists: FloatArray
    moving: bool = False
    still: int = 0
    lost: int = 0
    moved_px: float = 0.0
    seen: int = 0
    """Known points in its newest frame."""
    since_ns: int = 0
    found_ns: int = 0
    """Of the newest frame that was explained."""
    static_moved: bool = False
    """Its newest frame showed enough static points moved with it: the camera moves, and not the arm."""
    doubtful: bool = False
    """Its frames agree, but nothing proves that it was the camera, and not the arm."""

    @property
    def place(self) -> Literal["stands", "moving", "lost"]:
        """What is known of where it is, in a word."""
        if not self.moving:
            return "stands"
        return "lost" if self.lost >= LOST_FRAMES else "moving"


def standing_camera() -> MobileCamera:
    """A mobile camera where the model has it."""
    return MobileCamera(np.eye(4), np.eye(4), np.zeros(6))


class Relocalization(msgspec.Struct, eq=False, kw_only=True):
    """Cameras that have moved and are being found anew; see `camera_relocalization`.

    ``together``: they moved as one body. ``sums``, ``joint_sum`` (n,): sights at rest. ``reference`` (c, k, 2) [px]:
    the innovations of the first frame at rest, and ``referred`` (c, k) 1 where there is one: what stands keeps them.
    ``doubt``: why it is not proven yet that they, and not the arm, have moved; empty where it is.
    ``poses``: handed out so far, ``tried_at`` (n,) the joints of the last and ``tried_seen`` how much the moved cameras
    saw there. ``reason``: why it has failed.
    """

    phase: Literal["brake", "collect", "wait", "take", "verify", "failed"]
    cameras: tuple[str, ...]
    together: bool
    moved_px: float
    since_ns: int
    phase_ns: int
    sums: ObservationStatistics
    joint_sum: FloatArray
    reference: FloatArray
    referred: FloatArray
    tried_at: FloatArray
    joint_frames: int = 0
    rested_ns: int = 0
    poses: int = 0
    tried_seen: int = 0
    tries: int = 0
    contradicting: int = 0
    """Frames in a row in which what stands has moved."""
    doubt: str = ""
    reason: Reason | None = None


def nothing_sighted(cameras: int, rows: int, joints: int, markers: int) -> ModelMonitor:
    """A watch that has seen nothing: ``rows`` markers and static points, of them ``markers`` of the model."""
    return ModelMonitor(
        [CameraMonitor(rows, joints) for _ in range(cameras)], np.zeros(markers), np.zeros(markers, np.int64)
    )


class ObservationStatistics(msgspec.Struct, eq=False, kw_only=True):
    """Sights of the markers, summed up while the arm rests; see `measure_at_pose`."""

    counts: FloatArray
    """Sights of each marker in each camera, (c, m)."""
    sums: FloatArray
    """(c, m, 2)"""
    first: FloatArray
    """Pixels at the first sight (c, m, 2), against which the scatter is taken."""
    deviation_sums: FloatArray
    """(c, m, 2)"""
    square_sums: FloatArray
    """(c, m)"""
    covariance_sums: FloatArray
    """(c, m, 2, 2)"""
    frames: IntArray
    """Frames taken, by camera."""


class DriveDelays(NamedTuple):
    """How late the joints' drives are, and what they lack of their travel besides; see `core.monitors.following`.

    ``delay_s`` (n,) as measured, 0 before and where it is no matter: the median of ``samples`` (k, n) [s]. ``onset``
    (7, n): the measurement in progress. ``sent`` (n,) [rad or m] in all, and ``past`` (r, n) of the last r steps.
    ``velocity`` (n,): the commands that arrive now; ``under_way`` (n,): travel that is sent and has not arrived yet.
    ``missing`` (n,): arrived less measured travel of late, ``accounted`` (n,): arrived when the joints last told.
    """

    delay_s: FloatArray
    samples: FloatArray
    onset: FloatArray
    sent: FloatArray
    past: FloatArray
    velocity: FloatArray
    under_way: FloatArray
    accounted: FloatArray
    missing: FloatArray
