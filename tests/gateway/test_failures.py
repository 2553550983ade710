"""What a client is told of a calibration that ended badly: the code of its cause."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from stereoservo.client import FailedError
from stereoservo.core.cycle import Event
from stereoservo.daemon.kernel_compilation import example_settings
from stereoservo.gateway.calibration_jobs import CalibrationJobs
from stereoservo.gateway.persistence import ModelStore
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import EventMessage


def event(**fields: Any) -> EventMessage:
    return EventMessage(seq=1, boot="b", t_ns=0, t_wall=0.0, **fields)


@pytest.mark.parametrize("code", ["MARKERS_NOT_SEEN", "CAMERA_SILENT", "TRIAL_TOO_SMALL"])
def test_a_motion_that_ends_early_has_the_code_of_its_reason(code: str) -> None:
    reason = Reason(code, "hold", "left", 2.0, 4.0, "markers", "2 markers of 4")
    error = FailedError("calibration", event(kind="calibration_aborted", reasons=(reason,)))
    assert error.code == code


def test_a_fit_that_fails_has_the_code_of_the_fit() -> None:
    error = FailedError("calibration", event(kind="calibration_failed", name="no_baseline"))
    assert error.code == "no_baseline"


def test_without_name_or_reason_it_has_failed() -> None:
    assert FailedError("calibration", event(kind="calibration_aborted")).code == "failed"


def test_trial_motions_without_a_stop_fail_with_their_code(tmp_path: Path) -> None:
    log = EventLog("boot", lambda _: None)
    link = cast(ServoConnection, object())  # nothing is given to the core: there is no model
    calibration = CalibrationJobs(example_settings(), ModelStore(tmp_path), link, log, tmp_path / "checks.jsonl")
    calibration.on_core_event(Event(1, 1, "calibration_finished", id="g"), fresh=True)
    while calibration.busy:
        calibration.poll()
    (told,) = log.since(1).events
    assert (told.kind, told.name) == ("calibration_failed", "too_few_stops")
    assert FailedError("calibration", told).code == "too_few_stops"
