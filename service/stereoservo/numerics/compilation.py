"""Decorators that compile functions with numba as kernels, cached on disk, those of the control loop without fastmath;
list and log of the kernels that this process has compiled.
"""

from __future__ import annotations

import atexit
import functools
import os
import resource
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar, cast

import numba
from numba.core import event, types
from numba.core.registry import cpu_target

from stereoservo.numerics.kernel_cache import KERNELS, KernelCache, Overload, call_by_symbol

_F = TypeVar("_F", bound=Callable[..., Any])

Fields = tuple[Any, ...]
"""The fields of a record as a plain tuple: argument type of kernels that Python calls in each step or frame.

At every call from Python, numba's type lookup takes more than a microsecond for a NamedTuple, and a tenth of that for a
plain tuple. The kernel unpacks the fields in order, or makes the record from them: ``View(*view)``.
"""

LOG_VARIABLE = "STEREOSERVO_COMPILE_LOG"
"""Environment variable: file to which every process appends one line of JSON for each signature that it compiles."""


def kernel(function: _F) -> _F:
    """Compile for the loop: cached on disk, exact arithmetic, no Python objects.

    A kernel that calls another one with a literal (``solve(A, 0)``) calls the same compiled code as with any other
    integer; by default, numba compiles another version for each literal.

    A cached kernel is recompiled when its source or that of a kernel that it calls has changed. If no cache directory
    is writable, the kernel is compiled at every start, with a warning; ``NUMBA_CACHE_DIR`` sets a directory.
    """
    return _compile(function)


def inlined_kernel(function: _F) -> _F:
    """A :func:`kernel` that is compiled into each kernel that calls it: for inner loops with relevant call overhead."""
    return _compile(function, inline="always")


def reassociating_kernel(function: _F) -> _F:
    """A :func:`kernel` whose sums may be taken in any order, so that a loop over pixels uses vector instructions.

    For detectors only, which are not part of the replayed core: the result depends on the processor in its last bits.
    NaN and infinity are handled as in other kernels.
    """
    return _compile(function, fastmath={"reassoc", "nsz", "contract"})


def plain(record: tuple[Any, ...]) -> Fields:
    """The `Fields` of a NamedTuple."""
    return tuple(record)


def overloads() -> Iterator[Overload]:
    """Every signature of every kernel that this process has compiled or loaded."""
    for (module, name), dispatcher in KERNELS.items():
        for arguments in dispatcher.signatures:
            yield Overload(module, name, arguments)


def load(wanted: Iterable[Overload]) -> Iterator[None]:
    """Load kernels from the cache, one per step of the iterator; kernels that are not in the cache are compiled."""
    for overload in wanted:
        if overload.load():
            yield


def _compile(function: _F, **more: Any) -> _F:
    options: dict[str, Any] = {"fastmath": False, "error_model": "numpy", "no_cfunc_wrapper": True, **more}
    compiled = numba.njit(**options)(function)
    if compiled is not function:  # equal with NUMBA_DISABLE_JIT
        try:
            compiled._cache = KernelCache(function)
        except RuntimeError as error:  # numba: "cannot cache function ...: no locator available"
            warnings.warn(f"{error}; compiling at every start", RuntimeWarning, stacklevel=3)
        _forget_literals(compiled)
        if function.__closure__ is None:  # else another one may have its name
            _call_by_symbol(compiled)
        KERNELS[function.__module__, function.__qualname__] = compiled
    return cast(_F, compiled)


def _forget_literals(dispatcher: Any) -> None:
    """Make the lookup of calls by other kernels depend only on the argument types, not on the values of literals."""
    template, unliteral = dispatcher.get_call_template, cast(Any, types).unliteral

    def get_call_template(args: Any, kws: Any) -> Any:
        return template(
            tuple(unliteral(argument) for argument in args),
            {name: unliteral(argument) for name, argument in kws.items()},
        )

    dispatcher.get_call_template = get_call_template


def _call_by_symbol(dispatcher: Any) -> None:
    """Apply `call_by_symbol` to each signature that is compiled."""
    function, add = dispatcher.py_func, dispatcher.add_overload

    def add_overload(compiled: Any) -> None:
        call_by_symbol(Overload(function.__module__, function.__qualname__, compiled.signature.args), compiled)
        add(compiled)

    dispatcher.add_overload = add_overload


def report_compiled(tell: Callable[[int], None]) -> None:
    """Register ``tell``, which is called after each compilation of a kernel with the number of signatures that this
    process has compiled or loaded.
    """
    event.register("numba:compile", _Counting(tell))


class _Counting(event.Listener):  # type: ignore[misc]
    def __init__(self, tell: Callable[[int], None]) -> None:
        self._tell = tell

    def on_start(self, event: Any) -> None:
        """Do nothing: a kernel is counted when it is compiled."""

    def on_end(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        if (function.__module__, function.__qualname__) in KERNELS:
            self._tell(sum(len(dispatcher.overloads) for dispatcher in KERNELS.values()))


def _make_passes_once() -> None:
    """Use the same function passes for all functions: llvmlite does not free those of each, some 30 kB."""
    codegen = cpu_target.target_context.codegen()
    codegen._function_pass_manager = functools.cache(codegen._function_pass_manager)


_make_passes_once()


class _CompileLog(event.Listener):  # type: ignore[misc]
    """Appends to ``path``: process, kernel, argument types, and CPU seconds of this thread, without those of the
    kernels compiled within; at the end of the process its total CPU seconds and its largest resident memory [MB].
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._running: list[tuple[float, list[float]]] = []
        atexit.register(self._end)

    def on_start(self, event: Any) -> None:
        self._running.append((time.thread_time(), []))

    def on_end(self, event: Any) -> None:
        began, inner = self._running.pop()
        seconds = time.thread_time() - began
        if self._running:
            self._running[-1][1].append(seconds)
        function = event.data["dispatcher"].py_func
        self._append(
            {
                "module": function.__module__,
                "kernel": function.__qualname__,
                "signature": ", ".join(map(str, event.data["args"])),
                "seconds": seconds - sum(inner),
            }
        )

    def _end(self) -> None:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        self._append({"cpu_s": time.process_time(), "peak_mb": round(peak, 1)})

    def _append(self, line: dict[str, Any]) -> None:
        import json  # imported only here: a servo process does not need it

        process = os.path.basename(sys.argv[0]).removesuffix(".py")
        with open(self._path, "a", encoding="utf-8") as file:
            file.write(json.dumps({"process": process, "pid": os.getpid(), **line}) + "\n")


if LOG_VARIABLE in os.environ:
    event.register("numba:compile", _CompileLog(os.environ[LOG_VARIABLE]))
