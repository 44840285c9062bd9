"""The optimisers of `fit`: their settings, the choice between them, and Adam as a stage of a run.

A dispatch of Adam runs whole epochs in one loop on the device, with on-device shuffling. Validation chooses the best
parameters. The permutation of an epoch depends only on the run's key and the epoch number, so a resumed run takes
exactly the same steps as an uninterrupted one.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from dln_jax.learning.engine.problem import (
    Best,
    Dispatch,
    Problem,
    Sharing,
    Stage,
    Stop,
    better_of,
    by_devices,
    loss_of,
    no_best,
)
from dln_jax.precision import require_float64
from dln_jax.scale import first, mean, share, shares
from dln_jax.solvers.levenberg_marquardt import CHUNK
from dln_jax.solvers.normal_equations import count, jacobian_bytes
from dln_jax.types import InputError, require_positive

MOST_PARAMETERS = 2_000
"""With more parameters P, one iteration (P³) costs more than a thousand Adam steps, so `suited` chooses Adam."""
MOST_BYTES = 2**31
"""Largest memory that `suited` allows for the normal equations and a chunk of the Jacobian."""


class Adam(NamedTuple):
    """Settings of AdamW on minibatches (Kingma and Ba 2015; Loshchilov and Hutter 2019), for `fit`.

    With the gradient g of a batch, a step is m ← β₁ m + (1 - β₁) g, v ← β₂ v + (1 - β₂) g², then
    w ← w - η (m / (1 - β₁ᵗ) / √(v / (1 - β₂ᵗ)) + λ w). The learning rate η rises linearly, then decays as a cosine.

    The default β₂ of 0.99 forgets within a hundred steps. Residuals shrink by orders of magnitude during a run, so a
    longer memory keeps the steps too small: the two-link arm reaches a validation torque MSE of 9e-7, against 4e-6 with
    0.999 and the best of three learning rates.

    Raises:
        InputError: `fit` refuses settings out of range.

    Example:
        >>> import jax.numpy as jnp
        >>> import dln_jax
        >>> x = jnp.linspace(-1.0, 1.0, 64)
        >>> line = dln_jax.Problem(
        ...     residual=lambda w, x, y: w[0] * x + w[1] - y,
        ...     parameters=jnp.zeros(2),
        ...     arrays=(x, 3 * x + 1),
        ...     score=lambda w: (jnp.mean((w[0] * x + w[1] - 3 * x - 1) ** 2), jnp.nan),
        ... )
        >>> fit = dln_jax.fit(line, dln_jax.Adam(steps=400, batch=16, learning_rate=0.1))
        >>> print(fit.parameters.round(2))
        [3. 1.]
    """

    steps: int = 20_000
    """Number of steps, rounded up to whole epochs."""
    batch: int = 512
    """Samples per step, drawn without replacement; at most all of them."""
    learning_rate: float = 5e-3
    """Largest learning rate η."""
    weight_decay: float = 1e-5
    """Decoupled weight decay λ."""
    patience: int = 10_000
    """Training stops after this many steps without a lower score."""
    second_moment_decay: float = 0.99
    """Decay β₂ of the second moment per step."""
    warm_up_share: float = 0.02
    """Fraction of the steps that warm up; 0 with a `final_share` of 1 gives a constant rate."""
    final_share: float = 1e-3
    """Learning rate after the last step, as a fraction of the largest."""
    steps_per_dispatch: int = 200
    """Steps between two scores, rounded up to whole epochs."""
    rule: optax.GradientTransformation | None = None
    """Any optimiser of optax, which replaces AdamW and its schedule; it is not stored."""


class GaussNewton(NamedTuple):
    """Settings of Gauss-Newton with Levenberg-Marquardt damping on all samples, in float64, for `fit`.

    With the residuals r of N samples and J = dr/dw, an iteration solves (JᵀJ / N + damping s I) v = -Jᵀr / N, adds the
    geodesic acceleration of Transtrum and Sethna (2012), and adapts the damping as Nielsen (1999) does.
    `solvers.levenberg_marquardt` has the details. With many more samples than parameters, a run may take its first
    iterations on a subset, which is cheaper.

    Raises:
        InputError: `fit` refuses settings out of range, and parameters that are not float64.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import dln_jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> x = jnp.linspace(0.0, 1.0, 50)
        >>> decay = dln_jax.Problem(
        ...     residual=lambda rate, x, y: jnp.exp(-rate * x) - y,
        ...     parameters=jnp.ones(()),
        ...     arrays=(x, jnp.exp(-2.5 * x)),
        ...     score=lambda rate: (jnp.mean((jnp.exp(-rate * x) - jnp.exp(-2.5 * x)) ** 2), jnp.nan),
        ... )
        >>> print(dln_jax.fit(decay, dln_jax.GaussNewton(steps=20)).parameters.round(6))
        2.5
    """

    steps: int = 150
    """Largest number of iterations on all samples."""
    coarse_steps: int = 0
    """Largest number of iterations on the first `coarse_samples`, before the iterations on all."""
    coarse_samples: int = 2_048
    """Size of the subset: the first samples, so give them in random order. A set with fewer than twice as many skips
    this stage."""
    improvement: float = 0.0
    """A stage ends when an iteration decreases the loss by less than this fraction."""
    target: float = -math.inf
    """Training stops at this score; with several seeds, all must reach it."""
    steps_per_dispatch: int = 5
    """Iterations between two scores."""

    def has_coarse_stage(self, samples: int) -> bool:
        """Whether a run on this number of samples starts on a subset of them."""
        return self.coarse_steps > 0 and samples >= 2 * self.coarse_samples


Optimiser = Adam | GaussNewton
NAMES: dict[str, type[Optimiser]] = {"adam": Adam, "gauss-newton": GaussNewton}
POSITIVE = ("steps", "steps_per_dispatch", "coarse_samples", "batch", "patience", "learning_rate")


def check(optimiser: Optimiser) -> None:
    """Raises `InputError` for settings out of range."""
    settings = optimiser._asdict()
    require_positive(**{name: settings[name] for name in POSITIVE if name in settings})
    for name in ("coarse_steps", "learning_rate", "weight_decay"):
        if not 0 <= settings.get(name, 0) < math.inf:
            raise InputError(f"{name} is {settings[name]}; expected a finite number, zero or positive")


def suited(parameters: Any, samples: int, residuals: int) -> tuple[str, str]:
    """Returns the name of the optimiser that suits parameters of these shapes, and the reason as a sentence.

    Gauss-Newton reaches errors of 1e-8 and below in seconds while its P x P equations are small. The cost of an Adam
    step grows only with P.
    """
    size = count(parameters)
    needed = jacobian_bytes(parameters, samples, residuals, chunk_size=CHUNK, keep=False)
    if size <= MOST_PARAMETERS and needed <= MOST_BYTES:
        return "gauss-newton", f"{size:,} parameters: the normal equations take {needed / 2**20:,.0f} MiB"
    limit = f"{MOST_PARAMETERS:,} parameters" if size > MOST_PARAMETERS else f"{MOST_BYTES / 2**30:.0f} GiB"
    return "adam", f"{size:,} parameters need {needed / 2**20:,.0f} MiB of normal equations; the limit is {limit}"


def optimiser_named(name: str, *, precision: str, **settings: Any) -> Optimiser:
    """Builds an optimiser by name; ignores settings of other optimisers, and `None` means the default.

    Raises:
        InputError: an unknown name, a setting out of range, or Gauss-Newton in a precision other than f64.
    """
    if name not in NAMES:
        raise InputError(f"optimizer is '{name}'; expected one of {', '.join(NAMES)}")
    kind = NAMES[name]
    if kind is GaussNewton:
        require_float64(precision)
    chosen = kind(**{key: settings[key] for key in kind._fields if settings.get(key) is not None})
    check(chosen)
    return chosen


def transformation(adam: Adam) -> optax.GradientTransformation:
    """Returns AdamW with these settings, or the given rule."""
    if adam.rule is not None:
        return adam.rule
    rate = adam.learning_rate
    if (adam.warm_up_share, adam.final_share) != (0, 1):
        warm_up = max(1, round(adam.warm_up_share * adam.steps))
        rate = optax.warmup_cosine_decay_schedule(
            init_value=adam.learning_rate / warm_up,
            peak_value=adam.learning_rate,
            warmup_steps=warm_up,
            decay_steps=max(adam.steps, warm_up + 1),
            end_value=adam.final_share * adam.learning_rate,
        )
    return optax.adamw(rate, b2=adam.second_moment_decay, weight_decay=adam.weight_decay)


class AdamState(NamedTuple):
    """State of a run; resuming from it is exact. Several seeds add a leading axis."""

    parameters: Any
    optimiser: optax.OptState
    key: Array
    """[2] raw key data, which needs no conversion for storing."""
    epoch: Array
    """[] epochs done."""
    step: Array
    """[] steps done."""
    best: Best
    failed_step: Array
    """[] step with the first non-finite loss, or -1. If set, all other fields are as before the dispatch."""


def stages(problem: Problem, adam: Adam, shared: Sharing) -> list[Stage]:
    """Returns the single stage of a run.

    Raises:
        InputError: the number of devices does not divide a batch.
    """
    samples = problem.arrays[0].shape[0]
    batch = min(adam.batch, samples)
    shares(shared.samples, batch, "samples of a batch")
    batches = samples // batch  # an epoch leaves out samples that do not fill a batch
    epochs = -(-adam.steps // batches)
    most = min(epochs, -(-adam.steps_per_dispatch // batches))
    loss, optimiser = loss_of(problem), transformation(adam)

    def begin(parameters: Any, seed: Any) -> AdamState:
        return AdamState(
            parameters=parameters,
            optimiser=optimiser.init(parameters),
            key=jax.random.key_data(jax.random.key(seed)),
            epoch=jnp.zeros((), jnp.int32),
            step=jnp.zeros((), jnp.int32),
            best=no_best(parameters),
            failed_step=jnp.asarray(-1, jnp.int32),
        )

    def batches_of(state: AdamState) -> Any:
        """Returns the batches of a dispatch, one permutation per epoch; each device gets its part of shared batches."""

        def order(epoch: Array) -> Array:
            key = jax.random.fold_in(jax.random.wrap_key_data(state.key), epoch)
            return _permutation(key, samples)[: batches * batch].reshape(batches, batch)

        orders = jax.vmap(order)(state.epoch + jnp.arange(most)).reshape(-1, batch)
        own = share(orders, shared.samples, axis=1)
        return jax.tree.map(lambda array: array[own], problem.arrays)

    def run(epochs: Array, before: AdamState) -> tuple[AdamState, Array]:
        """Runs some epochs of one seed and returns [loss, validation, monitor]; devices may share every batch."""
        drawn, dtype = batches_of(before), before.best.validation.dtype

        def step(index: Array, carry: tuple[AdamState, Array]) -> tuple[AdamState, Array]:
            state, total = carry
            some = jax.tree.map(lambda array: array[index], drawn)
            value, gradient = mean(jax.value_and_grad(loss)(state.parameters, some), shared.samples)
            updates, optimiser_state = optimiser.update(gradient, state.optimiser, state.parameters)
            state = state._replace(
                parameters=optax.apply_updates(state.parameters, updates),
                optimiser=optimiser_state,
                step=state.step + 1,
                # Step of the first non-finite loss; later steps are discarded with the dispatch.
                failed_step=jnp.where(jnp.isfinite(value) | (state.failed_step >= 0), state.failed_step, state.step),
            )
            return state, total + value

        # One flat loop with a traced length, because the last dispatch of a run may be shorter.
        steps = epochs * batches
        state, total = jax.lax.fori_loop(0, steps, step, (before, jnp.zeros((), dtype)))
        state = state._replace(epoch=before.epoch + epochs)
        finite = jnp.isfinite(optax.tree.norm(state.parameters))
        failed_step = jnp.where(finite | (state.failed_step >= 0), state.failed_step, state.step)
        # One copy per dispatch keeps the last good state; a test in every step would slow down the loop.
        state = jax.tree.map(lambda new, old: jnp.where(failed_step < 0, new, old), state, before)
        # Devices of different types may round differently, so all continue from the state of the first.
        state = first(state, shared.samples)
        value, shown = first(problem.score(state.parameters), shared.samples)
        best = better_of(state.best, state.parameters, value, state.step)
        values = jnp.stack([jnp.asarray(v, dtype) for v in (total / steps, value, shown)])
        return state._replace(failed_step=failed_step, best=best), values

    starts, runs = (jax.vmap(begin), jax.vmap(run, (None, 0))) if problem.several else (begin, run)
    dispatch = jax.jit(by_devices(runs, shared), donate_argnums=1)

    def left(state: AdamState) -> int:
        return epochs - int(np.max(state.epoch))

    def compile_(state: AdamState) -> Dispatch:
        compiled = dispatch.lower(most, state).compile()
        return lambda state: compiled(min(most, left(state)), state)

    def ended(state: AdamState) -> Stop | None:
        if np.all(np.asarray(state.failed_step) >= 0):
            return Stop("not finite", int(np.max(state.failed_step)))
        if left(state) <= 0:
            return Stop("finished", int(np.max(state.step)))
        if np.all(np.asarray(state.step - state.best.step) >= adam.patience):
            return Stop("no improvement", int(np.max(state.step)))
        return None

    return [Stage("", lambda before: jax.jit(starts)(problem.parameters, problem.seed), compile_, ended)]


def _permutation(key: Array, count: int) -> Array:
    """Returns a random order of 0..count-1.

    Up to 2^16 it sorts single words twice, with random bits above the index, four times as fast as
    `jax.random.permutation`. Ties in one sort keep the order of the other; at 2^16, about 0.5 pairs tie in both.
    """
    place_bits = max(1, (count - 1).bit_length())
    if place_bits > 16:
        return jax.random.permutation(key, count)
    words = jax.random.bits(key, (2, count), jnp.uint32) << place_bits
    ordered = jnp.sort(words | jnp.arange(count, dtype=jnp.uint32))
    first, second = (ordered & (2**place_bits - 1)).astype(jnp.int32)
    return first[second]
