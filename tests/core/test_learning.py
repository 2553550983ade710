"""Progress of a calibration from the core's events: counts in the gateway, accuracies against the exact pixels."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.servo_core import ServoCore
from stereoservo.daemon.jobs.learning_progress import Learner
from stereoservo.gateway.learning import LearningProgress
from stereoservo.messages.goals import Calibrate, Enable
from stereoservo.messages.learning import LearningState

GOAL = "00000012"


def calibrated(bench: Any, **trials: Any) -> list[Any]:
    """The core's events of a calibration, and of the check motion before its model."""
    changed = msgspec.structs.replace(bench.settings.trials, range=np.full(6, 0.3), **trials)
    bench.settings = msgspec.structs.replace(bench.settings, trials=changed)
    bench.core = ServoCore(bench.settings)
    bench.run(0.1)
    bench.step(Enable())
    assert bench.reply(Calibrate(GOAL)).accepted
    assert bench.until(lambda e: e.kind in ("calibration_finished", "calibration_aborted"), 300.0)
    return list(bench.events)


@pytest.mark.parametrize("sweeps", [True, False])
def test_what_is_known_grows_with_the_data(benches: Any, sweeps: bool) -> None:
    bench = benches(0, noise_px=0.05)
    events = calibrated(bench, sweeps=sweeps, together=8)
    progress, learner = LearningProgress(bench.settings, None), Learner(bench.settings)
    states: list[LearningState] = []
    fits: list[tuple[int, Any]] = []
    for event in events:
        progress.on_event(event)
        learner.add(event)
        if (state := progress.state()) is not None:
            states.append(state)
        if count := learner.due():
            fits.append((count, learner.predict(count)))
    for before, after in pairwise(states):
        assert before.images <= after.images
        assert before.motion <= after.motion
        assert all(one.moved <= two.moved for one, two in zip(before.joints, after.joints, strict=True))
    assert [state.motion for state in states[:1] + states[-1:]] == [0, 7]
    assert states[-1].doing == "fitting"
    assert all(0.1 < joint.moved < 1.0 for joint in states[-1].joints)
    trials = learner._collector.trials()
    assert states[-1].images >= trials.images > 0
    counts = [count for count, _ in fits]
    assert counts[:6] == [1, 2, 3, 4, 5, 6]
    assert all(len(found.joints) == count for count, found in fits)
    print([(count, found.predicted_px) for count, found in fits])
    assert all(found.predicted_px is not None for _, found in fits)
    progress.end()
    assert progress.state() is None


def test_a_check_motion_and_what_comes_after_an_abort_are_no_calibration(benches: Any) -> None:
    bench = benches(0, noise_px=0.05)
    begin, *others = [event for event in calibrated(bench, sweeps=True) if event.id == GOAL]
    progress = LearningProgress(bench.settings, None)
    progress.on_event(msgspec.structs.replace(begin, message="check motion begins"))
    for event in others[:3]:
        progress.on_event(event)
    assert progress.state() is None
    progress.on_event(begin)
    assert progress.state() is not None
    progress.on_event(msgspec.structs.replace(begin, kind="calibration_aborted"))
    assert progress.state() is None
    progress.on_event(others[1])
    assert progress.state() is None
