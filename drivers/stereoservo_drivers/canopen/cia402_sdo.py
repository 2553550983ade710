"""SDO access to a drive's object dictionary, with errors as text, and NMT commands.

The protocol is implemented by the ``canopen`` package; frames are sent and received by the ``Link``, so that it needs
no receiving thread and no exception is lost in its callbacks.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any

import canopen
from canopen.nmt import NMT_COMMANDS, NmtMaster
from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.datatypes import SIGNED_TYPES
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError
from canopen.sdo.client import ReadableStream, WritableStream

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402 import SDO_REQUEST_ID, SDO_RESPONSE_ID, DriveAxis
from stereoservo_drivers.canopen.cia402_words import ABORT_NO_OBJECT, ABORT_NO_SUBINDEX, abort_hint, abort_words
from stereoservo_drivers.canopen.codec import Link

if TYPE_CHECKING:
    from stereoservo_drivers.canopen.cia402_configuration import Write

logging.getLogger("canopen").addHandler(logging.NullHandler())

SDO_TIMEOUT_S = 0.5
LOOK_S = 0.0002
"""Interval of checks for an awaited frame [s]."""

ABSENT = (ABORT_NO_OBJECT, ABORT_NO_SUBINDEX)

SIZES: dict[tuple[int, int], tuple[int, bool]] = {
    (0x100C, 0): (2, False), (0x100D, 0): (1, False), (0x1016, 1): (4, False), (0x1017, 0): (2, False),
    (0x6007, 0): (2, True), (0x603F, 0): (2, False), (0x605A, 0): (2, True),
    (0x605E, 0): (2, True), (0x6060, 0): (1, True), (0x6061, 0): (1, True), (0x6064, 0): (4, True),
    (0x606C, 0): (4, True), (0x6077, 0): (2, True), (0x607A, 0): (4, True), (0x607F, 0): (4, False),
    (0x6080, 0): (4, False), (0x6083, 0): (4, False), (0x6084, 0): (4, False), (0x6085, 0): (4, False),
    (0x60C1, 1): (4, True), (0x60C2, 1): (1, False), (0x60C2, 2): (1, True), (0x60F4, 0): (4, True),
    (0x60FD, 0): (4, False), (0x60FE, 1): (4, False), (0x60FE, 2): (4, False), (0x60FF, 0): (4, True),
    (0x6502, 0): (4, False),
}  # fmt: skip
"""Sizes [bytes] and signs of standard objects (CiA 301, CiA 402-2), for drives with an EDS that omits them."""
PDO_COMMUNICATION_SIZES = {0: 1, 1: 4, 2: 1, 3: 2, 4: 1, 5: 2, 6: 1}
"""Sizes [bytes] of the sub-indices of a PDO's communication record; of its mapping record, all are 4 but the first."""


class LinkNetwork(canopen.Network):
    """The ``canopen`` package's network, sending by a link. It does not receive."""

    def __init__(self, link: Link) -> None:
        super().__init__()
        self.link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send one frame. Raises DriverError (``connection_lost``)."""
        self.link.send([CanFrame(can_id, bytes(data), remote=remote)])


class _LinkSdoClient(SdoClient):
    """SDO client that lets the link run while it waits, and neither repeats nor logs."""

    def __init__(self, node_id: int, dictionary: canopen.ObjectDictionary, link: Link) -> None:
        super().__init__(SDO_REQUEST_ID + node_id, SDO_RESPONSE_ID + node_id, dictionary)
        self.network = LinkNetwork(link)
        self.link = link
        self.heard: list[CanFrame] = []

    def request_response(self, sdo_request: bytes) -> bytes:
        self.heard.clear()
        self.network.send_message(self.rx_cobid, sdo_request)
        deadline_ns = self.link.now_ns() + round(SDO_TIMEOUT_S * 1e9)
        while not self.heard:
            if self.link.now_ns() >= deadline_ns:
                raise SdoCommunicationError(f"no response within {SDO_TIMEOUT_S} s")
            self.link.wait(LOOK_S)
        response = self.heard.pop(0).data
        if len(response) != 8:
            raise SdoCommunicationError(f"a response of {len(response)} bytes, not 8")
        if response[0] == 0x80:
            raise SdoAbortedError(int.from_bytes(response[4:], "little"))
        return response

    def abort(self, abort_code: int = 0x08000000) -> None:
        self.network.send_message(self.rx_cobid, b"\x80\0\0\0" + abort_code.to_bytes(4, "little"))


class RemoteDrive:
    """The drive of ``axis`` over ``link``, with the objects of ``dictionary`` (an EDS). A context manager."""

    def __init__(self, link: Link, axis: DriveAxis, dictionary: canopen.ObjectDictionary) -> None:
        self.axis = axis
        self.node_id = axis.node_id
        self.name = axis.name
        self.dictionary = dictionary
        self._link = link
        self._client = _LinkSdoClient(axis.node_id, dictionary, link)
        self._nmt = NmtMaster(axis.node_id)
        self._nmt.network = self._client.network

    def __enter__(self) -> RemoteDrive:
        self._link.subscribe(self._client.tx_cobid, self._client.heard)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._link.unsubscribe(self._client.tx_cobid, self._client.heard)

    def error(self, code: str, message: str, *, retry: bool = False, **data: Any) -> DriverError:
        """An error of this drive, whose name precedes the ``message``."""
        return DriverError(code, f"{self.name}: {message}", retry=retry, node_id=self.node_id, **data)

    def nmt(self, command: str) -> None:
        """Send an NMT command of CiA 301 by name: ``OPERATIONAL``, ``PRE-OPERATIONAL``, ``RESET COMMUNICATION``."""
        self._nmt.send_command(NMT_COMMANDS[command])

    def variable(self, index: int, subindex: int = 0) -> ODVariable | None:
        """Entry of the EDS, None if there is none."""
        return self.dictionary.get_variable(index, subindex)

    def object_name(self, index: int, subindex: int = 0) -> str:
        """Name of an object as text: ``0x6085:0 (Quick stop deceleration)``."""
        variable = self.variable(index, subindex)
        label = f"0x{index:04X}:{subindex}"
        if variable is None:
            return label
        parent = variable.parent
        whole = "" if parent is self.dictionary else f"{parent.name}: "
        return f"{label} ({whole}{variable.name})"

    def read(self, index: int, subindex: int = 0) -> int:
        """An object's value. Raises DriverError (``sdo_abort``, ``sdo_timeout``)."""
        try:
            data = ReadableStream(self._client, index, subindex).read()
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise self._failed("reading", index, subindex, None, error) from error
        size, signed = self._layout(index, subindex) or (len(data), False)
        return int.from_bytes(data[:size], "little", signed=signed)

    def _layout(self, index: int, subindex: int) -> tuple[int, bool] | None:
        """Size of an object [bytes] and whether it is signed, from the EDS or the standard; None if neither has it."""
        variable = self.variable(index, subindex)
        if variable is not None and variable.fixed_size:
            return len(variable) // 8, variable.data_type in SIGNED_TYPES
        if 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00:
            return (4 if subindex else 1), False
        if 0x1400 <= index < 0x1A00 and subindex in PDO_COMMUNICATION_SIZES:
            return PDO_COMMUNICATION_SIZES[subindex], False
        return SIZES.get((index, subindex))

    def read_if_there(self, index: int, subindex: int = 0) -> int | None:
        """Value as by ``read``; None if the drive lacks the object, whether its EDS has it or not."""
        try:
            return self.read(index, subindex)
        except DriverError as error:
            if error.data.get("abort_code") in ABSENT:
                return None
            raise

    def write(self, index: int, subindex: int, value: int, option: str = "") -> None:
        """Write an object; one that neither its EDS nor the standard describes in the size in which the drive sends it.

        ``option``: the cell file's, for errors. Raises DriverError: ``option`` (outside the EDS's range),
        ``sdo_abort``, ``sdo_timeout``.
        """
        variable, layout = self.variable(index, subindex), self._layout(index, subindex)
        try:
            size, signed = layout or (len(ReadableStream(self._client, index, subindex).read()), value < 0)
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise self._failed("writing", index, subindex, value, error, option) from error
        low = -(1 << 8 * size - 1) if signed else 0
        high = (1 << 8 * size - signed) - 1
        if variable is not None:
            low = max(low, variable.min) if variable.min is not None else low
            high = min(high, variable.max) if variable.max is not None else high
        if not low <= value <= high:
            raise DriverError(
                "option",
                f"{self.name}: {value} for {self.object_name(index, subindex)} is outside {low} to {high} of "
                f"the EDS{_from(option)}",
                **self._data(index, subindex, value),
            )
        try:
            WritableStream(self._client, index, subindex, size).write(value.to_bytes(size, "little", signed=signed))
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise self._failed("writing", index, subindex, value, error, option) from error

    def write_all(self, writes: Iterable[Write]) -> None:
        """Write objects in order. Raises DriverError, as ``write``."""
        for write in writes:
            self.write(write.index, write.subindex, write.value, write.option)

    def _data(self, index: int, subindex: int, value: int | None) -> dict[str, Any]:
        return {
            "node_id": self.node_id,
            "joint": self.axis.joint.name,
            "object": f"0x{index:04X}:{subindex}",
            "value": value,
        }

    def _failed(
        self, doing: str, index: int, subindex: int, value: int | None, error: Exception, option: str = ""
    ) -> DriverError:
        what = f"{self.name}: {doing} {self.object_name(index, subindex)}"
        if value is not None:
            what += f" = {value}{_from(option)}"
        data = self._data(index, subindex, value)
        if isinstance(error, SdoAbortedError):
            hint = abort_hint(error.code)
            return DriverError(
                "sdo_abort",
                f"{what}: the drive refuses, {abort_words(error.code)}; {hint}",
                abort_code=error.code,
                **data,
            )
        return DriverError(
            "sdo_timeout",
            f"{what}: {error}; is the drive powered, is the cable whole and terminated, is another SDO client there?",
            retry=True,
            **data,
        )


def _from(option: str) -> str:
    return f" [option {option}]" if option else ""
