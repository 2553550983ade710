"""Preparation of a run in a process of its own: checks cell file and drivers, writes the run plan (the configuration
that all processes read), compiles the numba kernels that a cell needs first: those of its detectors and of a core
without a model.

In its own process, a driver that crashes while it describes itself ends nothing else.
``python -m stereoservo.daemon.cell_preparation CELL.toml RUNTIME_DIRECTORY STATE_DIRECTORY PARENT_PID JSON_OPTIONS``.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from stereoservo.control.law_registry import LAWS
from stereoservo.daemon.camera_setup import describe_camera, make_camera
from stereoservo.daemon.ipc_messages import PlanOptions, RunPlan, save_plan
from stereoservo.daemon.kernel_compilation import collect_seldom, report_progress, warm_up_first
from stereoservo.daemon.process_control import die_with_parent
from stereoservo.messages.cell_file import CellFile, CellFileError, load_cell_file
from stereoservo.messages.text_files import Remark
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import (
    AuxiliaryDriver,
    CameraDescription,
    Clock,
    DriverContext,
    DriverError,
    JointDriverDescription,
)

EXIT_INVALID = 2


@contextmanager
def _named(cell_path: Path, section: str) -> Iterator[None]:
    """Context manager that prefixes a driver's error with the file and the section of its options."""
    try:
        yield
    except DriverError as error:
        raise DriverError(error.code, f"{cell_path}: {section}: {error}", **error.data) from error


def describe_cell(
    cell: CellFile, cell_path: Path, runtime: Path, clock: Clock, *, seed: int = 0
) -> tuple[JointDriverDescription, tuple[CameraDescription, ...]]:
    """Descriptions of joint driver and cameras, each camera with its detector's marker ids.

    Raises PluginError, DriverError, CellFileError (a camera that can report no marker, or lacks a detector).
    """
    common = {
        "clock": clock,
        "cell": cell.cell.name,
        "runtime_dir": runtime,
        "cell_dir": cell_path.parent,
        "seed": seed,
        "arm": cell.arm_options,
    }
    joint_context = DriverContext(**common, mount=cell.camera[0].mount)  # type: ignore[arg-type]
    with _named(cell_path, "joints.options"):
        joint_driver = plugins.load(plugins.JOINT_DRIVERS, cell.joints.driver)(cell.joints.options, joint_context)
        joints: JointDriverDescription = joint_driver.describe()
    if joints.auxiliary and not isinstance(joint_driver, AuxiliaryDriver):
        raise DriverError(
            "auxiliary",
            f"joint driver {cell.joints.driver!r} declares auxiliary joints or outputs "
            f"({', '.join(spec.name for spec in joints.auxiliary)}), and lacks write_auxiliary, read_auxiliary or "
            "stop_auxiliary: commands would be reported as executed",
        )
    if joints.pacing != "clock":
        raise CellFileError(
            cell_path,
            "joints.driver",
            f"driver {cell.joints.driver!r} asks for pacing {joints.pacing!r}; the daemon paces by 'clock'",
        )
    cameras = []
    for section in cell.camera:
        context = DriverContext(**common, camera=section.name, mount=section.mount)  # type: ignore[arg-type]
        with _named(cell_path, f"camera {section.name!r}"):
            driver, detector = make_camera(section, context)
        cameras.append(describe_camera(section, driver, detector, cell_path))
    return joints, tuple(cameras)


def make_plan(cell_path: Path, runtime: Path, state: Path, options: PlanOptions) -> RunPlan:
    """The run plan of a cell, checked with its drivers. Raises CellFileError, PluginError, DriverError."""
    odd: list[Remark] = []
    cell = load_cell_file(cell_path, odd)
    joints, cameras = describe_cell(cell, cell_path, runtime, MonotonicClock(), seed=options.seed)
    joints = msgspec.structs.replace(joints, notes=(*joints.notes, *(f"{cell_path.name}: {remark}" for remark in odd)))
    plan = RunPlan(
        cell=cell, cell_path=str(cell_path), runtime=str(runtime), state=str(state), boot=options.boot,
        joints=joints, cameras=cameras, seed=options.seed, dry_run=options.dry_run,
        commissioning=options.commissioning, record=options.record,
        laws=LAWS.descriptions(), law_errors=dict(LAWS.errors),
    )  # fmt: skip
    try:
        plan.settings()
    except CellFileError as error:  # without the cell file's path
        if error.path == str(cell_path):
            raise
        raise CellFileError(cell_path, error.key, str(error).partition(f"{error.key}: ")[2] or str(error)) from error
    return plan


def main() -> int:
    """Entry of the process; writes one line to stderr if the cell cannot be run."""
    cell_path, runtime, state = (Path(argument) for argument in sys.argv[1:4])
    die_with_parent(int(sys.argv[4]), signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    collect_seldom()
    report_progress(runtime, "first", int(sys.argv[4]))
    try:
        plan = make_plan(cell_path, runtime, state, msgspec.json.decode(sys.argv[5], type=PlanOptions))
    except (CellFileError, DriverError, plugins.PluginError) as error:
        print(error, file=sys.stderr)
        return EXIT_INVALID
    try:
        save_plan(plan)
    except OSError as error:
        print(f"{runtime}: the run plan cannot be written: {error.strerror}", file=sys.stderr)
        return EXIT_INVALID
    warm_up_first()
    return 0


if __name__ == "__main__":
    sys.exit(main())
