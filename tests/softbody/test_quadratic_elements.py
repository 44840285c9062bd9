"""Quadratic and mixed elements: closed forms, orders of convergence, what they reproduce exactly, and derivatives."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import slow_among
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from dln_jax.rollout import rollout
from dln_jax.softbody import examples
from dln_jax.softbody.equilibrium import static_solve
from dln_jax.softbody.mesh import (
    NamedSet,
    barycentric_split,
    beam,
    boundary_vertices,
    box,
    lumped_masses,
    make_mesh,
    quadratic,
    read_mesh,
    vertices_where,
    volumes,
    with_midsides,
    write_mesh,
)
from dln_jax.softbody.mesh.simplices import SIDES, regularity, volume_ratios
from dln_jax.softbody.scene import element_energies, make_scene, potential, prepare, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.loads import point_force
from dln_jax.softbody.terms.strain_energies import corotated, neo_hookean, st_venant_kirchhoff, stable_neo_hookean
from dln_jax.solvers.elements.assembly import entries, pattern
from dln_jax.solvers.elements.energies import element_hessians
from dln_jax.types import InputError

SPLIT = "quadratic on a split mesh"
KINDS = ("quadratic", "mixed")


def of_kind(mesh, kind):
    if kind == "linear":
        return mesh
    return quadratic(barycentric_split(mesh) if kind == SPLIT else mesh)


def solid(mesh, kind, nu, density=stable_neo_hookean, **scene):
    material = elastic(mesh, density, youngs_modulus=1.0, poisson_ratio=nu, mixed=kind == "mixed")
    return make_scene(mesh, [material], **scene)


def displacements(scene, forces, free, held=0.0):
    """Solves the linearised problem with nodal forces and given displacements of what is not free."""
    energies, shape = element_energies(scene), scene.mesh.vertices.shape
    at = pattern(energies, *shape)
    hessian = jax.jit(lambda p: entries(at, element_hessians(energies, p.rest, prepare(scene, p, p.rest))))
    lower = coo_array((np.asarray(hessian(scene.params)), (at.rows, at.columns)), shape=(at.unknowns,) * 2).tocsc()
    stiffness = lower + lower.T - diags_array(lower.diagonal()).tocsc()
    u, free = np.where(free, 0.0, held).ravel(), free.ravel()
    u[free] = spsolve(stiffness[free][:, free], (np.ravel(forces) - stiffness @ u)[free])
    return u.reshape(shape)


def shape_functions(points):
    """N of quadratic simplices at barycentric points [q, corners]."""
    pairs = {2: ((0, 1),), 3: SIDES[2], 4: SIDES[3]}[points.shape[1]]
    i, j = np.array(pairs).T
    return np.concatenate([points * (2 * points - 1), 4 * points[:, i] * points[:, j]], axis=1)


def gauss(dimension):
    """Barycentric points and weights of collapsed products of Gauss-Legendre rules."""
    t, w = np.polynomial.legendre.leggauss(5)
    t, w = (t + 1) / 2, w / 2
    points, weights = [], []
    for place in itertools.product(range(5), repeat=dimension):
        a = t[list(place)]
        inner = np.cumprod(a)
        points.append([1 - inner[0], *(inner[:-1] - inner[1:]), inner[-1]])
        weights.append(np.prod(w[list(place)] * a ** np.arange(dimension - 1, -1, -1)))
    return np.array(points), np.array(weights) / np.sum(weights)


# A thick cylinder under internal pressure 1 (Lamé): one quarter, plane strain, on curved elements.
def cylinder_error(cells, nu, kind):
    """Relative L2 error of the displacement."""
    flat = of_kind(beam(1.0, np.pi / 2, cells, 2 * cells), kind)
    r, angle = 1 + flat.vertices[:, 0], flat.vertices[:, 1]
    mesh = flat._replace(vertices=np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1))
    forces, weights = np.zeros_like(mesh.vertices), {}
    for nodes in mesh.nodes:
        for (i, j), middle in zip(SIDES[2], nodes[3:], strict=True):
            if r[nodes[i]] == r[nodes[j]] == 1.0:
                weights[tuple(nodes[[i, j]])] = middle
    t, w = np.polynomial.legendre.leggauss(4)
    for (i, j), middle in weights.items():
        s = (t + 1) / 2
        N = shape_functions(np.stack([1 - s, s], axis=1))
        slope = np.stack([4 * s - 3, 4 * s - 1, 4 - 8 * s], axis=1) @ mesh.vertices[[i, j, middle]]
        inwards = np.stack([slope[:, 1], -slope[:, 0]], axis=1)
        np.add.at(forces, [i, j, middle], -(N * (w / 2)[:, None]).T @ inwards)
    free = np.stack([angle < np.pi / 2 - 1e-9, angle > 1e-9], axis=1)
    u = displacements(solid(mesh, kind, nu), forces, free)
    exact = mesh.vertices * ((1 + nu) / 3 * ((1 - 2 * nu) + 4 / r**2))[:, None]
    masses = lumped_masses(mesh, 1.0)
    return np.sqrt(masses @ ((u - exact) ** 2).sum(axis=1) / (masses @ (exact**2).sum(axis=1)))


@pytest.mark.parametrize(
    "case",
    [(0.3, "quadratic"), (0.4999, "quadratic"), (0.4999, "mixed")],
)
def test_displacements_of_a_pressurised_cylinder_converge_with_order_3(case):
    """Also with one pressure per element, because the pressure of Lamé's solution is uniform."""
    coarse, fine = (cylinder_error(cells, *case) for cells in (4, 8))
    assert fine < 2e-4 and np.log2(coarse / fine) == pytest.approx(3.0, abs=0.25)


# A clamped square or cube of a material with div u = 0: the exact u does not depend on nu, only locking does.
def clamped_error(cells, nu, kind, dimension=2):
    """Relative L2 error on unordered elements."""
    random = np.random.default_rng(0)
    points = np.stack(np.meshgrid(*[np.arange(cells + 1.0)] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    inner = (points > 0) & (points < cells)
    points = (points + 0.3 * inner * random.uniform(-1, 1, points.shape)) / cells
    elements = Delaunay(points).simplices
    mesh = of_kind(make_mesh(points, elements[np.abs(regularity(points, elements)) > 0.02]), kind)

    def bump(x):
        return jnp.prod(16 * (x * (1 - x)) ** 2)

    def exact(x):
        slope = jax.grad(lambda x: bump(x) * (1 + x[0]))(x)
        zeros = (0.0,) * (dimension - 2)
        return jnp.stack([slope[1], -slope[0], *zeros])  # a curl, in planes z = const

    def force(x):
        laplacian = jnp.trace(jax.hessian(exact)(x), axis1=1, axis2=2)
        pressure_slope = jax.grad(lambda x: jnp.sin(3 * x[0]) * x[1])(x) if nu > 0.4 else 0.0
        return pressure_slope - laplacian / (2 * (1 + nu))

    points, weights = gauss(dimension)
    N = points if kind == "linear" else shape_functions(points)
    at = np.einsum("qc,mcd->mqd", points, mesh.vertices[mesh.elements])
    loads, truth = (np.asarray(jax.jit(jax.vmap(jax.vmap(f)))(at)) for f in (force, exact))
    forces = np.zeros_like(mesh.vertices)
    np.add.at(forces, mesh.nodes, np.einsum("m,q,qk,mqd->mkd", volumes(mesh), weights, N, loads))
    free = np.repeat((np.abs(mesh.vertices - 0.5) < 0.5 - 1e-9).all(axis=1)[:, None], dimension, axis=1)
    u = displacements(solid(mesh, kind, nu), forces, free)

    def norm(values):
        return np.sqrt(np.einsum("m,q,mqd->", volumes(mesh), weights, values**2))

    return norm(np.einsum("qk,mkd->mqd", N, u[mesh.nodes]) - truth) / norm(truth)


def test_a_clamped_incompressible_square_locks_linear_elements_only():
    errors = {kind: clamped_error(12, 0.4999, kind) for kind in ("linear", "quadratic", "mixed", SPLIT)}
    assert errors["linear"] > 0.9 and errors["quadratic"] < 0.05
    assert errors["mixed"] < 0.004 and errors[SPLIT] < 0.01
    assert errors["mixed"] == pytest.approx(clamped_error(12, 0.3, "mixed"), rel=0.1)


@pytest.mark.slow
def test_quadratic_elements_on_a_split_mesh_keep_order_3_near_incompressibility():
    coarse, fine = (clamped_error(cells, 0.4999, SPLIT) for cells in (6, 12))
    assert np.log2(coarse / fine) == pytest.approx(3.0, abs=0.3)


@pytest.mark.slow
def test_mixed_tetrahedra_do_not_lock():
    """A clamped cube, where no theorem says so; errors with nu = 0.3 for comparison."""
    assert clamped_error(5, 0.4999, "quadratic", dimension=3) > 0.5
    assert clamped_error(5, 0.4999, "mixed", dimension=3) < 1.3 * clamped_error(5, 0.3, "mixed", dimension=3)


def tip_over_beam_theory(mesh, nu, kind, length=1.0, height=0.01):
    """Deflection under the own weight over that of Euler-Bernoulli; in the plane with the modulus of plane strain."""
    material = elastic(mesh, stable_neo_hookean, youngs_modulus=1e9, poisson_ratio=nu, mixed=kind == "mixed")
    up = mesh.dimension - 1
    weight = gravity(mesh, [0.0] * up + [-1e-3])
    scene = make_scene(mesh, [material, weight], held=vertices_where(mesh, lambda x: x[:, 0] == 0))
    x, info = jax.jit(lambda params: static_solve(scene, params))(scene.params)
    assert info.converged and info.least_J == pytest.approx(1.0, abs=1e-4)
    tip = vertices_where(mesh, lambda x: x[:, 0] == length)
    modulus = 1e9 / (1 - nu**2) if mesh.dimension == 2 else 1e9
    theory = 1000.0 * 1e-3 * height * length**4 / (8 * modulus * height**3 / 12)
    return float((mesh.vertices - x)[tip, up].mean()) / theory


def test_a_slender_beam_bends_with_one_element_through_the_thickness():
    assert tip_over_beam_theory(quadratic(beam(1.0, 0.01, 50, 1)), 0.3, "quadratic") == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
def test_elastica():
    """P L²/EI = 10 at the tip: deflection and shortening of an inextensible rod over its length."""
    height = 0.02
    mesh = quadratic(beam(1.0, height, 50, 1))
    tip = vertices_where(mesh, lambda x: x[:, 0] == 1.0)
    rod = elastic(mesh, st_venant_kirchhoff, youngs_modulus=12 / height**3, poisson_ratio=0.0)
    pull = point_force(mesh, tip, (0.0, -10.0 / len(tip)))
    scene = make_scene(mesh, [rod, pull], held=vertices_where(mesh, lambda x: x[:, 0] == 0))
    x, info = jax.jit(lambda params: static_solve(scene, params, iterations=500))(scene.params)
    middle = np.asarray(x)[tip].mean(axis=0)
    assert info.converged
    assert height / 2 - middle[1] == pytest.approx(0.81061, rel=5e-3) and 1 - middle[0] == pytest.approx(
        0.555, rel=5e-3
    )


def test_axial_frequency_of_a_bar():
    """sqrt(E / rho) / 4 L."""
    mesh = quadratic(beam(4.0, 1.0, 8, 2))
    bar = solid(mesh, "quadratic", 0.0, held=vertices_where(mesh, lambda x: x[:, 0] == 0), density=st_venant_kirchhoff)
    K = jax.jit(jax.hessian(lambda x: potential(bar, x, bar.params)))(bar.params.rest).reshape(2 * [mesh.vertices.size])
    free, m = bar.free.ravel(), np.repeat(np.asarray(bar.params.masses), 2)
    squared = np.linalg.eigvalsh(np.asarray(K / np.sqrt(np.outer(m, m)))[free][:, free])
    exact = (np.pi / 2 / 4) ** 2 / (m.sum() / 2 / 4)
    assert np.abs(squared / exact - 1).min() < 1e-3


@pytest.mark.slow
def test_a_slender_bar_bends_with_one_element_through_the_thickness():
    assert tip_over_beam_theory(quadratic(box((1.0, 0.01, 0.01), (50, 1, 1))), 0.3, "") == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize(
    "case",
    slow_among(
        itertools.product([stable_neo_hookean, neo_hookean, st_venant_kirchhoff, corotated], KINDS),
        lambda case: case[0] in (st_venant_kirchhoff, corotated),
    ),
)
def test_uniform_strain_has_the_energy_of_linear_elements(case):
    """The mixed volumetric energy differs by density, and equals its own for the stable neo-Hookean one."""
    density, kind = case
    mesh = box((1.0, 1.2, 0.8), (1, 1, 1))
    F = np.eye(3) + 1e-3 * np.random.default_rng(0).uniform(-1, 1, (3, 3))
    values = [
        float(potential(scene, jnp.asarray(scene.mesh.vertices @ F.T), scene.params))
        for scene in (solid(mesh, "linear", 0.4, density), solid(quadratic(mesh), kind, 0.4, density))
    ]
    exact = kind == "quadratic" or density is stable_neo_hookean
    assert values[1] == pytest.approx(values[0], rel=1e-9 if exact else 5e-3)


def test_patch_of_irregular_curved_triangles_is_exact():
    random = np.random.default_rng(0)
    mesh = quadratic(beam(1.0, 1.0, 3, 3))
    outside = boundary_vertices(mesh)
    assert len(outside) == 24 and (np.abs(mesh.vertices[outside] - 0.5).max(axis=1) > 0.499).all()
    inside = np.setdiff1d(np.arange(len(mesh.vertices)), outside)
    vertices = mesh.vertices.copy()
    vertices[inside] += random.uniform(-0.02, 0.02, vertices[inside].shape)
    mesh = mesh._replace(vertices=vertices)
    scene = solid(mesh, "mixed", 0.45, held=outside)
    affine = vertices @ (np.eye(2) + random.uniform(-0.2, 0.2, (2, 2)))
    start = affine.copy()
    start[inside] += random.uniform(-0.01, 0.01, start[inside].shape)
    x, info = jax.jit(lambda x: static_solve(scene, scene.params, x=x, tolerance=1e-9))(start)
    assert info.converged
    np.testing.assert_allclose(x, affine, atol=1e-12)


@pytest.mark.parametrize("mesh", [beam(1.0, 0.7, 2, 2), box((1.0, 0.7, 0.5), (1, 1, 1))], ids=["plane", "space"])
def test_masses_are_positive_and_integrate_linear_functions(mesh):
    body = quadratic(mesh)
    masses = lumped_masses(body, 3.0)
    assert masses.min() > 0 and masses.sum() == pytest.approx(3.0 * volumes(mesh).sum(), rel=1e-12)
    coarse = lumped_masses(mesh, 3.0)
    np.testing.assert_allclose(masses @ body.vertices, coarse @ mesh.vertices, rtol=1e-12)


def test_curved_sides_count_in_volumes_and_ratios():
    flat = quadratic(beam(1.0, np.pi / 2, 4, 8))
    r, angle = 1 + flat.vertices[:, 0], flat.vertices[:, 1]
    mesh = flat._replace(vertices=np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1))
    assert volumes(mesh).sum() == pytest.approx(0.75 * np.pi, rel=2e-5)
    np.testing.assert_allclose(volume_ratios(2 * mesh.vertices, mesh.vertices, mesh.nodes), 4.0)


def test_derivatives_in_material_and_rest_shape_equal_differences():
    mesh = quadratic(beam(1.0, 0.5, 2, 1))
    material = elastic(mesh, stable_neo_hookean, youngs_modulus=1e4, poisson_ratio=0.45, mixed=True)
    held = vertices_where(mesh, lambda x: x[:, 0] == 0)
    scene = make_scene(mesh, [material, gravity(mesh)], held=held, density=100.0)
    tip = int(np.argmax(mesh.vertices.sum(axis=1)))
    bulge = jnp.sin(3 * jnp.asarray(mesh.vertices)) * 0.1

    @jax.jit
    @jax.value_and_grad
    def height(parameters):
        modulus, nu, size = parameters
        params = with_parameters(scene.params, elastic={"youngs_modulus": 1e4 * modulus, "poisson_ratio": nu})
        params = params._replace(rest=params.rest + size * bulge)
        x, info = static_solve(scene, params, tolerance=1e-11)
        return jnp.where(info.converged, x[tip, 1], jnp.nan)

    at, step = np.array([1.0, 0.45, 0.3]), 1e-5
    slope = np.asarray(height(at)[1])
    for i in range(3):
        change = step * np.eye(3)[i]
        difference = (height(at + change)[0] - height(at - change)[0]) / (2 * step)
        assert slope[i] == pytest.approx(float(difference), rel=1e-6)


def test_mid_side_nodes_between_held_corners_are_held():
    mesh = quadratic(beam(1.0, 1.0, 2, 2))
    corners = vertices_where(mesh, lambda x: x[:, 0] == 0)
    linear = corners[corners < 9]
    assert with_midsides(mesh, linear).tolist() == corners.tolist()


def test_examples_of_order_2_hold_and_load_their_mid_side_nodes():
    corners = beam(1.0, 1.0, 1, 1)
    example = examples.beam(mesh=corners, held=[0, 1], order=2, mixed=True)
    mesh = example.scene.mesh
    assert mesh.midsides is not None and example.scene.held.tolist() == [0, 1, *with_midsides(mesh, [0, 1])[2:]]
    assert example.scene.held.size == 3
    twisted = examples.twist(cells=1, order=2)
    assert twisted.held_path is not None and (np.diff(twisted.scene.held) > 0).all()
    np.testing.assert_allclose(twisted.held_path(np.zeros(1))[0], twisted.scene.mesh.vertices[twisted.scene.held])
    for scene in (examples.slope(order=2).scene, examples.drop(dimension=3, cells=1, order=2).scene):
        assert all(set(range(len(scene.mesh.vertices))) == set(term.indices.ravel()) for term in scene.terms)


@pytest.mark.slow
def test_a_mixed_body_falls_and_bounces():
    example = examples.drop(cells=2, order=2, mixed=True, poisson_ratio=0.499)
    init, step = make_step(example.scene, example.dt)

    @jax.jit
    def run(state):
        observe = lambda state, info: (state.x, info.converged)  # noqa: E731
        return rollout(functools.partial(step, example.scene.params), state, steps=150, observe=observe)[1]

    x, converged = run(init(v=example.v))
    assert converged.all() and x[..., 1].min() > -0.01
    areas = volumes(example.scene.mesh)
    moved = np.array([volumes(example.scene.mesh._replace(vertices=np.asarray(now))) for now in x])
    np.testing.assert_allclose(moved / areas, 1.0, atol=0.02)


@pytest.mark.parametrize("cells", [(1, 1), (1, 1, 1)], ids=["plane", "space"])
def test_named_sets_keep_their_parts(cells, tmp_path):
    mesh = beam(1.0, 1.0, 2, 1) if len(cells) == 2 else box((2.0, 1.0, 1.0), (2, 1, 1))
    middle = mesh.vertices[:, 0].max() / 2
    part = np.flatnonzero(mesh.vertices[mesh.elements][..., 0].max(axis=1) <= middle)
    left = vertices_where(mesh, lambda x: x[:, 0] == 0)
    sets = {"half": NamedSet(np.unique(mesh.elements[part]), part), "left": NamedSet(left, np.zeros(0, int))}
    body = quadratic(barycentric_split(mesh._replace(sets=sets)))
    half = body.sets["half"]
    assert half.vertices.tolist() == vertices_where(body, lambda x: x[:, 0] <= middle).tolist()
    assert half.vertices.tolist() == np.unique(body.nodes[half.elements]).tolist()
    assert volumes(body)[half.elements].sum() == pytest.approx(volumes(mesh).sum() / 2)
    assert body.sets["left"].vertices.tolist() == vertices_where(body, lambda x: x[:, 0] == 0).tolist()
    pytest.importorskip("meshio", reason="the written file is read by meshio, of the extra [mesh]")
    write_mesh(tmp_path / "body.vtu", body)
    read = read_mesh(tmp_path / "body.vtu").mesh
    assert len(read.elements) == len(body.elements) and read.sets["half"].elements.tolist() == half.elements.tolist()


def test_mistakes_are_named():
    mesh = beam(1.0, 1.0, 1, 1)
    body = quadratic(mesh)
    with pytest.raises(InputError, match="quadratic already"):
        quadratic(body)
    with pytest.raises(InputError, match="split the linear mesh"):
        barycentric_split(body)
    with pytest.raises(InputError, match=r"quadratic\(mesh\)"):
        elastic(mesh, stable_neo_hookean, mixed=True)
    turned = body.vertices.copy()
    turned[body.midsides[0, 0]] += 2.0 * (turned[body.elements[0, 2]] - turned[body.midsides[0, 0]])
    with pytest.raises(InputError, match="element 0 is inverted"):
        elastic(body._replace(vertices=turned), stable_neo_hookean)
