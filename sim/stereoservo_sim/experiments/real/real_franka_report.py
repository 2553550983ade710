"""JSON report and figures of the real-arm experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from stereoservo.geometry.cameras import camera_centre
from stereoservo.geometry.homogeneous import from_homogeneous
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.real.real_franka import FOLDS, HeldOut, RealFrankaResult
from stereoservo_sim.experiments.real.tags import DICTIONARY_NAME

REFERENCE = {
    "median_px": 0.66,
    "rms_px": 0.86,
    "tag_sides_mm": [38.94, 39.09],
    "table_flatness_mm": 0.48,
    "corners": "cv2 CORNER_REFINE_SUBPIX, no radial term",
    "data": "fairo_franka/set_a, hand tag 9",
}
"""Measured before on that set; beside other sets it is only a scale."""

THESIS = {
    "rms_px": [0.09, 0.16],
    "what": "residual of the thesis's own self-calibration: dots, another arm, not held out",
}

MAGNIFIED = 40
"""Scale of the error arrows in the overlay."""

STATE = "distance of a predicted tag corner from the measured one [px], over all corners of held-out poses"


def report_real_franka(result: RealFrankaResult) -> dict[str, Any]:
    """JSON object of ``reproduce real-franka``."""
    seen, model = result.observations, result.fits.better
    sides = 1e3 * np.linalg.norm(model.corners - np.roll(model.corners, -1, axis=0), axis=1)
    fit = result.fits.errors(model, result.displacements, result.views)
    held = result.held_out
    kept = result.fits.kept.tolist()
    table = result.table
    return {
        "experiment": "real-franka",
        **_figures(held.chosen),
        "tag_side_mm": float(sides.mean()),
        "tag_sides_mm": sides.tolist(),
        "table_flatness_mm": table.rms_mm,
        "table_flatness_reason": table.reason,
        "table_tags": list(table.tags),
        "table_corners": len(table.points),
        "reference": REFERENCE,
        "thesis": THESIS,
        "error_is": STATE,
        "folds": f"pose index modulo {FOLDS}",
        "rows": _rows(result),
        "variants": {
            "radial chosen on training poses": {
                **_figures(held.chosen),
                "radial_folds": list(held.radial_folds),
            },
            "no radial term": _figures(held.pinhole),
            "one radial term a camera": _figures(held.radial),
            "cv2 subpixel corners": _figures(result.held_out_opencv.chosen),
            "cv2 subpixel corners, no radial term": _figures(result.held_out_opencv.pinhole),
        },
        "fit": {
            **_figures(fit),
            "radial": result.fits.radial_better,
            "radial_terms": dict(zip(_names(result, kept), model.radial.tolist(), strict=True)),
            "views_left_out": int((~model.inliers).sum()),
            "tag_offset_m": model.corners.mean(axis=0).tolist(),
            "robust_costs_of_starts": list(model.costs),
        },
        "triangulation": [
            {
                "cameras": _names(result, list(found.cameras)),
                "rms_mm": found.rms_mm,
                "median_mm": float(1e3 * np.median(found.errors)),
                "corners": len(found.errors),
            }
            for found in result.triangulated
        ],
        "triangulation_is": "distance of triangulated corners of held-out poses from where the arm says that they are",
        "hand_tag": result.hand_tag,
        "dictionary": DICTIONARY_NAME,
        "seed": result.seed,
        "data": str(result.directory),
        "images": {
            "read": seen.images_read,
            "with_hand_tag": len(seen.camera),
            "registered": int(seen.registered.sum()),
            "by_camera": dict(
                zip(
                    _names(result, list(range(len(seen.cameras)))),
                    np.bincount(seen.camera, minlength=len(seen.cameras)).tolist(),
                    strict=True,
                )
            ),
            "poses": len(np.unique(seen.pose)),
            "cameras_left_out": [seen.cameras[i] for i in range(len(seen.cameras)) if i not in kept],
        },
    }


def _names(result: RealFrankaResult, cameras: list[int]) -> list[str]:
    return [f"cam{result.observations.cameras[i]}" for i in cameras]


def _figures(errors: FloatArray) -> dict[str, Any]:
    """Median, rms and largest distance [px], and per axis, of errors ``(v, k, 2)``; NaN rows are not
    predicted."""
    known = errors[np.isfinite(errors).all(axis=(1, 2))]
    distance = np.linalg.norm(known, axis=2)
    return {
        "median_px": float(np.median(distance)),
        "rms_px": float(np.sqrt((distance**2).mean())),
        "max_px": float(distance.max()),
        "per_axis": {
            "median_abs_px": np.median(np.abs(known), axis=(0, 1)).tolist(),
            "rms_px": np.sqrt((known**2).mean(axis=(0, 1))).tolist(),
        },
        "corners": int(distance.size),
        "not_predicted": 4 * (len(errors) - len(known)),
    }


def _rows(result: RealFrankaResult) -> list[dict[str, Any]]:
    seen, errors = result.observations, result.held_out.chosen
    rows = []
    for fold in range(FOLDS):
        for index, name in enumerate(_names(result, list(range(len(seen.cameras))))):
            inside = (seen.pose % FOLDS == fold) & (seen.camera == index)
            if not inside.any():
                continue
            distance = np.linalg.norm(errors[inside], axis=2)
            predicted = np.isfinite(distance).all(axis=1)
            known = distance[predicted]
            rows.append(
                {
                    "fold": fold,
                    "camera": name,
                    "poses": seen.pose[inside].tolist(),
                    "predicted": int(predicted.sum()),
                    "median_px": float(np.median(known)) if known.size else None,
                    "rms_px": float(np.sqrt((known**2).mean())) if known.size else None,
                    "radial": fold in result.held_out.radial_folds,
                }
            )
    return rows


def draw_real_franka(result: RealFrankaResult, directory: Path) -> list[Path]:
    """Write ``residuals.png``, ``overlay.png``, ``cameras.png`` into ``directory`` (made if absent); their
    paths."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, painter in (
        ("residuals", _draw_residuals),
        ("overlay", _draw_overlay),
        ("cameras", _draw_cameras),
    ):
        figure = Figure(layout="constrained")
        FigureCanvasAgg(figure)
        painter(result, figure)
        paths.append(directory / f"{name}.png")
        figure.savefig(paths[-1], dpi=110)
    return paths


def _draw_residuals(result: RealFrankaResult, figure: Any) -> None:
    seen = result.observations
    figure.set_size_inches(10, 4.5)
    cloud, bars = figure.subplots(1, 2)
    for index, name in enumerate(_names(result, list(range(len(seen.cameras))))):
        errors = result.held_out.chosen[seen.camera == index].reshape(-1, 2)
        cloud.plot(errors[:, 0], errors[:, 1], ".", markersize=4, label=name)
    cloud.set(
        xlabel="u, predicted − measured [px]", ylabel="v [px]", title="held-out corners", aspect="equal"
    )
    cloud.grid(alpha=0.3)
    cloud.legend()
    both = {"registered corners": result.held_out, "cv2 subpixel corners": result.held_out_opencv}
    finite = {label: _finite_distances(held) for label, held in both.items()}
    edges = np.linspace(0, max(float(np.percentile(d, 99.5)) for d in finite.values()), 40)
    for label, distance in finite.items():
        bars.hist(
            distance, bins=edges, histtype="step", label=f"{label}: median {np.median(distance):.2f} px"
        )
    bars.set(xlabel="distance [px]", ylabel="corners", title="held-out distance")
    bars.legend()


def _finite_distances(held: HeldOut) -> FloatArray:
    distance = np.linalg.norm(held.chosen, axis=2).ravel()
    finite: FloatArray = distance[np.isfinite(distance)]
    return finite


def _draw_overlay(result: RealFrankaResult, figure: Any) -> None:
    seen = result.observations
    count = len(seen.cameras)
    figure.set_size_inches(min(6.5 * count, 26), 5)
    axes = figure.subplots(1, count, squeeze=False)[0]
    closed = [0, 1, 2, 3, 0]
    for index, (axis, name) in enumerate(zip(axes, _names(result, list(range(count))), strict=True)):
        axis.imshow(seen.backgrounds[index], cmap="gray", alpha=0.6)
        inside = seen.camera == index
        for i, (measured, error) in enumerate(
            zip(seen.pixels[inside], result.held_out.chosen[inside], strict=True)
        ):
            predicted = measured + error
            labels = ("measured", "predicted, held out") if i == 0 else (None, None)
            axis.plot(*measured[closed].T, "-", color="tab:green", linewidth=1.6, label=labels[0])
            axis.plot(*predicted[closed].T, "--", color="tab:red", linewidth=0.8, label=labels[1])
            axis.annotate(str(seen.pose[inside][i]), measured.max(axis=0), fontsize=6, color="tab:blue")
        corners, errors = (
            a[inside].reshape(-1, 2) for a in (seen.pixels, MAGNIFIED * result.held_out.chosen)
        )
        axis.quiver(
            *corners.T, *errors.T, angles="xy", scale_units="xy", scale=1, width=0.002, color="tab:purple"
        )
        axis.set(title=f"{name}, errors x{MAGNIFIED}", xticks=[], yticks=[])
        if inside.any():
            axis.legend(fontsize=7)


def _draw_cameras(result: RealFrankaResult, figure: Any) -> None:
    figure.set_size_inches(8, 7)
    axis = figure.add_subplot(projection="3d")
    model, views = result.fits.better, result.views
    hand = result.displacements[np.unique(views.pose)] @ np.append(model.corners.mean(axis=0), 1.0)
    axis.scatter(*hand[:, :3].T, color="0.4", s=12, label="tag on the hand")
    if len(result.table.points):
        axis.scatter(*result.table.points.T, color="0.7", marker="s", s=12, label="table tags")
    for P, name in zip(model.Ps, _names(result, result.fits.kept.tolist()), strict=True):
        centre = from_homogeneous(camera_centre(P)[None])[0]
        seen = hand[:, :3].mean(axis=0)
        depth = float(np.linalg.norm(seen - centre))
        axis.scatter(*centre, s=40, label=name)
        axis.plot(*np.stack([centre, centre + 0.4 * depth * P[2, :3]]).T, color="black", linewidth=0.8)
    axis.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="recovered cameras, in the arm's base")
    axis.set_aspect("equal")
    axis.legend()


def show_real_franka(answer: dict[str, Any], console: Console) -> None:
    """Tables of the held-out errors and of the figures beside the reference."""
    reference = answer["reference"]
    table = Table(title="real-franka: held-out poses predicted from the arm's poses", title_justify="left")
    for column in ("", "ours", "reference"):
        table.add_column(column, justify="left" if not column else "right")
    table.add_row("median [px]", f"{answer['median_px']:.3f}", f"{reference['median_px']}")
    table.add_row("rms [px]", f"{answer['rms_px']:.3f}", f"{reference['rms_px']}")
    sides = ", ".join(f"{side:.2f}" for side in answer["tag_sides_mm"])
    table.add_row("tag sides [mm]", sides, "–".join(f"{side:.2f}" for side in reference["tag_sides_mm"]))
    flat = answer["table_flatness_mm"]
    table.add_row(
        "table flatness [mm]",
        answer["table_flatness_reason"] if flat is None else f"{flat:.3f}",
        f"{reference['table_flatness_mm']}",
    )
    console.print(table)
    variants = Table(title="variants", title_justify="left")
    for column in ("", "median [px]", "rms [px]", "largest [px]"):
        variants.add_column(column, justify="left" if not column else "right")
    for name, figures in answer["variants"].items():
        variants.add_row(name, *(f"{figures[key]:.3f}" for key in ("median_px", "rms_px", "max_px")))
    console.print(variants)
    images = answer["images"]
    console.print(f"{images['with_hand_tag']} of {images['read']} images show tag {answer['hand_tag']}")
    if answer["not_predicted"]:
        console.print(
            f"{answer['not_predicted']} corners not predicted: too few views of that camera are left"
        )
