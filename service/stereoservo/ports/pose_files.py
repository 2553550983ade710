"""Reader of the poses of an arm's hand as people store them: text, CSV, JSON, YAML, XML or NumPy, one file or one a
picture. Layout, unit, order and rotation convention follow from the numbers, and where these do not decide, from the
motion of a board in the pictures: relative motions of arm and board are equal up to the hand-eye transform.
"""

from __future__ import annotations

import difflib
import itertools
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.messages.text_files import Remark
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.ports.number_files import NumberFileError, Table, read_tables

SUFFIXES = (".txt", ".csv", ".tsv", ".dat", ".json", ".jsonl", ".yaml", ".yml", ".xml", ".npy", ".npz")
MOST_EXTRA = 3
"""Columns before a pose, such as an index and a time."""
RIGID, UNIT_NORM = 1e-2, 1e-2
"""Largest deviation of a rotation matrix from an orthonormal one, and of a quaternion's norm from 1."""
MOST_BAD = 0.4
"""Largest share of rows that contradict a layout for it to be considered."""
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
SMALL, LARGE = 15.0, 300.0
"""95 % of the hand's distances from the base: below SMALL they are metres, above LARGE millimetres, else centimetres or
millimetres.
"""
RATIO = 2.0
"""Ratio of the misfits of two readings from which the better one is taken."""
LARGEST_MISFIT = 0.15
"""Misfit (rotations [rad], translations relative to their size) above which a reading does not explain the board."""
LEVERS = 3.0
"""Ratio of the hand's constant lever to the base's from which poses count as inverted."""
WRONG_SIZE = 0.1
"""Relative difference of the arm's lengths from the board's that is stated: the focal length is a rough estimate."""
NEARLY_HALF = 2.8
"""Angle [rad] between views from which the axis' sign is uncertain."""
MOST_PAIRS, ROUNDS = 300, 6
"""Pairs of views, and reweighted fits, of a hand-eye transform."""
LEAST_OF_LENS = 12
"""Markers in a view from which the camera's principal point and distortion are estimated with the board's poses."""
LEAST_VIEWS, LEAST_ANGLE = 4, 0.01
"""Views with a board from which it is compared with the arm, and its assumed error of rotation [rad]."""
SAME = 1e-6
"""Largest difference of the entries of poses [m] that are the same."""


class PoseFileError(Exception):
    """Poses cannot be read: the message names the file, the cause, and what would be valid.

    Attributes:
        code: ``unreadable``, ``no_poses``, ``ambiguous``, ``no_fit``, ``count``, ``format``.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class PoseReading(NamedTuple):
    """Poses (n, 4, 4) of the hand in the base [m], the index (n,) of the picture of each, its ``words``, such as
    ``columns``, ``mm``, and what was assumed or left out.
    """

    poses: FloatArray
    pictures: IntArray
    words: tuple[str, ...]
    findings: tuple[Remark, ...]


def read_poses(
    paths: Sequence[Path], pictures: Sequence[str], board: FloatArray | None = None, stated: str = ""
) -> PoseReading:
    """Poses of the hand in one file, or in one file a picture, for ``pictures`` by name, in their order.

    ``board`` (p, 4, 4) [m]: poses of the board in the camera, NaN where it is not seen. ``stated``: words that the
    reading must have, such as ``wxyz,mm`` or ``inverted``. Raises PoseFileError.
    """
    words = [word for word in re.split(r"[,\s]+", stated.lower()) if word]
    try:
        found = [one for table in read_tables(paths) for one in _readings(table)]
    except NumberFileError as error:
        raise PoseFileError("unreadable", str(error)) from error
    if not found:
        raise PoseFileError(
            "no_poses",
            f"{_names(paths)}: no columns of poses; valid are a 4x4 or 3x4 matrix (16 or 12 numbers), x y z with a "
            "quaternion (7) and x y z with angles or a rotation vector (6), as text, CSV, JSON, YAML, XML or NumPy",
        )
    wanted = len(pictures) or max(len(one.poses) for one in found)
    nearest = min(abs(len(one.poses) - wanted) for one in found)
    found = [one for one in found if abs(len(one.poses) - wanted) == nearest]
    clearest = max(one.rank for one in found)
    found = _of_words([one for one in found if one.rank == clearest], {*words} - {*METRES, "inverted", "direct"})
    chosen, match, how, fit = _decided(found, pictures, board)
    unit, by = _unit(chosen, fit, words)
    poses = chosen.poses[match.poses]
    poses[:, :3, 3] *= METRES[unit]
    inverted = "inverted" in words or ("direct" not in words and fit is not None and fit.inverted)
    good = _finite(poses)
    texts = [
        f"{good.sum()} poses in {_names(paths)} are read as {chosen}; decided by {how}",
        f"lengths are in {unit}, by {by}",
        *([match.remark] if match.remark else []),
        *(() if fit is None else fit.texts(METRES[unit], inverted)),
    ]
    bad = [
        Remark(chosen.table.lines[row], chosen.table.labels[row], "no pose of this layout: left out", True)
        for row in match.poses[~good].tolist()
    ]
    findings = (*chosen.table.remarks, *bad, *(Remark(0, "", text) for text in texts))
    made: FloatArray = np.asarray(np.linalg.inv(poses[good]) if inverted else poses[good], dtype=np.float64)
    return PoseReading(made, match.pictures[good], (*chosen.words, unit, *["inverted"] * inverted), findings)


def _names(paths: Sequence[Path]) -> str:
    return str(paths[0]) if len(paths) == 1 else f"{paths[0]} to {paths[-1].name} ({len(paths)} files)"


# -- layouts ---------------------------------------------------------------------------------------------------


class _Reading(NamedTuple):
    """A reading of the numbers: poses (n, 4, 4) in the file's unit of length, NaN for rows that contradict it;
    ``words`` that name it, names of the columns, and ``rank``: 3 for matrices, 2 for quaternions, 1 for three angles.
    """

    table: Table
    rank: int
    words: tuple[str, ...]
    names: str
    poses: FloatArray

    def __str__(self) -> str:
        return " ".join(self.words) + (f" [{self.names}]" if self.names else "")

    @property
    def hints(self) -> int:
        """Number of words that the names of the columns state, minus those that they contradict."""
        stated = 0
        for pattern, word, others in _HINTS:
            if re.search(pattern, re.sub(r"\w+\.", "", self.names.lower())):
                stated += (word in self.words) - any(other in self.words for other in others)
        return stated

    def good(self) -> BoolArray:
        return _finite(self.poses)


_EULER = tuple(f"R{a}R{b}R{c}" for a, b, c in itertools.permutations("xyz"))
_HINTS = (
    (r"deg|°", "deg", ("rad",)),
    (r"rad", "rad", ("deg",)),
    (r"rot\w*vec|rvec|axis.?angle|rodrigues", "rotation-vector", _EULER),
    (r"euler|rpy|roll|yaw", "RzRyRx", ("rotation-vector",)),
    (r"q?w[^a-z]+q?x[^a-z]|wxyz|q0", "wxyz", ("xyzw",)),
    (r"z[^a-z]+q?w(?![a-z])|xyzw", "xyzw", ("wxyz",)),
    (r"roll|r[_.]?x", "", ("angles-zyx",)),
)
_NOT_THE_ARM = re.compile(
    r"cam(?!e$)|marker|board|target|tag(?![a-z]*_?pose)|aruco|object|corner|joint|intrinsic|dist", re.I
)
_ROLE = re.compile(r"(?:^|[^a-z]|[a-z]+[^a-z])(q?[wxyz]|q[0-4]|r[xyz]|roll|pitch|yaw|[abcprot]|alpha|beta|gamma)$")
_UNIT = re.compile(r"[\s_]*[\[(](?:mm|cm|m|deg|rad|°)\w*[\])]$|[\s_]+(?:mm|cm|m|deg(?:rees?)?|rad(?:ians?)?|°)$")


def _readings(table: Table) -> list[_Reading]:
    """All readings that the numbers themselves allow."""
    found: list[_Reading] = []
    for names, values, placed in _columns(table):
        for words, rotations, positions in _layouts(values):
            if placed and "position-last" in words:
                continue
            good = _finite(rotations) & _finite(positions)
            R = np.where(good[:, None, None], rotations, np.eye(3))
            good &= (np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2)) < RIGID) & (np.linalg.det(R) > 0.0)
            if good.sum() < max(1.0, (1.0 - MOST_BAD) * len(values)):
                continue
            poses = np.full((len(values), 4, 4), np.nan)
            poses[good] = np.eye(4)
            poses[good, :3, :3] = Rotation.from_matrix(R[good]).as_matrix()
            poses[good, :3, 3] = positions[good]
            rank = {16: 3, 12: 3, 7: 2, 6: 1}[values.shape[1]]
            found.append(_Reading(table, rank, words, names, poses))
    arm = [one for one in found if not _NOT_THE_ARM.search(one.names)]
    return arm or found


_Columns = Iterator[tuple[str, FloatArray, bool]]
"""Names, columns (n, 16), (n, 12), (n, 7) or (n, 6), and whether the position is known to be first."""


def _columns(table: Table) -> _Columns:
    """Columns that may be poses."""
    vectors = {name: values for name, values in table.fields.items() if values.shape[1] > 1}
    for name, values in vectors.items():
        yield from _unnamed(name, values)
    places = [name for name, values in vectors.items() if values.shape[1] == 3]
    for name in (name for name, values in vectors.items() if values.shape[1] in (3, 4, 9)):
        others = [one for one in places if one != name and re.search(r"rot|rvec|euler|rpy|angle|orient", one) is None]
        if others and (vectors[name].shape[1] > 3 or re.search(r"rot|rvec|euler|rpy|angle|orient|^r", name, re.I)):
            near = max(others, key=lambda one: difflib.SequenceMatcher(None, name, one).ratio())
            yield f"{near} {name}", np.hstack([vectors[near], vectors[name]]), True
    yield from _named_columns(table)


def _named_columns(table: Table) -> _Columns:
    """Columns of single numbers: those whose names end as a pose's do, or all as if they had none."""
    scalars = {name: values for name, values in table.fields.items() if values.shape[1] == 1}
    roles: dict[str, str] = {}
    for name in scalars:
        plain = _UNIT.sub("", name.strip().lower())
        match = _ROLE.search(plain)
        if match is not None:
            turned = len(match[1]) == 1 and re.search(r"rot|quat|euler|orient", plain) is not None
            roles.setdefault(f"r{match[1]}" if turned else match[1], name)
    places = [roles.pop(one) for one in ("x", "y", "z") if one in roles]
    for first in (("rx", "ry", "rz"), ("roll", "pitch", "yaw")):
        if roles.keys() == set(first):
            roles = {one: roles[one] for one in first}
    if len(places) == 3 and len(roles) in (3, 4):
        used = [*places, *roles.values()]
        yield " ".join(used), np.hstack([scalars[name] for name in used]), True
    elif len(scalars) >= 6:
        yield from _unnamed(" ".join(scalars), np.hstack(list(scalars.values())))


def _unnamed(name: str, values: FloatArray) -> _Columns:
    """The last columns of an array (n, k), where those before them count."""
    for size in (16, 12, 7, 6):
        extra = values.shape[1] - size
        if 0 <= extra <= MOST_EXTRA and (not extra or _counts(values[:, 0])):
            yield name, values[:, extra:], False


def _counts(values: FloatArray) -> bool:
    """Whether values only grow, as an index or a time does."""
    known = values[np.isfinite(values)]
    return len(known) > 1 and bool((np.diff(known) > 0.0).all())


def _layouts(values: FloatArray) -> Iterator[tuple[tuple[str, ...], FloatArray, FloatArray]]:
    """Words, rotations (n, 3, 3) and positions (n, 3) of each layout of a pose's numbers (n, k)."""
    k = values.shape[1]
    if k == 16:
        M = values.reshape(-1, 4, 4)
        for word, T in (("rows", M), ("columns", M.transpose(0, 2, 1))):
            last = np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) < RIGID
            yield ("matrix-4x4", word), np.where(last[:, None, None], T[:, :3, :3], np.nan), T[:, :3, 3]
    elif k == 12:
        M = values.reshape(-1, 3, 4)
        yield ("matrix-3x4", "rows"), M[:, :, :3], M[:, :, 3]
        for word, R, t in (
            ("position-last", values[:, :9], values[:, 9:]),
            ("position-first", values[:, 3:], values[:, :3]),
        ):
            yield ("matrix-3x3", "rows", word), R.reshape(-1, 3, 3), t
            yield ("matrix-3x3", "columns", word), R.reshape(-1, 3, 3).transpose(0, 2, 1), t
    else:
        yield from _angles_or_quaternion(values[:, 3:], values[:, :3], "position-first")
        yield from _angles_or_quaternion(values[:, :-3], values[:, -3:], "position-last")


def _angles_or_quaternion(
    turns: FloatArray, positions: FloatArray, place: str
) -> Iterator[tuple[tuple[str, ...], FloatArray, FloatArray]]:
    good = _finite(turns)
    if turns.shape[1] == 4:
        good &= np.abs(np.linalg.norm(turns, axis=1) - 1.0) < UNIT_NORM
        for word, order in (("xyzw", [0, 1, 2, 3]), ("wxyz", [1, 2, 3, 0])):
            yield ("quaternion", word, place), _rotations(good, Rotation.from_quat, turns[:, order]), positions
        return
    for unit, scale in (("rad", 1.0), ("deg", np.pi / 180.0)):
        angles = scale * turns
        if unit == "rad" and np.nanmax(np.abs(turns), initial=0.0) > 2.0 * np.pi + RIGID:
            continue
        yield ("rotation-vector", unit, place), _rotations(good, Rotation.from_rotvec, angles), positions
        for name in (*_EULER, "RzRyRz", "RzRxRz"):
            axes = name.replace("R", "").upper()
            orders = {"": "XYZ", "angles-zyx": "ZYX"} if len(set(axes)) == 3 else {"": ""}
            for word, columns in orders.items():
                ordered = angles[:, [columns.index(axis) for axis in axes]] if columns else angles
                R = _rotations(good, partial(Rotation.from_euler, axes), ordered)
                yield tuple(one for one in (name, word, unit, place) if one), R, positions


def _finite(values: FloatArray) -> BoolArray:
    """Mask (n,) of the rows of values (n, ...) without NaN."""
    return np.asarray(np.isfinite(values).reshape(len(values), -1).all(axis=1))


def _rotations(good: BoolArray, make: Callable[[FloatArray], Rotation], values: FloatArray) -> FloatArray:
    found = np.full((len(values), 3, 3), np.nan)
    if good.any():
        found[good] = make(values[good]).as_matrix()
    return found


def _of_words(found: list[_Reading], words: Iterable[str]) -> list[_Reading]:
    """The readings that have all stated words. Raises PoseFileError (``format``)."""
    known = [{part.lower() for part in (*one.words, *one.names.split())} for one in found]
    kept = [one for one, parts in zip(found, known, strict=True) if parts.issuperset(words)]
    if not kept:
        raise PoseFileError(
            "format",
            f"no reading of the poses is {' '.join(words)!r}; words of those that the numbers allow are "
            f"{' '.join(sorted(set().union(*known)))}, {' '.join(METRES)}, inverted",
        )
    return kept


# -- poses and pictures ----------------------------------------------------------------------------------------


class _Match(NamedTuple):
    """Rows of poses, the index of the picture of each, and what was assumed. ``firm``: by names, numbers or counts."""

    poses: IntArray
    pictures: IntArray
    remark: str
    firm: bool


def numbers_of(names: Sequence[str]) -> list[int] | None:
    """The number in each name that is different in all of them; None if there is none."""
    parts = [re.findall(r"\d+", name) for name in names]
    for column in zip(*parts, strict=False) if parts else ():
        if len({int(one) for one in column}) == len(names):
            return [int(one) for one in column]
    return None


def _matches(table: Table, pictures: Sequence[str]) -> Iterator[_Match]:
    """Hypotheses of which pose belongs to which picture: first the one of names, numbers or equal counts."""
    n, p = len(table.labels), len(pictures)
    stems = {Path(name).stem: k for k, name in enumerate(pictures)}
    if not pictures:
        yield _match(range(n), range(n), "", True)
    elif all(Path(label).stem in stems for label in table.labels):
        yield _match([stems[Path(label).stem] for label in table.labels], range(p), "by the pictures' names", True)
    elif (own := _numbering(table)) is not None and (others := numbers_of(pictures)) is not None:
        offset, first = min(own) - min(others), 0
        inside = set(own) <= set(others) or set(others) <= set(own)
        text = "by their numbers"
        if n == p and sorted(own) == [number + offset for number in sorted(others)]:
            first, inside = offset, True
            text += f", poses from {min(own)} and pictures from {min(others)}" if offset else ""
        yield _match(own, [number + first for number in others], text, inside and first == offset)
        for shift in (-1, 1):
            moved = [number + first + shift for number in others]
            yield _match(own, moved, f"shifted by one ({shift:+d}) against their numbers", False)
    elif n == p:
        yield _match(range(n), range(n), "in their order", True)
        for shift in (-1, 1):
            yield _match(range(n), range(shift, n + shift), f"shifted by one ({shift:+d}) against their order", False)
    else:
        every = np.arange(max(n, p))
        for k in range(len(every)) if abs(n - p) == 1 else range(abs(n - p) + 1):
            fewer = np.delete(every, k).tolist() if abs(n - p) == 1 else (k + every[: min(n, p)]).tolist()
            own, others = (fewer, every.tolist()) if n < p else (every.tolist(), fewer)
            yield _match(own, others, "in their order", False)


def _match(own: Sequence[int], others: Sequence[int], how: str, firm: bool) -> _Match:
    """Poses and pictures of equal keys."""
    places = {key: k for k, key in enumerate(others)}
    pairs = np.array([(k, places[key]) for k, key in enumerate(own) if key in places], dtype=np.int64).reshape(-1, 2)
    left = [
        f"{name} without partner: {', '.join(map(str, keys))}"
        for name, keys in (("poses", sorted({*own} - {*others})), ("pictures", sorted({*others} - {*own})))
        if keys
    ]
    remark = "; ".join([f"poses and pictures are paired {how}", *left]) if how else ""
    return _Match(pairs[:, 0], pairs[:, 1], remark, firm)


def _numbering(table: Table) -> list[int] | None:
    """Numbers of the poses: in their names, or in a column that counts."""
    if all(table.labels):
        return numbers_of(table.labels)
    for name, values in table.fields.items():
        whole = values.shape[1] not in (3, 4, 6, 9, 12, 16) and not _ROLE.search(name.lower())
        if whole and _counts(values[:, 0]) and (values[:, 0] == np.round(values[:, 0])).all():
            return [int(value) for value in values[:, 0]]
    return None


# -- the board's motion ----------------------------------------------------------------------------------------


class _Fit(NamedTuple):
    """A hand-eye transform fitted to poses and board. ``turn`` [rad], ``shift``: median misfit of the rotations between
    views, and of the translations relative to their size; ``mean`` [rad]: of the rotations. ``scale``: of the poses'
    lengths to the board's [m]. ``on_hand``: whether the camera is on the hand, else the board. ``hand``, ``base``:
    distances of what is on the hand from it, and of the other from the base, in the poses' unit.
    """

    turn: float
    shift: float
    mean: float
    scale: float
    on_hand: bool
    hand: float
    base: float

    @property
    def misfit(self) -> float:
        return float(np.hypot(self.turn, self.shift))

    @property
    def inverted(self) -> bool:
        """Whether the levers are plausible only for poses of the base in the hand."""
        return self.hand > LEVERS * self.base

    def texts(self, metres: float, inverted: bool) -> Iterator[str]:
        """The fit in words; ``metres``: the poses' unit."""
        mount = "on the hand" if self.on_hand != inverted else "standing"
        yield (
            f"the camera is {mount}: motions of arm and board between views differ by {np.degrees(self.turn):.2g} deg "
            f"and {100.0 * self.shift:.2g} % of their length (medians)"
        )
        if inverted:
            yield (
                f"read as poses of the base in the hand: otherwise what is on the hand is {self.hand * metres:.2f} m "
                f"from it, and the other {self.base * metres:.2f} m from the base; --pose-format direct is the reverse"
            )
        if abs(np.log(self.scale * metres)) > WRONG_SIZE:
            yield f"the arm's lengths are about {self.scale * metres:.2g} of the board's: is the board's size right?"


def _pairs(views: int) -> tuple[IntArray, IntArray]:
    i, j = np.triu_indices(views, 1)
    some = np.unique(np.linspace(0, len(i) - 1, min(MOST_PAIRS, len(i))).round().astype(np.int64))
    return i[some], j[some]


def _angle_misfit(poses: FloatArray, board: FloatArray) -> float:
    """Median difference [rad] of the angles of rotation between views (k, 4, 4): no hand-eye transform changes them."""
    i, j = _pairs(len(poses))
    traces = [np.einsum("kij,kij->k", one[i, :3, :3], one[j, :3, :3]) for one in (poses, board)]
    arm, seen = (np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)) for trace in traces)
    return float(np.median(np.abs(arm - seen)))


def _hand_eye(poses: FloatArray, board: FloatArray) -> _Fit | None:
    """The better fit of both mounts to poses and board (k, 4, 4) of the same views; None where there is none."""
    i, j = _pairs(len(poses))
    arm, back = np.linalg.inv(poses[j]) @ poses[i], np.asarray(np.linalg.inv(board), dtype=np.float64)
    held = _fit(arm, board[j] @ back[i], poses, board, True), _fit(arm, back[j] @ board[i], poses, back, False)
    return min((one for one in held if one is not None), key=lambda one: one.misfit, default=None)


def _fit(A: FloatArray, B: FloatArray, poses: FloatArray, board: FloatArray, on_hand: bool) -> _Fit | None:
    """Least absolute deviations of ``A X = X B`` with a scale of B's lengths; ``board``: such that ``poses X board`` is
    constant.
    """
    a, b = (Rotation.from_matrix(one[:, :3, :3]).as_rotvec() for one in (A, B))
    sharp = (np.linalg.norm(a, axis=1) < NEARLY_HALF) & (np.linalg.norm(b, axis=1) < NEARLY_HALF)
    size = float(np.sqrt(3.0 * np.mean(A[:, :3, 3] ** 2)))
    if not sharp.any() or not size > 0.0:
        return None
    weights = sharp.astype(float)
    for _ in range(ROUNDS):
        U, _, V = np.linalg.svd(np.einsum("ki,kj,k->ij", a, b, weights))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
        turns = np.linalg.norm(a - b @ R.T, axis=1)
        weights = sharp / np.maximum(turns, 1e-9 + 0.1 * np.median(turns))
    left = np.concatenate([A[:, :3, :3] - np.eye(3), -(B[:, :3, 3] @ R.T)[:, :, None]], axis=2)
    weights = np.ones(len(A))
    for _ in range(ROUNDS):
        rows = left * weights[:, None, None]
        x = np.linalg.pinv(np.einsum("kij,kil->jl", rows, left)) @ -np.einsum("kij,ki->j", rows, A[:, :3, 3])
        rest = np.linalg.norm(left @ x + A[:, :3, 3], axis=1)
        weights = 1.0 / np.maximum(rest, 1e-9 * size + 0.1 * np.median(rest))
    if not x[3] > 0.0:
        return None
    other = np.einsum("kij,kj->ki", poses[:, :3, :3], x[:3] + x[3] * board[:, :3, 3] @ R.T) + poses[:, :3, 3]
    levers = float(np.linalg.norm(x[:3])), float(np.median(np.linalg.norm(other, axis=1)))
    mean, turn, shift = float(turns[sharp].mean()), float(np.median(turns[sharp])), float(np.median(rest)) / size
    return _Fit(turn, shift, mean, float(x[3]), on_hand, *levers)


# -- the decision ----------------------------------------------------------------------------------------------


class _Candidate(NamedTuple):
    reading: _Reading
    match: _Match
    fit: _Fit | None

    @property
    def misfit(self) -> float:
        return np.inf if self.fit is None else self.fit.misfit

    @property
    def mean(self) -> float:
        """Mean misfit of rotations, to which a single wrong pair contributes."""
        return np.inf if self.fit is None else self.fit.mean


def _candidates(found: list[_Reading], pictures: Sequence[str], board: FloatArray | None) -> list[list[_Candidate]]:
    """For each hypothesis of pairs the readings that may fit, the best first, and these by their best. Those whose
    angles between views differ from the board's more than others are left out.
    """
    hypotheses = zip(*(_matches(one.table, pictures) for one in found), strict=False)
    views = []
    for k, same in enumerate(hypotheses):
        for reading, match in zip(found, same, strict=True):
            poses, pair = reading.poses[match.poses], None
            if board is not None:
                both = _finite(poses) & _finite(board[match.pictures])
                pair = (poses[both], board[match.pictures][both]) if both.sum() >= LEAST_VIEWS else None
            views.append((k, reading, match, pair, 0.0 if pair is None else _angle_misfit(*pair)))
    most = RATIO * (min(angle for *_, angle in views) + LEAST_ANGLE)
    made: dict[int, list[_Candidate]] = {}
    for k, reading, match, pair, angle in views:
        if angle <= most:
            made.setdefault(k, []).append(_Candidate(reading, match, None if pair is None else _hand_eye(*pair)))
    by_match = [sorted(one, key=lambda one: one.misfit) for one in made.values()]
    return sorted(by_match, key=lambda one: one[0].mean)


def _decided(
    found: list[_Reading], pictures: Sequence[str], board: FloatArray | None
) -> tuple[_Reading, _Match, str, _Fit | None]:
    """The reading, its pictures, what decided it, and its fit. Raises PoseFileError (``count``, ``ambiguous``,
    ``no_fit``).
    """
    distinct: list[_Reading] = []
    for one in sorted(found, key=lambda one: (-one.hints, -one.good().sum())):
        if not any(_same(one, other) for other in distinct):
            distinct.append(one)
    hypotheses = _candidates(distinct, pictures, board)
    firm = next((one for one in hypotheses if one[0].match.firm), None)
    likely = hypotheses[0]
    if firm is not None and not RATIO * likely[0].mean < firm[0].mean:
        likely = firm
    elif likely[0].misfit > LARGEST_MISFIT or any(one[0].mean < RATIO * likely[0].mean for one in hypotheses[1:]):
        raise _miscounted(distinct[0].table, pictures)
    best = likely[0]
    if len(distinct) == 1:
        return best.reading, best.match, "the numbers alone", best.fit
    if best.fit is not None and best.misfit > LARGEST_MISFIT:
        raise PoseFileError(
            "no_fit",
            f"no reading of the poses explains the board's motion: '{best.reading}' is the best and off by "
            f"{np.degrees(best.fit.turn):.2g} deg and {100.0 * best.fit.shift:.2g} % of the lengths between views. Are "
            "poses and pictures of the same views, in the same order, and are these poses rather than joints?",
        )
    rivals = [one for one in likely if best.fit is None or one.misfit <= RATIO * best.misfit]
    hinted = max(one.reading.hints for one in rivals)
    rivals = [one for one in rivals if one.reading.hints == hinted]
    if len(rivals) > 1:
        raise _equal(rivals)
    (chosen,) = rivals
    if chosen.fit is None:
        return chosen.reading, chosen.match, "the names of the columns", None
    other = next((one for one in likely if one is not chosen), None)
    rival = "" if other is None else f" (next: {other.reading}, {other.misfit:.2g})"
    return chosen.reading, chosen.match, f"the board's motion, misfit {chosen.misfit:.2g}{rival}", chosen.fit


def _equal(rivals: list[_Candidate]) -> PoseFileError:
    first, second = (set(one.reading.words) for one in rivals[:2])
    words = [" ".join(sorted(one - other or one)) for one, other in ((first, second), (second, first))]
    basis = (
        "no board decides" if rivals[0].fit is None else f"misfits {rivals[0].misfit:.2g} and {rivals[1].misfit:.2g}"
    )
    return PoseFileError(
        "ambiguous",
        f"{len(rivals)} readings of the poses fit equally ({basis}), such as '{rivals[0].reading}' and "
        f"'{rivals[1].reading}'; state --pose-format {words[0]!r} or {words[1]!r}",
    )


def _same(one: _Reading, other: _Reading) -> bool:
    """Whether two readings agree wherever both have poses."""
    if one.poses.shape != other.poses.shape or not (both := one.good() & other.good()).any():
        return False
    scale = max(1.0, float(np.abs(one.poses[both]).max()))
    return bool(np.abs(one.poses[both] - other.poses[both]).max() < SAME * scale)


def _miscounted(table: Table, pictures: Sequence[str]) -> PoseFileError:
    first = next(_matches(table, pictures))
    return PoseFileError(
        "count",
        f"{len(table.labels)} poses and {len(pictures)} pictures; {first.remark}; equal counts, equal numbers, the "
        "pictures' names in the poses' file, or a board whose motion shows the partners are needed",
    )


def _unit(reading: _Reading, fit: _Fit | None, stated: Sequence[str]) -> tuple[str, str]:
    """Unit of the poses' lengths and what decided it. Raises PoseFileError (``ambiguous``)."""
    for unit in METRES.keys() & stated:
        return unit, "--pose-format"
    size = float(np.nanpercentile(np.linalg.norm(reading.poses[:, :3, 3], axis=1), 95))
    possible = ["m"] if size < SMALL else ["cm", "mm"] if size < LARGE else ["mm"]
    by_size = f"their size, {size:.3g}"
    if fit is not None:
        unit = min(possible, key=lambda one: abs(np.log(fit.scale * METRES[one])))
        return unit, by_size if len(possible) == 1 else f"{by_size}, and the board's"
    named = [unit for unit, pattern in _UNIT_NAMES.items() if re.search(pattern, reading.names.lower())]
    both = [unit for unit in named if unit in possible] if named else possible
    if len(both) == 1:
        return both[0], by_size if len(possible) == 1 else "the names of the columns"
    said = f", in {' or '.join(named)} by their names" if named else ""
    raise PoseFileError(
        "ambiguous",
        f"the poses' lengths are up to {size:.3g}, in {' or '.join(possible)} by their size{said}; state --pose-format "
        "m, cm or mm",
    )


_UNIT_NAMES = {"mm": r"mm\b|millim|_mm", "cm": r"\bcm\b|_cm|centim", "m": r"[\[(_ ]m[\])]?(?:\s|$)"}


# -- a folder of pictures and poses ------------------------------------------------------------------------------


PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
LEAST_PICTURES = 3
"""Files whose names differ only in digits from which they are a set."""


def picture_sets(folder: Path) -> dict[str, list[Path]]:
    """The pictures of each camera in a folder or its subfolders, by their numbers: the largest set of files whose names
    differ only in digits, and others as large.
    """
    sets = {key: paths for key, paths in _grouped(folder, PICTURES).items() if len(paths) >= LEAST_PICTURES}
    most = max(map(len, sets.values()), default=0)
    largest = [paths for paths in sets.values() if len(paths) == most]
    names = [Path(os.path.relpath(paths[0].parent, folder)) / re.sub(r"\d.*", "", paths[0].stem) for paths in largest]
    return {str(name).strip("/_-. ") or "camera": paths for name, paths in zip(names, largest, strict=True)}


def pose_paths(folder: Path, stated: Path | None = None) -> list[Path]:
    """The file, or files of one picture each, that hold poses: the stated one, or the only one in a folder.

    Raises PoseFileError (``no_poses``, ``ambiguous``, ``unreadable``).
    """
    if stated is not None and not stated.is_dir():
        return [stated]
    groups = list(_grouped(stated or folder, SUFFIXES).values())
    groups = [part for paths in groups for part in ([paths] if len(paths) >= LEAST_PICTURES else [[p] for p in paths])]
    found = [paths for paths in groups if _hold_poses(paths)]
    own = [paths for paths in found if paths == [folder / "poses.csv"]]
    if len(own or found) != 1:
        looked = ", ".join(_names(paths) for paths in found or groups) or "no file"
        kinds = f"{len(found)} may be the poses" if found else f"none holds poses ({', '.join(SUFFIXES)} are read)"
        raise PoseFileError("ambiguous" if found else "no_poses", f"{folder} has {looked}; {kinds}; give --poses FILE")
    return (own or found)[0]


def _hold_poses(paths: list[Path]) -> bool:
    try:
        return any(_readings(table) for table in read_tables(paths) if len(paths) > 1 or len(table.lines) > 1)
    except NumberFileError:
        return False


def _grouped(folder: Path, suffixes: Sequence[str]) -> dict[tuple[Path, str], list[Path]]:
    """Files of a folder and its subfolders by folder and name without digits, in the order of their numbers."""
    groups: dict[tuple[Path, str], list[Path]] = {}
    for path in sorted([*folder.glob("*"), *folder.glob("*/*")]):
        if path.suffix.lower() in suffixes and path.name != "board.json" and path.is_file():
            groups.setdefault((path.parent, re.sub(r"\d+", "", path.name.lower())), []).append(path)
    for key, paths in groups.items():
        numbers = numbers_of([path.stem for path in paths])
        groups[key] = [path for _, path in sorted(zip(numbers or range(len(paths)), paths, strict=True))]
    return groups


def board_poses(pixels: FloatArray, points: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Poses (f, 4, 4) of a plane board's ``points`` (m, 2) [m] in a camera with pictures of ``size`` [px], which is
    calibrated by them, from ``pixels`` (f, m, 2); NaN where fewer than four are seen.

    Raises PoseFileError (``no_fit``).
    """
    found = np.full((len(pixels), 4, 4), np.nan)
    seen = np.asarray(np.isfinite(pixels).all(axis=2))
    views = np.flatnonzero(seen.sum(axis=1) >= LEAST_VIEWS)
    if len(views) < LEAST_VIEWS:
        return found
    space = np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    if seen.sum(axis=1).max() < LEAST_OF_LENS:
        flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    camera = np.array([[max(size), 0.0, size[0] / 2.0], [0.0, max(size), size[1] / 2.0], [0.0, 0.0, 1.0]])
    shown = [np.flatnonzero(seen[k]) for k in views]
    images = [pixels[k, one].astype(np.float32) for k, one in zip(views, shown, strict=True)]
    try:
        _, _, _, turns, places = cv2.calibrateCamera(
            [space[one] for one in shown], images, size, camera, None, flags=flags
        )
    except cv2.error as error:
        raise PoseFileError(
            "no_fit", f"OpenCV calibrates no camera by the board in {len(views)} pictures: {error}"
        ) from error
    found[views] = np.eye(4)
    found[views, :3, :3] = Rotation.from_rotvec(np.reshape(turns, (-1, 3))).as_matrix()
    found[views, :3, 3] = np.reshape(places, (-1, 3))
    return found
