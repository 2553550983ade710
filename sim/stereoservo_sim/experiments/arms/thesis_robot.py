"""The robot of tables 5.1 to 5.4: arm, plate, cameras, trial motions, and the thesis's values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.world.synthetic import SyntheticCell, dh_link, flat_plate, placed, rotation, translation

SIGMA = 0.05
"""Noise of a dot's centre [px] an axis."""
IMPLIED_SIGMA, IMPLIED_BASELINE = 0.094, 0.20
"""Noise [px] an axis that the mean image error of table 5.1 with free points implies (0.117 px is the mean length of
what is left of it after the fit), and the baseline [m] that 8.6 states for the same robot."""
STOPS = 20
"""Of each joint's stroke, for each position of the plate."""
PLATE_TURNS_DEG = (-135.0, -67.5, 0.0, 67.5)
"""Of the last joint from home, while the others move: 4 dots become 16 rigid points, every 22.5° of a circle (fig.
5.16). Quarter turns would bring the square onto itself."""
ROWS = (
    (0.0, -90.0, 0.42),
    (0.400, 0.0, 0.0),
    (0.0, 90.0, 0.0),
    (0.0, -90.0, 0.800),
    (0.0, 90.0, 0.0003),
    (0.0, 0.0, 0.085),
)
"""a [m], alpha [°], d [m] of table 5.4: link 2 is a of joint 2, link 3 the offset from axis 3 to the wrist along axis
4; axes 4 and 6 miss each other by 0.3 mm along axis 5. Base height and flange are neither stated nor identifiable."""
HOME_DEG = (10.0, -60.0, 120.0, 20.0, 40.0, 15.0)
STROKES_DEG = (8.0, 8.0, 8.0, 30.0, 25.0, 170.0)
"""Each joint goes from minus to plus this about home."""
DISTANCE, BASELINE = 1.3, 0.46
"""[m] of the plate from the rig, and between the cameras, which look at it."""
SIZE = 512
"""Width and height of the images [px]."""

THESIS: dict[str, Any] = {
    "5.1": {
        "what": "mean image error [px] over the trial motion of each axis, (5.53) and (5.55)",
        "fixed": [0.55, 0.14, 0.15, 0.16, 0.16, 0.24],
        "free": [0.13, 0.10, 0.09, 0.12, 0.10, 0.16],
    },
    "5.2": {
        "what": "intrinsics [px], off-line calibration and experiment; the horizontal one is counted backwards",
        "right": {"fx": [1516.1, 1505.9], "fy": [1521.5, 1501.9], "u0": [260.5, 260.6], "v0": [252.6, 245.8]},
        "left": {"fx": [1534.3, 1512.7], "fy": [1539.6, 1507.5], "u0": [255.5, 250.4], "v0": [266.8, 254.6]},
    },
    "5.3": {
        "what": "angles between successive axes [°], factory and experiment",
        "axes 1, 2": [90.0, 89.72],
        "axes 2, 3": [0.0, 0.28],
        "axes 3, 4": [90.0, 89.71],
        "axes 4, 5": [90.0, 90.002],
        "axes 5, 6": [90.0, 90.10],
    },
    "5.4": {
        "what": "link lengths [mm], factory and experiment; link 2 gives the scale",
        "link 1": [0.0, 0.5522],
        "link 2": [400.0, 400.0],
        "link 3": [800.0, 800.5457],
        "link 4": [0.0, 0.0633],
        "link 5": [0.0, 0.0347],
        "axes 4, 6": [0.3, 0.1895],
    },
}
ASSUMPTIONS = [
    f"images of {SIZE}x{SIZE} px, off-line intrinsics of table 5.2 without the mirrored axis, left camera first",
    f"cameras {BASELINE} m apart, both looking at the plate {DISTANCE} m away; 4 dots at the corners of 10 cm",
    f"noise of {SIGMA} px an axis in every dot's centre; joint angles exact",
    f"implied: the same with {IMPLIED_SIGMA} px, from the mean of table 5.1 with free points, and the baseline of 8.6, "
    f"{IMPLIED_BASELINE} m",
    f"home {list(HOME_DEG)} deg, strokes of plus and minus {list(STROKES_DEG)} deg, {STOPS} stops each",
    f"joints 1 to 5 are driven {len(PLATE_TURNS_DEG)} times, the last joint at {list(PLATE_TURNS_DEG)} deg from home",
    "link 3 is read as the offset from axis 3 to the wrist along axis 4, axes 4, 6 as their distance along axis 5",
]


def thesis_cell(baseline: float = BASELINE) -> SyntheticCell:
    """The arm with its plate before the two cameras, ``baseline`` [m] apart."""
    left = [[1534.3, 0.0, 255.5], [0.0, 1539.6, 266.8], [0.0, 0.0, 1.0]]
    right = [[1516.1, 0.0, 260.5], [0.0, 1521.5, 252.6], [0.0, 0.0, 1.0]]
    aside = float(np.degrees(np.arctan2(0.5 * baseline, DISTANCE)))
    poses = np.array(
        [
            rotation("y", -aside) @ translation(0.5 * baseline, 0.0, 0.0),
            rotation("y", aside) @ translation(-0.5 * baseline, 0.0, 0.0),
        ]
    )
    cell = placed(
        ("revolute",) * 6,
        tuple(dh_link(*row) for row in ROWS),
        flat_plate(),
        np.radians(HOME_DEG),
        np.radians(STROKES_DEG),
        rotation("x", 180) @ rotation("y", 15) @ rotation("x", 10),
        cameras=(np.array([left, right]), poses),
        distance=DISTANCE,
    )
    return replace(cell, width=SIZE, height=SIZE)


def trial_motions(
    cell: SyntheticCell, stops: int = STOPS, turns_deg: tuple[float, ...] = PLATE_TURNS_DEG
) -> tuple[FloatArray, IntArray]:
    """Positions (s, n) and the joint that moves (s,): strokes, but for the last joint's at each turn of the plate."""
    positions, trials = [], []
    last = len(cell.kinds) - 1
    for j in range(last + 1):
        for turn in turns_deg if j < last else (0.0,):
            for share in np.linspace(-1.0, 1.0, stops):
                q = cell.home.copy()
                q[last] += np.radians(turn)
                q[j] += share * cell.ranges[j]
                positions.append(q)
                trials.append(j)
    return np.array(positions), np.array(trials, dtype=np.int64)
