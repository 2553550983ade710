"""Nothing is in the product that the product does not run."""

from pathlib import Path

import pytest

from reach import kept_for_later, read_product, report, unreached

PROJECT = """
[project.scripts]
run = "stereoservo.main:main"
[project.entry-points."stereoservo.laws"]
law = "stereoservo.laws:Law"
"""
MAIN = """
from stereoservo import laws as known
from stereoservo.helpers import helped as aid
TABLE = {"verb": "helpers:verb"}
def main():
    aid()
    return known.chosen
def forgotten():
    return main()
"""
LAWS = """
class Law:
    def step(self): return self.scaled()
    def scaled(self): return 1.0
    def never(self): return 2.0
def chosen(): return Law().step()
def unchosen(): return Law()
"""
HELPERS = """
def helped(): return deeper()
def deeper(): return 1
def verb(): return 2
def unused(): return also_unused()
def also_unused(): return 3
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    package = tmp_path / "service" / "stereoservo"
    package.mkdir(parents=True)
    (tmp_path / "docs").mkdir()
    (tmp_path / "pyproject.toml").write_text(PROJECT)
    for name, text in {"__init__": "", "main": MAIN, "laws": LAWS, "helpers": HELPERS}.items():
        (package / f"{name}.py").write_text(text)
    return tmp_path


def kept(tree: Path, *rows: str) -> None:
    table = "\n".join(rows)
    (tree / "docs" / "design.md").write_text(f"# Design\n\n## Kept for later work\n\n{table}\n\n## Next\n")


def test_what_no_entry_point_reaches_is_found(tree):
    names = {definition.key[1] for definition in unreached(read_product(tree))}
    assert names == {"forgotten", "Law.never", "unchosen", "unused", "also_unused"}


def test_a_row_keeps_what_it_names_and_a_row_for_nothing_is_found(tree):
    kept(tree, "| `helpers`, `laws:Law.never` | because | somebody |", "| `laws:chosen` | because | somebody |")
    stray, empty = report(tree)
    assert {definition.key[1] for definition in stray} == {"forgotten", "unchosen"}
    assert empty == ["laws:chosen"]


def test_a_row_without_a_caller_to_come_is_refused(tree):
    kept(tree, "| `helpers` | because | |")
    with pytest.raises(ValueError, match="caller to come"):
        kept_for_later(tree)


def test_the_product_holds_nothing_that_it_does_not_run_but_what_is_kept_for_later():
    stray, empty = report()
    assert [f"{definition.path}: {definition.key[1]}" for definition in stray] == []
    assert empty == []
