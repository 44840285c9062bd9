"""Locking of linear, quadratic and mixed elements, against closed forms.

A clamped square of an isotropic solid: u = curl of psi, with psi and its slope zero on the boundary, has div u = 0 and
is exact for every nu with the body force -mu laplace(u) + grad p, for any p at nu = 1/2. Only locking depends on nu.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import Delaunay

from dln_jax.softbody.equilibrium import static_solve
from dln_jax.softbody.mesh.mesh import Mesh, boundary_vertices, make_mesh, vertices_where, volumes
from dln_jax.softbody.mesh.quadratic import barycentric_split, quadratic
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.mesh.simplices import SIDES
from dln_jax.softbody.scene import make_scene, with_parameters
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.loads import point_force
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from scripts.reports.case import Findings
from scripts.reports.rows import expect

RATIOS = (0.3, 0.49, 0.4999)
CELLS = {"linear": (4, 8, 16, 32), "quadratic": (2, 4, 8, 16), "mixed": (2, 4, 8, 16), "split": (2, 3, 6, 12)}
"""Cells along a side, by kind; split: quadratic elements on a mesh split at its centres. Linear, quadratic and mixed
meshes have the same numbers of unknowns."""
LOCKED, LINEAR, EXACT = 0.5, 0.2, 0.02
"""Smallest error of elements that lock, largest error of linear elements where they do not, and of the others."""
MODULUS, AMPLITUDE = 1e9, 1e-5
"""Young's modulus in Pa, and size of psi in m²: small enough for linear elasticity, and large enough for rounding."""
TOLERANCE = 30.0
"""In m/s², 1e-5 of the acceleration by the body force."""
SLENDERNESS = 100


def locking(quick: bool) -> Findings:
    """Error and time of a clamped square by kind of element and Poisson's ratio, on unordered triangles."""
    rows = []
    for kind, sizes in CELLS.items():
        for cells in sizes[2:3] if quick else sizes:
            mesh, solve = _clamped(cells, kind)
            for nu in RATIOS:
                seconds, (x, converged) = _processor_time(solve, jnp.asarray(nu), _forces(mesh, nu, kind))
                error = _error(mesh, np.asarray(x) - mesh.vertices, kind) if converged else np.nan
                if cells != sizes[2 if quick else -1]:
                    continue
                text = f"relative L2 error; {len(mesh.elements)} elements, {mesh.vertices.size} unknowns, "
                text += f"{seconds:.3g} s of processor time"
                locks = kind == "linear" and nu == RATIOS[-1]
                bound = LOCKED if locks else LINEAR if kind == "linear" else 3 * EXACT if quick else EXACT
                rows.append(expect(f"locking/{kind}/nu={nu}", "error", text, error, bound, at_least=locks))
    return Findings(rows)


def slender(quick: bool) -> Findings:
    """A cantilever of L/h = 100 with one element through its thickness sags as Euler and Bernoulli say."""
    plane, space = beam(1.0, 1 / SLENDERNESS, 100, 1), box((1.0, 1 / SLENDERNESS, 1 / SLENDERNESS), (100, 1, 1))
    bodies = {
        "quadratic/2-d/nu=0.3": (quadratic(plane), 0.3, False, 0.03),
        "quadratic/2-d/nu=0.4999": (quadratic(plane), 0.4999, False, 0.03),
        "split/2-d/nu=0.4999": (quadratic(barycentric_split(plane)), 0.4999, False, 0.03),
        "quadratic/3-d/nu=0.3": (quadratic(space), 0.3, False, 0.03),
        "quadratic/3-d/nu=0.4999": (quadratic(space), 0.4999, False, 0.03),
        "linear/2-d/nu=0.3": (plane, 0.3, False, LOCKED),
        "mixed/2-d/nu=0.4999": (quadratic(plane), 0.4999, True, LOCKED),
    }
    rows = []
    for name, (mesh, nu, mixed, bound) in list(bodies.items())[: 1 if quick else None]:
        ratio = _sag(mesh, nu, mixed)
        texts = {LOCKED: "linear elements lock, mixed ones are too soft: one is not enough"}
        text = f"{texts.get(bound, 'plane strain E/(1 - nu²) in 2-d')}; deflection over theory {ratio:.4f}"
        rows.append(expect(f"slender/{name}", "tip_error", text, abs(ratio - 1), bound, at_least=bound == LOCKED))
    return Findings(rows)


def _clamped(cells: int, kind: str) -> tuple[Mesh, Any]:
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
        x, info = static_solve(scene, params, tolerance=TOLERANCE)
        return x, info.converged

    return mesh, jax.jit(solve).lower(jnp.asarray(0.3), jnp.zeros(mesh.vertices.shape)).compile()


def _processor_time(solve: Any, *arguments: Any) -> tuple[float, Any]:
    """Seconds of the processor that a call takes, the least of five, which other load affects least; and its result."""
    result, spent = jax.block_until_ready(solve(*arguments)), []
    for _ in range(5):
        began = time.process_time()
        jax.block_until_ready(solve(*arguments))
        spent.append(time.process_time() - began)
    return min(spent), result


def _displacement(x: Any) -> Any:
    slope = jax.grad(lambda x: AMPLITUDE * jnp.prod(16 * (x * (1 - x)) ** 2) * (1 + x[0]))(x)
    return jnp.stack([slope[1], -slope[0]])


def _points(mesh: Mesh, kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [m, q, 2], weights [m, q] and shape functions [q, nodes] of a rule of degree 7 or more."""
    t, w = np.polynomial.legendre.leggauss(5)
    a, b = (axis.ravel() for axis in np.meshgrid((t + 1) / 2, (t + 1) / 2, indexing="ij"))
    corners = np.stack([1 - a, a * (1 - b), a * b], axis=1)
    i, j = np.array(SIDES[2]).T
    functions = np.concatenate([corners * (2 * corners - 1), 4 * corners[:, i] * corners[:, j]], axis=1)
    weights = volumes(mesh)[:, None] * (np.outer(w, w).ravel() * a / 2)
    places = np.einsum("qc,mcd->mqd", corners, mesh.vertices[mesh.elements])
    return places, weights, corners if kind == "linear" else functions


def _forces(mesh: Mesh, nu: float, kind: str) -> np.ndarray:
    """Consistent nodal forces in N of the body force; the pressure acts if the solid is nearly incompressible."""
    places, weights, functions = _points(mesh, kind)
    mu = MODULUS / (2 * (1 + nu))

    def force(x: Any) -> Any:
        laplacian = jnp.trace(jax.hessian(_displacement)(x), axis1=1, axis2=2)
        pressure = mu * AMPLITUDE * (nu == RATIOS[-1])
        return jax.grad(lambda x: pressure * jnp.sin(3 * x[0]) * x[1])(x) - mu * laplacian

    values = np.asarray(jax.jit(jax.vmap(jax.vmap(force)))(places))
    forces = np.zeros_like(mesh.vertices)
    np.add.at(forces, mesh.nodes, np.einsum("mq,qk,mqd->mkd", weights, functions, values))
    return forces


def _error(mesh: Mesh, u: np.ndarray, kind: str) -> float:
    places, weights, functions = _points(mesh, kind)
    exact = np.asarray(jax.jit(jax.vmap(jax.vmap(_displacement)))(places))
    missed = np.einsum("qk,mkd->mqd", functions, u[mesh.nodes]) - exact
    squares = [np.einsum("mq,mqd->", weights, values**2) for values in (missed, exact)]
    return float(np.sqrt(squares[0] / squares[1]))


def _sag(mesh: Mesh, nu: float, mixed: bool) -> float:
    """Deflection of the tip under its weight over that of Euler and Bernoulli; NaN if the solve does not converge."""
    up, height, density, weight = mesh.dimension - 1, 1 / SLENDERNESS, 1000.0, 1e-3
    solid = elastic(mesh, stable_neo_hookean, youngs_modulus=MODULUS, poisson_ratio=nu, mixed=mixed)
    down = gravity(mesh, [0.0] * up + [-weight])
    scene = make_scene(mesh, [solid, down], density=density, held=vertices_where(mesh, lambda x: x[:, 0] == 0))
    x, info = jax.jit(lambda params: static_solve(scene, params))(scene.params)
    tip = vertices_where(mesh, lambda x: x[:, 0] == 1.0)
    modulus = MODULUS / (1 - nu**2) if mesh.dimension == 2 else MODULUS
    theory = density * weight * height / (8 * modulus * height**3 / 12)
    return float((mesh.vertices - x)[tip, up].mean() / theory) if info.converged else float("nan")
