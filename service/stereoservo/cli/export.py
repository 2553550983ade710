"""Command ``stereoservo export``: writes a flight recording for Foxglove and Rerun, a calibrated model as URDF, or the
cameras of a rig for OpenCV, ROS and Kalibr.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereoservo.cli.output import CommandError, JsonOption, emit, note
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.denavit_hartenberg import KnownLength, ReadOutError
from stereoservo.kinematics.model import CellModel, load_model
from stereoservo.kinematics.urdf import metric_arm, urdf_text
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.recording.flight_export import export_flight

SAME = 1e-9
"""Relative error up to which a replay on another processor tells the same."""
WHATS = ("markers", "baseline", "prismatic", "a", "d")


def export(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A flight recording (*.mcap), a model (*.json) for --urdf; or cameras: a rig of `calibrate --rig`, or a "
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
        typer.Option(
            "--cell", metavar="FILE", help="Cell file whose safety.limit are the joints' in the URDF."
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
    """Write a recording for Foxglove and Rerun, which still replays bit for bit; a fitted metric model as URDF; or
    cameras for OpenCV, ROS and Kalibr.

    Pictures in NAME.images beside a recording go with it. A URDF has the joints, and markers and cameras as links.
    """
    if opencv is not None or ros is not None or kalibr is not None:
        _export_cameras(file, opencv, ros, kalibr, json)
        return
    if file.suffix == ".json":
        if urdf is None:
            raise CommandError("usage", f"{file} is a model: --urdf FILE says where to write it to")
        _export_model(file, urdf, length, cell, json)
    elif urdf is not None:
        raise CommandError("usage", f"--urdf is for a model (*.json); {file} is none")
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


def _export_model(model: Path, urdf: Path, length: str, cell: Path | None, json: bool) -> None:
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
