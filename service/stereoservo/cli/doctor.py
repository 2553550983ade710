"""``stereoservo doctor``: checks a cell before it moves."""

from __future__ import annotations

import resource
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from stereoservo.cli.camera_examination import examine_cameras
from stereoservo.cli.examination import examine_joints, permission
from stereoservo.cli.output import CommandError, JsonOption, emit
from stereoservo.gateway.session import SessionError, gateway_config
from stereoservo.gateway.stores import ModelStore
from stereoservo.runtime.cellfile import load_cell_file
from stereoservo.runtime.describe import PlanOptions, make_plan
from stereoservo.runtime.directories import CellDirectories, cell_directories, create_directories
from stereoservo.runtime.interprocess import RunPlan
from stereoservo.runtime.locks import holder
from stereoservo.runtime.taught import load_taught

LOW_DISK_BYTES = 500_000_000


class Check(msgspec.Struct, frozen=True):
    """One check. ``ok`` None: worth knowing. ``cure``: the setting or act that mends it."""

    name: str
    ok: bool | None
    message: str
    cure: str = ""


def doctor(
    cell: Annotated[Path, typer.Argument(metavar="CELL", help="Path of a cell file.")],
    jog: Annotated[
        bool,
        typer.Option("--jog", help="Also turn each joint by one degree, once allowed: checks its units."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Allow what --jog asks for.")] = False,
    seconds: Annotated[
        float,
        typer.Option(
            "--seconds", help="How long the cameras are watched; 0: not at all.", min=0.0, max=600.0
        ),
    ] = 2.0,
    pictures: Annotated[
        Path | None,
        typer.Option(
            "--pictures", help="Where what each camera sees is saved (default: the cell's state directory)."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check cell file, drivers, drives, cameras, directories, wire, model and scheduling. Nothing moves without
    ``--jog``; drives and cameras are asked only while no daemon has them.
    """
    may_move = permission(jog, yes)
    loaded = load_cell_file(cell)
    checks = [Check("cell file", True, f"{cell} is valid")]
    directories = cell_directories(loaded.cell.name)
    create_directories(directories)
    plan = make_plan(cell.absolute(), directories.runtime, directories.state, PlanOptions("doctor"))
    checks.append(Check("drivers", True, _drivers(plan)))
    checks += [check(plan, directories) for check in CHECKS]
    signal.signal(
        signal.SIGPIPE, signal.SIG_IGN
    )  # an adapter that hangs up is a finding, no end without a word
    for found in examine_joints(plan, may_move):
        checks.append(Check(found.name, found.ok, found.message, found.cure))
    if seconds > 0:
        settings = plan.settings()
        model, _ = ModelStore(directories.models).newest_fitting(settings)
        for found in examine_cameras(
            plan, settings, model, seconds, pictures or directories.state / "doctor"
        ):
            checks.append(Check(found.name, found.ok, found.message, found.cure))
    failed = [check for check in checks if check.ok is False]
    text = "\n".join(_line(check) for check in checks)
    if failed:
        if not json:
            emit(None, text, False)
        tree = msgspec.to_builtins(checks)
        raise CommandError(
            "checks_failed", "; ".join(f"{check.name}: {check.message}" for check in failed), checks=tree
        )
    emit({"checks": checks}, text, json)


def _line(check: Check) -> str:
    mark = {True: "ok", False: "FAILED", None: "note"}[check.ok]
    cure = f"\n{'':20}cure: {check.cure}" if check.cure else ""
    return f"{mark:6} {check.name:12} {check.message}{cure}"


def _drivers(plan: RunPlan) -> str:
    cameras = ", ".join(
        f"{c.name} {c.width}x{c.height} at {c.rate_hz:g} Hz, {len(c.marker_ids)} markers"
        for c in plan.cameras
    )
    return f"{plan.joints.driver}: {len(plan.joints.joints)} joints; {cameras}"


def _daemon(plan: RunPlan, directories: CellDirectories) -> Check:
    pid = holder(directories.daemon_lock)
    if pid is None:
        return Check("daemon", True, "none runs for this cell")
    return Check("daemon", None, f"process {pid} runs this cell already; end it with `kill {pid}`")


def _rates(plan: RunPlan, directories: CellDirectories) -> Check:
    servo, joints = plan.cell.servo.rate_hz, plan.joints.rate_hz
    told = f"loop {servo:g} Hz, joints {joints:g} Hz"
    if servo <= joints:
        return Check("rates", True, told)
    return Check(
        "rates",
        None,
        f"{told}: some cycles see no new sample, and their command waits for the next",
        f"servo.rate_hz = {joints:g}",
    )


def _wire(plan: RunPlan, directories: CellDirectories) -> Check:
    try:
        config = gateway_config(plan.cell, Path(plan.cell_path).parent, directories.zenoh_socket)
    except SessionError as error:
        return Check("zenoh", False, str(error))
    return Check(
        "zenoh",
        True,
        f"{config['mode']}: {', '.join(config['listen']['endpoints'] or config['connect']['endpoints'])}",
    )


def _model(plan: RunPlan, directories: CellDirectories) -> Check:
    model, passed = ModelStore(directories.models).newest_fitting(plan.settings())
    if model is not None and passed:
        why = "; ".join(passed)
        return Check(
            "model",
            None,
            f"epoch {model.epoch} of {model.created} is used, newer ones are passed over: {why}",
        )
    if model is not None:
        return Check("model", True, f"epoch {model.epoch}, {model.stratum}, of {model.created}")
    return Check("model", None, "; ".join(passed) or "none yet: calibrate")


def _taught(plan: RunPlan, directories: CellDirectories) -> Check:
    goals = load_taught(directories.taught)
    return Check("taught", True, ", ".join(sorted(goals)) or "none yet")


def _scheduling(plan: RunPlan, directories: CellDirectories) -> Check:
    wanted = plan.cell.servo.priority
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if wanted == 0 or soft >= wanted or soft == resource.RLIM_INFINITY or _is_root():
        return Check(
            "scheduling",
            True,
            f"SCHED_FIFO priority {wanted}" if wanted else "ordinary scheduling was asked for",
        )
    return Check(
        "scheduling",
        None,
        f"SCHED_FIFO priority {wanted} is not allowed here (limit {soft}): `ulimit -r {wanted}`",
    )


def _is_root() -> bool:
    with open("/proc/self/status", encoding="ascii", errors="replace") as file:
        capabilities = next(int(line.split()[1], 16) for line in file if line.startswith("CapEff"))
    return bool(capabilities >> 23 & 1)  # CAP_SYS_NICE


def _disk(plan: RunPlan, directories: CellDirectories) -> Check:
    free = shutil.disk_usage(directories.state).free
    ok = True if free > LOW_DISK_BYTES else None
    return Check("disk", ok, f"{free / 1e9:.1f} GB free for recordings in {directories.state}")


CHECKS: tuple[Callable[[RunPlan, CellDirectories], Check], ...] = (
    _daemon,
    _rates,
    _wire,
    _model,
    _taught,
    _scheduling,
    _disk,
)
