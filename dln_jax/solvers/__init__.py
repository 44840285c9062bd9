"""Linear and nonlinear solvers that know no physics."""
