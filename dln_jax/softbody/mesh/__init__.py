"""Meshes of simplices: generation, validation and measurement."""

from dln_jax.softbody.mesh.mesh import (
    Mesh,
    boundary,
    boundary_vertices,
    edges,
    lumped_masses,
    make_mesh,
    overlaps,
    vertices_where,
    volumes,
)
from dln_jax.softbody.mesh.shapes import (
    Creature,
    beam,
    biped,
    body_length,
    box,
    crawler,
    disc,
    lattice,
    quadruped,
)
from dln_jax.softbody.mesh.simplices import simplex_volumes

__all__ = [
    "Creature",
    "Mesh",
    "beam",
    "biped",
    "body_length",
    "boundary",
    "boundary_vertices",
    "box",
    "crawler",
    "disc",
    "edges",
    "lattice",
    "lumped_masses",
    "make_mesh",
    "overlaps",
    "quadruped",
    "simplex_volumes",
    "vertices_where",
    "volumes",
]
