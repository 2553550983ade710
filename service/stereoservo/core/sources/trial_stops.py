"""Where the stops of trials are: of single joints, unevenly apart and as far as the images of a small first motion let
expect the markers in view, and of all joints at once, which show what single ones cannot: sag that depends on several
of them, joints that turn with others, their order.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from stereoservo.core.cycle import Sample
from stereoservo.core.settings import LARGEST_RANGE, CoreSettings, TrialSettings
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointKindName

GOLDEN = 0.6180339887498949
UNEVEN_STEP = 0.5
"""Share of a step by which stops of a single joint stand nearer at most."""
SHARE, UNEVEN = 0.8, 0.5
"""Of half the way that a joint was driven, how far it stands from the middle of that way at most; share of that by
which stops differ, so that a gear's ripple does not repeat and what grows with the way shows."""
ORDER = 16
"""Of the Hadamard matrix that gives the sides on which joints stand: its columns after the first, of ones, are as many
joints as a cell has at most."""
SHRUNK = (1.0, 0.75, 0.5)
"""Shares of a stop that are tried one after the other until the markers stay in view."""


def stop_offset(side: int, k: int, count: int, step: float) -> float:
    """Offset from the base [rad or m] of stop ``k`` of the ``count`` on a ``side``, 1 or -1; at its end, ``count``
    steps.

    Stops before the end stand up to half a step nearer, by the multiples of the golden ratio: where all were equally
    far apart, a gear's ripple whose period divides that distance would show at none of them.
    """
    if k == 0 or k == count:
        return side * k * step
    return side * step * (k - UNEVEN_STEP * ((k * GOLDEN + 0.25 * (1 - side)) % 1.0))


def combined_offsets(k: int, low: FloatArray, high: FloatArray) -> FloatArray:
    """Offsets (n,) from the base of stop ``k`` of all joints, which single ones were driven from ``low`` to ``high``
    (n,).

    Signs are those of the columns of a Hadamard matrix: within ``ORDER`` stops every pair of joints meets equally often
    on either side.
    """
    joint = np.arange(len(low))
    signs = np.array([1.0 - 2.0 * (((k % ORDER) & (1 + j)).bit_count() % 2) for j in joint.tolist()])
    shares = SHARE * (1.0 - UNEVEN * ((GOLDEN * (k + 1) * (joint + 1)) % 1.0))
    return np.asarray(0.5 * (low + high) + signs * shares * 0.5 * (high - low))


def in_view_at(offsets: FloatArray, in_view: Callable[[FloatArray], bool]) -> FloatArray | None:
    """``offsets`` (n,), or the largest share of them, that ``in_view`` allows; None where it allows none."""
    for share in SHRUNK:
        if in_view(share * offsets):
            return share * offsets
    return None


MIN_STOPS = 4  # of one joint, the base among them
MIN_MOTION_SIGMAS = 40.0
"""Motion in the images below which a joint's axis drowns in the noise of its stops."""
PROBE: dict[JointKindName, float] = {"revolute": 0.02, "prismatic": 0.005}  # [rad, m]
BORDER = 0.03
"""Margin kept from the border of a view, of its width."""
KEPT = 0.75
"""Share of the markers seen at the base that must stay inside; never fewer than ``min_markers``."""


def probe_size(kind: JointKindName) -> float:
    """Offset of the first small motion of a joint [rad or m]."""
    return PROBE[kind]


def room(joint: int, core: CoreSettings, settings: TrialSettings) -> FloatArray:
    """How far (2,) a joint may go upwards and downwards from its base: its limits, and a sensible largest range."""
    limits = core.limits
    margin = limits.position_margin + 4.0 * core.arrival[joint]
    base = settings.base[joint]
    up = limits.position_max[joint] - margin - base
    down = base - limits.position_min[joint] - margin
    largest = LARGEST_RANGE[core.joint_kinds[joint]]
    return np.array([min(max(float(up), 0.0), largest), min(max(float(down), 0.0), largest)])


def marker_pixels(samples: tuple[Sample, ...], core: CoreSettings) -> tuple[FloatArray, FloatArray]:
    """Pixels (c, m, 2) and sigmas (c, m) [px] of a stop in the cell's order, NaN where a marker was not seen."""
    row = {camera.name: c for c, camera in enumerate(core.cameras)}
    column = {marker: i for i, marker in enumerate(core.marker_ids)}
    pixels = np.full((len(row), len(column), 2), np.nan)
    sigmas = np.full((len(row), len(column)), np.nan)
    for sample in samples:
        c = row[sample.camera]
        seen = [column[marker] for marker in sample.ids.tolist()]
        pixels[c, seen] = sample.pixels
        sigmas[c, seen] = np.sqrt(0.5 * (sample.covariances[:, 0, 0] + sample.covariances[:, 1, 1]))
    return pixels, sigmas


def image_motion(base: FloatArray, pixels: FloatArray, sigmas: FloatArray) -> float:
    """Mean distance of the markers from where they were at the base, in sigmas, in the camera that shows it best.

    ``base``, ``pixels`` (c, m, 2), ``sigmas`` (c, m) [px].
    """
    distance = np.sqrt(((pixels - base) ** 2).sum(axis=-1)) / sigmas
    best = 0.0
    for row in distance:
        seen = row[np.isfinite(row)]
        if seen.size:
            best = max(best, float(seen.sum()) / seen.size)
    return best


def _needed(seen: int, settings: TrialSettings) -> int:
    return max(settings.min_markers, int(np.ceil(KEPT * seen)))


def enough_inside(pixels: FloatArray, core: CoreSettings, settings: TrialSettings) -> bool:
    """Whether enough of the markers (p, c, m, 2) lie inside every view by a margin; NaN: was not seen, not counted."""
    for c, camera in enumerate(core.cameras):
        inside = _inside(pixels[:, c], camera.width, camera.height)
        known = np.isfinite(pixels[:, c]).all(axis=-1)
        for seen, kept in zip(known.sum(axis=-1), (inside & known).sum(axis=-1), strict=True):
            if seen and kept < _needed(int(seen), settings):
                return False
    return True


def _inside(pixels: FloatArray, width: int, height: int) -> npt.NDArray[np.bool_]:
    margin = BORDER * width
    top = np.array([width, height]) - 1.0 - margin
    inside = (pixels >= margin) & (pixels <= top)
    return np.asarray(inside.all(axis=-1))


def extrapolated(
    last: FloatArray, last_at: float, before: FloatArray, before_at: float, at: float
) -> FloatArray:
    """Pixels (p, c, m, 2) at offset ``at`` on the straight line through those of two stops."""
    found: FloatArray = last + (last - before) * ((at - last_at) / (last_at - before_at))
    return found


def plan_sides(
    base: FloatArray, probe: FloatArray, offset: float, reach: FloatArray, core: CoreSettings,
    settings: TrialSettings,
) -> tuple[FloatArray, FloatArray, tuple[int, int]]:  # fmt: skip
    """From a probe's pixels (p, c, m, 2) at ``offset``: reach (2,) up and down, steps (2,), numbers of stops.

    The reach is where, on straight lines through base and probe, too few markers would be left in some view, and never
    beyond ``reach`` (2,) as given.
    """
    rates = (probe - base) / offset
    found = np.array(
        [
            min([float(reach[i])] + [
                _way(base[p, c], sign * rates[p, c], camera.width, camera.height, settings)
                for p in np.flatnonzero(np.isfinite(probe - base).any(axis=(1, 2, 3)))
                for c, camera in enumerate(core.cameras)
            ])
            for i, sign in enumerate((1.0, -1.0))
        ]
    )  # fmt: skip
    found[found < 2.0 * abs(offset)] = 0.0
    total = settings.stops - 1
    if found.sum() == 0.0:
        return found, np.zeros(2), (0, 0)
    up = int(np.clip(round(total * found[0] / found.sum()), 1, total - 1)) if found.all() else 0
    counts = (up, total - up) if found.all() else ((total, 0) if found[0] > 0.0 else (0, total))
    steps = np.array([r / count if count else 0.0 for r, count in zip(found, counts, strict=True)])
    return found, steps, counts


def _way(pixels: FloatArray, rates: FloatArray, width: int, height: int, settings: TrialSettings) -> float:
    """How far markers (m, 2) may go at ``rates`` (m, 2) [px a unit] until too few are left inside."""
    margin = BORDER * width
    low, high = np.full(2, margin), np.array([width, height]) - 1.0 - margin
    ways = []
    for pixel, rate in zip(pixels, rates, strict=True):
        if not (np.isfinite(pixel).all() and np.isfinite(rate).all()):
            continue
        way = np.inf
        for x, v, a, b in zip(pixel, rate, low, high, strict=True):
            if v != 0.0:
                way = min(way, max(0.0, ((b if v > 0.0 else a) - x) / v))
        ways.append(way)
    if not ways:
        return 0.0
    ways.sort(reverse=True)
    return float(ways[min(_needed(len(ways), settings), len(ways)) - 1])


def too_little(
    joint: int, stops: int, visited: float, motion: float, sigma_px: float, core: CoreSettings,
    settings: TrialSettings,
) -> Reason | None:  # fmt: skip
    """Why a joint's trial cannot identify it, and the cure: too few stops, too small a range, or too little motion
    in the images (``motion`` in sigmas of ``sigma_px``).
    """
    name = core.joint_names[joint]
    stated = np.isfinite(settings.range[joint])
    wider = (
        f"raise calibration.range.{name}"
        if stated
        else "put the base where this joint has more room before the border of a view or its limit"
    )
    if stops < MIN_STOPS or visited < settings.min_range:
        return Reason(
            "TRIAL_TOO_SMALL", "hold", name, visited, settings.min_range, "rad or m",
            f"joint {name} was seen at {stops} stops over {visited:.3f}; at least {MIN_STOPS} stops over "
            f"{settings.min_range} are needed: change calibration.base so that the markers stay in view, or {wider}",
        )  # fmt: skip
    if motion < MIN_MOTION_SIGMAS:
        more = MIN_MOTION_SIGMAS / max(motion, 0.1)
        return Reason(
            "TRIAL_TOO_SMALL", "hold", name, motion, MIN_MOTION_SIGMAS, "sigmas",
            f"joint {name} moved the markers by {motion:.1f} sigmas of {sigma_px:.3g} px over {visited:.3f}; at least "
            f"{MIN_MOTION_SIGMAS:g} are needed to see its axis: {wider} ({more:.1f} times as much), put the markers "
            "farther from its axis, or lower the noise (light, larger dots, calibration.frames)",
        )  # fmt: skip
    return None
