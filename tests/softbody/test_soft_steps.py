"""Time steps of soft bodies: what they keep exactly, what they compile, and what they refuse."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from dln_jax.rollout import rollout
from dln_jax.softbody.driven import drive, driven_step
from dln_jax.softbody.equilibrium import static_solve
from dln_jax.softbody.examples import drop
from dln_jax.softbody.integrators import BACKWARD_EULER, BDF2, INTEGRATORS, MIDPOINT
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.scene import make_scene, potential, with_parameters
from dln_jax.softbody.step import make_step, positions_and_convergence
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.springs import springs
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.softbody.verdict import LARGEST_GROWTH
from dln_jax.types import InputError

MESH = make_mesh([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.1]], [[0, 1, 2], [1, 3, 2]])
WEIGHT = gravity(MESH, (0.0, -9.81))
SOLID = elastic(MESH, stable_neo_hookean, youngs_modulus=1e5)
DT = 0.05


@functools.cache
def held_body():
    """A solid that falls, held at two vertices."""
    return make_scene(MESH, (SOLID, WEIGHT), held=[0, 1])


@functools.cache
def stepper(integrator=BACKWARD_EULER):
    return make_step(held_body(), DT, integrator)


@functools.cache
def program(integrator=BACKWARD_EULER):
    step = stepper(integrator).step

    def run(params, state):
        return rollout(functools.partial(step, params), state, steps=4, observe=lambda *state_and_info: state_and_info)

    return jax.jit(run)


every_integrator = pytest.mark.parametrize("integrator", INTEGRATORS.values(), ids=INTEGRATORS)


@every_integrator
def test_held_vertices_move_with_their_velocity(integrator):
    v = np.zeros((4, 2))
    v[:2] = 0.3, -0.2
    _, (states, info) = program(integrator)(held_body().params, stepper(integrator).init(v=v))
    assert info.converged.all() and info.definite is None
    t = DT * np.arange(1, 5)
    np.testing.assert_allclose(states.x[:, :2], MESH.vertices[:2] + t[:, None, None] * v[:2], atol=1e-14)
    np.testing.assert_array_equal(states.v[:, :2], np.broadcast_to(v[:2], (4, 2, 2)))
    assert (states.x[:, 2:, 1] < MESH.vertices[2:, 1] - 0.2 * t[:, None]).all()


@every_integrator
def test_a_body_without_inner_forces_falls_as_the_method_says(integrator):
    scene = make_scene(MESH, (WEIGHT,))
    init, step = make_step(scene, DT, integrator)
    last, _ = jax.jit(lambda state: rollout(functools.partial(step, scene.params), state, steps=6))(init(v=[1.0, 2.0]))
    n = np.arange(7)
    parabola = 2.0 * n * DT - 9.81 * (n * DT) ** 2 / 2
    # Backward Euler falls g h² n/2 further.
    behind = 9.81 * DT**2 * 6 / 2 if integrator is BACKWARD_EULER else 0.0
    np.testing.assert_allclose(last.x[:, 0] - MESH.vertices[:, 0], 6 * DT, atol=1e-12)
    fallen = np.asarray(last.x[:, 1] - MESH.vertices[:, 1])
    if integrator is BDF2:
        # The recurrence itself, after a first step of backward Euler.
        position, velocity = [0.0, 2.0 * DT - 9.81 * DT**2], [2.0, 2.0 - 9.81 * DT]
        for _ in range(5):
            velocity.append((4 * velocity[-1] - velocity[-2]) / 3 - 9.81 * 2 * DT / 3)
            position.append((4 * position[-1] - position[-2]) / 3 + 2 * DT / 3 * velocity[-1])
        np.testing.assert_allclose(fallen, position[6], atol=1e-12)
    else:
        np.testing.assert_allclose(fallen, parabola[6] - behind, atol=1e-12)


def test_elements_given_inverted_move_as_those_given_right():
    """They are the same mesh from then on."""
    mesh = make_mesh(MESH.vertices, [[0, 2, 1], [1, 3, 2]])
    assert mesh.turned == 1 and MESH.turned == 0
    np.testing.assert_array_equal(mesh.vertices, MESH.vertices)
    np.testing.assert_array_equal(mesh.elements, MESH.elements)


@pytest.mark.slow
def test_elements_that_meet_at_one_edge_keep_momentum():
    """Three triangles at an edge: what they do to each other cancels."""
    mesh = make_mesh([*MESH.vertices, [1.4, 1.2]], [[0, 1, 2], [1, 3, 2], [1, 4, 2]])
    scene = make_scene(mesh, (elastic(mesh, stable_neo_hookean, youngs_modulus=1e5),))
    v = np.random.default_rng(0).normal(size=mesh.vertices.shape)
    init, step = make_step(scene, DT, tolerance=1e-10)

    @jax.jit
    def run(state):
        advance = functools.partial(step, scene.params)
        return rollout(advance, state, steps=4, observe=lambda state, info: (state.v, info.converged))[1]

    seen = run(init(v=v))
    assert seen[1].all()
    momentum = np.einsum("n,tni->ti", scene.params.masses, seen[0])
    np.testing.assert_allclose(momentum, np.broadcast_to(scene.params.masses @ v, (4, 2)), rtol=1e-9)
    assert np.abs(seen[0][-1] - v).max() > 0.1


def test_a_hanging_weight_stretches_its_spring_by_its_weight_over_the_stiffness():
    pairs = [[0, 2], [1, 3]]
    scene = make_scene(MESH, (springs(pairs, stiffness=200.0), WEIGHT), masses=1.5, held=[2, 3])
    x, info = jax.jit(lambda params: static_solve(scene, params, x=params.rest.at[:2, 1].add(-0.05)))(scene.params)
    assert info.converged
    lengths = np.linalg.norm(np.asarray(x)[[0, 1]] - np.asarray(x)[[2, 3]], axis=1)
    rest = np.linalg.norm(MESH.vertices[[0, 1]] - MESH.vertices[[2, 3]], axis=1)
    np.testing.assert_allclose(lengths - rest, 1.5 * 9.81 / 200.0, rtol=1e-9)
    np.testing.assert_allclose(x[0, 0], x[2, 0], atol=1e-9)


@pytest.mark.slow
def test_segments_change_the_memory_and_not_the_motion_or_its_gradient():
    scene = make_scene(MESH, (springs([[0, 2], [1, 3]], stiffness=200.0),), masses=1.5, held=[0, 1])
    init, step = make_step(scene, DT)

    def height(v, segment):
        observe, advance = positions_and_convergence, functools.partial(step, scene.params)
        last, (x, converged) = rollout(advance, init(v=v), steps=6, segment=segment, observe=observe)
        return last.x[3, 1] + x[2, 3, 1], (x, converged)

    whole, parts = (jax.jit(jax.grad(functools.partial(height, segment=s), has_aux=True)) for s in (None, 3))
    v = jnp.ones((4, 2))
    (gradient, (x, converged)), (again, (x_again, _)) = whole(v), parts(v)
    assert x.shape == (6, 4, 2) and converged.all()
    np.testing.assert_allclose(x_again, x, atol=1e-12)
    assert np.abs(gradient).max() > 0.1
    np.testing.assert_allclose(again, gradient, rtol=1e-6, atol=1e-12)


def test_single_precision_follows_double():
    scene = held_body()
    single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), (scene.params, stepper().init()))
    last, (_, info) = program()(*single)
    assert last.x.dtype == jnp.float32 and info.converged.all()
    double, _ = program()(scene.params, stepper().init())
    np.testing.assert_allclose(last.x, double.x, atol=1e-4)


def test_what_a_scene_does_not_list_is_not_compiled():
    def flops(*terms):
        scene = make_scene(MESH, terms)
        init, step = make_step(scene, DT)
        program = jax.jit(lambda params, state: step(params, state, None)[0].x)
        cost = program.lower(scene.params, init()).compile().cost_analysis()
        assert cost is not None
        return cost["flops"]

    weight, solid, both = flops(WEIGHT), flops(SOLID), flops(SOLID, WEIGHT)
    assert weight < 0.7 * both
    assert weight < solid < both


def equations(jaxpr):
    """Equations of a program, those of its loops and calls included."""
    inner = [sub for equation in jaxpr.eqns for sub in jaxprs_in_params(equation.params)]
    return len(jaxpr.eqns) + sum(map(equations, inner))


@pytest.mark.slow
def test_definiteness_is_computed_on_request_only():
    def size_and_info(**options):
        init, step = make_step(held_body(), DT, **options)
        program = jax.jit(lambda params, state: step(params, state, None))
        shape = jax.eval_shape(program, held_body().params, init())[1]
        size = equations(jax.make_jaxpr(program)(held_body().params, init()).jaxpr)
        return size, shape if shape.definite is None else program(held_body().params, init())[1]

    (plain, info), (asked, info_asked) = size_and_info(), size_and_info(definite=True)
    assert info.definite is None and info_asked.definite
    assert plain < 0.85 * asked
    (x, info), (x_asked, info_asked) = (
        static_solve(held_body(), held_body().params, definite=d) for d in (False, True)
    )
    assert info.definite is None and info_asked.definite
    np.testing.assert_array_equal(x, x_asked)


def falling(example, dt, steps, integrator):
    init, step = driven_step(example, dt, integrator)
    observe = lambda state, info: (state.x, state.v, info)  # noqa: E731
    run = lambda params: rollout(functools.partial(step, params), init(), drive(example, dt, steps), observe=observe)  # noqa: E731
    return jax.jit(run)(example.scene.params)[1]


@pytest.mark.slow
def test_a_motion_whose_energy_explodes_is_not_converged():
    """The midpoint rule does not resolve this contact: forces are balanced in every step, and energy is created."""
    example = drop(cells=2, youngs_modulus=1e6)
    x, v, info = falling(example, 0.02, 100, MIDPOINT)
    masses, start = example.scene.params.masses, example.scene.params.rest
    energy = 0.5 * (masses[:, None] * v**2).sum((1, 2)) + jax.vmap(
        lambda x: potential(example.scene, x, example.scene.params)
    )(x)
    first = 0.5 * (masses[:, None] * example.v**2).sum() + potential(example.scene, start, example.scene.params)
    assert energy.max() > 1.5 * first and (info.residual < 1e-3).all()
    # Without held vertices, actuation and friction of the step, the growth is the change of the energy.
    np.testing.assert_allclose(info.energy_growth[:20], np.diff(np.append(first, energy[:20])), atol=1e-6 * first)
    assert not info.converged.all()
    exploded = np.asarray(info.diverged)
    assert exploded[info.energy_growth > LARGEST_GROWTH * info.energy_at_hand].all()
    inverted = np.asarray(info.least_J <= 0)
    np.testing.assert_array_equal(~np.asarray(info.converged), exploded | inverted)
    assert exploded.any()
    # Backward Euler takes the same steps and creates next to nothing.
    _, _, damped = falling(example, 0.02, 100, BACKWARD_EULER)
    assert damped.converged.all() and (damped.energy_growth <= 1e-2 * damped.energy_at_hand).all()


@pytest.mark.slow
def test_elements_inverted_by_an_impact_are_not_converged_and_have_no_derivatives():
    mesh = beam(1.0, 1.0, 2, 2)
    shifted = mesh._replace(vertices=mesh.vertices + np.array([0.0, 0.05]))
    ground = plane_contact(range(len(mesh.vertices)), normal=(0, 1), stiffness=1e8, width=1e-3)
    solid = elastic(shifted, stable_neo_hookean, youngs_modulus=1e6)
    scene = make_scene(shifted, (solid, ground))
    init, step = make_step(scene, 1e-3)

    def height(speed, steps):
        last, seen = rollout(
            functools.partial(step, scene.params),
            init(v=speed * np.array([0.0, -1.0])),
            steps=steps,
            observe=lambda _, info: info,
        )
        return last.x[:, 1].mean(), seen

    run = jax.jit(jax.value_and_grad(height, has_aux=True), static_argnums=1)
    (_, info), slope = run(100.0, 10)
    assert (info.least_J.min() <= 0) and (info.residual < 1e-3).all()
    np.testing.assert_array_equal(info.converged, info.least_J > 0)
    assert np.isnan(slope)
    (_, gentle), slope = run(1.0, 10)
    assert gentle.converged.all() and (gentle.least_J > 0.5).all()
    ahead, behind = (run(1.0 + sign * 1e-5, 10)[0][0] for sign in (1, -1))
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-5, rtol=1e-6)


@pytest.mark.slow
def test_work_of_held_vertices_is_not_growth():
    """A body that is pulled by its held vertices gains energy; none of it is created."""
    init, step = make_step(held_body(), DT, MIDPOINT)
    v = np.zeros((4, 2))
    v[:2] = 0.0, 3.0
    advance = functools.partial(step, held_body().params)
    info = jax.jit(lambda state: rollout(advance, state, steps=20, observe=lambda _, info: info)[1])(init(v=v))
    assert info.converged.all() and info.energy_at_hand.max() > 100.0
    assert (abs(info.energy_growth) < 0.05 * info.energy_at_hand).all()


def two_blocks(gap):
    """Two squares above each other, the lower one held."""
    square = beam(1.0, 1.0, 2, 2)
    above = square.vertices + np.array([0.0, 1.0 + gap])
    n = len(square.vertices)
    mesh = make_mesh(np.concatenate([square.vertices, above]), np.concatenate([square.elements, square.elements + n]))
    solid = elastic(mesh, stable_neo_hookean, youngs_modulus=1e5)
    return make_scene(mesh, (solid, gravity(mesh)), held=np.arange(n))


@pytest.mark.slow
def test_bodies_that_pass_through_each_other_are_counted():
    scene = two_blocks(gap=0.1)
    init, step = make_step(scene, DT)
    advance = functools.partial(step, scene.params)
    run = jax.jit(
        lambda state: rollout(advance, state, steps=12, observe=lambda state, info: (state.x, info.overlaps))[1]
    )
    x, overlaps = run(init())
    lowest = np.asarray(x)[:, 9:, 1].min(axis=1)
    np.testing.assert_array_equal(overlaps, (lowest < 1.0).astype(int))
    assert 0 < overlaps.sum() < 12 and lowest[-1] < 0.0
    # One component: nothing of it is traced.
    assert jax.eval_shape(stepper().step, held_body().params, stepper().init())[1].overlaps is None
    # Derivatives pass by it.
    slope = jax.jit(jax.grad(lambda v: rollout(advance, init(v=v), steps=12)[0].x[-1, 1]))(jnp.zeros(2))
    np.testing.assert_allclose(slope, [0.0, 12 * DT], atol=1e-9)


def test_what_resists_no_deformation_has_no_least_J():
    scene = make_scene(MESH, (springs([[0, 2], [1, 3]], stiffness=200.0),), masses=1.5, held=[0, 1])
    init, step = make_step(scene, DT)
    assert jax.eval_shape(step, scene.params, init())[1].least_J is None


def test_the_potential_is_the_sum_of_the_terms():
    scene = make_scene(MESH, (SOLID, WEIGHT), masses=2.0)
    height = 9.81 * 2.0 * MESH.vertices[:, 1].sum()
    np.testing.assert_allclose(potential(scene, scene.params.rest, scene.params), height, rtol=1e-13)


def test_parameters_of_terms_are_replaced_by_name_and_mistakes_are_named():
    params = held_body().params
    changed = with_parameters(params, elastic={"youngs_modulus": 2e5}, gravity={"acceleration": [0.0, -1.6]})
    assert changed.terms["elastic"].youngs_modulus == 2e5 and params.terms["elastic"].youngs_modulus == 1e5
    np.testing.assert_array_equal(changed.terms["gravity"].acceleration, [0.0, -1.6])
    assert changed.terms["elastic"].poisson_ratio is params.terms["elastic"].poisson_ratio
    with pytest.raises(InputError, match="no term 'ground'; expected one of elastic, gravity"):
        with_parameters(params, ground={"friction": 0.1})
    with pytest.raises(InputError, match="'elastic' has no parameter 'mu'; expected one of youngs_modulus"):
        with_parameters(params, elastic={"mu": 1.0})


def test_states_fit_their_integrator_or_are_refused():
    assert stepper(BDF2).init().previous is not None and stepper(MIDPOINT).init().previous is None
    with pytest.raises(InputError, match="x of vertex 2 is not finite"):
        stepper().init(x=np.where(np.arange(4)[:, None] == 2, np.nan, MESH.vertices))
    with pytest.raises(InputError, match="no room for the state before"):
        stepper(BDF2).step(held_body().params, stepper().init(), None)
    with pytest.raises(InputError, match="neither inputs nor steps"):
        rollout(lambda state, _: (state, None), jnp.zeros(1))
    with pytest.raises(InputError, match="segment is 4 for 6 steps"):
        rollout(lambda state, _: (state, None), jnp.zeros(1), steps=6, segment=4)
