"""Goals and commands that a client may send, as strict structs used on the wire and inside the core.

Numbers are SI ([m], [rad], [s]) and pixels. Every struct refuses unknown fields. Non-finite numbers are refused by
:func:`stereoservo.messages.wire.decode`, since JSON cannot carry them.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
GoalId = Annotated[str, Meta(pattern=r"^[0-9a-fA-F]{8}[0-9a-fA-F-]{0,28}$")]
Positive = Annotated[float, Meta(gt=0)]
Duration = Annotated[float, Meta(gt=0, le=86_400)]
"""[s], a day at most."""
Gain = Annotated[float, Meta(ge=1e-4, le=50)]
Damping = Annotated[float, Meta(ge=0, lt=1)]
Pixels = Annotated[float, Meta(ge=1e-4, le=1000)]
Lease = Annotated[float, Meta(ge=0.3, le=3600)]
Fraction = Annotated[float, Meta(ge=1e-4, le=1)]

LAW_TITLE = "LawName"
LawName = Annotated[str, Meta(min_length=1, max_length=64, title=LAW_TITLE)]
"""Of a law that is installed where the daemon runs: `CellInfo.laws` and the served schemas list them."""
DEFAULT_LAW = "cartesian3"
"""Of cells that name none."""
PointSource = Literal["triangulated", "predicted"]
JacobianName = Literal["current", "desired", "mean", "fixed-depth"]
ProfileName = Literal["linear", "exponential", "translation-first", "rotation-first", "planar-first"]
Epoch = Annotated[int, Meta(ge=0, le=2**63 - 1)]
MarkerId = Annotated[int, Meta(ge=0, le=2**31 - 1)]
Homogeneous = tuple[float, float, float, float]
Pixel = tuple[float, float]


class FeatureTarget(
    msgspec.Struct, frozen=True, tag="features", tag_field="kind", forbid_unknown_fields=True
):
    """Set-points: for each camera, marker id -> (u, v), raw pixels. ``model_epoch``: None, or refuse another model."""

    set_points: dict[str, dict[int, Pixel]]
    model_epoch: Epoch | None = None


class PointTarget(msgspec.Struct, frozen=True, tag="points", tag_field="kind", forbid_unknown_fields=True):
    """Marker id -> homogeneous point in the model's projective frame; three or more, not on one line.

    ``model_epoch``: of the model in whose frame they are.
    """

    points: dict[int, Homogeneous]
    model_epoch: Epoch


class DisplacementTarget(
    msgspec.Struct, frozen=True, tag="displacement", tag_field="kind", forbid_unknown_fields=True
):
    """A displacement of the marker body from its present pose: 4x4, row-major, projective, current -> goal.

    Either in the frame of the model of ``model_epoch``, or in the projective basis of five markers ``basis`` of the
    body, no four of them in a plane: in the coordinates in which these are e1 … e4 and (1, 1, 1, 1) now, so that no
    calibration is in it.
    """

    matrix: Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]
    model_epoch: Epoch | None = None
    basis: tuple[MarkerId, MarkerId, MarkerId, MarkerId, MarkerId] | None = None


class TaughtTarget(msgspec.Struct, frozen=True, tag="taught", tag_field="kind", forbid_unknown_fields=True):
    """A taught goal, by its name.

    ``relative_to``: where it holds. None: the pixels as they were taught, with the same model. ``"workpiece"``:
    relative to the ``common`` markers on the workpiece, which may have moved since. ``"cameras"``: the
    ``common`` markers stood still, and the cameras have moved or were exchanged. ``common``: five ids or more, seen
    when it was taught and now; empty: all that are both. ``lines``: edges of the workpiece instead of markers, or
    beside them (then only those in ``common`` that are named), each by two ids whose pixels lie on it in every image;
    the two need not be the same places in two images, nor then and now. ``planes``: faces of it, each by ids whose
    points lie on it, one or more seen when it was taught and three or more, perhaps others, now.
    """

    name: Name
    relative_to: Literal["workpiece", "cameras"] | None = None
    common: tuple[MarkerId, ...] = ()
    lines: Annotated[tuple[tuple[MarkerId, MarkerId], ...], Meta(max_length=64)] = ()
    planes: Annotated[
        tuple[Annotated[tuple[MarkerId, ...], Meta(min_length=3, max_length=64)], ...], Meta(max_length=16)
    ] = ()


class JointTarget(msgspec.Struct, frozen=True, tag="joints", tag_field="kind", forbid_unknown_fields=True):
    """Joint positions by joint name [rad or m]; joints left out stay where they are."""

    positions: dict[str, float]


class Feature(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A point, line or plane: the span of one, two or three points, specified in exactly one way.

    ``markers``: of the moving body, as they move. ``points``: homogeneous, in the frame of the goal's ``model_epoch``.
    ``pixels``: for each of two or more cameras the points' raw pixels, where they are. ``segments``: of a line, for
    each of two or more cameras two raw pixels of its image, which need not be the same places in two images.
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


class IncidenceTarget(
    msgspec.Struct, frozen=True, tag="incidence", tag_field="kind", forbid_unknown_fields=True
):
    """Incidence constraints; the remaining degrees of freedom stay free, or serve ``secondary`` in their null
    space.

    ``secondary``: joint positions, or set-points, approached as far as the incidences allow.
    """

    incidences: Annotated[tuple[IncidenceSpec, ...], Meta(min_length=1, max_length=16)]
    secondary: JointTarget | FeatureTarget | None = None
    model_epoch: Epoch | None = None


Target = FeatureTarget | PointTarget | DisplacementTarget | TaughtTarget | JointTarget | IncidenceTarget
StreamedTarget = FeatureTarget | PointTarget


class Centre(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Point of the body that moves on a straight line, specified in exactly one way.

    ``markers``: their affine middle. ``point``: homogeneous, where it is now in the frame of the model of
    ``model_epoch``, moving with the body.
    """

    markers: tuple[MarkerId, ...] = ()
    point: Homogeneous | None = None
    model_epoch: Epoch | None = None


class AdaptiveGain(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Adaptive gain ``λ(e) = (near − far) exp(−slope·e / (near − far)) + far``: ``near`` at no error, ``far`` at a
    large one [1/s].

    ``slope`` [1/s per 100 px]: how fast it falls from ``near``.
    """

    near: Gain
    far: Gain
    slope: Positive = 10.0


class Goal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A goal as a client states it; for fields that are None the cell's default applies.

    ``lease_s``: the goal is aborted when no renewal arrives for so long (None: no lease). ``tolerance_px``: largest
    pixel distance over visible markers and cameras, held ``hold_frames`` frames. ``speed_scale`` may only lower.
    ``cameras``: whose images the law may use (None: all). ``profile``: of laws that follow a plan; ``posture``
    likewise: joint positions by name [rad or m] near which the plan ends, where the arm reaches the goal by several
    postures; joints left out are near to where they are now.

    ``damping`` κ: share of the joints' measured velocity, less what a moving target or a plan asks for, that is taken
    from the law's (thesis 9.3, `control.pd`). An error then decays at ``gain / (1 + damping)``.

    ``blend_px``: hand over to the next queued goal as soon as the error is below it, without stopping; without one it
    is reached as usual. ``acknowledge_s``: reached, the arm holds there and the queue waits until a client
    acknowledges (a gripper has closed), at most so long; then, and where it is not reached, the queue is cancelled.

    ``follow_markers``: of a target that moves by itself, which the goal goes with. Cameras on the arm: of the body that
    they see; else of another body, five or more. ``follow_seen``: for each camera, where these markers are (raw pixels)
    when the target stands where the goal's set-points hold; none: where they are when it begins.
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

    ``subject``: the joint, keep-out or camera; ``marker``: the one that comes near, where one does.
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

    ``shares`` [0, 1] and ``joints`` by name at these; ``pixels``: camera -> marker -> raw pixels there.
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

    ``stamp_s``: the client's time of this set-point; from two of them the target's velocity is fed forward. None: the
    time of arrival is used.
    """

    id: GoalId
    target: StreamedTarget
    stamp_s: float | None = None


class AcknowledgeGoal(
    msgspec.Struct, frozen=True, tag="acknowledge", tag_field="command", forbid_unknown_fields=True
):
    """Release a reached goal with ``acknowledge_s``, so that the queue continues."""

    id: GoalId


class CancelGoal(msgspec.Struct, frozen=True, tag="cancel", tag_field="command", forbid_unknown_fields=True):
    """Cancel a goal; its terminal event is ``cancelled``."""

    id: GoalId


class Stop(msgspec.Struct, frozen=True):
    """Payload of ``command/stop``: who stops the arm, for people. Any other payload stops it as well."""

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
    """FAULT -> INACTIVE, where the cause has gone."""


class Jog(msgspec.Struct, frozen=True, tag="jog", tag_field="command", forbid_unknown_fields=True):
    """Joint velocities by name [rad/s or m/s] for ``lease_s`` from receipt: a dead man's switch, renewed by jogs."""

    velocities: dict[str, float]
    lease_s: Annotated[float, Meta(gt=0, le=1.0)] = 0.25


class AuxiliarySpec(msgspec.Struct, frozen=True):
    """An auxiliary joint (a gripper) or a digital output, as its driver declares it: outside the model and the laws.

    ``kind``: ``revolute`` [rad], ``prismatic`` [m], or ``digital``, 0 or 1. ``low``, ``high``: what may be ordered;
    ``velocity``: at which the driver moves the joint.
    """

    name: str
    kind: Literal["revolute", "prismatic", "digital"]
    low: float = 0.0
    high: float = 1.0
    velocity: float = 0.0


class OrderAuxiliary(
    msgspec.Struct, frozen=True, tag="auxiliary", tag_field="command", forbid_unknown_fields=True
):
    """Order positions of auxiliary joints [rad or m] and digital outputs (0 or 1) by name."""

    values: dict[str, float]


class Home(msgspec.Struct, frozen=True, tag="home", tag_field="command", forbid_unknown_fields=True):
    """Move every joint to the cell's home position."""

    id: GoalId
    speed_scale: Fraction = 1.0
    lease_s: Lease | None = None


class Calibrate(
    msgspec.Struct, frozen=True, tag="calibrate", tag_field="command", forbid_unknown_fields=True
):
    """Run the trial motions of the cell file and fit a model.

    ``check``: run the short check motion instead, and report whether the model still holds. ``lease_s``: the motion
    ends when no renewal arrives for so long (None: no lease); the fit that follows it needs no client.
    ``reset_zeros``, with ``check``: where the zeros of joints have drifted, and nothing else, make a model with
    moved zeros.
    """

    id: GoalId
    check: bool = False
    lease_s: Lease | None = None
    reset_zeros: bool = False


class Teach(msgspec.Struct, frozen=True, tag="teach", tag_field="command", forbid_unknown_fields=True):
    """Store the current observations, averaged over ``frames`` frames a camera, as a goal named ``name``.

    ``tool``: the markers by which the goal is meant, features of the tool rather than the hand's own; three or more.
    The gateway keeps them; to the core they mean nothing.
    """

    name: Name
    frames: Annotated[int, Meta(ge=1, le=1000)] = 20
    tool: tuple[MarkerId, ...] = ()


class ReanchorRefused(
    msgspec.Struct, frozen=True, tag="reanchor_refused", tag_field="command", forbid_unknown_fields=True
):
    """Reply of the fit to the event ``reanchor`` where it cannot relocalize the cameras; they stay suspended.

    From the process that fits; no client may send it.
    """

    message: str
    value: float | None = None
    threshold: float | None = None
    unit: str = ""


class ExtendLeases(
    msgspec.Struct, frozen=True, tag="extend_leases", tag_field="command", forbid_unknown_fields=True
):
    """All leases, and what waits to be acknowledged, end by ``seconds`` later: nobody could hear the clients so long.

    From the servo process; no client may send it, and it is not answered.
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
