"""Rigid bodies in a tree of revolute and prismatic joints: a description, its energies, and recursions over it.

`tree_system(tree)` is a record for `mechanics.equations.dynamics`; `lagrangian(tree)` is its Lagrangian.
"""
