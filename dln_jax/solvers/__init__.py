"""Linear and nonlinear solvers without any physics."""

from dln_jax.solvers import elimination, least_squares, levenberg_marquardt, normal_equations
from dln_jax.solvers.newton import SolverInfo, find_root

__all__ = [
    "SolverInfo",
    "elimination",
    "find_root",
    "least_squares",
    "levenberg_marquardt",
    "normal_equations",
]
