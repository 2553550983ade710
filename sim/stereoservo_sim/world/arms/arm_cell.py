"""The simulated cell of an arbitrary arm: mounting, marker body and cameras from the options of a cell file.

What is not stated is found by search: the base configuration around which the cell is laid out, and the
demonstration's goals. The search is seeded and depends on the options alone, so every process finds the same cell.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.messages.cell_file import Mount
from stereoservo.messages.decoding import decoding
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointKindName, JointSpec
from stereoservo_sim.world.body import roof_body
from stereoservo_sim.world.camera_rig import inverse_pose, look_at, stereo_rig
from stereoservo_sim.world.robots import Capsule, Robot, flange_pose, joint_frames, shape_segments
from stereoservo_sim.world.simulated_cell import SimulatedCell, simulated_cell
from stereoservo_sim.world.synthetic import rotation, translation
from stereoservo_sim.world.workpiece import Moved

MOVING: dict[str, JointKindName] = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
LARGEST = 1e6
"""Larger numbers are taken for damaged data [m, kg, rad]; except limits, where large numbers mean none."""
NO_LIMIT = 1e39
FASTEST: dict[JointKindName, float] = {"revolute": 1.0, "prismatic": 0.4}
"""Largest speed of a simulated joint [rad/s or m/s]: files state the motor's limit or none."""
ACCELERATION: dict[JointKindName, float] = {"revolute": 4.0, "prismatic": 2.0}
"""Acceleration of simulated joints [rad/s² or m/s²]; a URDF states none."""
ENDLESS = float(2.0 * np.pi)
"""Range to either side of a continuous joint [rad]."""
SHORTEST = 1e-3
"""Least length between the end points of a capsule [m]; a sphere is a capsule of this length."""


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


def load_urdf(path: Path, *, flange: str = "", mounted: FloatArray | None = None) -> Robot:
    """The arm of a URDF file, its root link at ``mounted`` (4, 4) in the world.

    ``flange``: the link that carries the body; default: the last moving link, or the last before the tree branches into
    several moving joints (a gripper's fingers) or before a gripper's single jaw. The robot's ``notes`` list what is
    omitted, and how it is included. Raises UrdfError.
    """
    with decoding(lambda cause: UrdfError(f"{path}: {cause}"), passed=(UrdfError,)):
        return _robot(_read(path), flange, np.eye(4) if mounted is None else mounted)


def _robot(tree: UrdfTree, flange: str, pose: FloatArray) -> Robot:
    chain, notes = chain_to_flange(tree, flange)
    fixed, links, specs = pose, [], []
    for joint in chain:
        fixed = fixed @ joint.origin
        if not joint.moves:
            continue
        turn = _to_axis(joint.axis)
        links.append(fixed @ turn)
        specs.append(_spec(joint, tree.path))
        fixed = turn.T
    parts = _rigid_parts(tree, chain, pose)
    masses, centres = zip(*(_weight(part, tree.path) for part in parts[1:]), strict=True)
    return Robot(
        name=tree.name, base=links[0], links=np.stack([*links[1:], fixed]), joints=tuple(specs),
        masses=np.array(masses), centres=np.array(centres), shapes=tuple(_shapes(parts, tree.path)), file=tree.path,
        mounted=pose, flange=chain[-1].child, notes=notes,
    )  # fmt: skip


# -- the tree -------------------------------------------------------------------------------------------------


def _read(path: Path) -> UrdfTree:
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise UrdfError(f"{path}: cannot be read: {error.strerror}") from error
    except ElementTree.ParseError as error:
        raise UrdfError(f"{path}: is not XML: {error} (a .xacro is first to be expanded)") from error
    if root.tag != "robot":
        raise UrdfError(f"{path}: its outermost element is <{root.tag}>; a URDF's is <robot>")
    links: dict[str, Element] = {}
    for link in root.findall("link"):
        if links.setdefault(_name(link, path), link) is not link:
            raise UrdfError(f"{path}: two links are named {link.get('name')!r}; each needs a name of its own")
    joints = tuple(_joint(element, links, path) for element in root.findall("joint"))
    return UrdfTree(path, root.get("name") or path.stem, links, joints)


def _name(element: Element, path: Path) -> str:
    name = element.get("name")
    if not name:
        raise UrdfError(f"{path}: a <{element.tag}> has no name")
    return name


def _joint(element: Element, links: dict[str, Element], path: Path) -> UrdfJoint:
    name, kind = _name(element, path), element.get("type", "")
    if kind not in (*MOVING, "fixed"):
        raise UrdfError(
            f"{path}: joint {name!r} is of type {kind!r}; {', '.join((*MOVING, 'fixed'))} can be simulated: make it "
            'type="fixed" where it stands still'
        )
    ends = []
    for tag in ("parent", "child"):
        found = element.find(tag)
        end = "" if found is None else found.get("link", "")
        if end not in links:
            raise UrdfError(f"{path}: joint {name!r}: its {tag} {end!r} is no link; links: {', '.join(links)}")
        ends.append(end)
    axis = element.find("axis")
    direction = np.array([1.0, 0.0, 0.0]) if axis is None else _vector(axis, "xyz", path)
    if kind in MOVING and not np.linalg.norm(direction) > 1e-6:
        raise UrdfError(f"{path}: joint {name!r}: its axis is {direction.tolist()}; a direction is needed")
    mimic, mimics = element.find("mimic"), ""
    if mimic is not None and kind in MOVING:
        mimics = mimic.get("joint", "")
        if not mimics:
            raise UrdfError(f'{path}: joint {name!r}: its <mimic> names no joint; joint="NAME" is needed')
        for key, default in (("multiplier", "1"), ("offset", "0")):
            _number(mimic, key, path, default)
    return UrdfJoint(name, kind, ends[0], ends[1], _origin(element, path), direction, element, mimics)


def _number(
    element: Element, key: str, path: Path, default: str = "0", least: float = -LARGEST, most: float = LARGEST
) -> float:
    text = element.get(key, default)
    try:
        found = float(text)
    except ValueError:
        found = float("nan")
    if not least <= found <= most:
        raise UrdfError(f"{path}: <{element.tag} {key}={text!r}>; a number from {least:g} to {most:g} is needed")
    return found


def _range(limit: Element, path: Path) -> tuple[float, float]:
    """Lowest and highest position of a joint [rad or m]."""
    low, high = (_number(limit, key, path, least=-NO_LIMIT, most=NO_LIMIT) for key in ("lower", "upper"))
    return low, high


def _vector(element: Element, key: str, path: Path, default: str = "0 0 0") -> FloatArray:
    text = element.get(key, default)
    try:
        found = np.array([float(word) for word in text.split()])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (3,) or not np.abs(found).max() <= LARGEST:
        raise UrdfError(f"{path}: <{element.tag} {key}={text!r}>; three numbers are needed, up to {LARGEST:g}")
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


def _spec(joint: UrdfJoint, path: Path) -> JointSpec:
    kind = MOVING[joint.kind]
    limit = joint.element.find("limit")
    low, high, speed = -ENDLESS, ENDLESS, FASTEST[kind]
    if limit is not None:
        stated = _number(limit, "velocity", path, least=-NO_LIMIT, most=NO_LIMIT)
        if joint.kind != "continuous":
            low, high = _range(limit, path)
        speed = min(speed, stated) if stated > 0.0 else speed
    elif joint.kind != "continuous":
        raise UrdfError(f"{path}: joint {joint.name!r} is {joint.kind} and has no <limit lower=… upper=…>")
    if not low < high:
        raise UrdfError(f"{path}: joint {joint.name!r}: limits {low:g} to {high:g}; the lower must be below the upper")
    return JointSpec(joint.name, kind, low, high, speed, ACCELERATION[kind])


# -- rigid parts of each joint ---------------------------------------------------------------------------------

Part = list[tuple[FloatArray, Element]]
"""Rigidly connected links, each with its pose (4, 4) in their joint's frame."""


def _rigid_parts(tree: UrdfTree, chain: list[UrdfJoint], mounted: FloatArray) -> list[Part]:
    """Rigid parts: of the base in the world, and of every moving joint of the chain in its frame."""
    along = {joint.name for joint in chain if joint.moves}
    parts: list[Part] = [[]]
    waiting = [(chain[0].parent, mounted, 0)]  # depth first, in the file's order
    while waiting:
        link, pose, part = waiting.pop()
        if part == len(parts):
            parts.append([])
        parts[part].append((pose, tree.links[link]))
        for joint in reversed(tree.below(link)):
            if joint.name in along:
                waiting.append((joint.child, _to_axis(joint.axis).T, part + 1))
            else:
                waiting.append((joint.child, pose @ joint.origin @ _resting(joint, tree.path), part))
    return parts


def _resting(joint: UrdfJoint, path: Path) -> FloatArray:
    """Motion (4, 4) of a joint beside the chain to its rest position."""
    if not joint.moves:
        return np.eye(4)
    return motion(joint.kind, joint.axis, resting_position(joint.element, path))


def resting_position(element: Element, path: Path) -> float:
    """Rest position of a joint [rad or m]: zero, or the nearest position in its range."""
    limit = element.find("limit")
    if limit is None or element.get("type") == "continuous":
        return 0.0
    return float(np.clip(0.0, *_range(limit, path)))


def motion(kind: str, axis: FloatArray, value: float) -> FloatArray:
    """Rotation (4, 4) by ``value`` about ``axis`` (3,), or translation along it if ``prismatic``."""
    moved = np.eye(4)
    if kind == "prismatic":
        moved[:3, 3] = value * axis / np.linalg.norm(axis)
        return moved
    turn = _to_axis(axis)
    c, s = np.cos(value), np.sin(value)
    return turn @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]) @ turn.T


def _weight(part: Part, path: Path) -> tuple[float, FloatArray]:
    """Mass [kg] of a part and its centre (3,) [m]."""
    mass, moment = 0.0, np.zeros(3)
    for pose, link in part:
        inertial = link.find("inertial")
        stated = None if inertial is None else inertial.find("mass")
        if inertial is None or stated is None:
            continue
        own = _number(stated, "value", path, least=0.0)
        mass += own
        moment += own * (pose @ _origin(inertial, path))[:3, 3]
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
    """Points (k, 3) [m] on a geometry's surface: corners of a box or mesh, rings of cylinders and spheres."""
    if geometry is None or len(geometry) == 0:
        return np.zeros((0, 3))
    shape = geometry[0]
    if shape.tag == "mesh":
        scale = _vector(shape, "scale", path, "1 1 1")
        return _mesh_points(shape.get("filename", ""), path) * scale
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1.0)])
    if shape.tag == "box":
        return 0.5 * cube * _vector(shape, "size", path)
    radius, length = (_number(shape, key, path, least=0.0) for key in ("radius", "length"))
    if shape.tag == "sphere":
        return radius * cube / np.sqrt(3.0)
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(16)], axis=1)
    half = np.array([0.0, 0.0, 0.5 * length])
    return np.concatenate([ring + half, ring - half])


def _mesh_points(named: str, path: Path) -> FloatArray:
    """Vertices (k, 3) of an .obj or .stl file; none for other formats or if the file is not found."""
    bare = named.split("://", 1)[-1]
    try:
        file = next((place for parent in path.parents if (place := parent / bare).is_file()), None)
    except OSError:  # an invalid file name
        return np.zeros((0, 3))
    if file is None or file.suffix.lower() not in (".obj", ".stl"):
        return np.zeros((0, 3))
    with decoding(lambda cause: UrdfError(f"{path}: its mesh {file}: {cause}")):
        points = _vertices(file.read_bytes(), file.suffix.lower() == ".obj")
    if not np.abs(points).max(initial=0.0) <= LARGEST:
        raise UrdfError(f"{path}: its mesh {file} has vertices that are no number, or beyond {LARGEST:g}")
    return points


def _vertices(data: bytes, obj: bool) -> FloatArray:
    if obj:
        rows = [line.split()[1:4] for line in data.splitlines() if line.startswith(b"v ")]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    count = int.from_bytes(data[80:84], "little")
    if len(data) != 84 + 50 * count:  # text
        rows = [line.split()[1:4] for line in data.splitlines() if line.strip().startswith(b"vertex")]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    facets = np.frombuffer(data, dtype=np.dtype([("numbers", "<f4", 12), ("end", "<u2")]), offset=84, count=count)
    with np.errstate(invalid="ignore"):  # NaN is rejected with its name
        return facets["numbers"][:, 3:].reshape(-1, 3).astype(np.float64)


def _capsule(link: int, points: FloatArray) -> Capsule:
    """The slimmest capsule around points (k, 3), among those along the coordinate axes and the longest extent."""
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


# -- the chain -----------------------------------------------------------------------------------------------
# The joints of a URDF's tree that form the arm: the chain from root to flange, and the omitted joints.


JAW = re.compile(r"gripper|jaw|finger|claw|pinch|grasp|thumb|knuckle", re.IGNORECASE)
"""Pattern of names of a gripper's joint at the end of a chain, unless the name matches `TURNS`."""
TURNS = re.compile(r"roll|pitch|yaw|rot|wrist|turn|swivel|spin", re.IGNORECASE)
JAW_LINK = re.compile(r"jaw|finger|claw|thumb|moving", re.IGNORECASE)
TOOL_FRAME = re.compile(r"tool0|tcp|gripper_frame|grasp|end_?effector|(?:^|_)eef?(?:_|$)", re.IGNORECASE)
"""Pattern of names of links fixed before the last joint at which the arm ends."""
MOST_NAMES = 8


class UrdfError(ValueError):
    """A URDF file cannot be used; the text names the file, the cause and what would be valid."""


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint of a URDF: ``origin`` (4, 4) in its parent, ``axis`` (3,), ``mimics``: the joint it is coupled to."""

    name: str
    kind: str
    parent: str
    child: str
    origin: FloatArray
    axis: FloatArray
    element: Element
    mimics: str = ""

    @property
    def moves(self) -> bool:
        """Whether it moves, independently or coupled to another."""
        return self.kind != "fixed"

    @property
    def driven(self) -> bool:
        """Whether it moves independently."""
        return self.moves and not self.mimics


class UrdfTree:
    """Links and joints of a URDF file, checked to form one tree or several. Raises UrdfError."""

    def __init__(self, path: Path, name: str, links: dict[str, Element], joints: tuple[UrdfJoint, ...]) -> None:
        self.path, self.name, self.links, self.joints = path, name, links, joints
        self.above: dict[str, UrdfJoint] = {}
        self._below: dict[str, list[UrdfJoint]] = {}
        named: dict[str, UrdfJoint] = {}
        for joint in joints:
            if named.setdefault(joint.name, joint) is not joint:
                raise UrdfError(f"{path}: two joints are named {joint.name!r}; each needs a name of its own")
            if (other := self.above.setdefault(joint.child, joint)) is not joint:
                raise UrdfError(
                    f"{path}: link {joint.child!r} is the child of joints {other.name!r} and {joint.name!r}; closed "
                    "chains cannot be simulated: leave one of them out"
                )
            self._below.setdefault(joint.parent, []).append(joint)
        self.roots = [link for link in links if link not in self.above]
        order = list(self.roots)
        for link in order:
            order.extend(joint.child for joint in self.below(link))
        if len(order) < len(links):
            circle = next(link for link in links if link not in set(order))
            raise UrdfError(f"{path}: link {circle!r} is below itself; a tree has no circle")
        self._depth = dict.fromkeys(links, 0)
        self._moving = dict.fromkeys(links, False)
        for link in reversed(order):
            for joint in self.below(link):
                self._depth[link] = max(self._depth[link], self.depth(joint))
                self._moving[link] |= self.moves(joint)
        for joint in joints:
            if joint.mimics and (joint.mimics == joint.name or joint.mimics not in named):
                raise UrdfError(
                    f"{path}: joint {joint.name!r} mimics {joint.mimics!r}; joints beside it: "
                    f"{', '.join(name for name in named if name != joint.name)}"
                )

    def below(self, link: str) -> list[UrdfJoint]:
        """Joints whose parent is ``link``, in the file's order."""
        return self._below.get(link, [])

    def moves(self, joint: UrdfJoint) -> bool:
        """Whether the joint, or one beyond it, moves."""
        return joint.moves or self._moving[joint.child]

    def depth(self, joint: UrdfJoint) -> int:
        """Largest number of driven joints in series from this joint on."""
        return joint.driven + self._depth[joint.child]

    def beyond(self, joint: UrdfJoint) -> list[UrdfJoint]:
        """All joints from this one on."""
        found = [joint]
        for one in found:
            found.extend(self.below(one.child))
        return found


def chain_to_flange(tree: UrdfTree, flange: str) -> tuple[list[UrdfJoint], tuple[str, ...]]:
    """Joints from the root to the link ``flange``, fixed ones included, and notes on what is omitted and how it is
    included. ``flange`` empty: the last moving link, or the last before a gripper or a branch of the tree. Raises
    UrdfError if no joint moves, one is coupled to another, or several arms are possible.
    """
    left = _LeftOut()
    if flange:
        if flange not in tree.links:
            raise UrdfError(f"{tree.path}: flange {flange!r} is no link; links: {', '.join(tree.links)}")
        chain, link = [], flange
        while link in tree.above:
            chain.insert(0, tree.above[link])
            link = chain[0].parent
    else:
        if len(tree.roots) != 1:
            raise UrdfError(
                f"{tree.path}: {len(tree.roots)} links without a parent{_listed(tree.roots)}; a tree has one root"
            )
        chain = _found(tree, tree.roots[0], left)
    end = chain[-1].child if chain else flange or tree.roots[0]
    coupled = next((joint for joint in chain if joint.mimics), None)
    if coupled is not None:
        raise UrdfError(
            f"{tree.path}: joint {coupled.name!r} mimics {coupled.mimics!r} and is on the way to the flange {end!r}; "
            f"mimic joints there cannot be driven. Valid: flange = {coupled.parent!r} or another link before it; or "
            'type="fixed" in the file, where it stands still'
        )
    if not any(joint.moves for joint in chain):
        root = chain[0].parent if chain else end
        raise UrdfError(f"{tree.path}: no joint moves between {root!r} and the flange {end!r}")
    _tell_beside(tree, chain, left)
    return chain, tuple(left.notes)


@dataclass
class _LeftOut:
    """The omitted joints, with notes on them."""

    notes: list[str] = field(default_factory=list)
    joints: set[str] = field(default_factory=set)

    def tell(self, note: str, joints: list[UrdfJoint]) -> None:
        self.notes.append(note)
        self.joints.update(joint.name for joint in joints)


def _found(tree: UrdfTree, link: str, left: _LeftOut) -> list[UrdfJoint]:
    chain: list[UrdfJoint] = []
    while moving := [joint for joint in tree.below(link) if tree.moves(joint)]:
        if len(moving) > 1:
            moving = _onward(tree, link, moving, chain, left)
            if not moving:
                break
        chain.append(moving[0])
        link = moving[0].child
    else:
        chain = _without_jaw(tree, chain, left)
        link = chain[-1].child if chain else link
    ahead = tree.below(link)  # a tool's frame behind the last joint, if it is the only one
    while len(ahead) == 1 and not ahead[0].moves:
        chain.append(ahead[0])
        ahead = tree.below(ahead[0].child)
    return chain


def _onward(
    tree: UrdfTree, link: str, moving: list[UrdfJoint], chain: list[UrdfJoint], left: _LeftOut
) -> list[UrdfJoint]:
    """The one joint with which the arm continues from ``link``, where the tree branches; None if the arm ends there.

    The arm ends at a gripper. Linkages coupled to the arm's own joints are no branch. Raises UrdfError if several arms
    begin there.
    """
    own = {joint.name for joint in chain}
    branches = [joint for joint in moving if not all(one.mimics in own for one in tree.beyond(joint) if one.moves)]
    if len(branches) == 1:
        return branches
    before, deepest = sum(joint.driven for joint in chain), max(map(tree.depth, branches), default=0)
    if before >= deepest:
        gripper = [one for joint in branches for one in tree.beyond(joint) if one.moves]
        first = next((one for one in gripper if one.driven), None)
        how = "" if first is None else f"; flange = {first.child!r} makes {first.name!r} a joint of the arm"
        left.tell(
            f"joints {_names(gripper)} are left out of the arm, which ends at {link!r}, where the file branches: they "
            f"stay at rest{how}",
            gripper,
        )
        return []
    driven = [joint for joint in branches if tree.depth(joint)]
    if len(driven) == 1:  # others are linkages coupled to joints further on
        return driven
    ends = []
    for joint in sorted(driven, key=tree.depth, reverse=True)[:MOST_NAMES]:
        try:
            onward = _found(tree, joint.child, _LeftOut())
        except UrdfError:  # it branches again
            onward = []
        ends.append(f"flange = {(onward[-1] if onward else joint).child!r}")
    raise UrdfError(
        f"{tree.path}: it branches into several arms at {link!r} (joints {_names(driven)}); say which is meant: "
        f"{' or '.join(ends)}"
    )


def _without_jaw(tree: UrdfTree, chain: list[UrdfJoint], left: _LeftOut) -> list[UrdfJoint]:
    """A chain without a gripper's single jaw at its end."""
    last = next((k for k in reversed(range(len(chain))) if chain[k].driven), 0)
    jaw = chain[last] if chain else None
    coupled = [joint for joint in chain[last + 1 :] if joint.mimics]
    if jaw is None or sum(joint.driven for joint in chain) < 2 or any(one.mimics != jaw.name for one in coupled):
        return chain
    frame = next((one.child for one in tree.below(jaw.parent) if not one.moves and TOOL_FRAME.search(one.child)), None)
    if JAW.search(jaw.name) and not TURNS.search(jaw.name):
        why = "by its name"
    elif JAW_LINK.search(jaw.child):
        why = f"by the name of its link {jaw.child!r}"
    elif frame is not None:
        why = f"since the tool's frame {frame!r} is fixed before it"
    else:
        return chain
    left.tell(
        f"joint {jaw.name!r} is taken for a gripper's jaw, {why}, and left out of the arm, which ends at "
        f"{jaw.parent!r}: it stays at rest; flange = {jaw.child!r} makes it a joint of the arm",
        [jaw],
    )
    return chain[:last]


def _tell_beside(tree: UrdfTree, chain: list[UrdfJoint], left: _LeftOut) -> None:
    """Add notes on joints beside the chain that no other note covers."""
    told = left.joints | {joint.name for joint in chain}
    own = {joint.name for joint in chain}
    others = [one for one in tree.joints if one.moves and one.name not in told]
    for one in others:
        if one.mimics in own:
            left.tell(
                f"joint {one.name!r} mimics the arm's {one.mimics!r} beside its chain: it stays at rest, with what it "
                "carries",
                [one],
            )
    free = [one for one in others if one.mimics not in own]
    if free:
        end = chain[-1].child
        left.tell(f"joints {_names(free)} are not on the way to the flange {end!r}: they stay at rest", free)


def _names(joints: list[UrdfJoint]) -> str:
    names = [repr(joint.name) for joint in joints[:MOST_NAMES]]
    return ", ".join(names) + (f" and {len(joints) - MOST_NAMES} more" if len(joints) > MOST_NAMES else "")


def _listed(names: list[str]) -> str:
    return f" ({', '.join(map(repr, names[:MOST_NAMES]))})" if names else ""


# -- arm cell ------------------------------------------------------------------------------------------


Length = Annotated[float, Meta(gt=0, le=20)]

CANDIDATES, EXAMINED = 600, 8
"""Number of base configurations drawn, and number of the best that are checked for visibility in the cameras."""
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
BEHIND_BODY = 0.05
"""Distance from the parts already on the flange to the ridge of the body [m]."""


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
    for index in np.argsort(-scores, kind="stable")[:EXAMINED]:
        cell = laid_out(robot, place, mount, drawn[index])
        score = scores[index] + _room_before_cameras(cell)
        if score > best:
            best, found = score, drawn[index]
    if found is None:
        raise ValueError(
            f"{robot.name}: of {EXAMINED} configurations in none do both cameras see every marker while each joint "
            "moves alone; state base = { joint = position, … }, or carried, distance_m (the body may be hidden by the "
            "flange's own link)"
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
