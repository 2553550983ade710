"""Pose of a part before a pinhole of unknown focal length, from pixels of its vertices or from measured lines.

It only tells which edges are in sight and where about; what is reported are the lines themselves. Square pixels about
the image's centre are assumed, and a focal length near the image's width.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo_drivers.edges.line_measurement import MeasuredLine
from stereoservo_drivers.edges.part_file import Part

FOCAL_WIDTHS = 1.25
"""Focal length at first, in widths of the image."""
FOCAL_SIGMA = 0.4
"""Of its logarithm."""
ITERATIONS = 12
CONVERGED = 1e-6


@dataclass(frozen=True, eq=False)
class PartPose:
    """``R`` (3, 3), ``t`` (3,) from the part to the camera, ``focal`` [px], ``centre`` (2,) [px] of the image."""

    R: FloatArray
    t: FloatArray
    focal: float
    centre: FloatArray

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) of the part; NaN behind the camera."""
        X = points @ self.R.T + self.t
        depth = np.where(X[:, 2:] > 1e-6, X[:, 2:], np.nan)
        pixels: FloatArray = self.focal * X[:, :2] / depth + self.centre
        return pixels

    def in_sight(self, part: Part) -> BoolArray:
        """Which edges of the part (e,) border a face that is turned to the camera."""
        eye = -self.R.T @ self.t
        facing = (part.normals @ eye - part.offsets > 0.0).astype(np.float64)
        seen: BoolArray = part.sides @ facing > 0.0
        return seen

    def slopes(self, points: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 7) of the pixels by a turn about the part's middle, a shift, and the focal's logarithm."""
        turned = points @ self.R.T
        X = turned + self.t
        z = X[:, 2]
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = self.focal / z
        by_point[:, :, 2] = -self.focal * X[:, :2] / z[:, None] ** 2
        turn = np.zeros((len(points), 3, 3))
        turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = turned[:, 2], -turned[:, 1], turned[:, 0]
        turn -= turn.transpose(0, 2, 1)
        J = np.empty((len(points), 2, 7))
        J[:, :, :3], J[:, :, 3:6] = by_point @ turn, by_point
        J[:, :, 6] = self.focal * X[:, :2] / z[:, None]
        return J

    def stepped(self, step: FloatArray) -> PartPose:
        """The pose after a step (7,) along `slopes`."""
        turn = np.asarray(cv2.Rodrigues(step[:3].reshape(3, 1))[0], dtype=np.float64)
        return replace(
            self,
            R=turn @ self.R,
            t=self.t + step[3:6],
            focal=self.focal * float(np.exp(np.clip(step[6], -1, 1))),
        )


def pose_from_pixels(
    points: FloatArray, pixels: FloatArray, size: tuple[int, int], start: PartPose | None
) -> tuple[PartPose, float] | None:
    """Pose that shows points (n, 3) at pixels (n, 2) of an image of ``size`` (width, height), n >= 4, and the rms
    distance [px] that is left; from ``start`` where it is given. None where no pose with all points before the camera
    is found.
    """
    width, height = size
    centre = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    starts = [] if start is None else [start]
    focal = FOCAL_WIDTHS * width
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    try:
        found, turn, shift = cv2.solvePnP(
            points.reshape(-1, 1, 3), pixels.reshape(-1, 1, 2), K, None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        found = False
    if found:
        starts.append(PartPose(np.asarray(cv2.Rodrigues(turn)[0]), np.ravel(shift), focal, centre))
    best: tuple[PartPose, float] | None = None
    for pose in starts:
        fitted = _descend(pose, points, pixels)
        if fitted is not None and (best is None or fitted[1] < best[1]):
            best = fitted
    return best


def _descend(pose: PartPose, points: FloatArray, pixels: FloatArray) -> tuple[PartPose, float] | None:
    for _ in range(ITERATIONS):
        left = pixels - pose.pixels(points)
        if not np.isfinite(left).all():
            return None
        step = _solve(pose, pose.slopes(points).reshape(-1, 7), left.ravel(), np.ones(left.size), 1.0)
        pose = pose.stepped(step)
        if float(np.abs(step).max()) < CONVERGED:
            break
    left = pixels - pose.pixels(points)
    return (pose, float(np.sqrt((left**2).sum(axis=1).mean()))) if np.isfinite(left).all() else None


def _solve(pose: PartPose, J: FloatArray, left: FloatArray, weights: FloatArray, sigma: float) -> FloatArray:
    """Step (7,) of weighted least squares, with what is expected of the focal length."""
    expected = np.log(FOCAL_WIDTHS * (2.0 * pose.centre[0] + 1.0) / pose.focal) / FOCAL_SIGMA * sigma
    A = np.concatenate([J * weights[:, None], np.eye(7)[6:] * sigma / FOCAL_SIGMA])
    step: FloatArray = np.linalg.lstsq(A, np.append(left * weights, expected), rcond=1e-9)[0]
    return step


def line_distances(
    part: Part, pose: PartPose, lines: dict[int, MeasuredLine]
) -> tuple[FloatArray, FloatArray]:
    """Distances (n, 2) [px] of the ends of n measured lines from the part's edges in the pose, and their derivatives
    (n, 2, 7) by the pose, as `PartPose.slopes` has them.
    """
    rows = np.array(list(lines), dtype=np.int64)
    a, b = part.points[part.edges[rows, 0]], part.points[part.edges[rows, 1]]
    u, v = pose.pixels(a), pose.pixels(b)
    Ju, Jv = pose.slopes(a), pose.slopes(b)
    along = v - u
    squared = np.maximum((along**2).sum(axis=1), 1e-12)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.sqrt(squared)[:, None]
    ends = np.array([[line.at(line.span[0]), line.at(line.span[1])] for line in lines.values()])
    s = ((ends - u[:, None]) * along[:, None]).sum(axis=2) / squared[:, None]
    distances = ((ends - u[:, None]) * normal[:, None]).sum(axis=2)
    by_pose = (1.0 - s)[..., None] * np.einsum("ni,nij->nj", normal, Ju)[:, None] + s[..., None] * np.einsum(
        "ni,nij->nj", normal, Jv
    )[:, None]
    return distances, by_pose


def pose_from_lines(
    part: Part, pose: PartPose, lines: dict[int, MeasuredLine], scale_px: float
) -> PartPose | None:
    """Pose of least distance from measured lines, those far from it (beside ``scale_px``) counted little; None where
    the part would come behind the camera.
    """
    for _ in range(ITERATIONS):
        distances, J = line_distances(part, pose, lines)
        if not np.isfinite(distances).all():
            return None
        worst = np.abs(distances).max(axis=1, keepdims=True)
        weights = np.sqrt(1.0 / (1.0 + (worst / scale_px) ** 2)) * np.ones((1, 2))
        step = _solve(pose, J.reshape(-1, 7), distances.ravel(), weights.ravel(), scale_px)
        # A step beyond a quarter turn, or the part's distance, is no refinement.
        step = step / max(
            1.0, float(np.abs(step[:3]).max()) / 0.3, float(np.abs(step[3:6]).max()) / (0.3 * pose.t[2])
        )
        pose = pose.stepped(step)
        if float(np.abs(step).max()) < CONVERGED:
            break
    return pose if np.isfinite(pose.pixels(part.points)).all() else None


def segments_in_sight(part: Part, pose: PartPose) -> tuple[IntArray, FloatArray]:
    """Numbers (k,) of the edges in sight and their ends (k, 2, 2) [px]."""
    rows = np.flatnonzero(pose.in_sight(part))
    return rows, pose.pixels(part.points)[part.edges[rows]]
