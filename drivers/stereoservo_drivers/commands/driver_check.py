"""``stereoservo driver-check DRIVER``: the checks that every joint driver must pass, with a report."""

from __future__ import annotations

import importlib
import inspect
import json
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from stereoservo.messages.addresses import Address
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.ports import plugins
from stereoservo.ports.devices import DriverContext, JointDriver
from stereoservo_drivers.episodes import EpisodeJointDriver
from stereoservo_drivers.kit.bench import JointDriverSetup
from stereoservo_drivers.kit.joint_checks import JOINT_CHECKS, CheckResult, run_check

WARNING = (
    "THE ARM IS GOING TO MOVE: every joint, at a twentieth of its speed, for fractions of a second{far}. Grippers and "
    "other auxiliary joints move at their own speed, and all digital outputs (valves, clamps) are switched for half a "
    "second. Is its surrounding clear and a hand on the emergency stop? Begin"
)


class DriverCheckError(Exception):
    """The command cannot be executed; ``code`` is stable."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class GivenDriver(JointDriverSetup):
    """A driver class with its options, from the command line."""

    def __init__(self, driver: type[JointDriver], options: dict[str, Any], pull: bool, folder: Path) -> None:
        self.driver, self.options, self.pull, self.folder = driver, options, pull, folder

    def make_context(self, folder: Path) -> DriverContext:
        return replace(super().make_context(folder), cell_dir=self.folder)

    def make_driver(self, context: DriverContext) -> JointDriver:
        return self.driver(self.options, context)

    def unplug(self, driver: JointDriver) -> bool:
        if self.pull:
            self.fault_s = 30.0
            print(f"Pull the device's cable now, within {self.fault_s:g} s.", file=sys.stderr, flush=True)
        return self.pull

    def plug_in(self, driver: JointDriver) -> None:
        if self.pull:
            _confirmed("Plug it in again. Done?", True)


def driver_check(
    driver: Annotated[
        str,
        typer.Argument(
            metavar="DRIVER",
            help="my_package:Driver, an installed driver's name, or my_package:Setup (a JointDriverSetup). Default: "
            "that of --cell.",
        ),
    ] = "",
    options: Annotated[str, typer.Option(metavar="JSON", help="The driver's options.")] = "{}",
    cell: Annotated[
        Path | None,
        typer.Option(
            metavar="CELL.toml", help="Take driver and options of this cell's [joints], and its safety.joint_timeout_s."
        ),
    ] = None,
    hardware: Annotated[
        bool, typer.Option("--hardware", help="Connect to the device and MOVE THE ARM, slowly.")
    ] = False,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="All checks, of a driver that simulates its device itself.")
    ] = False,
    whole_range: Annotated[
        bool, typer.Option("--whole-range", help="With --hardware: also drive every joint to a limit.")
    ] = False,
    pull: Annotated[bool, typer.Option("--pull", help="With --hardware: ask you to pull the cable.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print exactly one JSON object on stdout.")] = False,
) -> None:
    """Check a joint driver against the contract: what was measured, and what to do where it fails.

    Without --hardware or --simulated nothing is connected and nothing moves. Exits with 1 where a check fails.
    """
    if hardware and simulated:
        raise DriverCheckError("argument", "--hardware and --simulated exclude each other")
    if (whole_range or pull) and not hardware:
        raise DriverCheckError("argument", "--whole-range and --pull need --hardware")
    loaded = None if cell is None else load_cell_file(cell)
    driver = driver or (loaded.joints.driver if loaded else "")
    if not driver:
        raise DriverCheckError("argument", "say which: DRIVER, or the --cell that names it")
    folder = Path.cwd() if cell is None else cell.absolute().parent
    setup = _setup(driver, _options(options, loaded), pull, folder)
    if loaded is not None:
        setup.joint_timeout_s = loaded.safety.joint_timeout_s
    if (hardware or simulated) and getattr(setup, "driver", None) is EpisodeJointDriver:
        raise DriverCheckError(
            "playback",
            "joints of an episode are played back and take no commands: only the checks without --simulated and "
            "--hardware are for them",
        )
    if hardware:
        setup.real_time = True
        setup.whole_range = whole_range or bool(setup.whole_range)
        far = ", and to its limits" if setup.whole_range else ""
        if not yes and not _confirmed(WARNING.format(far=far), False):
            raise DriverCheckError("refused", "nothing was done; --yes begins without asking")
    _report(driver, _results(setup, hardware or simulated, hardware), as_json)


def _confirmed(question: str, default: bool) -> bool:
    """The answer to a question; ``default`` if the input has ended. Raises KeyboardInterrupt."""
    try:
        return typer.confirm(question, default=default, err=True)
    except typer.Abort as abort:  # an interrupt, or the end of the input
        if not isinstance(abort.__context__, EOFError):
            raise KeyboardInterrupt from abort
        print("\nno answer: the input has ended", file=sys.stderr, flush=True)
        return default


def _results(setup: JointDriverSetup, connected: bool, hardware: bool) -> list[CheckResult]:
    """Run the checks; on hardware, none after a failed one, since the arm would move."""
    results: list[CheckResult] = []
    failed = ""
    for check in JOINT_CHECKS:
        reason = "" if connected else "needs the device: --hardware (the arm moves) or --simulated"
        if failed and hardware:
            reason = f"the arm moves no more once a check has failed: mend {failed!r} first"
        if check.connects and reason:
            results.append(CheckResult(check.name, "not run", reason))
            continue
        results.append(_run(check, setup))
        if results[-1].verdict == "failed":
            failed = failed or check.name
    return results


def _options(text: str, cell: CellFile | None) -> dict[str, Any]:
    if cell is not None:
        if text != "{}":
            raise DriverCheckError("argument", "--options and --cell exclude each other")
        return dict(cell.joints.options)
    try:
        found = json.loads(text)
    except ValueError as error:
        raise DriverCheckError("argument", f"--options is no JSON: {error}") from error
    if not isinstance(found, dict):
        raise DriverCheckError(
            "argument", f'--options {Address(text)!r}; an object, {{"port": "/dev/ttyACM0"}}, is valid'
        )
    return found


def _setup(name: str, options: dict[str, Any], pull: bool, folder: Path) -> JointDriverSetup:
    """The setup with the driver to check. Raises DriverCheckError, plugins.PluginError."""
    if ":" not in name:
        return GivenDriver(plugins.load(plugins.JOINT_DRIVERS, name), options, pull, folder)
    module, _, attribute = name.partition(":")
    sys.path.insert(0, str(Path.cwd()))  # as with python -m
    try:
        found = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever a third party's module raises on import
        raise DriverCheckError("import", f"{name}: {type(error).__name__}: {error}") from error
    if not inspect.isclass(found):
        raise DriverCheckError("import", f"{name} is {found!r}; a driver class, or a JointDriverSetup, is needed")
    if not issubclass(found, JointDriverSetup):
        return GivenDriver(found, options, pull, folder)
    setup: JointDriverSetup = found()
    return setup


def _run(check: Any, setup: JointDriverSetup) -> CheckResult:
    print(f"{check.name} …", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        return run_check(check, setup, Path(folder))


def _report(driver: str, results: list[CheckResult], as_json: bool) -> None:
    """Print the results. Raises typer.Exit if a check has failed."""
    counts = Counter(result.verdict for result in results)
    summary = ", ".join(f"{counts[verdict]} {verdict}" for verdict in ("passed", "failed", "not run"))
    failed = [result.name for result in results if result.verdict == "failed"]
    if as_json:
        tree: dict[str, Any] = {"driver": driver, "checks": msgspec.to_builtins(results), "summary": dict(counts)}
        if failed:
            tree["error"] = {"code": "checks_failed", "message": "; ".join(failed)}
        print(json.dumps(tree, allow_nan=False))
    else:
        width = max(len(result.name) for result in results)
        for result in results:
            print(f"{result.verdict:8} {result.name:{width}}  {result.measured}")
            if result.remedy:
                print(f"{'':{width + 9}}  do: {result.remedy}")
        print(f"{driver}: {summary}")
    if failed:
        raise typer.Exit(1)
