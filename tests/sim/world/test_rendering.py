"""Rendered images against exact projections and closed-form areas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo_sim.world.coverage import blend_ellipse, blend_polygon
from stereoservo_sim.world.rendering import (
    DOT_LEVEL,
    Renderer,
    RenderSettings,
    circle_image,
    draw_body,
)
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, demo_cell

CELL = demo_cell()
EXACT = RenderSettings(blur_px=0.0, noise_grey=0.0, background="plain")


def centroid(image):
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    weight = image.astype(np.float64)
    return np.array([np.sum(weight * u), np.sum(weight * v)]) / weight.sum()


def ellipse(centre, half_axes, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    A = turn @ np.diag(1 / np.array(half_axes) ** 2) @ turn.T
    b = -A @ centre
    conic = np.zeros((3, 3))
    conic[:2, :2] = A
    conic[:2, 2] = conic[2, :2] = b
    conic[2, 2] = centre @ A @ centre - 1
    return conic


@settings(max_examples=60, deadline=None)
@given(
    u=st.floats(12, 28),
    v=st.floats(12, 28),
    long=st.floats(2.0, 9.0),
    ratio=st.floats(0.25, 1.0),
    angle=st.floats(0, np.pi),
)
def test_an_ellipse_has_its_area_and_its_centre(u, v, long, ratio, angle):
    image = np.zeros((40, 40), dtype=np.float32)
    blend_ellipse(image, ellipse(np.array([u, v]), (long, long * ratio), angle), 1.0)
    assert image.min() >= 0
    assert image.max() <= 1 + 1e-6
    assert image.sum() == pytest.approx(np.pi * long**2 * ratio, rel=5e-3)
    # What remains is the pixels' own undersampling, which falls with the size of the shape.
    assert np.abs(centroid(image) - [u, v]).max() < 0.05 / (long * ratio)


@settings(max_examples=60, deadline=None)
@given(
    points=st.lists(st.tuples(st.floats(2, 37), st.floats(2, 37)), min_size=3, max_size=3),
)
def test_a_triangle_has_its_area_and_its_centre(points):
    corners = np.array(points)
    (a, b), (c, d) = corners[1] - corners[0], corners[2] - corners[0]
    area = abs(a * d - b * c) / 2
    image = np.zeros((40, 40), dtype=np.float32)
    blend_polygon(image, corners, 1.0)
    assert image.sum() == pytest.approx(area, abs=0.15)
    if area > 20:
        # Pixels at the border are undersampled: their moments count the more, the longer it is for its area.
        border = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()
        assert np.abs(centroid(image) - corners.mean(axis=0)).max() < max(0.05, 0.1 * border / area)


def test_what_lies_outside_the_image_is_cut_off():
    image = np.zeros((20, 30), dtype=np.float32)
    blend_ellipse(image, ellipse(np.array([0.0, 10.0]), (4.0, 4.0), 0.0), 1.0)
    # The half that lies right of the image's left edge at -0.5.
    expected = 16 * (np.pi - np.arccos(0.125) + 0.125 * np.sqrt(1 - 0.125**2))
    assert image.sum() == pytest.approx(expected, rel=3e-3)
    blend_ellipse(image, ellipse(np.array([100.0, 10.0]), (4.0, 4.0), 0.0), 1.0)
    blend_polygon(image, np.array([[-9.0, -9.0], [-3.0, -9.0], [-3.0, -3.0]]), 1.0)
    assert image.sum() == pytest.approx(expected, rel=3e-3)


def test_a_conic_that_is_no_ellipse_draws_nothing():
    image = np.zeros((20, 20), dtype=np.float32)
    for conic in (np.diag([1.0, -1.0, -1.0]), np.diag([1.0, 1.0, 1.0])):
        blend_ellipse(image, conic, 1.0)
    assert not image.any()


def test_conic_vanishes_on_the_image_of_the_circle():
    camera = CELL.rig.cameras[0]
    pose = CELL.flange(CELL.base) @ CELL.body.flange_to_face[0]
    H = camera.P @ pose[:, [0, 1, 3]]
    centre, radius = np.array([0.02, -0.03]), 0.008
    conic = circle_image(H, centre, radius)
    angles = np.linspace(0, 2 * np.pi, 13)
    rim = centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.column_stack([rim, np.ones(13)]) @ H.T
    points /= points[:, 2:]
    inside = np.append(centre, 1) @ H.T
    inside /= inside[2]
    values = np.einsum("ij,jk,ik->i", points, conic, points)
    assert np.abs(values).max() < 1e-8 * abs(inside @ conic @ inside) * 1e3
    assert inside @ conic @ inside < 0


def measured_dots(image, camera, q):
    """Intensity-weighted centroids (14, 2) inside 1.4 times the outline that each dot should have."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    grid = np.stack([u, v, np.ones_like(u)], axis=-1).astype(np.float64)
    found = []
    for face, flange_to_face in zip(CELL.body.faces, CELL.body.flange_to_face, strict=True):
        H = camera.P @ (CELL.flange(q) @ flange_to_face)[:, [0, 1, 3]]
        for centre in face.positions:
            conic = circle_image(H, centre, 1.4 * face.radius)
            middle = np.append(centre, 1) @ H.T
            top, left = np.round(middle[1::-1] / middle[2]).astype(int) - 12
            window = (slice(top, top + 25), slice(left, left + 25))
            inside = np.einsum("vui,ij,vuj->vu", grid[window], conic, grid[window]) < 0
            patch = np.where(inside, image[window].astype(np.float64), np.inf)
            weight = np.where(inside, patch - patch.min(), 0.0)
            found.append(centroid(weight) + np.array([left, top]))
    return np.array(found)


def ellipse_centres(camera, q):
    """Centres of the dots' images, which perspective shifts off the images of the dots' centres; (14, 2)."""
    centres = []
    for face, flange_to_face in zip(CELL.body.faces, CELL.body.flange_to_face, strict=True):
        H = camera.P @ (CELL.flange(q) @ flange_to_face)[:, [0, 1, 3]]
        for position in face.positions:
            conic = circle_image(H, position, face.radius)
            centres.append(-np.linalg.solve(conic[:2, :2], conic[:2, 2]))
    return np.array(centres)


@pytest.mark.parametrize("blur", [0.0, 0.7])
def test_dots_are_where_they_should_be(blur):
    """Noise-free centroids, grey levels rounded, against the exact projections of the dots' centres."""
    errors, from_ellipse = [], []
    for q in (CELL.base, *DEMO_GOALS.values()):
        for camera in CELL.rig.cameras:
            chosen = RenderSettings(blur_px=blur, noise_grey=0.0, background="plain")
            image = Renderer(CELL, camera, chosen).render(q, np.random.default_rng(0))
            measured = measured_dots(image, camera, q)
            errors.append(measured - CELL.truth_pixels(q)[camera.name])
            from_ellipse.append(measured - ellipse_centres(camera, q))
    # Perspective shifts the image of a disc off that of its centre, all dots of a tilted plate to one side.
    for name, values, bias in (
        ("projected centres", errors, 0.006),
        ("ellipse centres", from_ellipse, 0.004),
    ):
        error = np.concatenate(values)
        rms = np.sqrt(np.mean(error**2))
        print(f"blur {blur} px: {name}: rms {rms:.4f}, max {np.abs(error).max():.4f} px")
        assert rms <= 0.012
        assert np.abs(error.mean(axis=0)).max() <= bias


def test_noise_has_its_sigma_and_differs_from_frame_to_frame():
    camera = CELL.rig.cameras[0]
    renderer = Renderer(CELL, camera, RenderSettings(noise_grey=3.0, background="plain"))
    rng = np.random.default_rng(5)
    first, second = renderer.render(CELL.base, rng), renderer.render(CELL.base, rng)
    corner = (slice(0, 100), slice(300, 640))
    assert first[corner].std() == pytest.approx(3.0, rel=0.05)
    assert first[corner].mean() == pytest.approx(90.0, abs=0.1)
    difference = first[corner].astype(float) - second[corner]
    assert difference.std() == pytest.approx(3.0 * np.sqrt(2), rel=0.05)


def test_the_same_seed_gives_the_same_image():
    camera = CELL.rig.cameras[1]
    images = [Renderer(CELL, camera, RenderSettings()).render(CELL.base, np.random.default_rng(3)) for _ in range(2)]
    assert np.array_equal(images[0], images[1])


def test_a_face_turned_away_shows_no_dots():
    """About its own vertical the body is turned until the cameras see one plate from behind."""
    camera = CELL.rig.cameras[0]
    q = CELL.base.copy()
    dots = []
    for turn in (0.0, -1.9):
        q[4] = CELL.base[4] + turn
        image = np.full((camera.height, camera.width), 60, dtype=np.float32)
        draw_body(image, CELL, camera, q)
        facing = CELL.visible(q, camera, max_incidence=np.deg2rad(80))
        away = ~CELL.turned_to(CELL.flange(q), camera, max_incidence=np.deg2rad(95))
        truth = CELL.truth_pixels(q)[camera.name]
        at = np.round(truth).astype(int)
        inside = np.all((at >= 0) & (at < [camera.width, camera.height]), axis=1)
        level = np.zeros(14)
        level[inside] = image[at[inside, 1], at[inside, 0]]
        assert np.all(level[facing] > 0.5 * DOT_LEVEL)
        assert np.all(level[away] < 0.5 * DOT_LEVEL)
        dots.append((np.count_nonzero(facing), np.count_nonzero(away & inside)))
    assert dots[0] == (14, 0)
    assert dots[1][1] >= 7


def test_the_arm_is_in_the_picture_and_moves():
    camera = CELL.rig.cameras[0]
    renderer = Renderer(CELL, camera, RenderSettings(noise_grey=0.0))
    rng = np.random.default_rng(0)
    here = renderer.render(CELL.base, rng)
    moved = renderer.render(CELL.base + np.array([0.2, 0, 0, 0, 0, 0]), rng)
    plain = Renderer(CELL, camera, RenderSettings(noise_grey=0.0, background="plain")).render(CELL.base, rng)
    assert np.count_nonzero(here != moved) > 5000
    assert np.count_nonzero(here != plain) > 100_000
    assert here.min() < 40
    assert here.max() > 190
