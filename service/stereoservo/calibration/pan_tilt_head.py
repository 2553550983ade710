"""Calibration and tracking control of a pan-tilt head: cameras on two joints before a static scene or a moving
target (thesis 4.5).

Calibration is the ordinary fit with cameras mounted eye-in-hand. From it follow the predicted image after a motion of
the joints (4.44), homing and angles (`kinematics.joint_angles`), and the joint velocity that keeps a moving target at
its place in the images. Only `calibrate_pan_tilt` is bound to two joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.geometry.cameras import projection_jacobian_many
from stereoservo.geometry.distortion import undistort
from stereoservo.kinematics.joint_reprojection import (
    JointAnglesError,
    SeenChain,
    points_seen,
    predicted_pixels,
    seen_chain,
)
from stereoservo.numerics.arrays import FloatArray

CONDITIONING = 1e-6
"""Relative singular value below which the joints do not move the images in a direction."""


def calibrate_pan_tilt(trials: TrialData, *, epoch: int) -> tuple[SeenChain, CalibrationFit]:
    """Head and fit from two joint-wise trajectories (4.5.2), pan first.

    Raises CalibrationError (``bad_data``) for trials of another mechanism, and as `fit_model` does.
    """
    _check_pan_tilt(trials.joint_kinds, tuple(camera.mount for camera in trials.cameras))
    result = fit_model(trials, epoch=epoch)
    return seen_chain(result.model), result


def _check_pan_tilt(kinds: tuple[str, ...], mounts: tuple[str, ...]) -> None:
    if tuple(kinds) != ("revolute", "revolute") or set(mounts) != {"eye_in_hand"}:
        raise CalibrationError(
            "bad_data",
            f"joints {kinds} with cameras mounted {sorted(set(mounts))}; a pan-tilt head has two revolute joints and "
            "cameras mounted eye_in_hand",
            kinds=list(kinds),
            mounts=list(mounts),
        )


def feed_forward(
    seen: SeenChain, q_from: FloatArray, pixels: FloatArray, q_to: FloatArray, sigma: FloatArray | float = 1.0
) -> FloatArray:
    """Predicted raw pixels (s, c, m, 2) at configurations ``q_to`` (s, n) of points seen at ``pixels`` (c, m, 2) in
    ``q_from`` (n,): reconstructed, displaced by the joints (4.44), projected. NaN where two cameras do not see a
    point.
    """
    points, _ = points_seen(seen, q_from, pixels, sigma)
    return predicted_pixels(seen, np.atleast_2d(q_to), points)


@dataclass(frozen=True, eq=False)
class TargetMotion:
    """Current state of a moving target: ``points`` (m, 4) at the chain's zero and their ``velocity`` (m, 4) [1/s], the
    joints' own motion taken out.
    """

    points: FloatArray
    velocity: FloatArray


def target_motion(
    times_s: npt.ArrayLike, points: FloatArray, now_s: float, *, plane: FloatArray, degree: int = 1
) -> TargetMotion:
    """The target's own motion from its track: ``points`` (k, m, 4) of `points_seen` at ``times_s`` (k,), brought to
    ``now_s`` by a polynomial of ``degree`` through each coordinate.

    Points of any scale are brought to height 1 over ``plane`` (4,): the plane at infinity where it is known, so that a
    straight uniform motion is one of degree 1; any plane far from the target else. NaN points are left out; a marker
    with fewer than ``degree`` + 1 sights becomes NaN. Raises JointAnglesError (``shape``, ``too_few``).
    """
    t = np.asarray(times_s, dtype=np.float64) - now_s
    if points.ndim != 3 or points.shape[::2] != (len(t), 4) or degree < 0:
        raise JointAnglesError(
            "shape",
            f"points {points.shape} at {len(t)} times, degree {degree}; (k, m, 4) and 0 or more are needed",
        )
    if len(np.unique(t)) <= degree:
        raise JointAnglesError(
            "too_few",
            f"{len(np.unique(t))} times; a track of degree {degree} needs {degree + 1}",
            times=len(t),
        )
    scaled = points / (points @ plane)[..., None]
    powers = t[:, None] ** np.arange(degree + 1)
    now, velocity = np.full(points.shape[1:], np.nan), np.full(points.shape[1:], np.nan)
    for i in range(points.shape[1]):
        seen = np.isfinite(scaled[:, i]).all(axis=1)
        if len(np.unique(t[seen])) > degree:
            coefficients = np.linalg.lstsq(powers[seen], scaled[seen, i], rcond=None)[0]
            now[i] = coefficients[0]
            velocity[i] = coefficients[1] if degree else 0.0
    return TargetMotion(now, velocity)


@dataclass(frozen=True, eq=False)
class TrackingStep:
    """Joint ``velocity`` (n,) [rad/s or m/s], largest distance ``error_px`` of a point from its set-point, and
    ``conditioning``: smallest over largest singular value of the image Jacobian, 0 where a joint moves nothing.
    """

    velocity: FloatArray
    error_px: float
    conditioning: float


def tracking_velocity(
    seen: SeenChain,
    q: FloatArray,
    motion: TargetMotion,
    set_points: FloatArray,
    gain: float,
    *,
    pixels: FloatArray | None = None,
) -> TrackingStep:
    """Joint velocities that keep a moving target's image at raw ``set_points`` (c, m, 2) [px], NaN where free.

    ``q̇ = J⁺(−gain e − ṡ)``: ``e`` the image error at ``q`` (n,) in ideal pixels, ``ṡ = J_G P H(q) Ṁ`` what the
    target's own motion does to the images, fed forward; ``gain`` [1/s]. ``e`` is read from ``pixels`` (c, m, 2) where
    given, else predicted from the track. Raises JointAnglesError (``too_few``) where no set-point has a point.
    """
    displacement, slopes = (array[0] for array in seen.displacements(q[None]))
    M = motion.points @ displacement.T
    through = projection_jacobian_many(seen.cameras, M)
    now = predicted_pixels(seen, q[None], motion.points)[0] if pixels is None else pixels
    error = np.stack(
        [undistort(lens, now[i]) - undistort(lens, set_points[i]) for i, lens in enumerate(seen.lenses)]
    )
    own = np.einsum("cmij,mj->cmi", through, motion.velocity @ displacement.T)
    J = np.einsum("cmij,njk,mk->cmin", through, slopes, motion.points)
    required = np.isfinite(error).all(axis=2) & np.isfinite(own).all(axis=2)
    if not required.any():
        raise JointAnglesError(
            "too_few", "no set-point belongs to a point with a track; at least one is needed"
        )
    n = seen.chain.joints
    rows, target_velocity = J[required].reshape(-1, n), -(gain * error + own)[required].ravel()
    velocity, _, _, singular = np.linalg.lstsq(rows, target_velocity, rcond=CONDITIONING)
    conditioning = float(singular[-1] / singular[0]) if len(singular) == n and singular[0] > 0 else 0.0
    return TrackingStep(velocity, float(np.linalg.norm(error[required], axis=1).max()), conditioning)
