"""Scenes and time steps of soft bodies: what they keep exactly, what they report, and what they refuse."""

import functools
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.rollout import rollout
from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.contact.obstacles import half_space, obstacle_contact
from dln_jax.softbody.integrators import BDF2, INTEGRATORS, MIDPOINT
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import beam, join, lattice, quadratic, translate
from dln_jax.softbody.scene import make_scene, with_parameters
from dln_jax.softbody.step import Motion, make_step, static_solve
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.fibres import fibres
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.springs import springs
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

MESH = make_mesh([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.1]], [[0, 1, 2], [1, 3, 2]])
WEIGHT = gravity(MESH, (0.0, -9.81))
SOLID = elastic(MESH, stable_neo_hookean, youngs_modulus=1e5)
DT = 0.05
BAR = beam(0.4, 0.1, 4, 1)
N = len(BAR.vertices)


@functools.cache
def held_body():
    """A solid that falls, held at two vertices."""
    return make_scene(MESH, (SOLID, WEIGHT), held=[0, 1])


def rolled_out(scene, steps, dt=DT, observe=lambda state, info: (state, info), **settings):
    """init, and (params, state) -> the observations of all steps."""
    init, step = make_step(scene, dt, **settings)

    def run(params, state):
        return rollout(functools.partial(step, params), state, steps=steps, observe=observe)[1]

    return init, run


def test_held_vertices_move_with_their_velocity_and_their_work_is_not_growth():
    init, run = rolled_out(held_body(), 20, integrator=MIDPOINT)
    v = np.zeros((4, 2))
    v[:2] = 0.3, 3.0
    states, info = jax.jit(run)(held_body().params, init(v=v))
    assert info.converged.all()
    t = DT * np.arange(1, 21)
    np.testing.assert_allclose(states.x[:, :2], MESH.vertices[:2] + t[:, None, None] * v[:2], atol=1e-13)
    np.testing.assert_array_equal(states.v[:, :2], np.broadcast_to(v[:2], (20, 2, 2)))
    _, step = make_step(held_body(), DT, MIDPOINT)
    state = jax.tree.map(lambda of: of[0], states)
    moved, _ = step(held_body().params, state._replace(v=state.v.at[:2].set(0)), None, Motion(held=states.x[1, :2]))
    np.testing.assert_allclose(moved.x, states.x[1], atol=1e-13)
    with one_line(r"expected \(2, 2\)"):
        step(held_body().params, state, None, Motion(held=states.x[1]))
    assert info.energy_at_hand.max() > 100.0 and (abs(info.energy_growth) < 0.05 * info.energy_at_hand).all()


@pytest.mark.parametrize("name", INTEGRATORS)
def test_a_body_without_inner_forces_falls_as_the_method_says(name):
    scene = make_scene(MESH, (WEIGHT,))
    init, run = rolled_out(scene, 6, integrator=INTEGRATORS[name])
    moved = jax.jit(run)(scene.params, init(v=[1.0, 2.0]))[0].x[-1] - MESH.vertices
    np.testing.assert_allclose(moved[:, 0], 6 * DT, atol=1e-12)
    fallen = 2.0 * 6 * DT - 9.81 * (6 * DT) ** 2 / 2
    if name == "backward-euler":  # falls g h² n/2 further
        fallen -= 9.81 * DT**2 * 6 / 2
    if name == "bdf2":
        # The recurrence itself, after a first step of backward Euler.
        position, velocity = [0.0, 2.0 * DT - 9.81 * DT**2], [2.0, 2.0 - 9.81 * DT]
        for _ in range(5):
            velocity.append((4 * velocity[-1] - velocity[-2]) / 3 - 9.81 * 2 * DT / 3)
            position.append((4 * position[-1] - position[-2]) / 3 + 2 * DT / 3 * velocity[-1])
        fallen = position[6]
    np.testing.assert_allclose(moved[:, 1], fallen, atol=1e-12)


def test_a_hanging_weight_stretches_its_spring_by_its_weight_over_the_stiffness():
    scene = make_scene(MESH, (springs([[0, 2], [1, 3]], stiffness=200.0), WEIGHT), masses=1.5, held=[2, 3])
    x, info = jax.jit(lambda params: static_solve(scene, params, x=params.rest.at[:2, 1].add(-0.05)))(scene.params)
    assert info.converged and info.least_J is None
    lengths, rest = (np.linalg.norm(at[[0, 1]] - at[[2, 3]], axis=1) for at in (np.asarray(x), MESH.vertices))
    np.testing.assert_allclose(lengths - rest, 1.5 * 9.81 / 200.0, rtol=1e-9)
    np.testing.assert_allclose(x[0, 0], x[2, 0], atol=1e-9)


def test_segments_change_the_memory_and_not_the_motion_or_its_gradient():
    def last(start, segment):
        final, seen = rollout(lambda x, u: (x * (u - x), None), start, jnp.linspace(3, 4, 6), segment=segment)
        return final + seen[2], seen

    (slope, seen), (again, seen_again) = (jax.grad(last, has_aux=True)(0.3, segment) for segment in (None, 3))
    assert seen.shape == (6,)
    np.testing.assert_allclose([again, *seen_again], [slope, *seen], rtol=1e-12)


def test_single_precision_follows_double():
    scene = held_body()
    init, run = rolled_out(scene, 4)
    run, double = jax.jit(run), (scene.params, init())
    states, info = run(*jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), double))
    assert states.x.dtype == jnp.float32 and info.converged.all()
    np.testing.assert_allclose(states.x, run(*double)[0].x, atol=1e-4)


def test_a_step_traces_its_energy_seven_times_at_most():
    traces = []

    def counted(F, mu, lam):
        traces.append(F)
        return stable_neo_hookean(F, mu, lam)

    scene = make_scene(MESH, [elastic(MESH, counted)], held=[0])
    init, step = make_step(scene, 0.01)
    traces.clear()
    jax.jit(step).trace(scene.params, init())
    # Both first guesses, the start, the search, the Hessian, the verdict, and the forces on held vertices.
    assert 0 < len(traces) <= 7


@pytest.mark.slow
def test_absent_contact_and_friction_leave_no_trace_in_a_step():
    def flops(*contacts, **settings):
        scene = make_scene(MESH, [SOLID], contacts=contacts)
        init, step = make_step(scene, DT, **settings)
        costs = jax.jit(step).lower(scene.params, init()).cost_analysis()
        assert costs is not None
        return costs["flops"]

    smooth, rough = (
        obstacle_contact(MESH, half_space([0.0, 1.0], -1.0), distance=1e-3, stiffness=1e4, friction=friction)
        for friction in (None, 0.5)
    )
    without_friction = flops(smooth)
    assert flops(smooth, friction_iterations=9) == without_friction
    assert 1.2 * flops() < without_friction < flops(rough) / 1.2


@pytest.mark.slow
def test_inverted_elements_are_not_converged_and_have_no_derivatives():
    scene = make_scene(MESH, (SOLID,))
    init, step = make_step(scene, 1e-5)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def height(size):
        state, info = step(scene.params, init(x=size * scene.params.rest * jnp.array([1.0, -1.0])))
        return state.x[-1, 1], info

    (_, info), slope = height(1.0)
    assert info.residual < 1e-3 and info.least_J == pytest.approx(-1.0, rel=1e-3)
    assert not info.converged and np.isnan(slope)


def test_parameters_of_terms_are_replaced_by_name_and_mistakes_are_named():
    params = held_body().params
    changed = with_parameters(params, elastic={"youngs_modulus": 2e5}, gravity={"acceleration": [0.0, -1.6]})
    assert changed.terms["elastic"].youngs_modulus == 2e5 and params.terms["elastic"].youngs_modulus == 1e5
    np.testing.assert_array_equal(changed.terms["gravity"].acceleration, [0.0, -1.6])
    assert changed.terms["elastic"].poisson_ratio is params.terms["elastic"].poisson_ratio
    with one_line("no term 'ground'; expected one of elastic, gravity"):
        with_parameters(params, ground={"friction": 0.1})
    with one_line("'elastic' has no parameter 'mu'; expected one of youngs_modulus"):
        with_parameters(params, elastic={"mu": 1.0})
    with one_line("gravity': acceleration has shape .3,.; expected .2,."):
        with_parameters(params, gravity={"acceleration": [0.0, 0.0, -1.6]})


def test_states_that_do_not_fit_are_refused():
    init = make_step(held_body(), DT).init
    two_steps = make_step(held_body(), DT, BDF2)
    assert two_steps.init().previous is not None and init().previous is None
    for mistake, words in (
        (lambda: init(x=np.where(np.arange(4)[:, None] == 2, np.nan, MESH.vertices)), "x of vertex 2 is not finite"),
        (lambda: two_steps.step(held_body().params, init(), None), "no previous state"),
        (lambda: make_step(held_body(), DT, BDF2, halvings=2), "halvings"),
        (lambda: rollout(lambda state, _: (state, None), jnp.zeros(1)), "neither inputs nor steps"),
        (lambda: rollout(lambda state, _: (state, None), 0.0, steps=6, segment=4), "segment is 4 for 6 steps"),
    ):
        with one_line(words):
            mistake()


def test_vertices_and_elements_are_chosen_by_indices_or_a_mask():
    solid, left = elastic(BAR, stable_neo_hookean), BAR.vertices[:, 0] == 0.0
    for held in (left, left.tolist(), np.flatnonzero(left)):
        np.testing.assert_array_equal(make_scene(BAR, [solid], held=held).held, np.flatnonzero(left))
    strong = np.arange(len(BAR.elements)) >= 6
    term = fibres(BAR, (1.0, 0.0), strength=1.0, activation=1.0, elements=strong)
    np.testing.assert_array_equal(term.indices, BAR.elements[strong])


def test_what_does_not_fit_a_scene_is_refused():
    solid = elastic(BAR, stable_neo_hookean)
    for options, words in (
        ({"held": np.ones(N - 1, bool)}, r"held is bool of shape \[9\]; expected integers \[k\], or booleans \[10\]"),
        ({"held": [0.7, 3.9]}, "held is float64"),
        ({"held": [0, N]}, f"held names vertex {N}; expected 0..{N - 1}"),
        ({"held": [-1]}, "held names vertex -1"),
        ({"held": [1, 2, 1]}, "held names a vertex twice"),
        ({"held": np.ones(N, bool)}, "at least one free vertex"),
        ({"masses": 1.0, "density": 500.0}, "masses and density"),
    ):
        with one_line(words):
            make_scene(BAR, [solid], **options)
    near: dict[str, Any] = {"distance": 1e-3, "stiffness": 1e4}
    for other in (beam(0.4, 0.2, 4, 1), quadratic(BAR)):
        above = obstacle_contact(other, half_space([0.0, 1.0], -1.0), **near)
        for terms, contacts in (
            ([elastic(other, stable_neo_hookean)], []),
            ([solid, gravity(other)], []),
            ([solid], [body_contact(other, **near)]),
            ([solid], [above]),
        ):
            with one_line("was made for another mesh"):
                make_scene(BAR, terms, contacts=contacts)
    make_scene(BAR, [solid, gravity(beam(0.4, 0.1, 4, 1))])


def test_a_contact_that_would_push_a_body_open_is_refused():
    # A slot of 3 mm between the two arms of a body.
    positions, elements = lattice([(0, 0), (0, 1), (0, 2), (1, 0), (1, 2)])
    positions = positions * 0.02
    positions[:, 1] = np.interp(positions[:, 1], [0.0, 0.02, 0.04, 0.06], [0.0, 0.02, 0.023, 0.043])
    slotted = make_mesh(positions, elements)
    with one_line("of one body are closer in its rest shape"):
        body_contact(slotted, distance=5e-3, stiffness=1e4)
    body_contact(slotted, distance=2e-3, stiffness=1e4)
    # Two bodies may be as near as that: they rest on each other.
    stacked = join(BAR, translate(BAR, [0.0, 0.103]))
    body_contact(stacked, distance=5e-3, stiffness=1e4)
    with one_line("capacity"):
        body_contact(stacked, distance=5e-3, stiffness=1e4, capacity=0)


THREADS = """
import ctypes, pathlib, sys
import scipy.linalg
import dln_jax.softbody.step
for path in pathlib.Path(scipy.__file__).parents[1].glob("scipy.libs/*scipy_openblas*"):
    print(ctypes.CDLL(str(path)).scipy_openblas_get_num_threads())
"""


def test_scipy_factorises_on_one_thread(monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    done = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, check=True)
    assert done.stdout.strip() in ("1", "")  # not all SciPys bring their own
