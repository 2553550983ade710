"""What a step of the core does grows no faster than the markers: counted in lines and bytes, never in time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from stereoservo.control.marker_groups import with_groups
from stereoservo.kinematics.model import save_model
from stereoservo_sim.benchmarks.core_loop import rx90_with_facets
from stereoservo_sim.world.exact_model import exact_model

from .step_counts import counts

SIZES = (4, 16, 64, 256)
GROWTH = 1.5
"""By how much the work of a marker may grow from one size to the next, four times as large: m log m, and no m²."""
ONCE = {"lines": 120_000, "bytes": 1_000_000}
"""What a step may do whatever the body: every three of the 24 markers that are tried, in two cameras."""


def of_lines(model: Path, markers: int) -> dict[str, int]:
    """Lines of each kind of step, in a process in which kernels are Python."""
    script = Path(__file__).with_name("step_counts.py")
    done = subprocess.run(
        [sys.executable, str(script), str(model), str(markers)],
        capture_output=True, text=True, check=False, env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found: dict[str, int] = json.loads(done.stdout)
    return found


def of_bytes(model: Path, markers: int) -> dict[str, int]:
    """Bytes of each kind of step that are no kernel's own."""
    return counts(model, markers, "bytes")


@pytest.mark.timeout(900)
@pytest.mark.parametrize("count", [of_bytes, of_lines])
def test_no_step_grows_faster_than_its_markers(
    count: Callable[[Path, int], dict[str, int]], tmp_path: Path
) -> None:
    found = {}
    for markers in (SIZES[0], *SIZES):  # the first one loads what is loaded once
        path = tmp_path / f"{markers}.json"
        save_model(with_groups(exact_model(rx90_with_facets(markers, 2))), path)
        found[markers] = count(path, markers)
    print(json.dumps(found))
    once = ONCE[count.__name__.removeprefix("of_")]
    for kind in found[SIZES[0]]:
        for few, many in pairwise(SIZES):
            before, after = found[few][kind], found[many][kind]
            assert after <= max(GROWTH * (many / few) * before, once + before), (
                kind,
                few,
                many,
                before,
                after,
            )
