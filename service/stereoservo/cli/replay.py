"""Command ``stereoservo replay``: runs the recorded inputs of a flight recording through the control core again and
compares the outputs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from stereoservo.cli.output import CommandError, JsonOption, emit
from stereoservo.recording.replay import RecordingError, ReplayResult
from stereoservo.recording.replay import replay as replay_file


def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A flight recording (*.mcap).")], json: JsonOption = False
) -> None:
    """Run a recording through the core again and compare, bit for bit where the machine is the same.

    A file that ends inside a record, as after a crash, is replayed up to there.
    """
    incomplete = ""
    try:
        result = replay_file(file)
    except RecordingError as error:
        if error.result is None:
            raise
        result, incomplete = error.result, str(error)
        if not error.cut:
            raise CommandError("recording", f"{incomplete}: {_verdict(result)}", **_figures(result)) from error
    figures = _figures(result) | {"complete": not incomplete, "incomplete": incomplete}
    if result.identical is False:
        raise CommandError(
            "differs",
            f"{file}: step {result.first_difference} differs, largest relative error {result.max_relative_error:.3g}",
            **figures,
        )
    text = f"{result.steps} steps, {result.checkpoints} checkpoints, {result.gaps} gaps: {_verdict(result)}"
    if incomplete:
        text += f" up to step {result.last_step}, where the recording breaks off\n{incomplete}"
    emit(figures, text, json)


def _figures(result: ReplayResult) -> dict[str, Any]:
    return {
        "identical": result.identical,
        "steps": result.steps,
        "max_relative_error": result.max_relative_error,
        "first_difference": result.first_difference,
        "checkpoints": result.checkpoints,
        "gaps": result.gaps,
        "fingerprint": msgspec.to_builtins(result.fingerprint),
    }


def _verdict(result: ReplayResult) -> str:
    if result.identical:
        return "identical"
    if result.identical is False:
        return f"step {result.first_difference} differs"
    return f"another machine; largest relative error {result.max_relative_error:.3g}"
