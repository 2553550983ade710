"""The suite's rules for shared machines: a failed test runs again only where the machine itself stood meanwhile, and
files with tests of real processes run one after another.
"""

import os
import shutil
import time
from pathlib import Path

import pytest

import machine_stalls

pytest_plugins = ["pytester"]

FAILS_ONCE = """
import os
import time

runs = 0

def test_it():
    global runs
    runs += 1
    if {stalls}:
        with open(os.environ["STEREOSERVO_TESTS_STALLS"], "a") as file:
            file.write(f"{{time.monotonic_ns()}} 600000000\\n")
    assert runs > 1
"""


@pytest.mark.parametrize(("stalls", "passed"), [(True, 1), (False, 0)])
def test_a_failed_test_runs_again_where_the_machine_stalled(
    stalls: bool, passed: int, pytester: pytest.Pytester
) -> None:
    settings_of_the_suite(pytester)
    pytester.makepyfile(FAILS_ONCE.format(stalls=stalls))
    result = pytester.runpytest_subprocess("-p", "no:xdist")
    result.assert_outcomes(passed=passed, failed=1 - passed)
    assert ("1 rerun" in result.stdout.str()) == stalls
    assert f"the machine stood still {2 * stalls} times" in result.stdout.str()


IN_REAL_TIME = """
class TestDriver:
    real_time = True
    runs = 0

    def test_it(self):
        TestDriver.runs += 1
        assert TestDriver.runs > 1
"""


def test_a_failed_test_of_a_driver_in_real_time_runs_again(pytester: pytest.Pytester) -> None:
    settings_of_the_suite(pytester)
    pytester.makepyfile(IN_REAL_TIME)
    pytester.runpytest_subprocess("-p", "no:xdist").assert_outcomes(passed=1)


REAL_TIME_LEFT = """
import os

def test_leaves_it():
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))

def test_next():
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
"""


def test_a_test_that_leaves_a_real_time_priority_behind_fails_and_the_next_has_none(
    pytester: pytest.Pytester,
) -> None:
    if os.geteuid() != 0:
        pytest.skip("SCHED_FIFO is not allowed here")
    settings_of_the_suite(pytester)
    pytester.makepyfile(REAL_TIME_LEFT)
    result = pytester.runpytest_subprocess("-p", "no:xdist")
    result.assert_outcomes(passed=2, errors=1)
    assert "left scheduling policy 1 behind" in result.stdout.str()


LIVE = """
import os, time, pytest

@pytest.mark.process
@pytest.mark.parametrize("k", range(4))
def test_it(k):
    time.sleep(0.2)
    with open("workers", "a") as file:
        file.write(os.environ["PYTEST_XDIST_WORKER"] + "\\n")
"""


def test_tests_of_processes_run_on_one_worker_and_the_others_of_their_files_do_not_wait(
    pytester: pytest.Pytester,
) -> None:
    settings_of_the_suite(pytester)
    beside = LIVE.replace("@pytest.mark.process\n", "").replace("test_it", "test_beside").replace("workers", "beside")
    whole = beside.replace("test_beside", "test_marked").replace('"beside"', '"workers"')
    pytester.makepyfile(
        test_one=LIVE + beside, test_two=LIVE + beside, test_three=f"{whole}\npytestmark = [pytest.mark.process]\n"
    )
    pytester.runpytest_subprocess("-n", "2").assert_outcomes(passed=20)
    live, others = (set((pytester.path / name).read_text().split()) for name in ("workers", "beside"))
    assert len(live) == 1
    assert others - live


def settings_of_the_suite(pytester: pytest.Pytester) -> None:
    """Let a suite in pytester's folder run as this one does."""
    for name in ("conftest.py", "machine_stalls.py"):
        shutil.copy(Path(__file__).with_name(name), pytester.path)
    pytester.makeini("[pytest]\npythonpath = .\nmarkers = process")


def test_the_longest_stall_that_ended_later(tmp_path: Path) -> None:
    path = tmp_path / "stalls"
    assert machine_stalls.longest_stall(path, 0) == 0.0
    path.write_text("1000 300000000\n2000 200000000\n3000 70000000\n")
    assert machine_stalls.longest_stall(path, 1000) == 0.2
    assert machine_stalls.longest_stall(path, time.monotonic_ns()) == 0.0
