"""A camera that sees no marker because of its light says so once, with value, limit and what to do."""

import numpy as np

from stereoservo.daemon.vision import LightWatch, judge_light

GOOD = np.tile(np.linspace(5, 200, 640).astype(np.uint8), (480, 1))


def test_dark_and_bright_pictures_are_told_apart_from_good_ones():
    assert judge_light(GOOD) is None
    code, text = judge_light((0.08 * GOOD).astype(np.uint8))
    assert code == "camera_dark"
    assert "15 grey levels" in text
    assert "30 are needed" in text
    assert "more light" in text
    code, text = judge_light(np.where(GOOD > 100, 255, GOOD).astype(np.uint8))
    assert code == "camera_glare"
    assert "51 %" in text
    assert judge_light(np.full((480, 640), 180, np.uint8)) is None  # a white wall is not dark


def test_it_is_told_once_and_taken_back_once():
    watch, dark = LightWatch(), (0.05 * GOOD).astype(np.uint8)
    told = [watch.see(dark, 0, round(k * 1e8)) for k in range(40)]
    assert [k for k, one in enumerate(told) if one is not None] == [10]
    assert told[10][0] == "camera_dark"
    assert watch.see(GOOD, 7, round(41e8)) == ("camera_light", "sees markers again")
    assert watch.see(GOOD, 7, round(42e8)) is None
    # out of view in good light: nothing is said
    assert all(watch.see(GOOD, 0, round((43 + k) * 1e8)) is None for k in range(40))
