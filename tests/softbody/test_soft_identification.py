"""Materials of soft bodies are identified from motions, and a rest shape from how it hangs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.rollout import rollout
from dln_jax.softbody.identification import ObservedMotions, design, identify
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.scene import make_scene, with_parameters
from dln_jax.softbody.step import make_step, positions_and_convergence, static_solve
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.springs import muscles
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements.linear_solvers import dense

MESH = make_mesh([[0.0, 0.0], [1.0, 0.0], [0.1, 1.0]], [[0, 1, 2]])
TRUTH, GUESS = (
    {"elastic": {"youngs_modulus": E, "poisson_ratio": nu}, "ground": {"friction": mu}, "muscles": {"stiffness": k}}
    for E, nu, mu, k in ((3e4, 0.35, 0.4, 900.0), (6e4, 0.2, 0.2, 400.0))
)


def slider():
    """A block with one muscle, pushed along a rough floor."""
    terms = (
        elastic(MESH, stable_neo_hookean),
        muscles([[0, 2]], stiffness=1.0),
        gravity(MESH, (0.0, -9.81)),
        plane_contact([0, 1], normal=[0.0, 1.0], stiffness=5e4, width=1e-3, friction=0.1, threshold_speed=0.05),
    )
    return make_scene(MESH, terms, masses=20.0)


def test_material_friction_and_muscle_are_recovered_from_a_motion():
    scene = slider()
    stepper = make_step(scene, 0.02, tolerance=1e-9, linear_solver=dense, friction_iterations=0)
    state = stepper.init(v=[1.5, 0.0])
    controls = 0.8 + 0.2 * jnp.cos(jnp.arange(5))[:, None]

    @jax.jit
    def motion(params):
        step = functools.partial(stepper.step, params)
        return rollout(step, state, controls, observe=positions_and_convergence)[1]

    x, converged = motion(with_parameters(scene.params, **TRUTH))
    assert converged.all()
    unseen = x.at[3, 2].set(jnp.nan)
    motions = ObservedMotions(state.x[None], state.v[None], controls[None], unseen[None])

    def scaled(ratios):
        return jax.tree.map(jnp.multiply, ratios, GUESS)

    def params(ratios):
        return with_parameters(scene.params, **scaled(ratios))

    result = identify(stepper, params, jax.tree.map(jnp.ones_like, GUESS), motions)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5), scaled(result.parameters), TRUTH)


def test_a_rest_shape_is_found_that_hangs_as_wanted():
    scene = make_scene(MESH, (elastic(MESH, stable_neo_hookean, youngs_modulus=2e5), gravity(MESH)), held=[0, 2])
    wanted = jnp.asarray(MESH.vertices)
    sagging, _ = static_solve(scene, scene.params)
    assert np.abs(sagging - wanted).max() > 0.02

    def with_rest(free):
        return scene.params._replace(rest=scene.params.rest.at[1].set(free))

    result = design(scene, with_rest, scene.params.rest[1], wanted)
    hanging, info = static_solve(scene, with_rest(result.parameters))
    assert info.converged
    np.testing.assert_allclose(hanging, wanted, atol=1e-7)


def test_mistakes_name_what_is_wrong():
    motions = ObservedMotions(*(jnp.zeros((1, *shape)) for shape in ((3, 2), (3, 2), (4, 1), (4, 3, 2))))
    with one_line("noise is 0"):
        identify(make_step(slider(), 0.02), lambda theta: theta, jnp.zeros(1), motions, noise=0.0)
