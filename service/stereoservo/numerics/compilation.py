"""Decorators that compile functions with numba as kernels, cached on disk; those of the control loop without
fastmath.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])


def kernel(function: _F) -> _F:
    """Compile for the loop: cached on disk, exact arithmetic, no Python objects.

    Numba renews a cached kernel when its own file changes, not when a kernel that it calls changes in another
    file: after an edit here, touch the callers' files. Where no cache directory is writable the kernel is
    compiled at every start, with a warning; ``NUMBA_CACHE_DIR`` names a directory.
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


def _compile(function: _F, **more: Any) -> _F:
    options: dict[str, Any] = {"fastmath": False, "error_model": "numpy", **more}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError as error:  # numba: "cannot cache function ...: no locator available"
        warnings.warn(f"{error}; compiling at every start", RuntimeWarning, stacklevel=3)
        compiled = numba.njit(**options)(function)
    return cast(_F, compiled)
