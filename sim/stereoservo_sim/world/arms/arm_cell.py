"""The simulated cell of an arbitrary arm: mounting, marker body and cameras from the options of a cell file.

What is not stated is found by search: the base configuration around which the cell is laid out, and the
demonstration's goals. The search is seeded and depends on the options alone, so every process finds the same cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.body import roof_body
from stereoservo_sim.world.camera_rig import inverse_pose, look_at, stereo_rig
from stereoservo_sim.world.robots import Robot, flange_pose, joint_frames, shape_segments
from stereoservo_sim.world.simulated_cell import SimulatedCell, simulated_cell
from stereoservo_sim.world.synthetic import rotation, translation
from stereoservo_sim.world.urdf_file import UrdfError, load_urdf
from stereoservo_sim.world.workpiece import Moved

Length = Annotated[float, Meta(gt=0, le=20)]

CANDIDATES, EXAMINED, MOST_EXAMINED = 600, 8, 200
"""Number of base configurations drawn, number of the best that are checked for visibility in the cameras, and largest
number if all of those fail.
"""
WIDEST = 2.4
"""A joint's base is drawn within this distance from the centre of its range [rad]: some joints turn several times."""
CLEAR = {"revolute": 0.5, "prismatic": 0.1}
"""Required distance of a joint's base from its limits [rad or m]."""
LEVER = 0.3
"""Length [m] that weighs rotations of the body against translations."""
HEIGHT = 0.25
"""Required height of body and cameras above the floor, on which the arm stands [m]."""
TRIALS = {"revolute": (0.1, 0.2, 0.3, 0.45), "prismatic": (0.04, 0.08, 0.12, 0.16)}
"""Tested displacements of each joint to either side of the base [rad or m]."""
BEHIND_BODY, FARTHER = 0.05, 0.15
"""Distance from the parts already on the flange to the ridge of the body [m], and what is added if these hide it."""


class ArmPlace(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of a cell file: which arm is simulated, and its layout. Without ``urdf``: the embedded arm.

    ``urdf``: a file, relative to the cell file, shipped here, or of pybullet_data.
    ``flange``: the link that carries the body (default: see `load_urdf`).
    ``mounted``: pose of the arm's root in the world.
    ``carried``: displacement of the marker body on the flange (of the rig, if the cameras are on the arm) from its
    default pose, which looks along the flange's z from in front of the parts there.
    ``base``: positions by joint [rad or m] around which the cell is laid out; those of omitted joints are searched for.
    ``distance_m``: from the rig to the body; default 1.4 m, or 0.85 m if the cameras are on the arm.
    ``baseline_m``: between the cameras; ``focal_px``: of both.
    """

    urdf: str = ""
    flange: str = ""
    mounted: Moved = Moved()
    carried: Moved = Moved()
    base: dict[str, float] = {}
    distance_m: Length | None = None
    baseline_m: Length = 0.20
    focal_px: Annotated[float, Meta(ge=100, le=5000)] | None = None


def urdf_path(named: str, folder: Path) -> Path:
    """Path of the URDF ``named`` in a cell file: relative to its ``folder``, else a file shipped here, else one of
    pybullet_data. Raises UrdfError.
    """
    places = [folder, Path(str(files("stereoservo_sim.world.arms")))]
    data = find_spec("pybullet_data")
    if data is not None and data.submodule_search_locations:
        places.append(Path(next(iter(data.submodule_search_locations))))
    for place in places:
        if (place / named).is_file():
            return (place / named).absolute()
    shipped = ", ".join(sorted(file.name for file in places[1].glob("*.urdf")))
    raise UrdfError(
        f"urdf = {named!r}: no such file in {', '.join(str(place) for place in places)}; shipped are {shipped}, and "
        "pybullet_data has franka_panda/panda.urdf, kuka_iiwa/model.urdf, xarm/xarm6_robot.urdf"
    )


def place_of(options: Mapping[str, Any]) -> ArmPlace:
    """The options on the arm among ``options`` of a joint driver or of emulated drives; others are ignored.

    Raises ValueError.
    """
    mine = {name: options[name] for name in ArmPlace.__struct_fields__ if name in options}
    try:
        return msgspec.convert(mine, ArmPlace)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from error


def cell_of(place: ArmPlace, mount: Mount, folder: Path) -> SimulatedCell:
    """The simulated cell at ``place`` with cameras on ``mount``; ``folder``: of the cell file. Raises ValueError."""
    if place.urdf:
        return _searched_cell(msgspec.json.encode(place), mount, urdf_path(place.urdf, folder))
    for name in ArmPlace.__struct_fields__:
        if getattr(place, name) != getattr(ArmPlace(), name):
            raise ValueError(f"{name} is of an arm of your own; give its urdf as well")
    return simulated_cell(mount)


@lru_cache(maxsize=16)
def _searched_cell(encoded: bytes, mount: Mount, path: Path) -> SimulatedCell:
    place = msgspec.json.decode(encoded, type=ArmPlace)
    robot = load_urdf(path, flange=place.flange, mounted=place.mounted.matrix)
    if place.carried == Moved():
        with suppress(ValueError):  # the arm's hand may hide the body: then it is farther out
            return laid_out(robot, place, mount, base_for(robot, place, mount))
        place = msgspec.structs.replace(place, carried=Moved((0.0, 0.0, FARTHER)))
    return laid_out(robot, place, mount, base_for(robot, place, mount))


# -- the layout -----------------------------------------------------------------------------------------------


def laid_out(robot: Robot, place: ArmPlace, mount: Mount, base: FloatArray) -> SimulatedCell:
    """The cell laid out around ``base`` (n,): eye-to-hand with the body on the flange and the rig before it, else
    reversed.
    """
    carried = translation(0.0, 0.0, _reach(robot) + BEHIND_BODY) @ place.carried.matrix
    flange = flange_pose(robot, base)
    if mount == "eye_in_hand":
        distance = place.distance_m or 0.85
        flange_to_rig = carried @ translation(0.03, -0.02, 0.0) @ rotation("z", 8.0) @ rotation("x", -2.0)
        body = roof_body()
        middle = body.marker_points.mean(axis=0)
        facing = rotation("y", 6.0) @ rotation("x", 180.0) @ rotation("z", -85.0)
        stand = flange @ flange_to_rig @ translation(0.0, 0.0, distance) @ facing @ translation(*-middle)
        rig = stereo_rig(
            inverse_pose(flange_to_rig),
            baseline=place.baseline_m,
            focal=place.focal_px or 500.0,
            vergence=2.0 * float(np.arctan(0.5 * place.baseline_m / distance)),
        )
        return SimulatedCell(robot, body, rig, base, stand)
    distance = place.distance_m or 1.4
    body = roof_body(roll=float(np.deg2rad(-95.0)), stand_off=0.0)
    body = replace(body, flange_to_face=carried @ body.flange_to_face)
    target = flange[:3, 3] + flange[:3, :3] @ body.marker_points.mean(axis=0)
    ahead = (flange @ carried)[:3, 2]
    up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    rig = stereo_rig(
        look_at(target + distance * ahead, target, up),
        baseline=place.baseline_m,
        focal=place.focal_px or 800.0,
        vergence=2.4 * float(np.arctan(0.5 * place.baseline_m / distance)),
    )
    return SimulatedCell(robot, body, rig, base)


def _reach(robot: Robot) -> float:
    """Extent [m] along the flange's z of the parts that move with the flange."""
    back = inverse_pose(robot.links[-1])
    last = [shape for shape in robot.shapes if shape.link == len(robot.joints)]
    tops = [
        float((back[:3, :3] @ np.array(end) + back[:3, 3])[2]) + shape.radius
        for shape in last
        for end in (shape.start, shape.end)
    ]
    return max([0.0, *tops])


# -- the base -------------------------------------------------------------------------------------------------


def base_for(robot: Robot, place: ArmPlace, mount: Mount) -> FloatArray:
    """Base configuration (n,): joints clear of their limits, the body's motion well-conditioned, and the body visible
    in all cameras there and while each joint moves alone. Raises ValueError if none is found.
    """
    stated = _stated(robot, place.base)
    if not np.isnan(stated).any():
        return stated
    low, high = (np.array([getattr(j, f"position_{side}") for j in robot.joints]) for side in ("min", "max"))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    drawn = np.random.default_rng(5).uniform(-0.9, 0.9, (CANDIDATES, len(middle)))
    drawn = middle + drawn * np.minimum(half, WIDEST)
    drawn = np.where(np.isnan(stated), drawn, stated)
    scores = np.array([_suitability(robot, q) for q in drawn])
    best, found = -np.inf, None
    for rank, index in enumerate(np.argsort(-scores, kind="stable")[:MOST_EXAMINED]):
        if rank >= EXAMINED and found is not None:
            break
        cell = laid_out(robot, place, mount, drawn[index])
        score = scores[index] + _room_before_cameras(cell)
        if score > best:
            best, found = score, drawn[index]
    if found is None:
        raise ValueError(
            f"{robot.name}: of {MOST_EXAMINED} configurations in none do both cameras see every marker while each "
            "joint moves alone; state base = { joint = position, … }, or carried, distance_m (the body may be hidden "
            "by the flange's own link)"
        )
    return np.asarray(found)


def _stated(robot: Robot, base: Mapping[str, float]) -> FloatArray:
    for name, value in base.items():
        joint = next((joint for joint in robot.joints if joint.name == name), None)
        if joint is None:
            raise ValueError(f"base: no joint {name!r}; joints: {', '.join(robot.joint_names)}")
        if not joint.position_min <= value <= joint.position_max:
            raise ValueError(
                f"base.{name} is {value:g}; the joint's range is {joint.position_min:g} to {joint.position_max:g}"
            )
    return np.array([base.get(name, np.nan) for name in robot.joint_names])


def body_jacobian(robot: Robot, q: FloatArray, point: FloatArray) -> FloatArray:
    """Jacobian (6, n) at ``q`` (n,): translation of ``point`` (3,) in the world, and rotation times ``LEVER``."""
    frames, _ = joint_frames(robot, q)
    axes = frames[:, :3, 2]
    swung = np.cross(axes, point - frames[:, :3, 3])
    straight = robot.prismatic[:, None]
    return np.concatenate([np.where(straight, axes, swung), np.where(straight, 0.0, LEVER * axes)], axis=1).T


def _suitability(robot: Robot, q: FloatArray) -> float:
    """Score of a base ``q`` (n,) before visibility is checked: higher is better."""
    pose = flange_pose(robot, q)
    body = pose[:3, 3] + 0.1 * pose[:3, 2]
    values = np.linalg.svd(body_jacobian(robot, q, body), compute_uv=False)
    room = min(
        min(value - joint.position_min, joint.position_max - value, CLEAR[joint.kind]) / CLEAR[joint.kind]
        for value, joint in zip(q.tolist(), robot.joints, strict=True)
    )
    floor = float(robot.mounted[2, 3])
    heights = np.array([body[2], body[2] + 0.7 * pose[2, 2]]) - floor
    above = float(np.clip(heights / HEIGHT, 0.02, 1.0).prod())
    away = float(np.clip(np.linalg.norm(body[:2] - robot.mounted[:2, 3]) / HEIGHT, 0.2, 1.0))
    return float(np.log(max(values[-1] / values[0], 1e-9)) + np.log(max(room, 1e-3)) + np.log(above) + np.log(away))


def _room_before_cameras(cell: SimulatedCell) -> float:
    """Score of how far each joint may move alone with all markers visible: higher is better; -inf: not at all."""
    if not seen_by_all(cell, cell.base) or _inside_arm(cell):
        return -np.inf
    score = 0.0
    for k, joint in enumerate(cell.robot.joints):
        shares = 0
        for step in TRIALS[joint.kind]:
            q = np.stack([cell.base, cell.base])
            q[:, k] += (-step, step)
            if not all(seen_by_all(cell, one) for one in q):
                break
            shares += 1
        if shares == 0:
            return -np.inf
        score += float(np.log(shares / len(TRIALS[joint.kind]))) / len(cell.base)
    return score


def _inside_arm(cell: SimulatedCell) -> bool:
    """Whether a camera (the body, if the cameras are on the arm) is within 0.1 m of the arm at its base."""
    ends, radii = shape_segments(cell.robot, cell.base)
    if cell.stand is not None:
        points = cell.marker_positions(cell.base)
    else:
        points = np.array([camera.centre for camera in cell.rig.cameras])
    for (start, end), radius in zip(ends, radii.tolist(), strict=True):
        along = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0.0, 1.0)
        gaps = np.linalg.norm(points - start - along[:, None] * (end - start), axis=1)
        if float(gaps.min()) < radius + 0.1:
            return True
    return False


def seen_by_all(cell: SimulatedCell, q: FloatArray) -> bool:
    """Whether every camera sees every marker at ``q`` (n,)."""
    return all(bool(cell.visible(q, camera).all()) for camera in cell.rig.cameras)
