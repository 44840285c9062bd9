"""Minima of sums of element energies, and the linear systems on the way."""
