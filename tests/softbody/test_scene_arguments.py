"""Arguments that do not fit a scene are refused: none is ignored."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody import Tie, make_scene, make_step, make_tied_step, static_solve
from dln_jax.softbody.contact import body_contact, half_space, obstacle_contact
from dln_jax.softbody.mesh import beam, make_mesh, quadratic
from dln_jax.softbody.mesh.shapes import lattice
from dln_jax.softbody.terms import elastic, fibres, gravity, muscles, stable_neo_hookean
from dln_jax.types import InputError

MESH = beam(0.4, 0.1, 4, 1)
N = len(MESH.vertices)
SOLID = elastic(MESH, stable_neo_hookean)


def test_held_vertices_are_indices_or_a_mask():
    left = MESH.vertices[:, 0] == 0.0
    for held in (left, left.tolist(), np.flatnonzero(left)):
        np.testing.assert_array_equal(make_scene(MESH, [SOLID], held=held).held, np.flatnonzero(left))
    assert len(make_scene(MESH, [SOLID]).held) == 0


@pytest.mark.parametrize(
    ("held", "said"),
    [
        (np.ones(N - 1, bool), r"held is bool of shape \[9\]; expected integers \[k\], or booleans \[10\]"),
        ([0.7, 3.9], "held is float64"),
        ([0, N], f"held names vertex {N}; expected 0..{N - 1}"),
        ([-1], "held names vertex -1"),
        ([1, 2, 1], "held names a vertex twice"),
        (np.ones(N, bool), "at least one that is free"),
    ],
)
def test_other_held_vertices_are_refused(held, said):
    with pytest.raises(InputError, match=said):
        make_scene(MESH, [SOLID], held=held)


def test_masks_choose_fibres_and_tied_vertices():
    strong = np.arange(len(MESH.elements)) >= 6
    term = fibres(MESH, (1.0, 0.0), strength=1.0, activation=1.0, elements=strong)
    np.testing.assert_array_equal(term.indices, MESH.elements[strong])
    left = MESH.vertices[:, 0] == 0.0
    scene = make_scene(MESH, [SOLID], held=left)

    def pose(q):
        return jnp.eye(2), jnp.concatenate([q, q])

    def inertia(q, qd, qdd):
        return qdd

    make_tied_step(scene, 0.01, [Tie(pose, left)], inertia)
    with pytest.raises(InputError, match="a tie is float64"):
        make_tied_step(scene, 0.01, [Tie(pose, np.array([0.2]))], inertia)


def test_density_and_masses_together_are_refused():
    with pytest.raises(InputError, match="masses and density"):
        make_scene(MESH, [SOLID], masses=1.0, density=500.0)


@pytest.mark.parametrize("other", [beam(0.4, 0.1, 2, 1), beam(0.4, 0.2, 4, 1), quadratic(MESH)])
def test_parts_of_another_mesh_are_refused(other):
    near: dict[str, Any] = {"distance": 1e-3, "stiffness": 1e4}
    with pytest.raises(InputError, match="'elastic' was made for another mesh"):
        make_scene(MESH, [elastic(other, stable_neo_hookean)])
    with pytest.raises(InputError, match="'gravity' was made for another mesh"):
        make_scene(MESH, [SOLID, gravity(other)])
    for contact in (body_contact(other, **near), obstacle_contact(other, half_space([0.0, 1.0], -1.0), **near)):
        with pytest.raises(InputError, match=f"'{contact.name}' was made for another mesh"):
            make_scene(MESH, [SOLID], contacts=[contact])
    make_scene(MESH, [SOLID, gravity(beam(0.4, 0.1, 4, 1))])


def test_a_contact_that_would_push_a_body_open_is_refused():
    # A slot of 3 mm between the two arms of a body.
    positions, elements = lattice([(0, 0), (0, 1), (0, 2), (1, 0), (1, 2)])
    positions = positions * 0.02
    positions[:, 1] = np.interp(positions[:, 1], [0.0, 0.02, 0.04, 0.06], [0.0, 0.02, 0.023, 0.043])
    slotted = make_mesh(positions, elements)
    with pytest.raises(InputError, match="of one body are closer in its rest shape"):
        body_contact(slotted, distance=5e-3, stiffness=1e4)
    body_contact(slotted, distance=2e-3, stiffness=1e4)
    # Two bodies may be as near as that: they rest on each other.
    above = MESH.vertices + np.array([0.0, 0.103])
    stacked = make_mesh(np.concatenate([MESH.vertices, above]), np.concatenate([MESH.elements, MESH.elements + N]))
    body_contact(stacked, distance=5e-3, stiffness=1e4)
    with pytest.raises(InputError, match="capacity"):
        body_contact(stacked, distance=5e-3, stiffness=1e4, capacity=0)


def test_a_control_needs_an_actuator():
    scene = make_scene(MESH, [SOLID], held=[0, 5])
    init, step = make_step(scene, 0.01)
    with pytest.raises(InputError, match="the control is one array, but the scene has no actuator"):
        step(scene.params, init(), jnp.ones(3))
    with pytest.raises(InputError, match="no actuator"):
        static_solve(scene, scene.params, jnp.ones(3))
    driven = make_scene(MESH, [SOLID, muscles([[0, 9]], stiffness=1.0)], held=[0, 5])
    with pytest.raises(InputError, match="expected shape"):
        make_step(driven, 0.01).step(driven.params, init(), jnp.ones(3))
