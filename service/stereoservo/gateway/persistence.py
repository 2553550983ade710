"""Files in a cell's state directory: stores of taught goals and models, written atomically, and the journal, a log of
events.
"""

from __future__ import annotations

import re
from pathlib import Path

from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.taught_goals import ModelOf, TaughtGoal, load_taught, save_taught
from stereoservo.kinematics.model import CellModel, ModelFileError, load_model

JOURNAL_BYTES = 10_000_000


class TaughtStore:
    """Taught goals by name. ``model_of``: see `load_taught`.

    Raises TaughtFileError for a damaged file (which stays as it is).
    """

    def __init__(self, path: Path, model_of: ModelOf = lambda _: None) -> None:
        self._path = path
        self.goals: dict[str, TaughtGoal] = load_taught(path, model_of)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the goals, sorted."""
        return tuple(sorted(self.goals))

    def add(self, name: str, goal: TaughtGoal) -> None:
        """Store a goal, replacing one of the same name. Raises OSError."""
        self.goals[name] = goal
        save_taught(self._path, self.goals)


class ModelStore:
    """Model files ``model-<epoch>.json``; an epoch is never used twice."""

    _FILE = re.compile(r"model-(\d{6,})\.json")

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def path(self, epoch: int) -> Path:
        """File of a model."""
        return self._directory / f"model-{epoch:06d}.json"

    def epochs(self) -> list[int]:
        """Epochs of all model files, ascending."""
        return sorted(
            int(match[1]) for path in self._directory.iterdir() if (match := self._FILE.fullmatch(path.name))
        )

    def next_epoch(self) -> int:
        """The last epoch plus one."""
        return max(self.epochs(), default=0) + 1

    def of_epoch(self, epoch: int) -> CellModel | None:
        """Model of an epoch, None where its file is missing or damaged."""
        try:
            return load_model(self.path(epoch))
        except ModelFileError:
            return None

    def newest_fitting(self, settings: CoreSettings) -> tuple[CellModel | None, list[str]]:
        """Newest model that fits the cell's joints and cameras, and why newer ones were skipped."""
        passed = []
        for epoch in reversed(self.epochs()):
            path = self.path(epoch)
            try:
                model = load_model(path)
            except ModelFileError as error:
                passed.append(str(error))
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
    """Log of events for people, one JSON object a line; the older half is dropped when the file has grown large."""

    def __init__(self, path: Path, limit: int = JOURNAL_BYTES) -> None:
        self._path = path
        self._limit = limit
        self._stream = path.open("ab", buffering=0)

    def add(self, line: bytes) -> None:
        """Append a line."""
        self._stream.write(line + b"\n")
        if self._stream.tell() > self._limit:
            self._stream.close()
            self._path.replace(self._path.with_suffix(".1.jsonl"))
            self._stream = self._path.open("ab", buffering=0)

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._stream.close()
