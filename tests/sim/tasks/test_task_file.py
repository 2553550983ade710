"""Task files: what is read is what was written; what does not fit is refused with line and column."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.tasks import task_file
from stereoservo_sim.tasks.ground_truth import sight
from stereoservo_sim.tasks.hard_tasks import hard_tasks, shipped_tasks_path, straight_path_margins
from stereoservo_sim.tasks.task_file import COLUMNS, TaskFileError, read_tasks, tasks_text

HEADER_LINE = 9


@pytest.fixture
def written(tmp_path, drawn):
    """Writes a file of two tasks, changed line by line: ``written({line: text})``."""

    def write(changes=None, extra=(), drop_comments=False):
        lines = tasks_text(drawn(3, 2), "test").splitlines()
        for number, text in (changes or {}).items():
            lines[number - 1] = text
        if drop_comments:
            lines = [line for line in lines if not line.startswith("#")]
        path = tmp_path / "tasks.csv"
        path.write_text("\n".join([*lines, *extra]) + "\n", encoding="utf-8")
        return path

    return write


def cells(path, line):
    return path.read_text(encoding="utf-8").splitlines()[line - 1].split(",")


def with_cell(written, line, column, value):
    row = cells(written(), line)
    row[COLUMNS.index(column)] = value
    return written({line: ",".join(row)})


def test_what_is_written_is_read(written, drawn):
    for made, found in zip(drawn(3, 2), read_tasks(written()), strict=True):
        assert found.id == made.id
        np.testing.assert_allclose(found.start, made.start, atol=1e-11)
        np.testing.assert_allclose(found.goal, made.goal, atol=1e-11)
        np.testing.assert_allclose(found.error_axis, made.error_axis, atol=1e-8)
    assert len(read_tasks(written(drop_comments=True))) == 2


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("rM0_03", "nan", "finite"),
        ("rMs_11", "inf", "finite"),
        ("rMs_11", "", "finite"),
        ("trans_m", "far", "finite"),
        ("id", "1.5", "integer"),
        ("id", "-1", "integer"),
        ("rM0_33", "2", "last row"),
        ("rMs_30", "0.1", "last row"),
        ("err_ax", "3", "unit vector"),
    ],
)
def test_bad_cells_are_named(written, column, value, words):
    path = with_cell(written, HEADER_LINE + 2, column, value)
    with pytest.raises(TaskFileError, match=words) as raised:
        read_tasks(path)
    assert raised.value.line == HEADER_LINE + 2
    assert column in str(raised.value)


def test_poses_that_are_no_rigid_motion_are_refused(written):
    row = cells(written(), HEADER_LINE + 1)
    scaled, mirrored = list(row), list(row)
    first = COLUMNS.index("rM0_00")
    for i in (first, first + 4, first + 8):
        scaled[i] = repr(1.1 * float(row[i]))
        mirrored[i] = repr(-float(row[i]))
    with pytest.raises(TaskFileError, match="no rotation") as raised:
        read_tasks(written({HEADER_LINE + 1: ",".join(scaled)}))
    assert raised.value.column.startswith("rM0_00")
    with pytest.raises(TaskFileError, match="mirror"):
        read_tasks(written({HEADER_LINE + 1: ",".join(mirrored)}))


def test_headers_and_rows_of_the_wrong_count(written):
    header = ",".join(COLUMNS)
    cases = [
        ({HEADER_LINE: header.replace("rM0_12,", "")}, "rM0_12", HEADER_LINE),
        ({HEADER_LINE: header + ",speed"}, "'speed'", HEADER_LINE),
        ({HEADER_LINE: header + ",id"}, "id", HEADER_LINE),
        ({HEADER_LINE + 1: "1,2,3"}, "3 fields", HEADER_LINE + 1),
    ]
    for changes, words, line in cases:
        with pytest.raises(TaskFileError) as raised:
            read_tasks(written(changes))
        assert words in str(raised.value)
        assert raised.value.line == line


def test_an_id_that_stands_twice_names_both_lines(written):
    path = with_cell(written, HEADER_LINE + 2, "id", "0")
    with pytest.raises(TaskFileError, match=f"line {HEADER_LINE + 1}") as raised:
        read_tasks(path)
    assert (raised.value.line, raised.value.column) == (HEADER_LINE + 2, "id")


def test_files_that_are_no_task_files(tmp_path, written, monkeypatch):
    path = tmp_path / "x"
    for data, words in [
        (b"", "no header"),
        (b"\xff\xfe\x00binary", "UTF-8"),
        (b"hello world\n", "missing"),
        (b'id,"unfinished\n', "not CSV"),
        (",".join(COLUMNS).encode() + b"\n", "no task"),
    ]:
        path.write_bytes(data)
        with pytest.raises(TaskFileError, match=words):
            read_tasks(path)
    with pytest.raises(TaskFileError, match="cannot be read"):
        read_tasks(tmp_path / "none.csv")
    with pytest.raises(TaskFileError, match="cannot be read"):
        read_tasks(tmp_path)
    good = written()
    monkeypatch.setattr(task_file, "MAX_BYTES", good.stat().st_size - 1)
    with pytest.raises(TaskFileError, match="longer than"):
        read_tasks(good)


def test_a_huge_file_is_not_read_to_its_end(tmp_path):
    path = tmp_path / "huge.csv"
    with path.open("wb") as file:
        file.truncate(task_file.MAX_BYTES * 1000)
    with pytest.raises(TaskFileError, match="longer than"):
        read_tasks(path)


def test_too_many_tasks(written, monkeypatch):
    monkeypatch.setattr(task_file, "MAX_TASKS", 1)
    with pytest.raises(TaskFileError, match="more than 1 tasks"):
        read_tasks(written())


def test_other_versions_cameras_and_markers_are_refused(written):
    lines = written().read_text(encoding="utf-8").splitlines()
    changes = [
        (0, lines[0].replace("v1", "v2"), "version"),
        (2, lines[2].replace("800.0", "900.0"), "other cameras"),
        (3, lines[3].replace("-0.1", "-0.2"), "rMcl"),
        (4, "# rMcr = here", "rMcr"),
        (5, lines[5].replace("0.05", "0.06"), "other markers"),
    ]
    for index, text, words in changes:
        assert text != lines[index]
        with pytest.raises(TaskFileError, match=words) as raised:
            read_tasks(written({index + 1: text}))
        assert raised.value.line == index + 1


def test_the_shipped_hard_tasks_are_what_their_generator_writes():
    shipped = read_tasks(shipped_tasks_path())
    assert len(shipped) == 120
    for made, found in zip(hard_tasks(count=4), shipped, strict=False):
        assert made.id == found.id
        np.testing.assert_allclose(found.start, made.start, atol=1e-11)
        np.testing.assert_allclose(found.goal, made.goal, atol=1e-11)
    for task in shipped:
        for pose in (task.start, task.goal):
            seen = sight(pose)
            assert seen.in_view
            assert seen.margin_px > 5.9
            assert seen.facing > 0.2
    ways = np.array([straight_path_margins(task.start, task.goal) for task in shipped])
    assert (ways[:, 0] < 0).sum() >= 30
    assert (ways[:, 1] <= 0).sum() >= 30
    assert max(task.angle_deg for task in shipped) == 180.0
    assert max(task.distance_m for task in shipped) > 0.55
