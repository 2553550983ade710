"""The commands of ``stereoservo``: imports the module of a command on demand, runs it, reports failures as text or
JSON, and returns the exit code.
"""

from __future__ import annotations

import ast
import importlib.util
import sys
import traceback
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup
from typer.main import get_command
from typer.models import CommandInfo

import stereoservo
from stereoservo.cli.early_stop import RaisedStop
from stereoservo.cli.output import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE, CommandError, fail, known, note
from stereoservo.ports import plugins

COMMANDS: dict[str, str] = {
    "run": "run:run",
    "status": "status:status",
    "stop": "stop:stop",
    "goal": "goal:goal",
    "teach": "teach:teach",
    "jog": "jog:jog",
    "auxiliary": "auxiliary:auxiliary",
    "home": "home:home",
    "calibrate": "calibrate.command:calibrate",
    "watch": "watch.command:watch",
    "web": "web:web",
    "enable": "operator_commands:enable",
    "disable": "operator_commands:disable",
    "hold": "operator_commands:hold",
    "resume": "operator_commands:resume",
    "reset": "operator_commands:reset",
    "acknowledge": "operator_commands:acknowledge",
    "cancel": "operator_commands:cancel",
    "record": "record:record",
    "replay": "replay:replay",
    "export": "export:export",
    "examine": "examine:examine",
    "ik": "ik:ik",
    "drivers": "drivers:drivers",
    "doctor": "doctor.command:doctor",
    "setup": "setup.command:setup",
    "init": "init:init",
    "ls": "ls:ls",
    "warmup": "warmup:warmup",
}
"""Commands of the service: name -> module:function below ``stereoservo.cli``."""

ANYTHING = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Settings of a command that accepts any arguments."""

_USAGE_ERROR: type[Exception] = typer.BadParameter.__mro__[1]
"""click's UsageError, independent of where this version of typer has its click."""


class LazyGroup(TyperGroup):
    """The group of commands, each imported when it is called; a broken plug-in is listed with its error and does not
    affect the others.
    """

    names_only = False
    """True while the shell completes names: no command is then imported for its text."""

    def list_commands(self, ctx: Any) -> list[str]:
        extra = [name for name in plugins.names(plugins.COMMANDS) if name not in COMMANDS]
        return [*COMMANDS, *extra]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in self.list_commands(ctx):
            return None
        if self.names_only and (described := _described(cmd_name, _places()[cmd_name])) is not None:
            return described
        try:
            function = _load(cmd_name)
        except plugins.PluginError as error:
            code = "plugin" if plugins.missing_extra(error.__cause__ or error) is None else "missing_extra"
            return _command(cmd_name, _broken(code, str(error)), ANYTHING)
        except ModuleNotFoundError as error:
            lacking = plugins.missing_extra(error)
            if lacking is None:
                raise
            return _command(cmd_name, _broken("missing_extra", f"`{cmd_name}` cannot run: {lacking}"), ANYTHING)
        return _command(cmd_name, function)

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Commands and options of the program that start with ``incomplete``."""
        self.names_only = True
        try:
            return super().shell_complete(ctx, incomplete)
        finally:
            self.names_only = False

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the groups of ``--help``; a command is imported only if its text cannot be read from its source."""
        places = _places()
        for heading, names in grouped(self.list_commands(ctx)):
            commands = [(name, _described(name, places[name]) or self.get_command(ctx, name)) for name in names]
            with formatter.section(heading):
                formatter.write_dl([(name, command.get_short_help_str(WHOLE)) for name, command in commands])
            example = next((EXAMPLES[name] for name in names if name in EXAMPLES), "")
            if example:
                formatter.write_text(f"  for example: stereoservo {example}")


WHOLE = 1000
"""Maximum length of a command's first sentence in the list: effectively unlimited."""


def _places() -> dict[str, str]:
    """Location of each command: ``module:function``."""
    extra = {plugin.name: plugin.value for plugin in plugins.list_plugins(plugins.COMMANDS)}
    return extra | {name: f"stereoservo.cli.{where}" for name, where in COMMANDS.items()}


def _described(name: str, where: str) -> Any:
    """A command that has only its help text, read from the source of ``module:function`` without an import; None if
    that cannot be read.
    """
    module, _, function = where.partition(":")
    try:
        spec = importlib.util.find_spec(module)
        source = "" if spec is None or spec.origin is None else Path(spec.origin).read_text(encoding="utf-8")
        tree = ast.parse(source)
    except Exception:  # whatever a third party's package raises on import, or contains in place of source
        return None
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == function]
    if not found:
        return None

    def described() -> None: ...

    described.__doc__ = ast.get_docstring(found[0])
    return _command(name, described)


def _load(name: str) -> Any:
    where = COMMANDS.get(name)
    if where is None:
        return plugins.load(plugins.COMMANDS, name)
    module, _, function = where.partition(":")
    return getattr(importlib.import_module(f"stereoservo.cli.{module}"), function)


def _broken(code: str, message: str) -> Any:
    """A command that reports why it cannot run."""

    def broken(ctx: typer.Context, json: bool = typer.Option(False, "--json")) -> None:
        raise CommandError(code, message, arguments=ctx.args)

    broken.__doc__ = f"(broken) {message}" if code == "plugin" else message
    return broken


def _command(name: str, function: Any, context_settings: dict[Any, Any] | None = None) -> Any:
    """Typer command of one function."""
    single = typer.Typer(add_completion=False, rich_markup_mode=None)
    epilog = f"Example: stereoservo {EXAMPLES[name]}" if name in EXAMPLES else None
    single.registered_commands.append(
        CommandInfo(name=name, callback=function, context_settings=context_settings, epilog=epilog)
    )
    command = get_command(single)
    command.name = name
    return command


app = typer.Typer(cls=LazyGroup, no_args_is_help=True, rich_markup_mode=None)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"stereoservo {stereoservo.__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    """Closes the loop between two uncalibrated cameras and a robot arm."""


def run(arguments: list[str], raised: RaisedStop | None) -> int:
    """Run one command line; returns the exit code. Failures are printed, as JSON with ``--json``.

    ``raised``: the stop that was already raised for it, see `early_stop`.
    """
    as_json = "--json" in arguments
    try:
        code = get_command(app).main(args=arguments, prog_name="stereoservo", standalone_mode=False, obj=raised)
    except KeyboardInterrupt:
        fail(CommandError("interrupted", "interrupted"), as_json)
        return EXIT_INTERRUPTED
    except typer.Abort:
        fail(CommandError("interrupted", "interrupted"), as_json)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()  # the reader of the output has ended
        return EXIT_FAILED
    except _USAGE_ERROR as error:
        context = getattr(error, "ctx", None)
        message = error.format_message() if hasattr(error, "format_message") else str(error)
        if context is not None and not as_json:
            note(context.get_usage())
        fail(CommandError("usage", message), as_json)
        return EXIT_USAGE
    except Exception as error:
        lacking = plugins.missing_extra(error)
        if lacking is not None:
            error = CommandError("missing_extra", lacking)
        if not known(error):
            traceback.print_exc()
        fail(error, as_json)
        return EXIT_FAILED
    if code == EXIT_INTERRUPTED:  # typer turns Ctrl-C into this
        fail(CommandError("interrupted", "interrupted"), as_json)
    return code if isinstance(code, int) else 0


# -- groups of verbs -----------------------------------------------------------------------------------------
# Additional texts of ``--help``: the group of each command and an example.


GROUPS: dict[str, tuple[str, ...]] = {
    "Set up": (
        "setup",
        "init",
        "doctor",
        "drivers",
        "print-plate",
        "learn-corners",
        "driver-check",
        "warmup",
    ),
    "Run": ("run", "status", "ls", "enable", "disable", "reset", "hold", "resume", "stop"),
    "Move": ("calibrate", "teach", "goal", "ik", "acknowledge", "cancel", "jog", "home", "auxiliary"),
    "Look": ("watch", "web", "record", "replay", "export", "examine"),
    "Simulate and measure": ("demo", "emulate", "simulate", "reproduce", "bench"),
}
"""Headings and their commands, in the order in which they are needed; any other command is listed below ``OTHERS``."""
OTHERS = "Others"
EXAMPLES: dict[str, str] = {
    "setup": "setup mycell.toml",
    "init": "init mycell.toml",
    "doctor": "doctor mycell.toml",
    "drivers": "drivers",
    "print-plate": "print-plate plate.pdf",
    "learn-corners": "learn-corners mycell.toml landmarks.npz --ask-to-move",
    "driver-check": "driver-check mycell.toml",
    "warmup": "warmup demo",
    "run": "run mycell.toml --commissioning",
    "status": "status mycell",
    "ls": "ls",
    "enable": "enable mycell",
    "disable": "disable mycell",
    "reset": "reset mycell",
    "hold": "hold mycell",
    "resume": "resume mycell",
    "stop": "stop mycell",
    "calibrate": "calibrate mycell --check",
    "teach": "teach mycell dock",
    "goal": "goal mycell dock --check",
    "ik": "ik mycell dock",
    "acknowledge": "acknowledge mycell ID",
    "cancel": "cancel mycell",
    "jog": "jog mycell j1=0.05 --seconds 1",
    "home": "home mycell",
    "auxiliary": "auxiliary mycell gripper=0.04",
    "watch": "watch mycell",
    "web": "web mycell --operate ann",
    "record": "record mycell --images --seconds 60",
    "replay": "replay flight.mcap",
    "export": "export flight.mcap",
    "examine": "examine flight.mcap",
    "demo": "demo --lockstep",
    "emulate": "emulate drives hil-can",
    "simulate": "simulate TASKS.csv --law cartesian3",
    "reproduce": "reproduce all --html thesis.html",
    "bench": "bench cycle --json",
}
"""By command, without the program's name."""


def grouped(names: list[str]) -> list[tuple[str, list[str]]]:
    """Headings with the available commands of each; commands without a group come last."""
    known = {name for members in GROUPS.values() for name in members}
    groups = [(heading, [name for name in members if name in names]) for heading, members in GROUPS.items()]
    groups.append((OTHERS, [name for name in names if name not in known]))
    return [(heading, members) for heading, members in groups if members]
