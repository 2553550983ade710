"""Experiment ``house`` (fig. 3.7): affine calibration from interest points of an unknown object, evaluated on the
grid.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stereoservo.geometry.cameras import triangulate
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.detectors.landmark_learning import LearningSettings
from stereoservo_sim.experiments.comparison import Comparison, of_limit, of_statement
from stereoservo_sim.experiments.pictures.landmark_tracks import epipolar_geometry, landmark_tracks
from stereoservo_sim.experiments.pictures.textured import Face, TexturedBody, texture
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
    plane_at_infinity_of,
    projective_cameras,
    upgrade,
)
from stereoservo_sim.experiments.translations.grid import (
    DISTANCE,
    NOISE_GREY,
    SIGMA,
    STEP,
    consecutive_homographies,
    cumulative_estimate,
    grid_points,
    scene_shifts,
)
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import spread

SIGMAS = (0.3, 0.5, 1.0)
"""[px] of the house's interest points."""
MOTIONS = (1, 5, 11, 17)
"""The first n motions of the grid's sequence: one, one axis, two axes, all three."""
POINTS = 60
LANDMARKS = 80
"""Interest points that the detector learns of a rendered house, at most."""
WALL, HEIGHT = 0.16, 0.1
"""[m]"""
TEXELS, TEXTURE = 256, 4.0
"""Of a wall's texture along a side, and its finest structure [texels]: some 3 px."""
THESIS: dict[str, Any] = {
    "figure": "3.7",
    "e_d_mm_below": 1.0,
    "where": "3.3.3: non-linear, on the grid's reconstruction; slightly above the grid's own 0.2 to 0.3 mm",
}
ASSUMPTIONS = [
    CAMERAS_ASSUMED,
    EPIPOLAR_ASSUMED,
    f"the house: {POINTS} points drawn anew for every seed on two walls, 16 cm wide and 10 cm high, and on two sides "
    f"of a roof, {DISTANCE} m before the rig; the thesis says neither their number nor their noise",
    "matches are right; rendered: the same house with an irregular texture, its interest points matched and found "
    "again by the product's detector of natural features, F estimated from them",
    f"motions as in grid: steps of {1e3 * STEP:.0f} mm, 5 along the baseline, 6 along the optical axis, 6 across",
    f"'upgrade only': on the grid's noise-free projective reconstruction; 'full': on that of one stereo image of the "
    f"grid with {SIGMA} px",
]


def house_points(rng: np.random.Generator, count: int = POINTS) -> FloatArray:
    """Points (count, 3) [m] on two walls and two sides of a roof, an edge of the house towards the rig."""
    half = np.sqrt(0.5)
    along, high = rng.uniform(0.0, WALL, count), rng.uniform(0.0, HEIGHT, count)
    side, roof = rng.integers(0, 2, count), rng.integers(0, 2, count) == 1
    # Along a wall to the left or right and away; the roof rises (v points down) and leans back over it.
    x, z = np.where(side == 0, -half, half) * along, half * along
    inward = np.where(roof, 0.5 * high, 0.0)
    house = np.stack(
        [x + np.where(side == 0, half, -half) * inward, np.where(roof, -high, high), z + half * inward],
        axis=1,
    )
    return np.asarray(house + np.array([0.0, 0.0, DISTANCE]))


def house_body(rng: np.random.Generator) -> TexturedBody:
    """The house's two walls and two sides of the roof with a random texture."""
    half, edge, faces = np.sqrt(0.5), np.array([0.0, 0.0, DISTANCE]), []
    for side in (-1.0, 1.0):
        across = WALL * np.array([side * half, 0.0, half])
        ridge = HEIGHT * np.array([-0.5 * side * half, -1.0, 0.5 * half])
        walls = (edge, np.array([0.0, HEIGHT, 0.0])), (edge + ridge, -ridge)
        faces += [Face(texture(rng, TEXELS, TEXTURE), origin, across, down) for origin, down in walls]
    return TexturedBody(faces)


def by_pictures(seed: int) -> dict[str, Any]:
    """The same through rendered pictures: ``e_D`` on the grid by the plane at infinity of all motions, how many
    interest points there were, and how far they are off [px]. Raises DriverError, GeometryError.
    """
    rng, rig, shifts = np.random.default_rng([seed, 3]), converging_rig(DISTANCE), scene_shifts()
    body = house_body(rng)
    pictures = {
        camera.name: [body.picture(camera, shift, rng, NOISE_GREY) for shift in shifts]
        for camera in rig.cameras
    }
    tracks = landmark_tracks(pictures, LearningSettings(tilts=1, most=LANDMARKS))
    sigma = float(np.sqrt(np.mean(tracks.sigmas**2)))
    cameras = projective_cameras(epipolar_geometry(tracks), tracks.pixels[0])
    Hs, points = consecutive_homographies(cameras, tracks.pixels)
    _, plane, _ = cumulative_estimate(cameras, tracks.pixels, Hs, points, sigma)
    X = grid_points()
    images = images_of(rig, X)
    measured = triangulate(cameras, images + SIGMA * rng.normal(size=images.shape))
    truth = body.points(rig.cameras[0], tracks.pixels[0, 0], shifts[0])
    off = tracks.pixels - images_of(rig, truth + (shifts - shifts[0])[:, None])
    return {
        "points": len(tracks.ids),
        "learnt": tracks.learnt,
        "rms_px": float(np.sqrt(np.nanmean(off**2))),
        "e_d_mm": distance_error(upgrade(plane, measured), X),
    }


def run_house(*, seeds: int, seed: int, progress: ProgressCall, pictures: bool = True) -> dict[str, Any]:
    """``e_D`` of the grid upgraded by the house's plane at infinity, over noise, motions and method, and, with
    ``pictures``, through rendered ones.
    """
    rig, X = converging_rig(DISTANCE), grid_points()
    grid_images = images_of(rig, X)
    cameras = projective_cameras(fundamental_of(rig), grid_images)
    exact = triangulate(cameras, grid_images)
    seen = pair_covariance(rig, X, SIGMA)
    values: dict[tuple[float, int, str, str], list[float]] = {}
    bounds: dict[tuple[float, int, str], list[float]] = {}
    failed: dict[tuple[float, int, str], int] = {}
    for i in range(seeds):
        progress("house", i, seeds)
        rng = np.random.default_rng([seed, i])
        scenes = house_points(rng) + scene_shifts()[:, None]
        clean = images_of(rig, scenes)
        noise = rng.normal(size=clean.shape)
        measured = triangulate(cameras, grid_images + SIGMA * rng.normal(size=grid_images.shape))
        for n in MOTIONS:
            plane_bound = cramer_rao(rig, scenes[0], (scenes[1 : n + 1] - scenes[0])[:, 0], 1.0).plane
            for sigma in SIGMAS:
                for structure, error in _expected(X, sigma**2 * plane_bound, seen).items():
                    bounds.setdefault((sigma, n, structure), []).append(error)
        for sigma in SIGMAS:
            pixels = clean + sigma * noise
            Hs, points = consecutive_homographies(cameras, pixels)
            for n in MOTIONS:
                try:
                    linear, plane, _ = cumulative_estimate(cameras, pixels[: n + 1], Hs[:n], points, sigma)
                except GeometryError:
                    failed[sigma, n, "non-linear"] = failed.get((sigma, n, "non-linear"), 0) + 1
                    continue
                for method, h in (("linear", linear), ("non-linear", plane)):
                    for structure, M in (("upgrade only", exact), ("full", measured)):
                        error = distance_error(upgrade(h, M), X)
                        values.setdefault((sigma, n, method, structure), []).append(error)
    rendered = [by_pictures(seed)] if pictures else []
    progress("house", seeds, seeds)
    rows = [
        {
            "sigma_px": sigma,
            "motions": n,
            "method": method,
            "structure": structure,
            "e_d_mm": spread(errors),
            "bound_e_d_mm": float(np.mean(bounds[sigma, n, structure])),
            "failed": failed.get((sigma, n, method), 0),
        }
        for (sigma, n, method, structure), errors in sorted(values.items())
    ]
    return {**answer_of("house", seed, seeds, rows, THESIS, ASSUMPTIONS), "rendered": rendered}


def _expected(X: FloatArray, plane: FloatArray, seen: FloatArray) -> dict[str, float]:
    """Errors at the bound: of the plane (3, 3) alone, and with the grid's own noise ``seen`` (3n, 3n) beside it."""
    n = len(seen)
    joint = np.zeros((n + 3, n + 3))
    joint[:n, :n], joint[n:, n:] = seen, plane
    return {"upgrade only": expected_errors(X, plane, None)[0], "full": expected_errors(X, None, joint)[0]}


def compare_house(answer: dict[str, Any]) -> list[Comparison]:
    """Fig. 3.7 beside our medians, all noises and numbers of motions."""
    worst = {
        method: max(
            row["e_d_mm"]["median"] for row in answer["rows"]
            if (row["method"], row["structure"]) == (method, "full")
        )
        for method in ("linear", "non-linear")
    }  # fmt: skip
    limit = THESIS["e_d_mm_below"]
    return [
        of_limit("fig. 3.7", f"e_D on the grid, non-linear, largest median to {SIGMAS[-1]:g} px", limit,
                 worst["non-linear"], "mm"),
        of_limit("fig. 3.7", "e_D on the grid, rendered: points, matches and F by the detector", limit,
                 max((one["e_d_mm"] for one in answer["rendered"]), default=None), "mm"),
        of_statement("fig. 3.7", "linear estimate", f"the limit of {limit:g} mm needs the non-linear one",
                     f"to {worst['linear']:.2g} mm, non-linear {worst['non-linear']:.2g} mm",
                     worst["linear"] > limit),
    ]  # fmt: skip


def draw_house(answer: dict[str, Any], folder: Path) -> list[Path]:
    """``e_D`` on the grid over the number of motions, one curve a noise; and a projective grid beside its upgrade
    (fig. 3.7)."""
    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2, sharey=True)
    for axis, structure in zip(axes, ("upgrade only", "full"), strict=True):
        for sigma, colour in zip(SIGMAS, ("#0072b2", "#009e73", "#d55e00"), strict=True):
            for method, style in (("linear", ":"), ("non-linear", "-")):
                key = (sigma, method, structure)
                mine = [r for r in answer["rows"] if (r["sigma_px"], r["method"], r["structure"]) == key]
                n = [r["motions"] for r in mine]
                label = f"{method}, {sigma} px"
                axis.plot(
                    n, [r["e_d_mm"]["median"] for r in mine], style, color=colour, marker=".", label=label
                )
                if method == "non-linear":
                    low, high = ([r["e_d_mm"][side] for r in mine] for side in ("p16", "p84"))
                    axis.fill_between(n, low, high, color=colour, alpha=0.12)
                    axis.plot(n, [r["bound_e_d_mm"] for r in mine], "--", color=colour, linewidth=0.8)
        axis.axhline(THESIS["e_d_mm_below"], color="black", linewidth=1.2, label="thesis, below")
        axis.set_yscale("log")
        axis.set_title(f"{structure}; dashed: bound", fontsize=9)
        axis.set_xlabel("motions", fontsize=8)
        axis.set_ylabel("e_D [mm]", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[1].legend(fontsize=7, loc="lower right", title="median; band: 16 % to 84 %", title_fontsize=7)
    path = folder / "house-e_D.png"
    figure.savefig(path, dpi=110)
    return [path, _draw_rectification(folder)]


def _draw_rectification(folder: Path) -> Path:
    """The grid as reconstructed projectively, and upgraded, in coordinates of its own moments."""
    rig, X = converging_rig(DISTANCE), grid_points()
    images = images_of(rig, X)
    cameras = projective_cameras(fundamental_of(rig), images)
    M = triangulate(cameras, images)
    # A frame further from affine than the canonical one, so that the projective distortion shows.
    across = (M[:, :1] - M[:, :1].mean()) / np.ptp(M[:, 0])
    skew = M[:, :3] / (M[:, 3:] * (1.0 + 0.8 * across))
    figure = Figure(figsize=(9, 4), layout="constrained")
    FigureCanvasAgg(figure)
    plane = plane_at_infinity_of(M, X)
    for k, (title, points) in enumerate((("projective", skew), ("affine", upgrade(plane, M))), start=1):
        axis = figure.add_subplot(1, 2, k, projection="3d")
        for face in points.reshape(2, 7, 7, 3):
            for line in (*face, *face.transpose(1, 0, 2)):
                axis.plot(
                    line[:, 0], line[:, 2], -line[:, 1], ".-", color="#0072b2", markersize=3, linewidth=0.7
                )
        axis.view_init(elev=40, azim=-75)
        axis.set_title(title, fontsize=9)
        axis.set_xticklabels([])
        axis.set_yticklabels([])
        axis.set_zticklabels([])
    path = folder / "house-rectification.png"
    figure.savefig(path, dpi=110)
    return path
