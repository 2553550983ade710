"""The suite's rule for machines that stall: a failed test runs again only where the machine itself stood meanwhile."""

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
    for name in ("conftest.py", "machine_stalls.py"):
        shutil.copy(Path(__file__).with_name(name), pytester.path)
    pytester.makeini("[pytest]\npythonpath = .")
    pytester.makepyfile(FAILS_ONCE.format(stalls=stalls))
    result = pytester.runpytest_subprocess("-p", "no:xdist")
    result.assert_outcomes(passed=passed, failed=1 - passed)
    assert ("1 rerun" in result.stdout.str()) == stalls


def test_the_longest_stall_that_ended_later(tmp_path: Path) -> None:
    path = tmp_path / "stalls"
    assert machine_stalls.longest_stall(path, 0) == 0.0
    path.write_text("1000 300000000\n2000 200000000\n3000 70000000\n")
    assert machine_stalls.longest_stall(path, 1000) == 0.2
    assert machine_stalls.longest_stall(path, time.monotonic_ns()) == 0.0
