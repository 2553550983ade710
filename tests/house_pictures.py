"""The two pictures in docs/design.md that are drawn from the code: which packages import which, and an image's path to
a joint velocity as it runs. ``python tests/house_pictures.py`` draws them again; `test_house.py` compares.
"""

from __future__ import annotations

import re
from itertools import groupby
from pathlib import Path

import house_figures as house

DESIGN = house.ROOT / "docs" / "design.md"
PACKAGES, IMAGE_PATH = "%% packages", "%% image path"
"""Second lines of the pictures, by which they are found in the page."""


def draw_packages() -> str:
    """Mermaid flowchart of the packages: an arrow to each that one imports and that none of its others reaches."""
    names = {house._dotted(path): path for path in house.modules()}
    graph: dict[str, set[str]] = {}
    for name, path in names.items():
        imported = {_package(other) for other in house._imported(path, set(names))}
        graph.setdefault(_package(name), set()).update(imported - {_package(name), ""})
    del graph[""]
    lines = [
        f"    {package} --> {other}"
        for package, others in sorted(graph.items())
        for other in sorted(others)
        if not any(other in house.reached(graph, between) for between in others - {other})
    ]
    return "\n".join(["flowchart TD", PACKAGES, *lines])


def _package(module: str) -> str:
    """``core`` of ``stereoservo.core.ingest``; ``drivers``, ``sim`` or ``sim.world`` of the other distributions; empty
    for the root of the service.
    """
    root, *parts = module.split(".")
    if root == "stereoservo":
        return parts[0] if parts else ""
    return "sim.world" if parts[:1] == ["world"] else root.removeprefix("stereoservo_")


def draw_image_path(path: house.CallPath) -> str:
    """Mermaid flowchart of a traced ``path``: its files in the order in which they are entered, each with the function
    that is entered first; those of a package that follow each other in one box.
    """
    first: dict[str, str] = {}
    for file, function in path.functions:
        first.setdefault(file, function)
    entries = [(*_place(file), function) for file, function in first.items()]
    boxes = []
    for package, group in groupby(entries, key=lambda entry: entry[0]):
        inside = "<br>".join(f"{file}: {function}" for _, file, function in group)
        boxes.append(f'["<b>{package}</b><br>{inside}"]')
    lines = [f"    {k}{box}" for k, box in enumerate(boxes)]
    chain = " --> ".join(map(str, range(len(boxes))))
    return "\n".join(["flowchart TD", IMAGE_PATH, *lines, f"    {chain}"])


def _place(file: str) -> tuple[str, str]:
    """Package, and file in it, without its ending."""
    folder = next(folder for folder in house.PRODUCT if (house.ROOT / file).is_relative_to(folder))
    inside = Path(file).relative_to(folder.relative_to(house.ROOT)).with_suffix("")
    if folder == house.SERVICE:
        return inside.parts[0], "/".join(inside.parts[1:])
    return folder.name.removeprefix("stereoservo_"), str(inside)


def drawn(text: str, mark: str) -> str:
    """The picture with this ``mark`` in the ``text`` of a page. Raises ValueError where there is not one."""
    found = re.findall(rf"```mermaid\n(flowchart \w+\n{mark}\n.*?)\n```", text, re.DOTALL)
    if len(found) != 1:
        raise ValueError(f"{len(found)} pictures {mark!r} in the page; one is needed")
    return found[0]


def main() -> None:
    """Draw both pictures in the page again."""
    text = DESIGN.read_text("utf-8")
    for mark, picture in ((PACKAGES, draw_packages()), (IMAGE_PATH, draw_image_path(house.image_path()))):
        text = text.replace(drawn(text, mark), picture)
    DESIGN.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
