"""Arbitrary arms in the simulated cell: read from URDF files; cell layout and goals are found by search."""
