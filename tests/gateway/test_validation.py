"""Static checks of goals: each problem names the value and what would have been valid."""

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo.control.law_registry import LAWS
from stereoservo.core.settings import CameraSettings
from stereoservo.daemon.kernel_compilation import example_settings
from stereoservo.gateway.validation import GoalContext, check_command, check_goal
from stereoservo.messages.goals import (
    AcknowledgeGoal,
    AdaptiveGain,
    AuxiliarySpec,
    Centre,
    DisplacementTarget,
    Feature,
    FeatureTarget,
    Goal,
    Hold,
    IncidenceSpec,
    IncidenceTarget,
    Jog,
    JointTarget,
    MetricFrame,
    OrderAuxiliary,
    PointTarget,
    StepTarget,
    TaughtTarget,
    Teach,
    UpdateGoal,
)
from stereoservo.messages.wire import decode, encode

SETTINGS = msgspec.structs.replace(
    example_settings(),
    cameras=(
        CameraSettings("left", 640, 480, 30.0, "eye_to_hand", (0, 1, 2, 3)),
        CameraSettings("right", 320, 240, 30.0, "eye_to_hand", (0, 1, 2)),
    ),
)
CONTEXT = GoalContext(SETTINGS, ("park", "pick"), (0, 1, 2))
GOOD = {0: (10.0, 10.0), 1: (20.0, 10.0), 2: (20.0, 20.0)}


BODY = msgspec.structs.replace(
    SETTINGS,
    cameras=tuple(CameraSettings(name, 640, 480, 30.0, "eye_to_hand", tuple(range(12))) for name in ("left", "right")),
)
"""A cell whose detectors know markers 0 to 11, of which 0 to 5 are the body's."""
RICH = GoalContext(BODY, ("park",), tuple(range(6)))
POINTS = {0: (0.0, 0.0, 1.0, 1.0), 1: (0.1, 0.0, 1.0, 1.0), 2: (0.0, 0.1, 1.0, 1.0)}
EYE = tuple(float(i % 5 == 0) for i in range(16))
MIRROR = (-1.0, *EYE[1:])
PIN = Feature(markers=(0,))
HOLE = Feature(points=((0.0, 0.0, 1.0, 1.0),))


def incidence(kind: Any, moving: Feature, fixed: Feature, **options: Any) -> IncidenceTarget:
    return IncidenceTarget((IncidenceSpec(kind, moving, fixed),), **{"model_epoch": 1, **options})


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
def test_each_problem_states_what_would_have_been_valid(target: Any, options: dict[str, Any], expected: str) -> None:
    (problem,) = problems(target, **options)
    assert expected in problem


def test_all_problems_are_reported_at_once() -> None:
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


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"gripper": 0.02, "light": 1.0}, ""),
        ({"gripper": 0.09}, "0 to 0.08 m is valid"),
        ({"light": 0.5}, "0 and 1 are valid"),
        ({"j1": 0.1}, "no auxiliary joint or output 'j1'; there are: gripper, light"),
        ({}, "is empty"),
    ],
)
def test_orders_of_auxiliary_joints_are_checked_against_what_the_driver_declares(values, told) -> None:
    specs = (AuxiliarySpec("gripper", "prismatic", 0.0, 0.08, 0.1), AuxiliarySpec("light", "digital"))
    context = GoalContext(SETTINGS, (), None, specs)
    found = check_command(OrderAuxiliary(values), context)
    assert (told in found[0]) if told else found == []
    assert "has none" in check_command(OrderAuxiliary({"gripper": 0.0}), CONTEXT)[0]


SEEN = FeatureTarget({"left": GOOD, "right": GOOD})
ALL_KINDS: list[Any] = [
    SEEN,
    PointTarget(POINTS, 1),
    DisplacementTarget(EYE, model_epoch=1),
    DisplacementTarget(EYE, basis=(0, 1, 2, 3, 4)),
    StepTarget("camera:left", (0.0, 0.0, 0.02), (0.1, 0.0, 0.0), length="markers:0,1=0.05"),
    StepTarget("scene:6-7-8", matrix=EYE),
    TaughtTarget("park", "workpiece", (6, 7, 8, 9, 10)),
    TaughtTarget("park", "cameras"),
    JointTarget({"j1": 0.5}),
    incidence("point-on-point", PIN, HOLE),
    incidence("point-on-line", PIN, Feature(pixels={"left": ((1, 1), (9, 9)), "right": ((1, 1), (9, 9))})),
    incidence("plane-on-plane", Feature(markers=(0, 1, 2)), Feature(markers=(6, 7, 8)), model_epoch=None),
    incidence("point-on-point", PIN, HOLE, secondary=JointTarget({"j1": 0.1})),
]


@pytest.mark.parametrize("target", ALL_KINDS)
def test_every_kind_of_goal_may_be_good_and_survives_the_wire(target: Any) -> None:
    goal = Goal("12345678", target)
    assert check_goal(goal, RICH) == []
    assert decode(encode(goal), Goal) == goal
    without = GoalContext(BODY, ("park",), None)
    assert check_goal(goal, without) == []


@pytest.mark.parametrize("law", LAWS)
def test_every_law_takes_every_target_that_fixes_a_pose(law: Any) -> None:
    for target in ALL_KINDS[:8]:
        assert check_goal(Goal("12345678", target, law=law), RICH) == []


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        (PointTarget({0: POINTS[0], 1: POINTS[1]}, 1), "2 marker(s) (0, 1); at least 3"),
        (PointTarget({**POINTS, 9: POINTS[0]}, 1), "9: the model has no such marker; it has: 0, 1, 2, 3, 4, 5"),
        (PointTarget({**POINTS, 70: POINTS[0]}, 1), "70: no detector of the cell knows it; they know: 0, 1"),
        (PointTarget({**POINTS, 0: (0.0, 0.0, 0.0, 0.0)}, 1), "points.0: (0, 0, 0, 0) is no point"),
        (PointTarget({**POINTS, 0: (0.0, 5e-324, 0.0, 0.0)}, 1), "points.0: its largest number is 4.94066e-324"),
        (PointTarget({**POINTS, 0: (0.0, -1e308, 0.0, 1.0)}, 1), "points.0: its largest number is 1e+308; 1e-100 to"),
        (PointTarget({0: POINTS[0], 1: POINTS[1], 2: (0.3, 0, 2.0, 2.0)}, 1), "0, 1, 2 lie on one line"),
        (DisplacementTarget(EYE), "neither of model_epoch and basis given; exactly one"),
        (DisplacementTarget(EYE, 1, (0, 1, 2, 3, 4)), "both of model_epoch and basis given"),
        (DisplacementTarget(EYE, basis=(0, 1, 2, 3, 3)), "basis: 3 stands 2 times; ids that differ"),
        (DisplacementTarget(EYE, basis=(0, 1, 2, 3, 9)), "basis: 9: the model has no such marker"),
        (DisplacementTarget((1e308,) * 16, 1), "matrix: its largest number is 1e+308; 1e-100 to 1e+100 is valid"),
        (DisplacementTarget((0.0,) * 16, 1), "matrix: is singular (singular values 0, 0, 0, 0)"),
        (DisplacementTarget(MIRROR, 1), "determinant is negative, which makes a mirror image"),
        (DisplacementTarget(EYE, 1, None, MetricFrame("tool", EYE, True, (0, 0, 0), True)), "kind 'step' with the"),
        (StepTarget(move=(0.0, 0.0, 0.0)), "exactly one of matrix, and of move or turn"),
        (StepTarget(move=(0.0, 0.0, 1.0), matrix=EYE), "exactly one of matrix, and of move or turn"),
        (StepTarget("hand", (0.0, 0.0, 1.0)), "no frame 'hand'; valid: tool, base, camera:left, camera:right, and"),
        (StepTarget("scene:0-6-7", (0.0, 0.0, 1.0)), "0 is of the marker body itself"),
        (StepTarget("base", (0.0, 0.0, 1.0), length="plate=5"), "length: 'plate=5' is no known length; WHAT:OF"),
        (StepTarget("base", (0.0, 0.0, 101.0)), "move: its largest number is 101; up to 100 is valid"),
        (StepTarget("base", turn=(0.0, 3.0, 3.0)), "turn: 243.085°; up to 180° is valid"),
        (StepTarget("base", matrix=MIRROR), "matrix: is not rigid, by 0; a rotation (3 x 3, determinant 1)"),
        (StepTarget("base", matrix=tuple(2.0 * x for x in EYE)), "matrix: is not rigid, by 3"),
        (TaughtTarget("park", None, (6, 7, 8)), "common: 6, 7, 8 belongs to relative_to"),
        (TaughtTarget("park", "workpiece", (6, 7)), "2 marker(s) (6, 7); 5 are needed, with a metric model 3"),
        (TaughtTarget("park", "workpiece", (6, 7, 8, 0)), "0 is of the marker body itself; markers beside it: 6"),
        (incidence("point-on-line", PIN, HOLE), "fixed.points: 1 given; a line is spanned by 2"),
        (incidence("line-on-line", PIN, Feature(points=2 * HOLE.points)), "moving.markers: 1 given; a line"),
        (incidence("point-on-point", HOLE, HOLE), "moving: given by points; what moves is given by markers"),
        (incidence("point-on-point", PIN, Feature()), "fixed: given by none; exactly one of markers, points, pixels"),
        (
            incidence("point-on-point", PIN, Feature(markers=(6,), points=HOLE.points)),
            "fixed: given by markers, points; exactly one",
        ),
        (incidence("point-on-point", PIN, Feature(markers=(1,))), "1 is of the marker body itself"),
        (incidence("point-on-point", PIN, HOLE, model_epoch=None), "target.model_epoch is needed with them"),
        (incidence("point-on-line", PIN, Feature(points=2 * HOLE.points)), "do not span a line; 2 points in general"),
        (
            incidence("point-on-line", PIN, Feature(points=((0.0, 0.0, 0.0, 5e-324),) * 2)),
            "points[0]: its largest number is 4.94066e-324",
        ),
        (incidence("point-on-point", PIN, Feature(pixels={"left": ((1, 1),)})), "of 1 camera(s) (left); two or more"),
        (
            incidence("point-on-point", PIN, Feature(pixels={"left": ((1, 1),), "up": ((1, 1),)})),
            "pixels.up: no camera 'up'; cameras: left, right",
        ),
        (
            incidence("point-on-point", PIN, Feature(pixels={"left": ((1, 999),), "right": ((1, 1),)})),
            "left[0]: pixel (1, 999) is outside the image",
        ),
        (incidence("point-on-point", PIN, HOLE, secondary=JointTarget({"j9": 0})), "secondary.positions.j9: no joint"),
        (incidence("point-on-point", PIN, HOLE, secondary=FeatureTarget({})), "secondary.set_points: is empty"),
    ],
)  # fmt: skip
def test_targets_that_cannot_be_say_what_would_have_been_valid(target: Any, expected: str) -> None:
    found = check_goal(Goal("12345678", target), RICH)
    assert len(found) >= 1
    assert expected in found[0]


@pytest.mark.parametrize(
    ("target", "options", "expected"),
    [
        (SEEN, {"law": "pbvs"}, "law: no law 'pbvs'; valid: stereo, image, points, cartesian3, cartesian2, trajectory"),
        (SEEN, {"law": "stereo", "profile": "linear"}, "profile: 'linear' belongs to law 'trajectory'; the goal's is"),
        (SEEN, {"law": "cartesian3", "jacobian": "mean"}, "jacobian: 'mean' belongs to laws stereo, image, points"),
        (SEEN, {"law": "stereo", "centre": Centre((0, 1))}, "centre: belongs to laws cartesian3, cartesian2"),
        (SEEN, {"law": "cartesian3", "centre": Centre()}, "centre: neither of markers and point given"),
        (SEEN, {"law": "cartesian3", "centre": Centre((9,))}, "centre.markers: 9: the model has no such marker"),
        (SEEN, {"law": "cartesian3", "centre": Centre((), (0, 0, 1, 1))}, "centre.model_epoch: is needed with a point"),
        (SEEN, {"cameras": ("left", "up")}, "cameras: no camera 'up'; cameras: left, right"),
        (SEEN, {"cameras": ()}, "cameras: is empty; some of left, right are needed"),
        (SEEN, {"cameras": ("left", "left")}, "cameras: 'left' stands twice"),
        (SEEN, {"law": "stereo", "cameras": ("left",)},
         "cameras: left alone; law 'stereo' takes two or more, 'image' works with one"),
        (
            FeatureTarget({"left": GOOD}), {"law": "image", "cameras": ("right",)},
            "cameras: right, but the set-points are of left",
        ),
        (SEEN, {"gain": AdaptiveGain(1.0, 1.0)}, "gain: near 1 is not above far 1"),
        (SEEN, {"gain": AdaptiveGain(0.5, 4.0)}, "gain: near 0.5 is not above far 4"),
        (SEEN, {"blend_px": 0.1}, "blend_px: 0.1 is not above the tolerance of 0.1 px"),
        (SEEN, {"blend_px": 2.0, "tolerance_px": 3.0}, "blend_px: 2 is not above the tolerance of 3 px"),
        (SEEN, {"blend_px": 5.0, "acknowledge_s": 9.0}, "acknowledge_s: 9 makes the arm stop and wait, blend_px 5"),
        (JointTarget({"j1": 0.1}), {"blend_px": 5.0}, "blend_px: 5.0 belongs to an image law"),
        (JointTarget({"j1": 0.1}), {"gain": AdaptiveGain(4.0, 1.0)}, 'gain: {"near":4.0,"far":1.0'),
        (JointTarget({"j1": 0.1}), {"damping": 0.3}, "damping: 0.3 belongs to an image law"),
        (incidence("point-on-point", PIN, HOLE), {"law": "stereo"}, "law: 'stereo' belongs to a target that"),
    ],
)  # fmt: skip
def test_options_that_do_not_go_together_are_named(target: Any, options: dict[str, Any], expected: str) -> None:
    (found,) = check_goal(Goal("12345678", target, **options), RICH)
    assert expected in found


def test_options_that_go_together_have_no_problem() -> None:
    for options in (
        {"law": "trajectory", "profile": "exponential", "centre": Centre((0, 1, 2, 3))},
        {"law": "image", "cameras": ("left",), "jacobian": "fixed-depth"},
        {"law": "cartesian3", "centre": Centre((), (0.0, 0.0, 1.0, 1.0), 3), "gain": AdaptiveGain(4.0, 0.8)},
        {"blend_px": 5.0, "mode": "queue"},
        {"acknowledge_s": 30.0},
    ):
        assert check_goal(Goal("12345678", SEEN, **options), RICH) == []  # type: ignore[arg-type]
    assert check_goal(Goal("12345678", JointTarget({"j1": 0.1}), acknowledge_s=3.0), RICH) == []


def test_commands_about_goals_are_checked_like_goals() -> None:
    assert check_command(UpdateGoal("12345678", SEEN, 1.0), RICH) == []
    assert check_command(UpdateGoal("12345678", PointTarget(POINTS, 1)), RICH) == []
    assert check_command(AcknowledgeGoal("12345678"), RICH) == []
    assert check_command(Teach("pick", 5, (6, 7, 8)), RICH) == []
    (found,) = check_command(UpdateGoal("12345678", FeatureTarget({"up": GOOD})), RICH)
    assert "no camera 'up'" in found
    (found,) = check_command(Teach("pick", 5, (6, 7)), RICH)
    assert "tool: 2 marker(s) (6, 7); at least 3" in found
    (found,) = check_command(Teach("pick", 5, (6, 7, 8, 70)), RICH)
    assert "tool: 70: no detector of the cell knows it" in found


numbers = st.floats(allow_nan=False, allow_infinity=False, width=32)


@given(st.lists(numbers, min_size=16, max_size=16))
def test_any_matrix_gets_an_answer(matrix: list[float]) -> None:
    goal = Goal("12345678", DisplacementTarget(tuple(matrix), 1))
    found = check_goal(goal, RICH)
    assert all("target.matrix" in problem for problem in found)
    scaled = np.array(matrix).reshape(4, 4) / max(1.0, float(np.abs(matrix).max()))
    if np.linalg.det(scaled) < -1e-3:
        assert "mirror" in found[0]


@given(st.dictionaries(st.integers(0, 8), st.tuples(numbers, numbers, numbers, numbers), max_size=5))
def test_any_points_get_an_answer(points: dict[int, Any]) -> None:
    found = check_goal(Goal("12345678", PointTarget(points, 1)), RICH)
    if len(points) < 3 or set(points) - set(range(6)) or not all(any(point) for point in points.values()):
        assert found


def test_markers_of_a_target_that_moves_go_with_goals_that_fix_a_pose() -> None:
    goal = Goal("00000001", FeatureTarget({"left": GOOD, "right": GOOD}), follow_markers=(14, 15, 16, 17, 18))
    assert check_goal(goal, CONTEXT) == []
    seen = {"middle": {14: (1.0, 2.0)}, "left": {14: (1.0, 2.0), 19: (1.0, 2.0)}}
    (camera, marker) = check_goal(msgspec.structs.replace(goal, follow_seen=seen), CONTEXT)
    assert camera == "follow_seen: no camera 'middle'; cameras: left, right"
    assert marker == "follow_seen.left: 19 not in follow_markers 14, 15, 16, 17, 18"
    (twice,) = check_goal(msgspec.structs.replace(goal, follow_markers=(14, 14, 15, 16, 17)), CONTEXT)
    assert twice == "follow_markers: 14 stands twice"
    taught = Goal("00000002", TaughtTarget("pick", relative_to="workpiece"), follow_markers=(14,))
    assert any("leave out relative_to 'workpiece'" in problem for problem in check_goal(taught, CONTEXT))
    joints = Goal("00000003", JointTarget({}), follow_markers=(14,))
    assert any("follows nothing that is seen" in problem for problem in check_goal(joints, CONTEXT))
