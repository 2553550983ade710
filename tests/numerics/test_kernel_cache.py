"""Compiled kernels in the cache and as installed: renewed with all that they are made of, used only where they fit."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from stereoservo.numerics.compilation import LOG_VARIABLE

CALLER = """
from acme.called import FACTOR, twice
from stereoservo.numerics.compilation import kernel

@kernel
def caller(x):
    return FACTOR * twice(x)
"""
CALLED = """
from stereoservo.numerics.compilation import kernel

FACTOR = {factor}

@kernel
def twice(x):
    return {count} * x
"""
REACHES = """
from acme import between
from acme.called import default, enclosed
from stereoservo.numerics.compilation import kernel

@kernel
def caller(x):
    return between.FACTOR * default(x) * enclosed(x)
"""
REACHED = """
from acme.constants import FACTOR
from stereoservo.numerics.compilation import kernel

@kernel
def default(x, factor=FACTOR):
    return factor * x

def around(factor):
    @kernel
    def enclosed(x):
        return factor * x
    return enclosed

enclosed = around(FACTOR)
"""


LONG = (
    """
import math

from stereoservo.numerics.compilation import kernel

FACTOR = 10.0

@kernel
def twice(x):
"""
    + "    x += 0.0 * math.sin(x)\n" * 200
    + "    return 2 * x\n"
)

TAKES_PAIR = """
from acme.{home} import Pair
from stereoservo.numerics.compilation import kernel

@kernel
def second(pair):
    return pair.second

@kernel
def caller(x):
    return second(Pair(x, 20.0 * x))
"""
PAIR = """
from typing import NamedTuple

class Pair(NamedTuple):
    first: float
    second: float
"""


@pytest.fixture
def acme(tmp_path: Path) -> Path:
    """A distribution with a kernel that calls another one, of another file."""
    package = tmp_path / "site" / "acme"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "caller.py").write_text(CALLER)
    (package / "called.py").write_text(CALLED.format(factor=10.0, count=2))
    return package


def run(acme: Path, cache: Path, first: str = "", **environment: str) -> tuple[float, set[str]]:
    """What a new process computes, after ``first``, and the kernels that it compiles."""
    log = cache.with_suffix(".log")
    log.unlink(missing_ok=True)
    done = subprocess.run(
        [sys.executable, "-c", f"{first}\nfrom acme.caller import caller; print(caller(1.0))"],
        env=os.environ
        | {
            "PYTHONPATH": os.pathsep.join([str(acme.parent), os.environ.get("PYTHONPATH", "")]),
            "PYTHONDONTWRITEBYTECODE": "1",  # files that are changed within a second
            "NUMBA_CACHE_DIR": str(cache),
            LOG_VARIABLE: str(log),
        }
        | environment,
        capture_output=True,
        check=True,
        text=True,
        timeout=240,
    )
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    return float(done.stdout), {line["kernel"] for line in lines if line.get("module", "").startswith("acme")}


def test_a_kernel_that_is_compiled_is_linked_with_what_came_from_the_cache(acme: Path, tmp_path: Path) -> None:
    assert run(acme, tmp_path / "cache") == (20.0, {"caller", "twice"})
    (acme / "caller.py").write_text(CALLER.replace("FACTOR * twice(x)", "twice(x) + twice(x)"))
    assert run(acme, tmp_path / "cache") == (4.0, {"caller"})


@pytest.mark.parametrize(("change", "result"), [({"count": 3}, 30.0), ({"factor": 7.0}, 14.0)])
def test_a_kernel_is_renewed_with_what_it_calls(
    acme: Path, tmp_path: Path, change: dict[str, float], result: float
) -> None:
    assert run(acme, tmp_path / "cache") == (20.0, {"caller", "twice"})
    assert run(acme, tmp_path / "cache") == (20.0, set())
    (acme / "called.py").write_text(CALLED.format(**{"factor": 10.0, "count": 2} | change))
    assert run(acme, tmp_path / "cache") == (result, {"caller", "twice"})


def test_a_kernel_is_renewed_with_constants_of_modules_of_defaults_and_of_functions_around_it(
    acme: Path, tmp_path: Path
) -> None:
    (acme / "constants.py").write_text("FACTOR = 10.0\n")
    (acme / "between.py").write_text("from acme.constants import FACTOR\n")
    (acme / "called.py").write_text(REACHED)
    (acme / "caller.py").write_text(REACHES)
    assert run(acme, tmp_path / "cache")[0] == 1000.0
    (acme / "constants.py").write_text("FACTOR = 7.0\n")
    assert run(acme, tmp_path / "cache") == (343.0, {"caller", "default", "around.<locals>.enclosed"})


def test_a_kernel_of_before_an_upgrade_is_not_taken_for_one_of_after(acme: Path, tmp_path: Path) -> None:
    file, after = acme / "called.py", CALLED.format(factor=10.0, count=3)
    upgrade = f"import pathlib, acme.caller; pathlib.Path({str(file)!r}).write_text({after!r})"
    assert run(acme, tmp_path / "cache", upgrade)[0] == 20.0
    assert run(acme, tmp_path / "cache")[0] == 30.0


def test_a_long_kernel_is_called_by_symbol_and_its_caller_is_renewed_where_the_symbol_is_lost(
    acme: Path, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    (acme / "called.py").write_text(LONG)
    assert run(acme, cache) == (20.0, {"caller", "twice"})
    (caller,), (called,) = cache.rglob("caller.caller*.nbc"), cache.rglob("called.twice*.nbc")
    assert caller.stat().st_size < called.stat().st_size
    os.utime(acme / "called.py", (0, 0))  # installed again, with the same content
    assert run(acme, cache) == (20.0, set())
    called.unlink()
    assert run(acme, cache) == (20.0, {"caller", "twice"})  # the new symbol has another number
    assert run(acme, cache) == (20.0, set())


@pytest.mark.parametrize("change", ["moved", "damaged"])
def test_a_list_of_kernels_that_cannot_be_read_is_written_anew(acme: Path, tmp_path: Path, change: str) -> None:
    (acme / "pairs.py").write_text(PAIR)
    (acme / "caller.py").write_text(TAKES_PAIR.format(home="pairs"))
    assert run(acme, tmp_path / "cache") == (20.0, {"caller", "second"})
    if change == "moved":  # an upgrade without the module of a type that the list names
        (acme / "pairs.py").rename(acme / "moved.py")
        (acme / "caller.py").write_text(TAKES_PAIR.format(home="moved"))
    else:
        for file in (tmp_path / "cache").rglob("*.nbi"):
            file.write_bytes(file.read_bytes()[:40])
    upgraded = {"PYTHONWARNINGS": "error::RuntimeWarning"} if change == "moved" else {}
    assert run(acme, tmp_path / "cache", **upgraded) == (20.0, {"caller", "second"})
    assert run(acme, tmp_path / "cache") == (20.0, set())


def test_installed_kernels_are_used_where_they_fit(acme: Path, tmp_path: Path) -> None:
    made = tmp_path / "made"
    run(acme, made, NUMBA_CPU_NAME="generic")
    installed = acme.parent / "stereoservo_kernels"
    (folder,) = (path for path in made.iterdir() if path.name.startswith("acme_"))
    shutil.copytree(folder, installed / "acme")
    (installed / "__init__.py").touch()
    assert run(acme, tmp_path / "empty") == (20.0, set())
    (acme / "called.py").write_text(CALLED.format(factor=10.0, count=4))
    assert run(acme, tmp_path / "other") == (40.0, {"caller", "twice"})
    (acme / "called.py").write_text(CALLED.format(factor=10.0, count=2))
    for file in (installed / "acme").glob("*.nbc"):
        file.write_bytes(file.read_bytes()[:100])
    assert run(acme, tmp_path / "damaged") == (20.0, {"caller", "twice"})
    for file in (tmp_path / "damaged").rglob("*.nbc"):
        file.write_bytes(b"")  # a computer that lost its power
    assert run(acme, tmp_path / "damaged") == (20.0, {"caller", "twice"})
    assert run(acme, tmp_path / "damaged") == (20.0, set())


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_release_s_kernels_in_a_fresh_environment(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    python = tmp_path / "venv" / "bin" / "python"

    def do(*command: str) -> str:
        environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
        done = subprocess.run(command, env=environment, cwd=tmp_path, stdout=subprocess.PIPE, check=True, text=True)
        return done.stdout

    do(sys.executable, "-m", "venv", str(tmp_path / "venv"))
    install = (str(python), "-m", "pip", "install", "--quiet", "--constraint", str(root / "constraints.txt"))
    do(*install, f"{root}[demo]", "hatchling")
    wheel = (
        str(python),
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-build-isolation",
        "--no-deps",
        "--wheel-dir",
        "dist",
    )
    do(*wheel, str(root / "deploy" / "kernels"))
    (built,) = (tmp_path / "dist").glob("stereoservo_kernels-*.whl")
    do(*install, "--no-deps", str(built))
    started = json.loads(
        do(str(python), "-m", "stereoservo.cli.main", "bench", "startup", "--json", "--repetitions", "1")
    )
    assert [row["kernel"] for row in started["kernels"] if row["kernel"].startswith("stereoservo")] == []
