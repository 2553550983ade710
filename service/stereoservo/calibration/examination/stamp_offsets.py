"""By how much a camera's stamps are early or late against known displacements of the body, such as the hand's poses,
before any camera is known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.numerics.arrays import FloatArray, IntArray

SOUGHT_S, GRID_S = 0.2, 0.02
"""Offsets that are tried, to either side, and their distance."""
TOLD_S = 2e-3
"""Offsets below are left to the examination, which knows the cameras."""
MARKERS = 4
"""Those seen most often are used."""
WEIGHED = 3
"""Times that the depths are put into the weights again."""
SPARE = 2.0
"""Rows for each unknown below which nothing is told."""


class Course(NamedTuple):
    """Of some frames: ``offsets`` (c,) [s] by which each camera's pictures are later than stamped, and the mean square
    [sigmas²] that is left then, of the worst camera.
    """

    offsets: FloatArray
    misfit: float


def course(views: RecordedViews, frames: IntArray) -> Course:
    """The course of ``frames`` (k,) of a recording whose displacements are known.

    A pixel is a ratio of linear forms in the entries of the body's displacement, whatever camera and marker are:
    fitted to each marker at the displacements of many offsets (direct linear transformation, depths as weights).
    """
    offsets, left = np.zeros(len(views.cameras)), 0.0
    grid = np.arange(-SOUGHT_S, SOUGHT_S + 0.5 * GRID_S, GRID_S) if views.timed else np.zeros(1)
    for c in range(len(views.cameras)):
        mine = frames[views.camera[frames] == c]
        costs = np.array([_misfit(views, mine, float(late)) for late in grid])
        if not np.isfinite(costs).all():
            continue
        k = int(np.argmin(costs))
        late, least = float(grid[k]), float(costs[k])
        if 0 < k < len(grid) - 1:
            bend = costs[k - 1] - 2.0 * costs[k] + costs[k + 1]
            finer = late + 0.5 * GRID_S * float(costs[k - 1] - costs[k + 1]) / max(float(bend), 1e-300)
            if (there := _misfit(views, mine, finer)) <= least:
                late, least = finer, there
            offsets[c] = late if abs(late) >= TOLD_S else 0.0
        left = max(left, least)
    return Course(offsets, left)


def _misfit(views: RecordedViews, mine: IntArray, late: float) -> float:
    """Mean square [sigmas²] that is left of the pixels of frames ``mine`` at displacements ``late`` [s] after them;
    infinite from too few.
    """
    seen = views.seen[mine]
    forms = _forms(views, views.times[mine] + late)
    cost, freedom = 0.0, 0
    for marker in np.argsort(-seen.sum(axis=0), kind="stable")[:MARKERS].tolist():
        known = seen[:, marker]
        if 2 * known.sum() < SPARE * 3 * forms.shape[1]:
            continue
        pixels, sigmas = views.pixels[mine[known], marker], views.sigmas[mine[known], marker]
        apart, unknowns = _fitted(forms[known], pixels)
        cost += float(((apart / sigmas[:, None]) ** 2).sum())
        freedom += apart.size - unknowns
    return cost / freedom if freedom > 0 else np.inf


def _forms(views: RecordedViews, times: FloatArray) -> FloatArray:
    """Entries (k, r) of the displacements that change, each centred and of deviation 1, and a column of ones."""
    assert views.generators is not None
    chain = ProjectiveChain(views.joint_kinds, views.generators, np.zeros(len(views.joint_kinds)))
    entries = chain.displacements(views.at(times))[:, :3].reshape(len(times), 12)
    spread = entries.std(axis=0)
    changing = spread > 1e-9
    centred = (entries - entries.mean(axis=0))[:, changing] / spread[changing]
    return np.asarray(np.hstack([centred, np.ones((len(times), 1))]))


def _fitted(forms: FloatArray, pixels: FloatArray) -> tuple[FloatArray, int]:
    """What ratios of linear forms (k, r) leave of pixels (k, 2), and the number of their unknowns."""
    middle, size = pixels.mean(axis=0), max(float(pixels.std()), 1e-9)
    x = (pixels - middle) / size
    r = forms.shape[1]
    depths = np.ones(len(forms))
    answer = np.zeros(3 * r - 1)
    for _ in range(WEIGHED):
        F, none = forms / depths[:, None], np.zeros_like(forms)
        design = np.vstack(
            [np.hstack([F, none, -x[:, :1] * F[:, :-1]]), np.hstack([none, F, -x[:, 1:] * F[:, :-1]])]
        )
        answer = np.linalg.lstsq(design, (x / depths[:, None]).T.ravel(), rcond=1e-10)[0]
        found = 1.0 + forms[:, :-1] @ answer[2 * r :]
        if not (np.abs(found) > 1e-6).all():
            break
        depths = found
    ideal = np.column_stack([forms @ answer[:r], forms @ answer[r : 2 * r]]) / depths[:, None]
    return np.asarray((ideal - x) * size), len(answer)
