"""The zenoh key space ``stereoservo/v1/<cell>/…``, with checks of the names in it (zenoh accepts nearly any key)."""

from __future__ import annotations

import re

ROOT = "stereoservo/v1"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
VERBS = (
    "enable",
    "disable",
    "hold",
    "resume",
    "reset",
    "jog",
    "auxiliary",
    "home",
    "calibrate",
    "teach",
    "cancel",
    "renew",
    "update",
    "acknowledge",
    "record",
    "synthesise",
    "restore",
)
"""Commands with an operator; ``stop`` has a key of its own."""


class InvalidKeyError(ValueError):
    """A name or key outside of the key space; the message contains the valid form."""


def check_name(kind: str, name: str) -> str:
    """``name``, if it is valid in a key. Raises InvalidKeyError."""
    if not NAME.fullmatch(name):
        raise InvalidKeyError(
            f"{kind} {name!r}: letters, digits, '_' and '-' are valid, up to 64, a letter or digit first"
        )
    return name


class KeySpace:
    """Keys of one cell. Raises InvalidKeyError for names that are invalid in a key."""

    def __init__(self, cell: str) -> None:
        self.prefix = f"{ROOT}/{check_name('cell', cell)}"
        self.state = f"{self.prefix}/state"
        self.event = f"{self.prefix}/event"
        self.info = f"{self.prefix}/info"
        self.model = f"{self.prefix}/model"
        self.goals = f"{self.prefix}/goals"
        self.alive = f"{self.prefix}/alive"
        self.stop = f"{self.prefix}/command/stop"
        self.any_goal = f"{self.prefix}/goal/*"
        self.any_schema = f"{self.prefix}/schema/*"

    def features(self, camera: str) -> str:
        """The key on which the features of ``camera`` are published."""
        return f"{self.prefix}/features/{check_name('camera', camera)}"

    def preview(self, camera: str) -> str:
        """The key on which pictures of ``camera`` are published while there is a subscriber."""
        return f"{self.prefix}/preview/{check_name('camera', camera)}"

    def goal(self, operator: str) -> str:
        """The key of ``operator``'s goals, for puts and queries."""
        return f"{self.prefix}/goal/{check_name('operator', operator)}"

    def command(self, verb: str, operator: str) -> str:
        """The key of ``operator``'s commands ``verb``."""
        _check_verb(verb)
        return f"{self.prefix}/command/{verb}/{check_name('operator', operator)}"

    def any_command(self, verb: str) -> str:
        """``verb`` of every operator."""
        _check_verb(verb)
        return f"{self.prefix}/command/{verb}/*"

    @property
    def any_command_at_all(self) -> str:
        """Every key below that of commands, those of no command included."""
        return f"{self.prefix}/command/**"

    def schema(self, name: str) -> str:
        """The JSON Schema of message ``name``."""
        return f"{self.prefix}/schema/{check_name('schema', name)}"

    def operator_of_goal(self, key: str) -> str:
        """The operator of a concrete goal key. Raises InvalidKeyError (a wildcard put reaches every
        subscriber).
        """
        return check_name("operator", self._rest(key, "goal", 1)[0])

    def command_of(self, key: str) -> tuple[str, str]:
        """Verb and operator of a concrete command key. Raises InvalidKeyError."""
        verb, operator = self._rest(key, "command", 2)
        _check_verb(verb)
        return verb, check_name("operator", operator)

    def is_command(self, key: str) -> bool:
        """Whether ``key`` is that of a command of any operator."""
        try:
            self.command_of(key)
        except InvalidKeyError:
            return False
        return True

    def schema_of(self, key: str) -> str:
        """The message name of a concrete schema key. Raises InvalidKeyError."""
        return check_name("schema", self._rest(key, "schema", 1)[0])

    def _rest(self, key: str, branch: str, parts: int) -> list[str]:
        prefix = f"{self.prefix}/{branch}/"
        rest = key.removeprefix(prefix).split("/")
        if not key.startswith(prefix) or len(rest) != parts:
            raise InvalidKeyError(f"key {key!r}: {prefix}{'/'.join(['<name>'] * parts)} is valid")
        return rest


def _check_verb(verb: str) -> None:
    if verb not in VERBS:
        raise InvalidKeyError(f"command {verb!r}; there are: stop, {', '.join(VERBS)}")
