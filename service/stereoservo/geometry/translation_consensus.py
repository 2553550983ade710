"""Plane at infinity and translation directions from images of a moved scene, with disagreeing motions rejected (thesis
3.2.2, 3.2.3).

Every motion is tested by itself, and then against the plane at infinity on which most of them agree. All thresholds
follow from the noise of the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.geometry.cameras import triangulate, triangulation_covariance
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.reprojection_fit import Images, covariance_of, minimise, read_images, with_rest
from stereoservo.geometry.strata import oriented_plane
from stereoservo.geometry.translation_fit import (
    TranslationFit,
    bundle_translations,
    homography_motion,
    planar_start,
    plane_basis,
)
from stereoservo.geometry.translations import (
    Weighting,
    direction_given_plane,
    image_weighting,
    plane_at_infinity_from_stack,
    translation_from_homography,
    translation_homography,
)
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

Reason = Literal["", "unseen", "points", "conditioning", "not_a_translation", "no_motion", "other_plane"]

TAIL = 1e-3
"""Probability with which one test rejects a good motion."""
ROUNDS = 5
"""Most rounds of selecting the agreeing motions."""
SCALE_DEVIATION = 1.0 / 3.0
"""Largest relative standard deviation of a point's height: at three of them the point reaches the plane at infinity."""


@dataclass(frozen=True, eq=False)
class MotionTest:
    """Result of the test of one motion from rest.

    ``reason`` why it is left out, empty if it is used: ``unseen`` (too few points before and after),
    ``points`` (no homography fits: wrong matches), ``conditioning`` (``σ₂`` of the homography's generator is above
    the value that noise explains), ``not_a_translation`` (a homography fits, a translation does not), ``no_motion``
    (it contains no plane at infinity), ``other_plane`` (a translation, but with a different plane at
    infinity from the others). ``conditioning`` σ₁/σ₂ and ``least_conditioning``, below which noise does not
    explain it; ``excess`` the chi-square by which the translation fits worse than the homography, with nine degrees of
    freedom; ``distance`` the squared Mahalanobis distance of its plane from that of the others, with three;
    ``scale_deviation`` the largest relative standard deviation of a point's height above its own plane: a motion above
    `SCALE_DEVIATION` determines too little by itself, but adds to others. NaN where not computed.
    """

    reason: Reason
    conditioning: float
    least_conditioning: float
    excess: float
    distance: float = float("nan")
    scale_deviation: float = float("nan")


@dataclass(frozen=True, eq=False)
class TranslationEstimate:
    """``fit`` of the motions ``used`` (n,) bool, and the test result of each of the n."""

    fit: TranslationFit
    used: BoolArray
    tests: tuple[MotionTest, ...]


@dataclass(frozen=True, eq=False)
class _Scene:
    """Observations: images of all stops, points (m, 4) at rest, NaN where unknown, and whether they are coplanar
    (``flat``).
    """

    images: Images
    pixels: FloatArray
    noise: FloatArray
    rest: FloatArray
    weighting: Weighting
    flat: bool

    def start(self, stops: IntArray) -> tuple[FloatArray, FloatArray]:
        """Linear estimate of the plane at infinity (4,) and directions (n, 4) from rest to each of the stops."""
        if self.flat:
            return planar_start(self.images.cameras, self.rest, self.pixels[stops])
        Hs = [translation_homography(self.images.cameras, self.rest, self.pixels[s]) for s in stops]
        plane = plane_at_infinity_from_stack(Hs, self.weighting)
        return plane, np.stack([direction_given_plane(H, plane, self.weighting) for H in Hs])

    def homography(self, stop: int) -> FloatArray:
        """Linear homography (4, 4) from rest to a stop; for coplanar points that of their translation."""
        if not self.flat:
            return translation_homography(self.images.cameras, self.rest, self.pixels[stop])
        plane, k = self.start(np.array([stop]))
        return np.asarray(np.eye(4) + np.outer(k[0], plane), dtype=np.float64)

    def deviation(self, fit: TranslationFit) -> float:
        """Relative deviation of the points' heights; for coplanar points also of positions off their plane, up to
        their own extent to either side, measured in the images.
        """
        among = scale_deviation(self.rest, fit)
        if not self.flat:
            return among
        M = self.rest[np.isfinite(self.rest).all(axis=1)]
        M = M / np.linalg.norm(M @ self.weighting.right.T, axis=1, keepdims=True)
        M = 2.0 * M / (M @ fit.plane)[:, None] * float(np.mean(M @ fit.plane))
        reach = np.linalg.norm((M - M.mean(axis=0)) @ self.weighting.left.T, axis=1).max()
        back = np.linalg.inv(self.weighting.left)
        worst = np.linalg.eigvalsh(back.T @ fit.plane_covariance @ back)[3]
        return max(among, float(reach * np.sqrt(worst) / np.mean(M @ fit.plane)))


@dataclass(frozen=True, eq=False)
class _Single:
    """One motion tested by itself: its plane at infinity in the chart of `_plane_chart`, None if it has none."""

    plane: FloatArray | None
    covariance: FloatArray | None
    test: MotionTest


def estimate_translations(
    Ps: FloatArray, pixels: FloatArray, sigma: FloatArray | float, *, reject: bool = True
) -> TranslationEstimate:
    """Plane at infinity and directions of pure translations from rest, from images alone.

    Cameras ``Ps`` (c, 3, 4), ``pixels`` (n + 1, c, m, 2) [px] with the stop at rest first, NaN where missing, noise
    ``sigma``, a number or (n + 1, c, m) [px]. Linear start, rejection (``reject``) of motions that are no translations
    or do not share the plane at infinity, then the bundle with free points. Raises GeometryError for shapes
    that do not fit, if no majority of the motions agrees, and if the motions used leave the plane at
    infinity undetermined; its data hold the reasons.

    Coplanar points (to within their noise) are possible if the motions lead out of their plane. The covariance is of
    first order: where `scale_deviation` is above about 1 % it is too small (at 2 % by half, at 6 % sixfold).
    """
    if len(pixels) < 2:
        raise GeometryError("too_few", "no motion is given; the stop at rest and one more are needed", motions=0)
    scene = _scene(Ps, pixels, sigma)
    n = len(pixels) - 1
    if not reject:
        everything = np.ones(n, dtype=bool)
        fit = _joint(scene, everything)
        _require_positive_scales(scene, fit)
        return TranslationEstimate(fit, everything, (MotionTest("", np.nan, np.nan, np.nan),) * n)
    singles = [_test_motion(scene, s) for s in range(1, n + 1)]
    used = _largest_agreement(singles)
    for _ in range(ROUNDS):
        _require_majority(used, singles)
        fit = _joint(scene, used)
        z, C = _plane_chart(scene.weighting.right, scene.rest, fit.plane, fit.plane_covariance)
        distances = np.array([_distance(m, z, C) for m in singles])
        again = distances <= chi2_distribution.isf(TAIL, 3)
        if np.array_equal(again, used):
            break
        used = again
    else:
        _require_majority(used, singles)
        fit = _joint(scene, used)
    _require_positive_scales(scene, fit)
    return TranslationEstimate(fit, used, _test_results(singles, used, distances))


def _scene(Ps: FloatArray, pixels: FloatArray, sigma: FloatArray | float) -> _Scene:
    images = read_images(Ps, pixels, sigma)
    noise = np.broadcast_to(np.asarray(sigma, dtype=np.float64), pixels.shape[:3])
    rest = triangulate(Ps, pixels[0], noise[0])
    weighting = image_weighting(Ps, rest)
    known = np.isfinite(rest).all(axis=1)
    sigmas = np.where(images.weights[0] > 0, noise[0], np.inf)[:, known]
    limit = chi2_distribution.isf(TAIL, int(known.sum()) - 3)
    flat = flatness(Ps, rest[known], sigmas) <= limit
    return _Scene(images, pixels, noise, rest, weighting, bool(flat))


def flatness(Ps: FloatArray, M: FloatArray, sigmas: FloatArray) -> float:
    """Sum of squared distances of triangulated points M (m, 4) from the best-fitting plane, over their variances.

    ``sigmas`` (c, m) [px], infinite where a camera does not see a point. Chi-square with m − 3 freedoms for coplanar
    points.
    """
    C = triangulation_covariance(Ps, M, sigmas)
    weights = 1.0 / np.linalg.norm(M, axis=1)
    plane = np.zeros(4)
    for _ in range(10):  # the variances depend on the plane
        plane = np.linalg.svd(M * weights[:, None], full_matrices=len(M) < 4)[2][3]
        weights = 1.0 / np.sqrt(np.maximum(np.einsum("i,nij,j->n", plane, C, plane), 1e-300))
    return float(((M @ plane * weights) ** 2).sum())


def scale_deviation(points: FloatArray, fit: TranslationFit) -> float:
    """Largest standard deviation of the scales ``hᵀM`` of points (m, 4), relative to the scales, normalised to 1 at the
    points' centroid. NaN points are left out.
    """
    M = points[np.isfinite(points).all(axis=1)]
    M = M / (M @ fit.plane)[:, None]
    # Heights 1 at the centroid: what changes all of them equally is scale.
    M = M - M.mean(axis=0)
    return float(np.sqrt(np.einsum("ni,ij,nj->n", M, fit.plane_covariance, M).max()))


def _require_positive_scales(scene: _Scene, fit: TranslationFit) -> None:
    """Raise GeometryError if the plane at infinity is too uncertain, or passes between the points."""
    points = scene.rest[np.isfinite(scene.rest).all(axis=1)]
    deviation = scene.deviation(fit)
    if not deviation <= SCALE_DEVIATION:
        raise GeometryError(
            "degenerate",
            f"the motions leave the plane at infinity undetermined: the points' heights above it are known to "
            f"{100 * deviation:.3g} % (at most {100 * SCALE_DEVIATION:.3g} %); longer motions, other directions than "
            "the optical axis, more motions or less noise are needed"
            + (", or points off one plane: these are coplanar" if scene.flat else ""),
            deviation=deviation,
            limit=SCALE_DEVIATION,
            coplanar=scene.flat,
        )
    oriented_plane(fit.plane, points)


def _joint(scene: _Scene, used: BoolArray) -> TranslationFit:
    """The bundle over the motions used, from their linear start: the stack (3.37)."""
    stops = np.concatenate([[True], used])
    plane, directions = scene.start(np.flatnonzero(stops)[1:])
    return bundle_translations(
        scene.images.cameras, scene.pixels[stops], scene.rest, plane, directions, scene.noise[stops]
    )


def _test_motion(scene: _Scene, stop: int) -> _Single:
    """Test of one motion from rest: does a homography fit, is it a translation, and with which plane at infinity?"""
    nan = float("nan")
    images, rest, weighting, pair = scene.images, scene.rest, scene.weighting, [0, stop]
    try:
        H_start = scene.homography(stop)
    except GeometryError:
        return _Single(None, None, MotionTest("unseen", nan, nan, nan))
    W = weighting.right
    back = np.asarray(np.linalg.inv(W), dtype=np.float64)
    both = (images.weights[pair] > 0).any(axis=1).all(axis=0) & np.isfinite(rest).all(axis=1)
    white = Images(images.cameras @ back, images.pixels[pair][:, :, both], images.weights[pair][:, :, both])
    M = rest[both] @ W.T
    M = M / np.linalg.norm(M, axis=1, keepdims=True)
    span = np.linalg.qr(W @ plane_basis(rest[both])[:, :3])[0] if scene.flat else None
    motion, x = homography_motion(conjugate(W, H_start)[None], span)
    try:
        best = minimise(white, with_rest(motion), x, M, free_points=True)
        covariance = covariance_of(best.information, "the homography")
    except GeometryError:
        return _Single(None, None, MotionTest("points", nan, nan, nan))
    H, slopes = motion(best.x)
    refined = conjugate(back, H[0])
    conditioning = least = nan
    if not scene.flat:  # with coplanar points the homography is only partly known
        svd = translation_from_homography(refined, weighting)
        noise = _second_singular_noise(weighting.left @ back, H[0], slopes[0], covariance)
        conditioning, least = svd.conditioning, float(svd.singular[0] / noise)
    freedom = white.measurements - len(x) - 3 * int(both.sum())
    if best.cost > chi2_distribution.isf(TAIL, max(1, freedom)):
        return _Single(None, None, MotionTest("points", conditioning, least, nan))
    try:
        plane, directions = scene.start(np.array([stop])) if scene.flat else (svd.plane, svd.generator @ svd.plane)
        fit = bundle_translations(
            images.cameras,
            scene.pixels[pair][:, :, both],
            rest[both],
            plane,
            directions.reshape(1, 4),
            scene.noise[pair][:, :, both],
        )
    except GeometryError as error:
        why: Reason = "not_a_translation" if error.code == "no_model" else "no_motion"
        return _Single(None, None, MotionTest(why, conditioning, least, nan))
    excess = fit.cost - best.cost
    reason: Reason = ""
    if excess > chi2_distribution.isf(TAIL, len(x) - 6):
        reason = "not_a_translation"
    elif conditioning < least:
        reason = "conditioning"
    if reason:
        return _Single(None, None, MotionTest(reason, conditioning, least, excess))
    z, variance = _plane_chart(W, rest, fit.plane, fit.plane_covariance)
    deviation = scene.deviation(fit)
    return _Single(z, variance, MotionTest("", conditioning, least, excess, scale_deviation=deviation))


def _second_singular_noise(left: FloatArray, H: FloatArray, slopes: FloatArray, covariance: FloatArray) -> float:
    """Value that ``σ₂`` of the generator of a true translation exceeds with probability `TAIL`, from the
    homography's covariance (15, 15), with G weighted by ``left``: by Weyl's inequality at most the norm of the error,
    whose square is nearly a scaled chi-square.
    """
    gamma = float(np.trace(H)) / 4.0
    traces = np.trace(slopes, axis1=1, axis2=2)
    errors = left @ (slopes / gamma - traces[:, None, None] * H / (4.0 * gamma**2))
    errors = errors.reshape(len(slopes), 16)
    C = errors.T @ covariance @ errors
    mean, variance = float(np.trace(C)), float((C * C).sum())
    freedom = mean**2 / variance
    return float(np.sqrt(variance / mean * chi2_distribution.isf(TAIL, freedom)))


def _plane_chart(
    W: FloatArray, points: FloatArray, plane: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Chart of a plane (4,): three coordinates and their covariance (3, 3), whitened, scaled to 1 at the centroid of
    the points.
    """
    M = points[np.isfinite(points).all(axis=1)] @ W.T
    centroid = (M / np.linalg.norm(M, axis=1, keepdims=True)).mean(axis=0)
    across = np.linalg.svd(centroid[None])[2][1:]
    back = np.linalg.inv(W).T
    h = back @ plane
    scale = float(h @ centroid)
    J = across @ (np.eye(4) - np.outer(h / scale, centroid)) @ back / scale
    return across @ h / scale, np.asarray(J @ covariance @ J.T, dtype=np.float64)


def _distance(single: _Single, plane: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance between a motion's plane and another one; infinite if it has none."""
    if single.plane is None or single.covariance is None:
        return float("inf")
    difference = single.plane - plane
    return float(difference @ np.linalg.solve(single.covariance + covariance, difference))


def _largest_agreement(singles: list[_Single]) -> BoolArray:
    """Largest consensus set: the motion with which most others agree, and those; among equals, the one with
    the most accurate plane.

    Motions that determine too little by themselves agree with any plane; they are used only if there are no others.
    """
    limit = float(chi2_distribution.isf(TAIL, 3))
    best: tuple[int, float, BoolArray] | None = None
    strong = [m for m in singles if m.test.scale_deviation <= SCALE_DEVIATION]
    for single in strong or singles:
        if single.plane is None or single.covariance is None:
            continue
        agree = np.array([_distance(other, single.plane, single.covariance) <= limit for other in singles])
        key = (int(agree.sum()), -float(np.linalg.slogdet(single.covariance)[1]))
        if best is None or key > best[:2]:
            best = (*key, agree)
    return np.zeros(len(singles), dtype=bool) if best is None else best[2]


def _require_majority(used: BoolArray, singles: list[_Single]) -> None:
    if 2 * int(used.sum()) > len(used):
        return
    reasons = [m.test.reason or ("" if u else "other_plane") for m, u in zip(singles, used, strict=True)]
    raise GeometryError(
        "no_model",
        f"{int(used.sum())} of {len(used)} motions are translations that agree on one plane at infinity; more than "
        f"half must (reasons: {', '.join(sorted({r for r in reasons if r}))})",
        used=int(used.sum()),
        motions=len(used),
        reasons=reasons,
        conditioning=[m.test.conditioning for m in singles],
        excess=[m.test.excess for m in singles],
    )


def _test_results(singles: list[_Single], used: BoolArray, distances: FloatArray) -> tuple[MotionTest, ...]:
    verdicts = []
    for single, use, distance in zip(singles, used, distances, strict=True):
        alone = single.test
        reason: Reason = alone.reason or ("" if use else "other_plane")
        known = float(distance) if np.isfinite(distance) else float("nan")
        verdicts.append(replace(alone, reason=reason, distance=known))
    return tuple(verdicts)
