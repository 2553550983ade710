"""Definitions of the product that no entry point reaches: `python tests/reach.py`.

What later work needs is listed with its reason in docs/design.md, "Kept for later work".

Entry points are those of pyproject.toml, the code that a module runs when it is imported, functions that a decorator
registers (a command line's verbs), the goal client, and the contract suites for drivers of third parties. From there
names are followed through imports; a method is reached when its class is and its name is used as an attribute anywhere
that is reached.
What is printed is a lower bound: a name that is only mentioned counts as used.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {
    "stereoservo": "service/stereoservo",
    "stereoservo_drivers": "drivers/stereoservo_drivers",
    "stereoservo_sim": "sim/stereoservo_sim",
}
PUBLIC = (
    "stereoservo_drivers.contracts", "stereoservo_drivers.kit", "stereoservo.control.contracts", "stereoservo.client",
)  # fmt: skip
"""What others import: suites that makers of drivers subclass, the goal client. All of it is an entry point."""
FOUND_BY_NAME = ("run_", "report_", "draw_", "show_", "notes_", "compare_")
"""Functions that an experiment's declaration finds in the modules that it names."""
KEPT_HEADING = "## Kept for later work"
NEUTRAL_DECORATORS = {
    "abstractmethod", "asynccontextmanager", "cache", "cached_property", "classmethod", "contextmanager",
    "dataclass", "kernel", "lru_cache", "njit", "override", "property", "runtime_checkable", "setter",
    "staticmethod", "total_ordering", "wraps",
}  # fmt: skip
"""Decorators that register nothing: what they decorate is reached by its name alone."""
INTERNAL_BASES = {
    "ABC", "Enum", "Exception", "Generic", "IntEnum", "NamedTuple", "Protocol", "RuntimeError", "StrEnum",
    "Struct", "ValueError", "object",
}  # fmt: skip
"""Bases from elsewhere that call no method of a class by name."""

Key = tuple[str, str]
"""Module and qualified name of a definition."""


@dataclass
class Mentions:
    """Names that a piece of code uses."""

    definitions: set[Key] = field(default_factory=set)
    attributes: set[str] = field(default_factory=set)
    modules: set[str] = field(default_factory=set)
    """Modules that a string names, below the package of the module that holds it."""

    def add(self, other: Mentions) -> None:
        self.definitions |= other.definitions
        self.attributes |= other.attributes
        self.modules |= other.modules


@dataclass
class Definition:
    """A function, class or method of the product."""

    key: Key
    path: str
    first_line: int
    lines: int
    mentions: Mentions
    registered: bool = False
    foreign_base: bool = False

    @property
    def owner(self) -> Key | None:
        """Class of a method."""
        module, name = self.key
        return (module, name.rpartition(".")[0]) if "." in name else None


@dataclass
class Product:
    """All definitions and what runs without being called."""

    definitions: dict[Key, Definition]
    roots: Mentions


def _module_name(path: Path, package: str, folder: Path) -> str:
    parts = path.relative_to(folder).with_suffix("").parts
    return ".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)])


def _sources(root: Path) -> Iterator[tuple[str, Path]]:
    for package, folder in PACKAGES.items():
        for path in sorted((root / folder).rglob("*.py")):
            yield _module_name(path, package, root / folder), path


class Scope:
    """Names of one module: its own definitions and what it imports."""

    def __init__(self, module: str, tree: ast.Module, modules: set[str]) -> None:
        self.modules = modules
        self.package = module.rpartition(".")[0]
        self.names: dict[str, Key] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    self.names[alias.asname or alias.name] = (node.module, alias.name)
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    if alias.asname:
                        self.names[alias.asname] = (alias.name, "")
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                self.names[node.name] = (module, node.name)

    def mentions(self, nodes: Iterable[ast.AST]) -> Mentions:
        result = Mentions()
        for start in nodes:
            for node in ast.walk(start):
                self._take(node, result)
        return result

    def _take(self, node: ast.AST, result: Mentions) -> None:
        if isinstance(node, ast.Name) and node.id in self.names:
            result.definitions.add(self.names[node.id])
        elif isinstance(node, ast.Attribute):
            result.attributes.add(node.attr)
            if (module := self._dotted(node.value)) is not None:
                result.definitions.add((module, node.attr))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if f"{self.package}.{node.value}" in self.modules:
                result.modules.add(f"{self.package}.{node.value}")
            if re.fullmatch(r"[A-Za-z_]\w*", node.value):
                result.attributes.add(node.value)
                if node.value in self.names:  # an annotation in quotes
                    result.definitions.add(self.names[node.value])
            elif re.fullmatch(r"[\w.]+:[\w.]+", node.value):
                module, _, name = node.value.partition(":")
                below = f"{self.package}.{module}"
                result.definitions.add((below if below in self.modules else module, name))

    def _dotted(self, node: ast.expr) -> str | None:
        """The module that ``node`` stands for."""
        if isinstance(node, ast.Attribute):
            base = self._dotted(node.value)
            name = f"{base}.{node.attr}" if base else ast.unparse(node)
        elif isinstance(node, ast.Name):
            module, attribute = self.names.get(node.id, (node.id, ""))
            name = f"{module}.{attribute}" if attribute else module
        else:
            return None
        return name if name in self.modules else None


def _last_name(node: ast.expr) -> str:
    node = node.func if isinstance(node, ast.Call) else node
    node = node.value if isinstance(node, ast.Subscript) else node
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def _registered(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> bool:
    return any(_last_name(d) not in NEUTRAL_DECORATORS for d in node.decorator_list)


def read_product(root: Path = ROOT) -> Product:
    """Definitions of the three packages below ``root`` and the names that are used from outside of them."""
    trees = {module: (path, ast.parse(path.read_text("utf-8"))) for module, path in _sources(root)}
    scopes = {module: Scope(module, tree, set(trees)) for module, (_, tree) in trees.items()}
    product = Product({}, _entry_points(root))
    for module, (path, tree) in trees.items():
        relative = path.relative_to(root).as_posix()
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                _add(product, scopes[module], module, relative, node.name, node, [node])
            elif isinstance(node, ast.ClassDef):
                _add_class(product, scopes[module], module, relative, node)
            elif not isinstance(node, ast.Import | ast.ImportFrom):
                product.roots.add(scopes[module].mentions([node]))
    _follow_reexports(product, scopes)
    return product


def _add(
    product: Product,
    scope: Scope,
    module: str,
    path: str,
    name: str,
    node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef,
    parts: list[ast.AST],
) -> Definition:
    lines = (node.end_lineno or node.lineno) - node.lineno + 1
    definition = Definition((module, name), path, node.lineno, lines, scope.mentions(parts), _registered(node))
    product.definitions[definition.key] = definition
    return definition


def _add_class(product: Product, scope: Scope, module: str, path: str, node: ast.ClassDef) -> None:
    methods = [part for part in node.body if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef)]
    called = [part for part in methods if part.name.startswith("__")]
    rest: list[ast.AST] = [part for part in node.body if part not in methods]
    owner = _add(product, scope, module, path, node.name, node, [*rest, *called, *node.bases, *node.decorator_list])
    bases = [base for base in node.bases if _last_name(base) not in INTERNAL_BASES]
    own_packages = tuple(PACKAGES)
    owner.foreign_base = any(
        not scope.names.get(_last_name(base), ("", ""))[0].startswith(own_packages) for base in bases
    )
    for method in methods:
        if method not in called:
            _add(product, scope, module, path, f"{node.name}.{method.name}", method, [method])


def _entry_points(root: Path) -> Mentions:
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    groups = [project["scripts"], *project["entry-points"].values()]
    result = Mentions()
    for target in (target for group in groups for target in group.values()):
        module, _, name = target.partition(":")
        result.definitions.add((module, name))
    return result


def _follow_reexports(product: Product, scopes: dict[str, Scope]) -> None:
    """Names that a package passes on count for the definition itself."""

    def resolved(key: Key) -> Key:
        for _ in range(5):
            scope = scopes.get(key[0])
            if key in product.definitions or scope is None or key[1] not in scope.names:
                return key
            key = scope.names[key[1]]
        return key

    for mentions in [product.roots, *(d.mentions for d in product.definitions.values())]:
        mentions.definitions = {resolved(key) for key in mentions.definitions}


def unreached(product: Product) -> list[Definition]:
    """Definitions that nothing reaches; methods of a class that is not reached itself are left out."""
    definitions = product.definitions
    used = Mentions()
    used.add(product.roots)
    for definition in definitions.values():
        if definition.owner is None and (definition.registered or definition.key[0].startswith(PUBLIC)):
            used.definitions.add(definition.key)
    live: set[Key] = set()
    while new := {key for key, d in definitions.items() if key not in live and _is_live(d, product, used, live)}:
        live |= new
        for key in new:
            used.add(definitions[key].mentions)
    return [d for key, d in definitions.items() if key not in live and (d.owner is None or d.owner in live)]


def _is_live(definition: Definition, product: Product, used: Mentions, live: set[Key]) -> bool:
    if definition.owner is not None:
        return definition.owner in live and _is_used(definition, product, used)
    module, name = definition.key
    return definition.key in used.definitions or (module in used.modules and name.startswith(FOUND_BY_NAME))


def _is_used(method: Definition, product: Product, used: Mentions) -> bool:
    owner = product.definitions[method.owner or ("", "")]
    if method.key[0].startswith(PUBLIC):
        return True
    return method.registered or owner.foreign_base or method.key[1].rpartition(".")[2] in used.attributes


def kept_for_later(root: Path = ROOT) -> dict[str, str]:
    """What the table in docs/design.md keeps, as ``module:name`` or ``module`` for all of it, with the reason.

    Raises ValueError for a row without a reason and a caller to come.
    """
    text = (root / "docs" / "design.md").read_text("utf-8")
    section = text.partition(KEPT_HEADING)[2].partition("\n## ")[0]
    kept: dict[str, str] = {}
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not line.startswith("| `"):
            continue
        if len(cells) != 3 or not all(cells):
            raise ValueError(f"docs/design.md: {line!r} needs definitions, a reason and the caller to come")
        for name in re.findall(r"`([^`]+)`", cells[0]):
            kept[name] = f"{cells[1]}; {cells[2]}"
    return kept


def _short(module: str) -> str:
    return module.removeprefix("stereoservo.")


def is_kept(definition: Definition, kept: Iterable[str]) -> str | None:
    """The row that keeps a definition, if any."""
    module, name = definition.key
    for row in kept:
        if row in (_short(module), f"{_short(module)}:{name}", f"{_short(module)}:{name.partition('.')[0]}"):
            return row
    return None


def report(root: Path = ROOT) -> tuple[list[Definition], list[str]]:
    """Definitions that nothing reaches and no row keeps, and rows that keep nothing."""
    kept = kept_for_later(root)
    dead = unreached(read_product(root))
    rows = {d.key: is_kept(d, kept) for d in dead}
    return [d for d in dead if rows[d.key] is None], sorted(set(kept) - set(rows.values()))


def main() -> int:
    """Print what nothing reaches; 1 where something is on no list."""
    stray, empty = report()
    for definition in stray:
        print(f"{definition.path}:{definition.first_line}: {definition.key[1]} ({definition.lines} lines)")
    for row in empty:
        print(f"docs/design.md: `{row}` is kept for later work, but is reached or is not there")
    lines = sum(d.lines for d in stray)
    print(f"{len(stray)} definitions, {lines} lines, are reached by no entry point and kept by no row")
    return 1 if stray or empty else 0


if __name__ == "__main__":
    sys.exit(main())
