"""Locks: one holder, a clear word for the second, nothing left over by the dead."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from stereoservo.messages.locks import AlreadyRunningError, ChannelLock, FileLock, hardware_lock_path, holder


def test_the_second_holder_is_reported_who_holds_and_how_to_end_it(tmp_path: Path) -> None:
    path = tmp_path / "a.lock"
    with FileLock(path, "cell 'demo'"):
        assert holder(path) == os.getpid()
        with pytest.raises(
            AlreadyRunningError, match=rf"cell 'demo' .* process {os.getpid()} .*`kill {os.getpid()}`"
        ) as caught:
            FileLock(path, "cell 'demo'")
        assert caught.value.pid == os.getpid()
    assert holder(path) is None
    FileLock(path, "cell 'demo'").release()


def test_a_killed_holder_leaves_no_lock(tmp_path: Path) -> None:
    path = tmp_path / "a.lock"
    code = f"""
import time, pathlib
from stereoservo.messages.locks import FileLock
lock = FileLock(pathlib.Path({str(path)!r}), "it")
print("held", flush=True)
time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    assert holder(path) == process.pid
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert holder(path) is None
    FileLock(path, "it").release()


def test_no_file_is_no_holder(tmp_path: Path) -> None:
    assert holder(tmp_path / "none.lock") is None


def test_a_hardware_channel_has_one_lock_whatever_the_cell_is_called(tmp_path: Path) -> None:
    path = hardware_lock_path(tmp_path, "canopen", {"channel": "can0", "bitrate": 1_000_000})
    assert path == tmp_path / "channel-canopen-can0.lock"
    assert (
        hardware_lock_path(tmp_path, "video", {"device": "/dev/video0"}) == tmp_path / "channel-video-dev-video0.lock"
    )
    assert hardware_lock_path(tmp_path, "fake", {}) is None
    assert hardware_lock_path(tmp_path, "video", {"source": "set", "episode": 0}) is None
    assert hardware_lock_path(tmp_path, "video", {"source": "set"}) is not None
    assert hardware_lock_path(tmp_path, "acme", {"channel": "can0", "episode": 0}) is not None


HOLD_CHANNEL = """
import time, pathlib, sys
from stereoservo.messages.locks import ChannelLock
lock = ChannelLock(pathlib.Path(sys.argv[1]), "it")
print("held", flush=True)
time.sleep(60)
"""


def test_a_channel_is_locked_whatever_the_runtime_directories_are(tmp_path: Path) -> None:
    name = f"channel-canopen-can0-{os.getpid()}.lock"
    mine, theirs = tmp_path / "mine" / name, tmp_path / "theirs" / name
    for path in (mine, theirs):
        path.parent.mkdir()
    with subprocess.Popen([sys.executable, "-c", HOLD_CHANNEL, str(theirs)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        with pytest.raises(AlreadyRunningError, match=rf"it is .* process {process.pid} ") as caught:
            ChannelLock(mine, "it")
        assert caught.value.pid == process.pid
        assert holder(mine) is None  # nothing is half locked
        process.kill()
    ChannelLock(mine, "it").release()
    with ChannelLock(mine, "it"), pytest.raises(AlreadyRunningError):
        ChannelLock(mine, "it")


def test_channels_with_long_names_are_distinguished(tmp_path: Path) -> None:
    long = "channel-video-" + "x" * 150
    with ChannelLock(tmp_path / f"{long}1.lock", "one"):
        ChannelLock(tmp_path / f"{long}2.lock", "other").release()


def test_a_device_has_one_lock_by_all_its_names(tmp_path: Path) -> None:
    assert hardware_lock_path(tmp_path, "video", {"device": 0}) == hardware_lock_path(
        tmp_path, "video", {"device": "/dev/video0"}
    )
    assert hardware_lock_path(tmp_path, "canopen", {"channel": "/dev/../dev/null"}) == hardware_lock_path(
        tmp_path, "canopen", {"channel": "/dev/null"}
    )


def no_room(*args: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("call", ["pwrite", "ftruncate"])
def test_a_full_disk_does_not_refuse_a_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    path = tmp_path / "a.lock"
    with monkeypatch.context() as patch:
        patch.setattr(os, call, no_room)
        lock = FileLock(path, "it")
        assert holder(path) is not None
        with pytest.raises(AlreadyRunningError, match="it is already in use"):
            FileLock(path, "it")
        lock.release()
    assert holder(path) is None


def test_a_lock_file_on_a_read_only_disk_is_as_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.lock"
    path.write_text("1\n")  # of a holder before, which nobody may be told to kill
    opened = os.open

    def read_only(name: Path, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_RDWR:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        return opened(name, flags, mode)

    monkeypatch.setattr(os, "open", read_only)
    with FileLock(path, "it"):
        assert holder(path) == 0
        with pytest.raises(AlreadyRunningError, match="another process"):
            FileLock(path, "it")
    assert holder(path) is None
    with pytest.raises(FileNotFoundError):
        FileLock(tmp_path / "none.lock", "it")


def test_a_channels_lock_is_named_without_its_password(tmp_path: Path) -> None:
    """Nor do two streams of one server share a lock, or one stream have two by its passwords."""

    def lock(source: str) -> Path:
        path = hardware_lock_path(tmp_path, "video", {"source": source})
        assert path is not None
        assert "Tulpe" not in path.name
        return path

    for form in ("http://me:{}@cam/s?channel={}", "http://cam/s?user=me&pwd={}&channel={}"):
        assert lock(form.format("Tulpe", 1)) == lock(form.format("Tulpe7", 1)) != lock(form.format("Tulpe", 2))
    dvr = "rtsp://10.0.0.1:554/user=admin_password={}_channel={}_stream=0.sdp"
    assert lock(dvr.format("Tulpe", 1)) == lock(dvr.format("Tulpe7", 1)) != lock(dvr.format("Tulpe", 2))
    lock("http://me:Tulpe#77@cam/s")
    lock("http://me:12/Tulpe@cam/s")
