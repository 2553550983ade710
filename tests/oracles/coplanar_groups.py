"""Faces of a marker body from all of its marker triples, in numpy: the readable reference of `control.faces`.

As it was before models held their coplanar groups: of the order of m⁴, for bodies of some tens of markers.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from stereoservo.control.faces import Faces
from stereoservo.control.marker_groups import (
    IN_PLANE,
    SPANS,
    marker_covariances,
    marker_distances,
    marker_information,
    trial_views,
    triangle_altitudes,
    turned_average,
)
from stereoservo.numerics.arrays import FloatArray


def faces_of_all_triples(
    points: FloatArray,
    matrices: FloatArray,
    sigma_px: float,
    camera_centres: FloatArray,
    seen: FloatArray,
    operators: FloatArray,
) -> Faces:
    """What `control.faces.find_faces` returns."""
    m = len(points)
    views = trial_views(points, matrices, operators)
    information = marker_information(points, views, sigma_px * np.sqrt(len(views) / len(matrices)))
    covariances = marker_covariances(points, information)
    form = turned_average(information, operators)
    distances = marker_distances(points, form)
    triples = np.array(list(combinations(range(m), 3)), dtype=np.int64)
    altitudes = triangle_altitudes(points, form, triples)
    groups: list[tuple[np.ndarray, np.ndarray, int, int, float]] = []
    for t in np.argsort(-altitudes, kind="stable"):
        triple = triples[t]
        if altitudes[t] < SPANS or any(g[1].sum() > 3 and g[1][triple].all() for g in groups):
            continue
        deviations = _deviations(points, covariances, triple)
        inside = np.abs(deviations) <= IN_PLANE
        extent = distances[np.ix_(inside, inside)].max()
        above, below = int((~inside & (deviations > 0)).sum()), int((~inside & ~(deviations > 0)).sum())
        groups.append((triple, inside, above, below, altitudes[t] / extent))

    def whole(group: tuple[np.ndarray, np.ndarray, int, int, float]) -> bool:
        counts = (seen[:, group[1]] > 0).sum(axis=1)
        return not ((counts > 0) & (counts < group[1].sum())).any()

    groups.sort(key=lambda g: (-whole(g), -g[1].sum(), -g[4]))
    chosen, left = [], np.ones(m, bool)
    for step in range(3):
        for triple, inside, above, below, _ in groups:
            bounds, many = above == 0 or below == 0, inside.sum() > 3
            if not ((bounds and many) if step == 0 else many if step == 1 else bounds):
                continue
            if (left & inside).sum() >= (3 if step < 2 else 1):
                chosen.append((triple, inside, above, below))
                left &= ~inside
    outward, sided = [], []
    for triple, inside, above, below in chosen:
        plane = np.linalg.det(np.concatenate([np.tile(points[triple], (4, 1, 1)), np.eye(4)[:, None]], axis=1))
        sees = (seen[:, inside] > 0).sum(axis=1) >= 3
        side = np.sign(np.sign(camera_centres[sees] @ plane).sum()) or np.sign(below) - np.sign(above)
        outward.append(triple if side >= 0 else triple[[0, 2, 1]])
        sided.append(abs(float(side)))
    members = np.array([inside for _, inside, *_ in chosen], float).reshape(-1, m)
    return Faces(np.array(outward, dtype=np.int64).reshape(-1, 3), members, np.array(sided), points)


def _deviations(points: FloatArray, covariances: FloatArray, triple: np.ndarray) -> FloatArray:
    """``det[M_i M_j M_k M_l]`` (m,) of the triple and each marker l, in standard deviations of itself."""
    others = np.setdiff1d(np.arange(len(points)), triple)
    four = np.column_stack([np.tile(triple, (len(others), 1)), others])
    # the determinant's derivative by a point: the point replaced by each unit vector
    replaced = np.tile(points[four][:, None, None], (1, 4, 4, 1, 1))
    for row in range(4):
        replaced[:, row, :, row] = np.eye(4)
    derivatives = np.linalg.det(replaced)
    variances = np.einsum("lri,lrij,lrj->l", derivatives, covariances[four], derivatives)
    found = np.zeros(len(points))
    found[others] = np.linalg.det(points[four]) / np.sqrt(variances)
    return found
