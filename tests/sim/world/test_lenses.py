"""Lenses that bend in the simulation: exact pixels and rendered images, against OpenCV and quadrature."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from oracles.lenses import with_lenses
from stereoservo.geometry.distortion import distort, undistort
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_sim.world.camera_rig import PinholeCamera, project
from stereoservo_sim.world.coverage import blend_polygon
from stereoservo_sim.world.rendering import BentImage, Renderer, RenderSettings, bend_outline, unit_circle
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, demo_cell, hand_cell

from ...drivers.detectors.scenes import as_frame, make_detector

CELL = demo_cell()
K1 = -0.3
WIDE = with_lenses(CELL, {"left": K1, "right": K1})


def camera_of(k1: float) -> PinholeCamera:
    return replace(CELL.rig.cameras[0], k1=k1)


@pytest.mark.parametrize("k1", [K1, 0.4])
def test_true_pixels_are_those_of_opencv(k1: float) -> None:
    cell = with_lenses(CELL, {"left": k1, "right": k1})
    for q in (cell.base, *DEMO_GOALS.values()):
        points = cell.marker_positions(q)
        for camera in cell.rig.cameras:
            rotation, _ = cv2.Rodrigues(camera.world_to_camera[:3, :3])
            expected, _ = cv2.projectPoints(
                points, rotation, camera.world_to_camera[:3, 3], camera.K, np.array([k1, 0, 0, 0.0])
            )
            np.testing.assert_allclose(cell.truth_pixels(q)[camera.name], expected[:, 0], atol=1e-9)


def test_a_lens_whose_image_ends_before_the_corners_is_known() -> None:
    camera = camera_of(0.0)
    corners = np.array([(-0.5, -0.5), (639.5, -0.5), (-0.5, 479.5), (639.5, 479.5)])
    for share, whole in ((0.999, True), (1.001, False)):
        lens = camera_of(share * camera.least_k1)
        assert lens.sees_whole_image is whole
        assert np.isfinite(undistort(lens.lens, corners)).all() == whole
    with pytest.raises(ValueError, match="corners dark"):
        Renderer(CELL, camera_of(-0.7), RenderSettings())


def test_markers_beyond_the_fold_are_not_seen() -> None:
    camera = camera_of(-10.0)  # folds 146 px from the centre
    q = DEMO_GOALS["far"]
    pixels, _ = camera.image_of(CELL.marker_positions(q))
    beyond = ~np.isfinite(pixels).all(axis=1)
    assert 0 < beyond.sum() < 14
    assert not (CELL.visible(q, camera) & beyond).any()


def disc_moments(camera: PinholeCamera, H: np.ndarray, centre: np.ndarray, radius: float) -> tuple[float, np.ndarray]:
    """Area [px²] and centroid (2,) of a disc's raw image, by the midpoint rule in polar coordinates."""
    r = (np.arange(60) + 0.5) / 60 * radius
    t = (np.arange(120) + 0.5) / 120 * 2 * np.pi
    R, T = np.meshgrid(r, t)
    points = centre + np.stack([R * np.cos(T), R * np.sin(T)], axis=-1)

    def image(p: np.ndarray) -> np.ndarray:
        h = p @ H[:, :2].T + H[:, 2]
        return distort(camera.lens, h[..., :2] / h[..., 2:])

    e = 1e-7
    dx, dy = ((image(points + e * a) - image(points - e * a)) / (2 * e) for a in np.eye(2))
    weight = np.abs(dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0]) * R
    area = weight.sum() * (radius / 60) * (2 * np.pi / 120)
    return float(area), (weight[..., None] * image(points)).sum(axis=(0, 1)) / weight.sum()


@pytest.mark.parametrize("k1", [K1, 0.4])
def test_a_dot_is_drawn_as_the_exact_image_of_its_disc(k1: float) -> None:
    """Area and centroid of the coverage, alone on black, against quadrature; the bias is that of the true image."""
    camera = camera_of(k1)
    rng = np.random.default_rng(7)
    errors, biases = [], []
    for _ in range(60):
        pose = CELL.flange(CELL.base + rng.uniform(-0.3, 0.3, 6)) @ CELL.body.flange_to_face[0]
        pose[:3, 3] += rng.uniform(-0.35, 0.35, 3)
        H = camera.P @ pose[:, [0, 1, 3]]
        centre, radius = rng.uniform(-0.04, 0.04, 2), 0.008
        middle = np.append(centre, 1.0) @ H.T
        exact_centre = distort(camera.lens, middle[:2] / middle[2])
        if not ((exact_centre > 15) & (exact_centre < (624, 464))).all():
            continue
        rim = (centre + radius * unit_circle()) @ H[:, :2].T + H[:, 2]
        image = np.zeros((480, 640), dtype=np.float32)
        blend_polygon(image, distort(camera.lens, rim[:, :2] / rim[:, 2:]), 1.0)
        area, centroid = disc_moments(camera, H, centre, radius)
        v, u = np.mgrid[0:480, 0:640]
        found = np.array([(image * u).sum(), (image * v).sum()], dtype=float) / float(image.sum())
        assert image.sum() == pytest.approx(area, rel=0.01)
        errors.append(found - centroid)
        biases.append(centroid - exact_centre)
    assert len(errors) > 25
    # A pixel's own sampling remains: it has no direction and falls with the dot's size.
    assert np.abs(np.mean(errors, axis=0)).max() < 0.003
    assert np.sqrt(np.mean(np.square(errors))) < 0.006
    assert np.abs(biases).max() < 0.03  # perspective and lens together, as in a real image


@pytest.mark.parametrize(("cell", "k1"), [("demo", K1), ("demo", 0.3), ("hand", 0.0), ("hand", -0.15)])
def test_detected_dots_are_where_the_truth_has_them(cell: str, k1: float) -> None:
    """Noise-free. The lens leaves a bias of ``k s r²/r0²`` towards the centre (s, r: radii of place and dot), of which
    the detector's own homography takes a part: 0.002 px at most here.
    """
    simulated = with_lenses(CELL if cell == "demo" else hand_cell(), {"left": k1, "right": k1})
    rng = np.random.default_rng(1)
    detector: DotDetector = make_detector(floor_px=0.0015)
    settings = RenderSettings(noise_grey=0.0, background="plain")
    reach = 0.3 if cell == "demo" else 0.15
    errors, radial = [], []
    renderers = {camera.name: Renderer(simulated, camera, settings) for camera in simulated.rig.cameras}
    for _ in range(12):
        q = simulated.base + rng.uniform(-reach, reach, 6)
        for camera in simulated.rig.cameras:
            observation = detector.detect(as_frame(renderers[camera.name].render(q, rng)), None)
            error = observation.pixels - simulated.truth_pixels(q)[camera.name][observation.ids]
            outwards = observation.pixels - camera.K[:2, 2]
            errors.append(error)
            radial.append((error * outwards).sum(axis=1) / np.linalg.norm(outwards, axis=1))
    error = np.concatenate(errors)
    assert len(error) > 12 * 2 * 10
    assert np.abs(error).max() < 0.02
    assert np.abs(error.mean(axis=0)).max() < 0.001
    assert np.sqrt(np.mean(error**2)) < 0.003
    assert abs(np.concatenate(radial).mean()) < 0.002


def blob_image(pinhole: PinholeCamera, at: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[0 : pinhole.height, 0 : pinhole.width]
    return (200 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * 4.0**2))).astype(np.uint8)


@pytest.mark.parametrize("k1", [K1, 0.4])
def test_the_background_is_bent_like_the_markers(k1: float) -> None:
    camera = camera_of(k1)
    bending = BentImage(camera)
    pose = camera.world_to_camera
    for x, y in ((0.0, 0.0), (0.25, -0.15), (-0.3, 0.2), (0.3, 0.22)):
        point = (np.linalg.inv(pose) @ np.array([x, y, 1.0, 1.0]))[None, :3]
        wanted = camera.image_of(point)[0][0]
        image = bending.image(blob_image(bending.pinhole, project(bending.pinhole.P, point)[0][0])).astype(float)
        v, u = np.mgrid[0:480, 0:640]
        near = (u - wanted[0]) ** 2 + (v - wanted[1]) ** 2 < 18**2
        found = np.array([(image * u)[near].sum(), (image * v)[near].sum()]) / image[near].sum()
        assert np.abs(found - wanted).max() < 0.1
    assert BentImage(camera_of(0.0)).pinhole.width == 640


def test_a_bent_outline_follows_the_lens_and_ends_at_its_rim() -> None:
    camera = camera_of(K1)
    square = np.array([[100.0, 80.0], [500, 80], [500, 400], [100, 400]])
    bent = bend_outline(camera, square)
    along = np.linspace(0, 1, 20, endpoint=False)[:, None]  # of 400 px, in pieces of 20 px
    np.testing.assert_allclose(bent[:20], distort(camera.lens, (1 - along) * square[0] + along * square[1]), atol=1e-9)
    far = bend_outline(camera, 50.0 * (square - camera.K[:2, 2]) + camera.K[:2, 2])
    assert np.isfinite(far).all()
    assert np.linalg.norm(far - camera.K[:2, 2], axis=1).min() > 400  # outside of the image's corners


@pytest.mark.parametrize("background", ["arm", "pybullet"])
def test_the_whole_picture_is_drawn(background: str) -> None:
    """Body and arm in one lens: dots light, and the arm's links where their axes are imaged."""
    camera = WIDE.rig.cameras[0]
    settings = RenderSettings(noise_grey=0.0, background=background)
    image = Renderer(WIDE, camera, settings).render(WIDE.base, np.random.default_rng(0))
    seen = WIDE.visible(WIDE.base, camera)
    assert seen.all()
    at = np.round(WIDE.truth_pixels(WIDE.base)["left"]).astype(int)
    assert (image[at[:, 1], at[:, 0]] > 150).all()
    assert image.min() < 60  # the plates
    assert image[:20].std() > 0.5 or background == "pybullet"  # a wall, not a void
