"""Hamiltonian training on motions without applied forces: a user's own, and published tasks."""
