"""Progress of a calibration from the core's events: counts in the gateway, accuracies against the exact pixels."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.ipc_messages import RunPlan, save_plan
from stereoservo.daemon.jobs.learning_progress import Learner
from stereoservo.gateway.calibration_jobs import LearningProgress
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.goals import Calibrate, Enable
from stereoservo.messages.learning import LearningState
from stereoservo.ports.devices import CameraDescription, JointDriverDescription, JointSpec

GOAL = "00000012"
PATIENCE_S = 120.0


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
    # A gateway that was started later hears of a calibration that is over.
    for event in (begin, *others):
        progress.on_event(event, fresh=event.kind != "calibration_finished")
    assert progress.state() is None


def test_the_job_predicts_in_its_own_process_and_ends_before_the_fit(benches: Any, tmp_path: Path) -> None:
    bench = benches(0, noise_px=0.05)
    events = calibrated(bench, sweeps=True)
    save_plan(plan_of(bench.settings, tmp_path))
    progress = LearningProgress(bench.settings, tmp_path)
    second = next(k for k, event in enumerate(events) if event.trial == 1)
    for event in events[: second + 1]:
        progress.on_event(event)
    state = progress.state()
    until_s = time.monotonic() + PATIENCE_S
    while state is not None and state.predicted_px is None and "ended" not in state.note and time.monotonic() < until_s:
        time.sleep(0.05)
        state = progress.state()
    assert state is not None
    assert [joint.name for joint in state.joints if joint.predicted_px is not None] == ["j1"], state.text
    assert state.coverage.keys() == set(bench.names)
    for event in events[second + 1 :]:
        progress.on_event(event)
    fitting = progress.state()
    assert fitting is not None
    assert (fitting.doing, fitting.predicted_px) == ("fitting", state.predicted_px)
    assert not list(tmp_path.glob("learning*"))
    assert progress._job is None


def test_a_job_that_dies_is_named(benches: Any, tmp_path: Path) -> None:
    bench = benches(0, noise_px=0.05)
    progress = LearningProgress(bench.settings, tmp_path)  # without a plan
    begin = next(event for event in calibrated(bench, sweeps=True) if event.kind == "calibration_progress")
    progress.on_event(begin)
    until_s = time.monotonic() + PATIENCE_S
    while "has ended" not in (state := progress.state() or LearningState("moving", 0, 0, 0, ())).text:
        assert time.monotonic() < until_s, state
        time.sleep(0.05)
    assert state.predicted_px is None
    progress.end()
    progress.end()


def plan_of(settings: CoreSettings, runtime: Path) -> RunPlan:
    """A plan of a cell with the joints, cameras and markers of these settings."""
    trials = settings.trials
    assert trials is not None
    cell = check_cell(
        {
            "schema": 1,
            "cell": {"name": "bench"},
            "joints": {"driver": "stub"},
            "camera": [{"name": camera.name, "driver": "stub"} for camera in settings.cameras],
            "safety": {
                "limit": [
                    {"joint": name, "min": -3.0, "max": 3.0, "velocity": 1.0, "acceleration": 4.0}
                    for name in settings.joint_names
                ]
            },
            "calibration": {
                "base": dict(zip(settings.joint_names, trials.base.tolist(), strict=True)), "frames": trials.frames,
            },
        }
    )  # fmt: skip
    specs = tuple(JointSpec(name, "revolute", -3.0, 3.0, 1.0, 4.0) for name in settings.joint_names)
    cameras = tuple(
        CameraDescription(
            "stub", camera.name, camera.width, camera.height, camera.rate_hz, "observations", 1.0,
            marker_ids=camera.marker_ids,
        )
        for camera in settings.cameras
    )  # fmt: skip
    joints = JointDriverDescription("stub", specs, settings.rate_hz, "clock", 0.1, 100.0)
    return RunPlan(cell, "cell.toml", str(runtime), str(runtime), "boot", joints, cameras)
