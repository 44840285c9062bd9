"""Integrators whose time step is the minimum of an incremental potential.

    x = argmin  1/2 sum m |x - y|² / h² + V(x)

| integrator | h | y | after the minimum x |
|---|---|---|---|
| backward-euler | dt | x_n + dt v_n | v_{n+1} = (x - x_n) / dt |
| bdf2 | 2/3 dt | (4 x_n - x_{n-1} + h (4 v_n - v_{n-1})) / 3 | v_{n+1} = (3 x - 4 x_n + x_{n-1}) / (2 dt) |
| midpoint | dt/2 | x_n + h v_n | x is half way: x_{n+1} = 2 x - x_n, v_{n+1} = 2 (x - x_n) / h - v_n |
| average-vector-field | dt/sqrt(2) | x_n + dt v_n | v_{n+1} = 2 (x - x_n) / dt - v_n |

Backward Euler is of first order and damps; bdf2 is of second order and damps little. The midpoint rule is of second
order and keeps momentum and angular momentum, but not energy: use it for smooth motions. The average-vector-field method
is of second order and keeps momentum and energy (Quispel and McLaren 2008), and angular momentum to second order. Its
force is the average along the step,

    F = -∫ grad V(x_n + s (x - x_n)) ds over 0 <= s <= 1,    so that    F·(x - x_n) = V(x_n) - V(x),

and V is replaced by W(x) = ∫ V(x_n + s (x - x_n)) / s ds, whose gradient is -F. Gauss-Legendre quadrature with as many
points as the body has dimensions is exact for the polynomials `stable_neo_hookean` and `st_venant_kirchhoff`, for
springs without rest length, for gravity, and for linear damping.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.scene import Previous, State
from dln_jax.solvers.elements.energies import Corners, ElementEnergy, local
from dln_jax.types import InputError


class Integrator(NamedTuple):
    """An integrator: one line of the table."""

    span: float
    """Time from the state to the minimum, in units of dt."""
    target: Callable[[State, Any], tuple[Any, Array]]
    """(state, dt) -> h, y."""
    finish: Callable[[State, Array, Any], tuple[Array, Array]]
    """(state, x of the minimum, dt) -> x_{n+1}, v_{n+1}."""
    two_steps: bool = False
    """Whether it needs the previous state."""
    averaged: bool = False
    """Whether forces are averages along the step, instead of those at x."""


def _previous(state: State) -> Previous:
    if state.previous is None:
        raise InputError("the state has no room for the state before; make it by the `init` beside this step")
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
"""Integrators by the names in command lines and tables."""


def averaged(element: ElementEnergy, points: int) -> ElementEnergy:
    """Returns the element energy W, by Gauss-Legendre quadrature; its data are those of `averaged_data`."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    quadrature = list(zip(((1 + nodes) / 2).tolist(), (weights / 2).tolist(), strict=True))

    def energy(x: Corners, start_and_data: tuple[Any, Any]) -> Float[Array, ""]:
        start, data = start_and_data

        def between(s: float) -> list[list[Array]]:
            return [[(1 - s) * a + s * b for a, b in zip(*pair, strict=True)] for pair in zip(start, x, strict=True)]

        values = [
            w / s * element.energy(between(s), data) for s, w in zip(nodes.tolist(), weights.tolist(), strict=True)
        ]
        return sum(values[1:], values[0])

    return element._replace(energy=energy)


def averaged_data(element: ElementEnergy, start: Float[Array, "n dim"], data: Any) -> tuple[Any, Any]:
    """Returns the data of `averaged`: the elements' positions at the start of the step, and their own data."""
    return local(element, start), data
