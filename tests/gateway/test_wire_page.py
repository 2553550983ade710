"""The examples of docs/wire.md are what the daemon takes."""

import re
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from stereoservo.core.settings import CameraSettings
from stereoservo.daemon.kernel_compilation import example_settings
from stereoservo.gateway.validation import GoalContext, check_command, check_goal
from stereoservo.messages.goals import Goal, Target, UpdateGoal
from stereoservo.messages.keys import VERBS
from stereoservo.messages.wire import Synthesise, decode

PAGE = (Path(__file__).parents[2] / "docs" / "wire.md").read_text()
EXAMPLES = [msgspec.json.decode(block) for block in re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)]
CELL = msgspec.structs.replace(
    example_settings(),
    cameras=tuple(CameraSettings(name, 640, 480, 30.0, "eye_to_hand", tuple(range(15))) for name in ("left", "right")),
)
CONTEXT = GoalContext(CELL, ("pick",), tuple(range(10)))


def test_every_kind_of_goal_has_an_example() -> None:
    kinds = {example["target"]["kind"] for example in EXAMPLES if "target" in example}
    assert kinds == {target.__struct_config__.tag for target in get_args(Target)}


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_are_taken(example: dict[str, Any]) -> None:
    data = msgspec.json.encode(example)
    if "pose" in example:
        assert decode(data, Synthesise).name
    elif "command" in example:
        assert check_command(decode(data, UpdateGoal), CONTEXT) == []
    else:
        assert check_goal(decode(data, Goal), CONTEXT) == []


def test_the_page_names_every_verb() -> None:
    (row,) = (line for line in PAGE.splitlines() if line.startswith("| `command/<verb>"))
    assert set(VERBS) <= set(row.replace("`", " ").split())
