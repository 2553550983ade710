"""Calibration of cameras without an arm: the bundle's cameras with their covariance, or refusal of views that leave
them undetermined; and the result's file.

Also advice on further views of the body that would improve the accuracy of the cameras.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.camera_rig.rig_bundle import EVALUATIONS, RigFit, RigStart, fit_rig, starts
from stereoservo.calibration.camera_rig.views import RigViews, refused, usable_views
from stereoservo.calibration.joint_noise import stop_rows
from stereoservo.calibration.least_squares import deviation_of, with_rows
from stereoservo.calibration.normal_equations import by_stop
from stereoservo.calibration.rig_model import Measurements, RigModel, predicted
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.strata import decompose_camera, intrinsics_and_jacobian
from stereoservo.numerics.arrays import FloatArray

SCHEMA = 1
LEAST_TURN = 8.0
"""Angle [°] from the mean direction that a tenth of the places must reach: of a board's normals, or a body's turns."""
TURN_SIGMAS = 5.0
"""Ratio of that angle to the standard deviation at a place, below which it counts as noise."""
FOCAL_DEVIATION = 0.02
"""Relative standard deviation of a focal length above which it counts as undetermined."""
CENTRE_DEVIATION = 0.03
"""Standard deviation of a principal point [image widths] above which it counts as undetermined."""
PAIR_DEVIATION = 1.0
"""Standard deviation of the rotation between two cameras [°] above which it counts as undetermined."""
OUTSIDE = 0.5
"""Distance of a principal point from the centre [image sizes] beyond which the model is implausible."""
MOST_LEFT_OUT = 0.2
"""Largest share of rejected measurements."""
MOST_NOISE = 2.0
"""Noise of the pixels [px] above which the views do not fit a pinhole with radial and tangential distortion."""
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
EXTRINSICS = ("rx", "ry", "rz", "tx", "ty", "tz")
WAVE = "Wave the body also tilted, by 20 to 40 degrees about two axes, near and far, and into the pictures' corners"


class RigCamera(msgspec.Struct, frozen=True):
    """A camera of a rig. ``focal`` (fx, fy) and ``centre`` (cx, cy) [px], integer = pixel centre; ``distortion`` (k1,
    k2, p1, p2[, k3]) of Brown's model as in OpenCV. ``rotation`` (3, 3), ``translation`` (3,): from the first
    camera's frame into its own. ``deviations`` of all by name: lengths in the rig's unit, angles in rad.
    """

    name: str
    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, ...]
    rotation: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    deviations: dict[str, float] = {}

    @property
    def matrix(self) -> FloatArray:
        """``K`` (3, 3)."""
        return np.array([[self.focal[0], 0.0, self.centre[0]], [0.0, self.focal[1], self.centre[1]], [0.0, 0.0, 1.0]])

    @property
    def motion(self) -> FloatArray:
        """``[R t; 0 1]`` (4, 4) from the first camera's frame."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.rotation, self.translation
        return T


class ViewResidual(msgspec.Struct, frozen=True):
    """A place of the body: rms residual [px] over all cameras, markers seen, measurements left out."""

    name: str
    rms_px: float
    markers: int
    left_out: int


class RigCalibration(msgspec.Struct, frozen=True):
    """A calibrated rig. ``unit``: of its lengths, ``m`` if one was known, else ``baseline`` (of the second camera).

    ``parameters`` name the rows of ``covariance``: ``CAMERA.NAME``. ``sigma_px``: noise of a pixel coordinate,
    estimated from the residuals. ``views`` worst first.
    """

    cameras: tuple[RigCamera, ...]
    unit: str
    rms_px: float
    sigma_px: float
    measurements: int
    left_out: int
    freedoms: int
    parameters: tuple[str, ...]
    covariance: tuple[tuple[float, ...], ...]
    marker_ids: tuple[int, ...]
    points: tuple[tuple[float, float, float], ...]
    views: tuple[ViewResidual, ...]
    schema: int = SCHEMA

    def camera(self, name: str) -> RigCamera:
        """The camera with that name. Raises KeyError."""
        return {camera.name: camera for camera in self.cameras}[name]


class KnownDistance(NamedTuple):
    """Distance [m] of two markers of the body, given by their ids."""

    first: int
    second: int
    metres: float


def calibrate_rig(views: RigViews, known: KnownDistance | None = None) -> tuple[RigCalibration, RigFit]:
    """Calibrate the cameras of ``views``; ``known``: for a body of unknown layout.

    Raises CalibrationError if the views leave the cameras undetermined: cause, value, limit and advice.
    """
    views = usable_views(views)
    try:
        begun = starts(views)
    except (GeometryError, np.linalg.LinAlgError) as error:
        raise _open(str(error)) from error
    _require_turns(begun[0].poses, np.zeros(len(begun[0].poses)), views)
    fit = _best_fit(views, begun)
    _require_turns(fit.poses, _turn_deviations(fit), fit.views)
    _require_fit(fit)
    result = rig_result(fit, known)
    _require_determined(result)
    return result, fit


def _best_fit(views: RigViews, begun: list[RigStart]) -> RigFit:
    """The first bundle that converges. Raises CalibrationError if none does: for lack of turns between the places, if
    the bundles' starts and results show that.
    """
    failure: Exception | None = None
    ended: list[RigFit] = []
    for start in begun:
        try:
            fit = fit_rig(views, start)
        except (GeometryError, np.linalg.LinAlgError) as error:
            failure = error
            continue
        if fit.solution.converged:
            return fit
        ended.append(fit)
    for start in begun:
        _require_turns(start.poses, np.zeros(len(start.poses)), views)
    for fit in ended:
        _require_turns(fit.poses, _turn_deviations(fit), fit.views)
    if not ended:
        raise _open(str(failure)) from failure
    raise refused(
        "no_fit",
        "the fit did not converge: steps",
        ended[-1].solution.evaluations,
        EVALUATIONS,
        "",
        "The data leave the cameras open, or views are wrong: wave the body also tilted, near and far",
    )


def _turn_deviations(fit: RigFit) -> FloatArray:
    """Standard deviations (s,) of the body's turns [°], for exact cameras."""
    return np.asarray(np.degrees(fit.pose_deviations()[:, 3:].max(axis=1)))


def _open(why: str) -> CalibrationError:
    return refused(
        "views_degenerate",
        f"the views leave the cameras open ({why}): places that determine them",
        0,
        1,
        " sets",
        WAVE,
    )


def _require_turns(poses: FloatArray, deviations: FloatArray, views: RigViews) -> None:
    """Raise CalibrationError if the board was not tilted, or the body not turned, between the places (s, 4, 4);
    ``deviations`` (s,) [°].

    A plane's normal is ``Kᵀ l`` of its vanishing line, so that parallel boards have one normal for any assumed camera;
    and turns of an unknown body are those of its projective displacements' eigenvalues.
    """
    known = np.isfinite(poses[:, 0, 0])
    if views.layout is not None:
        normal = np.linalg.svd(views.layout - views.layout.mean(axis=0))[2][2]
        directions = poses[known, :3, :3] @ normal
        mean = np.linalg.svd(directions)[2][0]
        angles = np.degrees(np.arccos(np.clip(np.abs(directions @ mean), 0.0, 1.0)))
        cause, what = "flat_motion", "the board stayed parallel to itself: tilt about the mean"
    else:
        turns = Rotation.from_matrix(poses[known, :3, :3])
        angles = np.degrees((turns.mean().inv() * turns).magnitude())
        cause, what = "no_turns", "the body was hardly turned: turn about the mean"
    reached = float(np.quantile(angles, 0.9))
    limit = max(LEAST_TURN, TURN_SIGMAS * float(np.median(deviations[known])))
    if not reached >= limit:
        raise refused(cause, what, reached, limit, "°", WAVE)


def _require_fit(fit: RigFit) -> None:
    share = 1.0 - float(fit.kept.mean())
    if share > MOST_LEFT_OUT:
        raise refused(
            "views_disagree",
            "measurements that fit no rigid body before cameras at rest",
            100 * share,
            100 * MOST_LEFT_OUT,
            " %",
            "Look for a camera that moved, markers that were mixed up, pictures not taken at one instant",
        )
    noise = float(np.sqrt(fit.variance * np.mean(fit.data.sigmas[fit.kept] ** 2)))
    if noise > MOST_NOISE:
        raise refused(
            "misfit",
            "the views do not fit cameras with radial and tangential distortion: noise",
            noise,
            MOST_NOISE,
            " px",
            "Check the board's size, that pictures of one place are of one instant, and the lens: a fisheye is none",
        )
    for camera, matrix in zip(fit.views.cameras, fit.rig.cameras, strict=True):
        K = decompose_camera(matrix)[0]
        off = max(abs(K[0, 2] / camera.width - 0.5), abs(K[1, 2] / fit.aspect / camera.height - 0.5))
        if not off <= OUTSIDE:
            raise refused(
                "no_camera",
                f"the principal point of {camera.name!r} lies outside its picture: from the middle",
                off,
                OUTSIDE,
                " image sizes",
                WAVE,
            )


def _require_determined(result: RigCalibration) -> None:
    for camera in result.cameras:
        relative = max(camera.deviations["fx"] / camera.focal[0], camera.deviations["fy"] / camera.focal[1])
        centre = max(camera.deviations["cx"], camera.deviations["cy"]) / camera.width
        turn = np.degrees(max(camera.deviations.get(name, 0.0) for name in EXTRINSICS[:3]))
        for code, what, value, limit, unit in (
            ("focal_open", "the focal length", 100 * relative, 100 * FOCAL_DEVIATION, " %"),
            ("centre_open", "the principal point", 100 * centre, 100 * CENTRE_DEVIATION, " % of the width"),
            ("pair_open", "the rotation from the first camera", turn, PAIR_DEVIATION, "°"),
        ):
            if not value <= limit:
                raise refused(code, f"{what} of {camera.name!r} stays open: deviation", value, limit, unit, WAVE)


# -- the result ---------------------------------------------------------------------------------------------


class _Physical(NamedTuple):
    """Intrinsics (c, 8) as of ``INTRINSICS``, rotations (c, 3, 3) and translations (c, 3) in the rig's unit."""

    intrinsics: FloatArray
    rotations: FloatArray
    translations: FloatArray


def _physical(
    rig: RigModel, aspect: float, known: KnownDistance | None, ids: tuple[int, ...], metric: bool
) -> _Physical:
    intrinsics, rotations, translations = [], [], []
    for matrix, lens in zip(rig.cameras, rig.lenses, strict=True):
        K, R, t = decompose_camera(matrix)
        q = K[0, 0] / lens[3]
        intrinsics.append([
            K[0, 0], K[1, 1] / aspect, K[0, 2], K[1, 2] / aspect,
            lens[0] * q**2, lens[4] * q**4, lens[5] * q, lens[6] * q,
        ])  # fmt: skip
        rotations.append(R)
        translations.append(t)
    shifts = np.array(translations)
    if known is not None:
        a, b = (rig.points[ids.index(one), :3] for one in (known.first, known.second))
        shifts = shifts * known.metres / np.linalg.norm(a - b)
    elif not metric:
        shifts = shifts / np.linalg.norm(shifts[1])
    return _Physical(np.array(intrinsics), np.array(rotations), shifts)


def rig_result(fit: RigFit, known: KnownDistance | None) -> RigCalibration:
    """The cameras of a fit with their covariance. Raises CalibrationError if ``known`` does not name two markers."""
    ids, metric = fit.views.marker_ids, fit.length_known
    if known is not None:
        missing = [one for one in (known.first, known.second) if one not in ids]
        if missing or known.first == known.second or not known.metres > 0.0:
            raise CalibrationError(
                "length",
                f"the known length is of markers {known.first} and {known.second}, {known.metres:g} m; two of the seen "
                f"markers {', '.join(map(str, ids))} and a positive length are needed",
            )
    here = _physical(fit.rig, fit.aspect, known, ids, metric)

    def vector(x: FloatArray) -> FloatArray:
        changed = _physical(fit.retract(x), fit.aspect, known, ids, metric)
        turns = Rotation.from_matrix(changed.rotations @ here.rotations.transpose(0, 2, 1)).as_rotvec()
        return np.concatenate([changed.intrinsics.ravel(), np.hstack([turns, changed.translations])[1:].ravel()])

    root = fit.root
    slopes = np.zeros((len(vector(np.zeros(len(root)))), len(root)))
    for j, sigma in enumerate(np.linalg.norm(root, axis=1)):
        step = np.zeros(len(root))
        step[j] = 1e-3 * sigma
        slopes[:, j] = (vector(step) - vector(-step)) / (2e-3 * sigma)
    half = slopes @ root
    covariance = half @ half.T
    names = [f"{camera.name}.{name}" for camera in fit.views.cameras for name in INTRINSICS]
    names += [f"{camera.name}.{name}" for camera in fit.views.cameras[1:] for name in EXTRINSICS]
    deviation = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    cameras = []
    for k, camera in enumerate(fit.views.cameras):
        fx, fy, cx, cy, *distortion = here.intrinsics[k].tolist()
        if fit.aspect == 1.0:
            fx = fy = 0.5 * (fx + fy)
        cameras.append(
            RigCamera(
                camera.name, camera.width, camera.height, (fx, fy), (cx, cy), tuple(distortion),
                tuple(map(tuple, here.rotations[k].tolist())), tuple(here.translations[k].tolist()),
                {n.rpartition(".")[2]: v for n, v in deviation.items() if n.rpartition(".")[0] == camera.name},
            )
        )  # fmt: skip
    kept = fit.residuals[fit.kept]
    scale = _scale(fit, known, ids)
    return RigCalibration(
        tuple(cameras), "m" if metric or known is not None else "baseline",
        float(np.sqrt((kept**2).sum(axis=1).mean())),
        float(np.sqrt(fit.variance * np.mean(fit.data.sigmas[fit.kept] ** 2))),
        int(fit.kept.sum()), int((~fit.kept).sum()), fit.freedoms, tuple(names),
        tuple(map(tuple, covariance.tolist())), ids, tuple(map(tuple, (scale * fit.points).tolist())), _views(fit),
    )  # fmt: skip


def _scale(fit: RigFit, known: KnownDistance | None, ids: tuple[int, ...]) -> float:
    """Factor from the fit's unit of length to the result's."""
    if known is not None:
        a, b = (fit.rig.points[ids.index(one), :3] for one in (known.first, known.second))
        return float(known.metres / np.linalg.norm(a - b))
    return 1.0 if fit.length_known else float(1.0 / np.linalg.norm(decompose_camera(fit.rig.cameras[1])[2]))


def _views(fit: RigFit) -> tuple[ViewResidual, ...]:
    squares = (fit.residuals**2).sum(axis=1)
    found = []
    for stop, name in enumerate(fit.views.names):
        mine = fit.data.stop == stop
        kept = mine & fit.kept
        rms = float(np.sqrt(squares[kept].mean())) if kept.any() else float("inf")
        found.append(ViewResidual(name, rms, int(mine.sum()), int((mine & ~fit.kept).sum())))
    return tuple(sorted(found, key=lambda view: -view.rms_px))


def save_rig(result: RigCalibration, path: Path) -> None:
    """Write the calibration as JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(result), indent=1) + b"\n")


def load_rig(path: Path) -> RigCalibration:
    """Read a calibration. Raises CalibrationError (``bad_file``)."""
    try:
        found = msgspec.json.decode(path.read_bytes(), type=RigCalibration)
    except (OSError, msgspec.DecodeError) as error:
        raise CalibrationError(
            "bad_file", f"{path} is no camera rig, as `stereoservo calibrate --rig` writes one: {error}"
        ) from error
    if found.schema != SCHEMA:
        raise CalibrationError("bad_file", f"{path} has schema {found.schema}; {SCHEMA} is valid")
    return found


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
"""Least share of the markers that are visible in an advised view."""


class ViewAdvice(msgspec.Struct, frozen=True):
    """A useful further view: its effect on the relative deviation of the least accurate focal length."""

    message: str
    camera: str
    place: str
    tilt: str
    distance: str
    deviation_px: float
    would_be_px: float


def next_views(fit: RigFit, result: RigCalibration) -> list[ViewAdvice]:
    """Views in front of the camera with the least accurate focal length, the most useful first; none if no such view
    shows the body.
    """
    worst = max(result.cameras, key=lambda camera: camera.deviations["fx"] / camera.focal[0])
    k = [camera.name for camera in result.cameras].index(worst.name)
    known, scale = fit.solution.statistics.triangle, float(np.sqrt(fit.variance))
    row = _focal_slope(fit, k)
    now = scale * deviation_of(known, row)
    found = []
    for (place, u, v), (tilt, x, y), (distance, share) in product(PLACES, TILTS, DISTANCES):
        more = _rows(fit, result, k, (u, v), (x, y), share)
        if more is not None:
            would = scale * deviation_of(with_rows(known, more), row)
            where = f"{distance}, {place} of {worst.name}, {tilt}"
            found.append(
                ViewAdvice(
                    f"the body {where}: its focal length to {would:.3f} px from {now:.3f}",
                    worst.name,
                    place,
                    tilt,
                    distance,
                    now,
                    would,
                )
            )
    return sorted(found, key=lambda one: one.would_be_px)


def _focal_slope(fit: RigFit, k: int) -> FloatArray:
    """Derivative (p,) of camera k's focal length by the parameters."""
    charts = fit.solution.charts
    row = np.zeros(charts.size)
    at = charts.start(1) + sum(len(basis) for basis in charts.cameras[:k])
    row[at : at + len(charts.cameras[k])] = intrinsics_and_jacobian(fit.rig.cameras[k], charts.cameras[k])[1][0]
    return row


def _rows(
    fit: RigFit,
    result: RigCalibration,
    k: int,
    place: tuple[float, float],
    tilt: tuple[float, float],
    share: float,
) -> FloatArray | None:
    """Rows (2 k, p) of one more view, with its own pose eliminated; None if it does not show the body."""
    camera = result.cameras[k]
    motions = np.array([np.array(one.motion) for one in result.cameras])
    depths = fit.poses[:, 2, 3]
    depth = share * float(np.median(depths))
    centroid = fit.points.mean(axis=0)
    ray = np.array([place[0] * camera.width / camera.focal[0], place[1] * camera.height / camera.focal[1], 1.0])
    turn = Rotation.from_euler("xy", tilt, degrees=True).as_matrix() @ _facing(fit, k)
    scale = float(np.linalg.norm(motions[k][:3, 3]))
    shift = motions[k][:3, 3] * (1.0 if fit.length_known or not scale else _unit(fit, k) / scale)
    R = motions[k][:3, :3]
    centre = R.T @ (depth * ray - shift)
    pose_turn = R.T @ turn
    offsets = np.append(centre - pose_turn @ centroid, Rotation.from_matrix(pose_turn @ fit.body_frame).as_euler("XYZ"))
    c, m = len(result.cameras), len(fit.points)
    cameras, markers = (grid.ravel() for grid in np.meshgrid(np.arange(c), np.arange(m), indexing="ij"))
    noise = fit.data.joint_noise
    assert noise is not None
    one = Measurements(
        offsets[None],
        cameras,
        np.zeros(c * m, dtype=np.int64),
        markers,
        np.zeros((c * m, 2)),
        np.full(c * m, float(np.median(fit.data.sigmas))),
    )
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
    """Rotation (3, 3) of the body in front of camera k that is nearest to the mean of its places."""
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
