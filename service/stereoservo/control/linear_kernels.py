"""The solvers of `kinematics.linear_kernels` under the name by which the laws know them."""

from stereoservo.kinematics.linear_kernels import (
    PIVOT_TOLERANCE,
    cholesky_solve,
    damped_least_squares,
    null_direction,
    right_singular,
)

__all__ = ["PIVOT_TOLERANCE", "cholesky_solve", "damped_least_squares", "null_direction", "right_singular"]
