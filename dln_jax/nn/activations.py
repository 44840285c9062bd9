"""Activations g with explicit formulas for the derivatives g' and g''.

Differentiating a formula for g twice loses digits: tanh'' near 0 and every derivative in saturation are differences
of nearly equal numbers. The formulas here keep relative accuracy in float32 and float64 from 1e-12 to 1e4: no
difference of nearly equal numbers, no intermediate overflow, no NaN in a branch that is not taken. A derivative below
the smallest normal number is 0.

Plain autodiff uses the same formulas: `value` differentiates to `first`, `first` to `second`, and `second` to another
formula, so a loss on Hessians can be trained. All functions are elementwise, keep shape and dtype, and work under jit,
vmap, and forward and reverse differentiation.
"""

import math
import reprlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.types import InputError

Elementwise = Callable[[Array], Array]
"""x [...] -> [...]."""


class Activation(NamedTuple):
    """g, g' and g'' of one activation; hashable, so that it can be a static argument."""

    name: str
    value: Elementwise
    """g(x)."""
    first: Elementwise
    """g'(x)."""
    second: Elementwise
    """g''(x)."""


def _differentiates_to(function: Elementwise, derivative: Elementwise) -> Elementwise:
    """Returns `function` with the formula `derivative` for autodiff."""
    wrapped = jax.custom_jvp(function)
    wrapped.defjvp(lambda primals, tangents: (wrapped(*primals), derivative(*primals) * tangents[0]))
    return wrapped


def _make(name: str, value: Elementwise, first: Elementwise, second: Elementwise, third: Elementwise) -> Activation:
    second = _differentiates_to(second, third)
    first = _differentiates_to(first, second)
    return Activation(name, _differentiates_to(value, first), first, second)


# The logistic function s(x) = 1 / (1 + e^-x), computed from e^-|x|, which never overflows and is small in both tails.


def _logistic(x: Array) -> Array:
    decay = jnp.exp(-jnp.abs(x))
    return jnp.where(x >= 0, 1.0, decay) / (1 + decay)


def _logistic_slope(x: Array) -> Array:
    """s'(x) = s(x) s(-x), a product of tails instead of s - s²."""
    decay = jnp.exp(-jnp.abs(x))
    return decay / ((1 + decay) * (1 + decay))


def _silu_third(x: Array) -> Array:
    slope, half = _logistic_slope(x), jnp.tanh(x / 2)
    return -slope * (half * (3 - x * half) + 2 * x * slope)


def _tanh_first(x: Array) -> Array:
    """sech²(x) = 4 s'(2x): 1 - tanh² would be 0 in saturation."""
    return 4 * _logistic_slope(2 * x)


def _tanh_third(x: Array) -> Array:
    tangent, slope = jnp.tanh(x), _tanh_first(x)
    return slope * (4 * tangent * tangent - 2 * slope)


# GELU, exact: x P(x), with P and p the distribution and density of the standard normal.


def _normal_density(x: Array) -> Array:
    return jnp.exp(-x * x / 2) * (1 / math.sqrt(2 * math.pi))


def _normal_distribution(x: Array) -> Array:
    """Uses erfc, because 1 + erf loses the lower tail."""
    return jax.lax.erfc(x * -math.sqrt(0.5)) / 2


def _step(x: Array) -> Array:
    """Derivative of relu, with 0 at the kink."""
    return jnp.where(x > 0, jnp.ones_like(x), jnp.zeros_like(x))


relu = _make("relu", lambda x: jnp.maximum(x, 0), _step, jnp.zeros_like, jnp.zeros_like)
"""max(x, 0). Its second derivative is 0 wherever it exists, and defined as 0 at the kink."""
softplus = _make(
    "softplus",
    lambda x: jnp.maximum(x, 0) + jnp.log1p(jnp.exp(-jnp.abs(x))),
    _logistic,
    _logistic_slope,
    lambda x: -_logistic_slope(x) * jnp.tanh(x / 2),
)
"""log(1 + e^x)."""
tanh = _make("tanh", jnp.tanh, _tanh_first, lambda x: -2 * jnp.tanh(x) * _tanh_first(x), _tanh_third)
cos = _make("cos", jnp.cos, lambda x: -jnp.sin(x), lambda x: -jnp.cos(x), jnp.sin)
sin = _make("sin", jnp.sin, jnp.cos, lambda x: -jnp.sin(x), lambda x: -jnp.cos(x))
silu = _make(
    "silu",
    lambda x: x * _logistic(x),
    lambda x: _logistic(x) * (1 + x * _logistic(-x)),
    lambda x: _logistic_slope(x) * (2 - x * jnp.tanh(x / 2)),
    _silu_third,
)
"""x / (1 + e^-x), also called swish."""
gelu = _make(
    "gelu",
    lambda x: x * _normal_distribution(x),
    lambda x: _normal_distribution(x) + x * _normal_density(x),
    lambda x: _normal_density(x) * (2 - x * x),
    lambda x: x * (_normal_density(x) * (x * x - 4)),
)
"""x P(X <= x) for a standard normal X, by erf rather than its tanh approximation."""
linear = _make("linear", lambda x: x, jnp.ones_like, jnp.zeros_like, jnp.zeros_like)
quadratic = _make("quadratic", lambda x: x * x, lambda x: 2 * x, lambda x: jnp.full_like(x, 2), jnp.zeros_like)
cubic = _make("cubic", lambda x: x * x * x, lambda x: 3 * x * x, lambda x: 6 * x, lambda x: jnp.full_like(x, 6))

ALL: dict[str, Activation] = {g.name: g for g in (relu, softplus, tanh, cos, sin, silu, gelu, linear, quadratic, cubic)}


def activation(name: str | Activation) -> Activation:
    """Returns the activation with this name, or the given activation; `InputError` for an unknown name."""
    if isinstance(name, Activation):
        return name
    if not isinstance(name, str) or name not in ALL:
        raise InputError(f"activation is {reprlib.repr(name)}; choose one of {', '.join(ALL)}")
    return ALL[name]
