"""Which case a chain is: exact cells, calibrated ones within their covariance, and arms that are nearly so."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.kinematics.inverse.recognition import chain_of, check_condition, recognise, structure
from stereoservo.kinematics.inverse.solver import inverse_kinematics
from stereoservo_sim.experiments import inverse_kinematics as families
from stereoservo_sim.experiments.inverse_kinematics import hide
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model

CASES = {
    "rx90": ("metric", "arm_with_wrist", False),
    "offset_wrist": ("metric", "numerical", False),
    "seven": ("metric", "numerical", False),
    "gantry": ("affine", "prismatic", False),
    "gantry_with_wrist": ("metric", "gantry_with_wrist", False),
    "scara": ("affine", "numerical", False),
    "mixed": ("metric", "numerical", False),
    "parallel": ("projective", "numerical", False),
    "pan_tilt": ("metric", "two_revolute", False),
}


@pytest.mark.parametrize("name", CASES)
def test_exact_cells_are_what_they_are(name):
    stratum, case, inverted = CASES[name]
    known = recognise(exact_model(getattr(synthetic, name)(), stratum=stratum))
    assert (known.case, known.inverted) == (case, inverted)


@pytest.mark.parametrize(
    ("make", "case"),
    [
        (families.one, "revolute"),
        (families.two, "two_revolute"),
        (families.parallel_pair, "two_parallel"),
        (families.shoulder_and_elbow, "arm"),
        (families.square_wrist, "wrist"),
        (families.concurrent, "wrist"),
        (families.sliding(2), "prismatic"),
        (families.general, "numerical"),
    ],
)
def test_random_arms_are_recognised_in_any_frame(make, case):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        assert hide(make(rng), rng).recognition.case == case


def test_dependent_slides_are_no_gantry():
    axes = families.sliding(2)(np.random.default_rng(0))
    chain = hide(families.joined(axes, axes.part(slice(0, 1))), np.random.default_rng(1)).chain
    assert recognise(chain).case == "numerical"


@pytest.fixture(scope="module")
def calibrated():
    """Fits at 0.1 px, each a second."""
    cells = {}

    def fitted(name, seed, change=None):
        if (name, seed, change) not in cells:
            cell = getattr(synthetic, name)()
            if change is not None:
                link, (what, amount) = change
                error = synthetic.rotation("x", amount) if what == "tilt" else synthetic.translation(amount, 0, 0)
                links = list(cell.links)
                links[link] = links[link] @ error
                cell = replace(cell, links=tuple(links))
            trials = cell.trials(0.1, np.random.default_rng(seed))
            cells[name, seed, change] = fit_model(trials, epoch=1).model
        return cells[name, seed, change]

    return fitted


def test_calibrated_arm_is_recognised_within_its_covariance(calibrated):
    """Off by 1e-4 and more, which a chain without covariance is not forgiven."""
    model = calibrated("rx90", 0)
    known = recognise(model)
    assert known.case == "arm_with_wrist"
    assert recognise(chain_of(model)).case == "numerical"
    held = [e for e in known.evidence if e.holds]
    assert {(e.condition, e.joints, e.freedom) for e in held} == {
        ("parallel", (1, 2), 2),
        ("common_point", (3, 4, 5), 3),
    }
    for evidence in held:
        assert evidence.deviation > 1e-6
        assert evidence.chi2 <= evidence.threshold


def test_the_structure_of_a_learnt_arm_is_reported_and_nothing_else(calibrated):
    """Of an elbow arm with a spherical wrist: the first axis meets the second, the upper arm turns in one plane."""
    for arm in (calibrated("rx90", 0), chain_of(exact_model(synthetic.rx90()))):
        told = structure(arm)
        assert {(e.condition, e.joints) for e in told} >= {("parallel", (1, 2)), ("common_point", (3, 4, 5))}
        assert all(e.holds for e in told)
        assert ("common_point", (3, 4)) not in {(e.condition, e.joints) for e in told}
    offset = structure(calibrated("rx90", 0, (4, ("shift", 0.003))))
    assert ("common_point", (3, 4, 5)) not in {(e.condition, e.joints) for e in offset}


def test_chi_square_of_conditions_that_hold_is_chi_square(calibrated):
    """Sum over two calibrations and two conditions of 2 and 3 freedoms, inside 99.9 %."""
    total = 0.0
    for seed in range(2):
        model = calibrated("rx90", seed)
        total += check_condition(model, "parallel", (1, 2)).chi2
        total += check_condition(model, "common_point", (3, 4, 5)).chi2
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 2 * (2 + 3))
    assert low < total < high


@pytest.mark.parametrize(
    ("change", "condition", "joints"),
    [
        ((1, ("tilt", 0.3)), "parallel", (1, 2)),
        ((4, ("shift", 0.003)), "common_point", (3, 4, 5)),
        ((4, ("shift", 0.003)), "common_point", (4, 5)),
    ],
)
def test_a_third_of_a_degree_and_three_millimetres_are_distinguished_from_none(calibrated, change, condition, joints):
    model = calibrated("rx90", 0, change)
    evidence = check_condition(model, condition, joints)
    assert not evidence.holds
    assert evidence.chi2 > 3 * evidence.threshold
    assert recognise(model).case == "numerical"


def test_closed_form_of_a_calibrated_arm_ends_on_the_chain_as_it_is(calibrated):
    """The conditions hold within noise only; the solutions reach the goal exactly all the same, all eight."""
    model = calibrated("rx90", 1)
    chain, known = chain_of(model), recognise(model)
    rng = np.random.default_rng(0)
    for _ in range(10):
        q = chain.zero + rng.uniform(-1.0, 1.0, 6)
        found = inverse_kinematics(model, displacement=chain.displacement(q), recognition=known)
        assert len(found.joints) == 8
        assert found.residuals.max() < 1e-10
        apart = np.mod(found.joints - q + np.pi, 2 * np.pi) - np.pi
        assert np.abs(apart).max(axis=1).min() < 1e-8
