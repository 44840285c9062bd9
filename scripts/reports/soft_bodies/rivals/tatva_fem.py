# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""tatva: operators of finite elements in JAX. It integrates energies and colours sparse Jacobians.

Newton's method with SciPy's sparse LU and the adjoint equation are written here from these parts, as in its examples.
It has neither motions nor a solver of its own.
"""

from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse.linalg import splu
from tatva import Mesh, Operator, sparse
from tatva.element import Tetrahedron4
from tatva.lifter import Fixed, Lifter

from dln_jax.softbody.mesh.mesh import lumped_masses
from scripts.reports.soft_bodies.rivals.body import DENSITY, GRAVITY, Body, Run, measured

VERSION = f"tatva {version('tatva')}"
TOLERANCE, ITERATIONS = 1e-9, 30
"""Largest residual force, N, and number of Newton's iterations."""


def static(body: Body) -> Run:
    """Equilibrium under the weight."""
    solve, _ = _programs(body)
    return measured(body, lambda: solve(body.modulus)[0][None])


def static_gradient(body: Body) -> tuple[Run, float]:
    """Derivative of the mean height at equilibrium by Young's modulus, in m/Pa, from the adjoint equation."""
    _, slope = _programs(body)
    return measured(body, lambda: slope(body.modulus)), float(slope(body.modulus))


def _programs(body: Body) -> tuple[Any, Any]:
    """The functions modulus -> (positions, free displacements, factors) and modulus -> derivative."""
    mesh = Mesh(coords=jnp.asarray(body.mesh.vertices), elements=jnp.asarray(body.mesh.elements))
    operator = Operator(mesh, Tetrahedron4())
    size = body.mesh.vertices.size
    lifter = Lifter(size, Fixed(jnp.asarray((3 * body.held[:, None] + np.arange(3)).ravel())))
    pattern = lifter.adapt_sparsity(sparse.pattern_from_mesh(mesh, n_dofs_per_node=3))
    weight = GRAVITY * jnp.asarray(lumped_masses(body.mesh, DENSITY))

    def energy(free: Any, modulus: Any) -> Any:
        u = lifter.lift_from_zeros(free).reshape(-1, 3)
        F = operator.grad(u) + jnp.eye(3)
        mu = modulus / (2 * (1 + body.ratio))
        lam = 2 * mu * body.ratio / (1 - 2 * body.ratio)
        change = jnp.sum(F[..., 0, :] * jnp.cross(F[..., 1, :], F[..., 2, :]), axis=-1) - 1
        density = 0.5 * mu * (jnp.sum(F**2, axis=(-2, -1)) - 3) - mu * change + 0.5 * (lam + mu) * change**2
        return operator.integrate(density) + weight @ u[:, 2]

    residual = jax.grad(energy)
    coloured = sparse.ColoredMatrix.from_csr(pattern)
    both = jax.jit(sparse.linearized_jacfwd(residual, coloured))
    by_modulus = jax.jit(jax.jacfwd(residual, argnums=1))
    of_height = jax.grad(lambda free: lifter.lift_from_zeros(free)[2::3].mean())(jnp.zeros(lifter.size_reduced))

    def solve(modulus: float) -> tuple[np.ndarray, Any, Any]:
        free = jnp.zeros(lifter.size_reduced)
        force, matrix = both(free, modulus)
        factors = splu(matrix.to_csr().tocsc())
        for _ in range(ITERATIONS):
            if np.abs(force).max() < TOLERANCE:
                break
            free = free - factors.solve(np.asarray(force))
            force, matrix = both(free, modulus)
            factors = splu(matrix.to_csr().tocsc())
        return body.mesh.vertices + np.asarray(lifter.lift_from_zeros(free)).reshape(-1, 3), free, factors

    def slope(modulus: float) -> np.ndarray:
        _, free, factors = solve(modulus)
        return -factors.solve(np.asarray(of_height), trans="T") @ np.asarray(by_modulus(free, modulus))

    return solve, slope
