"""Chooses a swing-up's gains, catch region and regulator by simulated trials of a model, in one compiled program.

1. Numbers without units (`scales.RANGES`) are drawn; scales of the model make gains and a regulator of them.
2. Every set is tried from a few starts near hanging, with the hardware's limits, resolution, noise and delay.
3. The best sets are tried again with motors that are stronger or weaker than the model says. The margin of a set is
   the largest such error up to which every trial succeeds; the set with the largest margin is chosen.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.closed_loop import Controller, Hardware, simulate
from dln_jax.control.observers import with_differences
from dln_jax.control.plants.plant import Layout
from dln_jax.control.plants.runs import HELD, TOLERANCE
from dln_jax.control.plants.scales import RANGES, circle, scales_of, swing_up_numbers
from dln_jax.control.plants.simulated import ACTIVE_SPREAD, SPREAD
from dln_jax.control.regulators import Regulator
from dln_jax.control.state_space import Law, error, field_of
from dln_jax.control.swing_up import SwingUpNumbers, Upright, law_at, upright_of
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.types import InputError, require_positive, require_seed

ERRORS = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3, 0.4)
"""Relative errors of the motors' strength in the second round."""
STARTS = 2
"""Starts of a set in the first round."""
FINALISTS = 8
ROUNDS = 4
"""First rounds, at most, until `FINALISTS` sets have succeeded."""
FASTEST_FILTER = 50.0
"""Cut-off frequency of measured rates, Hz, and at most a quarter of the samples' rate."""


class Tuned(NamedTuple):
    """Settings that swing the model up, and how safely."""

    law: Law
    """(q, qd) -> u."""
    numbers: SwingUpNumbers
    regulator: Regulator
    upright: Upright
    trials: int
    """Number of simulated trials."""
    worked: float
    """Share of the sets of the first rounds whose trials all succeeded."""
    margin: float
    """Relative error of the motors' strength up to which every trial of this set succeeded."""
    seconds: float
    """Median time until the goal at the model's own strength, s."""


def cutoff_for(rate: float) -> float:
    """Cut-off frequency of the rates, Hz, from the rate of the samples."""
    return min(FASTEST_FILTER, rate / 4)


def controller_of(law: Law, layout: Layout) -> Controller:
    """The law with rates from differences of the measurements."""
    return with_differences(law, len(layout.joints), rate=layout.rate, cutoff=cutoff_for(layout.rate))


def tune(
    model: Dynamics | PlainDynamics,
    layout: Layout,
    hardware: Hardware = Hardware(),  # noqa: B008
    *,
    sets: int = 128,
    seconds: float = 8.0,
    substeps: int = 1,
    seed: int = 0,
) -> Tuned:
    """Chooses all settings of a swing-up by trials.

    Args:
        model: known or learned, with friction if the plant has it.
        layout: of the plant: its motors, goal, limits and rate.
        hardware: noise, resolution and delay; the limits are those of the layout.
        sets: number of sets in a first round.
        seconds: duration of a trial, within which a plant has to be up and stay for a second.
        substeps: Runge-Kutta steps a sample.
        seed: of the sets, the starts and the noise.

    Raises:
        InputError: a model that `swing_up` refuses, or of which no set swings it up.
    """
    require_positive(sets=sets, substeps=substeps)
    require_seed(seed)
    if not seconds > HELD:
        raise InputError(f"seconds is {seconds}; expected more than the {HELD:g} s for which a plant has to stay up")
    lower, upper = layout.limits.control.T
    upright = upright_of(model, layout.actuation, layout.goal, postures=circle(layout), lower=lower, upper=upper)
    scales, random = scales_of(upright, layout), np.random.default_rng([seed, 31])
    lanes = max(sets * STARTS, FINALISTS * len(ERRORS) * STARTS)
    program = jax.jit(jax.vmap(trial_of(upright, layout, hardware, seconds=seconds, substeps=substeps)))
    settings: list[tuple[SwingUpNumbers, Regulator]] = []
    times = np.zeros((0, STARTS))
    trials = 0

    def tried(chosen: list[tuple[SwingUpNumbers, Regulator]], errors: tuple[float, ...], starts: int) -> np.ndarray:
        """Times [set, error, start]; idle lanes repeat the first trial."""
        nonlocal trials
        numbers = [(_traced(one), regulator) for one, regulator in chosen]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *numbers)
        count = len(chosen) * len(errors) * starts
        place = np.arange(lanes) % count
        which, error_of, start_of = np.unravel_index(place, (len(chosen), len(errors), starts))
        drawn = layout.hanging + _spread(layout) * random.normal(size=(starts, len(layout.joints)))
        keys = jax.random.split(jax.random.key(int(random.integers(2**31))), lanes)
        parts = jax.tree.map(lambda leaf: leaf[which], stacked)
        result = program(parts, drawn[start_of], 1 + np.array(errors)[error_of], keys)
        trials += count
        return np.asarray(result)[:count].reshape(len(chosen), len(errors), starts)

    for _ in range(ROUNDS):
        drawn = _draws(random, sets)
        fresh = [swing_up_numbers(upright, layout, scales, numbers) for numbers in drawn]
        settings += fresh
        times = np.concatenate([times, tried(fresh, (0.0,), STARTS)[:, 0]])
        if np.isfinite(times).all(axis=1).sum() >= FINALISTS:
            break
    good = np.isfinite(times).all(axis=1)
    if not good.any():
        raise InputError(
            f"none of {len(settings)} sets of gains swings the model up within {seconds:g} s and its limits in "
            f"{trials} trials, of which {np.isfinite(times).mean():.0%} came up; a stronger motor, wider limits, more "
            "time or a better model may"
        )
    best = np.argsort(np.where(good, times.max(axis=1), np.inf))[: min(FINALISTS, int(good.sum()))]
    starts = max(STARTS, lanes // (FINALISTS * len(ERRORS)))
    final = tried([settings[k] for k in best], ERRORS, starts)
    margins = np.array([_margin(np.isfinite(one).all(axis=1)) for one in final])
    share = np.isfinite(final).mean(axis=(1, 2))
    nominal = np.median(final[:, 0], axis=1)
    order = np.lexsort((nominal, -share, -margins))
    choice = int(order[0])
    if margins[choice] < 0:
        raise InputError(
            f"of {trials} trials, no set of gains brings all {starts} starts up at the model's own strength: the best "
            f"reaches {np.isfinite(final[:, 0]).mean(axis=1).max():.0%}; a stronger motor or wider limits may"
        )
    numbers, regulator = settings[best[choice]]
    law = law_at(upright, layout.joints, numbers, regulator)
    worked = float(good.mean())
    return Tuned(law, numbers, regulator, upright, trials, worked, float(margins[choice]), float(nominal[choice]))


def trial_of(
    upright: Upright, layout: Layout, hardware: Hardware, *, seconds: float, substeps: int
) -> Callable[[Any, Array, Array, Array], Array]:
    """(traced settings, start [d], strength of the motors, key) -> time in s until the goal, infinite if never."""
    B, d = layout.actuation, len(layout.joints)
    lower, upper = layout.limits.control.T
    field = field_of(upright.model, B)
    limited = hardware._replace(lower=lower, upper=upper, sees_rates=False)
    angles = np.array([kind == "revolute" for kind in layout.joints])
    has_limits = np.isfinite(layout.limits.position).any() or np.isfinite(layout.limits.rate).any()
    # One set of smoothing and compensation for all: they are no arrays of the trial.
    plain = swing_up_numbers(upright, layout, scales_of(upright, layout), {name: 1.0 for name in RANGES})[0]

    def trial(settings: Any, start: Array, strength: Array, key: Array) -> Array:
        (gains, level, kick, surplus), regulator = settings
        numbers = plain._replace(gains=gains, level=level, kick=kick, surplus=surplus)
        controller = controller_of(law_at(upright, layout.joints, numbers, regulator), layout)
        run = simulate(
            lambda x, u: field(x, strength * u), controller, jnp.concatenate([start, jnp.zeros(d)]),
            seconds=seconds, rate=layout.rate, controls=B.shape[1], hardware=limited, key=key, substeps=substeps,
        )  # fmt: skip
        off = jax.vmap(lambda x: error(x[:d], layout.goal, layout.joints))(run.x)
        away = ~(jnp.max(jnp.abs(off[:, angles]), axis=1) <= TOLERANCE)  # NaN is away
        last = jnp.max(jnp.where(away, run.t + 1 / layout.rate, 0.0))
        fine = last <= seconds - HELD
        if has_limits:
            q, qd = run.x[:, :d], run.x[:, d:]
            ahead = q + layout.limits.stopping * qd
            low, high = layout.limits.position.T
            fine &= jnp.all((jnp.minimum(q, ahead) >= low) & (jnp.maximum(q, ahead) <= high))
            fine &= jnp.all(jnp.abs(qd) <= layout.limits.rate)
        return jnp.where(fine, last, jnp.inf)

    return trial


def _traced(numbers: SwingUpNumbers) -> Any:
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, float), (numbers.gains, numbers.level, numbers.kick, numbers.surplus)
    )


def _draws(random: np.random.Generator, count: int) -> list[dict[str, float]]:
    """Sets of numbers, alternately with the energy of the passive part and of the whole plant."""
    low, high = np.log(np.array(list(RANGES.values()))).T
    rows = np.exp(random.uniform(low, high, size=(count, len(RANGES))))
    return [{**dict(zip(RANGES, row, strict=True)), "total": float(k % 2)} for k, row in enumerate(rows)]


def _spread(layout: Layout) -> np.ndarray:
    return np.where((layout.actuation != 0).any(axis=1), ACTIVE_SPREAD, SPREAD)


def _margin(succeeded: np.ndarray) -> float:
    """Largest error up to which all trials succeeded; negative if there is none."""
    failed = [abs(error) for error, fine in zip(ERRORS, succeeded, strict=True) if not fine]
    return max((abs(error) for error in ERRORS if not failed or abs(error) < min(failed)), default=-1.0)
