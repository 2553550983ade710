"""The structure of the code: its figures stay within their limits (`house_figures.py` prints all)."""

import importlib.util
import sys
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("house_figures", Path(__file__).with_name("house_figures.py"))
house = importlib.util.module_from_spec(_spec)
sys.modules["house_figures"] = house
_spec.loader.exec_module(house)


def test_modules_do_not_import_each_other_in_circles():
    assert house.circle_figure().items == ()


def test_modules_are_not_longer_than_the_limit():
    assert house.module_figure().items == ()


def test_no_folder_is_beyond_its_limit():
    assert house.folder_figure().items == ()


def test_no_function_is_beyond_its_limit():
    assert house.function_figure().items == ()


def test_kernels_have_few_arguments():
    """Those of the core that have more only become fewer: whoever takes one away lowers `CORE_KERNELS`."""
    core, elsewhere = house.argument_figures()
    assert elsewhere.items == ()
    assert core.value == house.CORE_KERNELS, core.items


def test_arguments_of_every_kind_of_kernel_are_counted(tmp_path, monkeypatch):
    module = tmp_path / "service/stereoservo/module.py"
    module.parent.mkdir(parents=True)
    seven = ", ".join("abcdefg")
    module.write_text(
        f"@kernel\ndef few(a, b, c, d, e, f): ...\n@reassociating_kernel\ndef many({seven}): ...\n"
        f"@kernel\ndef by_name(a, b, c, d, *, e, f, g): ...\ndef no_kernel({seven}): ...\n"
    )
    monkeypatch.setattr(house, "ROOT", tmp_path)
    monkeypatch.setattr(house, "PRODUCT", (module.parent,))
    assert house.kernel_arguments() == {"service/stereoservo/module.py": ["many 7", "by_name 7"]}


@pytest.mark.parametrize("law", house.LAWS)
def test_a_servo_step_enters_few_files(law):
    steady, accepting = house.servo_paths(law)
    assert len(steady.files) <= house.STEADY_FILES, sorted(steady.files)
    assert steady.hops <= house.STEADY_HOPS
    assert len(accepting.files) <= house.ACCEPTING_FILES, sorted(accepting.files)


def test_a_path_counts_files_and_hops():
    from stereoservo.core.ingest import nominal_period_ns
    from stereoservo.messages.reasons import Reason

    path = house.traced(lambda: Reason("A", "info"))
    assert path == (frozenset(), 0)

    class Settings:
        rate_hz = 250.0

    path = house.traced(lambda: nominal_period_ns(Settings()))
    assert path == (frozenset({"service/stereoservo/core/ingest.py"}), 0)
