"""The complete state of the control core as one versioned, serialisable struct: joint history, camera estimates, active
motion source, goal queue and plans, monitors. A copy of it with the same inputs gives the same outputs.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from stereoservo.control.faces import FaceChoice, Faces
from stereoservo.control.filters import ClientClock, TargetTrack
from stereoservo.core.block import Block, steps_of_delay
from stereoservo.core.camera_state import CameraEstimate
from stereoservo.core.cycle import PathFrame
from stereoservo.core.monitor_state import (
    MobileCamera,
    ModelComparison,
    ModelMonitor,
    ObservationStatistics,
    Relocalization,
    nothing_sighted,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.target.motion import TargetBody
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Goal, Request
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle, ModelReadiness
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.planning.path_search import PlanningState
from stereoservo.planning.plan import Plan

STATE_VERSION = 13
LEAST_SEPARATION_NS = 2_500_000  # between samples that are kept, except the newest


class JointHistory(msgspec.Struct, eq=False):
    """Ring buffer of joint samples: stamps [ns] and positions; ``count`` samples were ever written."""

    t_ns: IntArray
    positions: FloatArray
    count: int = 0


class Refused(msgspec.Struct, eq=False):
    """Samples of one source rejected by `ingest`: their total number, and the reason for the newest; None once one was
    accepted again.
    """

    count: int = 0
    reason: Reason | None = None


class JointLoadStatistics(msgspec.Struct, eq=False):
    """Statistics of the joints' loads in the trial motions ``id`` so far; see `kinematics.model.JointLoads`."""

    id: str
    velocities: FloatArray
    efforts: FloatArray
    largest_efforts: FloatArray
    following_errors: FloatArray


class Holding(msgspec.Struct, tag="hold"):
    """No motion."""


class AwaitingAcknowledgement(msgspec.Struct, tag="acknowledge"):
    """No motion: goal ``id`` is reached, and the queue waits until a client acknowledges it."""

    id: str
    acknowledge_s: float
    until_ns: int


class Jogging(msgspec.Struct, tag="jog", eq=False):
    """Joint velocities until the lease of the dead man's switch expires."""

    velocity: FloatArray
    until_ns: int


class Leased(msgspec.Struct, eq=False):
    """A goal whose client must renew its lease, if it has one."""

    lease_s: float | None
    lease_until_ns: int

    def renew_lease(self, now_ns: int) -> None:
        """Renew the lease after a message of the client."""
        self.lease_until_ns = now_ns + int((self.lease_s or 0.0) * 1e9)


class JointMove(Leased, tag="joints", eq=False, kw_only=True):
    """A straight line in joint space to ``target`` (n,)."""

    id: str
    target: FloatArray
    speed_scale: float
    started_ns: int
    time_limit_s: float
    start: FloatArray
    """Start positions (n,)."""
    acknowledge_s: float | None = None
    settled: int = 0


class Stream(msgspec.Struct, eq=False):
    """A goal that a client moves: its filtered set-points, in the client's time, and the client's last message with its
    time.

    ``set_points`` (c, m, 2): ideal pixels, as last sent.
    """

    track: TargetTrack
    clock: ClientClock
    updated_ns: int
    set_points: FloatArray


class LawRun(Leased, eq=False, kw_only=True):
    """A law that works on a goal.

    ``used`` (c,): 1 for cameras whose images it may use.
    Gains [1/s]: as in `messages.goals.AdaptiveGain`; ``damping``: as in `control.pd`.
    ``reasons``: results of the last examination of its progress, which is in the block (`core.block.RunProgress`).
    ``apart``: why the goal is not reached inside its tolerance (see `core.sources.progress`), as of the first
    ``apart_frames`` frames of all cameras.
    """

    goal: Goal
    points: str
    gain_near: float
    gain_far: float
    gain_slope: float
    tolerance_px: float
    hold_frames: int
    time_limit_s: float
    started_ns: int
    used: FloatArray
    damping: float = 0.0
    reasons: list[Reason] = []
    apart: Reason | None = None
    apart_frames: int = -1


class FollowedTarget(msgspec.Struct, eq=False, kw_only=True):
    """State of a goal that follows a target: the displacement ``reference`` (4, 4) of the target for which its
    set-points or features are given. ``told``: the last event of the target.
    """

    reference: FloatArray
    told: Literal["", "target_seen", "target_unseen", "target_met"] = ""


class Followed(FollowedTarget, eq=False, kw_only=True):
    """Set-points at the reference: ``set_points`` (c, m, 2), ``target_points`` (m, 4) and ``centre_target`` (4,)."""

    set_points: FloatArray
    target_points: FloatArray
    centre_target: FloatArray


class FollowedFeatures(FollowedTarget, eq=False, kw_only=True):
    """Incidences at the reference: their ``fixed`` features (k, 3, 4); ``drift`` (4, 4) [1/s], the current twist of the
    features relative to the body that shall be incident with them.
    """

    fixed: FloatArray
    drift: FloatArray


class ServoGoal(LawRun, tag="law", eq=False, kw_only=True):
    """A law drives the arm to set-points.

    ``set_points`` (c, m, 2): ideal pixels with ``wanted`` (c, m) 1 or 0, and their velocities ``rates`` [px/s].
    ``target_points`` (m, 4): all markers at the goal, if ``pose_known``; ``target_known`` (m,): those that determined
    it.
    ``faces``: of the body, and the ``choice`` of the one that the law uses.
    ``centre_weights`` (m,): the centre is the affine centroid of the markers by these weights, or, if they are zero,
    the point ``centre_body`` (4,) of the body at the chain's zero; ``centre_target`` (4,): the centre at the goal.
    ``stream``: of a moving goal, once a client has moved it.
    ``plan``: path of a planned law, for a body that was at ``start_points`` (m, 4); ``plan_s``: current time on it.
    ``goal_joints`` (n,): joints at the end of a plan. ``step_from`` (n,): corrected joints at the start of a step in a
    metric frame; None for other goals.
    """

    law: str
    jacobian: int
    set_points: FloatArray
    wanted: FloatArray
    rates: FloatArray
    target_points: FloatArray
    target_known: FloatArray
    pose_known: bool
    centre_weights: FloatArray
    centre_body: FloatArray
    centre_target: FloatArray
    faces: Faces
    choice: FaceChoice
    stream: Stream | None = None
    plan: Plan | None = None
    plan_s: float = 0.0
    start_points: FloatArray | None = None
    goal_joints: FloatArray | None = None
    followed: Followed | None = None
    step_from: FloatArray | None = None


class IncidenceGoal(LawRun, tag="incidence", eq=False, kw_only=True):
    """Incidences of the body with the scene, and a second task in their null space.

    ``kinds`` (k,), ``markers`` (k, 3), ``fixed`` (k, 3, 4): as in `control.incidence.IncidenceTask`.
    ``names`` (k,): for messages to people.
    Second task: ``joints`` (n,) where ``joints_wanted`` (n,) is 1; ``set_points`` (c, m, 2) ideal pixels where
    ``wanted`` (c, m) is 1.
    """

    kinds: IntArray
    markers: IntArray
    fixed: FloatArray
    names: tuple[str, ...]
    joints: FloatArray
    joints_wanted: FloatArray
    set_points: FloatArray
    wanted: FloatArray
    followed: FollowedFeatures | None = None


class PoseMeasurement(Leased, eq=False, kw_only=True):
    """Moves to configurations and measures there at rest; see `core.sources.measure_at_pose`."""

    id: str
    phase: Literal["move", "settle", "collect", "return", "sweep", "finish"]
    target: FloatArray
    phase_ns: int
    start: FloatArray
    """Measured positions when the current move started."""
    sums: ObservationStatistics
    joint_sum: FloatArray
    joint_frames: int = 0
    lost_ns: int = 0
    lost_camera: str = ""  # a camera with too few visible markers since lost_ns; 0: none
    silent_ns: int = 0
    """Last time at which some camera was known never to have delivered."""


class TrialMotion(PoseMeasurement, eq=False, kw_only=True):
    """What both programmes of calibration record: the range (n,) ``lowest`` to ``highest`` visited by each joint, its
    largest motion in the images ``motion_sigmas`` (n,), in sigmas, and ``sigma_px``, the median sigma of a marker at
    rest. For prediction: sums (n, c, m, 2) of a joint's offset from the base times the markers' motion [rad px or
    m px], and (n, c, m) of the squared offsets. Of the present path: its frames, and joint samples (n,) at ``path_ns``.
    """

    base_pixels: FloatArray
    last: FloatArray
    lowest: FloatArray
    highest: FloatArray
    motion_sigmas: FloatArray
    sigma_px: float
    slope_sums: FloatArray
    slope_weights: FloatArray
    path_frames: list[PathFrame] = msgspec.field(default_factory=list, name="way_frames")
    path_ns: list[int] = msgspec.field(default_factory=list, name="way_ns")
    path_joints: list[FloatArray] = msgspec.field(default_factory=list, name="way_joints")


class SweepMotion(TrialMotion, tag="sweeps", eq=False, kw_only=True):
    """Calibration by sweeps; see `core.sources.sweeps`.

    ``joint`` sweeps to a ``side``, -1 before the first, their number for all joints at once; ``outward``: away from the
    base; ``corner``: combinations of offsets tried; ``leg``: number of the sweep, of joint ``trial`` or of all, -1.
    ``base_pixels``, ``last`` (c, m, 2) [px]: markers at the base and in each camera's last frame, at ``last_ns`` (c,),
    with ``rates`` (c, m, 2) [px/s].
    ``stamp_sums`` (c, 2): scatter of each camera's stamps (`calibration.sweeps.stamp_scatter`), weighted by the number
    of frames, and that number. ``arrived_ns``: since when it rests at the base after the last sweep, 0: not yet.
    """

    joint: int
    side: int
    outward: bool
    corner: int
    leg: int
    trial: int
    last_ns: IntArray
    rates: FloatArray
    stamp_sums: FloatArray
    arrived_ns: int = 0


class CalibrationMotion(TrialMotion, tag="trials", eq=False, kw_only=True):
    """The calibration programme: joint after joint, stop after stop, then all joints at once (``joint`` is then their
    number). ``k`` counts steps from the base, and the stops of all joints.

    ``last``, ``before`` (p, c, m, 2) [px], NaN where unseen: the markers at the two outermost stops of this side, for
    each of the p positions of the spread joint (1 without one), at the offsets ``last_at``, ``before_at`` from the
    base.
    """

    joint: int
    side: int
    k: int
    count: int
    """Number of stops planned on this side."""
    step: float
    """Distance between stops of this side [rad or m]; 0 until the probe has determined the range."""
    reach: FloatArray
    """Range of the joint upwards and downwards (2,), if it is planned from visibility."""
    turn: int
    """Index of the spread joint's position."""
    seen_turns: int
    last_at: float
    before: FloatArray
    before_at: float
    stops: IntArray
    """Number of stops recorded, by joint."""


class CheckMotion(PoseMeasurement, tag="checking", eq=False, kw_only=True):
    """The check motion: ``targets`` (s, n) one after the other."""

    targets: FloatArray
    index: int
    seen: int = 0
    """Number of stops at which every camera saw enough."""
    reset_zeros: bool = False
    quick: bool = False


class TeachingState(ObservationStatistics, eq=False):
    """Averaging of a goal that is being taught."""

    name: str
    request: int
    frames_wanted: int
    started_ns: int


class GoalResolution(msgspec.Struct, eq=False, kw_only=True):
    """Resolution of a target in the model's frame, one part of the computation after the other (`core.goals.resolve`).

    Start: the body at ``start`` (m, 4) with its ``faces``, the arm at ``joints`` (n,), corrected, with its
    ``operators`` (n, 4, 4). ``part``: the next part; ``rounds``: least-squares iterations done.

    Results: ``set_points`` (c, m, 2) ideal pixels with ``wanted`` (c, m) 1 or 0; ``points`` (m, 4) of height 1:
    the whole body at the goal, if ``pose_known``, and the ``displacement`` (4, 4) from its start; ``targets`` (m, 4)
    where ``known`` (m,): the points that determined it; ``face`` (3,): three of these that span a face.
    """

    joints: FloatArray
    start: FloatArray
    operators: FloatArray
    faces: Faces
    needs_pose: bool
    part: int
    rounds: int
    set_points: FloatArray
    wanted: FloatArray
    targets: FloatArray
    known: BoolArray
    pose_known: bool
    face: IntArray
    displacement: FloatArray
    points: FloatArray


Purpose = Literal["reply", "enqueue", "queue", "ahead", "again"]


class PlanJob(msgspec.Struct, eq=False, kw_only=True):
    """A goal that is being resolved, then planned, and the resulting ``source``.

    ``purpose``: to answer ``request``; to queue the goal, which answers ``request``; the next goal of the queue; the
    goal after the active one, ahead of time; or the active one again. Planned from ``joints`` (n,) with the body at
    ``points`` (m, 4).
    """

    request: int
    purpose: Purpose
    goal: Goal
    source: ServoGoal | None
    planning: PlanningState | None
    joints: FloatArray
    points: FloatArray
    resolution: GoalResolution | None = None


Source = (
    Holding
    | AwaitingAcknowledgement
    | Jogging
    | JointMove
    | ServoGoal
    | IncidenceGoal
    | CalibrationMotion
    | SweepMotion
    | CheckMotion
)


class CoreState(msgspec.Struct, eq=False):
    """The complete state of the core: the numbers that kernels use in a ``block``, and the rest."""

    version: int
    block: Block
    step: int
    event_seq: int
    lifecycle: Lifecycle
    readiness: ModelReadiness
    model: CellModel | None
    pending_model: CellModel | None
    refused_joints: Refused
    refused_frames: list[Refused]
    """By camera."""
    cameras: list[CameraEstimate]
    source: Source
    queue: list[Goal]
    queued_until_ns: dict[str, int]
    """Times at which the leases of queued goals expire, by id."""
    planning: PlanJob | None
    waiting: list[Request]
    """Requests that are answered after the goal that is being planned."""
    ahead: ServoGoal | None
    """The next goal of the queue, planned from where the active one ends."""
    not_ahead: str
    """Id of a queued goal that cannot be planned ahead of its turn."""
    teaching: TeachingState | None
    held: bool
    stopped: bool
    stop_reason: Reason | None
    """Why the core stopped the arm; None if a person did."""
    fault: list[Reason]
    driver_request: str
    loads: JointLoadStatistics | None
    watching: ModelMonitor
    reanchoring: Relocalization | None
    """While it is not None, no law runs: its goal waits."""
    pending_reanchored: tuple[str, ...]
    """Of ``pending_model``: see `cycle.ModelUpdate`."""
    mobile: list[MobileCamera | None]
    """By camera; None for permanently static cameras."""
    adjusted: tuple[str, ...]
    """Mobile cameras whose matrix in ``model`` differs from the model of its epoch as it was handed in."""
    friction_of: str = ""
    """The goal for which friction is compensated; empty: none."""
    target: TargetBody | None = None
    """The target body that moves on its own and is followed; None before a goal has named it."""
    pending_kept: bool = False
    """Of ``pending_model``: see `cycle.ModelUpdate`."""
    comparison: ModelComparison | None = None
    """Of a kept model with the images; None once they have confirmed it, and for a model of this run."""

    @property
    def history(self) -> JointHistory:
        """The recent joint samples: arrays of the block, and their current count."""
        block = self.block
        return JointHistory(block.history_ns, block.history_positions, block.numbers.history_count)


def initial_state(settings: CoreSettings) -> CoreState:
    """The state before the first step: no estimates, and no motion allowed."""
    n = len(settings.joint_names)
    state = CoreState(
        version=STATE_VERSION,
        block=Block(
            {
                "joints": n,
                "cameras": len(settings.cameras),
                "markers": 0,
                "rows": 0,
                "window": 1 if settings.contact is None else settings.contact.samples,
                "past": steps_of_delay(settings.rate_hz),
            }
        ),
        step=0,
        event_seq=0,
        lifecycle=Lifecycle.UNCONFIGURED,
        readiness=ModelReadiness.NONE,
        model=None,
        pending_model=None,
        refused_joints=Refused(),
        refused_frames=[Refused() for _ in settings.cameras],
        cameras=[CameraEstimate(0) for _ in settings.cameras],
        source=Holding(),
        queue=[],
        queued_until_ns={},
        planning=None,
        waiting=[],
        ahead=None,
        not_ahead="",
        teaching=None,
        held=False,
        stopped=False,
        stop_reason=None,
        fault=[],
        driver_request="",
        loads=None,
        watching=nothing_sighted(len(settings.cameras), 0, n, 0),
        reanchoring=None,
        pending_reanchored=(),
        mobile=[None for _ in settings.cameras],
        adjusted=(),
    )
    share_observations(state)
    return state


def share_observations(state: CoreState) -> None:
    """Move the cameras' estimates and their newest frames into the block."""
    block, frames = state.block, state.watching.sightings
    markers, rows = (state.cameras[0].sigma.size, frames[0].seen.size) if frames else (0, 0)
    block.begin_observations(markers, rows)
    for here, camera in zip(block.estimates, state.cameras, strict=True):
        here.become(camera)
    for seen, frame in zip(block.sightings, frames, strict=True):
        seen.become(frame)
    state.cameras, state.watching.sightings = block.estimates, block.sightings
