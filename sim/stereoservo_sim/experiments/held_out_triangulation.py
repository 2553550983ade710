"""Tag corners triangulated at poses that no camera was fitted to: every pair of cameras beside all of them.

The truth is where the arm says that the corners are; its own error is common to all sets of cameras, which are compared
on the same corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.cameras import triangulate
from stereoservo_sim.experiments.driven_cameras import DrivenCameras, TagViews, carried, undistort

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Triangulated:
    """Cameras (indices) that were used, and the distances ``errors`` (n,) [m] of the corners from where they are."""

    cameras: tuple[int, ...]
    errors: FloatArray

    @property
    def rms_mm(self) -> float:
        """Root mean square distance [mm]."""
        return float(1e3 * np.sqrt(np.mean(self.errors**2)))


def triangulation_errors(
    folds: Sequence[tuple[int, IntArray, DrivenCameras]],
    displacements: FloatArray,
    views: TagViews,
    fold: IntArray,
) -> list[Triangulated]:
    """Each set of two or more of the cameras that every fold fitted, the largest set last.

    ``folds``: number, cameras (indices) and the model fitted without it; ``fold`` (v,) of the views. Only poses in
    which all these cameras saw the tag count. Empty where there is none.
    """
    if not folds:
        return []
    common = sorted(set.intersection(*(set(kept.tolist()) for _, kept, _ in folds)))
    subsets = [s for size in range(2, len(common) + 1) for s in combinations(common, size)]
    errors: dict[tuple[int, ...], list[FloatArray]] = {subset: [] for subset in subsets}
    for number, kept, model in folds:
        held = views.take(fold == number)
        for pose in np.unique(held.pose):
            at = {int(c): held.pixels[(held.pose == pose) & (held.camera == c)] for c in common}
            if any(len(pixels) != 1 for pixels in at.values()):
                continue
            truth = carried(displacements[pose][None], model.corners)[0]
            for subset in subsets:
                rows = [int(np.flatnonzero(kept == c)[0]) for c in subset]
                ideal = np.array(
                    [
                        undistort(at[c][0], model.radial[row][None], model.sizes[row][None])
                        for c, row in zip(subset, rows, strict=True)
                    ]
                )
                points = triangulate(model.Ps[rows], ideal)
                errors[subset].append(np.linalg.norm(points[:, :3] / points[:, 3:] - truth, axis=1))
    return [Triangulated(s, np.concatenate(found)) for s, found in errors.items() if found]
