"""Hamiltonian training on a user's motions and the published tasks: measurements, model selection and fits."""
