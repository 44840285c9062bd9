"""Mesh files: .msh of Gmsh by `mesh/gmsh.py`; .vtk, .vtu, .obj and TetGen's .ele and .node by meshio (extra `[mesh]`).

VTK has no sets, so integer arrays define them. An array of 0 and 1, as written by `write_mesh`, marks the members of
the set with its name. An array with up to `MOST_REGIONS` different numbers gives sets NAME-0, NAME-1, ... Arrays from
meshio's own conversion of sets, with names joined by hyphens, are read too.
"""

import contextlib
import importlib
import io
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from dln_jax.files import is_file, write_bytes, writing
from dln_jax.softbody.mesh.gmsh import read_gmsh
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import simplex_volumes
from dln_jax.softbody.mesh.solids import ELEMENTS, MERGE, FileMesh, ReadMesh, corners_by_kind, solid_mesh
from dln_jax.types import InputError, require_positive

SUFFIXES = (".msh", ".vtk", ".vtu", ".obj", ".ele", ".node")
QUADRATIC = {2: "triangle6", 3: "tetra10"}
"""Quadratic cells by dimension, in meshio's names, with nodes in VTK's order, as in `Mesh.nodes`."""
MOST_REGIONS = 64
"""An integer array with more different numbers is a numbering and defines no regions."""
INSTALL = "pip install 'dln-jax[mesh]'"


def read_mesh(path: str | Path, *, scale: float = 1.0, merge: float = MERGE) -> ReadMesh:
    """Reads the body in a mesh file with its named sets, and reports omissions and repairs.

    Args:
        path: a .msh (2.2 or 4.1, ASCII or binary), .vtk, .vtu, .obj, .ele or .node file.
        scale: length of the file's unit in m, such as 0.001 for millimetres.
        merge: vertices closer than this fraction of the largest extent are merged; 0 merges none.

    Raises:
        InputError: the file is missing, damaged or of another format, meshio is needed and missing, or as `solid_mesh`.
    """
    path = Path(path)
    if not is_file(path):
        raise InputError(f"{path!s:.200}: no such file; give the path of a mesh")
    if (suffix := path.suffix.lower()) not in SUFFIXES:
        raise InputError(f"{path}: expected {', '.join(SUFFIXES)}; convert it, for example by meshio convert")
    try:
        content = _read_gmsh(path) if suffix == ".msh" else _read_by_meshio(path)
        return solid_mesh(content, scale=scale, merge=merge)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def write_mesh(
    path: Path,
    mesh: Mesh,
    x: Float[np.ndarray, "n dim"] | None = None,
    *,
    vertex_data: Mapping[str, np.ndarray] | None = None,
    element_data: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Writes a mesh with its named sets as .vtu. `read_mesh` returns the same sets (of quadratic meshes the corners).

    Args:
        x: positions in m (default: the rest shape).
        vertex_data: arrays [n] or [n, dim] by name.
        element_data: arrays [m] by name.

    Raises:
        InputError: meshio is missing, or the file cannot be written.
    """
    meshio = require_meshio("writing .vtu files")
    n, m = len(mesh.vertices), len(mesh.elements)
    vertices = {
        name: _flags(n, part.vertices)
        for name, part in mesh.sets.items()
        # A set of exactly the nodes of its elements needs no vertex array.
        if not len(part.elements) or not np.array_equal(part.vertices, np.unique(mesh.nodes[part.elements]))
    }
    elements = {name: _flags(m, part.elements) for name, part in mesh.sets.items() if len(part.elements)}
    vertices |= {name: _in_space(values) for name, values in (vertex_data or {}).items()}
    elements |= element_data or {}
    content = meshio.Mesh(
        _in_space(mesh.vertices if x is None else x),
        [((ELEMENTS if mesh.midsides is None else QUADRATIC)[mesh.dimension], mesh.nodes)],
        point_data=vertices,
        cell_data={name: [values] for name, values in elements.items()},
    )
    with writing(path) as partial:
        meshio.write(partial, content, file_format="vtu")


def write_motion(
    path: Path,
    mesh: Mesh,
    t: Float[np.ndarray, " T"],
    x: Float[np.ndarray, "T n dim"],
    v: Float[np.ndarray, "T n dim"],
    *,
    stride: int = 1,
) -> None:
    """Writes a motion for ParaView: PATH.pvd with the times, and one .vtu per saved moment in a folder beside it.

    Every .vtu has, in single precision, the positions in m, displacement in m, velocity in m/s, J (volume over rest
    volume) of the elements, and the named sets.

    Args:
        path: the .pvd file to write.
        mesh: rest shape.
        t, x, v: times in s, positions in m and velocities in m/s.
        stride: write every `stride`-th moment.
    """
    require_positive(stride=stride)
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    rest, lines = simplex_volumes(mesh.vertices, mesh.nodes), []
    for number, k in enumerate(range(0, len(t), stride)):
        name, position = f"{number:04d}.vtu", x[k].astype(np.float64)
        J = simplex_volumes(position, mesh.nodes) / rest
        data = {"displacement": position - mesh.vertices, "velocity": v[k]}
        write_mesh(
            folder / name,
            mesh,
            position.astype(np.float32),
            vertex_data={name: values.astype(np.float32) for name, values in data.items()},
            element_data={"J": J.astype(np.float32)},
        )
        lines.append(f'<DataSet timestep="{float(t[k])!r}" file="{folder.name}/{name}"/>')
    text = "\n".join(
        ['<VTKFile type="Collection" version="0.1">', "<Collection>", *lines, "</Collection>", "</VTKFile>\n"]
    )
    write_bytes(path, text.encode())


def require_meshio(purpose: str) -> Any:
    """Returns the module meshio; raises `InputError` with the install command if it is missing."""
    try:
        return importlib.import_module("meshio")
    except ImportError:
        raise InputError(f"{purpose} needs meshio, which is not installed; {INSTALL}") from None


def _read_gmsh(path: Path) -> FileMesh:
    try:
        with np.errstate(invalid="raise"):  # NaN as the number of a node
            return read_gmsh(path.read_bytes())
    except InputError:
        raise
    except (ValueError, IndexError, ArithmeticError) as error:
        raise InputError(f"not a readable .msh file ({error}); save it again") from None


def _read_by_meshio(path: Path) -> FileMesh:
    meshio = require_meshio(f"reading {path.suffix} files")
    printed = io.StringIO()
    try:
        # If meshio cannot read a file, it prints and exits the process.
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            content = meshio.read(path)
        points = np.asarray(content.points, np.float64)
        points = np.pad(points[:, :3], ((0, 0), (0, max(3 - points.shape[1], 0))))
        blocks = [(block.type.rstrip("0123456789"), np.asarray(block.data, np.int64)) for block in content.cells]
    except (Exception, SystemExit) as error:
        reason = printed.getvalue().strip() or f"{type(error).__name__}: {error}"
        raise InputError(f"meshio cannot read it ({' '.join(reason.split())[:200]}); save it again") from None
    cells, curved = corners_by_kind(blocks)
    vertex_sets = {
        name: np.flatnonzero(members)
        for key, values in content.point_data.items()
        for name, members in _sets(key, np.asarray(values))
    }
    kinds = np.repeat([kind for kind, _ in blocks], [len(nodes) for _, nodes in blocks])
    cell_sets: dict[str, dict[str, np.ndarray]] = {}
    for key, parts in content.cell_data.items():
        if key.startswith("obj:"):  # numbers of groups, which meshio has not kept the names of
            continue
        for name, members in _sets(key, np.concatenate([np.asarray(part) for part in parts])):
            cell_sets[name] = {kind: np.flatnonzero(members[kinds == kind]) for kind in cells}
    return FileMesh(points, cells, vertex_sets, cell_sets, curved)


def _sets(key: str, values: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yields names and members of the sets in an array of a VTK file; nothing for other types than integers."""
    if values.dtype.kind not in "iu" or values.ndim != 1 or not len(values):
        return
    numbers, names = np.unique(values), _joined_names(key)
    flags = set(numbers.tolist()) <= {0, 1} and (values.dtype.itemsize == 1 or 1 in numbers)
    joined = numbers[0] >= -1 and numbers[-1] < len(names) and (len(names) > 1 or numbers[0] < 0)
    if flags and (values.dtype.itemsize == 1 or not joined):
        yield key, values == 1
    elif joined:
        yield from ((name, values == number) for number, name in enumerate(names))
    elif len(numbers) <= MOST_REGIONS:
        yield from ((f"{key}-{number}", values == number) for number in numbers)


def _joined_names(key: str) -> list[str]:
    """Splits an array's name into the names of meshio's sets, joined by hyphens."""
    parts = key.split("-")
    count = math.isqrt(len(parts) - 1) + 1
    names = [parts[0][: len(parts[0]) // 2], *parts[1 : count - 1], parts[-1][: len(parts[-1]) // 2]]
    return names if "-".join(names).join(names) == key else parts


def _flags(count: int, members: np.ndarray) -> np.ndarray:
    flags = np.zeros(count, np.uint8)
    flags[members] = 1
    return flags


def _in_space(values: np.ndarray) -> np.ndarray:
    """Adds a third component of zero to vectors in the plane; leaves scalars unchanged."""
    return np.pad(values, ((0, 0), (0, 1))) if values.ndim == 2 and values.shape[1] == 2 else values
