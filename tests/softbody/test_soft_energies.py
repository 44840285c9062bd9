"""Energy terms of soft bodies against plain numpy formulas, the laws of mechanics, and points where formulas break."""

from collections import namedtuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.terms import creature
from dln_jax.softbody.terms.contact import penalty, penalty_force, plane_contact
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.springs import muscles, springs
from dln_jax.softbody.terms.strain_energies import corotated, neo_hookean, st_venant_kirchhoff, stable_neo_hookean
from dln_jax.softbody.terms.term import Context
from dln_jax.solvers.elements.energies import ElementEnergy, value

MESHES = {
    2: Mesh(np.array([[0.0, 0.0], [1.1, 0.1], [0.2, 0.9], [1.3, 1.2]]), np.array([[0, 1, 2], [1, 3, 2]])),
    3: Mesh(
        np.array([[0.0, 0.0, 0.0], [1.1, 0.1, 0.0], [0.2, 0.9, 0.1], [0.1, 0.2, 1.2], [1.0, 1.1, 0.9]]),
        np.array([[0, 1, 2, 3], [1, 4, 2, 3]]),
    ),
}
REST = MESHES[3].vertices
PAIRS = np.array([[0, 1], [1, 2], [3, 0]])
STEP = 1e-5


def make_context(rest, x=None, control=None, dt=0.1):
    rest = jnp.asarray(rest)
    x = rest if x is None else jnp.asarray(x)
    return Context(rest, jnp.arange(1.0, 1.0 + len(rest)), x, jnp.asarray(dt), control)


def total(term, parameters, context, x):
    data = term.prepare(parameters, context)
    return value((ElementEnergy(term.energy, term.indices, term.unrolled, term.weights),), x, (data,))


# The independent formulas: elastic densities of the signed singular values, by LAPACK; lengths by norms.
def deformation(x, rest, elements):
    """Deformation gradients of the elements, and their volumes."""
    edges, rest_edges = ((of[elements[:, 1:]] - of[elements[:, :1]]).swapaxes(1, 2) for of in (x, rest))
    return edges @ np.linalg.inv(rest_edges), np.linalg.det(rest_edges) / (2 if x.shape[1] == 2 else 6)


def stable(sigma, mu, lam):
    J = sigma.prod(1)
    return mu / 2 * (sigma**2 - 1).sum(1) - mu * (J - 1) + (lam + mu) / 2 * (J - 1) ** 2


def logarithmic(sigma, mu, lam):
    log_J = np.log(sigma.prod(1))
    return mu / 2 * (sigma**2 - 1).sum(1) - mu * log_J + lam / 2 * log_J**2


def green(sigma, mu, lam):
    strain = (sigma**2 - 1) / 2
    return mu * (strain**2).sum(1) + lam / 2 * strain.sum(1) ** 2


def linear_in_stretch(sigma, mu, lam):
    return mu * ((sigma - 1) ** 2).sum(1) + lam / 2 * (sigma - 1).sum(1) ** 2


def lame(E, nu):
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def elastic_reference(density, elements):
    def energy(x, rest, parameters, control):
        F, volume = deformation(x, rest, elements)
        sigma = np.linalg.svd(F)[1]
        sigma[:, -1] *= np.where(np.linalg.det(F) < 0, -1.0, 1.0)
        return (volume * density(sigma, *lame(*parameters))).sum()

    return energy


def lengths(x):
    return np.linalg.norm(x[PAIRS[:, 1]] - x[PAIRS[:, 0]], axis=1)


def muscle_reference(x, rest, parameters, control):
    target = control * lengths(rest)
    return 0.5 * (parameters.stiffness * ((np.hypot(lengths(x), 1e-3) - target) / target) ** 2).sum()


Case = namedtuple("Case", "name dimension term reference control", defaults=[None])

DENSITIES = {
    "stable": (stable_neo_hookean, stable),
    "corotated": (corotated, linear_in_stretch),
    "logarithmic": (neo_hookean, logarithmic),
    "green": (st_venant_kirchhoff, green),
}


def solid(name, dimension):
    (density, reference), mesh = DENSITIES[name], MESHES[dimension]
    term = elastic(mesh, density, youngs_modulus=np.array([900.0, 1400.0]), poisson_ratio=0.35)
    return Case(name, dimension, term, elastic_reference(reference, mesh.elements))


def quickly_compiled():
    yield from (solid("stable", 2), solid("stable", 3), solid("corotated", 2), solid("logarithmic", 3))
    yield Case("muscles", 3, muscles(PAIRS, stiffness=90.0), muscle_reference, np.array([0.3, 1.0, 0.7]))


def slowly_compiled():
    yield from (solid(name, 3) for name in ("stable", "corotated", "green"))


Answers = namedtuple("Answers", "case rest positions energy gradient hessian slope difference direction")
"""The slope is in parameters, rest shape, control and positions, all of which change at once; the difference is that of
the independent formula."""


def answers_of(case):
    """Energy, gradient and Hessian of a term at named positions, in one program."""
    rest, d = MESHES[case.dimension].vertices, case.dimension
    random = np.random.default_rng(1)
    stretched = rest @ (np.eye(d) + 0.2 * random.normal(size=(d, d))) + 0.05 * random.normal(size=rest.shape)
    direction = random.normal(size=rest.shape)
    mirror = np.diag([-1.0, *[1.0] * (d - 1)])
    positions = {
        "rest": rest,
        "stretched": stretched,
        "forward": stretched + STEP * direction,
        "backward": stretched - STEP * direction,
        "point": np.zeros_like(rest),
        "flat": rest * np.r_[np.ones(d - 1), 0.0],
        "line": rest * np.r_[1.3, np.zeros(d - 1)],
        "mirrored": rest @ mirror,
        "inverted": stretched @ mirror,
        "joined": np.concatenate([rest[:1], rest[:1], rest[2:]]),
    }

    def energy_of(x, rest, parameters, control):
        return total(case.term, parameters, make_context(rest, control=control), x)

    @jax.jit
    def program(batch, inputs, changes):
        def at(x):
            slope = jax.value_and_grad(energy_of)
            (energy, first), tangents = jax.linearize(lambda x: slope(x, *inputs[1:]), x)
            units = jnp.eye(x.size).reshape(-1, *x.shape)
            return energy, first, jax.vmap(lambda unit: tangents(unit)[1])(units).reshape(x.size, x.size)

        return jax.vmap(at)(batch), jax.jvp(energy_of, inputs, changes)[1]

    inputs = (stretched, rest, jax.tree.map(np.asarray, case.term.parameters), case.control)
    changes = jax.tree.map(lambda value: value * random.normal(size=value.shape), inputs)
    results, slope = program(np.stack(list(positions.values())), inputs, changes)
    ahead, behind = (
        case.reference(*jax.tree.map(lambda value, change, size=size: value + size * change, inputs, changes))
        for size in (STEP, -STEP)
    )
    named = [dict(zip(positions, np.asarray(result), strict=True)) for result in results]
    return Answers(case, rest, positions, *named, slope, (ahead - behind) / (2 * STEP), direction)


@pytest.fixture(
    scope="module", params=[quickly_compiled, pytest.param(slowly_compiled, marks=pytest.mark.slow)], ids=["", "slow"]
)
def answers(request):
    return [answers_of(case) for case in request.param()]


def test_energy_equals_the_independent_formula(answers):
    for of in answers:
        parameters = jax.tree.map(np.asarray, of.case.term.parameters)
        for name in ("rest", "stretched", "point", "flat", "line", "mirrored", "inverted", "joined"):
            if of.case.name == "logarithmic" and name not in ("rest", "stretched"):
                assert np.isposinf(of.energy[name])
                continue
            expected = of.case.reference(of.positions[name], of.rest, parameters, of.case.control)
            # At a triple root of the corotated energy, s is exact to the cube root of rounding.
            tolerance = 1e-5 if name == "mirrored" and of.case.name == "corotated" else 1e-9
            message = f"{of.case.name} {name}"
            np.testing.assert_allclose(of.energy[name], expected, rtol=tolerance, atol=1e-9, err_msg=message)


def test_derivatives_equal_finite_differences(answers):
    for of in answers:
        assert of.slope == pytest.approx(of.difference, rel=1e-6), of.case.name
        hessian = of.hessian["stretched"]
        expected = (of.gradient["forward"] - of.gradient["backward"]).ravel() / (2 * STEP)
        product, largest = hessian @ of.direction.ravel(), np.abs(expected).max()
        np.testing.assert_allclose(product, expected, rtol=1e-6, atol=1e-6 * largest, err_msg=of.case.name)
        np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9, atol=1e-8)


def test_internal_forces_and_torques_cancel_and_derivatives_are_finite_where_elements_collapse(answers):
    for of in answers:
        for name in of.positions:
            assert np.isfinite(of.gradient[name]).all() and np.isfinite(of.hessian[name]).all(), (of.case.name, name)
        for name in ("stretched", "flat", "inverted", "joined"):
            force = of.gradient[name] / (1e-12 + np.abs(of.gradient[name]).max())
            torque = of.positions[name].T @ force
            np.testing.assert_allclose(force.sum(0), 0.0, atol=1e-12)
            tolerance = 1e-7 if name == "flat" else 1e-11
            np.testing.assert_allclose(torque - torque.T, 0.0, atol=tolerance)


def test_all_solids_have_the_same_stiffness_at_rest_and_no_force(answers):
    for of in answers:
        for other in answers:
            if {of.case.name, other.case.name} <= {*DENSITIES} and of.case.dimension == other.case.dimension:
                largest = np.abs(of.hessian["rest"]).max()
                np.testing.assert_allclose(of.hessian["rest"], other.hessian["rest"], atol=1e-9 * largest)
                np.testing.assert_allclose(of.gradient["rest"], 0.0, atol=1e-12 * largest)


def test_the_crease_of_the_corotated_energy_keeps_the_slope_of_a_change_of_size():
    term = elastic(MESHES[3], corotated, youngs_modulus=1e3)
    x = REST @ np.diag([1.3, 0.0, 0.0])
    slope = jax.jit(jax.grad(lambda size: total(term, term.parameters, make_context(REST), size * x)))(1.0)
    reference = elastic_reference(linear_in_stretch, MESHES[3].elements)
    ahead, behind = (reference(size * x, REST, (1e3, 0.3), None) for size in (1 + STEP, 1 - STEP))
    assert slope == pytest.approx((ahead - behind) / (2 * STEP), rel=1e-6)


def test_gravity_is_the_weight():
    """Against the last axis: y in the plane, z in space."""
    for dimension, mesh in MESHES.items():
        context, term = make_context(mesh.vertices), gravity(mesh)
        slope = jax.grad(lambda x, term=term, c=context: total(term, term.parameters, c, x))(context.x)
        np.testing.assert_allclose(slope, 9.81 * np.outer(context.masses, np.eye(dimension)[-1]), rtol=1e-14)


def test_penalty_is_continuous_and_its_force_is_its_slope():
    d = np.array([0.1, -0.05, -0.2 - 1e-9, -0.2 + 1e-9, -0.3])
    for width, expected in ((0.2, [0, 1.25e-3 / 12, 0.04 / 6, 0.04 / 6, 0.065 / 3]), (0.0, d**2 / 2 * (d < 0))):
        values, slopes = jax.vmap(jax.value_and_grad(lambda d, width=width: penalty(d, width)))(d)
        np.testing.assert_allclose(values, expected, rtol=1e-6)
        np.testing.assert_allclose(slopes, -penalty_force(d, width), rtol=1e-12)


def surface(dimension, **options):
    """A plane, and its unit normal."""
    normal = np.array([0.6, 0.8, 0.0][:dimension])
    return plane_contact([2, 0, 1], normal=5 * normal, offset=0.25, stiffness=800.0, width=0.01, **options), normal


@pytest.mark.parametrize("dimension", [2, 3])
def test_contact_pushes_along_the_normal_with_coulomb_friction(dimension):
    """Force mu N against fast slip, 2 r - r² of it below the threshold, none at rest; N from the start of the step."""
    mu, speed, dt = 0.4, 1e-3, 0.05
    (term, normal), (smooth, _) = surface(dimension, friction=mu, threshold_speed=speed), surface(dimension)
    start = np.outer(0.25 + np.array([-0.05, 0.0, -0.004]), normal)
    tangent = np.array([0.8, -0.6]) if dimension == 2 else np.array([0.48, -0.36, 0.8])
    context = make_context(start)
    pressed = 800.0 * np.array([0.045, 0.0, 0.0008])

    @jax.jit
    def derivatives(x, dt):
        def contact(x, stiffness):
            return total(smooth, smooth.parameters._replace(stiffness=stiffness), context, x)

        def friction(x, stiffness):
            parameters = term.parameters._replace(stiffness=stiffness)
            return total(term, parameters, context._replace(dt=dt), x) - contact(x, stiffness)

        slope = jax.grad(friction)
        return slope(x, 800.0), *jax.jacfwd(slope, argnums=(0, 1))(x, 800.0), jax.grad(contact)(x, 800.0)

    for ratio, share in ((1e3, 1.0), (1.0, 1.0), (0.5, 0.75), (1e-3, 1.999e-3)):
        # Normal motion is not slip.
        slope, hessian, in_stiffness, _ = derivatives(start + ratio * speed * dt * tangent + 1e-3 * normal, dt)
        np.testing.assert_allclose(slope, np.outer(mu * pressed * share, tangent), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(in_stiffness, slope / 800.0, rtol=1e-9, atol=1e-12)
        assert np.isfinite(hessian).all()
    slope, hessian, _, push = derivatives(start, dt)
    np.testing.assert_allclose(push, -np.outer(pressed, normal), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(slope, 0.0, atol=1e-15)
    for vertex, force in enumerate(pressed):
        expected = 2 * mu * force / (speed * dt) * (np.eye(len(normal)) - np.outer(normal, normal))
        np.testing.assert_allclose(hessian[vertex, :, vertex], expected, rtol=1e-9, atol=1e-9)
    slope, hessian, *_ = derivatives(start + tangent, jnp.inf)
    assert not np.any(slope) and not np.any(hessian)


BUMPS = creature.Bumps(jnp.asarray([0.1, 0.05]), jnp.asarray([[3.0, 1.0], [-2.0, 4.0]]), jnp.asarray([0.3, 1.2]))


def ground_reference(x, start, h, waves=()):
    """The ground of the published simulator in plain numpy; the last coordinate is the height."""
    energy = 0.0
    for before, after in zip(start, x, strict=True):
        y_n, y = (at[-1] - sum(a * np.sin(at[:-1] @ k + phase) for a, k, phase in waves) for at in (before, after))
        squared_speed = np.sum((after[:-1] - before[:-1]) ** 2) / h**2
        energy += 14000 * min(y, 0.0) ** 2 + 300 * max(0.01 - y_n, 0.0) * squared_speed
    return energy


def creature_reference(x, start, rest, triangles, actuation, h):
    F = deformation(x, rest, triangles)[0]
    J = np.linalg.det(F)
    s = -1.5 + 2 * J - 0.5 * J**2
    solid = 0.5 * 500 * (np.sum(F**2, axis=(1, 2)) - 2) - 500 * s + 0.5 * 50 * s**2
    muscle = muscle_reference(x, rest, muscles(PAIRS, stiffness=90.0).parameters, actuation)
    return solid.sum() + float(muscle) + creature.MASS * 9.8 * x[:, 1].sum() + ground_reference(x, start, h)


def test_creature_preset_follows_the_published_protocol():
    mesh, h = MESHES[2], creature.TIME_STEP
    random = np.random.default_rng(3)
    start = mesh.vertices + 0.03 * random.normal(size=(4, 2)) - np.array([0.0, 0.08])
    x = start + 0.05 * random.normal(size=(4, 2)) - np.array([0.0, 0.05])
    assert (x[:2, 1] < 0).all() and (start[:2, 1] < 0.01).all() and (start[2:, 1] > 0.01).all()
    actuation = np.array([0.25, 1.0, 0.6])
    terms = creature.creature_terms(mesh, PAIRS)
    assert [term.name for term in terms] == ["elastic", "muscles", "gravity", "ground"]
    context = make_context(mesh.vertices, start, actuation, h)._replace(masses=jnp.full(4, creature.MASS))
    energy = jax.jit(lambda x: sum(total(term, term.parameters, context, x) for term in terms))(x)
    expected = creature_reference(x, start, mesh.vertices, mesh.elements, actuation, h)
    assert energy == pytest.approx(expected, rel=1e-12)


def test_rough_ground_pushes_up_and_brakes_in_both_directions():
    random = np.random.default_rng(0)
    start = 0.1 * random.normal(size=(5, 3))
    x = start + 0.02 * random.normal(size=(5, 3))
    context = make_context(REST, start, dt=0.033)
    rough = creature.creature_terms(MESHES[3], [[0, 1]], bumps=BUMPS)[-1]
    waves = list(zip(*map(np.asarray, BUMPS), strict=True))
    energy = jax.jit(lambda x: total(rough, rough.parameters, context, x))(x)
    assert energy == pytest.approx(ground_reference(x, start, 0.033, waves), rel=1e-12)


def test_mistakes_are_named():
    def solid(**parameters):
        return elastic(MESHES[2], corotated, **parameters)

    def plane(normal=(0, 1), width=0.1):
        return plane_contact([0], normal=normal, stiffness=1.0, width=width)

    def driven(control):
        term = muscles(PAIRS, stiffness=1.0)
        return term.prepare(term.parameters, make_context(MESHES[2].vertices, control=control))

    flat = creature.Bumps(np.ones(1), np.ones((1, 1)), np.ones(1))
    for mistake, words in (
        (lambda: solid(poisson_ratio=np.array([0.3, 0.5])), "poisson_ratio of element 1 is 0.5"),
        (lambda: solid(poisson_ratio=-1.0), "poisson_ratio is -1.0"),
        (lambda: solid(youngs_modulus=np.array([1.0, np.nan])), "of element 1 is nan"),
        (lambda: solid(youngs_modulus=np.ones(3)), "one number, or 2: one per element"),
        (lambda: springs([[0, 1], [2, 2]], stiffness=1.0), "pair 1 joins vertex 2 to itself"),
        (lambda: springs([[0, -1]], stiffness=1.0), "contains the index -1"),
        (lambda: springs([[0, 1]], stiffness=1.0, softening=-0.1), "softening is -0.1"),
        (lambda: springs(np.zeros((0, 2), int), stiffness=1.0), "leave the term out"),
        (lambda: driven(None), "muscles got no control; expected shape .3,."),
        (lambda: driven(np.ones(2)), "a control of shape .2,.; expected shape .3,."),
        (lambda: plane(normal=(0, 0)), "normal of a plane is zero"),
        (lambda: plane(width=-0.1), "width is -0.1"),
        (lambda: creature.creature_terms(MESHES[3], PAIRS, bumps=flat), "have 1 components; expected 2"),
    ):
        with one_line(words):
            mistake()
