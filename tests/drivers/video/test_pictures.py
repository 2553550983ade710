"""JPEG data that are whole, and others."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo_drivers.video.pictures import one_channel, picture_size

IMAGE = np.random.default_rng(6).integers(0, 256, (48, 64, 3), np.uint8)
SETTINGS = {
    "gray": (IMAGE[:, :, 0], []),
    "colour": (IMAGE, []),
    "progressive": (IMAGE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    "restarts": (IMAGE, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
    "optimized": (IMAGE, [cv2.IMWRITE_JPEG_OPTIMIZE, 1]),
}
ENCODED = {name: cv2.imencode(".jpg", image, settings)[1].tobytes() for name, (image, settings) in SETTINGS.items()}


@pytest.mark.parametrize("name", ENCODED)
def test_whole_pictures_tell_their_size(name):
    assert picture_size(ENCODED[name]) == (64, 48)


@pytest.mark.parametrize("padding", [b"\0\0\0", b"\r\n", b"\xff\xff", b"vendor's own data"])
def test_what_stands_behind_the_end_does_not_matter(padding):
    assert picture_size(ENCODED["colour"] + padding) == (64, 48)


@pytest.mark.parametrize("name", ENCODED)
@given(data=st.data())
def test_no_cut_picture_passes(name, data):
    whole = ENCODED[name]
    assert picture_size(whole[: data.draw(st.integers(0, len(whole) - 2))]) is None


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_picture():
    whole, thumbnail = ENCODED["colour"], ENCODED["gray"]
    exif = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    both = whole[:2] + exif + whole[2:]
    assert picture_size(both) == (64, 48)
    assert picture_size(both[:-2]) is None


@given(st.binary(max_size=200))
def test_other_data_are_no_picture(data):
    assert picture_size(data) is None
    assert picture_size(b"\xff\xd8" + data) is None or b"\xff\xd9" in data


def test_a_gray_picture_in_three_channels_comes_back_bit_for_bit():
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    assert np.array_equal(one_channel(cv2.merge([image] * 3), "gray", "none"), image)
