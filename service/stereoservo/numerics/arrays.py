"""Type aliases of numpy arrays: floating point, integer, boolean, joint kinds, images."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
KindArray = npt.NDArray[np.uint8]
ImageArray = npt.NDArray[np.uint8]
Record = Any
"""An array (1,) of a structured type such as `core.block.BLOCK`."""
