"""Conversion of the options of ``stereoservo goal`` to a goal message: target, adaptive gain, and streamed set-points
from JSON lines. Raises CommandError, MessageError.
"""

from __future__ import annotations

import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from stereoservo.cli.output import CommandError, marker_ids, pairs, read_file
from stereoservo.messages.decoding import decoding
from stereoservo.messages.goals import FeatureTarget, Goal, PointTarget, StreamedTarget
from stereoservo.messages.wire import MessageError, decode, encode

KINDS = {"points": "points", "displacement": "displacement", "incidence": "incidence"}
"""Options that take a target as a file, and its kind."""
SOURCES = ("triangulated", "predicted")
PLANNED_LAW = "trajectory"
"""Law whose plan can end in a chosen posture."""


class StreamLine(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One line of a stream: set-points, or points with the epoch of their model; ``stamp_s``: time at which they are
    valid.
    """

    stamp_s: float | None = None
    set_points: dict[str, dict[int, tuple[float, float]]] | None = None
    points: dict[int, tuple[float, float, float, float]] | None = None
    model_epoch: int | None = None


def target_tree(
    name: str,
    joints: list[str] | None,
    set_points: Path | None,
    files: dict[str, Path | None],
    relative_to: str | None,
    common: str | None,
    lines: str | None = None,
    planes: str | None = None,
) -> dict[str, Any]:
    """The target in wire format. Exactly one of a name, joints, set-points or a file of ``files`` must be given."""
    given = [bool(name), bool(joints), set_points is not None, *(path is not None for path in files.values())]
    if sum(given) != 1:
        raise CommandError(
            "usage",
            "one of NAME (a taught goal), --joint, --set-points, --images, --points, --displacement, --incidence, "
            "--follow or --file is needed",
        )
    if (relative_to or common or lines or planes) and not name:
        raise CommandError("usage", "--relative-to, --common, --lines and --planes go with NAME, a taught goal")
    if name:
        tree: dict[str, Any] = {"kind": "taught", "name": name}
        if relative_to is not None:
            tree["relative_to"] = relative_to
        if common is not None:
            tree["common"] = marker_ids(common, "--common")
        for key, text, least, most in (("lines", lines, 2, 2), ("planes", planes, 3, 64)):
            if text is not None:
                tree[key] = _id_groups(text, f"--{key}", least, most)
        return tree
    if joints:
        return {"kind": "joints", "positions": pairs(joints, "--joint")}
    if set_points is not None:
        return {"kind": "features", "set_points": _object(set_points)}
    kind, path = next((kind, path) for kind, path in files.items() if path is not None)
    if kind == "points" and str(path) in SOURCES:
        raise CommandError("usage", f"--points takes a file; {path} goes with --point-source")
    tree = _object(path)
    if tree.get("kind", KINDS[kind]) != KINDS[kind]:
        raise CommandError("file", f"{path}: kind is {tree['kind']!r}; {KINDS[kind]!r} goes with --{kind}")
    matrix = tree.get("matrix")
    if kind == "displacement" and isinstance(matrix, list) and all(isinstance(row, list) for row in matrix):
        tree["matrix"] = [number for row in matrix for number in row]
    return {**tree, "kind": KINDS[kind]}


def _id_groups(text: str, what: str, least: int, most: int) -> list[list[int]]:
    """Parse ``400-401,402-407`` as groups of ids. Raises CommandError."""
    try:
        groups = [[int(part) for part in group.split("-")] for group in text.split(",")]
    except ValueError:
        groups = []
    if not groups or any(not least <= len(group) <= most for group in groups):
        count, example = (
            (f"{least}", "400-401,402-407") if least == most else (f"{least} or more", "400-401-406,402-403-408")
        )
        raise CommandError("argument", f"{what} {text!r}: groups of {count} ids are valid, {example} say")
    return groups


def _object(path: Path) -> dict[str, Any]:
    data = read_file(path)
    with decoding(lambda cause: CommandError("file", f"{path}: is not JSON: {cause}")):
        found = msgspec.json.decode(data)
    if not isinstance(found, dict):
        raise CommandError("file", f"{path}: holds {type(found).__name__}; a JSON object is needed")
    return found


def adaptive(text: str) -> dict[str, float]:
    """Parse ``NEAR:FAR[:SLOPE]`` as an adaptive gain."""
    try:
        values = [float(part) for part in text.split(":")]
    except ValueError:
        values = []
    if len(values) not in (2, 3):
        raise CommandError("argument", f"--adaptive-gain {text!r}: NEAR:FAR or NEAR:FAR:SLOPE is valid, 4:0.8:30 say")
    return dict(zip(("near", "far", "slope"), values, strict=False))


def make_goal(target: dict[str, Any], **options: Any) -> Goal:
    """A goal with a new id; options that are None have the cell's defaults, those with a posture the planning law."""
    tree = {"id": str(uuid.uuid4()), "target": target, **options}
    given = {key: value for key, value in tree.items() if value is not None}
    if "posture" in given:
        given.setdefault("law", PLANNED_LAW)
    return decode(encode(given), Goal)  # NaN is refused, not dropped


def stream_lines(source: str) -> Iterator[tuple[float | None, StreamedTarget]]:
    """Set-points with their stamps from JSON lines of a file, or of stdin (``-``), as they arrive.

    Those of a file are paced by their stamps. Raises CommandError naming the line.
    """
    lines: Iterator[bytes]
    lines = iter(sys.stdin.buffer) if source == "-" else iter(read_file(Path(source)).splitlines())
    began, first = time.monotonic(), None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            found = decode(line, StreamLine)
        except MessageError as error:
            raise CommandError("stream", f"{source}: line {number}: {error}") from error
        target = _streamed(found, f"{source}: line {number}")
        if found.stamp_s is not None and source != "-":
            first = found.stamp_s if first is None else first
            time.sleep(max(0.0, found.stamp_s - first - (time.monotonic() - began)))
        yield found.stamp_s, target


def _streamed(line: StreamLine, where: str) -> StreamedTarget:
    if (line.set_points is None) == (line.points is None):
        given = "neither" if line.points is None else "both"
        raise CommandError("stream", f"{where}: {given} of set_points and points given; exactly one is valid")
    if line.set_points is not None:
        return FeatureTarget(line.set_points, line.model_epoch)
    if line.points is None or line.model_epoch is None:
        raise CommandError("stream", f"{where}: points are in the frame of a model; model_epoch is needed with them")
    return PointTarget(line.points, line.model_epoch)
