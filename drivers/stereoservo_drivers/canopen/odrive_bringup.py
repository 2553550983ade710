"""Bring-up of ODrives over CANSimple: presence, unique node ids, velocity control, and reset of errors on request.

The axis watchdog (``axis0.config.enable_watchdog``, ``watchdog_timeout``), which disarms an axis when no velocities
arrive, and the rates of cyclic messages are configured over USB. Only the watchdog stops a joint when this host or the
cable fails. The watchdog, the velocity limit and the controller's mode are read back by RxSdo and TxSdo if the cell
file has the endpoints of the drive's release (``flat_endpoints.json``), whose numbers change with every release;
otherwise they are unknown, and reported as such: pull the cable once, with the arm at low speed, before you trust them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from stereoservo.messages.decoding import decoding
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen import odrive
from stereoservo_drivers.canopen.codec import Link, listening, until
from stereoservo_drivers.canopen.odrive import OdriveCodec, frame_id
from stereoservo_drivers.canopen.options import CanOptions

STEP_S = 0.01
HEARTBEAT_WAIT_S = 0.5
"""Time limit for heartbeats [s]: they come every 100 ms unless configured otherwise."""
ANSWER_WAIT_S = 0.05
QUIET_S = 0.05
"""Duration of the check for unrequested encoder estimates and for commands of another master [s]."""
PROTOCOL_VERSION = 2
ALL_NODES = tuple(range(63))

WATCHDOG, WATCHDOG_S = "axis0.config.enable_watchdog", "axis0.config.watchdog_timeout"
SPEED, RAMP = "axis0.controller.config.vel_limit", "axis0.controller.config.vel_ramp_rate"
CONTROL_MODE, INPUT_MODE = "axis0.controller.config.control_mode", "axis0.controller.config.input_mode"
CHECKED = (WATCHDOG, WATCHDOG_S, SPEED, RAMP, CONTROL_MODE, INPUT_MODE)
TYPES = {"bool": "?", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "float": "f"}
LEAST_CYCLES = 2.0
"""Least time-out of the watchdog [cycles]: a shorter one trips because of a single late cycle."""

Heard = dict[int, list[CanFrame]]
"""Data frames by node id."""


@contextmanager
def _listening(link: Link, nodes: tuple[int, ...], command: int) -> Iterator[Heard]:
    with listening(link, [frame_id(node, command) for node in nodes]) as received:
        yield {node: received[frame_id(node, command)] for node in nodes}


class DriveProperty(msgspec.Struct, frozen=True):
    """A property of a release: its number on the wire and its type."""

    id: int = 0
    type: str = ""


class Release(msgspec.Struct, frozen=True):
    """``flat_endpoints.json``: properties of one firmware for one hardware, by path."""

    fw_version: str
    hw_version: str
    endpoints: dict[str, DriveProperty]


def load_release(path: Path) -> Release:
    """Read a ``flat_endpoints.json``. Raises DriverError (``endpoints``)."""
    with decoding(lambda cause: DriverError("endpoints", f"endpoints: {path} {cause}", path=str(path))):
        release = msgspec.json.decode(path.read_bytes(), type=Release)
    unfit = [name for name in CHECKED if _layout(release, name) is None]
    if unfit:
        raise DriverError(
            "endpoints",
            f"endpoints: {path} has no {', '.join(unfit)}, or not as a number; take flat_endpoints.json of the release",
            path=str(path),
        )
    return release


def _layout(release: Release, name: str) -> tuple[int, struct.Struct] | None:
    endpoint = release.endpoints.get(name)
    if endpoint is None or endpoint.type not in TYPES or not 0 < endpoint.id <= 0xFFFF:
        return None
    return endpoint.id, struct.Struct("<BHB" + TYPES[endpoint.type])


class OdriveBringup:
    """Bring-up of the axes of one bus. ``firmware``, ``safety``: by node id, once connected: version, and the known
    values of watchdog, limit and ramp, as text, with whether all of them are known.
    """

    def __init__(self, options: CanOptions, codec: OdriveCodec, cell_dir: Path) -> None:
        self.codec = codec
        self.firmware: dict[int, str] = {}
        self.safety: dict[int, tuple[bool, str]] = {}
        self._options = options
        self._hardware: dict[int, str] = {}
        self._releases = [load_release(cell_dir / name) for name in options.endpoints]
        self._axes = {axis.node_id: axis for axis in codec.axes}
        self._nodes = tuple(self._axes)

    def connect(self, link: Link) -> None:
        """Check every node, set velocity control and limits, leave it idle.

        Errors of drives are not cleared: the codec reports them. Raises DriverError: ``node_missing``, ``no_answer``,
        ``duplicate_node``, ``identity``, ``version``, ``cyclic_messages``, ``no_feedback``, ``not_idle``,
        ``second_master``, ``no_watch``, ``watchdog``, ``limit``, ``mode``.
        """
        self._check_alone(link)
        # Axes that a dead master has left moving: before anything that can fail, and long before the idle state.
        link.send([axis.velocity(0.0) for axis in self.codec.axes])
        self._await_heartbeats(link)
        self._check_identities(link)
        self._check_versions(link)
        self._check_estimates(link)
        self._set_up(link)
        self._check_settings(link)
        self._await_idle(link)

    def reset(self, link: Link) -> None:
        """Configure again (a drive may have rebooted), clear errors, read them. Enables nothing.

        Raises DriverError (``node_missing``, ``reset_refused``, ``no_answer``, ``not_idle``).
        """
        self._await_heartbeats(link)
        self._set_up(link)
        self._check_settings(link)
        link.send([CanFrame(frame_id(node, odrive.CLEAR_ERRORS), bytes(8)) for node in self._nodes])
        link.wait(STEP_S)
        for node, answers in self._ask(link, odrive.GET_ERROR).items():
            axis = self._axes[node]
            self.codec.receive(answers[-1])
            if axis.errors:
                words = odrive.error_words(axis.errors)
                raise DriverError(
                    "reset_refused",
                    f"{axis.name}: {words} stays after Clear_Errors; remove the cause first",
                    retry=True,
                    node_id=node,
                    errors=axis.errors,
                )
        self._await_idle(link)
        for fault in self.codec.faults():
            if fault.code == "drive_fault":
                raise DriverError("reset_refused", fault.message, retry=True, errors=fault.value)

    def release(self, link: Link) -> None:
        """Command velocity zero and power off."""
        link.send([axis.velocity(0.0) for axis in self.codec.axes])
        link.send([axis.request(odrive.IDLE) for axis in self.codec.axes])

    def _ask(self, link: Link, command: int) -> Heard:
        """All replies of all nodes to a remote frame within ``ANSWER_WAIT_S``; raises if one has none."""
        with _listening(link, self._nodes, command) as received:
            link.send([axis.remote(command) for axis in self.codec.axes])
            link.wait(ANSWER_WAIT_S)
        answers = {node: [f for f in frames if not f.remote] for node, frames in received.items()}
        for node, frames in answers.items():
            if not frames:
                raise DriverError(
                    "no_answer",
                    f"{self._axes[node].name}: no answer to command 0x{command:02X} in {ANSWER_WAIT_S} s",
                    retry=True,
                    node_id=node,
                )
        return answers

    def _check_alone(self, link: Link) -> None:
        """Check that no other master sends velocities to these axes."""
        with _listening(link, self._nodes, odrive.SET_INPUT_VEL) as received:
            link.wait(QUIET_S)
        for node, frames in received.items():
            if frames:
                raise DriverError(
                    "second_master",
                    f"{self._axes[node].name}: somebody else commands this axis, {len(frames)} velocities within "
                    f"{QUIET_S} s; end the other master (another daemon or doctor on this bus) first",
                    retry=True,
                    node_id=node,
                    frames=len(frames),
                )

    def _await_heartbeats(self, link: Link) -> None:
        """Wait for every node's heartbeat, at most ``HEARTBEAT_WAIT_S``."""
        with _listening(link, ALL_NODES, odrive.HEARTBEAT) as received:
            until(link, lambda: all(received[node] for node in self._nodes), HEARTBEAT_WAIT_S, STEP_S)
        present = [node for node, frames in received.items() if frames]
        missing = [node for node in self._nodes if not received[node]]
        if missing:
            raise DriverError(
                "node_missing",
                f"no heartbeat of {', '.join(self._axes[node].name for node in missing)} within {HEARTBEAT_WAIT_S} s; "
                f"heard: {', '.join(f'node {node}' for node in present) or 'nobody'}. Check power, wiring, bitrate, "
                "axis0.config.can.node_id and heartbeat_msg_rate_ms",
                retry=True,
                missing=missing,
                heard=present,
            )

    def _check_identities(self, link: Link) -> None:
        for node, answers in self._ask(link, odrive.ADDRESS).items():
            axis = self._axes[node]
            serials = [int.from_bytes(frame.data[1:7], "little") for frame in answers]
            if len(answers) > 1:
                raise _duplicate(node, f"serial numbers {', '.join(f'0x{s:012X}' for s in serials)}")
            if axis.joint.serial_number not in (None, serials[0]):
                raise DriverError(
                    "identity",
                    f"{axis.name} has serial number {serials[0]}, the cell file says {axis.joint.serial_number}",
                    node_id=node,
                    serial_number=serials[0],
                )

    def _check_versions(self, link: Link) -> None:
        for node, answers in self._ask(link, odrive.VERSION).items():
            if len(answers) > 1:
                raise _duplicate(node, "two versions")
            data = answers[0].data
            if len(data) != 8 or data[0] != PROTOCOL_VERSION:
                raise DriverError(
                    "version",
                    f"{self._axes[node].name} answers {data.hex(' ')} to Get_Version; protocol version "
                    f"{PROTOCOL_VERSION} (firmware 0.6) is needed",
                    node_id=node,
                )
            self.firmware[node] = ".".join(str(number) for number in data[4:7])
            self._hardware[node] = ".".join(str(number) for number in data[1:4])

    def _check_estimates(self, link: Link) -> None:
        """Check that an estimate is only sent on request (in the cycle others would look like a second drive's)."""
        with _listening(link, self._nodes, odrive.GET_ENCODER_ESTIMATES) as unasked:
            link.wait(QUIET_S)
        for node, frames in unasked.items():
            if frames:
                raise DriverError(
                    "cyclic_messages",
                    f"{self._axes[node].name} sends encoder estimates unasked, {len(frames)} in {QUIET_S} s; set "
                    "axis0.config.can.encoder_msg_rate_ms = 0",
                    node_id=node,
                )
        for node, answers in self._ask(link, odrive.GET_ENCODER_ESTIMATES).items():
            if len(answers) > 1:
                raise _duplicate(node, f"{len(answers)} encoder estimates")
            if self.codec.receive(answers[0]) < 0:
                raise DriverError(
                    "no_feedback",
                    f"{self._axes[node].name}: encoder estimates {answers[0].data.hex(' ')} are not two finite "
                    "float32; calibrate the encoder",
                    node_id=node,
                )

    def _set_up(self, link: Link) -> None:
        mode = struct.pack("<II", odrive.VELOCITY_CONTROL, odrive.PASSTHROUGH)
        for node, axis in self._axes.items():
            link.send([axis.velocity(0.0), axis.request(odrive.IDLE)])
            link.send([CanFrame(frame_id(node, odrive.SET_CONTROLLER_MODE), mode)])
            if axis.joint.current_limit is not None:
                limits = struct.pack("<ff", axis.velocity_max, axis.joint.current_limit)
                link.send([CanFrame(frame_id(node, odrive.SET_LIMITS), limits)])

    def _check_settings(self, link: Link) -> None:
        """Read back each axis's protective settings, if its release is known. Raises DriverError if they are unsafe."""
        for node, axis in self._axes.items():
            firmware, hardware = self.firmware[node], self._hardware[node]
            known = [r for r in self._releases if (r.fw_version, r.hw_version) == (firmware, hardware)]
            told = f"watchdog, velocity limit and ramp are unknown (firmware {firmware}, hardware {hardware}): "
            if not known:
                told += "endpoints lists no flat_endpoints.json of this release"
                self.safety[node] = (False, told)
                continue
            values = {name: self._read(link, node, known[0], name) for name in CHECKED}
            silent = [name for name, value in values.items() if value is None]
            if silent:
                self.safety[node] = (False, f"{told}no answer on {', '.join(silent)}")
                continue
            found = {name: value for name, value in values.items() if value is not None}
            self.safety[node] = check_settings(axis, found, self._options)

    def _read(self, link: Link, node: int, release: Release, name: str) -> float | None:
        """One property by RxSdo; None if no answer arrives."""
        layout = _layout(release, name)
        assert layout is not None  # as checked by load_release
        number, answer = layout
        with _listening(link, (node,), odrive.TX_SDO) as received:
            request = struct.pack("<BHBI", 0, number, 0, 0)
            link.send([CanFrame(frame_id(node, odrive.RX_SDO), request)])
            until(link, lambda: bool(_answers(received[node], number, answer)), ANSWER_WAIT_S, STEP_S)
            answers = _answers(received[node], number, answer)
        return answers[-1] if answers else None

    def _await_idle(self, link: Link) -> None:
        """Wait for a new heartbeat of every axis that reports idle."""

        def all_idle() -> bool:
            return all(frames and frames[-1].data[4:5] == bytes([odrive.IDLE]) for frames in received.values())

        with _listening(link, self._nodes, odrive.HEARTBEAT) as received:
            idle = until(link, all_idle, HEARTBEAT_WAIT_S, STEP_S)
        for frames in received.values():
            for frame in frames[-1:]:
                self.codec.receive(frame)
        if not idle:
            words = "; ".join(
                f"{axis.name}: {said if received[axis.node_id] else 'silent'}"
                for axis, said in zip(self.codec.axes, self.codec.status_words(), strict=True)
            )
            raise DriverError(
                "not_idle", f"after {HEARTBEAT_WAIT_S} s not all axes say that they are idle: {words}", retry=True
            )


def _answers(frames: list[CanFrame], number: int, answer: struct.Struct) -> list[float]:
    unpacked = [answer.unpack_from(frame.data) for frame in frames if len(frame.data) >= answer.size]
    return [float(value) for _, endpoint, _, value in unpacked if endpoint == number]


def check_settings(axis: odrive.Axis, values: dict[str, float], options: CanOptions) -> tuple[bool, str]:
    """Check an axis's settings; returns whether all are valid, and the settings as text.

    Raises DriverError: ``no_watch``, ``watchdog`` (shorter than the cycle or longer than ``heartbeat_timeout_ms``),
    ``limit`` (below the joint's largest velocity), ``mode`` (not the one that was set).
    """
    data = {"node_id": axis.node_id, "joint": axis.joint.name}
    timeout_s = values[WATCHDOG_S]
    on = bool(values[WATCHDOG]) and timeout_s > 0.0
    if not on and "watch" not in axis.joint.accept_missing:
        raise DriverError(
            "no_watch",
            f"{axis.name}: its watchdog is off ({WATCHDOG} = {bool(values[WATCHDOG])}, {WATCHDOG_S} = {timeout_s:g} "
            "s): if this computer dies, it goes on with the last velocity. Set both over USB and save, or say that a "
            'safety relay cuts its power: accept_missing = ["watch"] of this joint',
            **data,
        )
    least, most = LEAST_CYCLES / options.rate_hz, options.heartbeat_timeout_ms * 1e-3
    if on and not least <= timeout_s <= most * (1.0 + 1e-6):
        raise DriverError(
            "watchdog",
            f"{axis.name}: {WATCHDOG_S} = {timeout_s:g} s; valid: {least:g} s, {LEAST_CYCLES:g} cycles at rate_hz, to "
            f"{most:g} s, heartbeat_timeout_ms. Set it over USB",
            value=timeout_s,
            **data,
        )
    speed, scale = values[SPEED], abs(axis.turns_per_unit)
    if not speed >= axis.velocity_max * (1.0 - 1e-5):
        raise DriverError(
            "limit",
            f"{axis.name}: {SPEED} = {speed:g} turns/s, {speed / scale:.3g} rad/s or m/s at the joint, is below "
            f"max_velocity {axis.joint.max_velocity:g}; lower max_velocity, or set current_limit here: "
            "the driver then sets both",
            value=speed,
            **data,
        )
    modes = int(values[CONTROL_MODE]), int(values[INPUT_MODE])
    if modes != (odrive.VELOCITY_CONTROL, odrive.PASSTHROUGH):
        raise DriverError(
            "mode",
            f"{axis.name}: control mode and input mode read {modes}, set were "
            f"{(odrive.VELOCITY_CONTROL, odrive.PASSTHROUGH)} (velocity, passthrough)",
            **data,
        )
    watchdog = f"watchdog {timeout_s:g} s" if on else "no watchdog, as accept_missing acknowledges"
    told = f"{watchdog}; velocity limit {speed:g} turns/s, {speed / scale:.3g} rad/s or m/s at the joint; ramps are "
    told += f"this driver's (its own, {values[RAMP]:g} turns/s², is not used in passthrough)"
    return on, told


def _duplicate(node: int, told: str) -> DriverError:
    return DriverError(
        "duplicate_node",
        f"more than one drive answers as node {node}: {told}; give each its own axis0.config.can.node_id",
        node_id=node,
    )
