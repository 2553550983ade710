"""Progress of a calibration on the wire and as text."""

import msgspec
import pytest

from stereoservo.messages.learning import JointLearning, LearningLines, LearningState
from stereoservo.messages.wire import StateMessage, encode, read, schema

JOINTS = tuple(JointLearning(f"j{k}") for k in (1, 2, 3))
KNOWN = (JointLearning("j1", 0.5, 0.05), JointLearning("j2", 0.4, 0.4), JointLearning("j3", 0.1))
MOVING = LearningState("moving", 3, 4, 212, KNOWN, 5.4, 0.41, {"left": 0.25})
STATE = {
    "t_ns": 1, "step": 1, "lifecycle": "active", "model": "none", "model_epoch": 0, "source": "calibration",
    "goal": "g", "law": "", "level": "ok", "reasons": [], "cell": "c", "boot": "b", "t_wall": 1.0, "joints": {},
    "velocities": {}, "command": {}, "error_px": None, "task_error": [], "innovation_px": {}, "visible": {},
    "loop": {"rate_hz": 1.0, "cycles": 1, "overruns": 0, "skipped": 0, "lateness_us": {}, "work_us": {}},
}  # fmt: skip


def test_a_state_of_an_older_daemon_has_no_learning_and_an_older_reader_skips_it() -> None:
    old = read(msgspec.json.encode(STATE), StateMessage)
    assert old.learning is None
    new = encode(msgspec.structs.replace(old, learning=MOVING))
    assert read(new, StateMessage).learning == MOVING

    class Older(msgspec.Struct):
        cell: str

    assert read(new, Older).cell == "c"
    assert b"predicted_px" in schema("state", ("stereo",))


def test_text_names_motion_images_time_and_what_is_known_of_each_joint() -> None:
    assert MOVING.text == "calibrating: joint 3 of 3, images 212, 5 s left, predicted 0.41 px (j1 0.05, j2 0.4)"
    first = LearningState("moving", 1, 4, 20, JOINTS, note="the first joint's motion is not done")
    assert first.text == (
        "calibrating: joint 1 of 3, images 20, accuracy not known yet (the first joint's motion is not done)"
    )
    assert "to the base, images 0" in LearningState("moving", 0, 4, 0, JOINTS).text
    assert "all joints at once" in msgspec.structs.replace(MOVING, motion=4).text
    assert "fitting the model" in msgspec.structs.replace(MOVING, doing="fitting").text


def test_the_picture_has_a_bar_for_each_joint_that_is_longer_for_smaller_errors() -> None:
    head, *rows = MOVING.picture.splitlines()
    assert head == MOVING.headline
    full = [row.count("█") for row in rows]
    assert len({len(row.rstrip("abcdefghijklmnopqrstuvwxyz .0123456789")) for row in rows}) == 1
    assert full[0] > full[1] > full[2] == 0
    assert rows[0].endswith("0.05 px")
    assert rows[2].endswith("not known yet")
    assert JointLearning("j1").share == 0.0
    errors = (100.0, 10.0, 0.1, 0.001, 1e-9, 0.0)
    assert [JointLearning("j", 1.0, px).share for px in errors] == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0, 1.0])


def test_a_line_is_printed_where_the_motion_or_the_accuracy_changes() -> None:
    lines: list[str] = []
    tell = LearningLines(lines.append)
    for motion in (1, 2, 3):
        for images in range(10):
            for joints, px in ((JOINTS, None),) if motion == 1 else ((KNOWN, 0.5 / motion),):
                tell(LearningState("moving", motion, 4, 10 * motion + images, joints, predicted_px=px))
    tell(msgspec.structs.replace(MOVING, doing="fitting"))
    assert len(lines) == 4
    assert [line[13:20] for line in lines[:3]] == ["joint 1", "joint 2", "joint 3"]
