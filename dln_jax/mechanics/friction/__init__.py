"""Friction of joints: laws, their Rayleigh functions, and load-dependent friction of transmissions."""
