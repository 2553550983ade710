"""An installation without extras: client and remote verbs run, the others name the extra that they need."""

import importlib.abc
import json
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

from stereoservo.cli import dispatch
from stereoservo.ports import plugins
from stereoservo_sim.world.physics import PhysicsError, import_pybullet

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WITHOUT = """
import importlib.abc, json, sys

class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
import contextlib, io
from stereoservo.cli import main
answers = []
for line in json.loads(sys.stdin.read()):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main.invoke(line)
    answers.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(answers))
"""


def answers(lines: list[list[str]], tmp_path: Path, *extras: str) -> list[tuple[int, str, str]]:
    """Exit code, stdout and stderr of command lines where the modules of ``extras`` are not installed."""
    modules = {module for extra in extras for module in plugins.EXTRAS[extra]}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT.format(modules=modules)],
        input=json.dumps(lines), capture_output=True, text=True, check=True, timeout=240, cwd=tmp_path,
    )  # fmt: skip
    return [tuple(answer) for answer in json.loads(done.stdout)]


def named(requirement: str) -> str:
    """The name of a distribution in a requirement."""
    found = re.match(r"[\w.-]+", requirement)
    assert found is not None
    return found[0].lower().replace("_", "-")


def test_every_module_of_an_extra_is_known_and_no_other() -> None:
    modules: dict[str, set[str]] = {}
    for module, distributions in packages_distributions().items():
        for distribution in distributions:
            modules.setdefault(distribution.lower().replace("_", "-"), set()).add(module)
    for extra, known in plugins.EXTRAS.items():
        required = {named(r) for r in PROJECT["optional-dependencies"][extra]} - {"stereoservo"}
        installed = {name for name in required if name in modules}
        for name in installed:
            assert modules[name] & set(known), f"{extra}: {name} brings {modules[name]}"
        if installed == required:
            assert {module for name in required for module in modules[name]} >= set(known)


def test_the_base_is_the_client_and_its_command_line() -> None:
    assert {named(r) for r in PROJECT["dependencies"]} == {"eclipse-zenoh", "msgspec", "typer", "rich"}


def test_verbs_of_a_client_run_without_extras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path))
    lines = [["--help"], ["ls"], ["stop", "nowhere"], ["goal", "nowhere", "dock"], ["watch", "nowhere"]]
    listed, cells, *others = answers(lines, tmp_path, *plugins.EXTRAS)
    assert listed[0] == 0
    assert all(f"\n  {name} " in listed[1] for name in (*dispatch.OWN, "demo", "reproduce"))
    assert cells == (0, "no live cell\n", "")
    for code, _, err in others:
        assert code == 1
        assert err.startswith("error: no daemon runs for cell 'nowhere'")


@pytest.mark.parametrize("extra", ["cell"])
def test_verbs_that_need_an_extra_name_it(extra: str, tmp_path: Path) -> None:
    verbs = [
        "run x.toml",
        "doctor x.toml",
        "init x.toml",
        "replay x.mcap",
        "drivers",
        "warmup",
        "export x.mcap",
        "demo",
        "simulate x",
    ]
    verbs += ["bench cycle", "reproduce robot", "emulate drives x.toml", "print-plate x.pdf"]
    for verb, (code, out, err) in zip(
        verbs, answers([[*verb.split(), "--json"] for verb in verbs], tmp_path, extra), strict=True
    ):
        body: dict[str, Any] = json.loads(out)["error"]
        assert (code, body["code"]) == (1, "missing_extra"), verb
        assert f"pip install 'stereoservo[{extra}]'" in body["message"], verb
        assert "Traceback" not in err


class WithoutPybullet(importlib.abc.MetaPathFinder):
    """Finds that pybullet is not installed."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name == "pybullet":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def test_a_simulated_cell_without_pybullet_says_where_it_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "pybullet", raising=False)
    monkeypatch.setattr(sys, "meta_path", [WithoutPybullet(), *sys.meta_path])
    with pytest.raises(PhysicsError, match=r"pip install 'stereoservo\[sim\]' on Python 3.11, Linux x86_64"):
        import_pybullet()
