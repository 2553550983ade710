"""`stereoservo doctor` and a joint driver that can examine its machine."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest

from stereoservo.cli import main as cli
from stereoservo.cli.doctor import cell as cell_module
from stereoservo.cli.doctor import command
from stereoservo.cli.doctor import joints as examination_module
from stereoservo.cli.setup.command import in_fault
from stereoservo.daemon.cell_preparation import make_plan
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.plant_driver import make_driver
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.directories import CellDirectories, cell_directories, create_directories
from stereoservo.messages.locks import FileLock
from stereoservo.ports.devices import Clock, DriverError, ExaminationFinding, JointState
from stereoservo_drivers.fake import FakeJointDriver

Doctor = Callable[..., tuple[int, list[dict[str, Any]]]]
QUESTION = "j1 will turn by one degree"


class Examination:
    """What the fake arm finds, and what it was told."""

    def __init__(self) -> None:
        self.allowed: list[bool] = []
        self.ended = False
        self.error: DriverError | None = None

    def __call__(self, _driver: object, may_move: Callable[[str], bool]) -> Iterator[ExaminationFinding]:
        try:
            yield ExaminationFinding("node 1", True, "answers")
            if self.error is not None:
                raise self.error
            self.allowed.append(may_move(QUESTION))
            yield ExaminationFinding("node 2", False, "is silent", "[[joints.options.joint]] node_id")
        finally:
            self.ended = True


@pytest.fixture
def examination(monkeypatch: pytest.MonkeyPatch) -> Examination:
    found = Examination()

    class ExaminableFake(FakeJointDriver):
        """A class of its own: what a protocol's isinstance has once said of a class, it keeps."""

        def examine(self, may_move: Callable[[str], bool]) -> Iterator[ExaminationFinding]:
            return found(self, may_move)

    def make(plan: RunPlan, clock: Clock) -> FakeJointDriver:
        driver = make_driver(plan, clock)
        driver.__class__ = ExaminableFake
        return driver

    monkeypatch.setattr(examination_module, "make_driver", make)
    return found


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    path = tmp_path / "cell.toml"
    assert cli.invoke(["init", str(path)]) == 0
    return path


@pytest.fixture
def doctor(cell: Path, capfd: pytest.CaptureFixture[str]) -> Doctor:
    def run(*options: str) -> tuple[int, list[dict[str, Any]]]:
        capfd.readouterr()
        code = cli.invoke(["doctor", str(cell), "--json", *options])
        result = json.loads(capfd.readouterr().out)
        checks = result["error"]["checks"] if code else result["checks"]
        return code, [check for check in checks if check["name"] in ("node 1", "node 2", "drives", "fault")]

    return run


def test_findings_are_checks_with_their_cure(doctor: Doctor, examination: Examination) -> None:
    code, checks = doctor()
    assert code == 1
    assert [(check["name"], check["ok"]) for check in checks] == [("node 1", True), ("node 2", False)]
    assert checks[1]["cure"] == "[[joints.options.joint]] node_id"
    assert examination.allowed == [False]
    assert examination.ended


def test_the_cure_is_printed_and_what_was_found_well(
    cell: Path, examination: Examination, capfd: pytest.CaptureFixture[str]
) -> None:
    assert cli.invoke(["doctor", str(cell)]) == 1
    out, err = capfd.readouterr()
    assert "ok     node 1       answers" in out
    assert "FAILED node 2       is silent" in out
    assert "cure: [[joints.options.joint]] node_id" in out
    assert err.strip() == "error: node 2: is silent"


def test_each_line_is_printed_as_soon_as_it_is_known(
    cell: Path, examination: Examination, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    printed = []

    def asked(_question: str) -> bool:
        printed.append(capfd.readouterr().out)
        return False

    monkeypatch.setattr(command, "permission", lambda jog, yes: asked)
    assert cli.invoke(["doctor", str(cell), "--seconds", "0"]) == 1
    assert "ok     node 1       answers" in printed[0]
    assert "node 2" not in printed[0]


def test_a_jog_is_allowed_by_yes_or_a_person_and_by_nobody_else(
    doctor: Doctor, examination: Examination, cell: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    doctor("--jog", "--yes")
    assert examination.allowed == [True]
    assert cli.invoke(["doctor", str(cell), "--jog"]) == 1  # no terminal here
    assert cli.invoke(["doctor", str(cell), "--yes"]) == 1
    assert examination.allowed == [True]
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    asked = []

    def confirm(question: str, **_: Any) -> bool:
        asked.append(question)
        return False

    monkeypatch.setattr("typer.confirm", confirm)
    doctor("--jog")
    assert asked == [QUESTION]
    assert examination.allowed == [True, False]


def test_a_machine_that_somebody_has_is_left_alone(doctor: Doctor, examination: Examination) -> None:
    directories = cell_directories("cell")
    create_directories(directories)
    with FileLock(directories.servo_lock, "the cell"):
        code, (check,) = doctor()
    assert (code, check["name"], check["ok"]) == (0, "drives", None)
    assert "already in use" in check["message"]
    with FileLock(directories.daemon_lock, "the daemon"):
        code, (check,) = doctor()
    assert (code, check["ok"]) == (0, None)
    assert "daemon" in check["message"]
    assert not examination.ended


def test_a_driver_error_is_a_failed_check(doctor: Doctor, examination: Examination) -> None:
    examination.error = DriverError("connection_lost", "no adapter at /dev/ttyACM0")
    code, checks = doctor()
    assert code == 1
    assert checks[-1]["message"] == "no adapter at /dev/ttyACM0"
    assert checks[-1]["ok"] is False


def test_a_fault_that_comes_up_while_the_arm_is_examined_is_one_that_setup_offers_to_reset(
    doctor: Doctor, examination: Examination
) -> None:
    examination.error = DriverError("drive_fault", "node 1: RPDO timed out", latched=True)
    _, checks = doctor()
    assert checks[-1]["name"] == "fault"
    found = msgspec.convert(checks, list[ExaminationFinding])
    assert in_fault([ExaminationFinding("drives", True, ""), *found]) is not None


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the fake arm does where it is taken for a real one that cannot examine itself: calls, positions, age."""
    told: dict[str, Any] = {"calls": [], "shift": 0.0, "age_ns": 0, "refusal": None}

    class Plain(FakeJointDriver):
        def configure(self) -> None:
            told["calls"].append("configure")
            if told["refusal"] is not None:
                raise told["refusal"]
            super().configure()

        def activate(self) -> None:
            told["calls"].append("activate")

        def read_state(self) -> JointState:
            state = super().read_state()
            return msgspec.structs.replace(
                state, positions=state.positions + told["shift"], t_ns=state.t_ns - told["age_ns"]
            )

        def close(self) -> None:
            told["calls"].append("close")
            super().close()

    def make(plan: RunPlan, clock: Clock) -> FakeJointDriver:
        driver = make_driver(plan, clock)
        driver.__class__ = Plain
        return driver

    def real(*given: Any) -> RunPlan:
        plan = make_plan(*given)
        return msgspec.structs.replace(plan, joints=msgspec.structs.replace(plan.joints, simulated=False))

    monkeypatch.setattr(examination_module, "make_driver", make)
    monkeypatch.setattr(cell_module, "make_plan", real)
    return told


@pytest.mark.parametrize(
    ("change", "failed", "word"),
    [
        ({}, None, "not looked at"),
        ({"shift": 10.0}, "joint positions", "its limits are"),
        ({"shift": math.nan}, "joint positions", "finite ones are needed"),
        ({"age_ns": 150_000_000}, "joint samples", "the arm stops at 100 ms"),
        ({"refusal": DriverError("servo", "servo 1 is in mode 3")}, "drives", "servo 1 is in mode 3"),
    ],
)
def test_an_arm_whose_driver_cannot_examine_it_is_read_and_closed_and_not_moved(
    cell: Path,
    plain: dict[str, Any],
    capfd: pytest.CaptureFixture[str],
    change: dict[str, Any],
    failed: str | None,
    word: str,
) -> None:
    plain |= change
    capfd.readouterr()
    code = cli.invoke(["doctor", str(cell), "--seconds", "0", "--json"])
    result = json.loads(capfd.readouterr().out)
    checks = (result["error"] if code else result)["checks"]
    assert [check["name"] for check in checks if check["ok"] is False] == ([failed] if failed else [])
    assert any(word in check["message"] for check in checks)
    assert plain["calls"] == ["configure", "close"]


def test_a_simulated_arm_is_told_not_to_have_been_connected(doctor: Doctor) -> None:
    code, (check,) = doctor("--seconds", "0")
    assert (code, check["ok"]) == (0, None)
    assert "'fake' simulates them" in check["message"]


def test_a_cell_with_one_camera_fails(cell: Path, capfd: pytest.CaptureFixture[str]) -> None:
    first, _, rest = cell.read_text().rpartition("[[camera]]")
    cell.write_text(first + rest[rest.index("\n[") :])
    assert len(load_cell_file(cell).camera) == 1
    capfd.readouterr()
    assert cli.invoke(["doctor", str(cell), "--seconds", "0", "--json"]) == 1
    checks = json.loads(capfd.readouterr().out)["error"]["checks"]
    assert [check["name"] for check in checks if check["ok"] is False] == ["camera count"]


def test_a_damaged_file_of_taught_goals_is_a_finding(tmp_path: Path) -> None:
    directories = CellDirectories("cell", tmp_path, tmp_path)
    directories.taught.write_bytes(b"\xff")
    finding = cell_module._taught(cast(RunPlan, None), directories)
    assert finding.ok is False
    assert "taught.json" in finding.message
    assert directories.taught.read_bytes() == b"\xff"  # who looks renames nothing
