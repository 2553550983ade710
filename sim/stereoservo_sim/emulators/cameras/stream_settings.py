"""Settings of the emulated cameras: section ``[emulate.cameras]`` of a cell file."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from stereoservo.messages.addresses import Address
from stereoservo.messages.cell_file import CellFile
from stereoservo.messages.goals import Name
from stereoservo_drivers.options import invalid
from stereoservo_sim.emulators.fault_engine import EmulationError
from stereoservo_sim.world.workpiece import Moved

Share = Annotated[float, Meta(ge=0, le=1)]
Milliseconds = Annotated[float, Meta(ge=0, le=10_000)]
Path = Annotated[str, Meta(pattern=r"^(/[A-Za-z0-9_.-]{1,64}\.mjpg)?$")]
CHANNEL = "http://127.0.0.1:"


class StreamSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One camera: ``[[emulate.cameras.camera]]``.

    ``path`` of its stream (default: ``/NAME.mjpg``). ``view``: the camera of the simulated rig (default: the one of
    this name); ``k1``, ``moved``: as of the simulated cameras. Shutters open at ``k / rate_hz + skew_ms``; an image is
    sent ``latency_ms`` later, varied by up to ``jitter_ms`` to either side. ``drop_rate``: probability that an image is
    lost.
    ``gain``: of the exposure.
    """

    name: Name
    path: Path = ""
    view: str = ""
    k1: float = 0.0
    moved: Moved = Moved()
    rate_hz: Annotated[float, Meta(ge=1, le=200)] = 30.0
    skew_ms: Milliseconds = 0.0
    latency_ms: Milliseconds = 40.0
    jitter_ms: Milliseconds = 0.0
    drop_rate: Share = 0.0
    gain: Annotated[float, Meta(ge=0, le=100)] = 1.0

    @property
    def stream(self) -> str:
        """Path of the stream."""
        return self.path or f"/{self.name}.mjpg"


class CamerasSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Section ``[emulate.cameras]``.

    ``port`` on this host; 0: a free one, reported when ready. ``background``: ``pybullet`` is its rendered arm,
    refreshed now and then; ``arm`` draws room and arm for every image; ``plain`` is a uniform grey. ``noise``: sigma of
    the sensor [grey levels]; ``blur``: sigma of the lens [px]. ``quality``: of the JPEGs. ``workpiece``: whether there
    is one beside the body. ``seed``: of noise, losses and jitter. ``connections``: largest number at the same time.
    """

    host: Literal["127.0.0.1"] = "127.0.0.1"
    port: Annotated[int, Meta(ge=0, le=65_535)] = 0
    background: Literal["arm", "plain", "pybullet"] = "arm"
    noise: Annotated[float, Meta(ge=0, le=100)] = 2.0
    blur: Annotated[float, Meta(ge=0, le=20)] = 0.7
    quality: Annotated[int, Meta(ge=1, le=100)] = 95
    workpiece: bool = False
    seed: Annotated[int, Meta(ge=0)] = 0
    connections: Annotated[int, Meta(ge=1, le=256)] = 32
    camera: tuple[StreamSettings, ...] = ()


def cameras_of_cell(cell: CellFile) -> CamerasSettings:
    """The emulated cameras of a cell. Raises EmulationError."""
    where = f"cell {cell.cell.name!r}"
    given = cell.emulate.get("cameras")
    if given is None:
        raise EmulationError(
            f"{where}: no [emulate.cameras], which says what to stand in for (the shipped cell 'hil-video' has it)"
        )
    try:
        settings = msgspec.convert(given, CamerasSettings)
    except msgspec.ValidationError as error:
        raise EmulationError(f"{where}: emulate.cameras: {invalid(CamerasSettings, given, error)}") from error
    if not settings.camera:
        raise EmulationError(f"{where}: emulate.cameras: no camera; at least one [[emulate.cameras.camera]] is needed")
    for key, values in (
        ("name", [camera.name for camera in settings.camera]),
        ("path", [camera.stream for camera in settings.camera]),
    ):
        twice = next((value for value in values if values.count(value) > 1), None)
        if twice is not None:
            raise EmulationError(f"{where}: emulate.cameras.camera: {key} {twice!r} is used twice; they must differ")
    return settings


def port_of(channel: str) -> int:
    """Port of ``http://127.0.0.1:PORT``. Raises EmulationError."""
    port = channel.removeprefix(CHANNEL).rstrip("/")
    if not channel.startswith(CHANNEL) or not port.isdecimal() or int(port) > 65_535:
        raise EmulationError(
            f"channel {Address(channel)!r}: emulated cameras listen on this host only: {CHANNEL}PORT (0: a free one)"
        )
    return int(port)
