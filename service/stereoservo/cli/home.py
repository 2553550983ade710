"""Command ``stereoservo home``: moves every joint to the cell's home position."""

from __future__ import annotations

from typing import Annotated

import typer

from stereoservo.cli import interruption
from stereoservo.cli.goal.command import follow
from stereoservo.cli.output import CellArgument, EndpointOption, JsonOption, OperatorOption
from stereoservo.client import Client


def home(
    cell: CellArgument,
    speed_scale: Annotated[float, typer.Option(help="Lowers the speed, (0, 1].")] = 1.0,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Move every joint to the cell's home position. Ctrl-C cancels."""
    with (
        Client(cell, endpoint=endpoint, operator=operator, while_waiting=interruption.check) as client,
        client.home(speed_scale) as handle,
    ):
        follow(handle, json, client.cell)
