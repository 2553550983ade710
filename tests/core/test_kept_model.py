"""A kept model is used only once frames have confirmed it; a goal waits for that, for a bounded time. Truth is the
bench's own Euclidean arm, whose cameras are moved independently of the model.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.stats import binom, chi2
from tests.core.conftest import BASE, NAMES, Bench, make_settings, make_truth

from stereoservo.calibration.change.model_check import ALPHA, check_model_holds
from stereoservo.control.marker_groups import with_groups
from stereoservo.core.cycle import Event, ModelUpdate, encode
from stereoservo.core.goals.accept import CONFIRMATION_S
from stereoservo.core.model_arrays import model_arrays
from stereoservo.core.monitor import COMPARED_ROUNDS, FEWEST_COMPARED, NOT_AT_REST, SILENT_S
from stereoservo.core.monitors.fault_isolation import LinearisedProblem
from stereoservo.core.prediction import MODEL_SIGMA_PX
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.sources.check import quick_targets
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.daemon.ipc_messages import NewModel, to_servo_decoder
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.messages.check_report import CheckReport
from stereoservo.messages.goals import Calibrate, Enable, JointTarget
from stereoservo.messages.status import ModelReadiness
from stereoservo.messages.wire import decode_command

NOISE_PX = 0.05


def kept(seed: int = 3, q: np.ndarray = BASE, **settings: Any) -> Bench:
    """A cell that has just loaded a kept model, enabled, before its first frame is compared."""
    truth = make_truth(seed)
    given = msgspec.structs.replace(make_settings(), **settings)
    bench = Bench(truth, given, ServoCore(given), np.random.default_rng(seed), q.copy(), NOISE_PX)
    bench.run(0.02)
    bench.step(Enable(), model_update=ModelUpdate(with_groups(truth.model), kept=True))
    return bench


def turn_camera(bench: Bench, camera: int, px: float) -> None:
    """Turn a camera about its vertical axis, by ``px`` pixels at the centre of its image."""
    angle = px / 800.0
    K = np.array([[800, 0, 320], [0, 800, 240], [0, 0, 1.0]])
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    bench.truth.cameras[camera] = K @ turn @ np.linalg.inv(K) @ bench.truth.cameras[camera]


def compared(bench: Bench) -> list[bool | None]:
    return [event.accepted for event in bench.events if event.kind == "model_compared"]


def test_the_right_model_is_confirmed_by_a_handful_of_frames() -> None:
    bench = kept()
    assert bench.run(0.05).status.model == "unconfirmed"
    event = bench.until(lambda e: e.kind == "model_compared", 0.5)
    assert event.accepted
    (reason,) = event.reasons
    assert reason.value is not None
    assert reason.threshold is not None
    assert reason.value <= reason.threshold
    status = bench.step().status
    assert status.model == "valid"
    assert not status.reasons
    assert sum(o.camera == "left" for inputs, _ in bench.log for o in inputs.observations) <= COMPARED_ROUNDS + 2


def test_a_model_of_this_run_is_valid_at_once() -> None:
    bench = kept()
    bench.step(model_update=ModelUpdate(with_groups(msgspec.structs.replace(bench.truth.model, epoch=8))))
    assert bench.step().status.model == "valid"
    bench.run(0.5)
    assert compared(bench) == []


@pytest.mark.parametrize("reanchor", [True, False])
def test_a_model_with_a_moved_camera_is_not_confirmed(reanchor: bool) -> None:
    bench = kept(reanchor=reanchor)
    turn_camera(bench, 1, 6.0)
    status = bench.run(1.0).status
    assert True not in compared(bench)
    assert status.model == ("unconfirmed" if reanchor else "suspect")
    assert any(event.kind == "health" and event.name == "camera_moved" for event in bench.events)
    refused = bench.reply(bench.goal(bench.points_target(BASE + 0.05)))
    assert not refused.accepted
    assert refused.reasons[0].code == ("CAMERA_MOVED" if reanchor else "MODEL_SUSPECT")


def test_images_that_no_change_explains_are_reported_with_value_limit_and_remedy() -> None:
    bench = kept()
    rng = np.random.default_rng(5)
    bench.bias_px = rng.uniform(-4.0, 4.0, (8, 2))
    event = bench.until(lambda e: e.kind == "model_compared", 1.0)
    assert event.accepted is False
    (reason,) = event.reasons
    assert reason.value is not None
    assert reason.threshold is not None
    assert reason.value > reason.threshold
    assert "calibrate --check --quick" in reason.hint
    assert f"{reason.threshold:.4g}" in reason.hint


def test_a_stated_joint_error_is_part_of_the_model_and_an_unstated_one_is_not() -> None:
    """The test uses the covariance that the model states for its joint readings."""
    for stated, confirmed in ((0.003, True), (None, False)):
        truth = make_truth(3)
        errors = JointAccuracy(*(np.full(6, 0.0 if stated is None else stated) for _ in range(4)))
        model = msgspec.structs.replace(truth.model, joint_accuracy=None if stated is None else errors)
        settings = make_settings()
        bench = Bench(truth, settings, ServoCore(settings), np.random.default_rng(1), BASE.copy(), NOISE_PX)
        bench.zero_offset = np.array([0.003, -0.004, 0.004, 0.003, -0.003, 0.002])
        bench.run(0.02)
        bench.step(Enable(), model_update=ModelUpdate(with_groups(model), kept=True))
        bench.run(1.0)
        assert (True in compared(bench)) is confirmed


def test_without_enough_markers_it_stays_unconfirmed_and_says_so() -> None:
    bench = kept()
    bench.marker_mask[FEWEST_COMPARED - 1 :] = False
    status = bench.run(5.0).status
    assert status.model == "unconfirmed"
    (reason,) = [r for r in status.reasons if r.code == "MODEL_UNCONFIRMED"]
    assert (reason.subject, reason.value, reason.threshold) == ("left", FEWEST_COMPARED - 1, FEWEST_COMPARED)
    bench.marker_mask[:] = True
    bench.run(0.5)
    assert compared(bench) == [True]


def test_a_camera_without_frames_is_waited_for_and_then_left_out() -> None:
    bench = kept()
    bench.cameras_on[1] = False
    status = bench.run(SILENT_S - 0.5).status
    assert status.model == "unconfirmed"
    assert any(r.code == "MODEL_UNCONFIRMED" and "camera right delivers no frames" in r.hint for r in status.reasons)
    bench.run(1.0)
    assert compared(bench) == [True]


def test_it_is_compared_at_rest_only() -> None:
    bench = kept()
    bench.run(0.02)
    assert bench.reply(bench.goal(JointTarget({"j1": float(BASE[0]) + 0.5}))).accepted
    status = bench.run(0.5).status
    assert status.command.any()
    assert [r.hint for r in status.reasons if r.code == "MODEL_UNCONFIRMED"] == [NOT_AT_REST.hint]
    assert bench.ended().kind == "goal_reached"
    assert compared(bench) == []
    bench.run(0.5)
    assert compared(bench) == [True]


def test_no_camera_at_all_confirms_nothing() -> None:
    bench = kept()
    bench.cameras_on[:] = [False] * len(bench.cameras_on)
    assert bench.run(2 * SILENT_S).status.model == "unconfirmed"


def test_a_goal_waits_for_the_confirmation_and_goes_on() -> None:
    bench = kept()
    bench.marker_mask[:] = False
    target = BASE + 0.02
    goal = bench.goal(bench.points_target(target))
    bench.step(goal)
    bench.run(1.0)
    assert not [e for e in bench.events if e.kind == "reply" and e.id == goal.goal.id]
    np.testing.assert_array_equal(bench.q, BASE)
    bench.marker_mask[:] = True
    assert bench.ended().kind == "goal_reached"
    np.testing.assert_allclose(bench.q, target, atol=2e-3)


def test_a_goal_that_waits_too_long_is_refused_with_what_is_missing() -> None:
    bench = kept()
    bench.marker_mask[:] = False
    begin_ns = bench.now_ns
    first, second = (bench.goal(bench.points_target(BASE + 0.02)) for _ in range(2))
    second = msgspec.structs.replace(second, goal=msgspec.structs.replace(second.goal, id="second"))
    bench.step(first)
    bench.run(1.0)
    bench.step(second)
    ends = [bench.until(lambda e, g=goal: e.kind == "reply" and e.id == g.goal.id, 5.0) for goal in (first, second)]
    for refused in ends:
        assert not refused.accepted
        assert (refused.reasons[0].code, refused.reasons[0].value) == ("MODEL_UNCONFIRMED", 0.0)
        assert "calibrate --check" in refused.message
        assert CONFIRMATION_S - 0.1 < (refused.t_ns - begin_ns) * 1e-9 < CONFIRMATION_S + 0.1
    np.testing.assert_array_equal(bench.q, BASE)
    assert bench.reply(bench.goal(JointTarget(dict(zip(NAMES, BASE + 0.01, strict=True))))).accepted


def test_what_needs_no_confirmed_model_does_not_wait() -> None:
    """Joint goals and calibration; and a goal that is refused anyway."""
    bench = kept()
    bench.marker_mask[:] = False
    assert bench.reply(Calibrate("anew"), 0.1).accepted
    held = kept()
    held.active = False
    held.marker_mask[:] = False
    held.run(0.1)
    assert held.reply(held.goal(held.points_target(BASE + 0.02)), 0.1).reasons[0].code == "NOT_ACTIVE"


def test_the_state_of_a_comparison_is_stored() -> None:
    bench = kept()
    bench.run(0.1)
    state = decode_state(encode_state(bench.core.state))
    assert state.comparison is not None
    assert encode_state(state) == encode_state(bench.core.state)
    again = ServoCore(bench.settings, state)
    bench.core = again
    bench.run(0.5)
    assert compared(bench) == [True]


def test_messages_carry_the_kept_model_and_the_quick_check() -> None:
    model = make_truth(3).model
    told = to_servo_decoder.decode(encode(NewModel(model, kept=True)))
    assert isinstance(told, NewModel)
    assert (told.kept, told.model.epoch) == (True, model.epoch)
    old = msgspec.msgpack.encode({k: v for k, v in msgspec.msgpack.decode(encode(told)).items() if k != "kept"})
    assert to_servo_decoder.decode(old).kept is False
    assert decode_command("calibrate", b'{"id": "0123abcd", "check": true, "quick": true}') == Calibrate(
        "0123abcd", True, quick=True
    )
    bench = kept()
    status = bench.run(0.05).status
    assert decode_state(encode_state(bench.core.state)).readiness is ModelReadiness.UNCONFIRMED
    assert msgspec.json.decode(msgspec.json.encode(status.model)) == "unconfirmed"


def test_false_alarms_over_many_models_are_within_the_stated_bound() -> None:
    """Models whose error is as stated (`MODEL_SIGMA_PX`): none of 400 rounds of two cameras is beyond five sigmas, for
    which 2e-4 false alarms are expected, and the test statistic is chi-square distributed.
    """
    settings, values, beyond = make_settings(), [], 0
    arrays, sigma = model_arrays(make_truth(3).model, settings), float(np.hypot(NOISE_PX, MODEL_SIGMA_PX))
    weights = np.full((2, 8), 1.0 / sigma)
    for seed in range(400):
        innovation = sigma * np.random.default_rng(seed).standard_normal((2, 8, 2))
        problem = LinearisedProblem(arrays, settings, [0, 1], BASE, innovation, weights)
        value, limit, _ = problem.worst_test(weights)
        beyond += value > limit
        values.append((innovation**2).sum() / sigma**2)
        assert problem.explained(weights) == (value <= limit)
    assert beyond == 0
    assert abs(np.mean(values) - 32.0) < 4.0 * np.sqrt(2.0 * 32.0 / len(values))
    assert chi2.sf(max(values), 32) > 1e-6


@pytest.mark.parametrize(("px", "confirmed"), [(MODEL_SIGMA_PX, True), (1.0, False)])
def test_models_within_their_stated_error_are_confirmed_and_others_are_not(px: float, confirmed: bool) -> None:
    """40 arms and cameras; one camera is turned by ``px``."""
    for seed in range(40):
        bench = kept(seed)
        turn_camera(bench, seed % 2, px)
        bench.run(0.4)
        assert (True in compared(bench)) is confirmed, seed


@pytest.mark.parametrize(
    ("speed", "acceleration", "scale"), [(1.0, 4.0, 1.0), (0.3, 0.5, 1.0), (2.0, 20.0, 0.2), (3.0, 1.0, 0.5)]
)
def test_the_quick_check_moves_at_most_three_seconds(speed: float, acceleration: float, scale: float) -> None:
    given = make_settings()
    limits = msgspec.structs.replace(
        given.limits, velocity_max=np.full(6, speed), acceleration_max=np.full(6, acceleration)
    )
    assert given.trials is not None
    trials = msgspec.structs.replace(given.trials, speed_scale=scale, range=np.full(6, 0.6))
    posture = BASE + np.array([0.05, -0.02, 0.03, 0.0, 0.04, -0.05])
    bench = kept(q=posture, limits=limits, trials=trials)
    bench.run(0.5)
    began = len(bench.commands)
    assert bench.reply(Calibrate("quick", check=True, quick=True)).accepted
    bench.until(lambda e: e.kind == "check_finished", 20.0)
    moving = sum(bool(command.any()) for command in bench.commands[began:])
    assert 0.5 < moving / bench.settings.rate_hz <= 3.0
    np.testing.assert_allclose(bench.q, posture, atol=1e-3)
    stops = [e.joints for e in bench.events if e.kind == "calibration_sample" and e.id == "quick"]
    assert len(stops) == 3
    assert (np.ptp(np.array(stops), axis=0) > 1e-3).all()


def quick_check(px: float) -> tuple[Bench, list[Event]]:
    """A quick check, without noise, of a cell whose right camera was turned by ``px`` since calibration; samples."""
    bench = kept()
    bench.noise_px = 0.0
    bench.run(0.5)
    turn_camera(bench, 1, px)
    bench.step(Calibrate("quick", check=True, quick=True))
    bench.until(lambda e: e.kind == "check_finished", 20.0)
    return bench, [e for e in bench.events if e.kind == "calibration_sample"]


def verdict_of(bench: Bench, samples: list[Event], rng: np.random.Generator) -> CheckReport:
    """Report on the ``samples`` with noise as they state it."""
    collector = TrialCollector(bench.settings)
    for event in samples:
        noisy = tuple(
            msgspec.structs.replace(
                s, pixels=s.pixels + np.sqrt(s.covariances[:, [0, 1], [0, 1]]) * rng.standard_normal(s.pixels.shape)
            )
            for s in event.samples
        )
        collector.add(msgspec.structs.replace(event, samples=noisy))
    return check_model_holds(bench.truth.model, collector.trials(), limit_px=bench.settings.tolerance_px)


def test_the_quick_check_has_its_stated_rate_of_false_alarms_and_finds_a_moved_camera() -> None:
    bench, samples = quick_check(0.0)
    reports = [verdict_of(bench, samples, np.random.default_rng(seed)) for seed in range(60)]
    alarms = sum(report.status != "holds" for report in reports)
    assert binom.sf(alarms - 1, len(reports), ALPHA) > 1e-3
    bench, samples = quick_check(0.5)
    report = verdict_of(bench, samples, np.random.default_rng(0))
    assert report.status == "recalibrate"
    assert "camera right" in report.message
    assert report.chi2 > report.measurements


def test_the_quick_check_stays_within_the_limits() -> None:
    given = make_settings()
    limits = msgspec.structs.replace(given.limits, position_max=np.where(np.arange(6) == 2, BASE[2] + 0.02, 3.0))
    settings = msgspec.structs.replace(given, limits=limits)
    targets = quick_targets(settings, make_truth(3).model, BASE)
    assert (targets <= limits.position_max - limits.position_margin).all()
    assert (targets >= limits.position_min + limits.position_margin).all()
    assert np.ptp(targets, axis=0)[0] > 0.0


def test_quick_goes_with_check() -> None:
    bench = kept()
    bench.run(0.1)
    assert bench.reply(Calibrate("alone", quick=True)).reasons[0].code == "QUICK_WITHOUT_CHECK"
