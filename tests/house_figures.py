"""Figures of the code's structure: files that one servo step enters, sizes, import circles, names used twice.

``python tests/house_figures.py`` prints them and exits 1 where one is beyond its limit; `test_house.py` holds them.
It uses nothing of the product but what it measures.
"""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = tuple(
    ROOT / part for part in ("service/stereoservo", "drivers/stereoservo_drivers", "sim/stereoservo_sim")
)
SERVICE = PRODUCT[0]

STEADY_FILES, STEADY_HOPS, ACCEPTING_FILES, IMAGE_FILES = 12, 40, 20, 18
FOLDER_MODULES, MODULE_LINES, FUNCTION_LINES = 20, 600, 80
KERNEL_ARGUMENTS, CORE_KERNELS = 6, 33
"""Arguments of a kernel; and kernels of the core that have more, as long as there are any."""
LAWS = ("stereo", "cartesian3")
LAW_NAMES = re.compile(r"""["'](stereo|cartesian3|cartesian2)["']""")
"""Names that are nothing but laws: `image`, `points` and `trajectory` are words of other things, too."""


class CallPath(NamedTuple):
    """The ``files`` entered by a call, and its ``hops``: consecutive function calls that are in different files."""

    files: frozenset[str]
    hops: int


class Figure(NamedTuple):
    """A figure and its limit; ``items``: what is beyond, or what it counts."""

    name: str
    value: int
    limit: int
    items: tuple[str, ...] = ()

    @property
    def within(self) -> bool:
        return self.value <= self.limit


# -- paths through the code -------------------------------------------------------------------------------------


def traced(call: Callable[[], Any]) -> CallPath:
    """The product's files that ``call`` enters. Compiled kernels that Python calls count as functions."""
    files: set[str] = set()
    last, hops = "", 0
    installed = {f"{_installed(folder.name)}/": folder.relative_to(ROOT) for folder in PRODUCT}
    inside = tuple(installed)

    def enter(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal last, hops
        name = frame.f_code.co_filename
        if event != "call" or not name.startswith(inside) or name.endswith(LOADING):
            return
        root = next(root for root in inside if name.startswith(root))
        files.add(str(installed[root] / name.removeprefix(root)))
        hops += bool(last) and name != last
        last = name

    before = sys.getprofile()
    sys.setprofile(enter)
    try:
        call()
    finally:
        sys.setprofile(before)
    return CallPath(frozenset(files), hops)


def _installed(package: str) -> Path:
    """The folder from which a package is imported: this tree's, or that of an installed wheel."""
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent


def _load(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


LOADING = ("numerics/kernel_cache.py", "numerics/compilation.py")
"""Run where a kernel is compiled or loaded, which the service does before its loop."""


def servo_paths(law: str, steps: int = 40) -> tuple[CallPath, CallPath]:
    """Of a core that drives to a goal by ``law``: the longest path of a steady step, and the goal-accepting one.

    A steady step is one in which frames arrive and the core emits no event; the goal is accepted from its request to
    the event ``goal_started``, and the step of these that enters the most files counts.
    """
    from stereoservo.control import law_registry
    from stereoservo.messages.goals import FeatureTarget

    bench_module = _load("house_bench", ROOT / "tests/core/conftest.py")
    bench = bench_module.make_bench(0, 0.02, k1=-0.1).ready()
    step = bench.core.step
    steady, accepting = [], []
    started = False
    len(law_registry.LAWS)  # the laws are imported once, before the loop begins

    def measured(inputs: Any) -> Any:
        nonlocal started
        outputs: list[Any] = []
        path = traced(lambda: outputs.append(step(inputs)))
        if not started:
            accepting.append(path)
        elif inputs.observations and not outputs[0].events:
            steady.append(path)
        started = started or any(event.kind == "goal_started" for event in outputs[0].events)
        return outputs[0]

    bench.core.step = measured
    bench.step(bench.goal(FeatureTarget(bench.features(bench_module.BASE + 0.1)), law=law))
    for _ in range(200):
        bench.step()
        if len(steady) >= steps:
            break
    if not steady or not started:
        raise RuntimeError(f"no steady step with law {law}: {[event.message for event in bench.events]}")
    return _longest(steady), _longest(accepting)


def _longest(paths: list[CallPath]) -> CallPath:
    """Of several paths, the most files and the most hops."""
    most = max(paths, key=lambda path: len(path.files))
    return CallPath(most.files, max(path.hops for path in paths))


def vision_path() -> CallPath:
    """From a camera's image to its observation: the vision process's pipeline, with detector `dots` and a prior."""
    sys.path.insert(0, str(ROOT / "tests/drivers/detectors"))
    try:
        parent = ModuleType("house_detectors")
        parent.__path__ = [str(ROOT / "tests/drivers/detectors")]
        sys.modules["house_detectors"] = parent
        scenes = importlib.import_module("house_detectors.scenes")
    finally:
        sys.path.pop(0)
    from stereoservo.daemon.ipc_messages import PRIOR_CAPACITY, PRIOR_LAYOUT, encode_prior
    from stereoservo.daemon.seqlock import SlotWriter
    from stereoservo.daemon.vision import CameraPipeline, VisionSlots
    from stereoservo.messages.directories import CellDirectories

    shot = scenes.random_shot(np.random.default_rng(5))

    class Driver:
        def poll(self) -> tuple[Any, ...]:
            return (shot.frame,)

    with tempfile.TemporaryDirectory() as folder:
        directories = CellDirectories("house", Path(folder), Path(folder))
        priors = SlotWriter(directories.prior_slot("left"), PRIOR_CAPACITY, PRIOR_LAYOUT)
        links = VisionSlots(directories, "left")
        pipeline = CameraPipeline(Driver(), scenes.make_detector(), links, scenes.Still())  # type: ignore[arg-type]
        pipeline.poll()
        priors.write(encode_prior(shot.prior()))
        pipeline.poll()
        priors.write(encode_prior(shot.prior()))
        path = traced(pipeline.poll)
        links.close()
        priors.close()
        return path


def path_figures() -> list[Figure]:
    """Files and hops of the servo step, and from image to joint velocity."""
    found = []
    for law in LAWS:
        steady, accepting = servo_paths(law)
        found += [
            Figure(f"files in a steady step, {law}", len(steady.files), STEADY_FILES, tuple(sorted(steady.files))),
            Figure(f"hops in a steady step, {law}", steady.hops, STEADY_HOPS),
            Figure(f"files in the goal-accepting step, {law}", len(accepting.files), ACCEPTING_FILES,
                   tuple(sorted(accepting.files))),
        ]  # fmt: skip
        if law == LAWS[0]:
            files = steady.files | vision_path().files
            found.append(
                Figure("files from image to velocity", len(files), IMAGE_FILES, tuple(sorted(files)))
            )
    return found


# -- sizes and names ------------------------------------------------------------------------------------------


def modules() -> Iterator[Path]:
    """All modules of the product."""
    for folder in PRODUCT:
        yield from sorted(folder.rglob("*.py"))


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def folder_figure() -> Figure:
    """Folders with too many modules, `cli` aside."""
    count: dict[Path, int] = defaultdict(int)
    for path in modules():
        count[path.parent] += path.name != "__init__.py"
    beyond = [f"{_name(f)}: {n}" for f, n in count.items() if n > FOLDER_MODULES and f.name != "cli"]
    return Figure(f"folders above {FOLDER_MODULES} modules", len(beyond), 0, tuple(beyond))


def module_figure() -> Figure:
    """Modules that are too long."""
    lengths = {path: len(path.read_text().splitlines()) for path in modules()}
    beyond = [f"{_name(path)}: {n}" for path, n in lengths.items() if n > MODULE_LINES]
    return Figure(f"modules above {MODULE_LINES} lines", len(beyond), 0, tuple(beyond))


def function_figure() -> Figure:
    """Functions that are too long."""
    beyond = []
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or node.lineno) - node.lineno + 1
                if length > FUNCTION_LINES:
                    beyond.append(f"{_name(path)}:{node.lineno} {node.name}: {length}")
    return Figure(f"functions above {FUNCTION_LINES} lines", len(beyond), 0, tuple(beyond))


def kernel_arguments() -> dict[str, list[str]]:
    """Of each module, the kernels that have too many arguments, and how many."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in modules():
        for name, count in _kernels(ast.parse(path.read_text())):
            if count > KERNEL_ARGUMENTS:
                found[_name(path)].append(f"{name} {count}")
    return found


def _kernels(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Functions with a decorator of `numerics.compilation`, each with the number of its arguments."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        decorators = {
            inner.id for one in node.decorator_list for inner in ast.walk(one) if isinstance(inner, ast.Name)
        }
        if any(name.endswith("kernel") for name in decorators):
            a = node.args
            yield node.name, len(a.posonlyargs + a.args + a.kwonlyargs)


def argument_figures() -> list[Figure]:
    """Kernels with too many arguments: in the core, where there may be no more than there were, and elsewhere."""
    found = kernel_arguments()
    figures = []
    for where, limit in (("in the core", CORE_KERNELS), ("elsewhere", 0)):
        mine = {
            path: names
            for path, names in found.items()
            if path.startswith("service/stereoservo/core/") == (where == "in the core")
        }
        figures.append(
            Figure(
                f"kernels with more than {KERNEL_ARGUMENTS} arguments, {where}",
                sum(map(len, mine.values())),
                limit,
                tuple(f"{path}: {', '.join(names)}" for path, names in mine.items()),
            )
        )
    return figures


def circle_figure() -> Figure:
    """Groups of modules that import each other when they are loaded."""
    imports = {_dotted(path): path for path in modules()}
    graph = {name: _imported(path, set(imports)) - {name} for name, path in imports.items()}
    circles = tuple(" - ".join(sorted(group)) for group in _strongly_connected(graph))
    return Figure("import circles", len(circles), 0, circles)


def _dotted(path: Path) -> str:
    folder = next(folder for folder in PRODUCT if folder in path.parents)
    parts = (folder.name, *path.relative_to(folder).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(path: Path, known: set[str]) -> set[str]:
    found = set()
    for node in _module_level(ast.parse(path.read_text()).body):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in known else node.module)
    return found & known


def _module_level(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    for node in body:
        if isinstance(node, ast.Try) or (
            isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.dump(node.test)
        ):
            yield from _module_level(node.body)
        else:
            yield node


def _strongly_connected(graph: dict[str, set[str]]) -> Iterator[set[str]]:
    """Groups of two or more nodes of which each reaches every other one."""
    reach: dict[str, set[str]] = {}
    for start in graph:
        seen: set[str] = set()
        ahead = list(graph[start])
        while ahead:
            node = ahead.pop()
            if node not in seen:
                seen.add(node)
                ahead.extend(graph[node])
        reach[start] = seen
    done: set[str] = set()
    for node in graph:
        if node in reach[node] and node not in done:
            group = {other for other in reach[node] if node in reach[other]}
            done |= group
            yield group


def repeated_classes() -> dict[str, list[str]]:
    """Class names that are defined more than once, and where."""
    where: dict[str, list[str]] = defaultdict(list)
    for path in modules():
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef):
                where[node.name].append(_name(path))
    return {name: paths for name, paths in sorted(where.items()) if len(paths) > 1}


def modules_with_law_names() -> list[str]:
    """Modules of the service that hold the name of a law in their code."""
    found = []
    for path in sorted(SERVICE.rglob("*.py")):
        tree = ast.parse(path.read_text())
        texts = {
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        if any(LAW_NAMES.fullmatch(repr(text)) for text in texts):
            found.append(_name(path))
    return found


def main() -> int:
    """Print all figures; 1 where one is beyond its limit."""
    sizes = [folder_figure(), module_figure(), function_figure(), *argument_figures()]
    figures = [*sizes, circle_figure(), *path_figures()]
    for figure in figures:
        print(f"{'ok  ' if figure.within else 'OVER'} {figure.name}: {figure.value} (limit {figure.limit})")
        for item in figure.items:
            print(f"         {item}")
    print(f"     class names used more than once: {len(repeated_classes())}")
    for name, paths in repeated_classes().items():
        print(f"         {name}: {', '.join(paths)}")
    print(f"     modules that hold names of laws: {len(modules_with_law_names())}")
    for path in modules_with_law_names():
        print(f"         {path}")
    return 0 if all(figure.within for figure in figures) else 1


if __name__ == "__main__":
    sys.exit(main())
