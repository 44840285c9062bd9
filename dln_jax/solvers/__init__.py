"""Linear and nonlinear solvers without any physics."""
