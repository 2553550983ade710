"""The filter of features: an optimal one by independent truth, and what irregular streams do to it."""

import math

import msgspec
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from stereoservo.control.filters import (
    ClientClock,
    TrackSettings,
    arrived,
    empty_track,
    observe,
    predict,
)


def steady_gains(period_s: float, settings: TrackSettings) -> tuple[float, float]:
    """``α`` and ``β`` of the filter at regular observations every ``period_s`` [s], once it has settled."""
    index = settings.density_px2_s3 * period_s**3 / settings.sigma_px**2

    def alpha(beta: float) -> float:
        return 0.5 * (math.sqrt(beta * (8.0 + beta / 3.0)) - beta)

    low, high = 0.0, 6.0 - 2.0 * math.sqrt(6.0) + 1.0
    while alpha(high) < 1.0:
        high *= 2.0
    for _ in range(200):
        beta = 0.5 * (low + high)
        rest = 1.0 - alpha(beta)
        if rest <= 0.0 or beta**2 > index * rest:
            high = beta
        else:
            low = beta
    return alpha(low), low


ALL = np.ones((1, 1))


def pixel(u, v=0.0):
    return np.array([[[u, v]]])


def model(T, q):
    return np.array([[1.0, T], [0.0, 1.0]]), q * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])


@pytest.mark.parametrize("rate_hz", [30.0, 200.0])
@pytest.mark.parametrize("sigma", [0.05, 1.0])
def test_the_gains_settle_at_those_of_the_riccati_equation(rate_hz, sigma):
    T, settings = 1.0 / rate_hz, TrackSettings(sigma_px=sigma)
    F, Q = model(T, settings.density_px2_s3)
    H = np.array([[1.0, 0.0]])
    prior = solve_discrete_are(F.T, H.T, Q, np.array([[sigma**2]]))
    K = (prior @ H.T / (prior[0, 0] + sigma**2)).ravel()
    alpha, beta = steady_gains(T, settings)
    np.testing.assert_allclose([alpha, beta / T], K, rtol=1e-9)
    track = empty_track(1, 1, settings)
    for k in range(1500):
        track = observe(track, k * T, pixel(0.0), ALL)
    np.testing.assert_allclose(track.covariance[0, 0, :2] / sigma**2, [alpha, beta / T], rtol=1e-6)


def test_irregular_stamps_give_the_filter_of_a_dense_reference():
    """Covariance and estimate against a Kalman filter written with matrices; missing markers among them."""
    rng = np.random.default_rng(3)
    settings = TrackSettings(sigma_px=0.3, jump_sigmas=50.0)
    track, t = empty_track(2, 3, settings), 0.0
    x = np.zeros((2, 3, 2, 2))  # per axis: position, rate
    P = np.zeros((2, 3, 2, 2))
    last = np.full((2, 3), -math.inf)
    for _ in range(120):
        t += rng.uniform(0.004, 0.035)
        wanted = (rng.random((2, 3)) < 0.8).astype(float)
        pixels = 300 + 40 * np.sin(2 * t) + rng.normal(0, 0.3, (2, 3, 2))
        track = observe(track, t, pixels, wanted)
        for c in range(2):
            for p in range(3):
                if not wanted[c, p]:
                    continue
                if t - last[c, p] > settings.gap_s:
                    x[c, p] = [[pixels[c, p, 0], 0.0], [pixels[c, p, 1], 0.0]]
                    P[c, p] = np.diag([0.3**2, settings.rate_px_s**2])
                else:
                    F, Q = model(t - last[c, p], settings.density_px2_s3)
                    prior = F @ P[c, p] @ F.T + Q
                    K = prior[:, 0] / (prior[0, 0] + 0.3**2)
                    for r in range(2):
                        ahead = F @ x[c, p, r]
                        x[c, p, r] = ahead + K * (pixels[c, p, r] - ahead[0])
                    P[c, p] = prior - np.outer(K, prior[0])
                last[c, p] = t
    np.testing.assert_allclose(track.positions, x[..., 0], rtol=1e-10)
    np.testing.assert_allclose(track.rates, x[..., 1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(track.covariance[..., 0], P[..., 0, 0], rtol=1e-9)
    np.testing.assert_allclose(track.covariance[..., 2], P[..., 1, 1], rtol=1e-8)
    assert track.jumps == 0


def test_the_covariance_is_honest():
    """Targets that accelerate as the filter assumes: normalised errors are chi-square with 2 freedoms an axis."""
    rng = np.random.default_rng(4)
    settings, T, n = TrackSettings(sigma_px=0.2), 1 / 60, 600
    F, Q = model(T, settings.density_px2_s3)
    L = np.linalg.cholesky(Q)
    x = np.zeros((n, 2, 2))  # n targets, two axes
    track = empty_track(1, n, settings)
    for k in range(60):
        x = x @ F.T + rng.normal(size=x.shape) @ L.T
        track = observe(track, k * T, (x[..., 0] + rng.normal(0, 0.2, (n, 2)))[None], np.ones((1, n)))
    off = np.stack([track.positions[0], track.rates[0]], axis=-1) - x
    a, b, c = track.covariance[0].T
    P = np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)
    nees = np.einsum("nri,nij,nrj->nr", off, np.linalg.inv(P), off)
    # 1200 values of mean 2 and variance 4
    assert abs(nees.mean() - 2.0) < 4 * 2 / math.sqrt(1200)


def feed(track, stamps, path, **extra):
    for t in stamps:
        track = observe(track, float(t), pixel(*path(t)), ALL, **extra)
    return track


def steadily(t):
    return 100.0 + 50.0 * t, 200.0 - 30.0 * t


def test_a_steady_target_is_known_exactly_and_extrapolated():
    rng = np.random.default_rng(5)
    stamps = np.cumsum(rng.uniform(0.005, 0.033, 200))
    track = feed(empty_track(1, 1), stamps, steadily)
    t = stamps[-1] + 0.02
    pixels, rates, tracked = predict(track, t)
    np.testing.assert_allclose(pixels[0, 0], steadily(t), atol=1e-6)
    np.testing.assert_allclose(rates[0, 0], [50, -30], atol=1e-4)
    assert tracked[0, 0] == 1
    before, _, _ = predict(track, stamps[-1] - 0.01)
    np.testing.assert_allclose(before[0, 0], steadily(stamps[-1] - 0.01), atol=1e-6)


def test_duplicates_and_late_ones_change_nothing():
    stamps = np.arange(20) * 0.01
    track = feed(empty_track(1, 1), stamps, steadily)
    again = observe(track, stamps[-1], pixel(500.0), ALL)
    late = observe(again, stamps[-2], pixel(500.0), ALL)
    np.testing.assert_array_equal(late.positions, track.positions)
    np.testing.assert_array_equal(late.covariance, track.covariance)
    assert (late.ignored, late.jumps) == (2, 0)


def test_a_jump_starts_anew_at_rest_for_all_markers():
    track = empty_track(1, 2)
    both = np.ones((1, 2))
    for k in range(30):
        track = observe(track, 0.01 * k, np.array([[steadily(0.01 * k), (10.0 + k, 0.0)]]), both)
    moved = np.array([[(400.0, 50.0), (40.0, 0.0)]])
    track = observe(track, 0.3, moved, both)
    np.testing.assert_array_equal(track.positions, moved)
    np.testing.assert_array_equal(track.rates, 0.0)
    assert track.jumps == 1
    # the second after the jump tells the rate again
    track = observe(track, 0.31, moved + np.array([1.0, 0.0]), both)
    np.testing.assert_allclose(track.rates[..., 0], 100.0, rtol=0.05)
    assert track.jumps == 1


def test_a_silent_client_moves_nothing():
    track = feed(empty_track(1, 1), np.arange(50) * 0.01, steadily)
    gap = track.settings.gap_s
    _, rates, _ = predict(track, 0.49 + 0.99 * gap)
    assert rates.any()
    pixels, rates, _ = predict(track, 0.49 + 10 * gap)
    np.testing.assert_array_equal(rates, 0.0)
    np.testing.assert_allclose(pixels[0, 0], steadily(0.49 + gap), atol=0.05)
    # back again: a new start where it is now, wherever that is; no jump
    track = observe(track, 5.0, pixel(7.0, 8.0), ALL)
    np.testing.assert_array_equal(track.positions[0, 0], [7.0, 8.0])
    np.testing.assert_array_equal(track.rates, 0.0)
    assert track.jumps == 0


def test_markers_left_out_go_on_and_are_dropped():
    both, one = np.ones((1, 2)), np.array([[1.0, 0.0]])
    track = empty_track(1, 2)
    for k in range(40):
        track = observe(track, 0.01 * k, np.array([[steadily(0.01 * k), steadily(0.01 * k)]]), both)
    track = observe(track, 0.45, np.array([[steadily(0.45), (math.nan, 0.0)]]), both)
    assert track.tracked.tolist() == [[1.0, 1.0]]
    np.testing.assert_allclose(predict(track, 0.45)[0][0, 1], steadily(0.45), atol=0.05)
    for k in range(46, 70):
        track = observe(track, 0.01 * k, np.array([[steadily(0.01 * k), (0.0, 0.0)]]), one)
    assert track.tracked.tolist() == [[1.0, 0.0]]
    assert predict(track, 0.7)[2].tolist() == [[1.0, 0.0]]


def test_refusals_and_serialisation():
    track = feed(empty_track(1, 1), [0.0, 0.01], steadily)
    with pytest.raises(ValueError, match="finite time"):
        observe(track, math.nan, pixel(0.0), ALL)
    with pytest.raises(ValueError, match="do not fit"):
        observe(track, 1.0, np.zeros((1, 2, 2)), ALL)
    with pytest.raises(ValueError, match="gap_s"):
        TrackSettings(gap_s=0.0)
    fields = msgspec.structs.asdict(track)
    assert {name for name, value in fields.items() if isinstance(value, np.ndarray)} == {
        "positions", "rates", "covariance", "stamps_s", "tracked",
    }  # fmt: skip
    copy = msgspec.structs.replace(track, **fields)
    np.testing.assert_array_equal(
        observe(copy, 0.02, pixel(3.0), ALL).rates, observe(track, 0.02, pixel(3.0), ALL).rates
    )


def test_the_clock_takes_the_fastest_message_and_follows_a_drift():
    rng = np.random.default_rng(6)
    clock = ClientClock()
    for k in range(400):
        stamp = 0.01 * k
        delay = 0.002 + rng.exponential(0.01)
        clock = arrived(clock, stamp, 1000.0 + stamp * (1 + 1e-4) + delay)
    # client's clock 100 ppm slow after 4 s, least delay 2 ms: the offset is within drift x 1 s of it
    assert clock.offset_s == pytest.approx(1000.0 + 3.99e-4 + 0.002, abs=2e-3)
    assert clock.offset_s >= 1000.002
