# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""tatva: operators of finite elements in JAX. It integrates energies and colours sparse Jacobians.

Newton's method with SciPy's sparse LU and the adjoint equation are written here from these parts, as in its examples.
It has neither motions nor a solver of its own.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse.linalg import splu
from tatva import Mesh, Operator, sparse
from tatva.element import Tetrahedron4
from tatva.lifter import Fixed, Lifter

from dln_jax.softbody.mesh import lumped_masses
from scripts.reports.soft_bodies.body import DENSITY, GRAVITY, Body, Run, measured


def static(body: Body) -> tuple[Run, Run]:
    """Equilibrium under the weight, and the derivative of its mean height by Young's modulus, m/Pa."""
    mesh = Mesh(coords=jnp.asarray(body.mesh.vertices), elements=jnp.asarray(body.mesh.elements))
    operator = Operator(mesh, Tetrahedron4())
    lifter = Lifter(body.mesh.vertices.size, Fixed(jnp.asarray((3 * body.held[:, None] + np.arange(3)).ravel())))
    pattern = lifter.adapt_sparsity(sparse.pattern_from_mesh(mesh, n_dofs_per_node=3))
    weight = GRAVITY * jnp.asarray(lumped_masses(body.mesh, DENSITY))

    def energy(free: Any, modulus: Any) -> Any:
        u = lifter.lift_from_zeros(free).reshape(-1, 3)
        F = operator.grad(u) + jnp.eye(3)
        mu, lam = modulus / 2.6, 0.3 * modulus / (1.3 * 0.4)
        change = jnp.sum(F[..., 0, :] * jnp.cross(F[..., 1, :], F[..., 2, :]), axis=-1) - 1
        density = 0.5 * mu * (jnp.sum(F**2, axis=(-2, -1)) - 3) - mu * change + 0.5 * (lam + mu) * change**2
        return operator.integrate(density) + weight @ u[:, 2]

    residual = jax.grad(energy)
    both = jax.jit(sparse.linearized_jacfwd(residual, sparse.ColoredMatrix.from_csr(pattern)))
    by_modulus = jax.jit(jax.jacfwd(residual, argnums=1))
    of_height = jax.grad(lambda free: lifter.lift_from_zeros(free)[2::3].mean())(jnp.zeros(lifter.size_reduced))

    def solve() -> tuple[Any, Any]:
        """Free displacements and factors: at most 30 iterations, until residual forces are below 1e-9 N."""
        free = jnp.zeros(lifter.size_reduced)
        for _ in range(30):
            force, matrix = both(free, body.modulus)
            if np.abs(force).max() < 1e-9:
                break
            free = free - splu(matrix.to_csr().tocsc()).solve(np.asarray(force))
        return free, splu(both(free, body.modulus)[1].to_csr().tocsc())

    def positions() -> np.ndarray:
        return body.mesh.vertices + np.asarray(lifter.lift_from_zeros(solve()[0])).reshape(1, -1, 3)

    def slope() -> np.ndarray:
        free, factors = solve()
        return -factors.solve(np.asarray(of_height), trans="T") @ np.asarray(by_modulus(free, body.modulus))

    return measured(body, positions), measured(body, slope)
