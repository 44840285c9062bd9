"""Soft bodies: meshes, energy terms and implicit time steps that minimise an incremental potential.

`mesh` builds bodies and `terms` their energies. A scene holds both, and `make_step` returns its time step.
"""
