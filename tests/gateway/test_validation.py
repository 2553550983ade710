"""Static checks of goals: each problem names the value and what would have been valid."""

from typing import Any

import msgspec
import pytest

from stereoservo.gateway.validation import GoalContext, check_command, check_goal
from stereoservo.runtime.commands import FeatureTarget, Goal, Hold, Jog, JointTarget, TaughtTarget
from stereoservo.runtime.settings import CameraSettings
from stereoservo.runtime.warmup import _settings

SETTINGS = msgspec.structs.replace(
    _settings(),
    cameras=(
        CameraSettings("left", 640, 480, 30.0, "eye_to_hand", (0, 1, 2, 3)),
        CameraSettings("right", 320, 240, 30.0, "eye_to_hand", (0, 1, 2)),
    ),
)
CONTEXT = GoalContext(SETTINGS, ("park", "pick"), (0, 1, 2))
GOOD = {0: (10.0, 10.0), 1: (20.0, 10.0), 2: (20.0, 20.0)}


def problems(target: Any, **options: Any) -> list[str]:
    return check_goal(Goal("12345678", target, **options), CONTEXT)


def test_good_goals_have_no_problem() -> None:
    assert problems(FeatureTarget({"left": GOOD, "right": GOOD}), law="cartesian3") == []
    assert problems(FeatureTarget({"left": {0: (-0.5, 479.5), **{k: GOOD[k] for k in (1, 2)}}})) == []
    assert problems(TaughtTarget("park"), law="stereo") == []
    assert problems(JointTarget({"j1": 0.5})) == []


@pytest.mark.parametrize(
    ("target", "options", "expected"),
    [
        (FeatureTarget({}), {}, "is empty; set-points for some of the cameras left, right"),
        (FeatureTarget({"middle": GOOD}), {}, "no camera 'middle'; cameras: left, right"),
        (FeatureTarget({"left": {}}), {}, "has no marker; markers: 0, 1, 2, 3"),
        (
            FeatureTarget({"left": {**GOOD, 9: (1.0, 1.0)}}),
            {},
            "left.9: the detector of camera 'left' knows no marker 9; it knows: 0, 1, 2, 3",
        ),
        (
            FeatureTarget({"left": {**GOOD, 3: (1.0, 1.0)}}),
            {},
            "left.3: the model has no marker 3; it has: 0, 1, 2",
        ),
        (
            FeatureTarget({"left": {**GOOD, 0: (640.0, 1.0)}}),
            {},
            "left.0: pixel (640, 1) is outside the image; u from -0.5 to 639.5, v from -0.5 to 479.5",
        ),
        (FeatureTarget({"right": {**GOOD, 0: (5.0, -3.0)}}), {}, "v from -0.5 to 239.5"),
        (FeatureTarget({"left": {0: (1.0, 1.0)}}), {}, "1 marker(s) (0); at least 3"),
        (TaughtTarget("pork"), {}, "no taught goal 'pork'; taught: park, pick"),
        (
            JointTarget({"j1": 0.1}),
            {"law": "stereo"},
            "law: 'stereo' works on set-points in images; a target of joints takes none of stereo, image",
        ),
        (JointTarget({"j1": 0.1}), {"gain": 2.0}, "gain: 2.0 belongs to an image law"),
        (JointTarget({}), {}, "is empty; joints: j1, j2"),
        (JointTarget({"j9": 0.1}), {}, "no joint 'j9'; joints: j1, j2, j3, j4, j5, j6"),
        (
            JointTarget({"j1": 1.995}),
            {},
            "positions.j1: 1.995 is outside the joint's limits; -1.99 to 1.99 is valid",
        ),
    ],
)
def test_each_problem_says_what_would_have_been_valid(
    target: Any, options: dict[str, Any], expected: str
) -> None:
    (problem,) = problems(target, **options)
    assert expected in problem


def test_all_problems_are_told_at_once() -> None:
    assert len(problems(FeatureTarget({"left": {9: (1.0, 1.0), 0: (-5.0, 1.0)}, "up": GOOD}))) == 3


def test_without_a_model_its_markers_are_not_asked_for() -> None:
    context = GoalContext(SETTINGS, (), None)
    assert check_goal(Goal("12345678", FeatureTarget({"left": {**GOOD, 3: (1.0, 1.0)}})), context) == []


def test_jogs_are_checked_against_joints_and_their_limits() -> None:
    assert check_command(Jog({"j1": 0.9, "j2": -1.0}), CONTEXT) == []
    assert "no joint 'x'; joints: j1" in check_command(Jog({"x": 0.1}), CONTEXT)[0]
    assert "-1 to 1 is valid" in check_command(Jog({"j1": 1.5}), CONTEXT)[0]
    assert "is empty" in check_command(Jog({}), CONTEXT)[0]
    assert check_command(Hold(), CONTEXT) == []
