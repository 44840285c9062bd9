"""Minimises sums of element energies, and solves the linear systems of its Newton steps."""
