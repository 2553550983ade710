"""A Euclidean cell as independent truth: `stereoservo_sim.world.synthetic`."""

import pytest

from stereoservo_sim.world import synthetic

ARMS = {
    "rx90": synthetic.rx90,
    "gantry": synthetic.gantry,
    "scara": synthetic.scara,
    "mixed": synthetic.mixed,
    "parallel": synthetic.parallel,
    "offset_wrist": synthetic.offset_wrist,
    "seven": synthetic.seven,
    "gantry_with_wrist": synthetic.gantry_with_wrist,
    "pan_tilt": synthetic.pan_tilt,
}


@pytest.fixture(scope="session")
def arms():
    """Makers of cells by name."""
    return ARMS


@pytest.fixture(scope="session")
def plate():
    """Four dots of a plane."""
    return synthetic.flat_plate()
