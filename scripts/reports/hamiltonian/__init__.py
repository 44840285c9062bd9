"""Hamiltonian tasks: data, training, errors, beside the published results."""
