"""``stereoservo learn-corners CELL.toml OUT.npz``: natural features of a cell, for the detector ``corners``."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import daemon_info
from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import CameraDriver, DriverContext, DriverError, Frame
from stereoservo.ports.image_files import ImageReader
from stereoservo_drivers.detectors.landmark_learning import LearningSettings, draw_landmarks, learn_landmarks
from stereoservo_drivers.detectors.landmarks import KINDS, encode_landmarks

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
PATIENCE_S = 10.0
LARGEST_PICTURE = 256 << 20
CameraImages = dict[str, list[ImageArray]]


class LearnError(Exception):
    """The command cannot be executed; ``code`` is stable."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class LearnOptions:
    """Options of the command; each field is one of the command line."""

    cell: Annotated[Path, typer.Argument(metavar="CELL.toml", help="The cell file: names of its cameras.")]
    out: Annotated[Path, typer.Argument(metavar="OUT.npz", help="File to write.")]
    images: Annotated[
        Path | None, typer.Option(help="Folder with CAMERA.png, CAMERA_*.png (averaged) or CAMERA.avi of each camera.")
    ] = None
    pair: Annotated[
        tuple[Path, Path] | None,
        typer.Option(metavar="LEFT RIGHT", help="Images of the first two cameras of the cell file, in its order."),
    ] = None
    moved: Annotated[
        tuple[Path, Path] | None,
        typer.Option(metavar="LEFT RIGHT", help="The same after the last joint alone has moved."),
    ] = None
    moved_images: Annotated[
        Path | None, typer.Option(help="A folder as --images, after the last joint alone has moved.")
    ] = None
    ask_to_move: Annotated[
        bool, typer.Option("--ask-to-move", help="With the cell's cameras: wait for a motion, then look again.")
    ] = False
    frames: Annotated[int, typer.Option(min=1, max=200, help="Frames of a camera or recording to average.")] = 8
    most: Annotated[int, typer.Option(min=16, max=2000, help="Landmarks to keep.")] = 150
    picture: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Draw what was matched, and of which kind it is.")
    ] = None
    force: Annotated[bool, typer.Option("--force", help="Write over a file that exists.")] = False
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False


def learn_corners(given: LearnOptions) -> None:
    """Learn landmarks from images of one moment, or of a scene at rest; a second set separates tool from scene."""
    if given.images is not None and given.pair is not None:
        raise LearnError("argument", "--images and --pair are two ways to give the images; give one of them")
    if given.moved is not None and given.moved_images is not None:
        raise LearnError("argument", "--moved and --moved-images are two ways to say the same; give one of them")
    if given.ask_to_move and (given.images is not None or given.pair is not None):
        raise LearnError("argument", "--ask-to-move is for live cameras; files go with --moved or --moved-images")
    for file in (given.out,) if given.picture is None else (given.out, given.picture):
        if file.exists() and not given.force:
            raise LearnError("exists", f"{file} exists; --force writes over it")
        if not file.absolute().parent.is_dir():
            raise LearnError("argument", f"{file}: there is no folder {file.parent} to write it into")
    if given.picture is not None and given.picture.suffix.lower() not in SUFFIXES:
        raise LearnError("argument", f"--picture {given.picture}: one of {', '.join(SUFFIXES)} is valid")
    section = load_cell_file(given.cell)
    before, after = _observations(section, given.cell, given.images, given.pair, given.frames, given.ask_to_move)
    if given.moved is not None:
        after = _pair(section, given.moved, "--moved")
    elif given.moved_images is not None:
        after = _folder(section, given.moved_images, given.frames)
    landmarks, report = learn_landmarks(before, after, LearningSettings(most=given.most))
    _write(given.out, encode_landmarks(landmarks))
    if given.picture is not None:
        _write_picture(given.picture, draw_landmarks(landmarks))
    kinds = {kind: landmarks.of_kind(kind).tolist() for kind in KINDS}
    answer: dict[str, Any] = {
        "file": str(given.out),
        "landmarks": len(landmarks.ids),
        **{kind: len(ids) for kind, ids in kinds.items()},
        "ids": kinds,
        "left_out": report.left_out,
        "pairs": [asdict(one) for one in report.pairs],
        "picture": None if given.picture is None else str(given.picture),
    }
    if given.as_json:
        print(json.dumps(answer, allow_nan=False))
    else:
        print("\n".join(_text(answer)))


def _text(answer: Mapping[str, Any]) -> list[str]:
    lines = [
        f"{pair['first']} and {pair['second']}: {pair['corners']} corners, {pair['aligned']} found in both, "
        f"{pair['consistent']} on their epipolar lines, {pair['unique']} without a double; "
        f"epipolar rms {pair['epipolar_rms_px']:.3f} px"
        + ("; all on one plane, which leaves the epipolar geometry open" if pair["planar"] else "")
        for pair in answer["pairs"]
    ]
    lines.append(
        f"{answer['file']}: {answer['landmarks']} landmarks: {answer['tool']} of the tool, {answer['static']} of the "
        f"scene, {answer['unsorted']} unsorted; {answer['left_out']} in doubt and left out"
    )
    lines.append('For the cell file, in each [[camera]]:\n\ndetector = "corners"')
    lines.append(f'detector_options = {{ landmarks = "{Path(answer["file"]).name}" }}')
    if answer["static"]:
        lines.append(f"\n[scene]\nstatic = {answer['ids']['static']}")
    if answer["picture"]:
        lines.append(f"\nwrote {answer['picture']}")
    return lines


def _observations(
    cell: CellFile, path: Path, images: Path | None, pair: tuple[Path, Path] | None, frames: int, ask: bool
) -> tuple[CameraImages, CameraImages | None]:
    """Images before a motion and, for live cameras if ``ask`` is set, after it."""
    if images is not None:
        return _folder(cell, images, frames), None
    if pair is not None:
        return _pair(cell, pair, "--pair"), None
    running = daemon_info(cell_directories(cell.cell.name))
    if running is not None:
        raise LearnError(
            "running", f"cell {cell.cell.name!r} is live and has its cameras; end its daemon, or give --images"
        )
    before = _take_frames(cell, path, frames)
    if not ask:
        return before, None
    print("Move the last joint alone by 10° or more, keep all else still, then press Enter.", file=sys.stderr)
    if not sys.stdin.readline():
        raise LearnError("input", "nobody pressed Enter: the input is closed")
    return before, _take_frames(cell, path, frames)


def _pair(cell: CellFile, files: tuple[Path, Path], option: str) -> CameraImages:
    if len(cell.camera) < 2:
        raise LearnError("argument", f"{option}: the cell file has {len(cell.camera)} camera; two are needed")
    return {camera.name: [_read(file)] for camera, file in zip(cell.camera, files, strict=False)}


def _folder(cell: CellFile, folder: Path, frames: int) -> CameraImages:
    if not folder.is_dir():
        raise LearnError("images", f"{folder} is no folder")
    views: CameraImages = {}
    for camera in cell.camera:
        stills = sorted(
            file
            for file in folder.iterdir()
            if file.suffix.lower() in SUFFIXES and (file.stem == camera.name or file.stem.startswith(f"{camera.name}_"))
        )
        video = folder / f"{camera.name}.avi"
        if stills:
            views[camera.name] = [_read(file) for file in stills[:frames]]
        elif video.exists():
            with ImageReader(video, camera.name) as reader:
                views[camera.name] = [frame.image for frame, _ in zip(reader, range(frames), strict=False)]
        else:
            raise LearnError(
                "images",
                f"{folder}: no {camera.name}.png, {camera.name}_*.png or {camera.name}.avi of camera {camera.name!r}",
            )
    return views


def _read(file: Path) -> ImageArray:
    if not file.is_file():
        raise LearnError("images", f"{file}: there is no such file")
    size = file.stat().st_size
    if size > LARGEST_PICTURE:
        raise LearnError("images", f"{file} has {size} bytes; pictures of at most {LARGEST_PICTURE} are read")
    data = np.fromfile(file, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if image is None:
        raise LearnError("images", f"{file} is no picture that can be read ({len(data)} bytes)")
    return np.asarray(image, dtype=np.uint8)


def _take_frames(cell: CellFile, path: Path, frames: int) -> CameraImages:
    """Frames of the cell's own cameras, through their drivers. Raises DriverError, PluginError."""
    opened: dict[str, CameraDriver] = {}
    views: CameraImages = {camera.name: [] for camera in cell.camera}
    try:
        for camera in cell.camera:
            context = DriverContext(
                clock=MonotonicClock(),
                cell=cell.cell.name,
                runtime_dir=path.parent,
                cell_dir=path.parent,
                camera=camera.name,
                mount=camera.mount,
            )
            driver: CameraDriver = plugins.load(plugins.CAMERA_DRIVERS, camera.driver)(camera.options, context)
            opened[camera.name] = driver
            driver.configure()
            driver.activate()
        until = time.monotonic() + PATIENCE_S
        while short := [name for name, seen in views.items() if len(seen) < frames]:
            if time.monotonic() > until:
                raise DriverError(
                    "silent", f"camera {short[0]!r} gave {len(views[short[0]])} of {frames} frames in {PATIENCE_S:g} s"
                )
            for name in short:
                _take(name, opened[name].poll(), views[name], frames)
            time.sleep(0.005)
    finally:
        for driver in opened.values():
            driver.close()
    return views


def _take(name: str, arrived: Sequence[Any], seen: list[ImageArray], frames: int) -> None:
    for frame in arrived:
        if not isinstance(frame, Frame):
            raise DriverError("no_images", f"camera {name!r} delivers observations; landmarks need its images")
        if len(seen) < frames:
            seen.append(np.array(frame.image))


def _write_picture(path: Path, drawn: ImageArray) -> None:
    encoded, data = cv2.imencode(path.suffix, drawn)
    if not encoded:
        raise LearnError("picture", f"{path}: cannot be written as {path.suffix}")
    _write(path, data.tobytes())


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically. Raises OSError."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_bytes(data)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
