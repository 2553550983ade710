"""The ratio of ``bench page`` and its interval, of latenesses whose ratio is known."""

import numpy as np

from stereoservo_sim.benchmarks.live_loop import ratios


def test_what_a_machine_does_to_both_of_a_pair_widens_no_interval_and_what_it_does_to_one_does() -> None:
    rng = np.random.default_rng(18)
    scales = rng.uniform(0.5, 2.0, 8)
    none = [np.round(1e3 * scale * rng.exponential(40.0, 200)).astype(np.int64) for scale in scales]
    for found in ratios([3 * segment for segment in none], none, rng).values():
        assert found == {"ratio": 3.0, "low": 3.0, "high": 3.0}
    apart = [np.round(3 * segment * rng.uniform(0.7, 1.4)).astype(np.int64) for segment in none]
    for found in ratios(apart, none, rng).values():
        assert found["low"] < found["ratio"] < found["high"]
