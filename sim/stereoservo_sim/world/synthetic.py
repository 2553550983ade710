"""Synthetic cells: an arm, cameras and markers, with pixels from exact projections and noise; no images.

Ground truth of experiments, benchmarks, campaigns and tests: Euclidean, exact, and used for evaluation only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from stereoservo.calibration.trial_data import TrialCamera, TrialData
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.model import pinhole
from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import FloatArray, IntArray

Kind = Literal["revolute", "prismatic"]

FIRST_MARKER = 10
"""Id of the first marker, so that ids differ from indices."""


def translation(x: float, y: float, z: float) -> FloatArray:
    """Translation (4, 4) [m]."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def rotation(axis: Literal["x", "y", "z"], degrees: float) -> FloatArray:
    """Rotation (4, 4) about an axis of the frame."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T = np.eye(4)
    T[i, i], T[i, j], T[j, i], T[j, j] = c, -s, s, c
    return T


def dh_link(a: float, alpha: float, d: float) -> FloatArray:
    """Transform after the joint of a Denavit-Hartenberg row (5.1): Tz(d) Tx(a) Rx(alpha); [m], [°]."""
    return translation(0, 0, d) @ translation(a, 0, 0) @ rotation("x", alpha)


@dataclass(frozen=True, eq=False)
class SyntheticCell:
    """A synthetic arm before cameras.

    ``base`` (4, 4): the arm's base in the rig's frame; if ``mount`` is eye-in-hand, in the frame of the markers.
    ``links`` (4, 4) each: fixed, after the joint about or along its z.
    ``body`` (m, 3): markers in the flange's frame, or in their own.
    ``intrinsics`` (c, 3, 3), ``lenses`` (c, 4 or 7), ``poses`` (c, 4, 4) from the rig (eye-in-hand: the flange) to each
    camera.
    ``home`` (n,), ``ranges`` (n,): trials go from -range to +range.
    """

    base: FloatArray
    kinds: tuple[Kind, ...]
    links: tuple[FloatArray, ...]
    body: FloatArray
    intrinsics: FloatArray
    poses: FloatArray
    home: FloatArray
    ranges: FloatArray
    lenses: FloatArray
    mount: Mount = "eye_to_hand"
    width: int = 640
    height: int = 480

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names j1 … jn, base first."""
        return tuple(f"j{j + 1}" for j in range(len(self.kinds)))

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """Marker ids from ``FIRST_MARKER`` on."""
        return tuple(range(FIRST_MARKER, FIRST_MARKER + len(self.body)))

    def frames(self, q: FloatArray) -> FloatArray:
        """Joint frames before their motion, z along the axis, and the flange: (n + 1, 4, 4) at ``q`` (n,)."""
        frames = [self.base]
        for kind, link, value in zip(self.kinds, self.links, q, strict=True):
            joint = rotation("z", np.degrees(value)) if kind == "revolute" else translation(0, 0, value)
            frames.append(frames[-1] @ joint @ link)
        return np.array(frames)

    def flange(self, q: FloatArray) -> FloatArray:
        """Pose of the flange (4, 4)."""
        return np.asarray(self.frames(q)[-1])

    def axes(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Joint axes at ``q``: points (n, 3) [m] and directions (n, 3)."""
        frames = self.frames(q)[:-1]
        return frames[:, :3, 3], frames[:, :3, 2]

    def markers(self, positions: FloatArray) -> FloatArray:
        """Markers (s, m, 4) in the rig's frame at ``positions`` (s, n)."""
        body = np.hstack([self.body, np.ones((len(self.body), 1))])
        to_rig = [self.flange(q) if self.mount == "eye_to_hand" else np.linalg.inv(self.flange(q)) for q in positions]
        return np.array([body @ pose.T for pose in to_rig])

    def depths(self, positions: FloatArray) -> FloatArray:
        """Depths (c, s, m) [m]."""
        return np.asarray(np.einsum("ck,smk->csm", self.poses[:, 2], self.markers(positions)))

    def pixels(self, positions: FloatArray) -> FloatArray:
        """Exact raw pixels (c, s, m, 2), inside the image or not. Raises ValueError for markers behind a camera."""
        seen = np.einsum("cij,cjk,smk->csmi", self.intrinsics, self.poses[:, :3], self.markers(positions))
        if not (seen[..., 2] > 0.0).all():
            raise ValueError(f"markers behind a camera: least depth {seen[..., 2].min():.3g} m")
        ideal = seen[..., :2] / seen[..., 2:]
        return np.array([distort(lens, pixels) for lens, pixels in zip(self.lenses, ideal, strict=True)])

    def in_view(self, positions: FloatArray, margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Mask (c, s, m): inside the image by ``margin`` [px] and in front of the camera."""
        with np.errstate(invalid="ignore", divide="ignore"):
            seen = np.einsum("cij,cjk,smk->csmi", self.intrinsics, self.poses[:, :3], self.markers(positions))
            ideal = seen[..., :2] / seen[..., 2:]
            raw = np.array([distort(lens, pixels) for lens, pixels in zip(self.lenses, ideal, strict=True)])
            limits = np.array([self.width, self.height]) - 0.5 - margin
            inside = ((raw > margin - 0.5) & (raw < limits)).all(axis=-1) & (seen[..., 2] > 0.0)
        return np.asarray(inside)

    def stops(self, count: int) -> tuple[FloatArray, IntArray]:
        """Joint-wise trial motions: positions (s, n) and the joint that moved (s,), ``count`` stops a joint."""
        positions, trials = [], []
        for j in range(len(self.kinds)):
            for value in np.linspace(-1, 1, count):
                q = self.home.copy()
                q[j] += value * self.ranges[j]
                positions.append(q)
                trials.append(j)
        return np.array(positions), np.array(trials, dtype=np.int64)

    def held_out(self, rng: np.random.Generator, count: int, share: float = 0.7) -> FloatArray:
        """Configurations (count, n) inside a share of the ranges, all joints moved."""
        return np.asarray(self.home + rng.uniform(-share, share, (count, len(self.home))) * self.ranges)

    def trials(
        self,
        sigma: float,
        rng: np.random.Generator,
        stops: int = 9,
        positions: tuple[FloatArray, IntArray] | None = None,
        stated: float | None = None,
    ) -> TrialData:
        """Trial data with Gaussian noise of ``sigma`` [px] an axis; ``stated``: the sigma reported by the detector.

        Every marker is reported at every stop, whether in the image or not: see ``in_view``.
        """
        configurations, moved = self.stops(stops) if positions is None else positions
        exact = self.pixels(configurations)
        return TrialData(
            joint_names=self.joint_names,
            joint_kinds=self.kinds,
            cameras=tuple(TrialCamera(f"cam{c}", self.width, self.height, self.mount) for c in range(len(self.poses))),
            marker_ids=self.marker_ids,
            positions=configurations,
            trials=moved,
            pixels=exact + rng.normal(0, sigma, exact.shape),
            sigmas=np.full(exact.shape[:3], stated or sigma),
            images=len(configurations) * len(self.poses),
        )

    def with_body(self, body: npt.ArrayLike) -> SyntheticCell:
        """The same cell with other markers (m, 3)."""
        return replace(self, body=np.asarray(body, dtype=np.float64))

    def lens_of(self, camera: int, k1: float, k2: float = 0.0, p1: float = 0.0, p2: float = 0.0) -> FloatArray:
        """Lens (7,) of OpenCV's first coefficients about a camera's principal point; square pixels are assumed."""
        K, r0 = self.intrinsics[camera], 0.5 * self.width
        share = r0 / float(np.sqrt(K[0, 0] * K[1, 1]))
        return np.array([k1 * share**2, K[0, 2], K[1, 2], r0, k2 * share**4, p1 * share, p2 * share])

    def with_k1(self, k1: float) -> SyntheticCell:
        """The same cell with lenses of Brown's ``k1`` about each principal point (OpenCV's first coefficient)."""
        r0 = 0.5 * self.width
        lenses = [(k1 * r0**2 / (K[0, 0] * K[1, 1]), K[0, 2], K[1, 2], r0) for K in self.intrinsics]
        return replace(self, lenses=np.array(lenses))


def two_faces() -> FloatArray:
    """14 dots (14, 3) on two faces of a body, 7 each, about 12 cm across."""
    face = np.array([(-45, -30), (0, -32), (45, -28), (-48, 5), (10, 0), (-40, 34), (42, 30)]) / 1000
    front = np.hstack([face, np.full((7, 1), 0.05)])
    side = front @ rotation("y", 50)[:3, :3].T + np.array([0.07, 0.0, -0.02])
    return np.vstack([front, side])


def flat_plate() -> FloatArray:
    """Four dots (4, 3) in one plane, as on the thesis's plate (fig. 5.15)."""
    return np.array([(-50, -50, 20), (50, -48, 20), (47, 50, 20), (-49, 45, 20)]) / 1000


def stereo_pair(count: int = 2) -> tuple[FloatArray, FloatArray]:
    """Intrinsics (c, 3, 3) and poses (c, 4, 4): f = 800 px, 640x480, baseline 20 cm, vergence 20°, looking along z.

    A third camera is above, a fourth below.
    """
    K = np.array([[800, 0, 322.0], [0, 795, 238.5], [0, 0, 1]])
    K2 = np.array([[812, 0, 315.0], [0, 806, 243.0], [0, 0, 1]])
    poses = [
        rotation("y", -10) @ translation(0.1, 0, 0),
        rotation("y", 10) @ translation(-0.1, 0, 0),
        rotation("x", -12) @ translation(0, -0.25, 0.05),
        rotation("x", 12) @ translation(0, 0.25, 0.05),
    ]
    return np.array([K, K2, K, K2][:count]), np.array(poses[:count])


def placed(
    kinds: tuple[Kind, ...],
    links: tuple[FloatArray, ...],
    body: FloatArray,
    home: npt.ArrayLike,
    ranges: npt.ArrayLike,
    facing: FloatArray,
    *,
    cameras: tuple[FloatArray, FloatArray] | None = None,
    distance: float = 1.3,
    mount: Mount = "eye_to_hand",
) -> SyntheticCell:
    """The cell with the body's centre ``distance`` [m] before the rig at home.

    ``facing`` (4, 4) rotates the flange in the rig's frame (eye-in-hand: the markers).
    """
    K, poses = stereo_pair() if cameras is None else cameras
    home, ranges = np.asarray(home, dtype=np.float64), np.asarray(ranges, dtype=np.float64)
    lenses = np.tile(pinhole(), (len(K), 1))
    cell = SyntheticCell(np.eye(4), kinds, links, body, K, poses, home, ranges, lenses, mount)
    middle = translation(*body.mean(axis=0))
    ahead = translation(0, 0, distance) @ facing
    if mount == "eye_to_hand":
        return replace(cell, base=ahead @ np.linalg.inv(cell.flange(home) @ middle))
    return replace(cell, base=middle @ np.linalg.inv(cell.flange(home) @ ahead))


def _facing(*turns: tuple[Literal["x", "y", "z"], float]) -> FloatArray:
    pose = np.eye(4)
    for axis, degrees in turns:
        pose = pose @ rotation(axis, degrees)
    return pose


RX90_ROWS = ((0, -90, 0.42), (0.40, 0, 0), (0, 90, 0), (0, -90, 0.80), (0, 90, 0), (0, 0, 0.085))
"""Six revolute joints with a spherical wrist, rows (a [m], alpha [°], d [m]) after the Stäubli RX 90 (5.5)."""
OFFSET_ROWS = ((0, -90, 0.36), (0.45, 0, 0.12), (0.4, 0, 0), (0, -90, 0.11), (0, 90, 0.095), (0, 0, 0.08))
"""Six revolute joints, the last three axes not intersecting."""
SEVEN_ROWS = ((0, -90, 0.36), (0, 90, 0), (0, 90, 0.42), (0, -90, 0), (0, -90, 0.40), (0, 90, 0), (0, 0, 0.126))
"""Seven revolute joints, shoulder, elbow and wrist."""


def _revolute_arm(
    rows: tuple[tuple[float, float, float], ...],
    home_deg: tuple[float, ...],
    ranges_deg: tuple[float, ...],
    body: FloatArray | None,
    cameras: int,
    distance: float,
) -> SyntheticCell:
    return placed(
        ("revolute",) * len(rows),
        tuple(dh_link(*row) for row in rows),
        two_faces() if body is None else body,
        np.radians(home_deg),
        np.radians(ranges_deg),
        _facing(("x", 180), ("y", 15), ("x", 10)),
        cameras=stereo_pair(cameras),
        distance=distance,
    )


def rx90(body: FloatArray | None = None, cameras: int = 2, distance: float = 1.3) -> SyntheticCell:
    """Cell of a 6R arm with a spherical wrist."""
    ranges = (15, 15, 15, 30, 30, 40)
    return _revolute_arm(RX90_ROWS, (10, -60, 120, 20, 40, 15), ranges, body, cameras, distance)


def offset_wrist(body: FloatArray | None = None) -> SyntheticCell:
    """Cell of a 6R arm with an offset wrist."""
    ranges = (12, 12, 15, 25, 30, 40)
    return _revolute_arm(OFFSET_ROWS, (10, -60, 100, -30, 50, 15), ranges, body, 2, 1.3)


def seven(body: FloatArray | None = None) -> SyntheticCell:
    """Cell of a 7R arm."""
    ranges = (10, 10, 15, 15, 25, 25, 40)
    return _revolute_arm(SEVEN_ROWS, (10, 30, 10, -70, 20, 50, 15), ranges, body, 2, 1.3)


def gantry() -> SyntheticCell:
    """Cell of a 3P arm: along x, y, z."""
    links = (rotation("x", -90), rotation("y", 90), np.eye(4))
    return placed(("prismatic",) * 3, links, two_faces(), np.zeros(3), (0.2, 0.15, 0.2), _facing(("x", 160), ("y", 20)))


def gantry_with_wrist() -> SyntheticCell:
    """Cell of a 3P3R arm."""
    links = (
        rotation("x", -90),
        rotation("y", 90),
        np.eye(4),
        dh_link(0, -90, 0.1),
        dh_link(0, 90, 0),
        dh_link(0, 0, 0.08),
    )
    kinds: tuple[Kind, ...] = ("prismatic",) * 3 + ("revolute",) * 3
    ranges = (0.12, 0.1, 0.15, *np.radians([25, 25, 40]))
    home = (0, 0, 0, *np.radians([20, 50, 10]))
    return placed(kinds, links, two_faces(), home, ranges, _facing(("x", 165), ("y", 20)))


def scara(body: FloatArray | None = None) -> SyntheticCell:
    """Cell of a SCARA: R, R, P, R with all axes parallel."""
    links = (translation(0.35, 0, 0.2), translation(0.3, 0, 0), np.eye(4), translation(0, 0, 0.03))
    return placed(
        ("revolute", "revolute", "prismatic", "revolute"),
        links,
        two_faces() if body is None else body,
        (0.3, 0.5, 0, 0.2),
        (*np.radians([15, 20]), 0.1, np.radians(40)),
        _facing(("x", 150), ("y", 25)),
    )


def mixed() -> SyntheticCell:
    """Cell of a linear axis under a wrist: P, R, R, R with different directions."""
    links = (
        rotation("x", 90),
        translation(0.2, 0, 0) @ rotation("x", 90),
        translation(0.1, 0, 0.1) @ rotation("x", -70),
        translation(0, 0, 0.1),
    )
    return placed(
        ("prismatic", "revolute", "revolute", "revolute"),
        links,
        two_faces(),
        (0, 0.3, 0.4, 0.2),
        (0.15, *np.radians([25, 30, 35])),
        _facing(("x", 170), ("y", 20)),
    )


def parallel(body: FloatArray | None = None) -> SyntheticCell:
    """Cell of three parallel revolute axes, which do not determine the plane at infinity."""
    links = (translation(0.3, 0, 0), translation(0.25, 0, 0), translation(0.05, 0, 0))
    return placed(
        ("revolute",) * 3,
        links,
        two_faces() if body is None else body,
        (0.3, 0.5, 0.2),
        np.radians([18, 22, 40]),
        _facing(("x", 150), ("y", 25)),
    )


def pan_tilt(body: FloatArray | None = None, distance: float = 2.0) -> SyntheticCell:
    """Cell of a pan-tilt head: 2R with the cameras on it (eye-in-hand), before static markers."""
    # Pan about the vertical, tilt about the horizontal; the flange is the rig: x right, y down, z ahead.
    links = (dh_link(0, 90, 0.1), rotation("y", 90) @ rotation("z", 180) @ translation(0.03, -0.08, 0.05))
    return placed(
        ("revolute", "revolute"),
        links,
        3.0 * two_faces() if body is None else body,
        np.zeros(2),
        np.radians([10, 7]),
        _facing(("x", 160), ("y", 20)),
        distance=distance,
        mount="eye_in_hand",
    )
