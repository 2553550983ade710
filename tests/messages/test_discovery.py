"""Finding daemons among files that nobody vouches for."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereoservo.messages.directories import RUNTIME_VARIABLE, cell_directories
from stereoservo.messages.discovery import DaemonInfo, NotRunningError, daemon_info, find_daemon, live_cells
from stereoservo.messages.locks import FileLock
from stereoservo.messages.wire import encode

INFO = DaemonInfo("demo", "unixsock-stream//tmp/z", "boot", 1, "demo.toml")


@pytest.mark.parametrize(
    "data", [b"", b"{", b"\xff", b'{"cell": "\xff"}', b"[" * 60_000, b'{"pid": "one"}', b" " * 100_000, b"null"]
)  # fmt: skip
def test_a_strange_announcement_is_no_daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes) -> None:
    monkeypatch.setenv(RUNTIME_VARIABLE, str(tmp_path))
    for name in ("demo", "other"):
        (tmp_path / name).mkdir()
    (tmp_path / "no cell's name").mkdir()
    (tmp_path / "no cell's name" / "daemon.lock").touch()
    demo, other = cell_directories("demo"), cell_directories("other")
    demo.daemon.write_bytes(encode(INFO))
    other.daemon.write_bytes(data)
    with FileLock(demo.daemon_lock, "demo"), FileLock(other.daemon_lock, "other"):
        assert daemon_info(other) is None
        assert live_cells() == [INFO]
        assert find_daemon("demo") == INFO
        with pytest.raises(NotRunningError, match="running: demo"):
            find_daemon("other")
        other.daemon.unlink()
        other.daemon.mkdir()
        assert daemon_info(other) is None
