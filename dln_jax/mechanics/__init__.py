"""Equations of motion, integrators and friction of any energy, for one state: no batch axis, no network.

`equations.dynamics` and `equations.flow` turn a record of energies into functions; `integrators` step them.
"""
