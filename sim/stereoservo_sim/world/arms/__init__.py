"""Any arm in the simulated cell: read from URDF files, with its cell and goals found by search."""
