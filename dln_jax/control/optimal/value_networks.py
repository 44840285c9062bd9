"""Networks for the cost to go: zero at the goal, positive elsewhere, with gradients in the same pass.

    V(x) = (z - z0)ᵀ L(z) L(z)ᵀ (z - z0)

L is lower triangular with a positive diagonal; its entries are the outputs of a differential network of z - z0 (Lutter
et al. 2021, arXiv:2105.04682). z holds the sines and cosines of angles and the other states in units of the box.
Without hidden layers L is constant and V a quadratic form, which solves a linear-quadratic problem exactly. The
parameters have a leading axis of ensemble members; V and V_x are means over the members. The module `fitted` fits the
parameters by rollouts.

`fit_hjb` fits the parameters to the Hamilton-Jacobi-Bellman equation by Levenberg-Marquardt in float64. It minimises
the mean square over the box of

    (rho V + g*(-Bᵀ V_x) - q - aᵀ V_x) / (mean of q)

The equation has several solutions, and only one is the cost to go. With a large discount this solution is near q / rho,
far from the others. Training starts there and follows the solution while the discount decreases to the problem's value
(continuation: Lutter, Belousov et al. 2019). Every fit draws new samples; unseen samples select the parameters.
"""

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh
from jaxtyping import Float

from dln_jax.control.optimal.problem import (
    ControlProblem,
    Disturbance,
    checked,
    features,
    hjb_residual,
    optimal_control,
    uniform,
)
from dln_jax.errors import require_network
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import Activation, softplus, tanh
from dln_jax.precision import quick_compilation
from dln_jax.process import held_back
from dln_jax.scale import local, of_first_process, program
from dln_jax.solvers import levenberg_marquardt
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
    """Discount of the fitted equation, 1/s."""


class ValueFit(NamedTuple):
    """Result of a fit."""

    parameters: Any
    """Parameters with the lowest validation."""
    validation: float
    history: list[ValueProgress]
    train_seconds: float
    compile_seconds: float = 0.0
    """Compilation time, not included in `train_seconds`."""


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


def discounts_down_to(discount: float, *, first: float = 30.0, ratio: float = 0.5, last: float = 0.01) -> list[float]:
    """Returns discount + first ratioᵏ while the second term is at least `last`, then the discount, all in 1/s.

    Args:
        discount: rho of the problem.
        first: first increment; V is then about q / (rho + first).
        ratio: ratio of consecutive increments, between 0 and 1.
        last: lower bound of the increments.

    Raises:
        InputError: a number is out of range.
    """
    require_positive(first=first, ratio=ratio, last=last)
    if not ratio < 1:
        raise InputError(f"ratio is {ratio}; expected less than 1 for a decreasing discount")
    steps = max(int(np.floor(np.log(last / first) / np.log(ratio))), 0) + 1
    return [*(discount + first * ratio**step for step in range(steps)), discount]


def fit_hjb(
    problem: ControlProblem,
    value_and_gradient: Callable[[Any, Array], tuple[Array, Array]],
    parameters: Any,
    key: Array,
    *,
    discounts: Sequence[float] | None = None,
    samples: int = 4096,
    validation: int = 2048,
    iterations: int = 20,
    rounds: int = 10,
    patience: int = 2,
    disturbance: Disturbance | None = None,
    mesh: Mesh | None = None,
    report: Callable[[ValueProgress], None] = lambda progress: None,
) -> ValueFit:
    """Fits a value function to the equation, in float64.

    Args:
        problem: the control problem.
        value_and_gradient: (parameters, x) -> V and V_x, for example of `value_network`.
        parameters: initial parameters, float64.
        key: random key of the samples.
        discounts: decreasing to the problem's discount; by default from `discounts_down_to`.
        samples: number of samples per draw, uniform in the box.
        validation: number of samples that select the parameters.
        iterations: largest number of Levenberg-Marquardt iterations per draw of samples.
        rounds: largest number of draws at the last discount.
        patience: the fit ends after this many rounds without a lower validation.
        disturbance: worst-case disturbance, for a robust value function.
        mesh: devices that share the samples of a fit.
        report: called after every draw with the root mean square residuals relative to the mean of q: `loss` on the
            fitted samples and `validation` on unseen samples, at this discount.

    Raises:
        InputError: the problem is invalid, the discounts do not end with its own, or the equation is not finite.
    """
    problem = checked(problem)
    require_positive(samples=samples, validation=validation, iterations=iterations, rounds=rounds, patience=patience)
    discounts = discounts_down_to(problem.discount) if discounts is None else list(discounts)
    if not discounts or discounts[-1] != problem.discount:
        raise InputError(f"discounts are {discounts}; expected a list that ends with the problem's, {problem.discount}")
    of_draws, of_validation = jax.random.split(key)
    unseen = uniform(problem, of_validation, validation)
    unit = float(jnp.mean(jax.vmap(problem.state_cost)(unseen)))

    def residual(parameters: Any, x: Array, discount: Array) -> Array:
        value, slope = value_and_gradient(parameters, x)
        left = hjb_residual(problem._replace(discount=discount), x, value, slope)
        if disturbance is not None:
            left -= disturbance(x, slope, optimal_control(problem, x, slope)) @ slope
        return left / unit

    @functools.partial(program, mesh=mesh, compiler_options=quick_compilation())
    def advance(parameters: Any, x: Array, discount: Array) -> tuple[Any, Array]:
        chunks = levenberg_marquardt.in_chunks((x, jnp.full(len(x), discount)), mesh)
        start = levenberg_marquardt.init(parameters)
        state = levenberg_marquardt.run_on_chunks(residual, start, chunks, iterations, samples=samples, mesh=mesh)
        return state.parameters, jnp.sqrt(state.loss)

    @functools.partial(program, mesh=mesh)
    def validated(parameters: Any, discount: Array) -> Array:
        return jnp.sqrt(jnp.mean(jax.vmap(residual, (None, 0, None))(parameters, unseen, discount) ** 2))

    history: list[ValueProgress] = []
    began = time.perf_counter()

    def fitted(parameters: Any, discount: float) -> Any:
        x = uniform(problem, jax.random.fold_in(of_draws, len(history)), samples)
        with held_back():  # as in `fitted.fit_values`
            parameters, loss = advance(parameters, x, jnp.asarray(discount))
            # This number decides the number of rounds, so all processes must use the same value.
            left = of_first_process(float(validated(parameters, jnp.asarray(discount))), mesh)
            passed = time.perf_counter() - began
            history.append(ValueProgress(len(history) + 1, float(loss), float(left), passed, discount))
        report(history[-1])
        return parameters

    for discount in discounts[:-1]:
        parameters = fitted(parameters, discount)
    best, lowest, since = parameters, np.inf, 0
    for _ in range(rounds):
        parameters = fitted(parameters, problem.discount)
        score = history[-1].validation
        best, lowest, since = (parameters, score, 0) if score < lowest else (best, lowest, since + 1)
        if since >= patience:
            break
    if not np.isfinite(lowest):
        raise InputError(
            "the equation is not finite at the samples; find states where the plant or a cost is not finite"
        )
    return ValueFit(local(best, mesh), float(lowest), history, history[-1].seconds)
