"""Calibration of cameras without an arm, for ``stereoservo calibrate --rig``: gathers the views from live cameras, a
recording or folders of pictures, calibrates, and formats the report.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from stereoservo.calibration.camera_rig.rig_calibration import (
    KnownDistance,
    RigCalibration,
    ViewAdvice,
    calibrate_rig,
    next_views,
    save_rig,
)
from stereoservo.calibration.camera_rig.views import RigViews, still_places
from stereoservo.calibration.trial_data import TrialCamera
from stereoservo.cli.calibrate.command import CalibrateOptions
from stereoservo.cli.doctor.cameras import SAME_REMEDY, lock_cameras, watch_cameras
from stereoservo.cli.output import CommandError, log, read_columns, shipped_or_path
from stereoservo.daemon.camera_setup import recorded_camera, video_of
from stereoservo.daemon.cell_preparation import make_plan
from stereoservo.daemon.ipc_messages import PlanOptions
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.directories import cell_directories, create_directories
from stereoservo.messages.locks import AlreadyRunningError, holder
from stereoservo.messages.recording_request import IMAGES_SUFFIX
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import CameraObservation, Detector, DriverContext, Frame

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
DEFAULT_OUTPUT = Path("rig.json")
SHOWN_VIEWS, SHOWN_ADVICE = 3, 3


class RigReport(msgspec.Struct, frozen=True):
    """JSON of ``calibrate --rig``: the calibration's fields, the file, and pictures that would improve it."""

    rms_px: float
    sigma_px: float
    unit: str
    cameras: list[dict[str, Any]]
    parameters: tuple[str, ...]
    covariance: tuple[tuple[float, ...], ...]
    views: list[dict[str, Any]]
    left_out: int
    poorly_known: list[str]
    next_views: list[dict[str, Any]]
    file: str


def calibrate_cameras(options: CalibrateOptions) -> tuple[RigReport, str]:
    """The report of a calibration, as tree and as text; the file is written.

    Raises CommandError, CalibrationError, and what cameras, recordings and cell files raise.
    """
    board = _board(options.board, options.pitch)
    views = _views(options, board)
    layout = _layout(options, board, views.marker_ids)
    result, fit = calibrate_rig(replace(views, layout=layout), _known(options.length, layout))
    path = options.output or DEFAULT_OUTPUT
    save_rig(result, path)
    advice = next_views(fit, result)
    report = RigReport(
        result.rms_px, result.sigma_px, result.unit, [msgspec.to_builtins(camera) for camera in result.cameras],
        result.parameters, result.covariance, [msgspec.to_builtins(view) for view in result.views], result.left_out,
        poorly_known(result), [msgspec.to_builtins(one) for one in advice[:SHOWN_ADVICE]], str(path),
    )  # fmt: skip
    return report, _text(result, advice, path)


# -- what was seen ------------------------------------------------------------------------------------------


def _board(text: str, pitch: float | None) -> tuple[int, int] | None:
    if not text:
        if pitch is not None:
            raise CommandError("argument", "--pitch goes with --board COLUMNSxROWS")
        return None
    columns, _, rows = text.partition("x")
    if not (columns.isdigit() and rows.isdigit()) or pitch is None or not pitch > 0.0:
        raise CommandError(
            "argument",
            f"--board {text!r} --pitch {pitch}: numbers of inner corners and their distance in metres are valid, "
            "--board 9x6 --pitch 0.025",
        )
    return int(columns), int(rows)


def _layout(options: CalibrateOptions, board: tuple[int, int] | None, ids: tuple[int, ...]) -> FloatArray | None:
    """Positions (m, 3) [m] of the markers ``ids`` on the body, if they are stated."""
    if board is not None:
        assert options.pitch is not None
        return np.array([[i % board[0], i // board[0], 0] for i in ids]) * options.pitch
    if options.layout is None:
        return None
    try:
        table = {
            int(row["id"]): [float(row[axis] or 0.0) for axis in "xyz" if axis in row]
            for _, row in read_columns(options.layout, ("id", "x", "y"), "layout")
        }
    except ValueError as error:
        raise CommandError(
            "layout", f"{options.layout}: {error!r}; columns id,x,y[,z] with metres are valid"
        ) from error
    missing = [i for i in ids if i not in table]
    if missing:
        raise CommandError("layout", f"{options.layout} lacks markers {missing}, which were seen")
    return np.array([[*table[i], 0.0][:3] for i in ids])


def _known(text: str, layout: FloatArray | None) -> KnownDistance | None:
    if not text:
        return None
    if layout is not None:
        raise CommandError("argument", "--length is for a body of unknown layout; the layout holds lengths")
    markers, _, metres = text.partition("=")
    try:
        first, second = (int(one) for one in markers.split(","))
        return KnownDistance(first, second, float(metres))
    except ValueError as error:
        raise CommandError("length", f"--length {text!r}: ID,ID=METRES is valid, 3,7=0.12") from error


def _views(options: CalibrateOptions, board: tuple[int, int] | None) -> RigViews:
    if options.images is None:
        return _live(options)
    if options.images.suffix == IMAGES_SUFFIX:
        return _recorded(options)
    return _folders(options, board)


def _folders(options: CalibrateOptions, board: tuple[int, int] | None) -> RigViews:
    """Views of pictures in one folder per camera; pictures of one pose have the same name, apart from the camera's."""
    assert options.images is not None
    folders = sorted(path for path in options.images.glob("*") if path.is_dir())
    pictures = {
        folder.name: {
            path.stem.replace(folder.name, ""): path
            for path in sorted(folder.glob("*"))
            if path.suffix.lower() in PICTURES
        }
        for folder in folders
    }
    pictures = {name: files for name, files in pictures.items() if files}
    if not pictures:
        raise CommandError(
            "images",
            f"{options.images} holds no folder with pictures; a folder a camera, such as {options.images}/left/01.png "
            f"and {options.images}/right/01.png, is valid ({', '.join(PICTURES)})",
        )
    keys = sorted({key for files in pictures.values() for key in files})
    cameras: list[TrialCamera] = []
    seen: dict[str, dict[str, CameraObservation]] = {}
    for name, files in pictures.items():
        detector = _detector(options, name, board)
        found: dict[str, CameraObservation] = {}
        size: tuple[int, ...] | None = None
        for key, path in files.items():
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise CommandError("images", f"{path} is no picture that OpenCV reads")
            if size is not None and size != image.shape:
                raise CommandError("images", f"{path} is {image.shape[1]}x{image.shape[0]}, others {size[1]}x{size[0]}")
            size = image.shape
            found[key] = detector.detect(Frame(name, len(found), 0, 0, image), None)
        assert size is not None
        shown = sum(o.ids.size > 0 for o in found.values())
        log(f"camera {name}: the body in {shown} of {len(files)} pictures")
        if board is not None and not shown:
            raise CommandError(
                "images",
                f"none of the {len(files)} pictures of camera {name!r} shows a board of {board[0]}x{board[1]} inner "
                "corners: --board counts the corners where four squares meet, 9x6 on a board of 10x7 squares",
            )
        cameras.append(TrialCamera(name, size[1], size[0]))
        seen[name] = found
    return _stacked(cameras, keys, seen)


def _stacked(cameras: list[TrialCamera], keys: list[str], seen: dict[str, dict[str, CameraObservation]]) -> RigViews:
    ids = tuple(sorted({int(i) for found in seen.values() for o in found.values() for i in o.ids}))
    column = {marker: k for k, marker in enumerate(ids)}
    pixels = np.full((len(cameras), len(keys), len(ids), 2), np.nan)
    sigmas = np.ones(pixels.shape[:3])
    for c, camera in enumerate(cameras):
        for s, key in enumerate(keys):
            one = seen[camera.name].get(key)
            if one is not None and one.ids.size:
                at = [column[int(i)] for i in one.ids]
                pixels[c, s, at] = one.pixels
                sigmas[c, s, at] = np.sqrt(0.5 * np.trace(one.covariances, axis1=1, axis2=2))
    return RigViews(tuple(cameras), ids, tuple(keys), pixels, sigmas)


def _detector(options: CalibrateOptions, camera: str, board: tuple[int, int] | None) -> Detector:
    """The board's detector, or that of the cell file's camera of this name."""
    context = DriverContext(MonotonicClock(), "rig", Path(), Path(), camera=camera)
    if board is not None:
        made: Detector = plugins.load(plugins.DETECTORS, "chessboard")({"columns": board[0], "rows": board[1]}, context)
        return made
    if not options.cell:
        raise CommandError(
            "argument",
            "--images of a folder a camera needs --board COLUMNSxROWS and --pitch METRES, or a cell file whose "
            "detectors see the body",
        )
    path = Path(options.cell)
    sections = {section.name: section for section in load_cell_file(path).camera}
    if camera not in sections or not sections[camera].detector:
        raise CommandError(
            "images", f"{path} has no camera {camera!r} with a detector; there are {', '.join(sections)}"
        )
    section = sections[camera]
    found: Detector = plugins.load(plugins.DETECTORS, section.detector)(
        section.detector_options, replace(context, cell_dir=path.absolute().parent)
    )
    return found


def _recorded(options: CalibrateOptions) -> RigViews:
    """Views of a recording of ``record --images``, taken while the body was held still."""
    assert options.images is not None
    if not options.cell:
        raise CommandError("argument", f"{options.images} is a recording: its cell file is needed, for the detectors")
    path = Path(options.cell)
    cell = load_cell_file(path)
    cameras: list[TrialCamera] = []
    seen: dict[str, list[CameraObservation]] = {}
    for section in cell.camera:
        one = recorded_camera(cell, path, section.name, video_of(options.images, section.name))
        cameras.append(TrialCamera(section.name, one.description.width, one.description.height))
        seen[section.name] = list(one.observations(log))
        log(f"camera {section.name}: {len(seen[section.name])} frames")
    return still_places(cameras, seen)


def _live(options: CalibrateOptions) -> RigViews:
    """Views of a cell file's cameras, observed for some seconds while the body is held in various poses."""
    if not options.cell:
        raise CommandError(
            "argument", "--rig needs a cell file with the cameras, or --images DIR with a folder a camera"
        )
    path = shipped_or_path(options.cell)
    directories = cell_directories(load_cell_file(path).cell.name)
    create_directories(directories)
    pid = holder(directories.daemon_lock)
    if pid is not None:
        raise CommandError(
            "daemon_runs", f"the daemon (process {pid}) has the cameras: end it with `kill {pid}`, or use a recording"
        )
    plan = make_plan(path.absolute(), directories.runtime, directories.state, PlanOptions("rig"))
    log(
        f"watching for {options.seconds:g} s: hold the body still for half a second, here and there, also tilted, near "
        "and far, in the pictures' corners"
    )
    began = time.monotonic()
    with ExitStack() as locks:
        try:
            same = lock_cameras(plan, locks)
        except AlreadyRunningError as error:
            raise CommandError("cameras", str(error)) from error
        if same:
            raise CommandError("cameras", f"{same}: {SAME_REMEDY}")
        records = watch_cameras(plan, options.seconds)
    failed = [f"{r.description.name}: {r.error}" for r in records if r.error]
    if failed:
        raise CommandError("cameras", "; ".join(failed))
    cameras = [TrialCamera(r.description.name, r.description.width, r.description.height) for r in records]
    views = still_places(cameras, {r.description.name: r.seen for r in records})
    log(f"{len(views.names)} places in {time.monotonic() - began:.0f} s")
    return views


# -- the report ---------------------------------------------------------------------------------------------


def poorly_known(result: RigCalibration) -> list[str]:
    """Parameters of these cameras that are too uncertain to rely on, with their standard deviations."""
    found = []
    for camera in result.cameras:
        d = camera.deviations
        for name, value, limit in (("fx", camera.focal[0], 0.002), ("fy", camera.focal[1], 0.002)):
            if d[name] > limit * value:
                found.append(f"{camera.name}.{name} to {100 * d[name] / value:.2g} %")
        for name in ("cx", "cy"):
            if d[name] > 0.005 * camera.width:
                found.append(f"{camera.name}.{name} to {d[name]:.2g} px")
        if d["k2"] > 0.1:
            found.append(f"{camera.name}.k2 to {d['k2']:.2g}: the pictures' corners are not covered")
        length = float(np.linalg.norm(camera.translation))
        if length and max(d["tx"], d["ty"], d["tz"]) > 0.005 * length:
            found.append(
                f"{camera.name}'s place to {100 * max(d['tx'], d['ty'], d['tz']) / length:.2g} % of the baseline"
            )
    return found


def _text(result: RigCalibration, advice: list[ViewAdvice], path: Path) -> str:
    places = len(result.views)
    lines = [
        f"{len(result.cameras)} cameras, {places} places, {result.measurements} measurements "
        f"({result.left_out} left out): {result.rms_px:.4f} px rms, noise {result.sigma_px:.4f} px a coordinate; "
        "(±) standard deviations"
    ]
    for camera in result.cameras:
        d = camera.deviations
        lines += [
            f"  {camera.name}: {camera.width}x{camera.height} px",
            f"    focal length     {camera.focal[0]:.3f} ± {d['fx']:.3f}, {camera.focal[1]:.3f} ± {d['fy']:.3f} px",
            f"    principal point  {camera.centre[0]:.3f} ± {d['cx']:.3f}, {camera.centre[1]:.3f} ± {d['cy']:.3f} px",
            "    distortion       "
            + ", ".join(
                f"{name} {value:.5f} ± {d[name]:.5f}"
                for name, value in zip(("k1", "k2", "p1", "p2"), camera.distortion, strict=True)
            ),
        ]
        if "tx" in d:
            first = result.cameras[0].name
            angle = np.degrees(np.arccos(np.clip((np.trace(np.array(camera.rotation)) - 1.0) / 2.0, -1.0, 1.0)))
            turn = np.degrees(max(d["rx"], d["ry"], d["rz"]))
            unit = " m" if result.unit == "m" else " baselines"
            place = ", ".join(
                f"{value:.6f} ± {d[name]:.6f}"
                for name, value in zip(("tx", "ty", "tz"), camera.translation, strict=True)
            )
            lines += [f"    from {first}: turned by {angle:.4f}° ± {turn:.4f}°, translation {place}{unit}"]
    if result.unit != "m":
        lines.append("  lengths are in baselines: state one (--length ID,ID=METRES) for metres")
    worst = ", ".join(
        f"{view.name or '(unnamed)'} {view.rms_px:.3f} px" + (f", {view.left_out} left out" if view.left_out else "")
        for view in result.views[:SHOWN_VIEWS]
    )
    lines.append(f"  worst places: {worst}")
    poor = poorly_known(result)
    lines.append(f"  poorly known: {'; '.join(poor) if poor else 'nothing'}")
    lines += [f"  would help: {one.message}" for one in advice[:SHOWN_ADVICE]]
    lines.append(f"  written to {path}")
    return "\n".join(lines)
