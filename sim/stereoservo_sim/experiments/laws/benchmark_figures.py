"""Figures 8.14 to 8.22 from the answer of ``benchmark-180``, and what the thesis says of them beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereoservo_sim.experiments.comparison import Comparison, of_statement
from stereoservo_sim.experiments.laws.driven_tasks import COLOURS, draw_images, labelled, picture, saved
from stereoservo_sim.tasks.setting import HEIGHT, WIDTH

Curve = dict[str, Any]


def draw_benchmark_180(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Figures of classical laws, control errors, paths of the centre, image errors, joint motions."""
    curves = answer["curves"]
    return [
        _classical(_of(curves, scene="aside", arm="free"), folder),
        _control_errors(curves, folder),
        _centres(_of(curves, scene="aside", arm="rx90"), folder),
        _images_and_joints(_of(curves, scene="aside", arm="rx90", law="cartesian3"), folder),
    ]


FAR_OUT_M = 5.0
"""Beyond any arm's reach."""
COMES_BACK = (
    "far out each camera still sees the roll that is left, as the tilted face is not symmetric about the axis, so "
    "the law turns and comes back; a run that ends at an arm's reach, as a real one must, has diverged: the thesis "
    "does not say where its own ended"
)


def compare_benchmark_180(answer: dict[str, Any]) -> list[Comparison]:
    """Figs 8.14 to 8.22 in the thesis's words, beside our runs."""
    rows = answer["rows"]
    summary = answer["beside_thesis"]
    return [
        *_classical_compared(rows),
        *_paths_compared(rows, summary),
        *_errors_compared(rows, summary),
        *_curves_compared(answer["curves"]),
    ]


def _classical_compared(rows: list[Curve]) -> list[Comparison]:
    found = []
    for law, told in (
        ("stereo", "stacked Jacobians"),
        ("euclidean-points", "Jacobian for 3D Euclidean points"),
    ):
        mine = [row for row in rows if row["law"] == law]
        seen = all(not row["face_visible"] and row["final_error_px"] < 1.0 for row in mine)
        stalled = max(row["stalled_s"] for row in mine)
        found.append(
            of_statement("fig. 8.14", told, "self-occlusion, trapped, escapes, converges",
                         f"{'shows the back' if seen else 'keeps the face'}, stalled {stalled:.1f} s, "
                         f"{max(row['final_error_px'] for row in mine):.2g} px at the end", seen and stalled > 1.0)
        )  # fmt: skip
    blocks = [row for row in rows if row["law"] == "stereo-block"]
    out = max(row["farthest_m"] for row in blocks)
    back = any(row["converged"] for row in blocks)
    found.append(
        of_statement("fig. 8.14", "block-wise pseudo-inverse", "diverges while moving towards infinity",
                     f"goes out to {out:.1f} m" + (" and comes back" if back else ""), out > FAR_OUT_M and not back,
                     COMES_BACK)
    )  # fmt: skip
    return found


def _paths_compared(rows: list[Curve], summary: list[Curve]) -> list[Comparison]:
    """Planned ways, and the centre's way beside its line."""
    found = []
    for item in summary:
        if "planned" in item:
            figure = "fig. 8.15" if item["planned"] == "linear" else "fig. 8.16"
            found.append(
                of_statement(figure, f"planned, {item['planned']}, {item['scene']}", "self-occlusion avoided",
                             f"cosine to the face from {item['smallest_facing']:.2f}", item["smallest_facing"] > 0.0)
            )  # fmt: skip
    apart = [row["line_deviation_mm"] for row in _of(rows, scene="aside", arm="free", model="projective", gain=0.5)
             if row["law"] in ("cartesian3", "cartesian2")]  # fmt: skip
    found.append(
        of_statement("fig. 8.17", "directTHREE beside directTWO", "very small deviation",
                     f"{max(apart):.2g} mm from the line at most", max(apart) < 2.0)
    )  # fmt: skip
    for law in ("cartesian3", "cartesian2"):
        free = {
            row["gain"]: row["line_deviation_mm"]
            for row in rows
            if (row["law"], row["arm"], row["step"], row["joint_speed_deg_s"])
            == (law, "rx90", "first order", None)
        }
        slow = [row for row in rows if row["law"] == law and row["joint_speed_deg_s"] is not None]
        if not free or not slow:
            continue
        ways = [free[gain] for gain in sorted(free)]
        limited = slow[0]["line_deviation_mm"]
        found.append(
            of_statement("fig. 8.18", f"{law}, centre beside its line",
                         "less at smaller gains, least with joints limited to 5°/s",
                         f"{', '.join(f'{way:.2g}' for way in ways)} mm at gains "
                         f"{', '.join(f'{gain:g}' for gain in sorted(free))}; limited {limited:.2g} mm",
                         ways == sorted(ways) and limited < free[slow[0]["gain"]])
        )  # fmt: skip
    return found


def _errors_compared(rows: list[Curve], summary: list[Curve]) -> list[Comparison]:
    """Control errors, image errors and joints."""
    found = []
    for figure, law in (("fig. 8.19", "cartesian2"), ("fig. 8.20", "cartesian3")):
        mine = _of(rows, scene="aside", law=law, model="projective", gain=0.5, step="corrected")
        rates = [row[f"{name}_rate"] for row in mine for name in ("tau", "theta_r", "theta_p", "theta_s")]
        known = [rate for rate in rates if rate is not None]
        found.append(
            of_statement(figure, f"{law}, control errors", "exponential convergence",
                         f"rates {min(known):.3f} to {max(known):.3f} of the gain",
                         min(known) > 0.95 and max(known) < 1.05)
        )  # fmt: skip
    start = _of(rows, scene="aside", law="cartesian2", gain=0.5, step="corrected")[0]["theta_start_deg"][0]
    found.append(
        of_statement("fig. 8.19", "theta_s at the start", "180°", f"{start:.1f}°", abs(start - 180.0) < 0.5)
    )
    (overlap,) = [item for item in summary if "overlap" in item]
    largest = max(overlap["theta_r_apart_deg"], overlap["theta_p_apart_deg"])
    found.append(
        of_statement("fig. 8.20", "projective beside Euclidean model", "almost perfect overlap of the angles",
                     f"{largest:.2g}° apart at most", largest < 0.5)
    )  # fmt: skip
    return found


def _curves_compared(curves: list[Curve]) -> list[Comparison]:
    """Figs 8.21 and 8.22 from the curves of the RX 90."""
    chosen = _of(curves, scene="aside", arm="rx90", law="cartesian3", gain=0.5, step="corrected")
    if not chosen:
        return []
    errors = np.abs(np.array(chosen[0]["image_errors_px"])).reshape(len(chosen[0]["image_errors_px"]), -1)
    rises = [float(np.maximum(np.diff(column), 0.0).sum()) for column in errors.T]
    return [
        of_statement("fig. 8.21", "errors of the markers' images", "neither exponential nor monotonic",
                     f"they rise by {max(rises):.0f} px on the way", max(rises) > 10.0),
        Comparison("fig. 8.22", "joint motion, free and limited to 5°/s", "curves", "drawn", "not comparable",
                   "the thesis shows curves and prints no values"),
    ]  # fmt: skip


def _of(curves: list[Curve], **wanted: Any) -> list[Curve]:
    return [curve for curve in curves if all(curve[key] == value for key, value in wanted.items())]


def _classical(curves: list[Curve], folder: Path) -> Path:
    """Left image and visibility of the face, one column a law (figs 8.14, 8.15)."""
    laws = [curve for curve in curves if curve["model"] == "projective" or curve["law"] == "euclidean-points"]
    figure = picture(2.6 * max(len(laws), 1), 5.5)
    axes = figure.subplots(2, max(len(laws), 1), squeeze=False)
    for k, curve in enumerate(laws):
        draw_images(axes[0, k], np.array(curve["pixels"])[:, 0], COLOURS[k], curve["law"])
        axes[0, k].set_xlim(0, WIDTH)
        axes[0, k].set_ylim(HEIGHT, 0)
        labelled(axes[0, k], f"{curve['law']}, left image", "u [px]", "v [px]")
        axes[1, k].plot(curve["seconds"], curve["facing"], color=COLOURS[k])
        axes[1, k].axhline(0.0, color="black", linewidth=0.6)
        axes[1, k].set_ylim(-1.0, 1.0)
        labelled(axes[1, k], "below 0: the back is seen", "[s]", "cosine to the face's normal")
    return saved(figure, folder, "benchmark-180-laws")


def _control_errors(curves: list[Curve], folder: Path) -> Path:
    """Of both Cartesian laws, with and without limited joints; metric beside projective (figs 8.19, 8.20)."""
    figure = picture(11, 4.2)
    axes = figure.subplots(1, 3)
    panels = (
        ("cartesian3", "free", "cartesian3; dashed: metric model", ("τ [of 100]", "θ_r [deg]", "θ_p [deg]")),
        ("cartesian3", "rx90", "cartesian3, RX 90; dashed: 5°/s", ("τ [of 100]", "θ_r [deg]", "θ_p [deg]")),
        ("cartesian2", "rx90", "cartesian2, RX 90; dashed: 5°/s", ("τ [of 100]", "θ_s [deg]")),
    )
    for axis, (law, arm, title, names) in zip(axes, panels, strict=True):
        for curve in _of(curves, scene="aside", law=law, arm=arm):
            limited = curve["joint_speed_deg_s"] is not None or curve["model"] == "metric"
            if not limited and (curve["gain"] != 0.5 or curve["step"] != "corrected"):
                continue
            errors = np.array(curve["task_errors"])
            t = np.linspace(curve["seconds"][0], curve["seconds"][-1], len(errors))
            for i, name in enumerate(names):
                values = 100.0 * errors[:, 0] / errors[0, 0] if i == 0 else np.degrees(errors[:, i])
                axis.plot(
                    t, values, "--" if limited else "-", color=COLOURS[i], label=None if limited else name
                )
        labelled(axis, title, "[s]", "still to be made")
        if axis.lines:
            axis.legend(fontsize=7)
    return saved(figure, folder, "benchmark-180-control-errors")


def _centres(curves: list[Curve], folder: Path) -> Path:
    """Path of the centre beside its line for several gains (figs 8.17, 8.18)."""
    figure = picture(11, 6)
    for line, law in zip(figure.subplots(2, 2, sharey=True), ("cartesian3", "cartesian2"), strict=True):
        for axis, step in zip(line, ("first order", "corrected"), strict=True):
            for colour, curve in zip(COLOURS, _of(curves, law=law, step=step), strict=False):
                limit = curve["joint_speed_deg_s"]
                name = f"gain {curve['gain']:g}/s" + ("" if limit is None else f", {limit:g}°/s")
                centre = np.array(curve["centre_mm"])
                axis.plot(centre[:, 0], centre[:, 1], color=colour, linewidth=0.9, label=name)
            labelled(axis, f"{law}, {step}", "along the line [mm]", "beside it [mm]")
            if axis.lines:
                axis.legend(fontsize=6)
    return saved(figure, folder, "benchmark-180-centre")


def _images_and_joints(curves: list[Curve], folder: Path) -> Path:
    """Image errors of the markers (fig. 8.21) and joints (fig. 8.22), free and with limited joint speed."""
    chosen = [
        *_of(curves, gain=0.5, step="corrected"),
        *[curve for curve in curves if curve["joint_speed_deg_s"] is not None],
    ]
    figure = picture(11, 3.6 * max(len(chosen), 1))
    axes = figure.subplots(max(len(chosen), 1), 2, squeeze=False)
    for line, curve in zip(axes, chosen, strict=False):
        limit = curve["joint_speed_deg_s"]
        name = f"gain {curve['gain']:g}/s" + ("" if limit is None else f", {limit:g}°/s")
        errors, joints = np.array(curve["image_errors_px"]), np.array(curve["joints_deg"])
        for p in range(errors.shape[1]):
            for i, dash in enumerate(("-", "--")):
                line[0].plot(curve["seconds"], errors[:, p, i], dash, color=COLOURS[p], linewidth=0.9)
        for j, q in enumerate(joints.T):
            line[1].plot(curve["seconds"], q, color=COLOURS[j], linewidth=0.9, label=f"joint {j + 1}")
        labelled(line[0], f"{name}: markers, left (dashed: v)", "[s]", "image error [px]")
        labelled(line[1], name, "[s]", "joint [deg]")
        line[1].legend(fontsize=6)
    return saved(figure, folder, "benchmark-180-joints")
