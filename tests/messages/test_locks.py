"""Locks: one holder, a clear word for the second, nothing left over by the dead."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from stereoservo.messages.locks import AlreadyRunningError, ChannelLock, FileLock, hardware_lock_path, holder


def test_the_second_holder_is_told_who_holds_and_how_to_end_it(tmp_path: Path) -> None:
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
        hardware_lock_path(tmp_path, "video", {"device": "/dev/video0"})
        == tmp_path / "channel-video-dev-video0.lock"
    )
    assert hardware_lock_path(tmp_path, "fake", {}) is None


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
    with subprocess.Popen(
        [sys.executable, "-c", HOLD_CHANNEL, str(theirs)], stdout=subprocess.PIPE
    ) as process:
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


def test_channels_with_long_names_are_told_apart(tmp_path: Path) -> None:
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
