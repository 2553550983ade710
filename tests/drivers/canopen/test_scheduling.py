"""The bus thread runs just above the servo loop, where that is allowed to run in real time."""

import os
import threading

import pytest

from stereoservo_drivers.canopen.bus_thread import follow_scheduling

PRIORITY = 3


def in_a_thread() -> tuple[int, int]:
    """Policy and priority of a new thread after it followed."""
    seen: list[tuple[int, int]] = []

    def run() -> None:
        follow_scheduling()
        seen.append((os.sched_getscheduler(0), os.sched_getparam(0).sched_priority))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return seen[0]


@pytest.mark.parametrize("flag", [0, os.SCHED_RESET_ON_FORK])
def test_it_follows_a_loop_in_real_time(flag):
    before, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | flag, os.sched_param(PRIORITY))
    except PermissionError:
        pytest.skip("SCHED_FIFO is not allowed here")
    try:
        policy, above = in_a_thread()
    finally:
        os.sched_setscheduler(0, before, priority)
    assert policy & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    assert above == PRIORITY + 1


def test_it_leaves_ordinary_scheduling_alone():
    # The flag of an earlier loop may still stand beside this thread's policy; new threads do not inherit it.
    policy, priority = in_a_thread()
    assert policy == os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    assert priority == os.sched_getparam(0).sched_priority
