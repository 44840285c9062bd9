"""Derivatives of a function from a vector x [n] to a vector y [m], as programs that are short in C.

Directions are turns of a loop. A program for all of them at once is at most a third faster at two and four degrees of
freedom, but the Hessian of forward dynamics takes 18 s in place of 2 to compile at four, and seven times the stack at
seven, which is more than it may.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

Function = Callable[[Array], Array]


def forward(function: Function, x: Array) -> Array:
    """Transposed Jacobian [n, m] along each input."""
    return jax.lax.map(lambda k: push(function, x, _unit(k, x)), jnp.arange(x.size))


def reverse(function: Function, x: Array) -> Array:
    """Transposed Jacobian [n, m] from each output."""
    value, pulled = jax.vjp(function, x)
    return jax.lax.map(lambda k: pulled(_unit(k, value))[0], jnp.arange(value.size)).T


def _unit(k: Array, like: Array) -> Array:
    # Compared and not read from a matrix, of which it is not known what a turn leaves unread.
    return (jnp.arange(like.size) == k).astype(like.dtype)


def push(function: Function, x: Array, seeds: Array) -> Array:
    """(dy/dx) seeds [m]."""
    return jax.jvp(function, (x,), (seeds,))[1]


def pull(function: Function, x: Array, seeds: Array) -> Array:
    """(dy/dx)ᵀ seeds [n], in reverse mode."""
    return jax.vjp(function, x)[1](seeds)[0]


def pull_forward(function: Function, x: Array, seeds: Array) -> Array:
    """The same in forward mode, which loops of unknown length have too."""
    return forward(function, x) @ seeds


def second(function: Function, x: Array, seeds: Array, pull: Callable[..., Array]) -> tuple[Array, Array]:
    """Derivatives of the pulled seeds: Hessian [n, n] of seeds . y by x, and the transposed Jacobian by the seeds."""
    both = forward(lambda x: jnp.concatenate([pull(function, x, seeds), function(x)]), x)
    return both[:, : x.size], both[:, x.size :]
