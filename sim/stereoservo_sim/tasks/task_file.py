"""Reader and writer of task files: alignment tasks as CSV; errors state line and column."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.tasks.setting import CENTRE_U, CENTRE_V, FOCAL, HEIGHT, MARKERS, WIDTH, camera_poses

MAX_BYTES = 64 * 2**20
MAX_TASKS = 100_000
RIGID_TOLERANCE = 1e-6
"""Largest difference of RᵀR from the identity, and of the last row from (0, 0, 0, 1)."""
UNIT_TOLERANCE = 1e-3
STATED_TOLERANCE = 1e-9
"""Largest difference of a camera's stated pose from the one fixed by v1."""
VERSION_LINE = "stereoservo benchmark tasks v"
VERSION = "1"
MAX_ID = 2**53

ERROR_AXIS = ("err_ax", "err_ay", "err_az")
START = tuple(f"rM0_{i}{k}" for i in range(4) for k in range(4))
GOAL = tuple(f"rMs_{i}{k}" for i in range(4) for k in range(4))
COLUMNS = ("id", "seed", "angle_deg", "trans_m", *ERROR_AXIS, *START, *GOAL)


class TaskFileError(Exception):
    """An invalid task file. The text states where, and what would be valid.

    Attributes:
        code: ``task_file``.
        line, column: position, from 1 and by name; 0 and empty if it is the file as a whole.
    """

    code = "task_file"

    def __init__(self, path: Path | str, line: int, column: str, message: str) -> None:
        where = f", line {line}" if line else ""
        super().__init__(f"{path}{where}{f', column {column}' if column else ''}: {message}")
        self.line = line
        self.column = column


@dataclass(frozen=True, eq=False)
class AlignmentTask:
    """Task: move the plate from ``start`` to ``goal``, (4, 4) poses in the rig's frame.

    ``error_axis`` (3,): unit axis of the hand-eye error of the coarse calibration. ``angle_deg``, ``distance_m``: of
    the path, as stated in the file.
    """

    id: int
    seed: int
    angle_deg: float
    distance_m: float
    error_axis: FloatArray
    start: FloatArray
    goal: FloatArray


def read_tasks(path: Path) -> tuple[AlignmentTask, ...]:
    """All tasks of a file, in order. Raises TaskFileError."""
    header: list[str] | None = None
    tasks: list[AlignmentTask] = []
    lines: dict[int, int] = {}
    for number, line in _lines(path):
        if line.startswith("#"):
            _check_comment(path, number, line)
            continue
        if not line.strip():
            continue
        fields = _fields(path, number, line)
        if header is None:
            header = _header(path, number, fields)
            continue
        if len(fields) != len(header):
            raise TaskFileError(path, number, "", f"{len(fields)} fields; the header has {len(header)} columns")
        task = _task(path, number, dict(zip(header, fields, strict=True)))
        if task.id in lines:
            raise TaskFileError(path, number, "id", f"{task.id} stands in line {lines[task.id]}, too")
        lines[task.id] = number
        tasks.append(task)
        if len(tasks) > MAX_TASKS:
            raise TaskFileError(path, number, "", f"more than {MAX_TASKS} tasks; split the file")
    if header is None:
        raise TaskFileError(path, 0, "", f"no header line; needed: {','.join(COLUMNS[:4])},…")
    if not tasks:
        raise TaskFileError(path, 0, "", "a header, but no task")
    return tuple(tasks)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise TaskFileError(path, 0, "", f"cannot be read: {error.strerror}") from error
    if len(data) > MAX_BYTES:
        raise TaskFileError(path, 0, "", f"longer than {MAX_BYTES // 2**20} MiB; no task file is")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise TaskFileError(path, line, "", "is not UTF-8 text; a CSV file is needed") from error
    yield from enumerate(text.split("\n"), start=1)


def _check_comment(path: Path, number: int, line: str) -> None:
    """Check that a comment on the scene agrees with v1, since other cameras would give other tasks."""
    text = line.lstrip("#").strip()
    if text.startswith(VERSION_LINE):
        version = text.removeprefix(VERSION_LINE).split()[0] if text != VERSION_LINE else ""
        if version != VERSION:
            raise TaskFileError(path, number, "", f"version {version!r}; this program reads {VERSION}")
    for name, pose in zip(("rMcl", "rMcr"), camera_poses(), strict=True):
        if text.startswith(name) and "=" in text:
            try:
                stated = np.array([float(part) for part in text.partition("=")[2].split(",")])
            except ValueError:
                stated = np.zeros(0)
            if stated.shape != (16,) or not np.abs(stated - pose.ravel()).max() <= STATED_TOLERANCE:
                valid = ",".join(f"{value:.12g}" for value in pose.ravel())
                raise TaskFileError(path, number, "", f"{name} is not the pose of v1, {valid}")
    if text.startswith("CAMERAS"):
        stage = f"fx=fy={FOCAL} cx={CENTRE_U} cy={CENTRE_V}, image {WIDTH}x{HEIGHT}"
        if stage not in text:
            raise TaskFileError(path, number, "", f"other cameras than those of v1: {stage}")
    if text.startswith("MARKERS"):
        stage = " ".join("({:g},{:g},{:g})".format(*marker) for marker in MARKERS)
        if stage not in text:
            raise TaskFileError(path, number, "", f"other markers than those of v1: {stage}")


def _fields(path: Path, number: int, line: str) -> list[str]:
    try:
        return next(csv.reader([line.rstrip("\r")], strict=True))
    except csv.Error as error:
        raise TaskFileError(path, number, "", f"is not CSV: {error}") from error


def _header(path: Path, number: int, fields: list[str]) -> list[str]:
    for name in COLUMNS:
        if name not in fields:
            raise TaskFileError(path, number, name, "is missing in the header")
    for name in fields:
        if name not in COLUMNS:
            raise TaskFileError(path, number, repr(name[:40]), f"is unknown; known: {', '.join(COLUMNS)}")
        if fields.count(name) > 1:
            raise TaskFileError(path, number, name, "stands twice in the header")
    return fields


def _task(path: Path, number: int, row: dict[str, str]) -> AlignmentTask:
    axis = np.array([_number(path, number, row, name) for name in ERROR_AXIS])
    length = float(np.linalg.norm(axis))
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        raise TaskFileError(
            path, number, ERROR_AXIS[0], f"the error axis has length {length:.6g}; a unit vector is needed"
        )
    return AlignmentTask(
        _integer(path, number, row, "id"),
        _integer(path, number, row, "seed"),
        _number(path, number, row, "angle_deg"),
        _number(path, number, row, "trans_m"),
        axis / length,
        _pose(path, number, row, START),
        _pose(path, number, row, GOAL),
    )


def _pose(path: Path, number: int, row: dict[str, str], names: Sequence[str]) -> FloatArray:
    pose = np.array([_number(path, number, row, name) for name in names]).reshape(4, 4)
    off = np.abs(pose[3] - np.array([0.0, 0.0, 0.0, 1.0]))
    if not off.max() <= RIGID_TOLERANCE:
        column = names[12 + int(off.argmax())]
        raise TaskFileError(path, number, column, "the last row of a pose is 0,0,0,1")
    R = pose[:3, :3]
    defect = float(np.abs(R.T @ R - np.eye(3)).max())
    where = f"{names[0]} to {names[10]}"
    if not defect <= RIGID_TOLERANCE:
        raise TaskFileError(
            path,
            number,
            where,
            f"no rotation: RᵀR is off the identity by {defect:.3g}; at most {RIGID_TOLERANCE:g} is taken",
        )
    if np.linalg.det(R) < 0.0:
        raise TaskFileError(path, number, where, "a mirror image: det R is -1; a rotation has determinant 1")
    return pose


def _number(path: Path, number: int, row: dict[str, str], name: str) -> float:
    try:
        value = float(row[name])
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e9:
        raise TaskFileError(path, number, name, f"{row[name][:40]!r}; a finite number below 1e9 is needed")
    return value


def _integer(path: Path, number: int, row: dict[str, str], name: str) -> int:
    try:
        value = int(row[name])
    except ValueError:
        value = -1
    if not 0 <= value <= MAX_ID:
        raise TaskFileError(path, number, name, f"{row[name][:40]!r}; an integer from 0 to {MAX_ID} is needed")
    return value


def tasks_text(tasks: Sequence[AlignmentTask], source: str) -> str:
    """Text of a task file, which `read_tasks` reads; ``source``: one line on the tasks' origin."""
    left, right = (",".join(f"{v:.12g}" for v in pose.ravel()) for pose in camera_poses())
    markers = " ".join("({:g},{:g},{:g})".format(*marker) for marker in MARKERS)
    out = io.StringIO()
    out.write(
        f"# {VERSION_LINE}{VERSION} ({source})\n"
        "# UNITS metres, radians, pixels. Frames right-handed, camera z forward, x right, y down. "
        "xMy = 4x4 pose of y in x, row-major.\n"
        f"# CAMERAS (both identical, no distortion): fx=fy={FOCAL} cx={CENTRE_U} cy={CENTRE_V}, "
        f"image {WIDTH}x{HEIGHT}\n"
        f"# rMcl = {left}\n# rMcr = {right}\n"
        f"# MARKERS in the plate frame o (index order = correspondence): {markers}\n"
        "# The plate's printed face has outward normal -z_o. TASK: move the plate from rM0 to rMs.\n"
        "# err_ax..err_az = unit axis of the 5 deg hand-eye rotation error of 'coarse calibration' runs "
        "(focal estimate = 1.1*f).\n"
    )
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for task in tasks:
        poses = (f"{v:.12g}" for v in (*task.start.ravel(), *task.goal.ravel()))
        axis = (f"{v:.9g}" for v in task.error_axis)
        writer.writerow([task.id, task.seed, f"{task.angle_deg:.6f}", f"{task.distance_m:.6f}", *axis, *poses])
    return out.getvalue()
