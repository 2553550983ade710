"""The joints of a URDF's tree that are the arm: the way from its root to the flange, and what is left out of it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

from stereoservo.numerics.arrays import FloatArray

JAW = re.compile(r"gripper|jaw|finger|claw|pinch|grasp|thumb|knuckle", re.IGNORECASE)
"""In the name of a last joint that opens and closes something, unless it is one of `TURNS`."""
TURNS = re.compile(r"roll|pitch|yaw|rot|wrist|turn|swivel|spin", re.IGNORECASE)
JAW_LINK = re.compile(r"jaw|finger|claw|thumb|moving", re.IGNORECASE)
TOOL_FRAME = re.compile(r"tool0|tcp|gripper_frame|grasp|end_?effector|(?:^|_)eef?(?:_|$)", re.IGNORECASE)
"""In the name of a link that is fixed before the last joint: the arm ends there."""
MOST_NAMES = 8


class UrdfError(ValueError):
    """A URDF file cannot be used; the text names the file, the cause and what would be valid."""


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint of a URDF: ``origin`` (4, 4) in its parent, ``axis`` (3,), ``mimics``: which joint it is coupled to."""

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
        """Whether it moves, by itself or coupled to another."""
        return self.kind != "fixed"

    @property
    def driven(self) -> bool:
        """Whether it moves by itself."""
        return self.moves and not self.mimics


class UrdfTree:
    """Links and joints of a URDF file, checked to be a tree, or several. Raises UrdfError."""

    def __init__(
        self, path: Path, name: str, links: dict[str, Element], joints: tuple[UrdfJoint, ...]
    ) -> None:
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
        """How many joints that are driven follow one another from this one on, at most."""
        return joint.driven + self._depth[joint.child]

    def beyond(self, joint: UrdfJoint) -> list[UrdfJoint]:
        """All joints from this one on."""
        found = [joint]
        for one in found:
            found.extend(self.below(one.child))
        return found


def chain_to_flange(tree: UrdfTree, flange: str) -> tuple[list[UrdfJoint], tuple[str, ...]]:
    """Joints from the root to the link ``flange``, fixed ones included, and notes on what is left out and how it is
    included. ``flange`` empty: the last link before nothing moves any more, before a gripper, or where the tree
    branches. Raises UrdfError: no joint moves, one is coupled to another, or it is open which of several arms is meant.
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
    """Notes on joints that are left out, and which these are."""

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
    ahead = tree.below(link)  # a tool's frame behind the last joint, where it is the only one
    while len(ahead) == 1 and not ahead[0].moves:
        chain.append(ahead[0])
        ahead = tree.below(ahead[0].child)
    return chain


def _onward(
    tree: UrdfTree, link: str, moving: list[UrdfJoint], chain: list[UrdfJoint], left: _LeftOut
) -> list[UrdfJoint]:
    """The one joint with which the arm goes on from ``link``, where it branches; none: it ends there, by a gripper.

    Linkages that are coupled to the arm's own joints are no branch. Raises UrdfError where several arms begin there.
    """
    own = {joint.name for joint in chain}
    branches = [
        joint for joint in moving if not all(one.mimics in own for one in tree.beyond(joint) if one.moves)
    ]
    if len(branches) == 1:
        return branches
    before, deepest = sum(joint.driven for joint in chain), max(map(tree.depth, branches), default=0)
    if before >= deepest:
        gripper = [one for joint in branches for one in tree.beyond(joint) if one.moves]
        first = next((one for one in gripper if one.driven), None)
        how = "" if first is None else f"; flange = {first.child!r} makes {first.name!r} a joint of the arm"
        how = "" if first is None else f"; flange = {first.child!r} makes {first.name!r} a joint of the arm"
        left.tell(
            f"joints {_names(gripper)} are left out of the arm, which ends at {link!r}, where the file branches: they "
            f"stay at rest{how}",
            gripper,
        )
        return []
    driven = [joint for joint in branches if tree.depth(joint)]
    if len(driven) == 1:  # beside the arm, linkages coupled to joints further on
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
    """A chain up to a gripper's single jaw at its end."""
    last = next((k for k in reversed(range(len(chain))) if chain[k].driven), 0)
    jaw = chain[last] if chain else None
    coupled = [joint for joint in chain[last + 1 :] if joint.mimics]
    if (
        jaw is None
        or sum(joint.driven for joint in chain) < 2
        or any(one.mimics != jaw.name for one in coupled)
    ):
        return chain
    frame = next(
        (one.child for one in tree.below(jaw.parent) if not one.moves and TOOL_FRAME.search(one.child)), None
    )
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
    """Tell of joints beside the chain of which no other note tells."""
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
