"""The conveyor of a demonstration: carries parts one after the other past the arm; ground truth of their motion."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.conveyor import AWAY, Conveyor
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.workpiece import Motion, Moved, MovedFile, moved_pose


class Belt:
    """The conveyor of a cell, switched by the file in its ``runtime_dir``; ``now_ns``: clock of the cell's cameras."""

    def __init__(self, conveyor: Conveyor, runtime_dir: Path, now_ns: Callable[[], int]) -> None:
        self.conveyor = conveyor
        self._file = MovedFile(runtime_dir)
        self._now_ns = now_ns
        self._since: list[int] = []
        self._moved: list[Moved] = []

    def clear(self) -> None:
        """Take the part off the belt."""
        self.place(AWAY)

    def put(self) -> None:
        """Put a part onto the stopped belt."""
        self.place(self.conveyor.begin)

    def run(self) -> None:
        """Switch the belt on."""
        self.place(self.conveyor.running(self._now_ns()))

    def place(self, moved: Moved) -> None:
        """Set the part's displacement or motion to ``moved``."""
        self._since.append(self._now_ns())
        self._moved.append(moved)
        self._file.write(moved)

    def moved(self, t_ns: int) -> Moved:
        """Displacement of the part at ``t_ns``."""
        k = bisect_right(self._since, t_ns) - 1
        if k < 0:
            return Moved()
        moved = self._moved[k]
        return moved.at(t_ns) if isinstance(moved, Motion) else moved

    def stops_ns(self, t_ns: int) -> int:
        """End time of the motion that was in progress at ``t_ns``."""
        moved = self._moved[bisect_right(self._since, t_ns) - 1]
        assert isinstance(moved, Motion)
        assert moved.since_ns is not None
        return moved.since_ns + round((moved.for_s or np.inf) * 1e9)

    def cell_at(self, cell: SimulatedCell, t_ns: int) -> SimulatedCell:
        """``cell`` with the part at its pose at ``t_ns``."""
        return with_part(cell, self.moved(t_ns))


def with_part(cell: SimulatedCell, moved: Moved) -> SimulatedCell:
    """``cell`` with its part displaced by ``moved``: the body, if the cameras are on the arm."""
    assert cell.stand is not None
    stand: FloatArray = moved_pose(cell.stand, moved)
    return replace(cell, stand=stand)
