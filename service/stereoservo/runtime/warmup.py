"""Compiles the kernels of the loop into numba's cache, so that a process that starts later finds them compiled."""

from __future__ import annotations

import numpy as np

from stereoservo.runtime.core import ServoCore
from stereoservo.runtime.cycle import StepInputs
from stereoservo.runtime.ports import JointState
from stereoservo.runtime.settings import CoreSettings


def warm_up(settings: CoreSettings) -> None:
    """Run some steps of a core that drives nothing."""
    core = ServoCore(settings)
    period_ns = round(1e9 / settings.rate_hz)
    rest = np.zeros(len(settings.joint_names))
    middle = 0.5 * (settings.limits.position_min + settings.limits.position_max)
    for k in range(1, 4):
        now_ns = 1_000_000_000 + k * period_ns
        core.step(StepInputs(now_ns, period_ns, JointState(k, now_ns, middle, rest), driver_active=True))
