"""Mesh files against the geometry they describe: formats, named sets, repairs, refusals and motions."""

import itertools
import struct
import sys
import xml.etree.ElementTree as ET

import meshio
import numpy as np
import pytest
from calls import assert_refused, command, one_line
from hypothesis import given, settings
from hypothesis import strategies as st

from dln_jax.commands import simulate
from dln_jax.softbody.mesh.files import read_mesh, write_mesh, write_motion
from dln_jax.softbody.mesh.mesh import (
    Mesh,
    NamedSet,
    boundary,
    components,
    make_mesh,
    values_by_set,
    vertices_in,
    volumes,
)
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.mesh.solids import FileMesh, corners_by_kind, solid_mesh
from dln_jax.types import InputError

BODIES = {2: beam(2.0, 1.0, 4, 2), 3: box((2.0, 1.0, 1.0), (4, 2, 2))}
TYPES = {1: 1, 2: 2, 3: 4}  # Gmsh's numbers of lines, triangles and tetrahedra


def parts(mesh):
    """Entities of a model: the dimension, the cells and the groups of each. One facet entity is in no group."""
    d, skin = mesh.dimension, boundary(mesh)
    right = mesh.vertices[mesh.elements][:, :, 0].mean(axis=1) > 1.0
    at_base = (mesh.vertices[skin][:, :, 0] == 0).all(axis=1)
    return [
        (d, mesh.elements[~right], [1]),
        (d, mesh.elements[right], [1, 2]),
        (d - 1, skin[at_base], [3]),
        (d - 1, skin[~at_base], []),
    ]


def gmsh_file(mesh, version, binary, *, names=True, parametric=False):
    """A .msh file as Gmsh writes it with Mesh.SaveAll (4.1), or with its groups (2.2), by the format's description."""
    pieces = []

    def put(form, *numbers, end=False):
        if binary:
            pieces.append(struct.pack("<" + form, *numbers))
        else:
            pieces.append((" ".join(f"{number:.17g}" for number in numbers) + " \n"[end]).encode())

    def line(text):
        pieces.append(text.encode() + b"\n")

    d, x = mesh.dimension, np.pad(mesh.vertices, ((0, 0), (0, 3 - mesh.dimension))).tolist()
    line(f"$MeshFormat\n{version} {int(binary)} 8")
    if binary:
        put("i", 1)
        line("")
    line("$EndMeshFormat")
    if names:
        line(f'$PhysicalNames\n3\n{d} 1 "whole body"\n{d} 2 "tip"\n{d - 1} 3 "base"\n$EndPhysicalNames')
    tags = 3 + 2 * np.arange(len(x))  # sparse, from 3 on
    rows = parts(mesh)
    if version == "4.1":
        line("$Entities")
        put("4Q", *[sum(dimension == k for dimension, *_ in rows) for k in range(4)], end=True)
        for dimension in range(4):
            for tag, (own, _, groups) in enumerate(rows):
                if own == dimension:
                    put("i6dQ", tag, *(0.0,) * 6, len(groups))
                    put(f"{len(groups)}i", *groups)
                    put("Q2i", 2, 1, -2, end=True)
        line("\n$EndEntities\n$Nodes")
        half = len(x) // 2
        put("4Q", 2, len(x), tags[0], tags[-1], end=True)
        for part, extra in ((slice(0, half), [0.5] * d * parametric), (slice(half, None), [])):
            put("3iQ", d, 0, bool(extra), len(x[part]), end=True)
            put(f"{len(x[part])}Q", *tags[part])
            for point in x[part]:
                put(f"{3 + len(extra)}d", *point, *extra, end=True)
        line("\n$EndNodes\n$Elements")
        put("4Q", len(rows), sum(len(cells) for _, cells, _ in rows), 1, 999, end=True)
        for tag, (dimension, cells, _) in enumerate(rows):
            put("3iQ", dimension, tag, TYPES[dimension], len(cells), end=True)
            for number, cell in enumerate(cells):
                put(f"{1 + len(cell)}Q", number + 1, *tags[cell], end=True)
    else:
        line(f"$Nodes\n{len(x)}")
        for tag, point in zip(tags, x, strict=True):
            put("i3d", tag, *point, end=True)
        listed = [(TYPES[k], group, cell) for k, cells, groups in rows for group in groups for cell in cells]
        line(f"\n$EndNodes\n$Elements\n{len(listed)}")
        for number, (kind, group, cell) in enumerate(listed):
            header = (kind, 1, 2, number) if binary else (number, kind, 2)
            put(f"{len(header) + 2 + len(cell)}i", *header, group, 7, *tags[cell], end=True)
    line("\n$EndElements")
    return b"".join(pieces)


def test_gmsh_files_are_read_with_their_groups(tmp_path):
    path = tmp_path / "finger.msh"
    for version, binary, dimension in itertools.product(("2.2", "4.1"), (False, True), (2, 3)):
        original = BODIES[dimension]
        path.write_bytes(gmsh_file(original, version, binary))
        mesh, statements = read_mesh(path)
        np.testing.assert_array_equal(mesh.vertices, original.vertices)
        assert mesh.turned == 0 and volumes(mesh).sum() == pytest.approx(2.0, rel=1e-14)
        # The groups are where their geometry is.
        right = mesh.vertices[mesh.elements][:, :, 0].mean(axis=1) > 1.0
        assert set(mesh.sets) == {"whole body", "tip", "base"}
        np.testing.assert_array_equal(vertices_in(mesh, ["base"]), np.flatnonzero(mesh.vertices[:, 0] == 0))
        np.testing.assert_array_equal(vertices_in(mesh, ["tip"]), np.unique(mesh.elements[right]))
        assert len(mesh.sets["base"].elements) == 0 and len(mesh.sets["whole body"].elements) == len(right)
        np.testing.assert_array_equal(values_by_set(mesh, 1e5, {"tip": 3e5}), np.where(right, 3e5, 1e5))
        assert any("left out" in statement for statement in statements)
        # In 2.2 an element is listed once for each of its groups.
        repeated = f"{right.sum()} repeated elements are removed"
        assert any(repeated in statement for statement in statements) == (version == "2.2")


def test_parametric_nodes_and_groups_without_names_are_read(tmp_path):
    path = tmp_path / "finger.msh"
    for binary in (False, True):
        path.write_bytes(gmsh_file(BODIES[3], "4.1", binary, names=False, parametric=True))
        mesh = read_mesh(path).mesh
        np.testing.assert_array_equal(mesh.vertices, BODIES[3].vertices)
        assert set(mesh.sets) == {"volume-1", "volume-2", "surface-3"}


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 100_000), st.integers(0, 255)), min_size=1, max_size=4), st.booleans())
def test_a_file_with_any_bytes_changed_is_read_or_refused(tmp_path_factory, changes, binary):
    data = bytearray(gmsh_file(BODIES[2], "4.1" if len(changes) % 2 else "2.2", binary))
    for place, value in changes:
        data[place % len(data)] = value
    path = tmp_path_factory.mktemp("changed") / "mesh.msh"
    path.write_bytes(data)
    try:
        read_mesh(path)
    except InputError as error:
        assert "\n" not in str(error)


def test_a_mesh_is_repaired_and_says_how(tmp_path):
    """Tetrahedra in mm that share no vertex, one inverted, one repeated, beside a loose vertex."""
    original = BODIES[3]
    m = len(original.elements)
    points = np.concatenate([1000 * original.vertices[original.elements].reshape(-1, 3), [[9e3, 0, 0]]])
    elements = np.arange(4 * m).reshape(m, 4)
    elements[3] = elements[3, [1, 0, 2, 3]]
    elements = np.concatenate([elements, elements[:1]])
    sets = {"last": {"tetra": np.array([m - 1, m])}}
    mesh, statements = solid_mesh(FileMesh(points, {"tetra": elements}, {"loose": np.array([4 * m])}, sets), scale=1e-3)
    assert mesh.turned == 1 and components(mesh).max() == 0 and len(mesh.vertices) == len(original.vertices)
    assert volumes(mesh).sum() == pytest.approx(2.0, rel=1e-14) and np.ptp(mesh.vertices[:, 0]) == pytest.approx(2.0)
    assert mesh.sets["last"].elements.tolist() == [0, m - 1] and len(mesh.sets["loose"].vertices) == 0
    assert [int(text.split()[0]) for text in statements] == [4 * m - len(original.vertices), 1, 1]
    with one_line(r"no two of the .* elements share a vertex"):
        solid_mesh(FileMesh(points, {"tetra": elements}, {}, {}), merge=0.0)


def test_elements_of_higher_order_are_reduced_to_their_corners():
    mesh = BODIES[2]
    n, m = len(mesh.vertices), len(mesh.elements)
    points = np.pad(mesh.vertices, ((0, 1), (0, 1)), constant_values=0.2)
    curved = np.pad(mesh.elements, ((0, 0), (0, 3)), constant_values=n)
    cells, count = corners_by_kind([("triangle", curved)])
    read = solid_mesh(FileMesh(points, cells, {}, {"all": {"triangle": np.arange(m)}}, count))
    np.testing.assert_array_equal(read.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.mesh.elements, mesh.elements)
    assert f"{m} elements of higher order" in read.statements[0] and len(read.mesh.sets["all"].vertices) == n


POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0], [2, 0, 0], [1, 1, 0], [0, 1, 1]])
REFUSED = {
    "surface without volume; fill it with tetrahedra first": {"triangle": [[0, 1, 2], [0, 1, 3]]},
    "it lies in a plane x = const": {"triangle": [[0, 2, 3], [2, 7, 3]]},
    "it has 1 hexahedra; mesh the body with tetrahedra only": {"tetra": [[0, 1, 2, 3]], "hexahedron": [range(8)]},
    "it has 1 quads; mesh the body with triangles only": {"triangle": [[0, 1, 2]], "quad": [[0, 1, 6, 2]]},
    "no triangles or tetrahedra": {"line": [[0, 1]]},
    r"tetrahedron 1 of 2 \(near .0.75, 0.25, 0.0. m\) has no volume": {"tetra": [[0, 1, 2, 3], [0, 1, 2, 5]]},
    "tetra 0 has vertex 9; expected 0 to 7": {"tetra": [[0, 1, 2, 9]]},
}


def test_what_is_no_body_is_refused():
    for words, cells in REFUSED.items():
        with one_line(words):
            solid_mesh(FileMesh(POINTS, {kind: np.array(list(map(list, of))) for kind, of in cells.items()}, {}, {}))


def test_files_that_cannot_be_read_are_refused(tmp_path, monkeypatch):
    whole, older = gmsh_file(BODIES[2], "4.1", False), gmsh_file(BODIES[2], "2.2", False)
    for name, data, words in (
        ("cut.msh", whole[: len(whole) // 2], "does not end; the file is cut off"),
        ("version.msh", whole.replace(b"4.1", b"4.0", 1), "version 4.0 of the MSH format; expected 2.2 or 4.1"),
        ("empty.msh", b"", "no version of the MSH format"),
        ("parts.msh", b"$PartitionedEntities\n$EndPartitionedEntities\n" + whole, "partitioned mesh"),
        ("few.msh", whole.replace(b"$Nodes\n2", b"$Nodes\n9"), "fewer numbers than its header"),
        ("bytes.msh", gmsh_file(BODIES[2], "4.1", True).replace(b"4.1 1 8", b"4.1 1 3", 1), "numbers have 3 bytes"),
        ("tags.msh", older.replace(b"\n1 2 2 ", b"\n1 2 -2 ", 1), "negative number of tags"),
        ("nan.msh", older.replace(b"\n1 2 2 ", b"\n1 2 nan ", 1), "not a readable .msh"),
        ("text.vtu", b"no xml", "meshio cannot read it"),
        ("empty.vtk", b"", "meshio cannot read it"),
        ("surface.stl", b"solid", "expected .msh, .vtk, .vtu, .obj"),
    ):
        (tmp_path / name).write_bytes(data)
        with one_line(f"{name}.*{words}"):
            read_mesh(tmp_path / name)
    monkeypatch.setitem(sys.modules, "meshio", None)
    with one_line("reading .vtu files needs meshio, which is not installed"):
        read_mesh(tmp_path / "text.vtu")
    (tmp_path / "whole.msh").write_bytes(whole)
    assert isinstance(read_mesh(tmp_path / "whole.msh").mesh, Mesh)


def test_sets_survive_a_round_trip_exactly(tmp_path):
    """Overlapping sets, an empty one, names with hyphens and spaces, and one of a surface and elements."""
    mesh, none = BODIES[2], np.zeros(0, np.int64)
    chosen = {"left-end": np.arange(5), "soft part": np.arange(3, 9), "0": np.arange(1)}
    sets = {name: NamedSet(np.unique(mesh.elements[of]), of) for name, of in chosen.items()}
    sets |= {"skin": NamedSet(np.array([1, 7, 9]), none), "none": NamedSet(none, none)}
    sets["both"] = NamedSet(np.unique([0, *mesh.elements[4], len(mesh.vertices) - 1]), np.array([4]))
    write_mesh(tmp_path / "mesh.vtu", mesh._replace(sets=sets))
    again, statements = read_mesh(tmp_path / "mesh.vtu")
    assert statements == () and set(again.sets) == set(sets)
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.elements, mesh.elements)
    for name, (vertices, elements) in sets.items():
        np.testing.assert_array_equal(again.sets[name].vertices, vertices, name)
        np.testing.assert_array_equal(again.sets[name].elements, elements, name)


def test_files_of_meshio_are_read(tmp_path):
    flat, solid = BODIES[2], BODIES[3]
    points, m = np.pad(flat.vertices, ((0, 0), (0, 1))), len(solid.elements)
    meshio.Mesh(points, [("triangle", flat.elements)]).write(tmp_path / "flat.obj")
    np.testing.assert_array_equal(read_mesh(tmp_path / "flat.obj").mesh.elements, flat.elements)
    region = 2 + np.arange(m) // (m // 2)
    for name in ("solid.vtk", "solid.vtu"):
        content = meshio.Mesh(solid.vertices, [("tetra", solid.elements)], cell_data={"region": [region]})
        content.point_sets = {"base": np.arange(5), "end": np.arange(5, 9), "other": np.arange(9, 11)}
        content.cell_sets = {"lower": [np.arange(4)], "upper": [np.arange(4, m)]}
        content.write(tmp_path / name)
        sets = read_mesh(tmp_path / name).mesh.sets
        counts = {"base": 0, "end": 0, "other": 0, "lower": 4, "upper": m - 4, "region-2": m // 2, "region-3": m // 2}
        assert {key: len(part.elements) for key, part in sets.items()} == counts
        assert sets["base"].vertices.tolist() == [0, 1, 2, 3, 4] and sets["end"].vertices.tolist() == [5, 6, 7, 8]


def test_motions_are_written_with_times_velocities_and_volumes(tmp_path):
    """An affine motion x = F(t) X has J = det F everywhere and velocities F' X."""
    mesh = BODIES[2]._replace(sets={"base": NamedSet(np.arange(3), np.zeros(0, np.int64))})
    t, rate = np.linspace(0.0, 0.6, 7), np.triu(np.full((2, 2), 0.5))
    F = np.eye(2) + t[:, None, None] * rate
    x = mesh.vertices @ F.swapaxes(1, 2)
    v = mesh.vertices @ rate.T
    write_motion(tmp_path / "motion.pvd", mesh, t, x, np.broadcast_to(v, x.shape), stride=3)
    frames = ET.parse(tmp_path / "motion.pvd").findall("./Collection/DataSet")
    assert [float(frame.attrib["timestep"]) for frame in frames] == pytest.approx(t[::3], abs=1e-15)
    for k, frame in zip((0, 3, 6), frames, strict=True):
        path = tmp_path / frame.attrib["file"]
        content = meshio.read(path)
        for written, expected in (
            (content.points, x[k]),
            (content.point_data["velocity"], v),
            (content.point_data["displacement"], x[k] - mesh.vertices),
        ):
            np.testing.assert_allclose(written[:, :2], expected, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(content.cell_data["J"][0], np.linalg.det(F[k]), rtol=1e-6)
        assert read_mesh(path).mesh.sets["base"].vertices.tolist() == [0, 1, 2]


def test_sets_that_do_not_exist_are_refused():
    skin = NamedSet(np.arange(2), np.zeros(0, np.int64))
    mesh = BODIES[2]._replace(sets={"skin": skin, "none": skin._replace(vertices=np.arange(0))})
    for refused, words in (
        (lambda: vertices_in(mesh, ["skin", "base"]), "no set 'base'; the sets are none, skin"),
        (lambda: vertices_in(mesh, ["none"]), "no vertex of the body is in the set 'none'"),
        (lambda: values_by_set(mesh, 1.0, {"skin": 2.0}), "'skin' has no elements; expected a set of triangle"),
    ):
        with one_line(words):
            refused()


def test_a_gmsh_finger_is_simulated_by_one_command(tmp_path, capsys):
    path = tmp_path / "finger.msh"
    path.write_bytes(gmsh_file(make_mesh(1000 * BODIES[2].vertices, BODIES[2].elements), "4.1", True))
    options = ("--scale", "0.001", "--pin", "base", "--youngs-modulus-of", "tip=1e5", "--vtu", "--no-figures")
    # The groups are split at x = 1, here 1 mm: everything but the base is the tip.
    command(simulate, "--mesh", path, *options, "--dt", "0.05", "--seconds", "0.1", "--out", tmp_path / "run")
    shown = capsys.readouterr().out
    assert "elements in 1 component, 2 x 1 m, " in shown.splitlines()[0] and "warning" not in shown
    assert "are left out" in shown and "named sets: whole body (" in shown
    last = read_mesh(tmp_path / "run" / "motion" / "0002.vtu").mesh
    base = last.sets["base"].vertices
    np.testing.assert_allclose(last.vertices[base], BODIES[2].vertices[base], atol=1e-7)
    assert last.vertices[:, -1].min() < -0.01


def test_mistakes_with_mesh_files_are_one_line(tmp_path, capsys, monkeypatch):
    finger = tmp_path / "finger.msh"
    finger.write_bytes(gmsh_file(BODIES[2], "4.1", False))
    rows = [
        ("--mesh", finger, "--pin", ",", "--pin names no set"),
        ("--mesh", finger, "--youngs-modulus-of", "tip", "expected NAME=VALUE"),
        ("--mesh", tmp_path / "absent.msh", "absent.msh: no such file"),
        ("--scene", "drop", "--mesh", finger, "--pin", "base", "the drop scene has no --pin"),
        ("--pin", "base", "--pin is an option of --mesh"),
    ]
    assert_refused(capsys, simulate, rows, out=tmp_path / "run")
    monkeypatch.setitem(sys.modules, "meshio", None)
    assert_refused(capsys, simulate, [("--vtu", "--vtu needs meshio, which is not")], out=tmp_path / "run")
