"""Integrators with time steps that minimise an incremental potential.

    x = argmin  1/2 sum m |x - y|² / h² + V(x)

| integrator | h | y | after the minimum x |
|---|---|---|---|
| backward-euler | dt | x_n + dt v_n | v_{n+1} = (x - x_n) / dt |
| bdf2 | 2/3 dt | (4 x_n - x_{n-1} + h (4 v_n - v_{n-1})) / 3 | v_{n+1} = (3 x - 4 x_n + x_{n-1}) / (2 dt) |
| midpoint | dt/2 | x_n + h v_n | x is at mid-step: x_{n+1} = 2 x - x_n, v_{n+1} = 2 (x - x_n) / h - v_n |
| average-vector-field | dt/sqrt(2) | x_n + dt v_n | v_{n+1} = 2 (x - x_n) / dt - v_n |

Backward Euler has order 1 and damps; bdf2 has order 2 and damps little. The midpoint rule has order 2 and conserves
momentum and angular momentum, but not energy: use it for smooth motions. The average-vector-field method (Quispel and
McLaren 2008) has order 2 and conserves momentum and energy, but not angular momentum. Its force is

    F = -∫ grad V(x_n + s (x - x_n)) ds over 0 <= s <= 1,    so that    F·(x - x_n) = V(x_n) - V(x),

and W(x) = ∫ V(x_n + s (x - x_n)) / s ds with the gradient -F replaces V. Gauss-Legendre quadrature with 2 points in the
plane and 3 in space is exact for the polynomials `stable_neo_hookean` and `st_venant_kirchhoff`; with `CONTACT_POINTS`
it is nearly exact for contact, friction and springs. Barriers of obstacles are averaged. Barriers between bodies are
not, because they would need all pairs that are near somewhere between x_n and x.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.scene import Previous, State
from dln_jax.solvers.elements.energies import Blocks, Corners, ElementEnergy, of_corners
from dln_jax.solvers.elements.moving import Elements, MovingEnergy
from dln_jax.types import InputError


class Integrator(NamedTuple):
    """An integrator: one row of the table."""

    span: float
    """Time from the state to the minimum, in units of dt."""
    target: Callable[[State, Any], tuple[Any, Array]]
    """(state, dt) -> h, y."""
    finish: Callable[[State, Array, Any], tuple[Array, Array]]
    """(state, x of the minimum, dt) -> x_{n+1}, v_{n+1}."""
    two_steps: bool = False
    """True if it needs the previous state."""
    averaged: bool = False
    """True if forces are averages along the step instead of values at x."""


CONTACT_POINTS = 8
"""Quadrature points of elements with fewer vertices than a simplex (contact, springs); they are cheap and have kinks.
In the example scenes a step creates up to 2 % of the current energy with 4 points, 0.2 % with 8 and 0.01 % with 16."""


def _previous(state: State) -> Previous:
    if state.previous is None:
        raise InputError("the state has no previous state; create it with the `init` of this step")
    return state.previous


def _bdf2_target(state: State, dt: Any) -> tuple[Array, Array]:
    x, v, previous = state.x, state.v, _previous(state)
    h = jnp.where(previous.known, 2 / 3 * dt, dt).astype(x.dtype)
    y = (4 * x - previous.x + h * (4 * v - previous.v)) / 3
    return h, jnp.where(previous.known, y, x + dt * v)


def _bdf2_finish(state: State, x: Array, dt: Any) -> tuple[Array, Array]:
    previous = _previous(state)
    v = (3 * x - 4 * state.x + previous.x) / (2 * dt)
    return x, jnp.where(previous.known, v, (x - state.x) / dt)


BACKWARD_EULER = Integrator(
    span=1.0,
    target=lambda state, dt: (dt, state.x + dt * state.v),
    finish=lambda state, x, dt: (x, (x - state.x) / dt),
)
BDF2 = Integrator(span=1.0, target=_bdf2_target, finish=_bdf2_finish, two_steps=True)
MIDPOINT = Integrator(
    span=0.5,
    target=lambda state, dt: (dt / 2, state.x + dt / 2 * state.v),
    finish=lambda state, x, dt: (2 * x - state.x, 4 / dt * (x - state.x) - state.v),
)
AVERAGE_VECTOR_FIELD = Integrator(
    span=1.0,
    target=lambda state, dt: (dt / np.sqrt(2), state.x + dt * state.v),
    finish=lambda state, x, dt: (x, 2 / dt * (x - state.x) - state.v),
    averaged=True,
)
INTEGRATORS = {
    "backward-euler": BACKWARD_EULER,
    "bdf2": BDF2,
    "midpoint": MIDPOINT,
    "average-vector-field": AVERAGE_VECTOR_FIELD,
}
"""Integrators by their names in command lines and tables."""


def averaged(element: ElementEnergy, dimension: int) -> ElementEnergy:
    """Returns the element energy W of a body in 2 or 3 dimensions.

    Its data are the elements' positions at the start of the step, and their own data.
    """
    solid = element.indices.shape[1] > dimension
    nodes, weights = np.polynomial.legendre.leggauss(dimension if solid else CONTACT_POINTS)
    nodes, weights = (1 + nodes) / 2, weights / 2

    of_one = of_corners(element)

    def energy(x: Corners, start_and_data: tuple[Any, Any]) -> Float[Array, ""]:
        start, data = start_and_data

        def at(s: Any) -> Array:
            between = [[(1 - s) * a + s * b for a, b in zip(*pair, strict=True)] for pair in zip(start, x, strict=True)]
            return of_one(between, data)

        if solid:
            # Unrolled, so that the few points fuse with the arithmetic of the element.
            return jnp.asarray(sum(w / s * at(s) for s, w in zip(nodes.tolist(), weights.tolist(), strict=True)))
        return jnp.sum(weights / nodes * jax.vmap(at)(jnp.asarray(nodes, x[0][0].dtype)))

    return element._replace(energy=energy, weights=None)


def averaged_moving(energy: MovingEnergy) -> MovingEnergy:
    """Returns the energy W of a fixed set of elements; its data are (start of the step, the energy's own data)."""
    nodes, weights = np.polynomial.legendre.leggauss(CONTACT_POINTS)
    nodes, weights = (1 + nodes) / 2, weights / 2

    def between(start: Blocks, x: Blocks) -> Float[Array, "points *shape"]:
        at = jnp.asarray(nodes, x.dtype).reshape(-1, *[1] * x.ndim)
        return start + at * (x - start)

    def describe(x: Blocks, elements: Elements, data: tuple[Blocks, Any]) -> tuple[Array, Any]:
        start, own = data
        described = jax.vmap(lambda x: energy.describe(x, elements, own), out_axes=1)(between(start, x))
        return start[elements.indices], described

    def gradient(x: Float[Array, "k b"], data: tuple[Array, Any]) -> tuple[Array, Array]:
        start, own = data
        values, slopes = jax.vmap(energy.gradient)(between(start, x), own)
        return jnp.sum(weights / nodes * values), jnp.tensordot(jnp.asarray(weights, x.dtype), slopes, axes=1)

    def hessian(x: Float[Array, "k b"], data: tuple[Array, Any]) -> Array:
        start, own = data
        return jnp.tensordot(jnp.asarray(weights * nodes, x.dtype), jax.vmap(energy.hessian)(between(start, x), own), 1)

    return MovingEnergy(
        elements=lambda x, step, data: energy.elements(x, step, data[1]),
        describe=describe,
        gradient=gradient,
        hessian=hessian,
        longest=lambda x, step, elements, data: energy.longest(x, step, elements, data[1]),
    )
