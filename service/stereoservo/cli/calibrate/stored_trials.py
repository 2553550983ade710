"""Calibration from stored trial data for ``stereoservo calibrate CELL --trials FILE.npz``: lenses from a file of
straight lines, fit, stored model, and what it was made of.
"""

from __future__ import annotations

import csv
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.cli.output import CommandError, note
from stereoservo.daemon.jobs.fit_job import report_folder
from stereoservo.gateway.child_jobs import calibration_result
from stereoservo.gateway.persistence import ModelStore
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.locks import holder
from stereoservo.messages.wire import CalibrationResult


class LinesUsed(msgspec.Struct, frozen=True):
    """Straight lines that determined the lenses: names of the lines by camera, noise of their pixels [px]."""

    file: str
    sigma_px: float
    cameras: dict[str, tuple[str, ...]]


class StoredFit(CalibrationResult, frozen=True):
    """A fit of stored trials. ``use``: when the cell starts to use it. ``lines``: None without ``--lines``."""

    use: str = ""
    lines: LinesUsed | None = None


def source_of_stored(result: StoredFit) -> str:
    """What a fit of stored trials was made of, and what becomes of it, as lines of text."""
    lines = [f"  fitted in {result.seconds:.1f} s"]
    if result.lines is not None:
        used = "; ".join(f"{name}: {', '.join(names)}" for name, names in result.lines.cameras.items())
        lines.append(f"  lines  {result.lines.file} (noise {result.lines.sigma_px:g} px), {used}")
    lines.append(f"  {result.use}")
    return "\n".join(lines)


def fit_stored_trials(
    cell: str, path: Path, lines: Path | None, lines_sigma: float, output: Path | None
) -> StoredFit:
    """Fit stored trial data in this process; the model is stored beside the cell's others unless ``output`` is
    given.

    Beside the others only while no daemon runs: that would keep its model and take this one unasked at its next start.

    Raises CommandError, CalibrationError, ModelFileError, OSError, CellFileError.
    """
    # scipy and the fit are slow to import; commands that only talk to a daemon do without.
    from stereoservo.calibration.fit_assessment import assess_failure
    from stereoservo.calibration.trial_data import CalibrationError, load_trials
    from stereoservo.daemon.jobs.fit_job import fit_trials, report_fit

    file, name, directory = resolve_cell(cell, output)
    data = load_trials(path)
    if file is not None:
        _must_fit(file, data, path)
    beside = output is None
    if output is None:
        directory.mkdir(parents=True, exist_ok=True)
        store = ModelStore(directory)
        epoch = store.next_epoch()
        output = store.path(epoch)
    else:
        epoch = 0
    calibration = None if file is None else file.calibration
    known = "" if calibration is None else calibration.known_length
    priors, used = (None, None) if lines is None else read_lines(lines, lines_sigma, data)
    started = time.monotonic()
    try:
        result, assessment = fit_trials(data, output, epoch, lens_priors=priors)
    except CalibrationError as error:
        failure = assess_failure(error.code, error.message)
        page_path = report_fit(data, path, output, None, failure)
        raise CommandError(
            error.code, f"{failure.text} A report is in {page_path}", report=str(page_path)
        ) from error
    seconds = time.monotonic() - started
    try:
        page: Path | None = report_fit(data, path, output, result, assessment, known)
    except OSError as error:
        note(f"no report could be written into {report_folder(output)}: {error}")
        page = None
    figures = calibration_result(result.model, output, assessment, page, path, seconds)
    use = (
        f"the daemon of cell {name!r} takes this model at its next start, where it fits the cell's joints, cameras and "
        "markers (`stereoservo doctor` tells); remove the file if it is not to"
        if beside
        else f"no daemon takes this model: it lies outside of {directory}"
    )
    return StoredFit(**msgspec.structs.asdict(figures), use=use, lines=used)


def resolve_cell(cell: str, output: Path | None) -> tuple[CellFile | None, str, Path]:
    """The cell file, where it was given, the cell's name, and its directory of models.

    Raises CommandError where a fit could not be kept, CellFileError.
    """
    from stereoservo.messages.files import check_writable

    if output is not None:
        try:
            check_writable(output)
        except OSError as error:
            raise CommandError("output", f"--output: {error.filename}: {error.strerror}") from error
    file = load_cell_file(Path(cell)) if cell.endswith(".toml") else None
    name = cell if file is None else file.cell.name
    directory = cell_directories(name).models
    if output is None:
        _must_not_run(name)
    elif output.resolve().parent == directory.resolve():
        raise CommandError(
            "output",
            f"--output: {directory} is where cell {name!r} keeps its numbered models: leave --output away to put the "
            "model there, or give another directory",
        )
    return file, name, directory


def _must_not_run(name: str) -> None:
    directories = cell_directories(name)
    pid = holder(directories.daemon_lock)
    if pid is not None:
        raise CommandError(
            "daemon_running",
            f"the daemon of cell {name!r} runs (pid {pid or 'unknown'}): it would keep its model and silently take "
            "this one at its next start. Either give --output FILE.json in another directory than "
            f"{directories.models}, or stop the daemon and run this again",
            cell=name, pid=pid,
        )  # fmt: skip


def _must_fit(file: CellFile, data: Any, path: Path) -> None:
    cameras = [camera.name for camera in file.camera]
    joints = {limit.joint for limit in file.safety.limit} or set(
        data.joint_names
    )  # not stated of a simulated arm
    if [camera.name for camera in data.cameras] != cameras or set(data.joint_names) != joints:
        raise CommandError(
            "other_cell",
            f"{path} is of joints {', '.join(data.joint_names)} and cameras "
            f"{', '.join(camera.name for camera in data.cameras)}; the cell has joints {', '.join(sorted(joints))} and "
            f"cameras {', '.join(cameras)}",
        )


def read_lines(path: Path, sigma: float, data: Any) -> tuple[dict[str, Any], LinesUsed]:
    """Lens of each camera, and the lines it was estimated from: a table ``camera,line,u,v``, with this header.

    Raises CommandError naming the row, or the camera whose lines do not determine its lens.
    """
    if not 0.0 < sigma < np.inf:
        raise CommandError("lines", f"--lines-sigma is {sigma:g} px; a positive finite number is needed")
    from stereoservo.geometry.distortion import lens_from_lines
    from stereoservo.geometry.homogeneous import GeometryError

    sizes = {camera.name: (camera.width, camera.height) for camera in data.cameras}
    found: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise CommandError("lines", f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CommandError("lines", f"{path}: is not UTF-8 text: {error}") from error
    reader = csv.DictReader(text.splitlines())
    if reader.fieldnames is None or set(reader.fieldnames) != {"camera", "line", "u", "v"}:
        raise CommandError(
            "lines", f"{path}: the first row is {reader.fieldnames}; camera,line,u,v is needed"
        )
    for number, row in enumerate(reader, start=2):
        try:
            pixel = float(row["u"]), float(row["v"])
        except (TypeError, ValueError) as error:
            raise CommandError("lines", f"{path}: row {number}: u and v are numbers [px]") from error
        if None in row:
            raise CommandError(
                "lines", f"{path}: row {number}: has more than the four values camera,line,u,v"
            )
        if row["camera"] not in sizes:
            raise CommandError(
                "lines", f"{path}: row {number}: no camera {row['camera']!r}; cameras: {', '.join(sizes)}"
            )
        width, height = sizes[row["camera"]]
        if not (-0.5 <= pixel[0] <= width - 0.5 and -0.5 <= pixel[1] <= height - 0.5):
            raise CommandError(
                "lines",
                f"{path}: row {number}: pixel ({pixel[0]:g}, {pixel[1]:g}) is outside the image of {width}x{height} px",
            )
        found[row["camera"]][row["line"]].append(pixel)
    if not found:
        raise CommandError("lines", f"{path}: holds no pixels; rows of camera,line,u,v are needed")
    lenses = {}
    for camera, of_camera in found.items():
        lines = [np.array(line) for line in of_camera.values()]
        try:
            lenses[camera] = lens_from_lines(lines, sigma, *sizes[camera])
        except GeometryError as error:
            names = ", ".join(repr(line) for line in of_camera)
            raise CommandError(
                "lines",
                f"{path}: lines of camera {camera!r} ({names}, counted from 0): {error}",
                camera=camera,
            ) from error
    names_of = {camera: tuple(of_camera) for camera, of_camera in found.items()}
    return lenses, LinesUsed(str(path), sigma, names_of)
