"""Reports of vision processes and supervisor, which the gateway forwards to clients: both ends of their channel."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from stereoservo.core.cycle import encode
from stereoservo.daemon.channels.seqpacket import ChannelError, ChannelServer, Outbox, PacketChannel
from stereoservo.daemon.ipc_messages import Received, Report, received_decoder, report_decoder
from stereoservo.daemon.process_control import write_log
from stereoservo.messages.addresses import redacted
from stereoservo.messages.decoding import RecordBoundary
from stereoservo.messages.recording_request import RecordedImages
from stereoservo.ports.devices import Clock

KEPT_REPORTS = 64


class Reporter:
    """Sends the reports of one process, oldest first, and keeps the last `KEPT_REPORTS` until the gateway has them."""

    def __init__(self, path: Path, origin: str, clock: Clock) -> None:
        self._path = path
        self._origin = origin
        self._clock = clock
        self._stream = time.monotonic_ns()
        self._number = 0
        self._lost = 0
        self._boundary = RecordBoundary("answers of the gateway", partial(write_log, origin))
        self._outbox = Outbox(KEPT_REPORTS)
        self._channel: PacketChannel | None = None

    def report(self, kind: str, message: str, images: RecordedImages | None = None) -> None:
        """Queue a report, log it, and send the queue."""
        write_log(self._origin, message)
        self._lost += self._outbox.full
        self._add(kind, message, images)
        self.flush()

    def _add(self, kind: str, message: str, images: RecordedImages | None = None) -> None:
        self._number += 1
        now_ns = self._clock.now_ns()
        report = Report(self._origin, kind, redacted(message), now_ns, images, self._stream, self._number)
        self._outbox.add(self._number, encode(report))

    def flush(self) -> None:
        """Send the queue, as far as the gateway accepts it; read its acknowledgements, and whether it has closed."""
        if not self._outbox:
            return
        if self._channel is not None:
            for data in self._channel.receive():
                with self._boundary:
                    self._outbox.release(received_decoder.decode(data).number)
        if self._lost and not self._outbox.full:
            message = f"{self._lost} reports were dropped while the gateway was away; the daemon's log has them"
            self._lost = 0
            self._add("warning", message)
        if self._channel is None or not self._channel.is_open:
            try:
                self._channel = PacketChannel.connect(self._path)
            except ChannelError:  # the gateway does not run (yet): tried again at the next flush
                return
            self._outbox.resume(0)
        self._outbox.flush(self._channel)


class ReportIntake:
    """The gateway's end: receives each report once. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._server = ChannelServer(path)
        self._boundary = RecordBoundary("reports of vision processes and supervisor", partial(write_log, "gateway"))
        self._had: dict[str, tuple[int, int]] = {}
        """For each origin its stream (a restarted process begins a new one) and the last number of the stream."""

    @property
    def note(self) -> str:
        """Text on reports that could not be read; empty if there were none."""
        return self._boundary.note

    def poll(self, take: Callable[[Report], None]) -> None:
        """Pass the received reports to ``take``, and acknowledge them to their senders, which then delete them."""
        self._server.accept()
        for peer in self._server.peers:
            for data in peer.receive():
                with self._boundary:
                    report = report_decoder.decode(data)
                    stream, number = self._had.get(report.origin, (0, 0))
                    if report.stream != stream or report.number > number:
                        take(report)
                        self._had[report.origin] = report.stream, report.number
                    peer.send(encode(Received(report.number)))

    def close(self) -> None:
        """Close all channels and remove the socket file. Idempotent."""
        self._server.close()
