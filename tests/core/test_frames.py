"""Frames of cameras: one kernel call compares each with the prediction and folds it, as by the definitions."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo.core.estimate import KNOWN, MEASURED, fold_frame, see_frame, workspace
from stereoservo.core.model_arrays import FIRST_SEEN_SIGMA_PX, model_arrays
from stereoservo.core.monitor import judge_round
from stereoservo.core.prediction import HUBER, MODEL_SIGMA_PX, TIMING_SIGMA_S, gate_threshold, improbable
from stereoservo.core.state import initial_state

from ..oracles.frames import distances, fold, residuals

H_S = 1e-4
MASKED, OUTLIER = 2, 5


def test_frames_are_folded_and_judged_as_by_their_definitions(benches: Any) -> None:
    bench = benches(4, static=4)
    truth, settings, rng = bench.truth, bench.settings, np.random.default_rng(1)
    block, room = initial_state(settings).block, workspace(settings, None)
    arrays = model_arrays(truth.model, settings)
    room.use(arrays)
    room.arrays["masked"][MASKED] = 1.0
    m, rows = len(arrays.marker_ids), len(arrays.row_ids)
    assert rows == m + 4
    block.begin_observations(m, rows)
    ids, masked = np.array([*arrays.marker_ids, *arrays.scene_ids]), np.zeros(m)
    masked[MASKED] = 1.0
    standing = truth.images_of(truth.static)
    gate = gate_threshold(settings.gate_sigma)
    filtered, seen_s, sums = np.zeros((2, m, 2)), np.full((2, m), -np.inf), np.zeros((2, 2))
    q, rate = bench.q.copy(), rng.normal(0.0, 0.1, 6)
    odd, last_ns = 0, 0
    for k in range(6):
        t_ns = 1_000_000_000 + 40_000_000 * k
        now, camera = q + rate * 0.04 * k, k % 2
        block.history_ns[:2] = t_ns - 1_000_000, t_ns + 3_000_000
        block.history_positions[:2] = now - 1e-3 * rate, now + 3e-3 * rate
        block.numbers.history_count = 2
        moved = [truth.pixels(now + s * H_S * rate)[camera] for s in (-1, 0, 1)]
        predicted = np.concatenate([moved[1], standing[camera]])
        velocity = np.concatenate([(moved[2] - moved[0]) / (2.0 * H_S), np.zeros((4, 2))])
        covariances = np.tile(0.04 * np.eye(2), (rows, 1, 1))
        covariances[:, 0, 1] = covariances[:, 1, 0] = 0.01
        observed = predicted + rng.normal(0.0, 0.2, (rows, 2))
        if k == 4:
            observed[OUTLIER] += 9.0
        shown = rng.permutation(rows)[: rows - 1]  # one is not seen, and they come in any order
        room.put_frame(0, camera, (k, t_ns), (ids[shown], observed[shown], covariances[shown]))
        found = see_frame(block.record, room.record, 0)
        assert found == KNOWN | MEASURED
        fold_frame(block.record, room.record, 0, found)
        assert block.numbers.round_due == (k >= 2)  # none has looked at the frame before
        frame = residuals(observed, predicted, velocity, covariances, TIMING_SIGMA_S)
        seen = np.isin(np.arange(rows), shown)
        used = seen & np.concatenate([masked == 0.0, np.ones(4, bool)])
        # the newest frame of its camera
        sighting, close = block.sightings[camera], {"rtol": 1e-6, "atol": 1e-6}
        np.testing.assert_array_equal(sighting.seen, seen)
        np.testing.assert_allclose(sighting.q, now, atol=1e-12)
        np.testing.assert_allclose(sighting.innovation[seen], frame.innovation[seen], **close)
        np.testing.assert_allclose(sighting.spread[seen], frame.spread[seen], **close)
        np.testing.assert_allclose(sighting.velocity[seen], frame.velocity[seen], rtol=1e-5, atol=1e-4)
        d2 = distances(frame.innovation, frame.spread, MODEL_SIGMA_PX)
        freedoms, squares = 2.0 * used.sum(), (frame.innovation[used] ** 2).sum()
        worst = int(np.flatnonzero(used)[d2[used].argmax()])
        np.testing.assert_allclose(sighting.chi2, d2[used].sum() / freedoms, rtol=1e-6)
        np.testing.assert_allclose(sighting.rms_px, np.sqrt(squares / freedoms), rtol=1e-6)
        assert sighting.worst == worst
        np.testing.assert_allclose(sighting.worst_px, np.linalg.norm(frame.innovation[worst]), rtol=1e-6)
        # what it says of the stamps: a weighted fit of innovations to velocities, frames forgotten in 30 s of motion
        weights = 1.0 / (frame.noise + MODEL_SIGMA_PX**2)
        for row, vectors in enumerate((frame.innovation, velocity)):
            fit = (weights[used] * (vectors * velocity)[used].sum(axis=-1)).sum() / used.sum()
            keep = np.exp(-0.08 / 30.0) if k >= 2 else 1.0
            sums[camera, row] = sums[camera, row] * keep + fit
        np.testing.assert_allclose([sighting.timing.product, sighting.timing.square], sums[camera], rtol=1e-4)
        # the estimate
        filtered[camera], seen_s[camera], sigma, accepted = fold(
            filtered[camera], seen_s[camera], t_ns * 1e-9, frame, used[:m], known_s=settings.limits.coast_s + 1.0,
            filter_s=settings.filter_s, gate=gate, model_px=MODEL_SIGMA_PX, first_px=FIRST_SEEN_SIGMA_PX, huber=HUBER,
        )  # fmt: skip
        assert accepted[OUTLIER] == (used[OUTLIER] and k != 4)
        estimate = block.estimates[camera]
        np.testing.assert_allclose(estimate.innovation, filtered[camera], **close)
        np.testing.assert_allclose(estimate.sigma[accepted], sigma[accepted], **close)
        np.testing.assert_array_equal(estimate.seen_ns == t_ns, accepted)
        assert (estimate.last_visible, estimate.frames) == (accepted.sum(), k // 2 + 1)
        if k >= 4 and not (d2[used].sum() <= improbable(freedoms) and d2[used].max() <= gate):
            odd |= 1 << camera
        last_ns = t_ns
    assert odd == 1

    def judged(now_ns: int, moving: int = 0) -> tuple[int, int, bool]:
        room.numbers.now_ns = now_ns
        return judge_round(block.record, room.record, moving)

    assert judged(last_ns) == (3, 1, True)
    assert judged(last_ns, 2)[0] == 1
    assert judged(last_ns + 10**9)[:2] == (0, 0)
