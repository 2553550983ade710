"""Report of a calibration as one self-contained HTML page: marker tracks, residuals by joint and camera, fit
statistics, and assessment.

A folder next to the model file, written atomically by the fit process after the model is saved.
"""

from __future__ import annotations

import base64
import html
import io
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

from stereoservo.numerics.arrays import FloatArray

matplotlib.use("Agg")

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from stereoservo.calibration.calibration_result import CalibrationReport
from stereoservo.calibration.change.model_changes import known_measurements
from stereoservo.calibration.fit_assessment import JOINT_ERRORS, STRATA, Acceptance
from stereoservo.calibration.joint_noise import estimated_errors
from stereoservo.calibration.rig_model import Measurements, acting_order, acting_rig, full_charts, predicted
from stereoservo.calibration.trial_data import TrialData
from stereoservo.calibration.variance_components import noise_of_accuracy, readings
from stereoservo.kinematics.denavit_hartenberg import (
    DH_HEADER,
    ReadOutError,
    decimals,
    denavit_hartenberg,
    dh_cells,
)
from stereoservo.kinematics.gauge_free import gauge_free_quantities
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.known_length import known_length_of

DPI = 90
HISTOGRAM = np.linspace(-5.0, 5.0, 41)
LISTED = 60
"""Largest number of omitted pixels that are listed individually."""

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #222 }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ccc }
table { border-collapse: collapse } td, th { padding: .15em .8em; text-align: right; border-bottom: 1px solid #eee }
td:first-child, th:first-child { text-align: left } img { max-width: 100% }
.verdict { padding: .8em 1em; border-left: 6px solid } .good { border-color: #2a7; background: #eefaf3 }
.usable { border-color: #d90; background: #fff8e8 } .not { border-color: #c33; background: #fdeeee }
"""


@dataclass(frozen=True)
class Residuals:
    """Residuals of the trials: ``pixels`` (k, 2) measured minus predicted [px], in ``sigmas`` (k, 2); the camera and
    the trial's joint (-1: the base) of each, and whether the fit excluded it.
    """

    data: Measurements
    pixels: FloatArray
    sigmas: FloatArray
    joint: npt.NDArray[np.int64]
    left_out: npt.NDArray[np.bool_]


def residuals_of(model: CellModel, trials: TrialData, report: CalibrationReport) -> Residuals:
    """Residuals of every pixel of the model's markers, with the errors of the joint readings removed. Raises
    CalibrationError if the trials do not belong to the model.
    """
    rig, order = acting_rig(model), acting_order(model)
    data = known_measurements(model, trials, order)
    accuracy = model.joint_accuracy
    if accuracy is not None:
        acting = np.array(order)
        at = readings((trials.positions - model.zero)[:, acting])
        data = data.with_joint_noise(noise_of_accuracy(accuracy.in_order(acting), at))
        data = data.corrected(estimated_errors(rig, full_charts(rig, model.stratum), data))
    pixels = data.pixels - predicted(rig, data)
    outliers = {(out.camera, out.stop, out.marker) for out in report.outliers}
    names = [camera.name for camera in model.cameras]
    left_out = np.array(
        [
            (names[c], int(s), model.marker_ids[m]) in outliers
            for c, s, m in zip(data.camera, data.stop, data.marker, strict=True)
        ],
        dtype=bool,
    )
    return Residuals(data, pixels, pixels / data.sigmas[:, None], trials.trials[data.stop], left_out)


def write_report(
    folder: Path,
    trials: TrialData,
    verdict: Acceptance,
    *,
    model: CellModel | None = None,
    report: CalibrationReport | None = None,
    trials_path: Path | None = None,
    known_length: str = "",
) -> Path:
    """Write ``folder/index.html``, replacing an older one; returns its path. Without a model: the report of a
    failure. ``known_length``: WHAT:OF=METRES, for the arm's dimensions in metres.

    Raises OSError.
    """
    page = _page(trials, verdict, model, report, trials_path, known_length).encode()
    scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        with (scratch / "index.html").open("wb") as file:
            file.write(page)
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        scratch.chmod(0o777 & ~umask)
        if folder.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{folder.name}.old.", dir=folder.parent))
            folder.rename(old / folder.name)
            scratch.rename(folder)
            shutil.rmtree(old)
        else:
            scratch.rename(folder)
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    return folder / "index.html"


def _page(
    trials: TrialData,
    verdict: Acceptance,
    model: CellModel | None,
    report: CalibrationReport | None,
    trials_path: Path | None,
    known_length: str,
) -> str:
    heading = "Calibration failed" if model is None else f"Calibration: model epoch {model.epoch}"
    parts = [
        f"<h1>{_e(heading)}</h1>",
        f'<p class="verdict {verdict.grade.split()[0]}">{_e(verdict.text)}</p>',
    ]
    if model is not None and report is not None:
        rest = residuals_of(model, trials, report)
        parts += [
            f"<p>{_facts(model, report)}</p>",
            "<h2>Residuals by joint and camera</h2>",
            "<p>Residual rms beside the floor that the stated noise sets. A joint far above its floor has play, a "
            "wrong scale or an encoder fault; a camera far above all others has a lens or a detector of its own.</p>",
            _image(draw_levels(model, report, rest)),
            _joints(model, rest),
            *_joint_errors(report),
            "<h2>Residual histograms</h2>",
            "<p>Residuals in stated sigmas against the Gaussian that they should be (line).</p>",
            _image(draw_histograms(model, rest)),
            "<h2>Residual vectors</h2>",
            "<p>Where in the image the residuals lie. Arrows without a pattern are noise; a ring or a swirl is the "
            "lens.</p>",
            _image(draw_vectors(model, rest)),
            "<h2>What is known, and how well</h2>",
            _cameras(report),
            _quantities(model),
            *_dimensions(model, known_length),
            "<h2>Left out</h2>",
            _outliers(report),
        ]
        for title, lines in (("Notes of the fit", report.notes), ("Taken as stated", report.untested)):
            if lines:
                parts += [f"<h2>{title}</h2>", "<ul>", *(f"<li>{_e(line)}</li>" for line in lines), "</ul>"]
    parts += [
        "<h2>Tracks</h2>",
        "<p>Every marker at every stop, one colour for the trial of each joint. Tracks must be smooth arcs or lines; a "
        "dot off its arc is a wrong match.</p>",
        _image(draw_tracks(trials)),
        _seen(trials),
    ]
    if trials_path is not None:
        parts.append(
            f"<p>The trial data are in <code>{_e(trials_path)}</code>; "
            f"<code>stereoservo calibrate CELL --trials {_e(trials_path)}</code> fits them again.</p>"
        )
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{_e(heading)}</title><style>{_STYLE}</style>'
        f"<body>{chr(10).join(parts)}</body></html>\n"
    )


def _e(value: object) -> str:
    return html.escape(str(value))


def _table(head: tuple[str, ...], rows: list[tuple[object, ...]]) -> str:
    lines = ["<table><tr>" + "".join(f"<th>{_e(cell)}</th>" for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{_e(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return "\n".join([*lines, "</table>"])


def _image(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">'


# -- words and tables ---------------------------------------------------------------------------------------


def _facts(model: CellModel, report: CalibrationReport) -> str:
    statistics = model.statistics
    if statistics is None:
        return ""
    return _e(
        f"{statistics.images} images, {statistics.measurements} measurements, {statistics.parameters} parameters "
        f"net of gauge; residual {statistics.rms_px:.4g} px rms; chi-square {statistics.chi2:.0f} with "
        f"{statistics.degrees_of_freedom} degrees of freedom ({'' if statistics.chi2_ok else 'NOT '}inside the "
        f"99.9 % interval); residuals {report.sigma_factor:.3f} times the stated noise; predicted pixels "
        f"known to {report.prediction_rms_px:.3g} px rms, {report.prediction_max_px:.3g} px at worst. "
        f"Stratum {STRATA[model.stratum]}."
    )


def floors(model: CellModel, rest: Residuals) -> FloatArray:
    """Expected residual rms (n,) [px] of each joint's trial: the fit's, or its sigmas if the model has none."""
    statistics = model.statistics
    found = []
    for j in range(len(model.joint_names)):
        stated = None if statistics is None else statistics.joints[j].expected_px
        mine = (rest.joint == j) & ~rest.left_out
        own = float(np.sqrt((rest.data.sigmas[mine] ** 2).mean())) if mine.any() else 0.0
        found.append(own if stated is None else stated)
    return np.array(found)


def _joints(model: CellModel, rest: Residuals) -> str:
    statistics = model.statistics
    if statistics is None:
        return ""
    rows: list[tuple[object, ...]] = []
    for joint, kind, floor in zip(statistics.joints, model.joint_kinds, floors(model, rest), strict=True):
        span = f"{np.degrees(joint.range):.1f}°" if kind == "revolute" else f"{joint.range:.4f} m"
        rows.append((joint.name, kind, joint.stops, span, f"{joint.rms_px:.4f}", f"{floor:.4f}"))
    return _table(("joint", "kind", "stops", "moved", "rms [px]", "floor [px]"), rows)


def _joint_errors(report: CalibrationReport) -> list[str]:
    """Section on the errors of the joint readings; empty if the trials show none."""
    if not report.joints:
        return []
    rows: list[tuple[object, ...]] = []
    for joint in report.joints:
        unit = "mrad" if joint.kind == "revolute" else "mm"
        rows.append(
            (
                joint.name,
                f"{1e3 * joint.repeatable:.3g} ± {1e3 * joint.repeatable_std:.1g} {unit}",
                f"{1e3 * joint.random:.3g} ± {1e3 * joint.random_std:.1g} {unit}",
                f"{1e3 * joint.posture:.3g} ± {1e3 * joint.posture_std:.1g} {unit}",
                f"{joint.pixels:.3g}",
            )
        )
    return [
        "<h2>Errors of the joint readings</h2>",
        f"<p>{_e(JOINT_ERRORS)}.</p>",
        _table(("joint", "repeatable", "random", "by posture", "in the images [px]"), rows),
    ]


def _quantities(model: CellModel) -> str:
    """Section on gauge-invariant quantities with standard deviations; those of the images are folded, undetermined ones
    are listed.
    """
    inner: list[tuple[object, ...]] = []
    seen: list[tuple[object, ...]] = []
    unknown: list[str] = []
    for quantity in gauge_free_quantities(model):
        if quantity.value is None:
            unknown.append(f"{quantity.name}: {quantity.reason}")
            continue
        deviation = "" if quantity.std is None else f"{quantity.std:.2g}"
        row = (quantity.name, _to_deviation(quantity.value, quantity.std), deviation, quantity.unit)
        (seen if " in " in quantity.name else inner).append(row)
    head = ("quantity", "value", "deviation", "unit")
    page = ""
    if inner:
        page = _table(head, inner) + (
            "<p>a and d are link dimensions after Denavit and Hartenberg: a of a joint is the common normal from its "
            "axis to the next, d the offset along its axis. Lengths are ratios to the one named after 'over': "
            "multiply by its true length.</p>"
        )
    if unknown:
        page += "<p>Not determined:</p><ul>" + "".join(f"<li>{_e(line)}</li>" for line in unknown) + "</ul>"
    return f"{page}<details><summary>As seen in the images</summary>{_table(head, seen)}</details>"


def _dimensions(model: CellModel, text: str) -> list[str]:
    """Section of the arm's Denavit-Hartenberg parameters by the known length stated in ``text``; empty without it."""
    if not text:
        return []
    heading = f"<h2>Denavit-Hartenberg parameters, by {_e(text)}</h2>"
    try:
        rows = denavit_hartenberg(model, known_length_of(text))
    except ReadOutError as error:
        return [heading, f"<p>Not determined: {_e(error)}.</p>"]
    return [
        heading,
        "<p>Row of a joint: what it does and the link behind it, Rz(θ) Tz(d) Tx(a) Rx(α) Ry(β); θ of a turning "
        "joint and d of a sliding one are offsets at position 0. Values in brackets are set by the convention.</p>",
        _table(DH_HEADER, [dh_cells(row) for row in rows]),
    ]


def _to_deviation(value: float, std: float | None) -> str:
    """``value`` rounded to the significant digits for its standard deviation."""
    if not std:
        return f"{value:.6g}"
    return f"{value:.{decimals(std)}f}"


def _cameras(report: CalibrationReport) -> str:
    rows: list[tuple[object, ...]] = []
    for camera in report.cameras:
        inner = "" if camera.intrinsics is None else ", ".join(f"{value:.2f}" for value in camera.intrinsics)
        lens = "pinhole"
        if camera.lens is not None:
            stds = camera.lens_std or (0.0, 0.0, 0.0)
            lens = "k {:.5f} ± {:.1g}, centre ({:.1f} ± {:.1g}, {:.1f} ± {:.1g})".format(
                *(value for pair in zip(camera.lens, stds, strict=True) for value in pair)
            )
        if camera.lens_terms is not None and camera.lens_terms_std is not None:
            pairs = zip(("k2", "p1", "p2"), camera.lens_terms, camera.lens_terms_std, strict=True)
            lens += "".join(f", {name} {value:.5f} ± {std:.1g}" for name, value, std in pairs)
        rms = f"{camera.rms_px:.4f}", f"{camera.expected_px:.4f} ± {camera.standard_error_px:.1g}"
        rows.append((camera.name, *rms, camera.pixels, camera.outliers, inner, lens))
    head = ("camera", "rms [px]", "floor [px]", "pixels", "left out", "fx, skew, fy, u0, v0 [px]", "lens")
    page = _table(head, rows)
    if report.left_intrinsics_std is not None:
        deviations = ", ".join(f"{value:.2g}" for value in report.left_intrinsics_std)
        page += f"<p>Deviations of the first camera's fx, skew, fy, u0, v0: {deviations} px.</p>"
    test = report.lens
    page += (
        f"<p>Lens: {'pinholes were taken' if test.model == 'none' else 'distortion was estimated'}; a lens that "
        f"bends is worth a chi-square of {test.chi2:.1f} for {test.freedom} parameters, pinholes stay below "
        f"{test.limit:.1f}.</p>"
    )
    return page


def _outliers(report: CalibrationReport) -> str:
    if not report.outliers and not report.markers_left_out:
        return "<p>Nothing.</p>"
    page = ""
    if report.markers_left_out:
        page = f"<p>Markers seen too rarely: {_e(', '.join(map(str, report.markers_left_out)))}.</p>"
    worst = sorted(report.outliers, key=lambda out: -out.distance_px)
    rows: list[tuple[object, ...]] = [
        (out.camera, out.stop, out.marker, f"{out.distance_px:.3g}") for out in worst[:LISTED]
    ]
    if rows:
        page += _table(("camera", "stop", "marker", "distance [px]"), rows)
    if len(worst) > LISTED:
        page += f"<p>… and {len(worst) - LISTED} more.</p>"
    return page


def _seen(trials: TrialData) -> str:
    rows: list[tuple[object, ...]] = []
    for j, name in enumerate((*trials.joint_names, "base")):
        own = trials.trials == (j if j < len(trials.joint_names) else -1)
        counts = trials.visible[:, own].sum(axis=2) if own.any() else np.zeros((len(trials.cameras), 1))
        span = np.ptp(trials.positions[own, j]) if own.any() and j < len(trials.joint_names) else 0.0
        rows.append((name, int(own.sum()), f"{span:.3f}", *(f"{row.min():.0f} to {row.max():.0f}" for row in counts)))
    head = ("trial", "stops", "moved [rad or m]", *(f"markers in {camera.name}" for camera in trials.cameras))
    return _table(head, rows)


# -- pictures -----------------------------------------------------------------------------------------------


def _axes(figure: Figure, rows: int, columns: int, **options: Any) -> npt.NDArray[Any]:
    return np.asarray(figure.subplots(rows, columns, squeeze=False, **options)).ravel()


def _view(axes: Any, name: str, width: int, height: int) -> None:
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title=name, xlabel="u [px]", ylabel="v [px]")


def draw_tracks(trials: TrialData) -> Figure:
    """Figure of all markers in each camera, the joints' trials in their colours."""
    c = len(trials.cameras)
    figure = Figure(figsize=(5.8 * c, 5.0), layout="constrained")
    colours = matplotlib.colormaps["tab10"]
    for k, (axes, camera) in enumerate(zip(_axes(figure, 1, c), trials.cameras, strict=True)):
        _view(axes, camera.name, camera.width, camera.height)
        for j, name in enumerate(trials.joint_names):
            own = np.flatnonzero(trials.trials == j)
            order = own[np.argsort(trials.positions[own, j])]
            for m in range(len(trials.marker_ids)):
                line = trials.pixels[k, order, m]
                axes.plot(*line.T, ".-", color=colours(j % 10), ms=3, lw=0.6, label=name if m == 0 else None)
        base = trials.pixels[k, trials.trials < 0].reshape(-1, 2)
        axes.plot(*base.T, "k+", ms=5, label="base")
        axes.legend(fontsize="small", loc="best")
    return figure


def draw_levels(model: CellModel, report: CalibrationReport, rest: Residuals) -> Figure:
    """Figure of the residual rms of each joint, with the expected one, and of each camera."""
    figure = Figure(figsize=(11.0, 3.4), layout="constrained")
    left, right = _axes(figure, 1, 2)
    kept = ~rest.left_out
    squares = (rest.pixels**2).mean(axis=1)
    trials_of = [kept & (rest.joint == j) for j in range(len(model.joint_names))]
    levels = [float(np.sqrt(squares[own].mean())) if own.any() else 0.0 for own in trials_of]
    at = np.arange(max(len(levels), len(model.cameras)))
    mine = at[: len(levels)]
    left.bar(mine - 0.2, levels, 0.4, label="residual rms")
    left.bar(mine + 0.2, floors(model, rest), 0.4, label="floor", color="0.7")
    left.set(xticks=mine, xticklabels=model.joint_names, ylabel="[px]", title="by joint")
    left.margins(y=0.25)  # space for the legend above the bars
    left.legend(fontsize="small", loc="upper right", ncols=2)
    cameras = [kept & (rest.data.camera == c) for c in range(len(model.cameras))]
    right.bar([camera.name for camera in model.cameras], [float(np.sqrt(squares[m].mean())) for m in cameras], 0.5)
    stated = [camera.expected_px for camera in report.cameras]
    right.hlines(stated, at[: len(stated)] - 0.35, at[: len(stated)] + 0.35, color="k", label="floor")
    right.set(ylabel="[px]", title="by camera")
    right.legend(fontsize="small")
    return figure


def draw_histograms(model: CellModel, rest: Residuals) -> Figure:
    """Figure of the residuals in sigmas, of each joint's trial and of each camera, against the standard Gaussian."""
    kept = ~rest.left_out
    groups = [(name, rest.joint == j) for j, name in enumerate(model.joint_names)]
    groups += [(f"camera {camera.name}", rest.data.camera == c) for c, camera in enumerate(model.cameras)]
    columns = 4
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(11.0, 2.2 * rows), layout="constrained")
    x = np.linspace(-5.0, 5.0, 200)
    panels = _axes(figure, rows, columns, sharex=True)
    for axes, (name, mine) in zip(panels, groups, strict=False):
        values = rest.sigmas[mine & kept].ravel()
        if values.size:
            axes.hist(np.clip(values, -5.0, 5.0), HISTOGRAM, density=True, color="0.75")
        axes.plot(x, np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi), "C3", lw=1.0)
        rms_sigmas = float(np.sqrt((values**2).mean())) if values.size else 0.0
        axes.set(title=f"{name}: {rms_sigmas:.2f} sigmas", yticks=[])
        axes.title.set_size("small")
    for axes in panels[len(groups) :]:
        axes.axis("off")
    return figure


def draw_vectors(model: CellModel, rest: Residuals) -> Figure:
    """Figure of the residual vectors over each image, magnified so that the rms is a thirtieth of the width."""
    c = len(model.cameras)
    figure = Figure(figsize=(5.8 * c, 4.8), layout="constrained")
    kept = ~rest.left_out
    rms = float(np.sqrt((rest.pixels[kept] ** 2).mean())) if kept.any() else 1.0
    for k, (axes, camera) in enumerate(zip(_axes(figure, 1, c), model.cameras, strict=True)):
        mine = kept & (rest.data.camera == k)
        gain = camera.width / 30.0 / max(rms, 1e-12)
        _view(axes, f"{camera.name}, magnified {gain:.3g} times", camera.width, camera.height)
        if mine.any():
            axes.quiver(
                *rest.data.pixels[mine].T,
                *(gain * rest.pixels[mine]).T,
                angles="xy",
                scale_units="xy",
                scale=1.0,
                width=0.002,
            )
    return figure
