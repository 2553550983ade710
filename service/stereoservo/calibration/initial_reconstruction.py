"""Start of a calibration: projective reconstruction of the first two cameras, its upgrade to the affine and metric
strata (thesis 5.4.3, 5.4.4): plane at infinity (5.59), camera intrinsics, start values of the metric model.

Frames: projective ``P`` with ``P_left = [N⁻¹ | 0]``; affine ``A`` with the plane at infinity (0, 0, 0, 1) and
the same left camera; Euclidean ``E`` with ``P_left = [K | 0]``. A generator's upper block in ``A`` is ``K̃
[w]ₓ K̃⁻¹`` with ``K̃ = N K``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stereoservo.calibration.rig_model import RigModel
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.geometry.cameras import canonical_pair, resection, triangulate
from stereoservo.geometry.displacements import exp_rotation, nearest_rotation_generator
from stereoservo.geometry.fundamental import (
    INLIER_SIGMAS,
    fundamental_refine,
    fundamental_robust,
    parallax_ratio,
    sampson_distances,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.screws import screw_twist
from stereoservo.geometry.strata import euclidean_to_projective, projective_to_euclidean, triangular_root
from stereoservo.numerics.arrays import BoolArray, FloatArray

SEPARATION = 10.0
"""Singular value, relative to its noise, above which it counts as nonzero."""
NOMINAL_FOCALS = (2.0, 3.0, 1.4)
"""Initial focal lengths [half image widths] if the linear estimate fails: 53°, 37° and 71° field of view."""


def planes_at_infinity(generators: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """Candidates (4,) for the plane that all generators (n, 4, 4) leave fixed, ``ker`` of the stack of ``-Ĥᵀ`` (5.59).

    Rows are weighted by ``noise`` (n,), the standard deviation of each generator's entries. First the least
    singular vector; then, of all that vanish within their noise, the one nearest to (0, 0, 0, 1), the plane at
    infinity of the canonical frame's nominal cameras: parallel axes leave a pencil of planes.
    """
    stack = (-generators.transpose(0, 2, 1) / noise[:, None, None]).reshape(-1, 4)
    _, values, rows = np.linalg.svd(stack)
    kernel = rows[values <= max(SEPARATION * np.sqrt(len(stack)), 1e-9 * values[0], values[3])]
    nearest: FloatArray = kernel.T @ kernel[:, 3]
    return rows[3], nearest, len(kernel) == 1


def scaled_plane(plane: FloatArray, points: FloatArray) -> FloatArray | None:
    """``plane`` (4,) scaled to mean height 1 over points (m, 4) of depth 1; None if it passes between the points."""
    scales = points @ plane / points[:, 2]
    mean = float(scales.mean())
    if mean == 0.0 or (scales / mean).min() <= 0.0:
        return None
    result: FloatArray = plane / mean
    return result


def affine_rig(rig: RigModel, plane: FloatArray) -> RigModel:
    """The projective ``rig`` in the affine frame of ``plane`` (4,), with generators snapped to it.

    Raises GeometryError if a generator is no rotation there: the plane is far from fixed.
    """
    moved = _transformed(rig, plane, np.eye(3))
    for j, kind in enumerate(rig.kinds):
        moved.generators[j, 3] = 0.0
        if kind == "revolute":
            moved.generators[j] = nearest_rotation_generator(moved.generators[j])
            moved.generators[j, 3] = 0.0
        else:
            moved.generators[j, :, :3] = 0.0
    return moved


def metric_rig(rig: RigModel, plane: FloatArray, intrinsics: FloatArray, spans: FloatArray) -> RigModel:
    """The projective ``rig`` in the Euclidean frame of ``plane`` (4,) and ``K̃`` (3, 3), generators unit twists.

    A revolute joint gets the rigid rotation nearest to its effect on the markers over half of its trial's
    range ``spans`` (n,) [rad]. That needs no exact frame, and uses a generator only where the markers are:
    off the plane of a planar target that moves within it, the generator is unknown.
    """
    moved = _transformed(rig, plane, intrinsics)
    for j, kind in enumerate(rig.kinds):
        if kind == "revolute":
            half = 0.25 * spans[j]
            ends = [moved.points @ exp_rotation(moved.generators[j], angle).T for angle in (-half, half)]
            moved.generators[j] = twist_between(*(end[:, :3] / end[:, 3:] for end in ends))
        else:
            moved.generators[j, 3] = 0.0
            moved.generators[j, :, :3] = 0.0
    return moved


def _transformed(rig: RigModel, plane: FloatArray, intrinsics: FloatArray) -> RigModel:
    upgrade, back = projective_to_euclidean(plane, intrinsics), euclidean_to_projective(plane, intrinsics)
    points = rig.points @ upgrade.T
    return RigModel(rig.kinds, upgrade @ rig.generators @ back, rig.cameras @ back, points / points[:, 3:], rig.lenses)


def twist_between(before: FloatArray, after: FloatArray) -> FloatArray:
    """Unit twist (4, 4), without pitch, of the rigid motion that best maps points (m, 3) to others (Kabsch)."""
    centroid, centroid_after = before.mean(axis=0), after.mean(axis=0)
    u, _, vt = np.linalg.svd((after - centroid_after).T @ (before - centroid))
    u[:, 2] *= np.linalg.det(u @ vt)
    rotation_vector = Rotation.from_matrix(u @ vt).as_rotvec()
    angle = float(np.linalg.norm(rotation_vector))
    axis = rotation_vector / angle
    # The centre lies on the bisector of the chord, at half its length over tan(θ/2) to the side.
    chord = centroid_after - centroid
    chord = chord - axis * (axis @ chord)
    centre = centroid + 0.5 * chord + 0.5 * np.cross(axis, chord) / np.tan(0.5 * angle)
    return screw_twist(axis, centre)


def intrinsics_linear(
    generators: FloatArray, revolute: npt.NDArray[np.bool_], noise: FloatArray
) -> tuple[FloatArray | None, bool]:
    """``K̃`` (3, 3) from affine generators (n, 4, 4) by ``A Ω + Ω Aᵀ = 0``, ``Ω = K̃ K̃ᵀ``, linear, weighted
    by ``noise`` (n,).

    None if noise leaves ``Ω`` indefinite. Second, whether ``Ω`` is unique beyond its noise.
    """
    blocks = generators[revolute, :3, :3] / noise[revolute, None, None]
    if not len(blocks):
        return None, False
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        basis[k, i, j] = basis[k, j, i] = 1.0
    system = blocks[:, None] @ basis + basis @ blocks[:, None].transpose(0, 1, 3, 2)
    _, values, rows = np.linalg.svd(system.transpose(0, 2, 3, 1).reshape(-1, 6))
    omega = np.tensordot(rows[5], basis, axes=1)
    omega = omega * np.sign(omega[2, 2])
    unique = bool(values[4] > SEPARATION * np.sqrt(9 * len(blocks)))
    return (triangular_root(omega) if np.linalg.eigvalsh(omega)[0] > 0.0 else None), unique


def nominal_intrinsics(focal: float) -> FloatArray:
    """``K̃`` (3, 3) of a camera with square pixels, central principal point and ``focal`` length [half widths]."""
    return np.diag([focal, focal, 1.0])


MIN_MATCHES = 16
"""Matches between two cameras below which a robust search for the epipolar geometry is not attempted."""
MIN_AGREEMENT = 0.4
"""Share of matches that must fit one epipolar geometry; below it the stated sigmas are increased once or twice."""
PARALLAX_RATIO, PARALLAX_SCATTER = 1.2, 3.0
"""Ratio of variances, homography to F, above which the parallax of n matches is significant: the first plus the second
over √n. Cameras with one centre give 1.13 to 1.33: F fits its own inliers a little too well."""
NARROW = 1.0 / 3.0
"""Factor on the sigmas in the second attempt: a nearly planar scene is refused only if planar to a third of the margin.
"""


def initial_reconstruction(trials: TrialData) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Projective reconstruction of all stops: cameras (c, 3, 4) in the canonical frame, points (s, m, 4), usable
    pixels (c, s, m).

    Points have depth 1 in the left camera, NaN if they are not usable in two cameras. Raises
    CalibrationError (``too_few_markers``, ``views_degenerate``).
    """
    c, s, m = trials.sigmas.shape
    flat = trials.pixels.reshape(c, s * m, 2)
    sigmas = np.where(trials.visible, trials.sigmas, 1.0).reshape(c, s * m)
    usable = np.zeros((c, s * m), dtype=bool)
    left, right = trials.cameras[:2]
    F, fits, seen = _epipolar(trials, flat, sigmas, 1)
    usable[:2, np.flatnonzero(seen)[fits]] = True
    try:
        P_left, P_right = canonical_pair(
            F,
            left.width,
            left.height,
            right_size=(right.width, right.height),
            left=flat[0, usable[0]],
            right=flat[1, usable[1]],
        )
        cameras = [P_left, P_right]
        points = triangulate(np.array(cameras), np.where(usable[:2, :, None], flat[:2], np.nan), sigmas[:2])
        for k in range(2, c):
            _, fits, seen = _epipolar(trials, flat, sigmas, k)
            usable[k, np.flatnonzero(seen)[fits]] = True
            both = usable[k] & np.isfinite(points).all(axis=1)
            cameras.append(resection(points[both], flat[k, both]))
        matrices = np.array(cameras)
        points = triangulate(matrices, np.where(usable[:, :, None], flat, np.nan), sigmas)
    except GeometryError as error:
        raise _degenerate(trials, 1, error) from error
    # Points behind a camera or in its focal plane come from wrong matches.
    depths = np.einsum("cj,pj->cp", matrices[:, 2], np.nan_to_num(points))
    common = np.sign(np.median(depths[:, np.isfinite(points).all(axis=1)], axis=1))
    matrices *= common[:, None, None]
    behind = (depths * common[:, None] <= 0) & usable
    usable &= ~behind
    points[behind.any(axis=0)] = np.nan
    return matrices, points.reshape(s, m, 4), usable.reshape(c, s, m)


def _epipolar(
    trials: TrialData, flat: FloatArray, sigmas: FloatArray, k: int
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """F of cameras 0 and k, the inliers among the common matches, and the mask (s m,) of these matches."""
    seen = np.isfinite(flat[0]).all(axis=1) & np.isfinite(flat[k]).all(axis=1)
    names = f"{trials.cameras[0].name!r} and {trials.cameras[k].name!r}"
    if int(seen.sum()) < MIN_MATCHES:
        raise CalibrationError(
            "too_few_markers",
            f"cameras {names} see {int(seen.sum())} markers in common over all stops; at least "
            f"{MIN_MATCHES} are needed",
            matches=int(seen.sum()),
            minimum=MIN_MATCHES,
        )
    sigma = float(np.sqrt(np.median(sigmas[0, seen] ** 2 + sigmas[k, seen] ** 2) / 2))
    best = 0.0
    for scale in (1.0, NARROW, 4.0, 16.0):
        try:
            F, _ = fundamental_robust(flat[0, seen], flat[k, seen], scale * sigma)
        except GeometryError as error:
            if scale == NARROW and error.code == "degenerate":
                weak = _weak_parallax(flat[0, seen], flat[k, seen], sigma)
                if weak is None:
                    rms = float(error.data.get("rms_px", np.nan))
                    raise CalibrationError(
                        "views_degenerate",
                        f"a plane explains what cameras {names} see in common to {rms:.3g} px, with sigmas of "
                        f"{sigma:.3g} px: their geometry stays open. The markers must not stay in one plane "
                        "over all trials, and the cameras must stand apart",
                        rms_px=rms,
                        sigma_px=sigma,
                    ) from error
                fits = np.abs(sampson_distances(weak, flat[0, seen], flat[k, seen])) <= INLIER_SIGMAS * sigma
                return weak, fits, seen
            continue
        fits = np.abs(sampson_distances(F, flat[0, seen], flat[k, seen])) <= INLIER_SIGMAS * max(1.0, scale) * sigma
        best = max(best, float(fits.mean()))
        if best >= MIN_AGREEMENT:
            return fundamental_refine(F, flat[0, seen][fits], flat[k, seen][fits], sigma), fits, seen
    raise CalibrationError(
        "views_degenerate",
        f"only {best:.0%} of the matches of cameras {names} fit one epipolar geometry at 16 sigmas "
        f"({16 * sigma:.3g} px); at least {MIN_AGREEMENT:.0%} must. Did a camera move, or are markers "
        "mixed up?",
        agreement=best,
        minimum=MIN_AGREEMENT,
    )


def _weak_parallax(left: FloatArray, right: FloatArray, sigma: float) -> FloatArray | None:
    """F (3, 3) of matches (n, 2) whose parallax is below the noise of each but significant over all; else None."""
    try:
        F, inliers = fundamental_robust(left, right, sigma, refuse_plane=False)
    except GeometryError:
        return None  # an undetermined geometry is reported by the other attempts
    enough = PARALLAX_RATIO + PARALLAX_SCATTER / np.sqrt(float(inliers.sum()))
    return F if parallax_ratio(F, left[inliers], right[inliers]) > enough else None


def _degenerate(trials: TrialData, k: int, error: GeometryError) -> CalibrationError:
    names = f"{trials.cameras[0].name!r} and {trials.cameras[k].name!r}"
    return CalibrationError(
        "views_degenerate",
        f"the views of cameras {names} do not determine their geometry: {error}. The cameras must be "
        "apart, and the markers must not stay in one plane over all trials",
        cause=error.code,
        cameras=[trials.cameras[0].name, trials.cameras[k].name],
    )
