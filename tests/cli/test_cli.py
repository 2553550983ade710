"""The command line's contract: one JSON object, errors as JSON, exit codes, broken plug-ins."""

import json
import os
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest

import stereoservo
from stereoservo.cli import dispatch, output
from stereoservo.cli import main as cli
from stereoservo.cli.warmup import _wait
from stereoservo.client import InvalidReplyError
from stereoservo.daemon.seqlock import StopSlot, create_stop_slot
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.compilation_progress import CompilationProgress, progress_path
from stereoservo.messages.directories import cell_directories, create_directories
from stereoservo.messages.locks import FileLock
from stereoservo.messages.wire import MessageError
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.detectors.dots import DotDetector

Run = Callable[..., tuple[int, Any, str]]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    """Run a command line with --json; gives exit code, the object and stderr."""

    def run_it(*arguments: str) -> tuple[int, Any, str]:
        code = cli.invoke([*arguments, "--json"])
        out, err = capfd.readouterr()
        assert out.count("\n") == 1, out
        return code, json.loads(out), err

    return run_it


@pytest.fixture
def cell(tmp_path: Path, run: Run) -> Path:
    """A cell file as `init` writes it."""
    path = tmp_path / "cell.toml"
    assert run("init", str(path))[0] == 0
    return path


def test_the_package_is_the_command_line() -> None:
    command = [sys.executable, "-m", "stereoservo.cli", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=240)
    assert done.stdout == f"stereoservo {stereoservo.__version__}\n"


@pytest.mark.parametrize("command", list(dispatch.OWN))
def test_every_command_has_help(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.invoke([command, "--help"]) == 0
    out = capfd.readouterr().out
    assert "Usage: stereoservo" in out
    assert "--json" in out


def test_help_lists_all_commands_and_those_of_entry_points(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.invoke(["--help"]) == 0
    out = capfd.readouterr().out
    for command in (*dispatch.OWN, "reproduce"):
        assert f"\n  {command} " in out


def test_init_writes_a_file_that_loads_with_every_joint_limited(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "line-1.toml"
    code, result, _ = run("init", str(path), "--camera", "right")
    assert code == 0
    assert result == {"cell": "line-1", "file": str(path)}
    loaded = load_cell_file(path)
    assert [camera.name for camera in loaded.camera] == ["right"]
    assert len(loaded.safety.limit) == 6
    assert "# " in path.read_text()
    assert tomllib.loads(path.read_text())["schema"] == 1


def test_init_does_not_overwrite_and_refuses_names_that_cannot_be_cells(tmp_path: Path, run: Run, cell: Path) -> None:
    before = cell.read_text()
    code, result, _ = run("init", str(cell))
    assert (code, result["error"]["code"]) == (1, "exists")
    assert cell.read_text() == before
    code, result, _ = run("init", str(tmp_path / "bad name.toml"))
    assert code == 1
    assert "bad name" in result["error"]["message"]
    assert run("init", str(cell), "--force")[0] == 0


def test_init_passes_options_on_to_the_driver_and_into_the_file(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "x.toml"
    joints = 'joints=[{name="pan"}, {name="tilt", max=1.0}]'
    code, _, _ = run("init", str(path), "--option", joints, "--option", "rate_hz=100.0", "--option", "mechanics=none")
    assert code == 0
    loaded = load_cell_file(path)
    assert loaded.joints.options["rate_hz"] == 100.0
    assert loaded.joints.options["mechanics"] == "none"  # no TOML: a text
    assert [(limit.joint, limit.max) for limit in loaded.safety.limit] == [("pan", 3.0), ("tilt", 1.0)]
    for option in ("rate_hz", "=3", "a b=3"):
        code, result, _ = run("init", str(tmp_path / "y.toml"), "--option", option)
        assert (code, result["error"]["code"]) == (1, "argument")


def test_init_with_an_unknown_driver_lists_those_there_are(tmp_path: Path, run: Run) -> None:
    code, result, _ = run("init", str(tmp_path / "x.toml"), "--joint-driver", "kuka")
    assert code == 1
    assert "no joint driver 'kuka'; there are: " in result["error"]["message"]
    assert "fake" in result["error"]["message"]


def test_init_with_a_driver_that_needs_options_says_where_to_begin(tmp_path: Path, run: Run) -> None:
    code, result, _ = run("init", str(tmp_path / "x.toml"), "--joint-driver", "canopen")
    assert (code, result["error"]["code"]) == (1, "option")
    assert "interface is missing" in result["error"]["message"]
    assert "--from hil-can" in result["error"]["message"]
    assert not (tmp_path / "x.toml").exists()


def test_doctor_checks_a_good_cell(run: Run, cell: Path) -> None:
    code, result, _ = run("doctor", str(cell))
    assert code == 0
    found = {check["name"]: check["ok"] for check in result["checks"]}
    assert found["drivers"] is True
    assert found["rates"] is True
    assert found["zenoh"] is True
    assert found["model"] is None  # none yet


def edited(cell: Path, old: str, new: str) -> str:
    text = cell.read_text()
    assert old in text
    cell.write_text(text.replace(old, new, 1))
    return str(cell)


def test_doctor_takes_the_name_of_a_shipped_cell_and_lists_them(run: Run) -> None:
    code, result, _ = run("doctor", "gantry", "--seconds", "0")
    assert code == 0
    assert "gantry.toml is valid" in next(c["message"] for c in result["checks"] if c["name"] == "cell file")
    code, _, err = run("doctor", "gantri")
    assert code != 0
    assert "no cell 'gantri' is shipped; there are demo, " in " ".join(err.split())


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ('"http://operator:Tulpe#77@127.0.0.1:9/video.mjpg"', "http://***@127.0.0.1:9/video.mjpg: nobody"),
        ('"http://operator:Tulpe77@127.0.0.1:9/straße.mjpg"', "http://***@127.0.0.1:9/straße.mjpg: nobody"),
        ('"http://operator:Tulpe/77@127.0.0.1:9/v"', "http://***@127.0.0.1:9/v: nobody"),
        ('"http://127.0.0.1:9/v?user=me&pwd=Tulpe"', "http://127.0.0.1:9/v?***: nobody"),
        ('"http://operator:12/Tulpe@127.0.0.1:9/v"', "in user and password '@' is written %40, '/' %2F"),
        ('"ftp://operator:Tulpe@127.0.0.1/v"', "http://, https:// (MJPEG, or a snapshot)"),
        ('"operator:Tulpe@127.0.0.1/v.mp4"', "a URL begins with http://"),
        ('["http://operator:Tulpe@127.0.0.1:9/v"]', "an integer or a text in quotes"),
        ('"http://operator:Tulpe"', "not a URL"),
    ],
)  # fmt: skip
def test_doctor_shows_no_cameras_password(source: str, told: str, run: Run, cell: Path) -> None:
    text = cell.read_text().replace('driver = "fake"\nmount', 'driver = "video"\ndetector = "dots"\nmount', 1)
    options = f"\n[camera.options]\nsource = {source}\nwidth = 64\nheight = 48\nopen_timeout_s = 0.5\n"
    second = '\n[[camera]]\nname = "right"'
    cell.write_text(text.replace(second, options + second, 1))
    code, result, err = run("doctor", str(cell), "--seconds", "0.1")
    assert code == 1
    shown = json.dumps(result, ensure_ascii=False) + err
    assert "Tulpe" not in shown
    assert "operator" not in shown.replace("http://operator:***", "")
    assert told in shown


@pytest.mark.parametrize("command", ["doctor", "run"])
def test_an_unknown_key_is_named_with_the_known_ones(command: str, run: Run, cell: Path) -> None:
    code, result, err = run(command, edited(cell, "[servo]", "[servo]\nspeed = 3"))
    assert code == 1
    assert "servo" in result["error"]["message"]
    assert "unknown field `speed`" in result["error"]["message"]
    assert "known keys: rate_hz, law" in result["error"]["message"]
    assert result["error"]["message"] in err


def test_a_joint_without_limits_is_named(run: Run, cell: Path) -> None:
    code, result, _ = run("doctor", edited(cell, 'joint = "j3"', 'joint = "j33"'))
    assert code == 1
    assert "j3" in result["error"]["message"]
    assert "no [[safety.limit]]" in result["error"]["message"] or "has no limits" in result["error"]["message"]


def test_a_cell_that_would_listen_to_everybody_fails_its_check(run: Run, cell: Path) -> None:
    with cell.open("a") as file:
        file.write('\n[zenoh]\nendpoints = ["tcp/0.0.0.0:7447"]\n')
    code, result, _ = run("doctor", str(cell))
    assert code == 1
    assert "every host" in result["error"]["message"]
    assert result["error"]["checks"]


def test_a_missing_cell_file_and_a_cell_that_does_not_run(tmp_path: Path, run: Run) -> None:
    code, result, _ = run("run", str(tmp_path / "none.toml"))
    assert code == 1
    assert "none.toml: cannot be read" in result["error"]["message"]
    code, result, _ = run("status", "nowhere")
    assert code == 1
    assert result["error"]["code"] == "not_running"
    assert "no daemon runs for cell 'nowhere'; running: none" in result["error"]["message"]
    priority = os.getpriority(os.PRIO_PROCESS, 0)
    assert run("stop", "nowhere")[0] == 1
    assert os.getpriority(os.PRIO_PROCESS, 0) == priority  # only a process that is a stop goes before others
    assert run("ls") == (0, {"cells": []}, "")


def test_a_cell_has_one_daemon_whatever_the_runtime_directories_are(
    cell: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directories = cell_directories(load_cell_file(cell).cell.name)
    create_directories(directories)
    with FileLock(directories.state_lock, "as its daemon does"):
        monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path / "elsewhere"))
        code, result, _ = run("run", str(cell))
    assert (code, result["error"]["code"]) == (1, "already_running")


def test_stop_takes_the_stop_slot_where_something_strange_answers(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def strange(*_: object, **__: object) -> None:
        raise InvalidReplyError("command/stop", MessageError("payload is not JSON"))

    monkeypatch.setattr("stereoservo.cli.stop.Client", strange)
    slot = cell_directories("demo").stop_slot
    slot.parent.mkdir(parents=True)
    create_stop_slot(slot)
    code, result, err = run("stop", "demo")
    assert code == 1
    assert result["error"]["code"] == "not_acknowledged"  # there is no servo process
    assert "raising the stop slot" in err


def slot_of(cell: str) -> Path:
    """The stop slot of a cell that seems to run."""
    path = cell_directories(cell).stop_slot
    path.parent.mkdir(parents=True)
    create_stop_slot(path)
    return path


@contextmanager
def acknowledging(path: Path) -> Iterator[None]:
    """A servo process that takes every stop."""
    slot, ended = StopSlot(path), threading.Event()
    lock = FileLock(cell_directories("demo").servo_lock, "the cell")

    def work() -> None:
        while not ended.wait(0.001):
            slot.poll()

    thread = threading.Thread(target=work)
    thread.start()
    yield
    ended.set()
    thread.join()
    lock.release()


ONLY_THE_STANDARD_LIBRARY = """
import sys
class Refusing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"typer", "rich", "msgspec", "zenoh", "numpy", "numba"}:
            raise SystemExit(f"{name} is imported")
sys.meta_path.insert(0, Refusing())
from stereoservo.cli import main
main.invoke(sys.argv[1:])
"""


@pytest.mark.parametrize("written", ["demo", "file"])
def test_a_stop_is_raised_before_any_library_is_imported(written: str, tmp_path: Path) -> None:
    slot = StopSlot(slot_of("demo"))
    path = tmp_path / "half-edited.toml"  # does not pass as a cell, and still names it
    path.write_text('[cell]\nname = "demo"\n[servo]\nspeeed = 1\n')
    arguments = ["stop", "demo" if written == "demo" else str(path), "--json"]
    ended = subprocess.run(
        [sys.executable, "-c", ONLY_THE_STANDARD_LIBRARY, *arguments],
        check=False, capture_output=True, text=True, timeout=240,
    )  # fmt: skip
    assert "is imported" in ended.stderr  # afterwards, for the answer
    assert slot.count == 1


def test_a_stop_on_its_host_asks_nobody_but_the_servo_process(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def asked(*_: object, **__: object) -> None:
        raise AssertionError("the gateway is asked")

    monkeypatch.setattr("stereoservo.cli.stop.Client", asked)
    path = slot_of("demo")
    with acknowledging(path):
        code, result, _ = run("stop", "demo")
    assert (code, result["accepted"]) == (0, True)
    assert StopSlot(path).count == 1


def test_a_stop_for_another_host_leaves_the_cell_of_this_name_here_alone(run: Run) -> None:
    path = slot_of("demo")
    code, result, _ = run("stop", "demo", "--endpoint", f"unixsock-stream/{path.parent}/none.sock")
    assert (code, result["error"]["code"]) == (1, "session")
    assert StopSlot(path).count == 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("goal", "nowhere"), "one of NAME"),
        (("goal", "nowhere", "pick", "--joint", "j1=0"), "one of NAME"),
        (("goal", "nowhere", "--joint", "j1=nan"), "NAME=NUMBER with a finite number"),
        (("goal", "nowhere", "--joint", "j1"), "NAME=NUMBER"),
        (("goal", "nowhere", "pick", "--law", ""), "law: Expected `str` of length >= 1"),
        (("goal", "nowhere", "pick", "--gain", "-1"), "gain: Expected `float` >= 0.0001"),
        (("goal", "nowhere", "pick", "--gain", "nan"), "gain is nan; finite numbers are valid"),
        (("goal", "nowhere", "pick", "--time-limit", "inf"), "time_limit_s is inf; finite numbers are valid"),
        (("goal", "nowhere", "--set-points", "/none.json"), "/none.json: No such file"),
        (("jog", "nowhere", "j1=fast"), "NAME=NUMBER"),
    ],
)
def test_arguments_are_checked_before_anything_is_asked(arguments: tuple[str, ...], text: str, run: Run) -> None:
    code, result, _ = run(*arguments)
    assert code == 1
    assert text in result["error"]["message"]


def test_usage_errors_are_json_too_and_exit_with_2(run: Run) -> None:
    code, result, _ = run("goal")
    assert (code, result["error"]["code"]) == (2, "usage")
    code, result, _ = run("fly")
    assert code == 2
    assert "fly" in result["error"]["message"]


def test_drivers_lists_plugins_with_their_errors(run: Run) -> None:
    code, result, _ = run("drivers")
    assert code == 0
    assert {entry["name"] for entry in result["joint_drivers"]} >= {"fake", "pybullet"}
    assert all(entry["error"] is None for entry in result["joint_drivers"])


def test_a_broken_command_is_listed_and_fails_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], run: Run
) -> None:
    info = tmp_path / "acme-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[stereoservo.commands]\nacme-dance = acme_commands_broken:dance\n")
    (tmp_path / "acme_commands_broken.py").write_text("raise RuntimeError('two left feet')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert cli.invoke(["--help"]) == 0
    assert "acme-dance" in capfd.readouterr().out
    code, result, _ = run("acme-dance")
    assert code == 1
    assert "two left feet" in result["error"]["message"]
    assert run("ls")[0] == 0


def test_help_reads_the_text_of_a_plugin_without_importing_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    info = tmp_path / "acme-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[stereoservo.commands]\nacme-sing = acme_singing:sing\n")
    (tmp_path / "acme_singing.py").write_text('def sing() -> None:\n    """Sings a song."""\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    assert cli.invoke(["--help"]) == 0
    assert "Sings a song." in capfd.readouterr().out
    assert "acme_singing" not in sys.modules


def test_a_damaged_recording_is_an_error_with_the_file(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"no recording")
    code, result, _ = run("replay", str(path))
    assert code == 1
    assert "x.mcap" in result["error"]["message"]


def test_an_interrupt_exits_with_130(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    def interrupted() -> list[Any]:
        raise KeyboardInterrupt

    monkeypatch.setattr("stereoservo.cli.status.live_cells", interrupted)
    code, result, _ = run("ls")
    assert (code, result["error"]["code"]) == (130, "interrupted")


def test_an_unexpected_error_shows_its_traceback_and_still_one_json_object(
    monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    monkeypatch.setattr("stereoservo.cli.status.live_cells", lambda: 1 / 0)
    code, result, err = run("ls")
    assert code == 1
    assert result["error"]["message"] == "division by zero"
    assert "Traceback" in err


def test_a_full_disk_behind_stderr_loses_a_remark_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    full = Path("/dev/full").open("w", buffering=1)  # noqa: SIM115 - what it holds is never written
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", full)
        output.log("the cell is up")
    with suppress(OSError):
        full.close()


def test_warmup_of_a_cell_makes_its_detectors_too(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise DriverError("option", "no detector today")

    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path / "r"))
    monkeypatch.setenv("STEREOSERVO_STATE_DIR", str(tmp_path / "s"))
    monkeypatch.setattr(DotDetector, "__init__", refused)
    assert cli.invoke(["warmup", "hil-video", "--json"]) == 1
    assert "no detector today" in json.loads(capfd.readouterr().out)["error"]["message"]
    assert cli.invoke(["warmup", "nowhere", "--json"]) == 2
    assert "hil-video" in capfd.readouterr().out


def test_warmup_tells_how_far_it_is_once_it_is_farther(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    class Compiling:
        """A process that compiles in steps, and ends well. At 0 its progress cannot be read."""

        done = iter([0, 3, 3, 0, 40])

        def wait(self, timeout_s: float) -> int:
            done = next(self.done, None)
            if done is None:
                return 0
            told = msgspec.json.encode(CompilationProgress("rest", 1, done, 300)) if done else b""
            progress_path(tmp_path, "rest").write_bytes(told)
            raise subprocess.TimeoutExpired("compile", timeout_s)

    assert _wait(Compiling(), tmp_path) == 0  # type: ignore[arg-type]
    lines = capfd.readouterr().err.splitlines()
    assert lines == ["compiling: 3 of about 300 kernels", "compiling: 40 of about 300 kernels"]
