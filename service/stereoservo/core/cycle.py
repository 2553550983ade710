"""Inputs and outputs of one step of the control core: the structs `StepInputs` and `StepOutputs` with status and
events, and their msgpack encoding, arrays bit for bit.
"""

from __future__ import annotations

import math
from typing import Any, Literal, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.model import CellModel, JointLoads
from stereoservo.messages.goals import PlanReport, Request
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import CoreStatus
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.ports.devices import CameraObservation, JointState, Prior

RESET_ZEROS = "reset_zeros"
"""Name of a ``check_finished`` event after which drifted joint zeros are to be reset."""


class DriverFault(msgspec.Struct, frozen=True):
    """A joint driver failed in this cycle."""

    code: str
    message: str


class ModelUpdate(msgspec.Struct, frozen=True, eq=False):
    """A new model for the core: applied only at rest, with an epoch.

    ``reanchored``: cameras of which only the matrices are new, in the same frame as before: a suspended goal continues.
    ``kept``: from an earlier run; frames must confirm it before goals use it.
    """

    model: CellModel
    reanchored: tuple[str, ...] = ()
    kept: bool = False


class StepInputs(msgspec.Struct, frozen=True, eq=False, omit_defaults=True):
    """Everything that one step may depend on.

    ``stop``: the stop slot was raised since the last step.
    ``compiling``: the kernels that need a model are not loaded yet (the first start on a computer); a model waits for
    them.
    ``driver_active``: the state of the driver as the servo process has set it (it owns enable and disable). The core's
    lifecycle follows ``driver_active`` and requests transitions through ``StepOutputs.driver_request``.
    ``sent``: velocities (n,) sent to the drives in place of the last step's command; None: that command.
    """

    now_ns: int
    period_ns: int
    joints: JointState | None
    observations: tuple[CameraObservation, ...] = ()
    requests: tuple[Request, ...] = ()
    model_update: ModelUpdate | None = None
    stop: bool = False
    driver_configured: bool = True
    driver_active: bool = False
    driver_fault: DriverFault | None = None
    parameter_epoch: int = 0
    compiling: bool = False
    sent: FloatArray | None = None


EventKind = Literal[
    "reply",  # answer to a request: accepted or refused
    "lifecycle",
    "model",
    "model_compared",  # rounds of frames agree with a kept model (accepted), or contradict it
    "goal_started",
    "goal_face",  # the law uses another face of the body from now on
    "target_seen",  # the target that a goal follows is found, or is visible again
    "target_unseen",  # it is not visible any more: the arm waits
    "target_met",  # the target moves, and its goal is held nevertheless
    "goal_acknowledged",
    "goal_reached",
    "goal_aborted",
    "goal_cancelled",
    "goal_preempted",
    "held",
    "resumed",
    "stopped",
    "fault",
    "calibration_progress",
    "calibration_sample",
    "calibration_frames",  # of a sweep of calibration
    "calibration_finished",
    "calibration_aborted",
    "check_finished",
    "health",  # the diagnosis of the model has changed
    "reanchor",  # cameras have moved, the arm rests, and the observations for their relocalization follow
    "reanchored",  # the cameras' poses are known again; a suspended goal continues
    "camera_adjusted",  # a mobile camera is static again; its matrix is the one estimated in motion
    "reanchor_failed",  # they are not: a suspended goal remains suspended
    "taught",
    "warning",
]


class Sample(msgspec.Struct, frozen=True, eq=False):
    """Markers averaged at rest in one camera: ``ids`` (k,), ``pixels`` (k, 2), ``covariances`` (k, 2, 2) of the mean.

    The covariances are the detector's: its noise divided by the number of observations, plus its systematic part.
    ``sights`` (k,), the number of observations, and ``scatter`` (k,) [px²], the variance of a coordinate over them,
    allow a test of the stated noise.
    """

    camera: str
    ids: IntArray
    pixels: FloatArray
    covariances: FloatArray
    frames: int
    sights: FloatArray
    scatter: FloatArray


class PathFrame(msgspec.Struct, frozen=True, eq=False, omit_defaults=True):
    """A frame taken in motion: number of its ``camera`` in the cell, stated shutter time, markers' ``ids`` (k,), raw
    ``pixels`` (k, 2), and of a sweep the stated ``variances`` (k,) of a coordinate [px²].
    """

    camera: int
    t_ns: int
    ids: IntArray
    pixels: FloatArray
    variances: FloatArray | None = None


class PathRecord(msgspec.Struct, frozen=True, eq=False, omit_defaults=True):
    """Data recorded in motion: ``frames``, and joint samples ``positions`` (k, n) at ``joints_ns`` (k,). ``leg``:
    number of the sweep, 0 on the path to a stop.
    """

    frames: tuple[PathFrame, ...]
    joints_ns: IntArray
    positions: FloatArray
    leg: int = 0


TRIALS_BEGIN = "trial motions begin"
"""Message of the event `calibration_progress` with which a calibration begins, and not a check motion."""


class Event(msgspec.Struct, frozen=True, eq=False):
    """A message that a client must not miss. ``seq`` counts from the core's start; ``t_ns`` monotonic."""

    seq: int
    t_ns: int
    kind: EventKind
    message: str = ""
    id: str = ""
    request: int = -1
    accepted: bool | None = None
    reasons: tuple[Reason, ...] = ()
    joints: FloatArray | None = None
    samples: tuple[Sample, ...] = ()
    trial: int = -1
    name: str = ""
    error_px: float | None = None
    progress: float | None = None
    plan: PlanReport | None = None
    """Of a reply to a goal that was planned."""
    path: PathRecord | None = msgspec.field(default=None, name="way")
    """Of a calibration's sweep, or of the path to its stop."""
    loads: JointLoads | None = None
    """Of finished trial motions, if the drives report loads."""
    cameras: tuple[str, ...] = ()
    """Of ``reanchor`` and the events after it: cameras that have moved; ``rigid``: as one body."""
    rigid: bool = False
    matrix: FloatArray | None = None
    """Of ``camera_adjusted``: the matrix (3, 4) of the camera ``name``, in the frame of model ``epoch``."""
    epoch: int = 0


class Status(CoreStatus[FloatArray], frozen=True, eq=False):
    """The state of the core after a step."""


class StepOutputs(msgspec.Struct, frozen=True, eq=False):
    """Outputs of a step. ``command`` (n,) to write, or None if nothing may be written in this lifecycle state."""

    command: FloatArray | None
    status: Status
    priors: tuple[Prior, ...] = ()
    events: tuple[Event, ...] = ()
    driver_request: Literal["", "activate", "deactivate", "reset"] = ""

    @property
    def step(self) -> int:
        """Number of the step."""
        return self.status.step

    @property
    def raw(self) -> FloatArray:
        """Velocity (n,) before the safety stage."""
        return self.status.command_raw

    @property
    def values(self) -> FloatArray:
        """The values of `StepResult`."""
        status, command = self.status, self.command
        error_px = NOT_MEASURED if status.error_px is None else status.error_px
        given = np.zeros_like(status.command_raw) if command is None else command
        return np.concatenate([[error_px], status.command_raw, status.velocities, given])


NOT_MEASURED = -1e300
"""Value of an error that is not measured."""


class StepResult(Protocol):
    """The values of a step's outputs that a recording keeps, as in `StepOutputs`. ``values`` (1 + 3n,): the error [px]
    of the active goal, the velocity before the safety stage, the filtered velocities of the joints, and the command
    (zero if there is none).
    """

    @property
    def command(self) -> FloatArray | None: ...
    @property
    def events(self) -> tuple[Event, ...]: ...
    @property
    def driver_request(self) -> str: ...
    @property
    def step(self) -> int: ...
    @property
    def raw(self) -> FloatArray: ...
    @property
    def values(self) -> FloatArray: ...


_DTYPES = {dtype.str: dtype for dtype in map(np.dtype, "?bBhHiIqQfd")}
"""Types of arrays that are accepted: `numpy.dtype` of arbitrary text would run a parser on it."""


def encode_array(value: object) -> object:
    """msgspec ``enc_hook``: an array as (dtype, shape, bytes), bit for bit."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, list(value.shape), np.ascontiguousarray(value).tobytes())
    raise NotImplementedError(f"cannot encode {type(value).__name__}")


def decode_array(kind: type, value: object) -> object:
    """msgspec ``dec_hook``, inverse of :func:`encode_array`. Raises ValueError or TypeError before
    memory is allocated.
    """
    parts: Any = value
    name, shape, data = parts
    dtype = _DTYPES.get(name) if isinstance(name, str) else None
    if dtype is None:
        raise ValueError(f"an array of {name!r:.40}; numbers are valid: {', '.join(_DTYPES)}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"an array of shape {shape!r:.80} and type {name!r} in {len(data)} bytes")
    array: npt.NDArray[np.generic] = np.frombuffer(data, dtype=dtype).reshape(shape).copy()
    return array


_encoder = msgspec.msgpack.Encoder(enc_hook=encode_array)


def encode(value: object) -> bytes:
    """A struct, or any object made of structs and arrays, as msgpack; arrays bit for bit."""
    return _encoder.encode(value)


def check_observation(observation: CameraObservation) -> None:
    """Raise ValueError unless an observation's arrays have the required shapes and types; compiled kernels accept no
    others.
    """
    ids = observation.ids
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise ValueError(f"ids are {ids.dtype} of shape {ids.shape}; integers (k,) are needed")
    for name, array, shape in (
        ("pixels", observation.pixels, (len(ids), 2)),
        ("covariances", observation.covariances, (len(ids), 2, 2)),
    ):
        if array.shape != shape or array.dtype.char != "d":
            raise ValueError(
                f"{name} are {array.dtype} of shape {array.shape}; float64 {shape} are needed for {len(ids)} ids"
            )
