"""``stereoservo teach``."""

from __future__ import annotations

from typing import Annotated

import typer

from stereoservo.cli.output import CellArgument, EndpointOption, JsonOption, OperatorOption, emit
from stereoservo.gateway.client import Client


def teach(
    cell: CellArgument,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of the goal; an older one of that name is replaced.")
    ],
    frames: Annotated[int, typer.Option(help="Frames a camera to average.", min=1, max=1000)] = 20,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Store what the cameras see now as a goal."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        event = client.teach(name, frames)
    emit(event, event.message, json)
