"""Figures of the code's structure: files that one servo step enters, sizes, import circles, names used twice.

``python tests/house_figures.py`` prints them and exits 1 where one is beyond its limit; `test_house.py` holds them.
It uses nothing of the product but what it measures.
"""

from __future__ import annotations

import ast
import functools
import importlib.util
import io
import re
import sys
import tempfile
import tokenize
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = tuple(ROOT / part for part in ("service/stereoservo", "drivers/stereoservo_drivers", "sim/stereoservo_sim"))
SERVICE = PRODUCT[0]

STEP_FILES, STEP_HOPS, ACCEPTING_FILES, IMAGE_FILES = 14, 40, 20, 24
"""Asked of paths: of a core step and from image to velocity as they are read, of the goal-accepting step as it runs."""
TODAY = {
    "files in a core step as read, stereo": 15,
    "files in the goal-accepting step, stereo": 21,
    "files in a core step as read, cartesian3": 19,
    "hops in a core step, cartesian3": 44,
    "files in the goal-accepting step, cartesian3": 21,
    "files from image to velocity as run": 27,
    "files from image to velocity as read": 37,
}
"""Figures that are beyond what is asked: they may only fall, and whoever makes one smaller lowers it here."""
MODULE_LINES, FUNCTION_LINES = 900, 80
KERNEL_ARGUMENTS = 6
PARAMETERS, VERBS = 10, 0
"""Parameters of a function; and verbs of the command line that have more (options are fields of a dataclass)."""
CODE_LINES, FILES, LAYOUT_EXCEPTIONS = 109_210, 536, 129
"""Of the product: lines of code, its files, and statements that are not laid out by the formatter (`# fmt: skip`)."""
ONE_IMPORTER, ONE_IN_FOLDER = 62, 34
"""Modules that one other module alone imports, and those of them in its own folder: a piece that is not read without
its importer stands in it. They may only become fewer, and whoever joins one lowers them here.
"""
NO_CODE = (
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
)  # fmt: skip
LAWS = ("stereo", "cartesian3")
LAW_NAMES = re.compile(r"""["'](stereo|cartesian3|cartesian2)["']""")
"""Names that are nothing but laws: `image`, `points` and `trajectory` are words of other things, too."""


class CallPath(NamedTuple):
    """The ``files`` that a call enters; its ``hops``: consecutive function calls that are in different files; and the
    ``functions``, by file and name, in the order in which they are entered first.
    """

    files: frozenset[str]
    hops: int
    functions: tuple[tuple[str, str], ...] = ()

    @property
    def read(self) -> frozenset[str]:
        """The files that hold all that runs: with those of the kernels that kernels call, which nobody sees enter."""
        return self.files | {file for file, _ in called_kernels(self.functions)}


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


STANDS_FOR_THE_WORLD = "sim/stereoservo_sim/world/"
"""What a driver of a simulated cell calls there happens outside of the computer in life."""
STANDS_FOR_PROCESSES = "service/stereoservo/daemon/lockstep.py"
"""Runs the loops of the processes in turn; what it calls is theirs."""


class Trace:
    """The product's files that calls enter from `start` to `stop`. Compiled kernels that Python calls count as
    functions; nothing may be compiled or loaded meanwhile: see `nothing_loaded`.
    """

    def __init__(self) -> None:
        self._installed = {f"{_installed(folder.name)}/": folder.relative_to(ROOT) for folder in PRODUCT}
        self._before: Any = None
        self.running = False

    def start(self) -> None:
        """Begin anew."""
        self._files: set[str] = set()
        self._functions: dict[tuple[str, str], None] = {}
        self._last, self._hops = "", 0
        self._outside: FrameType | None = None
        self.running, self._before = True, sys.getprofile()
        sys.setprofile(self._see)

    def stop(self) -> CallPath:
        """End; what was entered."""
        sys.setprofile(self._before)
        self.running = False
        return CallPath(frozenset(self._files), self._hops, tuple(self._functions))

    def _see(self, frame: FrameType, event: str, argument: Any) -> None:
        if self._outside is not None:
            if event == "return" and frame is self._outside:
                self._outside = None
            return
        name = frame.f_code.co_filename
        root = next((root for root in self._installed if name.startswith(root)), None)
        if event != "call" or root is None:
            return
        file = str(self._installed[root] / name.removeprefix(root))
        if file.startswith(STANDS_FOR_THE_WORLD):
            self._outside = frame
        elif file != STANDS_FOR_PROCESSES:
            self._files.add(file)
            self._functions[file, frame.f_code.co_name] = None
            self._hops += bool(self._last) and file != self._last
            self._last = file


def traced(call: Callable[[], Any]) -> CallPath:
    """What ``call`` enters."""
    trace = Trace()
    trace.start()
    try:
        call()
    finally:
        path = trace.stop()
    return path


@contextmanager
def nothing_loaded() -> Iterator[None]:
    """Raises RuntimeError where a kernel is compiled, or loaded from its cache, meanwhile: numba types what kernels
    call by Python functions, which a path would count, with a cold cache more than with a warm one.
    """
    from stereoservo.numerics import compilation

    before = set(compilation.overloads())
    yield
    loaded = {f"{one.module}.{one.name}" for one in set(compilation.overloads()) - before}
    if loaded:
        raise RuntimeError(f"kernels were loaded on the way: {', '.join(sorted(loaded))}")


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


def servo_paths(law: str, steps: int = 40) -> tuple[CallPath, CallPath]:
    """Of a core that drives to a goal by ``law``: the longest path of a steady step, and the goal-accepting one.

    A steady step is one in which frames arrive and the core emits no event; the goal is accepted from its request to
    the event ``goal_started``, and the step of these that enters the most files counts.
    """
    _drive(law, steps)  # all that is compiled, loaded or imported once is so before the loop begins
    with nothing_loaded():
        return _drive(law, steps)


def _drive(law: str, steps: int) -> tuple[CallPath, CallPath]:
    from stereoservo.messages.goals import FeatureTarget

    bench_module = _load("house_bench", ROOT / "tests/core/conftest.py")
    bench = bench_module.make_bench(0, 0.02, k1=-0.1).ready()
    step = bench.core.step
    steady, accepting = [], []
    started = False

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
    """Of several paths that with the most files, as they run and then as they are read, and the most hops of any."""
    most = max(paths, key=lambda path: (len(path.files), len(path.read)))
    return most._replace(hops=max(path.hops for path in paths))


@functools.cache
def image_path(law: str = LAWS[0], steps: int = 40) -> CallPath:
    """From a camera driver's `poll` to the joint driver's `write_velocity`, the longest of so many steps on the way to
    a goal: drivers and detector of the demonstration's cell, and the loops of vision and servo on the slots and sockets
    of their processes.
    """
    from stereoservo.core.cycle import ModelUpdate
    from stereoservo.daemon.lockstep import LockstepCell
    from stereoservo.messages.cell_file import check_cell
    from stereoservo.messages.goals import Enable, RunGoal
    from stereoservo_sim.cells import shipped_cell_path
    from stereoservo_sim.world.exact_model import exact_simulated_model
    from stereoservo_sim.world.simulated_cell import demo_cell

    links = _load("house_links", ROOT / "tests/sim/lockstep/test_lockstep_faults.py").SocketLinks
    told = tomllib.loads(shipped_cell_path("demo").read_text())
    for camera in told["camera"]:
        camera["options"]["background"] = "plain"  # nothing but the world is lighter
    world, paths, trace = demo_cell(), [], Trace()
    under_way = False

    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        with LockstepCell(check_cell(told), cell_dir=place, runtime_dir=place, links=links(place)) as cell:
            joints = cell.joints
            write = joints.write_velocity

            def polled(poll: Callable[[], Any]) -> Callable[[], Any]:
                def run() -> Any:
                    if under_way and not trace.running:
                        trace.start()
                    return poll()

                return run

            def written(velocities: Any) -> Any:
                try:
                    return write(velocities)
                finally:
                    if trace.running:
                        paths.append(trace.stop())

            for camera in cell.cameras:
                camera.poll = polled(camera.poll)  # type: ignore[method-assign]
            joints.write_velocity = written  # type: ignore[method-assign]
            cell.run_for(0.3)
            cell.submit(Enable())
            cell.update_model(ModelUpdate(exact_simulated_model(world, 1)))
            cell.run_for(0.3)
            goal = _goal_in_pictures(world, law)
            reply = cell.submit(RunGoal(goal))
            cell.run_for(0.5)
            under_way = True
            try:
                with nothing_loaded():
                    while len(paths) < steps:
                        cell.step()
            finally:
                under_way = False
                if trace.running:
                    trace.stop()
            if not reply.accepted or cell.status is None or cell.status.goal != goal.id:
                raise RuntimeError(f"no goal is under way: {reply.message}, {cell.status}")
    return _longest(paths)


def _goal_in_pictures(world: Any, law: str) -> Any:
    """A goal by ``law`` at the pictures of the ``world`` with its arm a little off its base: slow, so that it lasts."""
    from stereoservo.messages.goals import FeatureTarget, Goal

    at = world.marker_positions(world.base + 0.1)
    pixels = {name: world.camera(name, 0.0).image_of(at)[0].tolist() for name in ("left", "right")}
    ids = world.body.ids.tolist()
    target = FeatureTarget({name: dict(zip(ids, map(tuple, seen), strict=True)) for name, seen in pixels.items()})
    return Goal("00000000-0000-0000-0000-000000000001", target, law=law, gain=0.3)  # type: ignore[arg-type]


def path_figures() -> list[Figure]:
    """Files and hops of the servo step, and from image to joint velocity, as they run and as they are read."""
    found = []
    for law in LAWS:
        steady, accepting = servo_paths(law)
        found += [
            _asked(f"files in a core step as run, {law}", steady.files, STEP_FILES),
            _asked(f"files in a core step as read, {law}", steady.read, STEP_FILES),
            _asked(f"hops in a core step, {law}", steady.hops, STEP_HOPS),
            _asked(f"files in the goal-accepting step, {law}", accepting.files, ACCEPTING_FILES),
        ]
    path = image_path()
    found.append(_asked("files from image to velocity as run", path.files, IMAGE_FILES))
    found.append(_asked("files from image to velocity as read", path.read, IMAGE_FILES))
    return found


def _asked(name: str, found: frozenset[str] | int, asked: int) -> Figure:
    """Files or a number: at most what is ``asked``, or, where today's is beyond, that."""
    told = f"{name} (asked {asked})" if name in TODAY else name
    limit = TODAY.get(name, asked)
    if isinstance(found, int):
        return Figure(told, found, limit)
    return Figure(told, len(found), limit, tuple(sorted(found)))


# -- kernels that kernels call ------------------------------------------------------------------------------------


class KernelNames(NamedTuple):
    """Of a module, its ``kernels`` by name, and by the names that it imports module and name (empty: the module)."""

    kernels: dict[str, ast.FunctionDef]
    imports: dict[str, tuple[str, str]]


def called_kernels(functions: Iterable[tuple[str, str]]) -> set[tuple[str, str]]:
    """Of functions (file, name) those that are kernels, with all kernels that these call, and so on: by the names in
    their source.
    """
    files = {module: _name(path) for module, path in _sources().items()}
    dotted = {file: module for module, file in files.items()}
    found: set[tuple[str, str]] = set()
    waiting = [(dotted[file], name) for file, name in functions]
    while waiting:
        module, name = waiting.pop()
        kernel = _kernel_names(module).kernels.get(name)
        if kernel is None or (files[module], name) in found:
            continue
        found.add((files[module], name))
        waiting += _named(kernel, module, set(files))
    return found


def _named(kernel: ast.FunctionDef, module: str, known: set[str]) -> Iterator[tuple[str, str]]:
    """Module and name of all that a ``kernel`` names and that may be one of the modules that are ``known``."""
    for node in ast.walk(kernel):
        at, name = module, ""
        if isinstance(node, ast.Name):
            name = node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            at, inside = _kernel_names(module).imports.get(node.value.id, ("", ""))
            name = "" if inside else node.attr
        while at in known and name and name not in _kernel_names(at).kernels:  # it may be imported on
            at, name = _kernel_names(at).imports.get(name, ("", ""))
        if at in known and name:
            yield at, name


@functools.cache
def _sources() -> dict[str, Path]:
    """All modules of the product, by name."""
    return {_dotted(path): path for path in modules()}


@functools.cache
def _kernel_names(module: str) -> KernelNames:
    paths = _sources()
    tree = ast.parse(paths[module].read_text())
    imports: dict[str, tuple[str, str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports |= {alias.asname: (alias.name, "") for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                origin = (inner, "") if inner in paths else (node.module, alias.name)
                imports[alias.asname or alias.name] = origin
    return KernelNames({kernel.name: kernel for kernel in _kernels(tree)}, imports)


# -- sizes and names ------------------------------------------------------------------------------------------


def modules() -> Iterator[Path]:
    """All modules of the product."""
    for folder in PRODUCT:
        yield from sorted(folder.rglob("*.py"))


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def size_figures() -> list[Figure]:
    """Lines of code, without blank lines, comments and docstrings; files; statements that the formatter skips."""
    texts = [path.read_text() for path in modules()]
    exceptions = sum(text.count("# fmt: skip") for text in texts)
    return [
        Figure("lines of code", sum(map(code_lines, texts)), CODE_LINES),
        Figure("files", len(texts), FILES),
        Figure("statements with a layout of their own", exceptions, LAYOUT_EXCEPTIONS),
    ]


def code_lines(text: str) -> int:
    """Lines of a module that hold code."""
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            held |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and body:
            for one in body:
                if (
                    isinstance(one, ast.Expr)
                    and isinstance(one.value, ast.Constant)
                    and isinstance(one.value.value, str)
                ):
                    held -= set(range(one.lineno, (one.end_lineno or one.lineno) + 1))
    return len(held)


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


def parameter_figures() -> list[Figure]:
    """Functions with too many parameters: outside the command line, where there may be none, and the verbs, which have
    a parameter for each option.
    """
    verbs, others = [], []
    for path in modules():
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                count = len(_parameters(node))
                if count > PARAMETERS:
                    found = verbs if _is_verb(path, node) else others
                    found.append(f"{_name(path)}:{node.lineno} {node.name}: {count}")
    name = f"functions with more than {PARAMETERS} parameters"
    return [
        Figure(f"{name}, outside the command line", len(others), 0, tuple(others)),
        Figure(f"{name}, verbs of the command line", len(verbs), VERBS, tuple(verbs)),
    ]


def _parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[ast.arg]:
    """All named parameters but the instance or class that a method begins with."""
    a = function.args
    named = [*a.posonlyargs, *a.args, *a.kwonlyargs]
    return named[1:] if named and named[0].arg in ("self", "cls") else named


def _is_verb(path: Path, function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether typer calls a function of the command line: its parameters are annotated as options or arguments."""
    names = [
        node.attr if isinstance(node, ast.Attribute) else node.id
        for one in _parameters(function)
        for node in ast.walk(one)
        if isinstance(node, ast.Attribute | ast.Name)
    ]
    return bool({"cli", "commands"} & set(path.parts)) and any(name.endswith(("Option", "Argument")) for name in names)


def kernel_arguments() -> dict[str, list[str]]:
    """Of each module, the kernels that have too many arguments, and how many."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in modules():
        for kernel in _kernels(ast.parse(path.read_text())):
            a = kernel.args
            count = len(a.posonlyargs + a.args + a.kwonlyargs)
            if count > KERNEL_ARGUMENTS:
                found[_name(path)].append(f"{kernel.name} {count}")
    return found


def _kernels(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    """Functions with a decorator of `numerics.compilation`."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        decorators = {inner.id for one in node.decorator_list for inner in ast.walk(one) if isinstance(inner, ast.Name)}
        if any(name.endswith("kernel") for name in decorators):
            yield node


def argument_figure() -> Figure:
    """Kernels with too many arguments."""
    found = kernel_arguments()
    items = tuple(f"{path}: {', '.join(names)}" for path, names in found.items())
    name = f"kernels with more than {KERNEL_ARGUMENTS} arguments"
    return Figure(name, sum(map(len, found.values())), 0, items)


def circle_figure() -> Figure:
    """Groups of modules that import each other when they are loaded."""
    imports = {_dotted(path): path for path in modules()}
    graph = {name: _imported(path, set(imports)) - {name} for name, path in imports.items()}
    circles = tuple(" - ".join(sorted(group)) for group in _strongly_connected(graph))
    return Figure("import circles", len(circles), 0, circles)


def importer_figures() -> list[Figure]:
    """Modules that exactly one other module imports, wherever in it, and those in its folder. What pyproject.toml, or a
    table of commands or benches, names as ``module:function`` is loaded on its own, and has an importer more; packages
    are no modules of their own.
    """
    paths = {_dotted(path): path for path in modules()}
    importers: dict[str, set[str]] = defaultdict(set)
    for name, path in paths.items():
        tree = ast.parse(path.read_text())
        for imported in _imported_by(ast.walk(tree), set(paths)) - {name}:
            importers[imported].add(name)
        for imported in _named_in(tree, name, set(paths)) - {name}:
            importers[imported].add(f"table of {name}")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for group in (project.get("scripts", {}), *project.get("entry-points", {}).values()):
        for entry in group.values():
            importers[entry.partition(":")[0]].add("pyproject.toml")
    single = {
        name: next(iter(importers[name]))
        for name, path in paths.items()
        if path.name != "__init__.py" and len(importers[name]) == 1
    }
    single = {name: importer for name, importer in single.items() if importer in paths}
    beside = {name: one for name, one in single.items() if paths[one].parent == paths[name].parent}
    title = "modules with one importer"
    return [
        Figure(title, len(single), ONE_IMPORTER, tuple(f"{name} <- {one}" for name, one in single.items())),
        Figure(f"{title} in the same folder", len(beside), ONE_IN_FOLDER, tuple(sorted(beside))),
    ]


def _dotted(path: Path) -> str:
    folder = next(folder for folder in PRODUCT if folder in path.parents)
    parts = (folder.name, *path.relative_to(folder).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(path: Path, known: set[str]) -> set[str]:
    """Modules that are imported when the one at ``path`` is loaded."""
    return _imported_by(_module_level(ast.parse(path.read_text()).body), known)


def _imported_by(nodes: Iterable[ast.AST], known: set[str]) -> set[str]:
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in known else node.module)
    return found & known


def _named_in(tree: ast.AST, module: str, known: set[str]) -> set[str]:
    """Modules that a module names as ``module:function``, from the top or below its own package."""
    texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    named = [match[1] for match in map(re.compile(r"([\w.]+):\w+").fullmatch, texts) if match]
    return known & {*named, *(f"{module.rpartition('.')[0]}.{name}" for name in named)}


def _module_level(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    for node in body:
        if isinstance(node, ast.Try) or (isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.dump(node.test)):
            yield from _module_level(node.body)
        else:
            yield node


def reached(graph: dict[str, set[str]], start: str) -> set[str]:
    """Nodes that ``start`` reaches by one arrow or more."""
    seen: set[str] = set()
    ahead = list(graph[start])
    while ahead:
        node = ahead.pop()
        if node not in seen:
            seen.add(node)
            ahead.extend(graph[node])
    return seen


def _strongly_connected(graph: dict[str, set[str]]) -> Iterator[set[str]]:
    """Groups of two or more nodes of which each reaches every other one."""
    reach = {node: reached(graph, node) for node in graph}
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
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        if any(LAW_NAMES.fullmatch(repr(text)) for text in texts):
            found.append(_name(path))
    return found


def main() -> int:
    """Print all figures; 1 where one is beyond its limit."""
    sizes = [*size_figures(), module_figure(), function_figure(), *parameter_figures(), argument_figure()]
    importers = importer_figures()
    figures = [*sizes, circle_figure(), *importers, *path_figures()]
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
