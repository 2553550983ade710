"""Command ``stereoservo export``: writes a flight recording for Foxglove and Rerun, a calibrated model as URDF, or the
cameras of a rig for OpenCV, ROS and Kalibr.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from stereoservo.cli.output import CommandError, JsonOption, emit, note
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.denavit_hartenberg import DH_HEAD, ReadOutError, denavit_hartenberg, dh_cells
from stereoservo.kinematics.model import CellModel, load_model
from stereoservo.kinematics.urdf import metric_arm, urdf_text
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.known_length import KnownLength, known_length_of
from stereoservo.recording.flight_export import export_flight

if TYPE_CHECKING:
    from stereoservo.kinematics.inverse.recognition import Evidence

SAME = 1e-9
"""Relative error up to which a replay on another processor tells the same."""


def export(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A flight recording (*.mcap), a model (*.json); or cameras: a rig of `calibrate --rig`, or a "
            "file of OpenCV, ROS (or a folder of these) or Kalibr.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Of a recording: file to write (default: FILE.foxglove.mcap)."),
    ] = None,
    urdf: Annotated[
        Path | None, typer.Option("--urdf", metavar="FILE", help="Of a metric model: the URDF file to write.")
    ] = None,
    dh: Annotated[
        bool, typer.Option("--dh", help="Of a metric model: print its Denavit-Hartenberg parameters.")
    ] = False,
    length: Annotated[
        str,
        typer.Option(
            "--length",
            metavar="WHAT:OF=METRES",
            help="The known length: markers:10,11=0.05 (two ids), baseline:left,right=0.2 (two cameras), "
            "a:JOINT=METRES or d:JOINT=METRES (of its Denavit-Hartenberg row), "
            "prismatic:JOINT=1. Default: calibration.known_length of --cell, else the unit of a slide.",
        ),
    ] = "",
    cell: Annotated[
        Path | None,
        typer.Option(
            "--cell",
            metavar="FILE",
            help="Cell file: calibration.known_length, and safety.limit for the URDF.",
        ),
    ] = None,
    opencv: Annotated[
        Path | None,
        typer.Option("--opencv", metavar="FILE.yml", help="Of cameras: FileStorage YAML to write."),
    ] = None,
    ros: Annotated[
        Path | None,
        typer.Option("--ros", metavar="DIR", help="Of cameras: folder for a camera_info YAML of each."),
    ] = None,
    kalibr: Annotated[
        Path | None, typer.Option("--kalibr", metavar="FILE.yaml", help="Of cameras: Kalibr's camera chain.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write a recording for Foxglove and Rerun, which still replays bit for bit; a model's dimensions, or its URDF; or
    cameras for OpenCV, ROS and Kalibr.

    Pictures in NAME.images beside a recording go with it. A URDF has the joints, and markers and cameras as links.
    """
    if opencv is not None or ros is not None or kalibr is not None:
        _export_cameras(file, opencv, ros, kalibr, json)
        return
    if file.suffix == ".json":
        if urdf is None and not dh:
            raise CommandError(
                "usage",
                f"what to write of {file} is not said: of a model --urdf FILE or --dh, of cameras of `calibrate --rig` "
                "--opencv FILE.yml, --ros DIR or --kalibr FILE.yaml",
            )
        _export_model(file, urdf, dh, length, cell, json)
    elif urdf is not None or dh:
        raise CommandError("usage", f"--urdf and --dh are for a model (*.json); {file} is none")
    else:
        _export_flight(file, output if output is not None else file.with_suffix(".foxglove.mcap"), json)


def _export_cameras(
    file: Path, opencv: Path | None, ros: Path | None, kalibr: Path | None, json: bool
) -> None:
    from stereoservo.calibration.camera_rig import exchange  # OpenCV and YAML: for this alone
    from stereoservo.calibration.camera_rig.rig_calibration import load_rig

    cameras, unit = exchange.load_cameras(file) if file.suffix != ".json" else (), "m"
    if file.suffix == ".json":
        rig = load_rig(file)
        cameras, unit = rig.cameras, rig.unit
    if unit != "m":
        note(f"{file} holds no length in metres: translations are in baselines")
    written: list[str] = []
    if opencv is not None:
        exchange.save_opencv(cameras, opencv)
        written.append(str(opencv))
    if ros is not None:
        written += [str(path) for path in exchange.save_ros(cameras, ros)]
        if len(cameras) > 2:
            note("camera_info has no place for the poses of more than two cameras: they are left out")
    if kalibr is not None:
        exchange.save_kalibr(cameras, kalibr)
        written.append(str(kalibr))
    names = [camera.name for camera in cameras]
    emit(
        {"written": written, "cameras": names, "unit": unit},
        f"{', '.join(names)}: {', '.join(written)}",
        json,
    )


def _export_flight(file: Path, target: Path, json: bool) -> None:
    result = export_flight(file, target)
    if result.replay.identical is False:
        raise CommandError(
            "differs",
            f"{target} is written, but the replay that it is made from differs from the recording at step "
            f"{result.replay.first_difference}: joints and markers are those recorded, states and errors may not be",
        )
    error = result.replay.max_relative_error
    if error > SAME:
        note(
            f"the replay on this machine or version differs from the recording (largest relative error {error:.2g}): "
            "joints and markers are those recorded, states and errors those of the replay"
        )
    sizes = file.stat().st_size, target.stat().st_size
    lines = [f"{topic:32} {count} messages" for topic, count in sorted(result.messages.items())]
    lines.append(f"{target}: {sizes[1] / 1e6:.1f} MB, {sizes[1] / max(sizes[0], 1):.2f} times the recording")
    if result.incomplete:
        lines.append(f"up to where the recording breaks off: {result.incomplete}")
    figures = {
        "file": str(target),
        "identical": result.replay.identical,
        "max_relative_error": error,
        "steps": result.replay.steps,
        "messages": result.messages,
        "bytes": sizes[1],
        "recording_bytes": sizes[0],
        "incomplete": result.incomplete,
    }
    emit(figures, "\n".join(lines), json)


def _export_model(
    file: Path, urdf: Path | None, dh: bool, length: str, cell_path: Path | None, json: bool
) -> None:
    model = load_model(file)
    cell = None if cell_path is None else load_cell_file(cell_path)
    known = _known_length(length, model, cell)
    told: dict[str, Any] = {"joints": list(model.joint_names), "known": known}
    lines = [f"scaled by {known.what} of {', '.join(str(name) for name in known.of)}, {known.metres:g} m"]
    try:
        if dh:
            rows = denavit_hartenberg(model, known)
            told["denavit_hartenberg"] = msgspec.to_builtins(rows)
            lines += [" | ".join(cells) for cells in (DH_HEAD, *(dh_cells(row) for row in rows))]
            from stereoservo.kinematics.inverse.recognition import structure  # statistics: for this alone

            holds = structure(model)
            told["structure"] = [
                {**asdict(one), "joints": [model.joint_names[j] for j in one.joints]} for one in holds
            ]
            lines += [_words(one, model) for one in holds]
        if urdf is not None:
            arm = metric_arm(model, known)
            limits = () if cell is None else cell.safety.limit
            bounds = {limit.joint: (limit.min, limit.max, limit.velocity) for limit in limits}
            urdf.write_text(urdf_text(model, arm, urdf.stem, bounds))
            told["urdf"] = str(urdf)
            told["position_scales"] = dict(zip(model.joint_names, arm.scales.tolist(), strict=True))
            counts = f"{len(model.joint_names)} joints, {len(model.marker_ids)} markers, {len(model.cameras)} cameras"
            lines.append(f"{urdf}: {counts}")
    except (ReadOutError, GeometryError) as error:
        raise CommandError(error.code, str(error)) from error
    emit(told, "\n".join(lines), json)


def _words(one: Evidence, model: CellModel) -> str:
    """What holds of some axes within the model's covariance, in words."""
    *first, last = (model.joint_names[j] for j in one.joints)
    how = "are parallel" if one.condition == "parallel" else "meet in one point"
    held = (
        f"deviation {one.deviation:.1g}"
        if one.chi2 is None
        else f"chi-square {one.chi2:.1f} of {one.freedom}, up to {one.threshold:.1f}"
    )
    return f"axes of {', '.join(first)} and {last} {how}, by the model's covariance: {held}"


def _known_length(text: str, model: CellModel, cell: CellFile | None) -> KnownLength:
    """The known length that ``text`` or else the cell file states; by default the unit of the first slide. Raises
    CommandError.
    """
    if not text and cell is not None and cell.calibration is not None:
        text = cell.calibration.known_length
    slides = [n for n, kind in zip(model.joint_names, model.joint_kinds, strict=True) if kind == "prismatic"]
    if not text and slides:
        return KnownLength("prismatic", (slides[0],), 1.0)
    if not text:
        raise CommandError(
            "length",
            "turning joints alone leave the model's scale open: --length WHAT:OF=METRES is needed, markers:10,11=0.05 "
            "say, or calibration.known_length in the cell file and --cell FILE",
        )
    try:
        return known_length_of(text)
    except ValueError as error:
        raise CommandError("length", str(error)) from error
