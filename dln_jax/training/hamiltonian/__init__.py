"""A user's motions and the published Hamiltonian tasks: what is measured, which model suits it, and its training."""
