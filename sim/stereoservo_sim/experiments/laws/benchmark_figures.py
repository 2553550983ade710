"""Figures 8.14 to 8.22 from the answer of ``benchmark-180``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

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
