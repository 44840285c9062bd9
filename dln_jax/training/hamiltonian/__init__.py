"""Hamiltonian training on images."""
