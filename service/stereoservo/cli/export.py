"""Command ``stereoservo export``: writes a calibrated model for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereoservo.cli.output import CommandError, JsonOption, emit
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.denavit_hartenberg import KnownLength, ReadOutError
from stereoservo.kinematics.model import CellModel, load_model
from stereoservo.kinematics.urdf import metric_arm, urdf_text
from stereoservo.messages.cell_file import load_cell_file

WHATS = ("markers", "baseline", "prismatic", "a", "d")


def export(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A model file (*.json) of a metric model.")],
    urdf: Annotated[Path, typer.Option("--urdf", metavar="FILE", help="The URDF file to write.")],
    length: Annotated[
        str,
        typer.Option(
            "--length",
            metavar="WHAT:OF=METRES",
            help="The known length: markers:10,11=0.05 (two ids), baseline:left,right=0.2 (two cameras), "
            "a:JOINT=METRES or d:JOINT=METRES (of its Denavit-Hartenberg row), "
            "prismatic:JOINT=1 (the default where a joint slides).",
        ),
    ] = "",
    cell: Annotated[
        Path | None,
        typer.Option("--cell", metavar="FILE", help="Cell file whose safety.limit are the joints'."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write a fitted metric model as URDF: its joints, and markers and cameras as links."""
    found = load_model(model)
    limits = (
        {}
        if cell is None
        else {
            limit.joint: (limit.min, limit.max, limit.velocity) for limit in load_cell_file(cell).safety.limit
        }
    )
    known = _known_length(length, found)
    try:
        arm = metric_arm(found, known)
    except (ReadOutError, GeometryError) as error:
        raise CommandError(error.code, str(error)) from error
    urdf.write_text(urdf_text(found, arm, urdf.stem, limits))
    scales = dict(zip(found.joint_names, arm.scales.tolist(), strict=True))
    emit(
        {"urdf": str(urdf), "joints": list(found.joint_names), "position_scales": scales, "known": known},
        f"{urdf}: {len(found.joint_names)} joints, {len(found.marker_ids)} markers, {len(found.cameras)} cameras; "
        f"scaled by {known.what} of {', '.join(str(name) for name in known.of)}, {known.metres:g} m",
        json,
    )


def _known_length(text: str, model: CellModel) -> KnownLength:
    """The known length that ``text`` states; by default the unit of the first slide. Raises CommandError."""
    slides = [n for n, kind in zip(model.joint_names, model.joint_kinds, strict=True) if kind == "prismatic"]
    if not text and slides:
        return KnownLength("prismatic", (slides[0],), 1.0)
    what, _, rest = text.partition(":")
    of, _, metres = rest.rpartition("=")
    names = tuple(of.split(","))
    try:
        if what not in WHATS:
            raise ValueError(what)
        return KnownLength(what, tuple(int(n) for n in names) if what == "markers" else names, float(metres))  # type: ignore[arg-type]
    except ValueError as error:
        raise CommandError(
            "length",
            f"--length {text!r}: WHAT:OF=METRES is needed, one length of the model in metres, WHAT of "
            f"{', '.join(WHATS)}, e.g. markers:10,11=0.05"
            + ("" if text else "; turning joints alone leave the model's scale open"),
        ) from error
