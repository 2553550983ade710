"""Gauge-free quantities against the Euclidean truth: the same in every frame, and what they are said to be."""

import numpy as np
import pytest

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.kinematics.gauge_free import gauge_free_quantities
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model

STRATA = {
    "rx90": "metric",
    "pan_tilt": "metric",
    "mixed": "metric",
    "gantry_with_wrist": "metric",
    "gantry": "affine",
    "scara": "affine",
    "parallel": "projective",
}


def values(model):
    return {row.name: row.value for row in gauge_free_quantities(model) if row.value is not None}


@pytest.mark.parametrize(("name", "stratum"), STRATA.items())
def test_another_projective_frame_changes_nothing(name, stratum):
    cell = getattr(synthetic, name)()
    one = values(exact_model(cell, stratum=stratum))
    other = values(exact_model(cell, stratum=stratum, plane=(-0.2, 0.15, 0.6, 0.7)))
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert other[key] == pytest.approx(value, rel=1e-7, abs=1e-7), key


@pytest.mark.parametrize("name", STRATA)
def test_sights_and_their_motion_are_those_of_the_cell(name):
    """Pixels of the truth, and their finite differences by each joint; through lenses, too."""
    cell = getattr(synthetic, name)().with_k1(-0.2)
    found = values(exact_model(cell, stratum=STRATA[name]))
    marker = next(key for key in found if key.endswith("in cam0: u")).split(" in ")[0]
    index = cell.marker_ids.index(int(marker.split()[1]))
    here = cell.pixels(cell.home[None])[:, 0, index]
    h = 1e-5
    for c in range(2):
        assert [found[f"{marker} in cam{c}: {axis}"] for axis in "uv"] == pytest.approx(here[c], abs=1e-8)
        assert found[f"cam{c}: lens k"] == pytest.approx(cell.lenses[c, 0])
        for j, joint in enumerate(cell.joint_names):
            step = h * np.eye(len(cell.home))[j]
            ends = cell.pixels(np.array([cell.home - step, cell.home + step]))[c, :, index]
            slope = [found[f"{marker} in cam{c}: d{axis}/d{joint}"] for axis in "uv"]
            assert slope == pytest.approx((ends[1] - ends[0]) / (2 * h), abs=1e-4)


@pytest.mark.parametrize("name", ["rx90", "scara", "parallel", "pan_tilt"])
def test_images_of_axes_pass_through_the_images_of_their_points(name):
    cell = getattr(synthetic, name)()
    found = values(exact_model(cell, stratum=STRATA[name]))
    points, directions = cell.axes(cell.home)
    if cell.mount == "eye_in_hand":
        to_rig = np.linalg.inv(cell.flange(cell.home))
        points, directions = points @ to_rig[:3, :3].T + to_rig[:3, 3], directions @ to_rig[:3, :3].T
    for j, joint in enumerate(cell.joint_names):
        if cell.kinds[j] == "prismatic":
            continue
        for c, (K, pose) in enumerate(zip(cell.intrinsics, cell.poses, strict=True)):
            angle = np.radians(found[f"axis {joint} in cam{c}: angle"])
            distance = found[f"axis {joint} in cam{c}: distance from the middle"]
            along, right = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            for s in (0.3, 0.7):
                seen = K @ (pose[:3, :3] @ (points[j] + s * directions[j]) + pose[:3, 3])
                pixel = seen[:2] / seen[2]
                # The middle lies ``distance`` to the right of the line.
                assert (np.array([319.5, 239.5]) - pixel) @ right == pytest.approx(distance, abs=1e-6)
            assert np.linalg.norm(along) == pytest.approx(1.0)


def test_metric_quantities_are_the_cells():
    cell = synthetic.mixed()
    found = values(exact_model(cell))
    _, directions = cell.axes(cell.home)
    for j in range(3):
        cosine = np.cos(np.radians(found[f"angle of axes j{j + 1} j{j + 2}"]))
        assert cosine == pytest.approx(directions[j] @ directions[j + 1], abs=1e-12)
    for c, K in enumerate(cell.intrinsics):
        told = [found[f"cam{c}: {name}"] for name in ("fx", "skew", "fy", "u0", "v0")]
        assert told == pytest.approx([K[0, 0], 0, K[1, 1], K[0, 2], K[1, 2]], abs=1e-8)
    assert found["vergence cam0 cam1"] == pytest.approx(20.0)
    # One unit of the slide is a metre, so ratios to it are lengths.
    centres = [np.linalg.inv(pose)[:3, 3] for pose in cell.poses]
    assert found["baseline cam0 cam1 over unit of j1"] == pytest.approx(np.linalg.norm(centres[1] - centres[0]))
    assert found["a of j2 over unit of j1"] == pytest.approx(0.2)
    assert found["a of j3 over unit of j1"] == pytest.approx(0.1)
    assert found["d of j3 over unit of j1"] == pytest.approx(0.1)
    for i in (1, 7, 13):
        told = found[f"distance of markers 10 {10 + i} over unit of j1"]
        assert told == pytest.approx(np.linalg.norm(cell.body[i] - cell.body[0]))


def test_nearly_parallel_axes_are_reported_by_two_angles_with_signs():
    cell = synthetic.rx90()
    found = values(exact_model(cell))
    assert found["angle of axes j2 j3 about their normal"] == pytest.approx(0.0, abs=1e-9)
    assert found["angle of axes j2 j3 within their plane"] == pytest.approx(0.0, abs=1e-9)
    assert "angle of axes j2 j3" not in found
    assert found["a of j2 over d of j4"] == pytest.approx(0.5)


def test_a_gantry_measures_the_body_in_its_own_units():
    cell = synthetic.gantry()
    found = values(exact_model(cell, stratum="affine"))
    _, directions = cell.axes(cell.home)
    markers = cell.markers(cell.home[None])[0, :, :3]
    for i in (1, 6, 13):
        told = [found[f"marker {10 + i} from 10 along j{j}"] for j in (1, 2, 3)]
        assert told == pytest.approx(np.linalg.solve(directions.T, markers[i] - markers[0]), abs=1e-9)


def test_a_scara_knows_its_links_and_heights():
    cell = synthetic.scara()
    found = values(exact_model(cell, stratum="affine"))
    assert found["distance of axes j2 j4 over j1 j2"] == pytest.approx(0.30 / 0.35)
    # At joint angle q2 the elbow's inner angle is 180° - q2, counted from the first axis to the last.
    assert found["angle from axis j1 over j2 to j4 at the zero"] == pytest.approx(180 + np.degrees(0.5))
    _, directions = cell.axes(cell.home)
    markers = cell.markers(cell.home[None])[0, :, :3]
    for i in (2, 9):
        told = found[f"marker {10 + i} above 10 along axis j4"]
        assert told == pytest.approx((markers[i] - markers[0]) @ directions[2], abs=1e-9)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("rx90", {"scale of lengths": "known length"}),
        ("gantry", {"intrinsics and vergence": "no revolute joint"}),
        ("scara", {"intrinsics and vergence": "j1, j2, j4 are parallel"}),
        ("parallel", {"plane at infinity": "j1, j2, j3 are parallel", "intrinsics and vergence": "parallel"}),
    ],
)
def test_what_is_not_identifiable_is_reported_with_the_reason(name, told):
    rows = gauge_free_quantities(exact_model(getattr(synthetic, name)(), stratum=STRATA[name]))
    missing = {row.name: row.reason for row in rows if row.value is None}
    for key, reason in told.items():
        assert reason in missing[key]
    assert all(row.reason == "" for row in rows if row.value is not None)
    metric = {"cam0: fx", "vergence cam0 cam1"}
    assert (metric <= {row.name for row in rows}) == (STRATA[name] == "metric")


def test_standard_deviations_are_the_scatter_over_seeds():
    """Errors over the stated deviations, pooled: mean square 1 within its own scatter."""
    cell = synthetic.pan_tilt()
    squares = []
    for seed in range(20):
        model = fit_model(cell.trials(0.1, np.random.default_rng(seed)), epoch=1).model
        truth = values(exact_model(cell, zero=model.zero))
        rows = [row for row in gauge_free_quantities(model) if row.value is not None]
        squares.append([((row.value - truth[row.name]) / row.std) ** 2 for row in rows])
    single = np.mean(squares, axis=0)
    # chi-square with 20 freedoms: beyond 2.6 in one of 10 000.
    assert single.max() < 2.6
    # 20 seeds of about 60 parameters, quantities depending on one another: a standard error below 0.1.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.3)
