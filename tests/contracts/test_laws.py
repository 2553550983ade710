"""The shipped laws keep the contract of laws."""

from __future__ import annotations

import pytest

from stereoservo.control.contracts import LawContract
from stereoservo.control.law import Law
from stereoservo.control.law_registry import LAWS


class TestShippedLaws(LawContract):
    @pytest.fixture(autouse=True, params=list(LAWS))
    def _law(self, request: pytest.FixtureRequest) -> Law:
        self.law = LAWS[request.param]
        return self.law
