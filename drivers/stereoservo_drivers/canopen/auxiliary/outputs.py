"""Digital outputs of an arm's drives, written by SDO beside the cycle."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.bringup import Link
from stereoservo_drivers.canopen.options import CanOutput
from stereoservo_drivers.kit.auxiliary import verify_order

if TYPE_CHECKING:
    from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive

SDO_ORDER_ID, SDO_ANSWER_ID = 0x600, 0x580
DOWNLOAD_OUTPUTS = bytes([0x23, 0xFE, 0x60, 1])
"""Head of an SDO download of four bytes to 0x60FE:1 (CiA 301, 7.2.4.3.3)."""
DOWNLOADED = 0x60
OUTPUT_ANSWER_NS = 500_000_000
"""After which the answer to an order of outputs is taken for lost, and what is ordered is sent again."""

OUTPUTS, OUTPUT_MASK = (0x60FE, 1), (0x60FE, 2)


class DigitalOutputs:
    """Digital outputs of the drives, written without waiting for the drives' answers; ``options``: their cell file's.

    A drive is written one order at a time, for its answer does not say to which it belongs; what is ordered meanwhile
    follows. ``values``: by name, as the drives have confirmed them. Other bits of 0x60FE stay as they were found.
    """

    def __init__(self, outputs: tuple[CanOutput, ...]) -> None:
        self._outputs = {output.name: output for output in outputs}
        self._specs = tuple(output.spec() for output in outputs)
        self._ordered: dict[int, int] = {}
        self._confirmed: dict[int, int] = {}
        self._due: set[int] = set()
        self._sent: dict[int, tuple[int, int]] = {}
        self._answers: dict[int, list[CanFrame]] = {}
        self._link: Link | None = None

    def prepare(self, drive: RemoteDrive) -> None:
        """Read the outputs of a drive, and enable those that are used. Raises DriverError (``outputs``)."""
        used = [output for output in self._outputs.values() if output.node_id == drive.node_id]
        if not used:
            return
        found = drive.read_if_there(*OUTPUTS)
        if found is None:
            names = ", ".join(output.name for output in used)
            raise DriverError(
                "outputs",
                f"{drive.name} has no digital outputs (0x60FE:1); leave out: {names}",
                node_id=drive.node_id,
            )
        mask = drive.read_if_there(*OUTPUT_MASK)
        if mask is not None:
            drive.write(*OUTPUT_MASK, mask | sum(1 << output.bit for output in used), "output")
        self._ordered[drive.node_id] = self._confirmed[drive.node_id] = found
        self._due.discard(drive.node_id)
        self._sent.pop(drive.node_id, None)

    def listen(self, link: Link) -> None:
        """Take the drives' answers on ``link`` from now on."""
        self._link = link
        for node in self._ordered:
            self._answers[node] = []
            link.subscribe(SDO_ANSWER_ID + node, self._answers[node])

    def write(self, link: Link, values: Mapping[str, float]) -> None:
        """Switch outputs by name. Raises DriverError (``auxiliary``, ``connection_lost``)."""
        verify_order(values, self._specs)
        for name, value in values.items():
            output = self._outputs[name]
            rest = self._ordered[output.node_id] & ~(1 << output.bit)
            self._ordered[output.node_id] = rest | int(value) << output.bit
            self._due.add(output.node_id)
        self._exchange(link)

    def values(self) -> dict[str, float]:
        """What the drives have confirmed, by name; sends what is still to be sent. Never raises."""
        if self._link is not None:
            with suppress(DriverError):  # a bus that is lost is a fault of its own
                self._exchange(self._link)
        return {
            name: float(self._confirmed.get(output.node_id, 0) >> output.bit & 1)
            for name, output in self._outputs.items()
        }

    def _exchange(self, link: Link) -> None:
        """Take the drives' answers, then send each drive what is due. Raises DriverError."""
        now_ns = link.now_ns()
        for node, answers in self._answers.items():
            while answers:
                self._take(node, answers.pop(0).data)
            if now_ns - self._sent.get(node, (0, now_ns))[1] > OUTPUT_ANSWER_NS:
                del self._sent[node]  # its answer is lost: whether it was taken is not known
                self._due.add(node)
        for node in sorted(self._due - self._sent.keys()):
            bits = self._ordered[node]
            link.send([CanFrame(SDO_ORDER_ID + node, DOWNLOAD_OUTPUTS + bits.to_bytes(4, "little"))])
            self._due.discard(node)
            self._sent[node] = bits, now_ns

    def _take(self, node: int, data: bytes) -> None:
        """An answer of a drive: to its order, which is confirmed or, where nothing was ordered since, taken back."""
        if node not in self._sent or data[1:4] != DOWNLOAD_OUTPUTS[1:]:
            return  # to what bring-up has asked
        bits, _ = self._sent.pop(node)
        if data[0] == DOWNLOADED:
            self._confirmed[node] = bits
        elif node not in self._due:
            self._ordered[node] = self._confirmed[node]
