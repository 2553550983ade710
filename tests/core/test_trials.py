"""Trial motions: planned from visibility alone, spread positions, motions too small, leases; and the check motion."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.servo_core import ServoCore
from stereoservo.core.sources import calibration
from stereoservo.core.sources.calibration import (
    combined_offsets,
    enough_inside,
    extrapolated,
    plan_sides,
    start_trials,
    stop_offset,
)
from stereoservo.core.sources.check import check_targets
from stereoservo.core.sources.measure_at_pose import markers_lost
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.messages.cell_file import MAX_JOINTS
from stereoservo.messages.goals import Calibrate, Enable, Home, JointTarget, RenewGoal
from stereoservo.messages.reasons import Reason

from .conftest import BASE, CAMERA_NAMES

GOAL = "00000011"
ENDS = ("calibration_finished", "calibration_aborted", "check_finished")


def with_trials(bench: Any, **changes: Any) -> Any:
    """The bench's core with other trial settings."""
    trials = msgspec.structs.replace(bench.settings.trials, **changes)
    bench.settings = msgspec.structs.replace(bench.settings, trials=trials)
    bench.core = ServoCore(bench.settings)
    return bench


def calibrated(bench: Any, seconds: float = 300.0, **command: Any) -> tuple[Any, list[Any]]:
    bench.run(0.1)
    bench.step(Enable())
    assert bench.reply(Calibrate(GOAL, **command)).accepted
    end = bench.until(lambda e: e.kind in ENDS, seconds)
    return end, [e for e in bench.events if e.kind == "calibration_sample"]


def moved(samples: list[Any], joint: int, base: np.ndarray) -> np.ndarray:
    return np.array([e.joints[joint] - base[joint] for e in samples if e.trial == joint])


@pytest.mark.parametrize("seed", [0, 1])
def test_without_ranges_every_joint_goes_as_far_as_the_markers_stay_in_view(benches: Any, seed: int) -> None:
    bench = with_trials(benches(seed, noise_px=0.05), range=np.full(6, np.nan), stops=7)
    base = bench.settings.trials.base
    end, samples = calibrated(bench)
    assert end.kind == "calibration_finished", end
    assert not [e for e in bench.events if e.kind == "warning" and "loses" in e.message]
    for joint in range(6):
        offsets = moved(samples, joint, base)
        assert 6 <= len(offsets) <= 9
        assert offsets.min() < -0.1
        assert offsets.max() > 0.1
        assert np.abs(offsets).max() <= 0.6 + 1e-3
        # It went to the border, to the largest range, or to a limit: one more step would leave a view.
        for side in (offsets.max(), offsets.min()):
            q = base.copy()
            q[joint] += 1.6 * side
            pixels = bench.truth.pixels(q)
            inside = np.all((pixels > 19) & (pixels < np.array([620, 460])), axis=-1)
            assert abs(1.6 * side) > 0.6 or (inside.sum(axis=-1) < 8).any(), (joint, side)
    sights = [s for e in samples for s in e.samples]
    assert min(s.ids.size for s in sights) >= 6


def test_a_probe_at_the_border_turns_to_the_other_side(bench: Any) -> None:
    settings = with_trials(bench, range=np.full(6, np.nan)).settings
    base = np.full((1, 2, 8, 2), 200.0)
    base[..., 0] = 615.0  # at the right border: 640 less 3 % is 620
    probe = base + np.array([4.0, 0.0])
    reach, steps, counts = plan_sides(base, probe, 0.02, np.array([0.6, 0.5]), settings, settings.trials)
    assert counts == (0, 4)
    assert reach[0] == 0.0
    assert steps[1] == pytest.approx(0.125)
    reach, steps, counts = plan_sides(
        base - [300, 0], probe - [300, 0], 0.02, np.full(2, 1.6), settings, settings.trials
    )
    assert reach == pytest.approx([(619.8 - 315) / 200, (315 - 19.2) / 200])
    assert counts == (2, 2)
    assert steps == pytest.approx(reach / 2)


def test_extrapolation_is_exact_on_straight_tracks_and_counts_what_was_seen(bench: Any) -> None:
    settings = bench.settings
    track = np.array([[[[100.0, 100.0]] * 8] * 2])
    speed = np.array([50.0, 20.0])
    ahead = extrapolated(track + 0.2 * speed, 0.2, track, 0.0, 0.5)
    assert ahead == pytest.approx(track + 0.5 * speed)
    outside = track.copy()
    outside[0, 1, :2, 0] = 5.0
    assert enough_inside(outside, settings, settings.trials)  # six of eight stay
    outside[0, 1, :3, 0] = 5.0
    assert not enough_inside(outside, settings, settings.trials)
    outside[0, 1, :3] = np.nan  # not seen at the last stop: not counted
    assert enough_inside(outside, settings, settings.trials)


def test_a_joint_that_hardly_moves_the_markers_is_named_with_a_cure(benches: Any) -> None:
    bench = with_trials(benches(0, noise_px=0.05), range=np.array([0.1] * 5 + [0.03]), min_range=0.02, frames=1)
    end, _ = calibrated(bench)
    assert end.kind == "calibration_aborted"
    reason = end.reasons[0]
    assert (reason.code, reason.subject, reason.unit) == ("TRIAL_TOO_SMALL", "j6", "sigmas")
    assert reason.value < reason.threshold == 40.0
    assert "raise calibration.range.j6" in reason.hint


def test_all_joints_stand_apart_at_once_where_the_markers_stay_in_view(bench: Any) -> None:
    bench = with_trials(bench, together=8, frames=1)
    base = bench.settings.trials.base
    end, samples = calibrated(bench)
    assert end.kind == "calibration_finished", end
    apart = np.array([e.joints - base for e in samples if e.trial < 0][1:])
    assert apart.shape == (8, 6)
    assert (np.abs(apart) > 0.038).all()
    assert (np.abs(apart) < 0.082).all()
    assert np.linalg.matrix_rank(np.sign(apart)) == 6
    assert all(one.progress <= two.progress for one, two in pairwise(samples))
    assert min(s.ids.size for e in samples for s in e.samples) >= 6


def test_joints_stand_on_either_side_independently() -> None:
    """Of as many joints as a cell has at most; those of order 8 gave the eighth the sides of the first."""
    offsets = [combined_offsets(k, -np.ones(MAX_JOINTS), np.ones(MAX_JOINTS)) for k in range(16)]
    sides = np.sign(offsets)
    assert np.array_equal(sides.T @ sides, 16.0 * np.eye(MAX_JOINTS))


def test_a_stop_of_all_joints_that_is_not_reached_is_left_out(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole programme was aborted, with all single joints done."""
    stuck = Reason("STOP_NOT_REACHED", "hold", "j2", 0.0, 0.1, "rad or m", "joint j2 did not reach its stop")

    def never_there(visit: Any, context: Any, settings: Any) -> Reason | None:
        return stuck if visit.joint == 6 and visit.phase == "move" and visit.k == 3 else None

    monkeypatch.setattr(calibration, "too_slow", never_there)
    bench = with_trials(bench, together=5, frames=1)
    end, samples = calibrated(bench)
    assert end.kind == "calibration_finished", end
    assert len([e for e in samples if e.trial < 0]) == 1 + 4
    [told] = [e.message for e in bench.events if e.kind == "warning"]
    assert told == ("calibration: stop 3 of all joints is not reached: joint j2 did not reach its stop; left out")


def test_stops_of_all_joints_that_would_lose_the_markers_are_left_out(benches: Any) -> None:
    """Every joint alone goes as far as the view does: together they would go beyond."""
    bench = with_trials(benches(0, noise_px=0.05), range=np.full(6, np.nan), stops=7, together=8, frames=1)
    base = bench.settings.trials.base
    end, samples = calibrated(bench)
    assert end.kind == "calibration_finished", end
    low, high = (np.array([f(moved(samples, j, base)) for j in range(6)]) for f in (np.min, np.max))
    apart = np.array([e.joints - base for e in samples if e.trial < 0][1:])
    told = [e for e in bench.events if e.kind == "warning" and "of all joints" in e.message]
    assert len(apart) >= 4
    assert len(apart) + len(told) == 8
    wanted = np.array([combined_offsets(k, low, high) for k in range(8)])
    shares = np.array([(one @ wanted.T / (wanted**2).sum(axis=1)).max() for one in apart])
    assert shares.max() < 1.02
    assert shares.min() < 0.8  # some had to be shrunk


@pytest.mark.parametrize("period", [2.0 * np.pi / 200, 2.0 * np.pi / 320])
def test_stops_do_not_repeat_with_the_ripple_of_a_gear(period: float) -> None:
    """Where equal steps are whole periods, all stops but the outermost show the same."""
    step = 4.0 * period
    stops = [stop_offset(side, k, 5, step) for side in (1, -1) for k in range(1, 6)]
    assert np.abs(np.sort(np.abs(stops))[-2:]) == pytest.approx(5 * step)
    assert np.diff(sorted([0.0, *stops])).min() >= 0.5 * step
    ripple = np.sin(2.0 * np.pi * np.array([*stops, 0.0]) / period)
    assert ripple.std() > 0.5
    assert np.abs(np.sin(2.0 * np.pi * step * np.arange(-5, 6) / period)).max() < 1e-9


def test_a_spread_joint_visits_its_positions_at_every_stop_of_the_joints_before_it(bench: Any) -> None:
    offsets = np.linspace(-0.15, 0.15, 3)
    bench = with_trials(bench, spread_joint=5, spread_offsets=offsets)
    base = bench.settings.trials.base
    end, samples = calibrated(bench)
    assert end.kind == "calibration_finished", end
    for joint in range(5):
        stops = np.array([e.joints - base for e in samples if e.trial == joint])
        assert len(stops) == 4 * 3
        assert np.abs(np.delete(stops, [joint, 5], axis=1)).max() < 2e-3
        for offset in offsets:
            assert (np.abs(stops[:, 5] - offset) < 2e-3).sum() == 4
    own = moved(samples, 5, base)
    assert len(own) == 4 + 3  # its own stops, and the turned bases
    travel = np.abs(np.diff([e.joints[5] for e in samples if e.trial in range(5)])).sum()
    assert travel < 1.6 * 5 * 4 * 0.3  # there and back, not back to the first each time


def test_a_keep_out_on_the_way_ends_a_side_before_it(bench: Any) -> None:
    base = bench.settings.trials.base
    box = np.tile([-np.inf, np.inf], (6, 1))[None]
    box[0, 3] = base[3] + 0.075, base[3] + 0.08  # thinner than a step of 0.05
    limits = msgspec.structs.replace(bench.settings.limits, keep_outs=box, keep_out_names=("post",))
    bench.settings = msgspec.structs.replace(bench.settings, limits=limits)
    bench.core = ServoCore(bench.settings)
    end, samples = calibrated(bench)
    assert end.kind == "calibration_finished", end
    assert moved(samples, 3, base).max() == pytest.approx(stop_offset(1, 1, 2, 0.05), abs=2e-3)
    assert [e for e in bench.events if e.kind == "warning" and "j4" in e.message and "keep-out post" in e.message]


def test_stops_of_all_joints_from_which_a_keep_out_bars_the_way_back_are_left_out(bench: Any) -> None:
    bench = with_trials(bench, range=np.full(6, 0.2), together=8, frames=1)
    base = bench.settings.trials.base
    box = np.tile([-np.inf, np.inf], (6, 1))[None]
    # Between the base and where j1 stands above and j3 below it; reached from beside, it can only be left that way.
    box[0, 0], box[0, 2] = base[0] + [0.04, 0.055], base[2] - [0.045, 0.03]
    limits = msgspec.structs.replace(bench.settings.limits, keep_outs=box, keep_out_names=("post",))
    bench.settings = msgspec.structs.replace(bench.settings, limits=limits)
    bench.core = ServoCore(bench.settings)
    end, samples = calibrated(bench)
    assert end.kind == "calibration_finished", end
    apart = np.array([e.joints - base for e in samples if e.trial < 0][1:])
    assert len(apart) > 0
    assert not ((apart[:, 0] > 0.0) & (apart[:, 2] < 0.0)).any()


def test_markers_that_one_camera_loses_are_lost_though_another_sees_them(bench: Any) -> None:
    visit = start_trials(GOAL, BASE, 0, bench.settings)
    told = []
    for k in range(120):  # the cameras' frames come in turn, 10 ms apart
        seen = np.arange(8) if k % 2 or k < 20 or 60 < k < 70 else np.arange(2)
        sight = SimpleNamespace(camera=CAMERA_NAMES[k % 2], ids=seen)
        now_ns = 1 + 10_000_000 * k
        context = SimpleNamespace(observations=(sight,), settings=bench.settings, now_ns=now_ns)
        told.append(markers_lost(visit, context, bench.settings.trials))  # type: ignore[arg-type]
    assert told.index(True) == 112  # of the second loss, which begins at 70


@pytest.mark.parametrize("check", [False, True], ids=["trials", "check"])
def test_no_command_is_faster_than_the_speed_scale_of_the_calibration(bench: Any, check: bool) -> None:
    """From an arm that stands away from the base: the way there, the stops, and the way back."""
    bench = with_trials(bench, speed_scale=0.2, stops=4, frames=1, range=np.full(6, 0.06))
    bench.q = bench.q + 0.05
    bench.ready()
    end, _ = calibrated(bench, check=check)
    assert end.kind == ("check_finished" if check else "calibration_finished"), end
    bound = 0.2 * bench.settings.limits.velocity_max
    fastest = np.abs(np.array(bench.commands)).max(axis=0)
    assert (fastest <= bound * (1.0 + 1e-9)).all(), fastest
    assert (fastest > 0.9 * bound).any()


@pytest.mark.parametrize(("kind", "farthest"), [("revolute", 0.6), ("prismatic", 0.2)])
def test_without_a_range_a_joint_that_keeps_the_markers_in_view_goes_to_the_largest_range_and_no_farther(
    benches: Any, kind: str, farthest: float
) -> None:
    """The last joint turns the body on the spot; of which kind it is, is the drive's to say."""
    bench = benches(0)
    bench.settings = msgspec.structs.replace(bench.settings, joint_kinds=("revolute",) * 5 + (kind,))
    bench = with_trials(bench, range=np.array([0.06] * 5 + [np.nan]), frames=1)
    end, samples = calibrated(bench)
    assert end.kind == "calibration_finished", end
    base = bench.settings.trials.base[5]
    offsets = moved(samples, 5, bench.settings.trials.base)
    assert [offsets.min(), offsets.max()] == pytest.approx([-farthest, farthest], abs=1e-3)
    on_the_way = np.array([inputs.joints.positions[5] for inputs, _ in bench.log]) - base
    assert np.abs(on_the_way).max() <= farthest + 1e-3


def test_state_in_mid_calibration_survives_serialisation(bench: Any) -> None:
    with_trials(bench, range=np.full(6, np.nan))
    bench.run(0.1)
    bench.step(Enable())
    bench.reply(Calibrate(GOAL))
    bench.run(3.0)
    twin = ServoCore(bench.settings, decode_state(encode_state(bench.core.state)))
    start = len(bench.log)
    bench.run(3.0)
    for inputs, outputs in bench.log[start:]:
        assert twin.step(inputs).command.tobytes() == outputs.command.tobytes()


@pytest.mark.parametrize("command", [Calibrate(GOAL, lease_s=0.5), Home(GOAL, lease_s=0.5), Calibrate(GOAL, True, 0.5)])
def test_motion_of_a_client_that_died_ends_with_its_lease(bench: Any, command: Any) -> None:
    bench.q = bench.q - 1.5 * np.sign(bench.q)
    bench.ready()
    assert bench.reply(command).accepted
    for _ in range(4):
        bench.run(0.4)
        assert bench.reply(RenewGoal(GOAL)).accepted
    bench.until(lambda e: "LEASE_EXPIRED" in {r.code for r in e.reasons}, 1.0)
    assert np.abs(bench.run(1.0).command).max() == 0.0


def test_check_motion_takes_less_than_a_quarter_of_the_time(benches: Any) -> None:
    took = {}
    for check in (True, False):
        bench = with_trials(benches(0), stops=9, range=np.full(6, 0.15)).ready()
        start = bench.now_ns
        end, samples = calibrated(bench, check=check)
        assert end.kind == ("check_finished" if check else "calibration_finished")
        took[check] = bench.now_ns - start
        if check:
            offsets = np.array([e.joints for e in samples]) - bench.settings.trials.base
            assert len(offsets) == 7
            assert (offsets.max(axis=0) > 0.04).all()
            assert (offsets.min(axis=0) < -0.04).all()
    assert took[True] < 0.25 * took[False]


def test_check_needs_a_model_and_keeps_inside_the_limits(bench: Any) -> None:
    bench.run(0.1)
    bench.step(Enable())
    refused = bench.reply(Calibrate(GOAL, reset_zeros=True))
    assert (refused.accepted, refused.reasons[0].code) == (False, "RESET_WITHOUT_CHECK")
    refused = bench.reply(Calibrate(GOAL, check=True))
    assert refused.reasons[0].code == "NO_MODEL"
    limits = msgspec.structs.replace(bench.settings.limits, position_max=bench.settings.trials.base + 0.02)
    settings = msgspec.structs.replace(bench.settings, limits=limits)
    targets = check_targets(settings, bench.truth.model)
    assert (targets < limits.position_max - limits.position_margin).all()


def test_trials_that_preempt_a_fast_goal_brake_at_the_acceleration_limit_and_are_slow_from_there(
    bench: Any,
) -> None:
    with_trials(bench, speed_scale=0.1)
    bench.run(0.1)
    bench.step(Enable())
    assert bench.reply(bench.goal(JointTarget({"j1": 2.0, "j2": float(BASE[1]) + 1.0}))).accepted
    bench.run(0.6)
    limits = bench.settings.limits
    slow, change = 0.1 * limits.velocity_max[0], limits.acceleration_max[0] / bench.settings.rate_hz
    before = float(np.abs(bench.commands[-1]).max())
    assert before > 5.0 * slow
    bench.commands.clear()
    assert bench.reply(Calibrate(GOAL)).accepted
    bench.run(2.0)
    speeds = np.abs(bench.commands).max(axis=1)
    braking = before - change * np.arange(1, len(speeds) + 1)
    assert (speeds <= np.maximum(braking, slow) + 1e-9).all()
    assert speeds[0] > slow
    assert speeds[-1] > 0.0
