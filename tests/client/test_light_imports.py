"""What a goal client and the operator's verbs import: zenoh and msgspec, none of the numerical libraries."""

import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import stereoservo.messages

HEAVY = {"numpy", "numba", "scipy", "cv2", "matplotlib", "pybullet"}
PRINT_MODULES = "; import sys; print('\\n'.join(sys.modules))"


def modules_after(program: str) -> set[str]:
    """Names of the modules that a fresh interpreter holds after ``program``."""
    done = subprocess.run(
        [sys.executable, "-c", program + PRINT_MODULES],
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
    )
    return set(done.stdout.split())


def packages(modules: set[str]) -> set[str]:
    """The packages of stereoservo among ``modules``."""
    return {name.split(".")[1] for name in modules if name.startswith("stereoservo.")}


def test_the_client_needs_zenoh_and_msgspec_only() -> None:
    modules = modules_after("from stereoservo.client import Client")
    assert {"zenoh", "msgspec"} <= modules
    assert not HEAVY & modules
    assert packages(modules) == {"client", "messages"}


def test_messages_need_msgspec_only() -> None:
    names = [f"stereoservo.messages.{found.name}" for found in pkgutil.iter_modules(stereoservo.messages.__path__)]
    assert "stereoservo.messages.wire" in names
    modules = modules_after(f"import {', '.join(names)}")
    assert not (HEAVY | {"zenoh"}) & modules
    assert packages(modules) == {"messages"}


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--help"], 0),
        (["stop", "nowhere"], 1),
        (["status", "nowhere"], 1),
        (["goal", "nowhere", "--joint", "j1=0"], 1),
        (["enable", "nowhere"], 1),
        (["calibrate", "nowhere"], 1),
        (["warmup", "--help"], 0),
        (["bench", "--help"], 0),
        (["reproduce", "--help"], 0),
        (["demo", "--help"], 0),
        (["simulate", "--help"], 0),
        (["run", "--help"], 0),
    ],
)
def test_the_verbs_of_a_client_import_no_numerical_library(
    arguments: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path))
    modules = modules_after(f"from stereoservo.cli import main; assert main.invoke({arguments}) == {code}")
    assert "typer" in modules
    assert not HEAVY & modules
