"""How a client has a cell calibrated or checked: the motion under a lease, then what came of it."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from stereoservo.gateway.errors import FailedError, TimedOutError
from stereoservo.gateway.following import EventWatch, Lease
from stereoservo.gateway.messages import CalibrationResult, EventMessage
from stereoservo.kinematics.calibration.check_report import CheckReport, ZeroReset
from stereoservo.runtime.commands import Calibrate

if TYPE_CHECKING:
    from stereoservo.gateway.client import Client

REPORT_TIMEOUT_S = 120.0
Progress = Callable[[EventMessage], None]


def calibrate(
    client: Client, progress: Progress | None, timeout_s: float, *, report: bool, lease_s: float | None
) -> CalibrationResult:
    """See `Client.calibrate`."""
    command = Calibrate(str(uuid.uuid4()), lease_s=lease_s)
    event = _run(client, command, "calibrated", progress, timeout_s, report)
    if event.calibration is None:
        raise FailedError("calibration", event)
    return event.calibration


def check_model(
    client: Client, progress: Progress | None, timeout_s: float, lease_s: float | None
) -> CheckReport:
    """See `Client.check_model`."""
    command = Calibrate(str(uuid.uuid4()), check=True, lease_s=lease_s)
    event = _run(client, command, "checked", progress, timeout_s, False)
    if event.check is None:
        raise FailedError("check", event)
    return event.check


def reset_zeros(
    client: Client, progress: Progress | None, timeout_s: float, lease_s: float | None
) -> ZeroReset:
    """See `Client.reset_zeros`."""
    command = Calibrate(str(uuid.uuid4()), check=True, lease_s=lease_s, reset_zeros=True)
    event = _run(client, command, "zeros_reset", progress, timeout_s, False)
    if event.reset is None:
        raise FailedError("reset of joint zeros", event)
    return event.reset


def _run(
    client: Client,
    command: Calibrate,
    success: str,
    progress: Progress | None,
    timeout_s: float,
    report: bool,
) -> EventMessage:
    lease: Lease | None = None

    def until(*ends: str) -> Callable[[EventMessage], bool]:
        def wanted(event: EventMessage) -> bool:
            if event.id != command.id:
                return False
            if lease is not None and event.kind in ("calibration_finished", "check_finished"):
                lease.end()
            if progress is not None:
                progress(event)
            return event.kind in ends

        return wanted

    with EventWatch(client) as watch:
        client.command("calibrate", command)
        lease = Lease(client, command.id, command.lease_s)
        try:
            end = watch.wait(
                until(success, "calibration_failed", "calibration_aborted"), "calibration", timeout_s
            )
        finally:
            lease.end()
        if report and end.kind != "calibration_aborted":
            with suppress(TimedOutError):  # the model is there; its report is told by an event, if it comes
                watch.wait(until("calibration_report"), "the report", REPORT_TIMEOUT_S)
    return end
