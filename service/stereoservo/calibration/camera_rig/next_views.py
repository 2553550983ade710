"""Which further views of the body would make a rig's cameras better known."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.camera_rig.rig_bundle import RigFit
from stereoservo.calibration.camera_rig.rig_calibration import RigCalibration
from stereoservo.calibration.joint_errors.joint_noise import stop_rows
from stereoservo.calibration.least_squares import deviation, with_rows
from stereoservo.calibration.normal_equations import by_stop
from stereoservo.calibration.rig_model import Measurements, predicted
from stereoservo.geometry.strata import decompose_camera, intrinsics_and_slopes
from stereoservo.numerics.arrays import FloatArray

TILTS = (
    ("straight on", 0.0, 0.0),
    ("tilted 40° about the picture's x", 40.0, 0.0),
    ("tilted 40° about its y", 0.0, 40.0),
)
PLACES = (
    ("middle", 0.0, 0.0),
    ("left", -0.3, 0.0),
    ("right", 0.3, 0.0),
    ("top", 0.0, -0.3),
    ("bottom", 0.0, 0.3),
)
DISTANCES = (("near", 0.6), ("as far", 1.0))
INSIDE = 0.9
"""Share of the markers that a view must show."""


class ViewAdvice(msgspec.Struct, frozen=True):
    """A view that would help: what it does to the relative deviation of the worst known focal length."""

    message: str
    camera: str
    place: str
    tilt: str
    distance: str
    deviation_px: float
    would_be_px: float


def next_views(fit: RigFit, result: RigCalibration) -> list[ViewAdvice]:
    """Views before the camera whose focal length is known worst, the most helpful first; none where no such view shows
    the body.
    """
    worst = max(result.cameras, key=lambda camera: camera.deviations["fx"] / camera.focal[0])
    k = [camera.name for camera in result.cameras].index(worst.name)
    known, scale = fit.solution.determined.triangle, float(np.sqrt(fit.variance))
    row = _focal_slope(fit, k)
    now = scale * deviation(known, row)
    found = []
    for (place, u, v), (tilt, x, y), (distance, share) in product(PLACES, TILTS, DISTANCES):
        more = _rows(fit, result, k, (u, v), (x, y), share)
        if more is not None:
            would = scale * deviation(with_rows(known, more), row)
            where = f"{distance}, {place} of {worst.name}, {tilt}"
            found.append(
                ViewAdvice(
                    f"the body {where}: its focal length to {would:.3f} px from {now:.3f}",
                    worst.name, place, tilt, distance, now, would,
                )
            )  # fmt: skip
    return sorted(found, key=lambda one: one.would_be_px)


def _focal_slope(fit: RigFit, k: int) -> FloatArray:
    """Derivative (p,) of camera k's focal length by the parameters."""
    charts = fit.solution.charts
    row = np.zeros(charts.size)
    at = charts.start(1) + sum(len(basis) for basis in charts.cameras[:k])
    row[at : at + len(charts.cameras[k])] = intrinsics_and_slopes(fit.rig.cameras[k], charts.cameras[k])[1][0]
    return row


def _rows(
    fit: RigFit,
    result: RigCalibration,
    k: int,
    place: tuple[float, float],
    tilt: tuple[float, float],
    share: float,
) -> FloatArray | None:
    """Rows (2 k, p) of one more view, its own pose eliminated; None where it does not show the body."""
    camera = result.cameras[k]
    motions = np.array([np.array(one.motion) for one in result.cameras])
    depths = fit.poses[:, 2, 3]
    depth = share * float(np.median(depths))
    middle = fit.points.mean(axis=0)
    ray = np.array(
        [place[0] * camera.width / camera.focal[0], place[1] * camera.height / camera.focal[1], 1.0]
    )
    turn = Rotation.from_euler("xy", tilt, degrees=True).as_matrix() @ _facing(fit, k)
    scale = float(np.linalg.norm(motions[k][:3, 3]))
    shift = motions[k][:3, 3] * (1.0 if fit.length_known or not scale else _unit(fit, k) / scale)
    R = motions[k][:3, :3]
    centre = R.T @ (depth * ray - shift)
    pose_turn = R.T @ turn
    offsets = np.append(
        centre - pose_turn @ middle, Rotation.from_matrix(pose_turn @ fit.body_frame).as_euler("XYZ")
    )
    c, m = len(result.cameras), len(fit.points)
    cameras, markers = (grid.ravel() for grid in np.meshgrid(np.arange(c), np.arange(m), indexing="ij"))
    noise = fit.data.joint_noise
    assert noise is not None
    one = Measurements(
        offsets[None], cameras, np.zeros(c * m, dtype=np.int64), markers, np.zeros((c * m, 2)),
        np.full(c * m, float(np.median(fit.data.sigmas))),
    )  # fmt: skip
    pixels = predicted(fit.rig, one)
    size = np.array([(one.width, one.height * fit.aspect) for one in result.cameras])[cameras]
    inside = np.asarray((np.isfinite(pixels) & (pixels > 0.0) & (pixels < size - 1.0)).all(axis=1))
    if inside[cameras == k].mean() < INSIDE:
        return None
    kept = replace(one, pixels=pixels).select(inside)
    rows = next(iter(stop_rows(fit.rig, fit.solution.charts, by_stop(kept)[0])))
    A, (Q, _) = rows.rows[:, :-1], np.linalg.qr(rows.joints)
    return np.asarray(A - Q @ (Q.T @ A))


def _facing(fit: RigFit, k: int) -> FloatArray:
    """Rotation (3, 3) of the body before camera k that is nearest to the mean of its places."""
    turns = Rotation.from_matrix(fit.poses[:, :3, :3])
    mean: FloatArray = turns.mean().as_matrix()
    if not fit.length_known:
        return mean
    normal = np.linalg.svd(fit.points - fit.points.mean(axis=0))[2][2]
    seen = mean @ normal
    axis = np.cross(seen, np.sign(seen[2]) * np.array([0.0, 0.0, 1.0]))
    size = float(np.linalg.norm(axis))
    if size < 1e-9:
        return mean
    turn: FloatArray = Rotation.from_rotvec(axis / size * np.arcsin(min(size, 1.0))).as_matrix()
    return turn @ mean


def _unit(fit: RigFit, k: int) -> float:
    """Distance of camera k from the first one in the fit's unit of length."""
    return float(np.linalg.norm(decompose_camera(fit.rig.cameras[k])[2]))
