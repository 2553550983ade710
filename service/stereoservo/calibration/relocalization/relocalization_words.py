"""Descriptions for people: how relocalized cameras have moved, and why cameras cannot be relocalized."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import rq

from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray

How = Literal["moved", "moved_and_refocused", "resected", "moved_with_rig"]
WORDS: dict[How, str] = {
    "moved": "moved",
    "moved_and_refocused": "moved, and its focal length or principal point changed (was the lens touched?)",
    "resected": "moved",
    "moved_with_rig": "moved together with the others",
}
REMEDY = "show more markers, move the arm to other poses, or set up static points off one plane"


@dataclass(frozen=True)
class MovedCamera:
    """Description of a camera's motion.

    ``how``: ``moved`` (a displacement), ``moved_and_refocused`` (its intrinsics have changed, too), ``resected`` (the
    stratum has no displacements), ``moved_with_rig``. ``turned_deg`` by its own axes; ``shifted_share``:
    displacement of its centre over its distance from the points; ``shifted_m`` where prismatic joints give the scale;
    None where the model is not metric. ``moved_px``: rms image motion of the points that it sees. ``text`` in words.
    """

    how: How
    turned_deg: float | None
    shifted_share: float | None
    shifted_m: float | None
    moved_px: float
    text: str


@dataclass(frozen=True)
class OutlierObservation:
    """Pixels left out: of which ``camera`` and ``id``, at how many of how many poses, and how far off [px rms]."""

    camera: str
    id: int
    poses: int
    of: int
    error_px: float


def describe_moved_camera(
    model: CellModel,
    name: str,
    how: How,
    old: FloatArray,
    new: FloatArray,
    points: FloatArray,
    moved_px: float,
) -> MovedCamera:
    """Describe the motion of a camera whose matrix (3, 4) is ``new`` instead of ``old``; it sees ``points`` (k, 4)."""
    turned = share = metres = None
    words = WORDS[how]
    if model.projective_to_euclidean is not None:
        turned, share, metres = _displacement(model, model.projective_to_euclidean, old, new, points)
        far = "" if metres is None else f" ({1000.0 * metres:.3g} mm)"
        shift = f"{100.0 * share:.2g} % of its distance from the points{far}"
        words += f": turned by {turned:.3g} degrees, shifted by {shift}"
    text = f"camera {name!r} {words}; its points moved by {moved_px:.3g} px rms"
    return MovedCamera(how, turned, share, metres, moved_px, text)


def _displacement(
    model: CellModel, H: FloatArray, old: FloatArray, new: FloatArray, points: FloatArray
) -> tuple[float, float, float | None]:
    """Angle [deg], displacement of the centre over the distance from the points, and in [m] where a scale is known."""
    back = np.linalg.inv(H)
    turns, centres = [], []
    for matrix in (old, new):
        P = matrix @ back
        P = P * np.sign(np.linalg.det(P[:, :3]))
        K, R = rq(P[:, :3])
        turns.append(np.diag(np.sign(np.diag(K))) @ R)
        centres.append(-np.linalg.solve(P[:, :3], P[:, 3]))
    turn = turns[1] @ turns[0].T
    sine = 0.5 * np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(turn) - 1.0))))
    euclidean = points @ H.T
    middle = (euclidean[:, :3] / euclidean[:, 3:]).mean(axis=0)
    distance_moved = float(np.linalg.norm(centres[1] - centres[0]))
    metre = [
        float(np.linalg.norm((H @ generator @ back)[:3, 3]))
        for generator, kind in zip(model.generators, model.joint_kinds, strict=True)
        if kind == "prismatic"
    ]
    distance = float(np.linalg.norm(middle - centres[0]))
    return angle, distance_moved / distance, distance_moved / float(np.median(metre)) if metre else None


def too_few(names: list[str], count: int, ids: int, needed: int, what: str) -> CalibrationError:
    """Error text: too few points to determine a camera."""
    return CalibrationError(
        "too_few_points",
        f"camera {_listed(names)} sees {count} pixels of {ids} known points since it moved; at least {needed} are "
        f"needed ({what}): {REMEDY}",
        cameras=names,
        points=count,
        ids=ids,
        minimum=needed,
    )


def points_coplanar(names: list[str], count: int, ids: int) -> CalibrationError:
    """Error text: coplanar points leave a direction open."""
    return CalibrationError(
        "points_coplanar",
        f"{count} pixels of {ids} points do not determine camera {_listed(names)}: the points lie in one plane, or on "
        f"a line; {REMEDY}",
        cameras=names,
        points=count,
        ids=ids,
    )


def not_explained(
    names: list[str],
    chi2: float,
    limit: float,
    freedom: int,
    outliers: tuple[int, ...],
    share: float,
    most: float,
) -> CalibrationError:
    """Error text: no motion of the cameras explains the pixels."""
    ids = f", of ids {', '.join(str(i) for i in outliers)}" if outliers else ""
    return CalibrationError(
        "not_explained",
        f"no motion of camera {_listed(names)} explains its pixels: chi-square {chi2:.4g} with {freedom} degrees of "
        f"freedom (limit {limit:.4g}), {share:.0%} of them left out as wrong (limit {most:.0%}){ids}. Did markers "
        "slip, did a joint's zero or another camera move, are ids mixed up? If so calibrate, or check, anew",
        cameras=names,
        chi2=chi2,
        limit=limit,
        degrees_of_freedom=freedom,
        outliers=list(outliers),
        share=share,
        maximum=most,
    )


def too_uncertain(names: list[str], predicted_px: float, limit_px: float, poses: int) -> CalibrationError:
    """Error text: the camera is determined, but not accurately enough."""
    return CalibrationError(
        "too_uncertain",
        f"camera {_listed(names)} would predict markers to {predicted_px:.3g} px (one standard deviation) somewhere in "
        f"the range of the joints; at most {limit_px:g} px are taken. Seen at {poses} pose{'s' if poses > 1 else ''} "
        f"so far: {REMEDY}",
        cameras=names,
        predicted_px=predicted_px,
        limit_px=limit_px,
        poses=poses,
    )


def _listed(names: list[str]) -> str:
    return ", ".join(repr(name) for name in names)
