"""What the processes of one cell tell each other: structs and their msgpack codecs, and the capacities of
the slots.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from stereoservo.kinematics.model import CellModel
from stereoservo.runtime.cellfile import CellFile
from stereoservo.runtime.commands import Request
from stereoservo.runtime.cycle import Event, Status, decode_array, encode_array
from stereoservo.runtime.directories import CellDirectories
from stereoservo.runtime.image_order import RecordedImages
from stereoservo.runtime.loop import LoopStatistics
from stereoservo.runtime.ports import CameraDescription, CameraObservation, JointDriverDescription, Prior
from stereoservo.runtime.record import Fingerprint
from stereoservo.runtime.settings import CoreSettings, core_settings

OBSERVATION_LAYOUT = "CameraObservation.1"
PRIOR_LAYOUT = "Prior.1"
STATE_LAYOUT = "ServoState.1"
OBSERVATION_CAPACITY = 1 << 16
PRIOR_CAPACITY = 1 << 16
STATE_CAPACITY = 1 << 16

COMMISSIONING_SPEED = 0.05


class RunPlan(msgspec.Struct, frozen=True):
    """What the supervisor decided at the start; every child reads this, none the cell file, so that all
    agree.
    """

    cell: CellFile
    cell_path: str
    runtime: str
    state: str
    boot: str
    joints: JointDriverDescription
    cameras: tuple[CameraDescription, ...]
    seed: int = 0
    dry_run: bool = False
    commissioning: bool = False
    record: str = ""

    @property
    def directories(self) -> CellDirectories:
        """The cell's directories."""
        return CellDirectories(self.cell.cell.name, Path(self.runtime), Path(self.state))

    def settings(self) -> CoreSettings:
        """The core's settings. Raises CellFileError where cell file and drivers do not fit."""
        cap = COMMISSIONING_SPEED if self.commissioning else 1.0
        return core_settings(
            self.cell, self.joints, self.cameras, speed_cap=cap, watch_following=not self.dry_run
        )


class Hello(msgspec.Struct, frozen=True, tag="hello"):
    """The gateway has connected and knows the events up to ``last_event``; the servo process sends the
    later ones.
    """

    last_event: int


class Heartbeat(msgspec.Struct, frozen=True, tag="heartbeat"):
    """The gateway lives. Its silence means hold."""


class Ask(msgspec.Struct, frozen=True, tag="ask"):
    """A request for the core."""

    request: Request


class NewModel(msgspec.Struct, frozen=True, tag="model", eq=False):
    """A model for the core. ``reanchored``: see `cycle.ModelUpdate`."""

    model: CellModel
    reanchored: tuple[str, ...] = ()


ToServo = Hello | Heartbeat | Ask | NewModel


class ServoState(msgspec.Struct, frozen=True, eq=False):
    """What the servo process shows of itself, some tens of times a second."""

    status: Status
    loop: LoopStatistics
    driver_configured: bool
    driver_active: bool
    gateway: bool
    records_dropped: int
    differences: tuple[str, ...]
    """Why the drive was sent something else than the core asked; empty when it was not."""


class RecordingStart(msgspec.Struct, frozen=True, tag="start", array_like=True, eq=False):
    """First message on the step socket."""

    settings: CoreSettings
    fingerprint: Fingerprint


class RecordedStep(msgspec.Struct, frozen=True, tag="step", array_like=True):
    """One encoded step record. ``lost``: steps dropped just before it because the socket was full."""

    t_ns: int
    data: bytes
    lost: int = 0


class RecordedCheckpoint(msgspec.Struct, frozen=True, tag="checkpoint", array_like=True):
    """The encoded state before step ``step``."""

    t_ns: int
    step: int
    state: bytes
    lost: int = 0


FromServoSteps = RecordingStart | RecordedStep | RecordedCheckpoint


class Report(msgspec.Struct, frozen=True):
    """A vision process or the supervisor tells the gateway something that clients should hear."""

    origin: str
    kind: str
    message: str
    t_ns: int
    images: RecordedImages | None = None
    """Of a recording of images that has ended."""


class PlanError(Exception):
    """The run plan of a cell cannot be read."""


def _encoder() -> msgspec.msgpack.Encoder:
    return msgspec.msgpack.Encoder(enc_hook=encode_array)


_any_encoder = _encoder()
to_servo_decoder = msgspec.msgpack.Decoder(ToServo, dec_hook=decode_array)
event_decoder = msgspec.msgpack.Decoder(Event, dec_hook=decode_array)
state_decoder = msgspec.msgpack.Decoder(ServoState, dec_hook=decode_array)
observation_decoder = msgspec.msgpack.Decoder(CameraObservation, dec_hook=decode_array)
prior_decoder = msgspec.msgpack.Decoder(Prior, dec_hook=decode_array)
steps_decoder = msgspec.msgpack.Decoder(FromServoSteps, dec_hook=decode_array)
report_decoder = msgspec.msgpack.Decoder(Report)
_plan_decoder = msgspec.msgpack.Decoder(RunPlan)


def encode(message: Any) -> bytes:
    """Any of these structs as msgpack, arrays bit for bit."""
    return _any_encoder.encode(message)


def save_plan(plan: RunPlan) -> None:
    """Write the plan into the runtime directory."""
    path = Path(plan.runtime) / "plan.msgpack"
    temporary = path.with_suffix(".new")
    temporary.write_bytes(encode(plan))
    temporary.replace(path)


def load_plan(runtime: Path) -> RunPlan:
    """Read the plan of the cell whose runtime directory this is. Raises PlanError."""
    path = runtime / "plan.msgpack"
    try:
        return _plan_decoder.decode(path.read_bytes())
    except OSError as error:
        raise PlanError(f"{path}: {error.strerror}; this process is started by `stereoservo run`") from error
    except msgspec.MsgspecError as error:
        raise PlanError(f"{path}: {error}") from error
