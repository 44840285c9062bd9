"""Differential networks for functions: units of the fit, errors and verdict, and figures."""
