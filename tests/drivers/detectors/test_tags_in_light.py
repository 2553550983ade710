"""Tags where white is cut off, and where light is uneven over them: corners stay, and how sure of them the fit is."""

import pytest

from stereoservo_sim.experiments.changing_light import detector_row


@pytest.mark.parametrize(
    ("light", "rms_px", "chi2"),
    [
        ("clipped white, x 1.6", 0.03, 3.0),
        ("exposure ±50 %", 0.03, 1.6),
        ("soft shadow, 70 %", 0.15, 4.0),
        ("all of it", 0.1, 7.0),
    ],
)
def test_corners_hold_in_light_that_is_not_even(light, rms_px, chi2):
    row = detector_row("aruco", light, 3)
    print(row)
    assert row["found"] > 0.95 * row["shown"]
    assert row["wrong"] == 0
    assert row["rms_px"] < rms_px
    assert 0.5 < row["chi2_per_freedom"] < chi2


@pytest.mark.parametrize("light", ["steady", "clipped white, x 1.6", "flicker 30 %, 100 Hz bands", "all of it"])
def test_dots_hold_in_light_that_changes(light):
    row = detector_row("dots", light, 3)
    print(row)
    assert row["found"] == row["shown"]
    assert row["rms_px"] < 0.05
    assert 0.4 < row["chi2_per_freedom"] < 1.6


def test_nothing_is_reported_in_the_dark():
    rows = [detector_row(name, "dark, x 0.08", 3) for name in ("dots", "aruco", "corners")]
    assert [(row["found"], row["wrong"]) for row in rows] == [(0, 0)] * 3
