"""Pages of the documentation site that are made from the code and from other pages: a hook of mkdocs (`mkdocs.yml`).

`generated` returns their texts by name; nothing is written to disk. Needs the package with its daemon (`.[cell,docs]`).
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import textwrap
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import msgspec.inspect

ROOT = Path(__file__).parents[2]
EQUATION = re.compile(r"\((\d)\.(\d+)(?: to (?:\d\.)?(\d+))?\)|thesis (\d)\.(\d+)")
FOLDERS = "(?:deploy|service|sim|drivers|tests|examples)"
CHAPTERS = {
    "2": "Projective geometry of one and two cameras",
    "3": "Motion of a rigid stereo rig: displacements in projective space",
    "4": "Translations, rotations, and mobile cameras",
    "5": "Kinematics of the arm, and its self-calibration",
    "6": "Inverse kinematics",
    "7": "Paths: alignment, visibility, profiles",
    "8": "Control laws",
    "9": "Outlook",
}


def generated() -> dict[str, str]:
    """Markdown of every generated page, by its path below ``docs``."""
    return {
        "index.md": _of_the_root("README.md"),
        "contributing.md": _of_the_root("CONTRIBUTING.md"),
        "changes.md": _of_the_root("CHANGELOG.md"),
        "reference/cell-file.md": cell_file_page(),
        "reference/commands.md": commands_page(),
        "reference/messages.md": messages_page(),
        "reference/codes.md": codes_page(),
        "reference/client.md": client_page(),
        "reference/thesis.md": thesis_page(),
    }


def on_files(files: Any, config: Any) -> Any:
    """mkdocs: the generated pages beside those of ``docs``."""
    from mkdocs.structure.files import File

    for name, text in generated().items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """mkdocs: links to files of the repository that are no pages become the files' names."""
    return re.sub(
        r"\[([^\]]+)\]\((?:\.\./)+((?:deploy|service|sim|drivers|tests|examples)/[^)]*)\)",
        r"\1 (`\2`)",
        markdown,
    )


def _of_the_root(name: str) -> str:
    """A page of the repository's root, with its links as from within ``docs``."""
    text = (ROOT / name).read_text(encoding="utf-8")
    for page in ("CONTRIBUTING", "CHANGELOG", "README"):
        target = {"CONTRIBUTING": "contributing", "CHANGELOG": "changes", "README": "index"}[page]
        text = text.replace(f"]({page}.md", f"]({target}.md")
    text = text.replace("](docs/", "](")
    return re.sub(rf"\]\(({FOLDERS}/)", r"](../\1", text)


# Reference: cell file and messages, from the structs that decode them


def cell_file_page() -> str:
    """Every key of a cell file with type, default and meaning."""
    from stereoservo.messages import cell_file

    lines = [
        "# Cell file",
        "",
        _text(cell_file.__doc__),
        "",
        "`stereoservo init` writes one with comments.",
        "",
    ]
    for path, section in cell_file.sections().items():
        lines += [f"## {_heading(path)}", "", _text(section.__doc__), ""]
        lines += _table(section)
    return "\n".join(lines)


def _heading(path: str) -> str:
    arrays = {"camera", "safety.limit", "safety.keep_out"}
    return "Top level" if not path else f"`[[{path}]]`" if path in arrays else f"`[{path}]`"


def _table(struct: type[msgspec.Struct]) -> list[str]:
    """Fields of a struct as rows of a table."""
    said = _field_texts(struct)
    rows = ["| key | type | default | what |", "| --- | --- | --- | --- |"]
    for field in msgspec.inspect.type_info(struct).fields:  # type: ignore[attr-defined]
        cells = (
            f"`{field.encode_name}`",
            _type_text(field.type),
            _default_text(field),
            said.get(field.name, ""),
        )
        rows.append(f"| {' | '.join(cells)} |")
    return [*rows, ""]


def _field_texts(struct: type) -> dict[str, str]:
    """What is written under, or behind, the fields of a class in its source."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(struct)))
    body = tree.body[0].body  # type: ignore[attr-defined]
    texts: dict[str, str] = {}
    for node, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            value = getattr(after, "value", None)
            if isinstance(after, ast.Expr) and isinstance(value, ast.Constant) and isinstance(value.value, str):
                texts[node.target.id] = _text(value.value).replace("\n", " ").replace("|", "\\|")
    return texts


def _default_text(field: Any) -> str:
    if field.required:
        return "required"
    if field.default is not msgspec.NODEFAULT:
        value = field.default
    else:
        value = field.default_factory()
    if isinstance(value, msgspec.Struct) or value in ((), [], {}):
        return ""
    return f"`{json.dumps(value, default=str)}`" if value is not None else ""


def _type_text(kind: Any) -> str:
    """A type of msgspec's as words."""
    name = type(kind).__name__.removesuffix("Type")
    if name == "Metadata":
        return _type_text(kind.type)
    if name == "Custom":
        return f"`{kind.cls.__name__}`"
    if name == "Union":
        return " or ".join(_type_text(part) for part in kind.types)
    if name == "Literal":
        return ", ".join(f"`{json.dumps(value)}`" for value in kind.values)
    if name in ("List", "VarTuple", "Set"):
        return f"list of {_type_text(kind.item_type)}"
    if name == "Tuple":
        return "[" + ", ".join(_type_text(part) for part in kind.item_types) + "]"
    if name == "Dict":
        return f"table of {_type_text(kind.value_type)}"
    if name == "Struct":
        return "section" if kind.cls.__name__.endswith("Section") else f"`{kind.cls.__name__}`"
    words = {"Str": "text", "Int": "integer", "Float": "number", "Bool": "true or false", "None": "null"}
    return words.get(name, "anything") + _bounds(kind)


def _bounds(kind: Any) -> str:
    """Limits of a number or text."""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = [f"{sign} {getattr(kind, key):g}" for key, sign in signs.items() if getattr(kind, key, None) is not None]
    if getattr(kind, "pattern", None):
        found.append(f"`{kind.pattern}`".replace("|", "\\|"))
    return f" ({', '.join(found)})" if found else ""


def messages_page() -> str:
    """Every message of the wire with its fields."""
    from stereoservo.messages.wire import SCHEMAS

    lines = [
        "# Messages",
        "",
        "What [the wire](../wire.md) carries, as JSON. The same as JSON Schema: key `schema/<name>` of a live cell.",
        "",
    ]
    seen: set[type] = set()
    for name, kind in SCHEMAS.items():
        lines += [f"## {name}", ""]
        for struct in _structs(msgspec.inspect.type_info(kind), seen):
            lines += [f"### `{struct.__name__}`", "", _text(struct.__doc__), "", *_table(struct)]
    return "\n".join(lines)


def _structs(kind: Any, seen: set[type]) -> Iterator[type[msgspec.Struct]]:
    """The structs of a type that were not seen yet, outer ones first."""
    if isinstance(kind, msgspec.inspect.StructType):
        if kind.cls in seen:
            return
        seen.add(kind.cls)
        yield kind.cls
        for field in kind.fields:
            yield from _structs(field.type, seen)
    for name in ("types", "item_types"):
        for part in getattr(kind, name, ()):
            yield from _structs(part, seen)
    for name in ("item_type", "value_type", "type"):
        if hasattr(kind, name):
            yield from _structs(getattr(kind, name), seen)


# Reference: commands, codes, client


def commands_page() -> str:
    """Every command with its arguments and options."""
    from typer.main import get_command

    from stereoservo.cli.dispatch import app

    group = get_command(app)
    lines = [
        "# Commands",
        "",
        "As `stereoservo COMMAND --help` prints them. Every command takes `--json`.",
        "",
    ]
    context = group.make_context("stereoservo", [], resilient_parsing=True)  # type: ignore[attr-defined]
    for name in sorted(group.list_commands(context)):  # type: ignore[attr-defined]
        command = group.get_command(context, name)  # type: ignore[attr-defined]
        sub = command.make_context(name, [], parent=context, resilient_parsing=True)
        lines += [
            f"## {name}",
            "",
            "```text",
            command.get_usage(sub).strip(),
            "```",
            "",
            _text(command.help),
            "",
        ]
        rows = [record for parameter in command.params if (record := parameter.get_help_record(sub))]
        if rows:
            lines += ["| option | what |", "| --- | --- |"]
            lines += [*(f"| `{left.strip()}` | {' '.join(right.split())} |" for left, right in rows), ""]
    return "\n".join(lines)


def codes_page() -> str:
    """Every code that a document explains in a table, with the place."""
    lines = [
        "# Codes",
        "",
        "Reasons (`state.reasons`, `stereoservo status`), refusals, faults and verdicts by code, with the page that",
        "explains each.",
        "",
        "| code | what, and what to do | page |",
        "| --- | --- | --- |",
    ]
    found: list[tuple[str, str, str]] = []
    for page in sorted((ROOT / "docs").glob("*.md")):
        for row in re.findall(r"^\| *(`[^|]+`[^|]*)\|(.+)\|$", page.read_text(encoding="utf-8"), re.M):
            for code in re.findall(r"`([A-Z][A-Z0-9]*(?:_[A-Z0-9]+)+)`", row[0]):
                what = " · ".join(cell.strip() for cell in row[1].split("|") if cell.strip())
                found.append((code, re.sub(r"\]\((?=[a-z-]+\.md)", "](../", what), page.name))
    lines += [f"| `{code}` | {what} | [{page.removesuffix('.md')}](../{page}) |" for code, what, page in sorted(found)]
    return "\n".join([*lines, ""])


def client_page() -> str:
    """The Python client's classes with their methods."""
    import stereoservo.client as client

    lines = ["# Python client", "", _text(client.__doc__), "", "`from stereoservo.client import …`:", ""]
    for name in sorted(client.__all__):
        thing = getattr(client, name)
        lines += [f"## `{name}`", "", _text(inspect.getdoc(thing) or ""), ""]
        if not inspect.isclass(thing):
            continue
        for member, function in inspect.getmembers(thing, callable):
            if member.startswith("_") or not inspect.isfunction(inspect.unwrap(function)):
                continue
            signature = str(inspect.signature(function)).replace("'", "")
            shown = ["```python", f"{member}{signature}", "```"]
            lines += [f"### `{member}`", "", *shown, "", _text(inspect.getdoc(function)), ""]
    return "\n".join(lines)


# The thesis beside the code


def thesis_page() -> str:
    """The functions whose docstrings name an equation of the thesis, by chapter."""
    named: dict[str, dict[float, set[str]]] = defaultdict(lambda: defaultdict(set))
    for path in sorted((ROOT / "service" / "stereoservo").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        module = ".".join(path.relative_to(ROOT / "service").with_suffix("").parts)
        for node in [tree, *(n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.ClassDef))]:
            where = module if isinstance(node, ast.Module) else f"{module}.{node.name}"  # type: ignore[attr-defined]
            for match in EQUATION.finditer(ast.get_docstring(node) or ""):
                chapter, first = (match[1], match[2]) if match[1] else (match[4], match[5])
                if chapter in CHAPTERS:
                    named[chapter][float(int(first))].add(where)
    lines = [
        "# The thesis and the code",
        "",
        "Andreas Ruf, *Closing the loop between articulated motion and stereo vision: a projective approach* (INPG",
        "Grenoble, 2001), beside what implements it: the functions whose descriptions name an equation or a section.",
        "Corrections: [errata](../errata.md). The experiments: `stereoservo reproduce`.",
        "",
    ]
    for chapter in sorted(named):
        lines += [f"## {chapter} {CHAPTERS[chapter]}", "", "| equation | code |", "| --- | --- |"]
        for number in sorted(named[chapter]):
            places = ", ".join(f"`{place.removeprefix('stereoservo.')}`" for place in sorted(named[chapter][number]))
            lines.append(f"| {chapter}.{number:g} | {places} |")
        lines.append("")
    return "\n".join(lines)


def _text(docstring: str | None) -> str:
    """A docstring as markdown: double backticks are single ones there."""
    return inspect.cleandoc(docstring or "").replace("``", "`")
