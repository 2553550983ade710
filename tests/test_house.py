"""The structure of the code: what has reached its limit stays within it, and no figure grows (`house_figures.py`)."""

import importlib.util
import sys
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("house_figures", Path(__file__).with_name("house_figures.py"))
house = importlib.util.module_from_spec(_spec)
sys.modules["house_figures"] = house
_spec.loader.exec_module(house)

REACHED = {"stereo": (20, 57), "cartesian3": (20, 58)}
"""Files and hops of a steady step as they are; the limits to reach are those of `house_figures`."""
REACHED_ACCEPTING = 37


def test_modules_do_not_import_each_other_in_circles():
    assert house.circle_figure().items == ()


def test_modules_are_not_longer_than_the_limit():
    assert house.module_figure().items == ()


def test_no_folder_or_function_of_the_core_is_beyond_its_limit():
    items = [*house.folder_figure().items, *house.function_figure().items]
    assert [item for item in items if "stereoservo/core" in item] == []


@pytest.mark.parametrize("law", house.LAWS)
def test_a_servo_step_enters_no_more_files_than_it_did(law):
    steady, accepting = house.servo_paths(law)
    assert len(steady.files) <= REACHED[law][0], sorted(steady.files)
    assert steady.hops <= REACHED[law][1]
    assert len(accepting.files) <= REACHED_ACCEPTING, sorted(accepting.files)


def test_a_path_counts_files_and_hops():
    from stereoservo.core.ingest import nominal_period_ns
    from stereoservo.messages.reasons import Reason

    path = house.traced(lambda: Reason("A", "info"))
    assert path == (frozenset(), 0)

    class Settings:
        rate_hz = 250.0

    path = house.traced(lambda: nominal_period_ns(Settings()))
    assert path == (frozenset({"service/stereoservo/core/ingest.py"}), 0)
