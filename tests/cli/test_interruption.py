"""An interrupt whose exception was lost still ends a wait, and a server, which ends whatever hangs."""

from __future__ import annotations

import faulthandler
import os
import signal
import subprocess
import sys

import pytest

from stereoservo.cli import interruption

SWALLOWS = """
import os, signal
from stereoservo.cli import interruption

class Swallower:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)  # what is raised in a destructor is printed and lost
        for _ in range(1000):
            pass

interruption.check()
interruption.install()
swallower = Swallower()
del swallower
print("lost")
try:
    interruption.check()
except KeyboardInterrupt:
    print("remembered")
"""


def test_a_reader_that_goes_away_ends_a_command_by_an_exit_code_and_no_signal() -> None:
    """A library's socket that its peer closed must not kill a command, which SIGPIPE by default would."""
    ours, theirs = os.pipe()
    os.close(ours)
    with os.fdopen(theirs, "w") as closed:
        done = subprocess.run(
            [sys.executable, "-m", "stereoservo.cli.main", "drivers"], check=False, stdout=closed,
            stderr=subprocess.PIPE, text=True, timeout=240,
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (1, "")


def test_an_interrupt_that_a_destructor_swallowed_is_remembered() -> None:
    done = subprocess.run([sys.executable, "-c", SWALLOWS], capture_output=True, text=True, timeout=240, check=False)
    assert done.stdout.split() == ["lost", "remembered"], done.stderr
    assert "KeyboardInterrupt" in done.stderr


SERVES = """
import os, signal, sys, threading
from stereoservo.cli import web
from stereoservo.web import cell_link

class Swallower:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass

class Link:
    cell, recording = "none", False

    def __init__(self, *arguments, **named):
        self.watched = threading.Event()

    def start(self):
        START

    def close(self):
        CLOSE

forever = threading.Event()
cell_link.CellLink = Link
web.END_S = LIMIT
web.web("none", None, 0, "127.0.0.1", None, None, None, None, True)
print("ended")
"""
"""`stereoservo web` with a link in place of the cell's."""
SERVED = {
    "lost in a destructor": ("Swallower()", "pass", 0, "ending: pages are closed"),
    "a worker that waits": (
        "threading.Thread(target=forever.wait, name='page-command').start(); Swallower()", "pass", 0,
        "ended without waiting for what does not answer: page-command",
    ),
    "a link that hangs": ("Swallower()", "forever.wait()", 1, "in close"),
    "asked twice": ("Swallower()", "Swallower()", 130, "asked twice"),
}  # fmt: skip


@pytest.mark.parametrize("name", SERVED)
def test_the_page_ends_by_an_interrupt_whatever_hangs(name: str) -> None:
    pytest.importorskip("websockets", reason="the page's server needs websockets (extra web)")
    start, close, code, told = SERVED[name]
    limit = "2.0" if told == "in close" else "100.0"
    script = SERVES.replace("START", start).replace("CLOSE", close).replace("LIMIT", limit)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == code, done.stderr
    assert told in done.stderr
    assert '"url"' in done.stdout


def test_within_an_ending_an_interrupt_raises_nothing_and_afterwards_it_does_again() -> None:
    before = signal.getsignal(signal.SIGINT)
    with interruption.graceful_shutdown(60.0) as shutdown:
        woken: list[bool] = []
        shutdown.wake = lambda: woken.append(shutdown.asked)
        os.kill(os.getpid(), signal.SIGTERM)
        assert woken == [True]
        faulthandler.cancel_dump_traceback_later()
    assert signal.getsignal(signal.SIGINT) is before
