"""Common parts of the commands: options, arguments, exit codes, and output as text or as exactly one JSON object."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import msgspec
import typer

from stereoservo.messages.text_files import complete, json_of, table_of

if TYPE_CHECKING:
    from stereoservo.client import Client

EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


def cells_beginning(incomplete: str) -> list[str]:
    """Live cells and cell files whose names start so, for the shell's completion."""
    from stereoservo.messages.discovery import live_cells

    folder = Path(incomplete if incomplete.endswith("/") else Path(incomplete).parent)
    files = sorted(str(path) for path in folder.glob("*.toml"))
    return [name for name in [*(info.cell for info in live_cells()), *files] if name.startswith(incomplete)]


def goals_beginning(ctx: typer.Context, incomplete: str) -> list[str]:
    """Taught goals of the command's cell whose names start so, for the shell's completion; queries the daemon."""
    from stereoservo.client import Client

    try:
        with Client(ctx.params["cell"], endpoint=ctx.params.get("endpoint")) as client:
            names = [goal.name for goal in client.info().taught]
    except Exception:  # a shell prompt has no place for a message; the command itself reports the error
        return []
    return [name for name in names if name.startswith(incomplete)]


JsonOption = Annotated[bool, typer.Option("--json", help="Print exactly one JSON object on stdout.")]
CellArgument = Annotated[
    str,
    typer.Argument(
        metavar="CELL", help="Name of a live cell, or path of a cell file (*.toml).", autocompletion=cells_beginning
    ),
]
EndpointOption = Annotated[
    str | None, typer.Option("--endpoint", help="zenoh endpoint of a daemon on another host (CELL is then its name).")
]
OperatorOption = Annotated[
    str | None, typer.Option("--operator", help="Name under which commands are given (default: user and process).")
]
SetPointsOption = Annotated[
    Path | None, typer.Option("--set-points", metavar="FILE", help='JSON: {"camera": {"marker": [u, v]}} in pixels.')
]


@dataclass(frozen=True)
class CellOptions:
    """Options of a command to a live cell; `dispatch` makes each field of a dataclass an option of the command line."""

    endpoint: EndpointOption = None
    operator: OperatorOption = None
    json: JsonOption = False

    def client(self, cell: str, while_waiting: Callable[[], None] = lambda: None) -> Client:
        """Client of the cell, with these options."""
        from stereoservo.client import Client

        return Client(cell, endpoint=self.endpoint, operator=self.operator, while_waiting=while_waiting)

    def emit(self, result: Any, text: str) -> None:
        """Print a result: as JSON with ``--json``, else the text."""
        emit(result, text, self.json)


CELL_OPTIONS = CellOptions()


class CommandError(Exception):
    """A command failed. ``code`` is stable; ``data`` is added to the JSON along with the message."""

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data


def emit(result: Any, text: str, as_json: bool) -> None:
    """Print a result: as JSON, or as text for people."""
    if as_json:
        sys.stdout.write(msgspec.json.encode(result, enc_hook=str).decode() + "\n")
    elif text:
        sys.stdout.write(text + "\n")
    sys.stdout.flush()


def coloured(text: str, colour: str, stream: TextIO) -> str:
    """The text in bold and that colour if the stream is a terminal, unless ``NO_COLOR`` is set."""
    return typer.style(text, fg=colour, bold=True) if stream.isatty() and not os.environ.get("NO_COLOR") else text


def log(message: str) -> None:
    """Print progress and remarks on stderr; if that fails because of a full disk, only they are lost."""
    with suppress(OSError):
        print(message, file=sys.stderr, flush=True)


def log_hold(kind: str, message: str, cell: str) -> None:
    """Print that a motion which is waited for was held or resumed, and how to continue; nothing for other events."""
    if kind == "held":
        log(f"{message}: nothing moves until `stereoservo resume {cell}`")
    elif kind == "resumed":
        log(message)


def fail(error: BaseException, as_json: bool) -> None:
    """Print a failure: the message on stderr, and ``{"error": …}`` on stdout with ``--json``."""
    message = str(error) or type(error).__name__
    log(f"{coloured('error:', 'red', sys.stderr)} {message}")
    if as_json:
        body: dict[str, Any] = {"code": code_of(error), "message": message}
        reply = getattr(error, "reply", None)
        if reply is not None:
            body["problems"] = list(reply.problems)
            body["reasons"] = msgspec.to_builtins(reply.reasons)
        if isinstance(error, CommandError):
            body |= error.data
        emit({"error": body}, "", True)


def code_of(error: BaseException) -> str:
    """The code of a failure in JSON: the error's own, else the name of its class."""
    given = getattr(error, "code", None)
    return given if isinstance(given, str) and given else _snake(type(error).__name__)


def is_known_error(error: BaseException) -> bool:
    """Whether an exception is raised by this project on purpose, so that its text suffices without a traceback."""
    return type(error).__module__.split(".")[0].startswith("stereoservo") or isinstance(error, OSError)


def pairs(items: list[str], what: str) -> dict[str, float]:
    """Parse ``["a=0.1", "b=-2"]`` as a mapping. Raises CommandError for anything else."""
    found: dict[str, float] = {}
    for item in items:
        name, equals, value = item.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = float("nan")
        if not equals or not name or number != number or abs(number) == float("inf"):
            raise CommandError("argument", f"{what} {item!r}: NAME=NUMBER with a finite number is valid")
        found[name] = number
    return found


def marker_ids(text: str, what: str) -> list[int]:
    """Parse ``"10,11,12"`` as marker ids. Raises CommandError."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise CommandError("argument", f"{what} {text!r}: marker ids with commas, 10,11,12, are valid") from error


def read_file(path: Path) -> bytes:
    """Content of a file. Raises CommandError."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise CommandError("file", f"{path}: {error.strerror}") from error


def read_object(path: Path) -> dict[str, Any]:
    """Content of a JSON file; what is odd in it is logged. Raises CommandError."""
    try:
        tree, odd = json_of(read_file(path))
        complete((tree, odd))
    except ValueError as error:
        raise CommandError("file", f"{path}: is not JSON: {error}") from error
    for remark in odd:
        log(f"{path}: {remark}")
    if not isinstance(tree, dict):
        raise CommandError("file", f"{path}: holds {type(tree).__name__}; a JSON object is needed")
    return tree


def read_columns(path: Path, columns: tuple[str, ...], code: str) -> list[tuple[int, dict[str, str]]]:
    """Rows of a table with their lines, at least one; what is odd in it is logged.

    Raises CommandError (``code``), also if ``columns`` are missing.
    """
    try:
        table = table_of(path.read_bytes())
    except (OSError, ValueError) as error:
        raise CommandError(code, f"{path} cannot be read: {error}") from error
    for remark in table.remarks:
        log(f"{path}: {remark}")
    if missing := [name for name in columns if name not in table.columns]:
        raise CommandError(code, f"{path} lacks columns {', '.join(missing)}; it has {', '.join(table.columns)}")
    if not table.rows:
        raise CommandError(code, "; ".join((f"{path} holds no row below its header", *map(str, table.remarks[:3]))))
    return table.rows


def shipped_or_path(cell: str) -> Path:
    """Path of a cell file, or of the shipped one of that name. Raises BadParameter, PluginError."""
    from stereoservo.ports import plugins  # not for commands that need no file

    if cell.endswith(".toml") or Path(cell).exists():
        return Path(cell)
    found: list[str] = []
    for provider in plugins.names(plugins.CELLS):
        try:
            return Path(plugins.load(plugins.CELLS, provider)(cell))
        except ValueError as error:
            found.append(str(error))
    raise typer.BadParameter("; ".join(found) or f"{cell!r} is no .toml file", param_hint="CELL")


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name.removesuffix("Error")).lower()
