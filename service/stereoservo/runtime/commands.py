"""What a client may ask of a cell: goals and commands, as strict structs used on the wire and inside the core.

Numbers are SI ([m], [rad], [s]) and pixels. Every struct refuses unknown fields. Non-finite numbers are refused by
:func:`stereoservo.gateway.messages.decode`, since JSON cannot carry them.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
GoalId = Annotated[str, Meta(pattern=r"^[0-9a-fA-F]{8}[0-9a-fA-F-]{0,28}$")]
Positive = Annotated[float, Meta(gt=0)]
Gain = Annotated[float, Meta(gt=0, le=50)]
Pixels = Annotated[float, Meta(gt=0, le=1000)]
Lease = Annotated[float, Meta(ge=0.3, le=3600)]
Fraction = Annotated[float, Meta(gt=0, le=1)]

LAWS = ("stereo", "cartesian3")
LawName = Literal["stereo", "cartesian3"]
PointSource = Literal["triangulated", "predicted"]


class FeatureTarget(
    msgspec.Struct, frozen=True, tag="features", tag_field="kind", forbid_unknown_fields=True
):
    """Set-points: for each camera, marker id -> (u, v), raw pixels. ``model_epoch``: None, or refuse another model."""

    set_points: dict[str, dict[int, tuple[float, float]]]
    model_epoch: Annotated[int, Meta(ge=0, le=2**63 - 1)] | None = None


class TaughtTarget(msgspec.Struct, frozen=True, tag="taught", tag_field="kind", forbid_unknown_fields=True):
    """A goal that was shown before, by its name."""

    name: Name


class JointTarget(msgspec.Struct, frozen=True, tag="joints", tag_field="kind", forbid_unknown_fields=True):
    """Joint positions by joint name [rad or m]; joints left out stay where they are."""

    positions: dict[str, float]


Target = FeatureTarget | TaughtTarget | JointTarget


class Goal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A goal as a client states it. What is None takes the cell's default.

    ``lease_s``: the goal is aborted when no renewal arrives for so long (None: no lease). ``tolerance_px``: largest
    pixel distance over visible markers and cameras, held ``hold_frames`` frames. ``speed_scale`` may only lower.
    """

    id: GoalId
    target: Target
    law: LawName | None = None
    points: PointSource | None = None
    gain: Gain | None = None
    tolerance_px: Pixels | None = None
    hold_frames: Annotated[int, Meta(ge=1, le=10_000)] | None = None
    speed_scale: Fraction = 1.0
    lease_s: Lease | None = None
    time_limit_s: Positive | None = None
    mode: Literal["preempt", "queue"] = "preempt"
    check: bool = False


class RunGoal(msgspec.Struct, frozen=True, tag="goal", tag_field="command", forbid_unknown_fields=True):
    """Accept a goal (or, with ``goal.check``, answer whether it would be accepted)."""

    goal: Goal


class RenewGoal(msgspec.Struct, frozen=True, tag="renew", tag_field="command", forbid_unknown_fields=True):
    """Renew the lease of a goal."""

    id: GoalId


class CancelGoal(msgspec.Struct, frozen=True, tag="cancel", tag_field="command", forbid_unknown_fields=True):
    """Cancel a goal; its terminal event is ``cancelled``."""

    id: GoalId


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


class Home(msgspec.Struct, frozen=True, tag="home", tag_field="command", forbid_unknown_fields=True):
    """Move every joint to the cell's home position."""

    id: GoalId
    speed_scale: Fraction = 1.0
    lease_s: Lease | None = None


class Calibrate(
    msgspec.Struct, frozen=True, tag="calibrate", tag_field="command", forbid_unknown_fields=True
):
    """Run the trial motions of the cell file and fit a model.

    ``check``: run the short check motion instead, and say whether the model still holds. ``lease_s``: the motion ends
    when no renewal arrives for so long (None: no lease); the fit that follows it needs no client. ``reset_zeros``, with
    ``check``: where the zeros of joints have drifted, and nothing else, make a model with moved zeros.
    """

    id: GoalId
    check: bool = False
    lease_s: Lease | None = None
    reset_zeros: bool = False


class Teach(msgspec.Struct, frozen=True, tag="teach", tag_field="command", forbid_unknown_fields=True):
    """Store what the cameras see now, averaged over ``frames`` frames a camera, as a goal named ``name``."""

    name: Name
    frames: Annotated[int, Meta(ge=1, le=1000)] = 20


Command = (
    RunGoal
    | RenewGoal
    | CancelGoal
    | Hold
    | Resume
    | Enable
    | Disable
    | Reset
    | Jog
    | Home
    | Calibrate
    | Teach
)


class Request(msgspec.Struct, frozen=True):
    """A command on its way to the core: answered by exactly one reply event with the same ``request`` number."""

    request: int
    operator: str
    command: Command
