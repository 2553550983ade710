"""Command ``stereoservo examine``: a recording of joints and pictures judged: cameras, joints, stamps, frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereoservo.calibration.examination.examination import RecordingReport, examine_views
from stereoservo.cli.examine.flight import read_flight
from stereoservo.cli.examine.folder import read_folder
from stereoservo.cli.examine.lerobot import read_data_set
from stereoservo.cli.output import CommandError, JsonOption, emit
from stereoservo.ports.lerobot import is_data_set


def examine(
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET",
            help="A flight recording (*.mcap), a folder or a LeRobot data set: docs/recordings.md.",
        ),
    ],
    units: Annotated[
        str | None,
        typer.Option(help="Of a LeRobot data set: in what its states are, such as deg,gripper.pos=none."),
    ] = None,
    cameras: Annotated[
        str | None, typer.Option(help="Of a LeRobot data set: the cameras to examine, such as top,side.")
    ] = None,
    detector: Annotated[
        Path | None,
        typer.Option(
            help="Of a LeRobot data set: the file that names the detector. Default: detector.toml in it."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Judge a recording of joints and pictures: bumped cameras, drifted zeros, late stamps, dropped frames.

    Cameras and arm are learnt from the motion in it. Each cause has its onset, size and deviation; where the recording
    does not tell two causes apart, both are named, and what would decide. Exits non-zero only where it cannot be read.
    """
    if dataset.is_dir() and is_data_set(dataset):
        views = read_data_set(dataset, units, cameras, detector)
    elif any(one is not None for one in (units, cameras, detector)):
        raise CommandError(
            "dataset", f"--units, --cameras and --detector are for LeRobot data sets; {dataset} is none"
        )
    elif dataset.is_dir():
        views = read_folder(dataset)
    elif dataset.is_file():
        views = read_flight(dataset)
    else:
        raise CommandError(
            "dataset", f"{dataset} is no flight recording (*.mcap), folder or LeRobot data set"
        )
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
    if report.joints:
        lines.append(
            "  by joint [px rms]: " + ", ".join(f"{name} {rms:.3f}" for name, rms in report.joints.items())
        )
    if len(report.episodes) > 1:
        lines += [_of_episode(report, name, rms) for name, rms in report.episodes.items()]
    lines += [f"* {cause.message}" for cause in report.causes] or ["nothing has happened"]
    lines += [f"  note: {one}" for one in report.notes]
    lines.append(
        f"(a recording to which nothing has happened is said to have a change once in {1 / report.false_alarm:.0f})"
    )
    return "\n".join(lines)


def _of_episode(report: RecordingReport, name: str, rms: float) -> str:
    """Line on an episode: its residuals, and which causes are in it."""
    held = [f"{one.kind} {one.subject}".strip() for one in report.causes if int(name) in one.episodes]
    return f"  episode {name}: {rms:.3f} px rms, {', '.join(held) or 'nothing has happened'}"
