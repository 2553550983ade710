"""Data of a session report as plain arrays, with a check of their shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from stereoservo.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class CalibrationPlots:
    """Data of a self-calibration. Missing pixels and residuals are NaN.

    ``pixels`` and ``residuals`` (cameras, stops, markers, 2) [px]; ``joint`` (stops,) is the index of the
    joint that moved, -1 for a stop that belongs to none; ``sizes`` (cameras, 2) image width and height [px].
    ``sigma_px``: the noise [px] per coordinate that residuals are held against, or None. ``figures``: further
    lines of the table, name to value.
    """

    cameras: tuple[str, ...]
    joints: tuple[str, ...]
    sizes: IntArray
    joint: IntArray
    pixels: FloatArray
    residuals: FloatArray
    rms_px: float
    images: int
    seconds: float
    sigma_px: float | None = None
    figures: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class GoalPlots:
    """Data of one goal. ``times_s`` (t,), ``error_px`` (t,) NaN where unknown, ``velocities`` (t, joints) [rad/s or
    m/s].

    ``path_m`` (p, 3) of the centre and ``line_m`` (2, 3), start and end of its straight line [m]. ``gain``
    [1/s] draws the exponential that the law promises. ``tracks`` maps a camera's name to pixels (t', markers,
    2) [px].
    """

    name: str
    law: str
    outcome: str
    times_s: FloatArray
    error_px: FloatArray
    velocities: FloatArray
    path_m: FloatArray
    line_m: FloatArray
    final_error_px: float
    final_error_mm: float
    max_line_deviation_mm: float
    rotation_deg: float
    distance_mm: float
    steps: int
    seconds: float
    gain: float | None = None
    tracks: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True)
class ReportData:
    """All data of one report. ``facts``: lines of the last table (seed, loop, versions), name to value.

    ``velocity_limits`` (joints,) [rad/s or m/s] or None; ``tolerance_px``: what counts as reached.
    """

    title: str
    joints: tuple[str, ...]
    calibration: CalibrationPlots | None
    goals: tuple[GoalPlots, ...]
    tolerance_px: float | None = None
    velocity_limits: FloatArray | None = None
    summary: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)


def check_shapes(data: ReportData) -> None:
    """Raise ValueError naming the array whose shape does not fit the rest."""
    n = len(data.joints)
    if data.velocity_limits is not None:
        _expect("velocity_limits", data.velocity_limits, (n,))
    for goal in data.goals:
        t = len(goal.times_s)
        _expect(f"error_px of goal {goal.name!r}", goal.error_px, (t,))
        _expect(f"velocities of goal {goal.name!r}", goal.velocities, (t, n))
        _expect(f"path_m of goal {goal.name!r}", goal.path_m, (len(goal.path_m), 3))
        _expect(f"line_m of goal {goal.name!r}", goal.line_m, (2, 3))
    c = data.calibration
    if c is not None:
        cameras, stops = len(c.cameras), len(c.joint)
        markers = c.pixels.shape[2] if c.pixels.ndim == 4 else -1
        _expect("sizes of the calibration", c.sizes, (cameras, 2))
        _expect("pixels of the calibration", c.pixels, (cameras, stops, markers, 2))
        _expect("residuals of the calibration", c.residuals, (cameras, stops, markers, 2))


def _expect(what: str, array: FloatArray | IntArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{what} has shape {array.shape}; {shape} is needed")
