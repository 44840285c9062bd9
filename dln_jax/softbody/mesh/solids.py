"""Builds a body from the content of a mesh file: selects its triangles or tetrahedra, repairs them, keeps named sets.

Every change is reported. A set of surfaces, curves or points becomes a set of vertices; a set of the body's own
elements becomes a set of elements and of their corners.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from dln_jax.errors import LARGEST
from dln_jax.softbody.mesh.mesh import FLAT, WORDS, Mesh, NamedSet, make_mesh
from dln_jax.softbody.mesh.simplices import regularity
from dln_jax.types import InputError, require_positive

MERGE = 1e-7
"""Vertices closer than this fraction of the largest extent are merged; single precision rounds to 6e-8."""
CELLS = {
    "vertex": (0, 1),
    "line": (1, 2),
    "triangle": (2, 3),
    "quad": (2, 4),
    "polygon": (2, None),
    "tetra": (3, 4),
    "pyramid": (3, 5),
    "wedge": (3, 6),
    "hexahedron": (3, 8),
}
"""Dimension and number of corners of the cells that a file may contain; corners come first in all formats."""
ELEMENTS = {2: "triangle", 3: "tetra"}


class FileMesh(NamedTuple):
    """Content of a mesh file before selection and repair."""

    points: Float[np.ndarray, "n 3"]
    cells: dict[str, Int[np.ndarray, "m k"]]
    """Corners of the cells by kind, in meshio's names for linear cells: triangle, tetra, ..."""
    vertex_sets: dict[str, Int[np.ndarray, " k"]]
    cell_sets: dict[str, dict[str, Int[np.ndarray, " k"]]]
    """Indices of cells by name of the set and kind of cell."""
    curved: Mapping[str, int] = MappingProxyType({})
    """Number of higher-order cells, reduced to their corners, by kind."""


class ReadMesh(NamedTuple):
    """A body from a mesh file."""

    mesh: Mesh
    statements: tuple[str, ...]
    """Sentences about omissions, simplifications and repairs. `Mesh.turned` counts reoriented elements."""


def solid_mesh(content: FileMesh, *, scale: float = 1.0, merge: float = MERGE) -> ReadMesh:
    """Builds the body in a mesh file.

    The body is the file's tetrahedra or, without any, its triangles in a plane z = const. Cells of higher order are
    reduced to their corners. Close vertices are merged, loose vertices and repeated elements removed.

    Args:
        scale: length of the file's unit in m, such as 0.001 for millimetres.
        merge: fraction of the largest extent; 0 merges none.

    Raises:
        InputError: the file has a surface without volume, cells that are not simplices (such as hexahedra), an element
            without volume, or positions that are not finite.
    """
    require_positive(scale=scale)
    of_dimension = {
        d: {kind: nodes for kind, nodes in content.cells.items() if CELLS.get(kind, (3,))[0] == d and len(nodes)}
        for d in (2, 3)
    }
    if not any(of_dimension.values()):
        raise InputError("it has no triangles or tetrahedra; mesh the body, and save its elements")
    dimension = 3 if of_dimension[3] else 2
    element = ELEMENTS[dimension]
    points = scale * content.points
    if len(bad := np.flatnonzero(~(np.abs(points) <= LARGEST).all(axis=1))):
        raise InputError(f"vertex {bad[0]} is at {points[bad[0]].tolist()} m; expected finite positions")
    for kind, nodes in content.cells.items():
        if len(bad := np.argwhere((nodes < 0) | (nodes >= len(points)))):
            vertex = nodes[tuple(bad[0])]
            raise InputError(f"{kind} {bad[0][0]} has vertex {vertex}; expected 0 to {len(points) - 1}")
    if dimension == 2:
        points = _in_plane(points, np.concatenate([nodes.ravel() for nodes in of_dimension[2].values()]))
    for kind, nodes in of_dimension[dimension].items():
        if kind != element:
            raise InputError(f"it has {len(nodes)} {_plural(kind)}; mesh the body with {_plural(element)} only")
    elements, statements = content.cells[element], []
    if count := content.curved.get(element):
        statements.append(f"{count} elements of higher order are reduced to their corners, with straight edges")
    if others := [f"{len(of)} {_plural(kind)}" for kind, of in content.cells.items() if kind != element and len(of)]:
        kept = f"{len(elements)} {_plural(element)}"
        statements.append(f"the body consists of {kept}; {', '.join(others)} are left out and only define vertex sets")
    sets = {name: (vertices, np.zeros(0, np.int64)) for name, vertices in content.vertex_sets.items()}
    for name, members in content.cell_sets.items():
        corners = [content.cells[kind][indices].ravel() for kind, indices in members.items()]
        vertices = np.concatenate([*(sets[name][:1] if name in sets else ()), *corners, np.zeros(0, np.int64)])
        sets[name] = vertices, members.get(element, np.zeros(0, np.int64))
    return _repaired(points, elements, sets, merge, statements)


def corners_by_kind(blocks: Sequence[tuple[str, np.ndarray]]) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Returns corners of the cells by kind, and numbers of higher-order cells, from a file's blocks (linear kind,
    nodes)."""
    cells, curved = {}, {}
    for kind in dict.fromkeys(kind for kind, _ in blocks):
        count = CELLS.get(kind, (3, None))[1]
        own = [nodes for name, nodes in blocks if name == kind]
        cells[kind] = np.concatenate([nodes[:, :count] for nodes in own])
        curved[kind] = sum(len(nodes) for nodes in own if count and nodes.shape[1] > count)
    return cells, curved


def _plural(kind: str) -> str:
    return {"vertex": "points", "tetra": "tetrahedra", "hexahedron": "hexahedra"}.get(kind, f"{kind}s")


def _in_plane(points: Float[np.ndarray, "n 3"], corners: Int[np.ndarray, " k"]) -> Float[np.ndarray, "n 2"]:
    """Returns x and y of the points if these corners lie in a plane z = const; refuses other surfaces."""
    extents = np.ptp(points[corners], axis=0)
    flat = np.flatnonzero(extents <= MERGE * extents.max())
    if 2 in flat:
        return points[:, :2]
    if flat.size:
        raise InputError(f"it lies in a plane {'xyz'[flat[0]]} = const; rotate it to z = const, with y upwards")
    raise InputError(
        "it is a surface without volume; fill it with tetrahedra first, for example by Gmsh, TetGen or fTetWild"
    )


def _repaired(
    points: Float[np.ndarray, "n dim"],
    elements: Int[np.ndarray, "m corners"],
    sets: dict[str, tuple[np.ndarray, np.ndarray]],
    merge: float,
    statements: list[str],
) -> ReadMesh:
    """Merges and removes vertices and elements, renumbers the sets, and reports the changes."""
    extent = float(np.ptp(points[elements.ravel()], axis=0).max())
    same = _first_of_same(points, merge * extent)
    shape = regularity(points[same], elements)
    if len(bad := np.flatnonzero(np.abs(shape) <= FLAT)):
        kind, measure = WORDS[points.shape[1]]
        where = np.round(points[elements[bad[0]]].mean(axis=0), 9).tolist()
        raise InputError(
            f"{kind} {bad[0]} of {len(elements)} (near {where} m) has no {measure} once vertices closer than "
            f"{merge * extent:.1e} m are merged; repair the mesh ({len(bad)} of this kind)"
        )
    merged = same[elements]
    _, first, new_element = np.unique(np.sort(merged, axis=1), axis=0, return_index=True, return_inverse=True)
    # Elements stay in the order of the file.
    rank = np.argsort(np.argsort(first))
    kept, new_element = merged[np.sort(first)], rank[new_element.reshape(-1)]
    used, corners = np.unique(kept, return_inverse=True)
    loose = len(np.unique(same)) - len(used)
    counts = (
        (
            len(points) - len(np.unique(same)),
            f"duplicate vertices are merged (closer than {merge:.0e} of the extent, {merge * extent:.1e} m)",
        ),
        (loose, "loose vertices without an element are removed"),
        (len(elements) - len(kept), "repeated elements are removed"),
    )
    statements += [f"{count} {what}" for count, what in counts if count]
    new_vertex = np.full(len(points), -1)
    new_vertex[used] = np.arange(len(used))
    named = {}
    for name, (vertices, own) in sets.items():
        members = np.unique(new_vertex[same[vertices]])
        named[name] = NamedSet(members[members >= 0], np.unique(new_element[own]))
    mesh = make_mesh(points[used], corners.reshape(kept.shape))
    return ReadMesh(mesh._replace(sets=named), tuple(statements))


def _first_of_same(points: Float[np.ndarray, "n dim"], distance: float) -> Int[np.ndarray, " n"]:
    """Returns for every point the smallest index among the points connected to it by steps up to this distance."""
    if not distance > 0:
        return np.arange(len(points))
    pairs = KDTree(points).query_pairs(distance, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    _, labels = connected_components(graph, directed=False)
    return np.unique(labels, return_index=True)[1][labels]
