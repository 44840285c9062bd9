"""Quadratic and mixed elements: closed forms, orders of convergence, what they reproduce exactly, and derivatives."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from dln_jax.softbody import examples
from dln_jax.softbody.mesh.files import read_mesh, write_mesh
from dln_jax.softbody.mesh.mesh import NamedSet, lumped_masses, make_mesh, vertices_where, volumes
from dln_jax.softbody.mesh.shapes import barycentric_split, beam, box, quadratic, with_midsides
from dln_jax.softbody.mesh.simplices import SIDES, regularity, volume_ratios
from dln_jax.softbody.scene import element_energies, make_scene, potential, prepare
from dln_jax.softbody.step import static_solve
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import point_force
from dln_jax.softbody.terms.strain_energies import corotated, neo_hookean, st_venant_kirchhoff, stable_neo_hookean
from dln_jax.solvers.elements.assembly import entries, pattern
from dln_jax.solvers.elements.energies import element_hessians

SPLIT = "quadratic on a split mesh"


def of_kind(mesh, kind):
    if kind == "linear":
        return mesh
    return quadratic(barycentric_split(mesh) if kind == SPLIT else mesh)


def solid(mesh, kind, nu, density=stable_neo_hookean, **scene):
    material = elastic(mesh, density, youngs_modulus=1.0, poisson_ratio=nu, mixed=kind == "mixed")
    return make_scene(mesh, [material], **scene)


def displacements(scene, forces, free):
    """Solves the linearised problem with nodal forces, and no displacement of what is not free."""
    energies, shape = element_energies(scene), scene.mesh.vertices.shape
    at = pattern(energies, *shape)
    hessian = jax.jit(lambda p: entries(at, element_hessians(energies, p.rest, prepare(scene, p, p.rest))))
    lower = coo_array((np.asarray(hessian(scene.params)), (at.rows, at.columns)), shape=(at.unknowns,) * 2).tocsc()
    stiffness = lower + lower.T - diags_array(lower.diagonal()).tocsc()
    u, free = np.zeros(at.unknowns), free.ravel()
    u[free] = spsolve(stiffness[free][:, free], forces.ravel()[free])
    return u.reshape(shape)


def shape_functions(points):
    """N of quadratic simplices at barycentric points [q, corners]."""
    i, j = np.array(SIDES[points.shape[1] - 1]).T
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


def test_a_clamped_incompressible_square_locks_linear_elements_only_and_converges_with_order_3():
    errors = {kind: clamped_error(12, 0.4999, kind) for kind in ("linear", "quadratic", "mixed", SPLIT)}
    assert errors["linear"] > 0.9 and errors["quadratic"] < 0.05
    assert errors["mixed"] < 0.004 and errors[SPLIT] < 0.01
    assert errors["mixed"] == pytest.approx(clamped_error(12, 0.3, "mixed"), rel=0.1)
    assert np.log2(clamped_error(6, 0.4999, SPLIT) / errors[SPLIT]) == pytest.approx(3.0, abs=0.3)


def test_mixed_tetrahedra_do_not_lock():
    """A clamped cube, where no theorem says so; errors with nu = 0.3 for comparison."""
    assert clamped_error(5, 0.4999, "quadratic", dimension=3) > 0.5
    assert clamped_error(5, 0.4999, "mixed", dimension=3) < 1.3 * clamped_error(5, 0.3, "mixed", dimension=3)


def test_elastica():
    """P L²/EI = 10 at the tip: deflection and shortening of an inextensible rod over its length."""
    height = 0.02
    mesh = quadratic(beam(1.0, height, 50, 1))
    tip = vertices_where(mesh, lambda x: x[:, 0] == 1.0)
    rod = elastic(mesh, st_venant_kirchhoff, youngs_modulus=12 / height**3, poisson_ratio=0.0)
    pull = point_force(mesh, tip, (0.0, -10.0 / len(tip)))
    scene = make_scene(mesh, [rod, pull], held=vertices_where(mesh, lambda x: x[:, 0] == 0))
    x, info = jax.jit(lambda params: static_solve(scene, params, iterations=500))(scene.params)
    along, up = np.asarray(x)[tip].mean(axis=0)
    assert info.converged
    np.testing.assert_allclose([height / 2 - up, 1 - along], [0.81061, 0.555], rtol=5e-3)


@pytest.mark.parametrize(
    "density, kind",
    [
        (stable_neo_hookean, "quadratic"),
        (stable_neo_hookean, "mixed"),
        (neo_hookean, "mixed"),
        pytest.param(st_venant_kirchhoff, "mixed", marks=pytest.mark.slow),
        pytest.param(corotated, "mixed", marks=pytest.mark.slow),
    ],
)
def test_uniform_strain_has_the_energy_of_linear_elements(density, kind):
    """The mixed volumetric energy differs by density, and equals its own for the stable neo-Hookean one."""
    mesh = box((1.0, 1.2, 0.8), (1, 1, 1))
    F = np.eye(3) + 1e-3 * np.random.default_rng(0).uniform(-1, 1, (3, 3))
    linear, other = (
        float(jax.jit(lambda x, scene=scene: potential(scene, x, scene.params))(scene.mesh.vertices @ F.T))
        for scene in (solid(mesh, "linear", 0.4, density), solid(quadratic(mesh), kind, 0.4, density))
    )
    assert other == pytest.approx(linear, rel=1e-9 if density is stable_neo_hookean else 5e-3)


def test_patch_of_irregular_curved_triangles_is_exact():
    random = np.random.default_rng(0)
    mesh = quadratic(beam(1.0, 1.0, 3, 3))
    outside = vertices_where(mesh, lambda x: np.abs(x - 0.5).max(axis=1) > 0.499)
    assert len(outside) == 24
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


def test_masses_are_positive_and_integrate_linear_functions():
    for mesh in (beam(1.0, 0.7, 2, 2), box((1.0, 0.7, 0.5), (1, 1, 1))):
        body = quadratic(mesh)
        masses = lumped_masses(body, 3.0)
        assert masses.min() > 0 and masses.sum() == pytest.approx(3.0 * volumes(mesh).sum(), rel=1e-12)
        np.testing.assert_allclose(masses @ body.vertices, lumped_masses(mesh, 3.0) @ mesh.vertices, rtol=1e-12)


def test_curved_sides_count_in_volumes_and_ratios():
    flat = quadratic(beam(1.0, np.pi / 2, 4, 8))
    r, angle = 1 + flat.vertices[:, 0], flat.vertices[:, 1]
    mesh = flat._replace(vertices=np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1))
    assert volumes(mesh).sum() == pytest.approx(0.75 * np.pi, rel=2e-5)
    np.testing.assert_allclose(volume_ratios(2 * mesh.vertices, mesh.vertices, mesh.nodes), 4.0)


def test_examples_of_order_2_hold_and_load_their_mid_side_nodes():
    mesh = quadratic(beam(1.0, 1.0, 2, 2))
    corners = vertices_where(mesh, lambda x: x[:, 0] == 0)
    assert with_midsides(mesh, corners[corners < 9]).tolist() == corners.tolist()
    example = examples.beam(mesh=beam(1.0, 1.0, 1, 1), held=[0, 1], order=2, mixed=True)
    assert len(example.scene.held) == 3
    twisted = examples.twist(cells=1, order=2)
    assert (np.diff(twisted.scene.held) > 0).all()
    np.testing.assert_allclose(twisted.held_path(np.zeros(1))[0], twisted.scene.mesh.vertices[twisted.scene.held])
    for scene in (examples.slope(order=2).scene, examples.drop(dimension=3, cells=1, order=2).scene):
        assert all(set(range(len(scene.mesh.vertices))) == set(term.indices.ravel()) for term in scene.terms)


def test_named_sets_keep_their_parts(tmp_path):
    mesh = box((2.0, 1.0, 1.0), (2, 1, 1))
    part = np.flatnonzero(mesh.vertices[mesh.elements][..., 0].max(axis=1) <= 1.0)
    sets = {"half": NamedSet(np.unique(mesh.elements[part]), part), "left": NamedSet(np.arange(4), np.zeros(0, int))}
    body = quadratic(barycentric_split(mesh._replace(sets=sets)))
    half = body.sets["half"]
    assert half.vertices.tolist() == vertices_where(body, lambda x: x[:, 0] <= 1.0).tolist()
    assert volumes(body)[half.elements].sum() == pytest.approx(1.0)
    assert body.sets["left"].vertices.tolist() == vertices_where(body, lambda x: x[:, 0] == 0).tolist()
    write_mesh(tmp_path / "body.vtu", body)
    assert read_mesh(tmp_path / "body.vtu").mesh.sets["half"].elements.tolist() == half.elements.tolist()


def test_mistakes_are_named():
    mesh = beam(1.0, 1.0, 1, 1)
    body = quadratic(mesh)
    turned = body.vertices.copy()
    turned[body.midsides[0, 0]] += 2.0 * (turned[body.elements[0, 2]] - turned[body.midsides[0, 0]])
    for mistake, words in (
        (lambda: quadratic(body), "quadratic already"),
        (lambda: barycentric_split(body), "split the linear mesh"),
        (lambda: elastic(mesh, stable_neo_hookean, mixed=True), r"quadratic\(mesh\)"),
        (lambda: elastic(body._replace(vertices=turned), stable_neo_hookean), "element 0 is inverted"),
    ):
        with one_line(words):
            mistake()
