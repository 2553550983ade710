"""The state of the core as bytes, and the conversion of states written by former versions of this program."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from stereoservo.core.block import Block, restored
from stereoservo.core.camera_state import CameraEstimate, CameraMonitor, CameraTiming, camera_read
from stereoservo.core.cycle import decode_array, encode_array
from stereoservo.core.state import STATE_VERSION, CoreState, Refused, ServoGoal, share_observations

OLDEST_VERSION = 6
"""Oldest version of states that can be read."""


class StateVersionError(ValueError):
    """A state of another version of this program; ``version`` is the state's version."""

    def __init__(self, version: int) -> None:
        super().__init__(
            f"its state is of version {version}, this program works with version {STATE_VERSION}: what the core "
            "remembers has changed in between"
        )
        self.version = version


class _Versioned(msgspec.Struct):
    """The version, which every state contains, whatever else it holds."""

    version: int


KEPT = (Block, CameraEstimate, CameraMonitor, CameraTiming)
"""Types that are written out by their ``kept``."""


def _encode_hook(value: object) -> object:
    return value.kept() if isinstance(value, KEPT) else encode_array(value)


def _decode_hook(kind: type, value: Any) -> object:
    if kind not in KEPT:
        return decode_array(kind, value)
    if not isinstance(value, dict):
        raise TypeError(f"a {kind.__name__} that is a {type(value).__name__}")
    kept = {name: decode_array(kind, v) if isinstance(v, list) else v for name, v in value.items()}
    return restored(kept) if kind is Block else camera_read(kind, kept)


_encoder = msgspec.msgpack.Encoder(enc_hook=_encode_hook)
_decoder = msgspec.msgpack.Decoder(CoreState, dec_hook=_decode_hook)


def encode_state(state: CoreState) -> bytes:
    """The state as bytes, bit for bit: arrays and numbers of its block by name, of the cell's sizes."""
    return _encoder.encode(state)


def decode_state(data: bytes) -> CoreState:
    """Inverse of :func:`encode_state`. Raises StateVersionError, and anything on damaged bytes."""
    # Read first: a state of another version may have other fields, too.
    version = msgspec.msgpack.decode(data, type=_Versioned).version
    if not OLDEST_VERSION <= version <= STATE_VERSION:
        raise StateVersionError(version)
    if version < STATE_VERSION:
        data = msgspec.msgpack.encode(_of_this_version(msgspec.msgpack.decode(data), version))
    state: CoreState = _decoder.decode(data)
    share_observations(state)
    job = state.planning
    if job is not None and job.purpose == "again" and isinstance(state.source, ServoGoal):
        job.source = state.source  # written twice, but one object
    return state


MOVED_IN_VERSION_7 = ("stop_reason",)  # in a state of version 6 it is elsewhere


def is_recorded(state: CoreState, data: bytes) -> bool:
    """Whether ``data`` is this state bit for bit, in the fields that existed when it was written."""
    held = _as_of_now(msgspec.msgpack.decode(data))
    now, recorded = (msgspec.msgpack.decode(encode_state(s)) for s in (state, decode_state(data)))
    blocks = [[s["block"][name] for name in now["block"] if name in held["block"]] for s in (now, recorded)]
    rest = [[s[name] for name in now if name in held and name != "block"] for s in (now, recorded)]
    return bool(msgspec.msgpack.encode([blocks[0], rest[0]]) == msgspec.msgpack.encode([blocks[1], rest[1]]))


def _as_of_now(state: dict[str, Any]) -> dict[str, Any]:
    """A state of a former version with its values in the places of the current version."""
    if state["version"] < 7:
        state["stop_reason"] = None
    return state if state["version"] >= 10 else state | {"block": _block_of(state)}


BEFORE_VERSION_10 = {
    "last_step_ns": "", "last_joints_ns": "", "last_joints_seq": "", "last_followed_ns": "", "velocities": "",
    "command": "", "correction": "", "missing_travel": "", "untold_travel": "", "last_positions": "",
    "silent_from": "", "silent_travel": "", "silent_s": "",
    "history_ns": "history.t_ns", "history_positions": "history.positions", "history_count": "history.count",
    "delay_s": "delays.delay_s", "delay_samples": "delays.samples", "delay_onset": "delays.onset",
    "delay_sent": "delays.sent", "delay_past": "delays.past", "delay_velocity": "delays.velocity",
    "delay_under_way": "delays.under_way", "delay_accounted": "delays.accounted", "delay_missing": "delays.missing",
    "delay_steps": "delays.steps", "loads_ns": "contact.seen_ns", "leave_s": "contact.leave_s",
    "mean_efforts": "contact.mean_efforts", "effort_excess": "contact.effort_excess",
    "following_excess": "contact.following_excess", "contact_low": "contact.low", "contact_high": "contact.high",
    "efforts": "contact.efforts", "following_errors": "contact.following_errors",
}  # fmt: skip
"""Places in former states of the values that are now in the block; empty: same name."""


KNOWN_BY = {
    "last_positions": "followed",
    "silent_from": "silence_known",
    "efforts": "tells_efforts",
    "following_errors": "tells_following",
}
"""Values that could be None in former states, and the flags that replace None now."""


def _block_of(state: dict[str, Any]) -> dict[str, Any]:
    """The block, from the separate values of a former state; arrays still encoded."""
    block: dict[str, Any] = {}
    for name, place in BEFORE_VERSION_10.items():
        *path, last = (place or name).split(".")
        holder: Any = state
        for part in path:
            holder = holder.get(part) or {}
        if last not in holder:
            continue
        value = holder[last]
        if name in KNOWN_BY:
            block[KNOWN_BY[name]] = int(value is not None)
        if value is not None and not (isinstance(value, list) and value[1] == [0]):
            block[name] = value
    cameras, markers = len(state["cameras"]), state["cameras"][0]["sigma"][1][0] if state["cameras"] else 0
    joints, window = block["command"][1][0], block["effort_excess"][1][0]
    past = block["delay_past"][1][0] if "delay_past" in block else 0
    return block | {"joints": joints, "cameras": cameras, "markers": markers, "window": window, "past": past}


RUN_BEFORE_VERSION_12 = ("moved_s", "held", "last_frames")
WATCH_BEFORE_VERSION_12 = ("first_px", "mean_px", "least_px", "least_s")
FRICTION_BEFORE_VERSION_12 = {
    "friction": "velocity",
    "friction_from": "stood_at",
    "friction_sent": "sent",
    "friction_s": "sent_s",
}


def _with_run(state: dict[str, Any]) -> dict[str, Any]:
    """Convert a state before version 12, in which a law's progress and friction were stored beside the block."""
    source, friction = state["source"], state.get("friction")
    block = dict(state["block"])
    if "moved_s" in source:
        error, watch = source["error_px"], source["watch"]
        block["run"] = {
            **{name: source[name] for name in RUN_BEFORE_VERSION_12},
            **{name: watch[name] for name in WATCH_BEFORE_VERSION_12},
            "measured": error is not None,
            "newest_px": math.nan if error is None else error,
        }
        source = {**source, "reasons": watch["reasons"]}
    if friction is not None:
        block |= {name: friction[place] for name, place in FRICTION_BEFORE_VERSION_12.items()}
    return state | {
        "block": block,
        "source": source,
        "friction_of": "" if friction is None else friction["subject"],
    }


def _of_this_version(state: dict[str, Any], version: int) -> dict[str, Any]:
    """A state of a former version completed by the missing values; arrays still encoded. Raises StateVersionError for a
    state recorded during trial motions, because their programme has changed.
    """
    state = _with_round_due(state, version)
    if version >= 12:
        return state | {"version": STATE_VERSION}
    if version >= 10:
        return _with_run(state) | {"version": STATE_VERSION}
    if version < 9 and state["source"]["type"] == "trials":
        raise StateVersionError(version)
    if version == 6:  # before stamps and gaps of the loop were checked
        nothing = msgspec.to_builtins(Refused())
        state |= {"last_step_ns": 0, "refused_joints": nothing, "stop_reason": state["contact"].pop("reason")}
        state["refused_frames"] = [nothing for _ in state["cameras"]]
    if version < 8 and (planning := state.get("planning")) is not None:  # large bodies are planned in parts
        planning["goal"] = planning["source"]["goal"]
    block = _block_of(state) | {"round_due": int(state["watching"].get("due", False))}
    return _with_run(state | {"block": block}) | {
        "version": STATE_VERSION,
        "loads": state["contact"].get("loads"),
    }


def _with_round_due(state: dict[str, Any], version: int) -> dict[str, Any]:
    """Convert a state before version 13, in which the flag ``round_due`` was stored beside the block."""
    if version < 10:
        return state  # it has no block yet
    due = int(state["watching"].get("due", False))
    return state | {"block": {**state["block"], "round_due": due}}
