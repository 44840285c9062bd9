"""Reads .msh files of Gmsh, versions 2.2 and 4.1, ASCII and binary, with all their physical groups.

The format is described in https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format. meshio 5 refuses files with elements
in no physical group (`Mesh.SaveAll`) or with parametric node coordinates, and keeps only one of several groups of an
element. This reader accepts all of these.
"""

import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dln_jax.softbody.mesh.solids import CELLS, FileMesh, corners_by_kind
from dln_jax.types import InputError

Take = Callable[[str, Any], np.ndarray]
"""(type, count) -> the next numbers of a section."""
_Block = tuple[str, np.ndarray, tuple[str, ...]]
"""Kind and nodes of cells with the same physical groups, and these groups."""

KINDS = {
    1: "line2",
    2: "triangle3",
    3: "quad4",
    4: "tetra4",
    5: "hexahedron8",
    6: "wedge6",
    7: "pyramid5",
    8: "line3",
    9: "triangle6",
    10: "quad9",
    11: "tetra10",
    12: "hexahedron27",
    13: "wedge18",
    14: "pyramid14",
    15: "vertex1",
    16: "quad8",
    17: "hexahedron20",
    18: "wedge15",
    19: "pyramid13",
    21: "triangle10",
    23: "triangle15",
    25: "triangle21",
    26: "line4",
    27: "line5",
    28: "line6",
    29: "tetra20",
    30: "tetra35",
    31: "tetra56",
    36: "quad16",
    37: "quad25",
}
"""Kind of cell by Gmsh's number, and number of its nodes at the end."""
GEOMETRY = ("point", "curve", "surface", "volume")
"""Names of unnamed physical groups, completed by their number, such as surface-3."""


def read_gmsh(data: bytes) -> FileMesh:
    """Reads the content of a .msh file.

    Raises:
        InputError: another version, a partitioned mesh, an unknown kind of element, or a truncated section.
        ValueError: the numbers of a section do not fit its header.
    """
    sections = dict(_sections(data))
    form = sections.get("MeshFormat", b"").split(maxsplit=3)
    if len(form) < 3 or (version := form[0].decode(errors="replace")) not in ("2", "2.2", "4.1"):
        found_version = "no version" if len(form) < 3 else f"version {form[0].decode(errors='replace'):.10}"
        raise InputError(f"{found_version} of the MSH format; expected 2.2 or 4.1: save it by gmsh -format msh41")
    if "PartitionedEntities" in sections:
        raise InputError("a partitioned mesh; save it without partitions")
    if missing := [name for name in ("Nodes", "Elements") if name not in sections]:
        raise InputError(f"it has no section ${missing[0]}; mesh the model and save it again")
    binary = form[1] == b"1"
    if binary and form[2] not in (b"4", b"8"):
        raise InputError(f"its numbers have {form[2].decode(errors='replace'):.10} bytes; expected 4 or 8")
    types = None
    if binary:
        order = ">" if form[3][:4] == b"\0\0\0\1" else "<"
        types = {"i": f"{order}i4", "d": f"{order}f8", "n": f"{order}u{int(form[2])}"}
    names = {
        (int(dimension), int(tag)): name.decode(errors="replace")
        for dimension, tag, name in re.findall(rb'(\d+)\s+(\d+)\s+"(.*)"', sections.get("PhysicalNames", b""))
    }

    def reader(name: str) -> Take:
        return _reader(sections[name], types)

    if version == "4.1":
        tags, points = _nodes(reader("Nodes"))
        blocks = list(_elements(reader("Elements"), _groups(reader, sections, names)))
    else:
        tags, points = _nodes_2(sections["Nodes"], types)
        blocks = list(_elements_2(sections["Elements"], types, names))
    return _gathered(tags, points, blocks, list(names.values()))


def _gathered(tags: np.ndarray, points: np.ndarray, blocks: list[_Block], names: list[str]) -> FileMesh:
    """Joins the blocks of every kind, and numbers nodes by their position in the file instead of their tags.

    A named group without elements becomes an empty set: MSH 2.2 with `Mesh.SaveAll` keeps only the names.
    """
    order = np.argsort(tags, kind="stable")
    cells, curved = corners_by_kind([(kind, nodes) for kind, nodes, _ in blocks])
    sets: dict[str, dict[str, list[np.ndarray]]] = {name: {} for name in names}
    starts = dict.fromkeys(cells, 0)
    for kind, nodes, groups in blocks:
        for name in groups:
            sets.setdefault(name, {}).setdefault(kind, []).append(starts[kind] + np.arange(len(nodes)))
        starts[kind] += len(nodes)
    for kind, nodes in cells.items():
        place = np.searchsorted(tags[order], nodes).clip(max=len(tags) - 1)
        if len(unknown := np.argwhere(tags[order][place] != nodes)):
            raise InputError(
                f"{kind} {unknown[0][0]} has node {nodes[tuple(unknown[0])]}, which the file does not list"
            )
        cells[kind] = order[place]
    joined = {name: {kind: np.concatenate(parts) for kind, parts in kinds.items()} for name, kinds in sets.items()}
    return FileMesh(points, cells, {}, joined, curved)


def _sections(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yields names and contents of the sections between $Name and $EndName."""
    at = 0
    while (start := data.find(b"$", at)) >= 0:
        content = data.find(b"\n", start) + 1 or len(data)
        name = data[start + 1 : content].strip()
        end = data.find(b"$End" + name, content)
        if end < 0:
            raise InputError(f"section ${name.decode(errors='replace'):.40} does not end; the file is cut off")
        yield name.decode(errors="replace"), data[content:end]
        at = end + len(name) + 4


def _reader(section: bytes, types: dict[str, str] | None) -> Take:
    """Returns a function that reads numbers in order, of these NumPy types or as text."""
    numbers = np.fromiter(map(float, section.split() if types is None else ()), np.float64)
    at = 0

    def take(kind: str, count: Any) -> np.ndarray:
        nonlocal at
        if types is None:
            part = numbers[at : at + int(count)]
            at += len(part)
        else:
            part = np.frombuffer(section, types[kind], int(count), at) if count else np.zeros(0)
            at += part.nbytes
        if len(part) != count:  # a negative count takes all
            raise ValueError("a section has fewer numbers than its header states")
        return part.astype(np.float64 if kind == "d" else np.int64)

    return take


def _groups(
    reader: Callable[[str], Take], sections: dict[str, bytes], names: dict[tuple[int, int], str]
) -> dict[tuple[int, int], tuple[str, ...]]:
    """Returns physical groups by dimension and tag of the entities; files without entities have none."""
    groups: dict[tuple[int, int], tuple[str, ...]] = {}
    if "Entities" not in sections:
        return groups
    take = reader("Entities")
    for dimension, count in enumerate(take("n", 4)):
        for _ in range(count):
            tag = int(take("i", 1)[0])
            take("d", 6 if dimension else 3)  # bounding box
            physical = take("i", take("n", 1)[0])
            groups[dimension, tag] = tuple(_name(names, dimension, abs(int(group))) for group in physical)
            if dimension:
                take("i", take("n", 1)[0])  # entities of its boundary
    return groups


def _nodes(take: Take) -> tuple[np.ndarray, np.ndarray]:
    """Returns tags and positions of the nodes, version 4.1."""
    tags, points = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for _ in range(take("n", 4)[0]):
        dimension, _, parametric = take("i", 3)
        count = take("n", 1)[0]
        tags.append(take("n", count))
        points.append(take("d", count * (columns := 3 + dimension * bool(parametric))).reshape(count, columns)[:, :3])
    return np.concatenate(tags), np.concatenate(points)


def _elements(take: Take, groups: dict[tuple[int, int], tuple[str, ...]]) -> Iterator[_Block]:
    """Yields elements of version 4.1, with the groups of their entity."""
    for _ in range(take("n", 4)[0]):
        dimension, tag, number = take("i", 3)
        kind, nodes = _kind(number)
        count = take("n", 1)[0]
        rows = take("n", count * (1 + nodes)).reshape(count, 1 + nodes)
        yield kind, rows[:, 1:], groups.get((int(dimension), int(tag)), ())


def _nodes_2(section: bytes, types: dict[str, str] | None) -> tuple[np.ndarray, np.ndarray]:
    """Returns tags and positions of the nodes, version 2.2."""
    count, _, content = section.partition(b"\n")
    if types is not None:
        rows = np.frombuffer(content, [("tag", types["i"]), ("x", types["d"], 3)], int(count))
        return rows["tag"].astype(np.int64), rows["x"].astype(np.float64)
    table = _reader(content, None)("d", 4 * int(count)).reshape(-1, 4)
    return table[:, 0].astype(np.int64), table[:, 1:]


def _elements_2(section: bytes, types: dict[str, str] | None, names: dict[tuple[int, int], str]) -> Iterator[_Block]:
    """Yields elements of version 2.2: the first tag of an element is its group, and the element appears once per
    group."""
    count, _, content = section.partition(b"\n")
    take, binary = _reader(content, types), types is not None
    tables: dict[tuple[int, int], list[np.ndarray]] = {}
    read = 0
    while read < int(count):
        # ASCII has kind and number of tags for every element (number, kind, tags), binary for a block of elements.
        number, block, tags = map(int, take("i", 3)[slice(None) if binary else [1, 0, 2]])
        if tags < 0:
            raise ValueError("an element has a negative number of tags")
        columns, block = int(binary) + tags + _kind(number)[1], block if binary else 1
        tables.setdefault((number, tags), []).append(take("i", block * columns).reshape(block, columns))
        read += max(block, 1)
    for (number, tags), parts in tables.items():
        table, kind = np.concatenate(parts)[:, int(binary) :], _kind(number)[0]
        groups = table[:, 0] if tags else np.zeros(len(table), np.int64)
        for group in np.unique(groups).tolist():
            name = (_name(names, CELLS[kind][0], group),) if group else ()
            yield kind, table[groups == group][:, tags:], name


def _kind(number: Any) -> tuple[str, int]:
    """Returns the linear kind of the cells with this number of Gmsh, and the number of their nodes."""
    if (kind := KINDS.get(int(number))) is None:
        raise InputError(f"it has elements of Gmsh's type {number}; expected linear triangles or tetrahedra")
    linear = kind.rstrip("0123456789")
    return linear, int(kind.removeprefix(linear))


def _name(names: dict[tuple[int, int], str], dimension: int, tag: int) -> str:
    return names.get((dimension, tag), f"{GEOMETRY[dimension]}-{tag}")
