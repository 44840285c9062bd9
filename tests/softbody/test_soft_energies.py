"""Energy terms of soft bodies against plain numpy formulas, the laws of mechanics, and points where formulas break."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import slow_among

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.terms import creature
from dln_jax.softbody.terms.contact import distance_contact, plane_contact
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.penalty import penalty, penalty_force
from dln_jax.softbody.terms.springs import muscles, springs
from dln_jax.softbody.terms.strain_energies import corotated, neo_hookean, st_venant_kirchhoff, stable_neo_hookean
from dln_jax.softbody.terms.term import Context, Term
from dln_jax.solvers.elements.energies import ElementEnergy, value
from dln_jax.types import InputError

MESHES = {
    2: Mesh(np.array([[0.0, 0.0], [1.1, 0.1], [0.2, 0.9], [1.3, 1.2]]), np.array([[0, 1, 2], [1, 3, 2]])),
    3: Mesh(
        np.array([[0.0, 0.0, 0.0], [1.1, 0.1, 0.0], [0.2, 0.9, 0.1], [0.1, 0.2, 1.2], [1.0, 1.1, 0.9]]),
        np.array([[0, 1, 2, 3], [1, 4, 2, 3]]),
    ),
}
PAIRS = np.array([[0, 1], [1, 2], [3, 0]])
STEP = 1e-5


def make_context(rest, x=None, control=None, dt=0.1) -> Context:
    rest = jnp.asarray(rest)
    x = rest if x is None else jnp.asarray(x)
    control = None if control is None else jnp.asarray(control)
    return Context(rest, jnp.arange(1.0, 1.0 + len(rest)), x, jnp.asarray(dt), control)


def gradient_of(f, *arguments):
    """Compiled: op by op, each small operation would be a program of its own."""
    return jax.jit(jax.grad(f))(*arguments)


def total(term: Term, parameters, context: Context, x):
    data = term.prepare(parameters, context)
    return value((ElementEnergy(term.energy, term.indices, term.unrolled, term.weights),), x, (data,))


# The independent formulas: elastic densities of the signed singular values, by LAPACK; lengths by norms.
def singular_values(x, rest, elements):
    rest_edges = np.swapaxes(rest[elements[:, 1:]] - rest[elements[:, :1]], 1, 2)
    F = np.swapaxes(x[elements[:, 1:]] - x[elements[:, :1]], 1, 2) @ np.linalg.inv(rest_edges)
    sigma = np.linalg.svd(F)[1]
    sigma[:, -1] *= np.where(np.linalg.det(F) < 0, -1.0, 1.0)
    return sigma, np.linalg.det(rest_edges) / (2 if x.shape[1] == 2 else 6)


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
        sigma, volume = singular_values(x, rest, elements)
        return (volume * density(sigma, *lame(*parameters))).sum()

    return energy


def lengths(x):
    return np.linalg.norm(x[PAIRS[:, 1]] - x[PAIRS[:, 0]], axis=1)


def softened_spring_reference(x, rest, parameters, control):
    now, start = (np.sqrt(lengths(points) ** 2 + 0.3**2) for points in (x, rest))
    return 0.5 * (parameters.stiffness * (now - start) ** 2).sum()


def spring_reference(x, rest, parameters, control):
    return 0.5 * (parameters.stiffness * (lengths(x) - parameters.rest_length) ** 2).sum()


def muscle_reference(x, rest, parameters, control):
    target = control * lengths(rest)
    return 0.5 * (parameters.stiffness * ((np.sqrt(lengths(x) ** 2 + 1e-6) - target) / target) ** 2).sum()


class Case(NamedTuple):
    name: str
    dimension: int
    term: Term
    reference: object
    control: np.ndarray | None = None


def cases():
    densities = [stable_neo_hookean, neo_hookean, st_venant_kirchhoff, corotated]
    for density, numpy_density in zip(densities, [stable, logarithmic, green, linear_in_stretch], strict=True):
        for dimension, mesh in MESHES.items():
            # In the plane, the sum of singular values has a formula of its own; the others read invariants alone.
            if dimension == 3 or density in (stable_neo_hookean, corotated):
                term = elastic(mesh, density, youngs_modulus=np.array([900.0, 1400.0]), poisson_ratio=0.35)
                yield Case(density.__name__, dimension, term, elastic_reference(numpy_density, mesh.elements))
    term = springs(PAIRS, stiffness=20.0, rest_length=lengths(MESHES[3].vertices))
    yield Case("stiff-springs", 3, term, spring_reference)
    term = springs(PAIRS, stiffness=np.array([20.0, 30.0, 50.0]), softening=0.3)
    yield Case("springs", 2, term, softened_spring_reference)
    yield Case("muscles", 3, muscles(PAIRS, stiffness=90.0), muscle_reference, np.array([0.3, 1.0, 0.7]))


def has_parameter_derivatives(case: Case) -> bool:
    """The preparation is the same for all solids: one in space is enough."""
    return case.dimension == 2 or case.name in ("stable_neo_hookean", "stiff-springs", "muscles")


class Answers(NamedTuple):
    case: Case
    rest: np.ndarray
    positions: dict
    energy: dict
    gradient: dict
    hessian: dict
    parameter_gradient: object
    direction: np.ndarray
    rotation: np.ndarray


LONG = ("corotated", "neo_hookean", "st_venant_kirchhoff")


@pytest.fixture(
    scope="module",
    params=slow_among(cases(), lambda case: case.dimension == 3 and case.name in LONG),
    ids=lambda case: f"{case.name}-{case.dimension}d",
)
def answers(request):
    """Energy, gradient and Hessian of a term at named positions, in one program."""
    case = request.param
    rest = MESHES[case.dimension].vertices
    random = np.random.default_rng(1)
    rotation = np.linalg.qr(random.normal(size=(case.dimension, case.dimension)))[0]
    rotation[0] *= np.sign(np.linalg.det(rotation))
    stretched = rest @ (np.eye(case.dimension) + 0.2 * random.normal(size=(case.dimension, case.dimension)))
    stretched += 0.05 * random.normal(size=rest.shape)
    direction = random.normal(size=rest.shape)
    mirror, line = np.eye(case.dimension), np.zeros((case.dimension, case.dimension))
    mirror[0, 0], line[0, 0] = -1.0, 1.3
    positions = {
        "rest": rest,
        "moved rest": rest @ rotation.T + 3.0,
        "stretched": stretched,
        "moved": stretched @ rotation.T - 2.0,
        "forward": stretched + STEP * direction,
        "backward": stretched - STEP * direction,
        "point": np.zeros_like(rest),
        "flat": rest * np.r_[np.ones(case.dimension - 1), 0.0],
        "line": rest @ line,
        "mirrored": rest @ mirror,
        "inverted": stretched @ mirror,
        "joined": np.concatenate([rest[:1], rest[:1], rest[2:]]),
    }
    context = make_context(rest, control=case.control)

    def value(parameters, rest, control, x):
        return total(case.term, parameters, context._replace(rest=rest, control=control), x)

    @jax.jit
    def program(parameters, rest, control, batch):
        def at(x):
            slope = jax.value_and_grad(value, argnums=3)
            (energy, first), tangents = jax.linearize(lambda x: slope(parameters, rest, control, x), x)
            units = jnp.eye(x.size).reshape(-1, *x.shape)
            return energy, first, jax.vmap(lambda unit: tangents(unit)[1])(units).reshape(x.size, x.size)

        if not has_parameter_derivatives(case):
            return jax.vmap(at)(batch), None
        which = (0, 1) if control is None else (0, 1, 2)
        return jax.vmap(at)(batch), jax.grad(value, argnums=which)(parameters, rest, control, batch[2])

    batch = jnp.stack(list(positions.values()))
    results, parameter_gradient = program(case.term.parameters, context.rest, context.control, batch)
    named = [dict(zip(positions, np.asarray(result), strict=True)) for result in results]
    return Answers(case, rest, positions, *named, parameter_gradient, direction, rotation)


def test_energy_equals_the_independent_formula(answers):
    names = ["rest", "stretched", "forward"]
    if answers.case.name != "neo_hookean":
        names += ["point", "flat", "line", "mirrored", "inverted", "joined"]
    parameters = jax.tree.map(np.asarray, answers.case.term.parameters)
    for name in names:
        expected = answers.case.reference(answers.positions[name], answers.rest, parameters, answers.case.control)
        # At a triple root of the corotated energy, s is exact to the cube root of rounding.
        tolerance = 1e-5 if name == "mirrored" and answers.case.name == "corotated" else 1e-9
        np.testing.assert_allclose(answers.energy[name], expected, rtol=tolerance, atol=1e-9, err_msg=name)


def test_gradient_and_hessian_equal_finite_differences(answers):
    parameters = jax.tree.map(np.asarray, answers.case.term.parameters)
    ahead, behind = (
        answers.case.reference(answers.positions[name], answers.rest, parameters, answers.case.control)
        for name in ("forward", "backward")
    )
    slope = np.sum(answers.gradient["stretched"] * answers.direction)
    assert slope == pytest.approx((ahead - behind) / (2 * STEP), rel=1e-6)
    product = answers.hessian["stretched"] @ answers.direction.ravel()
    expected = (answers.gradient["forward"] - answers.gradient["backward"]).ravel() / (2 * STEP)
    np.testing.assert_allclose(product, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(answers.hessian["stretched"], answers.hessian["stretched"].T, rtol=1e-9, atol=1e-8)


def test_derivatives_in_parameters_rest_shape_and_control(answers):
    case, random = answers.case, np.random.default_rng(2)
    if not has_parameter_derivatives(case):
        pytest.skip("three-dimensional solids share this code; another one is differentiated")
    inputs = [jax.tree.map(np.asarray, case.term.parameters), answers.rest]
    inputs += [] if case.control is None else [case.control]
    changes = jax.tree.map(lambda value: np.asarray(value * random.normal(size=value.shape)), tuple(inputs))

    def reference(size):
        changed = jax.tree.map(lambda value, change: value + size * change, tuple(inputs), changes)
        return case.reference(answers.positions["stretched"], changed[1], changed[0], *(changed[2:] or (None,)))

    slope = sum(jax.tree.leaves(jax.tree.map(lambda g, c: np.sum(g * c), answers.parameter_gradient, changes)))
    assert slope == pytest.approx((reference(STEP) - reference(-STEP)) / (2 * STEP), rel=1e-6)


def test_rotation_and_translation_change_nothing_but_the_frame(answers):
    for fixed, moved in (("rest", "moved rest"), ("stretched", "moved")):
        scale = np.abs(answers.gradient["stretched"]).max()
        assert answers.energy[moved] == pytest.approx(answers.energy[fixed], rel=1e-11, abs=1e-10)
        expected = answers.gradient[fixed] @ answers.rotation.T
        np.testing.assert_allclose(answers.gradient[moved], expected, atol=1e-10 * scale)


def test_internal_forces_and_torques_cancel(answers):
    names = ["stretched", "flat", "inverted", "joined"]
    for name in names:
        force, x = answers.gradient[name], answers.positions[name]
        scale = 1e-12 + np.abs(force).max()
        np.testing.assert_allclose(force.sum(0) / scale, 0.0, atol=1e-12)
        torque = x.T @ force
        np.testing.assert_allclose((torque - torque.T) / scale, 0.0, atol=1e-7 if name == "flat" else 1e-11)


def test_the_rest_shape_is_at_rest(answers):
    if answers.case.name == "muscles":
        pytest.skip("an active muscle has a force in the rest shape")
    scale = np.abs(answers.gradient["stretched"]).max()
    assert abs(answers.energy["rest"]) < 1e-12 * scale
    np.testing.assert_allclose(answers.gradient["rest"], 0.0, atol=1e-12 * scale)


def test_small_strains_obey_linear_elasticity(answers):
    if "spring" in answers.case.name or answers.case.name == "muscles":
        pytest.skip("springs and muscles have no Lamé constants")
    mesh, rest = MESHES[answers.case.dimension], answers.rest
    stiffness = np.zeros((rest.size, rest.size))
    E, nu = (np.broadcast_to(value, 2) for value in answers.case.term.parameters)
    for corners, mu, lam in zip(mesh.elements, *lame(E, nu), strict=True):
        edges = (rest[corners[1:]] - rest[corners[0]]).T
        gradients = []
        for unit in np.eye(rest.size).reshape(-1, *rest.shape):
            gradients.append((unit[corners[1:]] - unit[corners[0]]).T @ np.linalg.inv(edges))
        strains = np.stack([(gradient + gradient.T) / 2 for gradient in gradients])
        traces = np.trace(strains, axis1=1, axis2=2)
        volume = np.linalg.det(edges) / (2 if rest.shape[1] == 2 else 6)
        stiffness += volume * (2 * mu * np.einsum("aij,bij->ab", strains, strains) + lam * np.outer(traces, traces))
    np.testing.assert_allclose(answers.hessian["rest"], stiffness, atol=1e-9 * stiffness.max())


def test_derivatives_are_finite_where_elements_collapse_or_lengths_vanish(answers):
    for name in answers.positions:
        assert np.isfinite(answers.gradient[name]).all(), name
        assert np.isfinite(answers.hessian[name]).all(), name
    for name in ("point", "flat", "line", "mirrored", "inverted"):
        infinite = answers.case.name == "neo_hookean"
        assert np.isposinf(answers.energy[name]) if infinite else np.isfinite(answers.energy[name]), name


def test_the_crease_of_the_corotated_energy_keeps_the_slope_of_a_change_of_size():
    mesh = MESHES[3]
    term = elastic(mesh, corotated, youngs_modulus=1e3)
    x, context = mesh.vertices @ np.diag([1.3, 0.0, 0.0]), make_context(mesh.vertices)
    slope = jnp.sum(x * gradient_of(lambda x: total(term, term.parameters, context, x), jnp.asarray(x)))
    reference = elastic_reference(linear_in_stretch, mesh.elements)
    ahead, behind = (reference(size * x, mesh.vertices, (1e3, 0.3), None) for size in (1 + STEP, 1 - STEP))
    assert slope == pytest.approx((ahead - behind) / (2 * STEP), rel=1e-6)


def test_a_spring_without_length_pulls_all_ways_alike():
    context = make_context(np.zeros((2, 3)))
    term = springs([[0, 1]], stiffness=7.0, rest_length=0.0)
    hessian = jax.jit(jax.hessian(lambda x: total(term, term.parameters, context, x)))(jnp.zeros((2, 3)))
    np.testing.assert_allclose(hessian.reshape(6, 6), 7.0 * np.kron([[1, -1], [-1, 1]], np.eye(3)))


def test_uniaxial_stretch_of_the_logarithmic_solid():
    """E = 1e3, nu = 0.3, lateral faces free: lateral stretch and nominal stress of the closed form."""
    term = elastic(MESHES[3], neo_hookean, youngs_modulus=1e3, poisson_ratio=0.3)
    rest, context = jnp.asarray(MESHES[3].vertices), make_context(MESHES[3].vertices)
    volume = singular_values(MESHES[3].vertices, MESHES[3].vertices, MESHES[3].elements)[1].sum()

    def energy(stretch, lateral):
        return total(term, term.parameters, context, rest * jnp.stack([stretch, lateral, lateral])) / volume

    @jax.jit
    @jax.vmap
    def solve(stretch):
        def improve(_, lateral):
            force, rate = jax.value_and_grad(jax.grad(energy, argnums=1), argnums=1)(stretch, lateral)
            return lateral - force / rate

        lateral = jax.lax.fori_loop(0, 30, improve, stretch**-0.3)
        return lateral, jax.grad(energy)(stretch, lateral)

    lateral, stress = solve(jnp.array([2.0, 0.5, 10.0]))
    np.testing.assert_allclose(lateral, [0.79807754, 1.21076739, 0.41653193], atol=1e-8)
    np.testing.assert_allclose(stress, [646.74466, -935.35206, 3839.4808], rtol=1e-7)


def test_single_precision_stays_single():
    term = elastic(MESHES[3], corotated, youngs_modulus=1e3)
    rest = MESHES[3].vertices
    stretches = np.array([1.2, 0.9, 1.1])
    parameters, context = jax.tree.map(lambda value: value.astype(np.float32), (term.parameters, make_context(rest)))
    energy = jax.jit(lambda x: total(term, parameters, context, x))(jnp.asarray(rest * stretches, np.float32))
    assert energy.dtype == np.float32
    expected = elastic_reference(linear_in_stretch, MESHES[3].elements)(rest * stretches, rest, (1e3, 0.3), None)
    assert energy == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("dimension", [2, 3])
def test_gravity_is_the_weight(dimension):
    """Against the last axis: y in the plane, z in space."""
    mesh = MESHES[dimension]
    context = make_context(mesh.vertices)
    term = gravity(mesh)
    force = -gradient_of(lambda x: total(term, term.parameters, context, x), context.x)
    expected = np.zeros_like(mesh.vertices)
    expected[:, -1] = -9.81 * np.asarray(context.masses)
    np.testing.assert_allclose(force, expected, rtol=1e-14)
    tilted = gravity(2, np.arange(1.0, 1.0 + dimension))
    slope = gradient_of(lambda p: total(tilted, p, context, context.x), tilted.parameters).acceleration
    np.testing.assert_allclose(slope, -(np.asarray(context.masses[:2]) @ mesh.vertices[:2]), rtol=1e-13)


def test_penalty_is_twice_continuously_differentiable():
    width = 0.2
    derivatives = [lambda d: penalty(d, width)]
    for _ in range(2):
        derivatives.append(jax.grad(derivatives[-1]))
    shifts = np.array([-1e-9, 0.0, 1e-9])
    depths = np.array([0.1, -0.05, -0.15, -0.3])

    @jax.jit
    @jax.vmap
    def evaluate(d):
        slopes = [jax.grad(lambda d, w=w: penalty(d, w))(d) for w in (width, 0.0)]
        return [f(d) for f in derivatives], slopes, [penalty_force(d, w) for w in (width, 0.0)], penalty(d, 0.0)

    values, slopes, forces, kinked = evaluate(jnp.r_[shifts, shifts - width, depths])
    for computed, at_edge in zip(values, [width**2 / 6, -width / 2, 1.0], strict=True):
        np.testing.assert_allclose(computed[:6], [0, 0, 0, at_edge, at_edge, at_edge], atol=1e-7)
    np.testing.assert_allclose(values[2][6:], [0, 0.25, 0.75, 1], rtol=1e-12)
    np.testing.assert_allclose(slopes, -np.array(forces), rtol=1e-12, atol=1e-17)
    np.testing.assert_allclose(kinked[6:], [0, 0.00125, 0.01125, 0.045], rtol=1e-12)


def surfaces(dimension, **options):
    """The same plane as a plane and as a distance, with the unit normal and the offset."""
    normal = np.array([0.6, 0.8, 0.0])[:dimension]
    vertices = [2, 0, 1]
    return (
        plane_contact(vertices, normal=5.0 * normal, offset=0.25, stiffness=800.0, width=0.01, **options),
        distance_contact(vertices, lambda x: x @ jnp.asarray(normal) - 0.25, stiffness=800.0, width=0.01, **options),
        normal,
    )


@pytest.mark.parametrize("kind, dimension", [(0, 2), (0, 3), (1, 3)], ids=["plane-2d", "plane-3d", "distance-3d"])
def test_coulomb_friction(kind, dimension):
    """Force mu N against fast slip, 2 r - r² of it below the threshold, none at rest; N from the start of the step."""
    mu, speed, dt = 0.4, 1e-3, 0.05
    term, normal = (surfaces(dimension, friction=mu, threshold_speed=speed)[place] for place in (kind, 2))
    smooth = surfaces(dimension)[kind]
    start = np.tile(normal * 0.25, (3, 1))
    start += np.outer([-0.05, 0.0, -0.004], normal)
    tangent = np.array([0.8, -0.6, 0.0])[:dimension]
    tangent = tangent if dimension == 2 else 0.6 * tangent + 0.8 * np.array([0, 0, 1.0])
    context = make_context(start, start, dt=dt)
    pressed = 800.0 * np.array([0.045, 0.0, 0.0008])

    @jax.jit
    def derivatives(x, dt):
        def friction(x, stiffness):
            parameters = term.parameters._replace(stiffness=stiffness)
            with_friction = total(term, parameters, context._replace(dt=dt), x)
            return with_friction - total(smooth, smooth.parameters._replace(stiffness=stiffness), context, x)

        slope = jax.grad(friction)
        hessian = jax.jacfwd(slope)(x, jnp.asarray(800.0))
        return slope(x, jnp.asarray(800.0)), hessian, jax.jacfwd(slope, argnums=1)(x, jnp.asarray(800.0))

    for ratio, share in ((1e3, 1.0), (1.0, 1.0), (0.5, 0.75), (1e-3, 1.999e-3)):
        # Normal motion is not slip.
        slope, hessian, in_stiffness = derivatives(start + ratio * speed * dt * tangent + 1e-3 * normal, dt)
        np.testing.assert_allclose(slope, np.outer(mu * pressed * share, tangent), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(in_stiffness, slope / 800.0, rtol=1e-9, atol=1e-12)
        assert np.isfinite(hessian).all()
    slope, hessian, _ = derivatives(start, dt)
    np.testing.assert_allclose(slope, 0.0, atol=1e-15)
    for vertex, force in enumerate(pressed):
        expected = 2 * mu * force / (speed * dt) * (np.eye(dimension) - np.outer(normal, normal))
        np.testing.assert_allclose(hessian[vertex, :, vertex], expected, rtol=1e-9, atol=1e-9)
    slope, hessian, _ = derivatives(start + tangent, jnp.inf)
    assert not np.any(slope) and not np.any(hessian)


@pytest.mark.parametrize("dimension", [2, 3])
def test_contact_pushes_along_the_normal_and_is_smooth_at_the_surface(dimension):
    plane, distance, normal = surfaces(dimension)
    assert plane.parameters.friction is None
    start = np.tile(normal * 0.25, (3, 1)) + np.outer([-0.05, 0.0, 0.1], normal)
    context = make_context(start, start)
    for term in (plane, distance):
        slope = gradient_of(lambda x, term=term: total(term, term.parameters, context, x), context.x)
        np.testing.assert_allclose(slope, np.outer([-800 * 0.045, 0, 0], normal), atol=1e-10)
        hessian = jax.jit(jax.hessian(lambda x, term=term: total(term, term.parameters, context, x)))(context.x)
        expected = np.zeros((3, dimension, 3, dimension))
        expected[0, :, 0] = 800 * np.outer(normal, normal)
        np.testing.assert_allclose(hessian, expected, atol=1e-8)
    # The plane's own parameters: a higher ground presses more, and the length of the normal does not count.
    gradient = gradient_of(lambda p: total(plane, p, context, context.x), plane.parameters)
    assert gradient.offset == pytest.approx(800 * 0.045, rel=1e-9)
    assert float(gradient.normal @ plane.parameters.normal) == pytest.approx(0.0, abs=1e-9)


def test_a_ball_rubs_along_its_tangent_and_not_at_its_centre():
    def ball(x):
        return jnp.where(jnp.any(x != 0), jnp.sqrt(jnp.where(jnp.any(x != 0), x @ x, 1.0)), 0.0) - 1.0

    term = distance_contact([0, 1], ball, stiffness=100.0, width=0.02, friction=0.5)
    start = np.array([[0.54, 0.72], [0.0, 0.0]])
    context = make_context(start, start, dt=0.01)
    gradient = jax.jit(jax.grad(lambda x: total(term, term.parameters, context, x)))
    moved = start + np.array([0.8, -0.6])
    normal = moved[0] / np.linalg.norm(moved[0])
    depth = np.linalg.norm(moved[0]) - 1.0
    expected = 0.5 * 100.0 * 0.09 * np.array([0.8, -0.6]) + (100.0 * (depth + 0.01) * normal if depth < -0.02 else 0.0)
    np.testing.assert_allclose(gradient(jnp.asarray(moved))[0], expected, rtol=1e-9)
    assert np.isfinite(gradient(jnp.asarray(start))).all()


def creature_reference(x, start, rest, triangles, pairs, actuation, h):
    """Protocol of the published simulator, in plain numpy."""
    total = 0.0
    for corners in triangles:
        F = (x[corners[1:]] - x[corners[0]]).T @ np.linalg.inv((rest[corners[1:]] - rest[corners[0]]).T)
        J = np.linalg.det(F)
        s = -1.5 + 2 * J - 0.5 * J**2
        total += 0.5 * 500 * (np.sum(F**2) - 2) - 500 * s + 0.5 * 50 * s**2
    for (i, j), a in zip(pairs, actuation, strict=True):
        l, l0 = np.sqrt(np.sum((x[i] - x[j]) ** 2) + 1e-6), np.linalg.norm(rest[i] - rest[j])
        total += 0.5 * 90 * ((l - a * l0) / (a * l0)) ** 2
    for (_, y), (x_n, y_n), x_now in zip(x, start, x[:, 0], strict=True):
        total += creature.MASS * 9.8 * y + (14000 * y**2 if y < 0 else 0.0)
        total += 300 * ((x_now - x_n) / h) ** 2 * (0.01 - y_n) if y_n < 0.01 else 0.0
    return total


def test_creature_preset_follows_the_protocol():
    mesh, h = MESHES[2], creature.TIME_STEP
    random = np.random.default_rng(3)
    start = mesh.vertices + 0.03 * random.normal(size=(4, 2)) - np.array([0.0, 0.08])
    x = start + 0.05 * random.normal(size=(4, 2)) - np.array([0.0, 0.05])
    assert (x[:2, 1] < 0).all() and (start[:2, 1] < 0.01).all() and (start[2:, 1] > 0.01).all()
    actuation = np.array([0.25, 1.0, 0.6])
    terms = creature.creature_terms(mesh, PAIRS)
    assert [term.name for term in terms] == ["elastic", "muscles", "gravity", "ground"]
    context = make_context(mesh.vertices, start, actuation, h)._replace(masses=jnp.full(4, creature.MASS))

    @jax.jit
    @jax.value_and_grad
    def value(x):
        return sum(total(term, term.parameters, context, x) for term in terms)

    energy, gradient = value(jnp.asarray(x))
    arguments = (start, mesh.vertices, mesh.elements, PAIRS, actuation, h)
    assert energy == pytest.approx(creature_reference(x, *arguments), rel=1e-12)
    differences = np.zeros_like(x)
    for place in np.ndindex(x.shape):
        shift = np.zeros_like(x)
        shift[place] = STEP
        ahead, behind = (creature_reference(x + sign * shift, *arguments) for sign in (1, -1))
        differences[place] = (ahead - behind) / (2 * STEP)
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-5)


def with_control(control):
    term = muscles(PAIRS, stiffness=1.0)
    return term.prepare(term.parameters, make_context(MESHES[2].vertices, control=control))


@pytest.mark.parametrize(
    "mistake, message",
    [
        (
            lambda: elastic(MESHES[2], corotated, poisson_ratio=np.array([0.3, 0.5])),
            "poisson_ratio of element 1 is 0.5",
        ),
        (lambda: elastic(MESHES[2], corotated, poisson_ratio=-1.0), "poisson_ratio is -1.0"),
        (lambda: elastic(MESHES[2], corotated, youngs_modulus=np.array([0.0, 1.0])), "of element 0 is 0.0"),
        (lambda: elastic(MESHES[2], corotated, youngs_modulus=np.array([1.0, np.nan])), "of element 1 is nan"),
        (lambda: elastic(MESHES[2], corotated, youngs_modulus=np.ones(3)), "one number, or 2: one per element"),
        (lambda: springs([[0, 1], [2, 2]], stiffness=1.0), "pair 1 joins vertex 2 to itself"),
        (lambda: springs([[0, -1]], stiffness=1.0), "contains the index -1"),
        (lambda: springs([[0, 1]], stiffness=-1.0), "stiffness is -1.0"),
        (lambda: springs([[0, 1]], stiffness=1.0, softening=-0.1), "softening is -0.1"),
        (lambda: springs(np.array([[0.0, 1.0]]), stiffness=1.0), "integer"),
        (lambda: springs(np.zeros((0, 2), int), stiffness=1.0), "leave the term out"),
        (lambda: with_control(None), "muscles got no control; expected shape .3,."),
        (lambda: with_control(np.ones(2)), "a control of shape .2,.; expected shape .3,."),
        (lambda: gravity(3), "no acceleration"),
        (lambda: gravity(MESHES[2], (0.0, np.inf)), "finite components"),
        (lambda: plane_contact([0, 0], normal=(0, 1), stiffness=1.0, width=0.1), "names a vertex twice"),
        (lambda: plane_contact([0], normal=(0, 0), stiffness=1.0, width=0.1), "normal of a plane is zero"),
        (lambda: plane_contact([0], normal=(0, 1), stiffness=1.0, width=-0.1), "width is -0.1"),
        (lambda: plane_contact([0], normal=(0, 1), stiffness=1.0, width=0.1, friction=-1.0), "friction is -1.0"),
        (
            lambda: creature.creature_terms(
                MESHES[3], PAIRS, bumps=creature.Bumps(np.ones(1), np.ones((1, 1)), np.ones(1))
            ),
            "have 1 components; expected 2",
        ),
    ],
)
def test_mistakes_are_named(mistake, message):
    with pytest.raises(InputError, match=message):
        mistake()
