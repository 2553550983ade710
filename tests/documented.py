"""The commands of the documents, each with its directive from `documents.toml`, and their client programs."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("deploy/*/README.md")]
)
PROGRAMS = re.compile(
    r"(?:stereoservo|pip|python3\.11|pytest|openssl|printf|echo|cp|install|ip|systemctl|journalctl|sysctl|docker|podman|"
    r"mkdocs|cosmic-ray|\.ci/run|\S+/bin/pip|\.) "
)
"""Beginning of a command in a block that is indented."""
DIRECTIVES = Path(__file__).with_name("documents.toml")
"""Which commands are not executed, or in the slow suite alone, by page."""


class Directive(NamedTuple):
    """How commands of a page with this beginning are treated (``skip`` or ``slow``), and the reason."""

    kind: str
    beginning: str
    why: str


class Documented(NamedTuple):
    """A command of a block, its line on the page, and the directive that applies to it."""

    line: int
    command: str
    directive: Directive | None


@cache
def directives() -> dict[str, list[Directive]]:
    """The directives of all pages, by the page's path in the repository."""
    tables = tomllib.loads(DIRECTIVES.read_text(encoding="utf-8"))
    return {
        page: [Directive(kind, *one) for kind, rows in kinds.items() for one in rows.items()]
        for page, kinds in tables.items()
    }


def documented(page: Path) -> list[Documented]:
    """Commands of a page's blocks, in order; the parts of `a && b` one by one."""
    return commands_of(page.read_text(encoding="utf-8"), directives().get(page.relative_to(ROOT).as_posix(), []))


def commands_of(text: str, stated: list[Directive]) -> list[Documented]:
    """Commands in a page's text, each with the longest of the ``stated`` directives that fits it."""
    found, fence = [], ""
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            fence = "" if fence else line.strip("` ") or "text"
            continue
        shell = fence == "sh" or (not fence and line.startswith("    "))
        if not shell or not PROGRAMS.match(line.strip() + " "):
            continue
        for part in re.sub(r"\s+# .*", "", line.strip()).split(" && "):
            fitting = [one for one in stated if part.startswith(one.beginning)]
            best = max(fitting, key=lambda one: len(one.beginning), default=None)
            found.append(Documented(number, part, best))
    return found


def mistakes(page: str, stated: list[Directive]) -> list[str]:
    """What is wrong with the directives of a page: no such page, kind, command or file, or no reason."""
    if ROOT / page not in PAGES:
        return [f"{page}: no such page"]
    found = documented(ROOT / page)
    wrong = []
    for one in stated:
        where = f"{page}: {one.kind} {one.beginning!r}"
        if one.kind not in ("skip", "slow"):
            wrong.append(f"{where}: neither skip nor slow")
        if not any(command.command.startswith(one.beginning) for command in found):
            wrong.append(f"{where}: no such command on the page")
        if len(one.why.split()) < 2:
            wrong.append(f"{where}: no reason")
        named = re.findall(r"\b(?:tests|\.ci)/[\w/.]*\w", one.why)
        wrong += [f"{where}: no {path}" for path in named if not (ROOT / path).exists()]
    return wrong


def snippets(page: Path) -> list[tuple[int, str]]:
    """Python blocks of a page that are whole programs of a client, with their line."""
    text = page.read_text(encoding="utf-8")
    return [
        (text[: block.start()].count("\n") + 2, block[1])
        for block in re.finditer(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        if re.search(r"^with (Client\(|zenoh\.open)", block[1], re.MULTILINE)
    ]
