"""A third party's detector, found by entry point: the example of docs/cameras.md, as it stands there."""

import re
import sys
from pathlib import Path

import numpy as np

from stereoservo.ports import plugins
from stereoservo.ports.devices import Detector, DriverContext

from .scenes import Still, as_frame

PAGE = Path(__file__).parents[3] / "docs" / "cameras.md"


def test_the_documented_detector_is_found_and_detects(tmp_path, monkeypatch):
    text = PAGE.read_text()
    code = next(block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "class Brightest" in block)
    entry = re.search(r"^    (\[project.*stereoservo\.detectors.*)\n    (brightest = .*)$", text, re.MULTILINE)
    name, target = (part.strip() for part in entry[2].replace('"', "").split("="))
    module = target.partition(":")[0]
    info = tmp_path / "acme_markers-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-markers\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[stereoservo.detectors]\n{name} = {target}\n")
    (tmp_path / f"{module}.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, module, raising=False)

    found = {plugin.name: plugin for plugin in plugins.list_plugins(plugins.DETECTORS, check=True)}
    assert found[name].error == ""
    assert {"aruco", "dots"} <= set(found)
    context = DriverContext(clock=Still(), cell="c", runtime_dir=tmp_path, cell_dir=tmp_path, camera="left")
    detector = plugins.load(plugins.DETECTORS, name)({"level": 100}, context)
    assert isinstance(detector, Detector)
    image = np.zeros((48, 64), np.uint8)
    assert detector.detect(as_frame(image), None).ids.tolist() == []
    image[20, 30] = 250
    observation = detector.detect(as_frame(image), None)
    assert (observation.ids.tolist(), observation.pixels.tolist()) == ([0], [[30.0, 20.0]])
    monkeypatch.delitem(sys.modules, module)
