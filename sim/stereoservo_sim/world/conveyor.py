"""The simulated conveyor: a belt that carries the marked part past the arm, straight and at constant speed.

It has no process of its own. The part's motion is in the file of the runtime directory that moves targets
(`stereoservo_sim.world.workpiece`), so that cameras in any process, the demonstration and a shell agree on it.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from stereoservo.messages.cell_file import CellFile
from stereoservo_sim.world.workpiece import Metres, Motion, Moved

NAME = "conveyor"
AWAY = Moved((0.0, 0.0, -5.0))
"""Displacement of the part while none is on the belt."""


class ConveyorError(Exception):
    """A cell file states no conveyor, or an invalid one; the text states what would be valid."""


class Conveyor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Section ``[emulate.conveyor]``: motion of parts on the belt, in the world's axes.

    A part is put onto the belt at ``begin_m`` [m] from its initial position in the cell, and carried at
    ``velocity_m_s`` [m/s] for ``for_s``; then the belt stops. ``every_s``: interval after which the next part starts at
    ``begin_m``; None: there is one part.
    """

    velocity_m_s: tuple[Metres, Metres, Metres]
    begin_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    for_s: Annotated[float, Meta(gt=0, le=3600)] = 10.0
    every_s: Annotated[float, Meta(gt=0, le=3600)] | None = None

    @property
    def begin(self) -> Moved:
        """Displacement at which a part is put onto the belt."""
        return Moved(self.begin_m)

    def running(self, since_ns: int) -> Motion:
        """The part's motion on the belt running from the monotonic time ``since_ns`` [ns]."""
        return Motion(
            shift_m=self.begin_m,
            velocity_m_s=self.velocity_m_s,
            since_ns=since_ns,
            for_s=self.for_s,
            every_s=self.every_s,
        )


def conveyor_of(cell: CellFile) -> Conveyor | None:
    """The conveyor of a cell, None if it has none. Raises ConveyorError if it is invalid."""
    given = cell.emulate.get(NAME)
    if given is None:
        return None
    where = f"cell {cell.cell.name!r}: [emulate.conveyor]"
    try:
        found = msgspec.convert(given, Conveyor)
    except msgspec.ValidationError as error:
        raise ConveyorError(
            f"{where}: {error}; it holds velocity_m_s = [x, y, z], and may hold begin_m, for_s, every_s"
        ) from error
    if not any(found.velocity_m_s):
        raise ConveyorError(f"{where}: velocity_m_s: the belt never moves; e.g. [0.0, 0.02, 0.0] is valid")
    if found.every_s is not None and found.every_s < found.for_s:
        raise ConveyorError(f"{where}: every_s: {found.every_s:g}; at least for_s, {found.for_s:g}, is valid")
    if cell.camera[0].mount != "eye_in_hand" and not _beside(cell):
        raise ConveyorError(
            f"{where}: before cameras that stand a conveyor carries a workpiece; add workpiece = true to their options"
        )
    return found


def _beside(cell: CellFile) -> bool:
    return any(camera.options.get("workpiece", False) for camera in cell.camera)
