"""Bring-up of ODrives over CANSimple: presence, unique node ids, velocity control, and reset of errors on request.

What CANSimple cannot do: the axis watchdog (``axis0.config.enable_watchdog``, ``watchdog_timeout``), which disarms an
axis when velocities cease, and the rates of cyclic messages are configured over USB. The watchdog is all that stops
a joint when this host or the cable dies, and its setting cannot be read here: pull the cable once, arm at low
speed, before you trust it. Nor can limits and the controller's mode be read back.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen import odrive
from stereoservo_drivers.canopen.bringup import Link, listening, until
from stereoservo_drivers.canopen.odrive import OdriveCodec, frame_id
from stereoservo_drivers.canopen.options import CanOptions

STEP_S = 0.01
HEARTBEAT_WAIT_S = 0.5
"""Heartbeats come every 100 ms unless configured otherwise."""
ANSWER_WAIT_S = 0.05
QUIET_S = 0.05
"""Time in which no unrequested encoder estimates and no commands of another master may come."""
PROTOCOL_VERSION = 2
ALL_NODES = tuple(range(63))

Heard = dict[int, list[CanFrame]]
"""Data frames by node id."""


@contextmanager
def _listening(link: Link, nodes: tuple[int, ...], command: int) -> Iterator[Heard]:
    with listening(link, [frame_id(node, command) for node in nodes]) as received:
        yield {node: received[frame_id(node, command)] for node in nodes}


class OdriveBringup:
    """Bring-up of the axes of one bus. ``firmware``: version by node id, once connected."""

    def __init__(self, options: CanOptions, codec: OdriveCodec, cell_dir: Path) -> None:
        self.codec = codec
        self.firmware: dict[int, str] = {}
        self._axes = {axis.node_id: axis for axis in codec.axes}
        self._nodes = tuple(self._axes)

    def connect(self, link: Link) -> None:
        """Check every node, set velocity control and limits, leave it idle.

        Errors of drives are not cleared: the codec reports them. Raises DriverError: ``node_missing``, ``no_answer``,
        ``duplicate_node``, ``identity``, ``version``, ``cyclic_messages``, ``no_feedback``, ``not_idle``,
        ``second_master``.
        """
        self._check_alone(link)
        # Whom a master that died has left moving: before anything that can fail, and long before the idle state.
        link.send([axis.velocity(0.0) for axis in self.codec.axes])
        self._await_heartbeats(link)
        self._check_identities(link)
        self._check_versions(link)
        self._check_estimates(link)
        self._set_up(link)
        self._await_idle(link)

    def reset(self, link: Link) -> None:
        """Configure again (a drive may have rebooted), clear errors, read them. Enables nothing.

        Raises DriverError (``node_missing``, ``reset_refused``, ``no_answer``, ``not_idle``).
        """
        self._await_heartbeats(link)
        self._set_up(link)
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
        """All replies of all nodes to a remote frame within ``ANSWER_WAIT_S``; raises where one has none."""
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

    def _check_estimates(self, link: Link) -> None:
        """Check that an estimate comes only on request (in the cycle others would look like a second drive's)."""
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

    def _await_idle(self, link: Link) -> None:
        """Wait for a new heartbeat of every axis that reports idle."""

        def all_idle() -> bool:
            return all(
                frames and frames[-1].data[4:5] == bytes([odrive.IDLE]) for frames in received.values()
            )

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
                "not_idle",
                f"after {HEARTBEAT_WAIT_S} s not all axes say that they are idle: {words}",
                retry=True,
            )


def _duplicate(node: int, told: str) -> DriverError:
    return DriverError(
        "duplicate_node",
        f"more than one drive answers as node {node}: {told}; give each its own axis0.config.can.node_id",
        node_id=node,
    )
