"""Requests of a client to calibrate a cell, check its model or reset joint zeros: runs the motion under a lease and
waits for the result.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable
from contextlib import suppress

from stereoservo.client.connection import Connection
from stereoservo.client.errors import FailedError, TimedOutError
from stereoservo.client.events import EventWatch, HeardEvents
from stereoservo.client.goal_handle import Lease
from stereoservo.messages.check_report import CheckReport, ZeroReset
from stereoservo.messages.goals import Calibrate
from stereoservo.messages.wire import CalibrationResult, EventMessage

REPORT_TIMEOUT_S = 120.0
Progress = Callable[[EventMessage], None]


def calibrate(
    connection: Connection,
    progress: Progress | None,
    timeout_s: float,
    *,
    report: bool,
    lease_s: float | None,
) -> CalibrationResult:
    """Implementation of `Client.calibrate`."""
    command = Calibrate(str(uuid.uuid4()), lease_s=lease_s)
    event = _run(connection, command, "calibrated", progress, timeout_s, report)
    if event.calibration is None:
        raise FailedError("calibration", event)
    return event.calibration


def check_model(
    connection: Connection, progress: Progress | None, timeout_s: float, lease_s: float | None
) -> CheckReport:
    """Implementation of `Client.check_model`."""
    command = Calibrate(str(uuid.uuid4()), check=True, lease_s=lease_s)
    event = _run(connection, command, "checked", progress, timeout_s, False)
    if event.check is None:
        raise FailedError("check", event)
    return event.check


def reset_zeros(
    connection: Connection, progress: Progress | None, timeout_s: float, lease_s: float | None
) -> ZeroReset:
    """Implementation of `Client.reset_zeros`."""
    command = Calibrate(str(uuid.uuid4()), check=True, lease_s=lease_s, reset_zeros=True)
    event = _run(connection, command, "zeros_reset", progress, timeout_s, False)
    if event.reset is None:
        raise FailedError("reset of joint zeros", event)
    return event.reset


def _run(
    connection: Connection,
    command: Calibrate,
    success: str,
    progress: Progress | None,
    timeout_s: float,
    report: bool,
) -> EventMessage:
    lease: Lease | None = None

    def hear(event: EventMessage) -> None:
        if lease is not None and event.kind in ("calibration_finished", "check_finished"):
            lease.end()
        if progress is not None:
            progress(event)

    with EventWatch(connection) as watch:
        heard = HeardEvents(watch, lambda event: event.id == command.id, hear)
        connection.command("calibrate", command)
        lease = Lease(connection, command.id, command.lease_s)
        try:
            end = heard.wait((success, "calibration_failed", "calibration_aborted"), "calibration", timeout_s)
        finally:
            lease.end()
        if report and end.kind != "calibration_aborted":
            with suppress(TimedOutError):  # the model exists; an event announces its report, if it comes
                heard.wait(("calibration_report",), "the report", REPORT_TIMEOUT_S)
    return end
