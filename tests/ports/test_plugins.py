"""Plug-ins by entry point: a broken one is listed, and only its own load fails."""

import sys
from pathlib import Path

import pytest

from stereoservo.ports import plugins


@pytest.fixture
def third_party(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed distribution with a good, a broken and a missing driver."""
    info = tmp_path / "acme_drivers-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-drivers\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(
        "[stereoservo.joint_drivers]\nacme = acme_good:Driver\nacme-broken = "
        "acme_broken:Driver\nacme-gone = acme_good:Nothing\n"
    )
    (tmp_path / "acme_good.py").write_text("class Driver: ...\n")
    (tmp_path / "acme_broken.py").write_text("raise RuntimeError('no such firmware')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("acme_good", "acme_broken"):
        monkeypatch.delitem(sys.modules, name, raising=False)


@pytest.mark.usefixtures("third_party")
def test_a_broken_plugin_is_listed_with_its_error_beside_the_good_ones() -> None:
    found = {plugin.name: plugin for plugin in plugins.list_plugins(plugins.JOINT_DRIVERS, check=True)}
    assert found["acme"].error == ""
    assert found["acme"].distribution == "acme-drivers 1.2"
    assert found["acme-broken"].error == "RuntimeError: no such firmware"
    assert "Nothing" in found["acme-gone"].error
    assert found["fake"].error == ""


@pytest.mark.usefixtures("third_party")
def test_listing_names_imports_nothing() -> None:
    assert "acme-broken" in plugins.names(plugins.JOINT_DRIVERS)
    plugins.list_plugins(plugins.JOINT_DRIVERS)
    assert "acme_good" not in sys.modules


@pytest.mark.usefixtures("third_party")
def test_loading_a_broken_or_unknown_one_says_why_and_what_there_is() -> None:
    assert plugins.load(plugins.JOINT_DRIVERS, "acme").__name__ == "Driver"
    with pytest.raises(plugins.PluginError, match=r"does not import: RuntimeError: no such firmware"):
        plugins.load(plugins.JOINT_DRIVERS, "acme-broken")
    with pytest.raises(plugins.PluginError, match=r"no joint driver 'kuka'; there are: .*acme.*fake") as caught:
        plugins.load(plugins.JOINT_DRIVERS, "kuka")
    assert "fake" in caught.value.known
