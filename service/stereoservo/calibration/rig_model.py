"""Parametric model of a cell that a calibration estimates (joint generators, cameras, lenses, markers, in any
stratum), its predicted pixels and residuals, and changes of its frame (thesis 5.53, 5.55 to 5.57).

Noise is that of raw (distorted) pixels; joint readings are exact unless `JointNoise` states otherwise. Parameters are
coordinates of the minimal charts of :mod:`stereoservo.kinematics.parameterization`, so that the Jacobian has full rank
if the data determine the model.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.geometry.distortion import distort, has_distortion
from stereoservo.kinematics.axes import stratum_frame
from stereoservo.kinematics.model import (
    CellModel,
    ModelCovariance,
    Stratum,
    check_model,
    pinhole,
)
from stereoservo.kinematics.parameterization import (
    Kind,
    LensModel,
    camera_basis,
    conjugation,
    exponentials,
    generator_basis,
    lens_basis,
    point_bases,
)
from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class RigModel:
    """A model under estimation: ``generators`` (n, 4, 4), ``cameras`` (c, 3, 4) to ideal pixels, ``points`` (m, 4)
    at joint offset 0, ``lenses`` (c, 7) from ideal to raw pixels; given as (c, 4) without terms, empty for pinholes.

    ``known``: whether the generators are known twists and their frame is used; else the first camera defines the frame.
    """

    kinds: tuple[Kind, ...]
    generators: FloatArray
    cameras: FloatArray
    points: FloatArray
    lenses: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    known: bool = False

    def __post_init__(self) -> None:
        if not len(self.lenses):
            object.__setattr__(self, "lenses", np.tile(pinhole(), (len(self.cameras), 1)))
        if self.lenses.shape[1] == 4:
            object.__setattr__(self, "lenses", np.hstack([self.lenses, np.zeros((len(self.lenses), 3))]))


@dataclass(frozen=True)
class LensPriors:
    """Prior estimates of the lenses: ``mean`` (c, 6) of (k, cu, cv, k2, p1, p2) and ``information`` (c, 6, 6), the
    inverse of its covariance, zero where nothing is known; or (c, 3) and (c, 3, 3) of (k, cu, cv) alone.
    """

    mean: FloatArray
    information: FloatArray


@dataclass(frozen=True)
class PinholeTies:
    """Standard deviations [px] of the constraints that tie each camera to its lens and to a pinhole's form: ``skew``,
    ``aspect`` (of fx - fy) and ``centre`` (of the lens centre about the principal point); infinite if free.
    """

    skew: float
    aspect: float
    centre: float


@dataclass(frozen=True)
class JointNoise:
    """Standard deviations of the errors of joint readings at s stops, true minus reported position [rad or m].

    ``own`` (s, n): of the error of a joint at that stop alone. ``shared`` (s, n): index of the error that it shares
    with other stops at the same reading, -1 if there is none; ``deviations`` (e,) of those errors.
    ``posture`` (n,): of the error that changes slowly with the posture; its values at the stops are spanned by
    ``features`` (s, r) with coefficients of unit variance.
    """

    own: FloatArray
    shared: IntArray
    deviations: FloatArray
    features: FloatArray
    posture: FloatArray

    @property
    def posture_dependent(self) -> IntArray:
        """Joints with errors that change with the posture."""
        return np.flatnonzero(self.posture > 0.0)

    @property
    def common(self) -> int:
        """Number of errors that stops share."""
        return len(self.deviations) + len(self.posture_dependent) * int(self.features.shape[1])

    def common_factors(self, stops: IntArray) -> FloatArray:
        """Derivatives (k, n, common) of each joint's error at ``stops`` (k,) by each shared error."""
        e, r = len(self.deviations), self.features.shape[1]
        factors = np.zeros((len(stops), len(self.posture), self.common))
        at, joint = np.nonzero(self.shared[stops] >= 0)
        error = self.shared[stops[at], joint]
        factors[at, joint, error] = self.deviations[error]
        for k, one in enumerate(self.posture_dependent):
            factors[:, one, e + k * r : e + (k + 1) * r] = self.posture[one] * self.features[stops]
        return factors

    def common_offsets(self, common: FloatArray) -> FloatArray:
        """Errors (s, n) [rad or m] due to the shared ones ``common`` (common,)."""
        e, r = len(self.deviations), self.features.shape[1]
        found = np.append(common[:e] * self.deviations, 0.0)[self.shared]
        for k, joint in enumerate(self.posture_dependent):
            error = self.features @ common[e + k * r : e + (k + 1) * r]
            found[:, joint] += self.posture[joint] * error
        return np.asarray(found)


@dataclass(frozen=True)
class JointErrors:
    """Estimated errors of joint readings in standard deviations: ``own`` (s, n), and the ``common`` (shared) ones."""

    own: FloatArray
    common: FloatArray

    @property
    def cost(self) -> float:
        """Sum of squares: minus twice the logarithm of their density."""
        return float((self.own**2).sum() + (self.common**2).sum())

    def offsets(self, noise: JointNoise) -> FloatArray:
        """The errors (s, n) [rad or m]."""
        return np.asarray(self.own * noise.own + noise.common_offsets(self.common))


@dataclass(frozen=True)
class Measurements:
    """Raw pixels in a flat list: camera, stop and marker of each (k,), ``pixels`` (k, 2), ``sigmas`` (k,) [px].

    ``offsets`` (s, n): joint positions of each stop minus the zero, ``joint_errors`` included. ``lens_priors`` are used
    as measurements of the free lenses, ``pinhole_ties`` of a metric rig's free cameras.
    ``joint_noise``: of the readings; None if they are exact.
    """

    offsets: FloatArray
    camera: IntArray
    stop: IntArray
    marker: IntArray
    pixels: FloatArray
    sigmas: FloatArray
    lens_priors: LensPriors | None = None
    joint_noise: JointNoise | None = None
    joint_errors: JointErrors | None = None
    pinhole_ties: PinholeTies | None = None

    @property
    def corrections(self) -> FloatArray:
        """Estimated errors (s, n) [rad or m] that are included in ``offsets``."""
        if self.joint_noise is None or self.joint_errors is None:
            return np.zeros_like(self.offsets)
        return self.joint_errors.offsets(self.joint_noise)

    def corrected(self, errors: JointErrors | None) -> Measurements:
        """The measurements with different estimated errors of the joint readings; None: with readings as reported."""
        if errors is None and self.joint_errors is None:
            return self
        reported = replace(self, offsets=self.offsets - self.corrections, joint_errors=None)
        if errors is None or self.joint_noise is None:
            return reported
        return replace(reported, offsets=reported.offsets + errors.offsets(self.joint_noise), joint_errors=errors)

    def with_joint_noise(self, noise: JointNoise | None) -> Measurements:
        """The measurements with readings as reported and a different noise of them."""
        return replace(self.corrected(None), joint_noise=noise)

    def with_errors_removed(self) -> Measurements:
        """The measurements with the estimated errors removed from the readings, which then count as exact."""
        return replace(self, joint_noise=None, joint_errors=None)

    def select(self, keep: npt.NDArray[np.bool_] | IntArray) -> Measurements:
        """The measurements where ``keep`` (k,) holds, or those of the indices ``keep``."""
        return replace(
            self,
            camera=self.camera[keep],
            stop=self.stop[keep],
            marker=self.marker[keep],
            pixels=self.pixels[keep],
            sigmas=self.sigmas[keep],
        )


@dataclass(frozen=True)
class Charts:
    """Minimal parameterization: basis directions of each part in the order of its parameters; an empty basis (0, ...)
    keeps the part fixed. Those of lenses are (p, 7), given as (p, 4) without terms.
    """

    generators: tuple[FloatArray, ...]
    cameras: tuple[FloatArray, ...]
    lenses: tuple[FloatArray, ...]
    points: tuple[FloatArray, ...]

    def __post_init__(self) -> None:
        whole = tuple(np.pad(basis, ((0, 0), (0, 7 - basis.shape[1]))) for basis in self.lenses)
        object.__setattr__(self, "lenses", whole)

    @property
    def parts(self) -> tuple[tuple[FloatArray, ...], ...]:
        """The four parts in the order of their parameters."""
        return self.generators, self.cameras, self.lenses, self.points

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(len(basis) for part in self.parts for basis in part)

    def start(self, part: int) -> int:
        """Index of the first parameter of a part: 0 generators, 1 cameras, 2 lenses, 3 points."""
        return sum(len(basis) for bases in self.parts[:part] for basis in bases)


def full_charts(
    rig: RigModel,
    stratum: Stratum,
    *,
    generators: bool = True,
    cameras: bool = True,
    points: bool = True,
    lenses: LensModel = "none",
) -> Charts:
    """Minimal charts around ``rig``; generators, cameras or points may be kept fixed, ``lenses`` selects their free
    parameters.

    With free cameras the first one fixes the gauge (projective, affine: fixed; metric: ``K [I | 0]``), the second
    one loses the remaining gauge freedom, further ones are free. Known generators are kept fixed and leave no gauge
    freedom; nor is there any if neither generators nor points are free.
    """
    gauge: Literal["right", "other"] = "right" if generators or points else "other"
    none = np.zeros((0, 3, 4))
    matrices: tuple[FloatArray, ...] = tuple(none for _ in rig.cameras)
    if cameras and rig.known:
        matrices = tuple(camera_basis(matrix, "other", stratum) for matrix in rig.cameras)
    elif cameras:
        left = camera_basis(rig.cameras[0], "left_metric", stratum) if stratum == "metric" else none
        matrices = (
            left,
            *(camera_basis(matrix, gauge if c == 0 else "other", stratum) for c, matrix in enumerate(rig.cameras[1:])),
        )
    return Charts(
        tuple(
            np.zeros((0, 4, 4)) if rig.known or not generators else generator_basis(h, kind, stratum)
            for h, kind in zip(rig.generators, rig.kinds, strict=True)
        ),
        matrices,
        tuple(lens_basis(lenses) for _ in rig.lenses),
        tuple(point_bases(rig.points, stratum) if points else np.zeros((len(rig.points), 0, 4))),
    )


def rig_at(rig: RigModel, charts: Charts, x: FloatArray) -> RigModel:
    """The rig at chart coordinates ``x``."""
    at = 0
    generators: list[FloatArray] = []
    for generator, basis in zip(rig.generators, charts.generators, strict=True):
        frame, _ = conjugation(basis, x[at : at + len(basis)])
        generators.append(frame @ generator @ np.linalg.inv(frame))
        at += len(basis)
    linear = []
    for part, bases in (
        (rig.cameras, charts.cameras),
        (rig.lenses, charts.lenses),
        (rig.points, charts.points),
    ):
        values = part.copy()
        for value, basis in zip(values, bases, strict=True):
            if len(basis):
                value += (x[at : at + len(basis)] @ basis.reshape(len(basis), -1)).reshape(value.shape)
                at += len(basis)
        linear.append(values)
    cameras, lenses, points = linear
    return RigModel(rig.kinds, np.array(generators), cameras, points, lenses, rig.known)


def partial_products(rig: RigModel, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``E_1 … E_j`` and ``E_{j+1} … E_n``, both (n + 1, s, 4, 4), j = 0 … n, at ``offsets`` (s, n) (5.18)."""
    steps = exponentials(rig.generators, rig.kinds, offsets)
    s, n = offsets.shape
    before = np.empty((n + 1, s, 4, 4))
    after = np.empty((n + 1, s, 4, 4))
    before[0] = after[n] = np.eye(4)
    for j in range(n):
        before[j + 1] = before[j] @ steps[:, j]
        after[n - 1 - j] = steps[:, n - 1 - j] @ after[n - j]
    return before, after


def displacements(rig: RigModel, offsets: FloatArray) -> FloatArray:
    """``E_1 … E_n`` (s, 4, 4) at ``offsets`` (s, n) (5.18)."""
    steps = exponentials(rig.generators, rig.kinds, offsets)
    product: FloatArray = steps[:, 0]
    for j in range(1, steps.shape[1]):
        product = product @ steps[:, j]
    return product


def predicted(rig: RigModel, data: Measurements, moved: FloatArray | None = None) -> FloatArray:
    """Raw pixels (k, 2) of the rig for each measurement (5.56); ``moved`` (s, 4, 4): displacements, if known."""
    if moved is None:
        moved = displacements(rig, data.offsets)
    world = rig.points @ moved.transpose(0, 2, 1)
    pixels = np.empty((len(data.camera), 2))
    for c, (matrix, lens) in enumerate(zip(rig.cameras, rig.lenses, strict=True)):
        mine = np.flatnonzero(data.camera == c)
        images = world[data.stop[mine], data.marker[mine]] @ matrix.T
        ideal = images[:, :2] / images[:, 2:]
        pixels[mine] = _through(lens, ideal)
    return pixels


def expected_pixels(rig: RigModel, offsets: FloatArray) -> FloatArray:
    """Pixels (c, s, m, 2) of a rig at ``offsets`` (s, n)."""
    shape = (len(rig.cameras), len(offsets), len(rig.points))
    camera, stop, marker = (index.ravel() for index in np.indices(shape))
    blank = np.zeros((len(camera), 2))
    return predicted(rig, Measurements(offsets, camera, stop, marker, blank, np.ones(len(camera)))).reshape(*shape, 2)


def _through(lens: FloatArray, ideal: FloatArray) -> FloatArray:
    """Raw pixels (k, 2) of ideal ones through a lens (7,), with or without second radial and tangential terms."""
    if not has_distortion(lens):
        return ideal
    return distort(lens if lens[4:].any() else lens[:4], ideal)


def residuals(rig: RigModel, data: Measurements) -> FloatArray:
    """Weighted residuals (2 k,): prediction minus measurement in sigmas, u and v of each measurement
    together; without those of lens priors.
    """
    return ((predicted(rig, data) - data.pixels) / data.sigmas[:, None]).ravel()


def projective_rig(model: CellModel) -> RigModel:
    """The model in its own projective frame, joints ordered from the base."""
    return _rig(model, np.eye(4))


def stratum_rig(model: CellModel) -> RigModel:
    """The model in the highest frame of its stratum, joints ordered from the base; heights 1 unless projective."""
    return _rig(model, stratum_frame(model.stratum, model.plane_at_infinity, model.projective_to_euclidean))


def acting_order(model: CellModel) -> tuple[int, ...]:
    """Joints in the order in which a rig composes them: with cameras on the tip, the tip's joint first."""
    order = tuple(range(len(model.joint_names)))
    return order[::-1] if model.tip_first else order


def acting_rig(model: CellModel) -> RigModel:
    """`stratum_rig` with joints in `acting_order`."""
    return _in_acting_order(stratum_rig(model), model)


def own_acting_rig(model: CellModel) -> RigModel:
    """`projective_rig` with joints in `acting_order`."""
    return _in_acting_order(projective_rig(model), model)


def _in_acting_order(rig: RigModel, model: CellModel) -> RigModel:
    order = list(acting_order(model))
    return RigModel(tuple(rig.kinds[j] for j in order), rig.generators[order], rig.cameras, rig.points, rig.lenses)


def _rig(model: CellModel, frame: FloatArray) -> RigModel:
    back = np.asarray(np.linalg.inv(frame))
    points = model.marker_points @ frame.T
    flat = model.stratum == "projective" or bool((frame == np.eye(4)).all())
    return RigModel(
        model.joint_kinds,
        frame @ model.generators @ back,
        np.array([camera.matrix for camera in model.cameras]) @ back,
        points if flat else points / points[:, 3:],
        np.array([camera.lens for camera in model.cameras]),
    )


def common_mount(trials: TrialData) -> Mount:
    """The mount that all cameras of the trials share. Raises CalibrationError (``mixed_mounts``)."""
    mounts = {camera.name: camera.mount for camera in trials.cameras}
    if len(set(mounts.values())) > 1:
        listed = ", ".join(f"{name!r} {mount}" for name, mount in mounts.items())
        raise CalibrationError(
            "mixed_mounts",
            f"the cameras are mounted differently: {listed}. One model needs cameras that see one motion: "
            "calibrate static ones and those on the tip each on their own",
            mounts=mounts,
        )
    return trials.cameras[0].mount


def reversed_trials(trials: TrialData) -> TrialData:
    """Trials with the joints in reverse order: seen from cameras on the tip, the base's joint is the
    last before the markers.
    """
    last = len(trials.joint_names) - 1
    return msgspec.structs.replace(
        trials,
        joint_names=trials.joint_names[::-1],
        joint_kinds=trials.joint_kinds[::-1],
        positions=trials.positions[:, ::-1],
        trials=np.where(trials.trials >= 0, last - trials.trials, trials.trials),
    )


def with_joints_reversed(model: CellModel) -> CellModel:
    """Model of reversed trials with its joints base first again, with eye-in-hand mount."""
    statistics = model.statistics
    if statistics is not None:
        statistics = msgspec.structs.replace(statistics, joints=statistics.joints[::-1])
    accuracy = model.joint_accuracy
    if accuracy is not None:
        accuracy = accuracy.in_order(np.arange(len(model.joint_names))[::-1])
    whole = msgspec.structs.replace(
        model,
        joint_names=model.joint_names[::-1],
        joint_kinds=model.joint_kinds[::-1],
        zero=model.zero[::-1].copy(),
        generators=model.generators[::-1].copy(),
        statistics=statistics,
        mount="eye_in_hand",
        joint_accuracy=accuracy,
        covariance=None if model.covariance is None else _reversed_covariance(model.covariance),
    )
    check_model(whole)
    return whole


def _reversed_covariance(given: ModelCovariance) -> ModelCovariance:
    """The covariance with the joints' blocks in the opposite order."""
    sizes = [len(basis) for basis in given.generators]
    starts = np.cumsum([0, *sizes])
    order = [i for j in reversed(range(len(sizes))) for i in range(starts[j], starts[j + 1])]
    order += list(range(starts[-1], len(given.covariance)))
    return msgspec.structs.replace(
        given, generators=given.generators[::-1], covariance=given.covariance[np.ix_(order, order)]
    )
