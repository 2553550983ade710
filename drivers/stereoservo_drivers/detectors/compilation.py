"""How the detectors' kernels are compiled: once, for given types, into numba's cache on disk."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba import types

_F = TypeVar("_F", bound=Callable[..., Any])

# Read-only arrays: a kernel compiled for them takes writable ones too. Anything else would be compiled anew
# in the middle of the work.
IMAGE = types.Array(types.uint8, 2, "C", readonly=True)
BOOL = types.boolean
INT = types.int64
INT32 = types.int32
FLOAT = types.float64


def given(dtype: Any, dimensions: int) -> Any:
    """Type of an input array, C order."""
    return types.Array(dtype, dimensions, "C", readonly=True)


def written(dtype: Any, dimensions: int) -> Any:
    """Type of an output array, C order."""
    return types.Array(dtype, dimensions, "C")


def kernel(function: _F) -> _F:
    """Compile on first use, cached on disk where a directory is writable (else at every start, with a
    warning).
    """
    options: dict[str, Any] = {"fastmath": False, "error_model": "numpy"}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError as error:  # numba: "cannot cache function ...: no locator available"
        warnings.warn(f"{error}; compiling at every start", RuntimeWarning, stacklevel=2)
        compiled = numba.njit(**options)(function)
    return cast(_F, compiled)


def compile_for(function: Callable[..., Any], *arguments: Any) -> None:
    """Compile a kernel for these argument types, now, and for no others, ever. Idempotent."""
    dispatcher = cast(Any, function)
    if not dispatcher.signatures:
        dispatcher.compile(arguments)
        dispatcher.disable_compile()
