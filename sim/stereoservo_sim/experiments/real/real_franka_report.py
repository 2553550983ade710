"""JSON report and figures of the real-arm experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from stereoservo.geometry.cameras import camera_centre
from stereoservo.geometry.homogeneous import from_homogeneous
from stereoservo_sim.experiments.real.real_franka import (
    FAR,
    FEW_POSES,
    FOLDS,
    INSIDE,
    HeldOut,
    RealFrankaResult,
    coverage,
)
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
    seen, whole, table = result.observations, result.whole, result.table
    corners, report = whole.corners, whole.fit.report
    sides = 1e3 * np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    kept = whole.kept.tolist()
    return {
        "experiment": "real-franka",
        **_figures(result.held_out, result),
        "uncertainty": _uncertainty(result.held_out),
        "few_poses": _few_poses(result),
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
            "lens chosen on training poses": {
                **_figures(result.held_out, result),
                "lenses": {str(fold): fitted.fit.report.lens.model for fold, fitted in result.held_out.fits},
            },
            **{name: _figures(held, result) for name, held in result.variants.items()},
        },
        "fit": {
            "rms_px": report.rms_px,
            "lens": report.lens.model,
            "sigma_factor": report.sigma_factor,
            "chi2": report.chi2,
            "degrees_of_freedom": report.degrees_of_freedom,
            "outliers": len(report.outliers),
            "tag_offset_m": corners.mean(axis=0).tolist(),
            "cameras": {one.name: one.intrinsics for one in report.cameras},
            "pose_errors": [
                {"axis": one.name, "random": one.random, "by_posture": one.posture, "rms_px": one.pixels}
                for one in report.joints
            ],
            "notes": list(report.notes),
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


def _uncertainty(held: HeldOut) -> dict[str, Any]:
    """The predicted deviations of held-out corners, and how they hold."""
    found = coverage(held)
    return {
        "median_px": float(np.nanmedian(held.deviations)),
        "inside": found.inside,
        "inside_is": f"share of {found.corners} corners in their {INSIDE:.0%} ellipses",
        "interval": list(found.interval),
        "interval_is": f"99 % of the share in {found.views} views, whose corners err together",
        "holds": found.interval[0] <= found.inside <= found.interval[1],
        "largest_sigmas": found.largest,
        f"beyond_{FAR:.0f}_sigmas": found.beyond,
    }


def _few_poses(result: RealFrankaResult) -> dict[str, Any]:
    """How training sets of few poses predict the rest."""
    rows: list[dict[str, Any]] = []
    for one in result.few:
        rows.append({"seed": one.seed, "poses": list(one.poses)})
        if one.held_out is None:
            rows[-1]["refused"] = one.refused
            continue
        rows[-1].update(_figures(one.held_out, result), **_uncertainty(one.held_out))
        del rows[-1]["not_predicted"]  # the poses learnt from are among them
    told = [one for one in rows if "corners" in one]
    return {
        "poses": FEW_POSES,
        "sets": len(rows),
        "refused": len(rows) - len(told),
        "corners": sum(one["corners"] for one in told),
        "max_px": max((one["max_px"] for one in told), default=None),
        "largest_sigmas": max((one["largest_sigmas"] for one in told), default=None),
        f"beyond_{FAR:.0f}_sigmas": sum(one[f"beyond_{FAR:.0f}_sigmas"] for one in told),
        "rows": rows,
    }


def _names(result: RealFrankaResult, cameras: list[int]) -> list[str]:
    return [f"cam{result.observations.cameras[i]}" for i in cameras]


def _figures(held: HeldOut, result: RealFrankaResult) -> dict[str, Any]:
    """Median, rms and largest distance [px], and per axis, of the corners that were predicted."""
    known = held.errors[np.isfinite(held.squares)]
    distance = np.linalg.norm(known, axis=1)
    measured = int(np.isfinite(result.views.pixels).all(axis=3).sum())
    return {
        "median_px": float(np.median(distance)),
        "rms_px": float(np.sqrt((distance**2).mean())),
        "max_px": float(distance.max()),
        "per_axis": {
            "median_abs_px": np.median(np.abs(known), axis=0).tolist(),
            "rms_px": np.sqrt((known**2).mean(axis=0)).tolist(),
        },
        "corners": len(known),
        "not_predicted": measured - len(known),
    }


def _rows(result: RealFrankaResult) -> list[dict[str, Any]]:
    seen, held = result.observations, result.held_out
    indices = np.unique(seen.pose)
    stops = {int(pose): stop for stop, pose in enumerate(result.indices)}
    lenses = {fold: fitted.fit.report.lens.model for fold, fitted in held.fits}
    rows = []
    for fold in range(FOLDS):
        for c, name in enumerate(_names(result, list(range(len(seen.cameras))))):
            poses = [int(i) for i in indices if i % FOLDS == fold and i in seen.pose[seen.camera == c]]
            if not poses:
                continue
            squares = held.squares[c, [stops[pose] for pose in poses]]
            distance = np.linalg.norm(held.errors[c, [stops[pose] for pose in poses]], axis=2)
            predicted = np.isfinite(squares).all(axis=1)
            known = distance[predicted]
            rows.append(
                {
                    "fold": fold,
                    "camera": name,
                    "poses": poses,
                    "predicted": int(predicted.sum()),
                    "median_px": float(np.median(known)) if known.size else None,
                    "rms_px": float(np.sqrt((known**2).mean())) if known.size else None,
                    "largest_sigmas": float(np.sqrt(squares[predicted].max())) if known.size else None,
                    "lens": lenses.get(fold),
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
        errors = result.held_out.errors[index].reshape(-1, 2)
        cloud.plot(errors[:, 0], errors[:, 1], ".", markersize=4, label=name)
    cloud.set(
        xlabel="u, predicted − measured [px]", ylabel="v [px]", title="held-out corners", aspect="equal"
    )
    cloud.grid(alpha=0.3)
    cloud.legend()
    both = {
        "registered corners": result.held_out,
        "cv2 subpixel corners": result.variants["cv2 subpixel corners"],
    }
    finite = {label: held.distances for label, held in both.items()}
    edges = np.linspace(0, max(float(np.percentile(d, 99.5)) for d in finite.values()), 40)
    for label, distance in finite.items():
        bars.hist(
            distance, bins=edges, histtype="step", label=f"{label}: median {np.median(distance):.2f} px"
        )
    bars.set(xlabel="distance [px]", ylabel="corners", title="held-out distance")
    bars.legend()


def _draw_overlay(result: RealFrankaResult, figure: Any) -> None:
    seen = result.observations
    count = len(seen.cameras)
    figure.set_size_inches(min(6.5 * count, 26), 5)
    axes = figure.subplots(1, count, squeeze=False)[0]
    closed = [0, 1, 2, 3, 0]
    for index, (axis, name) in enumerate(zip(axes, _names(result, list(range(count))), strict=True)):
        axis.imshow(seen.backgrounds[index], cmap="gray", alpha=0.6)
        inside = np.isfinite(result.held_out.squares[index]).all(axis=1)
        pixels, errors = result.views.pixels[index, inside], result.held_out.errors[index, inside]
        for i, (measured, error) in enumerate(zip(pixels, errors, strict=True)):
            predicted = measured + error
            labels = ("measured", "predicted, held out") if i == 0 else (None, None)
            axis.plot(*measured[closed].T, "-", color="tab:green", linewidth=1.6, label=labels[0])
            axis.plot(*predicted[closed].T, "--", color="tab:red", linewidth=0.8, label=labels[1])
            axis.annotate(str(result.indices[inside][i]), measured.max(axis=0), fontsize=6, color="tab:blue")
        corners, arrows = pixels.reshape(-1, 2), MAGNIFIED * errors.reshape(-1, 2)
        axis.quiver(
            *corners.T, *arrows.T, angles="xy", scale_units="xy", scale=1, width=0.002, color="tab:purple"
        )
        axis.set(title=f"{name}, errors x{MAGNIFIED}", xticks=[], yticks=[])
        if inside.any():
            axis.legend(fontsize=7)


def _draw_cameras(result: RealFrankaResult, figure: Any) -> None:
    figure.set_size_inches(8, 7)
    axis = figure.add_subplot(projection="3d")
    whole = result.whole
    hand = result.views.displacements @ np.append(whole.corners.mean(axis=0), 1.0)
    axis.scatter(*hand[:, :3].T, color="0.4", s=12, label="tag on the hand")
    if len(result.table.points):
        base = result.table.points @ whole.camera_to_base[:3, :3].T + whole.camera_to_base[:3, 3]
        axis.scatter(*base.T, color="0.7", marker="s", s=12, label="table tags")
    for P, name in zip(whole.matrices, _names(result, whole.kept.tolist()), strict=True):
        centre = from_homogeneous(camera_centre(P)[None])[0]
        seen = hand[:, :3].mean(axis=0)
        depth = float(np.linalg.norm(seen - centre))
        axis.scatter(*centre, s=40, label=name)
        ahead = P[2, :3] / np.linalg.norm(P[2, :3])
        axis.plot(*np.stack([centre, centre + 0.4 * depth * ahead]).T, color="black", linewidth=0.8)
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
    told, few = answer["uncertainty"], answer["few_poses"]
    low, high = told["interval"]
    table.add_row("predicted deviation, median [px]", f"{told['median_px']:.3f}", "")
    table.add_row("inside 95 % ellipses", f"{told['inside']:.1%}", f"{low:.1%} to {high:.1%}")
    table.add_row("largest error [predicted deviations]", f"{told['largest_sigmas']:.2f}", "")
    console.print(table)
    console.print(
        f"trained on {few['poses']} poses, {few['sets']} times ({few['refused']} refused): largest error "
        f"{few['max_px'] or 0.0:.2f} px, {few['largest_sigmas'] or 0.0:.2f} predicted deviations; "
        f"{few['beyond_4_sigmas']} of {few['corners']} corners beyond 4"
    )
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
