"""That a model is in use is taken from what the core works with: events `model` tell of other things, too."""

from __future__ import annotations

import threading
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.core.cycle import Event
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.daemon.kernel_compilation import example_settings
from stereoservo.gateway.calibration_jobs import CalibrationJobs
from stereoservo.gateway.model_updates import RelocalizationJobs
from stereoservo.gateway.persistence import ModelStore
from stereoservo.gateway.publisher import EventLog
from stereoservo.messages.check_report import ZeroReset
from stereoservo.messages.wire import CalibrationResult
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import rx90

MODEL = msgspec.structs.replace(exact_model(rx90()), epoch=5)
RESULT = CalibrationResult(0.1, {}, True, "m.json", 5, "metric", 1.0, 1, 2, 1, 0, 1, 2, 3.0)
RESET = ZeroReset(5, 4, (), 3.0, 1.0, "reset")
AGREES = Event(9, 1, "model", "the images agree with the model again", name="valid")
"""An event `model` that is of no new model."""
LINK: Any = SimpleNamespace(send_model=lambda model, cameras=(): True)


def orders(*steps: Any) -> list[tuple[Any, ...]]:
    """All orders of ``steps`` in which epochs ascend."""
    return [
        order for order in permutations(steps)
        if [step for step in order if isinstance(step, int)] == sorted(step for step in steps if isinstance(step, int))
    ]  # fmt: skip


@pytest.mark.parametrize(("what", "kind"), [(RESULT, "calibrated"), (RESET, "zeros_reset")])
@pytest.mark.parametrize("order", orders(4, 5, AGREES))
def test_a_model_is_reported_once_the_core_works_with_it(
    order: tuple[Any, ...], what: CalibrationResult | ZeroReset, kind: str, tmp_path: Path
) -> None:
    log = EventLog("boot", lambda _: None)
    jobs = CalibrationJobs(example_settings(), ModelStore(tmp_path), LINK, log, tmp_path / "checks.jsonl")
    jobs._send_to_core(MODEL, "g", what, tmp_path / "m.json")
    for step in order:
        if isinstance(step, int):
            jobs.on_model_applied(step)
        else:
            jobs.on_core_event(step, fresh=True)
        assert [event.kind for event in log.since(1).events] == [kind] * (5 in order[: order.index(step) + 1])
    assert not jobs.busy


def test_a_model_that_another_has_overtaken_is_no_longer_waited_for(tmp_path: Path) -> None:
    log = EventLog("boot", lambda _: None)
    jobs = CalibrationJobs(example_settings(), ModelStore(tmp_path), LINK, log, tmp_path / "checks.jsonl")
    jobs._send_to_core(MODEL, "g", RESULT, tmp_path / "m.json")
    jobs.on_model_applied(6)
    (told,) = log.since(1).events
    assert (told.kind, told.id) == ("calibration_failed", "g")
    assert "epoch 6" in told.message
    assert not jobs.busy


def test_the_gateway_goes_on_while_trial_data_are_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sweeps are reduced for longer than the gateway may be silent."""
    begun, may_end = threading.Event(), threading.Event()

    def slow(collector: TrialCollector) -> TrialData:
        begun.set()
        assert may_end.wait(60.0)
        raise CalibrationError("too_few_stops", "made at last")

    monkeypatch.setattr(TrialCollector, "trials", slow)
    log = EventLog("boot", lambda _: None)
    jobs = CalibrationJobs(example_settings(), ModelStore(tmp_path), LINK, log, tmp_path / "checks.jsonl")
    jobs.on_core_event(Event(1, 1, "calibration_finished", id="g"), fresh=True)
    assert begun.wait(60.0)
    jobs.poll()
    assert jobs.busy
    assert not log.since(1).events
    may_end.set()
    while jobs.busy:
        jobs.poll()
    (failed,) = log.since(1).events
    assert (failed.kind, failed.id, failed.message) == ("calibration_failed", "g", "made at last")
    jobs.close()


@pytest.mark.parametrize("order", orders(4, 5, AGREES))
def test_a_model_of_moved_cameras_is_taken_once_the_core_works_with_it(order: tuple[Any, ...], tmp_path: Path) -> None:
    log, taken = EventLog("boot", lambda _: None), list[int]()
    jobs = RelocalizationJobs(ModelStore(tmp_path), LINK, log, lambda: None, lambda model: taken.append(model.epoch))
    fit: Any = SimpleNamespace(cameras=("left",), goal="g")
    jobs._replace_model(MODEL, SimpleNamespace(message="moved", model="m.json"), fit)  # type: ignore[arg-type]
    for step in order:
        if isinstance(step, int):
            jobs.on_model_applied(step)
        else:
            jobs.on_core_event(step, fresh=True)
        assert taken == [5] * (5 in order[: order.index(step) + 1])
