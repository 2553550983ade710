"""docs/goals-and-laws.md names every law, kind of goal, profile, picture and code that there is."""

from __future__ import annotations

import ast
import re
from dataclasses import astuple
from pathlib import Path

import pytest

from stereoservo.control.law_registry import LAWS
from stereoservo.core import command
from stereoservo.messages.goals import Target
from stereoservo.planning.path_search import SHAPES
from stereoservo.planning.plan import Limit

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "goals-and-laws.md"
SOURCES = ROOT / "service" / "stereoservo"
CODE = re.compile(r"[A-Z][A-Z_]+")

pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="an installation without the documents")


def _codes(node: ast.expr) -> set[str]:
    """Codes that a first argument may be."""
    if isinstance(node, ast.Constant):
        return {str(node.value)}
    if isinstance(node, ast.IfExp):
        return _codes(node.body) | _codes(node.orelse)
    if isinstance(node, ast.Name):
        return {str(getattr(command, node.id))} if hasattr(command, node.id) else set()
    return set()


def _told_codes() -> set[str]:
    """Codes of all refusals and reasons in the sources, those of plans and incidences besides."""
    found = set(Limit.__args__)
    for path in SOURCES.rglob("*.py"):
        tree = ast.parse(path.read_text())
        for call in ast.walk(tree):
            if isinstance(call, ast.Call) and call.args:
                name = getattr(call.func, "id", getattr(call.func, "attr", ""))
                if name in ("RefusalError", "Reason"):
                    found |= _codes(call.args[0])
        if path.name == "incidence.py":
            found |= {
                constant.value
                for constant in ast.walk(tree)
                if isinstance(constant, ast.Constant)
                and isinstance(constant.value, str)
                and re.fullmatch(r"INCIDENCES?_[A-Z_]+", constant.value)
            }
    return found


def test_every_code_is_explained():
    written = set(re.findall(r"`([A-Z][A-Z_]+)`", PAGE.read_text()))
    told = _told_codes()
    assert len(told) > 60
    assert all(CODE.fullmatch(code) for code in told), told
    assert sorted(told - written) == []
    # and none that is not told any more
    assert sorted(written - told - {"FAR", "NEAR", "CELL"}) == []


def test_every_law_kind_and_profile_is_there():
    text = PAGE.read_text()
    kinds = {target.__struct_config__.tag for target in Target.__args__}
    for name in (*LAWS, *kinds, *SHAPES):
        assert f"`{name}`" in text, name


def test_the_table_of_laws_is_what_the_laws_say_of_themselves():
    rows = re.findall(r"^\| `([a-z0-9-]+)` \|(.*)\|$", PAGE.read_text().split("## Laws")[1], re.MULTILINE)
    written = {}
    for name, cells in rows:  # the first table; the others are measurements
        written.setdefault(name, tuple(cell.strip() for cell in cells.split("|")))
    assert written == {name: astuple(law.properties) for name, law in LAWS.items()}


def test_pictures_are_kept_small():
    pictures = re.findall(r"\]\((pictures/[a-z-]+\.png)\)", PAGE.read_text())
    assert len(pictures) == 6
    for picture in pictures:
        assert 1_000 < (PAGE.parent / picture).stat().st_size <= 60_000
