"""Reads an arm from a URDF file: the chain from its root to the flange, with joints' limits, masses and shapes.

Joints beside the chain, such as a gripper's, stay at zero, or at the nearest position that they can take; what they
carry belongs to the link that carries them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointKindName, JointSpec
from stereoservo_sim.world.robots import Capsule, Robot

MOVING: dict[str, JointKindName] = {
    "revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic",
}  # fmt: skip
FASTEST: dict[JointKindName, float] = {"revolute": 1.0, "prismatic": 0.4}
"""At most so fast a simulated joint is [rad/s or m/s]: a file states what the motor can, or nothing."""
ACCELERATION: dict[JointKindName, float] = {"revolute": 4.0, "prismatic": 2.0}
"""Which no URDF states [rad/s² or m/s²]."""
ENDLESS = float(2.0 * np.pi)
"""Range to either side of a joint that turns without end [rad]."""
SHORTEST = 1e-3
"""Between the ends of a capsule [m]: of a ball it is a short one."""


class UrdfError(ValueError):
    """A URDF file cannot be used; the text names the file, the cause and what would be valid."""


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    origin: FloatArray
    axis: FloatArray
    element: Element


@dataclass(frozen=True)
class _Tree:
    path: Path
    name: str
    links: dict[str, Element]
    joints: tuple[_Joint, ...]

    def below(self, link: str) -> list[_Joint]:
        return [joint for joint in self.joints if joint.parent == link]

    def moves(self, joint: _Joint) -> bool:
        """Whether the joint, or one beyond it, moves."""
        return joint.kind in MOVING or any(self.moves(one) for one in self.below(joint.child))


def urdf_path(named: str, folder: Path) -> Path:
    """File of the URDF ``named`` in a cell file: relative to its ``folder``, else one that is shipped here, else one of
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


def load_urdf(path: Path, *, flange: str = "", mounted: FloatArray | None = None) -> Robot:
    """The arm of a URDF file, its root link at ``mounted`` (4, 4) in the world.

    ``flange``: the link that carries the body; default: the last before nothing moves any more, or before the tree
    branches into several moving joints (a gripper's fingers). Raises UrdfError.
    """
    tree = _read(path)
    chain = _chain(tree, flange)
    pose = np.eye(4) if mounted is None else mounted
    fixed, links, specs = pose, [], []
    for joint in chain:
        fixed = fixed @ joint.origin
        if joint.kind not in MOVING:
            continue
        turn = _to_axis(joint.axis)
        links.append(fixed @ turn)
        specs.append(_spec(joint, path))
        fixed = turn.T
    if not specs:
        raise UrdfError(
            f"{path}: no joint moves between {chain[0].parent if chain else 'the root'!r} and the flange"
        )
    parts = _rigid_parts(tree, chain, pose)
    masses, centres = zip(*(_weight(part) for part in parts[1:]), strict=True)
    return Robot(
        name=tree.name, base=links[0], links=np.stack([*links[1:], fixed]), joints=tuple(specs),
        masses=np.array(masses), centres=np.array(centres), shapes=tuple(_shapes(parts, path)), file=path,
        mounted=pose, flange=chain[-1].child,
    )  # fmt: skip


# -- the tree -------------------------------------------------------------------------------------------------


def _read(path: Path) -> _Tree:
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise UrdfError(f"{path}: cannot be read: {error.strerror}") from error
    except ElementTree.ParseError as error:
        raise UrdfError(f"{path}: is not XML: {error} (a .xacro is first to be expanded)") from error
    if root.tag != "robot":
        raise UrdfError(f"{path}: its outermost element is <{root.tag}>; a URDF's is <robot>")
    links = {_name(link, path): link for link in root.findall("link")}
    joints = tuple(_joint(element, links, path) for element in root.findall("joint"))
    return _Tree(path, root.get("name", path.stem), links, joints)


def _name(element: Element, path: Path) -> str:
    name = element.get("name")
    if not name:
        raise UrdfError(f"{path}: a <{element.tag}> has no name")
    return name


def _joint(element: Element, links: dict[str, Element], path: Path) -> _Joint:
    name, kind = _name(element, path), element.get("type", "")
    if kind not in (*MOVING, "fixed"):
        raise UrdfError(
            f"{path}: joint {name!r} is of type {kind!r}; {', '.join((*MOVING, 'fixed'))} can be simulated"
        )
    ends = []
    for tag in ("parent", "child"):
        found = element.find(tag)
        end = "" if found is None else found.get("link", "")
        if end not in links:
            raise UrdfError(
                f"{path}: joint {name!r}: its {tag} {end!r} is no link; links: {', '.join(links)}"
            )
        ends.append(end)
    axis = element.find("axis")
    direction = np.array([1.0, 0.0, 0.0]) if axis is None else _vector(axis, "xyz", path)
    if kind in MOVING and not np.linalg.norm(direction) > 0.0:
        raise UrdfError(f"{path}: joint {name!r}: its axis is {direction.tolist()}; a direction is needed")
    return _Joint(name, kind, ends[0], ends[1], _origin(element, path), direction, element)


def _vector(element: Element, key: str, path: Path, default: str = "0 0 0") -> FloatArray:
    text = element.get(key, default)
    try:
        found = np.array([float(word) for word in text.split()])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise UrdfError(f"{path}: <{element.tag} {key}={text!r}>; three numbers are needed")
    return found


def _origin(element: Element, path: Path) -> FloatArray:
    """Pose (4, 4) of an element in its parent: translation, then roll, pitch and yaw about fixed axes."""
    pose, origin = np.eye(4), element.find("origin")
    if origin is None:
        return pose
    (cr, cp, cy), (sr, sp, sy) = (f(_vector(origin, "rpy", path)) for f in (np.cos, np.sin))
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = _vector(origin, "xyz", path)
    return pose


def _chain(tree: _Tree, flange: str) -> list[_Joint]:
    """Joints from the root to the flange, fixed ones included."""
    children = {joint.child: joint for joint in tree.joints}
    if flange:
        if flange not in tree.links:
            raise UrdfError(f"{tree.path}: flange {flange!r} is no link; links: {', '.join(tree.links)}")
        chain, link = [], flange
        while link in children and len(chain) <= len(tree.joints):
            chain.insert(0, children[link])
            link = children[link].parent
        return chain
    roots = [link for link in tree.links if link not in children]
    if len(roots) != 1:
        raise UrdfError(f"{tree.path}: {len(roots)} links without a parent; a tree has one root")
    chain, link = [], roots[0]
    while len(moving := [joint for joint in tree.below(link) if tree.moves(joint)]) == 1:
        chain.append(moving[0])
        link = moving[0].child
    ahead = tree.below(link)  # a tool's frame behind the last joint, where it is the only one
    while len(ahead) == 1 and ahead[0].kind == "fixed":
        chain.append(ahead[0])
        link = ahead[0].child
        ahead = tree.below(link)
    return chain


def _to_axis(axis: FloatArray) -> FloatArray:
    """Rotation (4, 4) whose z is along ``axis``."""
    z = axis / np.linalg.norm(axis)
    turn = np.eye(4)
    if z[2] > 1.0 - 1e-12:
        return turn
    x = np.cross(np.eye(3)[int(np.abs(z).argmin())], z)
    x /= np.linalg.norm(x)
    turn[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return turn


def _spec(joint: _Joint, path: Path) -> JointSpec:
    kind = MOVING[joint.kind]
    limit = joint.element.find("limit")
    low, high, speed = -ENDLESS, ENDLESS, FASTEST[kind]
    if limit is not None:
        try:
            stated = float(limit.get("velocity", "0"))
            if joint.kind != "continuous":
                low, high = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        except ValueError as error:
            raise UrdfError(f"{path}: joint {joint.name!r}: its <limit> has no number: {error}") from error
        speed = min(speed, stated) if stated > 0.0 else speed
    elif joint.kind != "continuous":
        raise UrdfError(f"{path}: joint {joint.name!r} is {joint.kind} and has no <limit lower=… upper=…>")
    if not -np.inf < low < high < np.inf:
        raise UrdfError(
            f"{path}: joint {joint.name!r}: limits {low:g} to {high:g}; the lower must be below the upper"
        )
    return JointSpec(joint.name, kind, low, high, speed, ACCELERATION[kind])


# -- what hangs on each joint ---------------------------------------------------------------------------------

Part = list[tuple[FloatArray, Element]]
"""Links that move as one, each with its pose (4, 4) in their joint's frame."""


def _rigid_parts(tree: _Tree, chain: list[_Joint], mounted: FloatArray) -> list[Part]:
    """Of the base, in the world, and of every moving joint of the chain, in its frame."""
    along = {joint.name for joint in chain if joint.kind in MOVING}
    root = chain[0].parent
    parts: list[Part] = [[]]

    def collect(link: str, pose: FloatArray, part: Part) -> None:
        part.append((pose, tree.links[link]))
        for joint in tree.below(link):
            if joint.name in along:
                parts.append([])
                collect(joint.child, _to_axis(joint.axis).T, parts[-1])
            else:
                collect(joint.child, pose @ joint.origin @ _resting(joint), part)

    collect(root, mounted, parts[0])
    return parts


def _resting(joint: _Joint) -> FloatArray:
    """Motion (4, 4) of a joint beside the chain to where it rests."""
    return (
        motion(joint.kind, joint.axis, resting_position(joint.element)) if joint.kind in MOVING else np.eye(4)
    )


def resting_position(element: Element) -> float:
    """Zero, or what of a joint's range is nearest to it [rad or m]."""
    limit = element.find("limit")
    if limit is None or element.get("type") == "continuous":
        return 0.0
    return float(np.clip(0.0, float(limit.get("lower", "0")), float(limit.get("upper", "0"))))


def motion(kind: str, axis: FloatArray, value: float) -> FloatArray:
    """Motion (4, 4) by ``value`` about, or with ``prismatic`` along, ``axis`` (3,)."""
    moved = np.eye(4)
    if kind == "prismatic":
        moved[:3, 3] = value * axis / np.linalg.norm(axis)
        return moved
    turn = _to_axis(axis)
    c, s = np.cos(value), np.sin(value)
    return turn @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]) @ turn.T


def _weight(part: Part) -> tuple[float, FloatArray]:
    """Mass [kg] and its centre (3,) [m] of a part."""
    mass, moment = 0.0, np.zeros(3)
    for pose, link in part:
        inertial = link.find("inertial")
        stated = None if inertial is None else inertial.find("mass")
        if inertial is None or stated is None:
            continue
        own = float(stated.get("value", "0"))
        mass += own
        moment += own * (pose @ _origin(inertial, Path()))[:3, 3]
    return mass, moment / mass if mass > 0.0 else moment


def _shapes(parts: list[Part], path: Path) -> Iterator[Capsule]:
    for number, part in enumerate(parts):
        for pose, link in part:
            for element in link.findall("collision") or link.findall("visual"):
                corners = _corners(element.find("geometry"), path)
                if len(corners):
                    placed = pose @ _origin(element, path)
                    yield _capsule(number, corners @ placed[:3, :3].T + placed[:3, 3])


def _corners(geometry: Element | None, path: Path) -> FloatArray:
    """Points (k, 3) [m] of a geometry's surface: the corners of a box or mesh, rings of what is round."""
    if geometry is None or len(geometry) == 0:
        return np.zeros((0, 3))
    shape = geometry[0]
    if shape.tag == "mesh":
        scale = _vector(shape, "scale", path, "1 1 1")
        return _mesh_points(shape.get("filename", ""), path) * scale
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1.0)])
    if shape.tag == "box":
        return 0.5 * cube * _vector(shape, "size", path)
    radius, length = float(shape.get("radius", "0")), float(shape.get("length", "0"))
    if shape.tag == "sphere":
        return radius * cube / np.sqrt(3.0)
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(16)], axis=1)
    half = np.array([0.0, 0.0, 0.5 * length])
    return np.concatenate([ring + half, ring - half])


def _mesh_points(named: str, path: Path) -> FloatArray:
    """Vertices (k, 3) of an .obj or .stl file; none of another, or where it is not found."""
    bare = named.split("://", 1)[-1]
    places = [parent / bare for parent in path.parents]
    file = next((place for place in places if place.is_file()), None)
    if file is None or file.suffix.lower() not in (".obj", ".stl"):
        return np.zeros((0, 3))
    data = file.read_bytes()
    if file.suffix.lower() == ".obj":
        rows = [line.split()[1:4] for line in data.splitlines() if line.startswith(b"v ")]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    count = int.from_bytes(data[80:84], "little")
    if len(data) != 84 + 50 * count:  # text
        rows = [line.split()[1:4] for line in data.splitlines() if line.strip().startswith(b"vertex")]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    facets = np.frombuffer(
        data, dtype=np.dtype([("numbers", "<f4", 12), ("end", "<u2")]), offset=84, count=count
    )
    return facets["numbers"][:, 3:].reshape(-1, 3).astype(np.float64)


def _capsule(link: int, points: FloatArray) -> Capsule:
    """The slimmest capsule around points (k, 3) of those along the coordinate axes and the longest extent."""
    middle = 0.5 * (points.max(axis=0) + points.min(axis=0))
    spread = points - middle
    longest = np.linalg.eigh(spread.T @ spread)[1][:, -1]
    best: tuple[float, Capsule] | None = None
    for axis in (*np.eye(3), longest):
        along = spread @ axis
        across = spread - along[:, None] * axis
        centre = 0.5 * (across.max(axis=0) + across.min(axis=0))
        radius = float(np.linalg.norm(across - centre, axis=1).max())
        low, high = float(along.min()) + radius, float(along.max()) - radius
        if high - low < SHORTEST:
            low, high = 0.5 * (low + high - SHORTEST), 0.5 * (low + high + SHORTEST)
        start, end = (middle + centre + at * axis for at in (low, high))
        volume = radius**2 * (high - low + 4.0 / 3.0 * radius)
        if best is None or volume < best[0]:
            best = volume, Capsule(link, tuple(start.tolist()), tuple(end.tolist()), max(radius, SHORTEST))
    assert best is not None
    return best[1]
