"""Interview of `stereoservo setup`: collects the hardware found on this computer and the facts only a person has, and
writes the cell file from both.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any

from stereoservo.cli.doctor.command import line_of
from stereoservo.cli.init import cell_text, toml_lines
from stereoservo.cli.output import CommandError, note
from stereoservo.cli.setup.dialogue import Dialogue
from stereoservo.messages.addresses import Address
from stereoservo.messages.cell_file import CameraSection, load_cell_file
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo.ports.discovery import (
    BusScan,
    CameraFinder,
    DriveFinder,
    FoundBus,
    FoundCamera,
    FoundDrive,
    JointChoice,
)

JOINT_DRIVER, CAMERA_DRIVER, DETECTOR = "canopen", "video", "dots"
COUNTS = 65536.0
SPEED_DEG = 20.0
AROUND_DEG = 40.0
"""Proposed range to both sides of the joint's position, if a drive has no limits."""
MARGIN = 5.0
"""[degrees or mm] Least distance of every limit from the arm's position, where it starts its trial motions."""
NAMES = ("left", "right")
_NEXT_CAMERA = re.compile(r"[\s,]+(?=[A-Za-z][A-Za-z0-9+.-]*://|/dev/|[0-9]+(?:[\s,]|$))")


def interview(file: Path, dialogue: Dialogue, extra: dict[str, Any]) -> None:
    """Find cameras and drives, ask for the rest, write the cell file and its plates.

    ``extra``: further options of the joint driver. Raises CommandError, DriverError, PluginError.
    """
    _plates(file, dialogue)
    cameras = _cameras(dialogue)
    finder, scan = _drives(dialogue, extra)
    joints = _joints(dialogue, scan)
    options = {**finder.options_of(scan, joints), **extra}
    described = finder(options, _context(file)).describe()
    base = [joint_position(joint) for joint in joints]
    text = cell_text(
        file.stem, JOINT_DRIVER, "\n".join(toml_lines(options, "joints.options")), described, cameras, base
    )
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CommandError("file", f"{file}: {error.strerror}") from error
    load_cell_file(file)
    dialogue.say(f"wrote {file}: every choice stands there with a comment, and may be changed there")


def _context(file: Path) -> DriverContext:
    return DriverContext(MonotonicClock(), file.stem, Path(os.devnull), file.absolute().parent)


# -- cameras -------------------------------------------------------------------------------------------------------


def _cameras(dialogue: Dialogue) -> list[CameraSection]:
    dialogue.heading("Cameras")
    finder = plugins.load(plugins.CAMERA_DRIVERS, CAMERA_DRIVER)
    assert isinstance(finder, CameraFinder)
    with dialogue.doing("looking for cameras"):
        found = finder.find_cameras()
    for k, camera in enumerate(found):
        modes = ", ".join(f"{w}x{h} at {rate:g} Hz" for w, h, rate in camera.modes[:3])
        dialogue.say(f"   {k}: {camera.name}, {Address(str(camera.options['source']))}; {modes or 'modes unknown'}")
    if not found:
        dialogue.say(
            "   no camera is at this computer's ports; network cameras have an address (http://, rtsp://, genicam://)"
        )
    default = " ".join(str(k) for k in range(2)) if len(found) >= 2 else None
    chosen = dialogue.ask(
        "cameras",
        "Which two cameras see the arm, the left one first, as seen from behind them: numbers from above, or addresses",
        default,
        lambda text: chosen_cameras(text, found),
        lambda text: " ".join(map(Address, _camera_words(text))),
    )
    names = NAMES if len(chosen) == len(NAMES) else tuple(f"camera{k + 1}" for k in range(len(chosen)))
    sections = []
    for name, camera in zip(names, chosen, strict=True):
        options = dict(camera.options)
        if camera.modes:
            options |= dict(zip(("width", "height", "rate_hz"), camera.modes[0], strict=True))
        source = Address(str(camera.options["source"]))
        with dialogue.doing(f"opening {source}"):
            try:
                width, height, rate = finder.probe_camera(options)
            except DriverError as error:
                raise CommandError("camera", f"camera {name!r}: {error}") from error
        dialogue.say(f"   {name}: {source} gives pictures of {width}x{height} at {rate:g} Hz")
        options |= {"width": width, "height": height, "rate_hz": rate}
        sections.append(CameraSection(name, CAMERA_DRIVER, DETECTOR, options=options))
    return sections


def chosen_cameras(text: str, found: Sequence[FoundCamera]) -> list[FoundCamera]:
    """Parse numbers of found cameras and addresses, by blanks or commas. Raises ValueError."""
    chosen = []
    for word in _camera_words(text):
        if word.isdecimal() and int(word) < len(found):
            chosen.append(found[int(word)])
        elif "://" in word or word.startswith("/dev/"):
            chosen.append(FoundCamera(Address(word), {"source": word}))
        else:
            known = f"0 to {len(found) - 1}, " if found else ""
            raise ValueError(f"{Address(word)!r}; valid: {known}an address with ://, a device /dev/video0")
    if len(chosen) < 2:
        raise ValueError(f"{len(chosen)} camera; a cell needs two: one alone tells nothing of depth")
    if len({str(camera.options["source"]) for camera in chosen}) < len(chosen):
        raise ValueError("one camera is given twice; each must be another")
    return chosen


def _camera_words(text: str) -> list[str]:
    """Numbers and addresses of an answer; blanks and commas in a password do not separate."""
    return [word for word in _NEXT_CAMERA.split(text.strip(" \t,")) if word]


# -- drives --------------------------------------------------------------------------------------------------------


def _drives(dialogue: Dialogue, extra: dict[str, Any]) -> tuple[Any, BusScan]:
    dialogue.heading("Drives")
    finder = plugins.load(plugins.JOINT_DRIVERS, JOINT_DRIVER)
    assert isinstance(finder, DriveFinder)
    with dialogue.doing("looking for CAN adapters and serial ports"):
        found = finder.find_buses()
    for k, bus in enumerate(found):
        dialogue.say(f"   {k}: {bus.name}")
    if not found:
        dialogue.say("   no CAN adapter is at this computer; one on a network is named INTERFACE:CHANNEL")
    bus = dialogue.ask(
        "bus",
        "Which adapter are the drives behind: a number from above, or INTERFACE:CHANNEL of python-can",
        "0" if found else None,
        lambda text: chosen_bus(text, found),
    )
    with dialogue.doing("asking every node id, at one bit rate after the other"):
        scan = finder.scan_bus({**bus.options, **extra})
    for drive in scan.drives:
        dialogue.say(f"   {drive.name}")
    for finding in scan.findings:
        dialogue.say(line_of(finding))
    failed = [finding for finding in scan.findings if finding.ok is False]
    if failed or not scan.drives:
        words = "; ".join(f"{finding.name}: {finding.message}" for finding in failed)
        raise CommandError("drives", words or "no drive answers on this bus")
    return finder, scan


def chosen_bus(text: str, found: Sequence[FoundBus]) -> FoundBus:
    """Parse the number of a found bus, or ``INTERFACE:CHANNEL``. Raises ValueError."""
    if text.isdecimal() and int(text) < len(found):
        return found[int(text)]
    interface, separator, channel = text.partition(":")
    if separator and interface and channel:
        return FoundBus(text, {"interface": interface, "channel": channel})
    known = f"0 to {len(found) - 1}, or " if found else ""
    raise ValueError(f"{known}INTERFACE:CHANNEL, such as socketcan:can0 or stereoservo_slcan:/dev/ttyACM0")


def _joints(dialogue: Dialogue, scan: BusScan) -> list[JointChoice]:
    drives = {drive.address: drive for drive in scan.drives}
    order = dialogue.ask(
        "order",
        "Node ids of the joints, base first, grippers left out; with a p behind that of a slide (prismatic joint)",
        " ".join(str(address) for address in sorted(drives)),
        lambda text: chosen_order(text, drives),
    )
    left_out = sorted(set(drives) - {drive.address for drive, _ in order})
    if left_out:
        dialogue.say(
            f"   no joints: nodes {', '.join(map(str, left_out))}; a gripper on a drive of its own is a section "
            "[[joints.options.gripper]] of the cell file, to be added once it is written"
        )
    n = len(order)
    told = [drive.options.get("counts_per_rev") for drive, _ in order]
    counts = dialogue.ask(
        "counts_per_rev",
        "Encoder counts per motor turn as the drives tell positions (lines x 4, or 2^bits), one for all or each",
        " ".join(f"{value or COUNTS:g}" if (value or COUNTS) < 1e6 else repr(value) for value in told),
        lambda text: numbers(text, n, positive=True),
    )
    gears = dialogue.ask(
        "gear_ratio",
        "Motor turns per joint turn (per metre of a slide), one for all or each",
        None,
        lambda text: numbers(text, n, positive=True),
    )
    units = dialogue.ask(
        "velocity_units",
        "Velocity unit of the drives (0x60FF) at one motor turn a second: counts, 60 for rpm, 60000 for rpm/1000",
        "counts",
        lambda text: velocity_units(text, n),
    )
    joints = [
        JointChoice(f"j{k + 1}", drive, "prismatic" if slide else "revolute", counts[k], gears[k], units[k], 0, 0, 1)
        for k, (drive, slide) in enumerate(order)
    ]
    ranges = dialogue.ask(
        "limits",
        "Range of each joint, LOW:HIGH in degrees (slides: mm), counted from its encoder's zero; one for all or each",
        " ".join(_range_text(joint) for joint in joints),
        lambda text: chosen_ranges(text, joints),
    )
    speeds = dialogue.ask(
        "speed",
        "Largest speed in degrees/s (slides: mm/s), one for all or each; begin slowly",
        f"{SPEED_DEG:g}",
        lambda text: numbers(text, n, positive=True),
    )
    return [
        JointChoice(
            j.name, j.drive, j.kind, j.counts_per_rev, j.gear_ratio, j.velocity_units_per_rev_s,
            round(low, 5), round(high, 5), round(speed * unit(j), 5),
        )
        for j, (low, high), speed in zip(joints, ranges, speeds, strict=True)
    ]  # fmt: skip


def chosen_order(text: str, drives: dict[int, FoundDrive]) -> list[tuple[FoundDrive, bool]]:
    """Parse node ids, base first, and which of them are prismatic. Raises ValueError."""
    order = []
    for word in text.replace(",", " ").split():
        number = word.removesuffix("p")
        if not number.isdecimal() or int(number) not in drives:
            raise ValueError(f"{word!r}; nodes that answer: {', '.join(map(str, sorted(drives)))}")
        order.append((drives[int(number)], word.endswith("p")))
    if not order or len({drive.address for drive, _ in order}) < len(order):
        raise ValueError("each node once, at least one")
    return order


def numbers(text: str, count: int, *, positive: bool = False) -> list[float]:
    """Parse one number for all, or ``count`` numbers by spaces. Raises ValueError."""
    words = text.replace(",", " ").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) not in (1, count) or not all(math.isfinite(value) for value in values):
        raise ValueError(f"one number, or {count} by spaces")
    if positive and min(values) <= 0.0:
        raise ValueError("numbers above zero")
    return values * count if len(values) == 1 else values


def velocity_units(text: str, count: int) -> list[float | None]:
    """Parse ``counts`` or numbers, one for all or one for each. Raises ValueError."""
    words = text.replace(",", " ").split()
    if len(words) not in (1, count):
        raise ValueError(f"one, or {count} by spaces: counts, or a number")
    units = [None if word == "counts" else numbers(word, 1, positive=True)[0] for word in words]
    return units * count if len(units) == 1 else units


def unit(joint: JointChoice) -> float:
    """A person's unit of a joint, degree or millimetre, in [rad or m]."""
    return math.radians(1.0) if joint.kind == "revolute" else 1e-3


def joint_position(joint: JointChoice, counts: int | None = None) -> float:
    """Position [rad or m] of a joint at ``counts`` of its drive, or at the counts when it was found."""
    at = joint.drive.position or 0 if counts is None else counts
    turns = at / (joint.counts_per_rev * joint.gear_ratio)
    return turns * 2.0 * math.pi if joint.kind == "revolute" else turns


def _range_text(joint: JointChoice) -> str:
    low, high = proposed_range(joint)
    return f"{low / unit(joint):.1f}:{high / unit(joint):.1f}"


def proposed_range(joint: JointChoice) -> tuple[float, float]:
    """The drive's own limits [rad or m]; if it has none, a range to both sides of the joint's position."""
    limits = joint.drive.limits
    if limits is not None:
        low, high = (joint_position(joint, counts) for counts in limits)
        return low, high
    here, way = joint_position(joint), AROUND_DEG * unit(joint)
    return here - way, here + way


def chosen_ranges(text: str, joints: Sequence[JointChoice]) -> list[tuple[float, float]]:
    """Parse ranges LOW:HIGH, within the drives' own limits. Raises ValueError."""
    words = text.replace(",", " ").split()
    if len(words) not in (1, len(joints)):
        raise ValueError(f"one LOW:HIGH, or {len(joints)} by spaces")
    ranges = []
    for joint, word in zip(joints, words * (len(joints) if len(words) == 1 else 1), strict=True):
        ends = word.split(":")
        if len(ends) != 2:
            raise ValueError(f"{joint.name}: {word!r}; LOW:HIGH is valid")
        low, high = (value * unit(joint) for value in numbers(" ".join(ends), 2))
        if low >= high:
            raise ValueError(f"{joint.name}: {word!r}; LOW must be below HIGH")
        own = proposed_range(joint)
        step = 0.1 * unit(joint)
        if joint.drive.limits is not None and (low < own[0] - step or high > own[1] + step):
            raise ValueError(
                f"{joint.name}: {word!r} reaches beyond the drive's own limits (0x607D), {_range_text(joint)}"
            )
        here = joint_position(joint)
        if not low + MARGIN * unit(joint) <= here <= high - MARGIN * unit(joint):
            raise ValueError(
                f"{joint.name}: {word!r}; it stands at {here / unit(joint):.1f} now, which must be {MARGIN:g} inside"
            )
        ranges.append((low, high))
    return ranges


# -- plates --------------------------------------------------------------------------------------------------------


def _plates(file: Path, dialogue: Dialogue) -> None:
    """Write the marker plates beside the cell file, and wait until the person has mounted them on the arm."""
    dialogue.heading("Markers")
    plate = file.with_name(f"{file.stem}-plate.pdf")
    printing: Callable[..., None] = plugins.load(plugins.COMMANDS, "print-plate")
    with suppress(SystemExit), redirect_stdout(StringIO()) as told:
        printing(
            plate, faces=None, dot_mm=None, spacing=None, polarity="light", tags=None, tag_mm=50.0, page="a4",
            force=True, as_json=False,
        )  # fmt: skip
    if not plate.exists():
        note(told.getvalue())
        raise CommandError("file", f"{plate} could not be written")
    dialogue.say(
        f"   {plate}: print it at 100 %, measure the bar, fold it, glue it to something stiff, fix that to the hand.\n"
        "   Bring the arm, by hand or by the drives' own tool, to where both cameras see the plate near the middle."
    )
    if not dialogue.confirm("plate", "Is the plate on the hand, and where both cameras see it?", True):
        raise CommandError("plate", "first the plate; then run the same command again")
