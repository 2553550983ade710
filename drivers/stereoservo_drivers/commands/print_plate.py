"""``stereoservo print-plate OUT``: faces of dots and tags, to scale."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from stereoservo_drivers.plate_files import write_pages
from stereoservo_drivers.plates import (
    SMALLEST_CELL_PX,
    SMALLEST_DOT_PX,
    DotPlates,
    Plate,
    PlateError,
    Polarity,
    TagPlates,
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
