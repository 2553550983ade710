"""The model of a cell: what self-calibration learns and the core works with; one versioned file."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

MODEL_SCHEMA = 1

Stratum = Literal["projective", "affine", "metric"]


class CameraModel(msgspec.Struct, frozen=True, eq=False):
    """A camera in the model's projective frame: ``matrix`` (3, 4) maps points to pixels; image size [px]."""

    name: str
    matrix: FloatArray
    width: int
    height: int


class JointStatistics(msgspec.Struct, frozen=True):
    """How well one joint's trial motion fits: residual rms [px], number of stops, range driven [rad or m]."""

    name: str
    rms_px: float
    stops: int
    range: float


class FitStatistics(msgspec.Struct, frozen=True, eq=False):
    """Statistics of the final least-squares fit.

    ``chi2`` is the sum of squared residuals in sigmas, with ``degrees_of_freedom`` = measurements - parameters net of
    gauge; ``chi2_ok``: inside the two-sided 99.9 % interval.
    """

    rms_px: float
    chi2: float
    degrees_of_freedom: int
    chi2_ok: bool
    measurements: int
    parameters: int
    outliers: int
    joints: tuple[JointStatistics, ...]
    images: int


class CellModel(msgspec.Struct, frozen=True, eq=False):
    """Projective kinematics, cameras and markers in one projective frame.

    ``generators`` (n, 4, 4): joint operators at ``zero`` (n,), revolute ones with eigenvalues (0, 0, i, -i), prismatic
    ones nilpotent (5.18). ``marker_points`` (m, 4): markers at the zero, orbital heights such that
    ``plane_at_infinity @ M == 1``. ``projective_to_euclidean`` (4, 4): H_PE up to one global scale, where the stratum is
    ``metric``. ``epoch`` is unique for each model a cell ever had.
    """

    schema: int
    epoch: int
    joint_names: tuple[str, ...]
    joint_kinds: tuple[Literal["revolute", "prismatic"], ...]
    zero: FloatArray
    generators: FloatArray
    cameras: tuple[CameraModel, ...]
    marker_ids: tuple[int, ...]
    marker_points: FloatArray
    plane_at_infinity: FloatArray
    stratum: Stratum
    projective_to_euclidean: FloatArray | None
    statistics: FitStatistics | None
    created: str = ""
    source: str = ""
