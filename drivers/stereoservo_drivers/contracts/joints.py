"""Contract tests of joint drivers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from stereoservo_drivers.kit.bench import JointDriverSetup
from stereoservo_drivers.kit.joint_checks import JOINT_CHECKS, JointCheck, run_check


class JointDriverContract(JointDriverSetup):
    """Base class of the tests: subclass under pytest and override :meth:`make_driver`.

    The suite moves the arm: slowly (``speed`` of each joint's largest velocity) and for fractions of a
    second. Clear the machine's surroundings before you run it on hardware.
    """

    @pytest.mark.parametrize("check", [pytest.param(check, id=check.name) for check in JOINT_CHECKS])
    def test_joint_driver(
        self, check: JointCheck, tmp_path: Path, record_property: Callable[[str, object], None]
    ) -> None:
        result = run_check(check, self, tmp_path)
        record_property(check.name, result.measured)
        if result.verdict == "not run":
            pytest.skip(result.measured)
        assert result.verdict == "passed", f"{result.measured}; {result.remedy}"
