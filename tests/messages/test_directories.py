"""Directories of a cell."""

from pathlib import Path

import pytest

from stereoservo.messages.directories import (
    DirectoryError,
    cell_directories,
    create_directories,
    runtime_root,
    state_root,
)


@pytest.fixture(autouse=True)
def roots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("STEREOSERVO_STATE_DIR", str(tmp_path / "state"))


def test_directories_are_private_and_made_once() -> None:
    directories = cell_directories("demo")
    create_directories(directories)
    create_directories(directories)
    assert directories.runtime.stat().st_mode & 0o777 == 0o700
    assert directories.runtime.parent.stat().st_mode & 0o777 == 0o700
    assert directories.models.is_dir()
    assert directories.recordings.is_dir()


def test_defaults_follow_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STEREOSERVO_RUNTIME_DIR")
    monkeypatch.delenv("STEREOSERVO_STATE_DIR")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    monkeypatch.setenv("HOME", "/home/x")
    assert runtime_root() == Path("/run/user/7/stereoservo")
    assert state_root() == Path("/home/x/.local/state/stereoservo")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert str(runtime_root()).startswith("/tmp/stereoservo-")


@pytest.mark.parametrize("name", ["", "..", "a/b", "-x", "a" * 65, "ä", "a b"])
def test_names_that_cannot_be_directories_are_refused(name: str) -> None:
    with pytest.raises(DirectoryError, match="letters, digits"):
        cell_directories(name)


def test_a_directory_that_others_may_write_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run").chmod(0o777)
    with pytest.raises(DirectoryError, match=r"others may write .*chmod 700"):
        create_directories(cell_directories("demo"))


def test_a_link_in_place_of_the_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DirectoryError, match="is not a directory of user"):
        create_directories(cell_directories("demo"))


def test_a_path_too_long_for_a_socket_names_the_variable_to_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path / ("d" * 90)))
    with pytest.raises(DirectoryError, match=r"at most 107; set STEREOSERVO_RUNTIME_DIR"):
        create_directories(cell_directories("demo"))
