"""Which freedom an incidence lacks, told before anything moves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.control.incidence import incidence_freedoms, incidence_task
from stereoservo.control.law import Scene
from stereoservo.control.mobility import FREEDOMS


def scene_of(world):
    markers = world.markers()
    pixels = world.pixels(markers)
    return Scene(
        np.ascontiguousarray(world.operators()), 0, np.ascontiguousarray(world.matrices), world.camera_centres,
        np.ascontiguousarray(world.hidden(markers)), pixels, np.ones((2, 4)),
    )  # fmt: skip


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(("axis", "anywhere"), [(0, False), (1, True), (2, False), (2, True)])
def test_the_turn_that_slides_lack_is_named(virtual, known, axis, anywhere):
    """A gantry shall lay its plate, or an edge of it, where only a turn about one axis of the image brings it."""
    rng = np.random.default_rng(axis)
    # In the middle of the left camera's view, square to it.
    world = virtual.free_arm(rng, np.eye(4))
    eye = world.eyes[0]
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    rotation = np.linalg.inv(K) @ world.euclidean[0][:, :3]
    T0 = virtual.pose(Rotation.from_matrix(rotation.T), eye[:3] + 1.1 * rotation[2])
    gantry = virtual.World(virtual.free_arm(rng, T0).generators[:3], T0, virtual.random_frame(rng), np.zeros(3))
    turned = T0 @ virtual.pose(Rotation.from_euler("xyz"[axis], 15, degrees=True), [0.02, 0.01, 0.03])
    goal = gantry.hidden(virtual.PLATE @ turned.T)
    kind, own = ("line-on-line", [0, 1]) if axis == 2 else ("plane-on-plane", [0, 1, 2])
    task = incidence_task(
        [kind, "point-on-point", "point-on-plane"], [own, [0], [2]], [goal[: len(own)], goal[:1], goal[:3]],
        gantry.infinity, 0.1,
    )  # fmt: skip
    upgrade = np.linalg.inv(gantry.frame) if known else None
    missing = incidence_freedoms(scene_of(gantry), task, gantry.infinity, upgrade, anywhere=anywhere)
    assert missing[0] is not None
    assert missing[0].name == f"{FREEDOMS[3 + axis]} of the first camera"
    assert missing[1:] == (None, None)
    arm = virtual.World(virtual.free_arm(rng, T0).generators, T0, gantry.frame, np.zeros(6))
    assert incidence_freedoms(scene_of(arm), task, gantry.infinity, upgrade) == (None, None, None)


def test_what_is_lost_at_a_singularity_is_not_lost_anywhere(virtual):
    """Two joints of a planar arm, stretched out, cannot start to draw their marker in; elsewhere they can."""
    rng = np.random.default_rng(6)
    T0 = virtual.pose(Rotation.from_euler("xyz", [20, -15, 40], degrees=True), [0.05, -0.03, 1.1])
    marker = (virtual.PLATE[0] @ T0.T)[:3]
    up, along = np.array([0.0, 0.6, 0.8]), np.array([0.8, -0.48, 0.36])
    for sense, lacks in ((along, "translation across the image, sideways"), (up, None)):
        screws = [virtual.screw(up, marker + reach * along) for reach in (0.5, 0.2)]
        world = virtual.World(np.array(screws), T0, virtual.random_frame(rng), np.zeros(2))
        target = world.hidden(np.append(marker + 0.05 * sense, 1.0)[None])
        task = incidence_task(["point-on-point"], [[0]], [target], world.infinity, 0.1)
        (here,) = incidence_freedoms(scene_of(world), task, world.infinity, np.linalg.inv(world.frame))
        assert here is not None
        (ever,) = incidence_freedoms(scene_of(world), task, world.infinity, np.linalg.inv(world.frame), anywhere=True)
        assert here.name.startswith(lacks or "translation")
        assert (ever is None) == (lacks is not None)


def test_done_and_undecided_incidences_lack_nothing(virtual):
    rng = np.random.default_rng(5)
    T0 = virtual.pose(Rotation.from_euler("xyz", [20, -15, 40], degrees=True), [0.05, -0.03, 1.1])
    arm = virtual.free_arm(rng, T0)
    gantry = virtual.World(arm.generators[:3], T0, arm.frame, np.zeros(3))
    there = gantry.hidden(gantry.markers())
    task = incidence_task(["plane-on-plane"], [[0, 1, 2]], [there[:3]], gantry.infinity, 0.1)
    assert incidence_freedoms(scene_of(gantry), task, gantry.infinity) == (None,)
