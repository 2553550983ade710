"""What compiles, and when: one signature for all literals, none in a warm start whatever the cell, none in a loop
without a model; and how the kernels of a first start get into a loop that runs.
"""

import fcntl
import os
import pickle
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.control.law_registry import LAWS
from stereoservo.core.servo_core import ServoCore
from stereoservo.daemon import kernel_compilation, supervisor
from stereoservo.daemon.kernel_compilation import (
    KernelLoader,
    compiled,
    example_model,
    example_settings,
    kernels_to_come,
)
from stereoservo.messages.goals import Goal, PointTarget, Request, RunGoal
from stereoservo.numerics.compilation import KERNELS, Overload, kernel, overloads

WITHOUT_A_MODEL = """
import msgspec, numpy as np
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import TrialSettings
from stereoservo.daemon import kernel_compilation as compilation
from stereoservo.messages.goals import *
from stereoservo.numerics.compilation import overloads

compilation.warm_up_first()
before = set(overloads())
zeros = np.zeros(6)
trials = TrialSettings(zeros, np.full(6, np.nan), 3, 2, 0.01, 1.0, 3, 0.01, 1.0)
keep_outs = np.full((1, 6, 2), [5.0, 6.0])
settings = compilation.example_settings()
limits = msgspec.structs.replace(settings.limits, keep_outs=keep_outs, keep_out_names=("box",))
core = ServoCore(msgspec.structs.replace(settings, home=zeros, trials=trials, limits=limits))
pixels = compilation._example_pixels(compilation.example_model())
joints = RunGoal(Goal("00000001", JointTarget({"j1": 0.001})))
pictures = RunGoal(Goal("00000002", FeatureTarget({"left": {0: (1.0, 1.0)}})))
commands = {2: joints, 30: Home("00000003"), 40: Jog({"j1": 0.1}), 50: Teach("a", 1), 52: pictures, 55: Hold(),
            57: Resume(), 60: Calibrate("00000004")}
sources = set()
for step in range(1, 120):
    asked = (Request(step, "tester", commands[step]),) if step in commands else ()
    inputs = compilation._inputs(step, pixels, compilation.example_model())
    outputs = core.step(msgspec.structs.replace(
        inputs, requests=asked, driver_active=True, compiling=True))
    sources.add(outputs.status.source)
assert {"joints", "jog", "calibrate"} <= sources, sources
assert core.state.pending_model is not None
assert set(overloads()) == before, set(overloads()) - before
"""


@kernel
def _shifted(x: float, by: int, up: bool) -> float:
    return x + by if up else x - by


@kernel
def _calls_with_literals(x: float, n: int) -> float:
    return _shifted(x, 1, True) + _shifted(x, 2, False) + _shifted(x, by=n, up=n > 0)


def test_literals_of_a_caller_make_no_signature_of_their_own() -> None:
    assert _calls_with_literals(1.0, 3) == (1.0 + 1) + (1.0 - 2) + (1.0 + 3)
    called = KERNELS[__name__, "_shifted"]
    assert len(called.signatures) <= 1  # none, where the caller came out of the cache
    assert _shifted(1.0, 4, False) == -3.0
    assert len(called.signatures) == 1


def test_a_core_without_a_model_needs_the_first_kernels_only() -> None:
    subprocess.run([sys.executable, "-c", WITHOUT_A_MODEL], check=True, timeout=240)


def signatures() -> set[Overload]:
    return set(overloads())


@pytest.mark.parametrize("joints", [3, 6, 12])
def test_no_cell_needs_kernels_that_the_example_did_not(joints: int) -> None:
    kernel_compilation.warm_up()
    before = signatures()
    model, settings = example_model(), example_settings()
    names = tuple(f"axis{k}" for k in range(joints))
    kinds = ("revolute",) * joints
    generators = np.concatenate([model.generators, np.roll(model.generators, 1, axis=0)])[:joints].copy()
    model = msgspec.structs.replace(
        model, joint_names=names, joint_kinds=kinds, zero=np.zeros(joints), generators=generators
    )
    ones = np.ones(joints)
    limits = msgspec.structs.replace(
        settings.limits, position_min=-2 * ones, position_max=2 * ones, velocity_max=ones, acceleration_max=4 * ones,
        keep_outs=np.full((1, joints, 2), [5.0, 6.0]), keep_out_names=("box",),
    )  # fmt: skip
    settings = msgspec.structs.replace(settings, joint_names=names, joint_kinds=kinds, limits=limits)
    pixels = kernel_compilation._example_pixels(model)
    points = model.marker_points + np.array([0.004, 0.0, 0.0, 0.0])
    target = PointTarget({i: tuple(p.tolist()) for i, p in enumerate(points)}, model.epoch)
    for law in LAWS:
        core = ServoCore(settings)
        for step in range(1, 30):
            inputs = kernel_compilation._inputs(step, pixels, model)
            still = msgspec.structs.replace(inputs.joints, positions=np.zeros(joints), velocities=np.zeros(joints))
            goal = (Request(1, "tester", RunGoal(Goal("00000001", target, law=law))),) if step == 5 else ()
            core.step(msgspec.structs.replace(inputs, joints=still, requests=goal, driver_active=True))
        assert core.state.model is not None
    assert signatures() == before


LARGE_BODY = """
from stereoservo.control.marker_groups import with_groups
from stereoservo.daemon import kernel_compilation
from stereoservo.numerics.compilation import overloads
from stereoservo_sim.benchmarks.cycle import CoreLoop, rx90_with_facets
from stereoservo_sim.world.exact_model import exact_model

kernel_compilation.warm_up()
cell = rx90_with_facets(300, 2)
loop = CoreLoop(cell, 0, with_groups(exact_model(cell)))
before = set(overloads())
loop.start_goal("stereo")
loop.move_goal(1)
assert set(overloads()) == before, set(overloads()) - before
"""


FOLLOWING = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from core.conftest import make_bench
from core.test_moving_target import following, slide
from stereoservo.daemon import kernel_compilation
from stereoservo.numerics.compilation import overloads

kernel_compilation.warm_up()
before = set(overloads())
bench, _ = following(make_bench, 0)
for way in (0.02, 0.2):  # a slow slide, then a jump
    slide(bench, lambda t: np.array([0.0, way * (t + 1.0), 0.0]))
    bench.run(1.0)
assert bench.core.state.target is not None
assert set(overloads()) == before, set(overloads()) - before
"""


def test_a_target_that_is_followed_needs_no_kernels_that_the_example_did_not() -> None:
    tests = Path(__file__).parents[1]
    subprocess.run([sys.executable, "-c", FOLLOWING, str(tests)], check=True, timeout=280)


@pytest.mark.slow
def test_a_large_body_needs_no_kernels_that_the_example_did_not() -> None:
    subprocess.run([sys.executable, "-c", LARGE_BODY], check=True, timeout=240)


def test_kernels_are_loaded_one_at_a_time_once_a_new_record_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "compiled.pickle"
    monkeypatch.setattr(kernel_compilation, "_record_path", lambda: path)
    path.write_bytes(b"of an older version")
    assert compiled() is None
    loader = KernelLoader()
    for now_ns in range(0, 10**10, 10**9):
        loader.advance(now_ns)
    assert not loader.loaded
    _calls_with_literals(1.0, 3)
    (wanted,) = [o for o in overloads() if o.name == "_calls_with_literals"]
    loads: list[Overload] = []
    monkeypatch.setattr(kernel_compilation, "load", lambda found: (loads.append(o) for o in found))
    record = kernel_compilation._Compiled(kernel_compilation._machine(), {__file__: (0, 0)}, {}, (wanted,) * 3)
    path.write_bytes(pickle.dumps(tuple(record)))
    loader.advance(10**10)
    assert not loads, "the sources have changed since"
    stamps = {__file__: kernel_compilation._stamp(__file__)}
    path.write_bytes(pickle.dumps(tuple(record._replace(sources=stamps))) + b" ")
    loader.advance(11 * 10**9)
    for count in (1, 2, 3):
        loader.advance((11 + count) * 10**9)
        assert (len(loads), loader.loaded) == (count, False)
    loader.advance(20 * 10**9)
    assert loader.loaded


def test_a_record_holds_for_its_sources_and_its_cache_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, source, cache = tmp_path / "compiled.pickle", tmp_path / "kernels.py", tmp_path / "cache"
    monkeypatch.setattr(kernel_compilation, "_record_path", lambda: path)
    cache.mkdir()
    source.write_text("x = 1\n")
    (cache / "kernels.x-1.py311.1.nbc").touch()
    stamps = {str(source): kernel_compilation._stamp(source)}
    record = kernel_compilation._Compiled(kernel_compilation._machine(), stamps, {str(cache): 1}, ())
    path.write_bytes(pickle.dumps(tuple(record)))
    assert compiled() == ()
    path.write_bytes(pickle.dumps(tuple(record._replace(machine=("another",)))))
    assert compiled() is None
    path.write_bytes(pickle.dumps(tuple(record)))
    (cache / "kernels.x-1.py311.1.nbc").unlink()
    assert compiled() is None
    (cache / "kernels.x-1.py311.1.nbc").touch()
    source.write_text("x = 22\n")
    assert compiled() is None


@pytest.mark.process
def test_what_one_process_has_compiled_another_knows() -> None:
    command = [sys.executable, "-m", "stereoservo.daemon.kernel_compilation", str(os.getpid())]
    subprocess.run(command, check=True, timeout=290)
    found = compiled()
    assert found is not None
    assert {"ingest", "command", "cartesian_step"} & {overload.name for overload in found}
    assert kernels_to_come() is None


def test_a_compilation_that_fails_is_told_once_and_begun_again(monkeypatch: pytest.MonkeyPatch) -> None:
    codes = iter([3, 0])
    began: list[list[str]] = []

    def spawn(arguments: list[str]) -> subprocess.Popen[bytes]:
        began.append(arguments)
        return subprocess.Popen([sys.executable, "-c", f"raise SystemExit({next(codes)})"])

    monkeypatch.setattr(supervisor, "_spawn", spawn)
    compilation = supervisor.Compilation(Path("/runtime"))
    assert compilation.check(0.0) == ""
    assert began[0][-2:] == ["beside", "/runtime"]

    def told(now: float) -> str:
        assert compilation._process is not None
        compilation._process.wait(240.0)
        return compilation.check(now)

    assert told(1.0) == "ended with exit code 3; starting again in 10 s"
    assert compilation.check(10.9) == ""
    assert len(began) == 1
    assert compilation.check(11.0) == ""
    assert len(began) == 2
    assert told(12.0) == ""
    assert compilation.check(1000.0) == ""
    assert len(began) == 2
    compilation.end()


def test_a_cell_with_drives_on_a_bus_waits_for_what_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as the other process holds the lock, and no longer; or until somebody ends the cell."""
    monkeypatch.setattr(kernel_compilation, "_record_path", lambda: tmp_path / "record")
    monkeypatch.setattr(kernel_compilation, "WAIT_S", 0.001)
    asked = []

    def given_up() -> bool:
        asked.append(len(asked))
        if len(asked) == 3:
            fcntl.flock(other, fcntl.LOCK_UN)
        return len(asked) > 5

    with open(kernel_compilation._lock_path(), "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        kernel_compilation.wait_until_compiled(given_up)
        assert len(asked) == 3
        fcntl.flock(other, fcntl.LOCK_EX)
        kernel_compilation.wait_until_compiled(given_up)
        assert len(asked) == 6
