"""Every arm of the simulation from its trial motions: the stratum it can tell, at the noise floor, predicting poses it
has not seen, with gauge-free quantities and their deviations that hold."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import propagate_covariance
from stereoservo.kinematics.denavit_hartenberg import COLUMNS, ReadOutError, denavit_hartenberg
from stereoservo.kinematics.gauge_free import gauge_free_quantities
from stereoservo.messages.known_length import KnownLength
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model

SIGMA = 0.05


def facing(tilt):
    return synthetic.rotation("x", tilt) @ synthetic.rotation("y", 20)


def one_revolute():
    links = (synthetic.translation(0.15, 0.05, 0.1),)
    body = synthetic.two_faces()
    return synthetic.placed(("revolute",), links, body, (0.2,), np.radians([35]), facing(160))


def one_prismatic():
    links = (synthetic.rotation("x", 20),)
    return synthetic.placed(("prismatic",), links, synthetic.two_faces(), (0.0,), (0.18,), facing(165))


def two_prismatic():
    links = (synthetic.rotation("x", -90), synthetic.rotation("y", 20))
    ranges = (0.15, 0.15)
    return synthetic.placed(("prismatic",) * 2, links, synthetic.two_faces(), (0.0, 0.0), ranges, facing(165))


def two_revolute():
    links = (synthetic.dh_link(0.2, 90, 0.05), synthetic.dh_link(0.12, 0, 0.1))
    ranges = np.radians([25, 35])
    return synthetic.placed(("revolute",) * 2, links, synthetic.two_faces(), (0.2, 0.3), ranges, facing(165))


ARMS = {
    synthetic.rx90: "metric",
    synthetic.offset_wrist: "metric",
    synthetic.seven: "metric",
    synthetic.gantry: "affine",
    synthetic.gantry_with_wrist: "metric",
    synthetic.scara: "affine",
    synthetic.mixed: "metric",
    synthetic.parallel: "projective",
    synthetic.pan_tilt: "metric",
    one_revolute: "projective",
    one_prismatic: "affine",
    two_prismatic: "affine",
    two_revolute: "metric",
}


@dataclass
class Fitted:
    cell: synthetic.SyntheticCell
    stratum: str
    model: object
    rng: np.random.Generator


@pytest.fixture(scope="module", params=ARMS, ids=lambda maker: maker.__name__)
def fitted(request):
    """One arm, calibrated from nine stops a joint."""
    cell, rng = request.param(), np.random.default_rng(5)
    trials = cell.trials(SIGMA, rng)
    return Fitted(cell, ARMS[request.param], fit_model(trials, epoch=1).model, rng)


def pixels_at(positions):
    """Raw pixels (c, s, m, 2), flat, as a function of the model."""

    def predict(model):
        chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
        points = np.array([model.marker_points @ chain.displacement(q).T for q in positions])
        seen = []
        for camera in model.cameras:
            images = points @ camera.matrix.T
            seen.append(distort(camera.lens, images[..., :2] / images[..., 2:]))
        return np.array(seen).ravel()

    return predict


def assert_consistent(errors, covariance):
    """Errors as a whole within their covariance: chi-square on its range, 99.98 % interval."""
    sizes = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(sizes, sizes))
    kept = values > 1e-7 * values[-1]
    parts = (vectors.T @ (errors / sizes))[kept] / np.sqrt(values[kept])
    low, high = chi2.ppf([1e-4, 1 - 1e-4], kept.sum())
    assert low < float(parts @ parts) < high, (float(parts @ parts), int(kept.sum()))
    # 4.5 sigmas: seven in a million.
    assert np.abs(errors / sizes).max() < 4.5


def test_stratum_and_noise_floor(fitted):
    model = fitted.model
    assert model.stratum == fitted.stratum
    statistics = model.statistics
    floor = SIGMA * np.sqrt(1 - statistics.parameters / statistics.measurements)
    assert abs(statistics.rms_px - floor) < 3.3 * floor / np.sqrt(2 * statistics.degrees_of_freedom)
    assert statistics.chi2_ok
    for joint in statistics.joints:
        assert abs(joint.rms_px - joint.expected_px) < 4 * joint.standard_error_px


def test_poses_that_were_not_seen_are_predicted_within_the_covariance(fitted):
    """All joints at once, which no trial moved together."""
    positions = fitted.cell.held_out(fitted.rng, 8)
    predicted, covariance = propagate_covariance(fitted.model, pixels_at(positions))
    assert_consistent(predicted - fitted.cell.pixels(positions).ravel(), covariance)
    assert np.sqrt(np.diag(covariance)).max() < 20 * SIGMA


def test_gauge_free_quantities_are_the_truth_within_their_deviations(fitted):
    model = fitted.model
    exact = exact_model(fitted.cell, zero=model.zero, stratum=model.stratum)
    truth = {row.name: row.value for row in gauge_free_quantities(exact)}
    errors = []
    for row in gauge_free_quantities(model):
        if row.value is not None:
            errors.append((row.value - truth[row.name]) / row.std)
    errors = np.array(errors)
    assert np.abs(errors).max() < 4.5
    # One in 370 is beyond three sigmas; quantities hang together, so a few at once.
    assert (np.abs(errors) > 3).mean() < 0.1
    assert (None in truth.values()) == (len(truth) > len(errors))


def test_rows_are_the_truth_within_their_deviations_or_refused(fitted):
    cell = fitted.cell
    known = KnownLength("markers", (10, 17), float(np.linalg.norm(cell.body[0] - cell.body[7])))
    if fitted.stratum != "metric":
        with pytest.raises(ReadOutError) as caught:
            denavit_hartenberg(fitted.model, known)
        assert caught.value.code == "stratum"
        return
    rows = denavit_hartenberg(fitted.model, known)
    truth = denavit_hartenberg(exact_model(cell, zero=fitted.model.zero), known)
    for row, exact in zip(rows, truth, strict=True):
        assert row.link == exact.link
        assert row.chosen == exact.chosen
        for column in COLUMNS:
            error = getattr(row, column) - getattr(exact, column)
            if column in ("alpha", "theta"):
                error = np.remainder(error + np.pi, 2 * np.pi) - np.pi
            if column in row.chosen:
                assert abs(error) < 1e-6
            else:
                assert abs(error) < 4.5 * getattr(row, f"{column}_std"), (row.joint, column)
        if row.scale is not None:
            assert abs(row.scale - 1.0) < 4.5 * row.scale_std
