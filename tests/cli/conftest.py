"""Every command line has directories of its own."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def roots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("STEREOSERVO_STATE_DIR", str(tmp_path / "state"))
