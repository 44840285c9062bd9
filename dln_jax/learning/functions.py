"""Fits a differential network, or an ensemble, to samples of a function and its derivatives.

Type 1 losses use values and Jacobians, type 2 losses only values (the published names). Derivative 2 adds the Hessian
to either. All losses are means over samples of sums of squares over components, without weights between the terms:

    r = [y_hat - y, dy_hat/dx - dy/dx, d²y_hat/dx² - d²y/dx²],   loss = mean over samples of |r|².

The published recipe (Adam with decoupled weight decay, minibatches, constant rate) suits wide networks. For small
networks, Levenberg-Marquardt on all samples reduces the errors to the level of the noise.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh
from jaxtyping import Float

from dln_jax.data.arrays import on_device
from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.errors import require_network
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton, Optimiser
from dln_jax.learning.engine.problem import (
    Problem,
    Progress,
    ProgressReport,
    Training,
    loss_of,
    selected_by,
    silent,
    unmonitored,
)
from dln_jax.learning.select import Selection, select
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import Activation, activation
from dln_jax.nn.differential_mlp import Layers
from dln_jax.precision import data_type
from dln_jax.types import InputError, SampleVector, Scalar, require_positive, require_seed

LOSSES = ("type1", "type2")
MISSING = {
    "dy": "type1 fits the gradient, but the data have no dy; add it or choose type2",
    "d2y": "derivative 2 fits the Hessian, but the data have no d2y; add it or choose derivative 1",
}
WIDTHS = (2, 4, 8, 16)
"""Widths of the hidden layers, for `grow_width`."""
GAUSS_NEWTON = GaussNewton(steps=40, coarse_steps=200, improvement=1e-7)
"""Optimiser for networks of `WIDTHS`."""


class Network(NamedTuple):
    """Network and loss; the defaults are the published ones."""

    loss: str = "type1"
    """type1 or type2."""
    derivative: int = 1
    """2 adds the Hessian to the loss."""
    activation: str = "cos"
    width: int = 128
    depth: int = 1
    members: int = 1
    """Networks in the ensemble; they differ in their initial parameters."""
    precision: str = "f32"
    """f32 or f64; Gauss-Newton needs f64."""
    seed: int = 0
    """Seed for the initial parameters and the sample order."""


Targets = tuple[Array | None, ...]
"""x, y, dy and d2y of `FunctionSamples`; arrays that the loss does not use are `None` and never computed."""


def published_adam(samples: int, *, epochs: int = 500, batch: int = 512, learning_rate: float = 1e-3) -> Adam:
    """Returns the published recipe for this number of samples: a constant rate and no early stopping."""
    require_positive(epochs=epochs, batch=batch)
    steps = epochs * (samples // min(batch, samples))
    return Adam(
        steps=steps,
        batch=batch,
        learning_rate=learning_rate,
        weight_decay=1e-6,
        patience=steps,
        second_moment_decay=0.999,
        warm_up_share=0,
        final_share=1,
        steps_per_dispatch=max(1, min(450, steps // 20)),
    )


def targets(data: FunctionSamples, network: Network) -> Targets:
    """Returns the arrays that the loss uses, on the device.

    Raises:
        InputError: settings are out of range, the data lack a derivative, or the squares of numbers overflow.
    """
    require_positive(members=network.members)
    require_seed(network.seed)
    require_network(width=network.width, depth=network.depth)
    activation(network.activation)
    dtype = data_type(network.precision)
    if network.loss not in LOSSES:
        raise InputError(f"loss is '{network.loss}'; expected one of {', '.join(LOSSES)}")
    if network.derivative not in (1, 2):
        raise InputError(f"derivative is {network.derivative}; expected 1, or 2 to fit the Hessian too")
    read = ["x", "y", *["dy"] * (network.loss == "type1"), *["d2y"] * (network.derivative == 2)]
    if missing := [key for key in read if getattr(data, key) is None]:
        raise InputError(MISSING[missing[0]])
    return tuple(on_device(key, getattr(data, key), dtype) if key in read else None for key in FunctionSamples._fields)


def residual(
    layers: Layers, x: Array, y: Array, dy: Array | None, d2y: Array | None, *, activation: Activation
) -> Float[Array, "r"]:
    """Returns r of one sample: the concatenated errors of value, Jacobian and Hessian, where targets exist."""
    if d2y is not None:
        predicted = differential_mlp.value_jacobian_and_hessian(layers, x, activation=activation)
    elif dy is not None:
        predicted = differential_mlp.value_and_jacobian(layers, x, activation=activation)
    else:
        predicted = (differential_mlp.value(layers, x, activation=activation),)
    pairs = zip(predicted, (y, dy, d2y), strict=False)
    return jnp.concatenate([(ours - theirs).ravel() for ours, theirs in pairs if theirs is not None])


def problem(sets: SampleSplit, network: Network, *, together: bool) -> Problem:
    """Builds the problem of an ensemble: the sum of the members' losses, or members as seeds for Gauss-Newton."""
    ours, theirs = (targets(data, network) for data in sets)
    sizes = (sets.train.inputs, *(network.width,) * network.depth, sets.train.outputs)
    layers = differential_mlp.init_ensemble(
        jax.random.key(network.seed), sizes, members=network.members, dtype=data_type(network.precision)
    )
    of_sample = functools.partial(residual, activation=activation(network.activation))
    members = selected_by(theirs, of_sample, layers, ours, jnp.full(network.members, network.seed))
    if not together:
        return members
    loss = loss_of(members)

    def total(layers: Layers, batch: Targets) -> Scalar:
        """Sums the losses, which gives every member the same gradient as alone."""
        if network.members == 1:
            # An axis of one member would make all products batched, at two or three times the cost.
            return loss(jax.tree.map(lambda leaf: leaf[0], layers), batch)
        return jax.vmap(loss, (0, None))(layers, batch).sum()

    def score(layers: Layers) -> tuple[Scalar, Scalar]:
        return unmonitored(total(layers, theirs) / network.members)

    return Problem(None, layers, ours, score, network.seed, total)


def train(
    sets: SampleSplit,
    network: Network,
    optimiser: Optimiser,
    *,
    checkpoint: Checkpoint | None = None,
    report: ProgressReport = silent,
    mesh: Mesh | None = None,
) -> Training:
    """Fits the training samples and keeps the parameters with the lowest loss on the validation samples.

    The resulting layers have a leading axis of ensemble members, even for a single one. With Adam, all members see the
    same batches and share one best step; Gauss-Newton keeps the best step of each member. Reports and history are means
    over the members. Devices of a mesh split the members if Gauss-Newton trains several, otherwise the samples. Errors
    as for `targets` and `fit`.
    """
    together = isinstance(optimiser, Adam)
    members = network.members if together else 1

    def mean(at: Progress) -> Progress:
        loss, validation = float(np.mean(at.loss)) / members, float(np.mean(at.validation))
        return at._replace(loss=loss, validation=validation, monitor=np.nan)

    task = problem(sets, network, together=together)
    training = fit(task, optimiser, checkpoint=checkpoint, report=lambda at: report(mean(at)), mesh=mesh)
    return training._replace(history=[mean(at) for at in training.history], best_step=int(np.max(training.best_step)))


def grow_width(sets: SampleSplit, network: Network, fit: Callable[[Network], Training]) -> Selection:
    """Trains networks of `WIDTHS` with `fit` and chooses the smallest that no other one significantly improves.

    The outcome of a trial is its `Training`. Errors are |r|² of validation samples, averaged over the ensemble.
    """
    held_out = targets(sets.validation, network)
    of_sample = functools.partial(residual, activation=activation(network.activation))

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def squares(layers: Layers, sample: Any) -> Array:
        errors = jax.vmap(lambda member: of_sample(member, *sample))(layers)
        return jnp.mean(jnp.sum(errors**2, axis=1))

    def fit_and_judge(candidate: Network) -> tuple[Training, SampleVector]:
        training = fit(candidate)
        return training, np.asarray(squares(training.parameters, held_out))

    return select([network._replace(width=width) for width in WIDTHS], fit_and_judge, patience=2)
