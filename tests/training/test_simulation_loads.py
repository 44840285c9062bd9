"""Pressures and loads of `simulate` by named sets of a user's mesh."""

from types import SimpleNamespace

import numpy as np
import pytest
from calls import one_line

from dln_jax.commands.simulate import Arguments
from dln_jax.commands.simulations import scenes
from dln_jax.softbody.mesh.shapes import lattice
from dln_jax.softbody.scene import make_scene, prepare


@pytest.fixture
def path(tmp_path):
    positions, elements = lattice([cell for cell in np.ndindex(4, 3) if cell not in ((1, 1), (2, 1))])
    np.savez(tmp_path / "frame.npz", vertices=0.1 * positions, elements=elements)
    return tmp_path / "frame.npz"


def options(path, **given_options):
    names = ("scale", "pin", "youngs_modulus_of", "pressure", "load")
    return SimpleNamespace(mesh=path, **(dict.fromkeys(names) | given_options))


def test_a_pressure_acts_in_the_closed_cavity(path):
    choices, _ = scenes.own_mesh(options(path, pressure="inner=2e4"), 1e6)
    mesh = choices["mesh"]
    (term,) = choices["loads"](mesh)
    scene = make_scene(mesh, [term])
    assert term.name == "pressure-inner" and len(term.indices) == 6
    assert float(prepare(scene, scene.params, scene.params.rest)[0][0][0]) == 2e4


def test_a_scene_that_holds_nothing_says_that_it_does_not_use_the_held_vertices_of_a_file(path):
    np.savez(path, **np.load(path), held=[0, 1])
    found = scenes.prepare(Arguments(mesh=path), "drop")
    assert any("`held` is not used" in line for line in found.statements)


def test_a_mistake_is_one_line(path):
    for option, value, message in (
        ("pressure", "bag=2", "--mesh the mesh has no set 'bag'"),
        ("pressure", "inner", "--pressure has 'inner'; expected NAME=VALUE"),
        ("pressure", "inner=1,inner=2", "--pressure names 'inner' twice"),
        ("load", "tip=1,2,3", "--load tip is '1,2,3'; expected 2 numbers"),
        ("load", "tip=1,2; tip=3,4", "--load names 'tip' twice"),
        ("load", "tip=0,nan", "--load tip is"),
    ):
        with one_line(message):
            scenes.own_mesh(options(path, **{option: value}), 1e6)
