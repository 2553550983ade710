"""Ways of a body in closed form: which pose it has at a share σ of the way (7.25), a bent centre line included.

A way is a row of 17 numbers in the coordinates of a `motion_frame`, whose origin is the centre: ``hinge`` axis (3) and
angle, ``planar`` axis (3) and angle [rad], ``displacement`` of the centre (3), ``bend`` (3), the shapes of the three
components. The centre goes ``μ_t(σ) displacement + 4σ(1 − σ) bend``; the body turns about it by
``exp(μ_r θ_r) exp(μ_p θ_p)``.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel
from stereoservo.trajectory.motion_frame import turn
from stereoservo.trajectory.profiles import progress

NUMBERS = 17


@kernel
def pose_on_way(way: FloatArray, share: float) -> FloatArray:
    """Displacement (4, 4) from the present pose, in the motion frame."""
    R_r = turn(way[0:3], way[3] * progress(way[15], share))
    R_p = turn(way[4:7], way[7] * progress(way[16], share))
    along, aside = progress(way[14], share), 4.0 * share * (1.0 - share)
    H = np.zeros((4, 4))
    H[3, 3] = 1.0
    for i in range(3):
        H[i, 3] = along * way[8 + i] + aside * way[11 + i]
        for k in range(3):
            H[i, k] = R_r[i, 0] * R_p[0, k] + R_r[i, 1] * R_p[1, k] + R_r[i, 2] * R_p[2, k]
    return H
