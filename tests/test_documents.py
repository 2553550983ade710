"""The documents' commands are commands of this version, their links lead somewhere, and the site can be built."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from documented import PAGES, ROOT, Directive, commands_of, directives, mistakes
from stereoservo.cli.dispatch import app

PLACEHOLDER = re.compile(r"[A-Z][A-Z_]*\d*")
"""A word that stands for a value of the reader's."""

pytestmark = pytest.mark.skipif(not (ROOT / "docs").exists(), reason="an installation without the documents")


def commands(text: str) -> Iterator[tuple[str, bool]]:
    """Command lines of a page, and whether each is whole: a block's, not a sentence's."""
    fenced = False
    for line in text.splitlines():
        fenced ^= line.lstrip().startswith("```")
        block = re.match(r"(?: {4,})?(?=stereoservo |pip )(.*)", line) if fenced or line.startswith("    ") else None
        found = [block[1]] if block else re.findall(r"`((?:stereoservo|pip install) [^`]+)`", line)
        for command in found:
            for part in re.split(r"&&|(?<!\|)\|(?!\|)", re.sub(r"(?:\s#\s|\s{2,}#).*", "", command)):
                if part.strip().startswith("stereoservo "):
                    yield part.strip().removesuffix("&").strip(), block is not None


def examined(command: str, whole: bool) -> str:
    """What is wrong with a command line of a document; empty where nothing is."""
    words = [word for word in shlex.split(re.sub(r"[\[\]]", "", command)[12:]) if word != "…" and "…" not in word]
    if not words or PLACEHOLDER.fullmatch(words[0]) or words[0].startswith("--"):
        return ""
    group: Any = get_command(app)
    context = group.make_context("stereoservo", [], resilient_parsing=True)
    verb = group.get_command(context, words[0])
    if verb is None:
        return f"{command}: no command {words[0]!r}"
    known = {name for parameter in verb.params for name in (*parameter.opts, *parameter.secondary_opts)}
    unknown = [word for word in words if word.startswith("--") and word.partition("=")[0] not in {*known, "--help"}]
    if unknown:
        return f"{command}: {words[0]} has no {', '.join(unknown)}"
    if not whole:
        return ""
    try:
        verb.make_context(words[0], words[1:], parent=context)
    except Exception as error:
        if any(PLACEHOLDER.fullmatch(word) for word in words[1:]) and "Invalid value" in repr(error):
            return ""
        return f"{command}: {error!r}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_documented_command_is_one(page: Path) -> None:
    found = list(commands(page.read_text(encoding="utf-8")))
    assert [problem for command, whole in found if (problem := examined(command, whole))] == []


def test_commands_that_are_none_are_found() -> None:
    text = "    stereoservo gaol mycell dock\n    stereoservo goal mycell --chekc\nas `stereoservo status --all` says\n"
    assert sum(bool(examined(command, whole)) for command, whole in commands(text)) == 3


@pytest.mark.parametrize("page", directives())
def test_directives_name_commands_of_their_page_and_a_reason(page: str) -> None:
    """tests/hil/test_documented_commands.py executes all other commands."""
    assert mistakes(page, directives()[page]) == []


def test_directives_of_missing_pages_and_commands_are_found() -> None:
    right = Directive("skip", "stereoservo demo", "takes minutes")
    assert mistakes("README.md", [right]) == []
    assert mistakes("docs/missing.md", [right]) == ["docs/missing.md: no such page"]
    for wrong in (
        right._replace(kind="never"),
        right._replace(beginning="stereoservo dance"),
        right._replace(why=""),
        right._replace(why="takes minutes; tests/test_missing.py runs it"),
    ):
        assert len(mistakes("README.md", [wrong])) == 1, wrong


def test_the_longest_directive_that_fits_a_command_applies() -> None:
    stated = [
        Directive("skip", "stereoservo demo", "a b"),
        Directive("slow", "stereoservo demo --cell", "a b"),
    ]
    text = "    stereoservo demo --cell wide\n    stereoservo demo && stereoservo status mycell\n"
    kinds = [one.directive and one.directive.kind for one in commands_of(text, stated)]
    assert kinds == ["slow", "skip", None]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_hold_no_comments(page: Path) -> None:
    """Directives for the tests are in tests/documents.toml, not on the pages."""
    assert "<!--" not in page.read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as they are made on the site and where repositories are hosted."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip()) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_somewhere(page: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"https?://|mailto:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path) if path else page
        if path.startswith("reference/") and path in generated():
            continue
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            broken.append(target)
    assert broken == []


def test_the_package_index_shows_the_readme_without_links_into_the_repository() -> None:
    """As `hatch-fancy-pypi-readme` makes it when the wheel is built."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for one in project["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(one["pattern"], one["replacement"], text)
    assert re.findall(r"\]\((?!https?:)[^)]*\)", text) == []
    assert "<!--" not in text
    assert "CONTRIBUTING.md" in text


@cache
def generated() -> dict[str, str]:
    """The pages of the site that are made from the code."""
    spec = importlib.util.spec_from_file_location("pages", ROOT / "docs" / "site" / "pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generated()


def test_the_reference_holds_every_key_command_message_and_method() -> None:
    from stereoservo.client import Client
    from stereoservo.messages.cell_file import sections
    from stereoservo.messages.wire import SCHEMAS

    pages = generated()
    for section in sections().values():
        for field in section.__struct_fields__:
            assert f"| `{field}` |" in pages["reference/cell-file.md"]
    group: Any = get_command(app)
    for name in group.list_commands(None):
        assert f"\n## {name}\n" in pages["reference/commands.md"]
    for name in SCHEMAS:
        assert f"\n## {name}\n" in pages["reference/messages.md"]
    for name in ("goal", "teach", "stop", "calibrate", "watch"):
        assert hasattr(Client, name)
        assert f"\n### `{name}`\n" in pages["reference/client.md"]
    assert "| 5.21 |" in pages["reference/thesis.md"]
    assert "| `JOINTS_STALE` |" in pages["reference/codes.md"]


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="needs .[docs]: mkdocs-material")
def test_the_site_can_be_built(tmp_path: Path) -> None:
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        check=False, cwd=ROOT, capture_output=True, text=True, timeout=240,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert "Cell file" in (tmp_path / "site" / "reference" / "cell-file" / "index.html").read_text(encoding="utf-8")
