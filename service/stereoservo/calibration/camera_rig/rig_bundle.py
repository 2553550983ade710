"""Bundle adjustment of a camera rig: the bundle of a cell (:mod:`stereoservo.calibration.bundle_adjustment`) with a
fictitious arm of six joints without readings, three along and three about the axes of the first camera, in place of
the hand that waves the body.

The six joints' errors at each stop are estimated with the other parameters; their standard deviations are so large that
they do not constrain the poses. Cameras are tied to pixels without skew, a single focal length, and a lens centred at
the principal point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.camera_rig.views import RigViews, refused
from stereoservo.calibration.initial_reconstruction import (
    NOMINAL_FOCALS,
    initial_reconstruction,
    intrinsics_linear,
    nominal_intrinsics,
    planes_at_infinity,
    scaled_plane,
)
from stereoservo.calibration.joint_noise import joint_columns
from stereoservo.calibration.least_squares import DenseFit, Limits, column_root, minimise
from stereoservo.calibration.lens_estimation import epipolar_lenses, undistorted
from stereoservo.calibration.rig_model import (
    JointNoise,
    Measurements,
    PinholeTies,
    RigModel,
    displacements,
    predicted,
    residuals,
    rig_at,
)
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.geometry.cameras import pixel_normaliser
from stereoservo.geometry.displacements import similarity_from_points
from stereoservo.geometry.distortion import lens_from_lines, pinhole_lens, undistort
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.homography import homography_from_points, plane_homography
from stereoservo.geometry.screws import twist_matrix
from stereoservo.geometry.strata import decompose_camera, projective_to_euclidean
from stereoservo.kinematics.parameterization import Kind, LensModel
from stereoservo.numerics.arrays import BoolArray, FloatArray

FOCAL_RANGE = (0.8, 20.0)
"""Range of initial focal lengths [half image widths]; outside it a nominal one is used."""
LINE_MARKERS = 5
"""Least number of a layout's markers on a line whose image is used to estimate the lens."""
LINES = 16
"""Approximate number of lines, evenly spread over the views, that initialise a lens."""
ON_LINE = 1e-6
"""Distance from a line, relative to the layout's size, up to which a marker counts as on it."""


@dataclass(frozen=True)
class RigStart:
    """Start of a bundle: ``cameras`` (c, 3, 4) in the first one's frame, ``poses`` (s, 4, 4) of the body in it,
    ``points`` (m, 3) on the body, ``lenses`` (c, 4). Lengths are in metres if the layout is known, else in an
    arbitrary unit; the body is then in its reference pose at stop ``reference``.
    """

    cameras: FloatArray
    poses: FloatArray
    points: FloatArray
    lenses: FloatArray
    reference: int | None


def rigid(R: FloatArray, t: FloatArray) -> FloatArray:
    """Motion (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def starts(views: RigViews) -> list[RigStart]:
    """Starts of the bundle, the best first. Raises CalibrationError if the views determine none."""
    return [_start_of_layout(views)] if views.layout is not None else _starts_of_body(views)


# -- a board of known layout --------------------------------------------------------------------------------


def _start_of_layout(views: RigViews) -> RigStart:
    assert views.layout is not None
    lenses = np.array([_line_lens(views, k) for k in range(len(views.cameras))])
    frame, plane = _in_plane(views.layout)
    homographies = plane_homographies(views, lenses, plane)
    focals = np.array([_focal(views, k, homographies[k]) for k in range(len(views.cameras))], dtype=np.float64)
    c, s = homographies.shape[:2]
    poses = np.full((c, s, 4, 4), np.nan)
    for k in range(c):
        for stop in np.flatnonzero(np.isfinite(homographies[k]).all(axis=(1, 2))):
            poses[k, stop] = _plane_pose(homographies[k, stop], focals[k], lenses[k, 1:3]) @ frame
    extrinsics = _extrinsics(poses)
    counts = views.seen.sum(axis=2)
    best = np.argmax(counts, axis=0)
    body = np.array([np.linalg.inv(extrinsics[best[i]]) @ poses[best[i], i] for i in range(s)])
    cameras = np.array([_pinhole(focals[k], lenses[k, 1:3]) @ extrinsics[k][:3] for k in range(c)])
    return RigStart(cameras, body, views.layout.copy(), lenses, None)


def _pinhole(focal: float, centre: FloatArray) -> FloatArray:
    return np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])


def _in_plane(layout: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motion (4, 4) of the layout into its plane z = 0, and its coordinates (m, 2) there."""
    centroid = layout.mean(axis=0)
    rows = np.linalg.svd(layout - centroid)[2]
    rows[2] *= np.linalg.det(rows)
    frame = rigid(rows, -rows @ centroid)
    return frame, (layout - centroid) @ rows[:2].T


def plane_homographies(views: RigViews, lenses: FloatArray, plane: FloatArray) -> FloatArray:
    """Homographies (c, s, 3, 3) from the plane (m, 2) to ideal pixels; NaN if a camera did not see it."""
    c, s, _ = views.sigmas.shape
    found = np.full((c, s, 3, 3), np.nan)
    for k in range(c):
        ideal = undistort(lenses[k], views.pixels[k])
        for stop in range(s):
            visible = np.isfinite(ideal[stop]).all(axis=1)
            if int(visible.sum()) >= 4:
                try:
                    found[k, stop] = plane_homography(plane[visible], ideal[stop, visible])
                except GeometryError:
                    continue  # the markers seen in this image are on one line: no homography
    return found


def _line_lens(views: RigViews, k: int) -> FloatArray:
    """Lens (4,) of camera k from the images of the layout's straight lines; without distortion if there are none."""
    camera, lines = views.cameras[k], []
    for members in _layout_lines(views.layout):
        for raw in views.pixels[k][:, members]:
            visible = raw[np.isfinite(raw).all(axis=1)]
            if len(visible) >= LINE_MARKERS:
                lines.append(visible)
    lines = lines[:: max(1, len(lines) // LINES)]
    if lines:
        sigma = float(np.median(views.sigmas[k][views.seen[k]]))
        try:
            found = lens_from_lines(lines, sigma, camera.width, camera.height).lens
            # Lines hardly determine the centre of a weak distortion, and the principal point is tied to it.
            return np.append(found[0], pinhole_lens(camera.width, camera.height)[1:])
        except GeometryError:
            pass  # the bundle converges from a lens without distortion, too
    return pinhole_lens(camera.width, camera.height)


def _layout_lines(layout: FloatArray | None) -> list[list[int]]:
    """Markers of each line along the layout's own axes that contains enough of them."""
    if layout is None:
        return []
    size = float(np.ptp(layout, axis=0).max())
    found = []
    for axis in range(3):
        others = np.delete(layout, axis, axis=1)
        keys = np.round(others / (ON_LINE * size)).astype(np.int64)
        for key in np.unique(keys, axis=0):
            members = np.flatnonzero((keys == key).all(axis=1)).tolist()
            if len(members) >= LINE_MARKERS:
                found.append(members)
    return found


def _focal(views: RigViews, k: int, homographies: FloatArray) -> float:
    """Focal length [px] from the circular points of all places, with a central principal point; nominal if they do
    not determine it: ``h₁ᵀ ω h₂ = 0``, ``h₁ᵀ ω h₁ = h₂ᵀ ω h₂``, linear in 1/f².
    """
    camera = views.cameras[k]
    N = pixel_normaliser(camera.width, camera.height)
    rows, right = [], []
    for H in homographies[np.isfinite(homographies).all(axis=(1, 2))]:
        G = N @ H
        a, b = G[:, 0], G[:, 1]
        size = float(np.linalg.norm(a) * np.linalg.norm(b))
        rows += [(a[:2] @ b[:2]) / size, (a[:2] @ a[:2] - b[:2] @ b[:2]) / size]
        right += [-a[2] * b[2] / size, -(a[2] ** 2 - b[2] ** 2) / size]
    square = float(np.dot(rows, right) / max(float(np.dot(rows, rows)), 1e-300))
    focal = 1.0 / np.sqrt(square) if square > 0.0 else NOMINAL_FOCALS[0]
    if not FOCAL_RANGE[0] <= focal <= FOCAL_RANGE[1]:
        focal = NOMINAL_FOCALS[0]
    return float(focal) * camera.width / 2.0


def _plane_pose(H: FloatArray, focal: float, centre: FloatArray) -> FloatArray:
    """Pose (4, 4) of the plane z = 0 whose homography to ideal pixels is ``H`` (3, 3)."""
    M = np.linalg.solve(_pinhole(focal, centre), H)
    M = M / np.sqrt(np.linalg.norm(M[:, 0]) * np.linalg.norm(M[:, 1])) * (np.sign(M[2, 2]) or 1.0)
    U, _, Vt = np.linalg.svd(np.column_stack([M[:, 0], M[:, 1], np.cross(M[:, 0], M[:, 1])]))
    return rigid(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, M[:, 2])


def _extrinsics(poses: FloatArray) -> FloatArray:
    """Motions (c, 4, 4) from the first camera's frame into each, along the pairs with most common places."""
    c = len(poses)
    known = np.asarray(np.isfinite(poses).all(axis=(2, 3)))
    found = np.full((c, 4, 4), np.nan)
    found[0], done = np.eye(4), {0}
    while len(done) < c:
        common = [(int((known[j] & known[k]).sum()), j, k) for j in done for k in range(c) if k not in done]
        count, j, k = max(common)
        if not count:
            raise refused(
                "camera_apart",
                "a camera has no place of the board in common with another",
                0,
                1,
                " places",
                "Hold it where two cameras at a time see it",
            )
        both = np.flatnonzero(known[j] & known[k])
        motions = np.array([poses[k, i] @ np.linalg.inv(poses[j, i]) for i in both])
        turns = Rotation.from_matrix(motions[:, :3, :3])
        deviations = [np.median((turns * turns[i].inv()).magnitude()) for i in range(len(both))]
        found[k] = motions[int(np.argmin(deviations))] @ found[j]
        done.add(k)
    return found


# -- a body of unknown layout -------------------------------------------------------------------------------


def _starts_of_body(views: RigViews) -> list[RigStart]:
    trials = TrialData(
        (), (), views.cameras, views.marker_ids, np.zeros((len(views.names), 0)),
        np.full(len(views.names), -1), views.pixels, views.sigmas,
    )  # fmt: skip
    found, failure = [], None
    for lenses in (
        epipolar_lenses(trials),
        np.array([pinhole_lens(c.width, c.height) for c in views.cameras]),
    ):
        try:
            found += _starts_through(views, trials, lenses)
        except (CalibrationError, GeometryError, np.linalg.LinAlgError) as error:
            failure = failure or error
    if not found and failure is not None:
        raise failure
    return found


def _starts_through(views: RigViews, trials: TrialData, lenses: FloatArray) -> list[RigStart]:
    """Starts with these ``lenses`` (c, 4): with noise of one pixel, estimated lenses may be wrong; if the bundle from
    them does not converge, one without distortion may.
    """
    cameras, points, _ = initial_reconstruction(undistorted(trials, lenses))
    known = np.asarray(np.isfinite(points).all(axis=2))
    reference = int(np.argmax((known[:, None] & known[None]).sum(axis=2).clip(0, 8).sum(axis=1)))
    motions = _displacements(points, reference)
    plane, _, _ = planes_at_infinity(motions - np.eye(4), np.ones(len(motions)))
    everywhere = points[known]
    scaled = scaled_plane(plane, everywhere)
    if scaled is None:
        scaled = scaled_plane(np.array([0.0, 0.0, 0.0, 1.0]), everywhere)
    if scaled is None:
        raise refused(
            "no_upgrade",
            "no plane at infinity leaves the body in front of the cameras",
            0,
            1,
            " planes",
            "Turn the body about two axes, by 30 degrees or more, and hold it still for each picture",
        )
    A = projective_to_euclidean(scaled, np.eye(3))
    affine = A @ motions @ np.linalg.inv(A)
    rotations = 0.5 * (affine - np.linalg.inv(affine))
    linear, _ = intrinsics_linear(rotations, np.ones(len(rotations), dtype=bool), np.ones(len(rotations)))
    focals = [] if linear is None else [float(np.sqrt(linear[0, 0] * linear[1, 1]))]
    focals = [f for f in focals if FOCAL_RANGE[0] <= f <= FOCAL_RANGE[1]] + list(NOMINAL_FOCALS)
    return [_metric_start(views, cameras, points, reference, scaled, nominal_intrinsics(f), lenses) for f in focals]


def _displacements(points: FloatArray, reference: int) -> FloatArray:
    """Projective displacements (k, 4, 4), of determinant 1, from the reference place to the others.

    Raises CalibrationError (``flat_body``, ``too_few_markers``).
    """
    known, found, flat = np.asarray(np.isfinite(points).all(axis=2)), [], 0
    for stop in range(len(points)):
        common = known[stop] & known[reference]
        if stop == reference or int(common.sum()) < 6:
            continue
        try:
            H = homography_from_points(points[reference, common], points[stop, common])
        except GeometryError as error:
            if error.code != "degenerate":
                raise
            flat += 1
            continue
        found.append(H if np.linalg.det(H) > 0 else -H)
    if len(found) < 2:
        if flat:
            raise refused(
                "flat_body",
                "the markers lie in one plane within their noise: places that show the body's depth",
                len(found),
                2,
                " places",
                "State the layout (--board with --pitch, or --layout), or use a body with markers off one plane",
            )
        raise refused(
            "too_few_markers",
            "too few places show six markers in two cameras",
            len(found),
            2,
            " places",
            "Turn the body so that two cameras at a time see the same six markers",
        )
    return np.array(found)


def _metric_start(
    views: RigViews,
    cameras: FloatArray,
    points: FloatArray,
    reference: int,
    plane: FloatArray,
    intrinsics: FloatArray,
    lenses: FloatArray,
) -> RigStart:
    """The start in the Euclidean frame of ``plane`` (4,) and ``intrinsics`` (3, 3) [half widths]."""
    upgrade = projective_to_euclidean(plane, intrinsics)
    matrices = cameras @ np.linalg.inv(upgrade)
    X = points @ upgrade.T
    X = X[..., :3] / X[..., 3:]
    finite = np.asarray(np.isfinite(X).all(axis=2))
    poses = np.full((len(X), 4, 4), np.nan)
    poses[reference] = np.eye(4)
    body = X[reference].copy()
    for _ in range(len(X)):
        known = np.asarray(np.isfinite(body).all(axis=1))
        open_stops = np.flatnonzero(~np.isfinite(poses[:, 0, 0]))
        if not len(open_stops):
            break
        stop = int(open_stops[np.argmax((finite[open_stops] & known).sum(axis=1))])
        common = finite[stop] & known
        try:
            poses[stop] = similarity_from_points(body[common], X[stop, common], scaled=False)
        except GeometryError:
            break  # the remaining ones have too few known points: left out
        new = finite[stop] & ~known
        body[new] = (X[stop, new] - poses[stop, :3, 3]) @ poses[stop, :3, :3]
    # The first camera is K [I | 0] in this frame. The other cameras' pixels are not square yet: the bundle's ties
    # enforce that as far as it explains the images.
    return RigStart(
        matrices / np.linalg.norm(matrices[:, 2, :3], axis=1)[:, None, None], poses, body, lenses, reference
    )


HAND: tuple[Kind, ...] = ("prismatic",) * 3 + ("revolute",) * 3
TIED = 1e-2
"""Standard deviation of a tie [px]: small enough to dominate the data, large enough that steps do not stall."""
LOOSE = 10.0
"""Initial ties [px] of the bundle of an unknown body, whose cameras do not have square pixels yet."""
WIDE = 100.0
"""Standard deviations of the hand's joints: rotations [rad], translations [distances of the body]."""
OUTLIER = 5.0
"""Residual, in estimated standard deviations of the noise, beyond which a measurement is left out."""
ROUNDS = 3
ASPECT_GAIN = 25.0
"""Gain in chi-square from which non-square pixels are accepted, plus 2 for each camera."""
ASPECT_ROUNDS = 3
EVALUATIONS = 150
POSE = Limits(evaluations=40, tolerance=1e-6)
"""Termination of the fit of one pose."""
FRAMES = 60
"""Number of tried body frames; the one whose middle angle stays farthest from a quarter turn is used."""


@dataclass(frozen=True)
class RigProblem:
    """Input of a bundle of ``views``: the mask ``kept`` (k,) of the ``data``'s measurements, the ``body_frame`` (3, 3)
    of the hand's angles. ``aspect``: factor on row coordinates that makes pixels square.
    """

    views: RigViews
    data: Measurements
    kept: BoolArray
    body_frame: FloatArray
    aspect: float
    length_known: bool


@dataclass(frozen=True)
class RigFit(RigProblem):
    """Bundle of a problem, with its ``solution``."""

    solution: Solution

    @property
    def rig(self) -> RigModel:
        """The model at the minimum."""
        return self.solution.rig

    @cached_property
    def poses(self) -> FloatArray:
        """Poses (s, 4, 4) of the body in the first camera's frame."""
        found: FloatArray = displacements(self.rig, self.solution.data.offsets)
        found[:, :3, :3] = found[:, :3, :3] @ self.body_frame.T
        return found

    @property
    def points(self) -> FloatArray:
        """Markers (m, 3) on the body."""
        return np.asarray(self.rig.points[:, :3] @ self.body_frame.T)

    @property
    def freedoms(self) -> int:
        """Degrees of freedom: residuals minus parameters, those of the body's poses included."""
        solution = self.solution
        free = len(self.views.names) - (0 if self.length_known else 1)
        return solution.rows - solution.charts.size - 6 * free

    @property
    def variance(self) -> float:
        """Variance factor: estimated over stated variance."""
        return self.solution.cost / max(self.freedoms, 1)

    @cached_property
    def residuals(self) -> FloatArray:
        """Residuals (k, 2) [px] of all measurements, including rejected ones."""
        data = replace(self.data, offsets=self.solution.data.offsets)
        return np.asarray((predicted(self.rig, data) - data.pixels) / np.array([1.0, self.aspect]))

    @cached_property
    def root(self) -> FloatArray:
        """``R⁻¹`` (p, p), with ``R⁻¹ R⁻ᵀ`` the covariance of the parameters at the variance of the residuals."""
        return np.asarray(self.solution.statistics.root * np.sqrt(self.variance))

    def retract(self, x: FloatArray) -> RigModel:
        """The model at chart coordinates ``x`` (p,)."""
        return rig_at(self.rig, self.solution.charts, x)

    def pose_deviations(self) -> FloatArray:
        """Standard deviations (s, 6) of the body's poses for exact cameras: along [m] and about [rad] the axes."""
        data = self.solution.data
        rows = joint_columns(self.rig, data)
        found = np.full((len(self.views.names), 6), np.inf)
        for stop in np.unique(data.stop):
            root = column_root(rows[np.repeat(data.stop == stop, 2)], bounded=True)
            found[stop] = np.sqrt(self.variance) * np.linalg.norm(root, axis=1)
        return found


def fit_rig(views: RigViews, start: RigStart, lenses: LensModel = "brown") -> RigFit:
    """The bundle from ``start``, with outliers rejected in rounds and non-square pixels detected.

    If its ``solution`` has not converged, the data leave the cameras undetermined. Raises GeometryError, LinAlgError if
    they determine no model.
    """
    views, start = _placed(views, start)
    data, body_frame = _measurements(views, start)
    rig = _rig(start, body_frame)
    known = start.reference is None
    if known:
        data = _with_refined_poses(rig, data)
    begun = RigProblem(views, data, np.ones(len(data.camera), dtype=bool), body_frame, 1.0, known)
    if not known:
        ties = PinholeTies(LOOSE, LOOSE, LOOSE)
        loose = _converged(begun, rig, lenses, ties)
        if not loose.solution.converged:  # its first step is too large for the initial places
            begun = replace(begun, data=_with_refined_poses(rig, data))
            loose = _converged(begun, rig, lenses, ties)
        if not loose.solution.converged:
            return loose
        begun, rig = loose, loose.rig
    square = _converged(begun, rig, lenses, PinholeTies(TIED, TIED, TIED))
    if not square.solution.converged:
        return square
    open_aspect = PinholeTies(TIED, np.inf, TIED)
    free = _converged(square, square.rig, lenses, open_aspect)
    if not free.solution.converged:
        return free
    # Pixels are square unless the chi-square of all cameras' aspects is far beyond chance.
    gain = (square.solution.cost - free.solution.cost) / max(free.variance, 1e-300)
    if gain < ASPECT_GAIN + 2.0 * len(views.cameras):
        return square
    for _ in range(ASPECT_ROUNDS):
        ratio = np.mean([np.divide(*np.diag(decompose_camera(P)[0])[:2]) for P in free.rig.cameras])
        free = _converged(*_stretched(free, float(ratio)), lenses, open_aspect)
        if not free.solution.converged:
            break
    return free


def _stretched(fit: RigFit, ratio: float) -> tuple[RigFit, RigModel]:
    """The fit with row coordinates scaled by ``ratio``, as a new start."""
    stretch = np.diag([1.0, ratio, 1.0])
    lenses = fit.rig.lenses * np.array([1.0, 1.0, ratio, 1.0, 1.0, 1.0, 1.0])
    rig = replace(fit.rig, cameras=stretch @ fit.rig.cameras, lenses=lenses)
    data = replace(fit.data, pixels=fit.data.pixels * np.array([1.0, ratio]))
    return replace(fit, data=data, aspect=fit.aspect * ratio), rig


def _placed(views: RigViews, start: RigStart) -> tuple[RigViews, RigStart]:
    """Views and start restricted to the stops and markers whose initial poses and points are known."""
    stops, markers = np.isfinite(start.poses[:, 0, 0]), np.isfinite(start.points[:, 0])
    reference = None if start.reference is None else int(stops[: start.reference].sum())
    return views.select(stops, markers), replace(
        start, poses=start.poses[stops], points=start.points[markers], reference=reference
    )


def _converged(begun: RigProblem, rig: RigModel, lenses: LensModel, ties: PinholeTies) -> RigFit:
    """The bundle from ``rig``, starting with the places and the kept measurements of ``begun``."""
    data, kept = replace(begun.data, pinhole_ties=ties), begun.kept
    for _ in range(ROUNDS):
        solution = solve(
            rig,
            data.select(kept),
            "metric",
            generators=False,
            points=not begun.length_known,
            lenses=lenses,
            max_evaluations=EVALUATIONS,
        )
        data, rig = replace(data, offsets=solution.data.offsets), solution.rig
        fit = RigFit(begun.views, data, kept, begun.body_frame, begun.aspect, begun.length_known, solution)
        sizes = np.linalg.norm(fit.residuals, axis=1) / data.sigmas
        # The median of a Rayleigh distribution is 1.1774 sigmas.
        noise = float(np.median(sizes[np.isfinite(sizes)])) / 1.1774
        inside = np.isfinite(sizes) & (sizes <= OUTLIER * max(noise, 1e-9) * np.sqrt(2.0))
        if (inside == kept).all():
            break
        kept = inside
    return fit


def _with_refined_poses(rig: RigModel, data: Measurements) -> Measurements:
    """The measurements with the hand's readings fitted to each stop separately, with cameras and body fixed, because
    the bundle does not damp the hand's errors.
    """
    offsets = data.offsets.copy()
    for stop in np.unique(data.stop):
        mine = data.select(data.stop == stop)
        offsets[stop] = _refined_pose(rig, replace(mine, stop=np.zeros_like(mine.stop)), offsets[stop])
    return replace(data, offsets=offsets)


def _refined_pose(rig: RigModel, data: Measurements, reading: FloatArray) -> FloatArray:
    fit = DenseFit[FloatArray](
        lambda q: residuals(rig, replace(data, offsets=q[None]))[:, None],
        lambda q: joint_columns(rig, replace(data, offsets=q[None]))[:, None],
        np.add,
    )
    return minimise(fit, reading, POSE).state


def _rig(start: RigStart, body_frame: FloatArray) -> RigModel:
    none, axes = np.zeros(3), np.eye(3)
    generators = np.concatenate([twist_matrix(none, axes), twist_matrix(axes, none)])
    lenses = np.hstack([start.lenses, np.zeros((len(start.lenses), 3))])
    points = np.hstack([start.points @ body_frame, np.ones((len(start.points), 1))])
    return RigModel(HAND, generators, start.cameras, points, lenses)


def _measurements(views: RigViews, start: RigStart) -> tuple[Measurements, FloatArray]:
    """The flat list of measurements, with the hand's readings at the start's poses, and the body's frame."""
    turns = Rotation.from_matrix(start.poses[:, :3, :3])
    tried = [Rotation.identity(), *Rotation.random(FRAMES, rng=np.random.default_rng(1))]
    worst = [float(np.abs(np.sin((turns * frame).as_euler("XYZ")[:, 1])).max()) for frame in tried]
    frame = tried[int(np.argmin(worst))]
    offsets = np.hstack([start.poses[:, :3, 3], (turns * frame).as_euler("XYZ")])
    s = len(offsets)
    own = np.tile(np.repeat([WIDE * float(np.abs(start.poses[:, :3, 3]).max()), WIDE], 3), (s, 1))
    if start.reference is not None:
        own[start.reference] = 0.0
    noise = JointNoise(own, np.full((s, 6), -1), np.zeros(0), np.zeros((s, 0)), np.zeros(6))
    camera, stop, marker = np.nonzero(views.seen)
    data = Measurements(
        offsets,
        camera,
        stop,
        marker,
        views.pixels[camera, stop, marker],
        views.sigmas[camera, stop, marker],
        joint_noise=noise,
    )
    return data, frame.as_matrix()
