"""Meshes of simple shapes, and transformations of meshes.

The shapes are beam, box, disc, any set of lattice cells, and creatures with muscles along their skin. Meshes can be
joined, moved, split, or made quadratic.

A creature stands on y = 0 and faces right. A drawing defines its square cells (`#`), with two triangles per cell, and
its pointed ends (`<`, `>`). All edges of the outline except those on the ground are muscles: on both sides of the legs,
to bend them, and on the upper and lower side of the body. Sizes suit the "creature" preset, with energies per triangle.
"""

import itertools
import math
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dln_jax.errors import require_memory
from dln_jax.softbody.mesh.mesh import Mesh, NamedSet, boundary, indices_of, make_mesh
from dln_jax.softbody.mesh.simplices import SIDES
from dln_jax.types import InputError, finite_array, require_positive

# Lattice cells are cut so that every diagonal joins two vertices with an even sum of coordinates: neighbours are mirror
# images, so they fit, and no direction is preferred. In space a cell is one regular tetrahedron between four alternate
# corners and one tetrahedron in each of the other four. The alternative, six equal tetrahedra around a space diagonal
# (Kuhn), takes a fifth more elements, which are flatter, and a bent bar twists towards its diagonals.
PATTERNS = {
    2: (((0, 0), (1, 0), (1, 1)), ((0, 0), (1, 1), (0, 1))),
    3: (
        ((0, 0, 0), (1, 1, 0), (0, 1, 1), (1, 0, 1)),
        ((1, 0, 0), (1, 1, 0), (0, 0, 0), (1, 0, 1)),
        ((0, 1, 0), (0, 0, 0), (1, 1, 0), (0, 1, 1)),
        ((0, 0, 1), (1, 0, 1), (0, 0, 0), (0, 1, 1)),
        ((1, 1, 1), (0, 1, 1), (1, 1, 0), (1, 0, 1)),
    ),
}
"""Corners of the simplices in a cell at even coordinates; at odd coordinates x is mirrored."""
POINT = 0.8
"""Length of a pointed end, in cells."""


class Creature(NamedTuple):
    """A body and its muscles."""

    name: str
    mesh: Mesh
    muscles: Int[np.ndarray, "k 2"]
    """Vertices at the two ends of every muscle, from left to right."""


def beam(length: float, height: float, cells_x: int, cells_y: int) -> Mesh:
    """Returns triangles on [0, length] x [0, height], in m; (cells_x + 1)(cells_y + 1) vertices, ordered along x first.

    Diagonals alternate: with an even number of cells along an axis, the mesh is its own mirror image along it.
    """
    return _grid((length, height), (cells_x, cells_y))


def box(lengths: tuple[float, float, float], cells: tuple[int, int, int]) -> Mesh:
    """Returns five tetrahedra per cell on [0, lx] x [0, ly] x [0, lz], in m; as symmetric as `beam`."""
    return _grid(lengths, cells)


def disc(radius: float, rings: int) -> Mesh:
    """Returns triangles on a disc around the origin, radius in m; 1 + 3 rings (rings + 1) vertices, 6 rings² triangles.

    Ring k has 6 k vertices; the boundary is a regular polygon inscribed in the circle.
    """
    _require_sizes(radius=radius)
    require_positive(rings=rings)
    _require_room(6 * rings**2)
    vertices, elements = [np.zeros((1, 2))], []
    for k in range(1, rings + 1):
        angles = 2 * np.pi * np.arange(6 * k) / (6 * k)
        vertices.append(radius * k / rings * np.stack([np.cos(angles), np.sin(angles)], axis=1))
        for sector, t in itertools.product(range(6), range(k)):
            within, without = (k - 1) * sector + t, k * sector + t
            elements.append((_on_ring(k - 1, within), _on_ring(k, without), _on_ring(k, without + 1)))
            if t < k - 1:
                elements.append((_on_ring(k - 1, within), _on_ring(k, without + 1), _on_ring(k - 1, within + 1)))
    return make_mesh(np.concatenate(vertices), elements)


def lattice(cells: ArrayLike) -> tuple[Int[np.ndarray, "n dim"], Int[np.ndarray, "m corners"]]:
    """Returns integer positions and positively oriented elements of the unit cells with these lower corners [c, dim].

    Vertices are in lexicographic order. Any set of cells works; scale the positions and pass both to `make_mesh`.
    """
    lower = np.asarray(cells, dtype=np.int64)
    pattern = np.array(PATTERNS[lower.shape[1]])
    mirrored = pattern.copy()
    mirrored[..., 0] = 1 - mirrored[..., 0]
    mirrored[:, -2:] = mirrored[:, :-3:-1].copy()  # Mirroring inverts an element; swapping two corners restores it.
    odd = lower.sum(axis=1) % 2 == 1
    corners = lower[:, None, None] + np.where(odd[:, None, None, None], mirrored, pattern)
    positions, numbers = np.unique(corners.reshape(-1, lower.shape[1]), axis=0, return_inverse=True)
    return positions, numbers.reshape(-1, pattern.shape[1])


def crawler() -> Creature:
    """A long low body on four small feet, pointed at both ends: 28 vertices, 24 muscles."""
    return _drawn("crawler", 0.3, "<########>", " #.#..#.# ")


def biped() -> Creature:
    """A body on two legs: 32 vertices, 24 muscles."""
    return _drawn("biped", 0.4, "####", "####", "####", "#..#", "#..#", "#..#")


def quadruped() -> Creature:
    """A body on two pairs of legs: 43 vertices, 32 muscles."""
    return _drawn("quadruped", 0.4, "########", "########", "#.#..#.#", "#.#..#.#")


def box_quadruped() -> Creature:
    """A body in space on four legs, made of cubes of 0.4 m: 56 vertices, 48 muscles along legs, back and belly."""
    body = itertools.product(range(4), range(3), (1,))
    legs = itertools.product((0, 3), (0, 2), (0,))
    positions, elements = lattice([*body, *legs])
    mesh = make_mesh(0.4 * positions.astype(np.float64), elements)
    number = {tuple(position): index for index, position in enumerate(positions.tolist())}
    along = [(p, (p[0] + 1, p[1], p[2])) for p in number if p[2] > 0]
    upright = [(p, (p[0], p[1], 1)) for p in number if p[2] == 0]
    pairs = [(number[start], number[end]) for start, end in along + upright if end in number]
    return Creature("box-quadruped", mesh, np.array(pairs))


def creature_named(name: str) -> Creature:
    """Returns the creature of this name; `InputError` lists the names if it is unknown."""
    creatures = {"crawler": crawler, "biped": biped, "quadruped": quadruped, "box-quadruped": box_quadruped}
    if name not in creatures:
        raise InputError(f"creature '{name}' is unknown; choose from {', '.join(creatures)}")
    return creatures[name]()


def body_length(creature: Creature) -> float:
    """Extent of the rest shape along x, in m."""
    return float(np.ptp(creature.mesh.vertices[:, 0]))


def _drawn(name: str, size: float, *rows: str) -> Creature:
    """Builds the creature of a drawing with cells of `size` m."""
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


def _grid(lengths: tuple[float, ...], cells: tuple[int, ...]) -> Mesh:
    names = "xyz"[: len(lengths)]
    _require_sizes(**{f"length along {name}": length for name, length in zip(names, lengths, strict=True)})
    require_positive(**{f"number of cells along {name}": count for name, count in zip(names, cells, strict=True)})
    _require_room(len(PATTERNS[len(cells)]) * math.prod(cells))
    positions, elements = lattice(list(itertools.product(*(range(count) for count in cells))))
    ticks = [np.linspace(0.0, length, count + 1) for length, count in zip(lengths, cells, strict=True)]
    return make_mesh(np.stack([tick[positions[:, axis]] for axis, tick in enumerate(ticks)], axis=1), elements)


def _on_ring(k: int, place: int) -> int:
    """Returns the index of the vertex at a position on ring k, modulo the ring."""
    return 0 if k == 0 else 1 + 3 * k * (k - 1) + place % (6 * k)


def _require_room(elements: int) -> None:
    # Estimate for vertices, derivatives, blocks of the Hessian and its factor.
    require_memory(f"a mesh of {elements:,} elements", 4096.0 * elements)


def _require_sizes(**sizes: int | float) -> None:
    require_positive(**sizes)
    for name, value in sizes.items():
        if not math.isfinite(value):
            raise InputError(f"{name} is {value}; expected a finite number, in m")


def join(*meshes: Mesh, **bodies: Mesh) -> Mesh:
    """Returns one mesh of several bodies without common vertices: `join(floor, left=pad, right=pad)`.

    Named sets are kept; sets with the same name are merged. A body passed by name becomes a set with this name, for
    example to give it its own material (`values_by_set`).

    Raises:
        InputError: there is no mesh, or the meshes mix plane and space, or linear and quadratic elements.
    """
    for name, mesh in bodies.items():
        whole = NamedSet(np.arange(len(mesh.vertices)), np.arange(len(mesh.elements)))
        meshes += (mesh._replace(sets={**mesh.sets, name: whole}),)
    if len({(mesh.dimension, mesh.midsides is None) for mesh in meshes}) != 1:
        raise InputError("there is no mesh, or the meshes differ in dimension or order; join meshes of the same kind")
    starts = [0, *itertools.accumulate(len(mesh.vertices) for mesh in meshes)]
    sets: dict[str, NamedSet] = {}
    elements = 0
    for mesh, start in zip(meshes, starts, strict=False):
        for name, (vertices, members) in mesh.sets.items():
            before = sets.get(name, NamedSet(np.zeros(0, int), np.zeros(0, int)))
            sets[name] = NamedSet(
                np.append(before.vertices, vertices + start), np.append(before.elements, members + elements)
            )
        elements += len(mesh.elements)
    nodes = np.concatenate([mesh.nodes + start for mesh, start in zip(meshes, starts, strict=False)])
    corners = meshes[0].dimension + 1
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        nodes[:, :corners],
        sets=sets,
        midsides=None if meshes[0].midsides is None else nodes[:, corners:],
    )


def translate(mesh: Mesh, offset: ArrayLike) -> Mesh:
    """Returns the mesh moved by an offset [dim] in m."""
    return mesh._replace(vertices=mesh.vertices + finite_array("offset", offset, (mesh.dimension,)))


def rotate(mesh: Mesh, rotation: ArrayLike, *, about: ArrayLike | None = None) -> Mesh:
    """Returns the mesh turned about a point, by default its centre.

    Args:
        mesh: the mesh.
        rotation: an angle in rad, counterclockwise, in the plane; a rotation vector [3] in rad in space.
        about: the point [dim], m.
    """
    size = 1 if mesh.dimension == 2 else 3
    turn = finite_array("rotation", np.atleast_1d(rotation), (size,))
    R = Rotation.from_rotvec(turn if size == 3 else [0.0, 0.0, turn[0]]).as_matrix()[: mesh.dimension, : mesh.dimension]
    centre = mesh.vertices.mean(axis=0) if about is None else finite_array("about", about, (mesh.dimension,))
    return mesh._replace(vertices=(mesh.vertices - centre) @ R.T + centre)


def quadratic(mesh: Mesh) -> Mesh:
    """Adds a node in the middle of every edge: triangles of 6 nodes and tetrahedra of 10.

    The new vertices come after the existing ones, which keep their indices. `with_midsides` extends named sets. Edges
    are straight; for a curved rest shape, move vertices by `mesh._replace(vertices=...)`. With curved edges, uniform
    strains are exact in the plane but not in space: move only mid-side nodes on the boundary.

    Raises:
        InputError: the mesh is already quadratic.
    """
    if mesh.midsides is not None:
        raise InputError("the mesh is quadratic already; pass the linear mesh")
    pairs = np.sort(mesh.elements[:, np.array(SIDES[mesh.dimension])], axis=2)
    sides, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    midsides = len(mesh.vertices) + number.reshape(pairs.shape[:2])
    vertices = np.concatenate([mesh.vertices, mesh.vertices[sides].mean(axis=1)])
    body = mesh._replace(vertices=vertices, midsides=midsides.astype(np.int32))
    sets = {name: part._replace(vertices=with_midsides(body, part.vertices)) for name, part in mesh.sets.items()}
    return body._replace(sets=MappingProxyType(sets))


def barycentric_split(mesh: Mesh) -> Mesh:
    """Splits each element of a linear mesh at its centre into 3 triangles or 4 tetrahedra (Alfeld split).

    In the plane, quadratic elements on a split mesh are the Scott-Vogelius pair of degree 2: it satisfies the inf-sup
    condition (Arnold and Qin 1992) and converges with order 3 even as nu approaches 1/2. In space this is proved only
    for degree 3 and above (Zhang 2005).

    Raises:
        InputError: the mesh is quadratic.
    """
    if mesh.midsides is not None:
        raise InputError("the mesh is quadratic; split the linear mesh, then pass it to quadratic")
    centres = len(mesh.vertices) + np.arange(len(mesh.elements))
    corners = np.arange(mesh.dimension + 1)
    parts = [np.where(corners == i, centres[:, None], mesh.elements) for i in corners]
    vertices = np.concatenate([mesh.vertices, mesh.vertices[mesh.elements].mean(axis=1)])
    count = len(mesh.elements)
    sets = {
        name: NamedSet(
            np.concatenate([part.vertices, centres[part.elements]]),
            np.concatenate([i * count + part.elements for i in corners]),
        )
        for name, part in mesh.sets.items()
    }
    split = make_mesh(vertices, np.concatenate(parts))
    return split._replace(turned=mesh.turned, sets=MappingProxyType(sets))


def with_midsides(mesh: Mesh, vertices: ArrayLike) -> Int[np.ndarray, " k"]:
    """Returns corners of a quadratic mesh together with the mid-side nodes between any two of them, for `held`."""
    vertices = indices_of("held", vertices, len(mesh.vertices))
    chosen = np.isin(mesh.elements, vertices)[:, np.array(SIDES[mesh.dimension])].all(axis=2)
    return np.union1d(vertices, mesh.nodes[:, mesh.dimension + 1 :][chosen]).astype(int)
