"""Lockstep: servo, vision and simulation in one process on a virtual clock, through the same interfaces.

The tests' and ``demo --lockstep``'s mode: deterministic given the seed, and as fast as the machine.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from stereoservo.runtime import plugins
from stereoservo.runtime.cameras import describe_camera, make_camera
from stereoservo.runtime.cellfile import CellFile
from stereoservo.runtime.clock import VirtualClock
from stereoservo.runtime.commands import Command, Request
from stereoservo.runtime.core import ServoCore
from stereoservo.runtime.cycle import DriverFault, Event, ModelUpdate, Status, StepInputs, StepOutputs
from stereoservo.runtime.ports import (
    CameraDescription,
    CameraDriver,
    CameraObservation,
    Detector,
    DriverContext,
    DriverError,
    Frame,
    JointDriver,
    JointState,
    Mount,
    Prior,
)
from stereoservo.runtime.record import encode_step, fingerprint
from stereoservo.runtime.recorder import CHECKPOINT_EVERY_S, FlightRecorder
from stereoservo.runtime.settings import CoreSettings, core_settings
from stereoservo.runtime.state import encode_state
from stereoservo.runtime.vision import PRIOR_MAX_AGE_S

REPLY_TIMEOUT_S = 60.0
"""Of virtual time: a goal is planned before it is answered."""


class LockstepTimeoutError(Exception):
    """What was waited for did not happen in the given virtual time; carries the last status."""

    def __init__(self, message: str, status: Status | None) -> None:
        super().__init__(message)
        self.status = status


class LockstepCell:
    """A cell on a virtual clock. ``on_step`` sees every step's inputs and outputs (logging, fault injection)."""

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
    ) -> None:
        self.cell = cell
        self.clock = VirtualClock()
        self.services: dict[str, Any] = {} if services is None else services
        self.events: list[Event] = []
        self.status: Status | None = None
        self._context = (cell.cell.name, runtime_dir, cell_dir, seed)
        self.joints: JointDriver = plugins.load(plugins.JOINT_DRIVERS, cell.joints.driver)(
            cell.joints.options, self._driver_context("")
        )
        self.cameras: list[CameraDriver] = []
        self.detectors: list[Detector | None] = []
        descriptions: list[CameraDescription] = []
        for section in cell.camera:
            camera, detector = make_camera(section, self._driver_context(section.name, section.mount))
            self.cameras.append(camera)
            self.detectors.append(detector)
            descriptions.append(describe_camera(section, camera, detector))
        self.descriptions = tuple(descriptions)
        self.settings: CoreSettings = core_settings(cell, self.joints.describe(), self.descriptions)
        self.core = ServoCore(self.settings)
        self.recorder = (
            FlightRecorder(recording, self.settings, fingerprint()) if recording is not None else None
        )
        self.on_step = on_step
        self.on_event: list[Callable[[Event], None]] = []
        """Called with every event, after its step."""
        self.period_ns = round(1e9 / self.settings.rate_hz)
        self._requests: list[Request] = []
        self._request_number = 0
        self._stop = False
        self._model_update: ModelUpdate | None = None
        self._active = False
        self._fault: DriverFault | None = None
        self._priors: dict[str, Prior] = {}
        self._last_checkpoint_ns = 0
        self.joints.configure()
        for camera in self.cameras:
            camera.configure()
            camera.activate()

    def _driver_context(self, camera: str, mount: Mount = "eye_to_hand") -> DriverContext:
        name, runtime_dir, cell_dir, seed = self._context
        return DriverContext(self.clock, name, runtime_dir, cell_dir, camera, seed, self.services, mount)

    def step(self) -> StepOutputs:
        """One period of virtual time."""
        self.clock.advance_to(self.clock.now_ns() + self.period_ns)
        joints = self._read()
        inputs = StepInputs(
            now_ns=self.clock.now_ns(),
            period_ns=self.period_ns,
            joints=joints,
            observations=tuple(self._observe()),
            requests=tuple(self._requests),
            model_update=self._model_update,
            stop=self._stop,
            driver_active=self._active,
            driver_fault=self._fault,
        )
        self._requests, self._model_update, self._stop = [], None, False
        checkpoint = self._checkpoint(inputs.now_ns)
        outputs = self.core.step(inputs)
        if self.recorder is not None:
            if checkpoint is not None:
                self.recorder.checkpoint(outputs.status.step, checkpoint, inputs.now_ns)
            self.recorder.step(encode_step(inputs, outputs), inputs.now_ns)
        self._act(outputs)
        self.status = outputs.status
        self.events.extend(outputs.events)
        for prior in outputs.priors:
            self._priors[prior.camera] = prior
        if self.on_step is not None:
            self.on_step(inputs, outputs)
        for event in outputs.events:
            for listener in self.on_event:
                listener(event)
        return outputs

    def _checkpoint(self, now_ns: int) -> bytes | None:
        due = (
            self._last_checkpoint_ns == 0 or (now_ns - self._last_checkpoint_ns) * 1e-9 >= CHECKPOINT_EVERY_S
        )
        if self.recorder is None or not due:
            return None
        self._last_checkpoint_ns = now_ns
        return encode_state(self.core.state)

    def _read(self) -> JointState | None:
        try:
            return self.joints.read_state()
        except DriverError as error:
            self._fault = DriverFault(error.code, str(error))
            return None

    def _observe(self) -> list[CameraObservation]:
        found: list[CameraObservation] = []
        for camera, detector, description in zip(
            self.cameras, self.detectors, self.descriptions, strict=True
        ):
            try:
                arrived = camera.poll()
            except DriverError:
                continue  # a camera that fails is a camera that is silent: the stale-input policy answers
            for item in arrived:
                if isinstance(item, Frame):
                    if detector is None:
                        raise ValueError(f"camera {description.name!r} delivers frames; it needs a detector")
                    found.append(detector.detect(item, self._fresh_prior(description.name)))
                else:
                    found.append(item)
        return found

    def _fresh_prior(self, camera: str) -> Prior | None:
        """As the vision process does: an old prior is none."""
        prior = self._priors.get(camera)
        if prior is None or (self.clock.now_ns() - prior.t_ns) * 1e-9 > PRIOR_MAX_AGE_S:
            return None
        return prior

    def _act(self, outputs: StepOutputs) -> None:
        try:
            if outputs.driver_request == "activate":
                self.joints.activate()
                self._active = True
            elif outputs.driver_request == "deactivate":
                self.joints.stop()
                self.joints.deactivate()
                self._active = False
            elif outputs.driver_request == "reset":
                self._fault = None
            elif outputs.command is not None and self._active:
                self.joints.write_velocity(outputs.command)
        except DriverError as error:
            self.joints.stop()
            self._active = False
            self._fault = DriverFault(error.code, str(error))

    # -- for the one who drives it --------------------------------------------------------------------------

    def submit(self, command: Command, operator: str = "lockstep") -> Event:
        """Send a command and step until its reply. Raises LockstepTimeoutError."""
        self._request_number += 1
        number = self._request_number
        self._requests.append(Request(number, operator, command))
        since = self.events[-1].seq if self.events else 0
        return self.wait_for(
            lambda event: event.kind == "reply" and event.request == number, REPLY_TIMEOUT_S, since
        )

    def request(self, command: Command, operator: str = "lockstep") -> None:
        """Send a command and do not wait for its reply."""
        self._request_number += 1
        self._requests.append(Request(self._request_number, operator, command))

    def raise_stop(self) -> None:
        """Raise the stop slot."""
        self._stop = True

    def update_model(self, update: ModelUpdate) -> None:
        """Hand a fitted model over."""
        self._model_update = update

    def run_for(self, seconds: float) -> None:
        """Step for so much virtual time."""
        for _ in range(round(seconds * 1e9 / self.period_ns)):
            self.step()

    def wait_for(self, wanted: Callable[[Event], bool], timeout_s: float, since: int = 0) -> Event:
        """Step until an event with number > ``since`` fits. Raises LockstepTimeoutError."""
        seen = 0
        for _ in range(round(timeout_s * 1e9 / self.period_ns) + 1):
            for event in self.events[seen:]:
                if event.seq > since and wanted(event):
                    return event
            seen = len(self.events)
            self.step()
        raise LockstepTimeoutError(f"nothing of what was waited for within {timeout_s} s", self.status)

    def close(self) -> None:
        """Stop the arm and release everything."""
        self.joints.stop()
        self.joints.deactivate()
        for camera in self.cameras:
            camera.deactivate()
            camera.close()
        self.joints.close()
        if self.recorder is not None:
            self.recorder.close()

    def __enter__(self) -> LockstepCell:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
