"""The truth of a demonstration: the simulated cell as the cell file has it, and where its arm was all the time."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.runtime.cellfile import CellFile
from stereoservo_sim.history import FILE_NAME, JointHistory
from stereoservo_sim.workpiece import Moved
from stereoservo_sim.world import SimulatedCell, simulated_cell, workpiece_cell

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
POLL_S = 1.0


def true_cell(cell: CellFile) -> SimulatedCell:
    """The simulated cell that a cell file's cameras show: their mount, lenses, workpiece, under its own names.

    Raises ValueError where a camera is none of the simulated rig.
    """
    shown = any(section.options.get("workpiece", False) for section in cell.camera)
    simulated = workpiece_cell() if shown else simulated_cell(cell.camera[0].mount)
    cameras = []
    for section in cell.camera:
        view = section.options.get("view") or section.name
        try:
            moved = msgspec.convert(section.options.get("moved", {}), Moved)
            camera = simulated.camera(view, float(section.options.get("k1", 0.0)), moved)
        except KeyError as error:
            raise ValueError(f"camera {section.name!r} is not simulated: {error.args[0]}") from error
        cameras.append(replace(camera, name=section.name))
    return replace(simulated, rig=replace(simulated.rig, cameras=tuple(cameras)))


class TruthLog:
    """Copies the arm's true joint positions out of its history before the ring overwrites them."""

    def __init__(self, history: JointHistory) -> None:
        self._history = history
        self._next = 0
        self._times: list[IntArray] = []
        self._positions: list[FloatArray] = []
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @classmethod
    def of_directory(cls, runtime_dir: Path) -> TruthLog:
        """The log of the arm whose joint driver runs in ``runtime_dir``. Raises HistoryError."""
        return cls(JointHistory.open(runtime_dir / FILE_NAME))

    def take(self) -> None:
        """Copy what is new."""
        self._next, times, positions = self._history.since(self._next)
        self._times.append(times)
        self._positions.append(positions)

    def follow(self) -> None:
        """Copy from time to time, in a thread, until ``end``."""
        self._thread = threading.Thread(target=self._run, name="truth-log", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(POLL_S):
            self.take()

    def end(self) -> tuple[IntArray, FloatArray]:
        """Stop following; times (k,) [ns] and positions (k, n)."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        self.take()
        return np.concatenate(self._times), np.concatenate(self._positions)
