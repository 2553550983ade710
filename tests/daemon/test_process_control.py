"""Signals that ask a process to end."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

PROGRAM = """
import signal, sys, time
from stereoservo.daemon.process_control import Termination
# Whatever this test was started under: an ignored signal is inherited.
signal.signal(signal.SIGHUP, signal.SIG_IGN if sys.argv[1:] == ["nohup"] else signal.SIG_DFL)
termination = Termination(grace_s=30.0)
print("ready", flush=True)
while not termination.asked:
    time.sleep(0.005)
print(f"ended in order by {signal.Signals(termination.first).name}")
"""


def ended_by(*numbers: int, arguments: tuple[str, ...] = ()) -> str:
    """What the program says after it was sent the signals."""
    command = [sys.executable, "-c", PROGRAM, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        for number in numbers:
            child.send_signal(number)
        try:
            output, _ = child.communicate(timeout=240)
        finally:
            child.kill()
    return output.strip()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_process_that_is_asked_to_end_ends_in_order(number: signal.Signals) -> None:
    assert ended_by(number) == f"ended in order by {number.name}"


def test_nohup_is_respected() -> None:
    assert ended_by(signal.SIGHUP, signal.SIGTERM, arguments=("nohup",)) == "ended in order by SIGTERM"


def test_a_log_that_cannot_be_written_ends_nothing() -> None:
    program = "from stereoservo.daemon.process_control import write_log\nwrite_log('servo', 'line')\nprint('alive')"
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=full, text=True, check=False
        )
    assert done.stdout.strip() == "alive"
