"""Connected components of a window, and the level around one. Numba kernels; no state."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo_drivers.detectors.compilation import kernel

MAX_WINDOW = 160
"""Largest side of a window [px]."""


def scratch() -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Label image and stack for :func:`measure`, to be reused between calls of one thread."""
    return np.zeros((MAX_WINDOW, MAX_WINDOW), np.int32), np.zeros(MAX_WINDOW * MAX_WINDOW, np.int32)


@kernel
def median_level(histogram, count):
    half = (count + 1) // 2
    total = 0
    for level in range(256):
        total += histogram[level]
        if total >= half:
            return float(level)
    return 255.0


@kernel
def nearest_component(image, dark, box, threshold, pu, pv, min_area, labels, stack, found):
    """Label the bright components of a window; the label of the one nearest to (pu, pv), 0 if there is none.

    ``found``: count, sum u, sum v, u_min, u_max, v_min, v_max, level sum of its inner pixels, their count.
    Components that touch the window's rim are something larger than a dot and do not count.
    """
    u0, v0, u1, v1 = box
    labels[: v1 - v0, : u1 - u0] = 0
    best = 0
    best_distance = 1e30
    label = 0
    for sv in range(v0, v1):
        for su in range(u0, u1):
            level = int(image[sv, su])
            if dark:
                level = 255 - level
            if level < threshold or labels[sv - v0, su - u0] != 0:
                continue
            label += 1
            labels[sv - v0, su - u0] = label
            stack[0] = (sv - v0) * MAX_WINDOW + (su - u0)
            top = 1
            count = 0
            sum_u = 0
            sum_v = 0
            u_min, u_max, v_min, v_max = su, su, sv, sv
            inner_sum = 0
            inner = 0
            while top > 0:
                top -= 1
                v = stack[top] // MAX_WINDOW + v0
                u = stack[top] % MAX_WINDOW + u0
                count += 1
                sum_u += u
                sum_v += v
                u_min = min(u_min, u)
                u_max = max(u_max, u)
                v_min = min(v_min, v)
                v_max = max(v_max, v)
                neighbours = 0
                for k in range(4):
                    nu = u + (1 if k == 0 else -1 if k == 1 else 0)
                    nv = v + (1 if k == 2 else -1 if k == 3 else 0)
                    if nu < u0 or nu >= u1 or nv < v0 or nv >= v1:
                        continue
                    other = int(image[nv, nu])
                    if dark:
                        other = 255 - other
                    if other < threshold:
                        continue
                    neighbours += 1
                    if labels[nv - v0, nu - u0] == 0:
                        labels[nv - v0, nu - u0] = label
                        stack[top] = (nv - v0) * MAX_WINDOW + (nu - u0)
                        top += 1
                if neighbours == 4:
                    here = int(image[v, u])
                    inner_sum += 255 - here if dark else here
                    inner += 1
            if count < min_area or u_min == u0 or v_min == v0 or u_max == u1 - 1 or v_max == v1 - 1:
                continue
            du = sum_u / count - pu
            dv = sum_v / count - pv
            if du * du + dv * dv < best_distance:
                best_distance = du * du + dv * dv
                best = label
                found[0] = count
                found[1] = sum_u
                found[2] = sum_v
                found[3] = u_min
                found[4] = u_max
                found[5] = v_min
                found[6] = v_max
                found[7] = inner_sum
                found[8] = inner
    return best


@kernel
def ring_level(image, dark, u_min, u_max, v_min, v_max):
    """Median level of the rectangular ring 3 to 4 px outside a bounding box (all inside the image)."""
    histogram = np.zeros(256, np.int32)
    count = 0
    for grow in (3, 4):
        for u in range(u_min - grow, u_max + grow + 1):
            for v in (v_min - grow, v_max + grow):
                level = int(image[v, u])
                histogram[255 - level if dark else level] += 1
                count += 1
        for v in range(v_min - grow + 1, v_max + grow):
            for u in (u_min - grow, u_max + grow):
                level = int(image[v, u])
                histogram[255 - level if dark else level] += 1
                count += 1
    return median_level(histogram, count)
