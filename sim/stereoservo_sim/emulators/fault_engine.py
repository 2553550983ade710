"""Engine of fault commands for all emulators: parsing, scheduling, undo and logging, from one table of verbs.

An emulator declares its verbs once (:class:`Verb`: words, units, action, whether ``for TIME`` may follow) and hands the
table to a :class:`FaultEngine`. A command is ``VERB WORDS [for TIME] [@ TIME]``; times count from the emulator's start.
Sans I/O: the engine reads no clock, so it runs the same in virtual and in real time.
"""

from __future__ import annotations

import heapq
import re
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import msgspec

NEVER_NS = 2**62
LONGEST_S = 1_000_000
_TIME_UNITS = {"us": 1e3, "ms": 1e6, "s": 1e9}
_TIME = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(us|ms|s)")


class EmulationError(Exception):
    """A cell's hardware cannot be emulated as requested; the text lists what is valid."""


class FaultCommandError(ValueError):
    """A fault command cannot be parsed or executed; the text lists what is valid."""


class _VerbCommand(msgspec.Struct, frozen=True):
    verb: str


class FaultCommand(_VerbCommand, frozen=True, kw_only=True):
    """A parsed command; each emulator adds the fields of its arguments.

    ``at_ns``: time after the emulator's start; None: at once. ``for_ns``: it is undone after that time; 0: never.
    """

    at_ns: int | None = None
    for_ns: int = 0


Command = TypeVar("Command", bound=FaultCommand)
Undo = Callable[[], None]
Answer = str | tuple[str, Undo]
"""Reply of an action, with its undo if there is one."""


class Word:
    """One argument of a command: its parser, and its default.

    ``read`` returns the command's fields from the word; raises FaultCommandError. ``missing``: the error's text; None:
    the word is optional and the fields are ``default``.
    """

    def __init__(
        self,
        read: Callable[[str], dict[str, Any]],
        missing: str | None = None,
        default: Mapping[str, Any] | None = None,
    ) -> None:
        self.read = read
        self.missing = missing
        self.default = dict(default or {})


@dataclass(frozen=True)
class Verb:
    """A verb of an emulator's fault commands.

    ``act(emulator, command)`` executes it. ``lasting``: ``for TIME`` may follow; its ``act`` then returns an undo.
    ``fixed``: fields that no word sets. ``prepare`` rewrites the words before they are read; ``parse``, if given,
    replaces ``words``. ``check`` raises FaultCommandError for words that do not fit each other. ``logged``: whether it
    is logged.
    """

    usage: str
    meaning: str
    act: Callable[[Any, Any], Answer]
    words: tuple[Word, ...] = ()
    lasting: bool = False
    fixed: Mapping[str, Any] = field(default_factory=dict)
    prepare: Callable[[list[str]], list[str]] | None = None
    parse: Callable[[list[str]], dict[str, Any]] | None = None
    check: Callable[[Any], None] | None = None
    logged: bool = True

    def fields(self, words: list[str]) -> dict[str, Any]:
        """Parse the command's fields from its words. Raises FaultCommandError."""
        words = words if self.prepare is None else self.prepare(words)
        if self.parse is not None:
            return self.parse(words)
        at_most(words, len(self.words))
        fields = dict(self.fixed)
        for k, word in enumerate(self.words):
            if k < len(words):
                fields |= word.read(words[k])
            elif word.missing is not None:
                raise FaultCommandError(word.missing)
            else:
                fields |= word.default
        return fields


def _text_verb(name: str, meaning: str, lines: Callable[[Any], list[str]]) -> Verb:
    """A verb that answers with lines of text, and changes nothing."""
    return Verb(name, meaning, lambda emulator, command: "\n".join(lines(emulator)), logged=False)


class FaultLanguage(Generic[Command]):
    """The verbs of an emulator, with ``status`` of its ``devices`` and ``help``, and the type of its commands.
    ``example`` (a command that may last) and ``note`` appear in the help.
    """

    def __init__(
        self, command: type[Command], verbs: Mapping[str, Verb], *, devices: str, example: str, note: str = ""
    ) -> None:
        self._command = command
        self.verbs = {
            **verbs,
            "status": _text_verb("status", f"the state of all {devices}", lambda emulator: emulator.status()),
            "help": _text_verb("help", "this list", lambda emulator: self.help_lines()),
        }
        self._example = example
        self._note = note

    @property
    def lasting(self) -> tuple[str, ...]:
        """Verbs that accept ``for TIME``."""
        return tuple(name for name, verb in self.verbs.items() if verb.lasting)

    def parse(self, text: str) -> Command:
        """Parse a command, e.g. ``freeze left for 2s @ 1.5s``. Raises FaultCommandError."""
        body, at, when = text.partition("@")
        words = body.split()
        if not words:
            raise FaultCommandError(f"an empty order; orders: {', '.join(self.verbs)}")
        name = words[0].lower()
        if name not in self.verbs:
            raise FaultCommandError(f"no order {words[0]!r}; orders: {', '.join(self.verbs)} (`help` explains them)")
        verb = self.verbs[name]
        try:
            at_ns = duration_ns(when.strip()) if at else None
            rest, for_ns = self._split_lasting(verb, words[1:])
            command = self._command(verb=name, **verb.fields(rest), at_ns=at_ns, for_ns=for_ns)
            if verb.check is not None:
                verb.check(command)
        except FaultCommandError as error:
            raise FaultCommandError(f"{text.strip()!r}: {error}; usage: {verb.usage}") from None
        return command

    def help_lines(self) -> list[str]:
        """Help text: one line a verb, then the common suffixes."""
        rows = [(verb.usage, verb.meaning) for verb in self.verbs.values()]
        width = max(len(usage) for usage, _ in rows)
        rows += [
            ("ORDER for TIME", f"taken back after that time, e.g. `{self._example} for 2s`{self._note}"),
            ("ORDER @ TIME", f"at that time after the start, e.g. `{self._example} @ 2.5s`"),
        ]
        return [f"{usage:<{width}}  {meaning}" for usage, meaning in rows]

    def _split_lasting(self, verb: Verb, words: list[str]) -> tuple[list[str], int]:
        """The words before ``for TIME``, and that time [ns], 0 without one."""
        if "for" not in words:
            return words, 0
        k = words.index("for")
        if not verb.lasting:
            raise FaultCommandError(f"`for` makes no sense here; it does with {', '.join(self.lasting)}")
        if len(words) != k + 2:
            raise FaultCommandError("`for` ends an order, with one time, e.g. for 2s")
        for_ns = duration_ns(words[k + 1])
        if for_ns == 0:
            raise FaultCommandError("`for` needs a time above 0")
        return words[:k], for_ns


class FaultLog(Protocol):
    """Protocol of the engine's log: ``kind`` is ``order`` or ``ended``."""

    def __call__(self, t_ns: int, kind: str, command: Any, text: str) -> None: ...


class FaultEngine(Generic[Command]):
    """Executes the fault commands of one emulator, now or when due, undoes them in time, and logs them.

    ``start_ns``: zero of the commands' times. ``check`` raises FaultCommandError if a command names something that does
    not exist. ``guard`` is held during an action or its undo.
    """

    def __init__(
        self,
        language: FaultLanguage[Command],
        emulator: Any,
        start_ns: int,
        *,
        check: Callable[[Command], None],
        log: FaultLog,
        guard: AbstractContextManager[Any] | None = None,
    ) -> None:
        self._language = language
        self._emulator = emulator
        self._start_ns = start_ns
        self._check = check
        self._log = log
        self._guard = guard if guard is not None else nullcontext()
        self._lock = threading.Lock()
        self._waiting: list[tuple[int, int, Command, Undo | None]] = []
        self._count = 0

    def parse(self, text: str) -> Command:
        """Parse a command and check its names. Raises FaultCommandError."""
        command = self._language.parse(text)
        self._check(command)
        return command

    def postpone(self, command: Command, now_ns: int) -> str | None:
        """Schedule a future command and return the reply; None if it is due now."""
        if command.at_ns is None or self._start_ns + command.at_ns <= now_ns:
            return None
        self._schedule(self._start_ns + command.at_ns, command, None)
        return f"{command.verb} at {command.at_ns * 1e-9:g} s"

    def do(self, command: Command, now_ns: int) -> str:
        """Execute a command; returns the reply. Raises FaultCommandError."""
        self._check(command)
        verb = self._language.verbs[command.verb]
        with self._guard:
            done = verb.act(self._emulator, command)
        answer, undo = (done, None) if isinstance(done, str) else done
        if command.for_ns and undo is not None:
            self._schedule(now_ns + command.for_ns, command, undo)
            answer += f" for {command.for_ns * 1e-9:g} s"
        if verb.logged:
            self._log(now_ns, "order", command, answer)
        return answer

    def order(self, text: str, now_ns: int) -> str:
        """Parse and execute a command, now or at its own time; returns the reply. Raises FaultCommandError."""
        command = self.parse(text)
        postponed = self.postpone(command, now_ns)
        return self.do(command, now_ns) if postponed is None else postponed

    def due_ns(self) -> int:
        """Time at which the next scheduled command is to be executed or undone."""
        with self._lock:
            return self._waiting[0][0] if self._waiting else NEVER_NS

    def advance(self, now_ns: int) -> bool:
        """Execute or undo the first command that is due by ``now_ns``; returns whether there was one.

        A scheduled command that can no longer be executed is logged as refused.
        """
        with self._lock:
            if not self._waiting or self._waiting[0][0] > now_ns:
                return False
            t_ns, _, command, undo = heapq.heappop(self._waiting)
        if undo is not None:
            with self._guard:
                undo()
            self._log(t_ns, "ended", command, command.verb)
            return True
        try:
            self.do(command, t_ns)
        except FaultCommandError as error:
            self._log(t_ns, "order", command, f"refused: {error}")
        return True

    def _schedule(self, t_ns: int, command: Command, undo: Undo | None) -> None:
        with self._lock:
            self._count += 1
            heapq.heappush(self._waiting, (t_ns, self._count, command, undo))


# -- words common to all languages ------------------------------------------------------------------------------------


def at_most(words: list[str], count: int) -> None:
    """Raise FaultCommandError if there are more than ``count`` words."""
    if len(words) > count:
        raise FaultCommandError(f"{' '.join(words[count:])!r} is too much")


def duration_ns(word: str) -> int:
    """Parse a duration such as ``6ms`` [ns]; 0 needs no unit. Raises FaultCommandError."""
    if word == "0":
        return 0
    match = _TIME.fullmatch(word)
    if match is None:
        raise FaultCommandError(f"time {word!r}; a number with us, ms or s is valid, e.g. 6ms")
    time_ns = float(match[1]) * _TIME_UNITS[match[2]]
    if time_ns > LONGEST_S * 1e9:
        raise FaultCommandError(f"time {word!r}; up to {LONGEST_S} s is valid")
    return round(time_ns)


def time_word(name: str, missing: str) -> Word:
    """Argument: a duration [ns] for the field ``name``."""
    return Word(lambda word: {name: duration_ns(word)}, missing)


def choice_word(valid: Mapping[str, Mapping[str, Any]], default: str | None = None) -> Word:
    """Argument: one of the keys of ``valid``; the fields are its value. Without ``default`` it is required."""

    def read(word: str) -> dict[str, Any]:
        if word not in valid:
            raise FaultCommandError(f"{word!r}; valid: {', '.join(valid)}")
        return dict(valid[word])

    if default is None:
        return Word(read, f"one of {', '.join(valid)} is missing")
    return Word(read, default=valid[default])
