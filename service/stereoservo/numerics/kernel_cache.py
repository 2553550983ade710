"""Cache of the machine code of kernels: valid for the sources of a kernel and of all that it calls, and prefilled if
the distribution ``stereoservo-kernels`` is installed.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import inspect
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import llvmlite.binding
import numpy as np
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile

SHIPPED = "stereoservo_kernels"
"""The package of that distribution: a folder for each package that has kernels, with the files of numba's cache."""
LEVELS = {"haswell": ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"), "generic": ()}
"""Processor levels for which its code is compiled, the best first, with the required processor features."""


INLINED = 150
"""Lines of LLVM code (optimised, without wrappers) up to which a kernel is linked into its callers and optimised again
in each; a longer one is called by its symbol.
"""

KERNELS: dict[tuple[str, str], Any] = {}
"""The kernels that this process has imported, by module and name."""


class Overload(NamedTuple):
    """One compiled signature of a kernel; can be pickled."""

    module: str
    name: str
    arguments: tuple[Any, ...]

    def load(self) -> bool:
        """Load it from the cache, or compile it; whether that was necessary and its kernel still exists."""
        key = (self.module, self.name)
        if key not in KERNELS:
            importlib.import_module(self.module)
        if key not in KERNELS or self.arguments in KERNELS[key].overloads:
            return False
        KERNELS[key].compile(self.arguments)
        return True


_BY_SYMBOL: dict[str, Overload] = {}
"""The kernels of this process that are called by symbol."""


def call_by_symbol(overload: Overload, compiled: Any) -> None:
    """Have kernels call this one, if it is long, by its symbol: its code is not linked into theirs."""
    library, symbol = compiled.library, compiled.fndesc.llvm_func_name
    wrappers = compiled.fndesc.llvm_cpython_wrapper_name, compiled.fndesc.llvm_cfunc_wrapper_name
    functions = [f for f in library._final_module.functions if not f.is_declaration and f.name not in wrappers]
    if sum(str(function).count("\n") for function in functions) > INLINED:
        empty = library.codegen._create_empty_module(library.name)
        library._shared_module = llvmlite.binding.parse_assembly(str(empty))
        _BY_SYMBOL[symbol] = overload


class _Linked(CompileResultCacheImpl):  # type: ignore[misc]
    """A kernel in the cache with the kernels that it calls by symbol: they are loaded before it."""

    def reduce(self, cres: Any) -> Any:
        module, symbol = cres.library._final_module, cres.fndesc.llvm_func_name
        declared = [function.name for function in module.functions if function.is_declaration]
        called = {name: _BY_SYMBOL[name] for name in declared if name in _BY_SYMBOL}
        return _BY_SYMBOL.get(symbol), called, super().reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        overload, called, compiled = payload
        engine, fndesc = target_context.codegen()._engine, compiled[1]
        for symbol, callee in called.items():
            callee.load()
            if not engine.is_symbol_defined(symbol):  # another process has compiled it since
                return None
        if overload is not None:
            engine._defined_symbols |= {fndesc.llvm_func_name, fndesc.llvm_cpython_wrapper_name}
            _BY_SYMBOL[fndesc.llvm_func_name] = overload
        return super().rebuild(target_context, compiled)


class KernelCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of one kernel. Raises RuntimeError if no cache directory is writable.

    numba recompiles a kernel when its own file has changed. Here the key also contains the sources of the kernels that
    it calls, and the constants that are compiled into them: after an upgrade or an edit, no outdated code is run. numba
    also recompiles when only the date of the file has changed; here, files of the same content are the same file, so an
    upgrade compiles only kernels that reach a changed file.
    """

    _impl_class = _Linked

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        self._stamp = file_hash(inspect.getfile(py_func))  # as imported: an upgrade may change the file later
        self._cache_file = IndexDataCacheFile(self._cache_path, self._impl.filename_base, self._stamp)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), dependencies(self._py_func), INLINED)

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        for load in (super()._load_overload, self._load_shipped):
            try:
                found = load(sig, target_context)
            except (AttributeError, ModuleNotFoundError):  # of another version, with types that are no more
                found = None
            except Exception as error:  # of a damaged file: whatever unpickling and LLVM raise
                warnings.warn(
                    f"{self._name}: its file in the cache is damaged ({error!r:.200}); compiling it again",
                    RuntimeWarning,
                    stacklevel=2,
                )
                found = None
            if found is not None:
                return _without_module(found)
        return None

    def _save_overload(self, sig: Any, data: Any) -> None:
        try:
            self._cache_file._load_index()
        except OSError:
            raise
        except Exception:  # damaged, or of another version, with types of a module that no longer exists
            self._cache_file.flush()
        super()._save_overload(sig, data)

    def _load_shipped(self, sig: Any, target_context: Any) -> Any:
        folder = shipped_folder()
        if folder is None:
            return None
        package = self._py_func.__module__.rpartition(".")[0]
        file = IndexDataCacheFile(str(folder / package), self._impl.filename_base, self._stamp)
        codegen = target_context.codegen()
        signature, (triple, *_), *sources = self._index_key(sig, codegen)
        for processor in levels_here():
            data = file.load((signature, (triple, processor, ""), *sources))
            if data is not None:
                return self._impl.rebuild(target_context, data)
        return None


@functools.cache
def levels_here() -> tuple[str, ...]:
    """The `LEVELS` whose code runs on this processor."""
    here = llvmlite.binding.get_host_cpu_features()
    return tuple(level for level, needs in LEVELS.items() if all(here.get(need) for need in needs))


@functools.cache
def shipped_folder() -> Path | None:
    """Folder of the installed compiled kernels; None if there are none."""
    spec = importlib.util.find_spec(SHIPPED)
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(next(iter(spec.submodule_search_locations)))


def _without_module(loaded: Any) -> Any:
    """A kernel from the cache without its parsed LLVM module. Only the compilation of a caller needs the module, and
    then parses it again from the bitcode. A servo process, which compiles nothing, needs a quarter less memory.
    """
    library = loaded.library
    if (module := getattr(library, "_shared_module", None)) is not None:
        bitcode = module.as_bitcode()
        module.close()
        library._shared_module = None
        library._get_module_for_linking = lambda: llvmlite.binding.parse_bitcode(bitcode)
    return loaded


def dependencies(function: Callable[..., Any]) -> str:
    """Hash of the dependencies of a kernel's code: the source files of all kernels, functions and classes of its
    distribution that it reaches by name, the constants, and the defaults of arguments.
    """
    found: set[str] = set()
    seen: set[Callable[..., Any]] = set()
    waiting = [function]
    while waiting:
        this = waiting.pop()
        if this not in seen:
            seen.add(this)
            parts, called = _named_by(this)
            found |= parts
            waiting.extend(called)
    return hashlib.sha256("\n".join(sorted(found)).encode()).hexdigest()


@functools.cache
def _named_by(function: FunctionType) -> tuple[frozenset[str], tuple[FunctionType, ...]]:
    """Texts for a function's source file and each constant that it references; and the functions that it references."""
    texts, called = {file_hash(inspect.getfile(function))}, []
    root = function.__module__.partition(".")[0]
    for name, value in _values(function, root):
        if isinstance(value, FunctionType) and not _foreign(value, root):
            called.append(value)
        elif isinstance(value, (type, ModuleType)):
            module = value.__name__ if isinstance(value, ModuleType) else value.__module__
            if not _foreign(value, root):
                texts.add(file_hash(str(getattr(sys.modules[module], "__file__", module))))
        elif isinstance(value, np.ndarray):
            texts.add(f"{name} = {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}")
        elif isinstance(value, (bool, int, float, complex, str, tuple, np.generic)):
            texts.add(f"{name} = {value!r}")
    return frozenset(texts), tuple(called)


def _values(function: FunctionType, root: str) -> Iterator[tuple[str, Any]]:
    """Names and values that a function references: globals, variables of enclosing functions, defaults of arguments,
    and attributes of its distribution's modules; for a kernel, its Python function.
    """
    names = sorted(set(_names(function.__code__)))
    around = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    waiting = [(name, function.__globals__[name]) for name in names if name in function.__globals__]
    waiting += [(name, cell.cell_contents) for name, cell in around]
    waiting += [(f"default {k}", value) for k, value in enumerate(function.__defaults__ or ())]
    waiting += (function.__kwdefaults__ or {}).items()
    modules: set[str] = set()
    while waiting:
        name, value = waiting.pop()
        if isinstance(value, ModuleType) and not _foreign(value, root) and value.__name__ not in modules:
            modules.add(value.__name__)
            waiting += [(f"{name}.{n}", getattr(value, n)) for n in names if hasattr(value, n)]
        yield name, getattr(value, "py_func", value)


def _foreign(value: Any, root: str) -> bool:
    """Whether a function, class or module belongs to another distribution with its own version: numba, numpy."""
    name = value.__name__ if isinstance(value, ModuleType) else value.__module__
    return not str(name).startswith((root.partition("_")[0] or root, "stereoservo"))


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


@functools.cache
def file_hash(path: str) -> str:
    """SHA-256 of a file's content; of its name only if the file cannot be read (code without a file)."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError:
        return path
