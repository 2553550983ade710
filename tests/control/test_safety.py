"""The safety stage: what it promises, for any input."""

import math
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from oracles.safety import expected
from stereoservo.core import command as stage
from stereoservo.core.block import Block, views
from stereoservo.core.command import (
    Bounds,
    Requested,
    SafetyConfigurationError,
    SafetyInputs,
    SafetyLimits,
    SafetyResult,
    command,
    explained,
    limit_velocity,
)
from stereoservo.core.context import ARRAYS, WORKSPACE, Numbers

DT = 0.004


def make_limits(n=3, keep_outs=(), **changes):
    values = {
        "joint_names": tuple(f"j{j + 1}" for j in range(n)),
        "position_min": np.full(n, -1.0),
        "position_max": np.full(n, 1.5),
        "velocity_max": np.linspace(0.5, 1.5, n),
        "acceleration_max": np.linspace(6.0, 2.0, n),
        "position_margin": 0.01,
        "keep_outs": np.array(keep_outs).reshape(-1, n, 2),
        "keep_out_names": tuple(f"box{k}" for k in range(len(keep_outs))),
        "joint_timeout_s": 0.1,
        "coast_s": 0.5,
    }
    return SafetyLimits(**(values | changes))


def safety_stage(inputs, limits):
    """The safety stage on arrays, by the kernel that the core has in its own.

    The output is finite and, for any ``raw``, within velocity and acceleration limits, the latter relative to
    ``previous`` (which, where it was no output of this stage, counts as scaled to the velocity limits; non-finite
    entries as rest). A joint that started inside its margins at a speed it can brake from never leaves them; one
    outside moves only inward; keep-out boxes are never entered. The output is a non-negative multiple of ``raw`` unless
    positions, acceleration or braking acted; then the joint that must brake does so fully, at the cost of direction.
    """
    limited, acted = np.empty(3), np.empty(3)
    wanted = Requested(
        inputs.raw, inputs.positions, inputs.previous, inputs.brake, inputs.dt_s, inputs.joint_age_s,
        inputs.feature_age_s, inputs.needs_features, inputs.speed_scale,
    )  # fmt: skip
    told, found = limit_velocity(wanted, Bounds(limits.table, limits.bounds, limits.keep_outs), limited, acted)
    return explained(inputs, limits, limited, found, acted) if told else SafetyResult(inputs.raw, limited)


def codes(result):
    return {reason.code for reason in result.reasons}


anything = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=300, deadline=None)
@given(
    raw=st.lists(anything, min_size=3, max_size=3),
    positions=st.lists(anything, min_size=3, max_size=3),
    previous=st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3),
    joint_age=anything,
    feature_age=anything,
    needs=st.booleans(),
    scale=anything,
    brake=st.booleans(),
)
def test_any_input_gives_a_finite_command_within_velocity_and_acceleration(
    raw, positions, previous, joint_age, feature_age, needs, scale, brake
):
    limits = make_limits(keep_outs=[[[0.2, 0.4], [-0.3, 0.3], [-np.inf, np.inf]]])
    previous = np.clip(previous, -limits.velocity_max, limits.velocity_max)
    result = safety_stage(
        SafetyInputs(np.array(raw), np.array(positions), previous, DT, joint_age, feature_age, needs, scale, brake),
        limits,
    )
    assert np.isfinite(result.limited).all()
    assert (np.abs(result.limited) <= limits.velocity_max * (1 + 1e-12)).all()
    assert (np.abs(result.limited - previous) <= limits.acceleration_max * DT * (1 + 1e-9) + 1e-15).all()
    if not np.isfinite(raw).all():
        assert stage.NON_FINITE_COMMAND in codes(result)
        assert result.braking
    for reason in result.reasons:
        assert reason.hint
        assert reason.value is None or math.isfinite(reason.value)


@settings(max_examples=200, deadline=None)
@given(
    raw=st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3),
    previous=st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3),
    scale=st.floats(0.0, 1.0),
)
def test_the_direction_is_kept_unless_positions_or_acceleration_act(raw, previous, scale):
    raw, previous = np.array(raw), np.array(previous)
    result = safety_stage(SafetyInputs(raw, np.zeros(3), previous, DT, speed_scale=scale), make_limits())
    if codes(result) & {stage.ACCELERATION_LIMITED, stage.JOINT_LIMIT}:
        change = result.limited - previous
        if stage.JOINT_LIMIT not in codes(result):  # a share of the way to a multiple of raw
            factor = 1.0 if not raw.any() else None
            assert factor == 1.0 or np.linalg.matrix_rank(np.stack([raw, previous, previous + change]), tol=1e-9) <= 2
        return
    size = np.abs(raw).max()
    multiple = 0.0 if size == 0.0 else result.limited[np.abs(raw).argmax()] / raw[np.abs(raw).argmax()]
    assert multiple >= 0.0
    np.testing.assert_allclose(result.limited, multiple * raw, atol=1e-12)


@settings(max_examples=200, deadline=None)
@given(raw=st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3), scale=st.floats(0.05, 1.0))
def test_far_from_its_limits_no_joint_is_clipped_whatever_speed_is_asked(raw, scale):
    """From the middle of their ranges the joints can brake from any speed within their velocity limits."""
    raw, limits = np.array(raw), make_limits()
    over = max(1.0, float((np.abs(raw) / (scale * limits.velocity_max)).max()))
    result = safety_stage(SafetyInputs(raw, np.zeros(3), raw / over, DT, speed_scale=scale), limits)
    np.testing.assert_allclose(result.limited, raw / over, rtol=1e-12, atol=1e-12)
    assert stage.JOINT_LIMIT not in codes(result)


def test_a_joint_that_brakes_for_its_limit_does_not_slow_the_others():
    limits = make_limits()
    q, asked = np.array([1.48, 0.0, 0.0]), np.array([40.0, 0.25, -0.5])
    result = safety_stage(SafetyInputs(asked, q, np.array([0.0, 0.25, -0.5]), DT), limits)
    assert codes(result) == {stage.JOINT_LIMIT, stage.ACCELERATION_LIMITED}
    np.testing.assert_array_equal(result.limited[1:], asked[1:])
    assert 0.0 < result.limited[0] <= limits.acceleration_max[0] * DT


@settings(max_examples=60, deadline=None)
@given(
    start=st.lists(st.floats(-0.98, 1.48), min_size=3, max_size=3),
    seed=st.integers(0, 10**6),
    dt=st.sampled_from([0.001, 0.004, 0.02, 0.04]),
    persistence=st.integers(1, 60),
    age=st.sampled_from([0.0, 0.003]),
)
def test_positions_never_leave_their_range(start, seed, dt, persistence, age):
    rng = np.random.default_rng(seed)
    limits = make_limits()
    q, command = np.array(start), np.zeros(3)
    for step in range(250):
        if step % persistence == 0:
            raw = rng.choice([-20.0, -1.0, -0.1, 0.0, 0.1, 1.0, 20.0], 3) * rng.random(3)
        period = dt * rng.uniform(0.5, 1.0)  # the loop may jitter, as long as the stage is told
        before = command
        command = safety_stage(
            SafetyInputs(raw, q, before, period, joint_age_s=age, brake=bool(rng.random() < 0.02)), limits
        ).limited
        q = q + command * period
        assert (np.abs(command - before) <= limits.acceleration_max * period + 1e-12).all()
        assert (q >= limits.position_min + limits.position_margin - 1e-9).all()
        assert (q <= limits.position_max - limits.position_margin + 1e-9).all()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), lag=st.integers(1, 20), persistence=st.integers(5, 200))
def test_samples_that_lag_behind_are_reckoned_with(seed, lag, persistence):
    rng = np.random.default_rng(seed)
    limits = make_limits(position_min=np.full(3, -0.3), position_max=np.full(3, 0.4))
    q, command = np.zeros(3), np.zeros(3)
    track = [q] * (lag + 1)
    for step in range(600):
        if step % persistence == 0:
            raw = rng.choice([-20.0, 20.0], 3) * rng.random(3)
        inputs = SafetyInputs(raw, track[-1 - lag], command, DT, joint_age_s=lag * DT)
        command = safety_stage(inputs, limits).limited
        q = q + command * DT
        track.append(q)
        assert (q >= limits.position_min + limits.position_margin - 1e-9).all()
        assert (q <= limits.position_max - limits.position_margin + 1e-9).all()


@settings(max_examples=60, deadline=None)
@given(
    start=st.lists(st.floats(-0.98, 1.48), min_size=3, max_size=3),
    seed=st.integers(0, 10**6),
    dt=st.sampled_from([0.001, 0.004, 0.02]),
    persistence=st.integers(5, 120),
)
def test_keep_outs_are_never_entered(start, seed, dt, persistence):
    boxes = np.array(
        [
            [[0.0, 0.5], [-0.4, 0.4], [-np.inf, np.inf]],
            [[-0.6, -0.3], [0.2, np.inf], [0.0, 0.3]],
            [[-np.inf, np.inf], [-np.inf, -0.6], [-np.inf, np.inf]],
        ]
    )
    limits = make_limits(keep_outs=boxes)

    def inside(q):
        return ((q > boxes[:, :, 0] - 0.01 + 1e-9) & (q < boxes[:, :, 1] + 0.01 - 1e-9)).all(axis=1)

    rng = np.random.default_rng(seed)
    q, command = np.array(start), np.zeros(3)
    assume(not inside(q).any())
    for step in range(250):
        if step % persistence == 0:
            raw = rng.uniform(-3.0, 3.0, 3)
        command = safety_stage(SafetyInputs(raw, q, command, dt), limits).limited
        q = q + command * dt
        assert not inside(q).any()


@pytest.mark.parametrize("outside", [1.6, -1.3, 1.495])
def test_a_joint_outside_may_only_move_inward(outside):
    inward = -np.sign(outside)
    q = np.array([outside, 0.0, 0.0])
    limits = make_limits()
    out = safety_stage(SafetyInputs(np.array([-inward, 0.2, 0.0]), q, np.zeros(3), DT), limits)
    assert out.limited[0] == 0.0
    assert out.limited[1] > 0.0
    (reason,) = [r for r in out.reasons if r.code == stage.JOINT_LIMIT]
    assert reason.subject == "j1"
    assert reason.value == outside
    assert reason.hint.startswith("jog j1 down" if outside > 0 else "jog j1 up")
    command = np.zeros(3)
    for _ in range(2000):
        command = safety_stage(SafetyInputs(np.array([inward, 0.0, 0.0]), q, command, DT), limits).limited
        assert command[0] * inward >= 0.0
        q = q + command * DT
    assert -1.0 < q[0] < 1.5


def test_a_braking_joint_has_its_full_deceleration_while_another_one_is_slow():
    # j3 turns round at full swing: alone, the uniform share would leave j1 too fast for its limit
    limits = make_limits(acceleration_max=np.array([4.0, 4.0, 0.5]))
    q, command = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    weakest = 1.0
    for step in range(1200):
        flip = 1.0 if (step // 60) % 2 else -1.0
        result = safety_stage(SafetyInputs(np.array([0.5, 0.0, 1.5 * flip]), q, command, DT), limits)
        command = result.limited
        q = q + command * DT
        weakest = min(weakest, 1.49 - q[0])
    assert -1e-9 <= weakest < 0.02
    assert stage.JOINT_LIMIT in codes(result)


def test_braking_is_uniform_and_ends_at_rest():
    limits = make_limits()
    command = np.array([0.4, -0.2, 0.1])
    direction = command / np.linalg.norm(command)
    steps = 0
    while np.abs(command).max() > 0:
        result = safety_stage(SafetyInputs(np.full(3, 0.3), np.zeros(3), command, DT, brake=True), limits)
        assert codes(result) == {stage.BRAKING}
        assert np.linalg.norm(command) > np.linalg.norm(result.limited)
        command = result.limited
        np.testing.assert_allclose(command, direction * np.linalg.norm(command), atol=1e-12)
        steps += 1
    # j1 (0.4 at 6) needs 0.067 s, j2 0.05 s, j3 0.05 s: the slowest sets the pace
    assert steps == math.ceil(0.4 / 6.0 / DT)


def test_stale_joints_brake():
    moving = np.array([0.3, 0.0, 0.0])
    fresh = safety_stage(SafetyInputs(moving, np.zeros(3), moving, DT, joint_age_s=0.1), make_limits())
    assert not fresh.braking
    for age in (0.11, math.nan, math.inf, -math.inf, -3600.0, -1e-9):
        result = safety_stage(SafetyInputs(moving, np.zeros(3), moving, DT, joint_age_s=age), make_limits())
        assert codes(result) == {stage.JOINTS_STALE, stage.BRAKING}
        assert result.limited[0] < moving[0]


@pytest.mark.parametrize(
    ("age", "needs", "expected", "braking"),
    [
        (0.05, True, set(), False),
        (0.3, True, {stage.COASTING}, False),
        (0.51, True, {stage.FEATURES_STALE, stage.BRAKING}, True),
        (math.nan, True, {stage.FEATURES_STALE, stage.BRAKING}, True),
        (-1e-9, True, {stage.FEATURES_STALE, stage.BRAKING}, True),
        (-3600.0, True, {stage.FEATURES_STALE, stage.BRAKING}, True),
        (-3600.0, False, set(), False),
        (5.0, False, set(), False),
    ],
)
def test_features_coast_then_brake(age, needs, expected, braking):
    moving = np.array([0.3, 0.0, 0.0])
    inputs = SafetyInputs(moving, np.zeros(3), moving, DT, feature_age_s=age, needs_features=needs)
    result = safety_stage(inputs, make_limits())
    assert codes(result) == expected
    assert result.braking == braking


def test_speed_scale_keeps_direction_and_says_so():
    raw = np.array([0.25, 0.5, -1.0])
    limits = make_limits(velocity_max=np.ones(3))
    result = safety_stage(SafetyInputs(raw, np.zeros(3), 0.1 * raw, DT, speed_scale=0.1), limits)
    np.testing.assert_allclose(result.limited, 0.1 * raw)
    (reason,) = result.reasons
    assert (reason.code, reason.subject, reason.value) == (stage.VELOCITY_SCALED, "j3", 1.0)
    assert reason.threshold == pytest.approx(0.1)


def test_a_command_within_every_limit_passes_bit_for_bit():
    raw = np.array([0.1, -0.123456789, 0.3])
    result = safety_stage(SafetyInputs(raw, np.zeros(3), raw, DT), make_limits())
    np.testing.assert_array_equal(result.limited, raw)
    assert result.reasons == ()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"velocity_max": np.array([1.0, 0.0, 1.0])}, "'j2': velocity_max is 0.0"),
        ({"acceleration_max": np.array([1.0, 1.0, np.inf])}, "'j3': acceleration_max is inf"),
        ({"position_margin": 2.0}, "nothing inside the margin 2.0"),
        ({"position_min": np.zeros(2)}, "position_min"),
        ({"coast_s": -1.0}, "coast_s is -1.0"),
        (
            {"keep_outs": np.zeros((1, 3, 2)), "keep_out_names": ("a",)},
            "'a': every low must be below its high",
        ),
        ({"keep_outs": [[[-np.inf, np.inf]] * 3], "keep_out_names": ("a",)}, "bounds no joint"),
        ({"keep_outs": [[[-0.1, 0.1]] * 3], "keep_out_names": ()}, "1 keep-outs have 0 names"),
        ({"keep_outs": [[[-0.1, 0.1]] * 3], "keep_out_names": ("a", "b")}, "1 keep-outs have 2 names"),
    ],
)
def test_limits_that_cannot_work_are_refused_by_name(changes, text):
    with pytest.raises(SafetyConfigurationError, match=text):
        make_limits(**changes)


@pytest.mark.parametrize(("beyond", "told"), [(1e-12, False), (1e-6, True)])
def test_only_a_change_that_counts_is_told(beyond, told):
    limits = make_limits()
    raw = np.array([limits.acceleration_max[0] * DT * (1.0 + beyond), 0.0, 0.0])
    result = safety_stage(SafetyInputs(raw, np.zeros(3), np.zeros(3), DT, 0.0, 0.0, False), limits)
    assert (stage.ACCELERATION_LIMITED in codes(result)) == told


def test_the_shortest_period_gives_reasons_with_numbers():
    inputs = SafetyInputs(np.full(3, 9.0), np.zeros(3), np.zeros(3), 5e-324, 0.0, 0.0, False)
    result = safety_stage(inputs, make_limits())
    assert stage.ACCELERATION_LIMITED in codes(result)
    assert all(reason.value is None or math.isfinite(reason.value) for reason in result.reasons)


def drawn(rng):
    """A step at which everything may act: near limits and boxes, fast and slow, stale, not finite."""
    n = 3
    boxes = np.sort(rng.uniform(-1.2, 1.6, (2, n, 2)), axis=2)
    boxes[rng.random(boxes.shape) < 0.3] *= np.inf
    boxes[:, :, 0], boxes[:, :, 1] = (
        np.where(boxes[:, :, 0] > 1e9, -np.inf, boxes[:, :, 0]),
        np.where(boxes[:, :, 1] < -1e9, np.inf, boxes[:, :, 1]),
    )
    boxes[:, 0] = np.sort(rng.uniform(-1.2, 1.6, (2, 2)))
    limits = make_limits(
        keep_outs=boxes,
        position_min=rng.uniform(-1.2, -0.5, n),
        position_max=rng.uniform(0.5, 1.6, n),
        velocity_max=rng.uniform(0.3, 2.0, n),
        acceleration_max=rng.uniform(0.5, 8.0, n),
        position_margin=float(rng.choice([0.0, 0.01, 0.05])),
    )
    edges = np.concatenate([limits.position_min, limits.position_max, boxes[np.isfinite(boxes)]])
    positions = np.where(
        rng.random(n) < 0.5, rng.choice(edges, n) + rng.normal(0.0, 0.05, n), rng.uniform(-1.0, 1.2, n)
    )
    previous = rng.uniform(-1.0, 1.0, n) * limits.velocity_max * rng.choice([0.1, 1.0, 1.2])
    raw = np.where(rng.random(n) < 0.6, previous + rng.normal(0.0, 0.01, n), rng.normal(0.0, 2.0, n))
    for array in (positions, previous, raw):
        if rng.random() < 0.05:
            array[rng.integers(n)] = rng.choice([np.nan, np.inf, -np.inf])
    raw[rng.random(n) < 0.1] = 0.0
    return limits, SafetyInputs(
        raw,
        positions,
        previous,
        float(rng.choice([0.001, 0.004, 0.02])),
        joint_age_s=float(
            rng.choice([0.0, 0.004, 0.05, 0.1, 0.3, -0.1, np.nan], p=[0.3, 0.3, 0.2, 0.05, 0.05, 0.05, 0.05])
        ),
        feature_age_s=float(rng.choice([0.0, 0.15, 0.3, 0.5, 0.7, -0.1, np.nan])),
        needs_features=bool(rng.random() < 0.3),
        speed_scale=float(rng.choice([1.0, 0.3, 0.0, 1.5, -1.0, np.nan], p=[0.6, 0.2, 0.05, 0.05, 0.05, 0.05])),
        brake=bool(rng.random() < 0.1),
    )


def test_the_stage_answers_as_its_plain_description_does():
    rng = np.random.default_rng(1)
    seen = set()
    for trial in range(1500):
        limits, inputs = drawn(rng)
        result, wanted = safety_stage(inputs, limits), expected(inputs, limits)
        where = f"trial {trial}: {inputs}, {limits}"
        np.testing.assert_allclose(result.limited, wanted.limited, rtol=1e-9, atol=1e-10, err_msg=where)
        assert result.braking == wanted.braking, where
        told = [(r.code, r.level, r.subject, r.value, r.threshold) for r in result.reasons]
        assert [t[:3] for t in told] == [r[:3] for r in wanted.reasons], where
        for reason, (*_, value, threshold, words) in zip(result.reasons, wanted.reasons, strict=True):
            assert reason.value == (None if value is None else pytest.approx(value, rel=1e-9, abs=1e-10)), where
            assert reason.threshold == (None if threshold is None else pytest.approx(threshold)), where
            assert words in reason.hint, where
        seen |= codes(result)
    assert len(seen) == 9


def test_a_step_of_the_core_is_limited_as_its_state_and_the_motion_say():
    rng = np.random.default_rng(2)
    counts = {"joints": 3, "cameras": 2, "markers": 0, "rows": 0, "window": 1, "past": 2}
    for active in (False, *[True] * 60):
        limits, step = drawn(rng)
        now_ns, source, cell = 10**12 + int(rng.integers(10**9)), *rng.uniform(0.2, 1.0, 2)
        ages_ns = [int(age * 1e9) for age in rng.uniform(0.0, 0.8, 3)]
        accepted = ages_ns[: rng.integers(3)]
        late = bool(rng.integers(2))  # drives that are late: where they will be counts, and not where they are
        block, record = Block(counts), np.zeros(1, WORKSPACE)
        work, arrays = Numbers.from_buffer(record.view(np.uint8).data), views(record, ARRAYS, counts)
        for estimate, age_ns in zip(block.estimates, accepted, strict=False):
            estimate.accepted_ns = now_ns - age_ns
        block.command[:], block.numbers.last_joints_ns = step.previous, now_ns - ages_ns[2] // 4
        arrays["q"][:], arrays["velocity"][:] = step.positions, step.raw
        arrays["limits"][:], arrays["bounds"][:] = limits.table, limits.bounds
        work.now_ns, work.dt_s, work.active, work.paused = now_ns, step.dt_s, active, step.brake
        work.needs_features, work.speed_scale = step.needs_features, source * cell
        outermost = step.positions
        if late:
            block.delay_s[:], block.delay_under_way[:] = 0.1, rng.uniform(-0.5, 0.5, 3)
            ahead, towards = (
                step.positions + block.delay_under_way,
                np.where(step.raw != 0.0, step.raw, step.previous),
            )
            outermost = np.where(towards > 0.0, np.maximum(step.positions, ahead), np.minimum(step.positions, ahead))
        command(block.record, record, limits.keep_outs)
        context = SimpleNamespace(
            derived=SimpleNamespace(workspace=SimpleNamespace(numbers=work, arrays=arrays)),
            state=SimpleNamespace(block=block), now_ns=now_ns, dt_s=step.dt_s,
        )  # fmt: skip
        result = stage.limited_command(context, limits)
        same = msgspec.structs.replace(
            step,
            positions=outermost,
            joint_age_s=ages_ns[2] // 4 * 1e-9,
            feature_age_s=min(accepted, default=now_ns) * 1e-9,
            speed_scale=source * cell,
        )
        wanted = expected(same, limits)
        sent = wanted.limited if active else np.zeros(3)
        np.testing.assert_allclose(block.command, sent, rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(result.limited, block.command)
        np.testing.assert_array_equal(result.raw, step.raw)
        assert [reason.code for reason in result.reasons] == [reason[0] for reason in wanted.reasons]
        assert not np.shares_memory(block.command, result.limited)


def test_the_limits_are_those_of_the_cell():
    names = {*SafetyLimits.__struct_fields__} - {"joint_names", "features_fresh_s"}
    limits = make_limits(keep_outs=[[[0.2, 0.4], [-0.3, 0.3], [-np.inf, np.inf]]])
    cell = SimpleNamespace(**{name: getattr(limits, name) for name in names})
    made = stage.safety_limits(SimpleNamespace(joint_names=limits.joint_names, limits=cell), 0.07)
    for name in SafetyLimits.__struct_fields__:
        wanted = 0.07 if name == "features_fresh_s" else getattr(limits, name)
        np.testing.assert_array_equal(getattr(made, name), wanted)
