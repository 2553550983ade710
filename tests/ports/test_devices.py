"""Descriptions of devices as third parties write them."""

import numpy as np

from stereoservo.ports.devices import JointSpec


def test_limits_out_of_an_array_are_plain_floats():
    joint = JointSpec("a", "revolute", *np.array([-1.5, 1.5, 2.0, 8.0, 1e-3]))
    told = (
        joint.position_min,
        joint.position_max,
        joint.velocity_max,
        joint.acceleration_max,
        joint.resolution,
    )
    assert [type(value) for value in told] == [float] * 5
    assert told == (-1.5, 1.5, 2.0, 8.0, 1e-3)
