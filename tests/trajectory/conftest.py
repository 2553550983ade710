"""The virtual cells of the control tests serve here too."""

import importlib.util
from pathlib import Path

_spec = importlib.util.spec_from_file_location(
    "stereoservo_virtual_cells", Path(__file__).parents[1] / "control" / "conftest.py"
)
_cells = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_cells)
virtual = _cells.virtual
