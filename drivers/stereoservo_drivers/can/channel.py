"""CAN channel over any python-can interface; its failures are raised as typed errors with remedies."""

from __future__ import annotations

import difflib
import errno
import json
import shutil
import socket
import subprocess
import termios
import time
from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol

import can
import msgspec

from stereoservo.messages.addresses import Address
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame, from_message, to_message
from stereoservo_drivers.can.slcan import SlcanBus, SlcanGarbledError, SlcanRefusedError
from stereoservo_drivers.can.slcan_lines import flags_in_words

SEND_TIMEOUT_S = 0.05
BATCH = 512
"""Largest number of frames returned by one ``receive``: a babbling node must not block the caller for ever."""
_KEPT_ERRORS = 256
NEEDS = {
    "canalystii": "the package canalystii (`pip install canalystii`)",
    "cantact": "the package cantact (`pip install cantact`)",
    "etas": "ETAS's BOA library, which is for Windows",
    "gs_usb": "the packages gs-usb and pyusb (`pip install 'python-can[gs_usb]'`) and libusb; on Linux, take socketcan",
    "iscan": "Thorsis's library iscandrv",
    "ixxat": "HMS's VCI driver, which is for Windows",
    "kvaser": "Kvaser's CANlib (libcanlib.so of the package linuxcan); on Linux, socketcan does without",
    "neousys": "Neousys's library wdt_dio",
    "neovi": "the packages python-ics and filelock (`pip install 'python-can[neovi]'`)",
    "nican": "National Instruments' NI-CAN driver, which is for Windows",
    "nixnet": "the package nixnet (`pip install 'python-can[nixnet]'`) and NI-XNET, which is for Windows",
    "pcan": "PEAK's PCAN-Basic library (libpcanbasic.so of the package pcanbasic); on Linux, socketcan does without",
    "systec": "SYS TEC's USB-CANmodul library, which is for Windows",
    "usb2can": "the package pywin32 and 8devices' usb2can library, which are for Windows",
    "vector": "Vector's XL Driver Library, which is for Windows",
}
"""Interface of python-can -> what it needs in addition to python-can."""
_FULL = (errno.ENOBUFS, errno.EAGAIN, errno.ETIMEDOUT)


class ChannelOptions(Protocol):
    """Options to open a channel; part of ``CanOptions``, too."""

    @property
    def interface(self) -> str: ...

    @property
    def channel(self) -> str | int: ...

    @property
    def bitrate(self) -> int: ...

    @property
    def interface_options(self) -> Mapping[str, Any]: ...


class ChannelSettings(msgspec.Struct, frozen=True):
    """The channel options as a separate struct."""

    interface: str
    channel: str | int
    bitrate: int = 1_000_000
    interface_options: dict[str, str | int | float | bool] = {}


class Channel:
    """An open CAN bus; opened by the constructor. One thread receives; others may send meanwhile if the interface is
    ``stereoservo_slcan`` or ``socketcan``.

    ``frames_sent``, ``frames_received``: counts. Every method raises DriverError with code ``can_open``,
    ``connection_lost`` (unplugged, peer gone, interface down), ``bus_off``, ``send_timeout`` (no frame is accepted any
    more) or ``send_refused`` (by the adapter); bus-off is never restarted here.
    """

    def __init__(self, options: ChannelOptions, *, send_timeout_s: float = SEND_TIMEOUT_S) -> None:
        channel = options.channel
        self._shown = Address(channel) if isinstance(channel, str) else channel
        self.name = f"CAN interface {options.interface!r}, channel {self._shown!r}"
        self.frames_sent = 0
        self.frames_received = 0
        self._options = options
        self._send_timeout_s = send_timeout_s
        self._errors: deque[tuple[int, BusError]] = deque(maxlen=_KEPT_ERRORS)
        self._malformed = 0
        self._bus = self._open()
        self._fast = self._bus if isinstance(self._bus, SlcanBus) else None

    def send(self, frames: list[CanFrame]) -> None:
        """Send ``frames`` in order, in one write if the interface supports it."""
        try:
            if self._fast is not None:
                self._fast.send_many(frames, self._send_timeout_s)
            else:
                for frame in frames:
                    self._bus.send(to_message(frame), timeout=self._send_timeout_s)
        except (can.CanError, OSError) as error:
            raise self._failure(error, "sending") from error
        self.frames_sent += len(frames)

    def receive(self, timeout_s: float) -> list[tuple[int, CanFrame]]:
        """All waiting frames (at most ``BATCH``), stamped [ns, monotonic] as read; blocks until the first one.

        Errors reported by controller and line are stored for ``take_errors``; bus-off raises.
        """
        try:
            received = self._receive_fast(timeout_s) if self._fast is not None else self._receive(timeout_s)
        except (can.CanError, OSError) as error:
            raise self._failure(error, "receiving") from error
        self.frames_received += len(received)
        return received

    def take_errors(self) -> list[tuple[int, BusError]]:
        """Bus errors since the last call, stamped [ns]; the newest 256."""
        errors = list(self._errors)
        self._errors.clear()
        return errors

    def close(self) -> None:
        """Release the interface. Idempotent; errors are ignored."""
        try:
            self._bus.shutdown()
        except (can.CanError, OSError) as error:
            self._errors.append((time.monotonic_ns(), BusError("close", f"{self.name}: closing: {error}")))

    def _receive_fast(self, timeout_s: float) -> list[tuple[int, CanFrame]]:
        assert self._fast is not None
        frames = self._fast.receive_many(timeout_s)
        now = time.monotonic_ns()
        if self._fast.malformed != self._malformed:
            self._malformed = self._fast.malformed
            self._errors.append((now, BusError("malformed_line", str(self._fast.last_malformed))))
        return [(now, frame) for frame in frames]

    def _receive(self, timeout_s: float) -> list[tuple[int, CanFrame]]:
        received: list[tuple[int, CanFrame]] = []
        message = self._bus.recv(timeout_s)
        while message is not None:
            now = time.monotonic_ns()
            if message.is_error_frame:
                self._take_error(bus_error(message), now)
            elif message.is_fd:
                self._errors.append((now, BusError("fd_frame", f"CAN FD frame 0x{message.arbitration_id:X}")))
            elif message.is_rx:
                received.append((now, from_message(message)))
            if len(received) >= BATCH:
                break
            message = self._bus.recv(0)
        return received

    def _take_error(self, error: BusError, now_ns: int) -> None:
        self._errors.append((now_ns, error))
        if error.code == BUS_OFF:
            raise self._error(
                "bus_off",
                f"{error.message}. It stays off until somebody restarts it: check cable, terminators and the bit "
                f"rate ({self._options.bitrate} bit/s) of every node, then set the interface down and up",
            )

    def _open(self) -> can.BusABC:
        options = self._options
        if options.interface not in can.VALID_INTERFACES:
            known = sorted(can.VALID_INTERFACES)
            near = difflib.get_close_matches(options.interface, known, 1)
            meant = f" Did you mean {near[0]!r}?" if near else ""
            raise self._error("can_open", f"no such interface.{meant} There are: {', '.join(known)}", known=known)
        if options.interface == "socketcan":
            self._check_socketcan(str(options.channel))
        try:
            bus = can.Bus(
                interface=options.interface,
                channel=options.channel,
                bitrate=options.bitrate,
                ignore_config=True,
                **dict(options.interface_options),
            )
        except Exception as error:  # other interfaces, without the vendor's library, may raise any exception
            raise self._not_opened(error) from error
        if options.interface == "socketcan":
            enlarge_receive_buffer(bus)
        return bus

    def _check_socketcan(self, channel: str) -> None:
        if not hasattr(socket, "AF_CAN"):
            raise self._error("can_open", "this system has no socketcan; use another interface")
        state = read_state(channel)
        if state is None:
            return
        reason = objection(state, channel, self._options.bitrate)
        if reason is not None:
            raise self._error("can_open", reason, retry=True)
        if state.restart_ms:
            text = f"{channel} restarts itself {state.restart_ms} ms after bus-off; set restart-ms 0 (deploy/can)"
            self._errors.append((time.monotonic_ns(), BusError("restart_ms", text)))

    def _not_opened(self, error: BaseException) -> DriverError:
        number, cause = _errno(error), str(error) or type(error).__name__
        socketcan_name = self._options.interface == "socketcan"
        if number in (errno.EACCES, errno.EPERM):
            remedy = "No permission: is this user in group dialout (`id`)? The udev rules in deploy/can set it"
        elif number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
            remedy = f"Somebody else has it: `fuser -v {self._shown}`; another daemon on this cell?"
        elif number == errno.ECONNREFUSED:
            remedy = "Nobody listens there: is `stereoservo emulate drives CELL` or the adapter's server running?"
        elif socketcan_name and number == errno.EAFNOSUPPORT:
            remedy = "This kernel has no CAN: `modprobe can_raw`; in a container, on the host"
        elif socketcan_name:
            remedy = f"Check `ip link show {self._shown}`; deploy/can sets interfaces up"
        elif number in (errno.EISDIR, errno.ENOTTY):
            remedy = "That is no serial port; they are listed by `ls -l /dev/serial/by-id`"
        elif isinstance(error.__cause__ or error, socket.gaierror):
            remedy = "No such host: check the name, or give its address"
        elif number is None and self._options.interface in NEEDS and not isinstance(error, TypeError):
            remedy = f"It needs {NEEDS[self._options.interface]}: is it installed?"
        elif isinstance(error, TypeError):
            remedy = (
                f"Check `interface_options` ({', '.join(self._options.interface_options) or 'none given'}) against "
                f"what python-can's manual lists for interface {self._options.interface!r}"
            )
        elif number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            remedy = "Is the adapter plugged in (`ls -l /dev/serial/by-id`, `dmesg | tail`)?"
        elif isinstance(error, ValueError):
            remedy = "Check `channel`, `bitrate` and `interface_options` of the cell file"
        elif isinstance(error, (ImportError, NameError, AttributeError)):
            remedy = f"What interface {self._options.interface!r} needs is not installed: its maker's library"
        else:
            remedy = "Is the adapter plugged in and powered, its driver installed, and nobody else using it?"
        return self._error("can_open", f"cannot be opened: {cause}. {remedy}", retry=not _wrong(error))

    def _failure(self, error: Exception, doing: str) -> DriverError:
        if isinstance(error, SlcanRefusedError):
            return self._error("send_refused", f"{error}{self._status_text()}")
        if isinstance(error, SlcanGarbledError):
            return self._error(
                "connection_lost", f"{error}. Check the serial speed (`@…` in the channel) and the adapter's firmware"
            )
        number = _errno(error)
        if isinstance(error, can.CanTimeoutError) or number in _FULL or "buffer full" in str(error).lower():
            return self._error(
                "send_timeout",
                f"{doing}: nothing was taken for {self._send_timeout_s} s ({error}). Does any drive have power and "
                f"acknowledge? Check cable, terminators and bit rate ({self._options.bitrate} bit/s)",
                retry=True,
            )
        return self._error("connection_lost", f"{doing}: {error}. {self._where_it_went()}", retry=True)

    def _status_text(self) -> str:
        """The adapter's status as text, to explain a refusal."""
        assert self._fast is not None
        try:
            flags = self._fast.status_flags()
        except can.CanError as error:
            return f"; asked for its status: {error}"
        if flags is None:
            return "; it tells no status. Its buffer is full, or its channel is closed or only listens"
        return f"; its status: {flags_in_words(flags)}. Check cable, terminators and the bit rate of every node"

    def _where_it_went(self) -> str:
        if self._options.interface == "socketcan":
            return f"Check `ip -details link show {self._shown}` and the adapter's plug"
        if "://" in str(self._options.channel):
            return "The other side has closed: is it still running?"
        return "Is the adapter still plugged in (`dmesg | tail`)?"

    def _error(self, code: str, text: str, *, retry: bool = False, **data: Any) -> DriverError:
        told = self._shown.hidden_in(text) if isinstance(self._shown, Address) else text
        return DriverError(
            code,
            f"{self.name}: {told}",
            retry=retry,
            interface=self._options.interface,
            channel=str(self._shown) if isinstance(self._shown, Address) else self._shown,
            bitrate=self._options.bitrate,
            **data,
        )


def _errno(error: BaseException | None) -> int | None:
    """The system's error number, also searched in an error's causes."""
    while error is not None:
        number = getattr(error, "errno", None)
        if number is None:
            number = error.args[0] if isinstance(error, termios.error) else getattr(error, "error_code", None)
        if isinstance(number, int):
            return number
        error = error.__cause__ or error.__context__
    return None


def _wrong(error: BaseException) -> bool:
    """Whether the configuration is the cause, and not the hardware."""
    return isinstance(error, (TypeError, ValueError, ImportError, can.CanInterfaceNotImplementedError))


# -- errors of the bus ---------------------------------------------------------------------------------------
# Decoding of a CAN controller's error frames into text.


BUS_OFF = "bus_off"

_CLASSES: tuple[tuple[int, str, str], ...] = (
    (0x040, BUS_OFF, "the controller has left the bus (bus-off)"),
    (0x020, "no_acknowledge", "no node acknowledges: cable, terminators, bit rate, is any drive powered?"),
    (0x008, "protocol", "a frame breaks the protocol: bit rate, terminators, cable, two nodes with one id?"),
    (0x010, "transceiver", "the transceiver reports a fault: wires short-circuited or torn?"),
    (0x001, "transmit_timeout", "the controller could not send in time"),
    (0x100, "restarted", "the controller was restarted after bus-off"),
    (0x002, "arbitration_lost", "arbitration lost"),
    (0x080, "bus_error", "bus error"),
)
"""Bits of the id of an error frame: Linux, include/uapi/linux/can/error.h."""

_CONTROLLER = 0x004
_CONTROLLER_WORDS: tuple[tuple[int, str, str], ...] = (
    (0x01, "overflow", "receive buffer overflow: frames are lost"),
    (0x02, "overflow", "transmit buffer overflow"),
    (0x10, "error_passive", "receive errors: the controller is error-passive"),
    (0x20, "error_passive", "transmit errors: the controller is error-passive"),
    (0x04, "error_warning", "receive errors have reached the warning level"),
    (0x08, "error_warning", "transmit errors have reached the warning level"),
    (0x40, "error_active", "the controller is error-active again"),
)
"""Bits of data byte 1."""


class BusError(msgspec.Struct, frozen=True):
    """An error reported by the controller or the line. ``code``: stable; ``message``: for people."""

    code: str
    message: str


def bus_error(message: can.Message) -> BusError:
    """Decode an error frame; returns the most severe error if it reports several."""
    number, data = message.arbitration_id, bytes(message.data)
    for bit, code, words in _CLASSES[:1]:
        if number & bit:
            return BusError(code, words)
    if number & _CONTROLLER and len(data) > 1:
        for bit, code, words in _CONTROLLER_WORDS:
            if data[1] & bit:
                return BusError(code, words + _counters(data))
    for bit, code, words in _CLASSES[1:]:
        if number & bit:
            return BusError(code, words + _counters(data))
    return BusError("bus_error", f"error frame 0x{number:X} [{data.hex(' ')}]")


def _counters(data: bytes) -> str:
    if len(data) < 8 or not (data[6] or data[7]):
        return ""
    return f" (error counters: {data[6]} transmit, {data[7]} receive)"


# -- SocketCAN -----------------------------------------------------------------------------------------------
# State of a Linux CAN network interface (SocketCAN).


RECEIVE_BUFFER = 1 << 20
"""[bytes] of the socket; the default holds some 300 frames, and the kernel drops further ones (python-can #657)."""
_SO_RCVBUFFORCE = 33


class SocketcanState(msgspec.Struct, frozen=True):
    """State as `ip -details link show` reports it; None: not reported (a virtual interface has no bit rate)."""

    kind: str
    up: bool
    state: str | None = None
    bitrate: int | None = None
    restart_ms: int | None = None
    queue_length: int | None = None


def read_state(channel: str) -> SocketcanState | None:
    """State of ``channel``; None if `ip` is missing or does not have the interface."""
    command = shutil.which("ip") or shutil.which("ip", path="/usr/sbin:/sbin")
    if command is None:
        return None
    try:
        answer = subprocess.run(
            [command, "-json", "-details", "link", "show", "dev", channel],
            capture_output=True,
            timeout=2.0,
            check=False,
        )
        links = json.loads(answer.stdout or b"[]")
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None
    return state_of(links[0]) if answer.returncode == 0 and links else None


def state_of(link: dict[str, Any]) -> SocketcanState:
    """State from ``link``: one element of what `ip -json -details link show` prints."""
    about = link.get("linkinfo", {})
    facts = about.get("info_data", {})
    return SocketcanState(
        kind=about.get("info_kind", ""),
        up="UP" in link.get("flags", ()),
        state=facts.get("state"),
        bitrate=facts.get("bittiming", {}).get("bitrate"),
        restart_ms=facts.get("restart_ms", 0) if about.get("info_kind") == "can" else None,
        queue_length=link.get("txqlen"),
    )


def objection(state: SocketcanState, channel: str, bitrate: int) -> str | None:
    """Text on why ``channel`` cannot be used at ``bitrate`` [bit/s], with the remedy; None if it can."""
    if state.kind not in ("can", "vcan", "vxcan", "slcan"):
        return f"it is a network interface of kind {state.kind or 'unknown'!r}, not of CAN"
    remedy = f"ip link set {channel} down; ip link set {channel} up type can bitrate {bitrate} restart-ms 0"
    if not state.up:
        return f"the interface is down. Cure: {remedy}, or the units in deploy/can"
    if state.bitrate is not None and state.bitrate != bitrate:
        return f"it runs at {state.bitrate} bit/s, the cell says {bitrate}. Cure: {remedy}"
    if state.state == "BUS-OFF":
        return f"its controller is in bus-off. Find the cause (cable, terminators, bit rate), then: {remedy}"
    return None


def enlarge_receive_buffer(bus: can.BusABC) -> int:
    """Enlarge the receive buffer for bursts while the receiving thread is delayed; returns the size granted
    [bytes].
    """
    channel: socket.socket = bus.socket  # type: ignore[attr-defined]
    try:
        channel.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
    except PermissionError:
        # Without CAP_NET_ADMIN, limited to net.core.rmem_max.
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    return channel.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
