"""Ground truth of a demonstration: the simulated cell of a cell file, and its arm's true positions over time."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.messages.addresses import Address
from stereoservo.messages.cell_file import CameraSection, CellFile
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_drivers.twist import TwistJointDriver, virtual_positions
from stereoservo_sim.emulators.cameras.stream_settings import cameras_of_cell
from stereoservo_sim.emulators.fault_engine import EmulationError
from stereoservo_sim.world.arms.arm_cell import cell_of, place_of
from stereoservo_sim.world.arms.arm_goals import goals_of
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory
from stereoservo_sim.world.simulated_cell import SimulatedCell, solid_cell, workpiece_cell
from stereoservo_sim.world.workpiece import Moved

POLL_S = 1.0


def true_cell(cell: CellFile, folder: Path = Path()) -> SimulatedCell:
    """Simulated cell of a cell file: its arm, its cameras with mount and lenses, its workpiece, by the file's names.
    ``folder``: of the cell file.

    Cameras of driver ``video`` show the images of ``[emulate.cameras]`` at their address. Raises ValueError if a camera
    is not one of the simulated rig, or the arm cannot be simulated.
    """
    options = [_simulated_options(section, cell) for section in cell.camera]
    shown = any(option.get("workpiece", False) for option in options)
    if shown:
        simulated = workpiece_cell()
    elif any(option.get("solid", False) for option in options):
        simulated = solid_cell()
    else:
        simulated = cell_of(place_of(cell.arm_options), cell.camera[0].mount, folder)
    cameras = []
    for section, option in zip(cell.camera, options, strict=True):
        view = option.get("view") or section.name
        try:
            moved = msgspec.convert(option.get("moved", {}), Moved)
            camera = simulated.camera(view, float(option.get("k1", 0.0)), moved)
        except KeyError as error:
            raise ValueError(f"camera {section.name!r} is not simulated: {error.args[0]}") from error
        cameras.append(replace(camera, name=section.name))
    return replace(simulated, rig=replace(simulated.rig, cameras=tuple(cameras)))


def shown_positions(cell: CellFile, truth: SimulatedCell) -> dict[str, FloatArray]:
    """Positions of the cell's joints (n,) at the demonstration's goals, by name; for an arm with Cartesian velocities,
    those of its virtual joints.
    """
    goals = goals_of(truth)
    if cell.joints.driver != TwistJointDriver.driver:
        return goals
    return {name: virtual_positions(cell.joints.options, truth, q) for name, q in goals.items()}


def _simulated_options(section: CameraSection, cell: CellFile) -> Mapping[str, Any]:
    """Options of the simulated camera behind a camera of the cell."""
    if section.driver != "video" or "cameras" not in cell.emulate:
        return section.options
    try:
        settings = cameras_of_cell(cell)
    except EmulationError as error:
        raise ValueError(str(error)) from error
    path = Address(str(section.options.get("source", ""))).parsed().path
    stream = next((stream for stream in settings.camera if stream.stream == path), None)
    if stream is None:
        streams = ", ".join(stream.stream for stream in settings.camera)
        raise ValueError(f"camera {section.name!r} shows {path!r}, which is not emulated; streams: {streams}")
    return {"view": stream.view or stream.name, "k1": stream.k1, "moved": stream.moved, "workpiece": settings.workpiece}


class TruthLog:
    """Copies the arm's true joint positions out of its history before the ring overwrites them."""

    def __init__(self, history: TrueJointHistory) -> None:
        self._history = history
        self._next = 0
        self._times: list[IntArray] = []
        self._positions: list[FloatArray] = []
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @classmethod
    def of_directory(cls, runtime_dir: Path) -> TruthLog:
        """The log of the arm whose joint driver runs in ``runtime_dir``. Raises HistoryError."""
        return cls(TrueJointHistory.open(runtime_dir / FILE_NAME))

    def take(self) -> None:
        """Copy new samples."""
        self._next, times, positions = self._history.since(self._next)
        self._times.append(times)
        self._positions.append(positions)

    def follow(self) -> None:
        """Copy periodically, in a thread, until ``end``."""
        self._thread = threading.Thread(target=self._run, name="truth-log", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(POLL_S):
            self.take()

    def end(self) -> tuple[IntArray, FloatArray]:
        """Stop copying; returns times (k,) [ns] and positions (k, n)."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        self.take()
        return np.concatenate(self._times), np.concatenate(self._positions)
