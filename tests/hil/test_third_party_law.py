"""A law of a third party over zenoh: listed by the daemon, accepted, reached; a name that it has not is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from stereoservo.client.client import Client
from stereoservo.client.errors import RefusedError
from stereoservo.messages.discovery import DaemonProcess
from third_party.wheel import LAW, install_law

from .conftest import CELL, eventually, moved_away

pytestmark = pytest.mark.process


def compiling(client: Client) -> bool:
    return any(reason.code == "COMPILING" for reason in client.status().reasons)


def test_a_goal_is_reached_by_an_installed_law(
    calibrated: Path, start: Callable[..., DaemonProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(install_law(tmp_path)))
    start(calibrated)
    with Client(CELL) as client:
        assert LAW in client.info().laws
        law, _ = json.loads(client.schema("goal"))["$defs"]["Goal"]["properties"]["law"]["anyOf"]
        assert LAW in law["enum"]
        eventually("its kernels are compiled", lambda: not compiling(client), 240.0)
        client.enable()
        moved_away(client)
        result = client.goal("park", law=LAW, tolerance_px=0.5, hold_frames=3).reached(60.0)
        assert result.error_px is not None
        assert result.error_px <= 0.5
        with pytest.raises(RefusedError, match=f"no law 'magic'; valid: .*{LAW}"):
            client.goal("park", law="magic")
