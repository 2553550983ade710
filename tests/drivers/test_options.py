"""A wrong option of a cell file is told with its key, its value and what would have been valid."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_drivers.options import decode_options

JOINT: dict[str, Any] = {
    "name": "j1", "node_id": 1, "counts_per_rev": 4096, "max_velocity": 1.0, "max_acceleration": 4.0,
    "quick_stop_deceleration": 10.0, "position_min": -2.9, "position_max": 2.9,
}  # fmt: skip
REMOVED = object()


def refusal(tree: dict[str, Any]) -> str:
    with pytest.raises(DriverError) as caught:
        decode_options(CanOptions, tree, "canopen")
    assert caught.value.code == "option"
    text = str(caught.value)
    assert text.startswith("driver 'canopen': ")
    assert "$" not in text  # no path of msgspec's
    return text.removeprefix("driver 'canopen': ")


def changed(tree: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    return {name: item for name, item in {**tree, key: value}.items() if item is not REMOVED}


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("protocol", "canopen", 'protocol = "canopen"; valid: "cia402" or "odrive"'),
        ("interface", REMOVED, "interface is missing; valid: a text in quotes"),
        ("channel", 1.5, "channel = 1.5; valid: a text in quotes or an integer"),
        ("bitrate", "1M", 'bitrate = "1M"; valid: an integer from 10000 to 1000000'),
        ("bitrate", 500, "bitrate = 500; valid: an integer from 10000 to 1000000"),
        ("max_bus_load", 70, "max_bus_load = 70; valid: a number above 0 to 0.95"),
        ("feedback", "effort", "feedback = \"effort\"; valid: a list in brackets, of \"effort\" or"),
        ("feedback", ["velocity", "torque"], 'feedback[1] = "torque"; valid: "effort" or "following_error" or'),
        ("command_timeout_s", 0, "command_timeout_s = 0; valid: a number above 0"),
        ("quick_stop_option", 0, "quick_stop_option = 0; valid: 1 or 2 or 3"),
        ("emcy_ignore", ["0x4210"], 'emcy_ignore[0] = "0x4210"; valid: an integer'),
        ("interface_options", {"a": 1, "b": [2]}, "interface_options.b = [2]; valid: a text in quotes or an integer"),
        ("interface_options", "x", 'interface_options = "x"; valid: a table of { NAME = '),
        ("heartbeat_timout_ms", 9, "no option 'heartbeat_timout_ms'; did you mean 'heartbeat_timeout_ms'? valid:"),
        ("joint", REMOVED, "joint is missing; valid: one table in double brackets each, with name, node_id,"),
        ("joint", {"name": "j1"}, "joint = {'name': 'j1'}; valid: one table in double brackets each"),
    ],
)  # fmt: skip
def test_an_option_of_the_bus(key: str, value: Any, told: str) -> None:
    assert told in refusal(changed({"interface": "virtual", "channel": "x", "joint": [JOINT]}, key, value))


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("node_id", 127, "joint 'j2': node_id = 127; valid: an integer from 1 to 126"),
        ("node_id", REMOVED, "joint 'j2': node_id is missing; valid: an integer from 1 to 126"),
        ("name", REMOVED, "joint[1]: name is missing; valid: a text in quotes"),
        ("name", 2, "joint[1].name = 2; valid: a text in quotes"),
        ("gear_ratio", -120, "joint 'j2': gear_ratio = -120; valid: a number above 0"),
        ("direction", -1.5, "joint 'j2': direction = -1.5; valid: -1 or 1"),
        ("kind", "rotary", "joint 'j2': kind = \"rotary\"; valid: \"prismatic\" or \"revolute\""),
        ("multi_turn", "yes", "joint 'j2': multi_turn = \"yes\"; valid: true or false"),
        ("multi_turn", 1, "joint 'j2': multi_turn = 1; valid: true or false"),
        ("vendor_id", "0xFB", "joint 'j2': vendor_id = \"0xFB\"; valid: an integer"),
        ("sdo", {"0x60C2:1": 4, "0x60C2:2": True}, "joint 'j2': sdo.0x60C2:2 = true; valid: an integer"),
        ("max_vel", 1.0, "joint 'j2': no option 'max_vel'; did you mean 'max_velocity'? valid: name, node_id"),
        ("position_max", True, "joint 'j2': position_max = true; valid: a number"),
    ],
)  # fmt: skip
def test_an_option_of_a_joint_is_told_with_its_name(key: str, value: Any, told: str) -> None:
    second = changed({**JOINT, "name": "j2", "node_id": 2}, key, value)
    assert told in refusal({"interface": "virtual", "channel": "x", "joint": [JOINT, second]})


def test_what_is_valid_passes() -> None:
    options = decode_options(CanOptions, {"interface": "virtual", "channel": 0, "joint": [JOINT]}, "canopen")
    assert msgspec.to_builtins(options.joint[0])["name"] == "j1"
