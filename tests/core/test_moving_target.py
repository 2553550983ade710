"""Targets that move by themselves before cameras on the arm: followed within a pixel, with the right causes named, and
carried through drop-outs. The truth is Euclidean, conjugated into a random projective frame.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from scipy.linalg import expm

from core.conftest import BASE, flange_at, twist
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.core.target.motion import (
    ACCELERATION_S,
    after,
    displaced,
    elapse,
    find_stated,
    fold_frame,
    jumped,
    pixel_rates,
    scaled_basis,
    solve_into,
    turns_about,
)
from stereoservo.core.target.track import report_untrackable, restart
from stereoservo.kinematics.kernels import image_jacobian, project_points, transform_points
from stereoservo.messages.goals import FeatureTarget, Goal, RunGoal

NOISE_PX = 0.1
MARKERS = tuple(range(8))


def slide(bench: Any, way: Callable[[float], np.ndarray]) -> None:
    """The body before the cameras goes along ``way`` (3,) [m] in the world, by the seconds from now."""

    def displacement(t: float) -> np.ndarray:
        D = np.eye(4)
        D[:3, 3] = way(t)
        return D

    ride(bench, displacement)


def ride(bench: Any, way: Callable[[float], np.ndarray]) -> None:
    """The body before the cameras is displaced by ``way`` (4, 4) in the world, by the seconds from now."""
    begin_ns, markers = bench.now_ns, bench.truth.markers

    def points(q: np.ndarray) -> np.ndarray:
        D = way((bench.now_ns - begin_ns) * 1e-9)
        return (np.linalg.inv(flange_at(q)) @ D @ flange_at(BASE) @ markers.T).T[:, :3]

    bench.truth.points = points


def following(benches: Any, seed: int, *, follows: bool = True) -> tuple[Any, np.ndarray]:
    """A bench whose arm holds what its cameras see, and the pixels of that."""
    bench = benches(seed, noise_px=NOISE_PX, mount="eye_in_hand").ready()
    wanted = bench.truth.pixels(bench.q)
    goal = Goal(
        "00000001", FeatureTarget(bench.features(bench.q)), law="stereo", gain=2.0, tolerance_px=0.1,
        time_limit_s=60.0, follow_markers=MARKERS if follows else (),
    )  # fmt: skip
    slide(bench, lambda t: 1e-6 * np.ones(3) * min(t, 1.0))
    assert bench.reply(RunGoal(goal)).accepted
    return bench, wanted


def largest_px(bench: Any, wanted: np.ndarray, seconds: float) -> float:
    """Largest distance of a marker from its goal over time."""
    errors = []
    for _ in range(round(seconds * bench.settings.rate_hz)):
        bench.step()
        errors.append(np.linalg.norm(bench.truth.pixels(bench.q) - wanted, axis=-1).max())
    return float(max(errors))


def verdicts(bench: Any) -> set[str]:
    return {event.name for event in bench.events if event.kind == "health" and event.name != "ok"}


@pytest.mark.parametrize("seed", [0, 1])
def test_a_target_that_slides_is_followed_and_no_other_cause_is_named(benches: Any, seed: int) -> None:
    bench, wanted = following(benches, seed)
    bench.run(0.4)
    direction = np.random.default_rng([seed, 19]).standard_normal(3)
    slide(bench, lambda t: 0.05 * t * direction / np.linalg.norm(direction))
    bench.run(2.0)
    assert largest_px(bench, wanted, 1.0) < 1.5
    assert verdicts(bench) == set()
    assert bench.core.state.source.goal.id == "00000001"  # it goes on as long as the target does


@pytest.mark.parametrize("turn", [-0.3, 0.5])
def test_a_target_on_a_turntable_is_followed(benches: Any, turn: float) -> None:
    """100 mm from an axis that is nearly the line of sight."""
    bench, wanted = following(benches, 6)
    bench.run(0.4)
    hand = flange_at(BASE)
    axis = hand[:3, :3] @ np.array([0.08, -0.05, 1.0])
    middle = (hand @ bench.truth.markers.T).T[:, :3].mean(axis=0)
    G = twist(axis / np.linalg.norm(axis), middle + 0.1 * hand[:3, 0])
    ride(bench, lambda t: np.asarray(expm(t * turn * G)))
    bench.run(2.0)
    largest = largest_px(bench, wanted, 1.0)
    print(f"{turn:+.1f} rad/s: {largest:.2f} px")
    assert largest < 1.0
    assert verdicts(bench) == set()


def test_without_its_name_the_same_target_is_lost(benches: Any) -> None:
    bench, wanted = following(benches, 0, follows=False)
    slide(bench, lambda t: 0.05 * t * np.array([0.0, 1.0, 0.0]))
    bench.run(1.0)
    assert largest_px(bench, wanted, 0.5) > 5.0


def test_it_is_carried_through_a_drop_out(benches: Any) -> None:
    bench, wanted = following(benches, 2)
    slide(bench, lambda t: 0.02 * t * np.array([0.0, 1.0, 0.0]))
    bench.run(2.0)
    bench.cameras_on = [False, False]
    body = bench.core.state.target
    state = [body.displacement.copy(), body.basis, body.drift, body.twist.copy(), body.rate.copy()]
    P = body.covariance.copy()
    elapse(*state[:3], (*state[3:], P), 0.3)
    sigma_px = np.sqrt(2.0 * np.trace(P[:6, :6]))  # of a marker, by the filter's own covariance
    largest = largest_px(bench, wanted, 0.3)
    print(f"{largest:.2f} px, {sigma_px:.2f} px stated")
    assert largest < 2.0 * sigma_px < 30.0
    bench.cameras_on = [True, True]
    bench.run(1.0)
    assert largest_px(bench, wanted, 0.5) < 1.5
    assert verdicts(bench) == set()


@pytest.mark.parametrize("seed", [0, 11, 13, 22, 32, 52])
def test_a_target_that_is_put_elsewhere_once_it_is_found_is_no_joint_that_is_off_and_has_no_speed(
    benches: Any, seed: int
) -> None:
    """By 15 to 80 px between its first two frames, before anything is known of its speed; then it stands."""
    bench, _ = following(benches, seed % 8)
    body = bench.core.state.target
    body.t_ns, body.seen_ns[:], body.first_seen[:] = 0, 0, 0.0  # as when a model is taken
    while body.t_ns == 0:
        bench.step()
    rng = np.random.default_rng([seed, 79])
    bench.run(rng.uniform(0.0, 0.03))
    away = flange_at(BASE)[:3, :3] @ np.array([*rng.uniform(-1.0, 1.0, 2), 0.1 * rng.standard_normal()])
    away *= rng.uniform(0.03, 0.15) / np.linalg.norm(away)
    slide(bench, lambda t: away)
    bench.run(0.12)  # three frames of each camera
    assert np.linalg.norm(body.twist) < 100.0
    bench.run(1.0)
    assert verdicts(bench) == set()


def test_a_camera_that_is_bumped_while_the_target_slides_is_named(benches: Any) -> None:
    bench, _ = following(benches, 3)
    slide(bench, lambda t: 0.02 * t * np.array([0.0, 1.0, 0.0]))
    bench.run(1.5)
    angle = np.radians(1.5)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    K = np.array([[500, 0, 320], [0, 500, 240], [0, 0, 1.0]])
    bench.truth.cameras[1] = K @ turn @ np.linalg.inv(K) @ bench.truth.cameras[1]
    found = bench.until(lambda e: e.kind == "health" and e.name != "ok", 1.0)
    assert (found.name, found.cameras) == ("camera_moved", ("right",))


def test_a_joint_whose_zero_jumps_while_the_target_slides_is_named(benches: Any) -> None:
    bench, _ = following(benches, 4)
    slide(bench, lambda t: 0.02 * t * np.array([0.0, 1.0, 0.0]))
    bench.run(1.5)
    bench.zero_offset = bench.zero_offset + np.array([0, 0, 0, 0, 0.03, 0])
    found = bench.until(lambda e: e.kind == "health" and e.name != "ok", 1.0)
    assert found.name == "joint_zero"
    assert found.reasons[0].subject == "j5"


@pytest.mark.parametrize(("amplitude", "hz"), [(0.001, 10.0), (0.002, 10.0), (0.004, 5.0)])
def test_a_target_that_shakes_is_no_camera_that_moved(benches: Any, amplitude: float, hz: float) -> None:
    """Of two pictures of one moment the first is compared with where the target was before the second tells it."""
    bench, _ = following(benches, 0)
    slide(bench, lambda t: np.array([0.0, 0.005 * t, 0.0]))
    bench.run(1.0)
    slide(bench, lambda t: np.array([0.0, 0.005 + amplitude * np.sin(2.0 * np.pi * hz * t), 0.0]))
    bench.run(2.0)
    assert verdicts(bench) == set()
    assert bench.core.state.source.goal.id == "00000001"


@pytest.mark.parametrize(("joint", "jump"), [(0, 0.02), (1, 0.02), (2, 0.04), (4, 0.04)])
def test_after_a_jump_of_a_joint_zero_no_camera_is_blamed(benches: Any, joint: int, jump: float) -> None:
    """The joint is named, the target is found anew where the pictures have it, and no goal ends by a camera."""
    bench, wanted = following(benches, 4)
    slide(bench, lambda t: 0.02 * t * np.array([0.0, 1.0, 0.0]))
    bench.run(1.5)
    bench.zero_offset = bench.zero_offset + jump * np.eye(6)[joint]
    bench.run(2.0)
    assert [e.name for e in bench.events if e.kind == "health"] == ["joint_zero", "ok"]
    assert "goal_aborted" not in {e.kind for e in bench.events}
    assert largest_px(bench, wanted, 0.5) < 1.5


def test_its_state_survives_serialisation_bit_for_bit(benches: Any) -> None:
    bench, _ = following(benches, 5)
    slide(bench, lambda t: 0.02 * t * np.array([0.0, 1.0, 0.0]))
    bench.run(0.8)
    twin = ServoCore(bench.settings, decode_state(encode_state(bench.core.state)))
    start = len(bench.log)
    bench.run(0.5)
    for inputs, outputs in bench.log[start:]:
        assert twin.step(inputs).command.tobytes() == outputs.command.tobytes()
    assert encode_state(twin.state) == encode_state(bench.core.state)


def test_a_goal_that_cannot_follow_is_refused_with_its_cause(benches: Any) -> None:
    bench = benches(0, mount="eye_in_hand").ready()
    target = FeatureTarget(bench.features(bench.q))
    reply = bench.reply(RunGoal(Goal("00000001", target, follow_markers=(77,))))
    assert (reply.accepted, reply.reasons[0].code) == (False, "NO_SUCH_MARKER")
    reply = bench.reply(RunGoal(Goal("00000002", target, law="trajectory", follow_markers=MARKERS)))
    assert (reply.accepted, reply.reasons[0].code) == (False, "LAW_CANNOT_FOLLOW")
    standing = benches(0).ready()
    target = FeatureTarget(standing.features(standing.q))
    reply = standing.reply(RunGoal(Goal("00000003", target, follow_markers=(1, 20, 21, 22, 23))))
    assert (reply.accepted, reply.reasons[0].subject) == (False, "1")


@pytest.mark.parametrize(("joints", "warned"), [(6, []), (2, ["TARGET_NOT_TRACKABLE"])])
def test_a_body_said_to_move_that_the_model_cannot_follow_is_told(benches: Any, joints: int, warned: list[str]) -> None:
    """Two joints and no metric model tell no displacements of the body; six joints do."""
    bench, told = benches(0, mount="eye_in_hand"), list[str]()
    settings = msgspec.structs.replace(bench.settings, body_moves=True)
    model = msgspec.structs.replace(
        bench.truth.model, stratum="affine", projective_to_euclidean=None,
        generators=bench.truth.model.generators[:joints],
    )  # fmt: skip
    state = ServoCore(settings).state
    state.model = model
    arrays = SimpleNamespace(
        metric_basis=None, generators=model.generators, ids=np.arange(8), marker_points=model.marker_points
    )
    restart(state, cast(Any, arrays), settings)

    def emit(kind: str, message: str, reasons: Any) -> None:
        told.append(reasons[0].code)

    report_untrackable(cast(Any, SimpleNamespace(state=state, settings=settings, emit=emit)))
    assert told == warned


# -- the filter's arithmetic -----------------------------------------------------------------------------------


def scene(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Twists (6, 4, 4) of a metric frame conjugated into a random one, cameras (2, 3, 4), points (8, 4), a carrier."""
    rng = np.random.default_rng(seed)
    H = np.eye(4) + 0.2 * rng.standard_normal((4, 4))
    twists = np.zeros((6, 4, 4))
    for k in range(3):
        twists[k, k, 3] = 1.0
        i, j = (k + 1) % 3, (k + 2) % 3
        twists[3 + k, j, i], twists[3 + k, i, j] = 1.0, -1.0
    K = np.array([[500, 0, 320], [0, 500, 240], [0, 0, 1.0]])
    cameras = np.array([K @ np.column_stack([np.eye(3), [s, 0.0, 1.0]]) for s in (-0.1, 0.1)])
    points = np.column_stack([rng.uniform(-0.1, 0.1, (8, 3)), np.ones(8)])
    back = np.linalg.inv(H)
    return (
        back @ twists @ H,
        np.ascontiguousarray(cameras @ H),
        np.ascontiguousarray(points @ back.T),
        np.eye(4),
    )


def test_the_scaled_basis_moves_the_markers_by_a_pixel_each_way() -> None:
    basis, cameras, points, carrier = scene(0)
    scaled, drift, good = scaled_basis(basis, cameras, carrier, points)
    J = image_jacobian(scaled, cameras, points).reshape(-1, 6)
    assert good
    np.testing.assert_allclose(J.T @ J / len(J), np.eye(6), atol=1e-8)
    whitening = np.linalg.lstsq(scaled.reshape(6, 16).T, basis.reshape(6, 16).T, rcond=None)[0]
    np.testing.assert_allclose(drift, 6.0 * whitening @ whitening.T / np.trace(whitening @ whitening.T), atol=1e-8)


def test_turns_are_about_the_middle_of_the_markers() -> None:
    basis, _, points, _ = scene(6)
    found = turns_about(basis, points, 0.3)
    np.testing.assert_array_equal(found[:3], basis[:3])
    np.testing.assert_allclose(found[3:] @ points.mean(axis=0), 0.0, atol=1e-12)
    turned = displaced(np.eye(4), found, np.array([0, 0, 0, 1.0, 0, 0]))
    alone = displaced(np.eye(4), basis, np.array([0, 0, 0, 0.3, 0, 0]))
    np.testing.assert_allclose(np.linalg.eigvals(turned).imag.max(), np.linalg.eigvals(alone).imag.max(), atol=1e-6)


def test_a_target_that_jumped_is_found_in_one_frame_of_one_camera() -> None:
    basis, cameras, points, _ = scene(7)
    rng = np.random.default_rng(7)
    scaled, _, _ = scaled_basis(basis, cameras, np.eye(4), points)
    carrier = displaced(np.eye(4), basis, 0.05 * rng.standard_normal(6))
    before = displaced(np.eye(4), scaled, 5.0 * rng.standard_normal(6))
    there = displaced(before, scaled, np.array([60.0, -40.0, 5.0, 3.0, -2.0, 1.0]))
    sights, _ = project_points(cameras[:1], transform_points(carrier, transform_points(there, points)))
    seen = np.ones(len(points))
    seen[2] = 0.0
    pose, moved_px, rest_px = jumped(scaled, points, before, (cameras[:1], carrier, sights[0], seen))
    np.testing.assert_allclose(transform_points(pose, points), transform_points(there, points), atol=1e-6)
    assert moved_px > 40.0
    assert rest_px < 1e-6


@pytest.mark.parametrize("markers", [3, 4, 8])
def test_a_target_whose_shape_is_known_is_found_however_it_has_turned(markers: int) -> None:
    """Within six deviations of what the pixels tell, 50 seeds of any turn."""
    for seed in range(50):
        basis, cameras, points, carrier = scene(seed)
        H = np.eye(4) + 0.2 * np.random.default_rng(seed).standard_normal((4, 4))
        rng = np.random.default_rng([seed, 31])
        points = np.ascontiguousarray(points[:markers])
        axis = rng.standard_normal(3)
        turned = displaced(
            np.eye(4),
            basis,
            np.concatenate([np.zeros(3), rng.uniform(0.0, np.pi) * axis / np.linalg.norm(axis)]),
        )
        there = displaced(turned, basis, np.concatenate([rng.uniform(-0.1, 0.1, 3), np.zeros(3)]))
        truth = transform_points(there, points)
        sights = project_points(cameras, truth)[0]
        noisy = sights + NOISE_PX * rng.standard_normal(sights.shape)
        arrays = SimpleNamespace(matrices=cameras, to_euclidean=H, plane_at_infinity=H[3].copy())
        scaled, _, _ = scaled_basis(basis, cameras, carrier, points)
        found, rest_px = find_stated(scaled, cast(Any, arrays), points, noisy, np.ones((2, markers)))
        off = project_points(cameras, transform_points(found, points))[0] - sights
        assert rest_px < 2.0 * NOISE_PX, seed
        assert np.abs(off).max() < 6.0 * NOISE_PX, seed


def test_a_frame_is_folded_as_a_kalman_filter_does() -> None:
    rng = np.random.default_rng(1)
    basis = scene(1)[0]
    root = rng.standard_normal((18, 18))
    P = root @ root.T + np.eye(18)
    J, left, variances = rng.standard_normal((8, 2, 6)), rng.standard_normal((8, 2)), rng.uniform(0.5, 2.0, 8)
    used = np.array([1.0] * 6 + [0.0, 1.0])
    H = np.zeros((14, 18))
    H[:, :6] = J[used > 0].reshape(-1, 6)
    S = H @ P @ H.T + np.diag(np.repeat(variances[used > 0], 2))
    gain = P @ H.T @ np.linalg.inv(S)
    step = gain @ left[used > 0].reshape(-1)
    D, twist, rate, covariance = np.eye(4), np.zeros(6), np.zeros(6), P.copy()
    fold_frame(D, basis, (twist, rate, covariance), (left, J), variances, used)
    np.testing.assert_allclose(covariance, P - gain @ H @ P, atol=1e-8)
    np.testing.assert_allclose(np.concatenate([twist, rate]), step[6:], atol=1e-8)
    np.testing.assert_allclose(D, displaced(np.eye(4), basis, step[:6]), atol=1e-9)


def test_time_passes_in_two_steps_as_in_one_for_the_known_part() -> None:
    basis = scene(2)[0]
    rng = np.random.default_rng(2)
    P = np.zeros((18, 18))
    drift = np.eye(6)
    twist, rate = 0.01 * rng.standard_normal(6), 0.0 * rng.standard_normal(6)
    one, two = [np.eye(4), twist.copy(), rate.copy()], [np.eye(4), twist.copy(), rate.copy()]
    elapse(one[0], basis, drift, (one[1], one[2], P.copy()), 0.2)
    for _ in range(2):
        elapse(two[0], basis, drift, (two[1], two[2], P.copy()), 0.1)
    np.testing.assert_allclose(one[0], two[0], atol=1e-12)
    _, later = after(np.eye(4), basis, np.zeros(6), np.ones(6), 0.3)
    np.testing.assert_allclose(later, ACCELERATION_S * (1.0 - np.exp(-0.3 / ACCELERATION_S)), atol=1e-12)


def test_pixel_rates_are_those_of_finite_differences() -> None:
    basis, cameras, points, carrier = scene(3)
    twist, dt = np.random.default_rng(3).standard_normal(6), 1e-6
    here, _ = project_points(cameras, points)
    there, _ = project_points(cameras, transform_points(displaced(np.eye(4), basis, dt * twist), points))
    rates = pixel_rates(basis, twist, cameras, carrier, points)
    np.testing.assert_allclose(rates, (there - here) / dt, rtol=1e-3, atol=1e-2)


def test_linear_equations_are_solved() -> None:
    rng = np.random.default_rng(4)
    A, B = rng.standard_normal((6, 6)), rng.standard_normal((6, 3))
    X = B.copy()
    solve_into(A.copy(), X)
    np.testing.assert_allclose(X, np.linalg.solve(A, B), atol=1e-9)
