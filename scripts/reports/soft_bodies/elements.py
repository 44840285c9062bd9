"""Locking of linear, quadratic and mixed elements, against closed forms.

A clamped square of an isotropic solid: u = curl of psi, with psi and its slope zero on the boundary, has div u = 0 and
is exact for every nu with the body force -mu laplace(u) + grad p, for any p at nu = 1/2. Only locking depends on nu.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import Delaunay

from dln_jax.softbody import make_scene, static_solve, with_parameters
from dln_jax.softbody.mesh import (
    Mesh,
    barycentric_split,
    beam,
    boundary_vertices,
    box,
    make_mesh,
    quadratic,
    vertices_where,
    volumes,
)
from dln_jax.softbody.mesh.simplices import SIDES
from dln_jax.softbody.terms import elastic, gravity, point_force, stable_neo_hookean
from scripts.reports.run import Numbers
from scripts.reports.soft_bodies.beams import processor_seconds

RATIOS = (0.3, 0.49, 0.4999)
CELLS = {"linear": 32, "quadratic": 16, "mixed": 16, "split": 12}
"""Cells along a side, by kind; split: quadratic elements on a mesh split at its centres. Linear, quadratic and mixed
meshes have the same numbers of unknowns."""
MODULUS, AMPLITUDE = 1e9, 1e-5
"""Young's modulus in Pa, and size of psi in m²: small enough for linear elasticity, and large enough for rounding."""


def locking(*, coarser: int = 1) -> Numbers:
    """Error and processor time of a clamped square by kind of element and Poisson's ratio, on unordered triangles."""
    numbers = {}
    for kind, cells in CELLS.items():
        mesh, solve = clamped(cells // coarser, kind)
        for nu in RATIOS:
            arguments = jnp.asarray(nu), jnp.asarray(forces(mesh, nu, kind))
            x, converged = solve(*arguments)
            numbers[f"locking/{kind}/nu={nu}"] = {
                "error": error_of(mesh, np.asarray(x) - mesh.vertices, kind) if converged else np.nan,
                "processor_seconds": processor_seconds(functools.partial(solve, *arguments), 5),
            }
    return numbers


def slender(*, bodies: int = 7) -> Numbers:
    """A cantilever of L/h = 100 with one element through its thickness sags as Euler and Bernoulli say."""
    plane, space = beam(1.0, 0.01, 100, 1), box((1.0, 0.01, 0.01), (100, 1, 1))
    cases = (
        ("quadratic/2-d", quadratic(plane), 0.3),
        ("quadratic/2-d", quadratic(plane), 0.4999),
        ("split/2-d", quadratic(barycentric_split(plane)), 0.4999),
        ("quadratic/3-d", quadratic(space), 0.3),
        ("quadratic/3-d", quadratic(space), 0.4999),
        ("linear/2-d", plane, 0.3),
        ("mixed/2-d", quadratic(plane), 0.4999),
    )
    numbers = {}
    for kind, mesh, nu in cases[:bodies]:
        ratio = sag(mesh, nu, mixed=kind.startswith("mixed"))
        numbers[f"slender/{kind}/nu={nu}"] = {"deflection_over_theory": ratio, "tip_error": abs(ratio - 1)}
    return numbers


def clamped(cells: int, kind: str) -> tuple[Mesh, Any]:
    """The mesh and (nu, forces) -> (positions, whether the solve converged), compiled."""
    grid = np.stack(np.meshgrid(*[np.arange(cells + 1.0)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    inner = (grid > 0) & (grid < cells)
    points = (grid + 0.3 * inner * np.random.default_rng(0).uniform(-1, 1, grid.shape)) / cells
    mesh = make_mesh(points, Delaunay(points).simplices)
    if kind != "linear":
        mesh = quadratic(barycentric_split(mesh) if kind == "split" else mesh)
    solid = elastic(mesh, stable_neo_hookean, youngs_modulus=MODULUS, poisson_ratio=RATIOS[-1], mixed=kind == "mixed")
    load = point_force(mesh, np.arange(len(mesh.vertices)), np.zeros(mesh.vertices.shape), name="load")
    scene = make_scene(mesh, [solid, load], density=1.0, held=boundary_vertices(mesh))

    def solve(nu: Any, forces: Any) -> tuple[Any, Any]:
        params = with_parameters(scene.params, elastic={"poisson_ratio": nu}, load={"force": forces})
        # In m/s², 1e-5 of the acceleration by the body force.
        x, info = static_solve(scene, params, tolerance=30.0)
        return x, info.converged

    return mesh, jax.jit(solve).lower(jnp.asarray(0.3), jnp.zeros(mesh.vertices.shape)).compile()


def displacement(x: Any) -> Any:
    """The exact displacement at a point."""
    slope = jax.grad(lambda x: AMPLITUDE * jnp.prod(16 * (x * (1 - x)) ** 2) * (1 + x[0]))(x)
    return jnp.stack([slope[1], -slope[0]])


def rule(mesh: Mesh, kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [m, q, 2], weights [m, q] and shape functions [q, nodes] of a rule of degree 7 or more."""
    t, w = np.polynomial.legendre.leggauss(5)
    a, b = (axis.ravel() for axis in np.meshgrid((t + 1) / 2, (t + 1) / 2, indexing="ij"))
    corners = np.stack([1 - a, a * (1 - b), a * b], axis=1)
    i, j = np.array(SIDES[2]).T
    functions = np.concatenate([corners * (2 * corners - 1), 4 * corners[:, i] * corners[:, j]], axis=1)
    weights = volumes(mesh)[:, None] * (np.outer(w, w).ravel() * a / 2)
    places = np.einsum("qc,mcd->mqd", corners, mesh.vertices[mesh.elements])
    return places, weights, corners if kind == "linear" else functions


def forces(mesh: Mesh, nu: float, kind: str) -> np.ndarray:
    """Consistent nodal forces in N of the body force; the pressure acts if the solid is nearly incompressible."""
    places, weights, functions = rule(mesh, kind)
    mu = MODULUS / (2 * (1 + nu))

    def force(x: Any) -> Any:
        laplacian = jnp.trace(jax.hessian(displacement)(x), axis1=1, axis2=2)
        pressure = mu * AMPLITUDE * (nu == RATIOS[-1])
        return jax.grad(lambda x: pressure * jnp.sin(3 * x[0]) * x[1])(x) - mu * laplacian

    values = np.asarray(jax.jit(jax.vmap(jax.vmap(force)))(places))
    nodal = np.zeros_like(mesh.vertices)
    np.add.at(nodal, mesh.nodes, np.einsum("mq,qk,mqd->mkd", weights, functions, values))
    return nodal


def error_of(mesh: Mesh, u: np.ndarray, kind: str) -> float:
    """Relative L2 error of a displacement."""
    places, weights, functions = rule(mesh, kind)
    exact = np.asarray(jax.jit(jax.vmap(jax.vmap(displacement)))(places))
    missed = np.einsum("qk,mkd->mqd", functions, u[mesh.nodes]) - exact
    squares = [np.einsum("mq,mqd->", weights, values**2) for values in (missed, exact)]
    return float(np.sqrt(squares[0] / squares[1]))


def sag(mesh: Mesh, nu: float, *, mixed: bool) -> float:
    """Deflection of the tip under its weight over that of Euler and Bernoulli; NaN if the solve does not converge."""
    up, height, density, weight = mesh.dimension - 1, 0.01, 1000.0, 1e-3
    solid = elastic(mesh, stable_neo_hookean, youngs_modulus=MODULUS, poisson_ratio=nu, mixed=mixed)
    down = gravity(mesh, [0.0] * up + [-weight])
    scene = make_scene(mesh, [solid, down], density=density, held=vertices_where(mesh, lambda x: x[:, 0] == 0))
    x, info = jax.jit(lambda params: static_solve(scene, params))(scene.params)
    tip = vertices_where(mesh, lambda x: x[:, 0] == 1.0)
    modulus = MODULUS / (1 - nu**2) if mesh.dimension == 2 else MODULUS
    theory = density * weight * height / (8 * modulus * height**3 / 12)
    return float((mesh.vertices - x)[tip, up].mean() / theory) if info.converged else float("nan")
