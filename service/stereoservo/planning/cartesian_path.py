"""Cartesian path of a body: displacement (4, 4) at a path parameter in [0, 1], composed of the translation, hinge and
planar rotation of a given decomposition, each with its own profile (thesis 7.4.3).

``H_c(σ) = exp(μ_t τ Ĥ_t) exp(μ_r θ_r Ĥ_r) exp(μ_p θ_p Ĥ_p)``: the translation is leftmost, so no rotation changes its
line; the hinge is second, so the planar rotation does not change the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

from stereoservo.geometry.displacements import exp_rotation, exp_translation
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.motion_frame import progress
from stereoservo.planning.path_search import shapes
from stereoservo.planning.plan import Profile
from stereoservo.planning.three_point_decomposition import ComponentStatus, Decomposition


class IncompleteDecompositionError(ValueError):
    """The arm cannot make a component of the path. ``component``: translation, hinge or planar."""

    def __init__(self, component: str, detail: str) -> None:
        super().__init__(f"the {component} of the way is missing: {detail}")
        self.component = component


@dataclass(frozen=True, eq=False)
class CartesianPath:
    """A Cartesian path: the ``decomposition`` of the whole displacement, with the ``profile`` of its components."""

    decomposition: Decomposition
    profile: Profile = "linear"

    def amounts(self, sigma: float) -> tuple[float, float, float]:
        """``τ(σ), θ_r(σ), θ_p(σ)`` (7.26)."""
        tau, theta_r, theta_p = (
            whole * progress(shape, sigma)
            for whole, shape in zip(self._whole(), shapes(self.profile, self._whole()), strict=True)
        )
        return tau, theta_r, theta_p

    def displacement(self, sigma: float) -> FloatArray:
        """``H_c(σ)`` (4, 4), σ in [0, 1] (7.25)."""
        d = self.decomposition
        tau, theta_r, theta_p = self.amounts(sigma)
        H: FloatArray = (
            exp_translation(d.translation.operator, tau)
            @ exp_rotation(d.hinge.operator, theta_r)
            @ exp_rotation(d.planar.operator, theta_p)
        )
        return H

    def _whole(self) -> tuple[float, float, float]:
        d = self.decomposition
        return d.translation.amount, d.hinge.amount, d.planar.amount


def cartesian_path(decomposition: Decomposition, profile: Profile = "linear") -> CartesianPath:
    """The Cartesian path of a decomposition with a profile. Raises IncompleteDecompositionError."""
    for name in ("translation", "hinge", "planar"):
        component = getattr(decomposition, name)
        if component.status == ComponentStatus.NOT_REACHABLE:
            raise IncompleteDecompositionError(name, component.detail)
    return CartesianPath(decomposition, profile)
