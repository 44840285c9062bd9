"""The optimisers of `fit`, as records of all their settings, and the choice between them."""

import math
from typing import Any, NamedTuple

import optax

from dln_jax.precision import require_float64
from dln_jax.solvers.levenberg_marquardt import CHUNK
from dln_jax.solvers.normal_equations import count, jacobian_bytes
from dln_jax.types import InputError, require_positive

MOST_PARAMETERS = 2_000
"""With more parameters P, the P³ of one iteration costs more than a thousand steps of Adam, so `suited` takes Adam."""
MOST_BYTES = 2**31
"""Largest memory that `suited` allows for the normal equations and a chunk of the Jacobian."""


class Adam(NamedTuple):
    """AdamW on minibatches: linear warm-up of the learning rate, then cosine decay.

    The second moment forgets within a hundred steps by default. Residuals shrink by orders of magnitude during a run,
    and a longer memory keeps the steps too small: the validation torque MSE is 9e-7, against 4e-6 with 0.999 and the
    best of three learning rates.
    """

    steps: int = 20_000
    """Rounded up to whole epochs."""
    batch: int = 512
    """Samples per step, drawn without replacement; at most all of them."""
    learning_rate: float = 5e-3
    """Peak of the schedule."""
    weight_decay: float = 1e-5
    """Decoupled weight decay."""
    patience: int = 10_000
    """Training stops after this many steps without a lower score."""
    second_moment_decay: float = 0.99
    warm_up_share: float = 0.02
    """Share of the steps in the warm-up; 0 with a final share of 1 gives a constant rate."""
    final_share: float = 1e-3
    """Learning rate after the last step, as a share of the peak."""
    steps_per_dispatch: int = 200
    """Steps between two scores; rounded up to whole epochs."""
    rule: optax.GradientTransformation | None = None
    """Another optimiser of optax in place of AdamW and its schedule, in memory only."""


class GaussNewton(NamedTuple):
    """Levenberg-Marquardt on all samples at once, in float64.

    With many more samples than parameters, a run may take its first iterations on a subset, at a fraction of the cost,
    and its last ones on all samples.
    """

    steps: int = 150
    """Largest number of iterations on all samples."""
    coarse_steps: int = 0
    """Largest number of iterations on the first `coarse_samples`, before those on all."""
    coarse_samples: int = 2_048
    """The first samples, so they must be in random order. Sets with fewer than twice as many skip that stage."""
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


def check(optimiser: Optimiser) -> None:
    """Raises `InputError` for settings out of range."""
    require_positive(steps=optimiser.steps, steps_per_dispatch=optimiser.steps_per_dispatch)
    if isinstance(optimiser, GaussNewton):
        require_positive(coarse_samples=optimiser.coarse_samples)
        if optimiser.coarse_steps < 0:
            raise InputError(f"coarse_steps is {optimiser.coarse_steps}; expected 0 for none or a positive number")
        return
    require_positive(batch=optimiser.batch, patience=optimiser.patience, learning_rate=optimiser.learning_rate)
    for name in ("learning_rate", "weight_decay"):
        if not 0 <= (value := getattr(optimiser, name)) < math.inf:
            raise InputError(f"{name} is {value}; expected a finite number, zero or positive")


def transformation(adam: Adam) -> optax.GradientTransformation:
    """AdamW with these settings, or the stated rule."""
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


def suited(parameters: Any, samples: int, residuals: int) -> tuple[type[Adam] | type[GaussNewton], str]:
    """Returns the optimiser that suits parameters of these shapes, and a sentence with the reason.

    Gauss-Newton brings P parameters to errors of 1e-8 and below in seconds while its P x P equations are small; the
    cost of Adam's steps grows only with P.
    """
    size = count(parameters)
    needed = jacobian_bytes(parameters, samples, residuals, chunk_size=CHUNK, keep=False)
    if size <= MOST_PARAMETERS and needed <= MOST_BYTES:
        return GaussNewton, f"{size:,} parameters: the normal equations take {needed / 2**20:,.0f} MiB"
    limit = f"{MOST_PARAMETERS:,} parameters" if size > MOST_PARAMETERS else f"{MOST_BYTES / 2**30:.0f} GiB"
    return Adam, f"{size:,} parameters need {needed / 2**20:,.0f} MiB of normal equations; the limit is {limit}"


NAMES: dict[str, type[Optimiser]] = {"adam": Adam, "gauss-newton": GaussNewton}


def optimiser_named(name: str, *, precision: str, **settings: Any) -> Optimiser:
    """Builds an optimiser by name. Settings that it lacks are ignored; a setting of `None` takes its default.

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


def name_of(optimiser: Optimiser | type[Optimiser]) -> str:
    """The name of an optimiser in command lines."""
    kind = optimiser if isinstance(optimiser, type) else type(optimiser)
    return next(name for name, optimiser_kind in NAMES.items() if optimiser_kind is kind)
