"""Folders with a board (`board.json`), pictures and poses of the hand, for ``examine``: docs/recordings.md."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.calibration.examination.board_examination import PLACES, BoardReport, Finding
from stereoservo.calibration.examination.hand_eye_fit import BoardViews
from stereoservo.cli.output import CommandError, log
from stereoservo.messages.cell_file import Mount
from stereoservo.messages.decoding import cause_of
from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import Detector, DriverContext, Frame

BOARD, PICTURES = "board.json", "images"
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
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
        return msgspec.json.decode((folder / BOARD).read_bytes(), type=Board)
    except (OSError, msgspec.DecodeError) as error:
        raise CommandError(
            "dataset",
            f"{folder / BOARD}: {cause_of(error)}; valid is "
            '{"type": "chessboard", "cols": 9, "rows": 6, "square_m": 0.025}, '
            "with type chessboard, charuco (marker_m, dictionary) or aruco (tags, dictionary)",
        ) from error


def board_views(folder: Path, board: Board, numbers: list[int], poses: FloatArray) -> tuple[BoardViews, list[Finding]]:
    """The views of a folder at hand ``poses`` (s, 4, 4), of the pictures with ``numbers`` (s,); views that were drawn
    over are named. Raises CommandError.
    """
    files = _pictures(folder, numbers)
    detector, layout = board.detector(), board.layout
    pixels = np.full((1, len(files), len(layout), 2), np.nan)
    size, drawn = None, []
    for k, path in enumerate(files):
        image = None if path is None else cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            continue
        if size is not None and size != image.shape[1::-1]:
            raise CommandError("dataset", f"{path} is {image.shape[1::-1]} px, others {size}; one camera has one size")
        size = image.shape[1::-1]
        pixels[0, k], covered = _corners(detector, image, len(layout))
        if covered:
            drawn.append(str(numbers[k]))
    if size is None:
        raise CommandError("dataset", f"{folder / PICTURES} holds no picture that OpenCV reads for any of the poses")
    found = int(np.isfinite(pixels[0, :, :, 0]).any(axis=1).sum())
    log(f"the board is found in {found} of {len(files)} pictures")
    findings = [] if not drawn else [Finding(
        "drawings", ",".join(drawn),
        f"views {', '.join(drawn)}: coloured drawings cover the corners, which are uncertain: they were painted over",
        "keep the pictures as the camera takes them, without detections drawn in", len(drawn),
    )]  # fmt: skip
    return BoardViews(tuple(map(str, numbers)), poses, layout, pixels, np.array([size])), findings


def _corners(detector: Detector, image: ImageArray, count: int) -> tuple[FloatArray, bool]:
    """Pixels (count, 2) of a colour picture (h, w, 3), NaN if not seen, and whether drawings had to be painted over."""
    coloured = np.ptp(image.astype(np.int16), axis=2) > COLOURED
    mask = cv2.dilate(coloured.astype(np.uint8), np.ones((3, 3), dtype=np.uint8))
    plain = _detected(detector, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), count)
    seen = np.isfinite(plain[:, 0])
    u, v = np.clip(np.round(plain[seen]), 0, np.array(mask.shape[::-1]) - 1).astype(int).T
    if not mask.any() or (seen.any() and mask[v, u].mean() < COVERED):
        return plain, False
    painted = cv2.cvtColor(cv2.inpaint(image, mask, 3, cv2.INPAINT_TELEA), cv2.COLOR_BGR2GRAY)
    again = _detected(detector, painted, count)
    better = bool(np.isfinite(again).sum() >= max(1, np.isfinite(plain).sum()))
    return (again, True) if better else (plain, False)


def _detected(detector: Detector, gray: Any, count: int) -> FloatArray:
    shown = detector.detect(Frame("camera", 0, 0, 0, gray), None)
    pixels = np.full((count, 2), np.nan)
    pixels[shown.ids] = shown.pixels
    return pixels


def _pictures(folder: Path, numbers: list[int]) -> list[Path | None]:
    """Picture of each pose: the one with its number in the name."""
    files = sorted(path for path in (folder / PICTURES).glob("*") if path.suffix.lower() in SUFFIXES)
    found = {int(digits[-1]): path for path in files if (digits := re.findall(r"\d+", path.stem))}
    if not set(numbers) & set(found):
        raise CommandError(
            "dataset",
            f"{folder / PICTURES} has {len(files)} pictures, none with a number of poses.csv ({numbers[0]} to "
            f"{numbers[-1]}) in its name; 000.png, 001.png are valid",
        )
    return [found.get(number) for number in numbers]


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
                + ", rotation vector " + _numbers(one.rotation_deg, one.rotation_deviation_deg, "deg")
            )  # fmt: skip
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
