"""The checks of joint drivers pass a correct driver and catch what people get wrong."""

from __future__ import annotations

import ctypes
import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from stereoservo_drivers.commands.driver_check import driver_check
from stereoservo_drivers.kit import joint_checks
from stereoservo_drivers.kit.bench import RUNAWAY_REMEDY, CheckFailedError, JointBench
from stereoservo_drivers.kit.joint_checks import JOINT_CHECKS, STALL_S, TRIES, JointCheck, run_check
from stereoservo_drivers.kit.timing import CommandWatchdog, StallWatch

from .faulty_drivers import (
    FAULTY,
    LOW,
    ConfigureFails,
    Driver,
    LimitsInDegrees,
    LimitsNotKept,
    OptionsRefused,
    ReadFailsInConfigure,
    ReadsFeedTheWatchdog,
    RefusesAfterATrip,
    SmallSetup,
    StopFailsWhileConnected,
    TimeOutNotKept,
)

CELL = """
schema = 1
cell.name = "small"
joints = { driver = "fake", options = { rate_hz = 100.0 } }
safety.joint_timeout_s = 0.25
camera = [{ name = "left", driver = "fake" }, { name = "right", driver = "fake" }]
"""


@pytest.mark.parametrize("check", JOINT_CHECKS, ids=lambda check: check.name)
def test_a_correct_driver_passes(check, tmp_path):
    result = run_check(check, SmallSetup(), tmp_path)
    assert (result.verdict, result.remedy) == ("passed", ""), result
    assert result.measured


@pytest.mark.parametrize(("faulty", "name"), FAULTY.items(), ids=[driver.__name__ for driver in FAULTY])
def test_a_planted_fault_is_caught_by_its_check_with_a_remedy(faulty, name, tmp_path):
    assert issubclass(faulty, Driver)
    setup = SmallSetup()
    setup.driver = faulty
    (check,) = (check for check in JOINT_CHECKS if check.name == name)
    result = run_check(check, setup, tmp_path)
    assert result.verdict == "failed", result
    assert result.measured
    assert result.remedy


def run(driver, name, folder):
    setup = SmallSetup()
    setup.driver = driver
    (check,) = (check for check in JOINT_CHECKS if check.name == name)
    return run_check(check, setup, folder)


@pytest.mark.parametrize(
    ("driver", "after"),
    [(ReadsFeedTheWatchdog, "moves it again"), (RefusesAfterATrip, "is refused (tripped) after silence")],
)
def test_after_a_trip_a_command_moves_the_arm_again_or_is_refused(driver, after, tmp_path):
    result = run(driver, "stops when commands cease", tmp_path)
    assert result.verdict == "passed", result
    assert result.measured.endswith(after)


@pytest.mark.parametrize(
    ("driver", "measured", "remedy"),
    [
        (ConfigureFails, "configure() raised DriverError (servo): servo 1 is in mode 3", "modes"),
        (
            ReadFailsInConfigure,
            "read_state(), which configure() calls, raised KeyError: 'servo 1'",
            "answers",
        ),
        (StopFailsWhileConnected, "stop(), which close() calls, raised OSError: write failed", "catch"),
        (
            OptionsRefused,
            "the driver cannot be made: DriverError (option): driver 'small': servo",
            "--options",
        ),
    ],
)
def test_an_exception_is_told_by_the_call_that_raised_it_with_what_to_do_there(driver, measured, remedy, tmp_path):
    result = run(driver, "keeps its description", tmp_path)
    assert result.verdict == "failed"
    assert result.measured.startswith(measured)
    assert remedy in result.remedy


def test_limits_that_look_like_degrees_are_told(tmp_path):
    result = run(LimitsInDegrees, "describes itself", tmp_path)
    assert (result.verdict, result.measured.partition("WARNING: ")[2]) == (
        "passed",
        "a goes from -150 to 150 rad at 90 rad/s: degrees?",
    )


def test_outputs_are_left_as_they_were_found(tmp_path):
    made = []

    class Kept(SmallSetup):
        def make_driver(self, context):
            made.append(super().make_driver(context))
            return made[-1]

    (check,) = (check for check in JOINT_CHECKS if check.name == "orders auxiliary joints")
    result = run_check(check, Kept(), tmp_path)
    assert (result.verdict, result.measured) == ("passed", "gripper 0.01, valve 1")
    assert made[-1].read_auxiliary() == {"gripper": pytest.approx(0.01), "valve": 0.0}


@pytest.mark.parametrize("stall_s", [0.03, 1.5])
@pytest.mark.parametrize(
    ("name", "driver", "verdict"),
    [
        ("keeps position limits", Driver, "passed"),
        ("keeps position limits", LimitsNotKept, "failed"),
        ("agrees with its velocities", Driver, "passed"),
    ],
)
def test_a_computer_that_stands_still_is_no_fault_of_the_driver(name, driver, verdict, stall_s, tmp_path):
    (check,) = (check for check in JOINT_CHECKS if check.name == name)

    class Stalling(SmallSetup):
        """Stands still once: at a joint's limit, or beyond the middle of what is driven."""

        waits, stalled = 0, False

        def wait(self, context, seconds):
            self.waits += 1
            at_limit = made[-1].device.positions[0] <= LOW[0] + 2.0e-3
            stalls = not self.stalled and (at_limit if name == "keeps position limits" else self.waits == 120)
            self.stalled = self.stalled or stalls
            super().wait(context, seconds + stalls * stall_s)

        def make_driver(self, context):
            made.append(driver({}, context))
            return made[-1]

    made, setup = [], Stalling()
    result = run_check(check, setup, tmp_path)
    assert setup.stalled
    assert result.verdict == verdict, result


def command(*arguments):
    app = typer.Typer()
    app.command()(driver_check)
    result = CliRunner().invoke(app, [*arguments, "--json"])
    return result.exit_code, json.loads(result.stdout) if result.stdout else result.exception


@pytest.fixture
def here(monkeypatch):
    monkeypatch.chdir(Path(__file__).parent)


@pytest.mark.usefixtures("here")
def test_without_a_device_nothing_is_connected_and_the_rest_is_told_as_not_run():
    code, report = command("faulty_drivers:Driver")
    assert code == 0
    assert report["summary"] == {"passed": 3, "not run": len(JOINT_CHECKS) - 3}
    code, report = command("faulty_drivers:RaisingStop")
    assert (code, report["error"]["message"]) == (1, "stop raises nothing unconnected")
    (failed,) = (check for check in report["checks"] if check["verdict"] == "failed")
    assert "raises nothing, in any state" in failed["remedy"]


@pytest.mark.usefixtures("here")
def test_a_setup_brings_its_own_cable_and_counter_and_a_driver_class_does_without():
    code, report = command("faulty_drivers:SmallSetup", "--simulated")
    assert (code, report["summary"]) == (0, {"passed": len(JOINT_CHECKS)})
    code, report = command("faulty_drivers:Driver", "--simulated")
    assert (code, report["summary"]) == (0, {"passed": len(JOINT_CHECKS) - 4, "not run": 4})
    assert command("fake", "--simulated", "--options", '{"rate_hz": 100}')[0] == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "--cell"),
        (["no_such_module:Driver"], "ModuleNotFoundError"),
        (["json:loads"], "a driver class"),
        (["nobody"], "there are:"),
        (["fake", "--options", "[1]"], "is valid"),
        (["fake", "--options", "{"], "no JSON"),
        (["fake", "--pull"], "--hardware"),
        (["fake", "--hardware", "--simulated"], "exclude"),
    ],
)
def test_bad_arguments_are_refused_with_what_is_valid(arguments, words):
    code, error = command(*arguments)
    assert code == 1
    assert words in str(error)


@pytest.mark.usefixtures("here")
def test_hardware_is_moved_only_after_a_yes():
    app = typer.Typer()
    app.command()(driver_check)
    result = CliRunner().invoke(app, ["faulty_drivers:Driver", "--hardware"], input="n\n")
    assert result.exit_code == 1
    assert "nothing was done" in str(result.exception)


@pytest.mark.parametrize("how", ["--simulated", "--hardware"])
def test_joints_that_are_played_back_are_not_driven(how):
    """21 checks failed, each with the advice to look at supply, emergency stop and brakes."""
    code, error = command("stereoservo_drivers.episodes:EpisodeJointDriver", how)
    assert code == 1
    assert error.code == "playback"
    assert "take no commands" in str(error)


@pytest.mark.usefixtures("here")
def test_the_end_of_the_input_is_no_yes_and_is_told():
    app = typer.Typer()
    app.command()(driver_check)
    result = CliRunner().invoke(app, ["faulty_drivers:Driver", "--hardware"], input="")
    assert result.exit_code == 1
    assert "--yes begins without asking" in str(result.exception)
    assert "the input has ended" in result.stderr


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(("wanted", "verdict"), [(True, "passed"), (None, "not run")])
def test_a_setup_says_whether_its_hardware_is_driven_to_its_limits(wanted, verdict, monkeypatch):
    (check,) = (check for check in JOINT_CHECKS if check.name == "keeps position limits")
    monkeypatch.setattr("stereoservo_drivers.commands.driver_check.JOINT_CHECKS", (check,))
    monkeypatch.setattr(importlib.import_module("faulty_drivers").SmallSetup, "whole_range", wanted)
    monkeypatch.setattr(importlib.import_module("faulty_drivers").SmallSetup, "speed", 0.5)
    code, report = command("faulty_drivers:SmallSetup", "--hardware", "--yes")
    assert (code, report["checks"][0]["verdict"]) == (0, verdict)


def test_a_cell_names_driver_options_and_the_age_of_samples(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "stereoservo_drivers.commands.driver_check._results", lambda *given: setups.append(given[0]) or []
    )
    setups = []
    cell = tmp_path / "cell.toml"
    cell.write_text(CELL)
    command("--cell", str(cell))
    (setup,) = setups
    assert (setup.driver.__name__, setup.options, setup.joint_timeout_s) == (
        "FakeJointDriver",
        {"rate_hz": 100.0},
        0.25,
    )


@pytest.mark.usefixtures("here")
def test_hardware_moves_no_more_once_a_check_has_failed():
    code, report = command("faulty_drivers:Degrees", "--hardware", "--yes")
    verdicts = {check["name"]: check["verdict"] for check in report["checks"]}
    names = list(verdicts)
    assert code == 1
    assert verdicts["moves as told"] == "failed"
    assert {verdicts[name] for name in names[names.index("moves as told") + 1 :]} == {"not run"}


class Racing(Driver):
    """A gear that is wrong by a hundred."""

    def limited(self, velocities):
        return 100.0 * velocities


def test_an_arm_that_runs_away_is_stopped_at_once(tmp_path):
    setup = SmallSetup()
    setup.driver = Racing
    bench = JointBench(setup, setup.make_context(tmp_path))
    driver = bench.active()
    with pytest.raises(CheckFailedError, match="runs away, and was stopped"):
        bench.drive(driver, bench.slow(driver), 0.3)
    assert np.abs(driver.device.positions).max() < 0.06
    assert not driver.device.velocities.any()
    bench.close()


class Watched(TimeOutNotKept):
    """A device that goes on for ever, behind a watchdog."""

    def activate(self):
        super().activate()
        self.watchdog = CommandWatchdog(0.1, lambda: self.device.exchange(np.zeros(2)))

    def write_velocity(self, qd):
        report = super().write_velocity(qd)
        self.watchdog.feed()
        return report

    def deactivate(self):
        if self.life.state == "active":
            self.watchdog.close()
        super().deactivate()


@pytest.mark.parametrize("name", ["stops when commands cease", "leaves nothing behind"])
def test_a_watchdog_stops_a_device_that_has_none(name, tmp_path):
    setup = SmallSetup()
    setup.driver, setup.real_time, setup.brake_s = Watched, True, 0.2
    (check,) = (check for check in JOINT_CHECKS if check.name == name)
    assert run_check(check, setup, tmp_path).verdict == "passed"


STALL_US = 60_000


def test_a_stall_of_this_process_is_noted():
    with StallWatch() as watch:
        ctypes.PyDLL(None).usleep(STALL_US)  # with the interpreter's lock: no thread of this process runs
    assert watch.longest_s >= STALL_S


class GivenStalls:
    """Stands for `StallWatch` where a test says itself when the computer stood still."""

    longest_s = 0.0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.longest_s = GivenStalls.longest_s


@pytest.mark.parametrize(
    ("real_time", "stalls", "fails", "remedy", "runs", "verdict"),
    [
        pytest.param(True, 1, 1, "", 2, "passed", id="stood still once"),
        pytest.param(True, 9, 9, "", TRIES, "failed", id="stands still always"),
        pytest.param(True, 0, 9, "", 1, "failed", id="the driver's fault"),
        pytest.param(True, 9, 9, RUNAWAY_REMEDY, 1, "failed", id="ran away"),
        pytest.param(False, 9, 9, "", 1, "failed", id="in virtual time"),
    ],
)
def test_a_check_that_fails_runs_again_where_the_computer_stood_still(
    real_time, stalls, fails, remedy, runs, verdict, tmp_path, monkeypatch
):
    monkeypatch.setattr(joint_checks, "StallWatch", GivenStalls)
    done = 0

    def run(bench: JointBench) -> str:
        nonlocal done
        done += 1
        monkeypatch.setattr(GivenStalls, "longest_s", STALL_US * 1e-6 if done <= stalls else 0.0)
        if done <= fails:
            raise CheckFailedError("joint 1 goes on", remedy)
        return "stands"

    setup = SmallSetup()
    setup.real_time = real_time
    result = run_check(JointCheck("stands", run, "stop it"), setup, tmp_path)
    assert (done, result.verdict) == (runs, verdict)
    told = "this computer stood still meanwhile, for up to" in result.measured
    assert told == (verdict == "failed" and real_time and stalls > 0)
