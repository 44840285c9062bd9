"""Barrier contact between and within bodies and with rigid obstacles: surfaces never cross."""
