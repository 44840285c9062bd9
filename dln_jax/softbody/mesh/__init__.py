"""Meshes of simplices: generation, validation and measurement."""
