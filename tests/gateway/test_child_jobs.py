"""What a child process prints, its objects among other things."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from stereoservo.gateway.child_jobs import ChildJob, FitFailedError

PROGRAM = r"""
import sys
sys.stdout.buffer.write(b'a library says hello\n' + b'[' * 60000 + b'\n\xff\n5\n{"progress": "half"}\n')
sys.stdout.buffer.write(b'{"progress": 0.5, "message": "fit"}\n{"model": "m.json"}\n')
"""


def test_lines_that_are_no_objects_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "printing_job.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    job = ChildJob("printing_job")
    until = time.monotonic() + 60.0
    while not job.ended and time.monotonic() < until:
        time.sleep(0.01)
    assert [(step.progress, step.message) for step in job.poll()] == [(0.5, "fit")]
    assert job.require("model") == "m.json"
    with pytest.raises(FitFailedError, match="exit code 0"):
        job.require("check")
    job.close()
    assert "output of printing_job: 1 records left out" in capsys.readouterr().err
