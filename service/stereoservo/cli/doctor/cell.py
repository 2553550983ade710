"""Findings of ``stereoservo doctor`` on a cell before it runs: file, drivers, drives, cameras, directories, network,
model and scheduling.
"""

from __future__ import annotations

import resource
import shutil
import sys
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

from stereoservo.cli.doctor.cameras import examine_cameras
from stereoservo.cli.doctor.joints import examine_joints
from stereoservo.cli.output import coloured
from stereoservo.client import SessionError
from stereoservo.daemon.cell_preparation import make_plan
from stereoservo.daemon.ipc_messages import PlanOptions, RunPlan
from stereoservo.daemon.taught_goals import TaughtFileError, load_taught
from stereoservo.gateway.persistence import ModelStore
from stereoservo.gateway.zenoh_config import gateway_config
from stereoservo.messages.cell_file import CellFileError, load_cell_file
from stereoservo.messages.directories import CellDirectories, cell_directories, create_directories
from stereoservo.messages.locks import holder
from stereoservo.messages.text_files import Remark
from stereoservo.ports.devices import ExaminationFinding, MayMove

LOW_DISK_BYTES = 500_000_000
SHOWN_REMARKS = 20
"""Odd lines of a file that are listed, the first ones."""


def examine_cell(path: Path, may_move: MayMove, seconds: float, pictures: Path | None) -> Iterator[ExaminationFinding]:
    """Findings on a cell, each as soon as it is available: its file, this computer, drives, cameras.

    ``seconds``: duration of observing the cameras; 0: not at all. Raises CellFileError, PluginError, DriverError if the
    file cannot be used.
    """
    plan, directories = yield from examine_file(path)
    yield from examine_joints(plan, may_move)
    if seconds > 0:
        yield from examine_pictures(plan, directories, seconds, pictures)


def examine_file(path: Path) -> Generator[ExaminationFinding, None, tuple[RunPlan, CellDirectories]]:
    """Findings on a cell file and this computer; returns the plan of a run. Raises as :func:`examine_cell`."""
    odd: list[Remark] = []
    try:
        loaded = load_cell_file(path, odd)
    except CellFileError:
        yield from remark_findings(path, odd, "correct this line: what it states is left out")
        raise
    yield ExaminationFinding("cell file", True, f"{path} is valid in itself")
    directories = cell_directories(loaded.cell.name)
    create_directories(directories)
    plan = make_plan(path.absolute(), directories.runtime, directories.state, PlanOptions("doctor"))
    yield ExaminationFinding("drivers", True, _drivers(plan))
    for text in plan.joints.notes:
        yield ExaminationFinding("cell file" if text.startswith(f"{path.name}: ") else "arm", None, text)
    for check in CHECKS:
        yield check(plan, directories)
    return plan, directories


def examine_pictures(
    plan: RunPlan, directories: CellDirectories, seconds: float, pictures: Path | None = None
) -> Generator[ExaminationFinding, None, None]:
    """Findings on the cameras, observed for ``seconds``; ``pictures``: directory for annotated images."""
    settings = plan.settings()
    model, _ = ModelStore(directories.models).newest_fitting(settings)
    yield from examine_cameras(plan, settings, model, seconds, pictures or directories.state / "doctor")


def remark_findings(path: Path, remarks: list[Remark], remedy: str) -> Iterator[ExaminationFinding]:
    """Findings on odd lines of a file, the first ones."""
    for remark in remarks[:SHOWN_REMARKS]:
        yield ExaminationFinding(path.name, None, str(remark), remedy if remark.lost else "")
    if len(remarks) > SHOWN_REMARKS:
        yield ExaminationFinding(path.name, None, f"{len(remarks) - SHOWN_REMARKS} more lines are odd")


def line_of(finding: ExaminationFinding) -> str:
    """A finding as text for a terminal."""
    mark, colour = {True: ("ok", "green"), False: ("FAILED", "red"), None: ("note", "yellow")}[finding.ok]
    remedy = f"\n{'':20}cure: {finding.remedy}" if finding.remedy else ""
    return f"{coloured(f'{mark:6}', colour, sys.stdout)} {finding.name:12} {finding.message}{remedy}"


def _drivers(plan: RunPlan) -> str:
    cameras = ", ".join(
        f"{c.name} {c.width}x{c.height} at {c.rate_hz:g} Hz, {len(c.marker_ids)} markers" for c in plan.cameras
    )
    return f"{plan.joints.driver}: {len(plan.joints.joints)} joints; {cameras}"


def _daemon(plan: RunPlan, directories: CellDirectories) -> ExaminationFinding:
    pid = holder(directories.daemon_lock)
    if pid is None:
        return ExaminationFinding("daemon", True, "none runs for this cell")
    return ExaminationFinding("daemon", None, f"process {pid} runs this cell already; end it with `kill {pid}`")


def _rates(plan: RunPlan, directories: CellDirectories) -> ExaminationFinding:
    servo, joints = plan.cell.servo.rate_hz, plan.joints.rate_hz
    summary = f"loop {servo:g} Hz, joints {joints:g} Hz"
    if servo <= joints:
        return ExaminationFinding("rates", True, summary)
    return ExaminationFinding(
        "rates",
        None,
        f"{summary}: some cycles see no new sample, and their command waits for the next",
        f"servo.rate_hz = {joints:g}",
    )


def _camera_count(plan: RunPlan, directories: CellDirectories) -> ExaminationFinding:
    """Finding on the number of cameras: a single camera does not observe depth, so no model can be learnt."""
    count = len(plan.cell.camera)
    if count > 1:
        return ExaminationFinding("camera count", True, f"{count} cameras")
    return ExaminationFinding(
        "camera count",
        False,
        "the cell has 1 camera, two are needed: it can never be calibrated, and without a model only joint goals run",
        "another [[camera]] that sees the markers, mounted as the first one",
    )


def _wire(plan: RunPlan, directories: CellDirectories) -> ExaminationFinding:
    try:
        config = gateway_config(plan.cell, Path(plan.cell_path).parent, directories.zenoh_socket)
    except SessionError as error:
        return ExaminationFinding("zenoh", False, str(error))
    return ExaminationFinding(
        "zenoh", True, f"{config['mode']}: {', '.join(config['listen']['endpoints'] or config['connect']['endpoints'])}"
    )


def _model(plan: RunPlan, directories: CellDirectories) -> ExaminationFinding:
    model, passed = ModelStore(directories.models).newest_fitting(plan.settings())
    if model is not None and passed:
        why = "; ".join(passed)
        return ExaminationFinding(
            "model", None, f"epoch {model.epoch} of {model.created} is used, newer ones are passed over: {why}"
        )
    if model is not None:
        return ExaminationFinding("model", True, f"epoch {model.epoch}, {model.stratum}, of {model.created}")
    return ExaminationFinding("model", None, "; ".join(passed) or "none yet: calibrate")


def _taught(plan: RunPlan, directories: CellDirectories) -> ExaminationFinding:
    try:
        goals = load_taught(directories.taught)
    except TaughtFileError as error:
        return ExaminationFinding("taught", False, str(error))
    return ExaminationFinding("taught", True, ", ".join(sorted(goals)) or "none yet")


def _scheduling(plan: RunPlan, directories: CellDirectories) -> ExaminationFinding:
    requested = plan.cell.servo.priority
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if requested == 0 or soft >= requested or soft == resource.RLIM_INFINITY or _is_root():
        return ExaminationFinding(
            "scheduling", True, f"SCHED_FIFO priority {requested}" if requested else "ordinary scheduling was asked for"
        )
    return ExaminationFinding(
        "scheduling",
        None,
        f"SCHED_FIFO priority {requested} is not allowed here (limit {soft}): `ulimit -r {requested}`",
    )


def _is_root() -> bool:
    with open("/proc/self/status", encoding="ascii", errors="replace") as file:
        capabilities = next(int(line.split()[1], 16) for line in file if line.startswith("CapEff"))
    return bool(capabilities >> 23 & 1)  # CAP_SYS_NICE


def _disk(plan: RunPlan, directories: CellDirectories) -> ExaminationFinding:
    free = shutil.disk_usage(directories.state).free
    ok = True if free > LOW_DISK_BYTES else None
    return ExaminationFinding("disk", ok, f"{free / 1e9:.1f} GB free for recordings in {directories.state}")


CHECKS: tuple[Callable[[RunPlan, CellDirectories], ExaminationFinding], ...] = (
    _daemon,
    _rates,
    _camera_count,
    _wire,
    _model,
    _taught,
    _scheduling,
    _disk,
)
