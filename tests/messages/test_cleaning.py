"""What a daemon removes from its runtime directory, and what it leaves."""

from __future__ import annotations

from pathlib import Path

from stereoservo.daemon.supervisor import clean
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.locks import FileLock


def test_files_that_another_process_holds_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    directories = CellDirectories("cell", tmp_path / "run", tmp_path / "state")
    for name in ("state.slot", "arm.truth", "daemon.lock"):
        (directories.runtime / name).touch()
    with FileLock(directories.runtime / "arm.truth.lock", "the emulated arm"):
        clean(directories)
        assert sorted(path.name for path in directories.runtime.iterdir()) == [
            "arm.truth", "arm.truth.lock", "daemon.lock",
        ]  # fmt: skip
    clean(directories)
    assert not (directories.runtime / "arm.truth").exists()
