"""Steps in a person's frames: the arm makes them along the true axes, in metres, whatever frame the model is in."""

from __future__ import annotations

import re
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.conftest import ROWS, flange_at, link
from stereoservo.gateway.goal_transfer import resolve_step
from stereoservo.gateway.observation_cache import MarkerObservation
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.messages.goals import Centre, StepTarget

LENGTH = "markers:0,2=0.16970562748477142"
"""Diagonal of the square of markers 0 to 3, 0.12 m wide."""


def pose(R: np.ndarray, origin: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, origin
    return T


def axes_by(z: np.ndarray, towards: np.ndarray) -> np.ndarray:
    x = towards - z * (z @ towards)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def true_frame(bench: Any, name: str) -> np.ndarray:
    """Pose (4, 4) of a frame in the arm's base, by its drawing (ROWS) and its true cameras alone."""
    at_zero = [np.eye(4)]
    for (a, alpha, d), theta in zip(ROWS, np.zeros(6), strict=True):
        at_zero.append(at_zero[-1] @ link(a, alpha, d, theta))
    axes = [T[:3, 2] for T in at_zero[:6]]
    in_hand = bench.truth.mount == "eye_in_hand"
    flange = flange_at(bench.q)
    camera = np.linalg.inv(np.vstack([euclidean_view(bench.truth.cameras[0]), (0, 0, 0, 1)]))
    if name == "camera:left":
        return flange @ camera if in_hand else camera
    if name == "base":
        return pose(axes_by(axes[0], axes[1]), at_zero[1][:3, 3])  # where the second axis meets the first
    if name.startswith("scene:"):
        a, b, c = bench.truth.static[:3, :3]
        z = np.cross(b - a, c - a)
        return pose(axes_by(z / np.linalg.norm(z), b - a), a)
    R = flange[:3, :3] @ flange_at(np.zeros(6))[:3, :3].T @ axes_by(axes[5], axes[4])
    return pose(R, (flange @ camera)[:3, 3] if in_hand else bench.truth.points(bench.q).mean(axis=0))


def euclidean_view(P: np.ndarray) -> np.ndarray:
    """``[R | t]`` (3, 4) of a true camera, whose intrinsics have no skew and square pixels."""
    omega = P[:, :3] @ P[:, :3].T
    cu, cv = omega[0, 2], omega[1, 2]
    f = np.sqrt(omega[0, 0] - cu * cu)
    return np.asarray(np.linalg.inv([[f, 0, cu], [0, f, cv], [0, 0, 1.0]]) @ P)


def seen_now(bench: Any) -> dict[str, dict[int, MarkerObservation]]:
    """The scene's markers, 8 and on, as a gateway holds them."""
    exact = bench.truth.images_of(bench.truth.static)
    return {
        name: {8 + i: MarkerObservation((float(u), float(v)), 0.01, False) for i, (u, v) in enumerate(exact[c])}
        for c, name in enumerate(bench.names)
    }


def stated(bench: Any, step: StepTarget, centre: Centre | None = None) -> Any:
    return resolve_step(
        step, centre, bench.truth.model, seen_now(bench) if len(bench.truth.static) else {}, LENGTH
    ).target


@pytest.mark.parametrize(
    ("mount", "frame", "law", "as_matrix"),
    [
        ("eye_to_hand", "tool", "cartesian3", False), ("eye_to_hand", "base", "trajectory", False),
        ("eye_to_hand", "camera:left", "stereo", True), ("eye_to_hand", "scene:8-9-10", "cartesian2", False),
        ("eye_in_hand", "tool", "stereo", True), ("eye_in_hand", "base", "image", False),
        ("eye_in_hand", "base", "cartesian3", True), ("eye_in_hand", "camera:left", "trajectory", False),
    ],
)  # fmt: skip
def test_a_step_ends_where_it_does_by_the_true_axes_of_its_frame(
    benches: Any, mount: str, frame: str, law: str, as_matrix: bool
) -> None:
    seed = sum(map(ord, mount + frame + law))
    print("seed", seed)
    bench = benches(seed, mount=mount, static=3 if frame.startswith("scene") else 0).ready()
    goal_q = bench.q + np.random.default_rng(seed).uniform(-0.08, 0.08, 6)  # where the arm can be
    F, start, middle = true_frame(bench, frame), flange_at(bench.q), true_frame(bench, "tool")[:3, 3]

    def made(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """True move [m] and turn [rad] of the flange from the start, in the frame's axes."""
        D = flange_at(q) @ np.linalg.inv(start)
        about = F[:3, 3] if as_matrix else middle
        turn = Rotation.from_matrix(D[:3, :3]).as_rotvec()
        return F[:3, :3].T @ (D[:3, :3] @ about + D[:3, 3] - about), F[:3, :3].T @ turn

    move, turn = made(goal_q)
    rigid = pose(Rotation.from_rotvec(turn).as_matrix(), move)
    step = StepTarget(frame, matrix=tuple(rigid.ravel())) if as_matrix else StepTarget(frame, tuple(move), tuple(turn))
    reply = bench.reply(bench.goal(stated(bench, step), law=law, gain=4.0))
    assert reply.accepted, reply
    event = bench.ended()
    assert event.kind == "goal_reached", event
    assert bench.error_px(goal_q) < 0.15  # in each coordinate; the tolerance is a distance of 0.1 px in its estimate
    asked, measured = event.message.split("asked ")[1].split("; made ")
    for text, true in (asked, (move, turn)), (measured, made(bench.q)):
        for part, exact in zip(text.split(" mm, "), (1e3 * true[0], np.degrees(true[1])), strict=True):
            stated_values = [float(number) for number in part.strip("()°").split(",")]
            assert np.abs(np.array(stated_values) - exact).max() < 0.006  # its last decimal


def test_a_queued_step_is_made_in_the_frame_where_the_goal_before_it_ends(benches: Any) -> None:
    bench = benches(3).ready()
    turned = stated(bench, StepTarget("tool", turn=(0.0, 0.0, 0.2)))
    moved = stated(bench, StepTarget("tool", move=(0.01, 0.0, 0.0)))
    assert bench.reply(bench.goal(turned, law="trajectory")).accepted
    assert bench.reply(bench.goal(moved, law="trajectory", mode="queue")).accepted
    bench.until(lambda event: event.kind == "goal_reached", 20.0)
    F = true_frame(bench, "tool")
    assert bench.ended().kind == "goal_reached"
    away = F[:3, :3].T @ (true_frame(bench, "tool")[:3, 3] - F[:3, 3])
    # 0.1 px are 0.6 mm of depth at 1.2 m, f = 800 and 0.3 m between the cameras; the frame before would be 2 mm off.
    assert np.abs(away - (0.01, 0.0, 0.0)).max() < 6e-4


def test_a_turn_is_made_about_the_centre_and_needs_no_length(bench: Any) -> None:
    bench.ready()
    step = StepTarget("base", turn=(0.0, 0.0, 0.1))
    target = resolve_step(step, Centre(markers=(0,)), bench.truth.model, {}, "").target
    before = bench.truth.points(bench.q)
    assert bench.reply(bench.goal(target, centre=Centre(markers=(0,)))).accepted
    event = bench.ended()
    said = r"in base: asked \(0.00, 0.00, 5.73\)°; made \(-?0.0\d, -?0.0\d, 5.[5-9]\d\)°$"
    assert re.search(said, event.message), event
    apart = np.linalg.norm(bench.truth.points(bench.q) - before, axis=1)
    assert apart[0] < 6e-4  # as above
    assert abs(apart[2] - 2 * np.sin(0.05) * np.linalg.norm((before[2] - before[0])[:2])) < 6e-4


def test_a_step_that_is_undefined_is_refused_with_what_would_define_it(benches: Any) -> None:
    model, up = benches(1).truth.model, StepTarget("tool", move=(0.0, 0.0, 0.02))
    parallel = msgspec.structs.replace(model, generators=np.repeat(model.generators[:1], 6, axis=0))
    affine = msgspec.structs.replace(model, stratum="affine", projective_to_euclidean=None)
    for text, step, given, length in (
        ("--length WHAT:OF=METRES, markers:10,11=0.05 say, or as calibration.known_length", up, model, ""),
        ("2 of 0, 1, 2, 3, 4, 5, 6, 7 needed", msgspec.structs.replace(up, length="markers:0,99=1"), model, LENGTH),
        ("calibrate with joint axes of two directions or more", up, affine, LENGTH),
        ("all joint axes of this arm are parallel", up, parallel, LENGTH),
        ("markers 8, 9, 10 of the scene are not seen by two", StepTarget("scene:8-9-10", up.move), model, LENGTH),
        ("calibrate first", up, None, LENGTH),
    ):
        with pytest.raises(TransferError, match=re.escape(text)):
            resolve_step(step, None, given, {}, length)
