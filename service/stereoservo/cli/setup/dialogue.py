"""Dialogue of `stereoservo setup` with a person: progress lines, questions with defaults, and answers that may be read
from a file and are stored, so that the whole dialogue can be repeated.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from json import dumps as toml_string
from pathlib import Path
from typing import TextIO, TypeVar

from stereoservo.cli.output import CommandError
from stereoservo.messages.text_files import complete, toml_of

QUIET_S = 1.5
"""Time without output after which the current activity is printed again: after 3 s of silence a person assumes the end.
"""
_LOOK_S = 0.2
T = TypeVar("T")


class Dialogue:
    """Output lines and questions. A context manager.

    ``answers``: by the question's key; missing ones are asked on a terminal, or have their default if there is none.
    None: all are typed.
    ``asked``: questions and their answers so far.
    ``longest_silence_s``: longest time between two lines, without waiting for a person.
    """

    def __init__(self, out: TextIO, answers: dict[str, str] | None = None) -> None:
        self.asked: dict[str, str] = {}
        self.longest_silence_s = 0.0
        self._out = out
        self._answers = answers
        self._doing = ""
        self._since_s = self._said_s = time.monotonic()
        self._waits = False
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._ticker = threading.Thread(target=self._tick, name="setup-ticker", daemon=True)

    def __enter__(self) -> Dialogue:
        self._ticker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._ticker.join()

    def say(self, line: str) -> None:
        """Print one line, or more."""
        with self._lock:
            self._write(line)

    def heading(self, line: str) -> None:
        """Print the heading of a step."""
        self.say(f"\n== {line}")

    @contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Context manager of an activity that may take long: printed repeatedly while there is no other output."""
        before = self._doing, self._since_s
        self._doing, self._since_s = what, time.monotonic()
        try:
            yield
        finally:
            self._doing, self._since_s = before

    def now(self, what: str) -> None:
        """Replace the current activity."""
        self._doing = what

    def ask(
        self, key: str, question: str, default: str | None, parse: Callable[[str], T], shown: Callable[[str], str] = str
    ) -> T:
        """The answer to a question, parsed by ``parse``, which raises ValueError with the valid values.

        ``default``: meaning of an empty answer; ``shown``: the form in which an answer is printed. Raises CommandError:
        no terminal and no answer, a scripted answer that is not valid.
        """
        prompt = f"{question}{'' if default is None else f' [{default}]'}: "
        while True:
            text = self._answer(key, prompt, default, shown)
            try:
                understood = parse(text)
            except ValueError as error:
                if self._scripted(key):
                    raise CommandError("answer", f"answer {key} = {shown(text)!r}: {error}") from error
                self.say(f"   {error}")
                continue
            self.asked[key] = text
            return understood

    def confirm(self, key: str, question: str, default: bool) -> bool:
        """Whether the answer is yes."""
        return self.ask(key, f"{question} (yes or no)", "yes" if default else "no", _yes_or_no)

    def _scripted(self, key: str) -> bool:
        """Whether a question is answered by the given answers, or by its default if they lack it."""
        return self._answers is not None and (key in self._answers or not sys.stdin.isatty())

    def _answer(self, key: str, prompt: str, default: str | None, shown: Callable[[str], str]) -> str:
        if self._scripted(key):
            assert self._answers is not None
            text = self._answers.get(key, default)
            if text is None:
                raise CommandError("answer", f"the answers have no {key!r}, and it has no default: {prompt}")
            self.say(f"?  {prompt}{shown(text)}")
            return text
        if not sys.stdin.isatty():
            raise CommandError(
                "terminal", "setup asks on the terminal, and there is none; --answers FILE answers for a person"
            )
        with self._lock:
            self._write(f"?  {prompt}", end="")
            self._waits = True
        try:
            line = sys.stdin.readline()
        finally:
            self._waits = False
            self._said_s = time.monotonic()
        if not line:
            raise CommandError("terminal", f"the terminal was closed before this was answered: {prompt}")
        return line.strip() or (default if default is not None else "")

    def _write(self, text: str, end: str = "\n") -> None:
        now = time.monotonic()
        self.longest_silence_s = max(self.longest_silence_s, now - self._said_s)
        self._said_s = now
        self._out.write(text + end)
        self._out.flush()

    def _tick(self) -> None:
        while not self._ended.wait(_LOOK_S):
            with self._lock:
                now = time.monotonic()
                if not self._waits and now - self._said_s > QUIET_S:
                    what = self._doing or "working"
                    self._write(f"   … {what}, {now - self._since_s:.0f} s")


def _yes_or_no(text: str) -> bool:
    match text.lower():
        case "y" | "yes":
            return True
        case "n" | "no":
            return False
    raise ValueError("yes or no")


def read_answers(path: Path) -> dict[str, str]:
    """Answers by key, from a TOML file of strings. Raises CommandError."""
    try:
        tree = complete(toml_of(path.read_bytes()))
    except OSError as error:
        raise CommandError("file", f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise CommandError("file", f"{path}: is not TOML: {error}") from error
    wrong = [key for key, value in tree.items() if not isinstance(value, str)]
    if wrong:
        raise CommandError("file", f'{path}: {wrong[0]}: answers are strings, KEY = "ANSWER"')
    return tree


def answers_text(asked: dict[str, str]) -> str:
    """Answers as the file that :func:`read_answers` reads."""
    return "".join(f"{toml_string(key)} = {toml_string(text)}\n" for key, text in asked.items())
