"""Command ``stereoservo replay``: runs the recorded inputs of a flight recording through the control core again and
compares the outputs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from stereoservo.cli.output import CommandError, JsonOption, emit
from stereoservo.recording.replay import replay as replay_file


def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A flight recording (*.mcap).")],
    json: JsonOption = False,
) -> None:
    """Run a recording through the core again and compare, bit for bit where the machine is the same."""
    result = replay_file(file)
    figures = {
        "identical": result.identical,
        "steps": result.steps,
        "max_relative_error": result.max_relative_error,
        "first_difference": result.first_difference,
        "checkpoints": result.checkpoints,
        "gaps": result.gaps,
        "fingerprint": msgspec.to_builtins(result.fingerprint),
    }
    if result.identical is False:
        raise CommandError(
            "differs",
            f"{file}: step {result.first_difference} differs, largest relative error "
            f"{result.max_relative_error:.3g}",
            **figures,
        )
    verdict = (
        "identical"
        if result.identical
        else f"another machine; largest relative error {result.max_relative_error:.3g}"
    )
    emit(
        figures,
        f"{result.steps} steps, {result.checkpoints} checkpoints, {result.gaps} gaps: {verdict}",
        json,
    )
