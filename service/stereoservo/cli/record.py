"""Command ``stereoservo record``: starts or stops a flight recording of a running cell (inputs of every control step,
images on request).
"""

from __future__ import annotations

import math
import time
from typing import Annotated, Any

import msgspec
import typer

from stereoservo.cli.output import CELL_OPTIONS, CellArgument, CellOptions, CommandError, log
from stereoservo.client import EventWatch, HeardEvents
from stereoservo.messages.recording_request import ImagesRecorded
from stereoservo.messages.wire import EventMessage

LAST_WORD_S = 10.0
"""Time limit [s]; the gateway gives its cameras 5 s to finish their files."""


def record(
    cell: CellArgument,
    seconds: Annotated[float, typer.Option(help="For how long (default: until Ctrl-C).", min=0.0)] = math.inf,
    images: Annotated[
        bool, typer.Option("--images", help="With what the cameras deliver, without loss, in NAME.images beside it.")
    ] = False,
    options: CellOptions = CELL_OPTIONS,
) -> None:
    """Record the flight of a live cell into a file on its host; `replay` runs it again."""

    def hear(event: EventMessage) -> None:
        if event.kind in ("images_ended", "recording_failed"):
            log(event.message)

    recorded: ImagesRecorded | None = None
    with options.client(cell) as client, EventWatch(client) as watch:
        heard = HeardEvents(watch, lambda event: True, hear)
        client.record(images=images)
        file = client.info().recording
        if not file:
            began = heard.wait(("recording", "recording_failed"), "the recording", 5.0)
            if began.kind != "recording":
                client.record(on=False)
                raise CommandError("recording_failed", began.message)
            file = began.message
        log(f"recording into {file}; Ctrl-C ends it")
        until = time.monotonic() + seconds
        try:
            while time.monotonic() < until:
                time.sleep(min(0.5, max(0.0, until - time.monotonic())))
                heard.poll()
        except KeyboardInterrupt:
            log("ending the recording")
        finally:
            reply = client.record(on=False)
        if images:
            recorded = heard.wait(("images_recorded",), "the end of the images", LAST_WORD_S).images
    lines = [reply.message]
    result: dict[str, Any] = {"file": file, "message": reply.message}
    if recorded is not None:
        result["images"] = msgspec.to_builtins(recorded)
        lines += [
            f"  {one.file}: {one.frames} frames"
            + (f", {one.left_out} left out" if one.left_out else "")
            + ("" if one.why == "ended" else f", {one.why}")
            for one in recorded.cameras
        ]
    options.emit(result, "\n".join(lines))
