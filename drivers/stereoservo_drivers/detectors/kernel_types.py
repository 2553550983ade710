"""Compilation of the detectors' kernels ahead of their first call, for given argument types."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numba import types

# Read-only arrays: a kernel compiled for them accepts writable ones, too. Other types would be compiled again during
# operation.
IMAGE = types.Array(types.uint8, 2, "C", readonly=True)
BOOL = types.boolean
INT = types.int64
INT32 = types.int32
FLOAT = types.float64
SINGLE = types.float32
BYTE = types.uint8
WORD = types.uint64


def given(dtype: Any, dimensions: int) -> Any:
    """Type of an input array, C order."""
    return types.Array(dtype, dimensions, "C", readonly=True)


def written(dtype: Any, dimensions: int) -> Any:
    """Type of an output array, C order."""
    return types.Array(dtype, dimensions, "C")


def fields(*types_of_fields: Any) -> Any:
    """Type of the fields of a record, see `stereoservo.numerics.compilation.Fields`."""
    return types.Tuple(types_of_fields)


SCRATCH = fields(written(INT32, 2), written(INT32, 2), written(SINGLE, 2))
"""Fields of `components.Scratch`."""


def compile_for(function: Callable[..., Any], *arguments: Any) -> None:
    """Compile a kernel for these argument types, now, and for no others later. Idempotent."""
    dispatcher = cast(Any, function)
    if not dispatcher.signatures:
        dispatcher.compile(arguments)
        dispatcher.disable_compile()
