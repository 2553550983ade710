"""``stereoservo print-plate OUT``: faces of dots and tags, to scale."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any
from xml.sax.saxutils import escape

import typer

from stereoservo_drivers.plates import (
    SMALLEST_CELL_PX,
    SMALLEST_DOT_PX,
    Box,
    Disc,
    DotPlates,
    Line,
    Page,
    Plate,
    PlateError,
    Polarity,
    TagPlates,
    Text,
    faces_named,
    lay_out,
    paper_named,
    tags_named,
)


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
        below += [
            f"dots of {2 * dots.millimetres[0].radius:g} mm: {dots.dot_px_range}",
            *_short(dots.cell_lines()),
        ]
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
    """Cell file lines short enough to be printed below a plate; long ones are shown on the terminal only."""
    if len(lines) > 4:
        return [lines[0], "detector_options: as `stereoservo print-plate` wrote them"]
    return lines


# -- files ---------------------------------------------------------------------------------------------------
# Pages of plates as SVG (one file a page) and as PDF (all in one), to scale.


HAIRLINE = 0.15
"""Width of lines [mm]."""
DASH = (1.2, 0.8)
MM = 72.0 / 25.4
"""Points in a millimetre."""


def svg_text(page: Page) -> str:
    """One page as SVG 1.1, user units of one millimetre."""
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

    # Text as text; without the date, the same plate is the same file.
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
                        axes.add_patch(
                            Rectangle((x, y), width, height, fc=str(1.0 - ink), lw=0, zorder=order)
                        )
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
    """Write ``pages`` to ``path``: ``.pdf`` in one file, ``.svg`` in one a page (NAME-1.svg, ... where there are more).

    Raises PlateError: ``format``, ``exists`` without ``force``, ``file`` where it cannot be written.
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
            "exists",
            f"{', '.join(there)}: exists already; another name, or --force to write over it",
            path=there,
        )
    if kind == ".pdf":
        _replace(path, lambda part: write_pdf(pages, part))
    else:
        for one, page in zip(paths, pages, strict=True):
            text = svg_text(page)
            _replace(one, lambda part, text=text: part.write_text(text, encoding="utf-8"))  # type: ignore[misc]
    return paths


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write beside ``path`` and rename, such that the file is always complete."""
    part = path.with_name(f".{path.name}.part")
    try:
        write(part)
        os.replace(part, path)
    except OSError as error:
        raise PlateError(
            "file",
            f"{path}: {error.strerror}; give a file in a folder that can be written to",
            path=str(path),
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
