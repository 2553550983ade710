"""Experiment ``grid`` (fig. 3.6): affine calibration of a moving rig before a calibration grid, per motion and
cumulative.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stereoservo.geometry.cameras import triangulate
from stereoservo.geometry.fundamental import fundamental_robust
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.translation_consensus import estimate_translations
from stereoservo.geometry.translation_fit import bundle_translations
from stereoservo.geometry.translations import (
    direction_given_plane,
    image_weighting,
    plane_at_infinity_from_stack,
    translation_from_homography,
    translation_homography,
)
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.comparison import Comparison, of_error, of_statement
from stereoservo_sim.experiments.pictures.chessboards import board_points, boards, find_boards
from stereoservo_sim.experiments.translations.affine_measures import (
    CAMERAS_ASSUMED,
    EPIPOLAR_ASSUMED,
    answer_of,
    converging_rig,
    cramer_rao,
    distance_error,
    expected_errors,
    fundamental_of,
    images_of,
    pair_covariance,
    projective_cameras,
    upgrade,
)
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import spread
from stereoservo_sim.world.camera_rig import StereoRig

DISTANCE = 1.1
"""[m] of the grid's edge from the rig; not stated in the thesis."""
SIGMA = 0.05
"""[px], as the thesis states it."""
STEP = 0.02
"""[m] between stops; not said in the thesis."""
NOISE_GREY = 2.0
"""[grey levels], of rendered pictures."""
RENDERED = 2
"""Sequences of rendered pictures, at most."""
CORRUPTED = 5
"""Of 17 motions, in the rows on rejection: 30 %."""
THESIS: dict[str, Any] = {
    "figure": "3.6",
    "e_d_mm": [0.2, 0.3],
    "where": "3.3.2: absolute error of the cumulative estimates, real images of about 0.05 px",
    "less_accurate_motions": [6, 11],
    "linear_and_non_linear": "no real difference here (3.3.2)",
}
ASSUMPTIONS = [
    CAMERAS_ASSUMED,
    EPIPOLAR_ASSUMED,
    f"the grid: 98 points on two faces at a right angle, 7 x 7 each, 25 mm apart, {DISTANCE} m before the rig",
    f"steps of {1e3 * STEP:.0f} mm: motions 1 to 5 along the baseline, 6 to 11 along the optical axis, 12 to 17 across",
    "'upgrade only' and 'full' as in gripper; the structure of a linear estimate is that of one stereo image",
    f"rendered: pictures of two chessboards at a right angle, 7 x 7 inner corners each, 25 mm apart, {NOISE_GREY:g} "
    "grey levels of noise; corners and matches by the product's finder of chessboards, F estimated from them",
]


def grid_points() -> FloatArray:
    """98 points (98, 3) [m] on two faces whose common edge points at the rig."""
    across, up = np.meshgrid(0.01 + 0.025 * np.arange(7), 0.025 * (np.arange(7) - 3.0))
    half = np.sqrt(0.5)
    left = np.stack([-half * across, up, half * across], axis=-1).reshape(-1, 3)
    right = np.stack([half * across, up, half * across], axis=-1).reshape(-1, 3)
    return np.asarray(np.vstack([left, right]) + np.array([0.0, 0.0, DISTANCE]))


def scene_shifts() -> FloatArray:
    """Translation of the scene relative to the rig at the 18 stops, (18, 3) [m], from the first one."""
    directions = np.repeat(np.eye(3)[[0, 2, 1]], [5, 6, 6], axis=0)
    path = np.vstack([np.zeros(3), STEP * np.cumsum(directions, axis=0)])
    # Half of every axis on either side of where the cameras look.
    return np.asarray(path - STEP * np.array([2.5, 3.0, 3.0]))


def consecutive_homographies(cameras: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Linear homographies (n, 4, 4) from each stop to the next, and the points (n + 1, m, 4) at all stops."""
    points = np.stack([triangulate(cameras, p) for p in pixels])
    Hs = [translation_homography(cameras, M, p) for M, p in zip(points[:-1], pixels[1:], strict=True)]
    return np.stack(Hs), points


def cumulative_estimate(
    cameras: FloatArray, pixels: FloatArray, Hs: FloatArray, points: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Linear plane at infinity of all motions, non-linear one, and the points of the latter at the first stop.

    Raises GeometryError where the fit fails.
    """
    weighting = image_weighting(cameras, points[0])
    linear = plane_at_infinity_from_stack(Hs, weighting)
    steps = np.stack([direction_given_plane(H, linear, weighting) for H in Hs])
    fit = bundle_translations(cameras, pixels, points[0], linear, np.cumsum(steps, axis=0), sigma)
    return linear, fit.plane, fit.points


def run_grid(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``e_D`` of every motion by itself and of the first n together, linear and non-linear."""
    rig, X = converging_rig(DISTANCE), grid_points()
    scenes = X + scene_shifts()[:, None]
    clean = images_of(rig, scenes)
    cameras = projective_cameras(fundamental_of(rig), clean[0])
    exact = np.stack([triangulate(cameras, p) for p in clean])
    values: dict[tuple[str, int, str, str], list[float]] = {}
    failed: dict[tuple[str, int, str], int] = {}
    for i in range(seeds):
        progress("grid", i, seeds)
        rng = np.random.default_rng([seed, i])
        pixels = clean + SIGMA * rng.normal(size=clean.shape)
        _one_sequence(values, failed, cameras, pixels, exact, scenes)
        _corrupted(values, failed, rig, cameras, pixels, exact, scenes, rng)
    rendered = [by_pictures(rig, np.random.default_rng([seed, i, 3])) for i in range(min(seeds, RENDERED))]
    progress("grid", seeds, seeds)
    bounds = _bounds(rig, scenes)
    rows = [
        {
            "estimate": estimate,
            "motion": n,
            "method": method,
            "structure": structure,
            "e_d_mm": spread(errors),
            "bound_e_d_mm": bounds.get((estimate, n, structure)),
            "failed": failed.get((estimate, n, method), 0),
        }
        for (estimate, n, method, structure), errors in sorted(values.items())
    ]
    return {
        **answer_of("grid", seed, seeds, rows, THESIS, ASSUMPTIONS),
        "rendered": rendered,
        "one_image_e_d_mm": expected_errors(
            scenes[0], None, _with_known_plane(pair_covariance(rig, scenes[0], SIGMA))
        )[0],
    }


def by_pictures(rig: StereoRig, rng: np.random.Generator) -> dict[str, Any]:
    """The same through rendered pictures: ``e_D`` of all motions with the structure of one stereo image and of all, and
    how far the corners are off [px]. Raises GeometryError.
    """
    X, body = board_points(DISTANCE), boards(DISTANCE)
    found = [
        [find_boards(body.picture(camera, shift, rng, NOISE_GREY)) for camera in rig.cameras]
        for shift in scene_shifts()
    ]
    whole = [k for k, pair in enumerate(found) if all(one is not None for one in pair)]
    pixels = np.array([found[k] for k in whole], dtype=np.float64)
    off = pixels - images_of(rig, X + scene_shifts()[whole][:, None])
    F, _ = fundamental_robust(*pixels.transpose(1, 0, 2, 3).reshape(2, -1, 2), SIGMA)
    cameras = projective_cameras(F, pixels[0])
    Hs, points = consecutive_homographies(cameras, pixels)
    _, plane, M = cumulative_estimate(cameras, pixels, Hs, points, SIGMA)
    return {
        "stops": len(whole),
        "rms_px": float(np.sqrt(np.mean(off**2))),
        "one_image_e_d_mm": distance_error(upgrade(plane, points[0]), X),
        "all_images_e_d_mm": distance_error(upgrade(plane, M), X),
    }


def _with_known_plane(points: FloatArray) -> FloatArray:
    joint = np.zeros((len(points) + 3, len(points) + 3))
    joint[: len(points), : len(points)] = points
    return joint


def _one_sequence(
    values: dict[tuple[str, int, str, str], list[float]],
    failed: dict[tuple[str, int, str], int],
    cameras: FloatArray,
    pixels: FloatArray,
    exact: FloatArray,
    scenes: FloatArray,
) -> None:
    Hs, points = consecutive_homographies(cameras, pixels)
    for n in range(1, len(pixels)):
        before = n - 1
        svd = translation_from_homography(Hs[before], image_weighting(cameras, points[before]))
        single: dict[str, tuple[FloatArray, FloatArray]] = {"linear": (svd.plane, points[before])}
        try:
            direction = (svd.generator @ svd.plane)[None]
            fit = bundle_translations(
                cameras, pixels[[before, n]], points[before], svd.plane, direction, SIGMA
            )
            single["non-linear"] = fit.plane, fit.points
        except GeometryError:
            failed["single", n, "non-linear"] = failed.get(("single", n, "non-linear"), 0) + 1
        _measure(values, "single", n, single, exact[before], scenes[before])
        try:
            linear, plane, M = cumulative_estimate(cameras, pixels[: n + 1], Hs[:n], points, SIGMA)
        except GeometryError:
            failed["cumulative", n, "non-linear"] = failed.get(("cumulative", n, "non-linear"), 0) + 1
            continue
        _measure(
            values,
            "cumulative",
            n,
            {"linear": (linear, points[0]), "non-linear": (plane, M)},
            exact[0],
            scenes[0],
        )


def _corrupted(
    values: dict[tuple[str, int, str, str], list[float]],
    failed: dict[tuple[str, int, str], int],
    rig: StereoRig,
    cameras: FloatArray,
    pixels: FloatArray,
    exact: FloatArray,
    scenes: FloatArray,
    rng: np.random.Generator,
) -> None:
    """Corruption of five stops: at three a fifth of the matches is wrong, at two the rig rotates by 1° as well."""
    from scipy.spatial.transform import Rotation

    pixels, last = pixels.copy(), len(pixels) - 1
    bad = rng.choice(np.arange(1, last + 1), CORRUPTED, replace=False)
    for stop in bad[:3]:
        wrong = rng.choice(pixels.shape[2], pixels.shape[2] // 5, replace=False)
        pixels[stop][:, wrong] = pixels[stop][:, np.roll(wrong, 1)]
    for stop in bad[3:]:
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.deg2rad(1.0) * axis / np.linalg.norm(axis)).as_matrix()
        turned = images_of(rig, scenes[stop] @ turn.T)
        pixels[stop] = turned + SIGMA * rng.normal(size=turned.shape)
    for estimate, reject in (("5 of 17 spoilt, rejected", True), ("5 of 17 spoilt, kept", False)):
        try:
            fit = estimate_translations(cameras, pixels, SIGMA, reject=reject).fit
        except GeometryError:
            failed[estimate, last, "non-linear"] = failed.get((estimate, last, "non-linear"), 0) + 1
            values.setdefault((estimate, last, "non-linear", "upgrade only"), [])
            continue
        _measure(values, estimate, last, {"non-linear": (fit.plane, fit.points)}, exact[0], scenes[0])


def _measure(
    values: dict[tuple[str, int, str, str], list[float]],
    estimate: str,
    n: int,
    planes: dict[str, tuple[FloatArray, FloatArray]],
    exact: FloatArray,
    X: FloatArray,
) -> None:
    for method, (plane, points) in planes.items():
        for structure, M in (("upgrade only", exact), ("full", points)):
            error = distance_error(upgrade(plane, M), X)
            values.setdefault((estimate, n, method, structure), []).append(error)


def _bounds(rig: StereoRig, scenes: FloatArray) -> dict[tuple[str, int, str], float]:
    bounds = {}
    for n in range(1, len(scenes)):
        for estimate, first in (("single", n - 1), ("cumulative", 0)):
            shifts = (scenes[first + 1 : n + 1] - scenes[first])[:, 0]
            bound = cramer_rao(rig, scenes[first], shifts, SIGMA)
            bounds[estimate, n, "upgrade only"] = expected_errors(scenes[first], bound.plane, None)[0]
            bounds[estimate, n, "full"] = expected_errors(scenes[first], None, bound.joint)[0]
    return bounds


def compare_grid(answer: dict[str, Any]) -> list[Comparison]:
    """Fig. 3.6 beside our medians."""
    rows = {(r["estimate"], r["motion"], r["method"], r["structure"]): r["e_d_mm"] for r in answer["rows"]}
    low, high = THESIS["e_d_mm"]
    last = max(key[1] for key in rows)

    def median(estimate: str, motion: int, method: str, structure: str) -> float:
        return float(rows[estimate, motion, method, structure]["median"])

    one = median("cumulative", last, "linear", "full")
    planes = [median("cumulative", last, method, "upgrade only") for method in ("linear", "non-linear")]
    along = [median("single", n, "linear", "upgrade only") for n in range(6, 12)]
    across = [median("single", n, "linear", "upgrade only") for n in (*range(1, 6), *range(12, 18))]
    rejected = rows["5 of 17 spoilt, rejected", last, "non-linear", "full"]["p84"]
    return [
        of_statement("fig. 3.6", "absolute error, cumulative; structure of one stereo image",
                     f"{low:g} to {high:g} mm", f"{one:.2g} mm", low <= one <= high,
                     "the noise and the distance are assumed"),
        of_error("fig. 3.6", "absolute error, cumulative; structure of all images", low,
                 median("cumulative", last, "non-linear", "full"), "mm"),
        *_compared_pictures(answer["rendered"], low, high),
        of_statement("fig. 3.6", "linear beside non-linear", "no real difference",
                     f"errors by the plane {planes[0]:.2g} and {planes[1]:.2g} mm, below the {one:.2g} mm of one "
                     "stereo image", max(planes) < 0.1 * one),
        of_statement("fig. 3.6", "motions along the optical axis, 6 to 11", "less accurate",
                     f"{min(along):.2g} to {max(along):.2g} mm, others {min(across):.2g} to {max(across):.2g} mm",
                     min(along) > max(across)),
        of_statement("fig. 3.6", "corrupted data, mismatches", "robust",
                     f"5 of 17 motions spoilt: {rejected:.2g} mm", rejected < high),
    ]  # fmt: skip


def _compared_pictures(rendered: list[dict[str, Any]], low: float, high: float) -> list[Comparison]:
    """The errors through rendered pictures, the largest of all sequences."""
    rms = max(one["rms_px"] for one in rendered)
    one = max(sequence["one_image_e_d_mm"] for sequence in rendered)
    said = f"through pictures, corners to {rms:.2g} px, F estimated"
    return [
        of_statement("fig. 3.6", "rendered, structure of one stereo image", f"{low:g} to {high:g} mm",
                     f"{one:.2g} mm {said}", low <= one <= high, "the finder's error decides"),
        of_error("fig. 3.6", "rendered, structure of all images", low,
                 max(sequence["all_images_e_d_mm"] for sequence in rendered), "mm"),
    ]  # fmt: skip


def draw_grid(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Single and cumulative estimates over the motions, linear and non-linear (fig. 3.6)."""
    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2)
    for axis, structure in zip(axes, ("upgrade only", "full"), strict=True):
        for estimate, style in (("single", ":"), ("cumulative", "-")):
            for method, colour in (("linear", "#d55e00"), ("non-linear", "#0072b2")):
                key = (estimate, method, structure)
                mine = sorted(
                    (
                        r
                        for r in answer["rows"]
                        if (r["estimate"], r["method"], r["structure"]) == key
                        and r["e_d_mm"]["mean"] is not None
                    ),
                    key=lambda r: int(r["motion"]),
                )
                n = [r["motion"] for r in mine]
                axis.plot(
                    n,
                    [r["e_d_mm"]["median"] for r in mine],
                    style,
                    color=colour,
                    marker=".",
                    label=f"{estimate}, {method}",
                )
                axis.fill_between(
                    n,
                    [r["e_d_mm"]["p16"] for r in mine],
                    [r["e_d_mm"]["p84"] for r in mine],
                    color=colour,
                    alpha=0.12,
                )
                if method == "non-linear":
                    axis.plot(n, [r["bound_e_d_mm"] for r in mine], style, color="black", linewidth=0.8)
        axis.axhspan(*THESIS["e_d_mm"], color="0.85", zorder=0, label="thesis")
        axis.set_yscale("log")
        axis.set_title(f"{structure}; black: bound", fontsize=9)
        axis.set_xlabel("motion", fontsize=8)
        axis.set_ylabel("e_D [mm]", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[0].legend(fontsize=7, loc="lower left", title="median; band: 16 % to 84 %", title_fontsize=7)
    path = folder / "grid-e_D.png"
    figure.savefig(path, dpi=110)
    return [path]
