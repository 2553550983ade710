"""Arms as URDF files describe them: which joints are the arm, where they are, how they are coupled, and their shapes.

What is odd is listed in the robot's ``notes``; what the arm itself needs and lacks is refused.
"""

from __future__ import annotations

import codecs
import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypeVar
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np

from stereoservo.messages.cell_file import MAX_JOINTS
from stereoservo.messages.decoding import decoding
from stereoservo.messages.text_files import decoded_text
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointKindName, JointSpec
from stereoservo_sim.world.robots import Capsule, Robot, UrdfPosition, capsule_around, rotation_to_axis

T = TypeVar("T")

MOVING: dict[str, JointKindName] = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
LARGEST = 1e6
"""Larger numbers are taken for damaged data [m, kg, rad]; except limits, where large numbers mean none."""
NO_LIMIT = 1e39
FASTEST: dict[JointKindName, float] = {"revolute": 1.0, "prismatic": 0.4}
"""Largest speed of a simulated joint [rad/s or m/s]: files state the motor's limit or none."""
ACCELERATION: dict[JointKindName, float] = {"revolute": 4.0, "prismatic": 2.0}
"""Acceleration of simulated joints [rad/s² or m/s²]; a URDF states none."""
ENDLESS: dict[JointKindName, float] = {"revolute": float(2.0 * np.pi), "prismatic": 1.0}
"""Range to either side of a joint without limits [rad or m]."""
MANY_TURNS, LARGEST_DEGREES = 4.0 * np.pi, 720.0
"""A revolute joint's limits beyond the first are degrees if they are whole numbers up to the second, else none."""
MOST_BYTES, MOST_JOINTS, MOST_MESH_BYTES = 8 << 20, 2000, 24 << 20
"""Size of the largest URDF that is read, the number of its joints, and the size of the largest mesh."""
MESHES = (".obj", ".stl", ".dae")
ABOVE = 3
"""Number of folders above a URDF's own in which its package's root is looked for."""
ON_AXIS = 1e-6
"""Largest distance of coupled joints' axes from one line [m], and of their directions [rad]."""
MOST_NAMES, MOST_TEXT = 8, 2000
"""Names listed in a message, and its length in characters: names in damaged files may have any length."""

JAW = re.compile(r"gripper|jaw|finger|claw|pinch|grasp|thumb|knuckle", re.IGNORECASE)
"""Pattern of names of a gripper's joint at the end of a chain, unless the name matches `TURNS`."""
TURNS = re.compile(r"roll|pitch|yaw|rot|wrist|turn|swivel|spin", re.IGNORECASE)
JAW_LINK = re.compile(r"jaw|finger|claw|thumb|moving", re.IGNORECASE)
TOOL_FRAME = re.compile(r"tool0|tcp|gripper_frame|grasp|end_?effector|(?:^|_)eef?(?:_|$)", re.IGNORECASE)
"""Pattern of names of links fixed before the last joint at which the arm ends."""
HAND, ASIDE, ARM = 7, 2, 4
"""Most joints of a finger; of a wheel, a head or a caster beside an arm; and least joints of an arm beside them."""


class UrdfError(ValueError):
    """A URDF file cannot be used; the text names the file, the cause and what would be valid."""


def load_urdf(path: Path, *, flange: str = "", mounted: FloatArray | None = None) -> Robot:
    """The arm of a URDF file, its root link at ``mounted`` (4, 4) in the world.

    ``flange``: the link that carries the body; default: the last moving link of the only arm, or the last before a
    gripper. Joints that are coupled along one line are one joint of the robot. The robot's ``notes`` list what is
    omitted, and how it is included. Raises UrdfError.
    """
    with decoding(lambda cause: UrdfError(f"{path}: {cause[:MOST_TEXT]}")):
        pose = np.eye(4) if mounted is None else mounted
        notes: list[str] = []
        tree = UrdfTree(_parsed(path, notes), path)
        chain = chain_to_flange(tree, flange, notes)
        axes = _coupled_axes(tree, chain)
        fixed, links, specs, positions = pose, [], [], []
        for k, axis in enumerate(axes):
            fixed = fixed @ axis.before
            turn = rotation_to_axis(axis.direction)
            links.append(fixed @ turn)
            fixed = turn.T @ axis.after
            specs.append(_spec(axis, notes))
            positions += [UrdfPosition(one.name, k, factor, offset) for one, factor, offset in axis.members]
        meshes = Meshes(path)
        parts = _rigid_parts(tree, axes, pose)
        masses, centres = zip(*map(_weight, parts[1:]), strict=True)
        shapes = tuple(_shapes(parts, meshes))
        text = _physics_text(tree, chain[0].parent, meshes)
        notes += meshes.notes
    return Robot(
        name=tree.name, base=links[0], links=np.stack([*links[1:], fixed]), joints=tuple(specs),
        masses=np.array(masses), centres=np.array(centres), shapes=shapes, text=text, positions=tuple(positions),
        mounted=pose, flange=chain[-1].child, notes=tuple(notes),
    )  # fmt: skip


# -- the file -------------------------------------------------------------------------------------------------


def _parsed(path: Path, notes: list[str]) -> Element:
    """The <robot> element of a file, by names with their prefixes: undeclared ones are usual."""
    if not path.is_file():
        raise ValueError("cannot be read: it is no file")
    if (size := path.stat().st_size) > MOST_BYTES:
        raise ValueError(f"has {size} bytes; a URDF of up to {MOST_BYTES} bytes is read")
    text = _decoded(path.read_bytes(), notes).lstrip()
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    try:
        parser.Parse(text.encode("utf-8", "surrogatepass"), True)
    except expat.ExpatError as error:
        raise ValueError(f"is not XML: {error} (a .xacro is first to be expanded)") from error
    root = builder.close()
    if root.tag != "robot":
        raise ValueError(f"its outermost element is <{root.tag[:80]}>; a URDF's is <robot>")
    macros = sorted({one.tag for one in root.iter() if one.tag.startswith("xacro:")})
    if macros and root.find("joint") is None:
        raise ValueError(f"no joint, but xacro commands{_listed(macros)}; expand it first: xacro FILE > arm.urdf")
    return root


def _decoded(data: bytes, notes: list[str]) -> str:
    """Text of a file, in the encoding that it declares where that is none of Unicode."""
    declared = re.match(rb"\s*<\?xml[^>]*encoding=[\"']([\w.-]+)", data)
    name = declared[1].decode() if declared else "utf-8"
    with suppress(LookupError, UnicodeError):
        if not codecs.lookup(name).name.startswith("utf"):
            return data.decode(name)
    text, remarks = decoded_text(data)
    notes += [str(remark) for remark in remarks]
    return text


def _name(element: Element) -> str:
    name = element.get("name")
    if not name:
        raise ValueError(f"a <{element.tag}> has no name")
    return name


def _number(element: Element, key: str, default: str = "0", least: float = -LARGEST, most: float = LARGEST) -> float:
    text = element.get(key, default)
    try:
        found = float(text)
    except ValueError:
        found = float("nan")
    if not least <= found <= most:
        raise _unusable(element, key, text, f"a number from {least:g} to {most:g} is needed")
    return found


def _vector(element: Element | None, key: str, default: str = "0 0 0") -> FloatArray:
    """Three numbers of an attribute, separated by spaces or commas."""
    text = default if element is None else element.get(key, default)
    try:
        found = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (3,) or not np.abs(found).max() <= LARGEST:
        raise _unusable(element, key, text, f"three numbers are needed, up to {LARGEST:g}")
    return found


def _unusable(element: Element | None, key: str, text: str, needed: str) -> ValueError:
    first = "; expand it first: xacro FILE > arm.urdf" if "$" in text else ""
    return ValueError(f"<{'' if element is None else element.tag} {key}={text[:80]!r}>; {needed}{first}")


def _origin(element: Element) -> FloatArray:
    """Pose (4, 4) of an element in its parent: translation, then roll, pitch and yaw about fixed axes."""
    pose, origin = np.eye(4), element.find("origin")
    (cr, cp, cy), (sr, sp, sy) = (f(_vector(origin, "rpy")) for f in (np.cos, np.sin))
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = _vector(origin, "xyz")
    return pose


# -- the tree -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint of a URDF. ``mimics``: the joint it is coupled to."""

    name: str
    kind: str
    parent: str
    child: str
    element: Element
    mimics: str = ""

    @property
    def moves(self) -> bool:
        """Whether it moves, independently or coupled to another."""
        return self.kind in MOVING

    @property
    def driven(self) -> bool:
        """Whether it moves independently."""
        return self.moves and not self.mimics

    @cached_property
    def origin(self) -> FloatArray:
        """Pose (4, 4) in its parent. Raises ValueError."""
        with _named(self):
            return _origin(self.element)

    @cached_property
    def axis(self) -> FloatArray:
        """Unit vector (3,) of its axis. Raises ValueError."""
        with _named(self):
            axis = _vector(self.element.find("axis"), "xyz", "1 0 0")
            if not (length := float(np.linalg.norm(axis))) > 1e-6:
                raise ValueError(f"its axis is {axis.tolist()}; a direction is needed")
            return axis / length

    @cached_property
    def mimicry(self) -> tuple[float, float]:
        """Multiplier and offset of its position from that of the joint it mimics. Raises ValueError."""
        with _named(self):
            mimic = self.element.find("mimic")
            assert mimic is not None
            return _number(mimic, "multiplier", "1"), _number(mimic, "offset")


def _named(joint: UrdfJoint) -> AbstractContextManager[None]:
    return decoding(lambda cause: ValueError(cause if cause.startswith("joint ") else f"joint {joint.name!r}: {cause}"))


class UrdfTree:
    """Links and joints of a URDF file, checked to form one tree or several. Raises ValueError."""

    def __init__(self, root: Element, path: Path) -> None:
        self.name, self.root = root.get("name") or path.stem, root
        self.links = self._unique("link")
        joints = self._unique("joint")
        if len(joints) > MOST_JOINTS:
            raise ValueError(f"has {len(joints)} joints; files of up to {MOST_JOINTS} are read")
        self.joints = {name: self._joint(name, element) for name, element in joints.items()}
        self.above: dict[str, UrdfJoint] = {}
        self._below: dict[str, list[UrdfJoint]] = {}
        for joint in self.joints.values():
            if (other := self.above.setdefault(joint.child, joint)) is not joint:
                raise ValueError(
                    f"link {joint.child!r} is the child of joints {other.name!r} and {joint.name!r}; closed "
                    "chains cannot be simulated: leave one of them out"
                )
            self._below.setdefault(joint.parent, []).append(joint)
        self.roots = [link for link in self.links if link not in self.above]
        order = list(self.roots)
        for link in order:
            order.extend(joint.child for joint in self.below(link))
        if len(order) < len(self.links):
            circle = next(link for link in self.links if link not in set(order))
            raise ValueError(f"link {circle!r} is below itself; a tree has no circle")
        self._depth = dict.fromkeys(self.links, 0)
        self._moving = dict.fromkeys(self.links, False)
        for link in reversed(order):
            for joint in self.below(link):
                self._depth[link] = max(self._depth[link], self.depth(joint))
                self._moving[link] |= self.moves(joint)

    def _unique(self, tag: str) -> dict[str, Element]:
        found: dict[str, Element] = {}
        for element in self.root.findall(tag):
            if found.setdefault(_name(element), element) is not element:
                raise ValueError(f"two {tag}s are named {element.get('name')!r}; each needs a name of its own")
        return found

    def _joint(self, name: str, element: Element) -> UrdfJoint:
        ends = []
        for tag in ("parent", "child"):
            found = element.find(tag)
            end = "" if found is None else found.get("link", "")
            if end not in self.links:
                raise ValueError(f"joint {name!r}: its {tag} {end!r} is no link; links{_listed(self.links)}")
            ends.append(end)
        mimic, kind = element.find("mimic"), element.get("type", "").strip().lower()
        mimics = "" if mimic is None or kind not in MOVING else mimic.get("joint") or "?"
        return UrdfJoint(name, kind, ends[0], ends[1], element, mimics)

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

    def leader(self, joint: UrdfJoint) -> tuple[str, float, float]:
        """The independent joint that leads ``joint``, and factor and offset of the position from the leader's.

        Raises ValueError if the joints mimic each other, or one that is not there.
        """
        factor, offset, seen = 1.0, 0.0, {joint.name}
        while joint.mimics:
            multiplier, shift = joint.mimicry
            factor, offset = factor * multiplier, offset + factor * shift
            if joint.mimics in seen or joint.mimics not in self.joints:
                others = [name for name in self.joints if name != joint.name]
                raise ValueError(f"joint {joint.name!r} mimics {joint.mimics!r}; joints beside it{_listed(others)}")
            joint = self.joints[joint.mimics]
            seen.add(joint.name)
        return joint.name, factor, offset


# -- the chain -----------------------------------------------------------------------------------------------


@dataclass
class _Arm:
    """A chain of joints, notes on what it omits, and the joints that these notes cover."""

    chain: list[UrdfJoint] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    covered: set[str] = field(default_factory=set)

    def omit(self, note: str, joints: list[UrdfJoint]) -> None:
        self.notes.append(note)
        self.covered.update(joint.name for joint in joints)

    @property
    def driven(self) -> set[str]:
        return {joint.name for joint in self.chain if joint.driven}


def chain_to_flange(tree: UrdfTree, flange: str, notes: list[str]) -> list[UrdfJoint]:
    """Joints from the root to the link ``flange``, fixed ones included; ``notes`` get what is omitted and how it is
    included. ``flange`` empty: that of the only arm. Raises ValueError if no joint moves or several arms are possible.
    """
    if flange:
        if flange not in tree.links:
            raise ValueError(f"flange {flange!r} is no link; links{_listed(tree.links)}")
        arm, link = _Arm(), flange
        while link in tree.above:
            arm.chain.insert(0, tree.above[link])
            link = arm.chain[0].parent
    else:
        arm = _only_arm(tree)
    chain, end = arm.chain, arm.chain[-1].child if arm.chain else flange or ", ".join(tree.roots[:1])
    if not any(joint.moves for joint in chain):
        root = chain[0].parent if chain else end
        raise ValueError(f"no joint moves between {root!r} and the flange {end!r}{_valid(_arms(tree))}")
    first = next(k for k, joint in enumerate(chain) if joint.moves)
    for k, joint in enumerate(chain):
        if joint.moves or joint.kind == "fixed":
            continue
        if k > first or joint.kind not in ("floating", "planar"):
            raise ValueError(
                f"joint {joint.name!r} is of type {joint.kind!r} and on the way to the flange {end!r}; "
                f'{", ".join((*MOVING, "fixed"))} can be simulated there: make it type="fixed" where it stands still'
            )
        arm.omit(f"joint {joint.name!r} is {joint.kind}, before the arm: it stays at its zero", [joint])
    _note_beside(tree, arm)
    notes += arm.notes
    return chain


def _only_arm(tree: UrdfTree) -> _Arm:
    """The arm of a file of one, or the one that has no like beside it. Raises ValueError."""
    arms = _arms(tree)
    if not arms:
        return _Arm()
    best = arms[0]
    others = [len(arm.driven - best.driven) for arm in arms[1:]]
    own = min((len(best.driven - arm.driven) for arm in arms[1:]), default=0)
    if max(others, default=0) > ASIDE or (others and own < ARM):
        raise ValueError(f"it holds several arms; say which is meant{_valid(arms)}")
    return best


def _valid(arms: list[_Arm]) -> str:
    """The flanges of arms, with the number of joints of each, as the end of a refusal."""
    ends = [f"flange = {arm.chain[-1].child!r} ({len(arm.driven)} joints)" for arm in arms[:MOST_NAMES]]
    more = f" and {len(arms) - MOST_NAMES} more" if len(arms) > MOST_NAMES else ""
    return f": {' or '.join(ends)}{more}" if ends else ""


def _arms(tree: UrdfTree) -> list[_Arm]:
    """The arms of a file, those of most joints first."""
    found = [arm for root in tree.roots for arm in _onward(tree, root, _Arm()) if any(one.moves for one in arm.chain)]
    return sorted({arm.chain[-1].child: arm for arm in found}.values(), key=lambda arm: -len(arm.driven))


def _onward(tree: UrdfTree, link: str, arm: _Arm) -> list[_Arm]:
    """The arms that continue ``arm`` from ``link``: several where the tree branches; it ends at a gripper.

    Linkages coupled to the arm's own joints are no branch.
    """
    while moving := [joint for joint in tree.below(link) if tree.moves(joint)]:
        if len(moving) > 1:
            own = {joint.name for joint in arm.chain}
            beyond = [(joint, [one for one in tree.beyond(joint) if one.moves]) for joint in moving]
            beyond = [(joint, ones) for joint, ones in beyond if not all(one.mimics in own for one in ones)]
            driven = [joint for joint, _ in beyond if tree.depth(joint)]  # others are coupled to joints further on
            if len(beyond) != 1 and len(arm.driven) >= max(map(tree.depth, driven), default=0) <= HAND:
                _without_gripper(arm, link, [one for _, ones in beyond for one in ones])
                break
            if len(beyond) > 1 and len(driven) > 1:
                copies = [_Arm([*arm.chain, joint], [*arm.notes], {*arm.covered}) for joint in driven]
                return [end for copy in copies for end in _onward(tree, copy.chain[-1].child, copy)]
            moving = [joint for joint, _ in beyond] if len(beyond) == 1 else driven
        arm.chain.append(moving[0])
        link = moving[0].child
    else:
        _without_jaw(tree, arm)
        link = arm.chain[-1].child if arm.chain else link
    ahead = tree.below(link)  # a tool's frame behind the last joint, if it is the only one
    while len(ahead) == 1 and not ahead[0].moves:
        arm.chain.append(ahead[0])
        ahead = tree.below(ahead[0].child)
    return [arm]


def _without_gripper(arm: _Arm, link: str, gripper: list[UrdfJoint]) -> None:
    first = next((one for one in gripper if one.driven), None)
    how = "" if first is None else f"; flange = {first.child!r} makes {first.name!r} a joint of the arm"
    arm.omit(
        f"joints {_names(gripper)} are left out of the arm, which ends at {link!r}, where the file branches: they "
        f"stay at rest{how}",
        gripper,
    )


def _without_jaw(tree: UrdfTree, arm: _Arm) -> None:
    """Take a gripper's single jaw off the end of a chain."""
    chain = arm.chain
    last = next((k for k in reversed(range(len(chain))) if chain[k].driven), 0)
    jaw = chain[last] if chain else None
    coupled = [joint for joint in chain[last + 1 :] if joint.mimics]
    if jaw is None or len(arm.driven) < 2 or any(one.mimics != jaw.name for one in coupled):
        return
    before = [joint for joint in chain[:last] if joint.driven]
    frame = next((one.child for one in tree.below(jaw.parent) if not one.moves and TOOL_FRAME.search(one.child)), None)
    if JAW.search(jaw.name) and not TURNS.search(jaw.name) and not any(JAW.search(one.name) for one in before):
        why = "by its name"
    elif JAW_LINK.search(jaw.child) and not any(JAW_LINK.search(one.child) for one in before):
        why = f"by the name of its link {jaw.child!r}"
    elif frame is not None:
        why = f"since the tool's frame {frame!r} is fixed before it"
    else:
        return
    arm.omit(
        f"joint {jaw.name!r} is taken for a gripper's jaw, {why}, and left out of the arm, which ends at "
        f"{jaw.parent!r}: it stays at rest; flange = {jaw.child!r} makes it a joint of the arm",
        [jaw, *coupled],
    )
    del chain[last:]


def _note_beside(tree: UrdfTree, arm: _Arm) -> None:
    """Add notes on joints and links beside the chain that no other note covers."""
    own, end = {joint.name for joint in arm.chain}, arm.chain[-1].child
    others = [one for one in tree.joints.values() if one.kind != "fixed" and one.name not in own | arm.covered]
    for one in others:
        if one.mimics in own:
            arm.omit(
                f"joint {one.name!r} mimics the arm's {one.mimics!r} beside its chain: it stays at rest, with what it "
                "carries",
                [one],
            )
    free = [one for one in others if one.mimics not in own]
    if free:
        arm.omit(f"joints {_names(free)} are not on the way to the flange {end!r}: they stay at rest", free)
    loose = [link for link in tree.roots if link != arm.chain[0].parent]
    if loose:
        arm.notes.append(f"links that no joint connects to the arm are left out, with what is below{_listed(loose)}")


def _names(joints: list[UrdfJoint]) -> str:
    return _listed([repr(joint.name) for joint in joints])[2:]


def _listed(names: list[str] | dict[str, Element]) -> str:
    """Names as the end of a sentence."""
    shown = [name[:80] for name in list(names)[:MOST_NAMES]]
    return f": {', '.join(shown)}" + (f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else "")


# -- coupled joints -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Axis:
    """A joint of the arm: one of the file, or several that move together along or about one line.

    ``before`` (4, 4): from the previous joint's moved frame to this one's, where ``direction`` (3,) is; ``after``
    (4, 4): from its frame to the last member's, at position 0. ``members``: joints of the file, with factor and offset
    of their positions from this one's.
    """

    name: str
    kind: JointKindName
    before: FloatArray
    direction: FloatArray
    after: FloatArray
    members: list[tuple[UrdfJoint, float, float]]


def _coupled_axes(tree: UrdfTree, chain: list[UrdfJoint]) -> list[_Axis]:
    """The joints of the arm along a chain, in order; its last ``after`` leads to the flange. Raises ValueError."""
    groups: list[tuple[str, list[tuple[UrdfJoint, float, float, FloatArray]]]] = []
    fixed = np.eye(4)
    on_chain = Counter(tree.leader(joint)[0] for joint in chain if joint.moves)
    for joint in chain:
        fixed = fixed @ joint.origin
        if joint.moves:
            name, factor, offset = tree.leader(joint)
            if on_chain[name] == 1:
                factor, offset = 1.0, 0.0  # nothing else on the chain moves with it
            if not groups or groups[-1][0] != name:
                groups.append((name, []))
            groups[-1][1].append((joint, factor, offset, fixed))
            fixed = np.eye(4)
    apart = next((name for name, count in Counter(name for name, _ in groups).items() if count > 1), None)
    if apart is not None:
        coupled = next(joint for joint in chain if joint.mimics and tree.leader(joint)[0] == apart)
        raise _unlike(coupled, "with joints of the arm between them")
    if len(groups) > MAX_JOINTS:
        valid = groups[MAX_JOINTS - 1][1][-1][0].child
        raise ValueError(
            f"{len(groups)} joints are on the way to the flange {chain[-1].child!r}; a cell has at most {MAX_JOINTS}. "
            f"Valid: flange = {valid!r} or another link before it"
        )
    axes = [_axis(name, members) for name, members in groups]
    axes[-1].after[:] = axes[-1].after @ fixed
    return axes


def _axis(name: str, group: list[tuple[UrdfJoint, float, float, FloatArray]]) -> _Axis:
    first = group[0][0]
    coupled = next((joint for joint, *_ in group if joint.mimics), first)
    kinds = {MOVING[joint.kind] for joint, *_ in group}
    pose, velocity = np.eye(4), np.zeros(3)
    for k, (joint, factor, offset, before) in enumerate(group):
        pose = pose @ before if k else pose
        direction = pose[:3, :3] @ joint.axis
        off_line = np.cross(direction, first.axis), np.cross(pose[:3, 3], first.axis)
        if len(kinds) > 1 or ("revolute" in kinds and np.abs(off_line).max() > ON_AXIS):
            raise _unlike(coupled, "along or about another line")
        velocity += factor * direction
        pose = pose @ motion(joint.kind, joint.axis, offset)
    rate = float(np.linalg.norm(velocity))
    if rate < ON_AXIS:
        raise _unlike(coupled, "against it, so that nothing moves")
    names = [joint.name for joint, *_ in group]
    return _Axis(
        name if name in names else first.name,
        kinds.pop(),
        group[0][3],
        velocity / rate,
        pose,
        [(joint, factor / rate, offset) for joint, factor, offset, _ in group],
    )


def _unlike(joint: UrdfJoint, how: str) -> ValueError:
    return ValueError(
        f"joint {joint.name!r} mimics {joint.mimics!r} and moves {how}, on the way to the flange; mimic joints can be "
        "driven where they follow each other and slide, or turn about one line. Valid: "
        f'flange = {joint.parent!r} or another link before it; or type="fixed" in the file, where it stands still'
    )


def motion(kind: str, axis: FloatArray, value: float) -> FloatArray:
    """Rotation (4, 4) by ``value`` about ``axis`` (3,), or translation along it if ``prismatic``."""
    moved = np.eye(4)
    if kind == "prismatic":
        moved[:3, 3] = value * axis
        return moved
    turn = rotation_to_axis(axis)
    c, s = np.cos(value), np.sin(value)
    return turn @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]) @ turn.T


def _spec(axis: _Axis, notes: list[str]) -> JointSpec:
    """Limits of a joint of the arm: each member's, by its factor and offset. Raises ValueError if there is no range."""
    low, high, speed = -np.inf, np.inf, FASTEST[axis.kind]
    for joint, factor, offset in axis.members:
        if abs(factor) < ON_AXIS:
            continue
        with _named(joint):
            found, note = joint_range(joint.element, axis.kind)
            limit = joint.element.find("limit")
            fastest = 0.0 if limit is None else _number(limit, "velocity", least=-NO_LIMIT, most=NO_LIMIT)
        if len(axis.members) == 1 or joint.driven or found:  # what mimics may leave its limits to its leader
            ends = sorted((end - offset) / factor for end in found or (-ENDLESS[axis.kind], ENDLESS[axis.kind]))
            low, high = max(low, ends[0]), min(high, ends[1])
            notes += [f"joint {joint.name!r}: {note}"] if note else []
        speed = min(speed, fastest / abs(factor)) if fastest > 0.0 else speed
    low, high = (end if np.isfinite(end) else sign * ENDLESS[axis.kind] for end, sign in ((low, -1.0), (high, 1.0)))
    if not low < high:
        raise ValueError(f"joint {axis.name!r}: limits {low:g} to {high:g}; the lower must be below the upper")
    return JointSpec(axis.name, axis.kind, low, high, speed, ACCELERATION[axis.kind])


def joint_range(element: Element, kind: JointKindName) -> tuple[tuple[float, float] | None, str]:
    """Lowest and highest position of a joint [rad or m], None if it has no limits; and what was assumed, or nothing.

    Raises ValueError.
    """
    limit = element.find("limit")
    if element.get("type", "").strip().lower() == "continuous":
        return None, ""
    low, high = (
        0.0 if limit is None else _number(limit, key, least=-NO_LIMIT, most=NO_LIMIT) for key in ("lower", "upper")
    )
    unit, reach = ("rad", "2π rad") if kind == "revolute" else ("m", "1 m")
    if low == high == 0.0:
        return None, f"no limits are stated: the simulation uses {reach} to either side of zero"
    if not low < high:
        raise ValueError(f"limits {low:g} to {high:g}; the lower must be below the upper")
    if kind == "prismatic" or max(-low, high) <= MANY_TURNS:
        return (low, high), ""
    if max(-low, high) <= LARGEST_DEGREES and low.is_integer() and high.is_integer():
        ends = float(np.deg2rad(low)), float(np.deg2rad(high))
        return ends, f"limits {low:g} to {high:g} are taken for degrees; a URDF has radians"
    return None, f"limits {low:g} to {high:g} {unit} are many turns: the simulation uses {reach} to either side of zero"


# -- rigid parts of each joint ---------------------------------------------------------------------------------

Part = list[tuple[FloatArray, Element]]
"""Rigidly connected links, each with its pose (4, 4) in their joint's frame."""


def _rigid_parts(tree: UrdfTree, axes: list[_Axis], mounted: FloatArray) -> list[Part]:
    """Rigid parts: of the base in the world, and of every joint of the arm in its frame; links between coupled joints
    move with the last of these.
    """
    entry = {}
    for axis in axes:
        joint, _, offset = axis.members[0]
        entry[joint.name] = rotation_to_axis(axis.direction).T @ motion(joint.kind, joint.axis, offset)
    later = {joint.name: offset for axis in axes for joint, _, offset in axis.members[1:]}
    parts: list[Part] = [[]]
    root = axes[0].members[0][0].parent
    while root in tree.above:
        root = tree.above[root].parent
    waiting = [(root, mounted, 0)]  # depth first, in the file's order
    while waiting:
        link, pose, part = waiting.pop()
        if part == len(parts):
            parts.append([])
        parts[part].append((pose, tree.links[link]))
        for joint in reversed(tree.below(link)):
            if joint.name in entry:
                waiting.append((joint.child, entry[joint.name], part + 1))
            else:
                rest = later.get(joint.name, resting_position(joint.element)) if joint.moves else 0.0
                moved = motion(joint.kind, joint.axis, rest) if rest else np.eye(4)
                waiting.append((joint.child, pose @ joint.origin @ moved, part))
    return parts


def resting_position(element: Element) -> float:
    """Rest position of a joint beside the arm [rad or m]: zero, or the nearest position in its range."""
    kind = MOVING.get(element.get("type", "").strip().lower(), "revolute")
    ends, _ = _used(lambda: joint_range(element, kind)) or (None, "")
    return float(np.clip(0.0, *ends)) if ends is not None else 0.0


def _weight(part: Part) -> tuple[float, FloatArray]:
    """Mass [kg] of a part and its centre (3,) [m]."""
    mass, moment = 0.0, np.zeros(3)
    for pose, link in part:
        inertial = link.find("inertial")
        stated = None if inertial is None else inertial.find("mass")
        if inertial is None or stated is None:
            continue
        with decoding(lambda cause, link=link: ValueError(f"link {link.get('name')!r}: {cause}")):
            own = _number(stated, "value", least=0.0)
            mass += own
            moment += own * (pose @ _origin(inertial))[:3, 3]
    return mass, moment / mass if mass > 0.0 else moment


def _shapes(parts: list[Part], meshes: Meshes) -> Iterator[Capsule]:
    for number, part in enumerate(parts):
        for pose, link in part:
            for element in link.findall("collision") or link.findall("visual"):
                with decoding(lambda cause, link=link: ValueError(f"link {link.get('name')!r}: {cause}")):
                    corners = _corners(element.find("geometry"), meshes)
                    if len(corners):
                        placed = pose @ _origin(element)
                        yield capsule_around(number, corners @ placed[:3, :3].T + placed[:3, 3])


def _corners(geometry: Element | None, meshes: Meshes) -> FloatArray:
    """Points (k, 3) [m] on a geometry's surface: corners of a box or mesh, rings of cylinders and spheres."""
    if geometry is None or len(geometry) == 0:
        return np.zeros((0, 3))
    shape = geometry[0]
    if shape.tag == "mesh":
        return meshes.points(shape.get("filename", "")) * _vector(shape, "scale", "1 1 1")
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1.0)])
    if shape.tag == "box":
        return 0.5 * cube * _vector(shape, "size")
    radius, length = (_number(shape, key, least=0.0) for key in ("radius", "length"))
    if shape.tag == "sphere":
        return radius * cube / np.sqrt(3.0)
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(16)], axis=1)
    half = np.array([0.0, 0.0, 0.5 * length])
    return np.concatenate([ring + half, ring - half])


# -- meshes ---------------------------------------------------------------------------------------------------


class Meshes:
    """The mesh files that a URDF names, as far as they are in its own tree: its package, else the nearest folder with
    a folder of meshes, else the one above its own.

    ``notes``: those that are not used, with the reason.
    """

    def __init__(self, path: Path) -> None:
        self._folder = path.absolute().parent
        above = [self._folder, *self._folder.parents[:ABOVE]]
        marked = [place for place in above if any((place / mark).exists() for mark in ("package.xml", "meshes"))]
        self._tree = marked[0] if marked and marked[0] != self._folder else self._folder.parent
        self._found: dict[str, Path | None] = {}
        self._points: dict[Path, FloatArray] = {}
        self._unused: dict[str, list[str]] = {}

    @property
    def notes(self) -> list[str]:
        """Notes on unused meshes, by reason."""
        return [
            f"{len(names)} meshes {why}, so these parts are not shown and hide nothing: {', '.join(names[:3])}"
            for why, names in self._unused.items()
        ]

    def file(self, named: str) -> Path | None:
        """The file of a mesh as it is ``named``; None if it is not used."""
        if named not in self._found:
            self._found[named] = self._looked_up(named)
        return self._found[named]

    def points(self, named: str) -> FloatArray:
        """Vertices (k, 3) of an .obj or .stl file; none if it is not used or of another format. Raises ValueError."""
        file = self.file(named)
        if file is None or file.suffix.lower() == ".dae":
            return np.zeros((0, 3))
        if file not in self._points:
            with decoding(lambda cause: ValueError(f"its mesh {file}: {cause}")):
                points = _vertices(file.read_bytes(), file.suffix.lower() == ".obj")
                if not np.abs(points).max(initial=0.0) <= LARGEST:
                    raise ValueError(f"has vertices that are no number, or beyond {LARGEST:g}")
            self._points[file] = points
        return self._points[file]

    def _looked_up(self, named: str) -> Path | None:
        why = "are not found"
        for place in self._places(unquote(named).replace("\\", "/")):
            try:
                state = place.stat()
            except (OSError, ValueError):  # not there, or an invalid file name
                continue
            if not stat.S_ISREG(state.st_mode):
                why = "are no regular files"
            elif place.suffix.lower() not in MESHES:
                why = f"have none of the endings {', '.join(MESHES)}"
            elif state.st_size > MOST_MESH_BYTES:
                why = f"are larger than {MOST_MESH_BYTES >> 20} MiB"
            else:
                return place
        self._unused.setdefault(why, []).append(named[:200])
        return None

    def _places(self, named: str) -> Iterator[Path]:
        """Paths at which a mesh may be, none outside the tree: as it is named, in its package, or copied elsewhere."""
        scheme, _, bare = named.rpartition("://")
        words = bare.lstrip("/").split("/") if scheme or named.startswith("/") else named.split("/")
        if not scheme or scheme == "file":
            yield from self._inside(Path(os.path.normpath(self._folder / bare)), self._tree)
        if ".." not in words:
            if scheme:
                for place in self._folder.parents:  # a package that holds the file, or one beside it
                    package = place / words[0]
                    if package in self._folder.parents or (package / "package.xml").is_file():
                        yield from self._inside(package.joinpath(*words[1:]), package)
            for k in range(max(0, len(words) - MOST_NAMES), len(words)):  # what people copy with a file
                for place in (self._folder, self._tree):
                    yield place.joinpath(*words[k:])

    @staticmethod
    def _inside(place: Path, tree: Path) -> Iterator[Path]:
        if tree.parent != tree and place.is_relative_to(tree):
            yield place


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


def _physics_text(tree: UrdfTree, base: str, meshes: Meshes) -> str:
    """The file as an engine reads it: one root, its joints known, its meshes where they are, commas left out."""
    links = {base}.union(one.child for joint in tree.below(base) for one in tree.beyond(joint))
    root = Element("robot", name=tree.name)
    for element in tree.root:
        if element.tag == "material":
            root.append(element)
        elif element.tag == "link" and element.get("name") in links:
            root.append(_with_meshes(element, meshes))
    for joint in tree.joints.values():
        if joint.parent in links:
            root.append(_physics_joint(joint))
    for element in root.iter():
        for key in ("xyz", "rpy", "size", "scale", "rgba"):
            if "," in element.get(key, ""):
                element.set(key, element.get(key, "").replace(",", " "))
    ElementTree.indent(root)  # pybullet cuts long lines
    return ElementTree.tostring(root, "unicode")


def _physics_joint(joint: UrdfJoint) -> Element:
    """A copy of a joint with a unit axis and the limits that are used, the lower above the upper where there are none;
    fixed if it has no axis, which joints beside the arm may lack.
    """
    element = deepcopy(joint.element)
    element.set("type", "fixed")
    if joint.moves and (axis := _used(lambda: joint.axis)) is not None:
        element.set("type", joint.kind)
        _part(element, "axis").set("xyz", " ".join(map(repr, axis.tolist())))
        ends, _ = _used(lambda: joint_range(joint.element, MOVING[joint.kind])) or (None, "")
        limit = _part(element, "limit")
        for key, value in zip(("lower", "upper"), ends or (1.0, -1.0), strict=True):
            limit.set(key, repr(value))
        for key in ("effort", "velocity"):
            limit.set(key, limit.get(key, "1"))
    return element


def _used(read: Callable[[], T]) -> T | None:
    """What is read of a joint; None if it cannot be used, which is refused of the arm's own joints before."""
    try:
        return read()
    except ValueError:
        return None


def _part(element: Element, tag: str) -> Element:
    found = element.find(tag)
    return ElementTree.SubElement(element, tag) if found is None else found


def _with_meshes(link: Element, meshes: Meshes) -> Element:
    """A copy of a link whose meshes have absolute paths; without those that are not used."""
    link = deepcopy(link)
    for part in [part for part in link if part.tag in ("visual", "collision")]:
        mesh = part.find("geometry/mesh")
        file = None if mesh is None else meshes.file(mesh.get("filename", ""))
        if file is not None:
            mesh.set("filename", str(file))
        elif mesh is not None:
            link.remove(part)
    return link
