"""Messages between the processes of one cell as structs with msgpack codecs (run plan, requests, heartbeats, servo
state, reports), and the capacities and layouts of their shared-memory slots.
"""

from __future__ import annotations

import struct
from pathlib import Path

import msgspec

from stereoservo.core.cycle import Event, Status, check_observation, decode_array, encode
from stereoservo.core.settings import CoreSettings, core_settings
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CameraSection, CellFile
from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.files import read_bounded, write_atomically
from stereoservo.messages.goals import Request
from stereoservo.messages.recording_request import RecordedImages
from stereoservo.messages.servo_state import COMMISSIONING_SPEED, MAX_PLAN_BYTES, LoopStatistics, plan_path
from stereoservo.ports.devices import (
    CameraDescription,
    CameraObservation,
    Clock,
    DriverContext,
    JointDriverDescription,
    Prior,
)
from stereoservo.recording.step_records import RecordedStep, StepMessage

OBSERVATION_LAYOUT = "CameraObservation.1"
PRIOR_LAYOUT = "Prior.1"
OBSERVATION_CAPACITY = 1 << 16
PRIOR_CAPACITY = 1 << 16
STATE_CAPACITY = 1 << 16


class RunPlan(msgspec.Struct, frozen=True):
    """The configuration of one run, fixed at its start; every process reads it instead of the cell file."""

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

    def driver_context(self, clock: Clock, camera: CameraSection | None = None) -> DriverContext:
        """The context for the constructor of the joint driver, or of driver and detector of ``camera``."""
        return DriverContext(
            clock=clock,
            cell=self.cell.cell.name,
            runtime_dir=Path(self.runtime),
            cell_dir=Path(self.cell_path).parent,
            camera="" if camera is None else camera.name,
            seed=self.seed,
            mount=(camera or self.cell.camera[0]).mount,
            arm=self.cell.arm_options,
        )

    def settings(self) -> CoreSettings:
        """The core's settings. Raises CellFileError where cell file and drivers contradict each other."""
        cap = COMMISSIONING_SPEED if self.commissioning else 1.0
        return core_settings(
            self.cell, self.joints, self.cameras, speed_cap=cap, watch_following=not self.dry_run
        )


class Hello(msgspec.Struct, frozen=True, tag="hello"):
    """First message of the gateway; ``last_event`` is the number of the last event it has, later ones are sent."""

    last_event: int


class Heartbeat(msgspec.Struct, frozen=True, tag="heartbeat"):
    """Heartbeat of the gateway; without it a moving arm is held."""


class Ask(msgspec.Struct, frozen=True, tag="ask"):
    """A request forwarded to the core."""

    request: Request


class NewModel(msgspec.Struct, frozen=True, tag="model", eq=False):
    """A model for the core. ``reanchored``: see `cycle.ModelUpdate`."""

    model: CellModel
    reanchored: tuple[str, ...] = ()


ToServo = Hello | Heartbeat | Ask | NewModel


class ServoState(msgspec.Struct, frozen=True, eq=False):
    """State of the servo process, published some tens of times a second."""

    status: Status
    loop: LoopStatistics
    driver_configured: bool
    driver_active: bool
    gateway: bool
    records_dropped: int
    differences: tuple[str, ...]
    """Reasons why the drives were sent something other than the core's command; empty where they were not."""
    notes: tuple[str, ...] = ()
    """Records of other processes that could not be read and were left out, by source."""
    auxiliary: dict[str, float] = {}


class Report(msgspec.Struct, frozen=True):
    """A message of a vision process or the supervisor that the gateway passes on to clients."""

    origin: str
    kind: str
    message: str
    t_ns: int
    images: RecordedImages | None = None
    """Of a recording of images that has ended."""


def decode_observation(data: bytes) -> CameraObservation:
    """An observation with arrays of the right shapes. Raises msgspec.MsgspecError, ValueError."""
    observation = observation_decoder.decode(data)
    check_observation(observation)
    return observation


def pack_step_message(message: StepMessage) -> bytes:
    """A message for the ring of step records; a step as it is, all else in msgpack."""
    if isinstance(message, RecordedStep):
        return _STEP.pack(_STEP_MARK, min(message.lost, 0xFFFFFFFF), message.t_ns) + message.data
    return encode(message)


def unpack_step_message(data: bytes) -> StepMessage:
    """Inverse of :func:`pack_step_message`. Raises msgspec.MsgspecError, ValueError, struct.error."""
    if data[:4] != b"\xc1" * 4:
        message: StepMessage = _steps_decoder.decode(data)
        return message
    _, lost, t_ns = _STEP.unpack_from(data)
    return RecordedStep(t_ns, data[_STEP.size :], lost)


class PlanError(DamagedError):
    """The run plan of a cell cannot be read."""


to_servo_decoder = msgspec.msgpack.Decoder(ToServo, dec_hook=decode_array)
event_decoder = msgspec.msgpack.Decoder(Event, dec_hook=decode_array)
state_decoder = msgspec.msgpack.Decoder(ServoState, dec_hook=decode_array)
observation_decoder = msgspec.msgpack.Decoder(CameraObservation, dec_hook=decode_array)
prior_decoder = msgspec.msgpack.Decoder(Prior, dec_hook=decode_array)
_steps_decoder = msgspec.msgpack.Decoder(StepMessage, dec_hook=decode_array)
_STEP = struct.Struct("<IIq")
"""Before a step in the ring: mark, steps lost before it, time. What is rare is msgpack, which no mark begins."""
_STEP_MARK = 0xC1C1C1C1  # a byte that msgpack never uses
report_decoder = msgspec.msgpack.Decoder(Report)
_plan_decoder = msgspec.msgpack.Decoder(RunPlan)


def save_plan(plan: RunPlan) -> None:
    """Write the plan into the runtime directory. Raises OSError."""
    write_atomically(plan_path(Path(plan.runtime)), encode(plan))


def load_plan(runtime: Path) -> RunPlan:
    """Read the plan of the cell whose runtime directory this is. Raises PlanError."""
    path = plan_path(runtime)
    with decoding(lambda cause: PlanError(path, f"{cause}; this process is started by `stereoservo run`")):
        return _plan_decoder.decode(read_bounded(path, MAX_PLAN_BYTES))
