"""Set-points of a goal from recorded images, for ``stereoservo goal CELL --images DIR``: mean marker pixels of every
recorded camera, checked against the live cell.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereoservo.cli.output import CommandError, note
from stereoservo.client import Client
from stereoservo.messages.discovery import find_daemon

if TYPE_CHECKING:
    from stereoservo.daemon.jobs.recorded_set_points import SetPoints

FRAMES = 20


def read_images(
    cell: str, endpoint: str | None, images: Path, at_s: float, frames: int
) -> tuple[SetPoints, ...]:
    """Set-points of every recorded camera; reports them on stderr.

    Raises CommandError, SetPointError, ImageFileError, DriverError, PluginError, CellFileError, NotRunningError.
    """
    from stereoservo.daemon.jobs.recorded_set_points import set_points_from_images  # OpenCV: for this alone

    if cell.endswith(".toml"):
        path = Path(cell)
    elif endpoint is None:
        path = Path(find_daemon(cell).cell_path)
    else:
        raise CommandError(
            "usage",
            "--images needs the cell file, for its cameras' detectors, and the cell is on another host: run this there",
        )
    found = set_points_from_images(path, images, at_s, frames)
    for one in found:
        left_out = ", ".join(str(marker) for marker in one.left_out)
        note(
            f"camera {one.camera}: {len(one.pixels)} markers in {one.frames} frames from {one.at_s:.2f} s on"
            + (f"; markers {left_out} are in fewer than half of them, and left out" if left_out else "")
        )
    return found


def feature_tree(found: tuple[SetPoints, ...]) -> dict[str, Any]:
    """The set-points as a target on the wire."""
    points = {one.camera: {str(marker): list(pixel) for marker, pixel in one.pixels.items()} for one in found}
    return {"kind": "features", "set_points": points}


def require_cameras(client: Client, found: tuple[SetPoints, ...]) -> None:
    """Raise CommandError where a recording does not match a camera of the live cell in its present setup."""
    if not found:
        return
    cameras = {camera.name: (camera.width, camera.height) for camera in client.info().cameras}
    for one in found:
        if cameras.get(one.camera) != one.size:
            has = cameras.get(one.camera)
            live = "has no such camera" if has is None else f"has it with {has[0]}x{has[1]} px"
            raise CommandError(
                "other_cell",
                f"camera {one.camera!r} is recorded with pictures of {one.size[0]}x{one.size[1]} px; the cell {live}",
                camera=one.camera,
            )
