"""Simulation of the pan-tilt head of thesis 4.5: two cameras on two joints before a mountain of interest points.

What `pan-tilt` and `homing` share: the cell, the trial motions, the tracker's noise, the calibration and what its
noise leaves open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.initial_reconstruction import initial_reconstruction
from stereoservo.calibration.rig_model import Measurements, RigModel, rig_at
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.single_joint_fit import common_points, linear_generator
from stereoservo.calibration.trial_data import TrialCamera, TrialData
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.rotation_fit import bundle_rotation
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.joint_reprojection import SeenChain, pinhole_lenses
from stereoservo.kinematics.model import CellModel, Stratum
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.synthetic import SyntheticCell, dh_link, placed, rotation, translation

Noise = Literal["independent", "drifting"]

SIGMA = 0.3
"""[px] an axis, between consecutive images (4.5.1)."""
PIXEL_MM = 0.011
FOCAL_PX = 12.5 / PIXEL_MM
WIDTH, HEIGHT = 768, 576
BASELINE, DISTANCE = 0.35, 2.0
"""[m] (4.5.1)."""
POINTS = 200
PAN_STEPS, TILT_STEPS, STEP = 20, 10, np.radians(1.0)
"""(4.5.2)"""
PAN_USED, TILT_USED = (0, 5, 10, 15, 20), (0, 3, 7, 10)
"""Steps that calibrate; the others evaluate."""
CALIBRATING_POINTS = 60
"""Interest points that calibrate; the others evaluate."""
ASSUMPTIONS = [
    f"pixels of {1000 * PIXEL_MM:.0f} um, so that 12.5 mm lenses have a focal length of {FOCAL_PX:.0f} px; images of "
    f"{WIDTH}x{HEIGHT} px",
    "vergence of 75 degrees: between the baseline and one optical axis where the other stands upright on it, that is "
    "15 degrees between the axes, taken in equal parts; with 75 degrees on both sides the scene at 2 m is out of view",
    "the mountain is a relief of 34 x 40 cm with five peaks up to 15 cm, seen at 20 degrees to the ground, new in "
    "every seed; points are not hidden by others",
    "the axes of the head pass 3 to 10 cm from the cameras; pan is upright, both trajectories start in one corner",
    "drifting: every image adds 0.3 px an axis to a track's error; independent: every image errs by 0.3 px by itself",
]


def mountain(rng: np.random.Generator, points: int = POINTS) -> FloatArray:
    """Interest points (points, 3) [m] on a relief, z up from the ground."""
    ground = rng.uniform([-0.17, -0.2], [0.17, 0.2], (points, 2))
    peaks = rng.uniform([-0.13, -0.15], [0.13, 0.15], (5, 2))
    heights, widths = rng.uniform(0.05, 0.15, 5), rng.uniform(0.04, 0.09, 5)
    squares = ((ground[:, None] - peaks) ** 2).sum(axis=2)
    relief = (heights * np.exp(-0.5 * squares / widths**2)).max(axis=1)
    return np.hstack([ground, relief[:, None]])


def head(rng: np.random.Generator) -> SyntheticCell:
    """Head before a random mountain, at home in the middle of its trajectories."""
    inward = 7.5
    K = np.array([[FOCAL_PX, 0, 0.5 * (WIDTH - 1)], [0, FOCAL_PX, 0.5 * (HEIGHT - 1)], [0, 0, 1]])
    poses = [rotation("y", side * inward) @ translation(-side * 0.5 * BASELINE, 0, 0) for side in (-1.0, 1.0)]
    links = (dh_link(0, 90, 0.1), rotation("y", 90) @ rotation("z", 180) @ translation(0.03, -0.08, 0.05))
    cell = placed(
        ("revolute", "revolute"),
        links,
        mountain(rng),
        (0.0, np.radians(-20.0)),
        (0.5 * PAN_STEPS * STEP, 0.5 * TILT_STEPS * STEP),
        rotation("x", 110),
        cameras=(np.array([K, K]), np.array(poses)),
        distance=DISTANCE,
        mount="eye_in_hand",
    )
    return replace(cell, width=WIDTH, height=HEIGHT)


def trajectories(cell: SyntheticCell) -> tuple[FloatArray, FloatArray]:
    """Pan (21, 2) and tilt (11, 2) trajectories [rad], both from one corner."""
    corner = cell.home - cell.ranges
    pan = corner + STEP * np.arange(PAN_STEPS + 1)[:, None] * [1.0, 0.0]
    tilt = corner + STEP * np.arange(TILT_STEPS + 1)[:, None] * [0.0, 1.0]
    return pan, tilt


def general_positions(cell: SyntheticCell, rng: np.random.Generator, count: int) -> FloatArray:
    """Configurations (count, 2) off both trajectories, by a degree or more."""
    return np.asarray(cell.home + rng.uniform(-1, 1, (count, 2)) * (cell.ranges - STEP))


def tracked(
    exact: FloatArray, noise: Noise, rng: np.random.Generator, first: FloatArray | None = None
) -> FloatArray:
    """Pixels (c, s, m, 2) of tracks through s images with the tracker's noise; ``first`` (c, m, 2): the error that the
    first image has already.
    """
    errors = rng.normal(0, SIGMA, exact.shape)
    if first is not None:
        errors[:, 0] = first
    if noise == "drifting":
        errors = np.cumsum(errors, axis=1)
    return np.asarray(exact + errors)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Noisy and exact pixels (c, s, m, 2) of both trajectories, and the configurations (s, 2)."""

    pan: FloatArray
    tilt: FloatArray
    pan_exact: FloatArray
    tilt_exact: FloatArray
    pan_positions: FloatArray
    tilt_positions: FloatArray
    noise: Noise


class SeenHead(NamedTuple):
    """A head and what it saw: ``tracks`` of both trajectories; tracked ``pixels`` (c, s, m, 2) at ``general`` positions
    (s, 2), and ``exact`` ones.
    """

    cell: SyntheticCell
    tracks: Tracks
    general: FloatArray
    pixels: FloatArray
    exact: FloatArray


def tracks_of(cell: SyntheticCell, noise: Noise, rng: np.random.Generator) -> Tracks:
    """Both trajectories, tracked from their common first image."""
    pan, tilt = trajectories(cell)
    pan_exact, tilt_exact = cell.pixels(pan), cell.pixels(tilt)
    first = rng.normal(0, SIGMA, pan_exact[:, 0].shape)
    return Tracks(
        tracked(pan_exact, noise, rng, first),
        tracked(tilt_exact, noise, rng, first),
        pan_exact,
        tilt_exact,
        pan,
        tilt,
        noise,
    )


def trial_data(cell: SyntheticCell, tracks: Tracks, points: int = CALIBRATING_POINTS) -> TrialData:
    """Trial data for calibration: a subset of steps and the first ``points``, with the tracker's expected noise."""
    own, steps, positions, pixels = [], [], [], []
    for joint, (used, where, images) in enumerate(
        (
            (PAN_USED, tracks.pan_positions, tracks.pan),
            (TILT_USED[1:], tracks.tilt_positions, tracks.tilt),  # the corner is one image, not two
        )
    ):
        for step in used:
            own.append(joint)
            steps.append(step)
            positions.append(where[step])
            pixels.append(images[:, step, :points])
    grown = np.sqrt(1.0 + np.array(steps)) if tracks.noise == "drifting" else np.ones(len(steps))
    shape = (2, len(steps), points)
    return TrialData(
        joint_names=("pan", "tilt"),
        joint_kinds=("revolute", "revolute"),
        cameras=tuple(TrialCamera(name, WIDTH, HEIGHT, "eye_in_hand") for name in ("left", "right")),
        marker_ids=cell.marker_ids[:points],
        positions=np.array(positions),
        trials=np.array(own, dtype=np.int64),
        pixels=np.stack(pixels, axis=1),
        sigmas=np.broadcast_to(SIGMA * grown[:, None], shape).copy(),
        images=2 * len(steps),
    )


@dataclass(frozen=True, eq=False)
class HeadCalibration:
    """A calibrated head: the bundle's ``solution``, joints in its order (tilt, pan), zero (2,) in ours."""

    solution: Solution
    zero: FloatArray

    @property
    def seen(self) -> SeenChain:
        """Calibrated head as a `SeenChain`."""
        return _seen(self.solution.rig, self.zero)

    def deviations(self) -> Iterator[tuple[SeenChain, SeenChain]]:
        """The head one standard deviation to either side along each column of a root of the covariance of joints and
        cameras: outer products of what they do add up to what the calibration's noise does.
        """
        charts = self.solution.charts
        size = charts.size - 3 * len(self.solution.rig.points)
        rows = self.solution.determined.root[:size]
        for column in np.linalg.cholesky(rows @ rows.T).T:
            x = np.concatenate([column, np.zeros(charts.size - size)])
            yield tuple(_seen(rig_at(self.solution.rig, charts, sign * x), self.zero) for sign in (1, -1))  # type: ignore[misc]


def _seen(rig: RigModel, zero: FloatArray) -> SeenChain:
    chain = ProjectiveChain(("revolute", "revolute"), rig.generators[::-1], zero, tip_first=True)
    return SeenChain(chain, rig.cameras, pinhole_lenses(len(rig.cameras)), ("pan", "tilt"))


def calibrated(trials: TrialData) -> HeadCalibration:
    """The ordinary fit, and the plain bundle of pinholes there, whose covariance is asked for.

    Raises CalibrationError as `fit_model` does.
    """
    model = fit_model(trials, epoch=1).model
    rig, stratum = _rig_of(model)
    camera, stop, marker = (index.ravel() for index in np.indices(trials.sigmas.shape))
    offsets = (trials.positions - model.zero)[:, ::-1]
    data = Measurements(offsets, camera, stop, marker, trials.pixels.reshape(-1, 2), trials.sigmas.ravel())
    return HeadCalibration(solve(rig, data, stratum), model.zero)


def _rig_of(model: CellModel) -> tuple[RigModel, Stratum]:
    """The model in the frame of its stratum, joints next to the cameras first."""
    stratum: Stratum = "metric" if model.projective_to_euclidean is not None else "projective"
    upgrade = np.eye(4) if model.projective_to_euclidean is None else model.projective_to_euclidean
    back = np.linalg.inv(upgrade)
    points = model.marker_points @ upgrade.T
    cameras = np.array([camera.matrix for camera in model.cameras]) @ back
    if stratum == "metric":
        points = points / points[:, 3:]
        cameras = cameras / cameras[0, 2, 2]
        cameras[0, :, 3] = 0.0
        cameras[0] = np.triu(cameras[0])
    generators = (upgrade @ model.generators @ back)[::-1]
    return RigModel(("revolute", "revolute"), generators, cameras, points), stratum


def separate_rotations(trials: TrialData) -> SeenChain:
    """Head from two rotations estimated separately (4.42), as in the thesis: cameras by their epipolar geometry,
    each generator linear, then of maximum likelihood with free points.

    Both trajectories start at the first stop, which is the chain's zero. Raises CalibrationError, GeometryError where
    nothing like a rotation is seen.
    """
    cameras, points, usable = initial_reconstruction(trials)
    zero = trials.positions[0]
    generators = []
    for joint in range(2):
        stops = np.flatnonzero((trials.trials == joint) | (np.arange(len(trials.trials)) == 0))
        angles = trials.positions[stops, joint] - zero[joint]
        pixels, sigmas = trials.pixels[:, stops], trials.sigmas[:, stops]
        start = linear_generator("revolute", cameras, points[stops], usable[:, stops], pixels, sigmas, angles)
        if start is None:
            raise GeometryError(
                "degenerate", f"the images of joint {trials.joint_names[joint]!r} show no rotation"
            )
        structure = common_points(start, "revolute", points[stops], angles)
        fit = bundle_rotation(cameras, pixels.swapaxes(0, 1), structure, start, angles, sigmas.swapaxes(0, 1))
        generators.append(fit.generator)
    chain = ProjectiveChain(("revolute", "revolute"), np.array(generators), zero, tip_first=True)
    return SeenChain(chain, cameras, pinhole_lenses(len(cameras)), ("pan", "tilt"))
