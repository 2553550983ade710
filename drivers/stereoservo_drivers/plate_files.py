"""Pages of plates as SVG (one file a page) and as PDF (all in one), to scale."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

from stereoservo_drivers.plates import Box, Disc, Line, Page, PlateError, Text

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
