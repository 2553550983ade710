"""Checks of ``stereoservo doctor`` on pairs of cameras: whether simultaneous observations fit the cell's model or the
epipolar constraint, and how much of the calibration motion lies inside the images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise, permutations, product

import numpy as np

from stereoservo.cli.doctor.camera_findings import CameraRecord, marker_scatter, mean_observations
from stereoservo.core.settings import TrialSettings
from stereoservo.geometry.cameras import project_many, triangulate
from stereoservo.geometry.distortion import distort, undistort
from stereoservo.geometry.fundamental import epipolar_distances, fundamental_robust
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CameraModel, CellModel
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import ExaminationFinding

FITS_PX = 0.5
"""Root mean square that views of one point may leave before the cameras are reported as moved."""
MATCHES = 10
"""Markers seen by two cameras that the epipolar constraint needs for a test: 7 are used up."""
AT_REST_PX = 1.0
"""Scatter of markers at rest at most: what is compared are means over time."""
WORKSPACE_SHARE = 0.9
SAME_PX = 0.5
"""Two cameras that show every marker this close to where the other does are one."""


def examine_views(records: Sequence[CameraRecord], model: CellModel | None) -> Iterator[ExaminationFinding]:
    """Findings on the simultaneous observations of pairs of cameras."""
    seen = [record for record in records if len(record.seen) >= 2]
    if len(seen) < 2:
        return
    moving = {
        record.name: scatter for record in seen if (scatter := marker_scatter(record) or 0.0) > AT_REST_PX
    }
    if moving:
        told = ", ".join(f"by {scatter:.1f} px in {name}" for name, scatter in moving.items())
        yield ExaminationFinding(
            "views " + "-".join(record.name for record in seen), None,
            f"the markers move meanwhile ({told}): views are compared where the arm stands",
        )  # fmt: skip
        return
    cameras = [] if model is None else [c for r in seen for c in model.cameras if c.name == r.name]
    if len(cameras) == len(seen):
        yield _by_model(seen, cameras)
        return
    for first, second in pairwise(seen):
        yield _by_epipolar(first, second)


def _common(records: Sequence[CameraRecord]) -> tuple[list[int], FloatArray]:
    """Markers seen by all cameras, and their raw pixels (c, k, 2)."""
    means = [mean_observations(record) for record in records]
    ids = sorted(set.intersection(*(set(found.tolist()) for found, _, _ in means)))
    pixels = [
        np.array([pixels[found.tolist().index(i)] for i in ids]).reshape(-1, 2) for found, pixels, _ in means
    ]
    return ids, np.array(pixels)


def reprojection_rms(cameras: Sequence[CameraModel], pixels: FloatArray) -> float:
    """Rms reprojection error [px] per coordinate of triangulated points in raw pixels (c, k, 2); NaN without
    points.
    """
    Ps = np.array([camera.matrix for camera in cameras])
    ideal = np.array([undistort(camera.lens, p) for camera, p in zip(cameras, pixels, strict=True)])
    points = triangulate(Ps, ideal)
    raw = np.array(
        [distort(camera.lens, m) for camera, m in zip(cameras, project_many(Ps, points), strict=True)]
    )
    squares = (raw - pixels) ** 2
    free = squares[np.isfinite(squares)].size - 3 * int(np.isfinite(points[:, 0]).sum())
    return float(np.sqrt(np.nansum(squares) / free)) if free > 0 else float("nan")


def _by_model(records: Sequence[CameraRecord], cameras: Sequence[CameraModel]) -> ExaminationFinding:
    ids, pixels = _common(records)
    name = "views " + "-".join(record.name for record in records)
    if not ids:
        return ExaminationFinding(name, None, "no marker is seen by all of them at once: nothing to compare")
    rms = reprojection_rms(cameras, pixels)
    summary = f"{len(ids)} markers seen by all leave {rms:.3f} px by the model's cameras"
    if rms <= FITS_PX:
        return ExaminationFinding(name, True, summary)
    for order in permutations(range(len(cameras))):
        if order == tuple(range(len(cameras))):
            continue
        if reprojection_rms([cameras[k] for k in order], pixels) <= FITS_PX:
            swapped = ", ".join(
                f"{r.name!r} shows what {cameras[k].name!r} did"
                for r, k in zip(records, order, strict=True)
                if r.name != cameras[k].name
            )
            return ExaminationFinding(
                name,
                False,
                f"{summary}: {swapped}",
                "exchange their sources, or their cables; none has moved",
            )
    return ExaminationFinding(
        name, False,
        f"{summary}; {FITS_PX:g} is the limit for cameras that stand where they stood: one has moved or zoomed",
        "re-anchor it (the running daemon does, once it sees enough), or `stereoservo calibrate`",
    )  # fmt: skip


def _by_epipolar(first: CameraRecord, second: CameraRecord) -> ExaminationFinding:
    ids, pixels = _common([first, second])
    name = f"views {first.name}-{second.name}"
    if len(ids) < MATCHES:
        return ExaminationFinding(
            name,
            None,
            f"{len(ids)} markers are seen by both; the epipolar constraint needs {MATCHES} to say anything",
        )
    sigma = float(np.median(np.concatenate([mean_observations(first)[2], mean_observations(second)[2]])))
    try:
        F, inliers = fundamental_robust(pixels[0], pixels[1], max(sigma, 0.05))
    except GeometryError as error:
        return ExaminationFinding(name, None, f"no epipolar constraint yet: {error}")
    distances = epipolar_distances(F, pixels[0], pixels[1])
    rms = float(np.sqrt(np.mean(distances[inliers] ** 2)))
    summary = f"{int(inliers.sum())} of {len(ids)} markers agree on one epipolar geometry, {rms:.3f} px"
    if inliers.all():
        return ExaminationFinding(name, True, summary)
    off = [marker for marker, inside in zip(ids, inliers, strict=True) if not inside]
    return ExaminationFinding(
        name, False, f"{summary}; markers {off} do not",
        "are they mistaken for others, or is there a second plate in view?",
    )  # fmt: skip


def same_camera_twice(records: Sequence[CameraRecord], pixels: float = SAME_PX) -> ExaminationFinding | None:
    """Finding on two cameras that show one picture: every marker within ``pixels`` [px] of the other's."""
    for k, first in enumerate(records):
        for second in records[k + 1 :]:
            ids, at, _ = mean_observations(first)
            others, where, _ = mean_observations(second)
            if len(ids) < 4 or list(ids) != list(others):
                continue
            if abs(at - where).max() <= pixels:
                return ExaminationFinding(
                    f"cameras {first.name}-{second.name}", False,
                    f"{first.name!r} and {second.name!r} show one and the same picture: one camera given twice",
                    "camera.options of one of them: source",
                )  # fmt: skip
    return None


def examine_coverage(
    model: CellModel, trials: TrialSettings, records: Sequence[CameraRecord]
) -> Iterator[ExaminationFinding]:
    """Findings on the share of the trial motions inside each camera's image, by the model, at all corners of two
    joints.
    """
    configurations = _corners(trials)
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
    points = np.array([model.marker_points @ chain.displacement(q).T for q in configurations])
    for record in records:
        camera = next((c for c in model.cameras if c.name == record.name), None)
        if camera is None:
            continue
        m = points.reshape(-1, 4) @ camera.matrix.T
        raw = distort(camera.lens, m[:, :2] / m[:, 2:])
        inside = (raw >= 0).all(axis=1) & (raw[:, 0] <= camera.width - 1) & (raw[:, 1] <= camera.height - 1)
        share = float(inside.mean())
        summary = f"{100 * share:.0f} % of the markers' places in the calibrated range are in the picture"
        wide = share >= WORKSPACE_SHARE
        yield ExaminationFinding(
            f"{record.name} coverage", True if wide else None, summary,
            "" if wide else "a shorter lens, more distance, or goals that keep to the middle",
        )  # fmt: skip


def _corners(trials: TrialSettings) -> FloatArray:
    reach = np.where(np.isfinite(trials.range), trials.range, 0.0)
    found = [trials.base]
    for i, j in product(range(reach.size), repeat=2):
        for a, b in product((-1.0, 1.0), repeat=2):
            q = trials.base.copy()
            q[i] += a * reach[i]
            if i != j:
                q[j] += b * reach[j]
            found.append(q)
    return np.array(found)
