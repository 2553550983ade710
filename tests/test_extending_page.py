"""docs/extending.md: every recipe's blocks are executed as they stand on the page."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console

from core.conftest import make_bench
from stereoservo.cli import main as cli
from stereoservo.control.law import Law
from stereoservo.core import monitor, move
from stereoservo.core.state import Holding, Source
from stereoservo.ports import plugins
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import CameraDriver, Detector, DriverContext, JointDriver
from stereoservo_sim.experiments.catalogue import EXPERIMENTS, find_experiment

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL))
PLUGINS = {
    "A control law": Law,
    "A joint driver": JointDriver,
    "A driver of servos on a serial line": JointDriver,
    "A camera driver": CameraDriver,
    "A detector": Detector,
}

OPTIONS: dict[str, dict[str, Any]] = {"A driver of servos on a serial line": {"servo": [{"name": "shoulder", "id": 1}]}}


def blocks(heading: str) -> list[tuple[str, str]]:
    """Module name and source of each Python block below a heading; its first line names the file that it belongs in."""
    found = re.findall(r"^```python\n(# (\S+)\.py.*?\n.*?)^```", SECTIONS[heading], re.MULTILINE | re.DOTALL)
    return [(module_name(path), source) for source, path in found]


def module_name(path: str) -> str:
    """Dotted name of a file of the page, which is below its package where it is one of this project."""
    package = {"core": "stereoservo.", "calibration": "stereoservo.", "experiments": "stereoservo_sim."}.get(
        path.partition("/")[0], ""
    )
    return package + path.replace("/", ".")


def entry_point(heading: str) -> tuple[str, str, str]:
    """Group, name and object of a recipe's entry point."""
    pattern = r'^ *\[project\.entry-points\."(.*?)"\]\n *(\S+) = "(.*?)"$'
    (entry,) = re.findall(pattern, SECTIONS[heading], re.MULTILINE)
    return entry


def executed(name: str, source: str) -> ModuleType:
    """A module that holds a block."""
    module = ModuleType(name)
    sys.modules[name] = module  # msgspec looks annotations up there
    exec(compile(source, str(PAGE), "exec"), vars(module))
    return module


def contract_suite(heading: str) -> type:
    """The contract suite of a recipe, on the recipe's own modules."""
    *modules, suite = blocks(heading)
    try:
        for module in modules:
            executed(*module)
        (found,) = (value for name, value in vars(executed(*suite)).items() if name.startswith("Test"))
    finally:
        sys.modules.pop(suite[0], None)
    return found


TestLaw = contract_suite("A control law")
TestJointDriver = contract_suite("A joint driver")
TestServos = contract_suite("A driver of servos on a serial line")
TestCameraDriver = contract_suite("A camera driver")
TestDetector = contract_suite("A detector")


def entry(heading: str, monkeypatch: pytest.MonkeyPatch) -> tuple[ModuleType, Any]:
    """The module of a recipe and its entry of the project's table, which is left as it is."""
    (name, source), (_, line) = blocks(heading)
    monkeypatch.delitem(sys.modules, name, raising=False)
    module = executed(name, source)
    monkeypatch.setitem(sys.modules, name, module)
    names: dict[str, Any] = {}
    exec(compile(line, str(PAGE), "exec"), names)
    return module, names["ENTRY"]


def test_every_recipe_has_its_blocks():
    assert list(SECTIONS) == [
        "A control law", "A motion source", "A monitor", "A joint driver", "A simulated arm",
        "A driver of servos on a serial line", "A camera driver", "A detector", "A command", "A fit",
        "An experiment",
    ]  # fmt: skip
    assert [heading for heading in SECTIONS if not blocks(heading)] == ["A simulated arm"]
    assert sum(len(blocks(heading)) for heading in SECTIONS) == PAGE.read_text().count("```python")


def installed(heading: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first block of a recipe as a package that is installed in ``folder``."""
    group, name, target = entry_point(heading)
    module, source = blocks(heading)[0]
    info = folder / "acme-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {target}\n")
    (folder / f"{module}.py").write_text(source)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, module, raising=False)


@pytest.mark.parametrize("heading", PLUGINS)
def test_a_plugin_is_found_by_the_entry_point_of_its_recipe(heading, tmp_path, monkeypatch):
    group, name, target = entry_point(heading)
    module, _ = blocks(heading)[0]
    assert target.partition(":")[0] == module
    installed(heading, tmp_path, monkeypatch)
    found = plugins.load(group, name)
    monkeypatch.delitem(sys.modules, module)
    if PLUGINS[heading] is not Law:
        options = OPTIONS.get(heading, {})
        found = found(options, DriverContext(VirtualClock(), "c", tmp_path, tmp_path, camera="left"))
    assert isinstance(found, PLUGINS[heading])
    assert (
        plugins.list_plugins(group)[[p.name for p in plugins.list_plugins(group)].index(name)].distribution
        == "acme 1.0"
    )


def test_the_motion_source_swings_a_joint_waits_in_hold_and_ends(monkeypatch):
    module, row = entry("A motion source", monkeypatch)
    bench = make_bench(0).ready()
    source = module.Nodding(2, 0.2, bench.now_ns, bench.now_ns + 1_000_000_000)
    monkeypatch.setitem(move.MOTION_SOURCES, *row.popitem())
    bench.core.state.source = source
    start, commands = bench.q.copy(), []
    for _ in range(75):
        outputs = bench.step()
        assert outputs.status.source == "nod"
        commands.append(outputs.status.command)
    swing = np.array(commands)
    assert 0.15 < swing[:, 2].max() <= 0.2
    assert -0.2 <= swing[:, 2].min() < -0.15
    assert not np.delete(swing, 2, axis=1).any()
    bench.run(1.0)
    assert isinstance(bench.core.state.source, Holding)
    assert not bench.core.state.block.command.any()
    np.testing.assert_allclose(bench.q, start, atol=0.02)
    # Its tag is one of its own in the checkpoint.
    data = msgspec.msgpack.encode(source)
    assert isinstance(msgspec.msgpack.decode(data, type=Source | module.Nodding), module.Nodding)


class Decided:
    """A state of which only what decisions change may be read."""

    def __init__(self, state):
        self._state = state

    def __getattr__(self, name):
        assert name not in ("block", "cameras"), f"`attends` reads `{name}`, which changes without it being called"
        return getattr(self._state, name)


def assert_attends_without_measurements():
    for one in monitor.MONITORS:
        one.attends(Decided(make_bench(0).ready().core.state))


def test_no_monitor_is_called_by_measurements(monkeypatch):
    """They would be asked of it after decisions only."""
    assert_attends_without_measurements()
    fast = monitor.Monitor("fast", lambda context: (), lambda state: bool(state.block.velocities.any()))
    monkeypatch.setattr(monitor, "MONITORS", (*monitor.MONITORS, fast))
    with pytest.raises(AssertionError, match="reads `block`"):
        assert_attends_without_measurements()


@pytest.mark.parametrize("watched", [True, False])
def test_the_monitor_stops_an_arm_that_runs_away(monkeypatch, watched):
    _, row = entry("A monitor", monkeypatch)
    if watched:
        monkeypatch.setattr(monitor, "MONITORS", (*monitor.MONITORS, row))
        assert_attends_without_measurements()
    bench = make_bench(0).ready()
    bench.run(0.2)
    assert not bench.core.state.stopped
    for _ in range(10):  # 1.5 rad/s where 1 rad/s is the limit
        bench.q = bench.q + np.array([0.0, 0.0, 0.0, 0.0, 0.015, 0.0])
        bench.step()
    stops = [event.reasons[0] for event in bench.events if event.kind == "stopped"]
    found = [reason for reason in stops if reason.code == "OVERSPEED"]
    assert len(found) == int(watched)
    for reason in found:
        assert (reason.subject, reason.unit, reason.threshold) == ("j5", "rad/s", 1.2)
        assert reason.value > reason.threshold


def test_the_command_runs_by_its_entry_point(tmp_path, monkeypatch, capfd):
    class Asked:
        """A client of a cell of two cameras, one without frames."""

        def __init__(self, cell, *, endpoint):
            assert (cell, endpoint) == ("mycell", None)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def status(self):
            return SimpleNamespace(joints_age_s=0.004, camera_age_s={"left": 0.021, "right": None})

    installed("A command", tmp_path, monkeypatch)
    monkeypatch.setattr("stereoservo.client.Client", Asked)
    assert cli.invoke(["ages", "mycell"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line.split(maxsplit=1) for line in lines] == [["joints", "4 ms"], ["left", "21 ms"], ["right", "none yet"]]
    assert cli.invoke(["ages", "mycell", "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == {"joints": 0.004, "left": 0.021, "right": None}
    assert cli.invoke(["ages", "--help"]) == 0
    assert "Print the ages" in capfd.readouterr().out


def test_the_fit_finds_a_line_among_outliers():
    """Exact points give the line; with a fifth of outliers errors stay within four deviations (40 seeds: 0.5 % by
    chance), and three points at one place give none.
    """
    ((name, source),) = blocks("A fit")
    fit_line = executed(name, source).fit_line
    del sys.modules[name]
    truth = np.array([0.6, 120.0])
    along, normal = np.array([-np.sin(0.6), np.cos(0.6)]), np.array([np.cos(0.6), np.sin(0.6)])
    for seed in range(40):
        rng = np.random.default_rng(seed)
        points = 120.0 * normal + rng.uniform(-200.0, 200.0, (50, 1)) * along
        exact, _ = fit_line(points, 0.5)
        assert np.abs(upright(exact) - truth).max() < 1e-6
        seen = points + 0.5 * rng.normal(size=points.shape)
        seen[:10] += rng.uniform(-40.0, 40.0, (10, 2))
        found, covariance = fit_line(seen, 0.5)
        assert (np.abs(upright(found) - truth) < 4.0 * np.sqrt(covariance.diagonal())).all()
    with pytest.raises(ValueError, match="3 points"):
        fit_line(np.zeros((3, 2)), 0.5)


def upright(state):
    """A line's state with its angle in [0, π): both normals are the same line."""
    a, d = state
    turned = bool(np.floor(a / np.pi) % 2)
    return np.array([a % np.pi, -d if turned else d])


def test_the_experiment_runs_by_its_declaration_and_is_drawn(monkeypatch, tmp_path):
    module, row = entry("An experiment", monkeypatch)
    assert module.__name__ == f"stereoservo_sim.experiments.{row.module}"
    monkeypatch.setitem(EXPERIMENTS, row.name, row)
    chosen = find_experiment("stereo-depth")
    answer = chosen.report(chosen.run(1, {"seeds": 100}, lambda *stage: None))
    assert json.loads(json.dumps(answer)) == answer
    for row in answer["rows"]:  # median of |N(0, σ)| is 0.6745 σ, its sampling sigma over 100 seeds 0.079 σ
        assert abs(row["error_mm"]["median"] / row["sigma_mm"] - 0.6745) < 4 * 0.079
    assert chosen.run(1, {"seeds": 100}, lambda *stage: None) == answer
    (figure,) = chosen.draw(answer, tmp_path)
    assert figure.stat().st_size > 1000
    with open(tmp_path / "table.txt", "w", encoding="utf-8") as file:
        chosen.show(answer, Console(file=file, markup=False))
    assert "stereo-depth: 100 seeds" in (tmp_path / "table.txt").read_text(encoding="utf-8")
