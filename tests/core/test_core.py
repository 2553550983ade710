"""The core in virtual time, named as promises."""

from __future__ import annotations

import math
import uuid
from typing import Any

import msgspec
import numpy as np
import pytest

from core.former_states import before_version_12, without_a_block
from stereoservo.core.cycle import DriverFault, ModelUpdate
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state_encoding import StateVersionError, decode_state, encode_state, is_recorded
from stereoservo.messages.goals import (
    Calibrate,
    CancelGoal,
    Command,
    Disable,
    Enable,
    FeatureTarget,
    Goal,
    Hold,
    Home,
    Jog,
    JointTarget,
    RenewGoal,
    Reset,
    Resume,
    RunGoal,
    Teach,
)

DISPLACED = np.array([0.25, -0.2, 0.15, 0.4, -0.3, 0.5])
TERMINAL = {"goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted"}


def goal(bench: Any, q: np.ndarray, **options: Any) -> RunGoal:
    target = FeatureTarget(bench.features(q))
    return RunGoal(Goal(str(uuid.UUID(int=bench.seq + 1)), target, **options))


def ended(event: Any) -> bool:
    return event.kind in TERMINAL


@pytest.mark.parametrize("law", ["stereo", "cartesian3"])
@pytest.mark.parametrize("points", ["predicted", "triangulated"])
@pytest.mark.parametrize("seed", [1, 2])
def test_goal_is_reached_from_a_random_frame_with_noise(benches: Any, law: str, points: str, seed: int) -> None:
    bench = benches(seed, noise_px=0.05).ready()
    target = bench.q + DISPLACED * (0.5 if law == "stereo" else 1.0)
    assert bench.reply(goal(bench, target, law=law, points=points)).accepted
    event = bench.until(ended, 25.0)
    assert event.kind == "goal_reached", event
    bench.run(0.5)
    assert bench.error_px(target) < 0.3
    assert np.linalg.norm(bench.truth.points(bench.q) - bench.truth.points(target), axis=1).max() < 2e-3


def test_goal_survives_a_camera_that_drops_out_for_good(bench: Any) -> None:
    bench.ready()
    target = bench.q + 0.5 * DISPLACED
    assert bench.reply(goal(bench, target, law="cartesian3")).accepted
    bench.run(0.5)
    bench.cameras_on[1] = False
    assert bench.until(ended, 25.0).kind == "goal_reached"
    assert bench.error_px(target) < 0.5


def test_arm_brakes_when_all_cameras_are_silent_and_goes_on_when_they_return(bench: Any) -> None:
    bench.ready()
    target = bench.q + DISPLACED
    bench.reply(goal(bench, target))
    bench.run(0.4)
    bench.cameras_on[:] = [False, False]
    outputs = bench.run(2.0)
    assert np.abs(outputs.command).max() == 0.0
    assert "FEATURES_STALE" in {reason.code for reason in outputs.status.reasons}
    bench.cameras_on[:] = [True, True]
    assert bench.until(ended, 25.0).kind == "goal_reached"


def test_arm_brakes_when_joints_are_silent(bench: Any) -> None:
    bench.ready()
    bench.reply(goal(bench, bench.q + DISPLACED))
    bench.run(0.4)
    bench.joints_on = False
    outputs = bench.run(1.0)
    assert np.abs(outputs.command).max() == 0.0
    assert "JOINTS_STALE" in {reason.code for reason in outputs.status.reasons}


@pytest.mark.parametrize("law", ["stereo", "cartesian3", "trajectory", "joints"])
def test_a_goal_goes_on_from_rest_once_the_joints_are_heard_again(bench: Any, law: str) -> None:
    bench.ready()
    target = bench.q + 0.5 * DISPLACED
    command = goal(bench, target, law=law) if law != "joints" else RunGoal(
        Goal("0000000c", JointTarget(dict(zip(bench.settings.joint_names, target.tolist(), strict=True))))
    )  # fmt: skip
    assert bench.reply(command).accepted
    assert np.abs(bench.run(0.4).command).max() > 0.1
    bench.joints_on = False
    assert np.abs(bench.run(1.0).command).max() == 0.0
    bench.joints_on = True
    step = bench.settings.limits.acceleration_max / bench.settings.rate_hz
    before, fastest = np.zeros(6), 0.0
    for _ in range(30):
        outputs = bench.step()
        assert (np.abs(outputs.command - before) <= step * 1.000001).all()
        assert outputs.status.goal == command.goal.id
        before, fastest = outputs.command, max(fastest, np.abs(outputs.command).max())
    assert fastest > 0.1  # nobody asked it to
    assert "JOINTS_STALE" not in {reason.code for reason in outputs.status.reasons}
    end = bench.until(ended, 25.0)
    assert (end.kind, end.id) == ("goal_reached", command.goal.id)
    assert bench.error_px(target) < 0.5


def moving(bench: Any) -> None:
    bench.ready()
    bench.reply(goal(bench, bench.q + DISPLACED))
    assert np.abs(bench.run(0.4).command).max() > 0.1


@pytest.mark.parametrize("how", ["stop", "hold", "disable", "fault"])
def test_first_command_after_an_interruption_starts_from_rest(bench: Any, how: str) -> None:
    moving(bench)
    if how == "stop":
        bench.step(stop=True)
    elif how == "hold":
        bench.step(Hold())
    elif how == "disable":
        bench.step(Disable())
    else:
        bench.step(driver_fault=DriverFault("torn", "cable torn"))
    bench.run(1.0)
    assert bench.log[-1][1].command is None or np.abs(bench.log[-1][1].command).max() == 0.0
    if how == "fault":
        assert not bench.reply(Enable()).accepted
        assert bench.reply(Reset()).accepted
        bench.run(0.05)
    if how in ("disable", "fault"):
        assert bench.reply(Enable()).accepted
        bench.run(0.02)
    else:
        assert bench.reply(Resume()).accepted
    if how != "hold":
        bench.reply(goal(bench, bench.q + DISPLACED))
    first = next(o.command for _, o in bench.log[-1:] if o.command is not None)
    step = bench.settings.limits.acceleration_max / bench.settings.rate_hz
    assert np.all(np.abs(first) <= step * 1.000001)
    assert np.abs(bench.run(0.4).command).max() > 0.1  # and it does move again


def test_stop_latches_until_resume_and_ends_the_goal_once(bench: Any) -> None:
    moving(bench)
    bench.step(stop=True)
    assert [e.kind for e in bench.events if e.kind in TERMINAL] == ["goal_aborted"]
    refused = bench.reply(goal(bench, bench.q + DISPLACED))
    assert not refused.accepted
    assert refused.reasons[0].code == "STOPPED"
    assert bench.reply(Resume()).accepted
    assert bench.reply(goal(bench, bench.q + DISPLACED)).accepted


def test_every_accepted_goal_ends_in_exactly_one_terminal_event(bench: Any) -> None:
    bench.ready()
    base, ids = bench.q.copy(), []
    for k, mode in enumerate(["preempt", "queue", "preempt", "queue", "queue"]):
        command = goal(bench, base + 0.2 * DISPLACED * (-1) ** k, mode=mode)
        ids.append(command.goal.id)
        assert bench.reply(command).accepted
        bench.run(0.2)
    assert bench.reply(CancelGoal(ids[-1])).accepted
    bench.run(30.0)
    ends = {i: [e.kind for e in bench.events if e.kind in TERMINAL and e.id == i] for i in ids}
    assert all(len(kinds) == 1 for kinds in ends.values()), ends
    # the preempting goal goes first, the queue stays
    assert [ends[i][0] for i in ids] == [
        "goal_preempted",
        "goal_reached",
        "goal_reached",
        "goal_reached",
        "goal_cancelled",
    ]


def test_goal_without_renewal_of_its_lease_is_aborted_and_the_arm_rests(bench: Any) -> None:
    bench.ready()
    command = goal(bench, bench.q + DISPLACED, lease_s=0.5)
    bench.reply(command)
    for _ in range(4):
        bench.run(0.3)
        bench.step(RenewGoal(command.goal.id))
    assert not [e for e in bench.events if ended(e)]
    event = bench.until(ended, 1.0)
    assert event.reasons[0].code == "LEASE_EXPIRED"
    assert np.abs(bench.run(1.0).command).max() == 0.0


def test_joint_goal_without_renewal_of_its_lease_is_aborted_too(bench: Any) -> None:
    bench.ready()
    target = JointTarget({"j1": float(bench.q[0] + 2.0)})
    assert bench.reply(RunGoal(Goal("0000000b", target, lease_s=0.5))).accepted
    event = bench.until(ended, 1.0)
    assert (event.kind, event.reasons[0].code) == ("goal_aborted", "LEASE_EXPIRED")
    assert np.abs(bench.run(1.0).command).max() == 0.0


def test_jog_stops_when_the_dead_mans_lease_runs_out(bench: Any) -> None:
    bench.ready()
    assert bench.reply(Jog({"j1": 0.2}, lease_s=0.3)).accepted
    outputs = bench.run(0.2)
    assert outputs.command[0] == pytest.approx(0.2)
    assert np.abs(bench.run(0.5).command).max() == 0.0


def test_home_and_joint_goals_arrive(bench: Any) -> None:
    bench.ready()
    target = {"j1": float(bench.q[0] + 0.3), "j6": float(bench.q[5] - 0.5)}
    assert bench.reply(RunGoal(Goal(str(uuid.UUID(int=5)), JointTarget(target)))).accepted
    assert bench.until(ended, 10.0).kind == "goal_reached"
    assert bench.q[0] == pytest.approx(target["j1"], abs=1e-3)
    assert bench.reply(Home(str(uuid.UUID(int=6)))).accepted
    assert bench.until(ended, 10.0).kind == "goal_reached"
    np.testing.assert_allclose(bench.q, bench.settings.home, atol=1e-3)


def bad_goals(bench: Any) -> list[tuple[Command, str]]:
    good = bench.features(bench.q)
    return [
        (RunGoal(Goal("00000001", FeatureTarget({"left": {77: (1.0, 2.0)}}))), "marker 77"),
        (RunGoal(Goal("00000002", FeatureTarget({"middle": {0: (1.0, 2.0)}}))), "middle"),
        (RunGoal(Goal("00000003", FeatureTarget({"left": {0: (640.2, 2.0)}}))), "640.2"),
        (RunGoal(Goal("00000004", FeatureTarget({"left": {0: (math.nan, 2.0)}}))), "nan"),
        (RunGoal(Goal("00000005", FeatureTarget({"left": {0: (10.0, 2.0)}}))), "at least 3"),
        (RunGoal(Goal("00000006", FeatureTarget({"left": good["left"]}), law="cartesian3")), "two cameras"),
        (RunGoal(Goal("00000007", FeatureTarget(good, model_epoch=3))), "epoch 3"),
        (RunGoal(Goal("00000008", JointTarget({"j9": 0.0}))), "j9"),
        (RunGoal(Goal("00000009", JointTarget({"j1": 50.0}))), "50"),
        (Jog({"j7": 0.1}), "j7"),
        (Jog({"j1": math.nan}), "nan"),
        (RunGoal(Goal("0000000a", JointTarget({"j1": math.nan}))), "nan"),
        (Teach("x"), ""),
    ]


@pytest.mark.parametrize("case", range(12))
def test_bad_goal_is_refused_with_its_value_and_the_arm_stays(bench: Any, case: int) -> None:
    bench.ready()
    command, text = bad_goals(bench)[case]
    reply = bench.reply(command)
    assert reply.accepted is False
    assert text in reply.message
    assert np.abs(bench.run(0.2).command).max() == 0.0


def test_bad_goal_leaves_the_running_goal_alone(bench: Any) -> None:
    moving(bench)
    active = bench.log[-1][1].status.goal
    for command, _ in bad_goals(bench)[:9]:
        assert bench.reply(command).accepted is False
    assert bench.log[-1][1].status.goal == active


def test_model_waits_for_rest_and_unknown_models_are_refused(bench: Any) -> None:
    moving(bench)
    newer = msgspec.structs.replace(bench.truth.model, epoch=9)
    bench.step(model_update=ModelUpdate(newer))
    assert bench.log[-1][1].status.model_epoch == 7
    bench.until(ended, 25.0)
    bench.run(1.0)
    assert bench.log[-1][1].status.model_epoch == 9
    foreign = msgspec.structs.replace(bench.truth.model, joint_names=("a", "b", "c", "d", "e", "f"))
    events = bench.step(model_update=ModelUpdate(foreign)).events
    assert any("refused" in e.message for e in events)
    assert bench.run(0.1).status.model_epoch == 9


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda m: {"joint_kinds": ("revolute",) * 5 + ("prismatic",)}, "joint kinds"),
        (lambda m: {"mount": "eye_in_hand"}, "learnt with cameras mounted eye_in_hand"),
        (
            lambda m: {"cameras": (m.cameras[0], msgspec.structs.replace(m.cameras[1], width=1280))},
            "1280x480 images of camera 'right'",
        ),
        (
            lambda m: {"cameras": (m.cameras[0], msgspec.structs.replace(m.cameras[1], name="top"))},
            "the cell also has 'right'",
        ),
    ],
    ids=["joint kinds", "mount", "image size", "cameras"],
)
def test_a_model_of_another_cell_is_refused_and_the_one_in_force_stays(bench: Any, change: Any, told: str) -> None:
    moving(bench)
    model, source = bench.core.state.model, bench.core.state.source
    foreign = msgspec.structs.replace(model, epoch=9, **change(model))
    (event,) = bench.step(model_update=ModelUpdate(foreign)).events
    assert event.kind == "warning"
    assert event.message.startswith("model refused: ")
    assert told in event.message
    assert bench.core.state.source is source
    assert bench.until(ended, 25.0).kind == "goal_reached"
    bench.run(1.0)  # at rest, where one that waited would be taken
    assert bench.core.state.model is model
    assert bench.log[-1][1].status.model_epoch == 7


def test_images_that_contradict_the_model_make_it_suspect_and_abort(bench: Any) -> None:
    moving(bench)
    bench.bias_px = bench.rng.normal(0.0, 60.0, (8, 2))  # of a shape that no one change explains
    event = bench.until(ended, 3.0)
    assert event.reasons[0].code == "MODEL_SUSPECT"
    refused = bench.reply(goal(bench, bench.q))
    assert refused.reasons[0].code == "MODEL_SUSPECT"


def test_images_while_the_joints_are_silent_tell_nothing_of_the_model(bench: Any) -> None:
    """Drives that say nothing while the arm brakes or is pushed: what cameras see then is not the model's fault."""
    bench.ready()
    before = bench.log[-1][1].status.model
    bench.joints_on = False
    bench.run(0.1)
    bench.q = bench.q + 0.4 * DISPLACED
    bench.run(2.0)
    assert bench.log[-1][1].status.model == before
    bench.joints_on = True
    bench.run(1.0)
    assert bench.log[-1][1].status.model == before


def test_goal_can_be_taught_and_reached_again(bench: Any) -> None:
    bench.ready()
    shown = bench.q + 0.6 * DISPLACED
    bench.reply(
        RunGoal(
            Goal(
                str(uuid.UUID(int=5)),
                JointTarget(dict(zip(bench.settings.joint_names, shown.tolist(), strict=True))),
            )
        )
    )
    bench.until(ended, 10.0)
    bench.run(0.3)
    assert bench.reply(Teach("there", 5)).accepted
    taught = bench.until(lambda e: e.kind == "taught", 5.0)
    bench.reply(Home(str(uuid.UUID(int=6))))
    bench.until(ended, 10.0)
    set_points = {
        s.camera: {int(i): (float(p[0]), float(p[1])) for i, p in zip(s.ids, s.pixels, strict=True)}
        for s in taught.samples
    }
    assert bench.reply(RunGoal(Goal(str(uuid.UUID(int=7)), FeatureTarget(set_points, model_epoch=7)))).accepted
    assert bench.until(ended, 25.0).kind == "goal_reached"
    assert bench.error_px(shown) < 0.3


def test_trial_motions_visit_each_joint_alone(bench: Any) -> None:
    bench.run(0.1)
    bench.step(Enable())
    bench.reply(Calibrate("00000011"))
    bench.until(lambda e: e.kind == "calibration_finished", 120.0)
    samples = [e for e in bench.events if e.kind == "calibration_sample"]
    base = bench.settings.trials.base
    for joint in range(6):
        stops = np.array([e.joints for e in samples if e.trial == joint])
        assert len(stops) == 4
        others = np.delete(stops - base, joint, axis=1)
        assert np.abs(others).max() < 2e-3
        assert np.ptp(stops[:, joint]) == pytest.approx(0.2, abs=5e-3)
    assert all(s.ids.size == 8 and s.frames == 2 for e in samples for s in e.samples)


def test_trial_motions_name_the_joint_that_does_not_follow(bench: Any) -> None:
    bench.run(0.1)
    bench.step(Enable())
    bench.frozen_joint = 2
    bench.reply(Calibrate("00000011"))
    event = bench.until(lambda e: e.kind == "calibration_aborted", 120.0)
    assert event.reasons[0].code == "JOINT_NOT_FOLLOWING"
    assert event.reasons[0].subject == "j3"
    outputs = bench.run(1.0)
    assert (outputs.status.lifecycle, outputs.command) == ("fault", None)
    assert not bench.reply(Enable()).accepted


def test_law_whose_encoder_stands_still_ends_in_a_latched_fault(bench: Any) -> None:
    moving(bench)
    bench.frozen_joint = 5
    event = bench.until(ended, 3.0)
    assert (event.reasons[0].code, event.reasons[0].subject) == ("JOINT_NOT_FOLLOWING", "j6")
    assert bench.run(0.5).status.lifecycle == "fault"
    bench.frozen_joint = -1
    assert bench.reply(Reset()).accepted
    bench.run(0.05)
    assert bench.reply(Enable()).accepted
    bench.run(3.0)  # the images contradicted the still encoder; now they agree again
    assert bench.reply(goal(bench, bench.q + 0.3 * DISPLACED)).accepted
    assert bench.until(ended, 25.0).kind == "goal_reached"


def test_dry_run_expects_no_motion(benches: Any) -> None:
    bench = benches(1)
    bench.core = ServoCore(msgspec.structs.replace(bench.settings, watch_following=False))
    moving(bench)
    bench.frozen_joint = 5
    assert bench.run(1.0).status.lifecycle == "active"


@pytest.mark.parametrize(("silent", "code"), [(True, "CAMERA_SILENT"), (False, "MARKERS_NOT_SEEN")])
def test_trial_motions_without_markers_name_the_camera(bench: Any, silent: bool, code: str) -> None:
    bench.run(0.1)
    bench.step(Enable())
    bench.reply(Calibrate("00000011"))
    if silent:
        bench.cameras_on[1] = False
    else:
        bench.marker_mask[:] = False
    event = bench.until(lambda e: e.kind == "calibration_aborted", 120.0)
    assert event.reasons[0].code == code
    assert event.reasons[0].subject in (("right",) if silent else ("left", "right"))
    assert np.abs(bench.run(1.0).command).max() == 0.0


def averaging(bench: Any, frames: int) -> Any:
    """``bench`` with so many frames averaged at each stop."""
    trials = msgspec.structs.replace(bench.settings.trials, frames=frames)
    bench.settings = msgspec.structs.replace(bench.settings, trials=trials)
    bench.core = ServoCore(bench.settings)
    return bench


def test_trial_motions_wait_for_a_camera_that_is_still_starting(benches: Any) -> None:
    frames = 4
    bench = averaging(benches(1), frames)
    bench.cameras_on[1] = False
    bench.run(0.1)
    bench.step(Enable())
    bench.reply(Calibrate("00000011"))
    bench.run(20.0)
    assert not [e for e in bench.events if e.kind.startswith("calibration_") and e.kind != "calibration_progress"]
    bench.cameras_on[1] = True
    sample = bench.until(lambda e: e.kind == "calibration_sample", 5.0)
    assert sample.trial == -1
    assert [s.frames for s in sample.samples] == [frames, frames]


def test_trial_motions_tell_a_camera_of_too_few_frames_from_one_without_markers(benches: Any) -> None:
    bench = averaging(benches(1), 4)
    bench.run(0.1)
    bench.step(Enable())
    bench.reply(Calibrate("00000011"))
    while bench.core.state.source.phase != "collect":
        bench.step()
    while bench.core.state.source.sums.frames[1] < 1:
        bench.step()
    bench.cameras_on[1] = False
    reason = bench.until(lambda e: e.kind == "calibration_aborted", 10.0).reasons[0]
    assert (reason.code, reason.subject) == ("CAMERA_SILENT", "right")
    assert (reason.value, reason.threshold) == (1.0, 4.0)


def test_trial_motions_back_off_when_markers_leave_the_view(bench: Any) -> None:
    bench.run(0.1)
    bench.step(Enable())
    bench.reply(Calibrate("00000011"))
    while not [e for e in bench.events if e.kind == "calibration_finished"]:
        bench.marker_mask[:] = bench.q[3] < bench.settings.trials.base[3] + 0.07
        bench.step()
        assert bench.seq < 30_000, bench.events[-1]
    assert [e for e in bench.events if e.kind == "warning" and "j4" in e.message]
    stops = np.array([e.joints[3] for e in bench.events if e.kind == "calibration_sample" and e.trial == 3])
    assert stops.max() < bench.settings.trials.base[3] + 0.07


def test_state_survives_serialisation_bit_for_bit(bench: Any) -> None:
    moving(bench)
    data = encode_state(bench.core.state)
    twin = ServoCore(bench.settings, decode_state(data))
    start = len(bench.log)
    bench.run(1.0)
    for inputs, outputs in bench.log[start:]:
        again = twin.step(inputs)
        assert again.command.tobytes() == outputs.command.tobytes()
    assert encode_state(twin.state) == encode_state(bench.core.state)


def test_a_state_of_version_11_is_taken_up(bench: Any) -> None:
    """In the midst of a goal, which goes on with its progress and its friction."""
    bench.dead_speed = 0.002
    moving(bench)
    data = encode_state(bench.core.state)
    assert bench.core.state.block.numbers.run.moved_s > 0.0
    assert bench.core.state.block.friction_from.any()
    assert encode_state(decode_state(msgspec.msgpack.encode(before_version_12(data)))) == data


def test_a_state_of_version_6_is_taken_up(bench: Any) -> None:
    """A recording of before stamps and gaps were checked: the same state but for what it does not hold."""
    moving(bench)
    state = bench.core.state
    later, in_block = ("refused_joints", "refused_frames"), ("silent_from", "silent_travel", "silent_s")
    old = without_a_block(encode_state(state))
    for name in (*later, *in_block, "last_step_ns"):
        del old[name]
    old["contact"]["reason"] = old.pop("stop_reason")
    old["version"] = 6
    data = msgspec.msgpack.encode(old)
    taken = decode_state(data)
    assert taken.block.numbers.last_step_ns == 0
    assert len(taken.refused_frames) == len(state.cameras)
    for name in later:
        setattr(taken, name, getattr(state, name))
    for name in in_block:
        getattr(taken.block, name)[:] = getattr(state.block, name)
    taken.block.numbers.last_step_ns, taken.block.numbers.silence_known = (
        state.block.numbers.last_step_ns,
        state.block.numbers.silence_known,
    )
    assert encode_state(taken) == encode_state(state)
    assert is_recorded(state, data)
    state.block.command[0] += 1e-9
    assert not is_recorded(state, data)
    old["version"] = 5
    with pytest.raises(StateVersionError):
        decode_state(msgspec.msgpack.encode(old))


def test_what_needs_kernels_that_are_not_compiled_yet_is_refused_and_the_model_waits(bench: Any) -> None:
    bench.step(model_update=ModelUpdate(bench.truth.model), compiling=True)
    bench.step(Enable(), compiling=True)
    for _ in range(20):
        status = bench.step(compiling=True).status
    assert (status.model_epoch, status.lifecycle) == (0, "active")
    assert [reason.code for reason in status.reasons] == ["COMPILING"]
    for command in (goal(bench, bench.q), Teach("park", 1), Calibrate("00000011", check=True)):
        (reply,) = [e for e in bench.step(command, compiling=True).events if e.kind == "reply"]
        assert not reply.accepted
        assert [reason.code for reason in reply.reasons] == ["COMPILING"]
    joints = RunGoal(Goal("00000012", JointTarget({"j1": float(bench.q[0]) + 0.01})))
    (reply,) = [e for e in bench.step(joints, compiling=True).events if e.kind == "reply"]
    assert reply.accepted
    bench.run(2.0)
    status = bench.step().status
    assert status.model_epoch == bench.truth.model.epoch
    assert status.reasons == ()
    assert bench.reply(goal(bench, bench.q)).accepted
