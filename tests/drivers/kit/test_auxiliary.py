"""Auxiliary joints as a cell file declares them."""

from __future__ import annotations

import pytest

from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.kit.auxiliary import AuxiliaryMotion


@pytest.mark.parametrize(
    ("specs", "words"),
    [
        ((AuxiliarySpec("g", "prismatic", 0.1, 0.0, 0.1),), "low below high"),
        ((AuxiliarySpec("g", "prismatic"),), "velocity above 0"),
        ((AuxiliarySpec("g", "prismatic", 0.0, float("nan"), 0.1),), "low below high"),
        ((AuxiliarySpec("g", "digital"), AuxiliarySpec("g", "digital")), "2 times"),
    ],
)
def test_auxiliary_joints_that_cannot_be_are_refused(specs: tuple[AuxiliarySpec, ...], words: str) -> None:
    with pytest.raises(DriverError, match=words) as refusal:
        AuxiliaryMotion(specs)
    assert refusal.value.code == "options"
