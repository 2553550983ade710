"""Command ``stereoservo export``: writes a flight recording that Foxglove and Rerun open, beside the bit-exact one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereoservo.cli.output import CommandError, JsonOption, emit, note
from stereoservo.recording.flight_export import export_flight

SAME = 1e-9
"""Relative error up to which a replay on another processor tells the same."""


def export(
    file: Annotated[Path, typer.Argument(metavar="FLIGHT", help="A flight recording (*.mcap).")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write (default: FLIGHT.foxglove.mcap).")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write a recording for Foxglove and Rerun, which still replays bit for bit.

    Pictures in NAME.images beside the recording go with it.
    """
    target = output if output is not None else file.with_suffix(".foxglove.mcap")
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
