"""Mesh files against the geometry they describe: formats, named sets, repairs, refusals and motions."""

import struct
import sys
import xml.etree.ElementTree as ET

import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from calls import command, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from dln_jax.cli.commands import simulate
from dln_jax.softbody.equilibrium import static_solve
from dln_jax.softbody.mesh import (
    Mesh,
    NamedSet,
    beam,
    boundary,
    box,
    disc,
    make_mesh,
    read_mesh,
    values_by_set,
    vertices_in,
    volumes,
    write_mesh,
    write_motion,
)
from dln_jax.softbody.mesh.mesh import components
from dln_jax.softbody.mesh.solids import FileMesh, solid_mesh
from dln_jax.softbody.scene import make_scene
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.types import InputError

BODIES = {2: beam(2.0, 1.0, 4, 2), 3: box((2.0, 1.0, 1.0), (4, 2, 2))}
TYPES = {2: 2, 3: 4}  # Gmsh's numbers of triangles and tetrahedra; their facets are one less.
FACET_TYPES = {2: 1, 3: 2}


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
    rows = [(dimension, cells, groups) for dimension, cells, groups in parts(mesh)]
    types = {d: TYPES[d], d - 1: FACET_TYPES[d]}
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
            put("3iQ", dimension, tag, types[dimension], len(cells), end=True)
            for number, cell in enumerate(cells):
                put(f"{1 + len(cell)}Q", number + 1, *tags[cell], end=True)
    else:
        line(f"$Nodes\n{len(x)}")
        for tag, point in zip(tags, x, strict=True):
            put("i3d", tag, *point, end=True)
        listed = [(types[k], group, cell) for k, cells, groups in rows for group in groups for cell in cells]
        line(f"\n$EndNodes\n$Elements\n{len(listed)}")
        for number, (kind, group, cell) in enumerate(listed):
            header = (kind, 1, 2, number) if binary else (number, kind, 2)
            put(f"{len(header) + 2 + len(cell)}i", *header, group, 7, *tags[cell], end=True)
    line("\n$EndElements")
    return b"".join(pieces)


def require_parts(mesh, original):
    """The groups are where their geometry is."""
    right = mesh.vertices[mesh.elements][:, :, 0].mean(axis=1) > 1.0
    assert set(mesh.sets) == {"whole body", "tip", "base"}
    np.testing.assert_array_equal(mesh.sets["base"].vertices, np.flatnonzero(mesh.vertices[:, 0] == 0))
    assert len(mesh.sets["base"].elements) == 0 and len(mesh.sets["whole body"].elements) == len(original.elements)
    np.testing.assert_array_equal(mesh.sets["tip"].elements, np.flatnonzero(right))
    np.testing.assert_array_equal(mesh.sets["tip"].vertices, np.unique(mesh.elements[right]))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_gmsh_files_are_read_with_their_groups(tmp_path, version, binary, dimension):
    original = BODIES[dimension]
    path = tmp_path / "finger.msh"
    path.write_bytes(gmsh_file(original, version, binary))
    mesh, statements = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, original.vertices)
    assert mesh.turned == 0 and volumes(mesh).sum() == pytest.approx(2.0, rel=1e-14)
    require_parts(mesh, original)
    assert any("left out" in statement for statement in statements)
    # In 2.2 an element is listed once for each of its groups.
    repeated = f"{len(mesh.sets['tip'].elements)} elements are listed more than once"
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
    with pytest.raises(InputError, match=r"no two of the .* elements share a vertex"):
        solid_mesh(FileMesh(points, {"tetra": elements}, {}, {}), merge=0.0)


def test_elements_of_higher_order_are_reduced_to_their_corners():
    mesh = BODIES[2]
    middles = mesh.vertices[mesh.elements][:, [[0, 1], [1, 2], [2, 0]]].mean(axis=2)
    n, m = len(mesh.vertices), len(mesh.elements)
    curved = np.concatenate([mesh.elements, n + np.arange(3 * m).reshape(m, 3)], axis=1)
    points = np.pad(np.concatenate([mesh.vertices, middles.reshape(-1, 2)]), ((0, 0), (0, 1)), constant_values=0.2)
    read = solid_mesh(FileMesh(points, {"triangle6": curved}, {}, {"all": {"triangle6": np.arange(m)}}))
    np.testing.assert_array_equal(read.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.mesh.elements, mesh.elements)
    assert f"{m} elements of higher order" in read.statements[0] and len(read.mesh.sets["all"].vertices) == n


POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0], [2, 0, 0], [1, 1, 0], [0, 1, 1]])
REFUSED = {
    "surface without volume; fill it with tetrahedra first, for example by Gmsh, TetGen": {
        "triangle": [[0, 1, 2], [0, 1, 3]]
    },
    "it lies in a plane x = const": {"triangle": [[0, 2, 3], [2, 7, 3]]},
    "it has 1 hexahedra; mesh the body with tetrahedra only": {"tetra": [[0, 1, 2, 3]], "hexahedron": [range(8)]},
    "it has 1 quads; mesh the body with triangles only": {"triangle": [[0, 1, 2]], "quad": [[0, 1, 6, 2]]},
    "no triangles or tetrahedra": {"line": [[0, 1]]},
    "tetrahedron 1 of 2 (near [0.75, 0.25, 0.0] m) has no volume": {"tetra": [[0, 1, 2, 3], [0, 1, 2, 5]]},
    "tetra 0 has vertex 9; expected 0 to 7": {"tetra": [[0, 1, 2, 9]]},
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_is_no_body_is_refused(message):
    cells = {kind: np.array([list(cell) for cell in nodes]) for kind, nodes in REFUSED[message].items()}
    with pytest.raises(InputError) as caught:
        solid_mesh(FileMesh(POINTS, cells, {}, {}))
    assert message in str(caught.value)


def test_files_that_cannot_be_read_are_refused(tmp_path):
    whole = gmsh_file(BODIES[2], "4.1", False)
    files = {
        "a.msh": (whole[: len(whole) // 2], "does not end; the file is cut off"),
        "b.msh": (whole.replace(b"4.1", b"4.0", 1), "version 4.0 of the MSH format; expected 2.2 or 4.1"),
        "c.msh": (b"$PartitionedEntities\n$EndPartitionedEntities\n" + whole, "partitioned mesh"),
        "d.msh": (whole.replace(b"nan", b"x").replace(b"$Nodes\n2", b"$Nodes\n9"), "fewer numbers than its header"),
        "i.msh": (
            gmsh_file(BODIES[2], "4.1", True).replace(b"4.1 1 8", b"4.1 1 3", 1),
            "numbers have 3 bytes; expected",
        ),
        "k.msh": (gmsh_file(BODIES[2], "2.2", False).replace(b"\n1 2 2 ", b"\n1 2 -2 ", 1), "negative number of tags"),
        "l.msh": (gmsh_file(BODIES[2], "2.2", False).replace(b"\n1 2 2 ", b"\n1 2 nan ", 1), "not a readable .msh"),
        "e.vtu": (b"no xml", "meshio cannot read it"),
        "f.vtk": (b"", "meshio cannot read it"),
        "g.stl": (b"solid", "expected .msh, .vtk, .vtu, .obj"),
        "h.msh": (b"", "no version of the MSH format"),
    }
    for name, (data, message) in files.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError) as caught:
            read_mesh(tmp_path / name)
        assert message in str(caught.value) and name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("dimension", [2, 3])
def test_sets_survive_a_round_trip_exactly(tmp_path, dimension):
    """Overlapping sets, an empty one, names with hyphens and spaces, and one of a surface and elements."""
    mesh, random = BODIES[dimension], np.random.default_rng(0)
    sets = {
        name: NamedSet(np.unique(mesh.elements[chosen]), chosen)
        for name, chosen in (("left-end", np.arange(5)), ("soft part", np.arange(3, 9)), ("0", np.arange(1)))
    }
    sets["skin"] = NamedSet(np.unique(random.integers(0, len(mesh.vertices), 6)), np.zeros(0, np.int64))
    sets["none"] = NamedSet(np.zeros(0, np.int64), np.zeros(0, np.int64))
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
    points = np.pad(flat.vertices, ((0, 0), (0, 1)))
    meshio.Mesh(points, [("triangle", flat.elements)]).write(tmp_path / "flat.obj")
    np.testing.assert_array_equal(read_mesh(tmp_path / "flat.obj").mesh.elements, flat.elements)
    m = len(solid.elements)
    region = np.arange(m) // (m // 3)
    for name in ("solid.vtk", "solid.vtu"):
        content = meshio.Mesh(solid.vertices, [("tetra", solid.elements)], cell_data={"region": [region + 2]})
        content.point_sets = {"base": np.arange(5), "end": np.arange(5, 9), "other": np.arange(9, 11)}
        content.cell_sets = {"lower": [np.arange(4)], "upper": [np.arange(4, m)]}
        content.write(tmp_path / name)
        sets = read_mesh(tmp_path / name).mesh.sets
        assert {key: len(part.elements) for key, part in sets.items()} == {
            **{"base": 0, "end": 0, "other": 0, "lower": 4, "upper": m - 4},
            **{f"region-{number}": (region + 2 == number).sum() for number in np.unique(region + 2)},
        }
        assert sets["base"].vertices.tolist() == [0, 1, 2, 3, 4] and sets["end"].vertices.tolist() == [5, 6, 7, 8]
    rows = "".join(f"{i} {' '.join(map(str, cell))}\n" for i, cell in enumerate(solid.elements))
    (tmp_path / "solid.1.ele").write_text(f"{m} 4 0\n{rows}")
    rows = "".join(f"{i} {' '.join(map(repr, point))}\n" for i, point in enumerate(solid.vertices.tolist()))
    (tmp_path / "solid.1.node").write_text(f"{len(solid.vertices)} 3 0 0\n{rows}")
    np.testing.assert_array_equal(read_mesh(tmp_path / "solid.1.ele").mesh.elements, solid.elements)


@pytest.mark.parametrize("dimension", [2, 3])
def test_motions_are_written_with_times_velocities_and_volumes(tmp_path, dimension):
    """An affine motion x = F(t) X has J = det F everywhere and velocities F' X."""
    mesh = BODIES[dimension]._replace(sets={"base": NamedSet(np.arange(3), np.zeros(0, np.int64))})
    t = np.linspace(0.0, 0.6, 7)
    F = np.eye(dimension) + t[:, None, None] * np.triu(np.full((dimension, dimension), 0.5))
    rate = np.triu(np.full((dimension, dimension), 0.5))
    x, v = mesh.vertices @ F.transpose(0, 2, 1), np.broadcast_to(mesh.vertices @ rate.T, (7, *mesh.vertices.shape))
    write_motion(tmp_path / "motion.pvd", mesh, t, x, v, stride=3)
    frames = ET.parse(tmp_path / "motion.pvd").findall("./Collection/DataSet")
    assert [float(frame.attrib["timestep"]) for frame in frames] == pytest.approx(t[::3], abs=1e-15)
    for k, frame in zip((0, 3, 6), frames, strict=True):
        path = tmp_path / frame.attrib["file"]
        content = meshio.read(path)
        np.testing.assert_allclose(content.points[:, :dimension], x[k], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(content.cell_data["J"][0], np.linalg.det(F[k]), rtol=1e-6)
        np.testing.assert_allclose(content.point_data["velocity"][:, :dimension], v[k], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(
            content.point_data["displacement"][:, :dimension], x[k] - mesh.vertices, rtol=1e-6, atol=1e-7
        )
        assert read_mesh(path).mesh.sets["base"].vertices.tolist() == [0, 1, 2]


def test_materials_by_set_divide_a_stretch_as_springs_in_series(tmp_path):
    """A bar (nu = 0) of two halves: the joint moves by E2 / (E1 + E2) of the end's displacement, to first order."""
    path = tmp_path / "bar.msh"
    path.write_bytes(gmsh_file(BODIES[2], "4.1", True))
    mesh = read_mesh(path).mesh
    moduli, end = values_by_set(mesh, 1e5, {"tip": 3e5}), np.flatnonzero(mesh.vertices[:, 0] == 2.0)
    assert np.unique(moduli).tolist() == [1e5, 3e5]
    material = elastic(mesh, stable_neo_hookean, youngs_modulus=moduli, poisson_ratio=0.0)
    scene = make_scene(mesh, [material], held=[*vertices_in(mesh, ["base"]), *end])
    stretch = 1e-5
    start = jnp.asarray(mesh.vertices * [1 + stretch / 2, 1.0])
    x, info = static_solve(scene, scene.params, x=start, tolerance=1e-9)
    joint = np.flatnonzero(mesh.vertices[:, 0] == 1.0)
    assert bool(info.converged) and len(joint) == 3
    np.testing.assert_allclose((np.asarray(x) - mesh.vertices)[joint, 0] / stretch, 0.75, rtol=1e-4)


def test_sets_that_do_not_exist_are_refused():
    mesh = make_mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    with pytest.raises(InputError, match="no set 'base'; it has no named sets"):
        vertices_in(mesh, ["base"])
    skin = NamedSet(np.arange(2), np.zeros(0, np.int64))
    mesh = mesh._replace(sets={"skin": skin, "none": skin._replace(vertices=np.arange(0))})
    with pytest.raises(InputError, match="no set 'base'; the sets are none, skin"):
        vertices_in(mesh, ["skin", "base"])
    with pytest.raises(InputError, match="no vertex of the body is in the set 'none'"):
        vertices_in(mesh, ["none"])
    with pytest.raises(InputError, match="'skin' has no elements; expected a set of triangle"):
        values_by_set(mesh, 1.0, {"skin": 2.0})


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
    finger, surface, flat = tmp_path / "finger.msh", tmp_path / "surface.obj", tmp_path / "flat.vtu"
    finger.write_bytes(gmsh_file(BODIES[2], "4.1", False))
    meshio.Mesh(POINTS, [("triangle", [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])]).write(surface)
    write_mesh(flat, disc(1.0, 1))
    mistakes = {
        "the mesh has no set 'bottom'; the sets are base, tip, whole body": ("--mesh", finger, "--pin", "base,bottom"),
        "--pin names no set": ("--mesh", finger, "--pin", ","),
        "the set 'base' has no elements": ("--mesh", finger, "--youngs-modulus-of", "base=1e5"),
        "expected SET=PA": ("--mesh", finger, "--youngs-modulus-of", "tip"),
        "youngs_modulus of element": ("--mesh", finger, "--youngs-modulus-of", "tip=-1"),
        "scale is 0.0; expected a positive number": ("--mesh", finger, "--scale", "0"),
        "surface without volume": ("--mesh", surface),
        "absent.msh: no such file": ("--mesh", tmp_path / "absent.msh"),
        "the drop scene has no --pin": ("--scene", "drop", "--mesh", finger, "--pin", "base"),
        "--pin is an option of --mesh": ("--pin", "base"),
    }
    for said, options in mistakes.items():
        assert said in refused(capsys, simulate, *options, "--out", tmp_path / "run"), said
    monkeypatch.setitem(sys.modules, "meshio", None)
    for said, options in {"reading .vtu files": ("--mesh", flat), "--vtu": ("--vtu",)}.items():
        line = refused(capsys, simulate, *options, "--out", tmp_path / "run")
        assert f"{said} needs meshio, which is not installed; pip install 'dln-jax[mesh]'" in line
    assert isinstance(read_mesh(finger).mesh, Mesh) and not (tmp_path / "run").exists()
