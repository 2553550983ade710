"""What a page may ask of the server, as strict structs: one JSON object a WebSocket message, with ``do`` and a number
``n`` that the answer repeats.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from stereoservo.messages.goals import Goal, GoalId, Name, StreamedTarget
from stereoservo.messages.wire import decode

Number = Annotated[int, Meta(ge=0, le=2**53)]
Offset = Annotated[float, Meta(ge=-1e5, le=1e5)]


class Stop(msgspec.Struct, frozen=True, tag="stop", tag_field="do", forbid_unknown_fields=True):
    """Stop the arm. Every page may."""

    n: Number = 0


class Take(msgspec.Struct, frozen=True, tag="take", tag_field="do", forbid_unknown_fields=True):
    """Hold the arm, with the one-time token of the terminal."""

    token: Annotated[str, Meta(max_length=200)]
    n: Number = 0


class Release(msgspec.Struct, frozen=True, tag="release", tag_field="do", forbid_unknown_fields=True):
    """Hold the arm no longer."""

    n: Number = 0


class Enable(msgspec.Struct, frozen=True, tag="enable", tag_field="do", forbid_unknown_fields=True):
    """Let the arm move."""

    n: Number = 0


class Disable(msgspec.Struct, frozen=True, tag="disable", tag_field="do", forbid_unknown_fields=True):
    """Stop the arm and switch its drives off."""

    n: Number = 0


class Hold(msgspec.Struct, frozen=True, tag="hold", tag_field="do", forbid_unknown_fields=True):
    """Decelerate and hold; the goal is kept."""

    n: Number = 0


class Resume(msgspec.Struct, frozen=True, tag="resume", tag_field="do", forbid_unknown_fields=True):
    """Continue after hold or stop."""

    n: Number = 0


class Reset(msgspec.Struct, frozen=True, tag="reset", tag_field="do", forbid_unknown_fields=True):
    """Leave a fault whose cause is gone."""

    n: Number = 0


class Teach(msgspec.Struct, frozen=True, tag="teach", tag_field="do", forbid_unknown_fields=True):
    """Store what the cameras see as goal ``name``."""

    name: Name
    n: Number = 0


class Calibrate(msgspec.Struct, frozen=True, tag="calibrate", tag_field="do", forbid_unknown_fields=True):
    """Run the trial motions and fit a model; ``check``: the short check motion instead."""

    check: bool = False
    n: Number = 0


class Drag(msgspec.Struct, frozen=True, tag="drag", tag_field="do", forbid_unknown_fields=True):
    """Move the outline of the marker body in the picture of ``camera`` by ``shift`` [px] and ``turn`` [rad]; ``nearer``
    multiplies its depth.

    From where the last drag ended (``draft``) or from where the arm is. ``done``: the next drag goes on from here.
    Nothing moves.
    """

    camera: Name
    shift: tuple[Offset, Offset]
    turn: Annotated[float, Meta(ge=-7.0, le=7.0)] = 0.0
    nearer: Annotated[float, Meta(ge=0.5, le=2.0)] = 1.0
    draft: bool = False
    done: bool = False
    n: Number = 0


class Check(msgspec.Struct, frozen=True, tag="check", tag_field="do", forbid_unknown_fields=True):
    """Plan the taught goal ``name``, or ``goal``, or without either the dragged goal. Nothing moves."""

    name: Name | None = None
    goal: Goal | None = None
    n: Number = 0


class Go(msgspec.Struct, frozen=True, tag="go", tag_field="do", forbid_unknown_fields=True):
    """Send the goal that was checked last."""

    n: Number = 0


class Send(msgspec.Struct, frozen=True, tag="send", tag_field="do", forbid_unknown_fields=True):
    """Send ``goal``, of any kind; its lease is the server's, which renews it while the page is open."""

    goal: Goal
    n: Number = 0


class Update(msgspec.Struct, frozen=True, tag="update", tag_field="do", forbid_unknown_fields=True):
    """Move the set-points of the goal ``id``; ``stamp_s``: the page's own time of them."""

    id: GoalId
    target: StreamedTarget
    stamp_s: float | None = None
    n: Number = 0


class Cancel(msgspec.Struct, frozen=True, tag="cancel", tag_field="do", forbid_unknown_fields=True):
    """Cancel the active goal."""

    n: Number = 0


class Play(msgspec.Struct, frozen=True, tag="play", tag_field="do", forbid_unknown_fields=True):
    """Of a recording: play it, ``speed`` times as fast, or pause."""

    playing: bool = True
    speed: Annotated[float, Meta(ge=0.05, le=50.0)] | None = None
    n: Number = 0


class Seek(msgspec.Struct, frozen=True, tag="seek", tag_field="do", forbid_unknown_fields=True):
    """Of a recording: go to ``at`` [s] after its begin."""

    at: Annotated[float, Meta(ge=0.0, le=1e7)]
    n: Number = 0


PageRequest = (
    Stop
    | Take
    | Release
    | Enable
    | Disable
    | Hold
    | Resume
    | Reset
    | Teach
    | Calibrate
    | Drag
    | Check
    | Go
    | Send
    | Update
    | Cancel
    | Play
    | Seek
)
OPEN = (Stop, Take, Release)
"""What a page may ask that does not hold the arm."""
PLAYBACK = (Play, Seek)
"""What a page may ask of a recording, and of nothing else."""


class _Numbered(msgspec.Struct):
    n: Number = 0


def decode_request(data: bytes) -> PageRequest:
    """A page's request. Raises MessageError, whatever the bytes."""
    kind: type[PageRequest] = PageRequest  # type: ignore[assignment]
    return decode(data, kind)


def number_of(data: bytes) -> int:
    """The number of a request that is not valid, which its answer repeats; 0 where it has none."""
    try:
        return msgspec.json.decode(data, type=_Numbered).n
    except Exception:  # bytes of any kind
        return 0
