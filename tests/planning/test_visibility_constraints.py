"""Visibility constraints: faces of plates and bodies, one camera, lenses, margins that yield to the ends."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.geometry.distortion import distort
from stereoservo.planning.planner import plan, start_planning

HALF = 0.04
CUBE = np.array([[x, y, z, 1.0] for x in (-HALF, HALF) for y in (-HALF, HALF) for z in (-HALF, HALF)])
SIDES = {
    "-x": ([0, 1, 2], [-1, 0, 0]), "+x": ([4, 5, 6], [1, 0, 0]), "-y": ([0, 1, 4], [0, -1, 0]),
    "+y": ([2, 3, 6], [0, 1, 0]), "-z": ([0, 2, 4], [0, 0, -1]), "+z": ([1, 3, 5], [0, 0, 1]),
}  # fmt: skip


def cube_request(virtual, cells, rng, T0, T_star, faces):
    world = virtual.free_arm(rng, T0)
    return world, cells.request(
        world, T_star,
        points=world.hidden(CUBE @ T0.T), targets=world.hidden(CUBE @ T_star.T), must_stay_visible=np.ones(8),
        faces=np.array([SIDES[name][0] for name in faces]),
    )  # fmt: skip


def sees(world, T, name):
    """Per camera, whether it stands before a side of the cube."""
    normal = T[:3, :3] @ SIDES[name][1]
    foot = T[:3, 3] + HALF * normal
    return (world.eyes[:, :3] - foot) @ normal > 0


@pytest.mark.parametrize("seed", range(4))
def test_sides_of_a_cube_are_kept_where_they_are_seen_at_both_ends(virtual, cells, seed):
    rng = np.random.default_rng(seed)
    T0 = virtual.pose(Rotation.from_euler("xyz", rng.uniform(-0.6, 0.6, 3)), [-0.08, 0.02, 1.0])
    T_star = virtual.pose(Rotation.from_euler("xyz", rng.uniform(-0.6, 0.6, 3)), [0.1, -0.03, 1.1])
    world, request = cube_request(virtual, cells, rng, T0, T_star, list(SIDES))
    planning = start_planning(request)
    for f, name in enumerate(SIDES):
        both = sees(world, T0, name) & sees(world, T_star, name)
        np.testing.assert_array_equal(planning.constraints.sides[f] != 0, both)
    found = plan(request).plan
    assert found is not None
    for q in found.joints:
        for f, name in enumerate(SIDES):
            kept = planning.constraints.sides[f] != 0
            assert sees(world, world.plate_pose(q), name)[kept].all()


def test_a_side_that_turns_away_is_no_hindrance_where_another_is_kept(virtual, cells):
    rng = np.random.default_rng(1)
    T0 = virtual.pose(Rotation.from_euler("y", 40, degrees=True), [0, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("y", -40, degrees=True), [0, 0, 1.0])
    world, request = cube_request(virtual, cells, rng, T0, T_star, ["-x", "+x", "-z"])
    assert sees(world, T0, "+x").any() != sees(world, T_star, "+x").any()
    assert plan(request).plan is not None
    # the side alone that is lost: nothing of what was asked for is seen at both ends
    lost = "+x" if sees(world, T0, "+x").any() else "-x"
    _, request = cube_request(virtual, cells, rng, T0, T_star, [lost])
    failure = start_planning(request).failure[0]
    assert (failure.kind, failure.path_parameter) == ("FACE_HIDDEN", 1.0)


def test_one_camera_is_enough(virtual, cells):
    rng = np.random.default_rng(2)
    T0, T_star = virtual.random_task(rng, 120, 0.3)
    world = virtual.free_arm(rng, T0)
    request = cells.request(world, T_star)
    limits = msgspec.structs.replace(request.limits, sizes=request.limits.sizes[:1], lenses=request.limits.lenses[:1])
    one = msgspec.structs.replace(
        request, matrices=request.matrices[:1], camera_centres=request.camera_centres[:1], limits=limits
    )
    found = plan(one).plan
    assert found is not None
    np.testing.assert_allclose(world.markers(found.joints[-1]), virtual.PLATE @ T_star.T, atol=1e-5)
    assert {approach.index for approach in found.approaches if approach.kind == "FIELD_OF_VIEW"} == {0}


def test_images_are_those_behind_the_lens(virtual, cells):
    rng = np.random.default_rng(3)
    T0, T_star = virtual.random_task(rng, 60, 0.2)
    world = virtual.free_arm(rng, T0)
    lenses = np.array([[-0.15, 322.0, 238.0, 320.0], [0.1, 318.0, 241.0, 320.0]])
    found = plan(cells.request(world, T_star, limits={"lenses": lenses})).plan
    assert found is not None
    clearances = []
    for q in found.joints:
        raw = np.array([distort(k, uv) for k, uv in zip(lenses, world.pixels(world.markers(q)), strict=True)])
        clearances.append(np.minimum(raw + 0.5, cells.SIZES[:, None] - 0.5 - raw).min())
    closest = {approach.kind: approach for approach in found.approaches}["FIELD_OF_VIEW"]
    assert closest.value == pytest.approx(min(clearances), abs=1e-3)
    assert closest.path_parameter == pytest.approx(int(np.argmin(clearances)) / 64)


def test_a_goal_within_the_margin_is_arrived_at_and_left_again(virtual, cells):
    rng = np.random.default_rng(4)
    inside = virtual.pose(Rotation.identity(), [0.0, 0.0, 1.0])
    near = inside.copy()
    low, high = 0.0, 0.4
    for _ in range(40):  # 2 px from a border, where 8 px are kept
        near[1, 3] = 0.5 * (low + high)
        clearance, _ = cells.clearances_of(virtual.free_arm(rng, near), near)
        low, high = (near[1, 3], high) if clearance > 2.0 else (low, near[1, 3])
    for T0, T_star in ((inside, near), (near, inside)):
        world = virtual.free_arm(rng, T0)
        assert plan(cells.request(world, T_star, limits={"view_margin_px": 8.0})).plan is not None
