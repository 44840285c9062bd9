"""Networks for the cost to go that are zero at the goal and positive elsewhere, with gradients in the same pass.

    V(x) = (z - z0)ᵀ L(z) L(z)ᵀ (z - z0)

L is lower triangular with a positive diagonal; its entries are the outputs of a differential network of z - z0
(Lutter et al. 2021, arXiv:2105.04682). z holds the sines and cosines of angles and the other states in units of the
box. Without hidden layers L is constant and V a quadratic form, which solves a linear-quadratic problem exactly.
The parameters have a leading axis of ensemble members; V and V_x are the means over it. `fitted` and
`residual` fit them.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.problem import ControlProblem, features
from dln_jax.errors import require_network
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import Activation, softplus, tanh
from dln_jax.types import InputError, require_positive


class ValueNetwork(NamedTuple):
    """A family of value functions, for one state."""

    init: Callable[[Array], Any]
    """Key -> parameters, with a leading axis of members."""
    value_and_gradient: Callable[[Any, Array], tuple[Array, Array]]
    """(parameters, x [n]) -> V and V_x [n], means over the members."""
    members: Callable[[Any, Array], tuple[Array, Array]]
    """(parameters, x [n]) -> V [K] and V_x [K, n] of the members."""


class ValueProgress(NamedTuple):
    """Progress of a fit after an iteration, or after a draw of samples."""

    step: int
    loss: float
    validation: float
    """Score that selects the parameters."""
    seconds: float
    """Time since the start."""
    discount: float
    """Discount of the equation that is fitted, 1/s."""


class ValueFit(NamedTuple):
    """Result of a fit."""

    parameters: Any
    """Parameters with the lowest validation."""
    validation: float
    history: list[ValueProgress]
    train_seconds: float
    compile_seconds: float = 0.0
    """Time of compilation that is not counted in `train_seconds`."""


def value_network(
    problem: ControlProblem,
    *,
    widths: Sequence[int] = (32, 32),
    members: int = 1,
    activation: Activation = tanh,
    floor: float = 1e-3,
    scale: float = 1.0,
) -> ValueNetwork:
    """Returns a family of value functions for a problem.

    Args:
        problem: its box, joints and goal define z.
        widths: widths of the hidden layers; none for a constant L.
        members: K of the ensemble.
        activation: between layers.
        floor: lower bound on the diagonal of L; 0 leaves the form semi-definite.
        scale: factor on V, for example the expected cost at the edge of the box.

    Raises:
        InputError: a size is out of range.
    """
    require_positive(members=members, scale=scale)
    for width in widths:
        require_network(width=width, depth=len(widths))
    if not floor >= 0:
        raise InputError(f"floor is {floor}; expected 0 or more")
    size = int(jax.eval_shape(lambda x: features(problem, x), jnp.asarray(problem.goal, float)).shape[0])
    rows, columns = np.tril_indices(size)
    diagonal = rows == columns

    def init(key: Array) -> Any:
        layers = differential_mlp.init_ensemble(key, (size, *widths, len(rows)), members=members)
        # Without hidden layers, L is the bias of the output layer.
        return layers if widths else layers[-1][1]

    def one(layers: Any, x: Array) -> tuple[Array, Array]:
        z, back_to_x = jax.vjp(lambda x: features(problem, x), x)
        if widths:
            entries, back_to_z = differential_mlp.value_and_pull_back(layers, z, activation=activation)
        else:
            entries, back_to_z = layers, lambda _: jnp.zeros_like(z)
        lower = jnp.where(diagonal, softplus.value(entries) + floor, entries)
        L = jnp.zeros((size, size), z.dtype).at[rows, columns].set(lower)
        y = L.T @ z
        # dV/dL = 2 z yᵀ; the network outputs the lower triangle.
        slopes = 2 * (z[rows] * y[columns]) * jnp.where(diagonal, softplus.first(entries), 1.0)
        (slope,) = back_to_x(2 * L @ y + back_to_z(slopes))
        return scale * (y @ y), scale * slope

    def every(layers: Any, x: Array) -> tuple[Float[Array, " K"], Float[Array, "K n"]]:
        return jax.vmap(one, in_axes=(0, None))(layers, x)

    def mean(layers: Any, x: Array) -> tuple[Float[Array, ""], Float[Array, " n"]]:
        values, slopes = every(layers, x)
        return jnp.mean(values), jnp.mean(slopes, axis=0)

    return ValueNetwork(init, mean, every)
