"""The centre of one dot: accuracy, covariance, refusal of what is not a whole dot. Truth: exact pictures."""

import numpy as np
import pytest

from stereoservo_drivers.detectors import centroids, components
from stereoservo_drivers.detectors.components import scratch
from stereoservo_drivers.detectors.face_fit import whole

from .rendering import Scene, conic_of_circle, digitise
from .scenes import normalised, rms

SCRATCH = scratch()
SIZE = (64, 64)


def tilted_circle(rng, radius, tilt):
    """Conic of a circle foreshortened by ``tilt`` [deg] in a random direction, and its centre near (32,
    32).
    """
    centre = 31.5 + rng.uniform(0, 1, 2)
    a = rng.uniform(0, np.pi)
    H = np.eye(3)
    H[:2, :2] = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ np.diag([1, np.cos(np.radians(tilt))])
    H[:2, 2] = centre
    return conic_of_circle(H, np.zeros(2), radius), centre


def measure(image, dark=False, half=20):
    out = np.zeros(components.FIELDS)
    window = 32 - half, 32 - half, 33 + half, 33 + half
    sought = components.Sought(32.0, 32.0, 30, 5)
    status = centroids.measure(components.Picture(image, dark), window, sought, SCRATCH, out)
    return status, out


def sample(seed, n, radius=4.0, tilt=0.0, **scene):
    """Errors (n, 2) and covariances (n, 2, 2) of n dots, all of which must be measured."""
    rng = np.random.default_rng(seed)
    errors, covariances = np.zeros((n, 2)), np.zeros((n, 2, 2))
    for k in range(n):
        conic, centre = tilted_circle(rng, radius, tilt)
        status, out = measure(Scene(size=SIZE, clutter=[conic], **scene).render(rng))
        assert status == components.OK
        errors[k] = out[:2] - centre
        unit = out[[components.CXX, components.CXY, components.CXY, components.CYY]].reshape(2, 2)
        covariances[k] = max(out[components.NOISE], 1 / 12) * unit
    return errors, covariances


def test_eight_pixel_discs_without_noise():
    errors, _ = sample(1, 200, lens_blur=0.0)
    assert rms(errors) < 0.003
    errors, _ = sample(2, 100, lens_blur=0.7)
    assert rms(errors) < 0.0015


@pytest.mark.parametrize("lens_blur", [0.0, 0.7])
@pytest.mark.parametrize("white", [180.0, 220.0])
def test_eight_pixel_discs_with_noise_of_three_levels(lens_blur, white):
    errors, _ = sample(3, 200, lens_blur=lens_blur, noise=3.0, white=white)
    assert rms(errors) < 0.012


@pytest.mark.parametrize(("radius", "tilt"), [(2.5, 0), (4, 60), (8, 0), (8, 70), (16, 30)])
@pytest.mark.parametrize("lens_blur", [0.7, 1.5])
def test_size_tilt_and_blur_without_noise(radius, tilt, lens_blur):
    errors, _ = sample(4, 40, radius=radius, tilt=tilt, lens_blur=lens_blur)
    assert rms(errors) < 0.004


@pytest.mark.parametrize("noise", [1.0, 3.0, 10.0])
@pytest.mark.parametrize(("radius", "tilt", "lens_blur"), [(4, 0, 0.7), (4, 60, 0.7), (8, 0, 0.7), (4, 0, 1.5)])
def test_covariances_are_the_scatter(radius, tilt, lens_blur, noise):
    """Sum of 2 n squared normalised errors ~ chi2(2 n), here with each dot's own noise estimate of about
    100 pixels.

    That estimate has a relative standard deviation of sqrt(2 / 100); it spreads the sum by less than 2 n /
    sqrt(50 n) and shifts its mean by 2 %. The bound is five standard deviations of both, and 5 % for
    sampling and rounding.
    """
    n = 150
    errors, covariances = sample(5, n, radius=radius, tilt=tilt, lens_blur=lens_blur, noise=noise)
    floor = 0.001**2 * np.eye(2)
    mean = normalised(errors, covariances + floor).sum() / (2 * n)
    deviation = np.sqrt(2 / (2 * n) + 1 / (50 * n))
    assert abs(mean - 1) < 5 * deviation + 0.07


def test_noise_level_is_found():
    rng = np.random.default_rng(6)
    conic, _ = tilted_circle(rng, 6.0, 0.0)
    clean = Scene(size=SIZE, clutter=[conic]).clean() + 0.3 * np.arange(64)
    levels = [measure(digitise(clean, 4.0, rng))[1][components.NOISE] for _ in range(60)]
    # white noise and rounding; the gradient of 0.3 levels a pixel does not count
    assert np.mean(levels) == pytest.approx(16.0 + 1 / 12, rel=0.05)


def test_dark_dots_are_light_dots_of_the_negative():
    rng = np.random.default_rng(7)
    for _ in range(10):
        conic, _ = tilted_circle(rng, 5.0, 40.0)
        image = Scene(size=SIZE, clutter=[conic], noise=2.0).render(rng)
        light, dark = measure(image), measure(255 - image, dark=True)
        assert light[0] == dark[0] == components.OK
        np.testing.assert_array_equal(light[1], dark[1])


def test_a_straight_cut_shows():
    """A dot covered from one side by 1 px or more, at any angle, is not whole; an uncovered one is, at any
    noise.
    """
    rng = np.random.default_rng(8)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    for radius in (4.0, 8.0):
        for _ in range(40):
            conic, centre = tilted_circle(rng, radius, 0.0)
            clean = Scene(size=SIZE, clutter=[conic]).clean()
            angle = rng.uniform(0, 2 * np.pi)
            depth = (u - centre[0]) * np.cos(angle) + (v - centre[1]) * np.sin(angle) - radius
            status, out = measure(digitise(clean, rng.choice([1.0, 5.0, 10.0]), rng))
            assert status == components.OK
            assert whole(out, 0.02)
            cut = np.where(depth > -rng.uniform(1.0, radius), 30.0, clean)
            status, out = measure(digitise(cut, 2.0, rng))
            assert status != components.OK or not whole(out, 0.02)


@pytest.mark.parametrize("gap", [1.5, 2.0, 2.5, 4.0, 8.0])
def test_a_neighbour_hides_a_dot_or_leaves_it_alone(gap):
    """Another dot so many pixels beside a thin one: refused, or measured as well as is said.

    (Nearer twins are one symmetric blob; their area tells.)
    """
    rng = np.random.default_rng(10)
    for _ in range(20):
        conic, centre = tilted_circle(rng, 5.0, 70.0)
        thin = np.linalg.eigh(conic[:2, :2])[1][:, 1]
        beside = np.eye(3)
        beside[:2, 2] = -thin * (gap + 2 * 5.0 * np.cos(np.radians(70.0)))
        neighbour = beside.T @ conic @ beside
        status, out = measure(Scene(size=SIZE, clutter=[conic, neighbour], noise=1.0).render(rng))
        if status == components.OK and whole(out, 0.02):
            to_either = [np.hypot(*(out[:2] - centre + k * beside[:2, 2])) for k in (0, 1)]
            assert min(to_either) < max(0.06, 3.0 * np.sqrt(out[components.EXX]))
        else:
            assert gap <= 4.0


def test_dots_at_the_border_are_refused():
    rng = np.random.default_rng(9)
    for offset in (-6.0, -2.0, 0.0, 3.0, 6.0):
        conic = conic_of_circle(np.eye(3), np.array([offset, 32.0]), 6.0)
        image = Scene(size=SIZE, clutter=[conic]).render(rng)
        out = np.zeros(components.FIELDS)
        sought = components.Sought(offset, 32.0, 30, 5)
        status = centroids.measure(components.Picture(image, False), (-20, 12, 21, 53), sought, SCRATCH, out)
        assert status != components.OK


@pytest.mark.parametrize("level", [0, 128, 255])
def test_empty_windows_are_no_contrast(level):
    assert measure(np.full((64, 64), level, np.uint8))[0] == components.NO_CONTRAST
