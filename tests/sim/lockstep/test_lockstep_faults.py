"""One fault at a time, in mid-goal: the arm comes to rest, and the status names the cause.

Each fault is run on the servo and vision loops twice: on links in memory (lockstep) and on the slots and sockets of the
daemon's processes. Time is virtual in both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import Event, ModelUpdate, encode
from stereoservo.daemon.channels.seqpacket import PacketChannel
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_CAPACITY,
    OBSERVATION_LAYOUT,
    Ask,
    Heartbeat,
    NewModel,
    Received,
    ServoState,
    event_decoder,
    state_decoder,
)
from stereoservo.daemon.links import GatewayMessages, VisionLinks
from stereoservo.daemon.lockstep import LockstepCell, LockstepLinks, MemoryLinks
from stereoservo.daemon.seqlock import SlotReader, StopSlot, create_slot, create_stop_slot
from stereoservo.daemon.servo_links import ProcessLinks
from stereoservo.daemon.vision import VisionSlots
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CellFile
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.goals import Disable, Enable, Goal, Jog, Request, Reset, RunGoal
from stereoservo.messages.servo_state import STATE_LAYOUT
from stereoservo.ports.devices import CameraObservation, DriverError, JointState
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.world.history import TrueJointHistory

CAMERAS = ("left", "right")
BOUND_S = 1.5  # coast (0.5) + braking from full speed (0.25) + drives' time-out (0.1), generously


class SocketLinks(ProcessLinks):
    """`LockstepLinks` over the slots and sockets of the daemon's processes, with the other ends of them all."""

    def __init__(self, directory: Path) -> None:
        self.directories = CellDirectories("faults", directory, directory)
        create_stop_slot(self.directories.stop_slot)
        for name in CAMERAS:
            create_slot(self.directories.observation_slot(name), OBSERVATION_CAPACITY, OBSERVATION_LAYOUT)
        super().__init__(self.directories, CAMERAS)
        self.run_cameras: Callable[[], None] = lambda: None
        self.gateway_alive = True
        self._vision = {name: VisionSlots(self.directories, name) for name in CAMERAS}
        self._stop_button = StopSlot(self.directories.stop_slot)
        self._gateway_end = PacketChannel.connect(self.directories.control_socket)
        self._gateway_end.send(encode(Received(0)))

    @property
    def state(self) -> ServoState:
        with SlotReader(self.directories.state_slot, STATE_LAYOUT) as reader:
            data = reader.newest()
        assert data is not None
        return state_decoder.decode(data)

    def receive(self) -> GatewayMessages:
        if self.gateway_alive:
            self._gateway_end.send(encode(Heartbeat()))
        return super().receive()

    def observations(self) -> tuple[CameraObservation, ...]:
        self.run_cameras()
        return super().observations()

    def vision(self, camera: str) -> VisionLinks:
        return self._vision[camera]

    def send_request(self, request: Request) -> None:
        assert self._gateway_end.send(encode(Ask(request)))

    def send_model(self, update: ModelUpdate) -> None:
        assert self._gateway_end.send(encode(NewModel(update.model, update.reanchored)))

    def raise_stop(self) -> None:
        self._stop_button.raise_stop()

    def take_events(self) -> list[Event]:
        return [event_decoder.decode(data) for data in self._gateway_end.receive(1 << 12)]

    def close(self) -> None:
        self._gateway_end.close()
        self._stop_button.close()
        for slots in self._vision.values():
            slots.close()
        super().close()


LINKS: dict[str, Callable[[Path], Any]] = {
    "lockstep": lambda directory: MemoryLinks(),
    "slots and sockets": SocketLinks,
}


class Flight:
    """A cell on its way to a goal, and the truth about its arm."""

    def __init__(self, directory: Path, links: LockstepLinks, file: CellFile, model: CellModel, target: Any) -> None:
        self.links: Any = links
        self.history = TrueJointHistory.in_memory(6, capacity=1 << 14)
        self.cell = LockstepCell(
            file,
            cell_dir=directory,
            runtime_dir=directory,
            services={"world": self.history},
            links=links,
        )
        self.calls: list[str] = []
        self._inside = False
        for name in ("configure", "activate", "stop", "deactivate", "read_state", "write_velocity"):
            self._note(name)
        self.cell.run_for(0.5)
        self.operator = LockstepOperator(self.cell)
        self.operator.enable()
        self.cell.update_model(ModelUpdate(model))
        self.cell.run_for(0.3)
        self.goal = Goal("0000abcd", target)
        assert self.cell.submit(RunGoal(self.goal)).accepted
        self.cell.run_for(0.8)
        assert self.speed() > 0.1

    def _note(self, name: str) -> None:
        """Note the servo loop's calls of one of the arm's methods; not those of the arm itself."""
        call = getattr(self.joints, name)

        def noted(*arguments: Any) -> Any:
            if self._inside:
                return call(*arguments)
            self.calls.append(name)
            self._inside = True
            try:
                return call(*arguments)
            finally:
                self._inside = False

        setattr(self.joints, name, noted)

    @property
    def joints(self) -> Any:
        return self.cell.joints

    @property
    def cameras(self) -> Any:
        return self.cell.cameras

    def speed(self) -> float:
        newest = self.history.newest()
        assert newest is not None
        return float(np.abs(newest[2]).max())

    def codes(self) -> set[str]:
        assert self.cell.status is not None
        return {reason.code for reason in self.cell.status.reasons}

    def ends(self) -> list[str]:
        return [
            e.kind
            for e in self.cell.events
            if e.id == self.goal.id and e.kind.startswith("goal_") and e.kind != "goal_started"
        ]


@pytest.fixture(params=LINKS)
def flight(
    request: pytest.FixtureRequest, fake_file: CellFile, calibrated: tuple[CellModel, Any], tmp_path: Path
) -> Iterator[Flight]:
    """A cell on its way to the goal, on each kind of links."""
    flight = Flight(tmp_path, LINKS[request.param](tmp_path), fake_file, *calibrated)
    yield flight
    flight.cell.close()


def blackout(flight: Flight) -> None:
    for camera in flight.cameras:
        camera.blackout = True


def fault(**changes: int) -> Callable[[Flight], None]:
    def inject(flight: Flight) -> None:
        for name, value in changes.items():
            setattr(flight.joints.faults, name, value)

    return inject


def stamps_of_the_future(flight: Flight) -> None:
    read = flight.joints.read_state

    def ahead() -> JointState:
        sample = read()
        return msgspec.structs.replace(sample, t_ns=sample.t_ns + 3_600_000_000_000)

    flight.joints.read_state = ahead


def frames_of_the_future(flight: Flight) -> None:
    poll = flight.cameras[1].poll

    def ahead() -> list[CameraObservation]:
        return [msgspec.structs.replace(o, t_shutter_ns=o.t_shutter_ns + 3_600_000_000_000) for o in poll()]

    flight.cameras[1].poll = ahead


def standstill(flight: Flight) -> None:
    flight.cell.clock.advance_to(flight.cell.clock.now_ns() + 600_000_000)


def gateway_silent(flight: Flight) -> None:
    flight.links.gateway_alive = False


@dataclass(frozen=True)
class Fault:
    """What happens, and what is seen 1.5 s later. ``calls``: the arm's first ones but for reads and writes."""

    inject: Callable[[Flight], None]
    code: str
    lifecycle: str
    calls: tuple[str, ...] = ()


FAULTS = {
    "write": Fault(fault(fail_write=1), "DRIVER_FAULT", "fault", ("stop", "stop", "deactivate")),
    "read": Fault(fault(fail_read=1), "DRIVER_FAULT", "fault", ("stop", "stop", "deactivate")),
    "encoder and stamp stand still": Fault(fault(freeze_encoder_after=1), "JOINTS_STALE", "active"),
    "encoder stands still": Fault(fault(stuck_encoder_after=1), "JOINT_NOT_FOLLOWING", "fault", ("stop", "deactivate")),
    "commands do not arrive": Fault(fault(drop_writes_after=1), "JOINT_NOT_FOLLOWING", "fault", ("stop", "deactivate")),
    "cameras": Fault(blackout, "FEATURES_STALE", "active"),
    "joint stamps an hour ahead": Fault(stamps_of_the_future, "JOINT_STAMP", "active"),
    "frames an hour ahead": Fault(frames_of_the_future, "CAMERA_STAMP", "active"),
    "loop stands still": Fault(standstill, "LOOP_GAP", "active"),
    "stop": Fault(lambda flight: flight.cell.raise_stop(), "STOPPED", "active"),
    "gateway": Fault(gateway_silent, "", "active"),
    "disable": Fault(lambda flight: flight.cell.request(Disable()), "", "inactive", ("stop", "deactivate")),
}


@pytest.mark.parametrize("name", FAULTS)
def test_single_fault_in_mid_goal_ends_at_rest(flight: Flight, name: str) -> None:
    fault = FAULTS[name]
    flight.calls.clear()
    fault.inject(flight)
    flight.cell.run_for(BOUND_S)
    assert flight.speed() == pytest.approx(0.0, abs=1e-9)
    assert not fault.code or fault.code in flight.codes()
    assert flight.cell.status is not None
    assert flight.cell.status.lifecycle == fault.lifecycle
    assert flight.links.state.driver_active == (fault.lifecycle == "active")
    others = [call for call in flight.calls if call not in ("read_state", "write_velocity")]
    assert tuple(others[: len(fault.calls)]) == fault.calls
    assert others == [] or fault.calls
    flight.cell.run_for(1.0)
    assert flight.speed() == pytest.approx(0.0, abs=1e-9)  # no fault re-enables by itself
    assert len(flight.ends()) <= 1


def test_a_silent_gateway_holds_and_is_named_when_it_is_back(flight: Flight) -> None:
    gateway_silent(flight)
    flight.cell.run_for(BOUND_S)
    assert not flight.links.state.gateway
    flight.links.gateway_alive = True
    flight.cell.run_for(0.1)
    assert flight.links.state.gateway
    (held,) = [event for event in flight.cell.events if event.kind == "held"]
    assert "its gateway said nothing for 0.5 s" in held.message


@pytest.mark.parametrize("call", ["read", "write"])
def test_a_driver_in_fault_is_left_alone_and_reset_connects_it_again(flight: Flight, call: str) -> None:
    setattr(flight.joints.faults, f"fail_{call}", 1)
    flight.cell.run_for(0.2)
    flight.calls.clear()
    flight.cell.run_for(1.0)
    assert call != "read" or flight.calls.count("read_state") <= 11
    assert "write_velocity" not in flight.calls
    setattr(flight.joints.faults, f"fail_{call}", None)
    assert not flight.cell.submit(Enable()).accepted
    flight.calls.clear()
    assert flight.cell.submit(Reset()).accepted
    flight.cell.run_for(0.2)
    assert [name for name in flight.calls if name != "read_state"] == ["stop", "deactivate", "configure"]
    assert flight.cell.status is not None
    assert flight.cell.status.lifecycle == "inactive"
    flight.operator.enable()
    assert flight.cell.submit(Jog({"j1": 0.1}, 0.2)).accepted
    flight.cell.run_for(0.1)
    assert flight.speed() > 0.01


def test_a_reset_that_cannot_connect_stays_in_fault(flight: Flight) -> None:
    flight.joints.faults.fail_read = 1
    flight.cell.run_for(0.2)
    flight.joints.faults.fail_read = None

    def refuse() -> None:
        raise DriverError("connection_lost", "the cable is out")

    flight.joints.configure = refuse
    flight.cell.submit(Reset())
    flight.cell.run_for(0.2)
    assert flight.cell.status is not None
    assert flight.cell.status.lifecycle == "fault"
    assert not flight.links.state.driver_configured
    assert "the cable is out" in [e for e in flight.cell.events if e.kind == "fault"][-1].message


def test_an_arm_that_refuses_to_be_enabled_is_in_fault(flight: Flight) -> None:
    assert flight.cell.submit(Disable()).accepted
    flight.cell.run_for(0.2)
    flight.joints.faults.fail_activate = True
    flight.calls.clear()
    flight.cell.submit(Enable())
    flight.cell.run_for(0.2)
    assert flight.cell.status is not None
    assert flight.cell.status.lifecycle == "fault"
    assert "DRIVER_FAULT" in flight.codes()
    assert "write_velocity" not in flight.calls


def test_a_camera_that_fails_is_reported_opened_again_and_the_goal_reached(flight: Flight) -> None:
    camera = flight.cameras[1]
    poll = camera.poll

    def lost() -> list[CameraObservation]:
        raise DriverError("connection_lost", "the cable is out")

    camera.poll = lost
    flight.cell.run_for(1.0)
    camera.poll = poll
    event = flight.cell.wait_for(lambda e: e.id == flight.goal.id and e.kind in ("goal_reached", "goal_aborted"), 30.0)
    assert event.kind == "goal_reached"
    assert flight.cell.reports == [
        ("camera_lost", "camera right: the cable is out; trying again"),
        ("camera_back", "camera right delivers again"),
    ]


def test_both_cameras_dark_for_two_seconds_changes_nothing_of_the_outcome(flight: Flight) -> None:
    blackout(flight)
    flight.cell.run_for(2.0)
    for camera in flight.cameras:
        camera.blackout = False
    event = flight.cell.wait_for(lambda e: e.id == flight.goal.id and e.kind in ("goal_reached", "goal_aborted"), 30.0)
    assert event.kind == "goal_reached"


def test_goal_whose_set_points_are_of_no_displacement_is_refused(
    flight: Flight, calibrated: tuple[CellModel, Any]
) -> None:
    shown = calibrated[1]
    swapped = {camera: {**pixels, 0: pixels[3], 3: pixels[0]} for camera, pixels in shown.set_points.items()}
    reply = flight.cell.submit(RunGoal(Goal("0000abce", type(shown)(swapped))))
    assert reply.accepted is False
    assert "no displacement" in reply.message
    assert flight.ends() == []
