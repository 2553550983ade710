"""Task files for the tests: the hard ones that are shipped, and others of the public file's kind, drawn here."""

from __future__ import annotations

import pytest

from stereoservo_sim.tasks.calibrations import calibrate
from stereoservo_sim.tasks.random_tasks import random_tasks


@pytest.fixture(scope="session")
def public_kind():
    """50 tasks of the public file's kind."""
    return random_tasks(11, 50)


@pytest.fixture(scope="session")
def learnt():
    """The free arm, self-calibrated at 0.1 px."""
    return calibrate("free", "self", 0.1, 0)


@pytest.fixture(scope="session")
def drawn():
    """Draws tasks of the public file's kind: ``drawn(seed, count)``."""
    return random_tasks
