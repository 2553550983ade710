"""The drift check over seeds: injected causes are named, nothing injected raises no alarm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from scipy.stats import binom, chi2

from stereoservo.calibration.bundle_adjustment import solve
from stereoservo.calibration.change.model_check import check_model_holds, examine_model, make_check_report
from stereoservo.calibration.rig_model import Measurements, RigModel
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.kinematics.model import MODEL_SCHEMA, CameraModel, CellModel, FitStatistics
from stereoservo.messages.check_report import CheckReport
from stereoservo_sim.world.synthetic import SyntheticCell, gantry, pan_tilt, parallel, rx90

SIGMA = 0.05
MODELS = 10
STATISTICS = FitStatistics(SIGMA, 3000.0, 3000, True, 3081, 81, 0, (), 108)


class Cell:
    """A synthetic cell, the trials that its models were made from, and models fitted to such trials."""

    def __init__(self, cell: SyntheticCell, stops: int = 9) -> None:
        self.cell = cell
        self.made_from = cell.trials(SIGMA, np.random.default_rng(0), stops)
        self.rig = truth_rig(cell)
        self.models: dict[int, CellModel] = {}

    @property
    def order(self) -> tuple[int, ...]:
        n = len(self.cell.kinds)
        return tuple(range(n)) if self.cell.mount == "eye_to_hand" else tuple(reversed(range(n)))

    def model(self, seed: int) -> CellModel:
        """One of ``MODELS`` that bundles find from the truth on."""
        seed %= MODELS
        if seed not in self.models:
            self.models[seed] = self._fitted(seed)
        return self.models[seed]

    def _fitted(self, seed: int) -> CellModel:
        cell, back = self.cell, np.argsort(self.order)
        camera, stop, marker = np.nonzero(self.made_from.visible)
        exact = cell.pixels(self.made_from.positions)[camera, stop, marker]
        data = Measurements(
            (self.made_from.positions - cell.home)[:, list(self.order)], camera, stop, marker,
            exact + np.random.default_rng(10_000 + seed).normal(0, SIGMA, exact.shape),
            np.full(len(camera), SIGMA),
        )  # fmt: skip
        rig = solve(self.rig, data, "metric").rig
        return CellModel(
            schema=MODEL_SCHEMA, epoch=1, joint_names=cell.joint_names, joint_kinds=cell.kinds, zero=cell.home,
            generators=rig.generators[back],
            cameras=tuple(
                CameraModel(f"cam{c}", P, cell.width, cell.height) for c, P in enumerate(rig.cameras)
            ),
            marker_ids=cell.marker_ids, marker_points=rig.points, plane_at_infinity=np.array([0, 0, 0, 1.0]),
            stratum="metric", projective_to_euclidean=np.eye(4), statistics=STATISTICS, mount=cell.mount,
        )  # fmt: skip

    def stops(self) -> np.ndarray:
        """What the check motion visits: see `core.sources.check`."""
        n = len(self.cell.kinds)
        found = [self.cell.home]
        for j in range(n):
            q = self.cell.home.copy()
            q[j] += 0.5 * self.cell.ranges[j]
            q[(j + 1) % n] -= 0.5 * self.cell.ranges[(j + 1) % n]
            found.append(q)
        return np.array(found)


def truth_rig(cell: SyntheticCell) -> RigModel:
    """The cell in the frame of its first camera."""
    to_camera = cell.poses[0] @ np.eye(4)
    if cell.mount == "eye_to_hand":
        joints, frame = cell.frames(cell.home)[:-1], to_camera
        points = cell.markers(cell.home[None])[0] @ to_camera.T
        sign, order = 1.0, range(len(cell.kinds))
    else:
        flange = np.linalg.inv(cell.flange(cell.home))
        joints, frame = cell.frames(cell.home)[:-1], to_camera @ flange
        points = cell.markers(cell.home[None])[0] @ to_camera.T
        sign, order = -1.0, reversed(range(len(cell.kinds)))
    generators = []
    for j in order:
        pose = frame @ joints[j]
        G = np.zeros((4, 4))
        if cell.kinds[j] == "revolute":
            G[0, 1], G[1, 0] = -1.0, 1.0
        else:
            G[2, 3] = 1.0
        generators.append(sign * pose @ G @ np.linalg.inv(pose))
    kinds = cell.kinds if cell.mount == "eye_to_hand" else cell.kinds[::-1]
    cameras = np.array(
        [K @ pose[:3] @ np.linalg.inv(to_camera) for K, pose in zip(cell.intrinsics, cell.poses, strict=True)]
    )
    return RigModel(kinds, np.array(generators), cameras, points)


@cache
def arm() -> Cell:
    return Cell(rx90())


def rotation(rng: np.random.Generator, angle: float, shift: float) -> np.ndarray:
    axis = rng.standard_normal(3)
    axis *= angle / np.linalg.norm(axis)
    K = np.array([(0, -axis[2], axis[1]), (axis[2], 0, -axis[0]), (-axis[1], axis[0], 0)])
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(np.eye(3) + K)[0] * np.sign(np.diag(np.linalg.qr(np.eye(3) + K)[1]))
    step = rng.standard_normal(3)
    pose[:3, 3] = shift * step / np.linalg.norm(step)
    return pose


def injected(cell: SyntheticCell, cause: str, rng: np.random.Generator) -> tuple[SyntheticCell, str, np.ndarray, str]:
    """A cell changed by a cause of random size and place; its subject, drift of the joints, kind."""
    n = len(cell.kinds)
    drift = np.zeros(n)
    if cause == "camera":
        c = int(rng.integers(len(cell.poses)))
        poses = cell.poses.copy()
        poses[c] = rotation(rng, rng.uniform(2e-3, 2e-2), 1e-3) @ poses[c]
        return replace(cell, poses=poses), f"cam{c}", drift, "camera"
    if cause == "cameras":
        move = rotation(rng, rng.uniform(2e-3, 1e-2), 1e-3)
        return replace(cell, poses=cell.poses @ move), "", drift, "cameras"
    if cause == "body":
        homogeneous = np.hstack([cell.body, np.ones((len(cell.body), 1))])
        body = homogeneous @ rotation(rng, rng.uniform(5e-3, 3e-2), 1e-3).T
        return cell.with_body(body[:, :3]), "", drift, "body"
    if cause == "marker":
        m = int(rng.integers(len(cell.body)))
        body = cell.body.copy()
        body[m] += rng.normal(0, 1e-3, 3)
        return cell.with_body(body), str(cell.marker_ids[m]), drift, "marker"
    if cause == "joint":
        j = int(rng.integers(n))
        drift[j] = rng.choice([-1, 1]) * rng.uniform(1e-3, 2e-2)
        return cell, cell.joint_names[j], drift, "joint"
    return cell, "", drift, ""


def checked(
    cell: Cell, cause: str, seed: int, noise: float = SIGMA, gross: int = 0
) -> tuple[CheckReport, str, str, float]:
    rng = np.random.default_rng(seed)
    model = cell.model(seed)
    changed, subject, drift, kind = injected(cell.cell, cause, rng)
    stops = cell.stops()
    data: TrialData = changed.trials(noise, rng, positions=(stops + drift, np.full(len(stops), -1)), stated=SIGMA)
    data = msgspec.structs.replace(data, positions=stops)
    for _ in range(gross):
        where = rng.integers(2), rng.integers(len(stops)), rng.integers(len(model.marker_ids))
        data.pixels[where] += rng.normal(0, 30, 2)
    return check_model_holds(model, data, made_from=cell.made_from), subject, kind, float(drift.sum())


CAUSES = ["camera", "cameras", "body", "marker", "joint"]


@pytest.mark.parametrize("cause", CAUSES)
@pytest.mark.parametrize("seeds", [10, pytest.param(20, marks=pytest.mark.slow)])
def test_an_injected_cause_is_named(cause: str, seeds: int) -> None:
    named = 0
    pulls = []
    for seed in range(seeds):
        report, subject, kind, drift = checked(arm(), cause, 1000 + seed)
        first = report.causes[0] if report.causes else None
        right = first is not None and (first.kind, first.subject) == (kind, subject)
        named += right
        if right and cause == "joint":
            pulls.append((first.value - drift) / first.deviation)
        if right:
            assert report.status in ("drifting", "recalibrate")
            assert subject in report.message
    assert named >= seeds - 1, named
    if pulls:
        assert np.square(pulls).sum() < chi2.isf(1e-3, len(pulls))


def test_a_body_that_moves_by_itself_is_no_fault() -> None:
    """Of a part that a belt has carried elsewhere nothing is to be cured; a joint's drift beside it is still named."""
    cell, stops = arm(), arm().stops()
    elsewhere, _, _, _ = injected(cell.cell, "body", np.random.default_rng(0))
    for drift in (0.0, 0.01):
        offset = np.zeros(len(cell.cell.kinds))
        offset[1] = drift
        data = elsewhere.trials(
            SIGMA, np.random.default_rng(1), positions=(stops + offset, np.full(len(stops), -1)), stated=SIGMA
        )
        data = msgspec.structs.replace(data, positions=stops)
        examined = examine_model(cell.model(0), data, made_from=cell.made_from)
        standing, moving = make_check_report(examined), make_check_report(examined, body_moves=True)
        assert "body" in [cause.kind for cause in standing.causes]
        grave = [cause.subject for cause in moving.causes if cause.effect_px > moving.limit_px]
        assert grave == ([cell.cell.joint_names[1]] if drift else [])
        assert (moving.status == "holds") == (drift == 0.0)
        assert "as [scene] moves says" in moving.message
        assert all(found.kind != "body" for found in moving.drifts)


@pytest.mark.parametrize("seeds", [40, pytest.param(80, marks=pytest.mark.slow)])
def test_nothing_injected_raises_no_alarm(seeds: int) -> None:
    reports = [checked(arm(), "", 2000 + seed)[0] for seed in range(seeds)]
    alarms = [report.message for report in reports if report.status != "holds"]
    # Two of 40, three of 80: a rate of 1 % gives more with a chance below 1 %, one of 0.3 % of 0.03 %.
    assert len(alarms) <= binom.isf(0.01, seeds, 0.01), alarms
    # The chi-square is one: its mean over the seeds within 4 deviations.
    count = reports[0].measurements
    assert np.mean([r.chi2 for r in reports]) == pytest.approx(count, abs=4 * np.sqrt(2 * count / len(reports)))
    assert all("model holds" in report.message for report in reports if report.status == "holds")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_rates_over_many_seeds() -> None:
    """Each cause named in at least 95 %, no false alarm in more than 1 %."""
    for cause in CAUSES:
        found = [checked(arm(), cause, 30_000 + seed) for seed in range(200)]
        named = sum(
            bool(report.causes) and (report.causes[0].kind, report.causes[0].subject) == (kind, subject)
            for report, subject, kind, _ in found
        )
        assert named >= 0.95 * 200, (cause, named)
    alarms = sum(checked(arm(), "", 40_000 + seed)[0].status != "holds" for seed in range(1000))
    assert alarms <= 10, alarms


def test_a_model_taken_for_exact_has_too_large_a_chi_square() -> None:
    """The model's own uncertainty matters: after a short calibration most."""
    cell = Cell(rx90(), stops=4)
    excess = {True: [], False: []}
    for seed in range(MODELS):
        data = cell.cell.trials(SIGMA, np.random.default_rng(seed), positions=(cell.stops(), np.full(7, -1)))
        for known in excess:
            report = check_model_holds(cell.model(seed), data, made_from=cell.made_from if known else None)
            excess[known].append(report.chi2 - report.measurements)
    deviation = np.sqrt(2 * report.measurements / MODELS)
    assert abs(np.mean(excess[True])) < 3 * deviation
    more = np.array(excess[False]) - np.array(excess[True])  # paired: the noise of the check cancels
    assert more.mean() > 5.0 * more.std() / np.sqrt(MODELS)


def test_two_causes_are_both_named() -> None:
    rng = np.random.default_rng(5)
    cell = arm()
    slipped, marker, _, _ = injected(cell.cell, "marker", rng)
    drift = np.array([0, 0, 0.01, 0, 0, 0])
    stops = cell.stops()
    data = slipped.trials(SIGMA, rng, positions=(stops + drift, np.full(7, -1)))
    report = check_model_holds(cell.model(3), msgspec.structs.replace(data, positions=stops), made_from=cell.made_from)
    assert {(c.kind, c.subject) for c in report.causes} == {("marker", marker), ("joint", "j3")}
    assert report.status == "recalibrate"


def test_a_small_significant_change_drifts_and_is_not_yet_a_reason() -> None:
    rng = np.random.default_rng(6)
    cell = arm()
    drift = np.array([0, 0, 2e-4, 0, 0, 0])
    stops = cell.stops()
    data = cell.cell.trials(SIGMA, rng, positions=(stops + drift, np.full(7, -1)))
    report = check_model_holds(cell.model(3), msgspec.structs.replace(data, positions=stops), made_from=cell.made_from)
    assert report.status == "drifting"
    assert "below the limit of 0.25 px" in report.message


def test_more_noise_is_no_moved_camera() -> None:
    report = checked(arm(), "", 7, noise=2.0 * SIGMA)[0]
    assert [cause.kind for cause in report.causes] == ["unexplained"]
    assert report.causes[0].subject in ("cam0", "cam1")
    assert 1.7 < report.sigmas < 2.3


def test_gross_errors_are_left_out() -> None:
    report, subject, kind, _ = checked(arm(), "joint", 8, gross=3)
    assert report.left_out == 3
    assert [(c.kind, c.subject) for c in report.causes] == [(kind, subject)]


def test_cameras_on_the_tip_are_checked_too() -> None:
    head = Cell(pan_tilt())
    named = 0
    for seed in range(10):
        report, subject, kind, _ = checked(head, "camera", 50 + seed)
        named += bool(report.causes) and (report.causes[0].kind, report.causes[0].subject) == (kind, subject)
        assert checked(head, "", 80 + seed)[0].status == "holds"
    assert named >= 9


def test_residuals_are_reported_by_joint_camera_and_marker() -> None:
    report, subject, _, _ = checked(arm(), "marker", 11)
    worst = max(report.per_marker, key=lambda marker: report.per_marker[marker])
    assert worst == subject
    assert set(report.per_joint) == set(arm().cell.joint_names)
    assert set(report.per_camera) == {"cam0", "cam1"}


def test_a_models_own_covariance_states_the_same_as_its_trials() -> None:
    cell = rx90()
    made_from = cell.trials(SIGMA, np.random.default_rng(1))
    model = fit_model(made_from, epoch=1).model
    assert model.covariance is not None
    data = cell.trials(SIGMA, np.random.default_rng(2), positions=(arm().stops(), np.full(7, -1)))
    own = check_model_holds(model, data)
    bare = msgspec.structs.replace(model, covariance=None)
    taken = check_model_holds(bare, data, made_from=made_from)
    assert own.chi2 == pytest.approx(taken.chi2, rel=1e-4)
    assert own.chi2 < check_model_holds(bare, data).chi2


@pytest.mark.parametrize("make", [gantry, parallel])
def test_cells_of_lower_strata_are_checked_too(make: Callable[[], SyntheticCell]) -> None:
    cell = make()
    model = fit_model(cell.trials(SIGMA, np.random.default_rng(1)), epoch=1).model
    assert model.stratum != "metric"
    stops, rng = Cell(cell).stops(), np.random.default_rng(2)
    free = np.full(len(stops), -1)
    assert check_model_holds(model, cell.trials(SIGMA, rng, positions=(stops, free))).status == "holds"
    drift = np.zeros(len(cell.kinds))
    drift[1] = 0.005
    data = cell.trials(SIGMA, rng, positions=(stops + drift, free))
    report = check_model_holds(model, msgspec.structs.replace(data, positions=stops))
    assert [(cause.kind, cause.subject) for cause in report.causes] == [("joint", "j2")]
    for kind in ("camera", "marker"):
        changed, subject, _, _ = injected(cell, kind, rng)
        report = check_model_holds(model, changed.trials(SIGMA, rng, positions=(stops, free)))
        assert [(cause.kind, cause.subject) for cause in report.causes] == [(kind, subject)]


def test_too_few_pixels_are_no_check() -> None:
    cell = arm()
    rng = np.random.default_rng(9)
    data = cell.cell.trials(SIGMA, rng, positions=(cell.stops()[:2], np.full(2, -1)))
    with pytest.raises(CalibrationError) as caught:
        check_model_holds(cell.model(3), data)
    assert caught.value.code == "too_few_stops"
    other = msgspec.structs.replace(data, joint_names=tuple("abcdef"))
    with pytest.raises(CalibrationError, match="the model has j1"):
        check_model_holds(cell.model(3), other)
