"""Activations against high-precision arithmetic, in both precisions."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from calls import one_line

from dln_jax.nn import activations

DIGITS = 330  # enough for a derivative by differences to be exact down to the smallest float64
MAGNITUDES = (0.0, float(np.float32(1e-12)), 0.25, 1.0, 2.75, 7.5, 30.0, 100.0, 1e4)  # exact in float32
POINTS = [sign * magnitude for magnitude in MAGNITUDES for sign in (1, -1)]

DEFINITIONS = {
    "softplus": lambda x: mpmath.log(1 + mpmath.exp(x)),
    "tanh": mpmath.tanh,
    "cos": mpmath.cos,
    "sin": mpmath.sin,
    "silu": lambda x: x / (1 + mpmath.exp(-x)),
    "linear": lambda x: x,
    "quadratic": lambda x: x**2,
    "cubic": lambda x: x**3,
}
# Unavoidable error: the number that the caller means is only known to half a rounding, and the tails of erfc and the
# roots of the derivatives of silu and gelu magnify it by x f'(x) / f(x).
CONDITIONED = {"silu", "gelu"}


def gelu_derivatives(x):
    """By hand: mpmath's erfc of 10,000 / sqrt 2 takes seconds at the precision that differences need."""
    density, distribution = mpmath.npdf(x), mpmath.erfc(-x / mpmath.sqrt(2)) / 2
    return [
        x * distribution,
        distribution + x * density,
        density * (2 - x**2),
        density * (x**3 - 4 * x),
        density * (-(x**4) + 7 * x**2 - 4),
    ]


def relu_derivatives(x):
    return [max(x, 0), int(x > 0), 0, 0, 0]


def reference_derivatives(name: str, x: float) -> list:
    """g and its first four derivatives."""
    if name == "relu":
        return relu_derivatives(x)
    if name == "gelu":
        with mpmath.workdps(50):
            return gelu_derivatives(mpmath.mpf(x))
    with mpmath.workdps(DIGITS):
        return list(mpmath.diffs(DEFINITIONS[name], mpmath.mpf(x), 4))


@pytest.mark.parametrize("name", activations.ALL)
@pytest.mark.as_users_compile
def test_derivatives_equal_high_precision(name):
    """|error| <= 4 eps |f|, plus eps |x f'| where the function is ill-conditioned, at 0, ±1e-12 ... ±1e4; orders
    0 to 2 are the formulas, 3 is autodiff of `second`."""
    activation, table = activations.ALL[name], [reference_derivatives(name, x) for x in POINTS]
    third = jax.vmap(jax.grad(activation.second))

    @jax.jit  # as users compile it, because the accuracy of exp and tanh is the compiler's
    def orders(x):
        return activation.value(x), activation.first(x), activation.second(x), third(x)

    for dtype in (np.float32, np.float64):
        x = jnp.asarray(POINTS, dtype)
        epsilon, smallest = float(jnp.finfo(dtype).eps), float(jnp.finfo(dtype).tiny)
        for order, result in enumerate(jax.device_get(orders(x))):
            assert result.dtype == dtype and result.shape == x.shape
            for point, got, exact in zip(POINTS, result, table, strict=True):
                bound = 4 * epsilon * abs(exact[order])
                if name in CONDITIONED:
                    bound += epsilon * abs(point * exact[order + 1])
                # XLA on CPU flushes subnormal numbers to 0, also inside a formula: a few times the smallest normal one.
                bound += 4 * smallest
                assert abs(mpmath.mpf(float(got)) - exact[order]) <= bound, (dtype, order, point, got)


def test_autodiff_uses_the_formulas():
    @jax.jit
    @jax.vmap
    def both(x):
        once = [jax.grad(g.value) for g in activations.ALL.values()]
        by_autodiff = [(first(x), jax.jacfwd(first)(x)) for first in once]
        return jnp.array(by_autodiff), jnp.array([(g.first(x), g.second(x)) for g in activations.ALL.values()])

    np.testing.assert_array_equal(*both(jnp.asarray(POINTS, jnp.float32)))


def test_an_unknown_name_lists_the_known():
    with one_line(r"'swoosh'.*relu, softplus, tanh.*cubic"):
        activations.activation("swoosh")
