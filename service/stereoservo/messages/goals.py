"""Goals and commands that a client may send, as strict structs used in messages and inside the core.

Numbers are SI ([m], [rad], [s]) and pixels. Every struct rejects unknown fields. Non-finite numbers are rejected by
:func:`stereoservo.messages.wire.decode`, since JSON cannot represent them.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
GoalId = Annotated[str, Meta(pattern=r"^[0-9a-fA-F]{8}[0-9a-fA-F-]{0,28}$")]
Positive = Annotated[float, Meta(gt=0)]
Duration = Annotated[float, Meta(gt=0, le=86_400)]
"""Duration [s], at most a day."""
Gain = Annotated[float, Meta(ge=1e-4, le=50)]
Damping = Annotated[float, Meta(ge=0, lt=1)]
Pixels = Annotated[float, Meta(ge=1e-4, le=1000)]
Lease = Annotated[float, Meta(ge=0.3, le=3600)]
Fraction = Annotated[float, Meta(ge=1e-4, le=1)]

LAW_TITLE = "LawName"
LawName = Annotated[str, Meta(min_length=1, max_length=64, title=LAW_TITLE)]
"""Name of a law that is installed where the daemon runs: `CellInfo.laws` and the served schemas list them."""
DEFAULT_LAW = "cartesian3"
"""Law of cells that name none."""
PointSource = Literal["triangulated", "predicted"]
JacobianName = Literal["current", "desired", "mean", "fixed-depth"]
ProfileName = Literal["linear", "exponential", "translation-first", "rotation-first", "planar-first"]
Epoch = Annotated[int, Meta(ge=0, le=2**63 - 1)]
MarkerId = Annotated[int, Meta(ge=0, le=2**31 - 1)]
Homogeneous = tuple[float, float, float, float]
Pixel = tuple[float, float]
Vector = tuple[float, float, float]
Matrix = Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]


class FeatureTarget(msgspec.Struct, frozen=True, tag="features", tag_field="kind", forbid_unknown_fields=True):
    """Set-points: for each camera, marker id -> (u, v), raw pixels. ``model_epoch``: the goal is refused with another
    model; None: any model.
    """

    set_points: dict[str, dict[int, Pixel]]
    model_epoch: Epoch | None = None


class PointTarget(msgspec.Struct, frozen=True, tag="points", tag_field="kind", forbid_unknown_fields=True):
    """Marker id -> homogeneous point in the model's projective frame; three or more, not collinear.

    ``model_epoch``: of the model in whose frame they are stated.
    """

    points: dict[int, Homogeneous]
    model_epoch: Epoch


class MetricFrame(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A Euclidean frame in the model's: ``pose``, 4x4, row-major, maps coordinates in it [m] to projective points, at
    the model's zero if it moves ``with_body``, the marker body.

    ``pivot`` [m]: coordinates, at the model's zero, of the point about which a displacement acts in place of the
    frame's origin; it moves with the body if ``pivot_with_body``. ``scaled``: False if the unit of length is unknown.
    """

    name: str
    pose: Matrix
    with_body: bool
    pivot: Vector
    pivot_with_body: bool
    scaled: bool = True


class DisplacementTarget(msgspec.Struct, frozen=True, tag="displacement", tag_field="kind", forbid_unknown_fields=True):
    """A displacement of the marker body from its current pose: 4x4, row-major, projective, current -> goal.

    Either in the frame of the model of ``model_epoch``, or in the projective basis of five markers ``basis`` of the
    body, no four of them coplanar: in the coordinates in which their current positions are e1 … e4 and (1, 1, 1, 1), so
    that it does not depend on a calibration.
    ``frame``, with ``model_epoch``: the matrix is rigid [m] in this frame, and displaces what the arm carries; this is
    the form of a `StepTarget` inside the daemon.
    """

    matrix: Matrix
    model_epoch: Epoch | None = None
    basis: tuple[MarkerId, MarkerId, MarkerId, MarkerId, MarkerId] | None = None
    frame: MetricFrame | None = None


class StepTarget(msgspec.Struct, frozen=True, tag="step", tag_field="kind", forbid_unknown_fields=True):
    """A step of what the arm carries, from its current pose, along and about the axes of a ``frame``: ``tool``,
    ``base``, ``camera:NAME``, or ``scene:A-B-C`` by three markers that do not move with the arm.

    ``move`` [m], and ``turn`` [rad], a rotation vector of up to 180°, about the middle of the markers (cameras on the
    arm: the centre of the first camera) or the goal's ``centre``. Or ``matrix``: 4x4, row-major, rigid [m], in the
    frame's coordinates, about its origin.
    ``length``: a known length, ``WHAT:OF=METRES``, for the scale; empty: the cell's, or the unit of a prismatic joint.
    """

    frame: Annotated[str, Meta(max_length=200)] = "tool"
    move: Vector = (0.0, 0.0, 0.0)
    turn: Vector = (0.0, 0.0, 0.0)
    matrix: Matrix | None = None
    length: Annotated[str, Meta(max_length=200)] = ""


class TaughtTarget(msgspec.Struct, frozen=True, tag="taught", tag_field="kind", forbid_unknown_fields=True):
    """A taught goal, by its name.

    ``relative_to``: the reference of the goal. None: the pixels as they were taught, with the same model.
    ``"workpiece"``:
    relative to the ``common`` markers on the workpiece, which may have moved since. ``"cameras"``: the ``common``
    markers are static, and the cameras have moved or were exchanged.
    ``common``: five ids or more, seen in teaching and now; empty: all that were seen both times.
    ``lines``: edges of the workpiece instead of markers, or in addition to them (then only the markers named in
    ``common``), each by two ids whose pixels are on the edge in every image;
    the two points may differ between images, and between teaching and now.
    ``planes``: faces of the workpiece, each by ids whose points are on it, one or more seen in teaching and three or
    more, possibly others, now.
    """

    name: Name
    relative_to: Literal["workpiece", "cameras"] | None = None
    common: tuple[MarkerId, ...] = ()
    lines: Annotated[tuple[tuple[MarkerId, MarkerId], ...], Meta(max_length=64)] = ()
    planes: Annotated[
        tuple[Annotated[tuple[MarkerId, ...], Meta(min_length=3, max_length=64)], ...], Meta(max_length=16)
    ] = ()


class JointTarget(msgspec.Struct, frozen=True, tag="joints", tag_field="kind", forbid_unknown_fields=True):
    """Joint positions by joint name [rad or m]; joints that are omitted do not move."""

    positions: dict[str, float]


class Feature(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A point, line or plane: the span of one, two or three points, specified in exactly one way.

    ``markers``: of the moving body; the feature moves with them.
    ``points``: homogeneous, in the frame of the goal's ``model_epoch``.
    ``pixels``: for each of two or more cameras the raw pixels of the points.
    ``segments``: of a line, for each of two or more cameras two raw pixels of its image; the two points may differ
    between images.
    """

    markers: Annotated[tuple[MarkerId, ...], Meta(max_length=3)] = ()
    points: Annotated[tuple[Homogeneous, ...], Meta(max_length=3)] = ()
    pixels: dict[str, Annotated[tuple[Pixel, ...], Meta(max_length=3)]] = {}
    segments: dict[str, tuple[Pixel, Pixel]] = {}


IncidenceKind = Literal[
    "point-on-point", "point-on-line", "point-on-plane", "line-on-line", "line-on-plane", "plane-on-plane"
]


class IncidenceSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Incidence constraint: ``moving`` (of the body) shall lie on ``fixed`` (in the scene) (2.5.3)."""

    kind: IncidenceKind
    moving: Feature
    fixed: Feature


class IncidenceTarget(msgspec.Struct, frozen=True, tag="incidence", tag_field="kind", forbid_unknown_fields=True):
    """Incidence constraints; the remaining degrees of freedom are free, or serve ``secondary`` in their null space.

    ``secondary``: joint positions, or set-points, approached as far as the incidences allow.
    """

    incidences: Annotated[tuple[IncidenceSpec, ...], Meta(min_length=1, max_length=16)]
    secondary: JointTarget | FeatureTarget | None = None
    model_epoch: Epoch | None = None


Target = FeatureTarget | PointTarget | DisplacementTarget | StepTarget | TaughtTarget | JointTarget | IncidenceTarget
StreamedTarget = FeatureTarget | PointTarget


class Centre(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Point of the body that moves on a straight line, specified in exactly one way.

    ``markers``: their affine centroid. ``point``: homogeneous, its current position in the frame of the model of
    ``model_epoch``; it moves with the body.
    """

    markers: tuple[MarkerId, ...] = ()
    point: Homogeneous | None = None
    model_epoch: Epoch | None = None


class AdaptiveGain(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Adaptive gain ``λ(e) = (near − far) exp(−slope·e / (near − far)) + far``: ``near`` at no error, ``far`` at a
    large one [1/s].

    ``slope`` [1/s per 100 px]: how fast it decreases from ``near``.
    """

    near: Gain
    far: Gain
    slope: Positive = 10.0


class Goal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A goal as a client states it; for fields that are None the cell's default applies.

    ``lease_s``: the goal is aborted if no renewal arrives for so long (None: no lease).
    ``tolerance_px``: largest pixel distance over visible markers and cameras, held for ``hold_frames`` frames.
    ``speed_scale``: may only lower the speed.
    ``cameras``: whose images the law may use (None: all).
    ``profile``: for laws that follow a plan.
    ``posture``: for laws that follow a plan: joint positions by name [rad or m] near which the plan ends, if the arm
    reaches the goal in several postures; omitted joints end near their current positions.

    ``damping`` κ: fraction of the joints' measured velocity, less that of a moving target or a plan, that is subtracted
    from the law's (thesis 9.3, `control.pd`). An error then decays at ``gain / (1 + damping)``.

    ``blend_px``: start the next queued goal as soon as the error is below it, without stopping; without a next goal it
    is reached as usual.
    ``acknowledge_s``: when the goal is reached, the arm holds there and the queue waits until a client acknowledges (a
    gripper has closed), at most so long; after that time, and if the goal is not reached, the queue is cancelled.

    ``follow_markers``: of a target that moves on its own and is followed by the goal. With cameras on the arm: markers
    of the body that they see; else of another body, five or more.
    ``follow_seen``: for each camera, the raw pixels of these markers at the target's pose for which the goal's
    set-points are stated; none: their pixels when the goal starts.
    """

    id: GoalId
    target: Target
    law: LawName | None = None
    points: PointSource | None = None
    jacobian: JacobianName | None = None
    centre: Centre | None = None
    cameras: tuple[str, ...] | None = None
    profile: ProfileName | None = None
    posture: dict[str, float] | None = None
    gain: Gain | AdaptiveGain | None = None
    damping: Damping | None = None
    tolerance_px: Pixels | None = None
    hold_frames: Annotated[int, Meta(ge=1, le=10_000)] | None = None
    speed_scale: Fraction = 1.0
    lease_s: Lease | None = None
    time_limit_s: Duration | None = None
    mode: Literal["preempt", "queue"] = "preempt"
    blend_px: Pixels | None = None
    acknowledge_s: Duration | None = None
    follow_markers: tuple[MarkerId, ...] = ()
    follow_seen: dict[str, dict[int, Pixel]] = {}
    check: bool = False


class Approach(msgspec.Struct, frozen=True):
    """Closest approach of the planned path to a limit: clearance ``room`` [``unit``] at path parameter ``share``.

    ``subject``: the joint, keep-out or camera; ``marker``: the marker that comes near, if there is one.
    """

    code: str
    subject: str
    value: float
    limit: float
    room: float
    unit: str
    share: float
    marker: int | None = None


class PlanReport(msgspec.Struct, frozen=True):
    """The plan of a goal: its duration ``seconds``, its path, and the closest approach to every limit.

    ``shares`` [0, 1] and ``joints`` by name at these path parameters; ``pixels``: camera -> marker -> raw pixels there.
    """

    law: str
    way: str
    seconds: float
    approaches: tuple[Approach, ...]
    shares: tuple[float, ...]
    joints: dict[str, tuple[float, ...]]
    pixels: dict[str, dict[int, tuple[Pixel, ...]]]


class RunGoal(msgspec.Struct, frozen=True, tag="goal", tag_field="command", forbid_unknown_fields=True):
    """Accept a goal (or, with ``goal.check``, answer whether it would be accepted)."""

    goal: Goal


class RenewGoal(msgspec.Struct, frozen=True, tag="renew", tag_field="command", forbid_unknown_fields=True):
    """Renew the lease of a goal."""

    id: GoalId


class UpdateGoal(msgspec.Struct, frozen=True, tag="update", tag_field="command", forbid_unknown_fields=True):
    """Move the set-points of the active goal: a moving target, streamed at 30 to 200 Hz. It also renews the lease.

    ``stamp_s``: the client's time of this set-point; the target's velocity is computed from two stamps and fed forward.
    None: the time of arrival is used.
    """

    id: GoalId
    target: StreamedTarget
    stamp_s: float | None = None


class AcknowledgeGoal(msgspec.Struct, frozen=True, tag="acknowledge", tag_field="command", forbid_unknown_fields=True):
    """Release a reached goal with ``acknowledge_s``, so that the queue continues."""

    id: GoalId


class CancelGoal(msgspec.Struct, frozen=True, tag="cancel", tag_field="command", forbid_unknown_fields=True):
    """Cancel a goal; its terminal event is ``cancelled``."""

    id: GoalId


class Stop(msgspec.Struct, frozen=True):
    """Payload of ``command/stop``: who stops the arm, as text. Any other payload stops it as well."""

    operator: Annotated[str, Meta(pattern="^[A-Za-z0-9_. -]{1,64}$")]


class Hold(msgspec.Struct, frozen=True, tag="hold", tag_field="command", forbid_unknown_fields=True):
    """Decelerate and hold; the goal is kept and may be resumed."""


class Resume(msgspec.Struct, frozen=True, tag="resume", tag_field="command", forbid_unknown_fields=True):
    """Leave hold, from a fresh measured state."""


class Enable(msgspec.Struct, frozen=True, tag="enable", tag_field="command", forbid_unknown_fields=True):
    """INACTIVE -> ACTIVE: the arm may move afterwards."""


class Disable(msgspec.Struct, frozen=True, tag="disable", tag_field="command", forbid_unknown_fields=True):
    """ACTIVE -> INACTIVE, with the arm stopped; aborts the goal."""


class Reset(msgspec.Struct, frozen=True, tag="reset", tag_field="command", forbid_unknown_fields=True):
    """FAULT -> INACTIVE, if the cause has gone."""


class Jog(msgspec.Struct, frozen=True, tag="jog", tag_field="command", forbid_unknown_fields=True):
    """Joint velocities by name [rad/s or m/s] for ``lease_s`` from receipt: a dead man's switch, renewed by jogs."""

    velocities: dict[str, float]
    lease_s: Annotated[float, Meta(gt=0, le=1.0)] = 0.25


class AuxiliarySpec(msgspec.Struct, frozen=True):
    """An auxiliary joint (a gripper) or a digital output, as its driver declares it: not part of the model and the
    laws.

    ``kind``: ``revolute`` [rad], ``prismatic`` [m], or ``digital``, 0 or 1. ``low``, ``high``: permitted range;
    ``velocity``: at which the driver moves the joint.
    """

    name: str
    kind: Literal["revolute", "prismatic", "digital"]
    low: float = 0.0
    high: float = 1.0
    velocity: float = 0.0


class OrderAuxiliary(msgspec.Struct, frozen=True, tag="auxiliary", tag_field="command", forbid_unknown_fields=True):
    """Command positions of auxiliary joints [rad or m] and digital outputs (0 or 1) by name."""

    values: dict[str, float]


class Home(msgspec.Struct, frozen=True, tag="home", tag_field="command", forbid_unknown_fields=True):
    """Move every joint to the cell's home position."""

    id: GoalId
    speed_scale: Fraction = 1.0
    lease_s: Lease | None = None


class Calibrate(msgspec.Struct, frozen=True, tag="calibrate", tag_field="command", forbid_unknown_fields=True):
    """Run the trial motions of the cell file and fit a model.

    ``check``: run the short check motion instead, and report whether the model is still valid; with ``quick``, one of
    at most three seconds of motion around the present posture.
    ``lease_s``: the motion ends if no renewal arrives for so long (None: no lease); the subsequent fit needs no client.
    ``reset_zeros``, with ``check``: if the zeros of joints have drifted, and nothing else has changed, make a model
    with corrected zeros.
    """

    id: GoalId
    check: bool = False
    lease_s: Lease | None = None
    reset_zeros: bool = False
    quick: bool = False


class Teach(msgspec.Struct, frozen=True, tag="teach", tag_field="command", forbid_unknown_fields=True):
    """Store the current observations, averaged over ``frames`` frames a camera, as a goal named ``name``.

    ``tool``: the markers that define the goal, features of the tool rather than of the hand; three or more.
    They are stored by the gateway and not used by the core.
    """

    name: Name
    frames: Annotated[int, Meta(ge=1, le=1000)] = 20
    tool: tuple[MarkerId, ...] = ()


class ReanchorRefused(
    msgspec.Struct, frozen=True, tag="reanchor_refused", tag_field="command", forbid_unknown_fields=True
):
    """Reply of the fit to the event ``reanchor`` if it cannot relocalize the cameras; they remain suspended.

    Sent by the process that fits; no client may send it.
    """

    message: str
    value: float | None = None
    threshold: float | None = None
    unit: str = ""


class ExtendLeases(msgspec.Struct, frozen=True, tag="extend_leases", tag_field="command", forbid_unknown_fields=True):
    """Extend all leases and acknowledgement times by ``seconds``, during which clients could not be heard.

    Sent by the servo process; no client may send it, and it is not answered.
    """

    seconds: float


Command = (
    RunGoal
    | RenewGoal
    | CancelGoal
    | UpdateGoal
    | AcknowledgeGoal
    | Hold
    | Resume
    | Enable
    | Disable
    | Reset
    | Jog
    | OrderAuxiliary
    | Home
    | Calibrate
    | Teach
    | ReanchorRefused
    | ExtendLeases
)


class Request(msgspec.Struct, frozen=True):
    """A command for the core: answered by exactly one reply event with the same ``request`` number."""

    request: int
    operator: str
    command: Command
