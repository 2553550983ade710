"""``goal`` and ``teach``: what the options say, plans and progress in words. No daemon is asked."""

from __future__ import annotations

import io
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stereoservo.cli import goal as goal_command
from stereoservo.cli.goal import adaptive, make_goal, plan_table, step_tree, stream_lines, target_tree
from stereoservo.cli.main import invoke
from stereoservo.cli.output import CommandError
from stereoservo.cli.status import progress_words
from stereoservo.cli.teach import read_drawing
from stereoservo.messages.goals import (
    AdaptiveGain,
    Approach,
    DisplacementTarget,
    FeatureTarget,
    IncidenceTarget,
    PlanReport,
    PointTarget,
    StepTarget,
    TaughtTarget,
)
from stereoservo.messages.wire import MessageError

EYE = [[float(i == j) for j in range(4)] for i in range(4)]
FLAT = tuple(number for row in EYE for number in row)
SEEN = {"left": {"0": [1, 2], "1": [3, 4], "2": [5, 6]}}


def written(tmp_path: Path, tree: Any) -> Path:
    path = tmp_path / "target.json"
    path.write_text(json.dumps(tree))
    return path


def made(tmp_path: Path, option: str, tree: Any) -> Any:
    files: dict[str, Path | None] = dict.fromkeys(("points", "displacement", "incidence"))
    files[option] = written(tmp_path, tree)
    return make_goal(target_tree("", None, None, files, None, None), law=None).target


def test_targets_come_from_files(tmp_path: Path) -> None:
    points = {"points": {"0": [0, 0, 1, 1]}, "model_epoch": 3}
    assert made(tmp_path, "points", points) == PointTarget({0: (0, 0, 1, 1)}, 3)
    assert made(tmp_path, "points", points | {"kind": "points"}) == PointTarget({0: (0, 0, 1, 1)}, 3)
    wanted = DisplacementTarget(FLAT, basis=(0, 1, 2, 3, 4))
    for matrix in (EYE, FLAT):
        assert made(tmp_path, "displacement", {"matrix": matrix, "basis": [0, 1, 2, 3, 4]}) == wanted
    hole = {"points": [[0, 0, 1, 1]]}
    spec = {"kind": "point-on-point", "moving": {"markers": [0]}, "fixed": hole}
    found = made(tmp_path, "incidence", {"incidences": [spec], "model_epoch": 1})
    assert isinstance(found, IncidenceTarget)
    found = made(tmp_path, "displacement", {"matrix": EYE, "frame": "base"})
    assert found == StepTarget("base", matrix=FLAT)
    taught = target_tree("pick", None, None, {}, "workpiece", "10,11,12")
    assert make_goal(taught).target == TaughtTarget("pick", "workpiece", (10, 11, 12))


def test_steps_are_read_in_their_units() -> None:
    step = step_tree(["z=+20mm", "x=-1.5cm"], ["y=10deg"], "base", "")
    turn = (0.0, pytest.approx(math.radians(10)), 0.0)
    assert make_goal(step).target == StepTarget("base", (-0.015, 0.0, 0.02), turn)
    assert make_goal(step_tree(["x=.5m,y=1e-3m"], None, None, "a:j2=0.4")).target == StepTarget(
        "tool", (0.5, 0.001, 0.0), length="a:j2=0.4"
    )
    for move, turn in ((["z=20"], None), (["z=20deg"], None), (["z=1mm", "z=2mm"], None), (None, ["w=3deg"])):
        with pytest.raises(CommandError, match="each of x, y, z at most once, a number and a unit"):
            step_tree(move, turn, None, "")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("pick", "--points", "predicted"), "one of NAME"),
        (("pick", "--move", "z=1mm"), "one of NAME"),
        (("pick", "--in", "base"), "--in and --length go with --move or --turn"),
        (("--points", "predicted"), "--points takes a file; predicted goes with --point-source"),
        (
            ("--joint", "j1=0", "--relative-to", "workpiece"),
            "--relative-to, --common, --lines and --planes go with NAME",
        ),
        (("pick", "--relative-to", "moon"), "target.relative_to: Invalid enum value 'moon'"),
        (("pick", "--common", "ten"), "--common 'ten': marker ids with commas, 10,11,12, are valid"),
        (("pick", "--centre", "0;1"), "--centre '0;1'"),
        (("pick", "--adaptive-gain", "4"), "NEAR:FAR or NEAR:FAR:SLOPE is valid"),
        (("pick", "--adaptive-gain", "4:nan"), "gain.far is nan"),
        (("pick", "--adaptive-gain", "4:1", "--gain", "2"), "one of them"),
        (("pick", "--damping", "1"), "damping"),
        (
            ("pick", "--jacobian", "last"),
            "jacobian: Invalid enum value 'last'; valid: current, desired, fixed-depth, mean",
        ),
        (("pick", "--profile", "wavy"), "profile: Invalid enum value 'wavy'; valid: exponential, linear"),
        (("pick", "--follow", "-"), "--follow is a target of its own"),
        (("--follow", "/none.jsonl"), "/none.jsonl: No such file"),
        (("--displacement", "/none.json"), "/none.json: No such file"),
        (("pick", "--blend", "-1"), "blend_px: Expected `float` >= 0.0001"),
        (("pick", "--acknowledge", "inf"), "acknowledge_s is inf"),
    ],
)
def test_options_are_checked_before_anybody_is_asked(
    arguments: tuple[str, ...], text: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert invoke(["goal", "nowhere", *arguments, "--json"]) == 1
    assert text in json.loads(capfd.readouterr().out)["error"]["message"]


def test_files_of_another_kind_are_named(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match="kind is 'joints'; 'points' goes with --points"):
        made(tmp_path, "points", {"kind": "joints"})
    with pytest.raises(CommandError, match="holds list; a JSON object is needed"):
        made(tmp_path, "displacement", EYE)
    with pytest.raises(MessageError, match="matrix"):
        made(tmp_path, "displacement", {"matrix": FLAT[:9]})
    (tmp_path / "target.json").write_text("{")
    with pytest.raises(CommandError, match="is not JSON"):
        target_tree("", None, None, {"points": tmp_path / "target.json"}, None, None)


def test_an_adaptive_gain_is_two_or_three_numbers() -> None:
    target = {"kind": "taught", "name": "pick"}
    assert make_goal(target, gain=adaptive("4:0.8")).gain == AdaptiveGain(4.0, 0.8)
    assert make_goal(target, gain=adaptive("4:0.8:30")).gain == AdaptiveGain(4.0, 0.8, 30.0)


def test_a_stream_in_a_file_is_paced_by_its_stamps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "way.jsonl"
    path.write_text("\n".join(json.dumps({"stamp_s": 7.0 + 0.5 * k, "set_points": SEEN}) for k in range(3)) + "\n\n")
    now, slept = 50.0, []

    def sleep(seconds: float) -> None:
        nonlocal now
        slept.append(seconds)
        now += seconds

    monkeypatch.setattr(goal_command, "time", SimpleNamespace(monotonic=lambda: now, sleep=sleep))
    found = list(stream_lines(str(path)))
    assert [stamp for stamp, _ in found] == [7.0, 7.5, 8.0]
    assert slept == [0.0, 0.5, 0.5]
    assert found[0][1] == FeatureTarget({"left": {0: (1, 2), 1: (3, 4), 2: (5, 6)}})


def test_a_stream_on_stdin_is_taken_as_it_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = (
        b'{"points": {"0": [0, 0, 1, 1]}, "model_epoch": 4}\n'
        b'{"stamp_s": 1.5, "points": {"0": [0, 0, 1, 1]}, "model_epoch": 4}\n'
    )
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(lines)))
    wanted = PointTarget({0: (0, 0, 1, 1)}, 4)
    assert list(stream_lines("-")) == [(None, wanted), (1.5, wanted)]


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ({}, "line 1: neither of set_points and points given"),
        ({"set_points": SEEN, "points": {}}, "line 1: both of set_points and points given"),
        ({"points": {"0": [0, 0, 1, 1]}}, "line 1: .*model_epoch is needed"),
        ({"set_points": SEEN, "when": 1}, "line 1: .*unknown field `when`"),
    ],
)
def test_a_line_that_is_no_target_is_named(tmp_path: Path, line: Any, text: str) -> None:
    with pytest.raises(CommandError, match=text):
        list(stream_lines(str(written(tmp_path, line))))


def test_an_empty_stream_is_no_goal(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "empty.jsonl"
    path.write_text("")
    assert invoke(["goal", "nowhere", "--follow", str(path), "--json"]) == 1
    assert "holds no set-points" in json.loads(capfd.readouterr().out)["error"]["message"]


def test_drawings_are_read_with_their_pose_in_rows_or_flat(tmp_path: Path) -> None:
    tree = {"workpiece": {"10": [0, 0, 0]}, "tool": {"0": [1, 2, 3]}}
    found = read_drawing(written(tmp_path, tree | {"pose": EYE}), "pick")
    assert found.pose == FLAT
    assert found == read_drawing(written(tmp_path, tree), "pick")
    assert found.tool == {0: (1.0, 2.0, 3.0)}
    with pytest.raises(MessageError, match="pose"):
        read_drawing(written(tmp_path, tree | {"pose": [1, 2]}), "pick")
    with pytest.raises(MessageError, match="unknown field `body`"):
        read_drawing(written(tmp_path, tree | {"body": 1}), "pick")


def test_a_plan_is_a_table_of_the_closest_approaches() -> None:
    plan = PlanReport(
        "cartesian3",
        "linear",
        3.25,
        (
            Approach("JOINT_LIMIT", "j3", 1.92, 1.99, 0.07, "rad", 0.41),
            Approach("FIELD_OF_VIEW", "left", 12.0, 5.0, 7.0, "px", 0.6, 3),
        ),
        (0.0, 1.0),
        {},
        {},
    )
    head, titles, first, second = plan_table(plan).splitlines()
    assert head == "law cartesian3, path linear, 3.25 s"
    assert titles.split() == ["limit", "of", "nearest", "limit", "at", "clearance", "at", "path"]
    assert first.split("  ")[-1].strip() == "41 %"
    assert "j3" in first
    assert "0.07 rad" in first
    assert "left, marker 3" in second
    assert titles.index("clearance") == first.index("0.07 rad") == second.index("7 px")


def test_progress_is_told_as_far_as_it_is_known() -> None:
    state: Any = SimpleNamespace(progress=0.4, seconds_left=2.0, error_px=1.25)
    assert progress_words(state) == "40 % of its path, 2.0 s left, error 1.250 px"
    assert progress_words(SimpleNamespace(progress=None, seconds_left=None, error_px=None)) == ""  # type: ignore[arg-type]
