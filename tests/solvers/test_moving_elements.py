"""Minima of sums with elements that move: Newton's method with their true Hessians."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.moving import Elements, MovingEnergy


def well(curvature):
    """Energy -½ c x² + x⁴/40 - x/20 of the first unknown, one element of the first block."""

    def gradient(x, _):
        along = x[0, 0]
        value = -0.5 * curvature * along**2 + 0.025 * along**4 - 0.05 * along
        return value, jnp.zeros_like(x).at[0, 0].set(-curvature * along + 0.1 * along**3 - 0.05)

    return MovingEnergy(
        elements=lambda x, step, data: Elements(jnp.zeros((1, 1), int), (), jnp.asarray(False)),
        describe=lambda x, elements, data: jnp.zeros(1),
        gradient=gradient,
        hessian=lambda x, _: jnp.zeros((2, 2)).at[0, 0].set(0.3 * x[0, 0] ** 2 - curvature),
        longest=lambda x, step, elements, data: jnp.ones((), x.dtype),
    )


@pytest.mark.parametrize("curvature", [0.5, 0.9, 0.99])
def test_elements_of_negative_curvature_take_few_iterations(curvature):
    """With Hessians that are always projected, the error would fall by the ratio of both curvatures in a step."""
    x, info = minimise(
        lambda x, _: 0.5 * jnp.sum(x**2), jnp.full((2, 2), 0.1), moving=[well(curvature)], moving_data=[None]
    )
    assert info.converged and int(info.iterations) <= 9
    # 0.1 x³ + (1 - c) x = 0.05
    (root,) = (root.real for root in np.roots([0.1, 0, 1 - curvature, -0.05]) if abs(root.imag) < 1e-9)
    assert float(x[0, 0]) == pytest.approx(root, abs=1e-8)
    assert float(jnp.abs(x[1]).max()) < 1e-8
