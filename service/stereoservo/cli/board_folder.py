"""Folders with a board (`board.json`), pictures and poses of the hand, for ``examine``: docs/recordings.md."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.calibration.examination.board_examination import PLACES, BoardReport, Finding, examine_board
from stereoservo.calibration.examination.hand_eye_fit import BoardViews
from stereoservo.cli.output import CommandError, log
from stereoservo.messages.cell_file import Mount
from stereoservo.messages.decoding import cause_of
from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import Detector, DriverContext, Frame
from stereoservo.ports.number_files import NumberFileError, read_tree
from stereoservo.ports.pose_files import (
    PoseFileError,
    board_poses,
    numbers_of,
    picture_sets,
    pose_paths,
    read_poses,
)

BOARD = "board.json"
COLOURED = 60
"""Difference of the channels [grey levels] from which a pixel is coloured: boards are printed in black and white."""
COVERED = 0.05
"""Share of the corners on coloured pixels from which a picture counts as drawn over."""


class Board(msgspec.Struct, frozen=True):
    """``board.json``: ``rows`` and ``cols`` are inner corners of a chessboard, squares of a ChArUco board; ``square_m``
    is the side of a square, or of the tag [m]. ``mount``: of the camera, if it is known.
    """

    type: Literal["chessboard", "charuco", "aruco"]
    square_m: Annotated[float, Meta(gt=0)]
    rows: Annotated[int, Meta(ge=1, le=65)] = 1
    cols: Annotated[int, Meta(ge=1, le=65)] = 1
    marker_m: float | None = None
    dictionary: str = "4x4_50"
    tags: tuple[int, ...] = (0,)
    mount: Mount | None = None

    @property
    def corners(self) -> tuple[int, int]:
        """Numbers of inner corners along a row and down a column."""
        return (self.cols - 1, self.rows - 1) if self.type == "charuco" else (self.cols, self.rows)

    @property
    def ordered(self) -> bool:
        """Whether the pattern tells both ends of the board apart in every picture."""
        return self.type == "aruco" or (self.type == "chessboard" and sum(self.corners) % 2 == 1)

    @property
    def layout(self) -> FloatArray:
        """Positions (m, 3) [m] of the markers, in the order of their ids."""
        if self.type == "aruco":
            return np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]) * self.square_m
        columns, rows = self.corners
        return np.array([[i % columns, i // columns, 0.0] for i in range(columns * rows)]) * self.square_m

    @property
    def first_id(self) -> int:
        """Id of the first marker; the others follow."""
        return 4 * self.tags[0] if self.type == "aruco" else 0

    def detector(self) -> Detector:
        """The detector of the board's corners. Raises what the plug-in raises for wrong options."""
        name = "aruco"
        options: dict[str, Any] = {"tags": self.tags[:1], "dictionary": self.dictionary}
        if self.type != "aruco":
            name = "chessboard"
            options = {"columns": self.corners[0], "rows": self.corners[1], "thorough": True}
            if self.type == "charuco":
                options |= {
                    "dictionary": self.dictionary,
                    "marker_share": (self.marker_m or 0.75 * self.square_m) / self.square_m,
                }
        context = DriverContext(MonotonicClock(), "examine", Path(), Path(), camera="camera")
        made: Detector = plugins.load(plugins.DETECTORS, name)(options, context)
        return made


def read_board(folder: Path) -> Board:
    """The board of a folder. Raises CommandError naming what would be valid."""
    try:
        return msgspec.convert(read_tree(folder / BOARD), Board, strict=False)
    except (NumberFileError, msgspec.ValidationError) as error:
        raise CommandError(
            "dataset",
            f"{folder / BOARD}: {cause_of(error)}; valid is "
            '{"type": "chessboard", "cols": 9, "rows": 6, "square_m": 0.025}, '
            "with type chessboard, charuco (marker_m, dictionary) or aruco (tags, dictionary)",
        ) from error


def examine_board_folder(folder: Path, poses: Path | None = None, pose_format: str = "") -> BoardReport:
    """The report on a folder of one camera's pictures of a board, and ``poses`` of any ``pose_format``.

    Raises CommandError, CalibrationError.
    """
    board = read_board(folder)
    [paths] = picture_sets(folder).values()
    names = [path.name for path in paths]
    pixels, size, drawn = _all_corners(paths, board)
    try:
        motion = board_poses(pixels, board.layout[:, :2], size)
        read = read_poses(pose_paths(folder, poses), names, motion, pose_format)
    except PoseFileError as error:
        raise CommandError("dataset", str(error)) from error
    order = np.argsort(read.pictures)
    shown = read.pictures[order]
    numbers = numbers_of([path.stem for path in paths]) or range(len(paths))
    labels = tuple(str(numbers[k]) for k in shown)
    report = examine_board(
        BoardViews(labels, read.poses[order], board.layout, pixels[None, shown], np.array([size])),
        board.mount,
        board.ordered,
    )
    covered = [str(numbers[k]) for k in drawn]
    findings = (
        []
        if not drawn
        else [
            Finding(
                "drawings",
                ",".join(covered),
                f"views {', '.join(covered)}: coloured drawings cover the corners; they were painted over, the "
                "corners are uncertain",
                "keep the pictures as the camera takes them, without detections drawn in",
                len(drawn),
            )
        ]
    )
    notes = (*map(str, read.findings), *report.notes)
    return msgspec.structs.replace(report, findings=(*findings, *report.findings), notes=notes)


def _all_corners(paths: list[Path], board: Board) -> tuple[FloatArray, tuple[int, int], list[int]]:
    """Pixels (s, m, 2) of the board in pictures, their size, and which were drawn over. Raises CommandError."""
    detector = board.detector()
    pixels = np.full((len(paths), len(board.layout), 2), np.nan)
    size: tuple[int, int] | None = None
    drawn = []
    for k, path in enumerate(paths):
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            continue
        shape = image.shape[1], image.shape[0]
        if size not in (None, shape):
            raise CommandError("dataset", f"{path} is {shape} px, others {size}; one camera has one size")
        size = shape
        pixels[k], covered = _corners(detector, image, board)
        if covered:
            drawn.append(k)
    if size is None:
        raise CommandError("dataset", f"{paths[0].parent} holds no picture that OpenCV reads")
    found = int(np.isfinite(pixels[:, :, 0]).any(axis=1).sum())
    log(f"the board is found in {found} of {len(paths)} pictures")
    return pixels, size, drawn


def _corners(detector: Detector, image: ImageArray, board: Board) -> tuple[FloatArray, bool]:
    """Pixels (m, 2) of a colour picture (h, w, 3), NaN if not seen, and whether drawings had to be painted over."""
    coloured = np.ptp(image.astype(np.int16), axis=2) > COLOURED
    mask = cv2.dilate(coloured.astype(np.uint8), np.ones((3, 3), dtype=np.uint8))
    plain = _detected(detector, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), board)
    seen = np.isfinite(plain[:, 0])
    u, v = np.clip(np.round(plain[seen]), 0, np.array(mask.shape[::-1]) - 1).astype(int).T
    if not mask.any() or (seen.any() and mask[v, u].mean() < COVERED):
        return plain, False
    painted = cv2.cvtColor(cv2.inpaint(image, mask, 3, cv2.INPAINT_TELEA), cv2.COLOR_BGR2GRAY)
    again = _detected(detector, painted, board)
    better = bool(np.isfinite(again).sum() >= max(1, np.isfinite(plain).sum()))
    return (again, True) if better else (plain, False)


def _detected(detector: Detector, gray: Any, board: Board) -> FloatArray:
    shown = detector.detect(Frame("camera", 0, 0, 0, gray), None)
    pixels = np.full((len(board.layout), 2), np.nan)
    pixels[shown.ids - board.first_id] = shown.pixels
    return pixels


def board_text(report: BoardReport) -> str:
    """A report on views of a board in words."""
    lines = []
    if report.mount is not None:
        lines.append(f"camera {PLACES[report.mount]} (log-odds {report.mount_odds:.0f} against the other mount)")
    for name, one in (("camera", report.camera), ("board", report.board)):
        if one is not None:
            hand = (name == "camera") == (report.mount == "eye_in_hand")
            lines.append(
                f"  {name} in the {'hand' if hand else 'base'}: "
                + _numbers(one.translation_mm, one.translation_deviation_mm, "mm")
                + ", rotation vector "
                + _numbers(one.rotation_deg, one.rotation_deviation_deg, "deg")
            )
    if report.intrinsics:
        lines.append("  " + ", ".join(f"{name} {v:.5g} ± {d:.2g}" for name, (v, d) in report.intrinsics.items()))
        lines.append(
            f"  errors: corners {report.corner_px:.2g} px, lens and board {report.smooth_px:.2g} px, "
            f"poses {report.pose_deg:.2g} deg and {report.pose_mm:.2g} mm; {report.used} of {report.views} views"
        )
    if report.held_out_px:
        lines.append("  left-out views are predicted to " + " and ".join(f"{one:.2f} px" for one in report.held_out_px))
    lines += [f"* {one.message}. {one.remedy[:1].upper()}{one.remedy[1:]}" for one in report.findings] or [
        "nothing is wrong"
    ]
    lines += [f"  note: {one}" for one in report.notes]
    lines.append(f"(in a recording without a fault, something is named once in {1 / report.false_alarm:.0f})")
    return "\n".join(lines)


def _numbers(values: tuple[float, ...], deviations: tuple[float, ...], unit: str) -> str:
    return f"({', '.join(f'{v:.2f} ± {d:.2g}' for v, d in zip(values, deviations, strict=True))}) {unit}"
