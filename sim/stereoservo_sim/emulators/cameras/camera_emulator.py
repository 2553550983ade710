"""All emulated cameras of a cell: their images and streams over time, and the fault commands that change them.

Sans I/O: the same in virtual and in real time. ``take`` and ``order`` may be called by two threads.
"""

from __future__ import annotations

import heapq
import re
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from stereoservo_sim.emulators.cameras.emulated_camera import EmulatedCamera, StreamPicture
from stereoservo_sim.emulators.fault_engine import (
    NEVER_NS,
    Answer,
    FaultCommand,
    FaultCommandError,
    FaultEngine,
    FaultLanguage,
    Undo,
    Verb,
    Word,
    choice_word,
    time_word,
)

EVENTS_KEPT = 10_000
RETRY_NS = 1_000_000
"""Retry period of a shutter that the arm's history does not reach yet."""


class CameraEvent(msgspec.Struct, frozen=True):
    """An event of a camera at ``t_ns``; ``kind``: ``order``, ``ended``, ``connected``, ``gone``."""

    t_ns: int
    kind: str
    camera: str = ""
    text: str = ""

    def place(self) -> dict[str, str]:
        """The camera as data."""
        return {"camera": self.camera}

    def where(self) -> str:
        """The camera as text."""
        return self.camera


class CameraEmulator:
    """Emulator of ``cameras``, by their streams. ``start_ns``: zero of the fault commands' times."""

    def __init__(self, cameras: Sequence[EmulatedCamera], start_ns: int) -> None:
        self.cameras = tuple(cameras)
        self.start_ns = start_ns
        self.stalled: set[str] = set()
        self.refused: set[str] = set()
        self.wanted: set[str] = {camera.stream for camera in cameras}
        """Streams with a client; no images are made for others."""
        self.on_close_connections: Callable[[str, bool], None] = lambda stream, within: None
        """Called to close a stream's connections, at once or within the next image."""
        self._camera_lock = threading.Lock()
        self._heap_lock = threading.Lock()
        self._streams = {camera.name: camera.stream for camera in cameras}
        self._waiting: list[tuple[int, int, str, StreamPicture]] = []
        self.faults = FaultEngine(
            LANGUAGE, self, start_ns, check=self._check_names, log=self._log_fault, guard=self._camera_lock
        )
        self._new_events: deque[CameraEvent] = deque(maxlen=EVENTS_KEPT)
        self._count = 0

    def open(self) -> None:
        """Load the renderers and start the shutters. Raises DriverError."""
        for camera in self.cameras:
            camera.open()

    def close(self) -> None:
        """Release."""
        for camera in self.cameras:
            camera.close()

    # -- images -----------------------------------------------------------------------------------------------------

    def take(self, now_ns: int) -> int:
        """Make every image that is due and requested; returns when to call again [ns]."""
        due_ns = NEVER_NS
        for camera in self.cameras:
            if self._streams[camera.name] not in self.wanted:
                continue
            if camera.due_ns() <= now_ns:
                with self._camera_lock:
                    picture = camera.expose()
                    stream = self._streams[camera.name]
                if picture is not None:
                    with self._heap_lock:
                        self._count += 1
                        heapq.heappush(self._waiting, (picture.t_send_ns, self._count, stream, picture))
            due_ns = min(due_ns, max(camera.due_ns(), now_ns + RETRY_NS))
        return due_ns

    def sending_ns(self) -> int:
        """Time at which the next image is to be sent, or the next fault command to be executed."""
        with self._heap_lock:
            picture_ns = self._waiting[0][0] if self._waiting else NEVER_NS
        return min(picture_ns, self.faults.due_ns())

    def sent(self, now_ns: int) -> list[tuple[str, StreamPicture]]:
        """Images due to be sent, oldest first, with their streams."""
        pictures = []
        with self._heap_lock:
            while self._waiting and self._waiting[0][0] <= now_ns:
                _, _, stream, picture = heapq.heappop(self._waiting)
                pictures.append((stream, picture))
        return pictures

    # -- orders -----------------------------------------------------------------------------------------------------

    def order(self, text: str, now_ns: int) -> str:
        """Execute the fault command ``text``, now or at its own time after the start; returns the reply.

        Raises FaultCommandError.
        """
        return self.faults.order(text, now_ns)

    def run_until(self, now_ns: int) -> None:
        """Execute the fault commands that are due, and undo those whose time has ended."""
        while self.faults.advance(now_ns):
            pass

    def _check_names(self, command: CameraCommand) -> None:
        for name in (command.camera, command.what if command.verb == "swap" else ""):
            if name:
                self.named(name)

    def _log_fault(self, t_ns: int, kind: str, command: CameraCommand, text: str) -> None:
        self.tell(t_ns, kind, command.camera, text)

    def take_events(self) -> list[CameraEvent]:
        """Events since the last call."""
        events = list(self._new_events)
        self._new_events.clear()
        return events

    def tell(self, t_ns: int, kind: str, camera: str, text: str = "") -> None:
        """Add an event."""
        self._new_events.append(CameraEvent(t_ns, kind, camera, text))

    def status(self) -> list[str]:
        """Status, one line a camera."""
        return [
            f"{camera.name} at {self._streams[camera.name]}: {camera.rate_hz:g} Hz, "
            f"skew {camera.view.phase_s * 1e3:g} ms, {camera.condition.words()}{self._stream_words(camera.stream)}"
            for camera in self.cameras
        ]

    def _stream_words(self, stream: str) -> str:
        marks = (("stalled", self.stalled), ("refused", self.refused))
        return "".join(f", {name}" for name, streams in marks if stream in streams)

    # -- effects of fault commands on streams -------------------------------------------------------------------------

    def named(self, name: str) -> tuple[EmulatedCamera, ...]:
        """The cameras of that name, or of ``all``. Raises FaultCommandError, which lists the cameras."""
        if name == ALL:
            return self.cameras
        found = tuple(camera for camera in self.cameras if camera.name == name)
        if not found:
            raise FaultCommandError(f"no camera {name!r}; cameras: {', '.join(c.name for c in self.cameras)}, {ALL}")
        return found

    def swap(self, first: EmulatedCamera, second: EmulatedCamera) -> None:
        """Exchange the images of two cameras' streams."""
        streams = self._streams
        streams[first.name], streams[second.name] = streams[second.name], streams[first.name]

    def unswap(self, camera: EmulatedCamera) -> None:
        """Undo the exchange of a camera's stream."""
        other = next(c for c in self.cameras if self._streams[c.name] == camera.stream)
        self.swap(camera, other)

    def close_connections(self, stream: str, *, within: bool = False) -> None:
        """Close the connections of a stream, at once or ``within`` the next image."""
        self.on_close_connections(stream, within)


# -- fault commands ------------------------------------------------------------------------------------------
# Fault commands of emulated cameras: the verbs, their arguments, and their effects.


ALL = "all"
_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"(-?\d+(?:\.\d*)?)(mm|cm|m)")
_ANGLE = re.compile(r"(-?\d+(?:\.\d*)?)deg")
_SIZE = re.compile(r"(\d{1,4})x(\d{1,4})")
LARGEST_SIZE = 4096


class CameraCommand(FaultCommand, frozen=True):
    """One fault command. ``camera``: its name, or ``all``. ``number``: depends on the verb: a count, a share, a gain,
    an angle [deg]; ``length_m``; ``size`` (width, height); ``what``: a second word.
    """

    camera: str = ""
    number: float = 0.0
    length_m: float = 0.0
    time_ns: int = 0
    size: tuple[int, int] = (0, 0)
    what: str = ""


# -- words ------------------------------------------------------------------------------------------------------------


def _number_word(what: str, low: float, high: float, default: float | None = None) -> Word:
    """Argument: a number, or a percentage, from ``low`` to ``high``."""

    def read(text: str) -> dict[str, Any]:
        try:
            value = float(text.removesuffix("%")) * (0.01 if text.endswith("%") else 1.0)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise FaultCommandError(f"{what} {text!r}; {low:g} to {high:g} is valid")
        return {"number": value}

    return Word(read, f"the {what} is missing") if default is None else Word(read, default={"number": default})


def _size(word: str) -> dict[str, Any]:
    match = _SIZE.fullmatch(word)
    if match is None or not all(1 <= int(part) <= LARGEST_SIZE for part in match.groups()):
        raise FaultCommandError(SIZE_IS)
    return {"size": (int(match[1]), int(match[2]))}


def _check_whole(command: CameraCommand) -> None:
    if command.number != int(command.number):
        raise FaultCommandError(f"count '{command.number:g}'; a whole number is valid")


def _check_two(command: CameraCommand) -> None:
    if command.camera == command.what or ALL in (command.camera, command.what):
        raise FaultCommandError("two different cameras are swapped")


def _bump_words(words: list[str]) -> dict[str, Any]:
    """Arguments: ``CAM back``, or an angle and a length in any order and the axis of the rotation."""
    if not words:
        raise FaultCommandError(str(CAMERA.missing))
    fields = CAMERA.read(words[0])
    rest = words[1:]
    if rest == ["back"]:
        return fields | {"what": "back"}
    fields["what"] = "y"
    if len(rest) >= 2 and rest[-2] == "about":
        if rest[-1] not in ("x", "y", "z"):
            raise FaultCommandError(f"axis {rest[-1]!r}; x, y or z is valid")
        fields["what"], rest = rest[-1], rest[:-2]
    for word in rest:
        angle, length = _ANGLE.fullmatch(word), _LENGTH.fullmatch(word)
        if angle is not None and abs(float(angle[1])) <= 180.0:
            fields["number"] = float(angle[1])
        elif length is not None and abs(float(length[1])) * _LENGTHS[length[2]] <= 10.0:
            fields["length_m"] = float(length[1]) * _LENGTHS[length[2]]
        else:
            raise FaultCommandError(f"{word!r}; an angle up to 180deg and a length up to 10m are valid, e.g. 5deg 3cm")
    if fields.get("number", 0.0) == 0.0 and fields.get("length_m", 0.0) == 0.0:
        raise FaultCommandError("the angle or the length is missing, e.g. 5deg 3cm")
    return fields


SIZE_IS = f"a size is WIDTHxHEIGHT, 1 to {LARGEST_SIZE} each, e.g. 320x240"
CAMERA = Word(lambda word: {"camera": word}, "the camera's name is missing")
SECOND_CAMERA = Word(lambda word: {"what": word}, "the camera's name is missing")
TIME = time_word("time_ns", "the camera's name or the time is missing")
COUNT = _number_word("count", 1, 1e6, 1.0)
ON_OR_OFF = choice_word({"on": {"what": "on"}, "off": {"what": "off"}})


# -- actions ----------------------------------------------------------------------------------------------------------

CameraAction = Callable[["CameraEmulator", EmulatedCamera, CameraCommand], Answer]


def _each(act: CameraAction) -> Callable[[CameraEmulator, CameraCommand], Answer]:
    """Action on every camera that the command names, with its undo."""

    def act_on_all(emulator: CameraEmulator, command: CameraCommand) -> Answer:
        answers, undos = [], []
        for camera in emulator.named(command.camera):
            done = act(emulator, camera, command)
            answer = done if isinstance(done, str) else done[0]
            answers.append(f"{camera.name}: {answer}")
            if not isinstance(done, str):
                undos.append(done[1])

        def undo() -> None:
            for undo_one in undos:
                undo_one()

        return "\n".join(answers), undo

    return act_on_all


def _set(camera: EmulatedCamera, answer: str, **marks: object) -> tuple[str, Undo]:
    """Action that sets fields of the camera's condition; the undo restores them."""
    before = {name: getattr(camera.condition, name) for name in marks}

    def undo() -> None:
        for name, value in before.items():
            setattr(camera.condition, name, value)

    for name, value in marks.items():
        setattr(camera.condition, name, value)
    return answer, undo


def _setter(answer: str, **marks: object) -> Callable[[CameraEmulator, CameraCommand], Answer]:
    """Factory of actions that set fixed fields of the condition."""
    return _each(lambda emulator, camera, command: _set(camera, answer, **marks))


def _by_command(
    answer: Callable[[CameraCommand], str], **marks: Callable[[CameraCommand], object]
) -> Callable[[CameraEmulator, CameraCommand], Answer]:
    """Factory of actions that set fields of the condition to values of the command."""
    return _each(
        lambda emulator, camera, command: _set(
            camera, answer(command), **{name: value(command) for name, value in marks.items()}
        )
    )


_latency = _by_command(lambda c: f"latency {c.time_ns * 1e-6:g} ms", latency_ns=lambda c: c.time_ns)
_jitter = _by_command(lambda c: f"jitter {c.time_ns * 1e-6:g} ms", jitter_ns=lambda c: c.time_ns)
_exposure = _by_command(lambda c: f"exposure {c.number:g}", gain=lambda c: c.number)
_lamp = _by_command(lambda c: f"lamp {c.what}", lamp=lambda c: c.what == "on")
_resize = _by_command(lambda c: f"{c.size[0]}x{c.size[1]}", size=lambda c: c.size)
_truncate = _by_command(lambda c: f"{c.number:g} JPEGs end in the middle", truncate=lambda c: int(c.number))
_corrupt = _by_command(lambda c: f"{c.number:g} JPEGs spoilt", corrupt=lambda c: int(c.number))


@_each
def _stall(emulator: CameraEmulator, camera: EmulatedCamera, command: CameraCommand) -> Answer:
    emulator.stalled.add(camera.stream)
    return "stalls", lambda: emulator.stalled.discard(camera.stream)


@_each
def _disconnect(emulator: CameraEmulator, camera: EmulatedCamera, command: CameraCommand) -> Answer:
    emulator.close_connections(camera.stream)
    return "connections closed"


@_each
def _cut(emulator: CameraEmulator, camera: EmulatedCamera, command: CameraCommand) -> Answer:
    emulator.close_connections(camera.stream, within=True)
    return "connections end in the middle of the next picture"


@_each
def _refuse(emulator: CameraEmulator, camera: EmulatedCamera, command: CameraCommand) -> Answer:
    emulator.refused.add(camera.stream)
    emulator.close_connections(camera.stream)
    return "connections refused", lambda: emulator.refused.discard(camera.stream)


@_each
def _skew(emulator: CameraEmulator, camera: EmulatedCamera, command: CameraCommand) -> Answer:
    before = camera.view.phase_s
    camera.view.change(phase_s=command.time_ns * 1e-9)
    return f"skew {command.time_ns * 1e-6:g} ms", lambda: camera.view.change(phase_s=before)


@_each
def _loss(emulator: CameraEmulator, camera: EmulatedCamera, command: CameraCommand) -> Answer:
    before = camera.view.drop_rate
    camera.view.change(drop_rate=command.number)
    return f"loses {command.number:.0%} of its pictures", lambda: camera.view.change(drop_rate=before)


def _swap(emulator: CameraEmulator, command: CameraCommand) -> Answer:
    first, second = emulator.named(command.camera)[0], emulator.named(command.what)[0]
    emulator.swap(first, second)
    return f"{first.name} and {second.name}: swapped", lambda: emulator.swap(first, second)


@_each
def _bump(emulator: CameraEmulator, camera: EmulatedCamera, command: CameraCommand) -> Answer:
    if command.what == "back":
        camera.put_back()
        return "where it stood at first"
    try:
        camera.bump(command.number, command.length_m, "xyz".index(command.what))
    except ValueError as error:
        raise FaultCommandError(str(error)) from error
    return f"turned by {command.number:g} deg about {command.what}, shifted by {command.length_m * 1e3:g} mm"


@_each
def _clear(emulator: CameraEmulator, camera: EmulatedCamera, command: CameraCommand) -> Answer:
    camera.clear()
    for marks in (emulator.stalled, emulator.refused):
        marks.discard(camera.stream)
    emulator.unswap(camera)
    return "as the cell file has it"


LANGUAGE = FaultLanguage(
    CameraCommand,
    {
        "freeze": Verb(
            "freeze CAM", "the same picture comes again and again, with new numbers and stamps",
            _setter("frozen", frozen=True), (CAMERA,), lasting=True,
        ),
        "drop": Verb(
            "drop CAM", "its pictures are lost; the connection stands",
            _setter("its pictures are lost", gone=True), (CAMERA,), lasting=True,
        ),
        "stall": Verb(
            "stall CAM", "the stream stops in the middle of a picture; the connection stands", _stall, (CAMERA,),
            lasting=True,
        ),
        "disconnect": Verb("disconnect CAM", "its connections are closed; they may come again", _disconnect, (CAMERA,)),
        "cut": Verb("cut CAM", "the same, in the middle of a picture", _cut, (CAMERA,)),
        "refuse": Verb(
            "refuse CAM", "its connections are closed and new ones turned away (503)", _refuse, (CAMERA,), lasting=True
        ),
        "latency": Verb(
            "latency CAM TIME", "from shutter to sending, e.g. `latency left 80ms`", _latency, (CAMERA, TIME),
            lasting=True,
        ),
        "jitter": Verb("jitter CAM TIME", "sent up to so much sooner or later", _jitter, (CAMERA, TIME), lasting=True),
        "skew": Verb(
            "skew CAM TIME", "its shutters open so much after those of a camera without skew", _skew, (CAMERA, TIME),
            lasting=True,
        ),
        "loss": Verb(
            "loss CAM SHARE", "chance that a picture is lost, e.g. `loss left 10%`", _loss,
            (CAMERA, _number_word("share", 0.0, 1.0)), lasting=True,
        ),
        "exposure": Verb(
            "exposure CAM FACTOR", "so many times as long, e.g. `exposure left 0.5`", _exposure,
            (CAMERA, _number_word("factor", 0.0, 100.0)), lasting=True,
        ),
        "lamp": Verb(
            "lamp on|off", "a lamp beside the upper left corners of all pictures", _lamp, (ON_OR_OFF,),
            fixed={"camera": ALL}, lasting=True,
        ),
        "black": Verb("black CAM", "the lens cap is on", _setter("black", look="black"), (CAMERA,), lasting=True),
        "white": Verb("white CAM", "dazzled", _setter("white", look="white"), (CAMERA,), lasting=True),
        "flip": Verb("flip CAM", "mounted upside down", _setter("flip", look="flip"), (CAMERA,), lasting=True),
        "mirror": Verb("mirror CAM", "left for right", _setter("mirror", look="mirror"), (CAMERA,), lasting=True),
        "size": Verb(
            "size CAM WIDTHxHEIGHT", "pictures of another size, e.g. `size left 320x240`", _resize,
            (CAMERA, Word(_size, SIZE_IS)), lasting=True,
        ),
        "swap": Verb(
            "swap CAM CAM", "their cables are exchanged", _swap, (CAMERA, SECOND_CAMERA), check=_check_two, lasting=True
        ),
        "truncate": Verb(
            "truncate CAM [COUNT]", "its next JPEGs end in the middle", _truncate, (CAMERA, COUNT), check=_check_whole
        ),
        "corrupt": Verb(
            "corrupt CAM [COUNT]", "bytes of its next JPEGs are flipped", _corrupt, (CAMERA, COUNT), check=_check_whole
        ),
        "bump": Verb(
            "bump CAM 5deg 3cm [about x|y|z]", "turned about its own axis (y), shifted along its x; `bump CAM back`",
            _bump, parse=_bump_words,
        ),
        "clear": Verb("clear CAM", "takes back everything but `bump`", _clear, (CAMERA,)),
    },
    devices="cameras",
    example="freeze left",
    note="; CAM may be all",
)  # fmt: skip
"""The console language of ``emulate cameras``."""
