"""Translations from images of a moved scene, motions that are none left out (thesis 3.2.2, 3.2.3).

Every motion is judged by itself, and then by the plane at infinity that most of them agree on. All thresholds
follow from the noise of the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from stereoservo.geometry.cameras import triangulate, triangulation_covariance
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.geometry.strata import heights_of_one_side
from stereoservo.geometry.translation_fit import (
    Images,
    TranslationFit,
    bundle_translations,
    covariance_of,
    homography_motion,
    minimise,
    read_images,
    with_rest,
)
from stereoservo.geometry.translations import (
    TranslationSVD,
    Weighting,
    direction_given_plane,
    image_weighting,
    plane_at_infinity_from_stack,
    translation_from_homography,
    translation_homography,
)

BoolArray = npt.NDArray[np.bool_]
Reason = Literal["", "unseen", "points", "conditioning", "not_a_translation", "no_motion", "other_plane"]

TAIL = 1e-3
"""Probability with which one test rejects a good motion."""
ROUNDS = 5
"""Most times that the agreeing motions are chosen again."""
HEIGHT_DEVIATION = 1.0 / 3.0
"""Largest relative standard deviation of a point's height: three of them reach the plane at infinity."""


@dataclass(frozen=True, eq=False)
class MotionJudgement:
    """One motion from rest, judged.

    ``reason`` why it is left out, empty where it is used: ``unseen`` (too few points before and after),
    ``points`` (no homography fits: wrong matches), ``conditioning`` (``σ₂`` of the homography's generator above
    what its noise explains), ``not_a_translation`` (a homography fits, a translation does not), ``no_motion``
    (no plane at infinity in it at all), ``other_plane`` (a translation, but not with the plane at
    infinity of the others). ``conditioning`` σ₁/σ₂ and ``least_conditioning``, below which noise does not
    explain it; ``excess`` the chi-square by which the translation fits worse than the homography, of nine
    freedoms; ``distance`` the squared Mahalanobis distance of its plane from that of the others, of three;
    ``height_deviation`` the largest relative standard deviation of a point's height above its own plane: a motion above
    `HEIGHT_DEVIATION` tells too little by itself, but adds to others. NaN where not computed.
    """

    reason: Reason
    conditioning: float
    least_conditioning: float
    excess: float
    distance: float = float("nan")
    height_deviation: float = float("nan")


@dataclass(frozen=True, eq=False)
class TranslationEstimate:
    """``fit`` of the motions ``used`` (n,) bool, the verdict on each of the n, and the homographies (n, 4, 4)
    they were judged by, NaN where there is none.
    """

    fit: TranslationFit
    used: BoolArray
    judgements: tuple[MotionJudgement, ...]
    homographies: FloatArray


@dataclass(frozen=True, eq=False)
class _Single:
    """One motion by itself: its homography and plane (chart of height 1 at the points' middle)."""

    homography: FloatArray | None
    plane: FloatArray | None
    covariance: FloatArray | None
    judgement: MotionJudgement


def estimate_translations(
    Ps: FloatArray, pixels: FloatArray, sigma: FloatArray | float, *, reject: bool = True
) -> TranslationEstimate:
    """Plane at infinity and directions of pure translations from rest, from images alone.

    Cameras ``Ps`` (c, 3, 4), ``pixels`` (n + 1, c, m, 2) [px] with the stop at rest first, NaN where missing, noise
    ``sigma``, a number or (n + 1, c, m) [px]. Linear start, motions left out that are no translations or do not
    share the plane at infinity (``reject``), then the bundle with free points. Raises GeometryError for shapes
    that do not fit, where fewer than half of the motions agree, and where the motions used leave the plane at
    infinity undetermined; its data hold the reasons.
    """
    images = read_images(Ps, pixels, sigma)
    noise = np.broadcast_to(np.asarray(sigma, dtype=np.float64), pixels.shape[:3])
    n = len(pixels) - 1
    if n < 1:
        raise GeometryError(
            "too_few", "no motion is given; the stop at rest and one more are needed", motions=n
        )
    rest = triangulate(Ps, pixels[0], noise[0])
    weighting = image_weighting(Ps, rest)
    _refuse_flat(Ps, rest, np.where(images.weights[0] > 0, noise[0], np.inf))
    if not reject:
        Hs = np.stack([translation_homography(Ps, rest, p) for p in pixels[1:]])
        fit = _joint(Ps, pixels, noise, rest, Hs, weighting, np.ones(n, dtype=bool))
        blank = MotionJudgement("", np.nan, np.nan, np.nan)
        _require_heights(rest, fit)
        return TranslationEstimate(fit, np.ones(n, dtype=bool), (blank,) * n, Hs)
    singles = [_judge_alone(images, pixels, noise, rest, weighting, s) for s in range(1, n + 1)]
    Hs = np.stack([np.full((4, 4), np.nan) if m.homography is None else m.homography for m in singles])
    used = _largest_agreement(singles)
    for _ in range(ROUNDS):
        _require_majority(used, singles)
        fit = _joint(Ps, pixels, noise, rest, Hs, weighting, used)
        z, C = _height_one(weighting.right, rest, fit.plane, fit.plane_covariance)
        distances = np.array([_distance(m, z, C) for m in singles])
        again = distances <= chi2_distribution.isf(TAIL, 3)
        if np.array_equal(again, used):
            break
        used = again
    else:
        fit = _joint(Ps, pixels, noise, rest, Hs, weighting, used)
    _require_heights(rest, fit)
    return TranslationEstimate(fit, used, _verdicts(singles, used, distances), Hs)


def flatness(Ps: FloatArray, M: FloatArray, sigmas: FloatArray) -> float:
    """Sum of squared distances of triangulated points M (m, 4) from the plane that fits best, over their variances.

    ``sigmas`` (c, m) [px], infinite where a camera does not see a point. Chi-square of m − 3 freedoms where the points
    are coplanar.
    """
    C = triangulation_covariance(Ps, M, sigmas)
    weights = 1.0 / np.linalg.norm(M, axis=1)
    plane = np.zeros(4)
    for _ in range(10):  # the variances follow the plane
        plane = np.linalg.svd(M * weights[:, None])[2][3]
        weights = 1.0 / np.sqrt(np.maximum(np.einsum("i,nij,j->n", plane, C, plane), 1e-300))
    return float(((M @ plane * weights) ** 2).sum())


def _refuse_flat(Ps: FloatArray, rest: FloatArray, sigmas: FloatArray) -> None:
    """Raise GeometryError where the noise explains what is not coplanar in the points."""
    known = np.isfinite(rest).all(axis=1)
    cost = flatness(Ps, rest[known], sigmas[:, known])
    limit = float(chi2_distribution.isf(TAIL, int(known.sum()) - 3))
    if cost <= limit:
        raise GeometryError(
            "degenerate",
            f"the {int(known.sum())} points are coplanar to within their noise (chi-square {cost:.4g} of "
            f"{limit:.4g}); "
            "a homography of space needs points off one plane",
            chi2=cost,
            limit=limit,
        )


def height_deviation(points: FloatArray, fit: TranslationFit) -> float:
    """Largest standard deviation of the heights ``hᵀM`` of points (m, 4), relative to the heights, where that of the
    points' middle is one. NaN points are left out.
    """
    M = points[np.isfinite(points).all(axis=1)]
    M = M / (M @ fit.plane)[:, None]
    # Heights 1 at the middle: what moves all of them alike is scale.
    M = M - M.mean(axis=0)
    return float(np.sqrt(np.einsum("ni,ij,nj->n", M, fit.plane_covariance, M).max()))


def _require_heights(rest: FloatArray, fit: TranslationFit) -> None:
    """Raise GeometryError where the plane at infinity is not known well enough, or cuts the points."""
    deviation = height_deviation(rest, fit)
    if not deviation <= HEIGHT_DEVIATION:
        raise GeometryError(
            "degenerate",
            f"the motions leave the plane at infinity undetermined: the points' heights above it are known to "
            f"{100 * deviation:.3g} % (at most {100 * HEIGHT_DEVIATION:.3g} %); longer motions, other directions than "
            "the optical axis, more motions or less noise are needed",
            deviation=deviation,
            limit=HEIGHT_DEVIATION,
        )
    heights_of_one_side(fit.plane, rest[np.isfinite(rest).all(axis=1)])


def _joint(
    Ps: FloatArray,
    pixels: FloatArray,
    noise: FloatArray,
    rest: FloatArray,
    Hs: FloatArray,
    weighting: Weighting,
    used: BoolArray,
) -> TranslationFit:
    """The bundle over the motions used, from their linear stack (3.37)."""
    plane = plane_at_infinity_from_stack(Hs[used], weighting)
    directions = np.stack([direction_given_plane(H, plane, weighting) for H in Hs[used]])
    stops = np.concatenate([[True], used])
    return bundle_translations(Ps, pixels[stops], rest, plane, directions, noise[stops])


def _judge_alone(
    images: Images,
    pixels: FloatArray,
    noise: FloatArray,
    rest: FloatArray,
    weighting: Weighting,
    stop: int,
) -> _Single:
    """Rest and one stop: does a homography fit, is it a translation, and with which plane at infinity?"""
    nan = float("nan")
    Ps, pair, W = images.cameras, [0, stop], weighting.right
    try:
        start = translation_homography(Ps, rest, pixels[stop])
    except GeometryError:
        return _Single(None, None, None, MotionJudgement("unseen", nan, nan, nan))
    both = (images.weights[pair] > 0).any(axis=1).all(axis=0) & np.isfinite(rest).all(axis=1)
    white = Images(Ps @ np.linalg.inv(W), images.pixels[pair][:, :, both], images.weights[pair][:, :, both])
    M = rest[both] @ W.T
    M = M / np.linalg.norm(M, axis=1, keepdims=True)
    motion, x = homography_motion(conjugate(W, start)[None])
    try:
        best = minimise(white, with_rest(motion), x, M, free_points=True)
        covariance = covariance_of(best.information, "the homography")
    except GeometryError:
        return _Single(start, None, None, MotionJudgement("points", nan, nan, nan))
    H, slopes = motion(best.x)
    back = np.linalg.inv(W)
    refined = conjugate(np.asarray(back, dtype=np.float64), H[0])
    svd = translation_from_homography(refined, weighting)
    least = svd.singular[0] / _second_singular_noise(weighting.left @ back, H[0], slopes[0], covariance)
    freedom = white.measurements - 15 - 3 * int(both.sum())
    if best.cost > chi2_distribution.isf(TAIL, max(1, freedom)):
        return _Single(refined, None, None, MotionJudgement("points", svd.conditioning, least, nan))
    try:
        fit = _alone(Ps, pixels[pair][:, :, both], noise[pair][:, :, both], rest[both], svd)
    except GeometryError as error:
        why: Reason = "not_a_translation" if error.code == "no_model" else "no_motion"
        return _Single(refined, None, None, MotionJudgement(why, svd.conditioning, least, nan))
    excess = fit.cost - best.cost
    reason: Reason = ""
    if excess > chi2_distribution.isf(TAIL, 9):
        reason = "not_a_translation"
    elif svd.conditioning < least:
        reason = "conditioning"
    if reason:
        return _Single(refined, None, None, MotionJudgement(reason, svd.conditioning, least, excess))
    plane, spread = _height_one(weighting.right, rest, fit.plane, fit.plane_covariance)
    deviation = height_deviation(rest, fit)
    judgement = MotionJudgement("", svd.conditioning, least, excess, height_deviation=deviation)
    return _Single(refined, plane, spread, judgement)


def _alone(
    Ps: FloatArray, pixels: FloatArray, noise: FloatArray, rest: FloatArray, svd: TranslationSVD
) -> TranslationFit:
    """The bundle of one motion, from the decomposition of its homography."""
    direction = (svd.generator @ svd.plane)[None]
    return bundle_translations(Ps, pixels, rest, svd.plane, direction, noise)


def _second_singular_noise(
    left: FloatArray, H: FloatArray, slopes: FloatArray, covariance: FloatArray
) -> float:
    """What ``σ₂`` of the generator of a true translation exceeds with probability `TAIL`, from the homography's
    covariance (15, 15), G weighted by ``left``: by Weyl at most the norm of the
    error, whose square is nearly a scaled chi-square.
    """
    gamma = float(np.trace(H)) / 4.0
    traces = np.trace(slopes, axis1=1, axis2=2)
    errors = left @ (slopes / gamma - traces[:, None, None] * H / (4.0 * gamma**2))
    errors = errors.reshape(len(slopes), 16)
    C = errors.T @ covariance @ errors
    mean, spread = float(np.trace(C)), float((C * C).sum())
    freedom = mean**2 / spread
    return float(np.sqrt(spread / mean * chi2_distribution.isf(TAIL, freedom)))


def _height_one(
    W: FloatArray, points: FloatArray, plane: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A plane (4,) as three coordinates, and their covariance (3, 3): whitened, of height one at the points'
    middle, where planes that pass far from the points do not differ by scale.
    """
    M = points[np.isfinite(points).all(axis=1)] @ W.T
    middle = (M / np.linalg.norm(M, axis=1, keepdims=True)).mean(axis=0)
    across = np.linalg.svd(middle[None])[2][1:]
    back = np.linalg.inv(W).T
    h = back @ plane
    height = float(h @ middle)
    J = across @ (np.eye(4) - np.outer(h / height, middle)) @ back / height
    return across @ h / height, np.asarray(J @ covariance @ J.T, dtype=np.float64)


def _distance(single: _Single, plane: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance between a motion's plane and another one; infinite where it has none."""
    if single.plane is None or single.covariance is None:
        return float("inf")
    difference = single.plane - plane
    return float(difference @ np.linalg.solve(single.covariance + covariance, difference))


def _largest_agreement(singles: list[_Single]) -> BoolArray:
    """The motions that agree with the one that most agree with; of equals, the one that knows its plane best.

    Motions that tell too little by themselves agree with anything: only where there are no others are they asked.
    """
    limit = float(chi2_distribution.isf(TAIL, 3))
    best: tuple[int, float, BoolArray] | None = None
    strong = [m for m in singles if m.judgement.height_deviation <= HEIGHT_DEVIATION]
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
    reasons = [m.judgement.reason or ("" if u else "other_plane") for m, u in zip(singles, used, strict=True)]
    raise GeometryError(
        "no_model",
        f"{int(used.sum())} of {len(used)} motions are translations that agree on one plane at infinity; more than "
        f"half must (reasons: {', '.join(sorted({r for r in reasons if r}))})",
        used=int(used.sum()),
        motions=len(used),
        reasons=reasons,
        conditioning=[m.judgement.conditioning for m in singles],
        excess=[m.judgement.excess for m in singles],
    )


def _verdicts(singles: list[_Single], used: BoolArray, distances: FloatArray) -> tuple[MotionJudgement, ...]:
    verdicts = []
    for single, use, distance in zip(singles, used, distances, strict=True):
        alone = single.judgement
        reason: Reason = alone.reason or ("" if use else "other_plane")
        known = float(distance) if np.isfinite(distance) else float("nan")
        verdicts.append(replace(alone, reason=reason, distance=known))
    return tuple(verdicts)
