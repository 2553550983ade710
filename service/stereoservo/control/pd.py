"""PD control and tracking (thesis 9.3): the damping term of a law's joint velocity, and the largest stable gain.

The features shall move at ``ṡ = ṡ* − λ(s − s*) − κ(ṡ_measured − ṡ*)``. With ``ṡ = J q̇`` and a Jacobian of full rank
this is, for every measure of the law's error, its joint velocity and

    q̇ = q̇_law + κ(q̇* − q̇_measured),

where ``q̇*`` moves the features at the velocity of their set-points. So every law takes the term (`damped_velocity`),
from the joints' own readings, without a filter of the features' velocities.

Benefit: with drives that follow their velocity with a lag T [s] and a target ``s*`` of angular frequency ω, the
transfer functions from ``s*`` to the error are, at ``p = iω``,

    P alone:                    (T p² + p) / (T p² + p + λ)
    feed-forward:               T p²       / (T p² + p + λ)
    feed-forward and damping:   T p²       / (T p² + (1 + κ) p + λ)

Damping multiplies the damping ratio ``1 / (2 √(λT))`` of the loop by ``1 + κ``, so that a higher gain may be used; an
error without overshoot decays at ``λ / (1 + κ)``. Drives with a delay τ have ``p + (λ + κp) e^{−pτ}`` in the
denominator instead, which is stable up to a gain of `largest_gain`, at most a sixth more than without damping.
"""

from __future__ import annotations

import math

from stereoservo.numerics.arrays import FloatArray

GAIN_MARGIN = 2.0
"""Required gain margin of a goal with damping: its gain times this must be stable."""


def damped_velocity(
    velocity: FloatArray, feed_forward: FloatArray | float, measured: FloatArray, damping: float
) -> FloatArray:
    """``velocity`` (n,) [rad/s or m/s] of a law, including feed-forward, with the damping term of κ = ``damping``.

    ``feed_forward`` (n,): joint velocity that moves the body with its set-points, 0 if they are static.
    ``measured`` (n,): joint velocity.
    """
    damped: FloatArray = velocity + damping * (feed_forward - measured)
    return damped


def largest_gain(damping: float, late_s: float) -> float:
    """The gain [1/s] at which a loop of drives with a delay ``late_s`` > 0 starts to oscillate: on the imaginary axis
    ``p = iω`` of the denominator, ``ω = λ / √(1 − κ²)`` and ``ωτ = π/2 + asin κ``.

    ``damping`` κ in [0, 1): with 1 and more no gain is stable.
    """
    return math.sqrt(1.0 - damping**2) * (0.5 * math.pi + math.asin(damping)) / late_s
