"""Paths of a cell: its runtime directory (sockets, slots, locks; removed with the daemon) and its state directory
(models, taught goals).
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import NamedTuple

RUNTIME_VARIABLE = "STEREOSERVO_RUNTIME_DIR"
STATE_VARIABLE = "STEREOSERVO_STATE_DIR"
SOCKET_PATH_MAX = 107  # sockaddr_un.sun_path without its terminating zero
CELL_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class DirectoryError(Exception):
    """A directory or path cannot be used; the message contains its path, the cause and the setting to change."""


class CellDirectories(NamedTuple):
    """Runtime and state directory of one cell."""

    cell: str
    runtime: Path
    state: Path

    @property
    def models(self) -> Path:
        """Model files, ``model-<epoch>.json``."""
        return self.state / "models"

    @property
    def recordings(self) -> Path:
        """Flight recordings."""
        return self.state / "recordings"

    @property
    def taught(self) -> Path:
        """Taught goals."""
        return self.state / "taught.json"

    @property
    def checks(self) -> Path:
        """Reports of model checks, one JSON object a line."""
        return self.state / "checks.jsonl"

    @property
    def journal(self) -> Path:
        """Journal of goals and faults, one JSON object a line."""
        return self.state / "journal.jsonl"

    @property
    def run_record(self) -> Path:
        """How the last run of the daemon ended."""
        return self.state / "run.json"

    @property
    def open_goals(self) -> Path:
        """The goals that have not ended."""
        return self.state / "open-goals.json"

    @property
    def daemon(self) -> Path:
        """Description of the running daemon (pid, endpoint)."""
        return self.runtime / "daemon.json"

    @property
    def daemon_lock(self) -> Path:
        """Lock file that the supervisor holds."""
        return self.runtime / "daemon.lock"

    @property
    def state_lock(self) -> Path:
        """Lock file that the supervisor holds, too: only one daemon writes models, taught goals and records."""
        return self.state / "daemon.lock"

    @property
    def servo_lock(self) -> Path:
        """Lock file that the servo process holds."""
        return self.runtime / "servo.lock"

    @property
    def descriptions(self) -> Path:
        """Descriptions of the cell's drivers and detectors."""
        return self.runtime / "descriptions.msgpack"

    @property
    def stop_slot(self) -> Path:
        """The stop slot."""
        return self.runtime / "stop"

    @property
    def state_slot(self) -> Path:
        """Newest state of the servo process."""
        return self.runtime / "state.slot"

    @property
    def control_socket(self) -> Path:
        """Requests to, events from the servo process."""
        return self.runtime / "control.sock"

    @property
    def steps_ring(self) -> Path:
        """Step records from the servo process."""
        return self.runtime / "steps.ring"

    @property
    def reports_socket(self) -> Path:
        """Reports of vision processes and supervisor to the gateway."""
        return self.runtime / "reports.sock"

    @property
    def zenoh_socket(self) -> Path:
        """The socket on which the gateway's router listens by default."""
        return self.runtime / "zenoh.sock"

    @property
    def plant_state_slot(self) -> Path:
        """Newest state of the simulated drives."""
        return self.runtime / "plant-state.slot"

    @property
    def plant_orders_slot(self) -> Path:
        """Newest commands to the simulated drives."""
        return self.runtime / "plant-orders.slot"

    def heartbeat_slot(self, process: str) -> Path:
        """Heartbeat of ``process``: ``servo``, ``plant``, ``gateway``, or ``vision-`` and a camera's name."""
        return self.runtime / f"heartbeat-{process}.slot"

    def observation_slot(self, camera: str) -> Path:
        """Newest observation of ``camera``."""
        return self.runtime / f"observation-{camera}.slot"

    def prior_slot(self, camera: str) -> Path:
        """Newest prior for ``camera``."""
        return self.runtime / f"prior-{camera}.slot"

    def preview_slot(self, camera: str) -> Path:
        """Newest preview picture of ``camera``."""
        return self.runtime / f"preview-{camera}.slot"

    def preview_request_slot(self, camera: str) -> Path:
        """Time until which preview pictures of ``camera`` are requested."""
        return self.runtime / f"preview-wanted-{camera}.slot"


def runtime_root() -> Path:
    """``$STEREOSERVO_RUNTIME_DIR``, else ``$XDG_RUNTIME_DIR/stereoservo``, else
    ``/tmp/stereoservo-<uid>``.
    """
    if given := os.environ.get(RUNTIME_VARIABLE):
        return Path(given).absolute()
    if given := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(given).absolute() / "stereoservo"
    return Path(f"/tmp/stereoservo-{os.getuid()}")


def state_root() -> Path:
    """``$STEREOSERVO_STATE_DIR``, else ``~/.local/state/stereoservo``."""
    if given := os.environ.get(STATE_VARIABLE):
        return Path(given).absolute()
    given = os.environ.get("XDG_STATE_HOME", "")
    # The specification of these directories requires that a relative path is ignored.
    base = Path(given) if given.startswith("/") else Path.home() / ".local" / "state"
    return base / "stereoservo"


def cell_directories(cell: str) -> CellDirectories:
    """The directories of ``cell``; creates nothing. Raises DirectoryError for an invalid name."""
    if not CELL_NAME.fullmatch(cell):
        raise DirectoryError(f"cell name {cell!r}: letters, digits, '_' and '-' are valid, up to 64")
    return CellDirectories(cell, runtime_root() / cell, state_root() / cell)


def directories_of(cell: str) -> CellDirectories:
    """The directories of a cell by its name, or by the path of its file (``*.toml``), of which only the name is read.

    Raises DirectoryError.
    """
    if not cell.endswith(".toml"):
        return cell_directories(cell)
    from stereoservo.messages.text_files import (
        toml_of,  # imported here, so that a stop by the cell's name need not wait for it
    )

    try:
        name = toml_of(Path(cell).read_bytes())[0]["cell"]["name"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DirectoryError(f"{cell}: the cell's name cannot be read: {error}") from error
    return cell_directories(str(name))


def create_directories(directories: CellDirectories) -> None:
    """Create both directories, readable by their owner only. Raises DirectoryError."""
    _private(directories.runtime.parent, RUNTIME_VARIABLE)
    _private(directories.runtime, RUNTIME_VARIABLE)
    for path in (directories.state, directories.models, directories.recordings):
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise DirectoryError(f"{path}: {error.strerror}; set {STATE_VARIABLE} to a directory you own") from error
    for path in (
        directories.control_socket,
        directories.reports_socket,
        directories.zenoh_socket,
    ):
        check_socket_path(path)


def _private(path: Path, variable: str) -> None:
    advice = f"set {variable} to a directory that only you can write"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise DirectoryError(f"{path}: {error.strerror}; {advice}") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise DirectoryError(f"{path}: is not a directory of user {os.getuid()}; {advice}")
    if found.st_mode & 0o022:
        raise DirectoryError(
            f"{path}: others may write to it (mode {stat.S_IMODE(found.st_mode):o}); chmod 700 it, or {advice}"
        )


def check_socket_path(path: Path) -> None:
    """Raise DirectoryError if the kernel could not bind ``path``."""
    length = len(os.fsencode(path))
    if length > SOCKET_PATH_MAX:
        raise DirectoryError(
            f"{path}: {length} bytes, and the path of a unix socket has at most {SOCKET_PATH_MAX}; "
            f"set {RUNTIME_VARIABLE} to a shorter directory, or shorten the cell's name"
        )
