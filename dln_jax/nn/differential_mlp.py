"""A multilayer perceptron that returns its value, Jacobian and Hessian in one pass, by exact layer rules.

Parameters are a tuple of layers `(weight [in, out], bias [out])`. With h_0 = x and L hidden layers,

    a_l = h_(l-1) W_l + b_l,   h_l = g(a_l),   y = h_L W_(L+1) + b_(L+1),

and the derivatives with respect to x follow from g' and g'' of the activation:

- forward, J_l = da_l/dx: J_1 = W_1 and J_(l+1) = (g'(a_l) J_l) W_(l+1);
- backward, for one output y_k, the adjoint lambda_l = dy_k/dh_l: lambda_L = W_(L+1)[:, k] and
  lambda_(l-1) = W_l (g'(a_l) lambda_l), which ends as the gradient dy_k/dx;
- two sweeps give its Hessian, H_k = sum_l J_lᵀ diag(lambda_l g''(a_l)) J_l;
- or second derivatives go forward for all outputs at once, S_l = d²a_l/dx²: S_1 = 0 and
  S_(l+1) = (g''(a_l) J_l J_l + g'(a_l) S_l) W_(l+1), for the n (n + 1) / 2 different pairs of inputs.

A backward sweep costs one pass per output, a forward sweep one per input or pair of inputs. `cheaper_jacobian` and
`cheaper_hessian` count floating point operations, and the shapes decide before anything is compiled.

One state, no batch axis: `jax.vmap` over x. The layers of an ensemble have a leading axis of members. The code stores J
as [n, width], so a batch of Jacobians and a weight form one matrix product.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.nn.initializers import Initializer, glorot_uniform, zeros
from jaxtyping import Float, PRNGKeyArray

from dln_jax.nn.activations import Activation
from dln_jax.types import InputError

Layers = tuple[tuple[Array, Array], ...]
"""(weight [in, out], bias [out]) of the layers, hidden ones first and the linear output layer last."""
Sweep = Literal["backward", "forward"]

GLOROT: Initializer = glorot_uniform()


def init(
    key: PRNGKeyArray | Array,
    sizes: Sequence[int],
    *,
    weight: Initializer = GLOROT,
    bias: Initializer = zeros,
    dtype: jax.typing.DTypeLike = float,
) -> Layers:
    """Returns random parameters of a network with `sizes` (n, width, ..., m).

    `weight` and `bias` are schemes (key, shape, dtype) -> array, as in `jax.nn.initializers`: Glorot's uniform scheme
    (Glorot and Bengio 2010) and zeros by default. `dtype` defaults to JAX's default float.

    Raises InputError if `sizes` are not at least two positive numbers.
    """
    shapes = layer_shapes(sizes)
    keys = jax.random.split(key, (len(shapes), 2))
    return tuple(
        (weight(ours[0], shape, dtype), bias(ours[1], shape[1:], dtype))
        for shape, ours in zip(shapes, keys, strict=True)
    )


def init_ensemble(key: PRNGKeyArray | Array, sizes: Sequence[int], *, members: int, **schemes: Any) -> Layers:
    """Applies `init` to one key per member: weights [members, in, out], biases [members, out]."""
    return jax.vmap(partial(init, sizes=sizes, **schemes))(jax.random.split(key, members))


def layer_shapes(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """(in, out) of the weights of a network with `sizes` (n, width, ..., m); raises InputError for invalid sizes."""
    if len(sizes) < 2 or min(sizes) < 1:
        raise InputError(f"sizes are {tuple(sizes)}; expected (inputs, hidden widths ..., outputs), all positive")
    return list(pairwise(sizes))


def value(layers: Layers, x: Array, *, activation: Activation) -> Float[Array, "m"]:
    """Returns y [m] at x [n]. Raises InputError if x or the layers have the wrong shape."""
    return _forward(layers, x, activation)[2]


def value_and_jacobian(
    layers: Layers, x: Array, *, activation: Activation
) -> tuple[Float[Array, "m"], Float[Array, "m n"]]:
    """Returns y [m] and dy/dx [m, n] at x [n]. Raises InputError if x or the layers have the wrong shape."""
    sizes, preactivations, y = _forward(layers, x, activation)
    if cheaper_jacobian(sizes) == "backward":
        jacobian = _each_output(lambda adjoint: _gradient(layers, preactivations, adjoint, activation), layers[-1][0])
    else:
        jacobian = _input_jacobians(layers, preactivations, activation)[-1].T
    return y, jacobian


def value_and_pull_back(
    layers: Layers, x: Array, *, activation: Activation
) -> tuple[Float[Array, "m"], Callable[[Array], Float[Array, "n"]]]:
    """Returns y [m] at x [n], and w [m] -> (dy/dx)ᵀ w [n] by one backward sweep. Raises InputError as `value`."""
    _, preactivations, y = _forward(layers, x, activation)
    return y, lambda w: _gradient(layers, preactivations, layers[-1][0] @ w, activation)


def value_jacobian_and_hessian(
    layers: Layers, x: Array, *, activation: Activation
) -> tuple[Float[Array, "m"], Float[Array, "m n"], Float[Array, "m n n"]]:
    """Returns y [m], dy/dx [m, n] and d²y/dx² [m, n, n] at x [n]. Raises InputError if a shape is wrong."""
    sizes, preactivations, y = _forward(layers, x, activation)
    backward = cheaper_hessian(sizes) == "backward"
    derivatives = _derivatives_by_two_sweeps if backward else _derivatives_by_forward_sweep
    return y, *derivatives(layers, preactivations, activation)


def mean_and_spread(network: Callable[[Layers, Array], Any], layers: Layers, x: Array) -> tuple[Any, Any]:
    """Returns mean and spread over K members of all outputs of `network(layers, x)` at x [n].

    The spread is the sample standard deviation (the sum of squares over K - 1).

    `network` is a function of one member, for instance
    `partial(value_jacobian_and_hessian, activation=tanh)` for the statistics of value, Jacobian and
    Hessian. The arrays of `layers` have a leading axis of members, as from `init_ensemble`.

    Raises InputError for fewer than two members.
    """
    members = layers[0][0].shape[0]
    if members < 2:
        raise InputError(f"the ensemble has {members} member; a spread needs at least 2")
    outputs = jax.vmap(network, in_axes=(0, None))(layers, x)
    mean, spread = partial(jnp.mean, axis=0), partial(jnp.std, axis=0, ddof=1)
    return jax.tree.map(mean, outputs), jax.tree.map(spread, outputs)


def cheaper_jacobian(sizes: Sequence[int]) -> Sweep:
    """Returns the sweep with fewer operations for the Jacobian of a network with `sizes` (n, width, ..., m)."""
    inputs, *widths, outputs = sizes
    if not widths:
        return "forward"
    between = sum(a * b for a, b in pairwise(widths))
    forward = inputs * (between + widths[-1] * outputs)
    backward = outputs * (between + widths[0] * inputs)
    return "backward" if backward <= forward else "forward"


def cheaper_hessian(sizes: Sequence[int]) -> Sweep:
    """Returns the sweep with fewer operations for Jacobian and Hessian, not counting J_l, which both need.

    It counts multiply-adds. A backward sweep takes, per output, the adjoint, and per layer n scaled columns and n²
    products of a width. A forward sweep takes, per pair of inputs, the weights after the first layer and three
    operations per hidden unit.
    """
    inputs, *widths, outputs = sizes
    if not widths:
        return "forward"
    pairs = inputs * (inputs + 1) // 2
    between = sum(a * b for a, b in pairwise(widths))
    backward = outputs * (between + widths[0] * inputs + sum(widths) * (inputs + inputs**2))
    forward = pairs * (between + widths[-1] * outputs + 3 * sum(widths)) + inputs * widths[-1] * outputs
    return "backward" if backward <= forward else "forward"


def _check(layers: Layers, x: Array) -> tuple[int, ...]:
    """Returns sizes (n, width, ..., m); InputError if the layers do not fit together or x is not one state [n]."""
    shapes = [(weight.shape, bias.shape) for weight, bias in layers]
    chained = bool(shapes) and all(len(weight) == 2 and bias == weight[1:] for weight, bias in shapes)
    if not chained or any(left[1] != right[0] for (left, _), (right, _) in pairwise(shapes)):
        raise InputError(
            f"layers have (weight, bias) shapes {shapes}; expected one network with weight [in, out] and bias [out], "
            "each in equal to the previous out. Use jax.vmap for an ensemble, as in mean_and_spread"
        )
    sizes = (shapes[0][0][0], *(weight[1] for weight, _ in shapes))
    if x.shape != sizes[:1]:
        raise InputError(f"x has shape {x.shape}; expected ({sizes[0]},), one state: use jax.vmap for a batch")
    return sizes


def _forward(layers: Layers, x: Array, activation: Activation) -> tuple[tuple[int, ...], list[Array], Array]:
    """Returns sizes, preactivations a_l of the hidden layers, and y."""
    sizes = _check(layers, x)
    preactivations, hidden = [], x
    for weight, bias in layers[:-1]:
        preactivations.append(hidden @ weight + bias)
        hidden = activation.value(preactivations[-1])
    weight, bias = layers[-1]
    return sizes, preactivations, hidden @ weight + bias


def _input_jacobians(layers: Layers, preactivations: list[Array], activation: Activation) -> list[Array]:
    """Returns J_l [n, width] of the hidden layers with these preactivations, and of the output."""
    jacobians = [layers[0][0]]
    for preactivation, (weight, _) in zip(preactivations, layers[1:], strict=False):
        jacobians.append((activation.first(preactivation) * jacobians[-1]) @ weight)
    return jacobians


def _each_output(function, weight: Array):
    """Returns function(weight[:, k]), stacked over the outputs k. A single output is computed without the axis, because
    XLA's sums over an axis of length 1 are slow."""
    if weight.shape[1] == 1:
        return jax.tree.map(lambda leaf: leaf[None], function(weight[:, 0]))
    return jax.vmap(function, in_axes=1)(weight)


def _gradient(layers: Layers, preactivations: list[Array], adjoint: Array, activation: Activation) -> Float[Array, "n"]:
    """dy/dx from dy/dh_L."""
    for preactivation, (weight, _) in zip(reversed(preactivations), reversed(layers[:-1]), strict=True):
        adjoint = (activation.first(preactivation) * adjoint) @ weight.T
    return adjoint


@jax.custom_jvp
def _congruence(jacobian: Float[Array, "n width"], curvature: Float[Array, "width"]) -> Float[Array, "n n"]:
    """J diag(c) Jᵀ."""
    return (jacobian * curvature) @ jacobian.T


@_congruence.defjvp
def _congruence_jvp(primals, tangents):
    """d(J c Jᵀ) = M + Mᵀ with M = (dJ c + J dc / 2) Jᵀ: one small product per state, and one in reverse, where the
    rules for the factors take two. This saves a sixth of a training step (batch 512, width 128)."""
    jacobian, curvature = primals
    jacobian_dot, curvature_dot = tangents
    half = (jacobian_dot * curvature + jacobian * (curvature_dot / 2)) @ jacobian.T
    return _congruence(jacobian, curvature), half + half.T


def _derivatives_by_two_sweeps(
    layers: Layers, preactivations: list[Array], activation: Activation
) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
    jacobians = _input_jacobians(layers[:-1], preactivations, activation)
    inputs, width = jacobians[0].shape
    # J_1 = W_1 is the same for all states of a batch. With its products formed first, the term is one matrix product.
    first_products = (jacobians[0][:, None] * jacobians[0]).reshape(inputs * inputs, width)

    def sweep(adjoint: Array) -> tuple[Array, Array]:
        hessian = jnp.zeros((inputs, inputs), adjoint.dtype)
        for index in reversed(range(len(preactivations))):
            curvature = adjoint * activation.second(preactivations[index])
            if index:
                hessian += _congruence(jacobians[index], curvature)
            else:
                hessian += (first_products @ curvature).reshape(inputs, inputs)
            adjoint = (activation.first(preactivations[index]) * adjoint) @ layers[index][0].T
        return adjoint, hessian

    return _each_output(sweep, layers[-1][0])


def _derivatives_by_forward_sweep(
    layers: Layers, preactivations: list[Array], activation: Activation
) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
    jacobians = _input_jacobians(layers, preactivations, activation)
    inputs = jacobians[0].shape[0]
    rows, columns = np.triu_indices(inputs)
    seconds = jnp.zeros((len(rows), jacobians[0].shape[1]), jacobians[0].dtype)  # S_l [pairs, width]
    for index, preactivation in enumerate(preactivations):
        products = jacobians[index][rows] * jacobians[index][columns]
        curved = activation.second(preactivation) * products
        if index:
            curved += activation.first(preactivation) * seconds
        seconds = curved @ layers[index + 1][0]
    pair_of = np.zeros((inputs, inputs), int)
    pair_of[rows, columns] = pair_of[columns, rows] = np.arange(len(rows))
    return jacobians[-1].T, seconds.T[:, pair_of]
