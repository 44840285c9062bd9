"""Equations of motion of any Hamiltonian H(q, p), for one state.

    dq/dt = dH/dp,   dp/dt = tau - dD/dqd - dH/dq        (Hamilton)

In coordinates and velocities, with qdd = H_pq qd + H_pp dp/dt along the motion, so that M = H_pp⁻¹,

    inverse:  H_pp dp/dt = qdd - H_pq qd,   tau = dp/dt + dH/dq + dD/dqd
    forward:  dp/dt from Hamilton,          qdd = d/dt dH/dp

The momentum p(q, qd) comes from the Legendre transform (`legendre`), which takes a Newton iteration in general; a
natural system, whose inverse mass matrix is given by its factor, needs two triangular solves instead
(`mechanics.natural_hamiltonian`). Nothing is regularised: a singular H_pp gives non-finite values.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.dynamics import Dynamics, decompose_by_differences
from dln_jax.mechanics.lagrangian import friction_force
from dln_jax.solvers.elimination import solve
from dln_jax.types import Dissipation, Hamiltonian, Scalar, Vector, require_positive

Energy = Callable[[Array, Array], Array]
"""Lagrangian or Hamiltonian."""
Guess = Callable[[Array, Array], Array]
"""(q, slope [d]) -> where a Newton iteration starts [d]."""


def velocity(H: Hamiltonian, q: Vector, p: Vector) -> Vector:
    """Generalised velocity qd = dH/dp [d]."""
    return jax.grad(H, argnums=1)(q, p)


def time_derivative(
    H: Hamiltonian, q: Vector, p: Vector, tau: Vector, *, dissipation: Dissipation | None = None
) -> tuple[Vector, Vector]:
    """(qd, pd), each [d], under a generalised force: Hamilton's equations."""
    force, qd = jax.grad(H, argnums=(0, 1))(q, p)
    pd = tau - force
    return qd, pd if dissipation is None else pd - friction_force(dissipation, q, qd)


def inverse(H: Hamiltonian, q: Vector, p: Vector, pd: Vector, *, dissipation: Dissipation | None = None) -> Vector:
    """Generalised force tau = pd + dH/dq + dD/dqd [d] that a motion takes."""
    force, qd = jax.grad(H, argnums=(0, 1))(q, p)
    tau = pd + force
    return tau if dissipation is None else tau + friction_force(dissipation, q, qd)


def power(H: Hamiltonian, q: Vector, p: Vector, tau: Vector) -> Scalar:
    """Power qd·tau that the generalised force supplies, in W."""
    return jnp.dot(velocity(H, q, p), tau)


def energy_rate(H: Hamiltonian, q: Vector, p: Vector, tau: Vector, *, dissipation: Dissipation | None = None) -> Scalar:
    """dH/dt along the motion, in W: the supplied power less what friction takes."""
    return jax.jvp(H, (q, p), time_derivative(H, q, p, tau, dissipation=dissipation))[1]


def conjugate(
    energy: Energy, q: Vector, slope: Vector, *, iterations: int = 1, initial_guess: Guess | None = None
) -> Vector:
    """x [d] where d(energy)/dx (q, x) = slope: the momentum of a velocity (of H), or the reverse (of L).

    A fixed number of full Newton steps from `initial_guess(q, slope)`, by default from zero. One step is exact for an
    energy that is quadratic in x, as every natural system's is. Otherwise check what is left,
    `velocity(H, q, x) - slope`: no step is damped, and an energy that is not convex in x may have no solution.
    Derivatives are those of the implicit function, of every order; what `energy` closes over is differentiated too.

    Raises InputError if `iterations` is not positive.
    """
    require_positive(iterations=iterations)
    identity = jnp.eye(slope.shape[0], dtype=slope.dtype)

    def residual(x: Vector) -> Vector:
        return jax.grad(energy, argnums=1)(q, x) - slope

    def newton(residual, start: Vector) -> Vector:
        def step(x, _):
            value, hessian_product = jax.linearize(residual, x)
            return x - solve(jax.vmap(hessian_product)(identity), value), None

        return jax.lax.scan(step, start, length=iterations)[0]

    def solve_hessian(hessian_product, right: Vector) -> Vector:
        return solve(jax.vmap(hessian_product)(identity), right)

    start = jnp.zeros_like(slope) if initial_guess is None else initial_guess(q, slope)
    return jax.lax.custom_root(residual, start, newton, solve_hessian)


def legendre(energy: Energy, *, iterations: int = 1, initial_guess: Guess | None = None) -> Energy:
    """H(q, p) = p·qd - L(q, qd) of a Lagrangian, and L(q, qd) of a Hamiltonian: the transform is its own inverse.

    Keywords as for `conjugate`; `initial_guess` is not differentiated, and must not close over what is.
    """
    require_positive(iterations=iterations)

    def transform(q: Vector, slope: Vector) -> Scalar:
        # What the energy closes over becomes arguments, which a function with its own derivative rule needs.
        function, closed_over = jax.closure_convert(energy, q, slope)
        return _legendre(function, iterations, initial_guess, q, slope, *closed_over)

    return transform


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _legendre(function, iterations, initial_guess, q, slope, *closed_over):
    x = _conjugate(function, iterations, initial_guess, q, slope, *closed_over)
    return jnp.dot(x, slope) - function(q, x, *closed_over)


@_legendre.defjvp
def _legendre_jvp(function, iterations, initial_guess, primals, tangents):
    """The envelope theorem: dx drops out of the first derivative, which leaves no solve to differentiate."""
    q, slope, *closed_over = primals
    q_dot, slope_dot, *closed_over_dot = tangents
    x = _conjugate(function, iterations, initial_guess, *primals)
    value, rate = jax.jvp(lambda q, *rest: function(q, x, *rest), (q, *closed_over), (q_dot, *closed_over_dot))
    return jnp.dot(x, slope) - value, jnp.dot(x, slope_dot) - rate


def _conjugate(function, iterations, initial_guess, q, slope, *closed_over):
    return conjugate(
        lambda q, x: function(q, x, *closed_over), q, slope, iterations=iterations, initial_guess=initial_guess
    )


hamiltonian_from_lagrangian = legendre
"""L(q, qd) -> H(q, p), solving dL/dqd = p for qd."""
lagrangian_from_hamiltonian = legendre
"""H(q, p) -> L(q, qd), solving dH/dp = qd for p."""


def dynamics(
    H: Hamiltonian,
    *,
    dissipation: Dissipation | None = None,
    iterations: int = 1,
    initial_guess: Guess | None = None,
) -> Dynamics:
    """All functions of the system at once, of (q, qd); `iterations` and `initial_guess` as for `conjugate`."""
    require_positive(iterations=iterations)

    def momentum(q: Vector, qd: Vector) -> Vector:
        return conjugate(H, q, qd, iterations=iterations, initial_guess=initial_guess)

    def inverse_mass(q: Vector, p: Vector):
        return jax.jacfwd(lambda momentum: velocity(H, q, momentum))(p)

    def frictionless(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        p = momentum(q, qd)
        _, drift = jax.jvp(lambda position: velocity(H, position, p), (q,), (qd,))
        return inverse(H, q, p, solve(inverse_mass(q, p), qdd - drift))

    def with_friction(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        tau = frictionless(q, qd, qdd)
        return tau if dissipation is None else tau + friction_force(dissipation, q, qd)

    def accelerate(q: Vector, qd: Vector, tau: Vector) -> Vector:
        p = momentum(q, qd)
        _, pd = time_derivative(H, q, p, tau, dissipation=dissipation)
        return jax.jvp(lambda *state: velocity(H, *state), (q, p), (qd, pd))[1]

    return Dynamics(
        inverse_dynamics=with_friction,
        forward_dynamics=accelerate,
        energy=lambda q, qd: H(q, momentum(q, qd)),
        mass_matrix=lambda q, qd: solve(inverse_mass(q, momentum(q, qd)), jnp.eye(q.shape[0], dtype=q.dtype)),
        decompose=lambda q, qd, qdd: decompose_by_differences(frictionless, q, qd, qdd),
        hamiltonian=H,
        friction=dissipation and functools.partial(friction_force, dissipation),
    )
