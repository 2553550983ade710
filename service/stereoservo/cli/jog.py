"""Command ``stereoservo jog``: moves joints at given velocities while this process renews its lease (a dead man's
switch).
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Annotated

import typer

from stereoservo.cli.output import CellArgument, EndpointOption, JsonOption, OperatorOption, emit, pairs
from stereoservo.client import Client, ClientError

LEASE_S = 0.3
EVERY_S = 0.1


def jog(
    cell: CellArgument,
    velocities: Annotated[list[str], typer.Argument(metavar="JOINT=VELOCITY...", help="[rad/s] or [m/s] by joint.")],
    seconds: Annotated[float, typer.Option(help="For how long; Ctrl-C ends it sooner.", min=0.0)] = 1.0,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Move joints at given velocities for some time."""
    requested = pairs(velocities, "velocity")
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        client.jog(requested, LEASE_S)
        try:
            until = time.monotonic() + seconds
            while (left := until - time.monotonic()) > 0:
                time.sleep(min(EVERY_S, left))
                client.jog(requested, LEASE_S)
        finally:
            with suppress(ClientError):  # the lease ends it anyway, slightly later
                client.jog(dict.fromkeys(requested, 0.0), 0.05)
        state = client.wait_state(lambda s: s.source != "jog", "at rest", 3.0)
    emit(state, "  ".join(f"{name} {value:+.4f}" for name, value in state.joints.items()), json)
