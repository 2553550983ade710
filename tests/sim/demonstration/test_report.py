"""The HTML report, from synthetic arrays."""

from __future__ import annotations

import base64
import dataclasses
import io
import re

import matplotlib.image
import numpy as np
import pytest

from stereoservo_sim.demonstration.results import (
    CalibrationPlots,
    GoalPlots,
    ReportData,
    draw_errors,
    draw_paths,
    draw_residuals,
    draw_velocities,
    render_report,
    write_report,
)

JOINTS = tuple(f"j{i + 1}" for i in range(6))


def goal(name="turned", law="cartesian3", gain=1.5):
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 8.0, 0.02)
    decay = np.exp(-1.5 * t)
    error = 140 * decay + 0.03 * np.abs(rng.normal(size=t.size))
    error[50:55] = np.nan  # the markers were hidden for a moment
    velocities = rng.uniform(-0.8, 0.8, 6) * decay[:, None]
    line = np.array([[0.1, -0.2, 1.2], [0.35, 0.05, 1.0]])
    way = (1 - decay)[:, None]
    path = line[0] + way * (line[1] - line[0]) + 0.003 * np.sin(np.pi * way) * np.array([0.6, -0.6, 0.0])
    corners = np.array([[0, 0], [60, 5], [55, 50], [-5, 45]])
    track = np.array([200.0, 150.0]) + way[:, :, None] * np.array([180.0, 90.0]) + corners
    return GoalPlots(
        name, law, "reached", t, error, velocities, path, line, 0.021, 0.034, 2.5, 97.3, 408.0, 400, 8.0,
        gain, {"left": track, "right": track + np.array([-40.0, 12.0])},
    )  # fmt: skip


def calibration():
    rng = np.random.default_rng(5)
    stops, markers = 48, 7
    joint = np.repeat(np.arange(6), 8)
    angle = np.linspace(-0.5, 0.5, 8)[np.arange(stops) % 8]
    centre = np.array([[180.0, 60.0], [320, 80], [300, 90], [330, 240], [250, 260], [320, 250]])[joint]
    marker = 25 * np.column_stack([np.cos(np.arange(markers)), np.sin(np.arange(markers) * 1.7)])
    turned = np.stack([np.cos(angle + 1.2), np.sin(angle + 1.2)], axis=1) * 120
    left = centre[:, None] + turned[:, None] + marker
    pixels = np.stack([left, left + np.array([30.0, -14.0])])
    residuals = rng.normal(0, 0.015, pixels.shape)
    pixels[1, 3, 2] = residuals[1, 3, 2] = np.nan
    return CalibrationPlots(
        ("left", "right"), JOINTS, np.array([[640, 480], [640, 480]]), joint, pixels, residuals,
        0.0151, 96, 21.4, 0.015, {"χ² / degrees of freedom": "1312 / 1290"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def data():
    goals = (goal("near", "stereo", None), goal(), goal("rolled"))
    return ReportData(
        "stereoservo demo",
        JOINTS,
        calibration(),
        goals,
        tolerance_px=0.3,
        velocity_limits=np.ones(6),
        summary="Three goals <shown> & reached.",
        facts={"seed": "7", "loop": "250 Hz, 0 overruns"},
    )


def pictures(text):
    return [base64.b64decode(part) for part in re.findall(r"data:image/png;base64,([A-Za-z0-9+/=]+)", text)]


def ink(png):
    """Share of pixels that are not white."""
    image = matplotlib.image.imread(io.BytesIO(png))
    return float((image[..., :3] < 0.9).any(axis=2).mean())


def test_one_file_holds_every_picture_and_number(data, tmp_path):
    path = write_report(data, tmp_path / "deep" / "report.html")
    text = path.read_text(encoding="utf-8")
    drawn = pictures(text)
    assert len(drawn) == 6
    assert all(ink(png) > 0.01 for png in drawn)
    assert not re.search(r'(src|href)="(?!data:)', text)
    for value in (
        "near",
        "turned",
        "97.3",
        "0.021",
        "2.50",
        "0.0151 px",
        "1312 / 1290",
        "250 Hz, 0 overruns",
    ):
        assert value in text
    assert "Three goals &lt;shown&gt; &amp; reached." in text
    assert "<shown>" not in text


def test_the_same_data_gives_the_same_file(data):
    short = dataclasses.replace(data, goals=data.goals[:1], calibration=None)
    assert render_report(short) == render_report(short)


def test_parts_that_are_absent_are_left_out(data):
    text = render_report(dataclasses.replace(data, goals=data.goals[:1], calibration=None, facts={}))
    assert "Self-calibration" not in text
    assert "<h2>Session</h2>" not in text
    assert len(pictures(text)) == 4
    text = render_report(dataclasses.replace(data, goals=()))
    assert "<h2>Goals</h2>" not in text
    assert len(pictures(text)) == 2


def test_error_axis_is_logarithmic_and_shows_what_the_data_say(data):
    figure = draw_errors(data.goals, 0.3)
    assert [axis.get_yscale() for axis in figure.axes] == ["log"] * 3
    line = figure.axes[1].lines[0]
    np.testing.assert_array_equal(line.get_xdata(), data.goals[1].times_s)
    np.testing.assert_allclose(line.get_ydata(), np.maximum(data.goals[1].error_px, 1e-4))
    promised = figure.axes[1].lines[1].get_ydata()
    assert promised[100] == pytest.approx(data.goals[1].error_px[0] * np.exp(-1.5 * 2.0))


def test_velocities_and_path_are_those_given(data):
    figure = draw_velocities(data.goals, JOINTS, np.ones(6))
    for axis, shown in zip(figure.axes, data.goals, strict=True):
        for j in range(6):
            np.testing.assert_array_equal(axis.lines[j].get_ydata(), shown.velocities[:, j])
    figure = draw_paths(data.goals)
    distance = figure.axes[2].lines[0].get_ydata()
    assert distance.max() == pytest.approx(1e3 * 0.003 * np.sqrt(0.72), rel=1e-3)  # across the line: (0.6, −0.6, 0)


def test_residual_histograms_count_every_finite_residual(data):
    figure = draw_residuals(data.calibration)
    assert len(figure.axes) == 12
    counted = sum(patch.get_height() for axis in figure.axes for patch in axis.patches)
    assert counted == np.isfinite(data.calibration.residuals).sum()


def test_a_shape_that_does_not_fit_is_named(data):
    short = dataclasses.replace(data.goals[0], velocities=data.goals[0].velocities[:, :5])
    with pytest.raises(ValueError, match=r"velocities of goal 'near' has shape \(400, 5\); \(400, 6\)"):
        render_report(dataclasses.replace(data, goals=(short,)))
    cut = dataclasses.replace(data.calibration, residuals=data.calibration.residuals[:, 1:])
    with pytest.raises(ValueError, match="residuals of the calibration"):
        render_report(dataclasses.replace(data, calibration=cut))


def test_a_goal_that_was_never_measured_is_drawn_empty(data):
    empty = dataclasses.replace(
        data.goals[0],
        outcome="aborted: no markers",
        error_px=np.full(400, np.nan),
        path_m=np.zeros((0, 3)),
        tracks={},
    )
    text = render_report(dataclasses.replace(data, goals=(empty,), calibration=None))
    assert "aborted: no markers" in text
    assert len(pictures(text)) == 3
