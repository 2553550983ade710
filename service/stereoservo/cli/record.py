"""``stereoservo record``."""

from __future__ import annotations

import math
import time
from typing import Annotated

import typer

from stereoservo.cli.output import CellArgument, EndpointOption, JsonOption, OperatorOption, emit, note
from stereoservo.gateway.client import Client, EventWatch


def record(
    cell: CellArgument,
    seconds: Annotated[float, typer.Option(help="For how long (default: until Ctrl-C).", min=0.0)] = math.inf,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Record the flight of a live cell into a file on its host; `replay` runs it again."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        with EventWatch(client) as watch:
            client.record()
            file = client.info().recording
            if not file:
                file = watch.wait(lambda e: e.kind == "recording", "the recording", 5.0).message
        note(f"recording into {file}; Ctrl-C ends it")
        until = time.monotonic() + seconds
        try:
            while time.monotonic() < until:
                time.sleep(min(0.5, max(0.0, until - time.monotonic())))
        except KeyboardInterrupt:
            note("ending the recording")
        finally:
            reply = client.record(on=False)
    emit({"file": file, "message": reply.message}, reply.message, json)
