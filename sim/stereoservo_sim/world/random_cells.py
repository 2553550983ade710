"""Random cells, each from one seed: rigs, arms, marker bodies and noise; evaluation of a fit's stated accuracy.

What is drawn: baseline 0.08 to 0.5 m, vergence 0 to 60°, focal lengths 450 to 1600 px on 640x480 (the two cameras
within 10 % of each other), principal points off by up to 30 px, roll up to 10° between the cameras; four families
of arms in random configurations; four bodies, two of them flat, 0.6 to 2 m away, tilted by up to 40°; noise 0.01 to
1 px (log-uniform), 9 to 15 stops a joint.

What is redrawn: rigs that do not both see the whole body at home, and configurations in which some joint cannot
move by ``MIN_RANGE`` with ``MIN_SHOWN`` markers in both images; an operator would choose another home, too. No case is
redrawn because its fit is hard.

Cases with lens distortion use the same rigs, whose cameras have lenses of one type: radial terms of OpenCV's model up
to those of wide lenses, tangential ones, a centre at the principal point. Lenses that would fold the image are
redrawn, since they are not manufactured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from stereoservo.calibration.trial_data import TrialData
from stereoservo.geometry.distortion import fold_radius, undistort
from stereoservo.kinematics.model import pinhole
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.synthetic import (
    OFFSET_ROWS,
    RX90_ROWS,
    SyntheticCell,
    dh_link,
    flat_plate,
    rotation,
    translation,
    two_faces,
)

Row = tuple[float, float, float]

BASELINES = (0.08, 0.5)
"""Range of the baseline [m]."""
VERGENCES = (0.0, 60.0)
"""Range of the angle between the optical axes [°]."""
FOCALS = (450.0, 1600.0)
"""Range of focal lengths [px], 640 px wide images."""
FOCAL_RATIO = 0.1
"""Largest relative difference of the right camera's focal length from the left one's."""
PRINCIPAL_OFFSET = 30.0
"""Largest offset of the principal point [px]."""
ROLL = 10.0
"""Largest roll about the optical axes, between the cameras [°]."""
DISTANCES = (0.6, 2.0)
"""Range of the distance from the rig to the body [m]."""
TILT = 40.0
"""Largest angle of the body against the rig's axis [°]."""
NOISES = (0.01, 1.0)
"""Range of the noise [px], log-uniform."""
STOPS = (9, 15)
"""Range of the number of stops per joint."""
MAX_RANGE = 0.6
"""Largest motion of a joint to either side [rad]."""
MIN_RANGE = 0.05
"""A home at which some joint may move less than this to either side [rad] is redrawn."""
MIN_SHOWN = 4
"""Least number of markers that both images show at every stop."""
K1, K2 = (-0.4, 0.1), (-0.05, 0.2)
"""Ranges of the radial terms of the lenses, OpenCV's."""
TANGENTIAL = 1e-3
"""Largest tangential term of each lens, OpenCV's."""
LENS_RATIO = 0.1
"""Largest relative difference of the radial terms of the second camera's lens from the first one's."""
UNFOLDED = 1.1
"""Least ideal radius at which lenses fold, as a multiple of the radius of the image's corner."""
MARGIN = 4.0
"""Least distance of markers from the edge of the image [px]."""

UR_ROWS: tuple[Row, ...] = ((0, 90, 0.15), (-0.42, 0, 0), (-0.39, 0, 0), (0, 90, 0.13), (0, -90, 0.1), (0, 0, 0.08))
"""Three parallel axes and a wrist whose axes do not intersect, rows (a [m], alpha [°], d [m])."""


@dataclass(frozen=True, eq=False)
class RandomCase:
    """A random cell with its noise [px], number of stops a joint, and parameters; ``redraws``: rejected homes, rigs."""

    seed: int
    cell: SyntheticCell
    sigma: float
    stops: int
    arm: str
    body: str
    redraws: int

    def trials(self) -> TrialData:
        """Trial data, reproducible; markers outside an image are missing."""
        rng = np.random.default_rng([self.seed, 1])
        return hidden_out_of_view(self.cell, self.cell.trials(self.sigma, rng, self.stops))

    def held_out(self, count: int = 40) -> FloatArray:
        """Configurations (count, n) inside the ranges with a marker in both images."""
        rng = np.random.default_rng([self.seed, 2])
        drawn = self.cell.held_out(rng, 20 * count)
        # A pose counts if it has a marker in both images; home always does.
        seen = self.cell.in_view(drawn).all(axis=0).any(axis=1)
        kept = drawn[seen][:count]
        return kept if len(kept) else self.cell.home[None]


def hidden_out_of_view(cell: SyntheticCell, trials: TrialData) -> TrialData:
    """The trials with NaN for exact pixels outside an image."""
    seen = cell.in_view(trials.positions)
    return msgspec.structs.replace(trials, pixels=np.where(seen[..., None], trials.pixels, np.nan))


def random_case(seed: int) -> RandomCase:
    """Random cell of ``seed``, reproducible bit for bit."""
    rng = np.random.default_rng([seed, 0])
    body_name = str(rng.choice(list(BODIES), p=SHARES))
    arm = str(rng.choice(list(ARMS)))
    sigma = float(np.exp(rng.uniform(*np.log(NOISES))))
    stops = int(rng.integers(STOPS[0], STOPS[1] + 1))
    redraws = 0
    while True:
        cell = _drawn(rng, arm, BODIES[body_name]())
        if cell is not None:
            return RandomCase(seed, cell, sigma, stops, arm, body_name, redraws)
        redraws += 1


def random_lens_case(seed: int) -> RandomCase:
    """Random cell of ``seed`` with lens distortion, reproducible bit for bit."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 3])
    return replace(case, cell=replace(case.cell, lenses=random_lenses(rng, case.cell)))


def random_lenses(rng: np.random.Generator, cell: SyntheticCell) -> FloatArray:
    """Lenses (c, 7) of the cell's cameras, about their principal points."""
    while True:
        radial = np.array([rng.uniform(*K1), rng.uniform(*K2)])
        lenses = np.array(
            [
                cell.lens_of(c, *(radial * (1.0 + c * rng.uniform(-1.0, 1.0) * LENS_RATIO)), *tangential)
                for c, tangential in enumerate(rng.uniform(-TANGENTIAL, TANGENTIAL, (2, 2)))
            ]
        )
        if all(unfolded(lens, cell.width, cell.height) for lens in lenses):
            return lenses


def unfolded(lens: FloatArray, width: int, height: int) -> bool:
    """Whether a lens folds only well outside its image."""
    corners = np.array([[u, v] for u in (0.0, width - 1.0) for v in (0.0, height - 1.0)])
    reach = np.linalg.norm(undistort(lens, corners) - lens[1:3], axis=1).max()
    return bool(UNFOLDED * reach < fold_radius(lens))


def random_pair(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Intrinsics (2, 3, 3) and poses (2, 4, 4) of two cameras aimed along the rig's z."""
    baseline, vergence = rng.uniform(*BASELINES), rng.uniform(*VERGENCES)
    focal = rng.uniform(*FOCALS)
    intrinsics, poses = [], []
    for side in (-1.0, 1.0):
        own = focal if side < 0 else focal * (1.0 + rng.uniform(-1.0, 1.0) * FOCAL_RATIO)
        centre = rng.uniform(-PRINCIPAL_OFFSET, PRINCIPAL_OFFSET, 2)
        aspect = rng.uniform(0.98, 1.02)
        intrinsics.append([[own, 0, 319.5 + centre[0]], [0, own * aspect, 239.5 + centre[1]], [0, 0, 1]])
        roll = rng.uniform(-0.5, 0.5) * ROLL
        poses.append(
            rotation("z", roll) @ rotation("y", side * 0.5 * vergence) @ translation(-side * 0.5 * baseline, 0, 0)
        )
    return np.array(intrinsics), np.array(poses)


def visible_ranges(cell: SyntheticCell) -> FloatArray:
    """Largest motion (n,) [rad or m] to either side of home, up to ``MAX_RANGE``, with ``MIN_SHOWN`` markers in both
    images, as the calibration motion would find it.
    """
    steps = np.linspace(0.0, MAX_RANGE, 61)
    n = len(cell.home)
    ranges = np.empty(n)
    for j in range(n):
        good = np.ones(len(steps), dtype=bool)
        for sign in (-1.0, 1.0):
            positions = np.repeat(cell.home[None], len(steps), axis=0)
            positions[:, j] += sign * steps
            good &= cell.in_view(positions, MARGIN).all(axis=0).sum(axis=1) >= MIN_SHOWN
        reached = int(np.argmin(good)) if not good.all() else len(steps)
        ranges[j] = steps[max(0, reached - 1)]
    return ranges


def _drawn(rng: np.random.Generator, arm: str, body: FloatArray) -> SyntheticCell | None:
    """A random cell, or None if the body is not visible or some joint can move too little."""
    rows, home = ARMS[arm](rng)
    intrinsics, poses = random_pair(rng)
    tilt_axis = rng.uniform(0.0, 360.0)
    facing = (
        translation(0, 0, rng.uniform(*DISTANCES))
        @ rotation("z", tilt_axis)
        @ rotation("y", rng.uniform(0.0, TILT))
        @ rotation("z", rng.uniform(0.0, 360.0))
        @ rotation("x", 180)
    )
    links = tuple(dh_link(*row) for row in rows)
    lenses = np.tile(pinhole(), (2, 1))
    none = np.zeros(len(rows))
    cell = SyntheticCell(np.eye(4), ("revolute",) * len(rows), links, body, intrinsics, poses, home, none, lenses)
    middle = translation(*body.mean(axis=0))
    cell = replace(cell, base=facing @ np.linalg.inv(cell.flange(home) @ middle))
    if not cell.in_view(home[None], MARGIN).all():
        return None
    ranges = visible_ranges(cell)
    return replace(cell, ranges=ranges) if float(ranges.min()) >= MIN_RANGE else None


def _posed(
    rows: tuple[Row, ...], home_deg: tuple[float, ...]
) -> Callable[[np.random.Generator], tuple[tuple[Row, ...], FloatArray]]:
    """A known arm at a random configuration within 30° of a home."""

    def draw(rng: np.random.Generator) -> tuple[tuple[Row, ...], FloatArray]:
        return rows, np.radians(np.array(home_deg) + rng.uniform(-30, 30, len(rows)))

    return draw


def _random_arm(rng: np.random.Generator) -> tuple[tuple[Row, ...], FloatArray]:
    """Random arm of six rows: twists of 0, ±90° or arbitrary, lengths up to 0.4 m, in a random configuration."""
    rows = []
    for _ in range(6):
        twist = float(rng.choice([0.0, 90.0, -90.0, rng.uniform(-180, 180)]))
        length = float(rng.choice([0.0, rng.uniform(-0.4, 0.4)]))
        rows.append((length, twist, float(rng.choice([0.0, rng.uniform(-0.4, 0.4)]))))
    # The tool is offset from the last axis's origin; the body's own offset does that for the others.
    return tuple(rows), rng.uniform(-np.pi, np.pi, 6)


def cube_corner() -> FloatArray:
    """12 dots (12, 3), four on each of three faces that meet at the tip of a corner, edges of 9 cm [m]."""
    square = np.array([(25, 25), (75, 30), (70, 80), (28, 70)]) / 1000
    corner = np.vstack([np.insert(square, axis, 0.0, axis=1) for axis in range(3)])
    # The edges fall away from the tip, which points along the flange's z.
    z = -np.ones(3) / np.sqrt(3.0)
    x = np.cross([1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.asarray(corner @ np.array([x, np.cross(z, x), z]).T + np.array([0.0, 0.0, 0.12]))


def seven_dots() -> FloatArray:
    """Seven dots (7, 3) in one plane: the front face of :func:`two_faces`."""
    return two_faces()[:7]


ARMS: dict[str, Callable[[np.random.Generator], tuple[tuple[Row, ...], FloatArray]]] = {
    "rx90": _posed(RX90_ROWS, (10, -60, 120, 20, 40, 15)),
    "offset": _posed(OFFSET_ROWS, (10, -60, 100, -30, 50, 15)),
    "ur": _posed(UR_ROWS, (10, -70, 90, -80, -70, 15)),
    "random": _random_arm,
}
"""Rows and home of each family, drawn with equal probability."""
BODIES: dict[str, Callable[[], FloatArray]] = {
    "two_faces": two_faces,
    "corner": cube_corner,
    "plate4": flat_plate,
    "plate7": seven_dots,
}
"""Markers of each body: 14, 12, 4 and 7."""
SHARES = (0.35, 0.35, 0.15, 0.15)
"""Probability of each body."""
