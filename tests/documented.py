"""What the documents tell their readers to type: commands with their markers, and programs that are clients."""

from __future__ import annotations

import re
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
MARKER = re.compile(r"<!-- (not executed|slow): (.+?): (.+?) -->")


class Marker(NamedTuple):
    """That commands which begin so are ``not executed`` by the tests, or ``slow``, and why."""

    kind: str
    beginning: str
    why: str


class Documented(NamedTuple):
    """A command of a block, and its line on the page."""

    line: int
    command: str
    marker: Marker | None


def markers(text: str) -> list[Marker]:
    """The markers of a page."""
    return [Marker(*found) for found in MARKER.findall(text)]


def documented(text: str) -> list[Documented]:
    """Commands of a page's blocks, in order; the parts of `a && b` one by one."""
    found, fence = [], ""
    marked = markers(text)
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            fence = "" if fence else line.strip("` ") or "text"
            continue
        shell = fence == "sh" or (not fence and line.startswith("    "))
        if not shell or not PROGRAMS.match(line.strip() + " "):
            continue
        for part in re.sub(r"\s+# .*", "", line.strip()).split(" && "):
            known = [one for one in marked if part.startswith(one.beginning)]
            found.append(Documented(number, part, known[0] if known else None))
    return found


def snippets(page: Path) -> list[tuple[int, str]]:
    """Python blocks of a page that are whole programs of a client, with their line."""
    text = page.read_text(encoding="utf-8")
    return [
        (text[: block.start()].count("\n") + 2, block[1])
        for block in re.finditer(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        if re.search(r"^with (Client\(|zenoh\.open)", block[1], re.MULTILINE)
    ]
