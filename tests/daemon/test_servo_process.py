"""The servo process's cycle, driven in this process: driver faults, silence, stop, events, records."""

import ast
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import Event, check_observation, encode
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import core_settings
from stereoservo.core.state_encoding import encode_state
from stereoservo.daemon.channels.seqpacket import PacketChannel
from stereoservo.daemon.heartbeat import DRIVER_CALL_S, SERVO_HANG_S
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_CAPACITY,
    OBSERVATION_LAYOUT,
    Ask,
    Heartbeat,
    Received,
    ServoState,
    encode_observation,
    event_decoder,
    state_decoder,
    unpack_step_message,
)
from stereoservo.daemon.pacing import ClockPacing
from stereoservo.daemon.record_ring import RingReader
from stereoservo.daemon.seqlock import SlotReader, SlotWriter, StopSlot, create_slot, create_stop_slot
from stereoservo.daemon.servo import AHEAD_S, GATEWAY_SILENCE_S, RETURN_S, UNHEARD_S, ServoProcess
from stereoservo.daemon.servo_links import ProcessLinks
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.goals import (
    AuxiliarySpec,
    Command,
    Disable,
    Enable,
    Goal,
    Hold,
    Jog,
    JointTarget,
    OrderAuxiliary,
    RenewGoal,
    Request,
    Reset,
    Resume,
    RunGoal,
)
from stereoservo.messages.servo_state import STATE_LAYOUT
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import (
    CameraDescription,
    CameraObservation,
    CommandReport,
    DriverError,
    JointDriverDescription,
    JointSpec,
    JointState,
)
from stereoservo.recording import step_records
from stereoservo.recording.step_layout import decode_step
from stereoservo.recording.step_messages import RecordedCheckpoint, RecordedStep, RecordingStart

RATE_HZ = 250.0
JOINTS = tuple(JointSpec(f"j{k}", "revolute", -2.0, 2.0, 1.0, 4.0) for k in (1, 2))


class StubArm:
    """Two joints that follow at once; keeps every call."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.calls: list[str] = []
        self.written: list[FloatArray] = []
        self.positions = np.zeros(2)
        self.fail: dict[str, DriverError] = {}
        self.seq = 0
        self.reading_s = 0.0
        """How long a read takes: its sample is stamped at its end."""

    def _call(self, name: str) -> None:
        self.calls.append(name)
        if name in self.fail:
            raise self.fail[name]

    def describe(self) -> JointDriverDescription:
        return JointDriverDescription("stub", JOINTS, RATE_HZ, "clock", 0.1, 100.0)

    def configure(self) -> None:
        self._call("configure")

    def activate(self) -> None:
        self._call("activate")

    def read_state(self) -> JointState:
        self._call("read_state")
        self.clock.advance_to(self.clock.now_ns() + round(self.reading_s * 1e9))
        self.seq += 1
        velocity = self.written[-1] if self.written else np.zeros(2)
        self.positions = self.positions + velocity / RATE_HZ
        return JointState(self.seq, self.clock.now_ns(), self.positions.copy(), velocity)

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        self._call("write_velocity")
        self.written.append(qd.copy())
        return CommandReport(self.seq, self.clock.now_ns(), qd, qd, ("capped",))

    def stop(self) -> None:
        self.calls.append("stop")
        self.written.append(np.zeros(2))

    def deactivate(self) -> None:
        self._call("deactivate")

    def close(self) -> None:
        self.calls.append("close")


class SlowArm(StubArm):
    """Whose robot goes at a tenth of what it is told, and says so."""

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        super().write_velocity(0.1 * qd)
        return CommandReport(self.seq, self.clock.now_ns(), qd, 0.1 * qd, ("robot_limit",))


class GrippingArm(StubArm):
    """With a gripper beside the joints."""

    gripper = 0.0

    def describe(self) -> JointDriverDescription:
        gripper = AuxiliarySpec("gripper", "prismatic", 0.0, 0.08, 0.1)
        return msgspec.structs.replace(super().describe(), auxiliary=(gripper,))

    def write_auxiliary(self, values: dict[str, float]) -> None:
        self._call("write_auxiliary")
        self.gripper = values["gripper"]

    def read_auxiliary(self) -> dict[str, float]:
        return {"gripper": self.gripper}

    def stop_auxiliary(self) -> None:
        self.calls.append("stop_auxiliary")


class Bench:
    """A servo process, its arm, and a gateway's ends of its links, on virtual time."""

    def __init__(
        self, directory: Path, *, dry_run: bool = False, kernels: Any = None, arm: type[StubArm] = StubArm
    ) -> None:  # fmt: skip
        self.directories = CellDirectories("bench", directory, directory)
        create_stop_slot(self.directories.stop_slot)
        create_slot(self.directories.observation_slot("left"), OBSERVATION_CAPACITY, OBSERVATION_LAYOUT)
        cell = check_cell(
            {
                "schema": 1,
                "cell": {"name": "bench"},
                "joints": {"driver": "stub"},
                "camera": [{"name": "left", "driver": "stub"}],
                "safety": {
                    "limit": [
                        {"joint": j.name, "min": -2.0, "max": 2.0, "velocity": 1.0, "acceleration": 4.0} for j in JOINTS
                    ]
                },
            }
        )
        self.clock = VirtualClock()
        self.arm = arm(self.clock)
        camera = CameraDescription("stub", "left", 640, 480, 30.0, "observations", 100.0, (0, 1, 2))
        core = ServoCore(core_settings(cell, self.arm.describe(), (camera,)))
        self.links = ProcessLinks(self.directories, ("left",))
        self.beats: list[float] = []
        """How long the next sign of life may take, each time that one was given."""
        self.process = ServoProcess(
            core, self.arm, self.links, self.clock, rate_hz=RATE_HZ, dry_run=dry_run, beat=self.beats.append,
            kernels=kernels,
        )  # fmt: skip
        self.pacing = ClockPacing(round(1e9 / RATE_HZ), now=self.clock.now_ns, sleep=self.clock.sleep)
        self.control: PacketChannel | None = None
        self.events: list[Event] = []
        self._requests = 0

    def connect(self, last_event: int = 0) -> None:
        self.control = PacketChannel.connect(self.directories.control_socket)
        self.control.send(encode(Received(last_event)))

    def run(self, cycles: int, *, beat: bool = True) -> None:
        for _ in range(cycles):
            if beat and self.control is not None:
                self.control.send(encode(Heartbeat()))
            self.process.cycle(self.pacing)
            if self.control is not None:
                self.events += [event_decoder.decode(data) for data in self.control.receive()]

    def ask(self, command: Command) -> Event:
        assert self.control is not None
        self._requests += 1
        self.control.send(encode(Ask(Request(self._requests, "test", command))))
        self.run(1)
        return next(e for e in self.events if e.kind == "reply" and e.request == self._requests)

    def state(self) -> ServoState:
        with SlotReader(self.directories.state_slot, STATE_LAYOUT) as reader:
            data = reader.poll()
        assert data is not None
        return state_decoder.decode(data)

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events if event.kind != "reply"]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    bench.connect()
    bench.process.configure()
    bench.run(5)
    yield bench
    bench.links.close()


def enabled(bench: Bench) -> None:
    assert bench.ask(Enable()).accepted
    bench.run(3)
    assert bench.state().driver_active


def jog(bench: Bench, cycles: int = 20) -> None:
    """Jog for some cycles, renewing the lease."""
    for _ in range(cycles):
        assert bench.ask(Jog({"j1": 0.5}, 0.1)).accepted


def test_a_request_is_answered_and_moves_the_arm(bench: Bench) -> None:
    enabled(bench)
    jog(bench)
    assert bench.arm.written[-1][0] > 0.1
    assert bench.arm.positions[0] > 0.0
    bench.run(25)
    assert bench.state().differences == ("capped",)


def test_an_arm_that_was_sent_less_than_commanded_is_not_taken_for_a_lagging_joint(tmp_path: Path) -> None:
    """It ended as a fault, with a travel that the joint was never sent; the true reason is told, and recorded."""
    bench = Bench(tmp_path, arm=SlowArm)
    bench.connect()
    bench.process.configure()
    bench.run(5)
    enabled(bench)
    ring = RingReader(bench.directories.steps_ring)
    ring.attach()
    jog(bench, round(2.0 * RATE_HZ))
    bench.run(25)
    assert bench.arm.positions[0] > 0.02
    assert bench.state().differences == ("robot_limit",)
    assert bench.state().driver_active
    steps = [unpack_step_message(data) for data in ring.read(1000)]
    inputs = [decode_step(step.data).inputs for step in steps if isinstance(step, RecordedStep)]
    told = [one.sent for one in inputs if one.sent is not None]
    assert any(sent[0] == pytest.approx(0.05) for sent in told)
    bench.links.close()


def test_a_sample_that_is_stamped_while_it_is_read_is_not_of_the_future(bench: Bench) -> None:
    bench.arm.reading_s = 0.0005
    enabled(bench)
    jog(bench)
    assert bench.arm.written[-1][0] > 0.3
    assert "JOINT_STAMP" not in [reason.code for reason in bench.state().status.reasons]


def test_a_process_that_stood_still_starts_from_rest_and_waits_for_resume(bench: Bench) -> None:
    enabled(bench)
    jog(bench, 40)
    assert bench.arm.written[-1][0] == pytest.approx(0.5)
    bench.clock.advance_to(bench.clock.now_ns() + 600_000_000)
    bench.run(1)
    assert np.abs(bench.arm.written[-1]).max() <= 4.0 / RATE_HZ
    (stopped,) = (e for e in bench.events if e.kind == "stopped")
    assert [reason.code for reason in stopped.reasons] == ["LOOP_GAP"]
    assert not bench.ask(Jog({"j1": 0.5}, 0.1)).accepted
    assert bench.ask(Resume()).accepted
    assert bench.ask(Jog({"j1": 0.5}, 0.1)).accepted
    assert 0.0 < bench.arm.written[-1][0] <= 4.0 / RATE_HZ


def test_nothing_is_written_before_enable(bench: Bench) -> None:
    bench.run(10)
    assert "write_velocity" not in bench.arm.calls
    assert not bench.ask(Jog({"j1": 0.5})).accepted


def test_gateway_silence_holds_a_moving_arm_and_only_then(bench: Bench) -> None:
    enabled(bench)
    bench.run(round(2 * GATEWAY_SILENCE_S * RATE_HZ), beat=False)
    assert "held" not in bench.kinds()
    assert not bench.state().gateway
    jog(bench)
    assert bench.state().gateway
    for _ in range(2):  # jog's own lease would end it as well: keep the core moving by hand
        bench.process.core.state.source.until_ns = 1 << 62  # type: ignore[union-attr]
    bench.run(round(0.9 * GATEWAY_SILENCE_S * RATE_HZ), beat=False)
    assert bench.arm.written[-1].any()
    bench.run(round(0.8 * GATEWAY_SILENCE_S * RATE_HZ), beat=False)
    assert bench.kinds().count("held") == 1
    (held,) = [event for event in bench.events if event.kind == "held"]
    assert "its gateway said nothing for 0.5 s" in held.message  # nobody asked for it: say why
    assert not bench.arm.written[-1].any()


LEASED = "aaaa0001"


def leased_goal(bench: Bench, lease_s: float) -> None:
    goal = Goal(LEASED, JointTarget({"j1": 1.5}), speed_scale=0.05, lease_s=lease_s)
    assert bench.ask(RunGoal(goal)).accepted


def ends(bench: Bench) -> list[Event]:
    return [event for event in bench.events if event.id == LEASED and event.kind == "goal_aborted"]


@pytest.mark.parametrize("lease_s", [0.3, 5.0])
@pytest.mark.parametrize("away_s", [0.4, 2.0, 12.0])
def test_no_lease_runs_out_while_the_gateway_could_not_hear_the_client(
    bench: Bench, away_s: float, lease_s: float
) -> None:
    """The goal ended with "the client did not renew its lease: is it alive?", of a client that lived and renewed."""
    enabled(bench)
    leased_goal(bench, lease_s)
    bench.run(round(away_s * RATE_HZ), beat=False)
    if away_s > GATEWAY_SILENCE_S:  # a new one; clients find it a little later
        assert bench.kinds().count("held") == 1
        bench.connect(bench.events[-1].seq)
        bench.run(round(0.5 * RETURN_S * RATE_HZ))
    for _ in range(8):
        assert bench.ask(RenewGoal(LEASED)).accepted
        bench.run(round(0.3 * lease_s * RATE_HZ))
    assert ends(bench) == []


def test_a_client_that_has_died_is_found_once_it_could_have_been_heard(bench: Bench) -> None:
    enabled(bench)
    leased_goal(bench, 1.0)
    bench.run(round(0.5 * RATE_HZ))
    bench.run(round(3.0 * RATE_HZ), beat=False)
    bench.connect(bench.events[-1].seq)
    heard_ns = bench.clock.now_ns()
    while not ends(bench):
        bench.run(1)
    (end,) = ends(bench)
    assert end.reasons[0].code == "LEASE_EXPIRED"
    after_s = (end.t_ns - heard_ns) * 1e-9
    assert RETURN_S + 0.5 <= after_s <= RETURN_S + 0.5 + UNHEARD_S + 2 * AHEAD_S


def test_a_gateway_that_stumbles_again_and_again_hides_no_dead_client(bench: Bench) -> None:
    enabled(bench)
    leased_goal(bench, 1.0)
    heard = 0.0
    while not ends(bench):
        bench.run(round(0.3 * RATE_HZ), beat=False)
        bench.run(round(0.3 * RATE_HZ))
        heard += 0.3
    assert heard < 2.0


def test_the_stop_slot_brakes_within_the_next_cycles_and_is_acknowledged(bench: Bench) -> None:
    enabled(bench)
    jog(bench)
    slot = StopSlot(bench.directories.stop_slot)
    word = slot.raise_stop()
    assert not slot.acknowledged(word)
    bench.run(1)
    assert slot.acknowledged(word)
    assert "stopped" in bench.kinds()
    speed = abs(bench.arm.written[-1][0])
    bench.run(round(speed / 4.0 * RATE_HZ) + 2)
    assert not bench.arm.written[-1].any()
    assert not bench.ask(Jog({"j1": 0.5})).accepted


@pytest.mark.parametrize("call", ["read_state", "write_velocity"])
def test_a_failing_driver_is_stopped_at_once_and_faults_the_cell(bench: Bench, call: str) -> None:
    enabled(bench)
    jog(bench)
    bench.arm.calls.clear()
    bench.arm.fail[call] = DriverError("connection_lost", "the cable is out")
    bench.run(2)
    assert bench.arm.calls[bench.arm.calls.index(call) + 1] == "stop"
    bench.run(20)
    assert not bench.state().driver_active
    assert bench.state().status.lifecycle == "fault"
    (fault,) = [event for event in bench.events if event.kind == "fault"]
    assert "the cable is out" in fault.message
    writes = bench.arm.calls.count("write_velocity")
    bench.run(20)
    assert bench.arm.calls.count("write_velocity") == writes


@pytest.mark.parametrize("active", [False, True])
@pytest.mark.parametrize(("ends", "code"), [(True, "DRIVER_FAULT"), (False, "JOINTS_STALE")])
def test_drives_that_end_or_hang_without_a_goal_are_a_reason_within_half_a_second(
    bench: Bench, active: bool, ends: bool, code: str
) -> None:
    if active:
        enabled(bench)
    bench.run(20)
    assert not [reason for reason in bench.state().status.reasons if reason.level != "info"]
    if ends:
        bench.arm.fail["read_state"] = DriverError("connection_lost", "the plant has ended")
    else:
        newest = bench.arm.read_state()
        bench.arm.read_state = lambda: newest  # type: ignore[method-assign]
    bench.run(round(0.5 * RATE_HZ))
    assert code in {reason.code for reason in bench.state().status.reasons}


def test_a_faulty_driver_is_not_hammered_and_reset_reconnects_it(bench: Bench) -> None:
    enabled(bench)
    bench.arm.fail["read_state"] = DriverError("connection_lost", "gone")
    bench.run(5)
    bench.arm.calls.clear()
    bench.run(50)
    assert bench.arm.calls.count("read_state") <= 3
    bench.arm.fail.clear()
    assert bench.ask(Reset()).accepted
    bench.run(25)
    assert "configure" in bench.arm.calls
    assert bench.state().status.lifecycle == "inactive"
    enabled(bench)


def test_each_cycle_is_a_sign_of_life_and_calls_that_take_long_are_announced(bench: Bench) -> None:
    bench.beats.clear()
    bench.run(3)
    assert bench.beats == [SERVO_HANG_S] * 3
    announced: list[float] = []
    bench.arm.configure = lambda: announced.append(bench.beats[-1])  # type: ignore[method-assign]
    bench.arm.activate = lambda: announced.append(bench.beats[-1])  # type: ignore[method-assign]
    bench.arm.deactivate = lambda: announced.append(bench.beats[-1])  # type: ignore[method-assign]
    enabled(bench)
    bench.arm.fail["read_state"] = DriverError("connection_lost", "gone")
    bench.run(5)
    bench.arm.fail.clear()
    assert bench.ask(Reset()).accepted
    bench.run(3)
    assert bench.beats[-1] == SERVO_HANG_S
    bench.process.shut_down()
    # Enabled; switched off for the fault; switched off and configured by the reset; switched off.
    assert announced == [DRIVER_CALL_S] * 5


def test_a_driver_that_refuses_to_activate_leaves_the_cell_in_fault(bench: Bench) -> None:
    bench.arm.fail["activate"] = DriverError("brake", "brake 2 does not release")
    bench.ask(Enable())
    bench.run(10)
    assert bench.state().status.lifecycle == "fault"
    assert "brake 2" in next(event.message for event in bench.events if event.kind == "fault")
    assert "write_velocity" not in bench.arm.calls


def test_a_dry_run_computes_and_never_touches_the_drives(tmp_path: Path) -> None:
    bench = Bench(tmp_path, dry_run=True)
    bench.connect()
    bench.process.configure()
    bench.run(5)
    assert bench.ask(Enable()).accepted
    bench.run(3)
    jog(bench)
    assert bench.state().status.command[0] > 0.0
    bench.process.shut_down()
    assert set(bench.arm.calls) == {"configure", "read_state", "close"}
    bench.links.close()


def test_shutdown_brakes_first_and_then_stops_switches_off_and_closes(bench: Bench) -> None:
    enabled(bench)
    jog(bench)
    bench.process.come_to_rest(bench.pacing, lambda: False)
    speeds = [abs(w[0]) for w in bench.arm.written[-8:]]
    assert speeds[-1] == 0.0
    assert speeds == sorted(speeds, reverse=True)
    bench.process.shut_down()
    assert bench.arm.calls[-3:] == ["stop", "deactivate", "close"]


def test_a_restarted_gateway_gets_the_events_that_it_missed_and_no_other(bench: Bench) -> None:
    enabled(bench)
    known = bench.events[-1].seq
    assert bench.control is not None
    bench.control.close()
    bench.control = None
    StopSlot(bench.directories.stop_slot).raise_stop()
    bench.run(3)
    bench.events.clear()
    bench.connect(last_event=known)
    bench.run(2)
    assert [event.kind for event in bench.events] == ["stopped"]
    bench.events.clear()
    bench.connect(last_event=0)
    bench.run(2)
    assert [event.seq for event in bench.events] == list(range(1, known + 2))


def test_records_begin_with_a_checkpoint_and_a_full_ring_makes_a_counted_gap(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    ring = RingReader(bench.directories.steps_ring)
    bench.run(4)
    assert ring.read(100) == []  # nobody reads yet: nothing is written
    ring.attach()
    bench.run(4)
    start, checkpoint, *records = [unpack_step_message(data) for data in ring.read(100)]
    assert isinstance(start, RecordingStart)
    assert start.settings.joint_names == ("j1", "j2")
    assert isinstance(checkpoint, RecordedCheckpoint)
    numbers = [decode_step(r.data).step for r in records if isinstance(r, RecordedStep)]
    assert numbers == list(range(checkpoint.step + 1, checkpoint.step + 5))
    bench.process._stream.dropped = 0
    filled = bytes(1 << 20)
    writer = bench.links._steps
    while writer.write(filled):
        pass
    encoded: list[int] = []
    monkeypatch.setattr(step_records, "encode_state", lambda state: encoded.append(state.step) or encode_state(state))
    while bench.process._stream.dropped == 0:
        bench.run(50)
    bench.run(100)
    pause = bench.process._stream._try_again
    assert np.diff(encoded).min() > pause > 10  # the whole state is not encoded in every step
    drained = [unpack_step_message(data) for data in ring.read(100_000) if data != filled]
    assert not any(isinstance(r, RecordedCheckpoint) and r.lost for r in drained)
    last = max(decode_step(r.data).step for r in drained if isinstance(r, RecordedStep))
    bench.run(pause + 2)
    gap, after, *_ = [unpack_step_message(data) for data in ring.read(100)]
    assert isinstance(gap, RecordedCheckpoint)
    assert gap.lost == bench.process._stream.dropped
    assert isinstance(after, RecordedStep)
    assert decode_step(after.data).step == last + gap.lost + 1
    ring.detach()
    bench.run(2)
    assert ring.read(100) == []
    ring.close()


def module_level_imports(name: str) -> set[str]:
    """Modules that ``name`` imports when it is imported."""
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.origin is not None
    found: set[str] = set()
    for node in ast.parse(Path(spec.origin).read_text()).body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found.add(node.module)
            package = importlib.util.find_spec(node.module)
            if node.module.startswith("stereoservo") and package is not None and package.submodule_search_locations:
                candidates = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= {module for module in candidates if importlib.util.find_spec(module)}
    return found


def test_the_servo_process_reaches_neither_json_nor_logging_nor_images() -> None:
    """Of its own modules; what numba imports is there before the loop starts."""
    forbidden = {
        "json",
        "logging",
        "zenoh",
        "cv2",
        "scipy",
        "mcap",
        "rich",
        "typer",
        "pybullet",
        "multiprocessing",
    }
    seen: set[str] = set()
    waiting = {"stereoservo.daemon.servo"}
    while waiting:
        name = waiting.pop()
        seen.add(name)
        imports = module_level_imports(name)
        assert not {module.split(".")[0] for module in imports} & forbidden, f"{name} imports {imports}"
        waiting |= {module for module in imports if module.startswith("stereoservo")} - seen
    assert "stereoservo.core.servo_core" in seen


def test_what_another_process_wrote_wrongly_is_left_out_and_told_and_the_loop_goes_on(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    slot = bench.directories.observation_slot("left")
    state = SlotReader(bench.directories.state_slot, STATE_LAYOUT)
    control = PacketChannel.connect(bench.directories.control_socket)
    damaged = (
        b"", b"\xff", b"\x91" * 60_000, b"\x80", encode(["left", 1, 2, 3]), encode({"camera": "\ud7ff", "ids": [1]}),
        encode({"camera": "left", "seq": 1, "t_shutter_ns": 1, "t_received_ns": 1, "ids": ["(" * 1000, [1], b""]}),
    )  # fmt: skip
    with SlotWriter(slot, OBSERVATION_CAPACITY, OBSERVATION_LAYOUT) as writer:
        for data in damaged:
            writer.write(data)
            control.send(data or b"\0")
            bench.process.cycle(bench.pacing)
    for _ in range(10):
        bench.process.cycle(bench.pacing)
    data = state.poll()
    assert data is not None
    from_gateway, observations = state_decoder.decode(data).notes
    assert from_gateway.startswith(f"messages of the gateway: {len(damaged)} records left out")
    assert observations.startswith(f"observation-left.slot: {len(damaged)} records left out")
    control.close()
    bench.links.close()


@pytest.mark.parametrize(
    "change",
    [
        {"ids": np.array(3)},
        {"ids": np.arange(3)[:, None]},
        {"ids": np.arange(7)},
        {"ids": np.arange(3.0)},
        {"pixels": np.zeros(6)},
        {"pixels": np.zeros((3, 3))},
        {"pixels": np.zeros((3, 2), np.int64)},
        {"covariances": np.zeros((2, 2, 2))},
        {"covariances": np.zeros(3)},
        {"covariances": np.zeros((3, 2, 2), np.float32)},
    ],
    ids=lambda change: ", ".join(f"{key} {array.dtype} {array.shape}" for key, array in change.items()),
)
def test_an_observation_of_wrong_shapes_never_reaches_the_core(tmp_path: Path, change: dict[str, Any]) -> None:
    bench = Bench(tmp_path)
    now = bench.clock.now_ns()
    good = CameraObservation("left", 1, now, now, np.arange(3), np.zeros((3, 2)), np.zeros((3, 2, 2)))
    slot = bench.directories.observation_slot("left")
    with pytest.raises(ValueError, match="needed"):  # a vision process takes none of its driver
        check_observation(msgspec.structs.replace(good, **change))
    with SlotWriter(slot, OBSERVATION_CAPACITY, OBSERVATION_LAYOUT) as writer:
        for data in (encode_observation(good)[:-8], encode_observation(good) + bytes(8)):
            writer.write(data)
            assert bench.links.observations() == ()
        writer.write(encode_observation(good))
        (taken,) = bench.links.observations()
        check_observation(taken)
        assert encode(taken) == encode(good)
    bench.links.close()


class Kernels:
    """Kernels to come: loaded with the tenth call."""

    def __init__(self) -> None:
        self.asked: list[bool] = []
        self.loaded = False
        self.moving = lambda: False

    def advance(self, now_ns: int) -> None:
        self.asked.append(self.moving())
        self.loaded = len(self.asked) == 10


def test_kernels_are_loaded_at_rest_alone_and_told_until_they_are(tmp_path: Path) -> None:
    kernels = Kernels()
    bench = Bench(tmp_path, kernels=kernels)
    kernels.moving = lambda: bool(np.any(bench.arm.written[-1:]))
    bench.connect()
    bench.process.configure()
    bench.run(1)
    enabled(bench)
    jog(bench)
    before = len(kernels.asked)
    assert before < 10
    jog(bench)
    assert len(kernels.asked) == before, "the arm moved"
    assert "COMPILING" in [reason.code for reason in bench.state().status.reasons]
    bench.run(400)
    assert len(kernels.asked) == 10
    assert not any(kernels.asked)
    assert "COMPILING" not in [reason.code for reason in bench.state().status.reasons]
    bench.links.close()


@pytest.fixture
def gripping(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path, arm=GrippingArm)
    bench.connect()
    bench.process.configure()
    bench.run(5)
    yield bench
    bench.links.close()


CLOSE = OrderAuxiliary({"gripper": 0.03})


def test_an_order_to_a_gripper_goes_to_the_driver_while_the_arm_is_on(gripping: Bench) -> None:
    refused = gripping.ask(CLOSE)
    assert (refused.accepted, refused.reasons[0].code) == (False, "NOT_ACTIVE")
    enabled(gripping)
    assert gripping.ask(CLOSE).accepted
    gripping.run(10)
    assert gripping.state().auxiliary == {"gripper": 0.03}
    assert gripping.ask(Hold()).accepted
    assert gripping.ask(CLOSE).accepted, "a held arm lets a gripper close"
    assert gripping.arm.calls.count("write_auxiliary") == 2
    assert gripping.ask(Disable()).accepted
    gripping.run(2)
    assert not gripping.ask(CLOSE).accepted


def test_a_stop_stops_the_gripper_and_refuses_its_orders_until_resume(gripping: Bench) -> None:
    enabled(gripping)
    StopSlot(gripping.directories.stop_slot).raise_stop()
    gripping.run(2)
    assert gripping.arm.calls.count("stop_auxiliary") == 1
    refused = gripping.ask(CLOSE)
    assert (refused.accepted, refused.reasons[0].code) == (False, "STOPPED")
    assert gripping.ask(Resume()).accepted
    assert gripping.ask(CLOSE).accepted
    assert gripping.arm.calls.count("write_auxiliary") == 1


def test_a_gripper_that_is_ordered_in_the_cycle_of_a_stop_is_stopped(gripping: Bench) -> None:
    enabled(gripping)
    gripping.run(10)
    gripping.arm.positions = gripping.arm.positions + 1.5  # a contact, or as here a reading that cannot be
    assert gripping.ask(CLOSE).accepted
    assert gripping.kinds()[-1] == "stopped"
    assert gripping.arm.calls[-2:] == ["write_auxiliary", "stop_auxiliary"]


def test_a_gripper_is_not_ordered_by_a_driver_that_has_just_failed(gripping: Bench) -> None:
    enabled(gripping)
    gripping.arm.fail["write_velocity"] = DriverError("connection_lost", "unplugged")
    gripping.ask(CLOSE)
    gripping.run(3)
    assert gripping.state().status.lifecycle == "fault"
    assert "write_auxiliary" not in gripping.arm.calls


def test_a_driver_that_refuses_an_order_to_its_gripper_is_a_fault(gripping: Bench) -> None:
    enabled(gripping)
    gripping.arm.fail["write_auxiliary"] = DriverError("connection_lost", "unplugged")
    gripping.ask(CLOSE)
    gripping.run(3)
    assert gripping.state().status.lifecycle == "fault"


def test_a_dry_run_moves_no_gripper(tmp_path: Path) -> None:
    bench = Bench(tmp_path, dry_run=True, arm=GrippingArm)
    bench.connect()
    bench.process.configure()
    bench.run(5)
    assert bench.ask(Enable()).accepted
    bench.run(3)
    assert bench.ask(CLOSE).accepted
    assert not {"write_auxiliary", "stop_auxiliary"} & set(bench.arm.calls)
    bench.links.close()
