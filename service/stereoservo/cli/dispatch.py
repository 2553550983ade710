"""The commands of ``stereoservo``: imports the module of a command on demand, runs it, reports failures as text or
JSON, and returns the exit code.
"""

from __future__ import annotations

import ast
import importlib.util
import sys
import traceback
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Any, NamedTuple

import typer
from typer.core import TyperGroup
from typer.main import get_command
from typer.models import CommandInfo

import stereoservo
from stereoservo.cli.early_stop import RaisedStop
from stereoservo.cli.output import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE, CommandError, fail, is_known_error, log
from stereoservo.ports import plugins


class Command(NamedTuple):
    """A command: its ``group`` in ``--help``, its ``place`` (module:function below `stereoservo.cli`; empty: found by
    entry point), and the arguments of an ``example``.
    """

    group: str
    place: str
    example: str


COMMANDS = {
    "setup": Command("Set up", "setup.command:setup", "mycell.toml"),
    "init": Command("Set up", "init:init", "mycell.toml"),
    "doctor": Command("Set up", "doctor.command:doctor", "mycell.toml"),
    "drivers": Command("Set up", "drivers:drivers", ""),
    "print-plate": Command("Set up", "", "plate.pdf"),
    "learn-corners": Command("Set up", "", "mycell.toml landmarks.npz --ask-to-move"),
    "driver-check": Command("Set up", "", "mycell.toml"),
    "warmup": Command("Set up", "warmup:warmup", "demo"),
    "run": Command("Run", "run:run", "mycell.toml --commissioning"),
    "status": Command("Run", "status:status", "mycell"),
    "ls": Command("Run", "status:ls", ""),
    "enable": Command("Run", "operator_commands:enable", "mycell"),
    "disable": Command("Run", "operator_commands:disable", "mycell"),
    "reset": Command("Run", "operator_commands:reset", "mycell"),
    "hold": Command("Run", "operator_commands:hold", "mycell"),
    "resume": Command("Run", "operator_commands:resume", "mycell"),
    "stop": Command("Run", "stop:stop", "mycell"),
    "calibrate": Command("Move", "calibrate.command:calibrate", "mycell --check"),
    "teach": Command("Move", "teach:teach", "mycell dock"),
    "goal": Command("Move", "goal:goal", "mycell dock --check"),
    "ik": Command("Move", "ik:ik", "mycell dock"),
    "acknowledge": Command("Move", "operator_commands:acknowledge", "mycell ID"),
    "cancel": Command("Move", "operator_commands:cancel", "mycell"),
    "jog": Command("Move", "operator_commands:jog", "mycell j1=0.05 --seconds 1"),
    "home": Command("Move", "home:home", "mycell"),
    "auxiliary": Command("Move", "operator_commands:auxiliary", "mycell gripper=0.04"),
    "watch": Command("Look", "watch:watch", "mycell"),
    "web": Command("Look", "web:web", "mycell --operate ann"),
    "record": Command("Look", "record:record", "mycell --images --seconds 60"),
    "replay": Command("Look", "replay:replay", "flight.mcap"),
    "export": Command("Look", "export:export", "flight.mcap"),
    "examine": Command("Look", "examine:examine", "flight.mcap"),
    "demo": Command("Simulate and measure", "", "--lockstep"),
    "emulate": Command("Simulate and measure", "", "drives hil-can"),
    "simulate": Command("Simulate and measure", "", "TASKS.csv --law cartesian3"),
    "reproduce": Command("Simulate and measure", "", "all --html thesis.html"),
    "bench": Command("Simulate and measure", "", "cycle --json"),
}
"""All known commands, in the order in which they are needed; any other that is installed is listed below ``OTHERS``."""
OWN = {name: command.place for name, command in COMMANDS.items() if command.place}
"""Commands of the service."""
OTHERS = "Others"

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
        extra = [name for name in plugins.names(plugins.COMMANDS) if name not in OWN]
        return [*OWN, *extra]

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
            example = next(filter(None, map(example_of, names)), "")
            if example:
                formatter.write_text(f"  for example: stereoservo {example}")


WHOLE = 1000
"""Maximum length of a command's first sentence in the list: effectively unlimited."""


def _places() -> dict[str, str]:
    """Location of each command: ``module:function``."""
    extra = {plugin.name: plugin.value for plugin in plugins.list_plugins(plugins.COMMANDS)}
    return extra | {name: f"stereoservo.cli.{where}" for name, where in OWN.items()}


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
    where = OWN.get(name)
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
    epilog = f"Example: stereoservo {example}" if (example := example_of(name)) else None
    single.registered_commands.append(
        CommandInfo(name=name, callback=expanded(function), context_settings=context_settings, epilog=epilog)
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
            log(context.get_usage())
        fail(CommandError("usage", message), as_json)
        return EXIT_USAGE
    except Exception as error:
        lacking = plugins.missing_extra(error)
        if lacking is not None:
            error = CommandError("missing_extra", lacking)
        if not is_known_error(error):
            traceback.print_exc()
        fail(error, as_json)
        return EXIT_FAILED
    if code == EXIT_INTERRUPTED:  # typer turns Ctrl-C into this
        fail(CommandError("interrupted", "interrupted"), as_json)
    return code if isinstance(code, int) else 0


def example_of(name: str) -> str:
    """An example of a command's use, without the program's name; empty if there is none."""
    return f"{name} {COMMANDS[name].example}".strip() if name in COMMANDS else ""


def grouped(names: list[str]) -> list[tuple[str, list[str]]]:
    """Headings with the available commands of each; commands without a group come last."""
    groups: dict[str, list[str]] = {group: [] for group in (*(row.group for row in COMMANDS.values()), OTHERS)}
    for name in sorted(names, key=[*COMMANDS, *names].index):
        groups[COMMANDS[name].group if name in COMMANDS else OTHERS].append(name)
    return [(heading, members) for heading, members in groups.items() if members]


# -- options that are declared as the fields of a dataclass -------------------------------------------------------


def expanded(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with every parameter of a dataclass replaced by the fields of that dataclass, as options."""
    own = signature(function, eval_str=True).parameters
    groups: dict[str, Any] = {name: one.annotation for name, one in own.items() if is_dataclass(one.annotation)}
    if not groups:
        return function
    parameters = [
        parameter.replace(kind=Parameter.KEYWORD_ONLY)
        for name, one in own.items()
        for parameter in (signature(groups[name], eval_str=True).parameters.values() if name in groups else [one])
    ]

    def called(**given: Any) -> Any:
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        return function(**given)

    called.__doc__ = function.__doc__
    called.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return called
