"""Command ``stereoservo examine``: a recording of joints and pictures judged: cameras, joints, stamps, frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereoservo.calibration.examination.examination import RecordingReport, examine_views
from stereoservo.cli.examine.flight import read_flight
from stereoservo.cli.examine.folder import read_folder
from stereoservo.cli.output import CommandError, JsonOption, emit


def examine(
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET", help="A flight recording (*.mcap), or a folder: docs/recordings.md."
        ),
    ],
    json: JsonOption = False,
) -> None:
    """Judge a recording of joints and pictures: bumped cameras, drifted zeros, late stamps, dropped frames.

    Cameras and arm are learnt from the motion in it. Each cause has its onset, size and deviation; where the recording
    does not tell two causes apart, both are named, and what would decide. Exits non-zero only where it cannot be read.
    """
    if dataset.is_dir():
        views = read_folder(dataset)
    elif dataset.is_file():
        views = read_flight(dataset)
    else:
        raise CommandError("dataset", f"{dataset} is neither a flight recording (*.mcap) nor a folder")
    report = examine_views(views)
    emit(report, _text(report), json)


def _text(report: RecordingReport) -> str:
    lines = []
    if report.learnt_from is None and report.rms_px is not None:
        lines.append(
            f"residuals {report.rms_px:.3f} px rms ({report.before_px:.3f} px with what has happened), of the "
            f"{report.stratum} model that the recording holds: no joint motions to learn one from"
        )
    if report.learnt_from is not None:
        first, last, stops = report.learnt_from
        lines.append(
            f"residuals {report.rms_px:.3f} px rms ({report.before_px:.3f} px with what has happened); "
            f"{report.stratum} model learnt from {stops} stops in frames {first} to {last}, {report.outliers} pixels "
            "left out"
        )
    for name, one in report.cameras.items():
        rms = "" if one.rms_px is None else f", {one.rms_px:.3f} px rms"
        offset = (
            ""
            if one.offset_s is None
            else f", {1e3 * one.offset_s:+.1f} ± {1e3 * (one.offset_deviation_s or 0):.1g} ms"
        )
        lost = "drops cannot be told" if one.dropped is None else f"{one.dropped} dropped"
        lines.append(f"  camera {name}: {one.frames} frames, {lost}{rms}{offset}")
    for what, groups in (("joint", report.joints), ("episode", report.episodes)):
        if len(groups) > 1:
            lines.append(
                f"  by {what} [px rms]: " + ", ".join(f"{name} {rms:.3f}" for name, rms in groups.items())
            )
    lines += [f"* {cause.message}" for cause in report.causes] or ["nothing has happened"]
    lines += [f"  note: {one}" for one in report.notes]
    lines.append(
        f"(a recording to which nothing has happened is said to have a change once in {1 / report.false_alarm:.0f})"
    )
    return "\n".join(lines)
