"""Incidence goals in closed loop against Euclidean truth, hidden by random projective frames."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stereoservo.control.incidence import (
    KINDS,
    IncidenceStatus,
    image_task,
    incidence_reasons,
    incidence_step,
    incidence_task,
    joint_task,
    limits_task,
)
from stereoservo.control.law import Options, Scene
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.kernels import image_jacobian

SPANS = {
    "point-on-point": (1, 1),
    "point-on-line": (1, 2),
    "point-on-plane": (1, 3),
    "line-on-line": (2, 2),
    "line-on-plane": (2, 3),
    "plane-on-plane": (3, 3),
}
FREEDOMS_TAKEN = dict(zip(KINDS, (3, 2, 1, 4, 2, 3), strict=True))
DT = 0.04
TOLERANCE = 0.1


def scene_of(world, q=None):
    markers = world.markers(q)
    pixels = world.pixels(markers)
    return Scene(
        np.ascontiguousarray(world.operators(q)), 0, np.ascontiguousarray(world.matrices), world.camera_centres,
        np.ascontiguousarray(world.hidden(markers)), pixels, np.ones(pixels.shape[:2]),
    )  # fmt: skip


def drive(world, task, gain=5.0, seconds=6.0, second=None, until=TOLERANCE, sigma=0.0, rng=None):
    """Run in closed loop, ``world.q`` moving; the last step and all errors (steps, k)."""
    errors = []
    for _ in range(int(seconds / DT)):
        scene = scene_of(world)
        if sigma:
            pixels = scene.pixels + rng.normal(0, sigma, scene.pixels.shape)
            scene = scene._replace(points=world.triangulated(pixels), pixels=pixels)
        rest = second(scene) if second else None
        step = incidence_step(scene, task, Options(gain, DT), rest)
        errors.append(step.error_px)
        if step.error_px.max() <= until:
            break
        world.q = world.q + DT * step.velocity
    return step, np.array(errors)


def distance_to(feature, X):
    """Euclidean distances (k,) [m] of points (k, 4) from the span of 1 to 3 points (K, 4)."""
    base = feature[0, :3]
    offsets = (X[:, :3] - base).T
    if len(feature) > 1:
        Q = np.linalg.qr((feature[1:, :3] - base).T)[0]
        offsets = offsets - Q @ (Q.T @ offsets)
    return np.linalg.norm(offsets, axis=0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gain", [2.0, 12.5])
def test_reached_from_far_and_no_freedom_taken_that_is_not_needed(virtual, kind, gain):
    rng = np.random.default_rng(KINDS.index(kind))
    own_count, fixed_count = SPANS[kind]
    for turn in range(6):
        T0, T1 = virtual.random_task(rng, rng.uniform(20, 170), 0.3)
        world = virtual.free_arm(rng, T0)
        own = rng.permutation(4)[:own_count].tolist()
        feature = virtual.PLATE[rng.permutation(4)[:fixed_count]] @ T1.T
        heights = rng.uniform(0.3, 3.0, fixed_count)[:, None] * (1 if turn % 2 else -1)
        task = incidence_task([kind], [own], [world.hidden(feature) * heights], world.infinity, TOLERANCE)
        step, _ = drive(world, task, gain, seconds=20.0 / gain)
        assert step.status[0] == IncidenceStatus.DONE
        assert step.rank == FREEDOMS_TAKEN[kind]
        # 0.1 px in both cameras are less than 1 mm at 1.5 m (800 px, 0.2 m apart)
        assert distance_to(feature, world.markers()[own]).max() < 1.5**2 * 0.2 / (800 * 0.2)


def test_error_is_what_the_cameras_see(virtual):
    """Against a search for the nearest point of the plane, and the plain distance of two points."""
    rng = np.random.default_rng(3)
    T0, T1 = virtual.random_task(rng, 10, 0.02)
    world = virtual.free_arm(rng, T0)
    feature = virtual.PLATE[:3] @ T1.T
    scene = scene_of(world)
    point = incidence_task(["point-on-point"], [[2]], [world.hidden(feature[:1])], world.infinity, TOLERANCE)
    pixels = world.pixels(np.vstack([world.markers()[2], feature[0]]))
    expected = np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=1).max()
    step = incidence_step(scene, point, Options(1.0))
    assert step.error_px[0] == pytest.approx(expected, rel=1e-9)

    near = T0.copy()
    near[:3, 3] += 0.002 * T0[:3, 2]
    feature = virtual.PLATE[:3] @ near.T
    plane = incidence_task(["point-on-plane"], [[2]], [world.hidden(feature)], world.infinity, TOLERANCE)
    X = world.markers()[2]

    def offsets(z):
        Y = X + 0.002 * T0[:, 2] + z[0] * near[:, 0] + z[1] * near[:, 1]
        return (world.pixels(Y[None]) - world.pixels(X[None])).ravel()

    nearest = least_squares(offsets, np.zeros(2), x_scale=1e-3, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    expected = np.linalg.norm(nearest.fun.reshape(2, 2), axis=1).max()
    step = incidence_step(scene, plane, Options(1.0))
    assert step.error_px[0] == pytest.approx(expected, rel=0.01)


def test_the_frame_does_not_matter(virtual):
    rng = np.random.default_rng(4)
    T0, T1 = virtual.random_task(rng, 100, 0.2)
    feature = virtual.PLATE[:2] @ T1.T
    steps = []
    for _ in range(3):
        world = virtual.free_arm(rng, T0)
        task = incidence_task(["line-on-line"], [[0, 2]], [world.hidden(feature)], world.infinity, TOLERANCE)
        steps.append(incidence_step(scene_of(world), task, Options(2.0, DT)))
    for other in steps[1:]:
        np.testing.assert_allclose(other.velocity, steps[0].velocity, rtol=0, atol=1e-8)
        np.testing.assert_allclose(other.error_px, steps[0].error_px, rtol=1e-9)


def test_units_of_joints_do_not_matter(virtual):
    """Joints told in units of their own make the same motion (none small enough for the metric's floor)."""
    rng = np.random.default_rng(5)
    T0, T1 = virtual.random_task(rng, 60, 0.2)
    world = virtual.free_arm(rng, T0)
    feature = world.hidden(virtual.PLATE[:3] @ T1.T)
    task = incidence_task(["point-on-plane"], [[0]], [feature], world.infinity, TOLERANCE)
    scene = scene_of(world)
    scale = np.array([1.0, 3, 1, 0.5, 2, 1])
    step = incidence_step(scene, task, Options(2.0))
    other = incidence_step(scene._replace(operators=scene.operators / scale[:, None, None]), task, Options(2.0))
    np.testing.assert_allclose(other.velocity / scale, step.velocity, rtol=0, atol=1e-9)


@pytest.mark.parametrize("angle", [90.0, 90.0 + 1e-9, 89.0])
@pytest.mark.parametrize("kind", ["line-on-line", "line-on-plane", "plane-on-plane"])
def test_exactly_across_is_left(virtual, kind, angle):
    """A line across its target, a plane upright on it: both ways are as near, the gradient vanishes."""
    rng = np.random.default_rng(6)
    T0 = virtual.pose(Rotation.from_euler("xyz", [15, -10, 20], degrees=True), [0.02, -0.03, 1.1])
    world = virtual.free_arm(rng, T0)
    own_count, fixed_count = SPANS[kind]
    corners = [[0, 1], [0, 1, 2]][own_count - 2]
    # about the plate's y axis: edge 0-1 along x turns to z
    turned = T0 @ virtual.pose(Rotation.from_euler("y", angle, degrees=True), [0, 0, 0.03])
    square = np.array([[-0.05, 0, 0, 1], [0.05, 0, 0, 1], [0, 0.05, 0, 1.0]])
    feature = square[:fixed_count] @ turned.T
    if kind == "line-on-plane":
        corners = [1, 2]  # along y
        feature = square @ (T0 @ virtual.pose(Rotation.from_euler("x", angle, degrees=True), [0, 0, 0.03])).T
    task = incidence_task([kind], [corners], [world.hidden(feature)], world.infinity, TOLERANCE)
    step, _ = drive(world, task, 5.0, seconds=8.0)
    assert step.status[0] == IncidenceStatus.DONE
    assert distance_to(feature, world.markers()[corners]).max() < 3e-3


def test_half_a_turn_of_three_points(virtual):
    rng = np.random.default_rng(7)
    T0 = virtual.pose(Rotation.from_euler("xyz", [15, -10, 20], degrees=True), [0.02, -0.03, 1.1])
    world = virtual.free_arm(rng, T0)
    feature = virtual.PLATE @ (T0 @ virtual.pose(Rotation.from_euler("z", 180, degrees=True), [0, 0, 0])).T
    task = incidence_task(
        ["point-on-point"] * 3, [[0], [1], [2]], world.hidden(feature[:3])[:, None], world.infinity, TOLERANCE
    )
    step, errors = drive(world, task, 5.0, seconds=8.0)
    assert errors[0].max() > 80
    assert step.rank == 6
    assert (step.status == IncidenceStatus.DONE).all()


def test_several_at_once_and_redundant_ones_do_no_harm(virtual):
    """A corner on a point, an edge on a line, the plate in a plane: the pose; and one of them said twice."""
    rng = np.random.default_rng(8)
    for _ in range(6):
        T0, T1 = virtual.random_task(rng, rng.uniform(20, 90), 0.2)
        world = virtual.rx90(rng, T0=T0) if rng.random() < 0.5 else virtual.free_arm(rng, T0)
        goal = world.hidden(virtual.PLATE @ T1.T)
        kinds = ["point-on-point", "line-on-line", "plane-on-plane", "plane-on-plane"]
        task = incidence_task(
            kinds, [[0], [0, 1], [0, 1, 2], [1, 2, 3]], [goal[:1], goal[:2], goal[:3], goal[1:]],
            world.infinity, TOLERANCE,
        )  # fmt: skip
        step, _ = drive(world, task, 5.0, seconds=8.0)
        assert step.rank == 6
        assert (step.status == IncidenceStatus.DONE).all(), step


def test_contradiction_ends_at_rest_with_those_concerned_named(virtual):
    rng = np.random.default_rng(9)
    T0, T1 = virtual.random_task(rng, 40, 0.2)
    world = virtual.free_arm(rng, T0)
    goal = virtual.PLATE @ T1.T
    aside = goal[0] + 0.05 * T1[:, 2]
    task = incidence_task(
        ["point-on-point", "point-on-point", "point-on-point"], [[0], [0], [2]],
        [world.hidden(goal[:1]), world.hidden(aside[None]), world.hidden(goal[2:3])], world.infinity, TOLERANCE,
    )  # fmt: skip
    step, errors = drive(world, task, 5.0, seconds=6.0)
    assert (step.status[:2] == IncidenceStatus.CONTRADICTS).all()
    assert np.abs(step.velocity).max() < 1e-3
    assert errors[-1].max() > 5
    names = ("corner on pin", "corner on hole", "far corner")
    (reason,) = incidence_reasons(step, task, names)
    assert reason.code == "INCIDENCES_CONTRADICT"
    assert reason.level == "hold"
    assert "corner on pin" in reason.subject
    assert "corner on hole" in reason.subject
    assert reason.value == pytest.approx(step.error_px.max())


@pytest.mark.parametrize("gap", [0.006, 0.05])
def test_contradiction_is_told_from_noise(virtual, gap):
    """A few pixels apart, with noise of 0.1 px and a tolerance of 0.5 px: named in nearly every step, and at rest."""
    rng = np.random.default_rng(16)
    T0, T1 = virtual.random_task(rng, 40, 0.1)
    world = virtual.free_arm(rng, T0)
    goal = virtual.PLATE @ T1.T
    aside = goal[0] + gap * T1[:, 0]
    task = incidence_task(
        ["point-on-point", "point-on-line", "point-on-point"], [[0], [0], [2]],
        [world.hidden(goal[:1]), world.hidden(np.array([aside, aside + T1[:, 1]])), world.hidden(goal[2:3])],
        world.infinity, 0.5,
    )  # fmt: skip
    drive(world, task, 2.0, 8.0, until=-1.0, sigma=0.1, rng=rng)
    named, speeds = [], []
    for _ in range(100):
        scene = scene_of(world)
        noisy = world.triangulated(scene.pixels + rng.normal(0, 0.1, scene.pixels.shape))
        step = incidence_step(scene._replace(points=noisy), task, Options(2.0, DT))
        named.append((step.status[:2] == IncidenceStatus.CONTRADICTS).all())
        speeds.append(np.abs(image_jacobian(scene.operators, scene.matrices, scene.points) @ step.velocity).max())
        world.q = world.q + DT * step.velocity
    assert np.mean(named) > 0.9
    # pixels a second: the gain times five standard deviations of a pixel, nothing of the gap
    assert max(speeds) < 2.0 * 0.1 * 5


def test_what_the_arm_cannot_move_is_named(virtual):
    """A gantry of three slides cannot lay a tilted plate into a plane; its corner it can."""
    rng = np.random.default_rng(10)
    T0, T1 = virtual.random_task(rng, 50, 0.1)
    arm = virtual.free_arm(rng, T0)
    gantry = virtual.World(arm.generators[:3], T0, arm.frame, np.zeros(3))
    goal = gantry.hidden(virtual.PLATE @ T1.T)
    task = incidence_task(
        ["point-on-point", "line-on-line"], [[0], [0, 1]], [goal[:1], goal[:2]], gantry.infinity, TOLERANCE
    )
    alone = task._replace(kinds=task.kinds[:1], markers=task.markers[:1], fixed=task.fixed[:1])
    step, _ = drive(gantry, alone)
    assert step.status[0] == IncidenceStatus.DONE
    line = task._replace(kinds=task.kinds[1:], markers=task.markers[1:], fixed=task.fixed[1:])
    step, _ = drive(gantry, line)
    assert step.status[0] == IncidenceStatus.NOT_DRIVABLE
    (reason,) = incidence_reasons(step, line, ("edge on seam",))
    assert reason.code == "INCIDENCE_NOT_DRIVABLE"
    assert reason.subject == "edge on seam"


@pytest.mark.parametrize("gain", [2.0, 12.5])
def test_second_task_of_joints_in_the_null_space(virtual, gain):
    """A point on a plane; the five other freedoms go where joints are asked to, as far as the plane allows."""
    rng = np.random.default_rng(11)
    T0, _ = virtual.random_task(rng, 30, 0.1)
    world = virtual.free_arm(rng, T0)
    wanted_q = np.array([0.05, -0.04, 0.06, 0.3, -0.2, 0.4])
    # The plane holds where the point is at the wanted joints: both tasks can be met.
    there = world.markers(wanted_q)
    task = incidence_task(["point-on-plane"], [[3]], [world.hidden(there[[3, 0, 1]])], world.infinity, 1e-3)
    step, errors = drive(
        world, task, gain, 20.0 / gain, until=-1.0,
        second=lambda scene: joint_task(world.q, wanted_q, np.ones(6), np.ones(6), gain),
    )  # fmt: skip
    assert errors[-1] < 1e-3
    np.testing.assert_allclose(world.q, wanted_q, atol=2e-3)
    assert step.rank == 1


def test_freedoms_that_are_left_drive_from_the_limits(virtual):
    """A point held in a plane by six joints: one that starts at its limit leaves it, the plane is kept."""
    rng = np.random.default_rng(17)
    world = virtual.rx90(rng)
    there = world.markers()
    task = incidence_task(["point-on-plane"], [[0]], [world.hidden(there[:3])], world.infinity, TOLERANCE)
    lower, upper = world.q - 1.5, world.q + 1.5
    lower[1], upper[1] = world.q[1] - 0.02, world.q[1] + 1.0
    lower[5], upper[5] = -np.inf, np.inf
    _, errors = drive(world, task, 5.0, 6.0, until=-1.0, second=lambda scene: limits_task(world.q, lower, upper, 0.5))
    assert errors.max() < 0.2
    share = (world.q - lower)[:5] / (upper - lower)[:5]
    assert share.min() > 0.1  # 0.02 at the start


def test_second_task_never_moves_the_first(virtual):
    """Set-points that the incidence forbids: it is held, they are approached as far as it allows."""
    rng = np.random.default_rng(12)
    T0, T1 = virtual.random_task(rng, 40, 0.1)
    world = virtual.free_arm(rng, T0)
    plane = world.markers()[:3]
    task = incidence_task(["plane-on-plane"], [[0, 1, 2]], [world.hidden(plane)], world.infinity, TOLERANCE)
    set_points = world.pixels(virtual.PLATE @ T1.T)

    def second(scene):
        return image_task(scene.operators, scene.matrices, scene.points, set_points, np.ones((2, 4)), 5.0)

    before = np.linalg.norm(world.pixels(world.markers()) - set_points)
    _, errors = drive(world, task, 5.0, 4.0, second=second, until=-1.0)
    after = np.linalg.norm(world.pixels(world.markers()) - set_points)
    assert errors[-1] < 1e-2
    assert errors.max() < 5.0  # what a step of a fifth of the way leaves in second order
    assert 1.0 < after < 0.8 * before
    # At rest no motion within the plane comes nearer: the gradient along it vanishes.
    scene = scene_of(world)
    rest = second(scene)
    inside = incidence_step(scene, task, Options(5.0, DT), rest).velocity
    assert np.abs(inside).max() < 0.02


def test_noise_is_averaged_as_a_first_order_loop_does(virtual):
    """On its feature, the true residual's rms is ``sqrt(g dt / (2 - g dt))`` of the measured one's."""
    rng = np.random.default_rng(13)
    T0, T1 = virtual.random_task(rng, 60, 0.1)
    world = virtual.free_arm(rng, T0)
    feature = world.hidden(virtual.PLATE[:3] @ T1.T)
    kinds, own = ["point-on-plane"] * 3, [[0], [1], [2]]
    task = incidence_task(kinds, own, [feature] * 3, world.infinity, 1.0)
    drive(world, task, 2.0, 8.0, until=-1.0)
    true, measured = [], []
    for _ in range(600):
        scene = scene_of(world)
        true.append(incidence_step(scene, task, Options(2.0, DT)).error_px)
        noisy = scene.pixels + rng.normal(0, 0.1, scene.pixels.shape)
        step = incidence_step(scene._replace(points=world.triangulated(noisy)), task, Options(2.0, DT))
        measured.append(step.error_px)
        world.q = world.q + DT * step.velocity
    ratio = np.sqrt(np.mean(np.square(true)) / np.mean(np.square(measured)))
    expected = np.sqrt(2.0 * DT / (2 - 2.0 * DT)) / np.sqrt(1 + 2.0 * DT / (2 - 2.0 * DT))
    # 600 steps, correlated over 1 / (g dt) of them, three conditions: 1 in 10 is three standard deviations
    assert ratio == pytest.approx(expected, rel=0.3)


def test_degenerate_input_is_refused_where_it_enters(virtual):
    rng = np.random.default_rng(14)
    T0, T1 = virtual.random_task(rng, 60, 0.1)
    world = virtual.free_arm(rng, T0)
    goal = world.hidden(virtual.PLATE @ T1.T)
    at_infinity = goal[1:3] - goal[:1]

    def build(kind, own, fixed):
        return incidence_task([kind], [own], [fixed], world.infinity, TOLERANCE)

    for kind, own, fixed, code in (
        ("line-on-line", [0, 0], goal[:2], "shape"),
        ("point-on-line", [0, 1], goal[:2], "shape"),
        ("point-on-line", [0], goal[:3], "shape"),
        ("point-on-line", [0], goal[[0, 0]], "degenerate"),
        ("point-on-plane", [0], np.vstack([goal[:2], goal[0] + 2 * goal[1]]), "degenerate"),
        ("point-on-point", [0], at_infinity[:1], "degenerate"),
        ("point-on-line", [0], at_infinity, "degenerate"),
        ("point-on-volume", [0], goal[:1], "shape"),
        ("point-on-point", [0], np.full((1, 4), np.nan), "not_finite"),
        ("point-on-point", [0], np.zeros((1, 4)), "not_finite"),
    ):
        with pytest.raises(GeometryError) as refused:
            build(kind, own, fixed)
        assert refused.value.code == code, kind
    # A point and a direction make a line.
    line = build("point-on-line", [0], np.vstack([goal[0], at_infinity[0]]))
    assert abs(line.fixed[0, 0] @ world.infinity - 1) < 1e-12
    assert abs(line.fixed[0, 1] @ world.infinity) < 1e-12

    scene = scene_of(world)
    good = build("plane-on-plane", [0, 1, 2], goal[:3])
    unknown = scene.points.copy()
    unknown[1] = np.nan
    step = incidence_step(scene._replace(points=unknown), good, Options(2.0))
    assert not step.velocity.any()
    assert step.status[0] == IncidenceStatus.NOT_FINITE
    assert incidence_reasons(step, good, ("plate",))[0].code == "INCIDENCE_UNSEEN"


def test_where_it_is_already_nothing_moves(virtual):
    rng = np.random.default_rng(18)
    T0, _ = virtual.random_task(rng, 60, 0.1)
    world = virtual.free_arm(rng, T0)
    there = world.hidden(world.markers())
    task = incidence_task(
        ["plane-on-plane", "line-on-line"],
        [[2, 1, 0], [1, 0]],
        [there[:3], there[:2]],
        world.infinity,
        TOLERANCE,
    )
    step = incidence_step(scene_of(world), task, Options(2.0, DT))
    assert (step.status == IncidenceStatus.DONE).all()
    assert np.abs(step.velocity).max() < 1e-9


def test_fixed_feature_behind_the_cameras_is_approached(virtual):
    """A plane that lies behind the cameras where the point faces it: errors stay finite, the way is straight."""
    rng = np.random.default_rng(15)
    T0, _ = virtual.random_task(rng, 60, 0.1)
    world = virtual.free_arm(rng, T0)
    behind = np.array([[0, 0, -0.3, 1], [1, 0, -0.3, 1], [0, 1, -0.3, 1.0]])
    task = incidence_task(["point-on-plane"], [[0]], [world.hidden(behind)], world.infinity, TOLERANCE)
    step = incidence_step(scene_of(world), task, Options(0.1))
    assert np.isfinite(step.error_px).all()
    before = distance_to(behind, world.markers()[:1])[0]
    world.q = world.q + DT * step.velocity
    assert distance_to(behind, world.markers()[:1])[0] == pytest.approx(before * (1 - 0.1 * DT), rel=1e-3)
