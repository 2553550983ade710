"""Options that contradict each other, the wire or the bus are refused, and the refusal says what would do."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.canopen.option_checks import bus_load, check_options, parse_sdo_key
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_drivers.options import decode_options


def joint(k: int = 1, **changes: Any) -> dict[str, Any]:
    return {
        "name": f"j{k}", "node_id": k, "counts_per_rev": 4096, "gear_ratio": 100.0, "max_velocity": 1.0,
        "max_acceleration": 4.0, "quick_stop_deceleration": 10.0, "position_min": -2.9, "position_max": 2.9,
    } | changes  # fmt: skip


def options(*joints: dict[str, Any], **changes: Any) -> CanOptions:
    values = {"interface": "virtual", "channel": "x", "joint": list(joints or (joint(1), joint(2)))} | changes
    return decode_options(CanOptions, values, "canopen")


def refused(*joints: dict[str, Any], **changes: Any) -> str:
    with pytest.raises(DriverError) as refusal:
        check_options(options(*joints, **changes))
    assert refusal.value.code == "option"
    return str(refusal.value)


def test_a_usual_arm_passes() -> None:
    check_options(options(*[joint(k) for k in range(1, 7)]))
    check_options(options(joint(multi_turn=True, position_min=-100.0, position_max=100.0)))
    check_options(options(joint(kind="prismatic", position_min=-1.0, position_max=12.0, offset_rad=5.0)))


def test_nodes_and_names_once_each() -> None:
    assert "'j2'" in (text := refused(joint(1), joint(2, node_id=1)))
    assert "node_id = 1" in text
    assert "'j1' (node 1)" in text
    assert "joint 'j1': name = j1" in refused(joint(1), joint(2, name="j1"))
    assert "master_id (2)" in refused(joint(1), joint(2), master_id=2)
    assert "at least one" in refused(joint=[])


def test_limits_in_degrees() -> None:
    text = refused(joint(position_min=-170.0, position_max=170.0))
    assert "are these degrees? -170 deg = -2.967 rad" in text
    assert "multi_turn" in text
    assert "170 deg = 2.967 rad" in refused(joint(position_min=-1.0, position_max=170.0))
    assert "90 deg = 1.571 rad" in refused(joint(max_velocity=90.0))
    assert "45 deg = 0.7854 rad" in refused(joint(offset_rad=45.0))
    check_options(options(joint(offset_rad=math.pi)))


def test_limits_the_wrong_way_round() -> None:
    assert "less than position_max = -1" in refused(joint(position_min=1.0, position_max=-1.0))
    assert "position_min" in refused(joint(position_min=1.0, position_max=1.0))


@pytest.mark.parametrize("option", ["position_min", "position_max", "offset_rad", "max_acceleration"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_that_are_none(option: str, value: float) -> None:
    values = msgspec.structs.asdict(options(joint()).joint[0])
    with pytest.raises(DriverError):
        check_options(options(values | {option: value}))


def test_velocities_that_do_not_fit_the_drives_objects() -> None:
    # 2^23 counts a motor turn and a gear of 500 are 6.7e8 counts per radian.
    text = refused(joint(counts_per_rev=2**23, gear_ratio=500.0, max_velocity=6.0, position_max=3.0))
    assert "max_velocity = 6 is 4.005e+09 drive units" in text
    assert "valid: up to 3.217" in text
    assert "max_acceleration" in refused(joint(counts_per_rev=2**23, gear_ratio=500.0, max_acceleration=7.0))
    # rpm of a motor without a gear: 0.01 rad/s is a tenth of an rpm.
    assert "which is nothing" in refused(joint(gear_ratio=1.0, velocity_units_per_rev_s=60.0, max_velocity=0.01))


def test_a_counter_that_wraps_within_the_limits() -> None:
    wraps = joint(counts_per_rev=2**23, gear_ratio=500.0, max_velocity=1.0, max_acceleration=2.0,
                  quick_stop_deceleration=2.0, position_min=-3.3, position_max=3.3)  # fmt: skip
    text = refused(wraps)
    assert "3.217" in text
    check_options(options(wraps | {"multi_turn": True}))


def test_the_bus_must_carry_it() -> None:
    arm = [joint(k) for k in range(1, 7)]
    # SYNC 55 bits at worst, frames with 6 data bytes 115 (three for each drive), heartbeats with one byte 65.
    load = bus_load(options(*arm))
    assert load.cycle_bits == 55 + 6 * 3 * 115
    assert load.share == pytest.approx((2125 * 250 + 7 * 50 * 65) / 1e6)
    text = refused(*arm, bitrate=500_000)
    assert "worst-case bus load" in text
    assert "rate_hz up to 154 fits" in text
    check_options(options(*arm, bitrate=500_000, rate_hz=154))
    assert "rate_hz up to 155" not in text
    refused(*arm, bitrate=500_000, rate_hz=155)


def test_an_odrive_arm_is_reckoned_by_its_own_frames() -> None:
    arm = [joint(k, counts_per_rev=1) for k in range(1, 7)]
    load = bus_load(options(*arm, protocol="odrive"))
    # 10 remote frames of 55 bits; 6 estimates, 6 velocities, 2 errors and 2 torques of 135.
    assert load.cycle_bits == 10 * 55 + 16 * 135
    # Its velocities are float32: slow joints without a gear are nothing special.
    check_options(options(joint(counts_per_rev=1, gear_ratio=1.0, max_velocity=0.1), protocol="odrive"))


def test_heartbeats_and_deadlines_leave_room() -> None:
    assert "at least 40" in refused(heartbeat_ms=20, heartbeat_timeout_ms=39)
    check_options(options(heartbeat_ms=20, heartbeat_timeout_ms=40))
    assert "at least 8" in refused(rpdo_deadline_ms=7)
    check_options(options(rpdo_deadline_ms=0))


@pytest.mark.parametrize("key", ["60C2:1", "0x60C2", "0x60C2:", "0x60C2:256", "0x0:1", "0x160C2:1", "x", ""])
def test_sdo_keys_that_are_no_objects(key: str) -> None:
    assert "0x60C2:1" in refused(joint(sdo={key: 1}))


def test_sdo_keys_and_values() -> None:
    assert parse_sdo_key("0x60C2:1") == (0x60C2, 1)
    assert parse_sdo_key("0x1f80:0x1F") == (0x1F80, 0x1F)
    check_options(options(joint(sdo={"0x60C2:1": -(2**31), "0x60C2:2": 2**32 - 1})))
    assert "32 bits" in refused(joint(sdo={"0x60C2:1": 2**32}))


def test_no_further_write_keeps_a_drive_from_stopping() -> None:
    for key, option in (
        ("0x6007:0", "abort_option"), ("0x605a:0", "quick_stop_option"), ("0x6085:0", "quick_stop_deceleration"),
    ):  # fmt: skip
        assert f"set by option {option}" in refused(joint(sdo={key: 1}))
    assert "run out" in refused(joint(sdo={"0x605E:0": 0}))
    check_options(options(joint(sdo={"0x605E:0": 1})))


def test_what_would_be_ignored_or_cannot_be() -> None:
    assert "feedback = ['effort', 'effort']; valid: each once" in refused(feedback=["effort", "effort"])
    assert "emcy_ignore = 0x142100; valid: codes of 16 bits" in refused(emcy_ignore=[0x142100])
    assert "joint[1] (node_id 2): name = ''" in refused(joint(1), joint(2, name=""))
    assert "joint 'j1': vendor_id = -1; valid: 0 to 0xffffffff" in refused(joint(vendor_id=-1))
    assert "joint 'j1': serial_number = 4294967296" in refused(joint(serial_number=2**32))
    assert "joint 'j1': current_limit = 5.0; valid: left out" in refused(joint(current_limit=5.0))
    odrive = joint(counts_per_rev=1, serial_number=2**47, current_limit=5.0)
    check_options(options(odrive, protocol="odrive", feedback=["velocity", "effort"]))


def test_outputs_belong_to_a_joints_drive_once_each() -> None:
    light = {"name": "light", "node_id": 1, "bit": 16}
    check_options(options(output=[light, light | {"name": "valve", "bit": 17}]))
    assert "that of a joint: 1, 2" in refused(output=[light | {"node_id": 9}])
    assert "no other output or gripper has" in refused(output=[light, light | {"bit": 17}])
    assert "no other output of this drive" in refused(output=[light, light | {"name": "valve"}])
    assert "CiA 402 drive's" in refused(protocol="odrive", output=[light])
    assert "ODrive's" in refused(endpoints=["flat_endpoints.json"])
