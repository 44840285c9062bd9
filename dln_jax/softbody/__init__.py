"""Soft bodies: meshes, energy terms, and implicit time steps that are minimisations of an incremental potential."""
