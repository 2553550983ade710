"""Files that the gateway keeps: stores of taught goals and models, and the journal, a log of events. None of them ends
the gateway: what is damaged is set aside, what cannot be written is told.
"""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Callable
from io import FileIO
from pathlib import Path

from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.taught_goals import (
    ModelOf,
    TaughtFileError,
    TaughtGoal,
    load_taught,
    refined_goal,
    save_taught,
)
from stereoservo.kinematics.model import CellModel, ModelFileError, load_model
from stereoservo.messages.files import set_aside

JOURNAL_BYTES = 10_000_000
REOPEN_S = 1.0
"""How often a journal that could not be opened is tried again."""
Tell = Callable[[str, str], None]
"""Called with the topic and the text of a note for the cell's keeper."""


class TaughtStore:
    """Taught goals by name. ``model_of``: see `load_taught`.

    A damaged file is set aside, told to ``recover``, and there are no goals; without ``recover`` it stays as it is, and
    TaughtFileError is raised.
    """

    def __init__(self, path: Path, model_of: ModelOf = lambda _: None, recover: Tell | None = None) -> None:
        self._path = path
        self.goals: dict[str, TaughtGoal] = {}
        try:
            self.goals = load_taught(path, model_of)
        except TaughtFileError as error:
            if recover is None:
                raise
            recover("taught goals", f"{error}; {set_aside(path)}, and there are no taught goals")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the goals, sorted."""
        return tuple(sorted(self.goals))

    def add(self, name: str, goal: TaughtGoal) -> None:
        """Store a goal, replacing one of the same name. Raises OSError, and the goal is not there then."""
        self._replace({**self.goals, name: goal})

    def refine(self, used: CellModel, model: CellModel) -> None:
        """State the goals in ``model`` in the place of ``used``, where nothing but the estimate changed (see
        `refined_goal`). Raises OSError where they cannot be stored; they are restated in memory then.
        """
        self.put_back({name: refined_goal(goal, used, model) for name, goal in self.goals.items()})

    def put_back(self, goals: dict[str, TaughtGoal]) -> None:
        """Have ``goals`` in memory, and in the file where it holds others. Raises OSError."""
        self.goals = goals
        try:
            stored = load_taught(self._path)
        except TaughtFileError:
            stored = None
        if stored != goals:
            save_taught(self._path, goals)

    def _replace(self, goals: dict[str, TaughtGoal]) -> None:
        save_taught(self._path, goals)
        self.goals = goals


class ModelStore:
    """Model files ``model-<epoch>.json``; an epoch is never used twice."""

    _FILE = re.compile(r"model-(\d{6,})\.json")
    _USED = re.compile(r"model-(\d{6,})\.json(?:\.damaged-\d+)?")

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def path(self, epoch: int) -> Path:
        """File of a model."""
        return self._directory / f"model-{epoch:06d}.json"

    def epochs(self) -> list[int]:
        """Epochs of all model files, ascending."""
        return self._epochs(self._FILE)

    def _epochs(self, pattern: re.Pattern[str]) -> list[int]:
        return sorted(
            int(match[1]) for path in self._directory.iterdir() if (match := pattern.fullmatch(path.name))
        )

    def next_epoch(self) -> int:
        """The last epoch plus one; those of damaged files that were set aside count."""
        return max(self._epochs(self._USED), default=0) + 1

    def of_epoch(self, epoch: int) -> CellModel | None:
        """Model of an epoch, None where its file is missing or damaged."""
        try:
            return load_model(self.path(epoch))
        except ModelFileError:
            return None

    def newest_fitting(
        self, settings: CoreSettings, *, recover: bool = False
    ) -> tuple[CellModel | None, list[str]]:
        """Newest model that fits the cell's joints and cameras, and why newer ones were skipped.

        ``recover``: set damaged files aside. Models of another schema are not damaged.
        """
        passed = []
        for epoch in reversed(self.epochs()):
            path = self.path(epoch)
            try:
                model = load_model(path)
            except ModelFileError as error:
                aside = f"; {set_aside(path)}" if recover and error.key != "schema" else ""
                passed.append(f"{error}{aside}")
                continue
            mismatch = _mismatch(model, settings)
            if not mismatch:
                return model, passed
            passed.append(f"{path}: {mismatch}")
        return None, passed


def _mismatch(model: CellModel, settings: CoreSettings) -> str:
    """Reason why ``model`` does not belong to this cell; empty where it does."""
    if model.joint_names != settings.joint_names or model.joint_kinds != settings.joint_kinds:
        return f"is of joints {_joints(model)}; the cell has {_joints(settings)}"
    of_model = [(camera.name, camera.width, camera.height) for camera in model.cameras]
    of_cell = [(camera.name, camera.width, camera.height) for camera in settings.cameras]
    if of_model != of_cell:
        return f"is of cameras {of_model}; the cell has {of_cell}"
    mounts = {camera.mount for camera in settings.cameras}
    if mounts != {model.mount}:
        return f"is of cameras mounted {model.mount}; the cell's are {', '.join(sorted(mounts))}"
    unknown = [marker for marker in model.marker_ids if marker not in settings.marker_ids]
    if unknown:
        return f"has markers {unknown} that no detector of the cell reports"
    return ""


def _joints(of: CellModel | CoreSettings) -> str:
    """Joint names, with the kinds of those that are not revolute."""
    return ", ".join(
        name if kind == "revolute" else f"{name} ({kind})"
        for name, kind in zip(of.joint_names, of.joint_kinds, strict=True)
    )


class Journal:
    """Log of events for people, one JSON object a line; the older half is dropped when the file has grown large.

    What cannot be written is lost and counted (``note``).
    """

    def __init__(self, path: Path, limit: int = JOURNAL_BYTES) -> None:
        self._path = path
        self._limit = limit
        self._stream: FileIO | None = None
        self._tried_s = -REOPEN_S
        self._torn = False
        self._lost = 0
        self._cause = ""
        try:
            self._open()
        except OSError as error:
            self._cause = error.strerror or str(error)

    @property
    def note(self) -> str:
        """Text on lines that are missing; empty where there are none."""
        return f"{self._path}: {self._lost} events are missing in it: {self._cause}" if self._cause else ""

    def _open(self) -> FileIO:
        if self._stream is None:
            self._tried_s = time.monotonic()
            self._stream = FileIO(self._path, "ab")
        return self._stream

    def add(self, line: bytes) -> None:
        """Append a line, unless the file cannot be written."""
        if self._stream is None and time.monotonic() - self._tried_s < REOPEN_S:
            self._lost += 1
            return
        try:
            self._write(line)
        except OSError as error:
            self._lost += 1
            self._cause = error.strerror or str(error)

    def _write(self, line: bytes) -> None:
        stream = self._open()
        data = (b"\n" if self._torn else b"") + line + b"\n"
        written = stream.write(data)
        self._torn = written < len(data)
        if self._torn:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if stream.tell() > self._limit:
            self.close()
            self._path.replace(self._path.with_suffix(".1.jsonl"))
            self._open()

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._stream is not None:
            stream, self._stream = self._stream, None
            stream.close()
