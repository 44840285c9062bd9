"""Two-dimensional creatures: a mesh that stands on y = 0 and faces right, with muscles along its skin.

A creature is a drawing of square cells (`#`), with two triangles per cell, and pointed ends (`<`, `>`). All edges of
the outline except those on the ground are muscles: both sides of the legs, to bend them, and the upper and lower side
of the body. Sizes suit the material of the "creature" preset, whose energies count per triangle and not per area.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from dln_jax.softbody.mesh.mesh import Mesh, boundary, make_mesh
from dln_jax.softbody.mesh.shapes import lattice

POINT = 0.8
"""Length of a pointed end, in cells."""


class Creature(NamedTuple):
    """A body and its muscles."""

    name: str
    mesh: Mesh
    muscles: Int[np.ndarray, "k 2"]
    """Vertices at the two ends of the muscles, from left to right."""


def crawler() -> Creature:
    """A long low body on four small feet, pointed in front and behind: 28 vertices, 24 muscles."""
    return _drawn("crawler", 0.3, "<########>", " #.#..#.# ")


def biped() -> Creature:
    """A body on two legs: 32 vertices, 24 muscles."""
    return _drawn("biped", 0.4, "####", "####", "####", "#..#", "#..#", "#..#")


def quadruped() -> Creature:
    """A body on two pairs of legs: 43 vertices, 32 muscles."""
    return _drawn("quadruped", 0.4, "########", "########", "#.#..#.#", "#.#..#.#")


def body_length(creature: Creature) -> float:
    """Extent of the rest shape along x, in m."""
    return float(np.ptp(creature.mesh.vertices[:, 0]))


def _drawn(name: str, size: float, *rows: str) -> Creature:
    """Returns the creature of a drawing whose cells have sides of `size` m."""
    drawing = {(x, y): mark for y, row in enumerate(reversed(rows)) for x, mark in enumerate(row)}
    positions, elements = lattice([cell for cell, mark in drawing.items() if mark == "#"])
    number = {tuple(position): index for index, position in enumerate(positions.tolist())}
    vertices, triangles = positions.tolist(), elements.tolist()
    for (x, y), mark in drawing.items():
        if mark == ">":
            triangles.append([number[x, y], len(vertices), number[x, y + 1]])
            vertices.append([x + POINT, y + 0.5])
        if mark == "<":
            triangles.append([number[x + 1, y], number[x + 1, y + 1], len(vertices)])
            vertices.append([x + 1 - POINT, y + 0.5])
    mesh = make_mesh(size * np.array(vertices, dtype=np.float64), triangles)
    skin = boundary(mesh)
    pairs = skin[(mesh.vertices[skin, 1] > 0).any(axis=1)]
    x, y = mesh.vertices[pairs].mean(axis=1).T
    return Creature(name, mesh, np.sort(pairs, axis=1)[np.lexsort((y, x))])
