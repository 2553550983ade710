"""The key space."""

import pytest

from stereoservo.messages.keys import InvalidKeyError, KeySpace

KEYS = KeySpace("demo")


def test_keys_are_those_of_the_design() -> None:
    assert KEYS.state == "stereoservo/v1/demo/state"
    assert KEYS.features("left") == "stereoservo/v1/demo/features/left"
    assert KEYS.goal("anna") == "stereoservo/v1/demo/goal/anna"
    assert KEYS.command("hold", "anna") == "stereoservo/v1/demo/command/hold/anna"
    assert KEYS.stop == "stereoservo/v1/demo/command/stop"
    assert KEYS.schema("goal") == "stereoservo/v1/demo/schema/goal"


def test_keys_lead_back_to_their_parts() -> None:
    assert KEYS.operator_of_goal(KEYS.goal("anna-1")) == "anna-1"
    assert KEYS.command_of(KEYS.command("teach", "bo_b")) == ("teach", "bo_b")
    assert KEYS.schema_of(KEYS.schema("command-jog")) == "command-jog"


@pytest.mark.parametrize("name", ["", "*", "**", "$*", "a/b", "..", "a b", "ä", "x" * 65, "-a", "a\0", "a\n"])
def test_names_that_zenoh_would_take_and_we_do_not(name: str) -> None:
    with pytest.raises(InvalidKeyError):
        KEYS.goal(name)
    with pytest.raises(InvalidKeyError):
        KeySpace(name)


@pytest.mark.parametrize(
    "key",
    [
        "stereoservo/v1/demo/goal/*",
        "stereoservo/v1/demo/goal/**",
        "stereoservo/v1/*/goal/anna",
        "stereoservo/v1/other/goal/anna",
        "stereoservo/v1/demo/goal/a/b",
        "stereoservo/v1/demo/goal",
    ],
)
def test_a_wildcard_put_is_not_an_operator(key: str) -> None:
    with pytest.raises(InvalidKeyError):
        KEYS.operator_of_goal(key)


def test_an_unknown_verb_gets_the_known_ones() -> None:
    with pytest.raises(InvalidKeyError, match=r"'fly'; there are: stop, enable"):
        KEYS.command_of("stereoservo/v1/demo/command/fly/anna")
