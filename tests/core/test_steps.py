"""Steps in a person's frames: the arm makes them along the true axes, in metres, whatever frame the model is in."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.conftest import BASE, ROWS, flange_at, link
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
    camera = np.linalg.inv(np.array([[*row] for row in np.vstack([euclidean_view(bench.truth.cameras[0]), (0, 0, 0, 1)])]))
    if name == "camera:left":
        return flange @ camera if in_hand else camera
    if name == "base":
        return pose(axes_by(axes[0], axes[1]), np.zeros(3))
    if name.startswith("scene:"):
        a, b, c = bench.truth.static[:3, :3]
        z = np.cross(b - a, c - a)
        return pose(axes_by(z / np.linalg.norm(z), b - a), a)
    R = flange[:3, :3] @ flange_at(np.zeros(6))[:3, :3].T @ axes_by(axes[5], axes[4])
    return pose(R, (flange @ camera)[:3, 3] if in_hand else bench.truth.points(bench.q).mean(axis=0))


def euclidean_view(P: np.ndarray) -> np.ndarray:
    """``[R | t]`` (3, 4) of a true camera, whose intrinsics have no skew and square pixels."""
    K = np.array([[P[0, :3] @ np.cross(P[2, :3], np.cross(P[0, :3], P[2, :3])), 0, 0]])
    centre = P[:, :3] @ P[:, :3].T
    cu, cv = centre[0, 2], centre[1, 2]
    f = np.sqrt(centre[0, 0] - cu * cu)
    K = np.array([[f, 0, cu], [0, f, cv], [0, 0, 1.0]])
    return np.linalg.inv(K) @ P


def seen_now(bench: Any) -> dict[str, dict[int, MarkerObservation]]:
    """The scene's markers, 8 and on, as a gateway holds them."""
    exact = bench.truth.images_of(bench.truth.static)
    return {
        name: {8 + i: MarkerObservation((float(u), float(v)), 0.01, False) for i, (u, v) in enumerate(exact[c])}
        for c, name in enumerate(bench.names)
    }


def stated(bench: Any, step: StepTarget, centre: Centre | None = None) -> Any:
    return resolve_step(step, centre, bench.truth.model, seen_now(bench) if len(bench.truth.static) else {}, LENGTH).target


def hand(bench: Any) -> np.ndarray:
    return flange_at(bench.q)


@pytest.mark.parametrize(
    ("mount", "frame", "law"),
    [
        ("eye_to_hand", "tool", "cartesian3"), ("eye_to_hand", "base", "trajectory"), ("eye_to_hand", "camera:left", "stereo"),
        ("eye_to_hand", "scene:8-9-10", "cartesian2"), ("eye_in_hand", "tool", "cartesian3"),
        ("eye_in_hand", "base", "image"), ("eye_in_hand", "camera:left", "trajectory"),
    ],
)  # fmt: skip
def test_a_step_is_made_along_and_about_the_true_axes_of_its_frame(
    benches: Any, mount: str, frame: str, law: str
) -> None:
    seed = sum(map(ord, mount + frame + law))
    print("seed", seed)
    rng = np.random.default_rng(seed)
    bench = benches(seed, mount=mount, static=3 if frame.startswith("scene") else 0).ready()
    move, turn = rng.uniform(-0.02, 0.02, 3), rng.uniform(-0.1, 0.1, 3)
    F, start, middle = true_frame(bench, frame), hand(bench), true_frame(bench, "tool")[:3, 3]
    reply = bench.reply(bench.goal(stated(bench, StepTarget(frame, tuple(move), tuple(turn))), law=law, gain=3.0))
    assert reply.accepted, reply
    event = bench.ended()
    assert event.kind == "goal_reached", event
    made = hand(bench) @ np.linalg.inv(start)  # in the base
    assert np.abs(F[:3, :3].T @ (made[:3, :3] @ middle + made[:3, 3] - middle) - move).max() < 3e-4
    assert np.abs(F[:3, :3].T @ Rotation.from_matrix(made[:3, :3]).as_rotvec() - turn).max() < 1e-3
    asked, measured = event.message.split("asked ")[1].split("; made ")
    for text in (asked, measured):
        mm, degrees = (np.array([float(x) for x in part.split("(")[1].split(")")[0].split(",")])
                       for part in text.split(" mm, "))
        assert np.abs(mm - 1e3 * move).max() < 0.3
        assert np.abs(degrees - np.degrees(turn)).max() < 0.06
