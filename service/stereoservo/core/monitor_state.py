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
"""Consecutive unexplained frames after which the pose of a moving camera counts as lost."""


STALE_PERIODS = 2.5
"""Frames older than so many periods of their camera are left out of a round."""
LATE_S = 0.02
"""Possible error of a stamp on a busy computer [s]."""


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
"""Diagnoses by which cameras, and not the arm, have moved."""


class ModelDiagnosis(msgspec.Struct, frozen=True):
    """Explanation of the innovations: ``subjects`` names cameras, the marker or the joint; ``size`` in ``unit``, its
    standard ``deviation``; ``moved_px``: resulting rms displacement in the images; ``text``: description.
    """

    kind: VerdictKind = "ok"
    subjects: tuple[str, ...] = ()
    size: float = 0.0
    deviation: float = 0.0
    unit: str = ""
    moved_px: float = 0.0
    text: str = ""


class ModelMonitor(msgspec.Struct, eq=False):
    """State of the model monitor. ``last``: diagnoses of the last rounds of frames, newest last. ``masked`` (m,): 1 for
    markers that have slipped and are not used; ``back`` (m,): consecutive rounds in which such a marker was in its
    place again.
    """

    sightings: list[CameraMonitor]
    masked: FloatArray
    back: IntArray
    verdict: ModelDiagnosis = msgspec.field(default_factory=ModelDiagnosis)
    last: list[ModelDiagnosis] = []


class ModelComparison(msgspec.Struct, eq=False):
    """Comparison of a kept model with the images, since the model was loaded at ``since_ns``.

    ``rounds``: number of the last rounds of frames that agree with it, negative if they contradict it.
    ``reason``: why it is not confirmed.
    ``wait_until_ns``: until when goals wait for it to be confirmed; 0: none waits.
    """

    since_ns: int
    reason: Reason
    rounds: int = 0
    wait_until_ns: int = 0


class MobileCamera(msgspec.Struct, eq=False):
    """A camera declared mobile; see `moving_camera`. While it is ``moving``, the model keeps its last static matrix.

    ``way`` (4, 4): displacement from there to the pose in its newest frame, ``P way``.
    ``reference`` (4, 4): the same for the first of the ``still`` frames that agree with each other.
    ``twists`` (6,): sum of the displacements of these frames from the reference, in the metric basis.
    ``lost``: consecutive frames without an explanation.
    ``moved_px``: rms displacement in the image since the last static pose.
    """

    way: FloatArray
    reference: FloatArray
    twists: FloatArray
    moving: bool = False
    still: int = 0
    lost: int = 0
    moved_px: float = 0.0
    seen: int = 0
    """Number of known points in its newest frame."""
    since_ns: int = 0
    found_ns: int = 0
    """Time of the newest frame that was explained."""
    static_moved: bool = False
    """Enough static points moved in its newest frame: the camera moves, and not the arm."""
    doubtful: bool = False
    """Its frames agree, but do not prove that the camera, and not the arm, has moved."""

    @property
    def place(self) -> Literal["stands", "moving", "lost"]:
        """The state of its pose, in a word."""
        if not self.moving:
            return "stands"
        return "lost" if self.lost >= LOST_FRAMES else "moving"


def standing_camera() -> MobileCamera:
    """A mobile camera at the pose that the model states."""
    return MobileCamera(np.eye(4), np.eye(4), np.zeros(6))


class Relocalization(msgspec.Struct, eq=False, kw_only=True):
    """Relocalization of cameras that have moved; see `camera_relocalization`.

    ``together``: they moved as one body.
    ``sums``, ``joint_sum`` (n,): observations at rest.
    ``reference`` (c, k, 2) [px]: the innovations of the first frame at rest, and ``referred`` (c, k) 1 where there is
    one; they do not change for static objects.
    ``doubt``: why it is not proven yet that the cameras, and not the arm, have moved; empty if it is proven.
    ``poses``: number handed out so far.
    ``tried_at`` (n,), ``tried_seen``: joints of the last pose, and number of markers that the moved cameras saw there.
    ``reason``: why it has failed.
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
    """Consecutive frames in which static objects have moved."""
    doubt: str = ""
    reason: Reason | None = None


def nothing_sighted(cameras: int, rows: int, joints: int, markers: int) -> ModelMonitor:
    """A model monitor without observations: ``rows`` markers and static points, of them ``markers`` of the model."""
    return ModelMonitor(
        [CameraMonitor(rows, joints) for _ in range(cameras)], np.zeros(markers), np.zeros(markers, np.int64)
    )


class ObservationStatistics(msgspec.Struct, eq=False, kw_only=True):
    """Statistics of the observations of the markers while the arm rests; see `measure_at_pose`."""

    counts: FloatArray
    """Number of observations of each marker in each camera, (c, m)."""
    sums: FloatArray
    """(c, m, 2)"""
    first: FloatArray
    """Pixels at the first observation (c, m, 2), relative to which the scatter is computed."""
    deviation_sums: FloatArray
    """(c, m, 2)"""
    square_sums: FloatArray
    """(c, m)"""
    covariance_sums: FloatArray
    """(c, m, 2, 2)"""
    frames: IntArray
    """Number of frames used, by camera."""


class DriveDelays(NamedTuple):
    """Delays of the joints' drives, and the travel missing in addition to them; see `core.monitors.following`.

    ``delay_s`` (n,): the measured delays, 0 before the measurement and where they are negligible: the median of
    ``samples`` (k, n) [s].
    ``onset`` (7, n): the measurement in progress.
    ``sent`` (n,) [rad or m]: total commanded travel, and ``past`` (r, n) that of the last r steps.
    ``velocity`` (n,): the commands that take effect now.
    ``in_transit`` (n,): travel that is commanded and has not taken effect yet.
    ``missing`` (n,): recent effective minus measured travel.
    ``accounted`` (n,): effective travel at the last joint sample.
    """

    delay_s: FloatArray
    samples: FloatArray
    onset: FloatArray
    sent: FloatArray
    past: FloatArray
    velocity: FloatArray
    in_transit: FloatArray
    accounted: FloatArray
    missing: FloatArray
