"""Hamiltonian tasks: data, training and errors, compared with published results."""
