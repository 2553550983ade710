"""Random cells and their judge: reproducible, as stated, and calibrated from nothing without a lie."""

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.self_calibration import fit_model
from stereoservo_sim.experiments.random_rigs import (
    held_out_ratio,
    judged_case,
    run_random_lenses,
    run_random_rigs,
)
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world import random_cells
from stereoservo_sim.world.random_cells import random_case, random_lens_case


def test_the_same_seed_gives_the_same_case():
    first, again, other = random_case(7), random_case(7), random_case(8)
    assert np.array_equal(first.trials().pixels, again.trials().pixels, equal_nan=True)
    assert np.array_equal(first.held_out(), again.held_out())
    assert first.sigma != other.sigma


def test_cases_are_what_is_stated():
    cases = [random_case(seed) for seed in range(60)]
    for case in cases:
        cell = case.cell
        baseline = np.linalg.norm(np.linalg.inv(cell.poses[0])[:3, 3] - np.linalg.inv(cell.poses[1])[:3, 3])
        assert 0.08 <= baseline <= 0.5
        axes = cell.poses[:, 2, :3]
        assert -1e-6 <= np.degrees(np.arccos(np.clip(axes[0] @ axes[1], -1, 1))) <= 60 + 1e-6
        assert 450 <= cell.intrinsics[0, 0, 0] <= 1600
        assert np.abs(cell.intrinsics[:, :2, 2] - [319.5, 239.5]).max() <= 30
        assert 0.01 <= case.sigma <= 1.0
        assert 9 <= case.stops <= 15
        assert (cell.ranges >= random_cells.MIN_RANGE).all()
        assert (cell.ranges <= 0.6 + 1e-12).all()
        both = cell.in_view(cell.stops(case.stops)[0]).all(axis=0).sum(axis=1)
        assert both.min() >= 4
    assert {case.body for case in cases} == {"two_faces", "corner", "plate4", "plate7"}
    assert {case.arm for case in cases} == {"rx90", "offset", "ur", "random"}
    assert max(case.redraws for case in cases) < 30


def test_flat_bodies_are_flat_and_the_corner_is_not():
    for name, make in random_cells.BODIES.items():
        body = make() - make().mean(axis=0)
        thickness = np.linalg.svd(body, compute_uv=False)[2]
        assert (thickness < 1e-9) == (name in ("plate4", "plate7"))


def test_the_judge_finds_a_model_that_is_off():
    """A hundredth of a radian at the third joint's zero: plausible, and wrong."""
    case = random_case(2)
    trials = case.trials()
    result = fit_model(trials, epoch=1)
    ratio, freedom, _ = held_out_ratio(case, trials, result)
    assert ratio < 1 + 6 * np.sqrt(2 / freedom)
    shifted = result.model.zero + np.array([0, 0, 0.01, 0, 0, 0])
    wrong = msgspec.structs.replace(result, model=msgspec.structs.replace(result.model, zero=shifted))
    assert held_out_ratio(case, trials, wrong)[0] > 10


def test_wilson_interval():
    """As in Wilson (1927), checked against the roots of (p - s)² = z² p (1 - p) / n."""
    for good, cases in ((50, 50), (997, 1000), (3, 10)):
        share, z = good / cases, 1.959963984540054
        roots = np.sort(np.roots([1 + z**2 / cases, -2 * share - z**2 / cases, share**2]).real)
        assert np.allclose(wilson(good, cases), roots, atol=1e-9)


def promised(cases, seed):
    answer = run_random_rigs(cases, seed)
    assert answer["wrong"] == 0, answer["not_successes"]
    return answer


@pytest.mark.parametrize("cases", [10, pytest.param(50, marks=pytest.mark.slow)])
def test_random_rigs_are_calibrated_from_nothing(cases):
    """With 99.5 % promised, two failures of fifty come once in forty runs, two of twenty once in two hundred; these
    are fixed cases.
    """
    assert promised(cases, 0)["success"] >= cases - 1


def test_lenses_of_random_cases_are_as_stated_and_their_command_counts():
    case, again = random_lens_case(7), random_lens_case(7)
    assert np.array_equal(case.cell.lenses, again.cell.lenses)
    for seed in range(40):
        cell = random_lens_case(seed).cell
        assert cell.lenses.shape == (2, 7)
        for K, lens in zip(cell.intrinsics, cell.lenses, strict=True):
            assert np.array_equal(lens[1:3], K[:2, 2])
            assert -0.44 <= lens[0] * K[0, 0] * K[1, 1] / lens[3] ** 2 <= 0.11
            assert random_cells.unfolded(lens, cell.width, cell.height)
    answer = run_random_lenses(2, 10)
    assert (answer["usable"], answer["wrong"], answer["refused"]) == (2, 0, 0)
    assert sum(row["cases"] for row in answer["rows"]) == 2
    assert answer["not_usable"] == []


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_thousand_random_rigs_are_calibrated_from_nothing():
    assert promised(1000, 2000)["success"] >= 995


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(3982, id="fifth joint, 0.77 px"),
        pytest.param(2934, id="first joint, 0.94 px"),
    ],
)
def test_noise_leads_no_axis_astray(seed):
    """The linear start finds no rotation here, and the nominal one creeps along a valley beside the minimum."""
    verdict = judged_case(random_case(seed))
    assert verdict.outcome == "success", verdict


@pytest.mark.slow
def test_a_lens_that_no_model_has_is_a_cause_that_fails():
    """A correction that was tried ended in a distortion of -1.8, and the whole fit in a `ModelFileError`."""
    assert judged_case(random_case(21040)).code == "not_identifiable"
