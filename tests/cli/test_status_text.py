"""What ``stereoservo status`` says of the joints' loads and the model's health."""

from __future__ import annotations

from typing import Any

import msgspec

from stereoservo.cli.status import describe
from stereoservo.messages.status import CameraHealth, Halt, Health, RefinementState
from stereoservo.messages.wire import LoopInfo, StateMessage, decode, encode

STATE = StateMessage(
    cell="demo", boot="b", t_ns=1, step=0, t_wall=1.0, lifecycle="active", model="valid", model_epoch=1, source="hold",
    goal="", law="", level="ok", reasons=(), joints={"j1": 0.1}, velocities={}, command={}, error_px=None,
    task_error=(), innovation_px={}, visible={}, loop=LoopInfo(250.0, 1, 0, 0, {"p99": 1.0, "max": 2.0}, {}),
)  # fmt: skip


def said(**fields: Any) -> list[str]:
    return describe(msgspec.structs.replace(STATE, **fields)).splitlines()


def loads(**fields: Any) -> list[str]:
    return [line for line in said(**fields) if line.startswith("  loads")]


def test_drives_that_tell_nothing_are_not_spoken_of() -> None:
    assert loads() == []


def test_the_following_error_nearest_to_its_limit_is_named() -> None:
    (line,) = loads(
        efforts={"j1": 3.21, "j2": -40.0},
        following_errors={"j1": 0.009, "j2": -0.004, "j3": 0.5},
        following_limits={"j1": 0.02, "j2": 0.005},
        effort_limits={"j1": 9.0},
    )
    assert line == "  loads   j1 +3.21  j2 -40  following j2 -0.004 of 0.005"


def test_loads_that_nothing_watches_say_so() -> None:
    (line,) = loads(efforts={"j1": 3.0})
    assert "no contact is watched for" in line


def test_a_state_of_an_older_daemon_is_read() -> None:
    tree = msgspec.json.decode(encode(STATE))
    for field in ("efforts", "following_errors", "effort_limits", "following_limits"):
        del tree[field]
    assert decode(msgspec.json.encode(tree), StateMessage) == STATE


def test_a_kept_model_that_no_frame_has_confirmed_is_told_in_words() -> None:
    assert said(model="unconfirmed")[0] == (
        "demo: active, model unconfirmed (epoch 1: kept, not confirmed by the images yet), hold"
    )
    assert "kept" not in said()[0]


def test_the_models_health_is_told_camera_by_camera() -> None:
    assert not [line for line in said() if line.startswith("  model ")]
    health = Health(
        "camera_moved", ("left",), text="camera left moved by 42 px rms",
        cameras={"left": CameraHealth(rms_px=42.0), "up": CameraHealth(rms_px=0.02, place="moving", timing="is late")},
    )  # fmt: skip
    told = said(health=health)
    assert "  model   camera moved: left 42.00 px  up 0.02 px (moving)" in told
    assert "          camera left moved by 42 px rms" in told
    assert "          camera up: is late" in told


def test_what_is_shown_carries_its_age_and_is_unknown_without_a_source() -> None:
    ages = {"left": 0.021, "right": 3.21, "up": None}
    told = said(joints_age_s=0.004, visible={"left": 14}, camera_age_s=ages)
    assert "  joints  j1 +0.1000 (+5.7°) (4 ms old)" in told
    assert "  markers left 14 (21 ms old)  right unknown (no frame for 3.2 s)  up unknown (no frame yet)" in told
    assert "  joints  unknown: no sample for 3.0 s" in said(joints={}, joints_age_s=3.0)
    assert "  joints  unknown: no sample yet" in said(joints={})
    told = said(health=Health("unknown", text="no camera delivers frames"))
    assert told[told.index("  model   unknown") + 1] == "          no camera delivers frames"


def test_the_markers_of_a_daemon_that_tells_no_ages_are_shown_as_before() -> None:
    assert "  markers left 14" in said(visible={"left": 14})


def test_who_stopped_the_arm_is_told() -> None:
    assert not any(line.startswith("  halt") for line in said())
    (line,) = (line for line in said(halt=Halt("stopped by ann", 1.0)) if line.startswith("  halt"))
    assert line.startswith("  halt    stopped by ann, ")


def test_messages_that_could_not_be_taken_are_counted() -> None:
    assert not any("refused" in line for line in said())
    assert "  refused 17000 messages that could not be taken since the gateway's start" in said(refused_messages=17000)
    assert decode(encode(msgspec.structs.replace(STATE, refused_messages=3)), StateMessage).refused_messages == 3


def test_how_far_the_refinement_is_and_how_it_is_undone() -> None:
    assert not any("refine" in line for line in said())
    assert "  refine  5 rest poses, a model is estimated from 16 on" in said(refinement=RefinementState(5, 16))
    (line,) = (one for one in said(refinement=RefinementState(130, None, refined_from=3)) if "refine" in one)
    assert "no model is estimated before the next calibration or start" in line
    assert "refined from epoch 3 (`calibrate CELL --undo-refinement`" in line
