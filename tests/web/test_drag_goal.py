"""A dragged goal against the Euclidean arm and cameras behind the projective model."""

import numpy as np
import pytest

from core.conftest import BASE, Truth, make_truth
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.web.model_view import DragModel

START = BASE + np.array([0.0, -0.2, 0.4, 0.0, -0.2, 0.0])
"""At `BASE` the arm is nearly stretched out."""
WIDE = np.tile([-3.0, 3.0], (6, 1))


def pose(truth: Truth, joints: np.ndarray) -> np.ndarray:
    """Rotation and translation (3, 4) of the truth's body from `START` to ``joints``, in metres (Kabsch)."""
    start, end = truth.points(START), truth.points(joints)
    u, _, vt = np.linalg.svd((end - end.mean(0)).T @ (start - start.mean(0)))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return np.column_stack([R, end.mean(0) - start.mean(0)])


def centre_pixel(truth: Truth, camera: int, joints: np.ndarray) -> np.ndarray:
    return truth.images_of(np.append(truth.points(joints).mean(0), 1.0)[None])[camera, 0]


@pytest.mark.parametrize("seed", range(6))
def test_the_body_moves_parallel_to_the_picture_without_turning(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = make_truth(seed, k1=(0.0, -0.15)[seed % 2], count=3)
    camera = seed % 3
    shift = rng.uniform(-50, 50, 2)
    found = DragModel(truth.model, WIDE).dragged(START, truth.model.cameras[camera].name, (shift[0], shift[1]))
    moved = pose(truth, found.joints)
    viewing = truth.cameras[camera][2, :3]
    assert found.left_px < 1e-4
    assert np.allclose(moved[:, :3], np.eye(3), atol=1e-6)
    assert abs(viewing @ moved[:, 3]) < 1e-6, "metres along the line of sight"
    assert np.allclose(centre_pixel(truth, camera, found.joints) - centre_pixel(truth, camera, START), shift, atol=1e-3)
    assert np.allclose(found.pixels, truth.pixels(found.joints), atol=1e-6)


def test_nearer_and_turned_about_the_line_of_sight() -> None:
    truth = make_truth(3)
    model = DragModel(truth.model, WIDE)
    middle = np.append(truth.points(START).mean(0), 1.0)
    depth = truth.cameras[0][2] @ middle
    nearer = pose(truth, model.dragged(START, "left", (0.0, 0.0), nearer=0.95).joints)
    assert np.isclose(truth.cameras[0][2, :3] @ nearer[:, 3], -0.05 * depth, atol=1e-6)
    assert np.allclose(nearer[:, :3], np.eye(3), atol=1e-6)

    turned = pose(truth, model.dragged(START, "left", (0.0, 0.0), turn=0.3).joints)[:, :3]
    angle = np.arccos((np.trace(turned) - 1) / 2)
    axis = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / (
        2 * np.sin(angle)
    )
    # A turn of the pixels is one of the body about the ray as far as the body is small before its distance.
    assert np.isclose(angle, 0.3, atol=0.02)
    assert axis @ truth.cameras[0][2, :3] > 0.99


def test_every_depth_on_the_ray_is_seen_on_the_epipolar_line() -> None:
    truth = make_truth(4, k1=-0.2, count=3)
    lines = DragModel(truth.model, WIDE).epipolar_lines("left", (250.0, 200.0))
    assert set(lines) == {"right", "high"}
    points = truth.points(BASE)
    ray = points[0] - (centre := -np.linalg.solve(truth.cameras[0][:, :3], truth.cameras[0][:, 3]))
    lines = DragModel(truth.model, WIDE).epipolar_lines("left", tuple(truth.pixels(BASE)[0, 0]))
    for stretch in (0.9, 1.0, 1.15):
        seen = truth.images_of(np.append(centre + stretch * ray, 1.0)[None])
        for camera, name in ((1, "right"), (2, "high")):
            ends = np.stack([lines[name][:-1], lines[name][1:]], axis=1)
            along = ends[:, 1] - ends[:, 0]
            t = np.clip(((seen[camera, 0] - ends[:, 0]) * along).sum(1) / (along**2).sum(1), 0.0, 1.0)
            distances = np.linalg.norm(ends[:, 0] + t[:, None] * along - seen[camera, 0], axis=1)
            assert distances.min() < 1.0, "px: a bent line is drawn by chords"


def test_an_arm_at_its_limit_goes_as_near_as_it_can_and_states_what_is_left() -> None:
    truth = make_truth(5)
    limits = np.column_stack([BASE - 0.02, BASE + 0.02])
    found = DragModel(truth.model, limits).dragged(BASE, "left", (120.0, 0.0))
    assert (found.joints >= limits[:, 0]).all()
    assert (found.joints <= limits[:, 1]).all()
    moved = truth.pixels(found.joints)[0] - truth.pixels(BASE)[0]
    assert found.left_px > 50.0
    assert 5.0 < moved[:, 0].mean() < 120.0


def test_what_cannot_be_dragged_is_refused() -> None:
    model = DragModel(make_truth(1, k1=-0.3).model, WIDE)
    with pytest.raises(GeometryError, match="left, right"):
        model.dragged(BASE, "top", (1.0, 1.0))
    with pytest.raises(GeometryError, match="lens"):
        model.dragged(BASE, "left", (5000.0, 0.0))
