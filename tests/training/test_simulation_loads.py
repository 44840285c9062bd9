"""Pressures and loads of `simulate` by named sets of a user's mesh."""

from types import SimpleNamespace

import numpy as np
import pytest

from dln_jax.cli.commands.simulate import Arguments
from dln_jax.softbody.mesh import lattice
from dln_jax.softbody.scene import make_scene, prepare
from dln_jax.training.simulation import example_of
from dln_jax.training.simulation_meshes import own_mesh
from dln_jax.types import InputError


@pytest.fixture
def path(tmp_path):
    positions, elements = lattice([cell for cell in np.ndindex(4, 3) if cell not in ((1, 1), (2, 1))])
    np.savez(tmp_path / "frame.npz", vertices=0.1 * positions, elements=elements)
    return tmp_path / "frame.npz"


def options(path, **given_options):
    names = ("scale", "pin", "youngs_modulus_of", "pressure", "load")
    return SimpleNamespace(mesh=path, **(dict.fromkeys(names) | given_options))


def test_a_pressure_acts_in_the_closed_cavity(path):
    choices, _ = own_mesh(options(path, pressure="inner=2e4"), 1e6)
    mesh = choices["mesh"]
    (term,) = choices["loads"](mesh)
    scene = make_scene(mesh, [term])
    assert term.name == "pressure-inner" and len(term.indices) == 6
    assert float(prepare(scene, scene.params, scene.params.rest)[0][0][0]) == 2e4


def test_a_scene_that_holds_nothing_says_that_it_does_not_use_the_held_vertices_of_a_file(path, tmp_path):
    stored = dict(np.load(path))
    np.savez(tmp_path / "held.npz", **stored, held=[0, 1])
    for file, said in ((path, False), (tmp_path / "held.npz", True)):
        _, statements = example_of(Arguments(scene="drop", mesh=file))
        assert any("`held` is not used" in line for line in statements) == said


def test_a_mistake_is_one_line(path):
    for mistake, message in [
        ({"pressure": "bag=2"}, r"--mesh the mesh has no set 'bag'"),
        ({"pressure": "inner"}, r"--pressure is 'inner'; expected SET=PA"),
        ({"load": "tip=1,2,3"}, r"--load is 'tip=1,2,3'; expected SET=FX,FY,"),
        ({"load": "tip=1,2; tip=3,4"}, r"--load names 'tip' twice; expected once"),
        ({"load": "tip=0,nan"}, r"--load is"),
        ({"load": "tip=0,-5"}, r"the mesh has no set 'tip'"),
        ({"load": "tip=0,-5;tip=0,5"}, r"--load names 'tip' twice"),
        ({"pressure": "inner=1,inner=2"}, r"--pressure names 'inner' twice"),
    ]:
        with pytest.raises(InputError, match=message):
            own_mesh(options(path, **mistake), 1e6)
