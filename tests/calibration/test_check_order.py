"""The check moves two joints at a time: it sees an order of joints that trials of single joints leave open."""

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.change.model_check import check_model_holds
from stereoservo.calibration.self_calibration import fit_model
from stereoservo_sim.world.synthetic import offset_wrist, rx90

SIGMA = 0.05


def relabelled(trials, order):
    """The trials of drives that answer under each other's names: what is reported of joint i moves ``order[i]``."""
    place = np.argsort(order)
    return msgspec.structs.replace(
        trials,
        positions=trials.positions[:, order],
        trials=np.where(trials.trials < 0, -1, place[trials.trials]),
    )


def two_at_a_time(cell):
    """Stops of the check motion: the base, then each joint displaced with the next one the other way."""
    stops = [cell.home]
    for joint in range(len(cell.home)):
        stop = cell.home.copy()
        stop[joint] += 0.5 * cell.ranges[joint]
        following = (joint + 1) % len(cell.home)
        stop[following] -= 0.5 * cell.ranges[following]
        stops.append(stop)
    return np.array(stops), np.full(len(stops), -1)


@pytest.mark.parametrize(
    ("maker", "swapped"),
    [
        (rx90, (1, 5)),
        (offset_wrist, (0, 1)),
        pytest.param(rx90, (0, 1), marks=pytest.mark.slow),
        pytest.param(rx90, (3, 4), marks=pytest.mark.slow),
        pytest.param(offset_wrist, (3, 4), marks=pytest.mark.slow),
        pytest.param(offset_wrist, (1, 5), marks=pytest.mark.slow),
    ],
)
def test_a_wrong_order_of_joints_fits_its_trials_and_fails_the_check(maker, swapped):
    cell, rng = maker(), np.random.default_rng(5)
    order = np.arange(6)
    order[list(swapped)] = order[list(swapped)[::-1]]
    made_from = relabelled(cell.trials(SIGMA, rng), order)
    wrong = fit_model(made_from, epoch=1)
    assert wrong.model.statistics.chi2_ok
    check = cell.trials(SIGMA, rng, positions=two_at_a_time(cell))
    report = check_model_holds(wrong.model, relabelled(check, order), made_from=made_from)
    assert report.status == "recalibrate"
    assert report.sigmas > 5.0
    assert report.left_out == 0
    made_from = cell.trials(SIGMA, rng)
    right = fit_model(made_from, epoch=2)
    assert check_model_holds(right.model, check, made_from=made_from).status == "holds"
