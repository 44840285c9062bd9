"""Derivatives of a function from a vector x [n] to a vector y [m], as programs that are short in C.

The C loops over the directions of derivatives. Unrolled, it would be at most a third faster at two and four degrees of
freedom, but the Hessian of forward dynamics would compile in 18 s instead of 2 s at four, and exceed the stack at
seven, with seven times as much.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

Function = Callable[[Array], Array]


def forward(function: Function, x: Array) -> Array:
    """Returns the transposed Jacobian [n, m], one input at a time."""
    return jax.lax.map(lambda k: push(function, x, _unit(k, x)), jnp.arange(x.size))


def reverse(function: Function, x: Array) -> Array:
    """Returns the transposed Jacobian [n, m], one output at a time."""
    value, pulled = jax.vjp(function, x)
    return jax.lax.map(lambda k: pulled(_unit(k, value))[0], jnp.arange(value.size)).T


def _unit(k: Array, like: Array) -> Array:
    # A comparison, because rows of an identity matrix would be kept in an array.
    return (jnp.arange(like.size) == k).astype(like.dtype)


def push(function: Function, x: Array, seeds: Array) -> Array:
    """Returns (dy/dx) seeds [m]."""
    return jax.jvp(function, (x,), (seeds,))[1]


def pull(function: Function, x: Array, seeds: Array) -> Array:
    """Returns (dy/dx)ᵀ seeds [n] in reverse mode."""
    return jax.vjp(function, x)[1](seeds)[0]


def pull_forward(function: Function, x: Array, seeds: Array) -> Array:
    """Returns (dy/dx)ᵀ seeds [n] in forward mode, which also differentiates loops of unknown length."""
    return forward(function, x) @ seeds


def second(function: Function, x: Array, seeds: Array, pull: Callable[..., Array]) -> tuple[Array, Array]:
    """Returns the Hessian [n, n] of seeds . y with respect to x, and the transposed Jacobian [n, m]."""
    both = forward(lambda x: jnp.concatenate([pull(function, x, seeds), function(x)]), x)
    return both[:, : x.size], both[:, x.size :]
