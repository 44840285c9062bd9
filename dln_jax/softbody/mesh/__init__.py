"""Meshes of simplices: generation, validation and measurement."""

from dln_jax.softbody.mesh.files import read_mesh, write_mesh, write_motion
from dln_jax.softbody.mesh.mesh import (
    Mesh,
    NamedSet,
    boundary,
    boundary_vertices,
    edges,
    lumped_masses,
    make_mesh,
    overlaps,
    vertices_where,
    volumes,
)
from dln_jax.softbody.mesh.quadratic import barycentric_split, quadratic, with_midsides
from dln_jax.softbody.mesh.sets import values_by_set, vertices_in
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
from dln_jax.softbody.mesh.surfaces import (
    closed_surface,
    enclosed_volume,
    facets_in,
    inner_surface,
    outer_surface,
    surface_parts,
)

__all__ = [
    "Creature",
    "Mesh",
    "NamedSet",
    "barycentric_split",
    "beam",
    "biped",
    "body_length",
    "boundary",
    "boundary_vertices",
    "box",
    "closed_surface",
    "crawler",
    "disc",
    "edges",
    "enclosed_volume",
    "facets_in",
    "inner_surface",
    "lattice",
    "lumped_masses",
    "make_mesh",
    "outer_surface",
    "overlaps",
    "quadratic",
    "quadruped",
    "read_mesh",
    "simplex_volumes",
    "surface_parts",
    "values_by_set",
    "vertices_in",
    "vertices_where",
    "volumes",
    "with_midsides",
    "write_mesh",
    "write_motion",
]
