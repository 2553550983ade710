"""``stereoservo print-plate OUT``: faces of dots and tags, to scale."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal
from xml.sax.saxutils import escape

import numpy as np
import typer

from stereoservo.ports.dot_plates import FACES, DotFace
from stereoservo_drivers.detectors.tag_registration import DICTIONARIES, cells_along, size_of, tag_cells


def print_plate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write: NAME.pdf or NAME.svg.")],
    faces: Annotated[
        str | None, typer.Option(help="Faces of dots, by commas [default: a,b, unless --tags is given].")
    ] = None,
    dot_mm: Annotated[
        float | None, typer.Option(help="Diameter of a dot [mm]; the face grows with it [default: its own].")
    ] = None,
    spacing: Annotated[
        float | None, typer.Option(help="Between corner dots [mm] [default: in proportion to the dots].")
    ] = None,
    polarity: Annotated[str, typer.Option(help="light dots on black, or dark dots on white.")] = "light",
    tags: Annotated[str | None, typer.Option(help="Tags, e.g. 36h11:0-3,7 or 4x4_50:9.")] = None,
    tag_mm: Annotated[float, typer.Option(help="Side of a tag's black square [mm].")] = 50.0,
    page: Annotated[str, typer.Option(help="a4, a3, letter, or WIDTHxHEIGHT in mm.")] = "a4",
    force: Annotated[bool, typer.Option("--force", help="Write over files that exist.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Write marker plates to scale, with the lines for the cell file. Print at 100 %, then measure the bar."""
    paper = paper_named(page)
    plates: list[Plate] = []
    below: list[str] = []
    lines: list[str] = []
    answer: dict[str, Any] = {}
    with_dots = faces is not None or tags is None
    if not with_dots and (dot_mm is not None or spacing is not None):
        raise PlateError("option", "--dot-mm and --spacing are of faces of dots; give --faces beside --tags")
    if with_dots:
        dots = DotPlates(faces_named("a,b" if faces is None else faces), dot_mm, spacing, _polarity(polarity))
        plates += dots.plates()
        lines += dots.cell_lines()
        below += [f"dots of {2 * dots.millimetres[0].radius:g} mm: {dots.dot_px_range}", *_short(dots.cell_lines())]
        answer["faces"] = [
            {"name": f.name, "ids": list(f.ids), "dot_mm": 2 * f.radius, "side_mm": 2 * f.half_side}
            for f in dots.millimetres
        ]
        answer["smallest_dot_px"] = SMALLEST_DOT_PX
    if tags is not None:
        printed = TagPlates(*tags_named(tags), tag_mm)
        plates += printed.plates()
        lines += printed.cell_lines()
        below += _short(printed.cell_lines())
        answer["tags"] = [{"name": p.name, "ids": list(p.ids), "side_mm": p.side} for p in printed.plates()]
        answer["smallest_cell_px"] = SMALLEST_CELL_PX
    pages = lay_out(plates, paper, below)
    files = write_pages(pages, out, force=force)
    answer = {"files": [str(file) for file in files], "pages": len(pages), "cell": "\n".join(lines), **answer}
    if as_json:
        print(json.dumps(answer, allow_nan=False))
        return
    print(f"{', '.join(answer['files'])}: {len(pages)} page(s): {'; '.join(p.title for p in pages)}")
    print("For the cell file, in [[camera]]:\n\n" + answer["cell"])


def _polarity(text: str) -> Polarity:
    """Parse the polarity. Raises PlateError ``polarity``."""
    match text:
        case "light" | "dark":
            return text
    raise PlateError("polarity", f"polarity {text!r}; valid: light, dark", known=["light", "dark"])


def _short(lines: list[str]) -> list[str]:
    """Cell file lines short enough to be printed below a plate; longer ones are shown only on the terminal."""
    if len(lines) > 4:
        return [lines[0], "detector_options: as `stereoservo print-plate` wrote them"]
    return lines


# -- files ---------------------------------------------------------------------------------------------------
# Pages of plates as SVG (one file per page) and as PDF (all in one), to scale.


HAIRLINE = 0.15
"""Width of lines [mm]."""
DASH = (1.2, 0.8)
MM = 72.0 / 25.4
"""Points per millimetre."""


def svg_text(page: Page) -> str:
    """One page as SVG 1.1, with user units of one millimetre."""
    size = f"{page.width:g}", f"{page.height:g}"
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{size[0]}mm" height="{size[1]}mm" '
        f'viewBox="0 0 {size[0]} {size[1]}">',
        f"<title>{escape(page.title)}</title>",
        f'<rect width="{size[0]}" height="{size[1]}" fill="#ffffff"/>',
    ]
    return "\n".join([*lines, *(_svg(shape) for shape in page.shapes), "</svg>", ""])


def _svg(shape: Disc | Box | Line | Text) -> str:
    match shape:
        case Disc(x, y, radius, ink):
            return f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{radius:.4f}" fill="{_colour(ink)}"/>'
        case Box(x, y, width, height, ink):
            place = f'x="{x:.4f}" y="{y:.4f}" width="{width:.4f}" height="{height:.4f}"'
            return f'<rect {place} fill="{_colour(ink)}" shape-rendering="crispEdges"/>'
        case Line(x0, y0, x1, y1, dashed):
            dash = f' stroke-dasharray="{DASH[0]},{DASH[1]}"' if dashed else ""
            ends = f'x1="{x0:.4f}" y1="{y0:.4f}" x2="{x1:.4f}" y2="{y1:.4f}"'
            return f'<line {ends} stroke="#000000" stroke-width="{HAIRLINE}"{dash}/>'
        case Text(x, y, words, size):
            style = f'font-family="monospace" font-size="{size:g}"'
            return f'<text x="{x:.4f}" y="{y:.4f}" {style}>{escape(words)}</text>'


def _colour(ink: float) -> str:
    level = round(255 * (1.0 - ink))
    return f"#{level:02x}{level:02x}{level:02x}"


def write_pdf(pages: Sequence[Page], path: Path) -> None:
    """Write all pages into one PDF, vectors only. Raises OSError."""
    import matplotlib
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure
    from matplotlib.font_manager import FontProperties
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle, Rectangle
    from matplotlib.text import Text as Words

    # Text as text; without the date, the same plate yields the same file.
    with matplotlib.rc_context({"pdf.fonttype": 42}), PdfPages(path, metadata={"CreationDate": None}) as pdf:
        for page in pages:
            figure = Figure(figsize=(page.width / 25.4, page.height / 25.4))
            axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
            axes.set_xlim(0.0, page.width)
            axes.set_ylim(page.height, 0.0)
            axes.axis("off")
            for order, shape in enumerate(page.shapes):
                match shape:
                    case Disc(x, y, radius, ink):
                        axes.add_patch(Circle((x, y), radius, fc=str(1.0 - ink), lw=0, zorder=order))
                    case Box(x, y, width, height, ink):
                        axes.add_patch(Rectangle((x, y), width, height, fc=str(1.0 - ink), lw=0, zorder=order))
                    case Line(x0, y0, x1, y1, dashed):
                        style = (0, (DASH[0] / HAIRLINE, DASH[1] / HAIRLINE)) if dashed else "-"
                        line = Line2D([x0, x1], [y0, y1], lw=HAIRLINE * MM, color="0", ls=style, zorder=order)
                        line.set_solid_capstyle("butt")
                        axes.add_line(line)
                    case Text(x, y, words, size):
                        font = FontProperties(family="monospace", size=size * MM)
                        words_at = Words(x, y, words, fontproperties=font, zorder=order, parse_math=False)
                        axes.add_artist(words_at)
            pdf.savefig(figure)


def write_pages(pages: Sequence[Page], path: Path, *, force: bool = False) -> list[Path]:
    """Write ``pages`` to ``path``: ``.pdf`` in one file, ``.svg`` in one per page (NAME-1.svg, ... if there are
    several).

    Raises PlateError: ``format``, ``exists`` without ``force``, ``file`` if it cannot be written.
    """
    kind = path.suffix.lower()
    if kind not in (".svg", ".pdf"):
        raise PlateError("format", f"{str(path)!r}: valid: a name that ends in .svg or .pdf", path=str(path))
    paths = [path]
    if kind == ".svg" and len(pages) > 1:
        paths = [path.with_name(f"{path.stem}-{k + 1}{path.suffix}") for k in range(len(pages))]
    there = [str(one) for one in paths if one.exists()]
    if there and not force:
        raise PlateError(
            "exists", f"{', '.join(there)}: exists already; another name, or --force to write over it", path=there
        )
    if kind == ".pdf":
        _replace(path, lambda part: write_pdf(pages, part))
    else:
        for one, page in zip(paths, pages, strict=True):
            text = svg_text(page)
            _replace(one, lambda part, text=text: part.write_text(text, encoding="utf-8"))  # type: ignore[misc]
    return paths


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write beside ``path`` and rename, so that the file is always complete."""
    part = path.with_name(f".{path.name}.part")
    try:
        write(part)
        os.replace(part, path)
    except OSError as error:
        raise PlateError(
            "file", f"{path}: {error.strerror}; give a file in a folder that can be written to", path=str(path)
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


# -- layout --------------------------------------------------------------------------------------------------
# Layout of marker plates for printing: faces of dots and tags on pages [mm], with cutting, folding and scale marks.
#
# Page coordinates: origin at the top left, x right, y down [mm]. Pages are written by `commands.print_plate`.


Polarity = Literal["light", "dark"]
PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height [mm] of the named paper sizes."""
BORDER = 8.0
"""Margin on each side of a page [mm]: many printers cannot reach it."""
HEADER, BAR = 16.0, 11.0
"""Heights of the heading, of the scale bar and of a line below [mm]."""
LINE = 3.4
TEXT = 2.6
BAR_MM = 100.0
MARK = 5.0
"""Length of a cutting mark, and its distance from the cut plate [mm]."""
CLEARANCE = 1.5
LEAST_DOT_MM, LEAST_TAG_MM = 2.0, 5.0
SMALLEST_DOT_PX = 6.0
"""Diameter [px] from which `dots` acquires faces reliably: 99.7 % of dots at 6 px, 89 % at 5, 11 % at 4 (noise of 2
grey levels, tilts to 30 degrees; further tilt foreshortens).
"""
SMALLEST_CELL_PX = 2.5
"""Cell [px] from which `aruco` reads tags reliably."""
LEAST_GAP = 0.5
"""Least black distance between two dots [diameters]."""


class PlateError(Exception):
    """A plate cannot be printed as requested. ``code`` is stable; the text has cause, value, and valid values."""

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data


@dataclass(frozen=True)
class Disc:
    """A filled circle [mm]; ``ink`` 0 is the paper's white, 1 black."""

    x: float
    y: float
    radius: float
    ink: float


@dataclass(frozen=True)
class Box:
    """A filled rectangle [mm] by its top left corner."""

    x: float
    y: float
    width: float
    height: float
    ink: float = 1.0


@dataclass(frozen=True)
class Line:
    """A hairline [mm]; dashed for a fold."""

    x0: float
    y0: float
    x1: float
    y1: float
    dashed: bool = False


@dataclass(frozen=True)
class Text:
    """A line of text by the left end of its base line [mm]."""

    x: float
    y: float
    words: str
    size: float = TEXT


@dataclass(frozen=True)
class Page:
    """Content of one sheet, lowest first; ``title`` names it."""

    width: float
    height: float
    title: str
    shapes: tuple[Disc | Box | Line | Text, ...]


@dataclass(frozen=True)
class Plate:
    """A square to cut out: ``side`` [mm], the shapes drawn on it relative to its top left corner, name and ids.

    ``joins``: whether plates of this kind share an edge, to be folded.
    """

    name: str
    ids: tuple[int, ...]
    side: float
    shapes: tuple[Disc | Box, ...]
    joins: bool


@dataclass(frozen=True)
class DotPlates:
    """Faces of dots to print. ``dot_mm``: diameter; ``spacing_mm``: between corner dots, default in proportion."""

    faces: tuple[DotFace, ...]
    dot_mm: float | None = None
    spacing_mm: float | None = None
    polarity: Polarity = "light"
    millimetres: tuple[DotFace, ...] = field(init=False)
    """The faces in their printed size, all lengths in millimetres."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "millimetres", tuple(self._scaled(face) for face in self.faces))

    def _scaled(self, face: DotFace) -> DotFace:
        """A face at the printed scale [mm]. Raises PlateError ``dot_size``, ``spacing``."""
        spacing = float(np.linalg.norm(face.positions[1] - face.positions[0]))
        nearest = _nearest(face)
        dot = self.dot_mm
        if dot is None:
            dot = 2000.0 * face.radius * (1.0 if self.spacing_mm is None else self.spacing_mm / (1e3 * spacing))
        if not LEAST_DOT_MM <= dot < np.inf:
            raise PlateError(
                "dot_size",
                f"dots of {dot:g} mm; valid: {LEAST_DOT_MM:g} mm and more. The detector needs {SMALLEST_DOT_PX:g} px "
                f"across a dot as the camera sees it; {_range(LEAST_DOT_MM)}",
                dot_mm=dot,
            )
        scale = (1e3 if self.spacing_mm is None else self.spacing_mm / spacing) * (
            1.0 if self.spacing_mm is not None else dot / (2e3 * face.radius)
        )
        least = (1.0 + LEAST_GAP) * dot / nearest * spacing
        if not (scale * spacing >= least * (1.0 - 1e-9)):
            raise PlateError(
                "spacing",
                f"face {face.name!r}: {scale * spacing:g} mm between the corner dots; valid for dots of {dot:g} mm: "
                f"{np.ceil(10 * least) / 10:g} mm and more",
                spacing_mm=scale * spacing,
                least_mm=least,
            )
        margin = (face.half_side - np.abs(face.positions).max() - face.radius) / (2.0 * face.radius)
        positions = face.positions * scale
        half = float(np.abs(positions).max() + dot / 2 + margin * dot)
        return DotFace(face.name, face.ids, positions, dot / 2, half)

    @property
    def dot_px_range(self) -> str:
        """Text: distance at which the smallest dots can still be detected."""
        return _range(2.0 * min(face.radius for face in self.millimetres))

    @property
    def in_proportion(self) -> bool:
        """Whether dots and faces are scaled alike, so that the detector's patterns are unchanged."""
        return self.spacing_mm is None or all(
            abs(mm.radius / one.radius - mm.positions[1, 0] / one.positions[1, 0]) < 1e-6 * mm.radius / one.radius
            for mm, one in zip(self.millimetres, self.faces, strict=True)
        )

    def plates(self) -> list[Plate]:
        """The plates to cut out."""
        ground, dot = (1.0, 0.0) if self.polarity == "light" else (0.0, 1.0)
        found = []
        for face in self.millimetres:
            side = 2.0 * face.half_side
            discs = [Disc(x, y, face.radius, dot) for x, y in (face.positions + face.half_side).tolist()]
            found.append(Plate(f"face {face.name}", face.ids, side, (Box(0, 0, side, side, ground), *discs), True))
        return found

    def cell_lines(self) -> list[str]:
        """Lines of a cell file, below ``[[camera]]``, that describe the plates."""
        options = ['polarity = "dark"'] if self.polarity == "dark" else []
        names = [face.name for face in self.faces]
        tables: list[str] = []
        if names != ["a", "b"] or not self.in_proportion:
            for face in self.millimetres:
                tables += [
                    "[[camera.detector_options.faces]]",
                    f'name = "{face.name}"',
                    f"ids = {list(face.ids)}",
                    f"positions = {np.round(face.positions, 4).tolist()}",
                    f"radius = {face.radius:g}",
                ]
        lines = ['detector = "dots"']
        if options and tables:
            lines += ["[camera.detector_options]", *options]
        elif options:
            lines.append("detector_options = { " + ", ".join(options) + " }")
        return lines + tables


@dataclass(frozen=True)
class TagPlates:
    """Tags to print; ``tag_mm``: side of the black square."""

    dictionary: str
    tags: tuple[int, ...]
    tag_mm: float = 50.0

    def plates(self) -> list[Plate]:
        """The plates to cut out, a white cell about each tag. Raises PlateError ``tag_size``."""
        if not LEAST_TAG_MM <= self.tag_mm < np.inf:
            raise PlateError(
                "tag_size", f"tags of {self.tag_mm:g} mm; valid: {LEAST_TAG_MM:g} mm and more", tag_mm=self.tag_mm
            )
        cell = self.tag_mm / cells_along(self.dictionary)
        found = []
        for tag in self.tags:
            cells = tag_cells(self.dictionary, tag)
            boxes = [
                Box((1 + first) * cell, (1 + j) * cell, (last - first) * cell, cell)
                for j, row in enumerate(cells)
                for first, last in _runs(row)
            ]
            ids = tuple(4 * tag + c for c in range(4))
            side = self.tag_mm + 2 * cell
            found.append(Plate(f"tag {self.dictionary}:{tag}", ids, side, tuple(boxes), False))
        return found

    def cell_lines(self) -> list[str]:
        """Lines of a cell file, below ``[[camera]]``, that describe the tags."""
        return [
            'detector = "aruco"',
            f'detector_options = {{ dictionary = "{self.dictionary}", tags = {list(self.tags)} }}',
        ]


def faces_named(text: str) -> tuple[DotFace, ...]:
    """Parse faces from ``a,b``. Raises PlateError ``face``."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in FACES]
    if not names or unknown or len(set(names)) < len(names):
        raise PlateError(
            "face",
            f"faces {text!r}: {_which(unknown) if unknown else 'none, or one twice'}; "
            f"valid: different ones of {', '.join(FACES)}, by commas",
            known=list(FACES),
        )
    return tuple(FACES[name] for name in names)


def tags_named(text: str) -> tuple[str, tuple[int, ...]]:
    """Parse dictionary and tags from ``36h11:0-3,7``. Raises PlateError ``tags``."""
    name, colon, numbers = text.partition(":")
    name = name.strip().lower()
    if name not in DICTIONARIES or not colon:
        raise PlateError(
            "tags",
            f"tags {text!r}; valid: DICTIONARY:IDS like 36h11:0-3,7 with one of {', '.join(DICTIONARIES)}",
            known=list(DICTIONARIES),
        )
    count, tags = size_of(name), []
    for part in numbers.split(","):
        match = re.fullmatch(r"\s*(\d{1,6})\s*(?:-\s*(\d{1,6})\s*)?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if not 0 <= first <= last < count:
            raise PlateError(
                "tags",
                f"tags {text!r}: {part.strip()!r} is not in {name}; valid: ids 0 to {count - 1}, like 0-3,7",
                count=count,
            )
        tags += [tag for tag in range(first, last + 1) if tag not in tags]
    return name, tuple(tags)


def paper_named(text: str) -> tuple[float, float]:
    """Parse width and height [mm] from ``a4`` or ``200x300``. Raises PlateError ``page``."""
    if text.lower() in PAPERS:
        return PAPERS[text.lower()]
    match = re.fullmatch(r"(\d{1,5}(?:\.\d+)?)x(\d{1,5}(?:\.\d+)?)(?:mm)?", text.lower())
    size = (float(match[1]), float(match[2])) if match else (0.0, 0.0)
    least = BAR_MM + 2 * BORDER
    if not least <= min(size) <= max(size) <= 5000.0:
        raise PlateError(
            "page",
            f"page {text!r}; valid: {', '.join(PAPERS)}, or WIDTHxHEIGHT in mm like 200x300, "
            f"from {least:g} to 5000 mm a side",
            known=list(PAPERS),
        )
    return size


def lay_out(plates: Sequence[Plate], paper: tuple[float, float], below: Sequence[str]) -> list[Page]:
    """Pages with ``plates`` in order and the text lines ``below``, as many plates per page as fit.

    Raises PlateError ``too_large``.
    """
    width, height = paper
    footer = BAR + LINE * len(below)
    space = (width - 2 * BORDER - 2 * (MARK + CLEARANCE), height - 2 * BORDER - HEADER - footer - MARK - CLEARANCE)
    pages, rest = [], list(plates)
    while rest:
        first = rest[0]
        gap = 0.0 if first.joins else 2 * (MARK + CLEARANCE)
        across, down = (int((side + gap + 1e-6) // (first.side + gap)) for side in space)
        if across < 1 or down < 1:
            raise PlateError(
                "too_large",
                f"{first.name} is {first.side:.1f} mm wide; on {width:g} x {height:g} mm there is room for "
                f"{max(min(space), 0.0):.1f} mm: a larger --page or smaller dots or tags",
                side_mm=first.side,
                room_mm=min(space),
            )
        if first.joins:  # a strip, so that only neighbours share an edge
            across, down = (across, 1) if across > down else (1, down)
        here = [plate for plate in rest[: across * down] if plate.side == first.side and plate.joins == first.joins]
        here = here[: next((k for k, plate in enumerate(here) if plate is not rest[k]), len(here))]
        rest = rest[len(here) :]
        pages.append(_page(here, across, gap, paper, below))
    return pages


def _page(plates: Sequence[Plate], across: int, gap: float, paper: tuple[float, float], below: Sequence[str]) -> Page:
    width, height = paper
    side = plates[0].side
    title = ", ".join(plate.name for plate in plates)
    columns = min(across, len(plates))
    left = (width - columns * side - (columns - 1) * gap) / 2
    top = BORDER + HEADER
    shapes: list[Disc | Box | Line | Text] = [
        Text(BORDER, BORDER + 4.0, f"stereoservo: {title}", 3.6),
        Text(BORDER, BORDER + 8.0, "this side up ^  not mirrored: if you can read this, it is right; print at 100 %"),
    ]
    for k, plate in enumerate(plates):
        x, y = left + (k % across) * (side + gap), top + (k // across) * (side + gap)
        shapes += [_moved(shape, x, y) for shape in plate.shapes]
        if plate.joins and k:
            shapes += _fold(x, y, side, beside=across > 1)
        elif plate.joins:
            rows = -(-len(plates) // across)
            shapes += _marks(x, y, columns * side, rows * side)
        else:
            shapes += _marks(x, y, side, side)
        if not plate.joins:
            shapes.append(Text(x + side + 0.6, y + side - 0.4, plate.name.rpartition(":")[2], 1.8))
    foot = height - BORDER - BAR - LINE * len(below)
    shapes += _scale_bar(BORDER, foot)
    shapes += [Text(BORDER, foot + BAR + LINE * (k + 0.8), line) for k, line in enumerate(below)]
    return Page(width, height, title, tuple(shapes))


def _marks(x: float, y: float, width: float, height: float) -> list[Line]:
    """Cutting marks outside the corners."""
    marks = []
    for cx, sx in ((x, -1), (x + width, 1)):
        for cy, sy in ((y, -1), (y + height, 1)):
            marks.append(Line(cx + sx * CLEARANCE, cy, cx + sx * (CLEARANCE + MARK), cy))
            marks.append(Line(cx, cy + sy * CLEARANCE, cx, cy + sy * (CLEARANCE + MARK)))
    return marks


def _fold(x: float, y: float, side: float, *, beside: bool) -> list[Line | Text]:
    """Marks of the edge that a plate shares with the previous one."""
    if beside:
        ends = [(x, y - CLEARANCE, 0, -1), (x, y + side + CLEARANCE, 0, 1)]
    else:
        ends = [(x - CLEARANCE, y, -1, 0), (x + side + CLEARANCE, y, 1, 0)]
    marks: list[Line | Text] = [
        Line(a, b, a + u * (MARK + 2.0), b + v * (MARK + 2.0), dashed=True) for a, b, u, v in ends
    ]
    a, b, u, v = ends[-1]
    marks.append(Text(a + u * 0.5 + 0.8 * v, b + v * 4.0 - 0.8 * u, "fold", 2.0))
    return marks


def _scale_bar(x: float, y: float) -> list[Line | Text]:
    ticks = [Line(x + 10.0 * k, y, x + 10.0 * k, y + (3.0 if k % 5 == 0 else 1.5)) for k in range(11)]
    words = f"{BAR_MM:g} mm from end to end: check with a ruler"
    return [Line(x, y, x + BAR_MM, y), *ticks, Text(x, y + 6.5, words)]


def _moved(shape: Disc | Box, x: float, y: float) -> Disc | Box:
    if isinstance(shape, Disc):
        return Disc(shape.x + x, shape.y + y, shape.radius, shape.ink)
    return Box(shape.x + x, shape.y + y, shape.width, shape.height, shape.ink)


def _runs(row: Sequence[float] | np.ndarray[Any, Any]) -> list[tuple[int, int]]:
    """First cell, and one past the last, of each run of black cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(row) > 0.5, [0]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _nearest(face: DotFace) -> float:
    """Least distance of two dots [m]."""
    between = np.linalg.norm(face.positions[:, None] - face.positions[None], axis=2)
    return float(between[np.triu_indices(len(between), 1)].min())


def _range(dot_mm: float) -> str:
    return f"{dot_mm:g} mm is {SMALLEST_DOT_PX:g} px at {dot_mm / SMALLEST_DOT_PX:.2f} m from a lens of 1000 px"


def _which(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names) + (" is unknown" if len(names) == 1 else " are unknown")
