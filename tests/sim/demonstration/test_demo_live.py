"""The demonstration of the plain cell as real processes: in a file of its own, beside which its lockstep runs."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from .test_demo import TIMEOUT_S, check, run_demo


@pytest.mark.process
@pytest.mark.timeout(TIMEOUT_S)
def test_demo_as_real_processes(tmp_path: Path) -> None:
    result = run_demo(tmp_path)
    check(result)
    assert result["lockstep"] is False
    assert result["loop"]["rate_hz"] == 250.0
    assert "skipped" in result["loop"]
    left = subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True, text=True, check=False)
    assert left.stdout == ""
