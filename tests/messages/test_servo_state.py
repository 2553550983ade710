"""The state as clients get it: what has lost its source is unknown, and everything carries its age."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from stereoservo.messages.reasons import Reason
from stereoservo.messages.servo_state import (
    LoopStatistics,
    Numbers,
    RunRecord,
    StateRecord,
    silence_limit_s,
    state_message,
)
from stereoservo.messages.status import CameraHealth, Health
from stereoservo.messages.wire import StateMessage

RUN = msgspec.convert(
    {
        "cell": {"cell": {"name": "cell"}},
        "boot": "b",
        "joints": {"joints": [{"name": "j1"}]},
        "cameras": [{"name": "fast", "rate_hz": 30.0}, {"name": "slow", "rate_hz": 1.0}],
    },
    RunRecord,
)
NOW_NS = 100_000_000_000
BOTH = {"fast": NOW_NS - 20_000_000, "slow": NOW_NS - 20_000_000}


class StatusOfCore:
    """A core's status with an arm in motion, a goal, and both cameras in agreement with the model."""

    t_ns, model_epoch, error_px, progress, seconds_left = NOW_NS, 1, 0.5, 0.25, 2.0
    step = 0
    lifecycle, model, source, goal, law, level = "active", "valid", "law", "g", "stereo", "ok"
    reasons: tuple[Any, ...] = ()
    positions = velocities = command = efforts = following_errors = Numbers((0.5,))
    effort_limits = following_limits = None
    task_error = Numbers(())
    innovation_px, visible = {"fast": 0.1, "slow": 0.2}, {"fast": 14, "slow": 13}
    health = Health("ok", cameras={"fast": CameraHealth(1.0), "slow": CameraHealth(1.0)})


def message(
    health: Health = StatusOfCore.health,
    *,
    joints_ns: int = NOW_NS,
    frames_ns: dict[str, int],
    reasons: tuple[Reason, ...] = (),
) -> StateMessage:
    status = StatusOfCore()
    status.health, status.reasons = health, reasons
    loop = LoopStatistics(250.0, 9, 0, 0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    state = StateRecord(
        status,
        loop,
        True,
        0,
        (),
        auxiliary={"gripper": 0.5},
        joints_ns=joints_ns,
        frames_ns=frames_ns,  # type: ignore[arg-type]
    )
    return state_message(RUN, "b", state, now_ns=NOW_NS, servo_alive=True, last_event=0)


def test_what_is_fresh_is_reported_with_its_age() -> None:
    found = message(joints_ns=NOW_NS - 4_000_000, frames_ns=BOTH)
    assert (found.joints_age_s, found.camera_age_s) == (0.004, {"fast": 0.02, "slow": 0.02})
    assert found.joints == found.velocities == found.efforts == found.following_errors == {"j1": 0.5}
    assert found.auxiliary == {"gripper": 0.5}
    assert found.visible == {"fast": 14, "slow": 13}
    assert (found.health.verdict, set(found.health.cameras)) == ("ok", {"fast", "slow"})
    assert found.error_px == 0.5


@pytest.mark.parametrize("joints_ns", [0, NOW_NS - 3_000_000_000])
def test_joints_of_drives_that_tell_nothing_are_unknown_and_do_not_move(joints_ns: int) -> None:
    found = message(joints_ns=joints_ns, frames_ns=BOTH)
    assert found.joints == found.velocities == found.efforts == found.following_errors == found.auxiliary == {}
    assert found.joints_age_s == (3.0 if joints_ns else None)
    assert found.command == {"j1": 0.5}, "what is commanded is known"


def test_of_a_silent_camera_nothing_is_reported_but_its_age_and_a_slow_one_is_given_its_time() -> None:
    found = message(frames_ns={"fast": NOW_NS - 1_000_000_000, "slow": NOW_NS - 1_000_000_000})
    assert silence_limit_s(30.0) < 1.0 < silence_limit_s(1.0)
    assert set(found.visible) == set(found.innovation_px) == set(found.health.cameras) == {"slow"}
    assert found.camera_age_s == {"fast": 1.0, "slow": 1.0}
    assert (found.health.verdict, found.error_px) == ("ok", 0.5), "one camera still sees it"


@pytest.mark.parametrize("frames_ns", [{}, dict.fromkeys(BOTH, NOW_NS - 9_000_000_000)])
def test_without_any_camera_nobody_knows_whether_the_model_holds(frames_ns: dict[str, int]) -> None:
    found = message(frames_ns=frames_ns)
    assert found.visible == found.innovation_px == {}
    assert (found.health.verdict, found.health.cameras, found.error_px) == ("unknown", {}, None)
    assert "no camera" in found.health.text
    moved = Health("camera_moved", ("fast",), text="camera fast moved")
    assert message(moved, frames_ns=frames_ns).health == moved, "what was found stays found"


def test_dead_cameras_are_no_cause_to_clear_the_view() -> None:
    asked = (Reason("FEATURES_STALE", "hold", hint="clear the view"), Reason("HELD", "hold", hint="resume to go on"))
    assert message(frames_ns=BOTH, reasons=asked).reasons == asked, "frames come, and show no markers"
    stale, held = message(frames_ns={}, reasons=asked).reasons
    assert (stale.code, stale.level, held) == ("FEATURES_STALE", "hold", asked[1])
    assert "no camera delivers frames" in stale.hint
