"""Decorators that compile functions with numba as kernels, cached on disk, those of the control loop without fastmath;
what this process has compiled, and a log of it.
"""

from __future__ import annotations

import atexit
import importlib
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar, cast

import numba
from numba.core import event, types

from stereoservo.numerics.kernel_cache import KernelCache

_F = TypeVar("_F", bound=Callable[..., Any])

Fields = tuple[Any, ...]
"""The fields of a record in a plain tuple, as a kernel takes them that Python calls in each step or frame.

numba looks up the type of a NamedTuple anew at every call from Python, for more than a microsecond; that of a plain
tuple by what is in it, for a tenth of that. The kernel unpacks the fields in their order, or makes the record of them:
``View(*view)``.
"""

LOG_VARIABLE = "STEREOSERVO_COMPILE_LOG"
"""Environment variable: a file to which every process appends a line of JSON for each signature that it compiles."""

KERNELS: dict[tuple[str, str], Any] = {}
"""The kernels that this process has imported, by module and name."""


class Overload(NamedTuple):
    """One compiled signature of a kernel; pickles."""

    module: str
    name: str
    arguments: tuple[Any, ...]


def kernel(function: _F) -> _F:
    """Compile for the loop: cached on disk, exact arithmetic, no Python objects.

    A kernel that calls another one with a literal (``solve(A, 0)``) calls the same compiled code as with any other
    integer; numba's own way compiles it once more for each literal.

    A cached kernel is renewed when its own source changes or that of a kernel which it calls. Where no cache
    directory is writable the kernel is compiled at every start, with a warning; ``NUMBA_CACHE_DIR`` names a directory.
    """
    return _compile(function)


def inlined_kernel(function: _F) -> _F:
    """A :func:`kernel` that is compiled into each kernel that calls it: a part of an inner loop, where the call itself
    would cost.
    """
    return _compile(function, inline="always")


def reassociating_kernel(function: _F) -> _F:
    """A :func:`kernel` whose sums may be taken in any order, so that a loop over pixels uses vector instructions.

    For detectors alone, which stand outside of the replayed core: its bits depend on the processor. NaN and infinity
    are what they are elsewhere.
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
    """Load kernels from the cache, one a step of the iterator; what is not in the cache is compiled."""
    for overload in wanted:
        key = (overload.module, overload.name)
        if key not in KERNELS:
            importlib.import_module(overload.module)
        if key in KERNELS and overload.arguments not in KERNELS[key].overloads:
            KERNELS[key].compile(overload.arguments)
            yield


def _compile(function: _F, **more: Any) -> _F:
    options: dict[str, Any] = {"fastmath": False, "error_model": "numpy", **more}
    compiled = numba.njit(**options)(function)
    if compiled is not function:  # with NUMBA_DISABLE_JIT it is
        try:
            compiled._cache = KernelCache(function)
        except RuntimeError as error:  # numba: "cannot cache function ...: no locator available"
            warnings.warn(f"{error}; compiling at every start", RuntimeWarning, stacklevel=3)
        _forget_literals(compiled)
        KERNELS[function.__module__, function.__qualname__] = compiled
    return cast(_F, compiled)


def _forget_literals(dispatcher: Any) -> None:
    """Have calls by other kernels looked up by the types of their arguments, not by the values of literals."""
    template, unliteral = dispatcher.get_call_template, cast(Any, types).unliteral

    def get_call_template(args: Any, kws: Any) -> Any:
        return template(
            tuple(unliteral(argument) for argument in args),
            {name: unliteral(argument) for name, argument in kws.items()},
        )

    dispatcher.get_call_template = get_call_template


def tell_compiled(tell: Callable[[int], None]) -> None:
    """Have this process call ``tell`` with the number of signatures that it holds, compiled or loaded, whenever it has
    compiled another kernel.
    """
    event.register("numba:compile", _Counting(tell))


class _Counting(event.Listener):  # type: ignore[misc]
    def __init__(self, tell: Callable[[int], None]) -> None:
        self._tell = tell

    def on_start(self, event: Any) -> None:
        """Nothing: a kernel counts when it is compiled."""

    def on_end(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        if (function.__module__, function.__qualname__) in KERNELS:
            self._tell(sum(len(dispatcher.overloads) for dispatcher in KERNELS.values()))


class _CompileLog(event.Listener):  # type: ignore[misc]
    """Appends to ``path``: process, kernel, types of the arguments, and CPU seconds of this thread, those of the
    kernels compiled meanwhile apart; at the end of the process its CPU seconds in all.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._running: list[tuple[float, list[float]]] = []
        atexit.register(lambda: self._append({"cpu_s": time.process_time()}))

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

    def _append(self, line: dict[str, Any]) -> None:
        import json  # for this alone: a servo process has none

        process = os.path.basename(sys.argv[0]).removesuffix(".py")
        with open(self._path, "a", encoding="utf-8") as file:
            file.write(json.dumps({"process": process, "pid": os.getpid(), **line}) + "\n")


if LOG_VARIABLE in os.environ:
    event.register("numba:compile", _CompileLog(os.environ[LOG_VARIABLE]))
