"""Every kind of goal is reached by the laws that take it, or refused before anything moves, with code and value."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.servo_core import ServoCore
from stereoservo.messages.goals import (
    AdaptiveGain,
    Centre,
    DisplacementTarget,
    Feature,
    FeatureTarget,
    IncidenceSpec,
    IncidenceTarget,
    JointTarget,
    PointTarget,
    Target,
)

DISPLACED = np.array([0.2, -0.15, 0.1, 0.3, -0.2, 0.4])
BASIS = (0, 1, 2, 4, 5)


def target_of(bench: Any, kind: str, q: np.ndarray) -> Target:
    if kind == "features":
        return FeatureTarget(bench.features(q))
    if kind == "points":
        return bench.points_target(q)
    H = bench.displacement_to(q)
    return bench.displacement_target(H) if kind == "displacement" else bench.basis_target(H, BASIS)


@pytest.mark.parametrize(
    ("kind", "law"),
    [
        ("features", "image"), ("features", "points"), ("points", "stereo"), ("points", "trajectory"),
        ("displacement", "cartesian3"), ("basis", "trajectory"), ("basis", "cartesian2"),
    ],
)  # fmt: skip
def test_goals_of_every_kind_are_reached(benches: Any, kind: str, law: str) -> None:
    bench = benches(5).ready()
    goal_q = bench.q + DISPLACED * (1.0 if law.startswith(("cart", "traj")) else 0.6)
    reply = bench.reply(bench.goal(target_of(bench, kind, goal_q), law=law, gain=3.0))
    assert reply.accepted, reply
    assert reply.plan.law == law
    assert bench.ended().kind == "goal_reached"
    assert bench.error_px(goal_q) < 0.15
    assert np.linalg.norm(bench.truth.points(bench.q) - bench.truth.points(goal_q), axis=1).max() < 1e-3


def bad_goals(bench: Any) -> dict[str, Target]:
    """What is wrong -> a target that is."""
    here = bench.projective(bench.truth.points(bench.q))
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    E = bench.truth.model.projective_to_euclidean
    middle = bench.truth.points(bench.q).mean(axis=0)
    about = np.eye(4)
    about[:3, 3] = middle
    mirrored = about @ mirror @ np.linalg.inv(about)
    stretched = about @ np.diag([1.5, 1.0, 1.0, 1.0]) @ np.linalg.inv(about)
    eyes = np.array([np.linalg.svd(P)[2][3] for P in bench.truth.cameras])
    eyes = (eyes / eyes[:, 3:])[:, :3].mean(axis=0)
    behind, aside = np.eye(4), np.eye(4)
    behind[:3, 3] = 2.0 * (eyes - middle)
    aside[:3, 3] = 0.9 * np.cross(eyes - middle, [0, 0, 1.0])
    points = {i: tuple(M.tolist()) for i, M in enumerate(here)}
    away = here[3] - here[0]
    body = np.column_stack([bench.truth.points(bench.q), np.ones(8)])
    mirrored_points = bench.projective((body @ mirrored.T)[:, :3])
    raw = tuple((np.linalg.inv(E) @ np.eye(4) @ E).ravel().tolist())
    return {
        "OTHER_MODEL": PointTarget(points, model_epoch=6),
        "NO_SUCH_MARKER": PointTarget({**points, 99: points[0]}, 7),
        "TOO_FEW_MARKERS": PointTarget({0: points[0], 1: points[1]}, 7),
        "COLLINEAR_MARKERS": PointTarget({i: tuple((here[0] + i * away).tolist()) for i in range(3)}, 7),
        "POINT_AT_INFINITY": PointTarget({**points, 0: tuple(away.tolist())}, 7),
        "FRAME_UNKNOWN": DisplacementTarget(raw),
        "DEGENERATE_BASIS": DisplacementTarget(raw, basis=(0, 1, 2, 3, 4)),
        "NON_FINITE": DisplacementTarget((float("nan"), *raw[1:]), model_epoch=7),
        "MIRRORED_GOAL": bench.displacement_target(mirrored),
        "MIRRORED_GOAL ": PointTarget({i: tuple(M.tolist()) for i, M in enumerate(mirrored_points)}, 7),
        "NOT_RIGID": bench.displacement_target(stretched),
        "NOT_RIGID ": DisplacementTarget(tuple(float(k == 0) for k in range(16)), model_epoch=7),
        "BEHIND_CAMERA": bench.displacement_target(behind),
        "FIELD_OF_VIEW": bench.displacement_target(aside),
    }  # fmt: skip


def test_goals_that_cannot_be_are_refused_with_code_and_the_arm_stays(bench: Any) -> None:
    bench.ready()
    for code, target in bad_goals(bench).items():
        reply = bench.reply(bench.goal(target))
        assert reply.accepted is False, code
        assert reply.reasons[0].code == code.strip(), (code, reply)
        assert len(reply.message) > 30
    assert np.abs(np.array(bench.commands)).max() == 0.0


def test_options_that_cannot_be_are_refused(bench: Any) -> None:
    bench.ready()
    target = FeatureTarget(bench.features(bench.q + 0.3 * DISPLACED))
    for code, options in {
        "NO_SUCH_CAMERA": {"cameras": ("middle",)},
        "TOO_FEW_MARKERS": {"cameras": ()},
        "NO_SUCH_MARKER": {"centre": Centre(markers=(0, 77))},
        "CENTRE_UNCLEAR": {"centre": Centre()},
        "FRAME_UNKNOWN": {"centre": Centre(point=(1.0, 0.0, 0.0, 1.0))},
        "OTHER_MODEL": {"centre": Centre(point=(1.0, 0.0, 0.0, 1.0), model_epoch=3)},
    }.items():
        reply = bench.reply(bench.goal(target, **options))
        assert (reply.accepted, reply.reasons[0].code) == (False, code), reply


def test_one_camera_is_enough_for_laws_in_the_images_and_not_for_others(bench: Any) -> None:
    bench.ready()
    goal_q = bench.q + 0.4 * DISPLACED
    one = FeatureTarget({"left": bench.features(goal_q)["left"]})
    for law in ("cartesian3", "cartesian2", "points", "trajectory"):
        reply = bench.reply(bench.goal(one, law=law))
        assert (reply.accepted, reply.reasons[0].code) == (False, "TOO_FEW_MARKERS"), reply
    reply = bench.reply(bench.goal(one, law="image", cameras=("left",), gain=3.0))
    assert reply.accepted
    assert "not planned" in reply.plan.way
    assert bench.ended().kind == "goal_reached"
    assert bench.error_px(goal_q) < 1.0


def test_chosen_centre_stays_on_its_line(benches: Any) -> None:
    """A tool point far outside the body goes straight, ten times closer to its line than with the body's middle."""

    def off_line(chosen: bool) -> float:
        bench = benches(0).ready()
        start, goal_q = bench.q.copy(), bench.q + DISPLACED
        A = bench.truth.points(start)
        tool = np.append(A[0] + 3.0 * (A[1] - A[0]), 1.0)
        point = tuple(bench.projective(tool[None, :3])[0].tolist())
        line = (bench.displacement_to(goal_q) @ tool - tool)[:3]
        assert np.linalg.norm(line) > 0.1
        goal = bench.goal(
            FeatureTarget(bench.features(goal_q)),
            centre=Centre(point=point, model_epoch=7) if chosen else None, gain=3.0,
        )  # fmt: skip
        assert bench.reply(goal).accepted
        body = np.linalg.lstsq(np.column_stack([A, np.ones(8)]).T, tool, rcond=None)[0]
        places = []
        while bench.events[-1].kind != "goal_reached":
            bench.step()
            places.append(body @ bench.truth.points(bench.q))
        off = np.cross(np.array(places) - tool[:3], line / np.linalg.norm(line))
        return float(np.linalg.norm(off, axis=1).max())

    assert off_line(True) < 0.1 * off_line(False)


def test_adaptive_gain_is_faster_near_the_goal(benches: Any) -> None:
    def seconds(gain: float | AdaptiveGain) -> float:
        bench = benches(2).ready()
        goal = bench.goal(FeatureTarget(bench.features(bench.q + 0.3 * DISPLACED)), gain=gain)
        assert bench.reply(goal).accepted
        since = bench.now_ns
        bench.ended()
        return (bench.now_ns - since) * 1e-9

    assert seconds(AdaptiveGain(near=4.0, far=1.0)) < seconds(2.0) < seconds(1.0)


def test_goal_where_the_body_is_is_reached_at_once_by_every_law(bench: Any) -> None:
    bench.ready()
    for law in ("stereo", "image", "points", "cartesian3", "cartesian2", "trajectory"):
        reply = bench.reply(bench.goal(bench.displacement_target(np.eye(4)), law=law))
        assert reply.accepted, reply
        assert bench.ended(2.0).kind == "goal_reached"
    assert np.abs(np.array(bench.commands)).max() < 1e-3


@pytest.mark.parametrize("law", ["cartesian3", "cartesian2", "trajectory"])
def test_half_a_turn_exactly_is_made(benches: Any, law: str) -> None:
    bench = benches(1)
    limits = bench.settings.limits
    wide = msgspec.structs.replace(limits, position_min=np.full(6, -4.0), position_max=np.full(6, 4.0))
    bench.settings = msgspec.structs.replace(bench.settings, limits=wide)
    bench.core = ServoCore(bench.settings)
    bench.ready()
    goal_q = bench.q.copy()
    goal_q[5] -= np.pi
    reply = bench.reply(bench.goal(bench.displacement_target(bench.displacement_to(goal_q)), law=law, gain=3.0))
    assert reply.accepted, reply
    assert bench.ended().kind == "goal_reached"
    assert bench.error_px(goal_q) < 0.2


def test_body_that_turns_its_back_is_refused(bench: Any) -> None:
    bench.ready()
    reply = bench.reply(bench.goal(bench.displacement_target(bench.turned("x", 180.0))))
    assert (reply.accepted, reply.reasons[0].code) == (False, "FACE_HIDDEN"), reply


def incidence(bench: Any, kind: str, moving: tuple[int, ...], fixed: np.ndarray, **options: Any) -> Any:
    spec = IncidenceSpec(kind, Feature(markers=moving), Feature(points=tuple(map(tuple, fixed.tolist()))))
    return bench.goal(IncidenceTarget((spec,), model_epoch=7, **options), gain=3.0)


def test_marker_is_brought_onto_a_plane_and_the_rest_goes_where_it_is_asked_to(bench: Any) -> None:
    bench.ready()
    corners = bench.truth.points(bench.q + 0.5 * DISPLACED)[:3]
    joint = float(bench.q[5] + 0.3)
    command = incidence(bench, "point-on-plane", (4,), bench.projective(corners), secondary=JointTarget({"j6": joint}))
    reply = bench.reply(command)
    assert reply.accepted, reply
    assert "not planned" in reply.plan.way
    assert bench.ended(30.0).kind == "goal_reached"
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    height = (bench.truth.points(bench.q)[4] - corners[0]) @ normal / np.linalg.norm(normal)
    assert abs(height) < 5e-4
    assert bench.q[5] == pytest.approx(joint, abs=0.02)


def test_incidences_that_cannot_be_are_refused(bench: Any) -> None:
    bench.ready()
    here = bench.projective(bench.truth.points(bench.q))
    point = (tuple(here[0].tolist()),)

    def code(spec: IncidenceSpec, epoch: int | None = 7) -> str:
        reply = bench.reply(bench.goal(IncidenceTarget((spec,), model_epoch=epoch)))
        assert reply.accepted is False
        return reply.reasons[0].code

    moving = Feature(markers=(0,))
    assert code(IncidenceSpec("point-on-point", moving, Feature(points=point)), 5) == "OTHER_MODEL"
    assert code(IncidenceSpec("point-on-point", moving, Feature(points=point)), None) == "FRAME_UNKNOWN"
    assert code(IncidenceSpec("point-on-point", Feature(markers=(55,)), Feature(points=point))) == "NO_SUCH_MARKER"
    for bad in (
        IncidenceSpec("point-on-point", moving, Feature()),
        IncidenceSpec("point-on-point", moving, Feature(markers=(1,))),
        IncidenceSpec("point-on-line", moving, Feature(points=point)),
        IncidenceSpec("point-on-line", moving, Feature(points=point * 2)),
        IncidenceSpec("line-on-line", moving, Feature(points=(point[0], tuple(here[1].tolist())))),
        IncidenceSpec("point-on-point", moving, Feature(pixels={"left": ((1.0, 2.0),)})),
    ):
        assert code(bad) == "FEATURE_UNCLEAR", bad
    assert np.abs(np.array(bench.commands)).max() == 0.0


def test_goal_beyond_the_joint_limits_is_refused_with_joint_and_place(bench: Any) -> None:
    limits = bench.settings.limits
    narrow = limits.position_max.copy()
    narrow[5] = bench.q[5] + 0.2
    bench.settings = msgspec.structs.replace(
        bench.settings, limits=msgspec.structs.replace(limits, position_max=narrow)
    )
    bench.core = ServoCore(bench.settings)
    bench.ready()
    goal_q = bench.q.copy()
    goal_q[5] += 0.6
    for law in ("cartesian3", "stereo"):
        reply = bench.reply(bench.goal(FeatureTarget(bench.features(goal_q)), law=law))
        assert (reply.accepted, reply.reasons[0].code) == (False, "JOINT_LIMIT"), reply
        assert (reply.reasons[0].subject, reply.plan.approaches[0].share) == ("j6", 1.0)
        assert reply.reasons[0].threshold == pytest.approx(narrow[5] - 0.01)
        assert reply.reasons[0].value == pytest.approx(goal_q[5], abs=1e-3)
        assert "at the goal joint j6" in reply.message
        assert "law 'trajectory' searches for another path, and for another posture" in reply.message
    assert np.abs(np.array(bench.commands)).max() == 0.0
    # Another posture of the arm has the body there, too: law trajectory goes that way.
    assert bench.reply(bench.goal(FeatureTarget(bench.features(goal_q)), law="trajectory")).accepted
    assert bench.ended(30.0).kind == "goal_reached"
    assert bench.error_px(goal_q) < 0.3
    assert bench.q[5] < narrow[5]


def test_a_goal_is_reached_in_the_posture_that_it_names(bench: Any) -> None:
    """A spherical wrist turned over has the body where it was: (q4 - pi, -q5, q6 - pi), by the arm's DH rows."""
    bench.ready()
    goal_q = bench.q + 0.5 * DISPLACED
    over = goal_q * (1, 1, 1, 1, -1, 1) + np.array([0, 0, 0, -np.pi, 0, -np.pi])
    np.testing.assert_allclose(bench.truth.points(over), bench.truth.points(goal_q), atol=1e-12)
    near = {f"j{i + 1}": q + 0.1 for i, q in enumerate(over)}
    target = FeatureTarget(bench.features(goal_q))
    reply = bench.reply(bench.goal(target, law="trajectory", posture=near))
    assert reply.accepted, reply
    assert reply.plan.way == "straight in the joints"
    assert bench.ended(60.0).kind == "goal_reached"
    assert bench.error_px(goal_q) < 0.15
    np.testing.assert_allclose(bench.q, over, atol=2e-3)  # with the turns that were asked for
    # The same images again in the posture of before; joints that are left out stay near.
    back = {f"j{i + 1}": goal_q[i] for i in (3, 4, 5)}
    assert bench.reply(bench.goal(target, law="trajectory", posture=back)).accepted
    assert bench.ended(60.0).kind == "goal_reached"
    np.testing.assert_allclose(bench.q, goal_q, atol=2e-3)


def test_a_posture_that_is_none_of_the_goal_is_refused_before_anything_moves(bench: Any) -> None:
    bench.ready()
    goal_q = bench.q + 0.5 * DISPLACED
    target = FeatureTarget(bench.features(goal_q))

    def refused(target: Target, law: str, **posture: float) -> Any:
        reply = bench.reply(bench.goal(target, law=law, posture=posture))
        assert not reply.accepted
        return reply.reasons[0]

    beside = refused(target, "trajectory", j4=goal_q[3] + 0.9)
    away = bench.q.copy()
    away[3] = goal_q[3] + 0.9
    assert beside.code == "NOT_REACHABLE"
    apart = bench.truth.pixels(away) - bench.truth.pixels(goal_q)
    assert beside.value == pytest.approx(np.linalg.norm(apart, axis=-1).max(), rel=0.02)
    assert "`stereoservo ik`" in beside.hint
    unplanned = refused(target, "stereo", j4=0.0)
    assert unplanned.code == "POSTURE_NOT_PLANNED"
    assert unplanned.hint.endswith("by a law that plans: trajectory")
    assert refused(JointTarget({"j1": 0.0}), "trajectory", j4=0.0).code == "POSTURE_NOT_PLANNED"
    assert refused(target, "trajectory", elbow=0.0).code == "NO_SUCH_JOINT"
    assert np.abs(np.array(bench.commands)).max() == 0.0
