"""PD tracking of moving set-points (thesis 9.3): the damping term that is added to the feature rates of a control
law's task, feature rates from measured joint velocities, and the expected tracking error.

The features shall move at ``ṡ = ṡ* − λ(s − s*) − κ(ṡ_measured − ṡ*)``. A law that drives ``ṡ = rates − λ(s − s*)``
needs no change: the damping goes into its rates (`damped_rates`).

What is to be gained: with drives that follow their velocity with a lag T [s] and a target ``s*`` of angular frequency
ω, the transfer functions from ``s*`` to the error are, at ``p = iω``,

    P alone:                    (T p² + p) / (T p² + p + λ)
    feed-forward:               T p²       / (T p² + p + λ)
    feed-forward and damping:   T p²       / (T p² + (1 + κ) p + λ)

(`tracking_error`). Feed-forward takes the error from first to second order in ω; damping multiplies the damping ratio
``1 / (2 √(λT))`` of the loop by ``1 + κ``, so that a higher gain may be used. The measured velocity is at least a step
old: for drives without lag the loop is ``ṡ_{k+1} = … − κ ṡ_k``, stable for ``κ < 1`` only, and larger ones are refused.
"""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import Task
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel


def pd_task(task: Task, measured_rates: FloatArray, measured: FloatArray, damping: float) -> Task:
    """``task`` with the damping term in its rates: what a law that feeds rates forward is given for PD tracking.

    ``measured_rates`` (c, m, 2) [px/s]: velocity of the features, from `control.filters` or the joints' velocities
    (`joint_feature_rates`), where ``measured`` (c, m) is not 0. ``damping`` κ in [0, 1). Raises ValueError outside.
    """
    check_damping(damping)
    return task._replace(rates=damped_rates(task.rates, measured_rates, measured, damping))


def check_damping(damping: float) -> None:
    """Raises ValueError where ``damping`` is outside [0, 1)."""
    if not 0.0 <= damping < 1.0:
        raise ValueError(
            f"damping is {damping}; at least 0 and below 1 is stable with a velocity one step old"
        )


@kernel
def damped_rates(
    rates: FloatArray, measured_rates: FloatArray, measured: FloatArray, damping: float
) -> FloatArray:
    """``ṡ* − κ(ṡ_measured − ṡ*)`` (c, m, 2) [px/s]; ``ṡ*`` alone where ``measured`` (c, m) is 0 or no number came."""
    out = rates.copy()
    cameras, markers = rates.shape[0], rates.shape[1]
    for c in range(cameras):
        for p in range(markers):
            if not measured[c, p] > 0.0:
                continue
            du = measured_rates[c, p, 0] - rates[c, p, 0]
            dv = measured_rates[c, p, 1] - rates[c, p, 1]
            if np.isfinite(du) and np.isfinite(dv):
                out[c, p, 0] -= damping * du
                out[c, p, 1] -= damping * dv
    return out


@kernel
def joint_feature_rates(jacobian: FloatArray, velocity: FloatArray) -> FloatArray:
    """``ṡ = J q̇`` (c, m, 2) [px/s] of measured joint velocities (n,): as the model sees it, without a filter's delay.

    ``jacobian`` (c, m, 2, n) as `kinematics.kernels.image_jacobian` gives it.
    """
    cameras, markers, _, n = jacobian.shape
    out = np.zeros((cameras, markers, 2))
    for c in range(cameras):
        for p in range(markers):
            for r in range(2):
                for j in range(n):
                    out[c, p, r] += jacobian[c, p, r, j] * velocity[j]
    return out


def tracking_error(
    omega: float, gain: float, lag_s: float, damping: float = 0.0, feed_forward: bool = True
) -> float:
    """Amplitude of the tracking error, relative to that of a target in sinusoidal motion, in the steady state.

    ``omega`` [rad/s], ``gain`` [1/s], ``lag_s`` of the drives [s]; see the head of this file.
    """
    p = 1j * omega
    characteristic = lag_s * p**2 + (1.0 + damping) * p + gain
    left = lag_s * p**2 + (0.0 if feed_forward else p * (1.0 + damping))
    return float(abs(left / characteristic))
