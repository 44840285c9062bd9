"""Energy terms of soft bodies against plain numpy formulas, the laws of mechanics, and points where formulas break."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.shapes import body_length, box_quadruped
from dln_jax.softbody.terms import (
    Context,
    Term,
    corotated,
    creature,
    distance_contact,
    elastic,
    gravity,
    muscles,
    neo_hookean,
    plane_contact,
    springs,
    st_venant_kirchhoff,
    stable_neo_hookean,
)
from dln_jax.softbody.terms.penalty import penalty, penalty_force
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


def make_context(rest, x=None, control=None, dt=0.1) -> Context:
    rest = jnp.asarray(rest)
    x = rest if x is None else jnp.asarray(x)
    return Context(rest, jnp.arange(1.0, 1.0 + len(rest)), x, jnp.asarray(dt), control)


def total(term: Term, parameters, context: Context, x):
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


def softened_spring_reference(x, rest, parameters, control):
    extension = np.hypot(lengths(x), 0.3) - np.hypot(lengths(rest), 0.3)
    return 0.5 * (parameters.stiffness * extension**2).sum()


def spring_reference(x, rest, parameters, control):
    return 0.5 * (parameters.stiffness * (lengths(x) - parameters.rest_length) ** 2).sum()


def muscle_reference(x, rest, parameters, control):
    target = control * lengths(rest)
    return 0.5 * (parameters.stiffness * ((np.hypot(lengths(x), 1e-3) - target) / target) ** 2).sum()


class Case(NamedTuple):
    name: str
    dimension: int
    term: Term
    reference: object
    control: np.ndarray | None = None

    @property
    def is_solid(self):
        return self.name in DENSITIES


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
    term = springs(PAIRS, stiffness=20.0, rest_length=lengths(REST))
    yield Case("springs", 3, term, spring_reference)
    term = springs(PAIRS, stiffness=np.array([20.0, 30.0, 50.0]), softening=0.3)
    yield Case("softened springs", 2, term, softened_spring_reference)
    yield Case("muscles", 3, muscles(PAIRS, stiffness=90.0), muscle_reference, np.array([0.3, 1.0, 0.7]))


def slowly_compiled():
    yield from (solid(name, 3) for name in ("corotated", "green"))


class Answers(NamedTuple):
    case: Case
    rest: np.ndarray
    positions: dict
    energy: dict
    gradient: dict
    hessian: dict
    slope: float
    """Derivative in parameters, rest shape, control and positions, all of which change at once."""
    difference: float
    """The same by differences of the independent formula."""
    direction: np.ndarray


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
        np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9, atol=1e-8, err_msg=of.case.name)


def test_internal_forces_and_torques_cancel(answers):
    for of in answers:
        for name in ("stretched", "flat", "inverted", "joined"):
            force = of.gradient[name] / (1e-12 + np.abs(of.gradient[name]).max())
            torque = of.positions[name].T @ force
            np.testing.assert_allclose(force.sum(0), 0.0, atol=1e-12, err_msg=of.case.name)
            tolerance = 1e-7 if name == "flat" else 1e-11
            np.testing.assert_allclose(torque - torque.T, 0.0, atol=tolerance, err_msg=of.case.name)


def test_small_strains_obey_linear_elasticity(answers):
    for of in answers:
        if not of.case.is_solid:
            continue
        mu, lam = lame(*of.case.term.parameters)

        @jax.jit
        @jax.hessian
        def stiffness(u, of=of, mu=mu, lam=lam):
            slope, volume = deformation(u.reshape(of.rest.shape), of.rest, MESHES[of.case.dimension].elements)
            strain = (slope + slope.swapaxes(1, 2)) / 2
            trace = jnp.trace(strain, axis1=1, axis2=2)
            return jnp.sum(volume * (mu * jnp.sum(strain**2, axis=(1, 2)) + lam / 2 * trace**2))

        expected = stiffness(np.zeros(of.rest.size))
        largest = np.abs(expected).max()
        np.testing.assert_allclose(of.hessian["rest"], expected, atol=1e-9 * largest, err_msg=of.case.name)
        np.testing.assert_allclose(of.gradient["rest"], 0.0, atol=1e-12 * largest, err_msg=of.case.name)


def test_derivatives_are_finite_where_elements_collapse_or_lengths_vanish(answers):
    for of in answers:
        for name in of.positions:
            assert np.isfinite(of.gradient[name]).all() and np.isfinite(of.hessian[name]).all(), (of.case.name, name)


def test_the_crease_of_the_corotated_energy_keeps_the_slope_of_a_change_of_size():
    term = elastic(MESHES[3], corotated, youngs_modulus=1e3)
    x = REST @ np.diag([1.3, 0.0, 0.0])
    slope = jax.jit(jax.grad(lambda size: total(term, term.parameters, make_context(REST), size * x)))(1.0)
    reference = elastic_reference(linear_in_stretch, MESHES[3].elements)
    ahead, behind = (reference(size * x, REST, (1e3, 0.3), None) for size in (1 + STEP, 1 - STEP))
    assert slope == pytest.approx((ahead - behind) / (2 * STEP), rel=1e-6)


def test_a_spring_without_length_pulls_all_ways_alike():
    context = make_context(np.zeros((2, 3)))
    term = springs([[0, 1]], stiffness=7.0, rest_length=0.0)
    hessian = jax.jit(jax.hessian(lambda x: total(term, term.parameters, context, x)))(context.x)
    np.testing.assert_allclose(hessian.reshape(6, 6), 7.0 * np.kron([[1, -1], [-1, 1]], np.eye(3)))


def test_single_precision_stays_single():
    term = elastic(MESHES[3], corotated, youngs_modulus=1e3)
    x = REST * np.array([1.2, 0.9, 1.1])
    parameters, context = jax.tree.map(lambda value: value.astype(np.float32), (term.parameters, make_context(REST)))
    energy = jax.jit(lambda x: total(term, parameters, context, x))(x.astype(np.float32))
    assert energy.dtype == np.float32
    expected = elastic_reference(linear_in_stretch, MESHES[3].elements)(x, REST, (1e3, 0.3), None)
    assert energy == pytest.approx(expected, rel=1e-4)


def test_gravity_is_the_weight():
    """Against the last axis: y in the plane, z in space."""
    for dimension, mesh in MESHES.items():
        context, term = make_context(mesh.vertices), gravity(mesh)
        slope = jax.jit(jax.grad(lambda x, term=term, c=context: total(term, term.parameters, c, x)))(context.x)
        np.testing.assert_allclose(slope, 9.81 * np.outer(context.masses, np.eye(dimension)[-1]), rtol=1e-14)


def test_penalty_is_twice_continuously_differentiable():
    @jax.jit
    @jax.vmap
    def derivatives(d):
        first = jax.grad(penalty)
        smooth = penalty(d, 0.2), first(d, 0.2), jax.grad(first)(d, 0.2)
        return smooth, penalty_force(d, 0.2), (first(d, 0.0), penalty_force(d, 0.0), penalty(d, 0.0))

    shifts = np.array([-1e-9, 0.0, 1e-9])
    smooth, force, kinked = derivatives(np.r_[shifts, shifts - 0.2, 0.1, -0.05, -0.15, -0.3])
    for values, at_edge in zip(smooth, [0.2**2 / 6, -0.1, 1.0], strict=True):
        np.testing.assert_allclose(values[:6], [0, 0, 0, at_edge, at_edge, at_edge], atol=1e-7)
    np.testing.assert_allclose(smooth[2][6:], [0, 0.25, 0.75, 1], rtol=1e-12)
    np.testing.assert_allclose([smooth[1], kinked[0]], [-force, -kinked[1]], rtol=1e-12, atol=1e-17)
    np.testing.assert_allclose(kinked[2][6:], [0, 0.00125, 0.01125, 0.045], rtol=1e-12)


def surface(kind, **options):
    """A plane in two dimensions, and one that is given by its distance in three, with the unit normal."""
    options = {"stiffness": 800.0, "width": 0.01, **options}
    if kind == "plane":
        return plane_contact([2, 0, 1], normal=[3.0, 4.0], offset=0.25, **options), np.array([0.6, 0.8])
    normal = np.array([0.6, 0.8, 0.0])
    return distance_contact([2, 0, 1], lambda x: x @ normal - 0.25, **options), normal


@pytest.mark.parametrize("kind", ["plane", "distance"])
def test_contact_pushes_along_the_normal_with_coulomb_friction(kind):
    """Force mu N against fast slip, 2 r - r² of it below the threshold, none at rest; N from the start of the step."""
    mu, speed, dt = 0.4, 1e-3, 0.05
    (term, normal), (smooth, _) = surface(kind, friction=mu, threshold_speed=speed), surface(kind)
    start = np.outer(0.25 + np.array([-0.05, 0.0, -0.004]), normal)
    tangent = np.array([0.8, -0.6]) if kind == "plane" else np.array([0.48, -0.36, 0.8])
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


def test_a_ball_rubs_along_its_tangent_and_not_at_its_centre():
    def ball(x):
        return jnp.where(jnp.any(x != 0), jnp.sqrt(jnp.where(jnp.any(x != 0), x @ x, 1.0)), 0.0) - 1.0

    term = distance_contact([0, 1], ball, stiffness=100.0, width=0.02, friction=0.5)
    start = np.array([[0.54, 0.72], [0.0, 0.0]])
    gradient = jax.jit(jax.grad(lambda x: total(term, term.parameters, make_context(start, dt=0.01), x)))
    # Outside the ball there is friction alone.
    slope = gradient(start + np.array([0.8, -0.6]))
    np.testing.assert_allclose(slope[0], 0.5 * 100.0 * 0.09 * np.array([0.8, -0.6]), rtol=1e-9)
    assert np.isfinite(gradient(start)).all()


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
    target = actuation * lengths(rest)
    muscle = 0.5 * 90 * ((np.sqrt(lengths(x) ** 2 + 1e-6) - target) / target) ** 2
    return solid.sum() + muscle.sum() + creature.MASS * 9.8 * x[:, 1].sum() + ground_reference(x, start, h)


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


def test_rough_ground_pushes_up_and_brakes_in_both_directions_and_flat_ground_computes_no_bumps():
    random = np.random.default_rng(0)
    start = 0.1 * random.normal(size=(5, 3))
    x = start + 0.02 * random.normal(size=(5, 3))
    context = make_context(REST, start, dt=0.033)
    rough, flat = (creature.creature_terms(MESHES[3], [[0, 1]], bumps=bumps)[-1] for bumps in (BUMPS, None))
    waves = list(zip(*map(np.asarray, BUMPS), strict=True))
    energy = jax.jit(lambda x: total(rough, rough.parameters, context, x))(x)
    assert energy == pytest.approx(ground_reference(x, start, 0.033, waves), rel=1e-12)
    assert " sin" not in str(jax.make_jaxpr(lambda x: total(flat, flat.parameters, context, x))(x))


def test_box_quadruped_stands_on_four_legs():
    box = box_quadruped()
    assert box.mesh.vertices.shape == (56, 3) and box.muscles.shape == (48, 2)
    assert (box.mesh.vertices[:, 2] == 0).sum() == 16 and body_length(box) == pytest.approx(1.6)
    np.testing.assert_allclose(np.linalg.norm(np.diff(box.mesh.vertices[box.muscles], axis=1), axis=2), 0.4)


def test_mistakes_are_named():
    def solid(**parameters):
        return elastic(MESHES[2], corotated, **parameters)

    def plane(vertices=(0,), normal=(0, 1), width=0.1):
        return plane_contact(vertices, normal=normal, stiffness=1.0, width=width)

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
        (lambda: springs(np.array([[0.0, 1.0]]), stiffness=1.0), "integer"),
        (lambda: springs(np.zeros((0, 2), int), stiffness=1.0), "leave the term out"),
        (lambda: driven(None), "muscles got no control; expected shape .3,."),
        (lambda: driven(np.ones(2)), "a control of shape .2,.; expected shape .3,."),
        (lambda: gravity(3), "no acceleration"),
        (lambda: gravity(MESHES[2], (0.0, np.inf)), "finite components"),
        (lambda: plane([0, 0]), "names a vertex twice"),
        (lambda: plane(normal=(0, 0)), "normal of a plane is zero"),
        (lambda: plane(width=-0.1), "width is -0.1"),
        (lambda: creature.creature_terms(MESHES[3], PAIRS, bumps=flat), "have 1 components; expected 2"),
    ):
        with one_line(words):
            mistake()
