"""Layout of self-identifying planar dot patterns (seven dots per face) as pure data, shared by the detector, the
simulation and the plate printer.

A face carries seven white dots on black: four corners in clockwise order as the viewer sees them, one on the edge from
corner 0 to corner 1, and two inside. No three of them but the edge triple are nearly collinear, and the edge dot's
fraction together with the two inner dots distinguishes the faces. A detector may use the pattern of *one face* up to
scale; the arrangement of the faces on a body is known only to the ground truth of the simulation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

CORNERS = (0, 1, 2, 3)
EDGE = 4
INNER = (5, 6)


@dataclass(frozen=True, eq=False)
class DotFace:
    """One planar face with seven dots.

    ``positions`` (7, 2) [m] in face coordinates: origin in the middle, x to the right and y down as seen from in front.
    Rows: corners 0..3 clockwise, the dot on edge 0-1, two inner dots. ``ids``: of the rows. ``radius`` [m] of a dot,
    ``half_side`` [m] of the black square around them.
    """

    name: str
    ids: tuple[int, ...]
    positions: npt.NDArray[np.float64]
    radius: float
    half_side: float


def seven_dots(
    name: str,
    first_id: int,
    edge_fraction: float,
    inner: tuple[tuple[float, float], tuple[float, float]],
    *,
    side: float = 0.084,
    radius: float = 0.008,
    margin: float = 0.018,
) -> DotFace:
    """A face from fractions of its corner square: ``edge_fraction`` along edge 0-1, ``inner`` (x, y) from corner 0.

    ``side`` [m] between corner dots, ``margin`` [m] of black outside the dots: a detector estimates the noise and the
    black level there, so it should be ten pixels wide. Ids are ``first_id`` .. ``first_id + 6``.
    """
    fractions = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (edge_fraction, 0.0), *inner])
    return DotFace(
        name=name,
        ids=tuple(range(first_id, first_id + 7)),
        positions=(fractions - 0.5) * side,
        radius=radius,
        half_side=side / 2 + radius + margin,
    )


DEFAULT_BODY: tuple[DotFace, ...] = (
    seven_dots("a", 0, 0.66, ((0.25, 0.40), (0.66, 0.49))),
    seven_dots("b", 7, 0.34, ((0.76, 0.40), (0.32, 0.52))),
)
"""The faces of the default marker body, ids 0..6 and 7..13."""

WORKPIECE: tuple[DotFace, ...] = (
    seven_dots("c", 14, 0.44, ((0.46, 0.85), (0.83, 0.49)), side=0.048, radius=0.005, margin=0.012),
    seven_dots("d", 21, 0.56, ((0.49, 0.34), (0.85, 0.30)), side=0.048, radius=0.005, margin=0.012),
)
"""Two smaller faces for a workpiece beside the body, ids 14..20 and 21..27."""

MORE: tuple[DotFace, ...] = (
    seven_dots("e", 28, 0.35, ((0.61, 0.17), (0.34, 0.78))),
    seven_dots("f", 35, 0.65, ((0.74, 0.61), (0.16, 0.5))),
    seven_dots("g", 42, 0.69, ((0.15, 0.59), (0.81, 0.67))),
    seven_dots("h", 49, 0.58, ((0.24, 0.36), (0.32, 0.8))),
    seven_dots("i", 56, 0.57, ((0.17, 0.37), (0.58, 0.79))),
    seven_dots("j", 63, 0.35, ((0.67, 0.17), (0.64, 0.78))),
    seven_dots("k", 70, 0.53, ((0.85, 0.48), (0.19, 0.43))),
    seven_dots("l", 77, 0.62, ((0.73, 0.52), (0.15, 0.28))),
    seven_dots("m", 84, 0.4, ((0.27, 0.86), (0.45, 0.32))),
)
"""Further faces for the user's own bodies, ids from 28. If six dots of one face are mapped by any homography to dots of
another, of itself, or of the mirror image of any, the error is 0.07 of half the corner distance or more (found by
random search; verified by an exhaustive test).
"""

FACES: dict[str, DotFace] = {face.name: face for face in (*DEFAULT_BODY, *WORKPIECE, *MORE)}
"""All faces by name."""
