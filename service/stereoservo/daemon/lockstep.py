"""A cell in one process on a virtual clock, for tests and simulation: the servo and vision loops of the daemon on
in-memory links, stepped in turn.

Used by tests, experiments and ``demo --lockstep``: deterministic given the seed, and as fast as the machine.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import msgspec

from stereoservo.control.marker_groups import with_groups
from stereoservo.core.cycle import Event, ModelUpdate, Status, StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CoreSettings, core_settings
from stereoservo.daemon.camera_setup import describe_camera, make_camera
from stereoservo.daemon.ipc_messages import ServoState
from stereoservo.daemon.links import GatewayMessages, ServoLinks, VisionLinks
from stereoservo.daemon.pacing import ClockPacing
from stereoservo.daemon.servo import ServoProcess
from stereoservo.daemon.vision import CameraPipeline, camera_loop, poll_interval_s
from stereoservo.messages.cell_file import CellFile, Mount
from stereoservo.messages.goals import Command, Request
from stereoservo.ports import plugins
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import (
    CameraDescription,
    CameraDriver,
    CameraObservation,
    Detector,
    DriverContext,
    DriverError,
    JointDriver,
    Prior,
)
from stereoservo.recording.flight_recorder import FlightRecorder
from stereoservo.recording.step_messages import RecordingStart, StepMessage

REPLY_TIMEOUT_S = 60.0
"""Virtual time limit of a reply [s]: a goal is planned before it is answered."""


class LockstepTimeoutError(Exception):
    """An expected condition did not occur within the given virtual time; carries the last status."""

    def __init__(self, message: str, status: Status | None) -> None:
        super().__init__(message)
        self.status = status


class LockstepLinks(ServoLinks, Protocol):
    """The servo loop's links together with their other ends, for a `LockstepCell`.

    ``run_cameras`` is called before observations are returned: the vision loops run after the joints were read.
    """

    run_cameras: Callable[[], None]

    def vision(self, camera: str) -> VisionLinks:
        """The links of a camera's vision loop."""
        ...

    def send_request(self, request: Request) -> None:
        """Send a request to the servo loop, as the gateway does."""
        ...

    def send_model(self, update: ModelUpdate) -> None:
        """Send a model to the servo loop, as the gateway does."""
        ...

    def raise_stop(self) -> None:
        """Raise the stop."""
        ...

    def take_events(self) -> list[Event]:
        """Events since the last call, as the gateway receives them."""
        ...

    def close(self) -> None:
        """Release all. Idempotent."""
        ...


class FlightFile:
    """A `StepSink` that writes a recording; the file begins with the first message."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._recorder: FlightRecorder | None = None

    def send(self, message: StepMessage) -> bool:
        """Write a message; always accepted."""
        if isinstance(message, RecordingStart):
            self._recorder = FlightRecorder(self._path, message.settings, message.fingerprint)
        else:
            assert self._recorder is not None  # a stream begins with its start
            self._recorder.write(message)
        return True

    def close(self) -> None:
        """Finish the file. Idempotent."""
        if self._recorder is not None:
            self._recorder.close()
            if self._recorder.failure:
                raise OSError(f"{self._path}: {self._recorder.failure}")


class MemoryLinks:
    """`LockstepLinks` within one process. ``gateway_alive``: whether the gateway sends heartbeats."""

    def __init__(self, recording: Path | None = None) -> None:
        self.run_cameras: Callable[[], None] = lambda: None
        self.gateway_alive = True
        self.state: ServoState | None = None
        """The newest published state."""
        self._recorder = None if recording is None else FlightFile(recording)
        self._requests: list[Request] = []
        self._model_update: ModelUpdate | None = None
        self._stop = False
        self._events: list[Event] = []
        self._cameras: dict[str, MemoryVisionLinks] = {}

    def receive(self) -> GatewayMessages:
        """Messages sent since the last call."""
        if not self.gateway_alive:
            return GatewayMessages()
        messages = GatewayMessages(True, tuple(self._requests), self._model_update)
        self._requests, self._model_update = [], None
        return messages

    def observations(self) -> tuple[CameraObservation, ...]:
        """Run the vision loops; return the newest observation of each camera, unless it was returned before."""
        self.run_cameras()
        found = tuple(one.take() for one in self._cameras.values())
        return tuple(observation for observation in found if observation is not None)

    def stop_raised(self) -> bool:
        """Whether the stop was raised since the last call."""
        raised, self._stop = self._stop, False
        return raised

    def step_recorder(self) -> FlightFile | None:
        """Writer of the recording, if one was requested."""
        return self._recorder

    def publish_prior(self, prior: Prior) -> None:
        """Pass a prior to its camera's vision loop."""
        self._cameras[prior.camera].prior = prior

    def publish_state(self, state: ServoState) -> None:
        """Replace the state."""
        self.state = state

    def publish_events(self, events: tuple[Event, ...]) -> None:
        """Keep the events for `take_events`."""
        self._events.extend(events)

    def vision(self, camera: str) -> MemoryVisionLinks:
        """Links of a camera's vision loop; created once per camera."""
        return self._cameras.setdefault(camera, MemoryVisionLinks())

    def send_request(self, request: Request) -> None:
        """Send a request with the next cycle."""
        self._requests.append(request)

    def send_model(self, update: ModelUpdate) -> None:
        """Send a model with the next cycle."""
        self._model_update = update

    def raise_stop(self) -> None:
        """Raise the stop for the next cycle."""
        self._stop = True

    def take_events(self) -> list[Event]:
        """The events since the last call."""
        events, self._events = self._events, []
        return events

    def close(self) -> None:
        """Finish the recording. Idempotent."""
        if self._recorder is not None:
            self._recorder.close()


class MemoryVisionLinks:
    """`VisionLinks` of one camera within one process."""

    def __init__(self) -> None:
        self.prior: Prior | None = None
        self._observation: CameraObservation | None = None

    def newest_prior(self) -> Prior | None:
        """The newest prior, of any age; None before the first."""
        return self.prior

    def publish_observation(self, observation: CameraObservation) -> None:
        """Replace the observation."""
        self._observation = observation

    def take(self) -> CameraObservation | None:
        """The observation, unless it was taken before."""
        observation, self._observation = self._observation, None
        return observation


class _ScheduledCamera:
    """A vision loop on the virtual clock. The camera is opened at once."""

    def __init__(
        self,
        pipeline: CameraPipeline,
        report: Callable[[str, str], None],
        clock: VirtualClock,
        *,
        camera: str,
        poll_s: float,
    ) -> None:
        self._clock = clock
        self._loop = camera_loop(pipeline, report, clock.now_ns, camera=camera, poll_s=poll_s)
        self._due_ns = 0
        self._resume()

    def _resume(self) -> None:
        self._due_ns = self._clock.now_ns() + round(next(self._loop) * 1e9)

    def run(self) -> None:
        """Run the vision loop, if it is due, until it waits; the first run follows the opening of the camera."""
        while self._due_ns <= self._clock.now_ns():
            self._resume()

    def close(self) -> None:
        """Close the camera. Idempotent."""
        self._loop.close()


class LockstepCell:
    """A cell on a virtual clock. ``on_step`` is called with every step's inputs and outputs (logging, fault injection).

    ``links``: in memory by default; ``recording`` is only for these. Raises CellFileError, PluginError, DriverError
    (the arm or a camera cannot be opened).
    """

    def __init__(
        self,
        cell: CellFile,
        *,
        cell_dir: Path,
        runtime_dir: Path,
        seed: int = 0,
        recording: Path | None = None,
        services: dict[str, Any] | None = None,
        on_step: Callable[[StepInputs, StepOutputs], None] | None = None,
        links: LockstepLinks | None = None,
    ) -> None:
        self.cell = cell
        self.clock = VirtualClock()
        self.services: dict[str, Any] = {} if services is None else services
        self.events: list[Event] = []
        self.status: Status | None = None
        self.reports: list[tuple[str, str]] = []
        """Kind and message of each report of the vision loops."""
        self.on_step = on_step
        self.on_event: list[Callable[[Event], None]] = []
        """Called with every event, after its step."""
        self._context = (cell.cell.name, runtime_dir, cell_dir, seed)
        self._request_number = 0
        self._make_drivers()
        self.settings: CoreSettings = core_settings(cell, self.joints.describe(), self.descriptions)
        self.period_ns = round(1e9 / self.settings.rate_hz)
        self.core = ServoCore(self.settings)
        self.links: LockstepLinks = MemoryLinks(recording) if links is None else links
        self.links.run_cameras = self._run_cameras
        self.servo = ServoProcess(self.core, self.joints, self.links, self.clock, rate_hz=self.settings.rate_hz)
        self._pacing = ClockPacing(self.period_ns, now=self.clock.now_ns, sleep=self.clock.sleep)
        self.servo.configure()
        self._loops = [self._open_camera(c) for c in range(len(self.cameras))]

    def _make_drivers(self) -> None:
        self.joints: JointDriver = plugins.load(plugins.JOINT_DRIVERS, self.cell.joints.driver)(
            self.cell.joints.options, self._driver_context("", self.cell.camera[0].mount)
        )
        self.cameras: list[CameraDriver] = []
        self.detectors: list[Detector | None] = []
        descriptions: list[CameraDescription] = []
        for section in self.cell.camera:
            camera, detector = make_camera(section, self._driver_context(section.name, section.mount))
            self.cameras.append(camera)
            self.detectors.append(detector)
            descriptions.append(describe_camera(section, camera, detector))
        self.descriptions = tuple(descriptions)

    def _driver_context(self, camera: str, mount: Mount) -> DriverContext:
        name, runtime_dir, cell_dir, seed = self._context
        return DriverContext(
            self.clock, name, runtime_dir, cell_dir, camera, seed, self.services, mount, self.cell.arm_options
        )

    def _open_camera(self, c: int) -> _ScheduledCamera:
        description = self.descriptions[c]
        pipeline = CameraPipeline(self.cameras[c], self.detectors[c], self.links.vision(description.name), self.clock)
        loop = _ScheduledCamera(
            pipeline,
            lambda kind, message: self.reports.append((kind, message)),
            self.clock,
            camera=description.name,
            poll_s=min(poll_interval_s(description.rate_hz), self.period_ns * 1e-9),
        )
        if self.reports:
            raise DriverError("camera", self.reports[0][1])
        return loop

    def _run_cameras(self) -> None:
        for loop in self._loops:
            loop.run()

    def step(self) -> StepOutputs:
        """Run one cycle of the servo loop, one period of virtual time later."""
        inputs = self.servo.cycle(self._pacing)
        outputs = self.servo.core.outputs()
        fresh = self.links.take_events()
        self.status = outputs.status
        self.events.extend(fresh)
        if self.on_step is not None:
            self.on_step(inputs, outputs)
        for event in fresh:
            for listener in self.on_event:
                listener(event)
        return outputs

    # -- the gateway's part -----------------------------------------------------------------------------------

    def submit(self, command: Command, operator: str = "lockstep") -> Event:
        """Send a command and step until its reply. Raises LockstepTimeoutError."""
        since = self.events[-1].seq if self.events else 0
        self.request(command, operator)
        number = self._request_number
        return self.wait_for(lambda event: event.kind == "reply" and event.request == number, REPLY_TIMEOUT_S, since)

    def request(self, command: Command, operator: str = "lockstep") -> None:
        """Send a command without waiting for its reply."""
        self._request_number += 1
        self.links.send_request(Request(self._request_number, operator, command))

    def raise_stop(self) -> None:
        """Raise the stop."""
        self.links.raise_stop()

    def update_model(self, update: ModelUpdate) -> None:
        """Send a fitted model, with the coplanar groups of its markers, as the gateway does."""
        self.links.send_model(msgspec.structs.replace(update, model=with_groups(update.model)))

    def run_for(self, seconds: float) -> None:
        """Step for ``seconds`` of virtual time."""
        for _ in range(round(seconds * 1e9 / self.period_ns)):
            self.step()

    def wait_for(self, accepts: Callable[[Event], bool], timeout_s: float, since: int = 0) -> Event:
        """Step until an event with number > ``since`` matches. Raises LockstepTimeoutError."""
        seen = 0
        for _ in range(round(timeout_s * 1e9 / self.period_ns) + 1):
            for event in self.events[seen:]:
                if event.seq > since and accepts(event):
                    return event
            seen = len(self.events)
            self.step()
        raise LockstepTimeoutError(f"nothing of what was waited for within {timeout_s} s", self.status)

    def close(self) -> None:
        """Stop the arm and release everything."""
        self.servo.shut_down()
        for loop in self._loops:
            loop.close()
        self.links.close()

    def __enter__(self) -> LockstepCell:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
