"""What is refused before a cell runs."""

from pathlib import Path

import msgspec
import pytest

from stereoservo.daemon import cell_preparation
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.ports import plugins
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.fake import FakeJointDriver
from stereoservo_sim.cells import shipped_cell_path


class OnlyDeclared:
    """Tells of a gripper, and has no way to order it anywhere."""

    def __init__(self, options, context):
        self.inner = FakeJointDriver({}, context)

    def describe(self):
        gripper = AuxiliarySpec("gripper", "prismatic", 0.0, 0.08, 0.1)
        return msgspec.structs.replace(self.inner.describe(), auxiliary=(gripper,))


def test_auxiliary_joints_that_nobody_can_order_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load = plugins.load
    monkeypatch.setattr(
        cell_preparation.plugins,
        "load",
        lambda group, name: OnlyDeclared if group == plugins.JOINT_DRIVERS else load(group, name),
    )
    path = shipped_cell_path("demo")
    with pytest.raises(DriverError, match=r"gripper.*write_auxiliary") as caught:
        cell_preparation.describe_cell(load_cell_file(path), path, tmp_path, VirtualClock())
    assert caught.value.code == "auxiliary"
