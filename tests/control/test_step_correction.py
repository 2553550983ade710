"""Steps that make the motion that was meant (8.5.2): the displacement is the truth."""

import numpy as np
import pytest
from scipy.linalg import expm

from oracles import step_correction as reference
from stereoservo.control import step_correction as kernels
from stereoservo.kinematics.composition import Composition, displacement

COMPOSITIONS = list(Composition)


def arm(virtual, rng, joints=6):
    """Operators of joints of all kinds in a random projective frame."""
    generators = np.array(
        [
            virtual.screw(rng.normal(size=3)) if j % 3 == 2 else virtual.screw(_unit(rng), rng.uniform(-0.5, 0.5, 3))
            for j in range(joints)
        ]
    )
    frame = virtual.random_frame(rng)
    return frame @ generators @ np.linalg.inv(frame), frame


def _unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


@pytest.mark.parametrize("composition", COMPOSITIONS)
@pytest.mark.parametrize("seed", range(6))
def test_the_step_makes_the_displacement_and_the_kernel_finds_it_too(virtual, composition, seed):
    rng = np.random.default_rng(seed)
    operators, frame = arm(virtual, rng)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (4, 3)), np.ones(4)]) @ frame.T
    truth = rng.uniform(-0.25, 0.25, 6)
    wanted = points @ displacement(operators, composition, truth).T
    rough = truth + rng.uniform(-0.05, 0.05, 6)
    step = reference.corrected_step(operators, composition, points, wanted, rough)
    np.testing.assert_allclose(step, truth, rtol=0, atol=1e-7)
    np.testing.assert_allclose(points @ displacement(operators, composition, step).T, wanted, rtol=0, atol=1e-11)
    found = kernels.corrected_step(operators, int(composition), points, wanted, rough)
    np.testing.assert_allclose(found, step, rtol=0, atol=1e-9)


@pytest.mark.parametrize("composition", COMPOSITIONS)
def test_step_operators_are_the_derivative(virtual, composition):
    rng = np.random.default_rng(7)
    operators, _ = arm(virtual, rng)
    step = rng.uniform(-0.3, 0.3, 6)
    H = displacement(operators, composition, step)
    turned = reference.step_operators(operators, composition, step)
    found, H_found = np.empty((6, 4, 4)), np.empty((4, 4))
    screws = kernels.joint_screws(operators)
    kernels.step_into(screws, int(composition), step, H_found, found, np.empty((5, 4, 4)))
    np.testing.assert_allclose(H_found, H, atol=1e-12)
    np.testing.assert_allclose(found, turned, atol=1e-10)
    kernels.displacement_into(screws, int(composition), step, H_found, np.empty((5, 4, 4)))
    np.testing.assert_allclose(H_found, H, atol=1e-12)
    h = 1e-6
    for j in range(6):
        nudge = h * np.eye(6)[j]
        ahead, behind = (displacement(operators, composition, step + s * nudge) for s in (1, -1))
        np.testing.assert_allclose((ahead - behind) / (2 * h), turned[j] @ H, atol=1e-7)


def test_exponentials_in_closed_form_and_by_series(virtual):
    rng = np.random.default_rng(8)
    frame = virtual.random_frame(rng)
    inverse = np.linalg.inv(frame)
    turn = virtual.screw(_unit(rng), rng.normal(size=3))
    cases = [
        turn,
        2.5 * turn,
        virtual.screw(rng.normal(size=3)),
        turn + virtual.screw(_unit(rng)),
        np.zeros((4, 4)),
    ]
    for G in (frame @ case @ inverse for case in cases):
        for amount in (0.0, 1e-9, -0.4, 3.0):
            H = np.empty((4, 4))
            kernels.exponential_into(G, amount, np.empty((4, 4)), np.empty((4, 4)), H)
            np.testing.assert_allclose(H, expm(amount * G), atol=1e-10)


@pytest.mark.parametrize("composition", COMPOSITIONS)
def test_a_redundant_arm_takes_the_least_change(virtual, composition):
    rng = np.random.default_rng(9)
    operators, frame = arm(virtual, rng, 8)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (4, 3)), np.ones(4)]) @ frame.T
    rough = rng.uniform(-0.1, 0.1, 8)
    wanted = points @ displacement(operators, composition, rough + rng.uniform(-0.02, 0.02, 8)).T
    step = kernels.corrected_step(operators, int(composition), points, wanted, rough)
    np.testing.assert_allclose(points @ displacement(operators, composition, step).T, wanted, rtol=0, atol=1e-10)
    assert np.abs(step - rough).max() < 0.3


def test_what_no_step_makes_is_approached_and_what_is_not_finite_is_left(virtual):
    rng = np.random.default_rng(10)
    operators, frame = arm(virtual, rng)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (4, 3)), np.ones(4)]) @ frame.T
    rough = np.full(4, 0.05)
    wanted = points @ displacement(operators, Composition.BASE_FIRST, np.full(6, 0.06)).T
    few = np.ascontiguousarray(operators[:4])
    step = kernels.corrected_step(few, 0, points, wanted, rough)
    before, after = (
        ((points @ displacement(few, Composition.BASE_FIRST, s).T - wanted) ** 2).sum() for s in (rough, step)
    )
    assert after <= before
    unknown = kernels.corrected_step(few, 0, points, np.full_like(wanted, np.nan), rough)
    np.testing.assert_array_equal(unknown, rough)
    np.testing.assert_array_equal(
        reference.corrected_step(few, Composition.BASE_FIRST, points, np.full_like(wanted, np.nan), rough),
        rough,
    )
