"""Equations of motion of any Hamiltonian H(q, p), for one state.

    dq/dt = dH/dp,   dp/dt = tau - dD/dqd - dH/dq        (Hamilton)

In coordinates and velocities, with qdd = H_pq qd + H_pp dp/dt along the motion, so that M = H_pp⁻¹,

    inverse:  H_pp dp/dt = qdd - H_pq qd,   tau = dp/dt + dH/dq + dD/dqd
    forward:  dp/dt from Hamilton,          qdd = d/dt dH/dp

The momentum p(q, qd) comes from the Legendre transform (`legendre`), in general by a Newton iteration. A natural system
with a factor of the inverse mass matrix needs two triangular solves instead (`mechanics.natural`). Nothing is
regularised: a singular H_pp gives non-finite values.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.dynamics import Functions, decompose_by_differences, friction_force
from dln_jax.solvers.elimination import solve
from dln_jax.types import Dissipation, Hamiltonian, Matrix, Scalar, Vector, require_positive

Energy = Callable[[Array, Array], Array]
"""A Lagrangian or Hamiltonian."""
Guess = Callable[[Array, Array], Array]
"""(q, slope [d]) -> initial value of a Newton iteration [d]."""
MOST_STEPS = 30
"""Largest number of Newton steps; without convergence the Legendre transform is NaN."""


class HamiltonianSystem(NamedTuple):
    """Energies of any Hamiltonian system, as functions of one state, and settings of the momentum solve.

    `flow` returns Hamilton's equations dq/dt = dH/dp, dp/dt = -dD/dqd - dH/dq. `dynamics` returns the equations in
    coordinates and velocities; a Newton iteration then solves dH/dp = qd for the momentum. All vectors are [d], in SI
    units.

    Example:
        >>> import jax.numpy as jnp
        >>> import dln_jax
        >>> pendulum = dln_jax.HamiltonianSystem(lambda q, p: 0.5 * p[0] ** 2 - 9.81 * jnp.cos(q[0]))
        >>> qd, pd = dln_jax.flow(pendulum).rates([0.5], [1.0])
        >>> print(qd, pd.round(2))
        [1.] [-4.7]
    """

    hamiltonian: Hamiltonian
    """(q, p) -> H, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""
    iterations: int | None = None
    """Newton steps to p(q, qd), as for `conjugate`; Hamilton's equations need none."""
    initial_guess: Guess | None = None
    """(q, qd) -> initial p [d] of these steps; zero by default."""


def velocity(H: Hamiltonian, q: Vector, p: Vector) -> Vector:
    """Returns the generalised velocity qd = dH/dp [d]."""
    return jax.grad(H, argnums=1)(q, p)


def time_derivative(
    H: Hamiltonian, q: Vector, p: Vector, tau: Vector, *, dissipation: Dissipation | None = None
) -> tuple[Vector, Vector]:
    """Returns (qd, pd), both [d], under a generalised force: Hamilton's equations."""
    force, qd = jax.grad(H, argnums=(0, 1))(q, p)
    pd = tau - force
    return qd, pd if dissipation is None else pd - friction_force(dissipation, q, qd)


def inverse(H: Hamiltonian, q: Vector, p: Vector, pd: Vector) -> Vector:
    """Returns the generalised force tau = pd + dH/dq [d] of a motion, without friction."""
    return pd + jax.grad(H)(q, p)


def conjugate(
    energy: Energy, q: Vector, slope: Vector, *, iterations: int | None = None, initial_guess: Guess | None = None
) -> Vector:
    """Solves d(energy)/dx (q, x) = slope for x [d]: the momentum of a velocity (for H), or the reverse (for L).

    Takes full Newton steps from `initial_guess(q, slope)`, by default from zero, until convergence. After `MOST_STEPS`
    without convergence the result and its derivatives are NaN. Steps are not damped: an energy that is not convex in x
    may have no solution. `iterations` fixes the number of steps without a test of convergence. One step is exact if the
    energy is quadratic in x, as in every natural system. Otherwise check `velocity(H, q, x) - slope`.

    Derivatives of all orders follow from the implicit function theorem, also by values that `energy` closes over.
    Raises InputError if `iterations` is not positive.
    """
    _require_iterations(iterations)
    identity = jnp.eye(slope.shape[0], dtype=slope.dtype)
    start = jnp.zeros_like(slope) if initial_guess is None else initial_guess(q, slope)

    def residual(x: Vector) -> Vector:
        return jax.grad(energy, argnums=1)(q, x) - slope

    def step(residual, x: Vector) -> tuple[Vector, Vector]:
        value, hessian_product = jax.linearize(residual, x)
        return x - solve_hessian(hessian_product, value), value

    def fixed_count(residual, start: Vector) -> Vector:
        return jax.lax.scan(lambda x, _: (step(residual, x)[0], None), start, length=iterations)[0]

    def until_converged(residual, start: Vector) -> tuple[Vector, Array]:
        eps = jnp.finfo(slope.dtype).eps

        def turn(state):
            count, x, _ = state
            better, left = step(residual, x)
            # The error is about the square of such a small step. Near a root at zero this relative test fails, and the
            # test of the residual decides.
            settled = jnp.max(jnp.abs(better - x)) < jnp.sqrt(eps) * jnp.max(jnp.abs(better))
            return count + 1, better, settled | (jnp.max(jnp.abs(left)) <= 16 * eps * jnp.max(jnp.abs(slope)))

        def running(state):
            count, x, converged = state
            return ~converged & (count < MOST_STEPS) & jnp.isfinite(x).all()

        _, x, converged = jax.lax.while_loop(running, turn, (0, start, jnp.asarray(False)))
        return x, converged.astype(x.dtype)

    def solve_hessian(hessian_product, right: Vector) -> Vector:
        return solve(jax.vmap(hessian_product)(identity), right)

    if iterations is not None:
        return jax.lax.custom_root(residual, start, fixed_count, solve_hessian)
    x, converged = jax.lax.custom_root(residual, start, until_converged, solve_hessian, has_aux=True)
    # A factor instead of a selection, so that derivatives also become NaN.
    return x * jnp.where(converged > 0, 1, jnp.nan).astype(x.dtype)


def legendre(energy: Energy, *, iterations: int | None = None) -> Energy:
    """Returns H(q, p) = p·qd - L(q, qd) of a Lagrangian, or the reverse; `iterations` as for `conjugate`."""
    _require_iterations(iterations)

    def transform(q: Vector, slope: Vector) -> Scalar:
        # A function with a custom derivative must take the values that the energy closes over as arguments.
        function, closed_over = jax.closure_convert(energy, q, slope)
        return _legendre(function, iterations, q, slope, *closed_over)

    return transform


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _legendre(function, iterations, q, slope, *closed_over):
    x = _conjugate(function, iterations, q, slope, *closed_over)
    return jnp.dot(x, slope) - function(q, x, *closed_over)


@_legendre.defjvp
def _legendre_jvp(function, iterations, primals, tangents):
    """The envelope theorem: dx drops out of the first derivative, so no solve is differentiated."""
    q, slope, *closed_over = primals
    q_dot, slope_dot, *closed_over_dot = tangents
    x = _conjugate(function, iterations, *primals)
    value, rate = jax.jvp(lambda q, *rest: function(q, x, *rest), (q, *closed_over), (q_dot, *closed_over_dot))
    return jnp.dot(x, slope) - value, jnp.dot(x, slope_dot) - rate


def _conjugate(function, iterations, q, slope, *closed_over):
    return conjugate(lambda q, x: function(q, x, *closed_over), q, slope, iterations=iterations)


def _require_iterations(iterations: int | None) -> None:
    if iterations is not None:
        require_positive(iterations=iterations)


def functions(system: HamiltonianSystem) -> Functions:
    """Returns the functions of the system in coordinates and velocities."""
    H, _, iterations, initial_guess = system
    _require_iterations(iterations)

    def momentum(q: Vector, qd: Vector) -> Vector:
        return conjugate(H, q, qd, iterations=iterations, initial_guess=initial_guess)

    def inverse_mass(q: Vector, p: Vector) -> Matrix:
        return jax.jacfwd(lambda momentum: velocity(H, q, momentum))(p)

    def forces(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        p = momentum(q, qd)
        _, drift = jax.jvp(lambda position: velocity(H, position, p), (q,), (qd,))
        return inverse(H, q, p, solve(inverse_mass(q, p), qdd - drift))

    def accelerate(q: Vector, qd: Vector, tau: Vector) -> Vector:
        p = momentum(q, qd)
        return jax.jvp(lambda *state: velocity(H, *state), (q, p), time_derivative(H, q, p, tau))[1]

    def energy(q: Vector, qd: Vector) -> Scalar:
        return H(q, momentum(q, qd))

    def mass_matrix(q: Vector, qd: Vector) -> Matrix:
        return solve(inverse_mass(q, momentum(q, qd)), jnp.eye(q.shape[0], dtype=q.dtype))

    return forces, accelerate, energy, mass_matrix, functools.partial(decompose_by_differences, forces)
